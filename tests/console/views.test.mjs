// Every view: its picture, its files, its link, its accessibility, and what it
// lets in and out.
import assert from 'node:assert/strict';
import {readFileSync, writeFileSync} from 'node:fs';
import {request} from 'node:http';
import {join} from 'node:path';
import {after, before, test} from 'node:test';

import {DRIVE, fact, isAccessible, OUT, pixels, pixelsOf, track, until, World}
    from './world.mjs';

const WIDTHS = [1440, 390];

let world;
/** Name, address, and what is there once the view is whole. */
let views;

before(async () => {
  world = await World.make(
      [], ({revisitd}) => [
        '--metrics', revisitd.metrics,
        '--link', 'camera=https://pictures.example/{vehicle}/{time_a}',
        '--link', 'viewer=https://viewer.example/?a={pose_a}&b={unix_b}']);
  const {revisitd} = world;
  revisitd.cli('stream', DRIVE, '--create', '--vehicle', 'boreas',
               '--uncertainty', 'file');
  revisitd.cli('vehicle', 'update', 'boreas', '--display-name', 'Glen Shields',
               '--label', 'site=toronto');
  revisitd.cli('vehicle', 'create', 'empty');
  for (const [id, latitude, longitude] of
       [['van-1', 52.5163, 13.3777], ['van-2', 52.5208, 13.4094]]) {
    const file = join(world.directory, `${id}.gpx`);
    writeFileSync(file, track([latitude, longitude]));
    revisitd.cli('stream', file, '--create', '--vehicle', id);
  }
  const decide = (command, asked, note) => {
    const found = revisitd.cli('find', 'boreas', '--sequence', asked, '--json');
    const [{query, matched}] = found.candidates;
    revisitd.cli(command, 'boreas', String(query.sequence),
                 String(matched.sequence), '--note', note);
    return `${query.sequence}-${matched.sequence}`;
  };
  const confirmed = decide('confirm', '1500', 'seen by hand');
  decide('reject', '1240', 'another road, below the bridge');
  views = [
    ['fleet', '/', 'tbody a'],
    ['vehicle', '/vehicles/boreas?at=1300', '.side tbody a'],
    ['candidate',
     `/vehicles/boreas/candidates/1520-${
         revisitd.cli('find', 'boreas', '--sequence', '1520', '--json')
             .candidates[0].matched.sequence}`,
     '.curve canvas'],
    ['server', '/server', '.columns meter'],
    ['all-verdicts', '/vehicles/boreas?at=1300&show=ellipse,accepted,' +
         'ambiguous,uninformative,rejected-by-shape,rejected-by-gate',
     '.side tbody a'],
    ['decided', `/vehicles/boreas/candidates/${confirmed}`, '.curve canvas'],
    ['geodetic', '/vehicles/van-1', '.map .degrees'],
  ];
});
after(() => world?.close());

async function opened([, path, ready], options) {
  const page = await world.open(path, options);
  await page.locator(ready).first().waitFor();
  return page;
}

test('no view breaks a rule of axe, light or dark, wide or narrow',
     async () => {
  for (const view of views) {
    for (const width of WIDTHS) {
      for (const colorScheme of ['light', 'dark']) {
        const page = await opened(view, {
          colorScheme, viewport: {width, height: 900},
        });
        if (['vehicle', 'all-verdicts'].includes(view[0])) {
          await page.getByText(/^(\d+) of \1 checks answered$/).waitFor();
        }
        await page.screenshot({
          path: join(OUT, `${view[0]}-${width}-${colorScheme}.png`),
          fullPage: true,
        });
        await isAccessible(page);
        // As it looks to those without green cones: to be looked at.
        const sight = await page.context().newCDPSession(page);
        await sight.send('Emulation.setEmulatedVisionDeficiency',
                         {type: 'deuteranopia'});
        await page.screenshot({
          path: join(OUT, `${view[0]}-${width}-${colorScheme}-deuteranopia.png`),
          fullPage: true,
        });
        await page.context().close();
      }
    }
  }
});

test('every view has a link that leads to it, and a way back', async () => {
  const page = await world.open('/');
  await page.getByRole('link', {name: 'Glen Shields'}).click();
  // Rows that come meanwhile move those that are there away from the mouse.
  await page.getByRole('table', {name: 'Candidates'}).locator('tbody a')
      .first().dispatchEvent('click');
  await page.locator('.evidence').waitFor();
  const title = await page.locator('h1').textContent();
  await page.reload();
  await page.locator('.evidence').waitFor();
  assert.equal(await page.locator('h1').textContent(), title);
  await page.goBack();
  await page.locator('.slider').waitFor();
  await page.goBack();
  await page.getByRole('heading', {name: 'Fleet'}).waitFor();
  await page.context().close();
});

