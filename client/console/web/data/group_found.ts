// Results of a search in the histories of a group's members.
import {type Candidate, type CandidateSet, UnsearchedReason} from
    '../../gen/revisit/v1/candidate_pb.js';
import {type GroupDecision, type PosePair, type PosePlace, vehicleId} from
    './group_links.js';

/** A candidate of a search in a group. */
export interface GroupFound extends PosePair {
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

/** The decision about just these two poses, either way round. */
export function decisionOf(decisions: readonly GroupDecision[],
                           {query, matched}: PosePair): GroupDecision|undefined {
  const isSame = (a: PosePlace, b: PosePlace) =>
      a.vehicle === b.vehicle && a.sequence === b.sequence;
  return decisions.find(made =>
      (isSame(made.query, query) && isSame(made.matched, matched)) ||
      (isSame(made.query, matched) && isSame(made.matched, query)));
}

/** Whether histories are still being read that were not searched. */
export function isPartial(set: CandidateSet): boolean {
  return set.unsearched.some(
      ({reason}) => reason === UnsearchedReason.NOT_READY);
}
