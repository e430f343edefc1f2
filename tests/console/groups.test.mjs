// Groups of vehicles: the list, the members of one in one map, a search across
// vehicles, and the links that follow from it.
import assert from 'node:assert/strict';
import {writeFileSync} from 'node:fs';
import {join} from 'node:path';
import {after, before, test} from 'node:test';

import {fact, isAccessible, Issuer, OUT, pixels, track, until, World, writeDays}
    from './world.mjs';

const WIDTHS = [1440, 390];
const TRACKS = 60;
const GROUP_CALLS = '**/revisit.v1.PoseGraphService/';
const POLICY = {
  version: 1,
  tenants: [{name: 'fleet', vehicle_prefix: 'fleet-'}],
  grants: [
    {token_subject: 'operator', tenant: '*', vehicles: ['*'],
     verbs: ['read', 'write', 'admin']},
    {token_subject: 'reader', tenant: '*', vehicles: ['*'], verbs: ['read']},
    {token_subject: 'half', tenant: 'fleet', vehicles: ['fleet-seven'],
     groups: ['fleet-depot'], verbs: ['read']},
  ],
};

const issuer = new Issuer();
let world;
let page;

/** Runs the command line as the operator. */
function cli(...args) {
  return world.revisitd.cli('--token-file', join(world.directory, 'token'),
                            ...args);
}

before(async () => {
  world = await World.make(directory => issuer.flags(directory, POLICY));
  writeFileSync(join(world.directory, 'token'), issuer.token('operator'));
  const [seven, eight] = writeDays(world.directory);
  for (const [id, file] of [['fleet-seven', seven], ['fleet-eight', eight]]) {
    cli('stream', file, '--create', '--vehicle', id);
  }
  cli('vehicle', 'update', 'fleet-seven', '--display-name', 'Shuttle 7');
  cli('group', 'create', 'fleet-depot', '--display-name', 'Depot North');
  for (const id of ['fleet-eight', 'fleet-seven']) {
    cli('group', 'add', 'fleet-depot', id);
  }
  cli('group', 'create', 'fleet-empty');
});
after(() => world?.close());

function as(subject) {
  return {extraHTTPHeaders:
      {authorization: `Bearer ${issuer.token(subject)}`}};
}

async function open(path, {subject = 'operator', ...options} = {}) {
  await page?.context().close();
  page = await world.open(path, {...options, ...as(subject)});
}

const table = name => page.getByRole('table', {name, exact: true});

/** The row of a table with this text in it. */
function row(name, text) {
  return table(name).locator('tbody tr', {hasText: text});
}

/** Waits until the text of a row of members matches. */
function memberSays(vehicle, pattern) {
  return until(async () => pattern.test(
      (await row('Members', vehicle).allInnerTexts()).join()),
      `${vehicle} that is ${pattern}`);
}

const links = () => cli('link', 'list', 'fleet-depot', '--json').loopClosures ??
    [];
const rejections = () => cli('link', 'list', 'fleet-depot', '--rejected',
                             '--json').rejectedCandidates ?? [];

/** Looks at the page at all widths and in both themes, and leaves pictures. */
async function isFine(path, name, ready) {
  for (const width of WIDTHS) {
    for (const colorScheme of ['light', 'dark']) {
      await open(path, {colorScheme, viewport: {width, height: 900}});
      await page.locator(ready).first().waitFor();
      await page.getByText('Asking the server…').waitFor({state: 'detached'});
      await page.screenshot({
        path: join(OUT, `groups-${name}-${width}-${colorScheme}.png`),
        fullPage: true,
      });
      assert.doesNotMatch(await page.locator('main').innerText(),
                          /NaN|undefined|Infinity/);
      await isAccessible(page);
    }
  }
}

/** Leaves the row that was clicked, which stands out on the map till then. */
async function lookAway() {
  await page.mouse.move(0, 0);
  await page.evaluate(() => document.activeElement.blur());
}

/** Asks for a search at a pose, as people do: by the form, or by its address. */
async function search(vehicle, pose) {
  await page.getByLabel('From vehicle').selectOption(vehicle);
  await page.getByLabel('At pose').fill(pose);
  await page.getByLabel('At pose').press('Enter');
  await table('Candidates').locator('tbody a').first().waitFor();
}

