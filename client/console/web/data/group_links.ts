// Loop closures between members of a group, and how they are told.
import {timestampMs} from '@bufbuild/protobuf/wkt';

import type {InterVehicleLoopClosure, MemberPose} from
    '../../gen/revisit/v1/group_pb.js';
import type {LoopClosureMeasurement} from
    '../../gen/revisit/v1/loop_closure_pb.js';

/** A pose of a member. */
export interface PosePlace {
  /** The vehicle's id. */
  vehicle: string;
  sequence: number;
}

/** A loop closure between two vehicles. */
export interface Link {
  /** The resource name. */
  name: string;
  query: PosePlace;
  matched: PosePlace;
  /** Undefined where nobody has measured it. */
  measurement: LoopClosureMeasurement|undefined;
  note: string;
  /** Milliseconds since 1970. */
  time: number;
  /** Who added it, as the server knows its callers; empty if it does not. */
  by: string;
}

/** The id of a vehicle by its name. */
export function vehicleId(name: string): string {
  return name.replace('vehicles/', '');
}

function placeOf(pose: MemberPose|undefined): PosePlace {
  return {vehicle: vehicleId(pose!.vehicle), sequence: Number(pose!.sequence)};
}

export function asLink(made: InterVehicleLoopClosure): Link {
  return {
    name: made.name,
    query: placeOf(made.query),
    matched: placeOf(made.matched),
    measurement: made.measurement,
    note: made.note,
    time: made.createTime ? timestampMs(made.createTime) : NaN,
    by: made.decidedBy,
  };
}

/** A pose of a member as people read it. */
export function placeName({vehicle, sequence}: PosePlace): string {
  return `${vehicle}@${sequence}`;
}

/** A link as people read it. */
export function linkName({query, matched}: Pick<Link, 'query'|'matched'>):
    string {
  return `${placeName(query)} – ${placeName(matched)}`;
}
