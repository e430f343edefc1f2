// Shared by the views of a vehicle: which candidates are asked for, and how
// its path, checks and decisions are drawn.
import {type Node, Verdict} from '../../gen/revisit/v1/candidate_pb.js';
import {allFound, type Answer, type Found, keyOf, pairOf, verdictName} from
    '../data/candidates.js';
import {type Decision, pairName} from '../data/decisions.js';
import {type Graph, nodeAt, nodeAtDistance} from '../data/graph.js';
import {type PlacedRecording, recordingOf} from '../data/recordings.js';
import type {VehicleStore} from '../data/vehicle.js';
import {type Colour, dots, type Mark, marks, type Shape, strokes,
        type Strokes, type Things} from '../draw/scene.js';
import {addEllipse, ellipse95} from '../geometry/ellipse.js';
import {PathDrawer} from '../geometry/path.js';
import {boxOf} from '../geometry/view.js';
import {probability} from '../parts/format.js';

const MOST_ELLIPSES = 400;

/** How verdicts are told apart: by colour, dash and mark. */
export const VERDICTS: Array<{
  verdict: Verdict, colour: Colour, dash?: [number, number], mark: Mark,
}> = [
  {verdict: Verdict.ACCEPTED, colour: 'accepted', mark: 'circle'},
  {verdict: Verdict.AMBIGUOUS, colour: 'ambiguous', dash: [9, 5],
   mark: 'diamond'},
  {verdict: Verdict.UNINFORMATIVE, colour: 'uninformative', dash: [2, 5],
   mark: 'bar'},
  {verdict: Verdict.REJECTED_BY_SHAPE, colour: 'rejected-by-shape',
   dash: [5, 3], mark: 'triangle'},
  {verdict: Verdict.REJECTED_BY_GATE, colour: 'rejected-by-gate',
   dash: [14, 4], mark: 'square'},
  {verdict: Verdict.ILL_CONDITIONED, colour: 'ill-conditioned', dash: [3, 8],
   mark: 'cross'},
];

/** The last checks up to a pose, the newest first, as many as may be
 * searched. */
export function posesToAsk(checks: ReadonlyArray<{pose: number}>, upTo: number,
                           most: number): number[] {
  return checks.map(({pose}) => pose).filter(pose => pose <= upTo)
      .slice(-most).reverse();
}

/** Accepted candidates about which nobody has decided, nor is about to. */
export function openQueue(store: VehicleStore): Found[] {
  return allFound(store.candidates.answers.value).filter(found =>
      found.candidate.verdict === Verdict.ACCEPTED &&
          store.isOpen(pairOf(found)));
}

export function linkTo(store: VehicleStore, found: Found): string {
  return `/vehicles/${store.id}/candidates/${keyOf(found)}`;
}

/** The path up to node `cut`, and what comes after it. */
export function pathShapes(graph: Graph, cut: number): Shape[] {
  const part = (id: string, label: string, colour: Colour, from: number,
                to: number): Strokes => {
    const drawer = new PathDrawer(graph, from, to);
    return {kind: 'strokes', id, label, colour, widthPixels: 2,
            segmentsIn: view => drawer.segmentsIn(view)};
  };
  const shapes: Shape[] = [];
  if (cut + 1 < graph.size) {
    shapes.push(part('ahead', 'Later path', 'path-ahead', cut,
                     graph.size - 1));
  }
  shapes.push(part('path', 'Path', 'path', 0, cut));
  shapes.push(dots({id: 'vehicle', label: 'Vehicle', colour: 'vehicle',
                    radiusPixels: 6}, [graph.x[cut], graph.y[cut]]));
  return shapes;
}

/** 95 % ellipses of the position at the nodes of checks, as claimed. */
export function ellipseShape(graph: Graph, nodes: number[]): Shape {
  let drawn = '';
  let segments = new Float32Array(0);
  return {
    kind: 'strokes',
    id: 'ellipses',
    label: '95 % ellipse at checks',
    colour: 'ellipse',
    widthPixels: 1,
    segmentsIn: view => {
      const {left, right, bottom, top} = boxOf(view);
      const inView = nodes.filter(
          i => graph.x[i] >= left && graph.x[i] <= right &&
              graph.y[i] >= bottom && graph.y[i] <= top);
      const step = Math.ceil(inView.length / MOST_ELLIPSES);
      const chosen = inView.filter((_, n) => n % step === 0);
      if (chosen.join() !== drawn) {
        drawn = chosen.join();
        const numbers: number[] = [];
        for (const i of chosen) {
          const [xx, xy, yy] = graph.covariance.subarray(3 * i, 3 * i + 3);
          addEllipse(numbers, graph.x[i], graph.y[i], ellipse95(xx, xy, yy));
        }
        segments = Float32Array.from(numbers);
      }
      return segments;
    },
  };
}

