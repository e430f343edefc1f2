// The servers of a fleet side by side: one may be looked at, and one may be
// away.
import assert from 'node:assert/strict';
import {mkdirSync, mkdtempSync, readFileSync, rmSync, writeFileSync} from
    'node:fs';
import {tmpdir} from 'node:os';
import {join} from 'node:path';
import {after, before, test} from 'node:test';
import {setTimeout as sleep} from 'node:timers/promises';

import {DRIVE, fact, isAccessible, Issuer, OUT, Revisitd, track, until, World}
    from './world.mjs';

const issuer = new Issuer();
const POLICY = {
  version: 1,
  tenants: [{name: 'acme', vehicle_prefix: 'acme-'}],
  grants: [
    {token_subject: 'operator', tenant: '*', vehicles: ['*'],
     verbs: ['read', 'write', 'admin']},
    {token_subject: 'acme', tenant: 'acme', vehicles: ['*'],
     verbs: ['read', 'write', 'admin']},
  ],
};
const COLUMNS = [
  'server', 'state', 'version', 'streams', 'calls', 'errors', 'poses',
  'ackP99', 'callP99', 'queue', 'vehicles', 'bytes', 'store', 'certificate',
];

let directory;
let token;
let world;
/** Servers by name, each with a store of its own. */
let servers;
const streams = [];

function asOperator(server, ...args) {
  return server.cli('--token-file', token, ...args);
}

/** A stream that stays open once some poses of the drive were sent. */
function stream(server, vehicle) {
  const child = server.openStream('--token-file', token, '--create',
                                  '--vehicle', vehicle,
                                  '--uncertainty', 'file');
  child.stdin.on('error', () => {});
  child.stdin.write(
      readFileSync(DRIVE, 'utf8').split('\n').slice(0, 100).join('\n') + '\n');
  streams.push(child);
}

before(async () => {
  directory = mkdtempSync(join(tmpdir(), 'revisit-console-'));
  token = join(directory, 'token');
  writeFileSync(token, issuer.token('operator'));
  const others = ['b', 'c'].map(name => {
    const files = join(directory, name);
    mkdirSync(files);
    return new Revisitd(files, issuer.flags(files, POLICY));
  });
  for (const server of others) await server.start();
  // Either of the first two says who a caller is.
  world = await World.make(files => issuer.flags(files, POLICY), made => [
    '--server', others[0].address,
    '--metrics', `a=${made.revisitd.metrics}`,
    '--metrics', `b=${others[0].metrics}`,
    '--metrics', `c=${others[1].metrics}`,
  ]);
  servers = {a: world.revisitd, b: others[0], c: others[1]};
  const file = join(directory, 'van.gpx');
  writeFileSync(file, track([52.5163, 13.3777]));
  for (const vehicle of ['acme-1', 'acme-2']) {
    asOperator(servers.b, 'stream', file, '--create', '--vehicle', vehicle);
  }
  asOperator(servers.a, 'stream', file, '--create', '--vehicle', 'acme-1');
});
after(async () => {
  for (const child of streams) child.kill();
  await world?.close();
  for (const name of ['b', 'c']) await servers?.[name].close();
  rmSync(directory, {recursive: true, force: true});
});

/** A page of somebody whom a proxy in front signs in. */
function open(path, subject = 'operator', options = {}) {
  return world.open(path, {extraHTTPHeaders: {
    authorization: `Bearer ${issuer.token(subject)}`}, ...options});
}

/** The rows of the table of servers by name, all of the same moment. */
async function rowsOf(page) {
  const rows = await page.getByRole('table', {name: 'Servers', exact: true})
      .locator('tbody tr').evaluateAll(found => found.map(
          row => [...row.cells].map(cell => cell.innerText)));
  return Object.fromEntries(rows.map(cells => [
    cells[0], Object.fromEntries(cells.map((text, i) => [COLUMNS[i], text])),
  ]));
}

/** Waits for rows that are so, and returns them. */
function rowsWhen(page, condition, what) {
  return until(async () => {
    const rows = await rowsOf(page);
    return Object.keys(rows).length === 4 && condition(rows) && rows;
  }, what);
}

/** What the console tells the operator. */
async function told(subject = 'operator') {
  const answer = await fetch(`${world.console.url}/metrics.json`, {
    headers: {authorization: `Bearer ${issuer.token(subject)}`}});
  return {status: answer.status, body: await answer.json()};
}

const allUp = rows => rows['All servers'].state === '3 of 3';

function picture(page, name) {
  return page.screenshot({path: join(OUT, `${name}.png`), fullPage: true});
}

