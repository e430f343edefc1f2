// The console as those see it who run it: probes, metrics, log, limits.
import assert from 'node:assert/strict';
import {readFileSync} from 'node:fs';
import {get} from 'node:http';
import {connect} from 'node:net';
import {after, before, test} from 'node:test';
import {setTimeout as sleep} from 'node:timers/promises';

import {DRIVE, until, World} from './world.mjs';

const SERVICE = 'revisit.v1.PoseGraphService';

let world;
let revisitd;
let gateway;

before(async () => {
  world = await World.make(
      ['--max-metadata-bytes', '8192', '--log-format', 'json'],
      ({revisitd: server}) => ['--admin-listen', '127.0.0.1:0', '--log-format',
                               'json', '--metrics', server.metrics]);
  ({revisitd, console: gateway} = world);
  revisitd.cli('stream', DRIVE, '--create', '--vehicle', 'shuttle-7',
               '--uncertainty', 'file');
});
after(() => world?.close());

/** Status, headers and text of the answer to a call through the console. */
async function call(method, request = {}, headers = {}) {
  const answer = await fetch(`${gateway.url}/${SERVICE}/${method}`, {
    method: 'POST', body: JSON.stringify(request),
    headers: {'content-type': 'application/json', ...headers},
  });
  return {status: answer.status, headers: answer.headers,
          text: await answer.text()};
}

async function probe(path) {
  const answer = await fetch(`http://${gateway.admin}${path}`);
  return {status: answer.status, text: await answer.text()};
}

/** The value of a metric, by name and labels as Prometheus reads them. */
async function metric(name) {
  const {text} = await probe('/metrics');
  const line = text.split('\n').find(one => one.startsWith(`${name} `));
  return line === undefined ? undefined : Number(line.split(' ').at(-1));
}

/** The lines about such an event in a log of JSON. */
function lines(log, event) {
  return log.split('\n').filter(line => line.startsWith('{'))
      .map(line => JSON.parse(line)).filter(line => line.event === event);
}

test('probes tell a living console from one whose revisitd is away',
     async () => {
  assert.equal((await probe('/livez')).status, 200);
  await until(async () => (await probe('/readyz')).status === 200, 'readiness');
  assert.equal((await probe('/elsewhere')).status, 404);
  await revisitd.close();
  const away = await until(async () => {
    const answer = await probe('/readyz');
    return answer.status === 503 && answer;
  }, 'end of readiness');
  assert.ok(away.text.includes(revisitd.address), away.text);
  assert.equal((await probe('/livez')).status, 200);
  assert.equal(await metric(
      `revisit_console_server_up{server="${revisitd.address}"}`), 0);
  await revisitd.start();
  await until(async () => (await probe('/readyz')).status === 200, 'readiness');
  assert.equal(lines(gateway.log, 'server_back').length, 1);
});

test('probes and metrics are not at the address that people reach',
     async () => {
  for (const path of ['/metrics', '/livez', '/readyz']) {
    assert.equal((await fetch(gateway.url + path)).status, 404, path);
  }
});

test('a revisitd that stands still is noticed within three seconds',
     async () => {
  const hanging = call('ListVehicles');
  assert.equal((await hanging).status, 200);
  revisitd.signal('SIGSTOP');
  try {
    const began = performance.now();
    // With no deadline of its own.
    const {status, text} = await call('ListVehicles');
    const waited = performance.now() - began;
    assert.equal(status, 503);
    assert.match(JSON.parse(text).message, /does not answer since/);
    assert.ok(waited < 3500, `${waited} ms`);
    // And then at once.
    const again = performance.now();
    assert.equal((await call('ListVehicles')).status, 503);
    assert.ok(performance.now() - again < 500);
  } finally {
    revisitd.signal('SIGCONT');
  }
  await until(async () => (await call('ListVehicles')).status === 200,
              'answer of a server that goes on');
});

