// What the queue makes of lists and events, without a browser.
import assert from 'node:assert/strict';
import {before, test} from 'node:test';

import {load} from './world.mjs';

const [OPEN, CONFIRMED, REJECTED, WITHDRAWN] = [1, 2, 3, 4];
const [CHECK, SEARCH, CONTRADICTION] = [1, 6, 7];

let queues;
before(async () => {
  queues = await load('web/data/queue.ts');
});

const at = seconds => ({seconds: BigInt(seconds), nanos: 0});

/** The first candidate of a check, as both a list and an event have it. */
function candidate(vehicle, sequence, state, eventNumber, more = {}) {
  return {name: `vehicles/${vehicle}/checks/${sequence}/candidates/1`, rank: 1,
          state, cause: 0, actor: '', decision: '',
          eventNumber: BigInt(eventNumber), ...more};
}

const evidence = (sequence, probability) => ({
  rank: 1, query: {sequence: BigInt(sequence)}, matched: {sequence: 3n},
  probability});

function check(vehicle, sequence, state, number, probability = 0.9) {
  return {vehicleUid: `uid-${vehicle}`, createTime: at(sequence),
          candidates: {candidates: [evidence(sequence, probability)]},
          states: [candidate(vehicle, sequence, state, number)]};
}

function event(vehicle, sequence, state, number, more = {}, probability = 0.9) {
  return {vehicleUid: `uid-${vehicle}`, number: BigInt(number),
          candidate: candidate(vehicle, sequence, state, number, more),
          evidence: evidence(sequence, probability), eventTime: at(sequence)};
}

const shown = (queue, order = 'newest') => queues.ordered(queue.values, order)
    .map(({vehicle, asked, state}) => `${vehicle} ${asked} ${state}`);

test('a list and the events behind it are one queue, also where they overlap',
     () => {
  const queue = new queues.Queue(100);
  queue.begin([check('a', 10, OPEN, 1), check('a', 20, OPEN, 4),
               check('a', 30, REJECTED, 5), check('b', 15, OPEN, 1, 0.2)],
              0.5, false);
  assert.deepEqual(shown(queue), ['a 20 1', 'a 10 1']);
  // These are told again although the list has them already.
  queue.take(event('a', 20, CONFIRMED, 3), 0);
  assert.deepEqual(shown(queue), ['a 20 1', 'a 10 1']);
  queue.take(event('a', 40, OPEN, 6), 0);
  queue.take(event('a', 10, CONFIRMED, 7, {actor: 'token:x', decision: 'd'}),
             1000);
  assert.deepEqual(shown(queue), ['a 40 1', 'a 20 1', 'a 10 2']);
  assert.equal(queue.openCount, 2);
  // After a break the watch begins at a cursor of before.
  queue.take(event('a', 10, OPEN, 1), 2000);
  queue.take(event('a', 40, OPEN, 6), 2000);
  assert.deepEqual(shown(queue), ['a 40 1', 'a 20 1', 'a 10 2']);
  const [decided] = queues.ordered(queue.values, 'newest').slice(-1);
  assert.deepEqual([decided.actor, decided.left], ['token:x', 1000]);
});

test('one that was decided goes after some seconds, and comes back in its place',
     () => {
  const queue = new queues.Queue(100);
  queue.begin([10, 20, 30].map((sequence, i) =>
      check('a', sequence, OPEN, i + 1)), 0, false);
  queue.take(event('a', 20, WITHDRAWN, 4), 1000);
  assert.equal(queue.sweep(1000 + queues.FADE_MILLISECONDS - 1), true);
  assert.deepEqual(shown(queue), ['a 30 1', 'a 20 4', 'a 10 1']);
  assert.equal(queue.sweep(1000 + queues.FADE_MILLISECONDS), false);
  assert.deepEqual(shown(queue), ['a 30 1', 'a 10 1']);
  // A decision was undone much later.
  queue.take({...event('a', 20, OPEN, 5), eventTime: at(99)}, 9000);
  assert.deepEqual(shown(queue), ['a 30 1', 'a 20 1', 'a 10 1']);
  // Undone while it was still shown, it stays.
  queue.take(event('a', 10, REJECTED, 6), 9000);
  queue.take(event('a', 10, OPEN, 7), 9100);
  assert.equal(queue.sweep(99_000), false);
  assert.equal(queue.openCount, 3);
});

