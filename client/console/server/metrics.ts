import type {IncomingMessage, ServerResponse} from 'node:http';

import {Code, ConnectError, type Transport} from '@connectrpc/connect';

import {type MetricsPage, Scraper, type ServerMetrics} from './scrape.js';
import {Standing} from './standing.js';

/** The answer to the page's question. */
export interface MetricsAnswer {
  /** Milliseconds since 1970 at which it was made. */
  time: number;
  /** In the order of the flags. */
  servers: ServerMetrics[];
}

/**
 * Answers GET /metrics.json with the metrics of all servers, whose admin ports
 * ask nobody who he is. They are of all tenants, so they go only to callers
 * whom revisitd itself takes to belong to none.
 */
export class Metrics {
  private readonly scrapers: Scraper[];
  private readonly standing: Standing;

  /** The servers behind `transports` say who a caller is: one that is away hides
   * no others' metrics. */
  constructor(pages: readonly MetricsPage[], transports: readonly Transport[]) {
    this.scrapers = pages.map(page => new Scraper(page));
    this.standing = new Standing(transports);
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
      Promise<[number, MetricsAnswer|{message: string}]> {
    if (request.method !== 'GET') return [405, {message: 'GET it'}];
    if (this.scrapers.length === 0) {
      return [404, {message: 'The console was started without --metrics.'}];
    }
    try {
      const {authorization} = request.headers;
      if (!await this.standing.isOverAllTenants(authorization)) {
        return [403, {message: 'Metrics are of the whole server, and this ' +
                               'caller belongs to a tenant of it.'}];
      }
    } catch (error) {
      const {code, rawMessage: message} = ConnectError.from(error);
      return [code === Code.Unauthenticated ? 401 :
              code === Code.PermissionDenied ? 403 : 503, {message}];
    }
    const servers = await Promise.all(
        this.scrapers.map(scraper => scraper.latest()));
    return [200, {time: Date.now(), servers}];
  }
}
