// Signing in at an issuer of OpenID Connect whose tokens revisitd checks.
import assert from 'node:assert/strict';
import {writeFileSync} from 'node:fs';
import {join} from 'node:path';
import {after, before, test} from 'node:test';
import {setTimeout as sleep} from 'node:timers/promises';

import {OpenIdIssuer} from './issuer.mjs';
import {Console, freePort, isAccessible, until, World} from './world.mjs';

const LIST = '/revisit.v1.PoseGraphService/ListVehicles';
const POLICY = {
  version: 1,
  tenants: [],
  grants: [{token_subject: 'alice', tenant: '*', vehicles: ['*'],
            verbs: ['read', 'write']}],
};

let issuer;
let world;

before(async () => {
  const base = `http://127.0.0.1:${await freePort()}`;
  issuer = await OpenIdIssuer.make(base);
  let files = 0;
  world = await World.make(directory => issuer.serverFlags(content => {
    const path = join(directory, `file-${++files}.json`);
    writeFileSync(path, JSON.stringify(content));
    return path;
  }, POLICY), () => ['--listen', new URL(base).host, ...issuer.consoleFlags(),
                     '--admin-listen', '127.0.0.1:0']);
  assert.equal(world.console.url, base);
});
after(async () => {
  await world?.close();
  await issuer?.stop();
});

/** Goes through the issuer's own pages. */
async function signInAs(page, name) {
  await page.locator('input[name=login]').fill(name);
  await page.locator('input[name=password]').fill('anything');
  await page.getByRole('button').click();
  await page.getByRole('button', {name: 'Continue'}).click();
}

/** A page of somebody who is signed in. */
async function openAs(name, path = '/') {
  const page = await world.open(path);
  await page.getByRole('alert').getByRole('link', {name: 'sign in'}).click();
  await signInAs(page, name);
  await page.waitForURL(world.console.url + path);
  return page;
}

/** The status of a call with the page's cookies and these headers. */
async function statusOf(page, headers) {
  const answer = await page.context().request.post(
      world.console.url + LIST,
      {headers: {'content-type': 'application/json', ...headers}, data: '{}'});
  return answer.status();
}

const FROM_PAGE = {'sec-fetch-site': 'same-origin'};

test('somebody who signs in sees what the policy grants, and the view they ' +
     'wanted', async () => {
  const page = await openAs('alice', '/server?x=1');
  await page.goto(world.console.url);
  await page.getByText('0 of 0 vehicles').waitFor();
  await page.locator('.sign-in summary').click();
  // The issuer's words are text.
  await page.getByText('Signed in as alice & <b>co</b>.').waitFor();
  await isAccessible(page);
  await page.context().close();
});

test('the browser holds a secret that scripts cannot read, and no token',
     async () => {
  const page = await openAs('alice');
  const cookies = (await page.context().cookies(world.console.url))
      .filter(({name}) => name.startsWith('revisit'));
  assert.deepEqual(cookies.map(
      ({name, httpOnly, sameSite, path}) => [name, httpOnly, sameSite, path]),
                   [['revisit-session', true, 'Lax', '/']]);
  assert.match(cookies[0].value, /^[\w-]{43}$/);
  assert.equal(await page.evaluate(() => document.cookie), '');
  assert.equal(await page.evaluate(() => sessionStorage.length), 0);
  await page.context().close();
});

test('whom the policy does not know is told so, and can sign out', async () => {
  const page = await world.open('/');
  await page.getByRole('alert').getByRole('link', {name: 'sign in'}).click();
  await signInAs(page, 'mallory');
  await page.waitForURL(`${world.console.url}/`);
  await page.locator('.sign-in summary').click();
  await page.getByText('Signed in as mallory').waitFor();
  assert.equal(await statusOf(page, FROM_PAGE), 403);
  await page.getByRole('button', {name: 'Sign out there'}).click();
  // The issuer asks whether that is meant for all of its sites.
  await page.getByRole('button', {name: /Yes/}).click();
  await page.waitForURL(`${world.console.url}/`);
  await page.getByRole('alert').getByRole('link', {name: 'sign in'}).waitFor();
  assert.equal(await statusOf(page, FROM_PAGE), 401);
  await page.context().close();
});

