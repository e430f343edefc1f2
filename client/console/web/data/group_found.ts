// Results of a search in the histories of a group's members.
import {type Candidate, type CandidateSet, UnsearchedReason} from
    '../../gen/revisit/v1/candidate_pb.js';
import {type Link, type PosePlace, vehicleId} from './group_links.js';

/** A candidate of a search in a group. */
export interface GroupFound {
  query: PosePlace;
  matched: PosePlace;
  candidate: Candidate;
  /** Whether it is in the history of another vehicle than the one that asked. */
  isAcross: boolean;
}

export function foundIn(vehicle: string, set: CandidateSet): GroupFound[] {
  return set.candidates.map(candidate => ({
    query: {vehicle, sequence: Number(candidate.query!.sequence)},
    matched: {
      vehicle: candidate.matchedVehicle ?
          vehicleId(candidate.matchedVehicle) : vehicle,
      sequence: Number(candidate.matched!.sequence),
    },
    candidate,
    isAcross: candidate.matchedVehicle !== '',
  }));
}

/** The link of just these two poses, either way round. */
export function linkOf(links: readonly Link[],
                       {query, matched}: Pick<GroupFound, 'query'|'matched'>):
    Link|undefined {
  const isSame = (a: PosePlace, b: PosePlace) =>
      a.vehicle === b.vehicle && a.sequence === b.sequence;
  return links.find(link =>
      (isSame(link.query, query) && isSame(link.matched, matched)) ||
      (isSame(link.query, matched) && isSame(link.matched, query)));
}

/** Whether histories are still being read that were not searched. */
export function isPartial(set: CandidateSet): boolean {
  return set.unsearched.some(
      ({reason}) => reason === UnsearchedReason.NOT_READY);
}
