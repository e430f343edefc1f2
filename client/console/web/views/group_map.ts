// How the members of a group are drawn in the frame of one of them: each path in
// its colour, and the links between them.
import {FrameState} from '../../gen/revisit/v1/recording_pb.js';
import {type Frames, frameAt, isExact, isKnown, type MemberFrame, onMap} from
    '../data/group_frames.js';
import {type Link, posesName, type PosePlace} from '../data/group_links.js';
import type {MemberPath} from '../data/group_paths.js';
import {type Colour, dots, marks, type PlaceName, RECORDING_COLOURS,
        type Scene, type Shape, strokes, type Things} from '../draw/scene.js';
import {addEllipse, ellipse95} from '../geometry/ellipse.js';
import {boxAround} from '../geometry/view.js';
import {count, length} from '../parts/format.js';
import {withinText} from '../parts/within.js';

const ESTIMATE_DASH: [number, number] = [8, 4];
const MOST_NAMES_IN_LEGEND = 3;

/** What there is to draw. */
export interface GroupScene {
  /** The members' ids. */
  members: readonly string[];
  frames: Frames;
  paths: ReadonlyMap<string, MemberPath>;
}

const MEMBER_COLOURS = ['path', ...RECORDING_COLOURS] as const;

/** Each member's colour. Where there are more members than colours, names and
 * what is pointed at tell those of one colour apart. */
export function coloursOf(members: readonly string[]): Map<string, Colour> {
  return new Map(members.map(
      (id, k) => [id, MEMBER_COLOURS[k % MEMBER_COLOURS.length]]));
}

/** The poses of each member that links name. */
export function posesOfLinks(links: readonly Link[]):
    Map<string, Set<number>> {
  const poses = new Map<string, Set<number>>();
  for (const {query, matched} of links) {
    for (const {vehicle, sequence} of [query, matched]) {
      const before = poses.get(vehicle) ?? new Set();
      poses.set(vehicle, before.add(sequence));
    }
  }
  return poses;
}

/** A link with both of its ends on the map. */
export interface PlacedLink {
  link: Link;
  ends: [number, number, number, number];
  /** Whether it is known where both frames lie, not only estimated. */
  isKnown: boolean;
  /** How far apart the map has the two ends, in metres. */
  apart: number;
}

/** A link as the map has it; undefined where an end is not on it. */
export function placeLink(link: Link,
                          {frames, paths}: Omit<GroupScene, 'members'>):
    PlacedLink|undefined {
  const place = ({vehicle, sequence}: PosePlace) => {
    const frame = frameAt(frames.get(vehicle), sequence);
    const own = paths.get(vehicle)?.poses.get(sequence);
    const at = own && onMap(frame, ...own);
    return at && {at, known: isKnown(frame!)};
  };
  const query = place(link.query);
  const matched = place(link.matched);
  if (!query || !matched) return undefined;
  return {
    link, ends: [...query.at, ...matched.at],
    isKnown: query.known && matched.known,
    apart: Math.hypot(query.at[0] - matched.at[0], query.at[1] - matched.at[1]),
  };
}

/** How a frame of a member is tied to that of the map, for people. */
export function frameText(frame: Pick<MemberFrame, 'state'|'doubt'>|undefined):
    string {
  if (!frame) return 'not known';
  const within = isExact(frame) ? 'exactly' : withinText(frame);
  switch (frame.state) {
    case FrameState.SAME: return 'the map is in its frame';
    case FrameState.AFTER: return `${within}, by where recordings began`;
    case FrameState.DATUM: return `${within}, by datums or fixes`;
    case FrameState.PROVISIONAL:
      return `provisional, ${within}, by too few loop closures`;
    case FrameState.KNOWN: return `known ${within}, by loop closures`;
    default: return 'not placed';
  }
}

/** Segments of a member's path on the map: where it is known that they lie there,
 * and where that is estimated. */
export function segmentsOf({x, y, sequence, joined}: MemberPath,
                           frames: readonly MemberFrame[]):
    {known: number[], estimated: number[]} {
  const segments = {known: [] as number[], estimated: [] as number[]};
  for (let i = 1; i < x.length; ++i) {
    if (!joined[i]) continue;
    const frame = frameAt(frames, sequence[i]);
    const from = onMap(frame, x[i - 1], y[i - 1]);
    if (!from) continue;
    segments[isKnown(frame!) ? 'known' : 'estimated'].push(
        ...from, ...onMap(frame, x[i], y[i])!);
  }
  return segments;
}

/** What a member is called: by its display name, if that is known. */
export function titleOf(id: string, paths: GroupScene['paths']): string {
  return paths.get(id)?.title || id;
}

/** The members of one colour, with what is drawn alike. */
interface Strand {
  colour: Colour;
  isEstimate: boolean;
  members: string[];
  segments: number[];
  /** Number of the segment behind the last one of each member. */
  ends: number[];
}