/** Where a node lies by the graph; by the search that named it, if the graph is
 * of before. */
function positionOf(graph: Graph, {index, sequence, pose}: Node):
    [number, number] {
  const i = Number(index);
  return graph.sequence[i] === Number(sequence) ?
      [graph.x[i], graph.y[i]] : [pose!.xMeters, pose!.yMeters];
}

function candidateTip({candidate}: Found): string {
  const {query, matched, verdict, probability: p} = candidate;
  return `${pairName({query: Number(query!.sequence),
                      matched: Number(matched!.sequence)})}: ${
      verdictName(verdict)}${p === undefined ? '' : `, ${probability(p)}`}`;
}

/** Links of candidates with marks in their middle, for each verdict. */
export function candidateShapes(store: VehicleStore, graph: Graph,
                                found: Found[]): Shape[] {
  // Accepted ones come last, and so lie above the others.
  return [...VERDICTS].reverse().flatMap(({verdict, colour, dash, mark}) => {
    const members =
        found.filter(({candidate}) => candidate.verdict === verdict);
    if (members.length === 0) return [];
    const segments = members.flatMap(({candidate: {query, matched}}) => [
      ...positionOf(graph, query!), ...positionOf(graph, matched!)]);
    const middles = members.flatMap((_, i) => [
      (segments[4 * i] + segments[4 * i + 2]) / 2,
      (segments[4 * i + 1] + segments[4 * i + 3]) / 2]);
    const things: Things = {
      link: i => linkTo(store, members[i]),
      tip: i => candidateTip(members[i]),
      key: i => keyOf(members[i]),
    };
    const name = verdictName(verdict);
    return [
      strokes({id: `candidates ${name}`, label: `Candidate, ${name}`, colour,
               dash, widthPixels: 2, things}, segments),
      marks({id: `marks ${name}`, label: '', colour, widthPixels: 2}, mark,
            middles),
    ];
  });
}

/** The stretches of path in which a verifier would look for the places, as far
 * as they lie before node `cut`. */
export function stretchShapes(
    graph: Graph, recordings: readonly PlacedRecording[], found: Found[],
    cut: number): Shape[] {
  const segments: number[] = [];
  for (const {candidate: {matched, placeInterval}} of found) {
    if (!placeInterval) continue;
    const centre = matched!.travelledMeters;
    const first = nodeAtDistance(graph, centre - placeInterval.metersBefore);
    const end = nodeAtDistance(graph, centre + placeInterval.metersAfter);
    // The interval keeps to the match's recording, because nodes of the one
    // before it or after it may be as far along the path.
    const {from, to} = recordingOf(recordings, Number(matched!.index)) ??
        {from: 0, to: graph.size - 1};
    for (let i = Math.max(first, from); i < Math.min(end, to, cut); ++i) {
      if (!graph.joined[i + 1]) continue;
      segments.push(graph.x[i], graph.y[i], graph.x[i + 1], graph.y[i + 1]);
    }
  }
  if (segments.length === 0) return [];
  return [strokes({id: 'stretches', label: 'Where a verifier would look',
                  colour: 'stretch', widthPixels: 7}, segments)];
}

/** Lines between pairs that were decided about, as far as both poses are at most
 * `upTo`: the query is the later one. */
export function decisionShapes(
    store: VehicleStore, graph: Graph,
    shape: {id: string, label: string, colour: Colour, dash?: [number, number]},
    decisions: readonly Decision[], upTo: number): Shape[] {
  const members = decisions.filter(
      ({query, matched}) => query <= upTo && nodeAt(graph, query) >= 0 &&
          nodeAt(graph, matched) >= 0);
  if (members.length === 0) return [];
  const segments = members.flatMap(({query, matched}) => {
    const [i, j] = [nodeAt(graph, query), nodeAt(graph, matched)];
    return [graph.x[i], graph.y[i], graph.x[j], graph.y[j]];
  });
  return [strokes({...shape, widthPixels: 4, things: {
    link: i => store.addressOf(members[i]),
    tip: i => `${pairName(members[i])}: ${members[i].kind}${
        members[i].note ? `, ${members[i].note}` : ''}`,
    key: i => members[i].name,
  }}, segments)];
}

/** Answers to checks up to a pose, by pose. */
export function answersUpTo(answers: ReadonlyMap<number, Answer>,
                            upTo: number): Map<number, Answer> {
  return new Map([...answers].filter(([pose]) => pose <= upTo)
                     .sort(([a], [b]) => a - b));
}
