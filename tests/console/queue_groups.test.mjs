// The queue of a vehicle whose stored checks search in a group: candidates in
// another vehicle are decided as those in its own history are.
import assert from 'node:assert/strict';
import {writeFileSync} from 'node:fs';
import {join} from 'node:path';
import {after, before, test} from 'node:test';

import {isAccessible, Issuer, OUT, until, World, writeDays} from './world.mjs';

const POLICY = {
  version: 1,
  tenants: [{name: 'fleet', vehicle_prefix: 'fleet-'}],
  grants: [
    {token_subject: 'operator', tenant: '*', vehicles: ['*'],
     verbs: ['read', 'write', 'admin']},
    // May decide about what lies in a vehicle's own history only.
    {token_subject: 'driver', tenant: 'fleet', vehicles: ['*'], groups: [],
     verbs: ['read', 'write']},
    {token_subject: 'driver', tenant: 'fleet', vehicles: ['*'],
     verbs: ['read']},
  ],
};
const ORDER = '/queue?order=probable';
const WATCH = '**/revisit.v1.PoseGraphService/WatchCandidates';

const issuer = new Issuer();
let world;
let page;

function cli(...args) {
  return world.revisitd.cli('--token-file', join(world.directory, 'token'),
                            ...args);
}

before(async () => {
  world = await World.make(directory => issuer.flags(directory, POLICY));
  writeFileSync(join(world.directory, 'token'), issuer.token('operator'));
  const [seven, eight] = writeDays(world.directory);
  cli('stream', seven, '--create', '--vehicle', 'fleet-seven');
  cli('group', 'create', 'fleet-depot');
  cli('vehicle', 'create', 'fleet-eight', '--checks', 'stored',
      '--check-group', 'fleet-depot');
  for (const id of ['fleet-eight', 'fleet-seven']) {
    cli('group', 'add', 'fleet-depot', id);
  }
  cli('stream', eight, '--vehicle', 'fleet-eight');
  await until(() => cli('vehicle', 'get', 'fleet-eight', '--json')
                        .checkDebt === 0, 'all checks');
});
after(() => world?.close());

const links = () => cli('link', 'list', 'fleet-depot', '--json').loopClosures ??
    [];
const rejections = () => cli('link', 'list', 'fleet-depot', '--rejected',
                             '--json').rejectedCandidates ?? [];

function stateOf(name) {
  const found = cli('checks', 'fleet-eight', '--json').checks
      .flatMap(({states}) => states).find(one => one.name === name);
  return found.state.replace('CANDIDATE_STATE_', '');
}

async function open(subject = 'operator', more = {}) {
  await page?.context().close();
  page = await world.open(ORDER, {...more, extraHTTPHeaders: {
    authorization: `Bearer ${issuer.token(subject)}`}});
  await page.locator('tr[aria-current]').waitFor();
}

/** The rows whose match lies in another vehicle. */
const across = () => page.locator('tbody tr', {hasText: 'in fleet-seven'});
const stateLine = () => page.locator('.state-line').innerText();

/** The name of the candidate that is looked at, as the address has it. */
function chosen() {
  const [vehicle, sequence, number] =
      new URL(page.url()).searchParams.get('at').split('/');
  return `vehicles/${vehicle}/checks/${sequence}/candidates/${number}`;
}

/** Looks at one in another vehicle, and returns its name and its two poses. */
async function chooseAcross() {
  await across().first().click();
  await page.locator('tr[aria-current]', {hasText: 'in fleet-seven'}).waitFor();
  const [, query, matched] = /fleet-eight@(\d+) – fleet-seven@(\d+)/.exec(
      await stateLine());
  return {name: chosen(), poses: {
    query: {vehicle: 'vehicles/fleet-eight', sequence: Number(query)},
    matched: {vehicle: 'vehicles/fleet-seven', sequence: Number(matched)}}};
}

const posesOf = ({query, matched}) => ({query, matched});

