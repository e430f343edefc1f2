// The servers' metrics: how they are read, what follows from them, and who is
// told.
import assert from 'node:assert/strict';
import {createServer} from 'node:http';
import {mkdtempSync, rmSync} from 'node:fs';
import {tmpdir} from 'node:os';
import {join} from 'node:path';
import {after, before, test} from 'node:test';

import {Console, Issuer, load, Revisitd, until} from './world.mjs';

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

/** Runs `use` with a console of these flags, and a function that returns status
 * and content of its answer to somebody. */
async function withConsole(flags, use, address = revisitd.address) {
  const console = new Console(() => address, flags);
  await console.start();
  try {
    return await use(async (subject, tokens = {}) => {
      const token = subject && (tokens[subject] ?? issuer.token(subject));
      const answer = await fetch(`${console.url}/metrics.json`, {
        headers: token ? {authorization: `Bearer ${token}`} : {},
      });
      return {status: answer.status, body: await answer.json()};
    });
  } finally {
    await console.close();
  }
}

function metricsOf(flags, subject, address) {
  return withConsole(flags, ask => ask(subject), address);
}

/** What the operator is told once it is so of the first server: nobody waits
 * long for a reading. */
function toldWhen(ask, condition, what) {
  return until(async () => {
    const {status, body} = await ask('operator');
    assert.equal(status, 200);
    return condition(body.servers[0]) && body;
  }, what);
}

test('an operator is told the metrics of the whole server', async () => {
  const body = await withConsole(
      ['--metrics', revisitd.metrics],
      ask => toldWhen(ask, ({scrape}) => scrape, 'reading'));
  assert.equal(body.servers.length, 1);
  const [{name: server, scrape: {time, samples}, silence}] = body.servers;
  assert.equal(server, new URL(revisitd.metrics).host);
  assert.equal(silence, undefined);
  assert.ok(Math.abs(time - Date.now()) < 60_000);
  assert.ok(time <= body.time);
  const open = samples.filter(({name}) => name === 'revisit_calls_open');
  assert.ok(open.some(({labels}) => labels.method === 'StreamPoses'));
  for (const {name, value} of samples) {
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
  assert.equal(body.servers, undefined);
});

test('strangers are refused them', async () => {
  for (const subject of [undefined, 'nobody']) {
    const {status, body} =
        await metricsOf(['--metrics', revisitd.metrics], subject);
    assert.ok(status === 401 || status === 403, `${status} to ${subject}`);
    assert.equal(body.servers, undefined);
  }
});

test('nobody is told them while the server cannot say who calls', async () => {
  const {status} = await metricsOf(['--metrics', revisitd.metrics], 'operator',
                                   '127.0.0.1:1');
  assert.equal(status, 503);
});

/** How often revisitd was asked who somebody is. */
async function questions() {
  const text = await (await fetch(revisitd.metrics)).text();
  return [...text.matchAll(
      /^revisit_calls_total\{[^}]*method="GetServerInfo"[^}]*\} (\d+)$/gm)]
      .reduce((sum, [, value]) => sum + Number(value), 0);
}

test('revisitd is asked about a caller once in ten seconds, however many tabs ' +
     'he has', async () => {
  await withConsole(['--metrics', revisitd.metrics], async ask => {
    const before = await questions();
    const began = Date.now();
    // All tabs of a caller have one token.
    const tokens = {operator: issuer.token('operator'),
                    acme: issuer.token('acme')};
    const asked = [];
    for (let round = 0; round < 5; ++round) {
      for (const subject of ['operator', 'acme', undefined]) {
        for (let tab = 0; tab < 3; ++tab) asked.push(ask(subject, tokens));
      }
      await Promise.all(asked);
    }
    assert.ok(Date.now() - began < 9000);
    assert.deepEqual(
        (await Promise.all(asked)).map(({status}) => status),
        Array(5).fill([200, 200, 200, 403, 403, 403, 401, 401, 401]).flat());
    assert.equal(await questions() - before, 3);
    await until(async () => {
      await ask('operator', tokens);
      return await questions() - before === 4;
    }, 'another question');
    assert.ok(Date.now() - began >= 10_000);
  });
});

