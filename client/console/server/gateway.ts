import type {IncomingMessage, ServerResponse} from 'node:http';
import {type Duplex} from 'node:stream';
import {constants} from 'node:zlib';

import compression from 'compression';

import {BASE_MAP_PATH, type BaseMap} from './base_map.js';
import {metadataBytes} from './forward.js';
import {reasonOf} from './issuer.js';
import type {Log} from './log.js';
import type {Metrics} from './metrics.js';
import {type Pages, SECURITY_HEADERS} from './pages.js';
import {RequestLog, RequestRecord} from './record.js';
import type {SignIn} from './sign_in.js';
import type {Telemetry} from './telemetry.js';

export const METRICS_PATH = '/metrics.json';
const SERVICES = /^\/[a-z][\w.]*\.[A-Z]\w*\/[A-Z]\w*$/;
const LARGE_ANSWERS = /\/ExportPoseGraph$|^\/metrics\.json$/;

/** The parts that answer the requests which are let in. */
export interface Parts {
  pages: Pages;
  metrics: Metrics;
  /** Undefined where there is none. */
  baseMap: BaseMap|undefined;
  signIn: SignIn|undefined;
  calls: (request: IncomingMessage, response: ServerResponse) => void;
}

/** Compresses as it goes, fast: a graph is tens of megabytes. An attacker who
 * can see sizes, and has somebody's browser ask for what the attacker chooses,
 * could learn what is compressed together with the choice (BREACH). Neither
 * answer holds a secret, and no other site can ask for them. */
const compress = compression({
  filter: () => true,
  level: constants.Z_BEST_SPEED,
  brotli: {params: {[constants.BROTLI_PARAM_QUALITY]: 1}},
}) as unknown as (request: IncomingMessage, response: ServerResponse,
                  next: () => void) => void;

/** Whether a request comes from the console's own page or from no browser.
 * The Host header is looked at so that no other site can reach a console on
 * the loopback under a name of its own (DNS rebinding). */
function isOwn(request: IncomingMessage, hosts: Set<string>): boolean {
  const site = request.headers['sec-fetch-site'];
  // A link from elsewhere to a view is welcome; calls are made by POST.
  const mayBeForeign = request.method === 'GET' || request.method === 'HEAD';
  return hosts.has(request.headers.host ?? '') &&
      (mayBeForeign || site === undefined || site === 'same-origin');
}

/** Ends the connection of a browser whose headers cannot be read. */
export function answerUnreadable(error: NodeJS.ErrnoException,
                                 socket: Duplex): void {
  if (error.code === 'ECONNRESET' || !socket.writable) {
    socket.destroy();
    return;
  }
  const [status, message] = error.code === 'HPE_HEADER_OVERFLOW' ?
      ['431 Request Header Fields Too Large',
       'Cookies and other headers are more than the console takes.'] :
      error.code === 'ERR_HTTP_REQUEST_TIMEOUT' ?
          ['408 Request Timeout', 'The request did not come to its end.'] :
          ['400 Bad Request', 'This is no request of HTTP.'];
  socket.end(`HTTP/1.1 ${status}\r\ncontent-type: text/plain\r\n` +
             `content-length: ${message.length + 1}\r\n` +
             `connection: close\r\n\r\n${message}\n`);
}

/** Lets requests in, or refuses them, and notes each. */
export class Gateway {
  private readonly requests: RequestLog;
  private readonly records = new WeakMap<object, RequestRecord>();

  /** `hosts` are the values of the Host header that are answered. */
  constructor(private readonly parts: Parts,
              private readonly hosts: Set<string>,
              private readonly maxMetadataBytes: number,
              private readonly log: Log, telemetry: Telemetry) {
    this.requests = new RequestLog(log, telemetry);
  }

  /** The record of a request that is being answered. */
  recordOf(request: object): RequestRecord|undefined {
    return this.records.get(request);
  }

  async answer(request: IncomingMessage, response: ServerResponse):
      Promise<void> {
    const record = new RequestRecord(request);
    this.records.set(request, record);
    this.requests.follow(record, response);
    try {
      await this.route(record, request, response);
    } catch (error) {
      this.log.write('error', 'not_answered', {
        request_id: record.trace.requestId, message: (error as Error).stack});
      response.destroy();
    }
  }

  private async route(record: RequestRecord, request: IncomingMessage,
                      response: ServerResponse): Promise<void> {
    for (const [name, value] of Object.entries(SECURITY_HEADERS)) {
      response.setHeader(name, value);
    }
    response.setHeader('x-request-id', record.trace.requestId);
    if (!isOwn(request, this.hosts)) {
      record.kind = 'refused';
      response.writeHead(403, {'content-type': 'text/plain'});
      response.end('The console does not answer under this name, or not to ' +
                   'the page that asks; --host adds a name.\n');
      return;
    }
    const {path} = record;
    if (SERVICES.test(path) || path === METRICS_PATH) {
      record.kind = path === METRICS_PATH ? 'metrics' : 'call';
      await this.answerCaller(record, request, response);
    } else if (await this.parts.signIn?.answer(request, response,
                                               record.trace.requestId)) {
      record.kind = 'sign_in';
    } else if (path === BASE_MAP_PATH && this.parts.baseMap) {
      record.kind = 'base_map';
      this.parts.baseMap.answer(request, response);
    } else {
      this.parts.pages.answer(request, response);
    }
  }

  /** Answers what depends on who asks. */
  private async answerCaller(record: RequestRecord, request: IncomingMessage,
                             response: ServerResponse): Promise<void> {
    try {
      await this.parts.signIn?.authorize(request);
    } catch (error) {
      this.refuse(record, response, 503, 'unavailable',
                  `the issuer cannot be asked to renew the sign-in: ${
                      reasonOf(error)}`);
      return;
    }
    const bytes = metadataBytes(request);
    if (bytes > this.maxMetadataBytes) {
      this.refuse(record, response, 431, 'resource_exhausted',
                  `the call's headers have ${bytes} bytes for revisitd; ` +
                  `allowed are ${this.maxMetadataBytes} ` +
                  '(--max-metadata-bytes)');
      return;
    }
    if (LARGE_ANSWERS.test(record.path)) {
      await new Promise<void>(done => compress(request, response, done));
    }
    if (record.kind === 'metrics') {
      await this.parts.metrics.answer(request, response);
    } else {
      this.parts.calls(request, response);
    }
  }

  /** In the form of Connect's errors, which the page shows. */
  private refuse(record: RequestRecord, response: ServerResponse,
                 status: number, code: string, message: string): void {
    record.kind = 'refused';
    record.outcome = {code: code.toUpperCase(), message};
    response.writeHead(status, {'content-type': 'application/json',
                                'cache-control': 'no-store'});
    response.end(JSON.stringify({code, message}));
  }
}
