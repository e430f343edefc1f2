// A real revisitd, a real console in front of it and a real browser, as the
// tests of the console start and stop them.
import assert from 'node:assert/strict';
import {spawn, spawnSync} from 'node:child_process';
import {generateKeyPairSync, sign} from 'node:crypto';
import {existsSync, mkdirSync, mkdtempSync, openSync, readFileSync, rmSync,
        writeFileSync} from 'node:fs';
import {createRequire} from 'node:module';
import {createServer} from 'node:net';
import {tmpdir} from 'node:os';
import {join} from 'node:path';
import {setTimeout as sleep} from 'node:timers/promises';
import {fileURLToPath} from 'node:url';

import {chromium} from 'playwright-core';

export const ROOT = fileURLToPath(new URL('../..', import.meta.url));
export const BIN = process.env.REVISIT_BIN ?? join(ROOT, 'build/release/bin');
export const DRIVE =
    join(ROOT, 'tests/data/boreas/boreas_glen_shields.csv');
/** Pictures that the tests leave to be looked at. */
export const OUT = join(ROOT, 'build/console');

const PATIENCE_MILLISECONDS = 120_000;

// The environment without settings of the programs under test.
const environment = Object.fromEntries(
    Object.entries(process.env).filter(([name]) => !/^REVISIT_/.test(name)));

/** Waits until `condition` returns something true, and returns that. */
export async function until(condition, what,
                            milliseconds = PATIENCE_MILLISECONDS) {
  const deadline = Date.now() + milliseconds;
  for (;;) {
    const value = await condition();
    if (value) return value;
    assert.ok(Date.now() < deadline, `no ${what} within ${milliseconds} ms`);
    await sleep(50);
  }
}

/** A port to listen at, below those that Linux gives to connections. */
export async function freePort() {
  for (;;) {
    const port = 20_000 + Math.floor(Math.random() * 12_768);
    const probe = createServer();
    const isFree = await new Promise(done => {
      probe.once('error', () => done(false));
      probe.listen(port, '127.0.0.1', () => done(true));
    });
    await new Promise(done => probe.close(done));
    if (isFree) return port;
  }
}

function ended(child) {
  return child.exitCode !== null || child.signalCode !== null;
}

async function stop(child, signal) {
  if (!child || ended(child)) return;
  child.kill(signal);
  await until(() => ended(child), 'end of a process');
}

export class Revisitd {
  constructor(directory, flags = [], store = join(directory, 'store')) {
    this.directory = directory;
    this.flags = flags;
    this.store = store;
  }

  /** Starts it: the first time at any ports, then at the same ones, which no
   * connection takes meanwhile. */
  async start() {
    this.address ??= `127.0.0.1:${await freePort()}`;
    this.admin ??= `127.0.0.1:${await freePort()}`;
    const portFile = join(this.directory, 'address');
    rmSync(portFile, {force: true});
    this.log = join(this.directory, 'revisitd.log');
    const log = openSync(this.log, 'a');
    this.child = spawn(
        join(BIN, 'revisitd'),
        ['--listen', this.address, '--store', this.store, '--admin-listen',
         this.admin, '--port-file', portFile, ...this.flags],
        {stdio: ['ignore', 'ignore', log], env: environment});
    await until(() => {
      assert.ok(!ended(this.child), `revisitd ended: ${
          readFileSync(this.log, 'utf8').slice(-2000)}`);
      return existsSync(portFile);
    }, 'revisitd that listens');
    /** Where it tells its metrics. */
    this.metrics = `http://${this.admin}/metrics`;
  }

  /** Has it stand still, with its connections open; 'SIGCONT' ends that. */
  signal(name) {
    this.child.kill(name);
  }

  /** The crash: no clean-up of any kind. */
  kill() {
    return stop(this.child, 'SIGKILL');
  }

  close() {
    return stop(this.child, 'SIGTERM');
  }

  /** Runs the command line and returns what it prints. */
  text(...args) {
    const run = spawnSync(join(BIN, 'revisit'),
                          ['--server', this.address, ...args],
                          {encoding: 'utf8', env: environment,
                           maxBuffer: 64 * 1024 * 1024});
    assert.equal(run.status, 0, `revisit ${args.join(' ')}: ${run.stderr}`);
    return run.stdout;
  }

  /** The same, read as JSON if it was asked to print that. */
  cli(...args) {
    const text = this.text(...args);
    return args.includes('--json') ? JSON.parse(text) : text;
  }

  /** Streams the lines of a recording as they are written to `stdin`. */
  openStream(...args) {
    return spawn(join(BIN, 'revisit'),
                 ['--server', this.address, 'stream', '-', ...args],
                 {stdio: ['pipe', 'ignore', 'ignore'], env: environment});
  }
}

/** The console in front of the server at an address, which is asked for when it
 * is started. */
export class Console {
  constructor(address, flags = []) {
    this.address = address;
    this.flags = flags;
  }

