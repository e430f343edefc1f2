// A person decides by keyboard over a slow network, and reloads now and then: each
// decision, note and undo has to be about the pair that it was meant for.
import assert from 'node:assert/strict';
import {after, before, test} from 'node:test';

import {DRIVE, isAccessible, until, World} from './world.mjs';

const DECISIONS = 50;
const RELOAD_EVERY = 9;
const SLOW = {offline: false, latency: 250, downloadThroughput: 600_000,
              uploadThroughput: 200_000};

let world;
let page;

before(async () => {
  world = await World.make();
  world.revisitd.cli('stream', DRIVE, '--create', '--vehicle', 'boreas',
                     '--uncertainty', 'file');
  page = await world.open('/vehicles/boreas');
  const network = await page.context().newCDPSession(page);
  await network.send('Network.enable');
  await network.send('Network.emulateNetworkConditions', SLOW);
});
after(() => world?.close());

/** Numbers from 0 to 1, the same in each run. */
function* numbers() {
  for (let state = 7;;) {
    state = (state * 1103515245 + 12345) % 2147483648;
    yield state / 2147483648;
  }
}
const random = numbers();
const chance = part => random.next().value < part;

const textOf = pair => pair.map(n => n.toLocaleString('en')).join('–');

/** The pair that is shown, by the label of its note. */
async function shownPair() {
  const label = await page.locator('.decision > label').innerText();
  return /about ([\d,]+)–([\d,]+)/.exec(label).slice(1)
      .map(text => Number(text.replaceAll(',', '')));
}

const noteField = () => page.locator('.decision input[name=note]');

async function write(note) {
  await page.keyboard.press('n');
  await page.keyboard.type(note);
  await page.keyboard.press('Escape');
}

/** Goes on to another pair about which nobody has decided. */
async function next(before) {
  await until(async () => {
    await page.keyboard.press('j');
    return textOf(await shownPair()) !== textOf(before);
  }, 'another pair');
}

const isQuiet = () => until(async () => !(await page.locator('.deeds')
    .textContent().catch(() => '')).includes('no answer yet'), 'answers');

async function reload() {
  await page.reload();
  await page.locator('.decision').waitFor();
  await page.getByText(/[1-9]\d* accepted candidates are open/).waitFor();
}

/** Asserts that no outcome of another pair is told at the one that is shown. */
async function tellsOnlyOfItself() {
  const told = await page.locator('.decision > [role=status]').innerText();
  const name = textOf(await shownPair());
  assert.ok(told === '' || told.includes(name), `${told} at ${name}`);
}

function stored() {
  const {revisitd} = world;
  const closures = revisitd.cli('closures', 'list', 'boreas', '--json')
                       .loopClosures ?? [];
  const rejections = revisitd.cli('rejections', 'list', 'boreas', '--json')
                         .rejectedCandidates ?? [];
  const row = kind => ({querySequence, matchedSequence, note}) => `${
      textOf([Number(querySequence), Number(matchedSequence)])} ${kind}: ${
      note ?? ''}`;
  return [...closures.map(row('c')), ...rejections.map(row('r'))].sort();
}

test('fifty decisions by keyboard are each on the pair they were meant for',
     async () => {
  await page.locator('a.button', {hasText: 'Review'}).waitFor();
  await page.keyboard.press('j');
  await page.locator('.decision').waitFor();
  await page.getByText(/[1-9]\d* accepted candidates are open/).waitFor();
  const meant = new Map();
  for (let i = 0; i < DECISIONS; ++i) {
    const pair = await shownPair();
    const name = textOf(pair);
    const act = chance(0.6) ? 'c' : 'r';
    let note = '';
    if (chance(0.7)) {
      note = `${i} about ${name}`;
      await write(note);
      if (chance(0.3)) {
        // A draft waits while others are looked at, and over a reload.
        await next(pair);
        assert.equal(await noteField().inputValue(), '');
        await page.goBack();
        await until(async () => textOf(await shownPair()) === name, 'the pair');
        if (chance(0.5)) await reload();
        assert.equal(await noteField().inputValue(), note);
      }
    }
    await page.keyboard.press(act);
    meant.set(name, `${name} ${act}: ${note}`);
    if (chance(0.5)) {
      // What comes late is not told at the next pair, nor takes its note.
      await next(pair);
      if (chance(0.5)) {
        const draft = `draft ${i}`;
        await write(draft);
        await isQuiet();
        assert.equal(await noteField().inputValue(), draft,
                     await page.locator('.decision').innerText());
        await tellsOnlyOfItself();
        await noteField().fill('');
        await noteField().blur();
      }
    } else {
      await page.locator('.state-line strong').waitFor();
      await isQuiet();
      if (chance(0.3)) {
        await page.keyboard.press('u');
        const kind = act === 'c' ? 'confirmed' : 'rejected';
        await page.locator('.decision > [role=status]', {
          hasText: `Undone: ${kind} ${name}.`}).waitFor();
        meant.delete(name);
      }
      await next(pair);
    }
    if (i % RELOAD_EVERY === RELOAD_EVERY - 1) {
      await isQuiet();
      await reload();
    }
  }
  await isQuiet();
  assert.ok(meant.size >= DECISIONS / 2, `${meant.size}`);
  assert.deepEqual(stored(), [...meant.values()].sort());
});

