// The shipped drive: streamed, looked at, decided about, and interrupted.
import assert from 'node:assert/strict';
import {readFileSync} from 'node:fs';
import {after, before, test} from 'node:test';

import {DRIVE, fact, number, pixels, until, World} from './world.mjs';

const NODES = 7949;
const STREAM = ['--create', '--vehicle', 'boreas', '--uncertainty', 'file'];

const [head, ...lines] = readFileSync(DRIVE, 'utf8').trim().split('\n');
let world;
let page;
let stream;

before(async () => {
  world = await World.make();
  stream = world.revisitd.openStream(...STREAM);
});
after(async () => {
  stream?.kill();
  await world?.close();
});

function feed(poses) {
  stream.stdin.write(poses.map(line => line + '\n').join(''));
}

/** The first candidate in the table that is accepted and not decided about. */
async function openAccepted() {
  const row = page.locator('.side tbody tr', {
    has: page.locator('.verdict.accepted'),
  }).first();
  await row.waitFor();
  await row.locator('a').click();
  await page.locator('.decision').waitFor();
  // Keys are for the page, not for the link that is gone.
  await page.locator('.evidence').waitFor();
}

test('a drive grows on the map while it is streamed', async () => {
  stream.stdin.write(head + '\n');
  feed(lines.slice(0, 700));
  await until(() => world.revisitd.cli('vehicle', 'list').includes('boreas'),
              'vehicle');
  page = await world.open('/vehicles/boreas?show=accepted');
  await page.locator('.map canvas').waitFor();
  const sizes = [await until(() => number(page, 'Nodes'), 'nodes')];
  await until(async () => await pixels(page, '--path') > 300, 'path drawn');
  const fleet = await world.open('/');
  await fleet.locator('tbody a', {hasText: 'boreas'}).waitFor();
  for (const [from, to] of [[700, 1200], [1200, 2000], [2000, lines.length]]) {
    feed(lines.slice(from, to));
    sizes.push(await until(async () => {
      const nodes = await number(page, 'Nodes');
      return nodes > sizes[sizes.length - 1] && nodes;
    }, 'growth'));
  }
  await fleet.locator('.state.streaming').waitFor();
  stream.stdin.end();
  await until(async () => await number(page, 'Nodes') === NODES, 'whole drive');
  await page.getByText(`${NODES.toLocaleString('en')} nodes`).waitFor();
  assert.equal(await number(page, 'Poses'), lines.length);
  await fleet.locator('.state.idle').waitFor();
  assert.deepEqual(fleet.complaints, []);
  await fleet.context().close();
});

test('the page asks at as many checks as a stream has', async () => {
  const printed = world.revisitd.text(
      'stream', DRIVE, '--create', '--vehicle', 'streamed', '--uncertainty',
      'file', '--candidates', '--json');
  const {length} = printed.match(/"nodesConsidered"/g);
  assert.ok(length > 300);
  const last = page.getByText('of the last 100.');
  await last.waitFor();
  assert.match(await last.innerText(),
               new RegExp(`^${length} checks fell due`));
  await page.getByText('100 of 100 checks answered').waitFor();
  const more = page.getByRole('button', {name: 'earlier ones'});
  for (let left = length - 100; left > 0; left -= 100) await more.click();
  await page.getByText(`${length} of ${length} checks answered`).waitFor();
  await more.waitFor({state: 'detached'});
});

test('checks show the candidates that the server answers', async () => {
  await openAccepted();
  const [asked, matched] = /(\d+)-(\d+)$/.exec(page.url()).slice(1);
  const {candidates} = world.revisitd.cli(
      'find', 'boreas', '--sequence', asked, '--aligned-path', '--json');
  const said = candidates.find(
      ({matched: node}) => String(node.sequence) === matched);
  assert.equal(said.verdict, 'VERDICT_ACCEPTED');
  const evidence = await page.locator('.evidence').innerText();
  const {gate} = said;
  assert.ok(evidence.includes(gate.squaredMahalanobisDistance.toFixed(2)),
            evidence);
  assert.ok(evidence.includes(`≤ ${gate.threshold.toFixed(2)}`), evidence);
  assert.match(await fact(page, 'Difference x'), new RegExp(
      said.difference.xMeters.toFixed(2).replace('-', '-?')));
  await until(async () => await pixels(page, '--query-path') > 100,
              'pass laid over the other');
});