test('another site cannot make calls or sign people out with their session',
     async () => {
  const page = await openAs('alice');
  assert.equal(await statusOf(page, FROM_PAGE), 200);
  for (const headers of [{}, {origin: 'https://evil.example'},
                         {origin: 'null'}]) {
    assert.equal(await statusOf(page, headers), 401, JSON.stringify(headers));
  }
  for (const site of ['cross-site', 'same-site', 'none']) {
    assert.equal(await statusOf(page, {'sec-fetch-site': site}), 403, site);
  }
  // A browser that says no more than an old one does.
  assert.equal(await statusOf(page, {origin: world.console.url}), 200);
  const {request} = page.context();
  for (const [method, headers] of [['get', {}], ['post', {}],
                                   ['post', {origin: 'https://evil.example'}]]) {
    const answer = await request[method](`${world.console.url}/sign-out`,
                                         {headers});
    assert.equal(answer.status(), 405);
  }
  assert.equal(await statusOf(page, FROM_PAGE), 200);
  await page.context().close();
});

test('an answer of the issuer is taken from the browser that asked for it, once',
     async () => {
  const page = await world.open('/');
  await page.getByRole('alert').getByRole('link', {name: 'sign in'}).click();
  await page.locator('input[name=login]').fill('alice');
  await page.locator('input[name=password]').fill('anything');
  await page.getByRole('button').click();
  await page.getByRole('button', {name: 'Continue'}).waitFor();
  // The last steps by hand, so that the console does not get the answer.
  const {request} = page.context();
  const agreed = await request.post(
      await page.locator('form').getAttribute('action'),
      {form: {prompt: 'consent'}, maxRedirects: 0});
  const sent = await request.get(agreed.headers().location, {maxRedirects: 0});
  const answer = sent.headers().location;
  assert.ok(answer.startsWith(`${world.console.url}/signed-in?`), answer);
  // Somebody else's browser.
  const other = await fetch(answer, {redirect: 'manual'});
  assert.equal(other.status, 400);
  assert.match(await other.text(), /this browser has not begun to sign in/);
  // An answer to another question.
  const forged = answer.replace(/state=[^&]+/, 'state=forged');
  const cookies = (await page.context().cookies())
      .map(({name, value}) => `${name}=${value}`).join('; ');
  const wrong = await fetch(forged, {redirect: 'manual', headers: {
    cookie: cookies}});
  assert.equal(wrong.status, 400);
  assert.doesNotMatch(wrong.headers.get('set-cookie'), /revisit-session=/);
  const taken = await fetch(answer, {redirect: 'manual', headers: {
    cookie: cookies}});
  assert.equal(taken.status, 303);
  const again = await fetch(answer, {redirect: 'manual', headers: {
    cookie: cookies}});
  assert.equal(again.status, 400);
  assert.match(await again.text(), /invalid_grant/);
  await page.context().close();
});

test('nobody is led to another site', async () => {
  for (const to of ['https://evil.example/', '//evil.example', '/\\evil.example',
                    '/sign-out', 'javascript:alert(1)']) {
    const page = await world.open(`/sign-in?to=${encodeURIComponent(to)}`);
    await signInAs(page, 'alice');
    await page.waitForURL(`${world.console.url}/`);
    await page.context().close();
  }
});

