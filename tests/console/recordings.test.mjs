// A vehicle whose odometry began anew twice: how its recordings are drawn and told,
// before and after a loop closure ties them.
import assert from 'node:assert/strict';
import {readFileSync, writeFileSync} from 'node:fs';
import {join} from 'node:path';
import {after, before, test} from 'node:test';

import {DRIVE, fact, isAccessible, number, OUT, pixels, until, World} from
    './world.mjs';

const WIDTHS = [1440, 390];
/** The poses of the shipped drive behind which the odometry begins anew. */
const CUTS = [1000, 1400];

let world;
let page;

/** Lines of the drive as an odometry that is at its origin at the first of them
 * would have written them. */
function begunAnew(lines) {
  const numbers = lines.map(line => line.split(',').map(Number));
  const [x0, y0, yaw0] = numbers[0].slice(5, 8);
  const [c, s] = [Math.cos(yaw0), Math.sin(yaw0)];
  return numbers.map(row => {
    const [x, y, yaw] = [row[5] - x0, row[6] - y0, row[7] - yaw0];
    return [...row.slice(0, 5), c * x + s * y, -s * x + c * y, yaw,
            ...row.slice(8)].join();
  });
}

before(async () => {
  world = await World.make();
  const [head, ...lines] = readFileSync(DRIVE, 'utf8').trim().split('\n');
  const {revisitd} = world;
  const files = [lines.slice(0, CUTS[0]),
                 begunAnew(lines.slice(...CUTS)),
                 begunAnew(lines.slice(CUTS[1]))].map((part, i) => {
    const file = join(world.directory,
                      `${['monday', 'tuesday', 'wednesday'][i]}.csv`);
    writeFileSync(file, [head, ...part].join('\n') + '\n');
    return file;
  });
  const common = ['--uncertainty', 'model', '--vehicle'];
  revisitd.cli('stream', files[0], '--create', ...common, 'two');
  revisitd.cli('stream', files[1], ...common, 'two', '--append', '--recording',
               'after:5m,17deg');
  revisitd.cli('stream', files[0], '--create', ...common, 'three');
  revisitd.cli('stream', files[1], ...common, 'three', '--append',
               '--recording', 'after:5m,17deg');
  revisitd.cli('stream', files[2], ...common, 'three', '--append',
               '--recording', 'unknown');
  revisitd.cli('stream', files[0], '--create', ...common, 'one');
  revisitd.cli('stream', files[1], ...common, 'one', '--append', '--recording',
               'same');
});
after(() => world?.close());

/** The text of the row of a recording in the table of them. */
function rowOf(title) {
  return page.getByRole('table', {name: 'Recordings'})
             .locator('tbody tr', {hasText: title});
}

async function open(path, options) {
  await page?.context().close();
  page = await world.open(path, options);
  page.listed = 0;
  page.on('request', request => {
    if (request.url().endsWith('/ListRecordings')) ++page.listed;
  });
}

async function openVehicle(id, options) {
  await open(`/vehicles/${id}`, options);
  await page.getByText(/^(\d+) of \1 checks answered$/).waitFor();
}

/** Looks at the page at all widths and in both themes, and leaves pictures. */
async function isFine(path, name, ready) {
  for (const width of WIDTHS) {
    for (const colorScheme of ['light', 'dark']) {
      await open(path, {colorScheme, viewport: {width, height: 900}});
      await page.locator(ready).first().waitFor();
      await page.getByText('Asking the server…')
          .waitFor({state: 'detached'});
      await until(async () => await pixels(page, '--background') > 1000,
                  'a map');
      await page.screenshot({
        path: join(OUT, `recordings-${name}-${width}-${colorScheme}.png`),
        fullPage: true,
      });
      assert.doesNotMatch(await page.locator('main').innerText(),
                          /NaN|undefined|Infinity/);
      await isAccessible(page);
    }
  }
}

test('a vehicle with one recording has no more than it had, for one call',
     async () => {
  await openVehicle('one');
  assert.equal(await page.getByRole('table', {name: 'Recordings'}).count(), 0);
  assert.equal(await fact(page, 'Recordings'), '');
  assert.equal(await page.locator('.place-name').count(), 0);
  assert.equal(await page.getByText('Recording of the match').count(), 0);
  world.revisitd.cli('vehicle', 'update', 'one', '--display-name', 'Other');
  await page.getByRole('heading', {name: 'Other'}).waitFor();
  await page.reload();
  page.listed = 0;
  await page.getByText(/^(\d+) of \1 checks answered$/).waitFor();
  const append = join(world.directory, 'monday.csv');
  world.revisitd.cli('stream', append, '--uncertainty', 'model', '--vehicle',
                     'one', '--append', '--recording', 'same');
  await until(async () => await number(page, 'Poses') === CUTS[1] + CUTS[0],
              'more poses');
  await page.getByText(/Map of revision/).waitFor();
  assert.equal(page.listed, 1);
});

test('a finding of another frame says what to send', async () => {
  await page.getByText(/^new frame: .*first pose of each recording/).waitFor();
  await page.getByText(/recording_start \(revisit: --recording\)/).waitFor();
});

