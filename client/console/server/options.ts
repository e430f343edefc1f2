import {parseArgs} from 'node:util';

import {type LinkTemplate, problemOf} from '../shared/links.js';
import type {MetricsPage} from './scrape.js';

export const USAGE = `\
usage: main.js [--listen ADDRESS:PORT] [--server ADDRESS:PORT]...
               [--tls-ca FILE] [--metrics [NAME=]URL]... [--base-map FILE]
               [--link NAME=TEMPLATE]... [--host NAME]...
               [--insecure-allow-remote]

Serves the console of revisit and passes its calls on to a revisitd.

  --listen ADDRESS:PORT   where the console listens (127.0.0.1:8080)
  --server ADDRESS:PORT   the revisitd (REVISIT_SERVER, or 127.0.0.1:50051);
                          given again, others that share its store and may
                          have a vehicle instead
  --tls-ca FILE           reach it by TLS; who may have issued its certificate
                          (REVISIT_TLS_CA)
  --metrics [NAME=]URL    where the revisitd tells its metrics, such as
                          http://127.0.0.1:9464/metrics (REVISIT_METRICS);
                          given again, where the others of a cluster do. NAME
                          is what the page calls the server instead of its
                          host and port
  --base-map FILE         a PMTiles archive, drawn below paths whose place on
                          the earth is known (REVISIT_BASE_MAP)
  --link NAME=TEMPLATE    a link from each pair of poses to another program, such
                          as 'camera=https://host/{vehicle}/{time_a}/{time_b}';
                          given again, further ones
  --host NAME             a name, with its port unless that is the usual one, by
                          which browsers reach the console through a proxy;
                          localhost and the address listened at always count
  --insecure-allow-remote
                          listen beyond the loopback, without TLS
  --help                  this text
`;

const SERVER_NAME = /^[A-Za-z0-9][A-Za-z0-9._-]{0,62}$/;

/** A wrong command line; the message is for people. */
export class UsageError extends Error {}

export interface Options {
  listenHost: string;
  listenPort: number;
  /** Addresses and ports of revisitd: of the one that is asked first, then of
   * those that share its store. */
  servers: string[];
  /** Path of a PEM file; undefined for a connection without TLS. */
  tlsCa: string | undefined;
  /** One for each server whose metrics are shown. */
  metrics: MetricsPage[];
  /** Path of a PMTiles archive. */
  baseMap: string | undefined;
  /** Leads from a pair of poses to other programs. */
  links: LinkTemplate[];
  /** Further values of the Host header that are answered. */
  hosts: string[];
}

function splitAddress(flag: string, value: string): [string, number] {
  const found = /^(\[[0-9a-fA-F:]+\]|[^:]+):(\d{1,5})$/.exec(value);
  if (!found || Number(found[2]) > 65535) {
    throw new UsageError(
        `${flag} is '${value}', not ADDRESS:PORT such as 127.0.0.1:8080`);
  }
  return [found[1].replace(/^\[|\]$/g, ''), Number(found[2])];
}

function splitMetrics(value: string): MetricsPage {
  // A URL has a colon, or a slash, before any sign of equality.
  const [, given, address] = /^(?:([^:/?#=]*)=)?(.*)$/s.exec(value)!;
  let url: URL|undefined;
  try {
    url = new URL(address);
  } catch {
    // Told below.
  }
  if (!url || !/^https?:$/.test(url.protocol) || url.username || url.password) {
    throw new UsageError(`--metrics is '${value}', not an address such as ` +
                         'http://127.0.0.1:9464/metrics, nor NAME=ADDRESS');
  }
  if (given !== undefined && !SERVER_NAME.test(given)) {
    throw new UsageError(
        `--metrics is '${value}', whose NAME has to be of 1 to 63 letters, ` +
        'digits, and any of . _ - but at its beginning');
  }
  const port = url.port || (url.protocol === 'https:' ? '443' : '80');
  return {name: given ?? `${url.hostname}:${port}`, url: url.href};
}

function splitAllMetrics(values: string[]): MetricsPage[] {
  const pages = values.map(splitMetrics);
  pages.forEach(({name, url}, i) => {
    for (const other of pages.slice(0, i)) {
      if (other.url === url) {
        throw new UsageError(`--metrics names ${url} twice`);
      }
      if (other.name === name) {
        throw new UsageError(
            `--metrics calls both ${other.url} and ${url} '${name}': ` +
            'say NAME=ADDRESS to tell them apart');
      }
    }
  });
  return pages;
}

function splitLink(value: string): LinkTemplate {
  const found = /^([^=]{1,63})=(.*)$/s.exec(value);
  const problem = found ? problemOf(found[2]) : 'it is not NAME=TEMPLATE';
  if (problem) {
    throw new UsageError(`--link is '${value}': ${problem}, such as ` +
        '\'camera=https://host/{vehicle}/{time_a}/{time_b}\'');
  }
  return {name: found![1], template: found![2]};
}

function isLoopback(host: string): boolean {
  return host === 'localhost' || host === '::1' || /^127\./.test(host);
}

/** Returns undefined if help was asked for. */
export function readOptions(args: string[], environment: NodeJS.ProcessEnv):
    Options | undefined {
  let values;
  try {
    ({values} = parseArgs({
       args,
       options: {
         'listen': {type: 'string', default: '127.0.0.1:8080'},
         'server': {type: 'string', multiple: true},
         'tls-ca': {type: 'string'},
         'metrics': {type: 'string', multiple: true},
         'base-map': {type: 'string'},
         'link': {type: 'string', multiple: true, default: []},
         'host': {type: 'string', multiple: true, default: []},
         'insecure-allow-remote': {type: 'boolean', default: false},
         'help': {type: 'boolean', short: 'h', default: false},
       },
     }));
  } catch (error) {
    throw new UsageError((error as Error).message);
  }
  if (values.help) return undefined;
  const [listenHost, listenPort] = splitAddress('--listen', values.listen!);
  if (!isLoopback(listenHost) && !values['insecure-allow-remote']) {
    throw new UsageError(
        `--listen ${listenHost} is beyond the loopback, where tokens would ` +
        'pass in the clear: put a proxy with TLS in front of the loopback, ' +
        'or say --insecure-allow-remote');
  }
  const servers =
      values.server ?? [environment.REVISIT_SERVER ?? '127.0.0.1:50051'];
  for (const server of servers) splitAddress('--server', server);
  const metrics = values.metrics ??
      (environment.REVISIT_METRICS ? [environment.REVISIT_METRICS] : []);
  return {
    listenHost,
    listenPort,
    servers,
    tlsCa: values['tls-ca'] ?? (environment.REVISIT_TLS_CA || undefined),
    metrics: splitAllMetrics(metrics),
    baseMap: values['base-map'] ?? (environment.REVISIT_BASE_MAP || undefined),
    links: values.link!.map(splitLink),
    hosts: values.host!,
  };
}
