import {readFileSync} from 'node:fs';
import {parseArgs} from 'node:util';

import {LOG_FORMATS, LOG_LEVELS, type LogFormat, type LogLevel} from './log.js';
import type {MetricsPage} from './scrape.js';
import {version} from '../package.json';
import {CALLBACK_PATH} from '../shared/addresses.js';
import {type LinkTemplate, problemOf} from '../shared/links.js';

export const USAGE = `\
usage: revisit-console [--listen ADDRESS:PORT] [--server ADDRESS:PORT]...
                       [--tls-ca FILE] [--max-metadata-bytes N]
                       [--metrics [NAME=]URL]... [--base-map FILE]
                       [--link NAME=TEMPLATE]... [--host NAME]...
                       [--public-url URL]
                       [--insecure-allow-remote]
                       [--oidc-issuer URL --oidc-client-id ID
                        [--oidc-client-secret-file FILE]
                        [--oidc-scopes SCOPES] [--oidc-resource URI]
                        [--oidc-token access|id]]
                       [--admin-listen ADDRESS:PORT]
                       [--log-format text|json] [--log-level LEVEL]
                       [--config FILE]

Serves the console of revisit and passes its calls on to a revisitd.

  --listen ADDRESS:PORT   where the console listens (127.0.0.1:8080)
  --server ADDRESS:PORT   the revisitd (REVISIT_SERVER, or 127.0.0.1:50051);
                          given again, others that share its store and may
                          have a vehicle instead
  --tls-ca FILE           reach it by TLS; who may have issued its certificate
                          (REVISIT_TLS_CA)
  --max-metadata-bytes N  bytes of the headers that one call of a browser may
                          take to the revisitd (7168); at least 1024 less than
                          the revisitd's own --max-metadata-bytes
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
  --public-url URL        where browsers reach the console, such as
                          https://console.example; its host counts as --host
  --insecure-allow-remote
                          listen beyond the loopback, without TLS

  --oidc-issuer URL       people sign in at this issuer by OpenID Connect. It is
                          the one of the revisitd's --token-issuer
  --oidc-client-id ID     what the issuer calls the console. There the address
                          after signing in is that of --public-url (without it,
                          of --listen) followed by ${CALLBACK_PATH}
  --oidc-client-secret-file FILE
                          holds the secret of a confidential client; without it
                          the client is a public one
  --oidc-scopes SCOPES    what is asked for ("openid profile offline_access")
  --oidc-resource URI     the service that the token is for, where the issuer
                          takes RFC 8707's resource; else its default
  --oidc-token access|id  which token the revisitd gets (access)

  --admin-listen ADDRESS:PORT
                          plain HTTP for probes and Prometheus: /livez, /readyz,
                          /metrics (none)
  --log-format text|json  form of the log's lines, on standard error (text)
  --log-level debug|info|warning|error|off
                          level of the least severe events that are logged
                          (info)
  --config FILE           options in lines KEY = "VALUE", without the dashes; a
                          key of a list may be given again
  --version               the version
  --help                  this text

Each option is a variable of the environment too, such as REVISIT_CONSOLE_LISTEN
(of a list, with spaces between), with on and off for those without a value.
The command line counts before variables, and those before the file.
`;

const SERVER_NAME = /^[A-Za-z0-9][A-Za-z0-9._-]{0,62}$/;
const SCOPES = 'openid profile offline_access';
/** The headers that gRPC itself adds to a call fit in what this leaves of the
 * least that a revisitd can be told to take, 8,192 bytes. */
const METADATA_BYTES = 7168;
const MOST_METADATA_BYTES = 1 << 20;

/** A wrong command line; the message is for people. */
export class UsageError extends Error {}

/** How people sign in. */
export interface OidcOptions {
  issuer: URL;
  clientId: string;
  /** Path of a file; undefined for a public client. */
  clientSecretFile: string|undefined;
  scopes: string;
  /** Value of the parameter `resource`; undefined for none. */
  resource: string|undefined;
  /** Which token is passed on. */
  token: 'access'|'id';
}

export interface Address {
  host: string;
  port: number;
}

export interface Options {
  listen: Address;
  /** Where probes and Prometheus are answered; undefined for nowhere. */
  adminListen: Address|undefined;
  /** Addresses and ports of revisitd: of the one that is asked first, then of
   * those that share its store. */
  servers: string[];
  /** Path of a PEM file; undefined for a connection without TLS. */
  tlsCa: string | undefined;
  /** Most bytes of a caller's headers that are passed on. */
  maxMetadataBytes: number;
  /** One for each server whose metrics are shown. */
  metrics: MetricsPage[];
  /** Path of a PMTiles archive. */
  baseMap: string | undefined;
  /** Leads from a pair of poses to other programs. */
  links: LinkTemplate[];
  /** Further values of the Host header that are answered. */
  hosts: string[];
  /** Where browsers reach the console, without a path; undefined for at the
   * address that is listened at. */
  publicUrl: URL|undefined;
  oidc: OidcOptions|undefined;
  logFormat: LogFormat;
  logLevel: LogLevel;
}