test('a decision made here is shown before its event, which adds who made it',
     () => {
  const queue = new queues.Queue(100);
  queue.begin([check('a', 10, OPEN, 1)], 0, false);
  const [{key}] = queue.values;
  queue.settle(key, CONFIRMED, 'made', 500);
  queue.take(event('a', 10, CONFIRMED, 2, {actor: 'me', decision: 'made'}),
             900);
  const [{left, actor, decision}] = queue.values;
  assert.deepEqual([left, actor, decision], [500, 'me', 'made']);
  // An answer that comes after the next event changes nothing.
  queue.take(event('a', 10, OPEN, 3), 1000);
  queue.take(event('a', 10, REJECTED, 4, {decision: 'theirs'}), 1100);
  queue.settle(key, CONFIRMED, 'made', 1200);
  assert.deepEqual([...queue.values].map(one => one.decision), ['theirs']);
});

test('a vehicle that is gone takes what was found with it, and no other one\'s',
     () => {
  const queue = new queues.Queue(100);
  queue.begin([check('a', 10, OPEN, 9), check('b', 10, OPEN, 9)], 0, false);
  queue.drop('uid-a');
  assert.deepEqual(shown(queue), ['b 10 1']);
  // Another one of the same id counts from 1.
  queue.take({...event('a', 10, OPEN, 1), vehicleUid: 'later'}, 0);
  assert.deepEqual(shown(queue), ['a 10 1', 'b 10 1']);
});

test('no more are held than the bound, and it is said that there are', () => {
  const queue = new queues.Queue(2);
  queue.begin([1, 2, 3].map(n => check('a', n, OPEN, n)), 0, false);
  assert.deepEqual([queue.openCount, queue.isCut], [2, true]);
  queue.begin([1, 2].map(n => check('a', n, OPEN, n)), 0, false);
  assert.equal(queue.isCut, false);
  queue.take(event('a', 3, OPEN, 3), 0);
  assert.deepEqual([queue.openCount, queue.isCut], [2, true]);
});

test('probability is an order, and the newest come first among equals', () => {
  const queue = new queues.Queue(100);
  queue.begin([check('a', 1, OPEN, 1, 0.5), check('a', 2, OPEN, 2, 0.9),
               check('b', 3, OPEN, 1, null), check('b', 4, OPEN, 2, 0.5)],
              0, false);
  assert.deepEqual(shown(queue, 'probable'),
                   ['a 2 1', 'b 4 1', 'a 1 1', 'b 3 1']);
});

test('value is the first order, as of the last list or event', () => {
  const queue = new queues.Queue(100);
  const valued = (sequence, number, valueSquareMeters) => {
    const one = check('a', sequence, OPEN, number);
    Object.assign(one.states[0], {valueSquareMeters});
    return one;
  };
  queue.begin([valued(1, 1, 0.5), valued(2, 2, 2), valued(3, 3, 0.5)], 0,
              false);
  assert.deepEqual(shown(queue, 'value'), ['a 2 1', 'a 3 1', 'a 1 1']);
  queue.take(event('a', 1, OPEN, 4, {valueSquareMeters: 3}), 0);
  assert.deepEqual(shown(queue, 'value'), ['a 1 1', 'a 2 1', 'a 3 1']);
  // A decision made the others worth less. It is of a list that was read before
  // an event, and knows of one that the page does not show.
  queue.take(event('a', 3, CONFIRMED, 5, {valueSquareMeters: 0.5}), 100);
  queue.renew([valued(1, 1, 9), valued(2, 2, 0.1), valued(3, 3, 9),
               valued(4, 6, 9)]);
  assert.deepEqual(shown(queue, 'value'), ['a 1 1', 'a 3 2', 'a 2 1']);
  assert.deepEqual([...queue.values].map(({value}) => value).sort(),
                   [0.1, 0.5, 3]);
  // What contradicts others comes first, whatever it is worth.
  for (const number of [7, 8]) {
    queue.take(event('a', number, OPEN, number, {cause: CONTRADICTION}), 200);
  }
  assert.deepEqual(shown(queue, 'value').slice(0, 3),
                   ['a 8 1', 'a 7 1', 'a 1 1']);
});

/** A check whose second search found its first candidate less probable, and one
 * more; and lost the third, which only a search between had found. */