test('that no server answers is not remembered', async () => {
  const started = new Revisitd(mkdtempSync(join(directory, 'late-')),
                               issuer.flags(directory, POLICY));
  await started.start();
  await started.kill();
  try {
    await withConsole(['--metrics', revisitd.metrics], async ask => {
      const tokens = {operator: issuer.token('operator')};
      assert.equal((await ask('operator', tokens)).status, 503);
      await started.start();
      await until(async () => (await ask('operator', tokens)).status === 200,
                  'an answer', 8000);
    }, started.address);
  } finally {
    await started.close();
  }
});

test('without --metrics there are none', async () => {
  const {status, body} = await metricsOf([], 'operator');
  assert.equal(status, 404);
  assert.match(body.message, /--metrics/);
});

test('a server that cannot say who calls is passed over', async () => {
  const flags = ['--server', revisitd.address, '--metrics', revisitd.metrics];
  const away = '127.0.0.1:1';
  assert.equal((await metricsOf(flags, 'operator', away)).status, 200);
  assert.equal((await metricsOf(flags, 'acme', away)).status, 403);
});

/** A page of metrics that is answered by `answer`, as long as `use` runs. */
async function withPage(answer, use) {
  const fake = createServer((request, response) => answer(response));
  await new Promise(done => fake.listen(0, '127.0.0.1', done));
  try {
    return await use(`http://127.0.0.1:${fake.address().port}/metrics`);
  } finally {
    fake.closeAllConnections();
    fake.close();
  }
}