test('people see that revisitd stands still, and that it goes on', async () => {
  const page = await world.open('/');
  await page.getByText('1 of 1 vehicles').waitFor();
  const banner = page.getByText('No answer from revisitd since');
  revisitd.signal('SIGSTOP');
  try {
    const began = performance.now();
    await banner.waitFor();
    // Three seconds, and the time until the page asks.
    const waited = performance.now() - began;
    assert.ok(waited < 6000, `${waited} ms`);
  } finally {
    revisitd.signal('SIGCONT');
  }
  await banner.waitFor({state: 'detached'});
  await page.context().close();
});

test('calls and requests are counted by code', async () => {
  const counted = `revisit_console_calls_total{method="GetVehicle",code=`;
  const before = await metric(`${counted}"OK"}`) ?? 0;
  await call('GetVehicle', {name: 'vehicles/shuttle-7'});
  await call('GetVehicle', {name: 'vehicles/nobody'});
  assert.equal(await metric(`${counted}"OK"}`), before + 1);
  assert.equal(await metric(`${counted}"NOT_FOUND"}`), 1);
  assert.equal(await metric(
      'revisit_console_call_seconds_count{method="GetVehicle"}'), before + 2);
  assert.equal(await metric('revisit_console_streams_open'), 0);
  await fetch(gateway.url);
  await until(async () => await metric(
      'revisit_console_requests_total{kind="page",status="200"}') >= 1,
      'count of a page');
  assert.ok(await metric('process_resident_memory_bytes') > 0);
});

/** What revisitd has logged of a call. */
async function loggedByServer(requestId) {
  return until(() => lines(readFileSync(revisitd.log, 'utf8'), 'call').find(
      line => line.request_id === requestId), `line of ${requestId}`);
}

test('a request has one id and one trace in both logs', async () => {
  const trace = '0af7651916cd43dd8448eb211c80319c';
  const {status, headers} = await call(
      'GetVehicle', {name: 'vehicles/someone'},
      {'traceparent': `00-${trace}-b7ad6b7169203331-01`,
       'x-request-id': 'mine-1'});
  assert.equal(status, 404);
  assert.equal(headers.get('x-request-id'), 'mine-1');
  const server = await loggedByServer('mine-1');
  assert.equal(server.trace_id, trace);
  assert.notEqual(server.parent_id, 'b7ad6b7169203331');
  const made = await call('ListVehicles', {}, {
    'traceparent': '00-00000000000000000000000000000000-b7ad6b7169203331-01',
    'x-request-id': 'two words'});
  const id = made.headers.get('x-request-id');
  assert.match(id, /^[0-9a-f]{16}$/);
  assert.match((await loggedByServer(id)).trace_id, /^(?!0{32})[0-9a-f]{32}$/);
});

test('changes and failures are logged each, and repeated questions are not',
     async () => {
  const beginning = gateway.log.length;
  for (let i = 0; i < 20; ++i) {
    await call('GetVehicle', {name: 'vehicles/shuttle-7'});
    await call('GetVehicle', {name: 'vehicles/not-there'});
  }
  for (let i = 0; i < 3; ++i) {
    await call('DeleteRejectedCandidate',
               {name: `vehicles/shuttle-7/rejectedCandidates/${i}`});
  }
  await sleep(200);
  const calls = lines(gateway.log.slice(beginning), 'call');
  const about = method => calls.filter(line => line.method === method);
  assert.equal(about('DeleteRejectedCandidate').length, 3);
  // They were counted in tests before, or are the first of their kind.
  assert.ok(about('GetVehicle').length <= 2, JSON.stringify(calls));
  for (const line of about('DeleteRejectedCandidate')) {
    assert.equal(line.level, 'warning');
    assert.match(line.request_id, /^[0-9a-f]{16}$/);
    assert.equal(line.peer, '127.0.0.1');
  }
});

