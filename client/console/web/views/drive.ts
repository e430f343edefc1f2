// Shared by the views of a vehicle: which candidates are asked for, and how
// its path, checks and decisions are drawn.
import {type Candidate, Verdict} from '../../gen/revisit/v1/candidate_pb.js';
import {allFound, type Answer, type Found, keyOf} from
    '../data/candidates.js';
import {type Graph, nodeAt, nodeAtDistance} from '../data/graph.js';
import type {VehicleStore} from '../data/vehicle.js';
import {type Colour, dots, type Shape, strokes, type Strokes} from
    '../draw/scene.js';
import {addEllipse, ellipse95} from '../geometry/ellipse.js';
import {PathDrawer} from '../geometry/path.js';
import {boxOf} from '../geometry/view.js';

/** A drive may have tens of thousands of checks; so many are asked about. */
export const MOST_CHECKS = 500;
const MOST_ELLIPSES = 400;

export const VERDICTS: Array<{verdict: Verdict, colour: Colour}> = [
  {verdict: Verdict.ACCEPTED, colour: 'accepted'},
  {verdict: Verdict.AMBIGUOUS, colour: 'ambiguous'},
  {verdict: Verdict.UNINFORMATIVE, colour: 'uninformative'},
  {verdict: Verdict.REJECTED_BY_SHAPE, colour: 'rejected-by-shape'},
  {verdict: Verdict.REJECTED_BY_GATE, colour: 'rejected-by-gate'},
  {verdict: Verdict.ILL_CONDITIONED, colour: 'ill-conditioned'},
];

/** The last checks up to a pose, the newest first. */
export function posesToAsk(checks: ReadonlyArray<{pose: number}>,
                           upTo: number): number[] {
  return checks.map(({pose}) => pose).filter(pose => pose <= upTo)
      .slice(-MOST_CHECKS).reverse();
}

/** Accepted candidates about which nobody has decided. */
export function openQueue(store: VehicleStore): Found[] {
  return allFound(store.candidates.answers.value).filter(
      ({candidate}) => candidate.verdict === Verdict.ACCEPTED &&
          !decisionAbout(store, candidate));
}

/** The decision about a candidate, if it had been made at pose `upTo`. */
export function decisionAbout(store: VehicleStore, candidate: Candidate,
                              upTo = Infinity) {
  return store.decisionAbout(Number(candidate.query!.sequence),
                             Number(candidate.matched!.sequence), upTo);
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

/** Links of candidates, one shape for each verdict. */
export function candidateShapes(store: VehicleStore, found: Found[]): Shape[] {
  // Accepted ones come last, and so lie above the others.
  return [...VERDICTS].reverse().flatMap(({verdict, colour}) => {
    const members =
        found.filter(({candidate}) => candidate.verdict === verdict);
    if (members.length === 0) return [];
    const segments = members.flatMap(({candidate: {query, matched}}) => [
      query!.pose!.xMeters, query!.pose!.yMeters,
      matched!.pose!.xMeters, matched!.pose!.yMeters,
    ]);
    const label = Verdict[verdict].toLowerCase().replaceAll('_', ' ');
    return [strokes({id: `candidates ${label}`, label: `Candidate, ${label}`,
                     colour, widthPixels: 2,
                     link: i => linkTo(store, members[i])}, segments)];
  });
}

/** The stretches of path in which a verifier would look for the places, as far
 * as they lie before node `cut`. */
export function stretchShapes(graph: Graph, found: Found[], cut: number):
    Shape[] {
  const segments: number[] = [];
  for (const {candidate: {matched, placeInterval}} of found) {
    if (!placeInterval) continue;
    const centre = matched!.travelledMeters;
    const first = nodeAtDistance(graph, centre - placeInterval.metersBefore);
    const end = nodeAtDistance(graph, centre + placeInterval.metersAfter);
    for (let i = first; i < Math.min(end, cut); ++i) {
      if (!graph.joined[i + 1]) continue;
      segments.push(graph.x[i], graph.y[i], graph.x[i + 1], graph.y[i + 1]);
    }
  }
  if (segments.length === 0) return [];
  return [strokes({id: 'stretches', label: 'Where a verifier would look',
                  colour: 'stretch', widthPixels: 7}, segments)];
}

/** Lines between pairs of poses, as far as both are at most `upTo`: the query is
 * the later one. */
export function pairShapes(
    graph: Graph, shape: {id: string, label: string, colour: Colour},
    pairs: ReadonlyArray<{querySequence: bigint, matchedSequence: bigint}>,
    upTo: number): Shape[] {
  const segments: number[] = [];
  for (const {querySequence, matchedSequence} of pairs) {
    if (Number(querySequence) > upTo) continue;
    const i = nodeAt(graph, Number(querySequence));
    const j = nodeAt(graph, Number(matchedSequence));
    if (i < 0 || j < 0) continue;
    segments.push(graph.x[i], graph.y[i], graph.x[j], graph.y[j]);
  }
  return segments.length > 0 ?
      [strokes({...shape, widthPixels: 4}, segments)] : [];
}

/** Answers to checks up to a pose, by pose. */
export function answersUpTo(answers: ReadonlyMap<number, Answer>,
                            upTo: number): Map<number, Answer> {
  return new Map([...answers].filter(([pose]) => pose <= upTo)
                     .sort(([a], [b]) => a - b));
}