/** Looks at a view in both widths and colours. */
async function looksWell(path, name, ready) {
  for (const width of [1440, 390]) {
    for (const colorScheme of ['light', 'dark']) {
      const page = await open(path, 'operator', {
        colorScheme, viewport: {width, height: 900}});
      await rowsWhen(page, ready, name);
      await sleep(2500);
      await picture(page, `${name}-${width}-${colorScheme}`);
      await isAccessible(page);
      await page.context().close();
    }
  }
}

test('servers stand side by side, and their totals below them', async () => {
  const page = await open('/server');
  await page.getByRole('heading', {name: 'Servers', level: 1}).waitFor();
  for (const name of ['a', 'c']) stream(servers[name], 'acme-3');
  const rows = await rowsWhen(
      page, found => allUp(found) && found['All servers'].streams === '2' &&
          Object.values(found).every(({calls}) => calls !== '–'),
      'streams and rates');
  assert.deepEqual(Object.keys(rows), ['a', 'b', 'c', 'All servers']);
  const {a, b, c, 'All servers': all} = rows;
  assert.deepEqual([a, b, c].map(row => row.streams), ['1', '0', '1']);
  assert.deepEqual([a, b, c, all].map(row => row.vehicles),
                   ['2', '2', '1', '5']);
  const version = asOperator(servers.a, 'info', '--json').version;
  for (const row of [a, b, c]) {
    assert.equal(row.state, 'up');
    assert.ok(version.startsWith(row.version) && row.version !== '');
    assert.match(row.calls, /^[\d.]+\/s$/);
    assert.match(row.errors, /^[\d.]+\/s$/);
    assert.match(row.queue, /^[\d.]+ (B|[KM]iB)$/);
    assert.match(row.store, /^[\d.]+ [KM]iB$/);
    // They have none.
    assert.equal(row.certificate, '–');
  }
  assert.equal(all.version, a.version);
  // Servers may share a store, of which each tells the size.
  assert.equal(all.store, '–');
  assert.equal(await fact(page, 'Streams open'), '2');
  assert.equal(await fact(page, 'Vehicles in memory'), '5');
  assert.deepEqual(page.complaints, []);
  await page.context().close();
});

test('totals of calls are the sums of the servers\' own', async () => {
  const page = await open('/server');
  const number = text => Number(text.replace(/[^\d.]/g, ''));
  // The page's own questions reach the first server, and are calls too.
  const rows = await rowsWhen(
      page, found => allUp(found) && number(found.a.calls) > 0, 'calls');
  const sum = ['a', 'b', 'c'].reduce(
      (all, name) => all + number(rows[name].calls), 0);
  assert.ok(Math.abs(number(rows['All servers'].calls) - sum) < 0.6,
            JSON.stringify(rows));
  // Only one of them ended calls: its percentile is that of all.
  assert.equal(rows['All servers'].callP99, rows.a.callP99);
  await page.context().close();
});

test('a server is chosen without a mouse, and has a link of its own',
     async () => {
  const page = await open('/server');
  await rowsWhen(page, allUp, 'servers');
  for (;;) {
    await page.keyboard.press('Tab');
    const at = await page.evaluate(() => document.activeElement.innerText);
    if (at === 'b') break;
    assert.notEqual(at, 'All servers', 'the row cannot be reached');
  }
  await page.keyboard.press('Enter');
  await page.getByRole('heading', {name: 'Server b', level: 1}).waitFor();
  assert.equal(new URL(page.url()).pathname, '/server/b');
  const chosen = page.getByRole('table', {name: 'Servers', exact: true})
      .locator('tr[aria-current]');
  assert.equal(await chosen.locator('td').first().innerText(), 'b');
  await until(async () => await fact(page, 'Takes writes') === 'yes',
              'facts of the server');
  assert.equal(await fact(page, 'Streams open'), '0');
  assert.equal(await fact(page, 'Vehicles in memory'), '2');
  await page.locator('.columns meter').first().waitFor();
  await page.reload();
  await page.getByRole('heading', {name: 'Server b', level: 1}).waitFor();
  await page.locator('dt', {hasText: 'Takes writes'}).waitFor();
  await page.getByRole('link', {name: 'c', exact: true}).click();
  await page.getByRole('heading', {name: 'Server c', level: 1}).waitFor();
  await until(async () => await fact(page, 'Streams open') === '1', 'stream');
  const file = page.waitForEvent('download');
  await page.getByRole('button', {name: 'SVG'}).click();
  assert.equal((await file).suggestedFilename(), 'server-c.svg');
  await page.goBack();
  await page.getByRole('heading', {name: 'Server b', level: 1}).waitFor();
  await page.getByRole('link', {name: 'All servers'}).first().click();
  await page.getByRole('heading', {name: 'Servers', level: 1}).waitFor();
  await page.goto(`${world.console.url}/server/nobody`);
  await page.getByText('no metrics of a server that is called nobody')
      .waitFor();
  assert.deepEqual(page.complaints, []);
  await page.context().close();
});

