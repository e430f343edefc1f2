// Deeds in the queue since the page was loaded, and which of them stand.
import {batch, signal} from '@preact/signals';

import {CandidateState} from '../../gen/revisit/v1/check_pb.js';
import type {LoopClosure} from '../../gen/revisit/v1/loop_closure_pb.js';
import {token} from './client.js';
import {type Deed, pairName} from './decisions.js';
import {posesName} from './group_links.js';
import {isOpen, otherVehicleOf, posesOf, type Waiting} from './queue.js';

/** Something that was done in the queue. `at` is the key of the candidate. */
export interface QueueDeed extends Deed {
  candidate: Waiting;
  /** The loop closure that was deleted before the candidate was rejected. */
  deleted?: LoopClosure;
}

/** All that was done since the page was loaded, the last at the end: it outlives
 * a look at another view, so that it can be undone after that. */
export const deeds = signal<QueueDeed[]>([]);
/** The subjects (subjectOf) about which the server lets this caller decide
 * nothing, as it said when that was tried. */
export const readOnly = signal<ReadonlySet<string>>(new Set());
token.subscribe(() => batch(() => {
  deeds.value = [];
  readOnly.value = new Set();
}));

/** The subject of a right: to decide about places in other vehicles takes
 * another one than about those in the vehicle's own history. */
export function subjectOf(one: Waiting): string {
  return otherVehicleOf(one) === undefined ? one.vehicle :
      `what ${one.vehicle} found in other vehicles`;
}

export function pairOfWaiting({evidence}: Waiting) {
  return {query: Number(evidence.query!.sequence),
          matched: Number(evidence.matched!.sequence)};
}

/** A candidate as people read it. */
export function nameOf(one: Waiting): string {
  return otherVehicleOf(one) === undefined ?
      `${pairName(pairOfWaiting(one))} of ${one.vehicle}` :
      posesName(posesOf(one));
}

export function isBusy(key: string): boolean {
  return deeds.value.some(({at, state}) => at === key && state === 'under way');
}

/** The decisions of this page that still stand, the last at the end. */
function standing(): QueueDeed[] {
  // The same pair may be decided about again after an undo, under the same name.
  const undone = (deed: QueueDeed) => deeds.value.some(
      ({id, act, state, made}) => act === 'undo' && state !== 'failed' &&
          id > deed.id && made === deed.made);
  // A loop closure that was upheld was there before, and stays.
  return deeds.value.filter(
      deed => deed.act !== 'undo' && deed.act !== 'uphold' &&
          deed.made !== undefined && !undone(deed));
}

/** The last decision of this page that still stands. */
export function lastDecision(): QueueDeed|undefined {
  return standing().at(-1);
}

/** The candidates as this page has decided about them: those in other vehicles
 * come into their states some seconds after the group has the decision. */
export function asDecided(all: readonly Waiting[]): readonly Waiting[] {
  const made = new Map(
      standing().filter(({candidate}) => otherVehicleOf(candidate) !== undefined)
          .map(deed => [deed.at, deed]));
  if (made.size === 0) return all;
  return all.map(one => {
    const deed = made.get(one.key);
    if (!deed || !isOpen(one) ||
        one.eventNumber !== deed.candidate.eventNumber) {
      return one;
    }
    return {...one, decision: deed.made!, state: deed.act === 'confirm' ?
              CandidateState.CONFIRMED : CandidateState.REJECTED};
  });
}