test('the list of groups counts members and links, and follows them', async () => {
  await open('/');
  await page.getByRole('link', {name: 'Groups'}).click();
  await page.getByText('2 of 2 groups').waitFor();
  await until(async () => /Depot North\s+fleet-depot\s+2\s+0/.test(
      await row('Groups', 'Depot North').innerText()), 'counts');
  await until(async () => /fleet-empty\s+0\s+0\s/.test(
      await row('Groups', 'fleet-empty').innerText()), 'a group of none');
  cli('link', 'add', 'fleet-depot', 'fleet-eight@500', 'fleet-seven@500');
  cli('group', 'remove', 'fleet-depot', 'fleet-seven');
  await until(async () => /fleet-depot\s+1\s+0/.test(
      await row('Groups', 'Depot North').innerText()), 'one that has left');
  cli('group', 'add', 'fleet-depot', 'fleet-seven');
  cli('link', 'add', 'fleet-depot', 'fleet-eight@500', 'fleet-seven@500');
  await until(async () => /fleet-depot\s+2\s+1/.test(
      await row('Groups', 'Depot North').innerText()), 'a link');
  cli('link', 'delete', 'fleet-depot', 'fleet-eight@500', 'fleet-seven@500');
  await page.getByLabel('Search').fill('NORTH');
  await page.getByText('1 of 2 groups').waitFor();
  assert.match(page.url(), /\/groups\?search=NORTH$/);
  await isFine('/groups', 'list', 'tbody a');
});

test('a group that nothing ties has a map of the chosen member alone',
     async () => {
  await open('/groups/fleet-depot');
  await page.getByRole('heading', {name: 'Depot North'}).waitFor();
  await until(async () => await fact(page, 'Members') === '2', 'members');
  assert.equal(await fact(page, 'Links'), '0');
  await page.getByText('Nobody has linked two members.').waitFor();
  await memberSays('fleet-seven', /not placed/);
  await page.getByText(
      'Not placed, since nothing ties them to fleet-eight: fleet-seven.')
      .waitFor();
  await memberSays('fleet-eight', /the map is in its frame\s+[\d.]+ km/);
  await until(async () => await pixels(page, '--path') > 200, 'its path');
  assert.equal(await pixels(page, '--recording-1'), 0);
  await page.getByRole('button', {name: 'Map here: fleet-seven'})
      .click();
  await lookAway();
  await memberSays('fleet-eight', /not placed/);
  await until(async () => await pixels(page, '--recording-1') > 200,
              'the other path');
  assert.equal(await pixels(page, '--path'), 0);
  assert.match(page.url(), /\?from=fleet-seven$/);
  // The way back leads to the same map.
  await page.reload();
  await until(async () => await pixels(page, '--recording-1') > 200,
              'the same map');
});

test('a search from a member finds a place in another one, with its evidence',
     async () => {
  await open('/groups/fleet-depot');
  await table('Members').locator('tbody a').first().waitFor();
  await search('fleet-eight', '');
  const first = table('Candidates').locator('tbody tr').first();
  assert.match(await first.innerText(),
               /1\s+fleet-seven\s+[\d,]+\s+accepted\s+[\d.> ]+\s.*not tied/);
  await page.getByText(
      /^Searched the histories of 1 other vehicle with [\d,]+ nodes/).waitFor();
  assert.match(page.url(), /asked=fleet-eight$/);
  // How old the other's state was stands at the member.
  await memberSays('fleet-seven', /\d (ms|s)\b/);
  await open('/groups/fleet-depot?asked=fleet-eight@700&own=off');
  await table('Candidates').locator('tbody a').first().waitFor();
  assert.equal(await page.getByLabel('At pose').inputValue(), '700');
  assert.equal(await page.getByLabel('in others only').isChecked(), true);
  assert.equal(await table('Candidates').getByText('itself').count(), 0);
});

test('a search at an early pose, and of a pose that is none, says so', async () => {
  await open('/groups/fleet-depot?asked=fleet-eight@3');
  await page.getByText(/^No candidates: path too short/).waitFor();
  await open('/groups/fleet-depot?asked=fleet-nobody');
  await page.getByRole('region', {name: 'Search'})
      .locator('.error', {hasText: 'not found'}).waitFor();
});

