import type {IncomingMessage, ServerResponse} from 'node:http';

import {Code, createContextKey} from '@connectrpc/connect';

import type {Log, LogFields} from './log.js';
import type {RequestKind, Telemetry} from './telemetry.js';
import {type Trace, traceOf} from './trace.js';

/** Lines about the same are written once in this time. */
const REPEATED_MILLISECONDS = 60_000;
const MOST_REPEATED = 1000;
const SLOW_SECONDS = 1;

interface Outcome {
  code: string;
  /** '' if there was no error. */
  message: string;
}

/** The notes about one request, for the line that it gets in the log. */
export class RequestRecord {
  readonly trace: Trace;
  kind: RequestKind = 'page';
  /** Of the call that was passed on, if the request was one. */
  outcome: Outcome|undefined;
  /** Whether it was one that changes what revisitd has. */
  changes = false;
  private readonly began = performance.now();

  constructor(readonly request: IncomingMessage) {
    const {traceparent, 'x-request-id': requestId} = request.headers;
    this.trace = traceOf(traceparent as string|undefined,
                         requestId as string|undefined);
  }

  ended(code: Code|undefined, message = ''): void {
    this.outcome = {code: code === undefined ? 'OK' : nameOf(code), message};
  }

  get seconds(): number {
    return (performance.now() - this.began) / 1000;
  }

  get path(): string {
    return (this.request.url ?? '/').split('?')[0];
  }
}

/** Where the handlers of calls find the record. */
export const RECORD = createContextKey<RequestRecord|undefined>(undefined);

/** The code as gRPC spells it, such as NOT_FOUND. */
export function nameOf(code: Code): string {
  return Code[code].replace(/(?<=[a-z])(?=[A-Z])/g, '_').toUpperCase();
}

/** Writes a line for each request: of level info for what changes something and
 * for the first of its kind within a minute, which then has the number of those
 * in between; of level debug for those, such as the questions of a page each
 * second. The log of revisitd has a line for each call anyway, with the same
 * request id. */
export class RequestLog {
  /** When a kind was last written about at level info, and how many there were
   * since; the eldest first. */
  private readonly last = new Map<string, {time: number, count: number}>();

  constructor(private readonly log: Log,
              private readonly telemetry: Telemetry) {}

  /** Notes the end of the answer, whenever that comes. */
  follow(record: RequestRecord, response: ServerResponse): void {
    response.once('close', () => {
      const status = response.writableFinished ? response.statusCode : 499;
      this.telemetry.answered(record.kind, status, record.seconds);
      this.write(record, status);
    });
  }

  private write(record: RequestRecord, status: number): void {
    const {outcome, trace, kind, path, request} = record;
    const peer = request.socket.remoteAddress ?? '';
    const what = kind === 'call' ? path.split('/').at(-1)! : kind;
    const slow = record.seconds > SLOW_SECONDS;
    const repeated = record.changes ? 0 : this.repeatsOf(
        [peer, what, outcome?.code, status, slow].join(' '));
    const failed = outcome ? outcome.code !== 'OK' : status >= 400;
    const fields: LogFields = {
      request_id: trace.requestId, method: kind === 'call' ? what : undefined,
      path: kind === 'call' ? undefined : path, status, code: outcome?.code,
      message: outcome?.message, peer, trace_id: trace.traceId,
      parent_id: trace.parentId,
      duration_ms: Math.round(1e4 * record.seconds) / 10,
      repeated: repeated || undefined,
    };
    const level = repeated === undefined ? 'debug' :
        failed ? 'warning' : 'info';
    this.log.write(level, kind === 'call' ? 'call' : 'request', fields);
  }

  /** How many there were since the last line; undefined if none is due. */
  private repeatsOf(kind: string): number|undefined {
    const now = performance.now();
    const before = this.last.get(kind);
    if (before && now - before.time < REPEATED_MILLISECONDS) {
      ++before.count;
      return undefined;
    }
    this.last.delete(kind);
    this.last.set(kind, {time: now, count: 0});
    if (this.last.size > MOST_REPEATED) {
      this.last.delete(this.last.keys().next().value!);
    }
    return before?.count ?? 0;
  }
}