const FLAGS = {
  'listen': {type: 'string'},
  'admin-listen': {type: 'string'},
  'server': {type: 'string', multiple: true},
  'tls-ca': {type: 'string'},
  'max-metadata-bytes': {type: 'string'},
  'metrics': {type: 'string', multiple: true},
  'base-map': {type: 'string'},
  'link': {type: 'string', multiple: true},
  'host': {type: 'string', multiple: true},
  'public-url': {type: 'string'},
  'insecure-allow-remote': {type: 'boolean'},
  'oidc-issuer': {type: 'string'},
  'oidc-client-id': {type: 'string'},
  'oidc-client-secret-file': {type: 'string'},
  'oidc-scopes': {type: 'string'},
  'oidc-resource': {type: 'string'},
  'oidc-token': {type: 'string'},
  'log-format': {type: 'string'},
  'log-level': {type: 'string'},
  'config': {type: 'string'},
  'version': {type: 'boolean'},
  'help': {type: 'boolean', short: 'h'},
} as const;

/** Flags that have no place in a file. */
const NOT_IN_FILE = new Set(['config', 'help', 'version']);

/** Variables without the word CONSOLE, since revisit itself has them or because
 * they are older. */
const SHARED_VARIABLES: Record<string, string> = {
  'server': 'REVISIT_SERVER',
  'tls-ca': 'REVISIT_TLS_CA',
  'metrics': 'REVISIT_METRICS',
  'base-map': 'REVISIT_BASE_MAP',
};

function parse(args: string[]) {
  try {
    return parseArgs({args, options: FLAGS}).values;
  } catch (error) {
    throw new UsageError((error as Error).message);
  }
}

type Values = ReturnType<typeof parse>;

/** The command line that says the same; `where` begins a complaint. */
function argsOf(key: string, value: string, where: string): string[] {
  if (FLAGS[key as keyof typeof FLAGS].type === 'string') {
    return [`--${key}=${value}`];
  }
  if (value !== 'on' && value !== 'off') {
    throw new UsageError(`${where}: ${key} is on or off`);
  }
  return value === 'on' ? [`--${key}`] : [];
}

