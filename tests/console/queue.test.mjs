// The queue of a drive whose checks are stored, worked through by keyboard, while
// others decide too, may only read, and the server comes and goes.
import assert from 'node:assert/strict';
import {readFileSync, writeFileSync} from 'node:fs';
import {join} from 'node:path';
import {after, before, test} from 'node:test';
import {setTimeout as sleep} from 'node:timers/promises';

import {DRIVE, isAccessible, Issuer, load, OUT, until, World} from './world.mjs';

const POLICY = {
  version: 1,
  tenants: [{name: 'acme', vehicle_prefix: 'acme-'}],
  grants: [
    {token_subject: 'operator', tenant: '*', vehicles: ['*'],
     verbs: ['read', 'write', 'admin']},
    {token_subject: 'verifier', tenant: 'acme', vehicles: ['*'],
     verbs: ['read', 'write']},
    {token_subject: 'reader', tenant: 'acme', vehicles: ['*'],
     verbs: ['read']},
  ],
};
const WATCH = '**/revisit.v1.PoseGraphService/WatchCandidates';
const LIST = /\/ListChecks$/;

const issuer = new Issuer();
let world;
let messages;

/** The command line as one of those whom the policy names. */
function cli(subject, ...args) {
  const file = join(world.directory, `token-${subject}`);
  writeFileSync(file, issuer.token(subject));
  return world.revisitd.cli('--token-file', file, ...args);
}

before(async () => {
  messages = await load(
      'gen/revisit/v1/pose_graph_service_pb.ts',
      `export {fromBinary, fromJson, toBinary} from '@bufbuild/protobuf';
       export {CheckSchema} from './gen/revisit/v1/check_pb.ts';`);
  world = await World.make(directory => issuer.flags(directory, POLICY));
  for (const id of ['acme-1', 'acme-2']) {
    cli('operator', 'vehicle', 'create', id, '--checks', 'stored');
    cli('operator', 'stream', DRIVE, '--vehicle', id, '--uncertainty', 'file');
  }
  await until(() => ['acme-1', 'acme-2'].every(
      id => cli('operator', 'vehicle', 'get', id, '--json').checkDebt === 0),
              'all checks');
});
after(() => world?.close());

const candidatesIn = state => (cli('operator', 'checks', '-', '--json').checks)
    .flatMap(({states}) => states)
    .filter(one => one.state === `CANDIDATE_STATE_${state}`);
const stateOf = name => ['OPEN', 'CONFIRMED', 'REJECTED', 'WITHDRAWN'].find(
    state => candidatesIn(state).some(one => one.name === name));
const closures = id => cli('operator', 'closures', 'list', id, '--json')
    .loopClosures ?? [];
const rejections = id => cli('operator', 'rejections', 'list', id, '--json')
    .rejectedCandidates ?? [];

/** As a proxy in front would tell who asks. */
const as = subject => ({extraHTTPHeaders: {
  authorization: `Bearer ${issuer.token(subject)}`}});

async function open(path, subject = 'verifier') {
  const page = await world.open(path, as(subject));
  await page.locator('tr[aria-current]').waitFor();
  return page;
}

/** How many are open, once the page says that this is so now. */
async function openCount(page) {
  const said = page.locator('.title [role=status]');
  return Number((await said.filter({hasText: /^[\d,]+ open$/}).innerText())
                    .replace(/\D/g, ''));
}

/** The name of the candidate that is looked at, as the address has it. */
function chosen(page) {
  const [vehicle, sequence, number] =
      new URL(page.url()).searchParams.get('at').split('/');
  return `vehicles/${vehicle}/checks/${sequence}/candidates/${number}`;
}

const cells = (page, row = page.locator('tr[aria-current]')) =>
    row.locator('td').allInnerTexts();
const column = (page, number) => page.locator(
    `tbody tr:not(.space) td:nth-child(${number})`).allInnerTexts();

