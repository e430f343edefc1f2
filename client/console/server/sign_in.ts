import type {IncomingMessage, ServerResponse} from 'node:http';

import {CALLBACK_PATH, routeOf, SESSION_PATH, SIGN_IN_PATH, SIGN_OUT_PATH} from
    '../shared/addresses.js';
import {Cookies} from './cookies.js';
import {type Attempt, Issuer, reasonOf, SignInError, type Tokens} from
    './issuer.js';
import type {Log} from './log.js';
import type {OidcOptions} from './options.js';
import {Sessions} from './sessions.js';
import type {Telemetry} from './telemetry.js';

const SESSION_COOKIE = 'revisit-session';
const ATTEMPT_COOKIE = 'revisit-sign-in';
const ATTEMPT_SECONDS = 600;
const MOST_VIEW_BYTES = 1000;

/** The page is told this about who uses it. */
export interface SessionAnswer {
  /** Null for nobody. */
  user: {subject: string, name: string}|null;
}

/** A sign-in that has begun, as the browser keeps it under seal. */
interface Pending extends Attempt {
  /** The view to come back to. */
  to: string;
  /** Milliseconds since 1970. */
  begun: number;
}

/** A view of this console, so that nobody is led elsewhere, with an address that
 * fits in a cookie. */
function viewIn(text: string|null): string {
  if (!text?.startsWith('/') || text.length > MOST_VIEW_BYTES) return '/';
  const path = text.split(/[?#]/)[0];
  return routeOf(path).view === 'none' ? '/' : text;
}

function escaped(text: string): string {
  return text.replace(/[&<>"']/g, c => `&#${c.charCodeAt(0)};`);
}

function queryOf(request: IncomingMessage): string {
  const url = request.url ?? '/';
  return url.includes('?') ? url.slice(url.indexOf('?') + 1) : '';
}

/** Whether a script of the console's own page asks: a browser that says neither
 * where a request comes from is not believed. */
function isFromPage({headers}: IncomingMessage, origin: string): boolean {
  const site = headers['sec-fetch-site'];
  return site === undefined ? headers.origin === origin :
                              site === 'same-origin';
}

function isReading({method}: IncomingMessage): boolean {
  return method === 'GET' || method === 'HEAD';
}

function answerJson(response: ServerResponse, body: object): void {
  response.writeHead(200, {'content-type': 'application/json',
                           'cache-control': 'no-store'});
  response.end(JSON.stringify(body));
}

function redirect(response: ServerResponse, to: string): void {
  response.writeHead(303, {'location': to, 'cache-control': 'no-store'});
  response.end();
}

/** Lets people sign in at an issuer, and adds their token to their calls. The
 * browser holds the secret of a session, and never a token. */
export class SignIn {
  private readonly issuer: Issuer;
  private readonly sessions: Sessions;
  private readonly cookies: Cookies;

  /** `base` is where browsers reach the console; `maxTokenBytes` are those that
   * may be passed on. Throws if the secret of the client cannot be read. */
  constructor(options: OidcOptions, private readonly base: URL,
              private readonly maxTokenBytes: number,
              private readonly log: Log,
              private readonly telemetry: Telemetry) {
    this.issuer = new Issuer(options, new URL(CALLBACK_PATH, base));
    this.sessions = new Sessions(this.issuer);
    this.cookies = new Cookies(base.protocol === 'https:');
    telemetry.observeSessions(() => this.sessions.size);
  }

  /** Answers a request for one of its addresses; false for any other. */
  async answer(request: IncomingMessage, response: ServerResponse,
               requestId: string): Promise<boolean> {
    switch ((request.url ?? '/').split('?')[0]) {
      case SIGN_IN_PATH:
        await this.trying(response, requestId,
                          () => this.begin(request, response));
        return true;
      case CALLBACK_PATH:
        await this.trying(response, requestId,
                          () => this.finish(request, response, requestId));
        return true;
      case SIGN_OUT_PATH:
        await this.end(request, response, requestId);
        return true;
      case SESSION_PATH:
        answerJson(response, await this.sessionOf(request));
        return true;
      default:
        return false;
    }
  }

  /** Adds the token of the session, if there is one, to a request that brings
   * none of its own. Throws if the issuer cannot be asked for it. */
  async authorize(request: IncomingMessage): Promise<void> {
    if (request.headers.authorization !== undefined) return;
    // Another site cannot have a signed-in browser make calls.
    if (!isReading(request) && !isFromPage(request, this.base.origin)) return;
    const tokens = await this.tokensOf(request);
    if (tokens) request.headers.authorization = `Bearer ${tokens.bearer}`;
  }

  private async tokensOf(request: IncomingMessage): Promise<Tokens|undefined> {
    const secret = this.cookies.read(request, SESSION_COOKIE);
    return secret === undefined ? undefined : this.sessions.tokensOf(secret);
  }

  private async sessionOf(request: IncomingMessage): Promise<SessionAnswer> {
    const tokens = await this.tokensOf(request).catch(() => undefined);
    return {user: tokens ? {subject: tokens.subject, name: tokens.name} : null};
  }

  private async begin(request: IncomingMessage, response: ServerResponse):
      Promise<void> {
    const to = viewIn(new URLSearchParams(queryOf(request)).get('to'));
    if (request.headers.host !== this.base.host) {
      // The issuer sends people back to the one name, where a cookie that was
      // set under another is not sent.
      redirect(response, new URL(`${SIGN_IN_PATH}?to=${
          encodeURIComponent(to)}`, this.base).href);
      return;
    }
    const [url, attempt] = await this.issuer.begin();
    const pending: Pending = {...attempt, to, begun: Date.now()};
    response.setHeader('set-cookie', this.cookies.made(
        ATTEMPT_COOKIE, this.cookies.seal(JSON.stringify(pending)),
        ATTEMPT_SECONDS));
    redirect(response, url.href);
  }

  private pendingOf(request: IncomingMessage): Pending {
    const sealed = this.cookies.read(request, ATTEMPT_COOKIE);
    const text = sealed === undefined ? undefined : this.cookies.unseal(sealed);
    const pending = text === undefined ? undefined :
                                         JSON.parse(text) as Pending;
    if (!pending || Date.now() - pending.begun > 1000 * ATTEMPT_SECONDS) {
      throw new SignInError('this browser has not begun to sign in here, or ' +
                            'began too long ago');
    }
    return pending;
  }

  private async finish(request: IncomingMessage, response: ServerResponse,
                       requestId: string): Promise<void> {
    const pending = this.pendingOf(request);
    const tokens = await this.issuer.finish(queryOf(request), pending);
    if (tokens.bearer.length > this.maxTokenBytes) {
      throw new SignInError(
          `the issuer's token has ${tokens.bearer.length} bytes, more than ` +
          `the ${this.maxTokenBytes} that --max-metadata-bytes leaves`);
    }
    // A session that there was before ends.
    this.sessions.remove(this.cookies.read(request, SESSION_COOKIE) ?? '');
    response.setHeader('set-cookie', [
      this.cookies.removed(ATTEMPT_COOKIE),
      this.cookies.made(SESSION_COOKIE, this.sessions.add(tokens)),
    ]);
    this.telemetry.signedIn('ok');
    this.log.write('info', 'signed_in', {request_id: requestId,
                                         subject: tokens.subject});
    redirect(response, pending.to);
  }

  private async end(request: IncomingMessage, response: ServerResponse,
                    requestId: string): Promise<void> {
    if (request.method !== 'POST' || !isFromPage(request, this.base.origin)) {
      response.writeHead(405, {'allow': 'POST'});
      response.end();
      return;
    }
    const tokens = this.sessions.remove(
        this.cookies.read(request, SESSION_COOKIE) ?? '');
    let to: URL|undefined;
    if (tokens) {
      this.log.write('info', 'signed_out', {request_id: requestId,
                                            subject: tokens.subject});
      to = await this.issuer.end(tokens).catch((error: unknown) => {
        this.log.write('warning', 'sign_out_not_told', {
          request_id: requestId, message: reasonOf(error)});
        return undefined;
      });
    }
    response.setHeader('set-cookie', this.cookies.removed(SESSION_COOKIE));
    answerJson(response, {to: to?.href ?? '/'});
  }

  /** Tells people what went wrong, on a page of its own. */
  private async trying(response: ServerResponse, requestId: string,
                       step: () => Promise<void>): Promise<void> {
    try {
      await step();
    } catch (error) {
      const message = reasonOf(error);
      this.telemetry.signedIn('failed');
      this.log.write('warning', 'sign_in_failed', {request_id: requestId,
                                                   message});
      response.setHeader('set-cookie', this.cookies.removed(ATTEMPT_COOKIE));
      response.writeHead(400, {'content-type': 'text/html; charset=utf-8',
                               'cache-control': 'no-store'});
      response.end(`<!doctype html>
<html lang="en"><meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>Not signed in - revisit</title>
<main><h1>Not signed in</h1>
<p>${escaped(message)}</p>
<p>Request ${escaped(requestId)}</p>
<p><a href="${SIGN_IN_PATH}">Try again</a>, or go on to <a href="/">the
console</a>.</p></main></html>
`);
    }
  }
}