function strandsOf({members, frames, paths}: GroupScene): Strand[] {
  const colours = coloursOf(members);
  const strands = new Map<string, Strand>();
  for (const id of members) {
    const path = paths.get(id);
    if (!path) continue;
    const {known, estimated} = segmentsOf(path, frames.get(id) ?? []);
    for (const [segments, isEstimate] of
         [[known, false], [estimated, true]] as const) {
      if (segments.length === 0) continue;
      const colour = colours.get(id)!;
      const key = `${colour} ${isEstimate}`;
      const strand = strands.get(key) ??
          {colour, isEstimate, members: [], segments: [], ends: []};
      strands.set(key, strand);
      strand.members.push(id);
      for (const number of segments) strand.segments.push(number);
      strand.ends.push(strand.segments.length / 4);
    }
  }
  return [...strands.values()];
}

function legendText({members, isEstimate}: Strand,
                    {frames, paths}: GroupScene): string {
  const names = members.slice(0, MOST_NAMES_IN_LEGEND).map(id => {
    const estimated = frames.get(id)!.find(
        frame => frame.motion && !isKnown(frame) === isEstimate);
    const path = `${titleOf(id, paths)}, ${length(paths.get(id)!.travelled)}`;
    return isEstimate ? `${path}, ${frameText(estimated)}` : path;
  });
  const more = members.length - names.length;
  return names.join('; ') + (more > 0 ? ` and ${count(more)} others` : '');
}

function strandShape(strand: Strand, scene: GroupScene): Shape {
  const {colour, isEstimate, members, segments, ends} = strand;
  const owners = new Uint16Array(segments.length / 4);
  ends.forEach((end, k) => owners.fill(k, ends[k - 1] ?? 0, end));
  const of = (segment: number) => members[owners[segment]];
  return strokes({
    id: `members ${colour} ${isEstimate ? 'estimated' : ''}`,
    label: legendText(strand, scene), colour, widthPixels: 2,
    dash: isEstimate ? ESTIMATE_DASH : undefined,
    things: {
      link: i => `/vehicles/${of(i)}`,
      tip: i => titleOf(of(i), scene.paths),
      key: of,
    },
  }, segments);
}

/** 95 % ellipses of where estimated frames lie. */
function doubtShapes({members, frames, paths}: GroupScene): Shape[] {
  const colours = coloursOf(members);
  const outlines = new Map<Colour, number[]>();
  for (const id of members.filter(one => paths.has(one))) {
    const colour = colours.get(id)!;
    for (const frame of frames.get(id) ?? []) {
      if (isKnown(frame) || !frame.doubt) continue;
      const numbers = outlines.get(colour) ?? [];
      outlines.set(colour, numbers);
      addEllipse(numbers, frame.doubt.x, frame.doubt.y,
                 ellipse95(...frame.doubt.covariance));
    }
  }
  return [...outlines].map(([colour, numbers]) => strokes(
      {id: `doubts ${colour}`, label: '', colour, dash: [3, 3],
       widthPixels: 1.5}, numbers));
}

function thingsOf(at: (i: number) => PlacedLink): Things {
  return {
    link: i => `/vehicles/${at(i).link.query.vehicle}?at=${
        at(i).link.query.sequence}`,
    tip: i => {
      const {link, apart} = at(i);
      return `${posesName(link)}, ${length(apart)} apart${
          link.note ? `: ${link.note}` : ''}`;
    },
    key: i => at(i).link.name,
  };
}

function linkShapes(placed: readonly PlacedLink[]): Shape[] {
  return [true, false].flatMap((known): Shape[] => {
    const of = placed.filter(one => one.isKnown === known);
    if (of.length === 0) return [];
    const colour = 'closure';
    const ends = of.flatMap(one => one.ends);
    return [
      strokes({id: `links ${known}`, colour, widthPixels: 4,
               label: known ? 'Link of two known frames' :
                              'Link of frames that are estimated',
               dash: known ? undefined : ESTIMATE_DASH,
               things: thingsOf(i => of[i])}, ends),
      // A link whose two ends are at one place would not be seen otherwise.
      marks({id: `marks ${known}`, label: '', colour, widthPixels: 2},
            known ? 'square' : 'circle', ends),
      dots({id: `ends ${known}`, label: '', colour, radiusPixels: 2,
            things: thingsOf(i => of[i >> 1])}, ends),
    ];
  });
}

/** The first places of members, each with its name. */
function namesOf({members, frames, paths}: GroupScene): PlaceName[] {
  const colours = coloursOf(members);
  return members.flatMap(id => {
    const path = paths.get(id);
    if (!path) return [];
    for (let i = 0; i < path.x.length; ++i) {
      const at = onMap(frameAt(frames.get(id), path.sequence[i]), path.x[i],
                       path.y[i]);
      if (!at) continue;
      return [{text: titleOf(id, paths), colour: colours.get(id)!, x: at[0],
               y: at[1]}];
    }
    return [];
  });
}

export function sceneOfGroup(scene: GroupScene,
                             placed: readonly PlacedLink[]): Scene {
  const strands = strandsOf(scene);
  const names = namesOf(scene);
  const starts = [...new Set(names.map(({colour}) => colour))].map(
      colour => dots({id: `starts ${colour}`, label: '', colour,
                      radiusPixels: 4},
                     names.filter(name => name.colour === colour)
                         .flatMap(({x, y}) => [x, y])));
  return {
    shapes: [...strands.map(strand => strandShape(strand, scene)).reverse(),
             ...doubtShapes(scene), ...starts, ...linkShapes(placed)],
    box: boxAround(strands.flatMap(({segments}) => segments)),
    names,
  };
}
