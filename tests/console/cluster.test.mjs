// Several servers that share a store: the console goes to the one that has the
// vehicle.
import assert from 'node:assert/strict';
import {spawn} from 'node:child_process';
import {chmodSync, mkdirSync, mkdtempSync, readFileSync, rmSync,
        writeFileSync} from 'node:fs';
import {tmpdir} from 'node:os';
import {join} from 'node:path';
import {after, before, test} from 'node:test';

import {BIN, Console, load, Revisitd, ROOT, track, until} from './world.mjs';

const SKIPPED = 77;

/** A google.rpc.ErrorInfo that says who the owner is. */
function notOwner(owner) {
  const field = (number, data) => Buffer.concat(
      [Buffer.from([number << 3 | 2, data.length]), data]);
  return {
    type: 'google.rpc.ErrorInfo',
    value: Buffer.concat([
      field(1, Buffer.from('NOT_OWNER')),
      field(2, Buffer.from('revisit.v1')),
      field(3, Buffer.concat([field(1, Buffer.from('epoch')),
                              field(2, Buffer.from('7'))])),
      field(3, Buffer.concat([field(1, Buffer.from('owner')),
                              field(2, Buffer.from(owner))])),
    ]),
  };
}

/** A cluster at these addresses. `made` are the attempts of its calls so far,
 * and `answers` what each is answered: an owner, a code, or undefined for OK. */
async function fakeCluster(addresses) {
  const {Cluster, Code, ConnectError} = await load(
      'server/cluster.ts',
      'export {Code, ConnectError} from \'@connectrpc/connect\'');
  const connected = [];
  const cluster = new Cluster(addresses, address => {
    connected.push(address);
    return {transport: address, watch: {check() {}, hear() {}}};
  });
  const made = [];
  const call = (vehicle, ...answers) => cluster.call(
      vehicle, async ({transport, headers}) => {
    made.push([transport, ...headers.map(
        ([name, value]) => `${name} ${Buffer.from(value, 'base64')}`)]);
    const answer = answers.shift();
    if (answer === undefined) return 'answer';
    const error = new ConnectError('no', Code.Unavailable);
    if (answer !== 'away') error.details.push(notOwner(answer));
    throw error;
  });
  return {call, made, connected};
}

test('an owner whose address was given is gone to, now and later', async () => {
  const {call, made, connected} = await fakeCluster(['a:1', 'b:1']);
  assert.equal(await call('van', 'b:1'), 'answer');
  assert.equal(await call('van'), 'answer');
  assert.equal(await call('bus'), 'answer');
  assert.equal(await call(undefined), 'answer');
  assert.deepEqual(made, [['a:1'], ['b:1'], ['b:1'], ['a:1'], ['a:1']]);
  assert.deepEqual(connected, ['a:1', 'b:1']);
});

test('another owner is asked for by a header, and never connected to',
     async () => {
  const {call, made, connected} = await fakeCluster(['a:1']);
  assert.equal(await call('van', 'evil:1'), 'answer');
  assert.equal(await call('van'), 'answer');
  assert.deepEqual(made, [['a:1'], ['a:1', 'x-revisit-owner evil:1'],
                          ['a:1', 'x-revisit-owner evil:1']]);
  assert.deepEqual(connected, ['a:1']);
});

test('servers that lead on and on are not followed for ever', async () => {
  const {call, made} = await fakeCluster(['a:1', 'b:1', 'c:1']);
  await assert.rejects(call('van', 'b:1', 'c:1', 'b:1', 'c:1', 'b:1', 'c:1'));
  assert.equal(made.length, 4);
  made.length = 0;
  // The one that was named is not the owner, and knows no other.
  await assert.rejects(call('van', 'c:1', 'c:1'));
  assert.ok(made.length <= 2);
});

test('an owner that is away is forgotten', async () => {
  const {call, made} = await fakeCluster(['a:1', 'b:1']);
  await call('van', 'b:1');
  await assert.rejects(call('van', 'away'));
  await call('van');
  assert.deepEqual(made, [['a:1'], ['b:1'], ['b:1'], ['a:1']]);
});

test('calls are known by the vehicle in their request', async () => {
  const {vehicleOf} = await load('server/cluster.ts');
  for (const [request, vehicle] of [
    [{name: 'vehicles/van'}, 'van'],
    [{parent: 'vehicles/van'}, 'van'],
    [{vehicle: 'vehicles/van', sequence: 3n}, 'van'],
    [{name: 'vehicles/van/loopClosures/c-1'}, 'van'],
    [{parent: 'vehicles/-'}, undefined],
    [{name: ''}, undefined],
    [{service: 'vehicles/van'}, undefined],
  ]) {
    assert.equal(vehicleOf(request), vehicle);
  }
});