test('a candidate in another vehicle is confirmed by a key, with its note, and ' +
     'undone by another', async () => {
  await open('/groups/fleet-depot?asked=fleet-eight');
  await table('Candidates').locator('tbody tr.chosen').waitFor();
  await page.keyboard.press('n');
  await page.keyboard.type('just looked');
  // Letters in the note are no keys of the view.
  assert.deepEqual(links(), []);
  await page.keyboard.press('Escape');
  await page.keyboard.press('c');
  await page.getByText(/^Linked fleet-eight@\d+ – fleet-seven@\d+\./).waitFor();
  const [link] = links();
  assert.equal(link.note, 'just looked');
  assert.equal(link.decidedBy, 'token:operator');
  assert.match(await row('Links', 'just looked').innerText(),
               /fleet-eight@\d+\s+fleet-seven@\d+\s.*none.*token:operator/s);
  assert.match(await table('Candidates').locator('tr.chosen').innerText(),
               /linked by token:operator/);
  assert.ok(await page.getByRole('button', {name: /^Confirm/}).isDisabled());
  assert.equal(await page.getByLabel('Note').inputValue(), '');
  await until(async () => await fact(page, 'Links') === '1', 'a link counted');
  await page.keyboard.press('u');
  await page.getByText(/: u once more deletes it\.$/).waitFor();
  assert.equal(links().length, 1);
  await page.keyboard.press('u');
  await page.getByText(/^Deleted the link fleet-eight@/).waitFor();
  assert.deepEqual(links(), []);
  await page.getByText('Nobody has linked two members.').waitFor();
});

test('a candidate in another vehicle is rejected by a key, with its note, and ' +
     'undone by another', async () => {
  await open('/groups/fleet-depot?asked=fleet-eight');
  await table('Candidates').locator('tbody tr.chosen').waitFor();
  await page.getByText('Nobody has rejected a candidate between two members.')
      .waitFor();
  await page.keyboard.press('n');
  await page.keyboard.type('another crossing');
  assert.deepEqual(rejections(), []);
  await page.keyboard.press('Escape');
  await page.keyboard.press('r');
  await page.getByText(/^Rejected fleet-eight@\d+ – fleet-seven@\d+\./)
      .waitFor();
  const [rejected] = rejections();
  assert.equal(rejected.note, 'another crossing');
  assert.equal(rejected.decidedBy, 'token:operator');
  assert.deepEqual(links(), []);
  assert.match(
      await row('Rejected candidates', 'another crossing').innerText(),
      /fleet-eight@\d+\s+fleet-seven@\d+\s.*token:operator/s);
  assert.match(await table('Candidates').locator('tr.chosen').innerText(),
               /rejected by token:operator/);
  await page.locator('.state-line', {hasText: ': rejected by token:operator'})
      .waitFor();
  for (const name of [/^Confirm/, /^Reject/]) {
    assert.ok(await page.getByRole('button', {name}).isDisabled());
  }
  // It is decided, so no key decides it once more.
  await page.keyboard.press('c');
  await until(async () => await fact(page, 'Rejected') === '1', 'one counted');
  await page.keyboard.press('u');
  await page.getByText(/is rejected fleet-eight@.*: u once more deletes it\.$/)
      .waitFor();
  assert.equal(rejections().length, 1);
  await page.keyboard.press('u');
  await page.getByText(/^Deleted the rejection of fleet-eight@/).waitFor();
  assert.deepEqual([links(), rejections()], [[], []]);
  assert.ok(await page.getByRole('button', {name: /^Undo/}).isDisabled());
});

test('the last decision of the page is undone first, be it a link or a rejection',
     async () => {
  await open('/groups/fleet-depot?asked=fleet-eight&own=off');
  await table('Candidates').locator('tbody tr.chosen').waitFor();
  await page.keyboard.press('r');
  await page.getByText(/^Rejected fleet-/).waitFor();
  await page.locator('.state-line', {hasText: 'rejected'}).waitFor();
  await search('fleet-eight', '700');
  await page.locator('.state-line', {hasText: /@\d+$/}).waitFor();
  await page.keyboard.press('Escape');
  await page.keyboard.press('c');
  await page.getByText(/^Linked fleet-/).waitFor();
  const undo = async () => {
    await page.keyboard.press('u');
    await page.getByText(/: u once more deletes it\.$/).waitFor();
    await page.keyboard.press('u');
    await page.getByText(/^Deleted the /).waitFor();
    return [links().length, rejections().length];
  };
  assert.deepEqual(await undo(), [0, 1]);
  assert.deepEqual(await undo(), [0, 0]);
});