function searchedAgain(isStale) {
  const one = check('a', 10, OPEN, 1, 0.9);
  one.stale = isStale;
  one.latest = {candidates: [{...evidence(10, 0.2), rank: 2},
                             {...evidence(10, 0.7), rank: 1}]};
  Object.assign(one.states[0], {latestRank: 2});
  const more = (number, latestRank) => ({
    ...candidate('a', 10, OPEN, 2), rank: 0, latestRank,
    cause: SEARCH, name: `vehicles/a/checks/10/candidates/${number}`});
  one.states.push(more(2, 1), more(3, 0));
  return one;
}

test('what was told then and what is found now are kept apart', () => {
  const queue = new queues.Queue(100);
  queue.begin([searchedAgain(true)], 0, false);
  const seen = () => [...queue.values].map(
      ({told, evidence: found, isSearchedAgain, isStale}) =>
          [told?.probability, found.probability, isSearchedAgain, isStale]);
  assert.deepEqual(seen(), [[0.9, 0.2, true, true],
                            [undefined, 0.7, true, true]]);
  // A least probability is that of the last search.
  queue.begin([searchedAgain(false)], 0.5, false);
  assert.deepEqual(seen(), [[undefined, 0.7, true, false]]);
});

test('an event of a second search adds to what was told', () => {
  const queue = new queues.Queue(100);
  const first = check('a', 10, OPEN, 1, 0.9);
  first.stale = true;
  queue.begin([first], 0, false);
  queue.take(event('a', 10, OPEN, 2, {cause: SEARCH, latestRank: 1}, 0.3), 0);
  const [one] = queue.values;
  assert.deepEqual([one.told.probability, one.evidence.probability,
                    one.isSearchedAgain, one.isStale],
                   [0.9, 0.3, true, false]);
  // Of one that comes with its first search, nothing else was told.
  queue.take(event('a', 20, OPEN, 3, {cause: CHECK, latestRank: 0}, 0.6), 0);
  const two = [...queue.values].find(({asked}) => asked === 20);
  assert.deepEqual([two.told.probability, two.isSearchedAgain], [0.6, false]);
});

test('a match in another vehicle is known by it, and one in its own is not', () => {
  const queue = new queues.Queue(100);
  queue.begin([check('a', 10, OPEN, 1)], 0, false);
  const other = event('a', 20, OPEN, 2);
  other.evidence.matchedVehicle = 'vehicles/b';
  queue.take(other, 0);
  const [across, own] = queues.ordered(queue.values, 'newest');
  assert.deepEqual([across, own].map(queues.otherVehicleOf),
                   ['b', undefined]);
  assert.deepEqual([across, own].map(
      one => queues.posesOf(one).matched.vehicle), ['b', 'a']);
});

test('a contradicted one is known while it is open', () => {
  const queue = new queues.Queue(100);
  queue.take(event('a', 10, OPEN, 2, {cause: CONTRADICTION}), 0);
  const [{key}] = queue.values;
  assert.equal(queues.isContradicted([...queue.values][0]), true);
  queue.settle(key, CONFIRMED, 'closure', 500);
  assert.equal(queues.isContradicted([...queue.values][0]), false);
});

test('the row that is looked at stays, or the next one below takes its place',
     () => {
  const rows = (...texts) => texts.map(text => (
      {key: text[0], state: text.endsWith('-') ? CONFIRMED : OPEN}));
  const {follow, neighbour} = queues;
  assert.equal(follow(undefined, [], rows('a-', 'b', 'c')), 'b');
  // Others come above it, and it is decided.
  assert.equal(follow('b', ['b', 'c'], rows('z', 'b', 'c')), 'b');
  assert.equal(follow('b', ['z', 'b', 'c'], rows('z', 'b-', 'c')), 'b');
  assert.equal(follow('b', ['a', 'b', 'c', 'd'], rows('z', 'a', 'c-', 'd')),
               'd');
  assert.equal(follow('d', ['a', 'b', 'd'], rows('a', 'b', 'z')), 'b');
  assert.equal(follow('d', ['a', 'd'], []), undefined);
  assert.equal(neighbour(rows('a', 'b-', 'c'), 'a', 1), 'c');
  assert.equal(neighbour(rows('a', 'b-', 'c'), 'c', -1), 'a');
  assert.equal(neighbour(rows('a', 'b-'), 'a', 1), 'a');
});
