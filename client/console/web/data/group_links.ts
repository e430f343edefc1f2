// Decisions about two poses of two members of a group, and how they are told.
import {timestampMs} from '@bufbuild/protobuf/wkt';

import type {InterVehicleLoopClosure, InterVehicleRejectedCandidate,
             MemberPose} from '../../gen/revisit/v1/group_pb.js';
import type {LoopClosureMeasurement} from
    '../../gen/revisit/v1/loop_closure_pb.js';

/** A pose of a member. */
export interface PosePlace {
  /** The vehicle's id. */
  vehicle: string;
  sequence: number;
}

/** Two poses of two vehicles. */
export interface PosePair {
  query: PosePlace;
  matched: PosePlace;
}

/** A loop closure between two vehicles, or a candidate that was rejected. */
export interface GroupDecision extends PosePair {
  kind: 'linked'|'rejected';
  /** The resource name. */
  name: string;
  note: string;
  /** Milliseconds since 1970. */
  time: number;
  /** Who made it, as the server knows its callers; empty if it does not. */
  by: string;
}

/** A loop closure between two vehicles. */
export interface Link extends GroupDecision {
  /** Undefined where nobody has measured it. */
  measurement: LoopClosureMeasurement|undefined;
}

/** The id of a vehicle by its name. */
export function vehicleId(name: string): string {
  return name.replace('vehicles/', '');
}

function placeOf(pose: MemberPose|undefined): PosePlace {
  return {vehicle: vehicleId(pose!.vehicle), sequence: Number(pose!.sequence)};
}

function asDecision(kind: GroupDecision['kind'],
                    made: InterVehicleLoopClosure|InterVehicleRejectedCandidate):
    GroupDecision {
  return {
    kind,
    name: made.name,
    query: placeOf(made.query),
    matched: placeOf(made.matched),
    note: made.note,
    time: made.createTime ? timestampMs(made.createTime) : NaN,
    by: made.decidedBy,
  };
}

export function asLink(made: InterVehicleLoopClosure): Link {
  return {...asDecision('linked', made), measurement: made.measurement};
}

export function asRejection(made: InterVehicleRejectedCandidate):
    GroupDecision {
  return asDecision('rejected', made);
}

/** A pose of a member as people read it. */
export function placeName({vehicle, sequence}: PosePlace): string {
  return `${vehicle}@${sequence}`;
}

/** The poses of two members as people read them. */
export function posesName({query, matched}: PosePair): string {
  return `${placeName(query)} – ${placeName(matched)}`;
}
