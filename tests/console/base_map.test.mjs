// The user's own map below the paths.
import assert from 'node:assert/strict';
import {readFileSync, writeFileSync} from 'node:fs';
import {join} from 'node:path';
import {after, before, test} from 'node:test';

import {picture, vectors, writeArchive} from './pmtiles.mjs';
import {coloursAt, Console, DRIVE, isAccessible, load, OUT, pixelsOf, track,
        until, World} from './world.mjs';

const LEVEL = 14;
const LONGITUDE = 13.3777;
/** track() moves so far northwards from one of its points to the next. */
const STEP_DEGREES = 5e-5;
// Neither is like a colour of the page.
const NORTH = [120, 180, 120];
const SOUTH = [200, 120, 40];
const ATTRIBUTION =
    '<a href="https://www.openstreetmap.org/copyright">© OpenStreetMap</a>' +
    '<img src="/x"> and <a href="javascript:throw 1"><b>me</b></a>';

let world;
let archive;
/** Column of the tiles of the level, and the row north of the edge. */
let column, row;

/** Latitude of the northern edge of a row of tiles. */
function edgeOf(y) {
  return Math.atan(Math.sinh(Math.PI * (1 - 2 * y / 2 ** LEVEL))) * 180 /
      Math.PI;
}

/** Tiles around the place, with the data of those north and south of it. */
function around(north, south) {
  const tiles = [];
  for (let dx = -3; dx <= 3; ++dx) {
    for (let dy = -3; dy <= 3; ++dy) {
      tiles.push({z: LEVEL, x: column + dx, y: row + dy,
                  data: dy <= 0 ? north : south});
    }
  }
  return tiles;
}

before(async () => {
  column = Math.floor(2 ** LEVEL * (LONGITUDE + 180) / 360);
  row = 5371;
  world = await World.make([], ({directory}) => {
    archive = join(directory, 'base.pmtiles');
    writeArchive(archive, 'png', around(picture(NORTH), picture(SOUTH)),
                 {attribution: ATTRIBUTION});
    return ['--base-map', archive];
  });
  const {revisitd, directory} = world;
  // Half of the way lies on either side of the edge.
  const file = join(directory, 'van.gpx');
  writeFileSync(file, track(
      [edgeOf(row + 1) - 14.5 * STEP_DEGREES, LONGITUDE]));
  revisitd.cli('stream', file, '--create', '--vehicle', 'van');
  revisitd.cli('stream', DRIVE, '--create', '--vehicle', 'local',
               '--uncertainty', 'file');
});
after(() => world?.close());

function isNear(colour, wanted) {
  return colour.every((part, i) => Math.abs(part - wanted[i]) <= 4);
}

/** Waits until the map has these colours beside the path, at its northern and
 * its southern end. */
async function groundIs(page, north, south) {
  await until(async () => {
    const {x, top, bottom, count} = await pixelsOf(page, '--path');
    if (count < 100) return false;
    const [above, below] = await coloursAt(
        page, [[x + 30, top + 10], [x + 30, bottom - 10]]);
    return isNear(above, north) && isNear(below, south);
  }, `ground ${north} above ${south}`);
}

async function openVan(options) {
  const page = await world.open('/vehicles/van?show=accepted', options);
  await page.locator('.map canvas').waitFor();
  return page;
}

test('the map lies below the path where it belongs', async () => {
  const page = await openVan({colorScheme: 'light'});
  await groundIs(page, NORTH, SOUTH);
  // Its links are nearly of the colour of the path.
  await page.locator('.attribution').evaluate(made => made.remove());
  const {x, top, bottom} = await pixelsOf(page, '--path');
  // The path goes on to the centre of the disc of the vehicle at its north.
  const middle = (top - 6 + bottom) / 2;
  assert.ok(bottom - top > 200, `from ${top} to ${bottom}`);
  const [above, below] =
      await coloursAt(page, [[x + 30, middle - 4], [x + 30, middle + 4]]);
  assert.ok(isNear(above, NORTH), `above the edge ${above}`);
  assert.ok(isNear(below, SOUTH), `below the edge ${below}`);
  await page.screenshot({path: join(OUT, 'base-map-raster.png')});
  assert.deepEqual(page.complaints, []);
  await page.context().close();
});