test('every decided pair can be looked at after a reload', async () => {
  await page.goto(world.console.url + '/vehicles/boreas');
  const rows = page.getByRole('table', {name: 'Decisions'}).locator('tbody a');
  await rows.first().waitFor();
  const links = await rows.evaluateAll(all => all.map(
      ({href, ariaLabel}) => [href, ariaLabel]));
  assert.ok(links.length > 5);
  for (const [href, label] of links.slice(0, 6)) {
    await page.goto(href);
    await page.locator('.state-line strong').waitFor();
    const [kind, name] = label.split(' ');
    assert.equal(textOf(await shownPair()), name);
    assert.equal(await page.locator('.state-line strong').innerText(), kind);
    await page.locator('.curve canvas').waitFor();
    assert.equal(await page.locator('.map.small canvas').count(), 1);
  }
});

test('a key counts as soon as the panel is there', async () => {
  const early = await world.browser.newContext();
  const other = await early.newPage();
  // Before any frame is drawn, and long before what waits for one.
  await other.addInitScript(() => {
    new MutationObserver((_, observer) => {
      if (!document.querySelector('.decision')) return;
      observer.disconnect();
      document.body.dispatchEvent(
          new KeyboardEvent('keydown', {key: 'n', bubbles: true}));
      window.focused = document.activeElement.getAttribute('name');
    }).observe(document, {childList: true, subtree: true});
  });
  await other.goto(`${world.console.url}/vehicles/boreas/candidates/2060-1063`);
  await other.locator('.decision').waitFor();
  assert.equal(await other.evaluate(() => window.focused), 'note');
  await early.close();
});

test('nobody is led back to a pair while its decision is under way', async () => {
  const vehicle = await world.open('/vehicles/boreas');
  const label = vehicle.locator('.decision > label');
  const open = async () => Number(/([\d,]+) accepted candidates are open/.exec(
      await vehicle.locator('.decision').innerText())[1]);
  let answer;
  const answered = new Promise(done => answer = done);
  await vehicle.route('**/AddLoopClosure', async route => {
    await answered;
    await route.continue();
  });
  await vehicle.getByText(/^(\d+) of \1 checks answered$/).waitFor();
  await vehicle.locator('a.button', {hasText: 'Review'}).click();
  await label.waitFor();
  const [name, before] = [await label.innerText(), await open()];
  await vehicle.keyboard.press('c');
  await until(async () => await open() < before, 'a shorter queue');
  const shown = new Set();
  for (let i = 0; i <= before; ++i) {
    const last = await label.innerText();
    await vehicle.keyboard.press('j');
    await until(async () => await label.innerText() !== last, 'another pair');
    shown.add(await label.innerText());
  }
  assert.ok(shown.size > 1 && !shown.has(name), name);
  answer();
  await vehicle.locator('.deeds', {hasText: 'Confirmed'}).waitFor();
  await vehicle.keyboard.press('u');
  await vehicle.keyboard.press('u');
  await vehicle.locator('.decision > [role=status]', {hasText: 'Undone'})
      .waitFor();
  await vehicle.context().close();
});

test('a rejection is undone after a reload, and that is named', async () => {
  await page.goto(world.console.url + '/vehicles/boreas');
  const row = page.getByRole('link', {name: /^rejected/}).first();
  const name = (await row.getAttribute('aria-label')).split(' ')[1];
  await row.click();
  await page.locator('.state-line', {hasText: 'rejected'}).waitFor();
  const before = stored();
  const lists = [];
  page.on('request', request => lists.push(request.url().split('/').at(-1)));
  await page.keyboard.press('u');
  await page.locator('.decision > [role=status]', {
    hasText: `Undone: rejected ${name}.`}).waitFor();
  await page.getByText('Nobody has decided about this pair').waitFor();
  await until(() => lists.includes('ListRejectedCandidates'), 'what is left');
  assert.ok(!lists.includes('ListDeletedPosePairs'), 'asked by nobody');
  const gone = before.filter(text => text.startsWith(`${name} r`));
  assert.equal(gone.length, 1);
  assert.deepEqual(stored(), before.filter(text => text !== gone[0]));
});

