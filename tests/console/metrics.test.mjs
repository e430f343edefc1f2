// The server's metrics: how they are read, what follows from them, and who is
// told.
import assert from 'node:assert/strict';
import {createServer} from 'node:http';
import {mkdtempSync, rmSync} from 'node:fs';
import {tmpdir} from 'node:os';
import {join} from 'node:path';
import {after, before, test} from 'node:test';

import {Console, Issuer, load, Revisitd} from './world.mjs';

const issuer = new Issuer();
const POLICY = {
  version: 1,
  tenants: [{name: 'acme', vehicle_prefix: 'acme-'}],
  grants: [
    {token_subject: 'operator', tenant: '*', vehicles: ['*'], verbs: ['read']},
    {token_subject: 'acme', tenant: 'acme', vehicles: ['*'],
     verbs: ['read', 'write', 'admin']},
  ],
};

let directory;
let revisitd;

before(async () => {
  directory = mkdtempSync(join(tmpdir(), 'revisit-console-'));
  revisitd = new Revisitd(directory, issuer.flags(directory, POLICY));
  await revisitd.start();
});
after(async () => {
  await revisitd?.close();
  rmSync(directory, {recursive: true, force: true});
});

/** Status and content of what a console with these flags answers. */
async function metricsOf(flags, subject, address = revisitd.address) {
  const console = new Console(() => address, flags);
  await console.start();
  try {
    const answer = await fetch(`${console.url}/metrics.json`, {
      headers: subject ? {authorization: `Bearer ${issuer.token(subject)}`} :
                         {},
    });
    return {status: answer.status, body: await answer.json()};
  } finally {
    await console.close();
  }
}

test('an operator is told the metrics of the whole server', async () => {
  const {status, body} =
      await metricsOf(['--metrics', revisitd.metrics], 'operator');
  assert.equal(status, 200);
  assert.ok(Math.abs(body.time - Date.now()) < 60_000);
  const open = body.samples.filter(({name}) => name === 'revisit_calls_open');
  assert.ok(open.some(({labels}) => labels.method === 'StreamPoses'));
  for (const {name, value} of body.samples) {
    assert.match(name, /^(revisit|process)_/);
    assert.equal(typeof value, 'number', name);
  }
});

test('a tenant is refused them, whatever he may do with his vehicles',
     async () => {
  const {status, body} =
      await metricsOf(['--metrics', revisitd.metrics], 'acme');
  assert.equal(status, 403);
  assert.match(body.message, /belongs to a tenant/);
  assert.equal(body.samples, undefined);
});

test('strangers are refused them', async () => {
  for (const subject of [undefined, 'nobody']) {
    const {status, body} =
        await metricsOf(['--metrics', revisitd.metrics], subject);
    assert.ok(status === 401 || status === 403, `${status} to ${subject}`);
    assert.equal(body.samples, undefined);
  }
});

test('nobody is told them while the server cannot say who calls', async () => {
  const {status} = await metricsOf(['--metrics', revisitd.metrics], 'operator',
                                   '127.0.0.1:1');
  assert.equal(status, 503);
});

test('without --metrics there are none', async () => {
  const {status, body} = await metricsOf([], 'operator');
  assert.equal(status, 404);
  assert.match(body.message, /--metrics/);
});

test('metrics that are too long, too late, or none are an error', async () => {
  let answer;
  const fake = createServer((request, response) => answer(response));
  await new Promise(done => fake.listen(0, '127.0.0.1', done));
  const url = `http://127.0.0.1:${fake.address().port}/metrics`;
  try {
    for (const [kind, answering, message] of [
      ['long', response => {
        response.on('error', () => {});
        response.end('revisit_x 1\n'.repeat(400_000));
      }, /more than 4194304 bytes/],
      ['none', response => response.end('revisit_x{le="1} 2\n'),
       /no sample|no labels/],
      ['elsewhere', response => {
        response.writeHead(302, {location: revisitd.metrics});
        response.end();
      }, /redirect/],
      ['absent', response => {
        response.writeHead(404);
        response.end();
      }, /answers 404/],
      ['late', () => {}, /timeout|aborted/],
    ]) {
      answer = answering;
      const {status, body} = await metricsOf(['--metrics', url], 'operator');
      assert.equal(status, 502, kind);
      assert.match(body.message, message);
    }
  } finally {
    fake.closeAllConnections();
    fake.close();
  }
});

test('the text of metrics is read strictly', async () => {
  const {parseMetrics} = await load('server/exposition.ts');
  assert.deepEqual(parseMetrics([
    '# HELP a b', '# TYPE a counter', '', 'a 1', 'a_b{} -2.5e3 1700000000000',
    'a{x="1",y="q\\"\\\\\\n}{",} +Inf', 'a{ x = "2" } NaN',
  ].join('\n')), [
    {name: 'a', labels: {}, value: 1},
    {name: 'a_b', labels: {}, value: -2500},
    {name: 'a', labels: {x: '1', y: 'q"\\\n}{'}, value: null},
    {name: 'a', labels: {x: '2'}, value: null},
  ]);
  for (const line of ['a', 'a{x=1} 2', 'a{x="1} 2', 'a{x="1"', '2 3', 'a 0x1',
                      'a 1 2 3', 'a{x="1"y="2"} 3']) {
    assert.throws(() => parseMetrics(line), /of a metric/, line);
  }
});

test('rates and quantiles are those between two readings', async () => {
  const {Interval, Reading} = await load('web/data/readings.ts');
  const reading = (time, calls, buckets) => new Reading({time, samples: [
    ...Object.entries(calls).map(([code, value]) => (
        {name: 'calls', labels: {code, method: 'm'}, value})),
    ...Object.entries(buckets).flatMap(([le, value]) => ['a', 'b'].map(
        method => ({name: 'seconds_bucket', labels: {le, method},
                    value: value / 2}))),
  ]});
  const interval = new Interval(
      reading(1000, {OK: 5}, {0.1: 100, 1: 100, '+Inf': 100}),
      reading(5000, {OK: 25, ABORTED: 4}, {0.1: 140, 1: 200, '+Inf': 202}));
  assert.equal(interval.seconds, 4);
  assert.equal(interval.rate('calls'), 6);
  assert.equal(interval.rate('calls', {code: 'OK'}), 5);
  assert.equal(interval.rate('others'), undefined);
  assert.deepEqual([...interval.ratesBy('calls', 'code')],
                   [['OK', 5], ['ABORTED', 1]]);
  // 40 of 102 new values are at most 0.1, and 100 at most 1.
  const half = interval.quantile('seconds', 0.5);
  assert.ok(Math.abs(half.value - (0.1 + 0.9 * 11 / 60)) < 1e-9);
  assert.equal(half.isBeyond, false);
  assert.deepEqual(interval.quantile('seconds', 0.99),
                   {value: 1, isBeyond: true});
  assert.equal(interval.quantile('others', 0.5), undefined);
  assert.equal(new Interval(interval.now, interval.now)
                   .quantile('seconds', 0.5), undefined);
});
