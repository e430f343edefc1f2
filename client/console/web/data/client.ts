// The one place through which the page calls: the console's server passes each
// call on to revisitd.
import {Code, ConnectError, createClient, type Interceptor} from
    '@connectrpc/connect';
import {createConnectTransport} from '@connectrpc/connect-web';
import {signal} from '@preact/signals';

import {Health} from '../../gen/grpc/health/v1/health_pb.js';
import {PoseGraphService} from
    '../../gen/revisit/v1/pose_graph_service_pb.js';

const TOKEN_KEY = 'revisit-token';
const DEADLINE_MILLISECONDS = 20_000;

/** The bearer token that was pasted, or ''. It is kept for this tab only. */
export const token = signal(sessionStorage.getItem(TOKEN_KEY) ?? '');

/** How the last call went, as far as that concerns all calls. */
export type Connection =
    {state: 'connecting'}|{state: 'connected'}|
    {state: 'unreachable', since: Date, message: string}|
    {state: 'unauthenticated', message: string};
export const connection = signal<Connection>({state: 'connecting'});

export function signIn(pasted: string): void {
  const value = pasted.trim().replace(/^Bearer\s+/i, '');
  if (value === '') {
    sessionStorage.removeItem(TOKEN_KEY);
  } else {
    sessionStorage.setItem(TOKEN_KEY, value);
  }
  token.value = value;
}

function note(error: unknown): void {
  const {code, rawMessage: message} = ConnectError.from(error);
  if (code === Code.Unauthenticated) {
    connection.value = {state: 'unauthenticated', message};
  } else if (code === Code.Unavailable || code === Code.Unknown) {
    const before = connection.value;
    const since = before.state === 'unreachable' ? before.since : new Date();
    connection.value = {state: 'unreachable', since, message};
  } else if (code !== Code.Canceled && code !== Code.DeadlineExceeded) {
    connection.value = {state: 'connected'};
  }
}

/** The headers that every call bears, the worker's too. */
export function credentials(): Record<string, string> {
  return token.value ? {authorization: `Bearer ${token.value}`} : {};
}

const withCredentials: Interceptor = next => async request => {
  for (const [name, value] of Object.entries(credentials())) {
    request.header.set(name, value);
  }
  try {
    const answer = await next(request);
    connection.value = {state: 'connected'};
    return answer;
  } catch (error) {
    note(error);
    throw error;
  }
};

const transport = createConnectTransport({
  baseUrl: location.origin,
  useBinaryFormat: true,
  defaultTimeoutMs: DEADLINE_MILLISECONDS,
  interceptors: [withCredentials],
});

export const service = createClient(PoseGraphService, transport);
export const health = createClient(Health, transport);

/** Tells people what went wrong: the server's messages stand alone. */
export function messageOf(error: unknown): string {
  const {code, rawMessage} = ConnectError.from(error);
  return `${rawMessage} (${
      Code[code].replace(/(?<=[a-z])(?=[A-Z])/g, ' ').toLowerCase()})`;
}

/**
 * Empty pages that may follow each other. The service sends none before the last
 * one.
 */
const MOST_EMPTY_PAGES = 100;

/**
 * Reads all pages of a list. Fails if a page has the token of the one before it, or
 * if too many empty ones follow each other: such a list might never end.
 */
export async function allPages<Page extends {nextPageToken: string}, Item>(
    list: (pageToken: string) => Promise<Page>,
    items: (page: Page) => Item[]): Promise<Item[]> {
  const all: Item[] = [];
  let pageToken = '';
  let emptyPages = 0;
  do {
    const page = await list(pageToken);
    const onPage = items(page);
    for (const item of onPage) all.push(item);
    emptyPages = onPage.length === 0 ? emptyPages + 1 : 0;
    const repeats = pageToken !== '' && page.nextPageToken === pageToken;
    if (repeats || emptyPages > MOST_EMPTY_PAGES) {
      throw new Error('the server\'s list does not go on');
    }
    pageToken = page.nextPageToken;
  } while (pageToken !== '');
  return all;
}

/**
 * Calls `work` again and again while the page is in view, waiting at least
 * `interval` milliseconds between two calls and four times as long as the last
 * one took (a minute at most), so that a large fleet or graph is not asked for
 * all the time. Errors do not end it. Returns how to end it.
 */
export function repeat(interval: number, work: () => Promise<void>):
    () => void {
  let ended = false;
  const run = async () => {
    while (!ended) {
      const began = performance.now();
      let failed = false;
      if (!document.hidden) {
        await work().catch((error: unknown) => {
          failed = true;
          if (!(error instanceof ConnectError)) console.error(error);
        });
      }
      const pause = failed ? interval : Math.max(
          interval, Math.min(60_000, 4 * (performance.now() - began)));
      await new Promise(done => setTimeout(done, pause));
    }
  };
  void run();
  return () => {
    ended = true;
  };
}