test('a server that was killed is shown as silent since then, and up again ' +
     'once it is', async () => {
  const page = await open('/server');
  await rowsWhen(page, allUp, 'servers');
  const killed = Date.now();
  await servers.b.kill();
  const rows = await rowsWhen(page, found => found.b.state !== 'up', 'silence');
  assert.match(rows.b.state, /^no answer since .*\d:\d/);
  assert.equal(rows.b.streams, '–');
  assert.equal(rows.a.state, 'up');
  assert.equal(rows['All servers'].state, '2 of 3');
  assert.equal(rows['All servers'].vehicles, '3');
  await page.getByText('b has not answered since').waitFor();
  const {body} = await told();
  const {silence: {since, message}} = body.servers[1];
  assert.ok(since >= killed && since <= Date.now());
  assert.match(message, /ECONNREFUSED/);
  // The others are read on.
  stream(servers.c, 'acme-4');
  await rowsWhen(page, found => found.c.streams === '2', 'another stream');
  await looksWell('/server', 'servers-one-down',
                  found => found['All servers'].state === '2 of 3');
  await page.goto(`${world.console.url}/server/b`);
  await page.getByText('b has not answered since').waitFor();
  await picture(page, 'server-b-down');
  await isAccessible(page);
  await servers.b.start();
  await rowsWhen(page, allUp, 'all servers');
  await until(async () => await fact(page, 'Takes writes') === 'yes',
              'facts of the server');
  assert.equal(await page.getByText('has not answered').count(), 0);
  assert.deepEqual(page.complaints, []);
  await page.context().close();
});

test('a server that hangs holds up no other', async () => {
  const before = await until(async () => {
    const {body} = await told();
    return body.servers.every(({scrape}) => scrape) && body.servers;
  }, 'readings');
  servers.c.child.kill('SIGSTOP');
  try {
    let [last] = before;
    let answers = 0;
    const silence = await until(async () => {
      const [a, , c] = (await told()).body.servers;
      ++answers;
      assert.ok(a.scrape.time >= last.scrape.time);
      last = a;
      await sleep(600);
      return c.silence;
    }, 'deadline');
    assert.match(silence.message, /timeout/);
    // Those before the last did not wait for the end of the question to it.
    assert.ok(answers > 2, `${answers} answers`);
    assert.ok(last.scrape.time - before[0].scrape.time > 3000);
  } finally {
    servers.c.child.kill('SIGCONT');
  }
  await until(async () => (await told()).body.servers[2].scrape, 'its return');
});

test('the first server being away hides no other, and nothing more is told',
     async () => {
  await servers.a.kill();
  try {
    const {status} = await until(async () => {
      const answer = await told();
      const [first, second] = answer.body.servers ?? [];
      return first?.silence && second.scrape && answer;
    }, 'silence');
    assert.equal(status, 200);
    assert.equal((await told('acme')).status, 403);
    assert.ok([401, 403].includes((await told('nobody')).status));
  } finally {
    await servers.a.start();
  }
});

test('callers of a tenant see no server, at any address', async () => {
  for (const path of ['/server', '/server/b']) {
    const page = await open(path, 'acme');
    await page.getByText('this caller belongs to a tenant').waitFor();
    // Longer than the page waits between two questions.
    await sleep(1500);
    assert.equal(await page.locator('.table, .columns').count(), 0);
    assert.equal(await page.locator('.curve', {hasText: 'Streams'}).count(), 0);
    for (const {admin} of Object.values(servers)) {
      assert.equal(await page.getByText(admin).count(), 0);
    }
    assert.deepEqual(page.complaints, []);
    await page.context().close();
  }
  const {status, body} = await told('acme');
  assert.equal(status, 403);
  assert.deepEqual(Object.keys(body), ['message']);
  const settings = await (await fetch(`${world.console.url}/console.json`))
                             .json();
  assert.deepEqual(settings, {metrics: true, baseMap: false, links: [],
                              signIn: false});
});

test('no view of servers breaks a rule of axe, light or dark, wide or narrow',
     async () => {
  await looksWell('/server', 'servers', allUp);
  await looksWell('/server/a', 'server-a', allUp);
});