test('it lists what is open, the most valuable first or by another order, as ' +
     'the address has it', async () => {
  const page = await world.open('/', as('verifier'));
  await page.getByRole('link', {name: 'Queue'}).click();
  await page.locator('tr[aria-current]').waitFor();
  assert.equal(await openCount(page), candidatesIn('OPEN').length);
  await page.getByText('0 checks owed').waitFor();
  await page.getByLabel('Vehicle').selectOption('acme-2');
  await until(async () => (await column(page, 3)).every(
      text => text === 'acme-2'), 'candidates of one vehicle');
  assert.equal(await openCount(page), candidatesIn('OPEN').length / 2);
  await page.getByLabel('Least probability').fill('0.9');
  await page.keyboard.press('Enter');
  await until(async () => await openCount(page) <
      candidatesIn('OPEN').length / 2, 'probable ones');
  const valuesOf = async number => (await column(page, number)).map(
      text => Number(text.replace(/> 0.999/, '1').replace(/[^\d.]/g, '')));
  const descending = values => [...values].sort((a, b) => b - a);
  const byValue = await valuesOf(6);
  assert.deepEqual(byValue, descending(byValue));
  assert.ok(byValue[0] > byValue.at(-1));
  await page.getByLabel('Order').selectOption('probable');
  assert.match(page.url(), /vehicle=acme-2/);
  assert.match(page.url(), /least=0\.9/);
  assert.match(page.url(), /order=probable/);
  await page.reload();
  await page.locator('tr[aria-current]').waitFor();
  const values = await valuesOf(5);
  assert.deepEqual(values, descending(values));
  assert.ok(values.length > 5 && values.every(value => value >= 0.9));
  assert.deepEqual(page.complaints, []);
  await page.context().close();
});

test('it is accessible, light or dark, wide or narrow', async () => {
  for (const width of [1440, 390]) {
    for (const colorScheme of ['light', 'dark']) {
      const page = await world.open('/queue', {
        colorScheme, viewport: {width, height: 900}, ...as('reader')});
      await page.locator('tr[aria-current]').waitFor();
      await openCount(page);
      await page.screenshot({path: join(OUT, `queue-${width}-${
          colorScheme}.png`), fullPage: true});
      await isAccessible(page);
      await page.context().close();
    }
  }
});

test('what a key does is done to the candidate that is looked at', async () => {
  const page = await open('/queue?vehicle=acme-1&order=newest');
  const first = chosen(page);
  await page.keyboard.press('j');
  const second = chosen(page);
  assert.notEqual(second, first);
  await page.keyboard.press('k');
  assert.equal(chosen(page), first);
  // Enter leads to its view, and the way back to the same row.
  const [query, match] = await cells(page);
  await page.keyboard.press('Enter');
  await page.getByRole('heading', {name: `Pose ${query} at pose ${match}`})
      .waitFor();
  await page.goBack();
  await page.locator('tr[aria-current]').waitFor();
  assert.equal(chosen(page), first);

  await page.keyboard.press('c');
  await page.getByText(`Confirmed ${query}–${match} of acme-1.`).first()
      .waitFor();
  await page.locator('tr.leaving', {hasText: 'confirmed here'}).first()
      .waitFor();
  assert.equal(stateOf(first), 'CONFIRMED');
  assert.equal(closures('acme-1').length, 1);
  assert.equal(closures('acme-1')[0].decidedBy, 'token:verifier');
  const next = chosen(page);
  assert.notEqual(next, first);
  await page.keyboard.press('r');
  await page.locator('.decision > [role=status]', {hasText: 'Rejected'})
      .waitFor();
  assert.equal(stateOf(next), 'REJECTED');
  // Undone, the last one first.
  await page.keyboard.press('u');
  await until(() => stateOf(next) === 'OPEN', 'an undone rejection');
  assert.deepEqual(rejections('acme-1'), []);
  await until(() => chosen(page) === next, 'the candidate again');
  await page.locator('tr.leaving', {hasText: 'confirmed here'}).first()
      .waitFor({state: 'detached'});
  await page.keyboard.press('u');
  await until(() => stateOf(first) === 'OPEN', 'an undone confirmation');
  assert.deepEqual(closures('acme-1'), []);
  // It has gone, and comes back in its place.
  await until(() => chosen(page) === first, 'the first candidate again');
  assert.deepEqual((await cells(page)).slice(0, 2), [query, match]);
  // Nothing is left to undo, and letters in a field are no keys.
  await page.keyboard.press('u');
  await page.getByLabel('Least probability').focus();
  await page.keyboard.press('c');
  await sleep(300);
  assert.deepEqual(closures('acme-1'), []);
  assert.deepEqual(page.complaints, []);
  await page.context().close();
});

