// How recordings of a vehicle are drawn and told: each in its colour, under its
// name, in the frame of the last one, or by itself where it is not placed in that.
import {FrameState} from '../../gen/revisit/v1/recording_pb.js';
import type {Candidate} from '../../gen/revisit/v1/candidate_pb.js';
import type {Pair} from '../data/decisions.js';
import {type Graph, nodeAt} from '../data/graph.js';
import {type PlacedRecording, recordingId, recordingOf, recordingTitle} from
    '../data/recordings.js';
import {type Colour, dots, type PlaceName, RECORDING_COLOURS, type Shape,
        strokes, type Strokes} from '../draw/scene.js';
import {addEllipse, ellipse95} from '../geometry/ellipse.js';
import {StretchesDrawer} from '../geometry/path.js';
import type {Box} from '../geometry/view.js';
import {count} from '../parts/format.js';
import {type Column, Table} from '../parts/table.js';
import {withinText} from '../parts/within.js';
import {setQuery} from '../route.js';

const ESTIMATE_DASH: [number, number] = [8, 4];
const MOST_NAMES_IN_LEGEND = 2;

type Recordings = readonly PlacedRecording[];

/** Whether its place in the last recording's frame is not yet known. */
function isEstimate({state}: PlacedRecording): boolean {
  return state !== FrameState.SAME && state !== FrameState.KNOWN;
}

function colourFor(recordings: Recordings, recording: PlacedRecording): Colour {
  const k = recordings.indexOf(recording);
  return k + 1 === recordings.length ?
      'path' : RECORDING_COLOURS[k % RECORDING_COLOURS.length];
}

/** The recordings that a map shows: the chosen one by itself, or all that are
 * placed. */
export function shownOf(recordings: Recordings, chosen: string|null):
    Recordings {
  const alone = recordings.filter(({id}) => id === chosen);
  return alone.length > 0 ? alone :
                            recordings.filter(({isPlaced}) => isPlaced);
}

/** Whether a map that shows these recordings shows a node. Of a vehicle with one
 * recording, it shows all. */
export function isShownIn(recordings: Recordings, shown: Recordings,
                          node: number): boolean {
  const recording = recordingOf(recordings, node);
  return recordings.length === 0 ||
      (recording !== undefined && shown.includes(recording));
}

/** The box around these recordings. */
export function boxOfRecordings({x, y}: Graph, shown: Recordings):
    Box|undefined {
  if (shown.length === 0) return undefined;
  const box = {left: Infinity, right: -Infinity, bottom: Infinity,
               top: -Infinity};
  for (const {from, to} of shown) {
    for (let i = from; i <= to; ++i) {
      box.left = Math.min(box.left, x[i]);
      box.right = Math.max(box.right, x[i]);
      box.bottom = Math.min(box.bottom, y[i]);
      box.top = Math.max(box.top, y[i]);
    }
  }
  return box;
}

/** The recordings of both poses of a pair. */
export function recordingsOf(graph: Graph, recordings: Recordings,
                             {query, matched}: Pair):
    Array<PlacedRecording|undefined> {
  return [query, matched].map(
      sequence => recordingOf(recordings, nodeAt(graph, sequence)));
}

/** Whether the graph has both poses of a pair in one frame. */
export function areInOneFrame(graph: Graph, recordings: Recordings, pair: Pair):
    boolean {
  const [query, matched] = recordingsOf(graph, recordings, pair);
  return query === matched || (!!query?.isPlaced && !!matched?.isPlaced);
}

/** Where the recording lies in the frame of the last one, for people. */
function placeText(recording: PlacedRecording): string {
  const within = withinText(recording);
  switch (recording.state) {
    case FrameState.SAME: return 'the map is in its frame';
    case FrameState.AFTER: return `${within}, by where recordings began`;
    case FrameState.DATUM: return `${within}, by a datum`;
    case FrameState.PROVISIONAL:
      return `${within}, by too few loop closures`;
    case FrameState.KNOWN: return `known ${within}, by loop closures`;
    default: return 'not placed yet';
  }
}

/** How the frames of a candidate's two poses are tied, for people. */
export function tieText({frameState, difference}: Candidate): string {
  switch (frameState) {
    case FrameState.SAME: return 'both poses are in one recording';
    case FrameState.AFTER: return 'tied by where the recordings began';
    case FrameState.DATUM: return 'tied by a datum that they share';
    case FrameState.PROVISIONAL:
      return 'tied by confirmed loop closures, somewhere by fewer than three ' +
          'that agree';
    case FrameState.KNOWN: return 'tied by confirmed loop closures';
    case FrameState.NONE:
      return difference ?
          'tied by matches since the recording began, none of them confirmed' :
          'not tied: the shapes alone were compared';
    default: return '–';
  }
}

/** The title of the recording in which a candidate's match lies. */
export function titleOfMatch(recordings: Recordings,
                             {recordingOfMatch}: Candidate): string {
  const id = recordingId(recordingOfMatch);
  return recordings.find(other => other.id === id)?.title ??
      recordingTitle('', id);
}

/** The recordings that look alike, in groups of one colour and dash: a vehicle may
 * have a thousand. */
function groupsOf(recordings: Recordings, shown: Recordings):
    Array<{colour: Colour, estimated: boolean, members: PlacedRecording[]}> {
  const groups = new Map<string, ReturnType<typeof groupsOf>[number]>();
  for (const recording of shown) {
    const colour = colourFor(recordings, recording);
    const estimated = shown.length > 1 && isEstimate(recording);
    const key = `${colour} ${estimated}`;
    const group = groups.get(key) ?? {colour, estimated, members: []};
    group.members.push(recording);
    groups.set(key, group);
  }
  return [...groups.values()];
}

