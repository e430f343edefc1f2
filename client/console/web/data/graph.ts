// A vehicle's pose graph as the map and the curves need it: one array for each
// number of a node, by the node's index.
import {ConnectError} from '@connectrpc/connect';

import {growPyramid, type Pyramid} from '../geometry/pyramid.js';

/** Nodes that follow each other, with one number of each in an array. */
export interface Nodes {
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
}

/** The nodes of one revision. */
export interface Graph extends Nodes {
  revision: number;
  size: number;
  /** As long as it is the same, nodes are only added. */
  nodesId: string;
  /** Edges of confirmed loop closures: earlier node, later node, and so on. */
  closures: Uint32Array;
  pyramid: Pyramid;
}

/** The part of a vehicle's graph that an earlier one lacks. */
export interface Growth extends Pick<Graph, 'revision'|'closures'> {
  nodes: Nodes;
}

export interface GraphRequest {
  vehicle: string;
  origin: string;
  headers: Record<string, string>;
  /** The nodes that are here already are those of this id; none for ''. */
  nodesId: string;
  size: number;
}

export type GraphMessage =
    {kind: 'progress', nodes: number}|{kind: 'graph', graph: Graph}|
    {kind: 'growth', growth: Growth}|
    {kind: 'error', code: ConnectError['code'], message: string};

/** How much more room than needed grown arrays have, so that they are copied
 * rarely. */
const SPARE = 1.125;
const ITEMS: Array<[keyof Nodes, number]> = [
  ['sequence', 1], ['fraction', 1], ['time', 1], ['travelled', 1], ['x', 1],
  ['y', 1], ['heading', 1], ['covariance', 3], ['joined', 1],
];

/** `before` with `added` behind it. The room of `before` is used where it
 * suffices: views of it stay what they are. */
function extended<Numbers extends Float64Array|Float32Array|Uint8Array>(
    before: Numbers, added: Numbers): Numbers {
  const Kind = before.constructor as {
    new (size: number): Numbers, BYTES_PER_ELEMENT: number,
    new (buffer: ArrayBufferLike, offset: number, size: number): Numbers};
  const size = before.length + added.length;
  if (before.byteOffset + size * Kind.BYTES_PER_ELEMENT <=
      before.buffer.byteLength) {
    const both = new Kind(before.buffer, before.byteOffset, size);
    both.set(added, before.length);
    return both;
  }
  const roomy = new Kind(Math.ceil(SPARE * size));
  roomy.set(before);
  roomy.set(added, before.length);
  return roomy.subarray(0, size) as Numbers;
}

/** The graph with what came. REQUIRES: nothing was added to `graph` before. */
export function grown(graph: Graph, {revision, closures, nodes}: Growth):
    Graph {
  const added = nodes.x.length;
  if (added === 0) return {...graph, revision, closures};
  const all = Object.fromEntries(ITEMS.map(
      ([name]) => [name, extended(graph[name] as Float64Array,
                                  nodes[name] as Float64Array)])) as
      unknown as Nodes;
  return {
    ...graph, ...all, revision, closures, size: graph.size + added,
    pyramid: growPyramid(graph.pyramid, all.x, all.y, all.joined),
  };
}

/** Room for so many nodes. */
export function noNodes(size: number): Nodes {
  return Object.fromEntries(ITEMS.map(([name, width]) => [
    name, name === 'fraction' ? new Float32Array(size) :
          name === 'joined' ? new Uint8Array(size) :
                              new Float64Array(width * size),
  ])) as unknown as Nodes;
}

/** Index of the last node at or before a pose, or -1. */
export function nodeAt(
    graph: Pick<Graph, 'size'|'sequence'|'fraction'>, sequence: number):
    number {
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

  /** The graph as it is now, made of the one before where that is possible. */
  load(vehicle: string, headers: Record<string, string>, before: Graph|undefined,
       onProgress: (nodes: number) => void): Promise<Graph> {
    return new Promise((resolve, reject) => {
      this.worker.onmessage = ({data}: MessageEvent<GraphMessage>) => {
        if (data.kind === 'progress') {
          onProgress(data.nodes);
        } else if (data.kind === 'graph') {
          resolve(data.graph);
        } else if (data.kind === 'growth') {
          resolve(grown(before!, data.growth));
        } else {
          reject(new ConnectError(data.message, data.code));
        }
      };
      this.worker.onerror = event => reject(new Error(event.message));
      const request: GraphRequest = {
        vehicle, headers, origin: location.origin,
        nodesId: before?.nodesId ?? '', size: before?.size ?? 0,
      };
      this.worker.postMessage(request);
    });
  }

  close(): void {
    this.worker.terminate();
  }
}