test('a decision of somebody else is seen live, and fades', async () => {
  const page = await open('/queue?vehicle=acme-1&order=newest', 'reader');
  const other = await open('/queue?vehicle=acme-1&order=newest');
  const name = chosen(page);
  const [query] = await cells(page);
  assert.equal(chosen(other), name);
  await other.keyboard.press('r');
  const row = page.locator('tr.leaving', {has: page.getByText(query, {
    exact: true})});
  await row.getByText('rejected by token:verifier').waitFor();
  assert.equal(chosen(page), name);
  assert.ok(await page.getByRole('button', {name: 'Confirm'}).isDisabled());
  await page.screenshot({path: join(OUT, 'queue-leaving.png')});
  await row.waitFor({state: 'detached'});
  await until(() => chosen(page) !== name, 'another row');
  // So is what the command line undoes and decides.
  const [rejected] = rejections('acme-1');
  cli('operator', 'rejections', 'delete', 'acme-1',
      rejected.querySequence, rejected.matchedSequence);
  await page.locator('tbody tr:not(.leaving)', {has: page.getByText(query, {
    exact: true})}).waitFor();
  await other.context().close();
  assert.deepEqual(page.complaints, []);
  await page.context().close();
});

test('who may only read is told so once, and has no keys to decide then',
     async () => {
  const page = await open('/queue?vehicle=acme-1&order=newest', 'reader');
  await page.keyboard.press('c');
  await page.locator('.decision .error', {hasText: 'permission denied'}).first()
      .waitFor();
  await page.getByText('You may read acme-1, but not decide about it.')
      .waitFor();
  const asked = [];
  page.on('request', request => asked.push(request.url().split('/').at(-1)));
  for (const name of ['Confirm', 'Reject']) {
    assert.ok(await page.getByRole('button', {name}).isDisabled(), name);
  }
  for (const key of ['c', 'r', 'j', 'c', 'r']) await page.keyboard.press(key);
  await sleep(300);
  assert.deepEqual(asked.filter(name => /^(Add|Reject|Delete)/.test(name)), []);
  assert.deepEqual(page.complaints, []);
  await page.context().close();
});

test('what is found meanwhile comes above, and moves no key to another one',
     async () => {
  const page = await open('/queue?order=newest', 'reader');
  const before = await openCount(page);
  const name = chosen(page);
  const marked = await cells(page);
  cli('operator', 'vehicle', 'create', 'acme-3', '--checks', 'stored');
  cli('operator', 'stream', DRIVE, '--vehicle', 'acme-3', '--uncertainty',
      'file');
  await until(async () => await openCount(page) === before * 3 / 2,
              'what was found of a third drive');
  assert.equal(chosen(page), name);
  // It is followed to where it stands now.
  await until(async () => `${await cells(page)}` === `${marked}`,
              'the same row in view');
  await page.keyboard.press('k');
  assert.match(chosen(page), /acme-3/);
  await page.getByLabel('Vehicle').locator('option', {hasText: 'acme-3'})
      .waitFor({state: 'attached'});
  // A vehicle that is deleted takes its candidates with it.
  cli('operator', 'vehicle', 'delete', '--yes', 'acme-3');
  await until(async () => await openCount(page) === before, 'their end');
  assert.deepEqual(page.complaints, []);
  await page.context().close();
});

test('out of view it watches nothing, and catches up in view', async () => {
  const page = await open('/queue?vehicle=acme-1&order=newest', 'reader');
  const [query, match] = (await cells(page)).map(
      text => text.replaceAll(',', ''));
  await openCount(page);
  const asked = [];
  page.on('request', request => asked.push(request.url().split('/').at(-1)));
  const turn = hidden => page.evaluate(isHidden => {
    Object.defineProperty(document, 'hidden',
                          {value: isHidden, configurable: true});
    document.dispatchEvent(new Event('visibilitychange'));
  }, hidden);
  const ended = page.waitForEvent(
      'requestfailed', request => /WatchCandidates$/.test(request.url()));
  await turn(true);
  await ended;
  cli('operator', 'reject', 'acme-1', query, match);
  await sleep(1500);
  assert.equal(await page.locator('tr.leaving').count(), 0);
  assert.deepEqual(asked.filter(name => name === 'WatchCandidates'), []);
  await turn(false);
  await page.locator('tr.leaving', {hasText: 'rejected by token:operator'})
      .first().waitFor();
  assert.deepEqual(asked.filter(name => name === 'ListChecks'), []);
  cli('operator', 'rejections', 'delete', 'acme-1', query, match);
  assert.deepEqual(page.complaints, []);
  await page.context().close();
});

