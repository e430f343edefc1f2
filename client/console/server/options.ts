import {parseArgs} from 'node:util';

export const USAGE = `\
usage: main.js [--listen ADDRESS:PORT] [--server ADDRESS:PORT]...
               [--tls-ca FILE] [--metrics URL] [--base-map FILE]
               [--host NAME]... [--insecure-allow-remote]

Serves the console of revisit and passes its calls on to a revisitd.

  --listen ADDRESS:PORT   where the console listens (127.0.0.1:8080)
  --server ADDRESS:PORT   the revisitd (REVISIT_SERVER, or 127.0.0.1:50051);
                          given again, others that share its store and may
                          have a vehicle instead
  --tls-ca FILE           reach it by TLS; who may have issued its certificate
                          (REVISIT_TLS_CA)
  --metrics URL           where the revisitd tells its metrics, such as
                          http://127.0.0.1:9464/metrics (REVISIT_METRICS)
  --base-map FILE         a PMTiles archive, drawn below paths whose place on
                          the earth is known (REVISIT_BASE_MAP)
  --host NAME             a name, with its port unless that is the usual one, by
                          which browsers reach the console through a proxy;
                          localhost and the address listened at always count
  --insecure-allow-remote
                          listen beyond the loopback, without TLS
  --help                  this text
`;

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
  metrics: string | undefined;
  /** Path of a PMTiles archive. */
  baseMap: string | undefined;
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

function checkMetrics(value: string): void {
  let url: URL|undefined;
  try {
    url = new URL(value);
  } catch {
    // Told below.
  }
  if (!url || !/^https?:$/.test(url.protocol) || url.username || url.password) {
    throw new UsageError(`--metrics is '${value}', not an address such as ` +
                         'http://127.0.0.1:9464/metrics');
  }
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
         'metrics': {type: 'string'},
         'base-map': {type: 'string'},
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
  const metrics =
      values.metrics ?? (environment.REVISIT_METRICS || undefined);
  if (metrics !== undefined) checkMetrics(metrics);
  return {
    listenHost,
    listenPort,
    servers,
    tlsCa: values['tls-ca'] ?? (environment.REVISIT_TLS_CA || undefined),
    metrics,
    baseMap: values['base-map'] ?? (environment.REVISIT_BASE_MAP || undefined),
    hosts: values.host!,
  };
}
