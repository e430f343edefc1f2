// The one place through which the page calls: the console's server passes each
// call on to revisitd.
import {Code, ConnectError, createClient, type Interceptor} from
    '@connectrpc/connect';
import {createConnectTransport} from '@connectrpc/connect-web';
import {signal} from '@preact/signals';

import {Health} from '../../gen/grpc/health/v1/health_pb.js';
import {PoseGraphService} from
    '../../gen/revisit/v1/pose_graph_service_pb.js';
import {errorInfoOf} from '../../shared/error_info.js';

const TOKEN_KEY = 'revisit-token';
const DEADLINE_MILLISECONDS = 20_000;
/** A call that takes longer lets the server be asked whether it is there. */
const SLOW_MILLISECONDS = 1000;
const PROBE_MILLISECONDS = 1500;
/** Header by which a call is found in the server's log. */
const REQUEST_ID = 'x-request-id';

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

function missed(message: string): void {
  const before = connection.value;
  const since = before.state === 'unreachable' ? before.since : new Date();
  connection.value = {state: 'unreachable', since, message};
}

function found(): void {
  if (connection.value.state === 'unreachable') {
    connection.value = {state: 'connected'};
  }
}

/** Whether a server answered that it still reads the histories of a group. */
export function isReadingGroup(error: unknown): boolean {
  return errorInfoOf(error)?.reason === 'GROUP_NOT_READY';
}

function note(error: unknown): void {
  const {code, rawMessage: message} = ConnectError.from(error);
  if (isReadingGroup(error)) {
    connection.value = {state: 'connected'};
    return;
  }
  if (code === Code.Unauthenticated) {
    connection.value = {state: 'unauthenticated', message};
  } else if (code === Code.Unavailable || code === Code.Unknown) {
    missed(message);
  } else if (code !== Code.Canceled && code !== Code.DeadlineExceeded) {
    connection.value = {state: 'connected'};
  }
}

/** The headers that every call bears, the worker's too. */
export function credentials(): Record<string, string> {
  return token.value ? {authorization: `Bearer ${token.value}`} : {};
}

/** Names a call for the server's log. */
function newRequestId(): string {
  const bytes = crypto.getRandomValues(new Uint8Array(8));
  return 'console-' +
      Array.from(bytes, byte => byte.toString(16).padStart(2, '0')).join('');
}

const requestIds = new WeakMap<ConnectError, string>();
const slowCalls = new Set<object>();

const withCredentials: Interceptor = next => async request => {
  for (const [name, value] of Object.entries(credentials())) {
    request.header.set(name, value);
  }
  const requestId = newRequestId();
  request.header.set(REQUEST_ID, requestId);
  const slow = setTimeout(() => {
    slowCalls.add(request);
    void probe();
  }, SLOW_MILLISECONDS);
  try {
    const answer = await next(request);
    connection.value = {state: 'connected'};
    return answer;
  } catch (error) {
    note(error);
    const told = ConnectError.from(error);
    requestIds.set(told, requestId);
    throw told;
  } finally {
    clearTimeout(slow);
    slowCalls.delete(request);
  }
};

function transportWith(timeoutMs: number, interceptors: Interceptor[]) {
  return createConnectTransport({
    baseUrl: location.origin, useBinaryFormat: true,
    defaultTimeoutMs: timeoutMs, interceptors,
  });
}

const transport = transportWith(DEADLINE_MILLISECONDS, [withCredentials]);
export const service = createClient(PoseGraphService, transport);
export const health = createClient(Health, transport);

const prober = createClient(Health, transportWith(PROBE_MILLISECONDS, []));
let probing = false;

/** While calls take long, asks the server whether it is there at all: a search
 * may take its time, but a server that has stopped answers nothing. */
async function probe(): Promise<void> {
  if (probing) return;
  probing = true;
  while (slowCalls.size > 0) {
    try {
      await prober.check({});
      found();
    } catch (error) {
      const {code, rawMessage} = ConnectError.from(error);
      if (code === Code.DeadlineExceeded) {
        missed(`nothing came for ${PROBE_MILLISECONDS} ms`);
      } else if (code === Code.Unavailable || code === Code.Unknown) {
        missed(rawMessage);
      } else {
        found();
      }
    }
    await new Promise(done => setTimeout(done, SLOW_MILLISECONDS));
  }
  probing = false;
}

/** Tells people what went wrong: the server's messages stand alone. The id of
 * the request finds it in the server's log. */
export function messageOf(error: unknown): string {
  const told = ConnectError.from(error);
  const id = requestIds.get(told);
  return `${told.rawMessage} (${
      Code[told.code].replace(/(?<=[a-z])(?=[A-Z])/g, ' ').toLowerCase()}${
      id ? `, request ${id}` : ''})`;
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

const IDLE_MILLISECONDS = 5 * 60_000;
const IDLE_POLL_MILLISECONDS = 10_000;
let touched = Date.now();

/** Whether nobody looks: the page is hidden, or nobody has touched it for five
 * minutes. Then nothing is searched, and little is asked. */
export const idle = signal(document.hidden);

function lookWhetherIdle(): void {
  idle.value = document.hidden || Date.now() - touched > IDLE_MILLISECONDS;
}
setInterval(lookWhetherIdle, 1000);
document.addEventListener('visibilitychange', () => {
  if (!document.hidden) touched = Date.now();
  lookWhetherIdle();
});
for (const event of ['pointermove', 'pointerdown', 'keydown', 'wheel']) {
  addEventListener(event, () => {
    touched = Date.now();
    if (idle.value) lookWhetherIdle();
  }, {passive: true, capture: true});
}

/** Waits, but no longer than until somebody is back. */
function pauseFor(milliseconds: number): Promise<void> {
  return new Promise(done => {
    const wasIdle = idle.value;
    const timer = setTimeout(finish, milliseconds);
    const stop = idle.subscribe(now => {
      if (wasIdle && !now) finish();
    });
    function finish() {
      clearTimeout(timer);
      queueMicrotask(() => stop());
      done();
    }
  });
}

/**
 * Calls `work` again and again while the page is in view, waiting at least
 * `interval` milliseconds between two calls and four times as long as the last
 * one took (a minute at most), so that a large fleet or graph is not asked for
 * all the time; ten seconds while nobody has touched the page for long. Errors
 * do not end it. Returns how to end it.
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
      const least = idle.value ? Math.max(interval, IDLE_POLL_MILLISECONDS) :
                                 interval;
      await pauseFor(failed ? interval : Math.max(
          least, Math.min(60_000, 4 * (performance.now() - began))));
    }
  };
  void run();
  return () => {
    ended = true;
  };
}