test('a candidate is confirmed with a note, by keys, and that is undone',
     async () => {
  await page.keyboard.press('n');
  await page.keyboard.type('seen by hand');
  await page.keyboard.press('Escape');
  await page.keyboard.press('c');
  await page.getByText(/^Confirmed [\d,]+–[\d,]+\. Later searches build on it/)
      .first().waitFor();
  const {loopClosures} =
      world.revisitd.cli('closures', 'list', 'boreas', '--json');
  assert.equal(loopClosures.length, 1);
  assert.equal(loopClosures[0].note, 'seen by hand');
  assert.match(page.url(), new RegExp(`-${loopClosures[0].matchedSequence}$`));
  await page.getByText('Loop closures: 1.').waitFor();
  await page.locator('.decision').getByText('seen by hand').waitFor();
  await page.keyboard.press('u');
  const {querySequence, matchedSequence} = loopClosures[0];
  const pair = [querySequence, matchedSequence].map(
      sequence => Number(sequence).toLocaleString('en')).join('–');
  await page.getByText(`Undone: confirmed ${pair}.`).first().waitFor();
  assert.equal(world.revisitd.cli('closures', 'list', 'boreas', '--json')
                   .loopClosures.length, 0);
});

test('a rejected candidate is offered again once the rejection is undone',
     async () => {
  await page.keyboard.press('n');
  await page.keyboard.type('a bridge above');
  await page.keyboard.press('Escape');
  await page.keyboard.press('r');
  await page.getByText('The server no longer offers this pair').waitFor();
  const {rejectedCandidates} =
      world.revisitd.cli('rejections', 'list', 'boreas', '--json');
  assert.equal(rejectedCandidates.length, 1);
  assert.equal(rejectedCandidates[0].note, 'a bridge above');
  await page.locator('.decision').getByText('a bridge above').waitFor();
  const vehicle = await world.open('/vehicles/boreas');
  const row = vehicle.getByRole('table', {name: 'Decisions'})
      .getByRole('row', {name: 'a bridge above'});
  assert.match(await row.innerText(), /rejected/);
  await vehicle.context().close();
  await page.keyboard.press('u');
  await page.getByText('Nobody has decided about this pair').waitFor();
  await page.getByText('The server no longer offers this pair')
      .waitFor({state: 'detached'});
  assert.equal(world.revisitd.cli('rejections', 'list', 'boreas', '--json')
                   .rejectedCandidates.length, 0);
});

test('keys lead through the queue of open candidates', async () => {
  const first = page.url();
  await page.keyboard.press('j');
  await until(() => page.url() !== first, 'next candidate');
  const second = page.url();
  await page.locator('.evidence').waitFor();
  await page.keyboard.press('k');
  await until(() => page.url() === first, 'candidate before');
  await page.keyboard.press('j');
  await until(() => page.url() === second, 'next candidate');
});

test('what is decided elsewhere is seen here', async () => {
  await page.getByRole('link', {name: 'boreas'}).click();
  const [, query, match] = /^(\d+) at pose (\d+)$/.exec(
      (await page.locator('.side tbody tr', {
        has: page.locator('.verdict.accepted'),
      }).first().locator('a').getAttribute('aria-label')).replaceAll(',', ''));
  world.revisitd.cli('confirm', 'boreas', query, match);
  await until(async () => await number(page, 'Loop closures') === 1,
              'closure');
  await page.locator('.legend', {hasText: 'Loop closure'}).waitFor();
  world.revisitd.cli('closures', 'delete', 'boreas', query, match);
  await until(async () => await number(page, 'Loop closures') === 0,
              'no closure');
});

/** Labels of the shapes of the map in a saved file, with how many lines each
 * has. */
async function savedShapes(page) {
  const [download] = await Promise.all([
    page.waitForEvent('download'),
    page.getByRole('button', {name: 'SVG', exact: true}).click(),
  ]);
  const text = readFileSync(await download.path(), 'utf8');
  return Object.fromEntries(
      [...text.matchAll(/<path d="([^"]*)"[^>]*><title>([^<]*)/g)].map(
          ([, path, title]) => [title, path.split('M').length - 1]));
}

/** How many pixels of a curve have about this colour, and the last column of
 * them. */
function curvePixels(page, title, property) {
  return page.locator('.curve', {hasText: title}).locator('canvas').evaluate(
      (canvas, name) => {
    const {width, height} = canvas;
    const {data} = canvas.getContext('2d').getImageData(0, 0, width, height);
    const value = parseInt(getComputedStyle(document.documentElement)
                               .getPropertyValue(name).trim().slice(1), 16);
    const wanted = [value >> 16, value >> 8 & 255, value & 255];
    let [count, last] = [0, 0];
    for (let i = 0; i < data.length; i += 4) {
      if (data[i + 3] > 200 && wanted.every(
              (part, k) => Math.abs(part - data[i + k]) < 20)) {
        ++count;
        last = Math.max(last, i / 4 % width);
      }
    }
    return {count, last};
  }, property);
}

