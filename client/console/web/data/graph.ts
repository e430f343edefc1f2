// A vehicle's pose graph as the map and the curves need it: one array for each
// number of a node, by the node's index.
import {ConnectError} from '@connectrpc/connect';

import type {Pyramid} from '../geometry/pyramid.js';

/** The nodes of one revision. */
export interface Graph {
  revision: number;
  size: number;
  /** Last pose at or before the node, and how far the node lies behind it. */
  sequence: Float64Array;
  fraction: Float32Array;
  /** Milliseconds since 1970, or NaN. */
  time: Float64Array;
  travelled: Float64Array;
  x: Float64Array;
  y: Float64Array;
  heading: Float64Array;
  /** xx, xy, yy of each node, in square metres. */
  covariance: Float64Array;
  /** Whether an edge leads from the node before to this one. */
  joined: Uint8Array;
  /** Edges of confirmed loop closures: earlier node, later node, and so on. */
  closures: Uint32Array;
  pyramid: Pyramid;
}

export interface GraphRequest {
  vehicle: string;
  origin: string;
  headers: Record<string, string>;
}

export type GraphMessage =
    {kind: 'progress', nodes: number}|{kind: 'graph', graph: Graph}|
    {kind: 'error', code: ConnectError['code'], message: string};

/** Index of the last node at or before a pose, or -1. */
export function nodeAt(graph: Graph, sequence: number): number {
  let low = 0;
  let high = graph.size;
  while (low < high) {
    const middle = (low + high) >> 1;
    const beyond = graph.sequence[middle] > sequence ||
        (graph.sequence[middle] === sequence && graph.fraction[middle] > 0);
    if (beyond) {
      high = middle;
    } else {
      low = middle + 1;
    }
  }
  return low - 1;
}

/** Index of the first node that is as far along the path, or graph.size. */
export function nodeAtDistance(graph: Graph, travelled: number): number {
  let low = 0;
  let high = graph.size;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (graph.travelled[middle] < travelled) {
      low = middle + 1;
    } else {
      high = middle;
    }
  }
  return low;
}

/** The pose to ask at so that a search is made at this node, where there is
 * one: otherwise at the node before it. */
export function poseToAsk(graph: Graph, node: number): number {
  const sequence = graph.sequence[node];
  if (graph.fraction[node] === 0) return sequence;
  const nextIsLater = node + 1 < graph.size &&
      (graph.sequence[node + 1] > sequence + 1 ||
       (graph.sequence[node + 1] === sequence + 1 &&
        graph.fraction[node + 1] > 0));
  return nextIsLater ? sequence + 1 : sequence;
}

/**
 * The nodes at which a stream of these poses has its checks: the first at or
 * behind each multiple of the interval, from two sequence lengths on.
 */
export function checkNodes(graph: Graph, checkInterval: number,
                           sequenceLength: number): number[] {
  const nodes: number[] = [];
  let next = Math.ceil(2 * sequenceLength / checkInterval - 1e-9);
  for (;;) {
    const node = nodeAtDistance(graph, (next - 1e-9) * checkInterval);
    if (node >= graph.size) return nodes;
    nodes.push(node);
    next = Math.max(
        next + 1, Math.floor(graph.travelled[node] / checkInterval + 1e-9) + 1);
  }
}

/** Fetches the graph in a worker, so that the page stays smooth meanwhile. */
export class GraphLoader {
  private readonly worker = new Worker(
      new URL('./graph_worker.ts', import.meta.url), {type: 'module'});

  load(request: GraphRequest, onProgress: (nodes: number) => void):
      Promise<Graph> {
    return new Promise((resolve, reject) => {
      this.worker.onmessage = ({data}: MessageEvent<GraphMessage>) => {
        if (data.kind === 'progress') {
          onProgress(data.nodes);
        } else if (data.kind === 'graph') {
          resolve(data.graph);
        } else {
          reject(new ConnectError(data.message, data.code));
        }
      };
      this.worker.onerror = event => reject(new Error(event.message));
      this.worker.postMessage(request);
    });
  }

  close(): void {
    this.worker.terminate();
  }
}
