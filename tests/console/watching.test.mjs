// A tab that watches a vehicle of 400 km: what it costs the network and the
// server, and what it does when the server stops.
import assert from 'node:assert/strict';
import {createWriteStream} from 'node:fs';
import {connect, createServer} from 'node:net';
import {join} from 'node:path';
import {finished} from 'node:stream/promises';
import {after, before, test} from 'node:test';
import {setTimeout as sleep} from 'node:timers/promises';

import {Console, freePort, until, World} from './world.mjs';

const POSES = 20_000;
const SPACING_METERS = 20;
const WATCHED_SECONDS = 60;
/** Bytes of a node of an export, of which one comes each 2 m. */
const NODE_BYTES = 160;
const MOST_SEARCHES = 100;
const CHECK_METERS = 50;

const HEAD = 't,x,y,yaw,pxx,pxy,pxt,pyy,pyt,ptt\n';

let world, page, poses, passed, proxy, behind, stream;

/** A drive that winds along without an end. */
function* drive() {
  let [x, y, heading] = [0, 0, 0];
  for (let i = 0;; ++i) {
    yield `${i},${x.toFixed(3)},${y.toFixed(3)},${heading.toFixed(6)},` +
        '0.01,0,0,0.01,0,0.0001\n';
    heading += 0.04 * Math.sin(i / 37) + 0.06 * Math.sin(i / 211) +
        (Math.floor(i / 500) % 2 ? 0.03 : -0.027);
    heading = Math.atan2(Math.sin(heading), Math.cos(heading));
    x += SPACING_METERS * Math.cos(heading);
    y += SPACING_METERS * Math.sin(heading);
  }
}

const some = count => Array.from({length: count}, () => poses.next().value)
                          .join('');

/** Passes bytes on to a port, and counts those that come back. */
async function countingProxy(target) {
  const server = createServer(incoming => {
    const outgoing = connect(target(), '127.0.0.1');
    incoming.pipe(outgoing).pipe(incoming);
    outgoing.on('data', data => passed += data.length);
    for (const socket of [incoming, outgoing]) {
      socket.on('error', () => { incoming.destroy(); outgoing.destroy(); });
    }
  });
  const port = await freePort();
  server.listen(port, '127.0.0.1');
  return {server, port};
}

/** Searches that were made: some are refused at first, and asked for again. */
async function searches() {
  const text = await (await fetch(world.revisitd.metrics)).text();
  return [...text.matchAll(
      /^revisit_calls_total\{[^}]*method="FindCandidates",code="OK"\} (\d+)/gm)]
      .reduce((sum, [, count]) => sum + Number(count), 0);
}

before(async () => {
  world = await World.make();
  poses = drive();
  const file = join(world.directory, 'drive.csv');
  const out = createWriteStream(file);
  out.write(HEAD + some(POSES));
  out.end();
  await finished(out);
  world.revisitd.cli('stream', file, '--create', '--vehicle', 'long',
                     '--columns', 't=t,x=x,y=y,yaw=yaw', '--batch', '4096');
  passed = 0;
  proxy = await countingProxy(() => Number(new URL(behind.url).port));
  behind = new Console(() => world.revisitd.address,
                       ['--host', `127.0.0.1:${proxy.port}`]);
  await behind.start();
  page = await world.open('/');
});
after(async () => {
  stream?.kill();
  proxy?.server.close();
  await behind?.close();
  await world?.close();
});

test('a minute of a growing vehicle costs its new nodes and checks', async t => {
  await page.goto(`http://127.0.0.1:${proxy.port}/vehicles/long`);
  await page.getByText(/^Map of revision/).waitFor({timeout: 120_000});
  await page.getByText(`${MOST_SEARCHES} of ${MOST_SEARCHES} checks answered`)
      .waitFor({timeout: 300_000});
  assert.equal(await searches(), MOST_SEARCHES);
  const nodes = async () => Number(/([\d,]+) nodes/.exec(
      await page.locator('.title [role=status]').innerText())[1]
      .replaceAll(',', ''));
  const before = {bytes: passed, searches: await searches(),
                  nodes: await nodes()};
  assert.ok(before.nodes >= 199_000, `${before.nodes}`);
  stream = world.revisitd.openStream('--append', '--vehicle', 'long',
                                     '--columns', 't=t,x=x,y=y,yaw=yaw');
  stream.stdin.write(HEAD);
  for (let second = 0; second < WATCHED_SECONDS; ++second) {
    stream.stdin.write(some(1));
    // Somebody is there.
    await page.mouse.move(700 + second, 20);
    await sleep(1000);
  }
  stream.stdin.end();
  const metres = WATCHED_SECONDS * SPACING_METERS;
  await until(async () => await nodes() >= before.nodes + metres / 2 - 20,
              'growth on the map');
  await sleep(3000);
  const cost = {bytes: passed - before.bytes,
                searches: await searches() - before.searches,
                nodes: await nodes() - before.nodes};
  console.log(`${cost.nodes} new nodes of ${before.nodes}: ${
      cost.bytes} bytes, ${cost.searches} searches`);
  // Each second there is the vehicle besides, some 1.5 kB with its headers.
  const others = 3000 * (WATCHED_SECONDS + 30);
  assert.ok(cost.bytes < NODE_BYTES * cost.nodes * 2 + others +
            cost.searches * 60_000, `${cost.bytes} bytes`);
  // A check at the last node is asked about once more when the next node says
  // which pose comes behind it.
  assert.ok(cost.searches <= 2 * Math.ceil(metres / CHECK_METERS),
            `${cost.searches} searches`);
  t.diagnostic(JSON.stringify(cost));
});

test('a page that nobody sees searches nothing and asks nothing', async () => {
  const see = hidden => page.evaluate(value => {
    Object.defineProperty(document, 'hidden',
                          {configurable: true, get: () => value});
    document.dispatchEvent(new Event('visibilitychange'));
  }, hidden);
  await see(true);
  await sleep(3000);
  const [bytes, before] = [passed, await searches()];
  const more = world.revisitd.openStream('--append', '--vehicle', 'long',
                                         '--columns', 't=t,x=x,y=y,yaw=yaw');
  more.stdin.write(HEAD + some(20));
  more.stdin.end();
  await sleep(6000);
  assert.equal(await searches(), before);
  assert.equal(passed, bytes);
  await see(false);
  await until(async () => await searches() > before, 'searches again');
});

test('a server that stops is missed within seconds, and found again',
     async () => {
  const banner = page.getByText('No answer from revisitd since');
  assert.equal(await banner.count(), 0);
  world.revisitd.child.kill('SIGSTOP');
  const stopped = performance.now();
  try {
    await banner.waitFor({timeout: 10_000});
    const took = performance.now() - stopped;
    console.log(`missed after ${Math.round(took)} ms`);
    assert.ok(took < 5000, `${took} ms`);
  } finally {
    world.revisitd.child.kill('SIGCONT');
  }
  await banner.waitFor({state: 'detached'});
  assert.deepEqual(page.complaints, []);
});
