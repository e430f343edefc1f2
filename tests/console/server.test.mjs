// The console's server by itself: how it starts, and how it reaches revisitd.
import assert from 'node:assert/strict';
import {spawnSync} from 'node:child_process';
import {mkdtempSync, rmSync, writeFileSync} from 'node:fs';
import {get} from 'node:http';
import {tmpdir} from 'node:os';
import {join} from 'node:path';
import {after, before, test} from 'node:test';

import {Console, Revisitd, ROOT} from './world.mjs';

let directory;

before(() => {
  directory = mkdtempSync(join(tmpdir(), 'revisit-console-'));
});
after(() => rmSync(directory, {recursive: true, force: true}));

function start(...args) {
  return spawnSync('node', [join(ROOT, 'client/console/dist/server/main.js'),
                            ...args], {encoding: 'utf8', timeout: 30_000});
}

/** The status of an answer to a request for this host. */
function statusUnder(port, host) {
  return new Promise((done, fail) => get(
      {port, host: '127.0.0.1', headers: {host}}, answer => {
        answer.resume();
        done(answer.statusCode);
      }).on('error', fail));
}

test('wrong usage is refused with 64 and says what is allowed', () => {
  for (const [args, message] of [
    [['--listen', '0.0.0.0:8080'], /beyond the loopback/],
    [['--listen', '8080'], /not ADDRESS:PORT/],
    [['--server', 'nowhere'], /not ADDRESS:PORT/],
    [['--server', '127.0.0.1:99999'], /not ADDRESS:PORT/],
    [['--server', '127.0.0.1:1', '--server', 'nowhere'], /not ADDRESS:PORT/],
    [['--metrics', 'nowhere'], /--metrics is 'nowhere'/],
    [['--metrics', 'file:///etc/passwd'], /--metrics is 'file:/],
    [['--metrics', 'http://a:b@127.0.0.1/metrics'], /--metrics is/],
    [['--metrics', 'a=b'], /--metrics is 'a=b', not an address/],
    [['--metrics', '=http://127.0.0.1:1/metrics'], /NAME has to be/],
    [['--metrics', 'a b=http://127.0.0.1:1/metrics'], /NAME has to be/],
    [['--metrics', `${'n'.repeat(64)}=http://127.0.0.1:1/`], /NAME has to be/],
    [['--metrics', 'http://127.0.0.1:1/metrics', '--metrics',
      'a=http://127.0.0.1:1/metrics'],
     /--metrics names http:\/\/127\.0\.0\.1:1\/metrics twice/],
    [['--metrics', 'a=http://127.0.0.1:1/metrics', '--metrics',
      'a=http://127.0.0.1:2/metrics'], /--metrics calls both .* 'a'/],
    [['--metrics', 'http://127.0.0.1:1/x', '--metrics',
      'http://127.0.0.1:1/y'], /--metrics calls both .* '127\.0\.0\.1:1'/],
    [['--max-metadata-bytes', '100'], /--max-metadata-bytes is '100'/],
    [['--admin-listen', '9465'], /--admin-listen is '9465', not ADDRESS/],
    [['--public-url', 'http://console.example'], /not an address of https/],
    [['--public-url', 'https://console.example/a'], /the root of a host/],
    [['--oidc-client-id', 'a'], /--oidc-client-id needs --oidc-issuer/],
    [['--oidc-issuer', 'https://login.example'], /needs --oidc-client-id/],
    [['--oidc-issuer', 'http://login.example', '--oidc-client-id', 'a'],
     /--oidc-issuer is .*, not an address of https/],
    [['--oidc-issuer', 'https://login.example', '--oidc-client-id', 'a',
      '--oidc-scopes', 'profile'], /without openid/],
    [['--oidc-issuer', 'https://login.example', '--oidc-client-id', 'a',
      '--oidc-token', 'refresh'], /allowed are access, id/],
    [['--oidc-issuer', 'https://login.example', '--oidc-client-id', 'a',
      '--listen', '0.0.0.0:8080', '--insecure-allow-remote'],
     /needs --public-url/],
    [['--log-format', 'xml'], /allowed are text, json/],
    [['--log-level', 'loud'], /allowed are debug, info/],
    [['--link', 'https://host/{vehicle}'], /it is not NAME=TEMPLATE/],
    [['--link', 'a=javascript:alert({pose_a})'], /it has to begin with/],
    [['--link', 'a=ftp://host/'], /neither http nor https/],
    [['--link', 'a=https://host/{pose_c}'], /\{pose_c\} is none of/],
    [['--colour', 'red'], /colour/],
  ]) {
    const {status, stderr} = start(...args);
    assert.equal(status, 64, stderr);
    assert.match(stderr, message);
    assert.match(stderr, /usage:/);
  }
  assert.match(start('--help').stdout, /^usage:/);
});

test('options in a file count after those of the command line', async () => {
  const file = join(directory, 'console.conf');
  writeFileSync(file, '# A comment.\n\nlisten = "127.0.0.1:1"\n' +
      'log-format = json  # And one more.\nhost = "a.example"\n' +
      'host = "b.example"\ninsecure-allow-remote = off\n');
  const console = new Console(() => '127.0.0.1:1', ['--config', file]);
  await console.start();
  try {
    const {port} = new URL(console.url);
    for (const [host, status] of [['a.example', 200], ['b.example', 200],
                                  ['c.example', 403]]) {
      assert.equal(await statusUnder(port, host), status, host);
    }
  } finally {
    await console.close();
  }
  assert.match(console.log, /^\{"time":".*"event":"stopping"/m);
});

test('a line of a file that is no option is named', () => {
  const file = join(directory, 'wrong.conf');
  for (const line of ['colour = "red"', 'listen', 'config = "a"',
                      'insecure-allow-remote = "yes"', 'listen = "a" b']) {
    writeFileSync(file, `# First.\n${line}\n`);
    const {status, stderr} = start('--config', file);
    assert.equal(status, 64, line);
    assert.match(stderr, /wrong\.conf:2: /);
  }
});

test('a certificate authority that cannot be read is named', () => {
  const {status, stderr} = start('--tls-ca', join(directory, 'missing.pem'));
  assert.equal(status, 1);
  assert.match(stderr, /missing\.pem/);
});

test('a base map that is none is named', () => {
  const path = join(directory, 'other.pmtiles');
  writeFileSync(path, 'PMTiles\x02 and more');
  for (const [file, message] of [
    [join(directory, 'missing.pmtiles'), /missing\.pmtiles/],
    [path, /other\.pmtiles is no PMTiles archive of version 3/],
  ]) {
    const {status, stderr} = start('--base-map', file);
    assert.equal(status, 1);
    assert.match(stderr, message);
  }
});

test('a base map is served in parts', async () => {
  const path = join(directory, 'base map.pmtiles');
  const content = Buffer.from('PMTiles\x03' + '0123456789'.repeat(100));
  writeFileSync(path, content);
  const console = new Console(() => '127.0.0.1:1', ['--base-map', path]);
  await console.start();
  const ask = async (headers = {}, method = 'GET') => {
    const answer = await fetch(`${console.url}/base-map.pmtiles`,
                               {method, headers});
    return {status: answer.status, headers: answer.headers,
            text: await answer.text()};
  };
  try {
    const whole = await ask();
    assert.equal(whole.status, 200);
    assert.equal(whole.text, content.toString());
    assert.equal(whole.headers.get('accept-ranges'), 'bytes');
    assert.match(whole.headers.get('content-security-policy'), /'none'/);
    const tag = whole.headers.get('etag');
    assert.match(tag, /^"/);
    for (const [range, from, to] of [['bytes=0-7', 0, 8],
                                     ['bytes=8-', 8, 1008],
                                     ['bytes=-10', 998, 1008],
                                     ['bytes=1000-5000', 1000, 1008]]) {
      const part = await ask({range});
      assert.equal(part.status, 206, range);
      assert.equal(part.text, content.subarray(from, to).toString());
      assert.equal(part.headers.get('content-range'),
                   `bytes ${from}-${to - 1}/1008`);
      assert.equal(part.headers.get('etag'), tag);
    }
    const beyond = await ask({range: 'bytes=2000-3000'});
    assert.equal(beyond.status, 416);
    assert.equal(beyond.headers.get('content-range'), 'bytes */1008');
    // Without a word on caches, fetch adds that none is to be used.
    assert.equal((await ask({'if-none-match': tag,
                             'cache-control': 'max-age=0'})).status, 304);
    assert.equal((await ask({range: 'bytes=0-1', 'if-range': tag})).status,
                 206);
    const head = await ask({}, 'HEAD');
    assert.equal(head.headers.get('content-length'), '1008');
    assert.equal(head.text, '');
    assert.equal((await ask({}, 'POST')).status, 405);
    // Another file in its place has another tag, and parts of the one that was
    // meant are not mixed with its.
    writeFileSync(path, Buffer.concat([content, content]));
    const mixed = await ask({range: 'bytes=0-1', 'if-range': tag});
    assert.equal(mixed.status, 200);
    assert.notEqual(mixed.headers.get('etag'), tag);
    rmSync(path);
    assert.equal((await ask()).status, 404);
  } finally {
    await console.close();
  }
});

test('there is no base map unless one is given', async () => {
  const console = new Console(() => '127.0.0.1:1');
  await console.start();
  try {
    assert.equal((await fetch(`${console.url}/base-map.pmtiles`)).status, 404);
    assert.deepEqual(await (await fetch(`${console.url}/console.json`)).json(),
                     {metrics: false, baseMap: false, links: [],
                      signIn: false});
  } finally {
    await console.close();
  }
});

/** Code and message with which a call through the console ends. */
async function askVersion(console) {
  const answer = await fetch(
      `${console.url}/revisit.v1.PoseGraphService/GetServerInfo`,
      {method: 'POST', headers: {'content-type': 'application/json'},
       body: '{}'});
  return answer.json();
}

test('revisitd is reached by TLS, if its authority is known', async t => {
  const key = join(directory, 'key.pem');
  const certificate = join(directory, 'certificate.pem');
  const made = spawnSync('openssl', [
    'req', '-x509', '-newkey', 'ec', '-pkeyopt', 'ec_paramgen_curve:P-256',
    '-nodes', '-days', '2', '-subj', '/CN=test', '-addext',
    'subjectAltName=IP:127.0.0.1', '-keyout', key, '-out', certificate,
  ]);
  if (made.error) {
    t.skip('no openssl here');
    return;
  }
  const revisitd = new Revisitd(
      directory, ['--tls-cert', certificate, '--tls-key', key]);
  const known =
      new Console(() => revisitd.address, ['--tls-ca', certificate]);
  const plain = new Console(() => revisitd.address);
  try {
    await revisitd.start();
    await known.start();
    assert.ok((await askVersion(known)).version);
    await plain.start();
    assert.equal((await askVersion(plain)).code, 'unavailable');
  } finally {
    await plain.close();
    await known.close();
    await revisitd.close();
  }
});