test('tabs are named after what they show', async () => {
  for (const [i, title] of [[0, 'Fleet · revisit'],
                            [1, 'Glen Shields · revisit'],
                            [2, /^[\d,]+–[\d,]+ · Glen Shields · revisit$/],
                            [3, 'Server · revisit']]) {
    const page = await opened(views[i]);
    await until(async () => {
      const got = await page.title();
      return typeof title === 'string' ? got === title : title.test(got);
    }, `title ${title}`);
    await page.context().close();
  }
});

test('a vehicle with a name is shown with its id, and with its settings',
     async () => {
  const page = await opened(views[0]);
  await page.getByRole('row', {name: /Glen Shields\s+boreas/}).waitFor();
  await page.getByRole('link', {name: 'Glen Shields'}).click();
  await page.locator('h1 + code', {hasText: 'boreas'}).waitFor();
  await page.locator('.settings summary').click();
  assert.equal(await fact(page, 'Node spacing'), '2 m');
  assert.equal(await fact(page, 'Correlation model'), 'dead reckoning');
  assert.equal(await fact(page, 'Gate probability'), '0.95');
  assert.match(await fact(page, 'Place tolerance'),
               /^position 2 m, heading 0\.1 rad$/);
  await page.context().close();
});

test('a table is sorted by a column, either way, and then as it was',
     async () => {
  const page = await opened(views[4]);
  await page.getByText(/^(\d+) of \1 checks answered$/).waitFor();
  const table = page.getByRole('table', {name: 'Candidates'});
  const head = table.getByRole('button', {name: 'Match'});
  const column = async () => (await table.locator('tbody td:nth-child(2)')
      .allInnerTexts()).map(text => Number(text.replaceAll(',', '')));
  const rising = values => values.every((v, i) => i === 0 || values[i - 1] <= v);
  const asItCame = await column();
  await head.click();
  assert.equal(await table.locator('th[aria-sort]').getAttribute('aria-sort'),
               'ascending');
  const up = await column();
  assert.ok(rising(up) && up[0] < asItCame[0] + 1, `${up}`);
  await head.click();
  const down = await column();
  assert.ok(rising([...down].reverse()) && down[0] >= Math.max(...asItCame));
  await head.click();
  assert.deepEqual(await column(), asItCame);
  assert.equal(await table.locator('th[aria-sort]').count(), 0);
  await page.context().close();
});

test('a row that is pointed at stands out on the map, a link in the table',
     async () => {
  const page = await opened(['', '/vehicles/boreas?show=accepted',
                             '.side tbody a']);
  await page.getByText(/^(\d+) of \1 checks answered$/).waitFor();
  assert.equal(await pixels(page, '--selected'), 0);
  const rows = page.getByRole('table', {name: 'Decisions'}).locator('tbody tr');
  await rows.first().hover();
  const spot = await until(async () => {
    const found = await pixelsOf(page, '--selected');
    return found.count > 3 && found;
  }, 'the pair on the map');
  await page.mouse.move(5, 5);
  await until(async () => await pixels(page, '--selected') === 0, 'nothing');
  const box = await page.locator('.map .canvas').boundingBox();
  await page.mouse.move(box.x + spot.x, box.y + spot.y);
  await page.locator('.map .tip', {hasText: /–.*: /}).waitFor();
  await page.locator('tr.pointed').first().waitFor();
  await page.context().close();
});

test('a pair has the times of its poses, and links that name it elsewhere',
     async () => {
  const page = await opened(views[2]);
  const times = await page.locator('.poses tbody td:nth-child(3)')
                          .allInnerTexts();
  assert.equal(times.length, 2);
  const [query] = times.map(text => text.replace(' ', 'T')
      .replace(' UTC', 'Z'));
  assert.equal(new Date(query).toISOString(), query);
  const href = name => page.getByRole('link', {name}).getAttribute('href');
  assert.equal(await href(/^camera/), 'https://pictures.example/boreas/' +
               encodeURIComponent(query));
  const pair = await page.locator('h1').innerText();
  const [, a] = /^Pose ([\d,]+)/.exec(pair);
  assert.match(await href(/^viewer/), new RegExp(
      `\\?a=${a.replaceAll(',', '')}&b=\\d+\\.\\d{3}$`));
  const link = page.getByRole('link', {name: /^camera/});
  assert.equal(await link.getAttribute('rel'), 'noopener noreferrer');
  await page.context().close();
});

