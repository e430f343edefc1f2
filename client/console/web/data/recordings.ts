// The recordings of a vehicle: stretches of its poses, each in a frame of its own,
// and the graph with all of them in the frame of the last one, as far as it is known
// how they lie in that.
import {CovarianceForm} from '../../gen/revisit/v1/geometry_pb.js';
import type {FrameState, Recording} from
    '../../gen/revisit/v1/recording_pb.js';
import {boxesOf} from '../geometry/pyramid.js';
import {apply, type Rigid} from '../geometry/rigid.js';
import {count} from '../parts/format.js';
import {type Graph, nodeAt} from './graph.js';

/** How far a frame may lie from where it is drawn. */
export interface Doubt {
  /** The place that it is about, in the frame of the map. */
  x: number;
  y: number;
  /** xx, xy, yy in square metres. */
  covariance: [number, number, number];
  headingDeviation: number;
}

/** A recording with its nodes in a graph. */
export interface PlacedRecording {
  /** The last part of its name. */
  id: string;
  /** Its label, or else the pose at which it begins. */
  title: string;
  firstSequence: number;
  lastSequence: number;
  /** Its first and its last node. */
  from: number;
  to: number;
  /** How its frame is tied to that of the last recording. */
  state: FrameState;
  /** Whether it is known, or estimated, where its frame lies in the last one's. */
  isPlaced: boolean;
  /** Undefined for the last recording, and where it is not placed. */
  doubt: Doubt|undefined;
}

/** A graph whose nodes are in the frame of the last recording, but for those of
 * recordings that are not placed: these are in frames of their own. */
export interface Placement {
  graph: Graph;
  /** The eldest first; empty for a vehicle that has only one. */
  recordings: PlacedRecording[];
}

/** Changes where recordings or their frames may have changed: with nodes that are
 * elsewhere, gaps between nodes, or loop closures. */
export function tiesOf({nodesId, joined, closures}: Graph): string {
  const gaps = joined.reduce((sum, isJoined) => sum + 1 - isJoined, 0);
  return `${nodesId} ${gaps} ${closures.join()}`;
}

export function recordingTitle(label: string, id: string): string {
  return label || `from pose ${count(Number(id))}`;
}

/** The last part of a recording's name. */
export function recordingId(name: string): string {
  return name.slice(name.lastIndexOf('/') + 1);
}

/** A frame as seen from another one, in which it may be placed. */
type Placed =
    Pick<Recording, 'framePose'|'frameCovariance'|'frameReference'>;

export function motionOf({framePose}: Pick<Placed, 'framePose'>):
    Rigid|undefined {
  return framePose && {angle: framePose.headingRadians, x: framePose.xMeters,
                       y: framePose.yMeters};
}

export function doubtOf(placed: Placed): Doubt|undefined {
  const {frameCovariance, frameReference} = placed;
  const motion = motionOf(placed);
  if (!frameCovariance || !frameReference || !motion) return undefined;
  const {form, values} = frameCovariance;
  const [yy, hh] = form === CovarianceForm.SPATIAL_10 ? [4, 9] : [3, 5];
  const [x, y] = apply(motion, frameReference.xMeters, frameReference.yMeters);
  return {x, y, covariance: [values[0], values[1], values[yy]],
          headingDeviation: Math.sqrt(Math.max(0, values[hh]))};
}

/** The part of `recordings` that the graph has nodes of, with these. */
function withNodes(graph: Graph, recordings: readonly Recording[]):
    PlacedRecording[] {
  const begun = recordings.map(recording => ({
    recording, from: nodeAt(graph, Number(recording.firstSequence)),
  })).filter(({recording, from}) => from >= 0 &&
                 graph.sequence[from] === Number(recording.firstSequence));
  return begun.map(({recording, from}, k) => {
    const id = recordingId(recording.name);
    return {
      id,
      title: recordingTitle(recording.label, id),
      firstSequence: Number(recording.firstSequence),
      lastSequence: Number(recording.lastSequence),
      from,
      to: (begun[k + 1]?.from ?? graph.size) - 1,
      state: recording.frameState,
      isPlaced: recording.framePose !== undefined,
      doubt: doubtOf(recording),
    };
  });
}

/** Moves nodes [from, to] into another frame. */
function move({x, y, heading, covariance}: Graph, from: number, to: number,
              motion: Rigid): void {
  const [c, s] = [Math.cos(motion.angle), Math.sin(motion.angle)];
  for (let i = from; i <= to; ++i) {
    [x[i], y[i]] = apply(motion, x[i], y[i]);
    heading[i] += motion.angle;
    const [xx, xy, yy] = covariance.subarray(3 * i, 3 * i + 3);
    covariance[3 * i] = c * c * xx - 2 * c * s * xy + s * s * yy;
    covariance[3 * i + 1] = c * s * (xx - yy) + (c * c - s * s) * xy;
    covariance[3 * i + 2] = s * s * xx + 2 * c * s * xy + c * c * yy;
  }
}

/** The graph in the frame of the last recording. `own`, in which each recording is
 * in its own frame, stays as it is, and is what is returned for a vehicle with one
 * recording. */
export function place(own: Graph, recordings: readonly Recording[]):
    Placement {
  const placed = recordings.length > 1 ? withNodes(own, recordings) : [];
  if (placed.length < 2) return {graph: own, recordings: []};
  const graph = {...own, x: own.x.slice(), y: own.y.slice(),
                 heading: own.heading.slice(),
                 covariance: own.covariance.slice()};
  const motions = new Map(recordings.map(
      recording => [recordingId(recording.name), motionOf(recording)]));
  for (const {id, from, to} of placed) {
    const motion = motions.get(id);
    if (motion) move(graph, from, to, motion);
  }
  const {pyramid} = own;
  graph.pyramid = {
    ...pyramid,
    boxes: boxesOf(pyramid.first, pyramid.last, graph.x, graph.y),
  };
  return {graph, recordings: placed};
}

/** The one of these recordings, from the eldest, that has a node. */
export function recordingOf(recordings: readonly PlacedRecording[],
                            node: number): PlacedRecording|undefined {
  let low = 0;
  let high = recordings.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (recordings[middle].from > node) {
      high = middle;
    } else {
      low = middle + 1;
    }
  }
  const found = recordings[low - 1];
  return found && node <= found.to ? found : undefined;
}
