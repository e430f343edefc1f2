import type {IncomingMessage, ServerResponse} from 'node:http';

import {Code, ConnectError, createClient, type Transport} from
    '@connectrpc/connect';

import {PoseGraphService} from '../gen/revisit/v1/pose_graph_service_pb.js';
import {type MetricSample, parseMetrics} from './exposition.js';

/** One reading of the server's metrics, as the page gets it. */
export interface Scrape {
  /** Milliseconds since 1970 at which they were read. */
  time: number;
  samples: MetricSample[];
}

const MOST_BYTES = 4 << 20;
const DEADLINE_MILLISECONDS = 5000;
/** Pages that ask in the meantime share one reading. */
const FRESH_MILLISECONDS = 500;
const SHOWN = /^(revisit|process)_/;

async function readBounded(answer: Response): Promise<string> {
  const parts: Uint8Array[] = [];
  let bytes = 0;
  for await (const part of answer.body as unknown as
             AsyncIterable<Uint8Array>) {
    bytes += part.length;
    if (bytes > MOST_BYTES) {
      throw new Error(`more than ${MOST_BYTES} bytes of metrics`);
    }
    parts.push(part);
  }
  return Buffer.concat(parts).toString();
}

async function scrape(url: string): Promise<Scrape> {
  const answer = await fetch(url, {
    redirect: 'error',
    signal: AbortSignal.timeout(DEADLINE_MILLISECONDS),
  });
  if (answer.status !== 200) {
    await answer.body?.cancel();
    throw new Error(`${url} answers ${answer.status}`);
  }
  const samples = parseMetrics(await readBounded(answer));
  return {time: Date.now(),
          samples: samples.filter(({name}) => SHOWN.test(name))};
}

/**
 * Answers GET /metrics.json with the metrics of revisitd, whose admin port asks
 * nobody who he is. They are of all tenants, so they go only to callers whom
 * revisitd itself takes to belong to none, by its answer to GetServerInfo.
 */
export class Metrics {
  private last: {begun: number, scrape: Promise<Scrape>}|undefined;
  private readonly service;

  /** `url` is where revisitd tells its metrics; undefined if nobody knows. */
  constructor(private readonly url: string|undefined, transport: Transport) {
    this.service = createClient(PoseGraphService, transport);
  }

  async answer(request: IncomingMessage, response: ServerResponse):
      Promise<void> {
    const [status, body] = await this.resultFor(request);
    response.writeHead(status, {
      'content-type': 'application/json',
      'cache-control': 'no-store',
    });
    response.end(JSON.stringify(body));
  }

  private async resultFor(request: IncomingMessage):
      Promise<[number, Scrape|{message: string}]> {
    if (request.method !== 'GET') return [405, {message: 'GET it'}];
    if (this.url === undefined) {
      return [404, {message: 'The console was started without --metrics.'}];
    }
    const {authorization} = request.headers;
    try {
      const {overAllTenants} = await this.service.getServerInfo({}, {
        timeoutMs: DEADLINE_MILLISECONDS,
        headers: authorization === undefined ? {} : {authorization},
      });
      if (!overAllTenants) {
        return [403, {message: 'Metrics are of the whole server, and this ' +
                               'caller belongs to a tenant of it.'}];
      }
    } catch (error) {
      const {code, rawMessage: message} = ConnectError.from(error);
      return [code === Code.Unauthenticated ? 401 :
              code === Code.PermissionDenied ? 403 : 503, {message}];
    }
    try {
      return [200, await this.latest(this.url)];
    } catch (error) {
      const {message, cause} = error as Error;
      const why = cause instanceof Error ? `: ${cause.message}` : '';
      return [502, {message: `No metrics from ${this.url}: ${message}${why}`}];
    }
  }

  private latest(url: string): Promise<Scrape> {
    const now = Date.now();
    if (!this.last || now - this.last.begun > FRESH_MILLISECONDS) {
      this.last = {begun: now, scrape: scrape(url)};
    }
    return this.last.scrape;
  }
}