  async start() {
    this.child = spawn(
        'node',
        [join(ROOT, 'client/console/dist/server/main.js'), '--listen',
         '127.0.0.1:0', '--server', this.address(), ...this.flags],
        {stdio: ['ignore', 'pipe', 'pipe'], env: environment});
    let said = '';
    this.child.stdout.on('data', data => said += data);
    /** What it has written to its log. */
    this.log = '';
    this.child.stderr.on('data', data => this.log += data);
    const found = await until(() => {
      assert.ok(!ended(this.child), `the console ended: ${this.log}`);
      return /http:\/\/\S+:\d+/.exec(said);
    }, 'console that listens');
    this.url = found[0];
    /** Its admin port, if the flags gave it one. */
    this.admin = /admin listening on (\S+)/.exec(said)?.[1];
  }

  close() {
    return stop(this.child, 'SIGTERM');
  }
}

/** Everything, and the end of everything. */
export class World {
  /** `flags` are those of revisitd, or make them of its directory;
   * `consoleFlags` makes those of the console, once revisitd runs. */
  static async make(flags = [], consoleFlags = () => []) {
    const world = new World();
    world.directory = mkdtempSync(join(tmpdir(), 'revisit-console-'));
    world.revisitd = new Revisitd(
        world.directory,
        typeof flags === 'function' ? flags(world.directory) : flags);
    await world.revisitd.start();
    world.console = new Console(() => world.revisitd.address,
                                consoleFlags(world));
    await world.console.start();
    // There may be no graphics card here: WebGL is drawn in software then.
    world.browser = await chromium.launch({
      executablePath: process.env.CHROMIUM ?? '/usr/bin/chromium',
      args: ['--use-angle=swiftshader', '--enable-unsafe-swiftshader',
             '--ignore-gpu-blocklist',
             // Chromium's own sandbox does not run as root.
             ...process.getuid() === 0 ? ['--no-sandbox'] : []],
    });
    mkdirSync(OUT, {recursive: true});
    return world;
  }

  async close() {
    await this.browser?.close();
    await this.console?.close();
    await this.revisitd?.close();
    rmSync(this.directory, {recursive: true, force: true});
  }

  /** A page whose errors are kept in `page.complaints`. */
  async open(path, {context = {}, ...options} = {}) {
    const page = await (await this.browser.newContext({
      viewport: {width: 1440, height: 900}, ...options, ...context,
    })).newPage();
    page.setDefaultTimeout(PATIENCE_MILLISECONDS);
    page.complaints = [];
    page.on('console', message => {
      // A failed call is shown to the user; the browser notes it besides.
      if (message.type() === 'error' &&
          !/Failed to load resource/.test(message.text())) {
        page.complaints.push(message.text());
      }
    });
    page.on('pageerror', error => page.complaints.push(error.stack));
    await page.goto(this.console.url + path);
    return page;
  }
}

const AXE = readFileSync(
    createRequire(import.meta.url).resolve('axe-core/axe.min.js'), 'utf8');

/** Asserts that the page breaks no rule of axe, fits its width, and nothing was
 * complained about. */
export async function isAccessible(page) {
  // Evaluated by the debugger, which no policy of the page hinders.
  await page.evaluate(AXE);
  const {violations} = await page.evaluate(() => axe.run());
  assert.deepEqual(violations.map(({id, nodes}) => [
    page.url(), page.viewportSize().width, id,
    nodes.map(({html}) => html)]), []);
  assert.ok(await page.evaluate(
      () => document.documentElement.scrollWidth <= innerWidth),
      `${page.url()} is wider than ${page.viewportSize().width} pixels`);
  assert.deepEqual(page.complaints, []);
}

/** The number behind a name in a view's list of facts. */
export async function fact(page, name) {
  const value = page.locator('dl.facts > div', {
    has: page.locator('dt', {hasText: new RegExp(`^${name}$`)}),
  }).locator('dd');
  return await value.count() > 0 ? (await value.textContent()).trim() : '';
}

export async function number(page, name) {
  return Number((await fact(page, name)).replaceAll(',', ''));
}

/** How many pixels of the map on the screen have about this colour. */
export async function pixels(page, property) {
  return (await pixelsOf(page, property)).count;
}

/** How many they are, where the one in the middle of them is, and the least and
 * greatest of their y. */