test('people who say no to the issuer are told what came of it', async () => {
  const page = await world.open('/sign-in');
  await page.getByRole('link', {name: /Cancel/}).click();
  await page.getByRole('heading', {name: 'Not signed in'}).waitFor();
  await page.getByText('access_denied').waitFor();
  await page.getByRole('link', {name: 'Try again'}).click();
  await page.locator('input[name=login]').waitFor();
  assert.match(world.console.log, /sign_in_failed request_id=[0-9a-f]{16}/);
  const metrics = await (await fetch(
      `http://${world.console.admin}/metrics`)).text();
  assert.match(metrics, /revisit_console_sign_ins_total\{result="failed"\} [1-9]/);
  assert.match(metrics, /revisit_console_sign_ins_total\{result="ok"\} [1-9]/);
  assert.match(metrics, /revisit_console_sessions [1-9]/);
  await page.context().close();
});

test('a name that is not the public one leads to that first', async () => {
  const {port} = new URL(world.console.url);
  const answer = await fetch(`http://localhost:${port}/sign-in?to=/server`,
                             {redirect: 'manual'});
  assert.equal(answer.status, 303);
  assert.equal(answer.headers.get('location'),
               `${world.console.url}/sign-in?to=%2Fserver`);
});

test('tokens are renewed while people work, once for all calls',
     async () => {
  issuer.lifetime = 32;
  const page = await openAs('alice');
  issuer.lifetime = 600;
  const before = issuer.given;
  // Away from the page, which asks by itself.
  await page.goto('about:blank');
  // Half a minute before its end a token is renewed, once for all calls.
  await sleep(3000);
  const statuses = await Promise.all(Array.from(
      {length: 8}, () => statusOf(page, FROM_PAGE)));
  assert.deepEqual([...new Set(statuses)], [200]);
  await until(() => issuer.given === before + 1, 'renewal');
  await sleep(500);
  assert.equal(issuer.given, before + 1);
  await page.context().close();
});

test('a session ends when the issuer does not know it any more', async () => {
  // So short that each call renews it.
  issuer.lifetime = 20;
  const page = await openAs('alice');
  await issuer.stop();
  // The issuer is away, and the token still good.
  assert.equal(await statusOf(page, FROM_PAGE), 200);
  await issuer.start();
  assert.equal(await statusOf(page, FROM_PAGE), 200);
  await issuer.forget();
  await until(async () => await statusOf(page, FROM_PAGE) === 401,
              'end of the session', 45_000);
  await page.getByRole('alert').getByRole('link', {name: 'sign in'}).waitFor();
  issuer.lifetime = 600;
  await page.context().close();
});

test('behind TLS the cookies are secure', async () => {
  const hidden = new Console(
      () => world.revisitd.address,
      ['--public-url', 'https://console.example', ...issuer.consoleFlags()]);
  await hidden.start();
  try {
    const {port} = new URL(hidden.url);
    const {get} = await import('node:http');
    const headers = await new Promise((done, fail) => get(
        {host: '127.0.0.1', port, path: '/sign-in',
         headers: {host: 'console.example'}},
        answer => done(answer.headers)).on('error', fail));
    const [cookie] = headers['set-cookie'];
    assert.match(cookie, /^__Host-revisit-sign-in=.*; Path=\/; HttpOnly; SameSite=Lax; Secure; Max-Age=600$/);
    const to = new URL(headers.location);
    assert.equal(to.searchParams.get('redirect_uri'),
                 'https://console.example/signed-in');
    assert.equal(to.searchParams.get('code_challenge_method'), 'S256');
    assert.ok(to.searchParams.get('nonce'));
  } finally {
    await hidden.close();
  }
});

test('an issuer that is away is told, and found once it is there', async () => {
  await issuer.stop();
  const late = new Console(() => world.revisitd.address, issuer.consoleFlags());
  await late.start();
  try {
    const refused = await fetch(`${late.url}/sign-in`, {redirect: 'manual'});
    assert.equal(refused.status, 400);
    assert.match(await refused.text(), /ECONNREFUSED/);
    await issuer.start();
    const found = await fetch(`${late.url}/sign-in`, {redirect: 'manual'});
    assert.equal(found.status, 303);
    assert.ok(found.headers.get('location').startsWith(issuer.url));
  } finally {
    await late.close();
  }
});
