// A path of up to millions of nodes, ready to be drawn at any scale: for each
// scale those nodes that are needed so that no other one lies farther from the
// drawn line than the scale's tolerance.

/** Nodes of one chunk after another; chunk c has nodes[starts[c]] up to, but
 * without, nodes[starts[c + 1]]. */
export interface Level {
  toleranceMeters: number;
  nodes: Uint32Array;
  starts: Uint32Array;
}

export interface Pyramid {
  /** First and last node of each chunk. */
  first: Uint32Array;
  last: Uint32Array;
  /** Least x, least y, greatest x, greatest y of each chunk. */
  boxes: Float64Array;
  /** From the finest. Level 0 has all nodes. */
  levels: Level[];
}

const CHUNK_NODES = 2048;
const FINEST_TOLERANCE_METERS = 0.1;
const TOLERANCE_FACTOR = 3;
const LEVELS = 12;

/** Chunks of joined nodes, from one of them on. Neighbours share a node where
 * they are joined. */
function splitIntoChunks(from: number, size: number, joined: Uint8Array):
    {first: number[], last: number[]} {
  const first: number[] = [];
  const last: number[] = [];
  let begin = from;
  for (let i = from + 1; i <= size; ++i) {
    const cut = i === size || !joined[i];
    if (!cut && i - begin < CHUNK_NODES) continue;
    first.push(begin);
    last.push(cut ? i - 1 : i);
    begin = i;
  }
  return {first, last};
}

/** Keeps those of `nodes` that the line needs so that the others lie within the
 * tolerance (Douglas and Peucker), the first and the last one always. */
function simplify(nodes: Uint32Array, x: Float64Array, y: Float64Array,
                  tolerance: number, kept: number[]): void {
  const keep = new Uint8Array(nodes.length);
  keep[0] = keep[nodes.length - 1] = 1;
  const open = [[0, nodes.length - 1]];
  for (let range = open.pop(); range; range = open.pop()) {
    const [from, to] = range;
    const x0 = x[nodes[from]];
    const y0 = y[nodes[from]];
    const dx = x[nodes[to]] - x0;
    const dy = y[nodes[to]] - y0;
    const square = dx * dx + dy * dy;
    let farthest = -1;
    let most = tolerance * tolerance;
    for (let i = from + 1; i < to; ++i) {
      const px = x[nodes[i]] - x0;
      const py = y[nodes[i]] - y0;
      const along = square > 0 ?
          Math.min(1, Math.max(0, (px * dx + py * dy) / square)) :
          0;
      const ex = px - along * dx;
      const ey = py - along * dy;
      const distance = ex * ex + ey * ey;
      if (distance > most) {
        most = distance;
        farthest = i;
      }
    }
    if (farthest < 0) continue;
    keep[farthest] = 1;
    open.push([from, farthest], [farthest, to]);
  }
  for (let i = 0; i < nodes.length; ++i) {
    if (keep[i]) kept.push(nodes[i]);
  }
}

function simplifyLevel(finer: Level, x: Float64Array, y: Float64Array,
                       toleranceMeters: number): Level {
  const kept: number[] = [];
  const starts = new Uint32Array(finer.starts.length);
  for (let c = 0; c + 1 < starts.length; ++c) {
    simplify(finer.nodes.subarray(finer.starts[c], finer.starts[c + 1]), x, y,
             toleranceMeters, kept);
    starts[c + 1] = kept.length;
  }
  return {toleranceMeters, nodes: Uint32Array.from(kept), starts};
}

/** Least x, least y, greatest x, greatest y of each chunk. */
export function boxesOf(first: Uint32Array, last: Uint32Array, x: Float64Array,
                        y: Float64Array): Float64Array {
  const boxes = new Float64Array(4 * first.length);
  for (let c = 0; c < first.length; ++c) {
    const box = [Infinity, Infinity, -Infinity, -Infinity];
    for (let i = first[c]; i <= last[c]; ++i) {
      box[0] = Math.min(box[0], x[i]);
      box[1] = Math.min(box[1], y[i]);
      box[2] = Math.max(box[2], x[i]);
      box[3] = Math.max(box[3], y[i]);
    }
    boxes.set(box, 4 * c);
  }
  return boxes;
}

/** All nodes of all chunks. */
function finestLevel(first: Uint32Array, last: Uint32Array): Level {
  const starts = new Uint32Array(first.length + 1);
  for (let c = 0; c < first.length; ++c) {
    starts[c + 1] = starts[c] + last[c] - first[c] + 1;
  }
  const nodes = new Uint32Array(starts[first.length]);
  for (let c = 0; c < first.length; ++c) {
    for (let i = first[c]; i <= last[c]; ++i) {
      nodes[starts[c] + i - first[c]] = i;
    }
  }
  return {toleranceMeters: 0, nodes, starts};
}

/** The pyramid of the nodes from one on. */
function buildFrom(from: number, x: Float64Array, y: Float64Array,
                   joined: Uint8Array): Pyramid {
  const chunks = splitIntoChunks(from, x.length, joined);
  const first = Uint32Array.from(chunks.first);
  const last = Uint32Array.from(chunks.last);
  const levels = [finestLevel(first, last)];
  let tolerance = FINEST_TOLERANCE_METERS;
  while (levels.length < LEVELS) {
    levels.push(simplifyLevel(levels[levels.length - 1], x, y, tolerance));
    tolerance *= TOLERANCE_FACTOR;
  }
  return {first, last, boxes: boxesOf(first, last, x, y), levels};
}

export function buildPyramid(x: Float64Array, y: Float64Array,
                             joined: Uint8Array): Pyramid {
  return buildFrom(0, x, y, joined);
}

function joinArrays<Numbers extends Uint32Array|Float64Array>(
    before: Numbers, after: Numbers): Numbers {
  const Kind = before.constructor as new (size: number) => Numbers;
  const both = new Kind(before.length + after.length);
  both.set(before);
  both.set(after, before.length);
  return both;
}

/** The same as buildPyramid() makes of nodes of which the first `pyramid` has:
 * all chunks but the last one stay as they are. */
export function growPyramid(pyramid: Pyramid, x: Float64Array, y: Float64Array,
                            joined: Uint8Array): Pyramid {
  const kept = pyramid.first.length - 1;
  if (kept < 0) return buildPyramid(x, y, joined);
  const tail = buildFrom(pyramid.first[kept], x, y, joined);
  return {
    first: joinArrays(pyramid.first.subarray(0, kept), tail.first),
    last: joinArrays(pyramid.last.subarray(0, kept), tail.last),
    boxes: joinArrays(pyramid.boxes.subarray(0, 4 * kept), tail.boxes),
    levels: pyramid.levels.map(({toleranceMeters, nodes, starts}, i) => {
      const added = tail.levels[i];
      const end = starts[kept];
      return {
        toleranceMeters,
        nodes: joinArrays(nodes.subarray(0, end), added.nodes),
        starts: joinArrays(starts.subarray(0, kept),
                           added.starts.map(start => start + end)),
      };
    }),
  };
}
