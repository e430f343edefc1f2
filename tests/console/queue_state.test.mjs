// What the queue makes of lists and events, without a browser.
import assert from 'node:assert/strict';
import {before, test} from 'node:test';

import {load} from './world.mjs';

const [OPEN, CONFIRMED, REJECTED, WITHDRAWN] = [1, 2, 3, 4];

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