test('one link places the other member, dashed; three that agree, solid',
     async () => {
  await open('/groups/fleet-depot');
  await memberSays('fleet-seven', /not placed/);
  const confirm = pose => {
    const {candidates} = cli('find', 'fleet-eight', '--group', 'fleet-depot',
                             '--exclude-own', '--sequence', pose, '--json');
    const [{query, matched}] = candidates;
    cli('link', 'add', 'fleet-depot', `fleet-eight@${query.sequence}`,
        `fleet-seven@${matched.sequence}`);
  };
  confirm('996');
  await memberSays('Shuttle 7',
                   /provisional, to within [\d.]+ m, [\d.]+°, by too few/);
  await until(async () => await pixels(page, '--recording-1') > 200,
              'the other path');
  const legend = text => page.locator('.legend li', {hasText: text});
  await legend(/^Shuttle 7, [\d.]+ km, provisional/).waitFor();
  assert.equal(await legend('Shuttle 7').locator('.dashed').count(), 1);
  assert.equal(await legend('fleet-eight').locator('.dashed').count(), 0);
  await until(async () => await pixels(page, '--closure') > 20, 'the link');
  assert.equal(await legend('Link of frames that are estimated')
      .locator('.dashed').count(), 1);
  assert.match(await row('Links', 'fleet-seven').innerText(),
               /estimated\s+[\d.]+ m\s/);
  // Both begin at one place, where there is room for one name.
  assert.deepEqual(await page.locator('.place-name').allInnerTexts(),
                   ['fleet-eight']);
  await isFine('/groups/fleet-depot?asked=fleet-eight', 'provisional',
               '.place-name');
  for (const pose of ['600', '700', '800']) confirm(pose);
  await open('/groups/fleet-depot');
  await memberSays('Shuttle 7', /known to within [\d.]+ m.*by loop closures/);
  await legend(/^Link of two known frames$/).waitFor();
  assert.equal(await page.locator('.legend .dashed').count(), 0);
  // What is pointed at in the table stands out on the map.
  await row('Links', 'fleet-seven').first().hover();
  await until(async () => await pixels(page, '--selected') > 20, 'the link');
  await isFine('/groups/fleet-depot?asked=fleet-eight', 'known',
               '.place-name');
});

test('a link is deleted by a button that is pressed twice', async () => {
  await open('/groups/fleet-depot');
  const button = page.getByRole('button', {name: /^Delete /}).first();
  await button.click();
  const before = links().length;
  // Whoever goes elsewhere meanwhile is asked again.
  await page.getByRole('button', {name: /^Really delete/}).blur();
  await page.getByRole('button', {name: /^Really delete/})
      .waitFor({state: 'detached'});
  await button.click();
  await page.getByRole('button', {name: /^Really delete/}).click();
  await page.getByText(/^Deleted the link/).waitFor();
  assert.equal(links().length, before - 1);
  await until(async () => await fact(page, 'Links') === `${before - 1}`,
              'one link fewer');
});

test('a rejection of somebody else is seen, and deleted in its table', async () => {
  await open('/groups/fleet-depot');
  await page.getByText('Nobody has rejected a candidate between two members.')
      .waitFor();
  cli('link', 'reject', 'fleet-depot', 'fleet-eight@500', 'fleet-seven@100',
      '--note', 'a bridge above');
  await row('Rejected candidates', 'a bridge above').waitFor();
  await isFine('/groups/fleet-depot?asked=fleet-eight', 'rejected',
               'table[aria-label="Rejected candidates"] tbody a');
  await open('/groups/fleet-depot');
  const before = links().length;
  await page.getByRole('button', {
    name: 'Delete fleet-eight@500 – fleet-seven@100'}).click();
  assert.equal(rejections().length, 1);
  await page.getByRole('button', {name: /^Really delete/}).click();
  await page.getByText('Deleted the rejection of fleet-eight@500').waitFor();
  assert.deepEqual(rejections(), []);
  assert.equal(links().length, before);
  await until(async () => await fact(page, 'Rejected') === '0', 'none counted');
});

test('whoever may only read is told so, and changes nothing', async () => {
  const before = links().length;
  await open('/groups/fleet-depot?asked=fleet-eight@500',
             {subject: 'reader'});
  await table('Candidates').locator('tbody tr.chosen').waitFor();
  await page.keyboard.press('c');
  await page.locator('.error', {hasText: /was not linked: .*permission denied/})
      .waitFor();
  await page.keyboard.press('r');
  await page.locator('.error', {
    hasText: /was not rejected: .*permission denied/}).waitFor();
  const button = page.getByRole('button', {name: /^Delete /}).first();
  await button.click();
  await page.getByRole('button', {name: /^Really delete/}).click();
  await page.locator('.error', {hasText: /was not deleted: .*permission/})
      .waitFor();
  assert.equal(links().length, before);
  assert.deepEqual(rejections(), []);
});

test('members that the caller may not read are no part of the page', async () => {
  await open('/groups/fleet-depot', {subject: 'half'});
  await memberSays('Shuttle 7', /the map is in its frame/);
  assert.equal(await fact(page, 'Members'), '1');
  assert.doesNotMatch(await page.locator('main').innerText(), /fleet-eight/);
  await open('/groups/fleet-empty', {subject: 'half'});
  await page.locator('main .error').first().waitFor();
});

