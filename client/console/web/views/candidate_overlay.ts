// How both passes of a pair are laid over each other.
import type {Candidate} from '../../gen/revisit/v1/candidate_pb.js';
import type {Pair} from '../data/decisions.js';
import {type Graph, nodeAt, nodeAtDistance} from '../data/graph.js';
import type {Curve} from '../draw/curve.js';
import {dots, type Scene, strokes} from '../draw/scene.js';
import {apply, fit} from '../geometry/rigid.js';
import {boxAround} from '../geometry/view.js';

/** Nodes that are drawn before and behind the aligned ones. */
const CONTEXT_NODES = 25;

export interface Overlay {
  scene: Scene;
  residuals: Curve;
}

/** Nodes of this pass with those of the earlier one, the oldest first. */
export type AlignedNodes = Array<[number, number]>;

/** The pairs that a search has aligned; none where they are not those of this
 * graph. */
export function alignedBySearch(graph: Graph, {alignedPath}: Candidate):
    AlignedNodes {
  const pairs = alignedPath.map(
      ({queryIndex, matchedIndex}): [number, number] =>
          [Number(queryIndex), Number(matchedIndex)]);
  return pairs.some(([q, m]) => q >= graph.size || m >= graph.size) ? [] :
                                                                      pairs;
}

/** The aligned nodes of an earlier pass that was driven the same way (`sense` -1)
 * or the other way (1), as far back as both passes go without a gap. */
function alignedInSense(graph: Graph, q: number, m: number, sense: 1|-1,
                        lengthMeters: number): AlignedNodes {
  const {travelled, joined} = graph;
  const pairs: AlignedNodes = [];
  let before = m;
  for (let i = q; i >= 0; --i) {
    const back = travelled[q] - travelled[i];
    const distance = travelled[m] + sense * back;
    const j = nodeAtDistance(graph, distance - 1e-6);
    if (back > lengthMeters || distance < 0 || j >= graph.size) break;
    const gone = joined.subarray(Math.min(before, j) + 1,
                                 Math.max(before, j) + 1);
    if (gone.includes(0)) break;
    before = j;
    pairs.push([i, j]);
    if (!joined[i]) break;
  }
  return pairs.reverse();
}

/** Square metres that are left of each pair where this pass lies on the earlier
 * one as well as it can. */
function misfit({x, y}: Graph, pairs: AlignedNodes): number {
  const moved = fit(pairs.flatMap(([q]) => [x[q], y[q]]),
                    pairs.flatMap(([, m]) => [x[m], y[m]]));
  return pairs.reduce((sum, [q, m]) => {
    const [px, py] = apply(moved, x[q], y[q]);
    return sum + (px - x[m]) ** 2 + (py - y[m]) ** 2;
  }, 0) / pairs.length;
}

/** Nodes that lie as far before the query as those of the earlier pass before
 * the match (behind it, where that was driven the other way), as far back as
 * `lengthMeters`: for pairs that no search offers today. Where both poses are not
 * `inOneFrame`, their headings do not say which way that was: then it is the one
 * in which the shapes are more alike. */
export function alignedByDistance(graph: Graph, {query, matched}: Pair,
                                  lengthMeters: number, inOneFrame: boolean):
    AlignedNodes {
  const [q, m] = [nodeAt(graph, query), nodeAt(graph, matched)];
  if (q < 0 || m < 0) return [];
  const aligned = (sense: 1|-1) =>
      alignedInSense(graph, q, m, sense, lengthMeters);
  const {heading} = graph;
  if (inOneFrame) {
    return aligned(Math.cos(heading[q] - heading[m]) < 0 ? 1 : -1);
  }
  const [same, opposite] = [aligned(-1), aligned(1)];
  return misfit(graph, opposite) < misfit(graph, same) ? opposite : same;
}

/** Both passes, the recent one moved and turned so that it lies on the earlier
 * one as well as it can, and how far the pairs are apart then. */
export function overlayOf(graph: Graph, pairs: AlignedNodes):
    Overlay|undefined {
  if (pairs.length === 0) return undefined;
  const {x, y, heading, travelled} = graph;
  // Metres from the matched node, in which small differences are not lost.
  const [, end] = pairs[pairs.length - 1];
  const at = (i: number): [number, number] => [x[i] - x[end], y[i] - y[end]];
  const moved = fit(pairs.flatMap(([q]) => at(q)),
                    pairs.flatMap(([, m]) => at(m)));
  const movedAt = (i: number) => apply(moved, ...at(i));
  const path = (indices: number[], place: (i: number) => [number, number]) => {
    const [first, last] = [Math.min(...indices), Math.max(...indices)];
    // Beyond a gap there may be another recording, in another frame.
    let [least, most] = [first, last];
    while (least > first - CONTEXT_NODES && graph.joined[least]) --least;
    while (most < last + CONTEXT_NODES && graph.joined[most + 1]) ++most;
    const segments: number[] = [];
    for (let i = least; i < most; ++i) {
      if (graph.joined[i + 1]) segments.push(...place(i), ...place(i + 1));
    }
    return segments;
  };
  const matchedPath = path(pairs.map(([, m]) => m), at);
  const queryPath = path(pairs.map(([q]) => q), movedAt);
  const [lastQuery] = pairs[pairs.length - 1];
  const residuals = pairs.map(([q, m]) => {
    const [px, py] = movedAt(q);
    const [mx, my] = at(m);
    const [cosine, sine] = [Math.cos(heading[m]), Math.sin(heading[m])];
    return {
      back: travelled[q] - travelled[lastQuery],
      along: cosine * (px - mx) + sine * (py - my),
      across: -sine * (px - mx) + cosine * (py - my),
    };
  }).sort((a, b) => a.back - b.back);
  return {
    scene: {
      shapes: [
        strokes({id: 'pairs', label: 'Aligned pairs', colour: 'grid',
                 widthPixels: 1},
                pairs.flatMap(([q, m]) => [...movedAt(q), ...at(m)])),
        strokes({id: 'matched', label: 'Earlier pass',
                 colour: 'matched-path', widthPixels: 3}, matchedPath),
        strokes({id: 'query', label: 'This pass, laid over it',
                 colour: 'query-path', widthPixels: 2}, queryPath),
        dots({id: 'matched end', label: 'Match', colour: 'matched-path',
              radiusPixels: 6}, at(end)),
        dots({id: 'query end', label: 'Query', colour: 'query-path',
              radiusPixels: 4}, movedAt(lastQuery)),
      ],
      box: boxAround([...matchedPath, ...queryPath]),
    },
    residuals: {
      title: 'Residuals of the aligned pairs, m',
      xLabel: 'm from the query',
      x: residuals.map(({back}) => back),
      series: [
        {label: 'along the earlier pass', colour: 'path', as: 'line',
         values: residuals.map(({along}) => along)},
        {label: 'across it', colour: 'query-path', as: 'line',
         values: residuals.map(({across}) => across)},
      ],
    },
  };
}