test('metrics that are too long, too late, or none are told as such, and ' +
     'those of others beside them', async () => {
  for (const [kind, answer, message] of [
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
    await withPage(answer, url => withConsole(
        ['--metrics', `${kind}=${url}`, '--metrics', revisitd.metrics],
        async ask => {
      const began = Date.now();
      let answers = 0;
      const bad = await until(async () => {
        const {status, body: {servers: [server, other]}} =
            await ask('operator');
        ++answers;
        assert.equal(status, 200, kind);
        assert.equal(server.name, kind);
        assert.equal(server.scrape, undefined, kind);
        return server.silence && other.scrape?.samples.length > 0 && server;
      }, kind);
      // Its deadline is its own: answers did not wait for it.
      if (kind === 'late') assert.ok(answers > 2, `${answers} answers`);
      assert.match(bad.silence.message, message);
      assert.match(bad.silence.message, new RegExp(url));
      assert.ok(bad.silence.since >= began && bad.silence.since <= Date.now());
    }));
  }
});

test('a server is silent since it was first asked in vain', async () => {
  let isWell = true;
  let asked = 0;
  const answer = response => {
    ++asked;
    response.writeHead(isWell ? 200 : 500);
    response.end('revisit_x 1\n');
  };
  await withPage(answer, url => withConsole(['--metrics', url], async ask => {
    const when = async (condition, what) =>
        (await toldWhen(ask, condition, what)).servers[0];
    const well = await when(({scrape}) => scrape, 'reading');
    assert.equal(well.scrape.samples.length, 1);
    isWell = false;
    const {silence: first, scrape} =
        await when(({silence}) => silence, 'silence');
    assert.ok(first.since > well.scrape.time);
    assert.equal(scrape, undefined);
    const before = asked;
    // The second of two more questions comes behind the answer to the first.
    const {silence: still} =
        await when(() => asked > before + 1, 'more questions');
    assert.deepEqual(still, first);
    isWell = true;
    const again = await when(({silence}) => !silence, 'another reading');
    assert.ok(again.scrape.time > first.since);
    isWell = false;
    const {silence: second} = await when(({silence}) => silence, 'silence');
    assert.ok(second.since > again.scrape.time);
  }));
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

/** Samples of calls by code, of a histogram by bound, and of gauges. */
function samplesOf({calls = {}, buckets = {}, gauges = {}}) {
  return [
    ...Object.entries(calls).map(([code, value]) => (
        {name: 'calls', labels: {code, method: 'm'}, value})),
    ...Object.entries(buckets).flatMap(([le, value]) => ['a', 'b'].map(
        method => ({name: 'seconds_bucket', labels: {le, method},
                    value: value / 2}))),
    ...Object.entries(gauges).map(([name, value]) => (
        {name, labels: {}, value})),
  ];
}

/** Those of a server from one time to another, in milliseconds. */
async function intervalOf(...ends) {
  const {Interval, Reading} = await load('web/data/readings.ts');
  const [before, now] = ends.map(
      ([time, values]) => new Reading({time, samples: samplesOf(values)}));
  return new Interval(before, now ?? before);
}

test('rates and quantiles are those between two readings', async () => {
  const {quantile} = await load('web/data/readings.ts');
  const interval = await intervalOf(
      [1000, {calls: {OK: 5}, buckets: {0.1: 100, 1: 100, '+Inf': 100}}],
      [5000, {calls: {OK: 25, ABORTED: 4},
              buckets: {0.1: 140, 1: 200, '+Inf': 202}}]);
  assert.equal(interval.seconds, 4);
  assert.equal(interval.rate('calls'), 6);
  assert.equal(interval.rate('calls', {code: 'OK'}), 5);
  assert.equal(interval.rate('others'), undefined);
  assert.deepEqual([...interval.ratesBy('calls', 'code')],
                   [['OK', 5], ['ABORTED', 1]]);
  // 40 of 102 new values are at most 0.1, and 100 at most 1.
  const half = quantile(interval, 'seconds', 0.5);
  assert.ok(Math.abs(half.value - (0.1 + 0.9 * 11 / 60)) < 1e-9);
  assert.equal(half.isBeyond, false);
  assert.deepEqual(quantile(interval, 'seconds', 0.99),
                   {value: 1, isBeyond: true});
  assert.equal(quantile(interval, 'others', 0.5), undefined);
});

test('one reading has values, and no rates yet', async () => {
  const {quantile} = await load('web/data/readings.ts');
  const one = await intervalOf([1000, {calls: {OK: 5}, gauges: {queued: 3},
                                       buckets: {1: 5, '+Inf': 7}}]);
  assert.equal(one.seconds, 0);
  assert.equal(one.value('queued'), 3);
  assert.equal(one.rate('calls'), undefined);
  assert.deepEqual([...one.ratesBy('calls', 'code')], []);
  assert.equal(quantile(one, 'seconds', 0.5), undefined);
});

test('totals are sums of values and rates, and percentiles those of all values',
     async () => {
  const {quantile} = await load('web/data/readings.ts');
  const {Total} = await load('web/data/total.ts');
  const none = {0.1: 0, 1: 0, '+Inf': 0};
  // 300 new values in four seconds, of which one in a hundred is beyond 0.1;
  // and 100 in two, of which a half is.
  const fast = await intervalOf(
      [1000, {calls: {OK: 10}, buckets: none}],
      [5000, {calls: {OK: 50, ABORTED: 4}, gauges: {queued: 3, vehicles: 1},
              buckets: {0.1: 297, 1: 300, '+Inf': 300}}]);
  const slow = await intervalOf(
      [2900, {calls: {OK: 100}, buckets: none}],
      [4900, {calls: {OK: 104}, gauges: {vehicles: 2},
              buckets: {0.1: 50, 1: 100, '+Inf': 100}}]);
  const begun = await intervalOf([4800, {calls: {OK: 7},
                                         gauges: {vehicles: 4}}]);
  const total = new Total([fast, slow, begun]);
  assert.equal(total.time, 5000);
  assert.equal(total.seconds, 4);
  assert.equal(total.value('vehicles'), 7);
  assert.equal(total.value('queued'), 3);
  assert.equal(total.value('others'), undefined);
  assert.equal(total.rate('calls'), 11 + 2);
  assert.equal(total.rate('others'), undefined);
  assert.deepEqual([...total.by('calls', 'code')], [['OK', 161],
                                                    ['ABORTED', 4]]);
  assert.deepEqual([...total.ratesBy('calls', 'code')], [['OK', 12],
                                                         ['ABORTED', 1]]);
  // A second brings 75 and 50 values, 74.25 and 25 of them at most 0.1.
  assert.deepEqual(total.bucketRates('seconds'),
                   new Map([[0.1, 99.25], [1, 125], [Infinity, 125]]));
  const p90 = quantile(total, 'seconds', 0.9).value;
  assert.ok(Math.abs(p90 - (0.1 + 0.9 * (112.5 - 99.25) / 25.75)) < 1e-9);
  // It is neither the sum nor the mean of the servers' own.
  const own = [fast, slow].map(part => quantile(part, 'seconds', 0.9).value);
  assert.ok(own[0] < p90 && p90 < own[1], `${own} ${p90}`);
});

test('errors and the end of a certificate are told where they are known',
     async () => {
  const {certificateEnd, errorRate} =
      await load('web/views/server_facts.ts');
  const {Interval, Reading} = await load('web/data/readings.ts');
  const name = 'revisit_tls_certificate_expiry_timestamp_seconds';
  const interval = (end, errors) => new Interval(...[0, 10].map(
      seconds => new Reading({time: 1000 * seconds, samples: [
        {name, labels: {}, value: end},
        ...[['OK', 7], ['ABORTED', errors]].map(([code, value]) => (
            {name: 'revisit_calls_total', labels: {code},
             value: value * seconds})),
      ]})));
  assert.equal(certificateEnd(interval(10 + 90 * 86_400, 0)), 'in 90 days');
  assert.equal(certificateEnd(interval(10 - 3 * 3600, 0)), '3 hours ago');
  assert.equal(errorRate(interval(0, 2)), 2);
  const none = await intervalOf([0, {}], [1000, {}]);
  assert.equal(certificateEnd(none), undefined);
  assert.equal(errorRate(none), undefined);
});

test('of servers with other buckets those count that all have', async () => {
  const {Total} = await load('web/data/total.ts');
  const part = buckets => intervalOf(
      [0, {buckets: Object.fromEntries(
          Object.keys(buckets).map(bound => [bound, 0]))}],
      [1000, {buckets}]);
  const total = new Total([
    await part({0.1: 1, 0.5: 2, 1: 3, '+Inf': 4}),
    await part({0.1: 10, 0.2: 20, 1: 30, '+Inf': 40}),
  ]);
  assert.deepEqual(total.bucketRates('seconds'),
                   new Map([[0.1, 11], [1, 33], [Infinity, 44]]));
});

test('the history of servers goes on beside one that restarts, is slow or ' +
     'silent', async () => {
  const {historyAfter, NO_HISTORY} = await load('web/data/server_history.ts');
  const scrape = (time, start, ended, streams) => ({time, samples: [
    {name: 'process_start_time_seconds', labels: {}, value: start},
    {name: 'revisit_calls_total', labels: {code: 'OK', method: 'm'},
     value: ended},
    {name: 'revisit_calls_open', labels: {method: 'StreamPoses'},
     value: streams},
    {name: 'revisit_calls_open', labels: {method: 'FindCandidates'}, value: 9},
  ]});
  const silence = {since: 2500, message: 'no'};
  let history = NO_HISTORY;
  const states = [];
  for (const [time, a, b] of [
    [1000, {scrape: scrape(1000, 1, 0, 2)}, {scrape: scrape(990, 1, 100, 3)}],
    // The second is slow.
    [2000, {scrape: scrape(2000, 1, 10, 2)}, {scrape: scrape(990, 1, 100, 3)}],
    [3000, {scrape: scrape(3000, 1, 20, 2)}, {silence}],
    // It was restarted, and counts from 0.
    [4000, {scrape: scrape(4000, 1, 30, 2)}, {scrape: scrape(3990, 2, 5, 1)}],
    [5000, {scrape: scrape(5000, 1, 40, 2)}, {scrape: scrape(4990, 2, 9, 1)}],
  ]) {
    history = historyAfter(history, {time, servers: [{name: 'a', ...a},
                                                     {name: 'b', ...b}]});
    const [, second] = history.servers;
    states.push([second.silence !== undefined,
                 second.interval.rate('revisit_calls_total')]);
  }
  assert.deepEqual(states, [[false, undefined], [false, undefined],
                            [true, undefined], [false, undefined], [false, 4]]);
  const drawn = points => points.map(
      ({time, streams, calls}) => [time, streams, calls]);
  const [first, second] = history.servers;
  assert.deepEqual(drawn(first.points),
                   [[1000, 2, null], [2000, 2, 10], [3000, 2, 10],
                    [4000, 2, 10], [5000, 2, 10]]);
  assert.deepEqual(drawn(second.points),
                   [[990, 3, null], [3000, null, null], [3990, 1, null],
                    [4990, 1, 4]]);
  assert.deepEqual(drawn(history.totalPoints),
                   [[1000, 5, null], [2000, 5, 10], [3000, 2, 10],
                    [4000, 3, 10], [5000, 3, 14]]);
  // Nobody answers: there is no total, and none is drawn.
  history = historyAfter(history, {time: 6000, servers: [
    {name: 'a', silence}, {name: 'b', silence}]});
  assert.equal(history.total, undefined);
  assert.equal(history.totalPoints.at(-1).streams, null);
});