export async function pixelsOf(page, property) {
  const shot = await page.locator('.map:not(.small) .canvas').screenshot();
  return page.evaluate(async ([base64, name]) => {
    const wanted = getComputedStyle(document.documentElement)
                       .getPropertyValue(name).trim();
    const value = parseInt(wanted.slice(1), 16);
    const colour = [value >> 16, (value >> 8) & 255, value & 255];
    const bytes = Uint8Array.from(atob(base64), c => c.charCodeAt(0));
    const bitmap = await createImageBitmap(new Blob([bytes]));
    const canvas = new OffscreenCanvas(bitmap.width, bitmap.height);
    const context = canvas.getContext('2d');
    context.drawImage(bitmap, 0, 0);
    const {data} = context.getImageData(0, 0, bitmap.width, bitmap.height);
    const found = [];
    for (let i = 0; i < data.length; i += 4) {
      const far = Math.abs(data[i] - colour[0]) +
          Math.abs(data[i + 1] - colour[1]) + Math.abs(data[i + 2] - colour[2]);
      if (far < 30) found.push(i / 4);
    }
    const middle = found[found.length >> 1] ?? 0;
    const row = i => Math.floor(i / bitmap.width);
    return {count: found.length, x: middle % bitmap.width, y: row(middle),
            top: row(found[0] ?? 0), bottom: row(found.at(-1) ?? 0)};
  }, [shot.toString('base64'), property]);
}

/** Red, green and blue of these points of the map on the screen. */
export async function coloursAt(page, points) {
  const shot = await page.locator('.map:not(.small) .canvas').screenshot();
  return page.evaluate(async ([base64, wanted]) => {
    const bytes = Uint8Array.from(atob(base64), c => c.charCodeAt(0));
    const bitmap = await createImageBitmap(new Blob([bytes]));
    const canvas = new OffscreenCanvas(bitmap.width, bitmap.height);
    const context = canvas.getContext('2d');
    context.drawImage(bitmap, 0, 0);
    return wanted.map(([x, y]) => [...context.getImageData(
        Math.round(x), Math.round(y), 1, 1).data].slice(0, 3));
  }, [shot.toString('base64'), points]);
}

/** The exports of a module of the console, and of what is named besides. */
export async function load(path, more = '') {
  const folder = join(ROOT, 'client/console');
  const {buildSync} = createRequire(join(folder, 'web/main.tsx'))('esbuild');
  const {outputFiles: [{text}]} = buildSync({
    stdin: {contents: `export * from './${path}';${more}`, resolveDir: folder},
    bundle: true, write: false, format: 'esm',
  });
  return import(`data:text/javascript,${encodeURIComponent(text)}`);
}

/** A recording as GPX: half a minute northwards from each of these latitudes and
 * longitudes. */
export function track(...starts) {
  const points = starts.flatMap(([latitude, longitude], part) =>
      Array.from({length: 30}, (_, i) => {
        const time = new Date(Date.UTC(2026) + 1000 * (40 * part + i));
        return `<trkpt lat="${latitude + 5e-5 * i}" lon="${longitude}">` +
            `<ele>40</ele><time>${time.toISOString()}</time></trkpt>`;
      }));
  return '<?xml version="1.0"?>\n<gpx version="1.1" creator="test" ' +
      'xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>\n' +
      points.join('\n') + '\n</trkseg></trk></gpx>\n';
}

/** The second day of the shipped drive begins behind this time. */
const SECOND_DAY = 2e6;

/** Files of both days of the shipped drive, each in a frame of its own. */
export function writeDays(directory) {
  const rows = readFileSync(DRIVE, 'utf8').trim().split('\n')
                   .map(line => line.split(','));
  const [head, ...poses] = rows.map(
      row => [row[1], row[5], row[6], row[7]]);
  const days = [poses.filter(([t]) => Number(t) < SECOND_DAY),
                poses.filter(([t]) => Number(t) >= SECOND_DAY)];
  const [, x0, y0] = days[1][0].map(Number);
  const moved = days[1].map(
      ([t, x, y, yaw]) => [t, Number(x) - x0, Number(y) - y0, yaw]);
  return [days[0], moved].map((day, i) => {
    const file = join(directory, `day-${i}.csv`);
    writeFileSync(file, [head, ...day].map(row => row.join()).join('\n') +
        '\n');
    return file;
  });
}

const ISSUER = 'https://login.example';
const AUDIENCE = 'revisit';

/** A key that signs tokens, and the flags of a server that believes it. */
export class Issuer {
  constructor() {
    const {publicKey, privateKey} = generateKeyPairSync('ed25519');
    this.privateKey = privateKey;
    this.jwk = {...publicKey.export({format: 'jwk'}), kid: 'one', use: 'sig',
                alg: 'EdDSA'};
  }

  flags(directory, policy) {
    const keys = join(directory, 'keys.json');
    const rules = join(directory, 'policy.json');
    writeFileSync(keys, JSON.stringify({keys: [this.jwk]}));
    writeFileSync(rules, JSON.stringify(policy));
    return ['--token-keys', keys, '--token-issuer', ISSUER,
            '--token-audience', AUDIENCE, '--policy', rules];
  }

  token(subject) {
    const part = value =>
        Buffer.from(JSON.stringify(value)).toString('base64url');
    const signed = `${part({alg: 'EdDSA', kid: 'one'})}.${part({
      iss: ISSUER, aud: AUDIENCE, sub: subject,
      exp: Math.floor(Date.now() / 1000) + 3600,
    })}`;
    const signature = sign(null, Buffer.from(signed), this.privateKey);
    return `${signed}.${signature.toString('base64url')}`;
  }
}
