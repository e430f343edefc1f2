// A server that asks who calls: each sees what its policy grants.
import assert from 'node:assert/strict';
import {writeFileSync} from 'node:fs';
import {join} from 'node:path';
import {after, before, test} from 'node:test';

import {DRIVE, Issuer, World} from './world.mjs';

const POLICY = {
  version: 1,
  tenants: [{name: 'acme', vehicle_prefix: 'acme-'},
            {name: 'umbra', vehicle_prefix: 'umbra-'}],
  grants: [
    {token_subject: 'operator', tenant: '*', vehicles: ['*'],
     verbs: ['read', 'write', 'admin']},
    {token_subject: 'acme', tenant: 'acme', vehicles: ['*'],
     verbs: ['read']},
    {token_subject: 'acme-verifier', tenant: 'acme', vehicles: ['*'],
     verbs: ['read', 'write']},
    {token_subject: 'umbra', tenant: 'umbra', vehicles: ['*'],
     verbs: ['read']},
  ],
};

const issuer = new Issuer();
let world;

before(async () => {
  world = await World.make(directory => issuer.flags(directory, POLICY),
                           ({revisitd}) => ['--metrics', revisitd.metrics]);
  const file = join(world.directory, 'token');
  writeFileSync(file, issuer.token('operator'));
  const operator = (...args) =>
      world.revisitd.cli('--token-file', file, ...args);
  operator('stream', DRIVE, '--create', '--vehicle', 'acme-1',
           '--uncertainty', 'file');
  operator('vehicle', 'create', 'umbra-1');
});
after(() => world?.close());

async function signIn(page, token) {
  await page.locator('.sign-in summary').click();
  await page.getByLabel('Bearer token').fill(token);
  await page.getByRole('button', {name: 'Use'}).click();
}

function vehicles(page) {
  return page.locator('tbody a').allInnerTexts();
}

test('without a token it says so and shows nothing', async () => {
  const page = await world.open('/');
  await page.getByText('revisitd asks who you are').waitFor();
  assert.deepEqual(await vehicles(page), []);
  await page.context().close();
});

test('a pasted token shows the vehicles of its tenant only', async () => {
  const page = await world.open('/');
  await signIn(page, `Bearer ${issuer.token('acme')}`);
  await page.getByText('1 of 1 vehicles').waitFor();
  assert.deepEqual(await vehicles(page), ['acme-1']);
  assert.equal(await page.getByText('revisitd asks who you are').count(), 0);
  // It stays for the tab, and leaves nothing that goes anywhere by itself.
  await page.reload();
  await page.getByText('1 of 1 vehicles').waitFor();
  assert.deepEqual(await page.context().cookies(), []);
  await page.goto(world.console.url + '/vehicles/umbra-1');
  await page.locator('main .error', {hasText: 'not found'}).waitFor();
  assert.equal(await page.locator('.map').count(), 0);
  await page.context().close();
});

test('another token shows another tenant, and none nothing', async () => {
  const page = await world.open('/');
  await signIn(page, issuer.token('acme'));
  await page.getByText('1 of 1 vehicles').waitFor();
  await signIn(page, issuer.token('umbra'));
  await page.locator('tbody a', {hasText: 'umbra-1'}).waitFor();
  assert.deepEqual(await vehicles(page), ['umbra-1']);
  await page.locator('.sign-in summary').click();
  await page.getByRole('button', {name: 'Sign out'}).click();
  await page.getByText('revisitd asks who you are').waitFor();
  assert.deepEqual(await vehicles(page), []);
  await page.context().close();
});

test('the header of a proxy in front is passed on', async () => {
  const page = await world.open('/', {
    extraHTTPHeaders: {authorization: `Bearer ${issuer.token('umbra')}`},
  });
  await page.getByText('1 of 1 vehicles').waitFor();
  assert.deepEqual(await vehicles(page), ['umbra-1']);
  await page.context().close();
});

test('who may only read is told so when he decides', async () => {
  const page = await world.open('/');
  await signIn(page, issuer.token('acme'));
  await page.getByText('1 of 1 vehicles').waitFor();
  await page.goto(world.console.url + '/vehicles/acme-1');
  await page.locator('.side tbody a').first().click();
  await page.locator('.evidence').waitFor();
  await page.getByRole('button', {name: 'Confirm'}).click();
  await page.locator('.decision', {hasText: 'permission denied'}).waitFor();
  assert.deepEqual(page.complaints, []);
  await page.context().close();
});

test('a decision says who made it, to whoever may read it', async () => {
  const page = await world.open('/');
  await signIn(page, issuer.token('acme-verifier'));
  await page.getByText('1 of 1 vehicles').waitFor();
  await page.goto(world.console.url + '/vehicles/acme-1');
  await page.locator('.side tbody a').first().click();
  await page.locator('.evidence').waitFor();
  await page.getByRole('button', {name: 'Confirm'}).click();
  await page.locator('.state-line', {
    hasText: /confirmed, .* by token:acme-verifier/}).waitFor();
  await signIn(page, issuer.token('acme'));
  await page.goto(world.console.url + '/vehicles/acme-1');
  const row = page.getByRole('table', {name: 'Decisions'})
                  .locator('tbody tr', {hasText: 'confirmed'});
  await row.getByRole('cell', {name: 'token:acme-verifier'}).waitFor();
  assert.deepEqual(page.complaints, []);
  await page.context().close();
});

test('who may read is told who undid a decision', async () => {
  const page = await world.open('/');
  await signIn(page, issuer.token('acme-verifier'));
  await page.getByText('1 of 1 vehicles').waitFor();
  await page.goto(world.console.url + '/vehicles/acme-1');
  await page.getByRole('link', {name: /^confirmed/}).click();
  await page.locator('.state-line', {hasText: 'confirmed'}).waitFor();
  await page.getByRole('button', {name: 'Undo'}).click();
  await page.locator('.decision > [role=status]', {hasText: 'Undone: confirmed'})
      .waitFor();
  await signIn(page, issuer.token('acme'));
  await page.goto(world.console.url + '/vehicles/acme-1');
  await page.locator('.undone summary').click();
  const cells = page.getByRole('table', {name: 'Undone decisions'})
      .locator('tbody td');
  await cells.first().waitFor();
  const texts = await cells.allInnerTexts();
  assert.deepEqual([texts[2], texts[4], texts[6]],
                   ['confirmed', 'token:acme-verifier', 'token:acme-verifier']);
  assert.deepEqual(page.complaints, []);
  await page.context().close();
});

test('metrics are for those of no tenant, and others are told so', async () => {
  const page = await world.open('/server');
  await signIn(page, issuer.token('operator'));
  await page.locator('.columns meter').first().waitFor();
  await page.locator('dt', {hasText: 'Nodes in memory'}).waitFor();
  await signIn(page, issuer.token('acme'));
  await page.getByText('this caller belongs to a tenant').waitFor();
  await page.locator('dt', {hasText: 'Durability'}).waitFor();
  assert.equal(await page.locator('.columns').count(), 0);
  assert.equal(await page.getByText('in memory', {exact: false})
                   .and(page.locator('dt')).count(), 0);
  assert.deepEqual(page.complaints, []);
  await page.context().close();
});
