import {parseArgs} from 'node:util';

export const USAGE = `\
usage: main.js [--listen ADDRESS:PORT] [--server ADDRESS:PORT]
               [--tls-ca FILE] [--host NAME]... [--insecure-allow-remote]

Serves the console of revisit and passes its calls on to a revisitd.

  --listen ADDRESS:PORT   where the console listens (127.0.0.1:8080)
  --server ADDRESS:PORT   the revisitd (REVISIT_SERVER, or 127.0.0.1:50051)
  --tls-ca FILE           reach it by TLS; who may have issued its certificate
                          (REVISIT_TLS_CA)
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
  /** Address and port of revisitd. */
  server: string;
  /** Path of a PEM file; undefined for a connection without TLS. */
  tlsCa: string | undefined;
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
         'server': {type: 'string'},
         'tls-ca': {type: 'string'},
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
  const server =
      values.server ?? environment.REVISIT_SERVER ?? '127.0.0.1:50051';
  splitAddress('--server', server);
  return {
    listenHost,
    listenPort,
    server,
    tlsCa: values['tls-ca'] ?? (environment.REVISIT_TLS_CA || undefined),
    hosts: values.host!,
  };
}
