import {readFileSync} from 'node:fs';
import {createServer, type IncomingMessage, type Server as HttpServer,
        type ServerResponse} from 'node:http';
import type {AddressInfo} from 'node:net';
import {fileURLToPath} from 'node:url';

import {createContextValues} from '@connectrpc/connect';
import {compressionGzip, connectNodeAdapter, createGrpcTransport,
        Http2SessionManager} from '@connectrpc/connect-node';

import {makeAdmin} from './admin.js';
import {BaseMap} from './base_map.js';
import {Cluster, type Server} from './cluster.js';
import {forward} from './forward.js';
import {answerUnreadable, Gateway} from './gateway.js';
import {Log} from './log.js';
import {Metrics} from './metrics.js';
import {type Address, type Options, readOptions, USAGE, UsageError} from
    './options.js';
import {Pages} from './pages.js';
import {RECORD} from './record.js';
import {SignIn} from './sign_in.js';
import {Telemetry} from './telemetry.js';
import {Watch} from './watch.js';

const WRONG_USAGE = 64;
const MAX_REQUEST_BYTES = 65536;
/** For the headers of a browser that are not passed on, cookies among them. */
const OTHER_HEADER_BYTES = 16384;
/** How long calls may go on after the console was told to stop. */
const DRAIN_MILLISECONDS = 5000;
/** How often it then looks for connections on which no call is left. */
const IDLE_MILLISECONDS = 100;
/** The name of a bearer token's header, and what stands before the token. */
const BEARER_BYTES = 32 + 'authorization'.length + 'Bearer '.length;

/** The page asks for these to know which of its parts there are. */
function settingsOf(options: Options): object {
  return {metrics: options.metrics.length > 0,
          baseMap: options.baseMap !== undefined, links: options.links,
          signIn: options.oidc !== undefined};
}

/** Connects to all servers, and goes on looking whether they are there. */
function clusterOf(options: Options, log: Log, telemetry: Telemetry): Cluster {
  const nodeOptions =
      options.tlsCa ? {ca: readFileSync(options.tlsCa)} : {};
  const connect = (address: string): Server => {
    const baseUrl = `${options.tlsCa ? 'https' : 'http'}://${address}`;
    const sessionManager = new Http2SessionManager(baseUrl, {}, nodeOptions);
    const transport = createGrpcTransport({baseUrl, sessionManager});
    const watch = new Watch(address, transport,
                            reason => sessionManager.abort(reason), log,
                            telemetry);
    void watch.run();
    return {transport, watch};
  };
  return new Cluster(options.servers, connect);
}

function nameOf({host, port}: Address): string {
  return `${host.includes(':') ? `[${host}]` : host}:${port}`;
}

/** Listens, and returns the address with its port, once that is known. */
function listen(server: HttpServer, {host, port}: Address): Promise<Address> {
  return new Promise(done => {
    server.on('error', error => {
      console.error(`console: cannot listen: ${error.message}`);
      process.exit(1);
    });
    server.listen(port, host, () => done(
        {host, port: (server.address() as AddressInfo).port}));
  });
}

function gatewayOf(options: Options, cluster: Cluster, base: URL,
                   hosts: Set<string>, log: Log, telemetry: Telemetry,
                   stopping: AbortSignal): Gateway {
  const pages =
      new Pages(fileURLToPath(new URL('../web', import.meta.url)));
  pages.add('/console.json', JSON.stringify(settingsOf(options)));
  const gateway: Gateway = new Gateway({
    pages,
    metrics: new Metrics(options.metrics,
                         cluster.servers.map(({transport}) => transport)),
    baseMap: options.baseMap === undefined ? undefined :
                                             new BaseMap(options.baseMap),
    signIn: options.oidc && new SignIn(
        options.oidc, base, options.maxMetadataBytes - BEARER_BYTES, log,
        telemetry),
    calls: connectNodeAdapter({
      routes: router => forward(router, cluster, telemetry, stopping),
      readMaxBytes: MAX_REQUEST_BYTES,
      // Brotli is as slow here as it can be.
      acceptCompression: [compressionGzip],
      grpc: false,
      grpcWeb: false,
      contextValues: request => createContextValues().set(
          RECORD, gateway.recordOf(request)),
    }),
  }, hosts, options.maxMetadataBytes, log, telemetry);
  return gateway;
}

/** Lets calls end that are on, for a while; those that `stop` aborts at once. */
function stopAtSignals(server: HttpServer, log: Log,
                       stop: AbortController): void {
  for (const signal of ['SIGINT', 'SIGTERM'] as const) {
    process.once(signal, () => {
      log.write('info', 'stopping', {signal});
      stop.abort();
      server.close(() => process.exit(0));
      server.closeIdleConnections();
      // A connection whose call has ended would be kept open for a next call,
      // and the server would not end: idle connections are closed repeatedly.
      setInterval(() => server.closeIdleConnections(), IDLE_MILLISECONDS);
      setTimeout(() => process.exit(0), DRAIN_MILLISECONDS);
    });
  }
}

async function serve(options: Options): Promise<void> {
  const log = new Log(options.logFormat, options.logLevel);
  const telemetry = new Telemetry();
  const cluster = clusterOf(options, log, telemetry);
  const hosts = new Set(options.hosts);
  let gateway: Gateway|undefined;
  const server = createServer({
    maxHeaderSize: options.maxMetadataBytes + OTHER_HEADER_BYTES,
  }, (request: IncomingMessage, response: ServerResponse) => {
    void gateway!.answer(request, response);
  });
  server.on('clientError', answerUnreadable);
  const address = await listen(server, options.listen);
  const base = options.publicUrl ?? new URL(`http://${nameOf(address)}`);
  for (const host of [address.host, '127.0.0.1', 'localhost']) {
    hosts.add(nameOf({host, port: address.port}));
  }
  const stop = new AbortController();
  gateway = gatewayOf(options, cluster, base, hosts, log, telemetry,
                      stop.signal);
  if (options.adminListen) {
    const admin = await listen(
        makeAdmin(cluster.servers.map(({watch}) => watch), telemetry),
        options.adminListen);
    console.log(`admin listening on ${nameOf(admin)}`);
  }
  stopAtSignals(server, log, stop);
  console.log(`The console is at http://${nameOf(address)}, its revisitd at ` +
              options.servers.join(', '));
}

function fail(error: unknown): never {
  console.error(`console: ${(error as Error).message}`);
  if (error instanceof UsageError) console.error(USAGE);
  process.exit(error instanceof UsageError ? WRONG_USAGE : 1);
}

try {
  const options = readOptions(process.argv.slice(2), process.env);
  if (typeof options === 'string') {
    process.stdout.write(options);
  } else {
    serve(options).catch(fail);
  }
} catch (error) {
  fail(error);
}
