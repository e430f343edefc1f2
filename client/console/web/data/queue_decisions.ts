// Decides about stored candidates as they were found, and takes that back.
import {Code, ConnectError} from '@connectrpc/connect';

import type {LoopClosure} from '../../gen/revisit/v1/loop_closure_pb.js';
import {allPages, service} from './client.js';
import {link, reject, takeBack} from './group_decisions.js';
import {isContradicted, otherVehicleOf, posesOf, type Waiting} from
    './queue.js';
import type {QueueDeed} from './queue_deeds.js';

const CLOSURES_A_PAGE = 1000;

/** The names that a decision has made, and has deleted before. */
type Made = Pick<QueueDeed, 'act'|'made'|'deleted'>;

/** The loop closure that confirmed a contradicted candidate. Undefined of other
 * candidates, and where it is gone: then this is one as any other. */
async function closureOf(one: Waiting): Promise<LoopClosure|undefined> {
  if (!isContradicted(one)) return undefined;
  const closures = await allPages(
      pageToken => service.listLoopClosures({
        parent: `vehicles/${one.vehicle}`, pageToken,
        pageSize: CLOSURES_A_PAGE}),
      page => page.loopClosures);
  return closures.find(({name}) => name === one.decision);
}

function ownPairOf({name, vehicle, evidence}: Waiting) {
  return {parent: `vehicles/${vehicle}`, candidate: name,
          pair: {querySequence: evidence.query!.sequence,
                 matchedSequence: evidence.matched!.sequence}};
}

async function confirmOwn(one: Waiting): Promise<Made> {
  const {parent, candidate, pair} = ownPairOf(one);
  const closure = await closureOf(one);
  const {loopClosure} = await service.addLoopClosure(closure ?
      {parent, candidate, loopClosure: closure,
       loopClosureId: closure.name.split('/').at(-1)} :
      {parent, candidate, loopClosure: pair});
  return {act: closure ? 'uphold' : 'confirm', made: loopClosure!.name};
}

async function rejectOwn(one: Waiting): Promise<Made> {
  const {parent, candidate, pair} = ownPairOf(one);
  const deleted = await closureOf(one);
  // One pair of poses is not both.
  if (deleted) await service.deleteLoopClosure({name: deleted.name});
  const {rejectedCandidate} = await service.rejectCandidate(
      {parent, candidate, rejectedCandidate: pair});
  return {act: 'reject', made: rejectedCandidate!.name, deleted};
}

/** The group that decides about a candidate: that in which it was found, or,
 * where the server did not keep that, in which the vehicle's checks search. */
async function groupOf({group, vehicle: id}: Waiting): Promise<string> {
  if (group) return group;
  const {vehicle} = await service.getVehicle({name: `vehicles/${id}`});
  const searched = vehicle!.settings?.checkGroup;
  if (!searched) {
    throw new ConnectError(`the checks of ${id} search in no group any more`,
                           Code.FailedPrecondition);
  }
  return searched;
}

/** Decides about a candidate, wherever its match lies. */
export async function decideAbout(act: 'confirm'|'reject', one: Waiting):
    Promise<Made> {
  if (otherVehicleOf(one) === undefined) {
    return act === 'confirm' ? confirmOwn(one) : rejectOwn(one);
  }
  const decide = act === 'confirm' ? link : reject;
  const {name} = await decide(await groupOf(one), posesOf(one), '');
  return {act, made: name};
}

async function deleteMade({act, candidate}: QueueDeed, name: string):
    Promise<void> {
  if (otherVehicleOf(candidate) !== undefined) {
    await takeBack({kind: act === 'confirm' ? 'linked' : 'rejected', name});
  } else if (act === 'confirm') {
    await service.deleteLoopClosure({name});
  } else {
    await service.deleteRejectedCandidate({name});
  }
}

/** Deletes what a decision has made, and adds what it deleted. */
export async function undoDeed(deed: QueueDeed): Promise<void> {
  const {candidate, deleted} = deed;
  try {
    await deleteMade(deed, deed.made!);
  } catch (error) {
    // Somebody else was faster.
    if (ConnectError.from(error).code !== Code.NotFound) throw error;
  }
  if (deleted) {
    await service.addLoopClosure({
      parent: `vehicles/${candidate.vehicle}`, loopClosure: deleted,
      candidate: candidate.name,
      loopClosureId: deleted.name.split('/').at(-1)});
  }
}
