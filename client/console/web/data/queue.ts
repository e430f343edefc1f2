// The stored candidates that wait for a decision, over all vehicles: what a list
// of stored checks and the events behind it make of them. Nothing is called from
// here.
import {timestampMs} from '@bufbuild/protobuf/wkt';

import type {Candidate, CandidateSet} from '../../gen/revisit/v1/candidate_pb.js';
import {CandidateCause, type CandidateEvent, CandidateState, type Check,
        type CheckCandidate} from '../../gen/revisit/v1/check_pb.js';
import {type PosePair, vehicleId} from './group_links.js';

/** How long one that was decided is shown, with who decided. */
export const FADE_MILLISECONDS = 6000;

/** A candidate that is shown: it is open, or was until just now. */
export interface Waiting {
  /** Its name, and the uid of its vehicle: one that is made anew under the same
   * id has others. */
  key: string;
  /** `vehicles/{vehicle}/checks/{sequence}/candidates/{number}`. */
  name: string;
  vehicle: string;
  vehicleUid: string;
  /** The pose at which the check was due. */
  asked: number;
  /** What the last search that found it did. */
  evidence: Candidate;
  /** What the first search of its check did; undefined where only a later one
   * found it, and where nothing has told the page. */
  told: Candidate|undefined;
  /** Whether its check was searched again. */
  isSearchedAgain: boolean;
  /** Whether its check waits to be searched again, as of the last list. */
  isStale: boolean;
  /** What a look at it is worth, in square metres, as of the last list or
   * event. */
  value: number;
  state: CandidateState;
  cause: CandidateCause;
  /** Who caused the state; empty where no caller did, or nobody was asked. */
  actor: string;
  /** Name of the loop closure or the rejected candidate that decided. */
  decision: string;
  /** `groups/{group}` in which a match in another vehicle was found; empty of
   * others, and where the server did not say. */
  group: string;
  /** Events up to this one tell nothing new about it. */
  eventNumber: bigint;
  /** When the check found it, in milliseconds since 1970. */
  found: number;
  /** When the page learned that it is open no longer, by its own clock. */
  left: number|undefined;
}

export type Order = 'value'|'newest'|'probable';

function waiting(vehicleUid: string, candidate: CheckCandidate,
                 evidence: Candidate, found: number): Waiting {
  const {name, state, cause, actor, decision, eventNumber, group, latestRank,
         valueSquareMeters} = candidate;
  const [, vehicle, , asked] = name.split('/');
  return {key: `${vehicleUid} ${name}`, name, vehicle, vehicleUid,
          asked: Number(asked), evidence, state, cause, actor, decision,
          eventNumber, group, found, left: undefined,
          // The first search is the last one until there is another.
          told: cause === CandidateCause.CHECK && !latestRank ? evidence :
                                                                undefined,
          isSearchedAgain: latestRank > 0 || cause === CandidateCause.SEARCH,
          isStale: false, value: valueSquareMeters ?? 0};
}

/** A candidate of a list; undefined where no search that the list has tells its
 * two places. */
function listed(check: Check, candidate: CheckCandidate): Waiting|undefined {
  const ofRank = (set: CandidateSet|undefined, rank: number) =>
      rank > 0 ? set?.candidates.find(found => found.rank === rank) : undefined;
  const told = ofRank(check.candidates, candidate.rank);
  const evidence = ofRank(check.latest, candidate.latestRank) ?? told;
  if (!evidence) return undefined;
  const found = check.createTime ? timestampMs(check.createTime) : 0;
  return {...waiting(check.vehicleUid, candidate, evidence, found), told,
          isSearchedAgain: check.latest !== undefined, isStale: check.stale};
}

export function isOpen({state}: Waiting): boolean {
  return state === CandidateState.OPEN;
}

/** The vehicle in whose history its match lies; undefined where that is its
 * own. */
export function otherVehicleOf({evidence}: Waiting): string|undefined {
  return evidence.matchedVehicle ? vehicleId(evidence.matchedVehicle) :
                                   undefined;
}

export function posesOf(one: Waiting): PosePair {
  const {vehicle, evidence: {query, matched}} = one;
  return {
    query: {vehicle, sequence: Number(query!.sequence)},
    matched: {vehicle: otherVehicleOf(one) ?? vehicle,
              sequence: Number(matched!.sequence)},
  };
}

/** Whether it is open once more because the loop closure that confirmed it
 * contradicts others. */
export function isContradicted(one: Waiting): boolean {
  return isOpen(one) && one.cause === CandidateCause.CONTRADICTION;
}

/** The order that is asked for. A row moves only where what it rests on has
 * changed: a second search found another probability, or a decision made another
 * value of it. The row that is looked at is followed. */
export function ordered(all: Iterable<Waiting>, order: Order): Waiting[] {
  // One whose loop closure contradicts others comes before all, as in the lists
  // of the server.
  const rankOf = (one: Waiting) =>
      order === 'value' ? (isContradicted(one) ? Infinity : one.value) :
      order === 'probable' ? one.evidence.probability ?? 0 : 0;
  return [...all].sort((a, b) => rankOf(b) - rankOf(a) ||
      b.found - a.found || a.vehicle.localeCompare(b.vehicle, 'en') ||
      b.asked - a.asked || a.name.localeCompare(b.name, 'en', {numeric: true}));
}