test('what undoes more than a link is not passed on', async () => {
  for (const method of ['DeleteGroup', 'CreateGroup', 'UpdateGroup',
                        'AddGroupMember', 'RemoveGroupMember',
                        'UpdateGroupMember']) {
    const {status} = await fetch(
        `${world.console.url}/revisit.v1.PoseGraphService/${method}`,
        {method: 'POST', body: '{"name": "groups/fleet-depot"}',
         headers: {...as('operator').extraHTTPHeaders,
                   'content-type': 'application/json'}});
    assert.equal(status, 404, method);
  }
  assert.equal(cli('group', 'list', '--json').groups.length, 2);
});

test('of many members, fifty are drawn until somebody asks for more',
     async () => {
  cli('group', 'create', 'fleet-many');
  for (let i = 0; i < TRACKS; ++i) {
    const id = `fleet-van-${String(i).padStart(2, '0')}`;
    const file = join(world.directory, `${id}.gpx`);
    writeFileSync(file, track([52.5 + 0.002 * (i % 8), 13.4 + 0.002 * i]));
    cli('stream', file, '--create', '--vehicle', id);
    cli('group', 'add', 'fleet-many', id);
  }
  await open('/groups/fleet-many');
  const exported = new Set();
  page.on('request', request => {
    if (request.url().endsWith('/ExportPoseGraph')) {
      exported.add(request.postDataBuffer()?.toString('latin1'));
    }
  });
  await page.getByText(`50 of ${TRACKS} members that are placed are on the map.`)
      .waitFor();
  await page.locator('.legend').waitFor();
  await until(async () => {
    const text = await page.locator('.legend').innerText();
    return [...text.matchAll(/and (\d+) others/g)].reduce(
        (sum, [, others]) => sum + Number(others) + 3, 0) === 50;
  }, 'fifty members in the legend');
  // Their fixes are in one frame.
  assert.equal(await page.locator('.legend .dashed').count(), 0);
  assert.ok(exported.size <= 50, `${exported.size} exports`);
  // Names that would lie over others are left out, and the table has all.
  assert.ok(await page.locator('.place-name').count() <= 40);
  await isAccessible(page);
  await page.getByRole('button', {name: 'Draw 10 more'}).click();
  await until(async () => exported.size === TRACKS, 'all paths');
  await page.screenshot({path: join(OUT, 'groups-many.png'), fullPage: true});
});

test('a server that reads histories is not taken for one that is away',
     async () => {
  await open('/groups/fleet-depot');
  await page.route(`${GROUP_CALLS}ListFrameTransforms`, route => route.fulfill({
    status: 503, contentType: 'application/json', body: JSON.stringify({
      code: 'unavailable', message: 'reads histories', details: [{
        type: 'google.rpc.ErrorInfo',
        value: Buffer.from('\n\x0fGROUP_NOT_READY').toString('base64')}]})}));
  await page.reload();
  await page.getByText('The server is reading the histories of the members…')
      .waitFor();
  assert.equal(await page.locator('.banner').count(), 0);
  assert.equal(await page.locator('main .error').count(), 0);
  await page.unroute(`${GROUP_CALLS}ListFrameTransforms`);
  await page.getByText('Map in the frame of fleet-eight').waitFor();
});

test('a server without groups, or without their frames or rejections, is told ' +
     'as such',
     async () => {
  const unknown = route => route.fulfill({
    status: 501, contentType: 'application/json',
    body: '{"code": "unimplemented", "message": "no such method"}'});
  await open('/groups/fleet-depot');
  await page.route(`${GROUP_CALLS}ListFrameTransforms`, unknown);
  await page.reload();
  await page.getByText('does not tell where members lie, so there is no map')
      .waitFor();
  assert.equal(await page.locator('.map').count(), 0);
  await memberSays('fleet-seven', /not told/);
  await page.route(`${GROUP_CALLS}ListInterVehicleRejectedCandidates`, unknown);
  await page.goto(`${world.console.url}/groups/fleet-depot?asked=fleet-eight@500`);
  await page.getByText(/rejects no candidates between\s+vehicles/).waitFor();
  await table('Candidates').locator('tbody tr.chosen').waitFor();
  await row('Links', 'fleet-seven').first().waitFor();
  assert.ok(await page.getByRole('button', {name: /^Confirm/}).isEnabled());
  assert.ok(await page.getByRole('button', {name: /^Reject/}).isDisabled());
  assert.equal(await page.locator('main .error').count(), 0);
  await page.route(`${GROUP_CALLS}ListGroups`, unknown);
  await page.goto(`${world.console.url}/groups`);
  await page.getByText('This revisitd is of a version without groups.')
      .waitFor();
});