test('a row says in which vehicle its match lies, and leads there', async () => {
  await open();
  const {poses} = await chooseAcross();
  await isAccessible(page);
  await page.screenshot({path: join(OUT, 'queue-across.png'), fullPage: true});
  await page.keyboard.press('Enter');
  await page.waitForURL(
      `**/vehicles/fleet-seven?at=${poses.matched.sequence}`);
  await page.goBack();
  await page.locator('tr[aria-current]', {hasText: 'in fleet-seven'}).waitFor();
  await open('operator', {colorScheme: 'dark',
                          viewport: {width: 390, height: 900}});
  await across().first().waitFor();
  await isAccessible(page);
});

test('a candidate in another vehicle is confirmed by a key, and undone by another',
     async () => {
  await open();
  const {name, poses} = await chooseAcross();
  await page.keyboard.press('c');
  await page.locator('.decision > [role=status]', {hasText: 'Confirmed'})
      .waitFor();
  assert.match(await page.locator('.decision > [role=status]').innerText(),
               /^Confirmed fleet-eight@\d+ – fleet-seven@\d+\.$/);
  const [link, ...others] = links();
  assert.deepEqual([posesOf(link), others], [poses, []]);
  assert.equal(link.decidedBy, 'token:operator');
  // The server has a look at the group within seconds, and tells.
  await until(() => stateOf(name) === 'CONFIRMED', 'a state that follows');
  await page.locator('tbody tr.leaving', {hasText: 'confirmed here'}).first()
      .waitFor({state: 'detached'});
  assert.notEqual(chosen(), name);
  await page.keyboard.press('u');
  await until(() => stateOf(name) === 'OPEN', 'an undone confirmation');
  assert.deepEqual(links(), []);
  await until(() => chosen() === name, 'the candidate again');
  assert.deepEqual(page.complaints, []);
});

test('one that is rejected is shown as decided while the server tells nothing, ' +
     'and as open once that is undone', async () => {
  await open();
  await page.route(WATCH, () => undefined);
  await page.reload();
  await across().first().waitFor();
  const {name, poses} = await chooseAcross();
  await page.keyboard.press('r');
  await page.locator('tbody tr.leaving', {
    hasText: 'rejected here, the server follows'}).waitFor();
  const [rejected, ...others] = rejections();
  assert.deepEqual([posesOf(rejected), others, links()], [poses, [], []]);
  assert.notEqual(chosen(), name);
  await page.keyboard.press('u');
  await page.locator('.decision > [role=status]', {hasText: 'Undone'})
      .waitFor();
  assert.deepEqual(rejections(), []);
  await until(() => chosen() === name, 'the candidate again');
  await until(() => stateOf(name) === 'OPEN', 'an undone rejection');
  assert.ok(await page.getByRole('button', {name: /^Reject/}).isEnabled());
  assert.ok(await page.getByRole('button', {name: /^Undo/}).isDisabled());
  assert.deepEqual(page.complaints, []);
});

test('who may not write the group is told so once, and decides about the ' +
     'vehicle\'s own history on', async () => {
  await open('driver');
  await chooseAcross();
  await page.keyboard.press('r');
  await page.locator('.decision .error', {hasText: 'permission denied'}).first()
      .waitFor();
  await chooseAcross();
  await page.getByText('You may read what fleet-eight found in other vehicles, ' +
                       'but not decide about it.').waitFor();
  assert.ok(await page.getByRole('button', {name: /^Reject/}).isDisabled());
  assert.deepEqual(rejections(), []);
  await until(async () => {
    await page.keyboard.press('j');
    return /\d of fleet-eight$/.test(await stateLine());
  }, 'one in its own history');
  assert.ok(await page.getByRole('button', {name: /^Reject/}).isEnabled());
});

test('the group in which it was found decides, whichever is searched now',
     async () => {
  await open();
  await chooseAcross();
  const name = chosen();
  cli('vehicle', 'update', 'fleet-eight', '--check-group', '');
  await page.keyboard.press('c');
  await until(() => stateOf(name) === 'CONFIRMED', 'the confirmation');
  assert.equal(links().length, 1);
});