function argsOfFile(path: string): string[] {
  return readFileSync(path, 'utf8').split('\n').flatMap((line, i) => {
    if (/^\s*(#|$)/.test(line)) return [];
    const found = /^\s*([a-z-]+)\s*=\s*(?:"([^"]*)"|([^\s"#]+))\s*(?:#.*)?$/
        .exec(line);
    const [, key, quoted, bare] = found ?? [];
    const where = `${path}:${i + 1}`;
    if (!found || !(key in FLAGS) || NOT_IN_FILE.has(key)) {
      throw new UsageError(`${where}: '${line}' is no option as in ` +
                           'listen = "127.0.0.1:8080"');
    }
    return argsOf(key, quoted ?? bare, where);
  });
}

function argsOfEnvironment(environment: NodeJS.ProcessEnv): string[] {
  return Object.entries(FLAGS).flatMap(([key, flag]) => {
    if (NOT_IN_FILE.has(key)) return [];
    const own = `REVISIT_CONSOLE_${key.toUpperCase().replaceAll('-', '_')}`;
    const name = environment[own] ? own : SHARED_VARIABLES[key] ?? own;
    const value = environment[name];
    if (!value) return [];
    const values = 'multiple' in flag && name === own ? value.split(/\s+/) :
                                                        [value];
    return values.flatMap(one => argsOf(key, one, name));
  });
}

function splitAddress(flag: string, value: string): Address {
  const found = /^(\[[0-9a-fA-F:]+\]|[^:]+):(\d{1,5})$/.exec(value);
  if (!found || Number(found[2]) > 65535) {
    throw new UsageError(
        `${flag} is '${value}', not ADDRESS:PORT such as 127.0.0.1:8080`);
  }
  return {host: found[1].replace(/^\[|\]$/g, ''), port: Number(found[2])};
}

/** The URL of HTTP in a text; undefined for another, or one with a password. */
function urlIn(text: string): URL|undefined {
  let url: URL;
  try {
    url = new URL(text);
  } catch {
    return undefined;
  }
  return /^https?:$/.test(url.protocol) && !url.username && !url.password ?
      url : undefined;
}

function splitMetrics(value: string): MetricsPage {
  // A URL has a colon, or a slash, before any sign of equality.
  const [, given, address] = /^(?:([^:/?#=]*)=)?(.*)$/s.exec(value)!;
  const url = urlIn(address);
  if (!url) {
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

/** Whether a host's name or address leads to this machine alone. */
export function isLoopback(host: string): boolean {
  return host === 'localhost' || host === '::1' || host === '[::1]' ||
      /^127\./.test(host);
}

function oneOf<T extends string>(flag: string, value: string,
                                 allowed: readonly T[]): T {
  const found = allowed.find(one => one === value);
  if (found === undefined) {
    throw new UsageError(
        `${flag} is '${value}'; allowed are ${allowed.join(', ')}`);
  }
  return found;
}

/** A URL that nobody on the way can change: by TLS, or on this machine. */
function safeUrl(flag: string, value: string): URL {
  const url = urlIn(value);
  if (!url || (url.protocol === 'http:' && !isLoopback(url.hostname))) {
    throw new UsageError(`${flag} is '${value}', not an address of https, nor ` +
                         'one of http on the loopback');
  }
  return url;
}

function publicUrlOf(value: string|undefined): URL|undefined {
  if (value === undefined) return undefined;
  const url = safeUrl('--public-url', value);
  if (url.pathname !== '/' || url.search || url.hash) {
    throw new UsageError(`--public-url is '${value}', but the console is at ` +
                         'the root of a host');
  }
  return url;
}

function oidcOf(values: Values, listen: Address): OidcOptions|undefined {
  const issuer = values['oidc-issuer'];
  if (issuer === undefined) {
    const other = Object.keys(values).find(name => name.startsWith('oidc-'));
    if (other) throw new UsageError(`--${other} needs --oidc-issuer`);
    return undefined;
  }
  const clientId = values['oidc-client-id'];
  if (!clientId) throw new UsageError('--oidc-issuer needs --oidc-client-id');
  if (values['public-url'] === undefined && !isLoopback(listen.host)) {
    throw new UsageError('--oidc-issuer needs --public-url, to which the ' +
                         'issuer sends people back');
  }
  const scopes = values['oidc-scopes'] ?? SCOPES;
  if (!scopes.split(' ').includes('openid')) {
    throw new UsageError(`--oidc-scopes is '${scopes}', without openid`);
  }
  return {
    issuer: safeUrl('--oidc-issuer', issuer), clientId, scopes,
    clientSecretFile: values['oidc-client-secret-file'],
    resource: values['oidc-resource'],
    token: oneOf('--oidc-token', values['oidc-token'] ?? 'access',
                 ['access', 'id']),
  };
}

function metadataBytesOf(value: string|undefined): number {
  if (value === undefined) return METADATA_BYTES;
  const bytes = /^\d{1,9}$/.test(value) ? Number(value) : 0;
  if (bytes < 1024 || bytes > MOST_METADATA_BYTES) {
    throw new UsageError(`--max-metadata-bytes is '${value}'; allowed is ` +
                         `1024 to ${MOST_METADATA_BYTES}`);
  }
  return bytes;
}

function listenOf(values: Values): Address {
  const listen = splitAddress('--listen', values.listen ?? '127.0.0.1:8080');
  if (!isLoopback(listen.host) && !values['insecure-allow-remote']) {
    throw new UsageError(
        `--listen ${listen.host} is beyond the loopback, where tokens would ` +
        'pass in the clear: put a proxy with TLS in front of the loopback, ' +
        'or say --insecure-allow-remote');
  }
  return listen;
}

/** Returns a text if that was asked for. */
export function readOptions(args: string[], environment: NodeJS.ProcessEnv):
    Options|string {
  const given = parse(args);
  if (given.help) return USAGE;
  if (given.version) return `revisit-console ${version}\n`;
  const values: Values = {
    ...given.config === undefined ? {} : parse(argsOfFile(given.config)),
    ...parse(argsOfEnvironment(environment)),
    ...given,
  };
  const listen = listenOf(values);
  const servers = values.server ?? ['127.0.0.1:50051'];
  for (const server of servers) splitAddress('--server', server);
  const publicUrl = publicUrlOf(values['public-url']);
  const admin = values['admin-listen'];
  return {
    listen,
    adminListen: admin === undefined ? undefined :
                                       splitAddress('--admin-listen', admin),
    servers,
    tlsCa: values['tls-ca'],
    maxMetadataBytes: metadataBytesOf(values['max-metadata-bytes']),
    metrics: splitAllMetrics(values.metrics ?? []),
    baseMap: values['base-map'],
    links: (values.link ?? []).map(splitLink),
    hosts: [...values.host ?? [], ...publicUrl ? [publicUrl.host] : []],
    publicUrl,
    oidc: oidcOf(values, listen),
    logFormat: oneOf('--log-format', values['log-format'] ?? 'text',
                     LOG_FORMATS),
    logLevel: oneOf('--log-level', values['log-level'] ?? 'info', LOG_LEVELS),
  };
}