test('what is open is saved as SVG and as PNG', async () => {
  const page = await open('/queue?vehicle=acme-2', 'reader');
  for (const type of ['SVG', 'PNG']) {
    const [download] = await Promise.all([
      page.waitForEvent('download'),
      page.getByRole('button', {name: type, exact: true}).click(),
    ]);
    const path = join(OUT, `saved-queue.${type.toLowerCase()}`);
    await download.saveAs(path);
    const content = readFileSync(path);
    if (type === 'SVG') {
      const [query, match] = await cells(page);
      assert.ok(content.toString().includes(`${query}–${match} of acme-2`));
    } else {
      assert.equal(content.subarray(1, 4).toString(), 'PNG');
    }
  }
  assert.deepEqual(page.complaints, []);
  await page.context().close();
});

test('after a break it goes on from its cursor', async () => {
  const page = await open('/queue?vehicle=acme-1&order=newest', 'reader');
  const lists = [];
  page.on('request', request => {
    if (LIST.test(request.url())) lists.push(request.url());
  });
  await openCount(page);
  await world.revisitd.kill();
  await page.getByText(/open, as of before$/).waitFor();
  await world.revisitd.start();
  await openCount(page);
  const name = chosen(page);
  const [query, match] = (await cells(page)).map(
      text => text.replaceAll(',', ''));
  cli('operator', 'reject', 'acme-1', query, match, '--candidate', name);
  await page.locator('tr.leaving', {hasText: 'rejected by token:operator'})
      .first().waitFor();
  assert.deepEqual(lists, []);
  cli('operator', 'rejections', 'delete', 'acme-1', query, match);
  await page.context().close();
});

test('a cursor that the server has no longer lets it list anew', async () => {
  const page = await world.open('/server', as('reader'));
  let lists = 0;
  page.on('request', request => lists += LIST.test(request.url()));
  // The end of a stream, as Connect has it.
  const end = Buffer.from(JSON.stringify(
      {error: {code: 'out_of_range', message: 'kept no longer'}}));
  const head = Buffer.alloc(5);
  head.writeUInt8(2);
  head.writeUInt32BE(end.length, 1);
  await page.route(WATCH, route => route.fulfill({
    contentType: 'application/connect+proto',
    body: Buffer.concat([head, end])}), {times: 1});
  await page.goto(`${world.console.url}/queue?vehicle=acme-1&order=newest`);
  await page.locator('tr[aria-current]').waitFor();
  assert.ok(await openCount(page) > 0);
  assert.equal(lists, 2);
  assert.equal(await page.locator('main .error').count(), 0);
  await page.context().close();
});

/** Has the page be told of the first candidate of a check as if its loop closure
 * contradicted others, and a second search had found it less probable. */
async function contradict(page, sequence) {
  await page.route(LIST, async route => {
    const response = await route.fetch();
    const {ListChecksResponseSchema: schema, fromBinary, toBinary} = messages;
    const list = fromBinary(schema, await response.body());
    const check = messages.fromJson(messages.CheckSchema, cli(
        'operator', 'checks', 'acme-2', '--sequence', sequence, '--json'));
    check.latest = structuredClone(check.candidates);
    check.latest.candidates[0].probability = 0.25;
    check.stale = true;
    Object.assign(check.states[0], {
      state: 1, cause: 7, latestRank: 1});
    list.checks = [
      check, ...list.checks.filter(({name}) => name !== check.name)];
    const body = Buffer.from(toBinary(schema, list));
    await route.fulfill({response, body, headers: {
      'content-type': 'application/proto'}});
  });
}

