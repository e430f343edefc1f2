// Decides about two poses of two members of a group, and takes that back.
import {service} from './client.js';
import {asLink, asRejection, type GroupDecision, type Link, type PosePair,
        type PosePlace} from './group_links.js';

function memberPose({vehicle, sequence}: PosePlace) {
  return {vehicle: `vehicles/${vehicle}`, sequence: BigInt(sequence)};
}

/** Ties the two vehicles at these poses, which somebody has found to be one
 * place. */
export async function link(parent: string, {query, matched}: PosePair,
                           note: string): Promise<Link> {
  const {loopClosure} = await service.addInterVehicleLoopClosure({
    parent, loopClosure: {query: memberPose(query),
                          matched: memberPose(matched), note}});
  return asLink(loopClosure!);
}

/** Has these poses, which somebody has found not to be one place, offered no
 * more. */
export async function reject(parent: string, {query, matched}: PosePair,
                             note: string): Promise<GroupDecision> {
  const {rejectedCandidate} = await service.rejectInterVehicleCandidate({
    parent, rejectedCandidate: {query: memberPose(query),
                                matched: memberPose(matched), note}});
  return asRejection(rejectedCandidate!);
}

/** Deletes a decision, whoever has made it. */
export async function takeBack({kind, name}: Pick<GroupDecision, 'kind'|'name'>):
    Promise<void> {
  if (kind === 'linked') {
    await service.deleteInterVehicleLoopClosure({name});
  } else {
    await service.deleteInterVehicleRejectedCandidate({name});
  }
}