test('headers that revisitd refuses hurt nobody but who sends them',
     async () => {
  // A proxy, or a page, in the hands of one person: too long for the revisitd,
  // for the console's limit, and for the console's parser.
  const sizes = [6000, 7900, 12_000, 40_000];
  const counts = {others: 0, failed: 0};
  let over = false;
  const others = Array.from({length: 6}, async () => {
    while (!over) {
      const {status} = await call('ListVehicles');
      ++counts.others;
      if (status !== 200) ++counts.failed;
    }
  });
  const statuses = new Map(sizes.map(size => [size, new Set()]));
  for (let i = 0; i < 60; ++i) {
    const size = sizes[i % sizes.length];
    const {status, text} = await call(
        'ListVehicles', {}, {authorization: `Bearer ${'a'.repeat(size)}`});
    statuses.get(size).add(status);
    if (status === 431) assert.match(text, /allowed are 7168|more than the/);
  }
  over = true;
  await Promise.all(others);
  assert.deepEqual([...statuses].map(([size, found]) => [size, ...found]),
                   [[6000, 200], [7900, 431], [12_000, 431], [40_000, 431]]);
  assert.ok(counts.others > 60, counts.others);
  assert.equal(counts.failed, 0);
});

test('cookies take no room in calls, and too many are told so', async () => {
  const few = await call('ListVehicles', {},
                         {cookie: `other=${'a'.repeat(12_000)}`});
  assert.equal(few.status, 200);
  const many = await call('ListVehicles', {},
                          {cookie: `other=${'a'.repeat(40_000)}`});
  assert.equal(many.status, 431);
  assert.match(many.text, /Cookies/);
});

/** The bytes of an answer as they came, and its headers. */
function raw(path, coding) {
  return new Promise((done, fail) => get(
      gateway.url + path, {headers: {'accept-encoding': coding}}, answer => {
        const parts = [];
        answer.on('data', part => parts.push(part));
        answer.on('end', () => done({headers: answer.headers,
                                     bytes: Buffer.concat(parts).length}));
      }).on('error', fail));
}

test('pages and scripts are compressed and kept by their names', async () => {
  const page = await (await fetch(gateway.url)).text();
  const script = /src="([^"]+\.js)"/.exec(page)[1];
  const plain = await raw(script, 'identity');
  assert.equal(plain.headers['content-encoding'], undefined);
  assert.match(plain.headers['cache-control'], /immutable/);
  for (const [accepted, coding] of [['gzip, deflate, br', 'br'],
                                    ['gzip', 'gzip'],
                                    ['br;q=0, gzip', 'gzip']]) {
    const {headers, bytes} = await raw(script, accepted);
    assert.equal(headers['content-encoding'], coding);
    assert.equal(headers.vary, 'accept-encoding');
    assert.ok(bytes < plain.bytes / 3, `${bytes} of ${plain.bytes}`);
  }
  const index = await raw('/', 'br');
  assert.equal(index.headers['cache-control'], 'no-cache');
  // Files of the compressed forms have no addresses of their own.
  assert.equal((await fetch(`${gateway.url}${script}.br`)).status, 404);
});

test('metrics and graphs are compressed on their way', async () => {
  const plain = await raw('/metrics.json', 'identity');
  const {headers, bytes} = await raw('/metrics.json', 'gzip');
  assert.equal(headers['content-encoding'], 'gzip');
  assert.ok(bytes < plain.bytes / 3, `${bytes} of ${plain.bytes}`);
  // The one field of the request, and Connect's prefix of a message.
  const name = Buffer.from('vehicles/shuttle-7');
  const message = Buffer.from([0x0a, name.length, ...name]);
  const prefix = Buffer.from([0, 0, 0, 0, message.length]);
  const graph = await fetch(`${gateway.url}/${SERVICE}/ExportPoseGraph`, {
    method: 'POST', body: Buffer.concat([prefix, message]),
    headers: {'content-type': 'application/connect+proto',
              'connect-protocol-version': '1', 'accept-encoding': 'gzip'},
  });
  assert.equal(graph.headers.get('content-encoding'), 'gzip');
  assert.ok((await graph.arrayBuffer()).byteLength > 100_000);
});

test('what is no request of HTTP is told so', async () => {
  const {port} = new URL(gateway.url);
  const said = await new Promise(done => {
    let text = '';
    const socket = connect(port, '127.0.0.1', () => socket.write('hello\r\n\r\n'));
    socket.on('data', data => text += data);
    socket.on('close', () => done(text));
  });
  assert.match(said, /^HTTP\/1\.1 400 Bad Request\r\n/);
});