test('the first candidate that is open is a key away, and has the focus',
     async () => {
  const page = await opened(views[1]);
  await page.locator('a.button', {hasText: 'Review'}).waitFor();
  await page.keyboard.press('j');
  await page.getByText('Nobody has decided about this pair').waitFor();
  assert.ok(await page.evaluate(
      () => document.activeElement.matches('.decision')));
  await page.keyboard.press('Tab');
  assert.ok(await page.evaluate(
      () => document.activeElement.matches('input[name=note]')));
  await page.context().close();
});

test('maps without a base map have lines of latitude and longitude',
     async () => {
  for (const view of ['/?search=van', '/vehicles/van-1']) {
    const page = await opened(['', view, '.map .degrees']);
    const labels = await page.locator('.map .degrees').allInnerTexts();
    assert.ok(labels.some(text => /^52\.51\d+° N$/.test(text)) ||
              labels.some(text => /^52\.52\d*° N$/.test(text)), `${labels}`);
    assert.ok(labels.some(text => /^13\.\d+° E$/.test(text)), `${labels}`);
    await until(async () => await pixels(page, '--grid') > 200, 'lines');
    await page.locator('.map .place',
                       {hasText: /52\.5\d+° N, 13\.[34]\d+° E/}).waitFor();
    await page.context().close();
  }
});

test('search, state and labels narrow the fleet, and the link keeps that',
     async () => {
  const page = await world.open('/');
  await page.getByText('4 of 4 vehicles').waitFor();
  await page.getByLabel('Search').fill('site=toronto');
  await page.getByText('1 of 4 vehicles').waitFor();
  assert.match(page.url(), /search=site%3Dtoronto/);
  await page.reload();
  await page.getByText('1 of 4 vehicles').waitFor();
  await page.getByLabel('Search').fill('');
  await page.getByLabel('State').selectOption('streaming');
  await page.getByText('0 of 4 vehicles').waitFor();
  await page.context().close();
});

test('vehicles with geodetic positions share a map, and a click leads on',
     async () => {
  const page = await world.open('/?search=van');
  await page.locator('.map canvas').waitFor();
  const box = await page.locator('.map .canvas').boundingBox();
  const {x, y} = await until(async () => {
    const dot = await pixelsOf(page, '--vehicle');
    return dot.count > 50 && dot;
  }, 'vehicles on the map');
  await page.mouse.click(box.x + x, box.y + y);
  await until(() => /vehicles\/van-\d$/.test(page.url()), 'its view');
  await page.context().close();
});

test('every view is saved as SVG and as PNG', async () => {
  for (const view of views) {
    const page = await opened(view);
    const save = async type => {
      const [download] = await Promise.all([
        page.waitForEvent('download'),
        page.getByRole('button', {name: type, exact: true}).click(),
      ]);
      const path = join(OUT, `saved-${view[0]}.${type.toLowerCase()}`);
      await download.saveAs(path);
      return readFileSync(path);
    };
    const svg = (await save('SVG')).toString();
    const parts = await page.evaluate(text => {
      const parsed = new DOMParser().parseFromString(text, 'image/svg+xml');
      return {
        error: parsed.querySelector('parsererror')?.textContent,
        texts: parsed.querySelectorAll('text').length,
        shapes: parsed.querySelectorAll('path[d], circle').length,
      };
    }, svg);
    assert.equal(parts.error, undefined);
    assert.ok(parts.texts > 3, `${view[0]}: ${JSON.stringify(parts)}`);
    if (view[0] !== 'fleet') assert.ok(parts.shapes > 1, view[0]);
    const png = await save('PNG');
    assert.equal(png.subarray(1, 4).toString(), 'PNG');
    assert.ok(png.readUInt32BE(16) >= 1280, 'narrow picture');
    assert.deepEqual(page.complaints, []);
    await page.context().close();
  }
});