test('recordings are drawn in the frame of the last one, as estimates',
     async () => {
  await openVehicle('two');
  assert.equal(await number(page, 'Recordings'), 2);
  assert.match(await rowOf('from pose 1').innerText(),
               /to within [\d.,]+ m, [\d.,]+°, by where recordings[^]*1–1,000/);
  assert.match(await rowOf('tuesday').innerText(),
               /in its frame[^]*1,001–1,400/);
  assert.deepEqual(await page.locator('.place-name').allInnerTexts(),
                   ['tuesday', 'from pose 1']);
  const legend = page.locator('.legend li', {hasText: 'from pose 1, placed'});
  assert.equal(await legend.locator('.swatch.recording-1.dashed').count(), 1);
  await until(async () => await pixels(page, '--recording-1') > 200,
              'the earlier recording');
  await until(async () => await pixels(page, '--path') > 50, 'the last one');
  assert.equal(page.listed, 1);
});

test('a candidate says in which recording its match lies, and how it is tied',
     async () => {
  const row = page.getByRole('table', {name: 'Candidates'})
                  .locator('tbody tr').first();
  assert.match(await row.innerText(),
               /from pose 1\s+tied by where the recordings began/);
  await row.locator('a').click();
  await page.locator('.evidence').waitFor();
  assert.equal(await fact(page, 'Recording of the match'), 'from pose 1');
  assert.equal(await fact(page, 'Frames'),
               'tied by where the recordings began');
  assert.notEqual(await fact(page, 'Difference x'), '');
  assert.deepEqual(
      await page.locator('.poses tbody th').allInnerTexts(),
      ['A, query, in tuesday', 'B, match, in from pose 1']);
});

test('what is not placed is not drawn over the rest, but by itself',
     async () => {
  await openVehicle('three');
  await page.getByText(/^2 of 3 recordings are not placed yet/).waitFor();
  assert.match(await rowOf('tuesday').innerText(), /not placed yet/);
  await until(async () => await pixels(page, '--path') > 50, 'the last one');
  assert.equal(await pixels(page, '--recording-1'), 0);
  assert.equal(await pixels(page, '--recording-2'), 0);
  assert.deepEqual(await page.locator('.place-name').allInnerTexts(),
                   ['wednesday']);
  await page.getByRole('button', {name: 'Alone: tuesday'}).click();
  await page.getByText(/^The map shows tuesday alone, in its own frame/)
      .waitFor();
  assert.match(page.url(), /\?recording=1001$/);
  await until(async () => await pixels(page, '--recording-2') > 200,
              'the chosen one');
  assert.equal(await pixels(page, '--path'), 0);
  await page.getByRole('button', {name: 'Show all that are placed'}).click();
  await until(async () => await pixels(page, '--path') > 50, 'the last one');
});

test('a candidate without a difference and a gate is told by its shape',
     async () => {
  const {candidates} = world.revisitd.cli(
      'find', 'three', '--sequence', '1460', '--json');
  const [first] = candidates;
  assert.equal(first.gate, undefined);
  const path = `/vehicles/three/candidates/1460-${first.matched.sequence}`;
  await isFine(path, 'shape-alone', '.evidence');
  const rules = await page.locator('.evidence').innerText();
  assert.match(rules, /nothing ties the frames[^]*the shape alone is compared/);
  assert.match(rules, /Path gate/);
  assert.match(await fact(page, 'Difference'), /^not known/);
  assert.equal(await fact(page, 'Frames'),
               'not tied: the shapes alone were compared');
  // Two small maps, since the two recordings share no frame.
  assert.equal(await page.locator('.map.small').count(), 2);
  await open('/vehicles/three?at=1465');
  await page.getByRole('cell', {name: 'shape alone'}).first().waitFor();
});

test('views of recordings are accessible before a loop closure ties them',
     async () => {
  await isFine('/vehicles/two', 'after', '.place-name');
  await isFine('/vehicles/three', 'unknown', '.place-name');
});

test('a confirmed loop closure places a recording, three make it known',
     async () => {
  await openVehicle('three');
  const confirm = asked => {
    const {candidates: [{query, matched}]} = world.revisitd.cli(
        'find', 'three', '--sequence', String(asked), '--json');
    world.revisitd.cli('confirm', 'three', String(query.sequence),
                       String(matched.sequence));
  };
  confirm(1500);
  await rowOf('from pose 1').getByText(/^to within .* by too few loop closures/)
      .waitFor();
  await until(async () => await pixels(page, '--recording-1') > 200,
              'the first recording');
  assert.ok(await pixels(page, '--recording-2') > 50);
  await until(async () => await page.getByText('not placed yet').count() === 0,
              'all placed');
  await isFine('/vehicles/three', 'provisional', '.place-name');
  await openVehicle('three');
  for (const asked of [1600, 1700, 1800]) confirm(asked);
  await rowOf('from pose 1').getByText(/^known to within .* by loop closures/)
      .waitFor();
  const legend = page.locator('.legend li', {hasText: 'from pose 1'});
  assert.equal(await legend.locator('.dashed').count(), 0);
  await page.screenshot({path: join(OUT, 'recordings-known.png')});
  await page.context().close();
});
