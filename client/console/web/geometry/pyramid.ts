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

/** Chunks of joined nodes. Neighbours share a node where they are joined. */
function splitIntoChunks(size: number, joined: Uint8Array):
    {first: number[], last: number[]} {
  const first: number[] = [];
  const last: number[] = [];
  let begin = 0;
  for (let i = 1; i <= size; ++i) {
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

export function buildPyramid(x: Float64Array, y: Float64Array,
                             joined: Uint8Array): Pyramid {
  const chunks = splitIntoChunks(x.length, joined);
  const first = Uint32Array.from(chunks.first);
  const last = Uint32Array.from(chunks.last);
  const boxes = new Float64Array(4 * first.length);
  const starts = new Uint32Array(first.length + 1);
  for (let c = 0; c < first.length; ++c) {
    const box = [Infinity, Infinity, -Infinity, -Infinity];
    for (let i = first[c]; i <= last[c]; ++i) {
      box[0] = Math.min(box[0], x[i]);
      box[1] = Math.min(box[1], y[i]);
      box[2] = Math.max(box[2], x[i]);
      box[3] = Math.max(box[3], y[i]);
    }
    boxes.set(box, 4 * c);
    starts[c + 1] = starts[c] + last[c] - first[c] + 1;
  }
  const all = new Uint32Array(starts[first.length]);
  for (let c = 0; c < first.length; ++c) {
    for (let i = first[c]; i <= last[c]; ++i) {
      all[starts[c] + i - first[c]] = i;
    }
  }
  const levels: Level[] = [{toleranceMeters: 0, nodes: all, starts}];
  let tolerance = FINEST_TOLERANCE_METERS;
  while (levels.length < LEVELS) {
    levels.push(simplifyLevel(levels[levels.length - 1], x, y, tolerance));
    tolerance *= TOLERANCE_FACTOR;
  }
  return {first, last, boxes, levels};
}