test('the server\'s view shows what the server does', async () => {
  const page = await opened(views[3]);
  const row = (table, name) => page.getByRole('table', {name: table})
      .locator('tbody tr', {hasText: name}).locator('td').allInnerTexts();
  assert.equal(await fact(page, 'Streams open'), '0');
  assert.equal(await fact(page, 'Takes writes'), 'yes');
  assert.match(await fact(page, 'Size of the store'), /^[\d.]+ [KM]iB$/);
  const stream =
      world.revisitd.openStream('--create', '--vehicle', 'streamed',
                                '--uncertainty', 'file');
  try {
    const [head, ...poses] = readFileSync(DRIVE, 'utf8').split('\n');
    stream.stdin.write(head + '\n');
    const [, p50, p99, rate, all] = await until(async () => {
      stream.stdin.write(poses.splice(0, 20).map(line => line + '\n').join(''));
      if (await fact(page, 'Streams open') !== '1') return false;
      const found = await row('Latencies', 'Acknowledgement');
      return /ms$/.test(found[2]) && found;
    }, 'stream and its acknowledgements');
    assert.ok(parseFloat(p50) <= parseFloat(p99), `${p50} ${p99}`);
    assert.ok(parseFloat(rate) > 0 && Number(all.replaceAll(',', '')) > 0);
    assert.match(await fact(page, 'Poses accepted'), /^[\d.]+\/s$/);
    const [, , share] = await row('Limits in use', 'max-streams');
    assert.match(share, /^(< )?[\d.]*[1-9] %$/);
    // An error is counted with its code and reason.
    await ask('POST', CALL + 'GetVehicle', JSON_TYPE,
              '{"name": "vehicles/nobody"}');
    await until(async () => (await row('Reason of an error',
                                       'VEHICLE_NOT_FOUND')).length > 0,
                'reason');
    assert.equal((await row('Ended with', 'NOT_FOUND')).length, 3);
    // Curves are drawn once there are two readings.
    await page.locator('.curve', {hasText: 'Streams open'})
        .locator('canvas').waitFor();
    await page.screenshot({path: join(OUT, 'server-busy.png'), fullPage: true});
  } finally {
    stream.kill();
  }
  world.revisitd.cli('vehicle', 'delete', '--yes', 'streamed');
  assert.deepEqual(page.complaints, []);
  await page.context().close();
});

/** Status and headers of a bare request. */
function ask(method, path, headers = {}, body = undefined) {
  return new Promise((resolve, reject) => {
    const {hostname, port} = new URL(world.console.url);
    const sent = request({hostname, port, method, path, headers}, answer => {
      let text = '';
      answer.on('data', data => text += data);
      answer.on('end', () => resolve({status: answer.statusCode,
                                      headers: answer.headers, text}));
    });
    sent.on('error', reject);
    sent.end(body);
  });
}

const CALL = '/revisit.v1.PoseGraphService/';
const JSON_TYPE = {'content-type': 'application/json'};

test('the page may load nothing from elsewhere and run nothing inline',
     async () => {
  const {headers, text} = await ask('GET', '/');
  const policy = headers['content-security-policy'];
  assert.match(policy, /default-src 'none'/);
  assert.match(policy, /script-src 'self'(;|$)/);
  assert.match(policy, /style-src 'self'(;|$)/);
  assert.doesNotMatch(policy, /unsafe|https?:|\*/);
  assert.equal(headers['set-cookie'], undefined);
  assert.doesNotMatch(text, /<script(?![^>]*src=)|<style|style=|\son\w+=/);
  const page = await opened(views[1]);
  const addresses = await page.evaluate(
      () => performance.getEntriesByType('resource').map(({name}) => name));
  for (const address of addresses) {
    assert.ok(address.startsWith(world.console.url + '/'), address);
  }
  assert.deepEqual(await page.context().cookies(), []);
  await page.context().close();
});

test('it answers under its own names only, and calls from its own page only',
     async () => {
  const known = await ask('POST', CALL + 'GetServerInfo', JSON_TYPE, '{}');
  assert.equal(known.status, 200);
  assert.ok(JSON.parse(known.text).version);
  const rebound = await ask('POST', CALL + 'GetServerInfo',
                            {...JSON_TYPE, host: 'evil.example'}, '{}');
  assert.equal(rebound.status, 403);
  const foreign = await ask(
      'POST', CALL + 'GetServerInfo',
      {...JSON_TYPE, 'sec-fetch-site': 'cross-site'}, '{}');
  assert.equal(foreign.status, 403);
});

test('it passes on what its page calls, and nothing else', async () => {
  for (const method of ['AppendPoses', 'DeleteVehicle', 'UpdateVehicle',
                        'RevisePoses', 'AcceptDataLoss', 'CreateVehicle']) {
    const {status} = await ask('POST', CALL + method, JSON_TYPE, '{}');
    assert.equal(status, 404, method);
  }
  for (const path of ['/../package.json', '/%2e%2e/server/main.js',
                      '/assets/', '/vehicles/Not_A_Name']) {
    assert.equal((await ask('GET', path)).status, 404, path);
  }
});

test('an error of the server comes with its code and message', async () => {
  const {status, text} = await ask('POST', CALL + 'GetVehicle', JSON_TYPE,
                                   '{"name": "vehicles/nobody"}');
  assert.equal(status, 404);
  const error = JSON.parse(text);
  assert.equal(error.code, 'not_found');
  assert.match(error.message, /nobody/);
  assert.equal(error.details[0].type, 'google.rpc.ErrorInfo');
});
