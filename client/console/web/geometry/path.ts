import type {Graph} from '../data/graph.js';
import {boxOf, type View} from './view.js';

// How far a node may lie from the line that is drawn, in pixels. The levels of
// the pyramid are made from each other, so that their tolerances add up to half
// as much again.
const TOLERANCE_PIXELS = 0.35;
// Chunks this far outside of the view are kept, in parts of its size, so that
// moving the map a little changes nothing.
const MARGIN = 0.25;

/** Draws nodes [from, to] of a graph, as far as a view can show them. */
export class PathDrawer {
  private drawn = '';
  private segments: Float32Array = new Float32Array(0);

  constructor(private readonly graph: Graph, private readonly from: number,
              private readonly to: number) {}

  /** Segments x0, y0, x1, y1; the same array while nothing has changed. */
  segmentsIn(view: View): Float32Array {
    const level = this.levelFor(view);
    const chunks = this.chunksIn(view);
    const drawn = `${level} ${chunks.join()}`;
    if (drawn !== this.drawn) {
      this.drawn = drawn;
      this.segments = this.draw(level, chunks);
    }
    return this.segments;
  }

  private levelFor(view: View): number {
    const {levels} = this.graph.pyramid;
    const allowed = TOLERANCE_PIXELS * view.metersPerPixel;
    let level = 0;
    while (level + 1 < levels.length &&
           levels[level + 1].toleranceMeters <= allowed) {
      ++level;
    }
    return level;
  }

  private chunksIn(view: View): number[] {
    const {first, boxes} = this.graph.pyramid;
    // The box is widened in steps, so that it stays as it is for a while.
    const box = boxOf(view);
    const step = MARGIN * view.metersPerPixel * Math.max(view.width,
                                                         view.height);
    const left = Math.floor(box.left / step - 1) * step;
    const bottom = Math.floor(box.bottom / step - 1) * step;
    const right = Math.ceil(box.right / step + 1) * step;
    const top = Math.ceil(box.top / step + 1) * step;
    const chunks: number[] = [];
    for (let c = this.firstChunk(); first[c] <= this.to; ++c) {
      if (boxes[4 * c] > right || boxes[4 * c + 1] > top ||
          boxes[4 * c + 2] < left || boxes[4 * c + 3] < bottom) {
        continue;
      }
      chunks.push(c);
    }
    return chunks;
  }

  /** The first chunk that does not end before the first node. */
  private firstChunk(): number {
    const {last} = this.graph.pyramid;
    let low = 0;
    let high = last.length;
    while (low < high) {
      const middle = (low + high) >> 1;
      if (last[middle] < this.from) {
        low = middle + 1;
      } else {
        high = middle;
      }
    }
    return low;
  }

  private draw(level: number, chunks: number[]): Float32Array {
    const {x, y, pyramid} = this.graph;
    const {nodes, starts} = pyramid.levels[level];
    const numbers: number[] = [];
    for (const c of chunks) {
      let before = -1;
      const add = (node: number) => {
        if (before >= 0 && node !== before) {
          numbers.push(x[before], y[before], x[node], y[node]);
        }
        before = node;
      };
      const first = Math.max(this.from, pyramid.first[c]);
      const last = Math.min(this.to, pyramid.last[c]);
      add(first);
      for (let i = starts[c]; i < starts[c + 1]; ++i) {
        if (nodes[i] > first && nodes[i] < last) add(nodes[i]);
      }
      add(last);
    }
    return Float32Array.from(numbers);
  }
}

/** Draws several stretches of nodes as one. */
export class StretchesDrawer {
  private readonly drawers: PathDrawer[];
  private parts: Float32Array[] = [];
  private segments: Float32Array = new Float32Array(0);

  /** Each stretch is its first and its last node. */
  constructor(graph: Graph, stretches: ReadonlyArray<[number, number]>) {
    this.drawers = stretches.map(([from, to]) =>
                                     new PathDrawer(graph, from, to));
  }

  /** Segments x0, y0, x1, y1; the same array while nothing has changed. */
  segmentsIn(view: View): Float32Array {
    const parts = this.drawers.map(drawer => drawer.segmentsIn(view));
    if (parts.some((part, i) => part !== this.parts[i])) {
      this.parts = parts;
      this.segments = new Float32Array(
          parts.reduce((sum, part) => sum + part.length, 0));
      let at = 0;
      for (const part of parts) {
        this.segments.set(part, at);
        at += part.length;
      }
    }
    return this.segments;
  }
}