function legendText(members: PlacedRecording[], estimated: boolean): string {
  const names = members.slice(0, MOST_NAMES_IN_LEGEND)
      .map(recording => recording.title +
          (estimated ? `, placed ${withinText(recording)}` : ''));
  const more = members.length - names.length;
  return names.join('; ') + (more > 0 ? ` and ${count(more)} others` : '');
}

/** The paths of these recordings up to node `cut`, paler what comes after it;
 * those that are only estimated to lie there dashed, each with the 95 % ellipse of
 * its place. The last shape is the vehicle, if it is there. */
export function recordingShapes(graph: Graph, recordings: Recordings,
                                shown: Recordings, cut: number): Shape[] {
  const drawn = (shape: Omit<Strokes, 'kind'|'segmentsIn'|'widthPixels'>,
                 stretches: Array<[number, number]>): Shape[] => {
    if (stretches.length === 0) return [];
    const drawer = new StretchesDrawer(graph, stretches);
    return [{...shape, kind: 'strokes', widthPixels: 2,
             segmentsIn: view => drawer.segmentsIn(view)}];
  };
  const ahead = drawn(
      {id: 'ahead', label: 'Later path', colour: 'path-ahead'},
      shown.filter(({to}) => to > cut).map(
          ({from, to}) => [Math.max(from, cut), to]));
  const paths = groupsOf(recordings, shown).flatMap(
      ({colour, estimated, members}) => {
    const begun = members.filter(({from}) => from <= cut);
    const id = `path ${colour} ${estimated ? 'estimated' : ''}`;
    const label = legendText(begun, estimated);
    const path = drawn(
        {id, label, colour, dash: estimated ? ESTIMATE_DASH : undefined},
        begun.map(({from, to}) => [from, Math.min(to, cut)]));
    const outlines: number[] = [];
    for (const {doubt} of estimated ? begun : []) {
      if (!doubt) continue;
      addEllipse(outlines, doubt.x, doubt.y, ellipse95(...doubt.covariance));
    }
    return outlines.length === 0 ? path :
        [...path, strokes({id: `doubt ${id}`, label: '', colour,
                           dash: [3, 3], widthPixels: 1.5}, outlines)];
  });
  const starts = groupsOf(recordings, shown).map(({colour, members}) => dots(
      {id: `starts ${colour}`, label: '', colour, radiusPixels: 4},
      members.filter(({from}) => from <= cut)
          .flatMap(({from}) => [graph.x[from], graph.y[from]])));
  return [...ahead, ...paths, ...starts,
          ...isShownIn(recordings, shown, cut) ?
              [dots({id: 'vehicle', label: 'Vehicle', colour: 'vehicle',
                     radiusPixels: 6}, [graph.x[cut], graph.y[cut]])] : []];
}

/** The names of recordings at their first nodes, the latest first. */
export function recordingNames(graph: Graph, recordings: Recordings,
                               shown: Recordings): PlaceName[] {
  return shown.map(recording => ({
    text: recording.title, colour: colourFor(recordings, recording),
    x: graph.x[recording.from], y: graph.y[recording.from],
  })).reverse();
}

/** All recordings with how each is placed, and the way to see one by itself. */
export function RecordingTable({recordings, chosen}:
    {recordings: Recordings, chosen: string|null}) {
  const columns: Array<Column<PlacedRecording>> = [
    {title: 'Recording', by: ({title}) => title, cell: recording => (
      <>
        <span class={`swatch ${colourFor(recordings, recording)} ${
            recording.isPlaced && isEstimate(recording) ? 'dashed' : ''}`} />
        {recording.title}
      </>)},
    {title: 'Map', cell: ({id, title}) => (
      <button type="button" aria-pressed={id === chosen}
              aria-label={`Alone: ${title}`}
              onClick={() => setQuery('recording',
                                      id === chosen ? undefined : id)}>
        Alone
      </button>)},
    {title: 'Placed', by: placeText, cell: placeText},
    {title: 'Poses', number: true, by: ({firstSequence}) => firstSequence,
     cell: ({firstSequence, lastSequence}) =>
         `${count(firstSequence)}–${count(lastSequence)}`},
  ];
  return <Table label="Recordings" columns={columns} rows={[...recordings]}
                keyOf={({id}) => id} current={chosen ?? undefined} empty="" />;
}

/** Says what the map leaves out, and how sure it is of the rest. */
export function ShownRecordings({recordings, chosen}:
    {recordings: Recordings, chosen: string|null}) {
  const alone = recordings.find(({id}) => id === chosen);
  const unplaced = recordings.filter(({isPlaced}) => !isPlaced);
  if (alone) {
    return (
      <p class="hint" role="status">
        The map shows {alone.title} alone{alone.isPlaced ? '' :
            ', in its own frame: it is not placed yet'}.{' '}
        <button type="button" onClick={() => setQuery('recording', undefined)}>
          Show all that are placed
        </button>
      </p>
    );
  }
  return (
    <>
      {unplaced.length > 0 && (
        <p class="hint" role="status">
          {count(unplaced.length)} of {count(recordings.length)} recordings{' '}
          {unplaced.length === 1 ? 'is' : 'are'} not placed yet, and not on the
          map: a confirmed loop closure ties a recording to the last one.
        </p>
      )}
      {recordings.some(one => one.isPlaced && isEstimate(one)) && (
        <p class="hint">
          Dashed recordings are placed by an estimate, in 95 of 100 cases to
          within so much. A confirmed loop closure ties them; with three that
          agree it is known where they lie.
        </p>
      )}
    </>
  );
}