test('who made the map is named, by text and links alone', async () => {
  const page = await openVan();
  const made = page.locator('.attribution');
  await made.waitFor();
  assert.equal(await made.innerText(), '© OpenStreetMap and me');
  assert.deepEqual(
      await made.locator('*').evaluateAll(
          all => all.map(({localName, href}) => [localName, href])),
      [['a', 'https://www.openstreetmap.org/copyright']]);
  assert.deepEqual(page.complaints, []);
  await page.context().close();
});

test('a view with a base map breaks no rule of axe', async () => {
  for (const width of [1440, 390]) {
    for (const colorScheme of ['light', 'dark']) {
      const page = await openVan({colorScheme, viewport: {width, height: 900}});
      await page.locator('.attribution').waitFor();
      await until(async () => (await pixelsOf(page, '--path')).count > 100,
                  'path');
      await page.screenshot({
        path: join(OUT, `base-map-${width}-${colorScheme}.png`),
        fullPage: true,
      });
      await isAccessible(page);
      await page.context().close();
    }
  }
});

test('it is hidden by a box, and the link keeps that', async () => {
  const page = await openVan();
  await groundIs(page, NORTH, SOUTH);
  await page.getByLabel('Base map').uncheck();
  await groundIs(page, [255, 255, 255], [255, 255, 255]);
  assert.equal(await page.locator('.attribution').count(), 0);
  assert.match(page.url(), /base=off/);
  await page.reload();
  await groundIs(page, [255, 255, 255], [255, 255, 255]);
  await page.getByLabel('Base map').check();
  await groundIs(page, NORTH, SOUTH);
  await page.context().close();
});

test('a dark page dims pictures', async () => {
  const page = await openVan({colorScheme: 'dark'});
  const dimmed = colour => colour.map(
      (part, i) => Math.round(0.55 * part + 0.45 * [0x12, 0x16, 0x1d][i]));
  await groundIs(page, dimmed(NORTH), dimmed(SOUTH));
  await page.context().close();
});

test('saved files have the map in them', async () => {
  const page = await openVan();
  await groundIs(page, NORTH, SOUTH);
  for (const type of ['SVG', 'PNG']) {
    const [download] = await Promise.all([
      page.waitForEvent('download'),
      page.getByRole('button', {name: type, exact: true}).click(),
    ]);
    const path = join(OUT, `saved-base-map.${type.toLowerCase()}`);
    await download.saveAs(path);
    const file = readFileSync(path);
    if (type === 'SVG') assert.match(file.toString(), /© OpenStreetMap and me/);
    const counts = await page.evaluate(async ([base64, mime, colours]) => {
      const bytes = Uint8Array.from(atob(base64), c => c.charCodeAt(0));
      const image = new Image();
      image.src = URL.createObjectURL(new Blob([bytes], {type: mime}));
      await image.decode();
      const canvas =
          new OffscreenCanvas(image.naturalWidth, image.naturalHeight);
      const context = canvas.getContext('2d');
      context.drawImage(image, 0, 0);
      const {data} = context.getImageData(0, 0, canvas.width, canvas.height);
      return colours.map(colour => {
        let found = 0;
        for (let i = 0; i < data.length; i += 4) {
          if (colour.every((part, k) => Math.abs(data[i + k] - part) < 5)) {
            ++found;
          }
        }
        return found;
      });
    }, [file.toString('base64'),
        type === 'SVG' ? 'image/svg+xml' : 'image/png', [NORTH, SOUTH]]);
    assert.ok(Math.min(...counts) > 10_000, `${type}: ${counts}`);
  }
  assert.deepEqual(page.complaints, []);
  await page.context().close();
});

