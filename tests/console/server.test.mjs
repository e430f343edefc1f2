// The console's server by itself: how it starts, and how it reaches revisitd.
import assert from 'node:assert/strict';
import {spawnSync} from 'node:child_process';
import {mkdtempSync, rmSync} from 'node:fs';
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

test('wrong usage is refused with 64 and says what is allowed', () => {
  for (const [args, message] of [
    [['--listen', '0.0.0.0:8080'], /beyond the loopback/],
    [['--listen', '8080'], /not ADDRESS:PORT/],
    [['--server', 'nowhere'], /not ADDRESS:PORT/],
    [['--server', '127.0.0.1:99999'], /not ADDRESS:PORT/],
    [['--colour', 'red'], /colour/],
  ]) {
    const {status, stderr} = start(...args);
    assert.equal(status, 64, stderr);
    assert.match(stderr, message);
    assert.match(stderr, /usage:/);
  }
  assert.match(start('--help').stdout, /^usage:/);
});

test('a certificate authority that cannot be read is named', () => {
  const {status, stderr} = start('--tls-ca', join(directory, 'missing.pem'));
  assert.equal(status, 1);
  assert.match(stderr, /missing\.pem/);
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
