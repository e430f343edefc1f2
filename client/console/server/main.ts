import {readFileSync} from 'node:fs';
import {createServer, type IncomingMessage, type ServerResponse} from
    'node:http';
import type {AddressInfo} from 'node:net';
import {fileURLToPath} from 'node:url';

import {connectNodeAdapter, createGrpcTransport} from
    '@connectrpc/connect-node';

import {BASE_MAP_PATH, BaseMap} from './base_map.js';
import {Cluster} from './cluster.js';
import {forward} from './forward.js';
import {Metrics} from './metrics.js';
import {type Options, readOptions, USAGE, UsageError} from './options.js';
import {Pages, SECURITY_HEADERS} from './pages.js';

const WRONG_USAGE = 64;
const MAX_REQUEST_BYTES = 65536;

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

/** The page asks for these to know which of its parts there are. */
function settingsOf(options: Options): object {
  return {metrics: options.metrics.length > 0,
          baseMap: options.baseMap !== undefined, links: options.links};
}

function serve(options: Options): void {
  const nodeOptions =
      options.tlsCa ? {ca: readFileSync(options.tlsCa)} : {};
  const cluster = new Cluster(options.servers, address => createGrpcTransport({
    baseUrl: `${options.tlsCa ? 'https' : 'http'}://${address}`,
    nodeOptions,
  }));
  const pages =
      new Pages(fileURLToPath(new URL('../web', import.meta.url)));
  const metrics = new Metrics(options.metrics, cluster.transports);
  const baseMap = options.baseMap === undefined ?
      undefined : new BaseMap(options.baseMap);
  pages.add('/console.json', JSON.stringify(settingsOf(options)));
  const answer = connectNodeAdapter({
    routes: router => forward(router, cluster),
    readMaxBytes: MAX_REQUEST_BYTES,
    grpc: false,
    grpcWeb: false,
    fallback: (request, answered) => {
      const response = answered as ServerResponse;
      const path = (request.url ?? '/').split('?')[0];
      if (path === '/metrics.json') {
        void metrics.answer(request as IncomingMessage, response);
      } else if (path === BASE_MAP_PATH && baseMap) {
        baseMap.answer(request as IncomingMessage, response);
      } else {
        pages.answer(request as IncomingMessage, response);
      }
    },
  });
  const hosts = new Set(options.hosts);
  const server = createServer((request, response) => {
    for (const [name, value] of Object.entries(SECURITY_HEADERS)) {
      response.setHeader(name, value);
    }
    if (isOwn(request, hosts)) {
      answer(request, response);
    } else {
      response.writeHead(403, {'content-type': 'text/plain'});
      response.end('The console does not answer under this name, or not to ' +
                   'the page that asks; --host adds a name.\n');
    }
  });
  server.on('error', error => {
    console.error(`console: cannot listen: ${error.message}`);
    process.exit(1);
  });
  server.listen(options.listenPort, options.listenHost, () => {
    const {port} = server.address() as AddressInfo;
    const host = options.listenHost.includes(':') ?
        `[${options.listenHost}]` : options.listenHost;
    hosts.add(`${host}:${port}`).add(`localhost:${port}`);
    console.log(`The console is at http://${host}:${port}, its revisitd at ` +
                options.servers.join(', '));
  });
  for (const signal of ['SIGINT', 'SIGTERM'] as const) {
    process.on(signal, () => process.exit(0));
  }
}

try {
  const options = readOptions(process.argv.slice(2), process.env);
  if (options) {
    serve(options);
  } else {
    process.stdout.write(USAGE);
  }
} catch (error) {
  console.error(`console: ${(error as Error).message}`);
  if (error instanceof UsageError) console.error(USAGE);
  process.exit(error instanceof UsageError ? WRONG_USAGE : 1);
}