test('the fleet has it, and a local frame has none', async () => {
  const page = await world.open('/?search=van');
  await page.locator('.attribution').waitFor();
  await page.goto(world.console.url + '/vehicles/local?show=accepted');
  await page.locator('.map canvas').waitFor();
  await until(async () => (await pixelsOf(page, '--path')).count > 300, 'path');
  assert.equal(await page.getByLabel('Base map').count(), 0);
  const loaded = await page.evaluate(
      () => performance.getEntriesByType('resource').map(({name}) => name));
  assert.ok(!loaded.some(name => /ground-|tile_worker|pmtiles/.test(name)),
            `${loaded}`);
  await page.context().close();
});

test('vector tiles are drawn in the colours of the page', async () => {
  const path = join(world.directory, 'vector.pmtiles');
  const all = [[0, 0], [4096, 0], [4096, 4096], [0, 4096]];
  writeArchive(path, 'mvt', around(
      vectors([{layer: 'landuse', kind: 'area', name: 'park', points: all}]),
      vectors([
        {layer: 'water', kind: 'area', name: 'lake', points: all},
        {layer: 'roads', kind: 'line', name: 'major_road',
         points: [[0, 100], [4096, 100]]},
        {layer: 'nobody-knows', kind: 'area', name: 'x', points: all},
      ])), {attribution: 'drawn by hand'});
  const console = new Console(() => world.revisitd.address,
                              ['--base-map', path]);
  await console.start();
  try {
    for (const colorScheme of ['light', 'dark']) {
      const page = await world.open('/', {colorScheme});
      await page.goto(console.url + '/vehicles/van?show=accepted');
      const [green, water] = await page.evaluate(
          names => names.map(name => {
            const value = parseInt(
                getComputedStyle(document.documentElement)
                    .getPropertyValue(name).trim().slice(1), 16);
            return [value >> 16, value >> 8 & 255, value & 255];
          }), ['--ground-green', '--ground-water']);
      await groundIs(page, green, water);
      await until(async () =>
          (await pixelsOf(page, '--ground-major-road')).count > 300, 'road');
      await page.screenshot(
          {path: join(OUT, `base-map-vector-${colorScheme}.png`)});
      assert.deepEqual(page.complaints, []);
      await page.context().close();
    }
  } finally {
    await console.close();
  }
});

test('a map is placed in the frame in which the server has the path',
     async () => {
  const {tangentFrame, mercatorFrame, toEarth} =
      await load('web/geometry/frame.ts');
  // 10 km away a plane and Mercator's map differ by metres, and the earth's
  // curvature is 8 m.
  const origin = {latitude: 52.5, longitude: LONGITUDE};
  const far = {latitude: 52.59, longitude: LONGITUDE + 0.1};
  const file = join(world.directory, 'far.gpx');
  writeFileSync(file, track([origin.latitude, origin.longitude],
                            [far.latitude, far.longitude]));
  world.revisitd.cli('stream', file, '--create', '--vehicle', 'far');
  const poses = world.revisitd.text('export', 'far', '--format', 'tum')
                    .trim().split('\n').filter(line => !line.startsWith('#'))
                    .map(line => line.split(' ').map(Number));
  assert.equal(poses.length, 60);
  const frame = tangentFrame(origin, 40);
  const [x, y] = frame.toMap(far);
  const [, px, py] = poses[30];
  assert.ok(Math.hypot(px - x, py - y) < 0.01, `${[px, py]} but ${[x, y]}`);
  for (const made of [frame, mercatorFrame(origin)]) {
    const back = toEarth(made, ...made.toMap(far));
    assert.ok(Math.abs(back.latitude - far.latitude) < 1e-9);
    assert.ok(Math.abs(back.longitude - far.longitude) < 1e-9);
  }
});