test('the time slider shows what was known then, and nothing later',
     async () => {
  const {revisitd} = world;
  // One of each kind lies before the pose at which the slider will stand, the
  // query of one is behind it, and one is behind it as a whole.
  const decisions = [[300, 40], [420, 60], [900, 800]];
  for (const [query, matched] of decisions) {
    revisitd.cli('confirm', 'boreas', String(query), String(matched));
    revisitd.cli('reject', 'boreas', String(query + 30), String(matched + 15));
  }
  await page.goto(world.console.url + '/vehicles/boreas?at=350&show=accepted');
  await page.locator('.legend', {hasText: 'Later path'}).waitFor();
  await until(async () => await pixels(page, '--path-ahead') > 300,
              'path that is yet to come');
  assert.ok(await pixels(page, '--path') > 100);
  const answered = /^(\d+) of \1 checks answered$/;
  await page.getByText(answered).waitFor();
  const poses = (await page.locator('.side tbody td:first-child')
                     .allInnerTexts()).map(
      text => Number(text.replaceAll(',', '')));
  assert.ok(Math.max(...poses, 0) <= 350, `${poses}`);
  assert.equal(await number(page, 'Poses'), 350);
  await until(async () => await number(page, 'Loop closures') === 1 &&
              await number(page, 'Rejected') === 1, 'decisions of then');
  assert.ok(await number(page, 'Nodes') < NODES);
  for (const name of ['State', 'Inflation', 'Revision']) {
    assert.equal(await fact(page, name), '', name);
  }
  const then = await savedShapes(page);
  assert.equal(then['Loop closure'], 1);
  assert.equal(then['Rejected by a verifier'], 1);
  // No curve reaches behind the line at the pose.
  const {last: end} = await curvePixels(page, 'Travelled', '--closure');
  const {last: line} = await curvePixels(page, 'Travelled', '--selected');
  assert.ok(end > 0 && end <= line + 2, `${end} behind ${line}`);

  await page.goto(world.console.url + '/vehicles/boreas?at=440&show=accepted');
  await page.getByText(answered).waitFor();
  await until(async () => await number(page, 'Loop closures') === 2 &&
              await number(page, 'Rejected') === 1, 'second closure');
  await page.getByRole('button', {name: 'Newest'}).click();
  await page.locator('.slider', {hasText: '(newest)'}).waitFor();
  await until(async () => await number(page, 'Loop closures') === 3 &&
              await number(page, 'Rejected') === 3, 'all decisions');
  const now = await savedShapes(page);
  assert.equal(now['Loop closure'], 3);
  for (const [query, matched] of decisions) {
    revisitd.cli('closures', 'delete', 'boreas', String(query),
                 String(matched));
    revisitd.cli('rejections', 'delete', 'boreas', String(query + 30),
                 String(matched + 15));
  }
});

test('a curve that has one value is a dot', async () => {
  const nodes = world.revisitd.text('export', 'boreas', '--format', 'nodes-csv')
                    .trim().split('\n').map(row => row.split(','));
  const [names] = nodes;
  const first = nodes.slice(1).find(
      row => Number(row[names.indexOf('travelled_m')]) >= 300);
  const pose = Number(first[names.indexOf('sequence')]) + 1;
  await page.goto(world.console.url + `/vehicles/boreas?at=${pose}`);
  await page.getByText('1 of 1 checks answered').waitFor();
  const {count} = await until(async () => {
    const found = await curvePixels(page, 'Learned scale', '--scale');
    return found.count > 0 && found;
  }, 'dot');
  assert.ok(count < 60, `${count} pixels`);
  const [download] = await Promise.all([
    page.waitForEvent('download'),
    page.getByRole('button', {name: 'SVG', exact: true}).click(),
  ]);
  const text = readFileSync(await download.path(), 'utf8');
  const scale = await page.evaluate(
      () => getComputedStyle(document.documentElement)
                .getPropertyValue('--scale').trim());
  assert.match(text, new RegExp(`<circle [^>]*fill="${scale}"`));
  await page.getByRole('button', {name: 'Newest'}).click();
  await page.locator('.slider', {hasText: '(newest)'}).waitFor();
});

test('a server that is killed is missed, and found when it is back',
     async () => {
  await world.revisitd.kill();
  await page.getByText('No answer from revisitd since').waitFor();
  // The graph of before is still shown.
  assert.equal(await number(page, 'Nodes'), NODES);
  await world.revisitd.start();
  await page.getByText('No answer from revisitd since')
      .waitFor({state: 'detached'});
  world.revisitd.cli('vehicle', 'update', 'boreas', '--display-name',
                     'After the crash');
  await page.getByRole('heading', {name: 'After the crash'}).waitFor();
  assert.equal(await number(page, 'Nodes'), NODES);
});

test('nothing of it was complained about by the browser', () => {
  assert.deepEqual(page.complaints, []);
});