let directory;
let postgres;
let servers;
let hasPostgres = true;

before(async () => {
  directory = mkdtempSync(join(tmpdir(), 'revisit-console-'));
  // PostgreSQL may have to enter it as another user.
  chmodSync(directory, 0o711);
  postgres = spawn('python3', [join(ROOT, 'tests/console/private_postgres.py'),
                               BIN, directory],
                   {stdio: ['pipe', 'pipe', 'inherit']});
  let url = '';
  postgres.stdout.on('data', data => url += data);
  await until(() => url.includes('\n') || postgres.exitCode !== null,
              'PostgreSQL');
  if (postgres.exitCode === SKIPPED) {
    hasPostgres = false;
    return;
  }
  assert.equal(postgres.exitCode, null, 'PostgreSQL did not start');
  servers = [];
  for (const name of ['a', 'b']) {
    const files = join(directory, name);
    mkdirSync(files);
    const server = new Revisitd(files, [], url.trim());
    servers.push(server);
    await server.start();
  }
});
after(async () => {
  for (const server of servers ?? []) await server.close();
  postgres?.stdin.end();
  await until(() => postgres.exitCode !== null, 'end of PostgreSQL');
  rmSync(directory, {recursive: true, force: true});
});

/** How often a server was asked for this, with this code. */
function callsAt(server, method, code) {
  return readFileSync(server.log, 'utf8').split('\n').filter(
      line => line.includes(`method=${method} `) &&
          line.includes(`code=${code}`)).length;
}

/** The parts of a streamed answer, as Connect frames them. */
async function exported(console, vehicle) {
  const name = Buffer.from(`vehicles/${vehicle}`);
  const message = Buffer.concat([Buffer.from([1 << 3 | 2, name.length]), name]);
  const answer = await fetch(
      `${console.url}/revisit.v1.PoseGraphService/ExportPoseGraph`, {
        method: 'POST',
        headers: {'content-type': 'application/connect+proto',
                  'connect-protocol-version': '1'},
        body: Buffer.concat([Buffer.from([0, 0, 0, 0, message.length]),
                             message]),
      });
  const bytes = Buffer.from(await answer.arrayBuffer());
  const parts = [];
  for (let at = 0; at < bytes.length;) {
    const end = at + 5 + bytes.readUInt32BE(at + 1);
    parts.push({isEnd: (bytes[at] & 2) !== 0,
                data: bytes.subarray(at + 5, end)});
    at = end;
  }
  return parts;
}

test('a vehicle of another server is read, exported and decided about there',
     async t => {
  if (!hasPostgres) {
    t.skip('no PostgreSQL here');
    return;
  }
  const [first, owner] = servers;
  const file = join(directory, 'van.gpx');
  writeFileSync(file, track([52.5163, 13.3777]));
  for (const vehicle of ['van', 'bus']) {
    owner.cli('stream', file, '--create', '--vehicle', vehicle);
  }
  const console = new Console(() => first.address,
                              ['--server', owner.address]);
  await console.start();
  const call = async (method, request) => {
    const answer = await fetch(
        `${console.url}/revisit.v1.PoseGraphService/${method}`,
        {method: 'POST', headers: {'content-type': 'application/json'},
         body: JSON.stringify(request)});
    return {status: answer.status, body: await answer.json()};
  };
  try {
    for (let i = 0; i < 3; ++i) {
      const {status, body} = await call('GetVehicle', {name: 'vehicles/van'});
      assert.equal(status, 200, JSON.stringify(body));
      assert.equal(body.vehicle.durableSequence, '30');
    }
    const made = await call('AddLoopClosure', {
      parent: 'vehicles/van',
      loopClosure: {querySequence: '29', matchedSequence: '1'},
    });
    assert.equal(made.status, 200, JSON.stringify(made.body));
    // A call that is streamed finds the way by itself too.
    const parts = await exported(console, 'bus');
    assert.equal(parts.at(-1).data.toString(), '{}');
    assert.ok(parts.length > 1 && parts[0].data.includes('vehicles/bus'));
    // The log is written beside the calls, in their order.
    for (const server of servers) {
      server.text('info');
      await until(() => callsAt(server, 'GetServerInfo', 'OK') > 0,
                  'last call in the log');
    }
    // It was asked where the console knew it to be, or where it went since.
    assert.ok(callsAt(owner, 'GetVehicle', 'OK') +
              callsAt(first, 'GetVehicle', 'OK') >= 3);
    assert.equal(callsAt(first, 'GetVehicle', 'UNAVAILABLE'), 1);
  } finally {
    await console.close();
  }
});