/**
 * The row that is looked at, by its key: the same one as long as it is shown;
 * behind one that is gone, the next that was below it, or else above it. So what
 * arrives meanwhile is never decided about by a key that was meant for another.
 */
export function follow(selected: string|undefined, before: readonly string[],
                       rows: readonly Waiting[]): string|undefined {
  const shown = new Set(rows.map(({key}) => key));
  if (selected !== undefined && shown.has(selected)) return selected;
  const at = selected === undefined ? -1 : before.indexOf(selected);
  if (at < 0) return (rows.find(isOpen) ?? rows[0])?.key;
  const open = new Set(rows.filter(isOpen).map(({key}) => key));
  const near = [...before.slice(at + 1), ...before.slice(0, at).reverse()];
  return near.find(key => open.has(key)) ?? near.find(key => shown.has(key)) ??
      rows[0]?.key;
}

/** The open row below this one, or above it; itself, where there is none. */
export function neighbour(rows: readonly Waiting[], selected: string|undefined,
                          direction: 1|-1): string|undefined {
  const at = rows.findIndex(({key}) => key === selected);
  const beyond = direction > 0 ? rows.slice(at + 1) :
                                 rows.slice(0, Math.max(0, at)).reverse();
  return beyond.find(isOpen)?.key ?? selected;
}

export class Queue {
  private all = new Map<string, Waiting>();
  /** Number of the last event of each vehicle, by uid: those that come again
   * after a break tell nothing. */
  private readonly told = new Map<string, bigint>();
  /** When those that are gone were found, should a decision be undone. */
  private readonly found = new Map<string, number>();
  /** Whether there are open ones that are left out, since there are too many. */
  isCut = false;

  /** Holds at most so many open ones. */
  constructor(private readonly most: number) {}

  get values(): Iterable<Waiting> {
    return this.all.values();
  }

  get openCount(): number {
    return [...this.all.values()].filter(isOpen).length;
  }

  /** Begins anew with the open ones of a list that are at least so probable;
   * those that fade do so to their end. */
  begin(checks: readonly Check[], leastProbability: number, isCut: boolean):
      void {
    const fading = [...this.all].filter(([, {left}]) => left !== undefined);
    this.all = new Map(fading);
    this.told.clear();
    this.isCut = isCut;
    for (const check of checks) {
      for (const candidate of check.states) {
        const one = listed(check, candidate);
        if (!one || !isOpen(one) ||
            (one.evidence.probability ?? 0) < leastProbability) {
          continue;
        }
        if (this.openCountIsMost()) {
          this.isCut = true;
          return;
        }
        this.all.set(one.key, one);
      }
    }
  }

  /** Takes over what a later list tells of those that are shown: values, and
   * what second searches found. Events tell who comes and goes. */
  renew(checks: readonly Check[]): void {
    for (const check of checks) {
      for (const candidate of check.states) {
        const one = listed(check, candidate);
        const before = one && this.all.get(one.key);
        if (!before || before.eventNumber > one.eventNumber) continue;
        const {evidence, told, isSearchedAgain, isStale, value} = one;
        this.all.set(one.key, {...before, evidence, told, isSearchedAgain,
                               isStale, value});
      }
    }
  }

  /** What an event tells, at `now` of the page's clock. */
  take(event: CandidateEvent, now: number): void {
    const {vehicleUid, number, candidate, evidence, eventTime} = event;
    if (!candidate || !evidence ||
        number <= (this.told.get(vehicleUid) ?? 0n)) {
      return;
    }
    this.told.set(vehicleUid, number);
    const one = waiting(vehicleUid, candidate, evidence,
                        eventTime ? timestampMs(eventTime) : now);
    const before = this.all.get(one.key);
    if (before && before.eventNumber >= number) return;
    one.found = before?.found ?? this.found.get(one.key) ?? one.found;
    one.told ??= before?.told;
    one.isSearchedAgain ||= before?.isSearchedAgain ?? false;
    one.isStale = one.cause !== CandidateCause.SEARCH &&
        (before?.isStale ?? false);
    one.eventNumber = number;
    if (isOpen(one)) {
      if (!before && this.openCountIsMost()) {
        this.isCut = true;
      } else {
        this.all.set(one.key, one);
      }
    } else if (before) {
      this.all.set(one.key, {...one, left: before.left ?? now});
    }
  }

  /** Shows the outcome of a decision of this page, before its event comes. */
  settle(key: string, state: CandidateState, decision: string, now: number):
      void {
    const before = this.all.get(key);
    if (before && isOpen(before)) {
      this.all.set(key, {...before, state, decision, left: now, actor: ''});
    }
  }

  /** A vehicle is gone, and all that was found with it. */
  drop(vehicleUid: string): void {
    for (const [key, one] of this.all) {
      if (one.vehicleUid === vehicleUid) this.all.delete(key);
    }
    this.told.delete(vehicleUid);
  }

  /** Lets those go that have faded. Returns whether others are left to fade. */
  sweep(now: number): boolean {
    let isFading = false;
    for (const [key, {left, found}] of this.all) {
      if (left === undefined) continue;
      if (now - left >= FADE_MILLISECONDS) {
        this.found.set(key, found);
        this.all.delete(key);
      } else {
        isFading = true;
      }
    }
    return isFading;
  }

  private openCountIsMost(): boolean {
    return this.all.size >= this.most && this.openCount >= this.most;
  }
}
