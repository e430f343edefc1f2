// Where the recordings of a group's members lie in the frame of one of them.
import type {FrameTransform, ListFrameTransformsResponse} from
    '../../gen/revisit/v1/group_pb.js';
import {FrameState} from '../../gen/revisit/v1/recording_pb.js';
import {apply, type Rigid} from '../geometry/rigid.js';
import {vehicleId} from './group_links.js';
import {type Doubt, doubtOf, motionOf, recordingId} from './recordings.js';

/** How often a list begins anew because the group has changed on its way. */
const MOST_ATTEMPTS = 5;

/** A recording of a member, in the frame of the map. */
export interface MemberFrame {
  /** Sequence of its first pose. */
  firstSequence: number;
  /** How its frame is tied to that of the map. */
  state: FrameState;
  /** Undefined where nothing ties them. */
  motion: Rigid|undefined;
  /** How far it may lie from there; undefined where it is not placed, and in the
   * map's own frame. */
  doubt: Doubt|undefined;
  /** Loop closures that agree and tie the two recordings directly. */
  closures: number;
}

/** By the member's id, each eldest first. */
export type Frames = ReadonlyMap<string, readonly MemberFrame[]>;

export function framesOf(transforms: readonly FrameTransform[]): Frames {
  const frames = new Map<string, MemberFrame[]>();
  for (const transform of transforms) {
    const id = vehicleId(transform.vehicle);
    const before = frames.get(id) ?? [];
    frames.set(id, before);
    before.push({
      firstSequence: Number(recordingId(transform.recording)),
      state: transform.frameState,
      motion: motionOf(transform),
      doubt: doubtOf(transform),
      closures: transform.loopClosureCount,
    });
  }
  for (const all of frames.values()) {
    all.sort((a, b) => a.firstSequence - b.firstSequence);
  }
  return frames;
}

/** The recording that a pose is in. */
export function frameAt(frames: readonly MemberFrame[]|undefined,
                        sequence: number): MemberFrame|undefined {
  if (!frames) return undefined;
  let k = frames.length;
  while (k > 0 && frames[k - 1].firstSequence > sequence) --k;
  return frames[k - 1];
}

/** Whether nothing is claimed to be wrong with where a frame lies: fixes without a
 * bias are all in one. */
export function isExact({doubt}: Pick<MemberFrame, 'doubt'>): boolean {
  return doubt !== undefined && doubt.headingDeviation === 0 &&
      doubt.covariance.every(value => value === 0);
}

/** Whether it is known where a frame lies on the map, not only estimated. */
export function isKnown(frame: Pick<MemberFrame, 'state'|'doubt'>): boolean {
  return frame.state === FrameState.SAME ||
      frame.state === FrameState.KNOWN || isExact(frame);
}

/** Whether a member has a recording on the map. */
export function isOnMap(frames: readonly MemberFrame[]|undefined): boolean {
  return frames?.some(({motion}) => motion) ?? false;
}

/** A place of a recording as the map has it; undefined where the recording is
 * not placed. */
export function onMap(frame: MemberFrame|undefined, x: number, y: number):
    [number, number]|undefined {
  return frame?.motion && apply(frame.motion, x, y);
}

type Page = Pick<ListFrameTransformsResponse,
                 'frameTransforms'|'groupRevision'|'nextPageToken'>;

/** All transforms, of one revision of the group: pages of several do not fit
 * together. */
export async function ofOneRevision(
    list: (pageToken: string) => Promise<Page>): Promise<FrameTransform[]> {
  for (let attempt = 1; attempt <= MOST_ATTEMPTS; ++attempt) {
    const transforms: FrameTransform[] = [];
    const revisions = new Set<bigint>();
    let pageToken = '';
    do {
      const page = await list(pageToken);
      transforms.push(...page.frameTransforms);
      revisions.add(page.groupRevision);
      if (page.nextPageToken !== '' && page.nextPageToken === pageToken) {
        throw new Error('the server\'s list does not go on');
      }
      pageToken = page.nextPageToken;
    } while (pageToken !== '' && revisions.size === 1);
    if (revisions.size === 1) return transforms;
  }
  throw new Error('the group changes faster than its frames are told');
}