test('undone decisions are shown where somebody opens them, and kept up to date',
     async () => {
  const {revisitd} = world;
  const deletions = () => revisitd.cli('deletions', 'list', 'boreas', '--json')
                              .deletedPosePairs;
  const vehicle = await world.open('/vehicles/boreas');
  const rows = vehicle.getByRole('table', {name: 'Undone decisions'})
                   .locator('tbody tr:not(.space)');
  const asked = [];
  vehicle.on('request', request => asked.push(request.url().split('/').at(-1)));
  const count = deletions().length;
  assert.ok(count > 1);
  await vehicle.locator('.undone summary').click();
  await rows.first().waitFor();
  const last = deletions()[0].rejectedCandidate;
  const cells = await rows.first().locator('td').allInnerTexts();
  assert.deepEqual(cells.slice(0, 3), [
    Number(last.querySequence).toLocaleString('en'),
    Number(last.matchedSequence).toLocaleString('en'), 'rejected']);
  assert.equal(cells[7], last.note);
  assert.ok(asked.filter(name => name === 'ListDeletedPosePairs').length === 1);
  await isAccessible(vehicle);
  // Somebody else undoes one more.
  revisitd.cli('reject', 'boreas', '2064', '300', '--note', 'mistaken');
  await vehicle.getByRole('table', {name: 'Decisions', exact: true})
      .getByText('mistaken').waitFor();
  revisitd.cli('rejections', 'delete', 'boreas', '2064', '300');
  await rows.first().getByText('mistaken').waitFor();
  assert.equal(deletions().length, count + 1);
  // The console asks no more for decisions that were closed.
  await vehicle.locator('.undone summary').click();
  const before = asked.length;
  revisitd.cli('reject', 'boreas', '2064', '300');
  revisitd.cli('rejections', 'delete', 'boreas', '2064', '300');
  await until(() => asked.slice(before).includes('ListRejectedCandidates'),
              'a look at the decisions');
  assert.ok(!asked.slice(before).includes('ListDeletedPosePairs'));
  await vehicle.context().close();
});

test('undo at an undecided pair names the other one, and waits', async () => {
  await page.getByText(/[1-9]\d* accepted candidates are open/).waitFor();
  const first = await shownPair();
  await next(first);
  const decided = await shownPair();
  await page.keyboard.press('r');
  await page.locator('.state-line strong').waitFor();
  const all = stored();
  await next(decided);
  await page.keyboard.press('u');
  const said = page.locator('.decision > [role=status]');
  await said.filter({hasText: `rejected ${textOf(decided)}: u once more`})
      .waitFor();
  assert.deepEqual(stored(), all);
  // Another key, and it asks again.
  await page.keyboard.press('n');
  await page.keyboard.press('Escape');
  await page.keyboard.press('u');
  await said.filter({hasText: 'u once more'}).waitFor();
  assert.deepEqual(stored(), all);
  await page.keyboard.press('u');
  await said.filter({hasText: `Undone: rejected ${textOf(decided)}.`})
      .waitFor();
  assert.equal(stored().length, all.length - 1);
});

test('a decision that fails is told at its pair, with the request', async () => {
  const pair = await shownPair();
  const draft = 'kept for another try';
  await write(draft);
  await world.revisitd.kill();
  await page.keyboard.press('c');
  await next(pair);
  await page.locator('.deeds[open] .error', {
    hasText: `${textOf(pair)} was not confirmed`}).waitFor();
  await tellsOnlyOfItself();
  await page.locator('.deeds .error a').first().click();
  await until(async () => textOf(await shownPair()) === textOf(pair), 'it');
  assert.match(await page.locator('.decision > [role=status]').innerText(),
               /request console-[0-9a-f]{16}/);
  assert.equal(await noteField().inputValue(), draft);
  await world.revisitd.start();
  await page.getByText('No answer from revisitd since')
      .waitFor({state: 'detached'});
  await page.keyboard.press('c');
  await page.locator('.state-line', {hasText: draft}).waitFor();
  assert.deepEqual(page.complaints, []);
});