test('a contradicted one is upheld, or given up, and says what was told then',
     async () => {
  const first = cli('operator', 'checks', 'acme-2', '--json').checks.find(
      ({states}) => states[0].state === 'CANDIDATE_STATE_OPEN');
  const sequence = first.name.split('/').at(-1);
  const {query, matched} = first.candidates.candidates[0];
  const pair = [query.sequence, matched.sequence];
  cli('operator', 'confirm', 'acme-2', ...pair, '--note', 'by eye');
  const page = await world.browser.newPage(as('verifier'));
  await contradict(page, sequence);
  const show = async () => {
    await page.goto(`${world.console.url}/queue?vehicle=acme-2`);
    await page.locator('tr[aria-current]', {hasText: 'contradicted, stale'})
        .waitFor();
  };
  await show();
  assert.deepEqual(
      (await page.getByLabel('Both searches').locator('tr').allInnerTexts())
          .slice(0, 2).map(text => text.trim().split(/\s*\t\s*/)),
      [['Told then', 'Found now'],
       ['Probability', Number(first.candidates.candidates[0].probability)
           .toFixed(3).replace('1.000', '> 0.999'), '0.250']]);
  await page.getByText('To uphold it keeps it').waitFor();
  await page.screenshot({path: join(OUT, 'queue-contradicted.png')});
  await page.getByRole('button', {name: 'Uphold'}).waitFor();
  await page.keyboard.press('c');
  await page.getByText('Upheld the loop closure of').first().waitFor();
  // It is the one that was there, so there is nothing to undo.
  const [closure, ...others] = closures('acme-2');
  assert.deepEqual([closure.note, others], ['by eye', []]);
  assert.ok(await page.getByRole('button', {name: /^Undo/}).isDisabled());
  // Given up, it is deleted; and undone, it is there again.
  await show();
  await page.keyboard.press('r');
  await page.locator('.decision > [role=status]', {hasText: 'Rejected'})
      .waitFor();
  assert.deepEqual(closures('acme-2'), []);
  assert.equal(rejections('acme-2').length, 1);
  await page.keyboard.press('u');
  await page.locator('.decision > [role=status]', {hasText: 'Undone'})
      .waitFor();
  assert.deepEqual(closures('acme-2').map(({name, note}) => [name, note]),
                   [[closure.name, 'by eye']]);
  assert.deepEqual(rejections('acme-2'), []);
  cli('operator', 'closures', 'delete', 'acme-2', ...pair);
  await page.close();
});

test('the queue of a drive is worked through by keyboard', async () => {
  const page = await open('/queue?vehicle=acme-1&order=probable');
  const of = state => candidatesIn(state).filter(
      ({name}) => name.startsWith('vehicles/acme-1/'));
  const names = of('OPEN').map(({name}) => name);
  const all = names.length;
  assert.ok(all > 50, `${all}`);
  let pressed = 0;
  // Second searches open others, until they are done as well; among these are
  // candidates whose loop closures contradict others.
  const isDone = () => of('OPEN').length === 0 &&
      cli('operator', 'checks', 'acme-1', '--fresh-only', '--json').checks
          .length === cli('operator', 'checks', 'acme-1', '--json').checks
          .length;
  const nothing = page.getByText('Nothing waits for a decision.');
  while (!(await nothing.isVisible() && isDone())) {
    const button = page.getByRole('button', {name: /^(Confirm|Uphold)/});
    if (!await button.isEnabled()) {
      // What was decided is on its way, and nothing else is left in view.
      await sleep(50);
      continue;
    }
    await page.keyboard.press(pressed++ % 3 === 2 ? 'r' : 'c');
    assert.ok(pressed <= 2 * all, 'it does not come to its end');
  }
  assert.equal(await openCount(page), 0);
  assert.deepEqual(of('OPEN'), []);
  // Second searches withdraw some, and find others.
  const ended = new Set([...of('CONFIRMED'), ...of('REJECTED'),
                         ...of('WITHDRAWN')].map(({name}) => name));
  assert.deepEqual(names.filter(name => !ended.has(name)), []);
  // Each decision is on record, by who made it.
  const made = [...closures('acme-1'), ...rejections('acme-1')];
  assert.ok(made.length > 20 && made.length <= pressed, `${made.length}`);
  assert.ok(made.every(({decidedBy}) => decidedBy === 'token:verifier'));
  // The other vehicle's are as they were.
  assert.ok(candidatesIn('OPEN').length > 0);
  assert.deepEqual(page.complaints, []);
  await page.context().close();
});

test('a console that is stopped does not wait for those who watch', async () => {
  const page = await open('/queue?vehicle=acme-2', 'reader');
  await openCount(page);
  const began = performance.now();
  await world.console.close();
  assert.ok(performance.now() - began < 3000,
            `${performance.now() - began} ms`);
  assert.deepEqual(page.complaints, []);
  await page.context().close();
});
