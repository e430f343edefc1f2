// Exports a pose graph and turns it into arrays.
import {timestampMs} from '@bufbuild/protobuf/wkt';
import {ConnectError, createClient} from '@connectrpc/connect';
import {createConnectTransport} from '@connectrpc/connect-web';

import {CovarianceForm} from '../../gen/revisit/v1/geometry_pb.js';
import {EdgeKind, type Edge, PoseGraphService} from
    '../../gen/revisit/v1/pose_graph_service_pb.js';
import type {Node} from '../../gen/revisit/v1/candidate_pb.js';
import {buildPyramid} from '../geometry/pyramid.js';
import type {Graph, GraphMessage, GraphRequest} from './graph.js';

function post(message: GraphMessage, transfer: Transferable[] = []): void {
  (self as unknown as Worker).postMessage(message, transfer);
}

/** Room for all nodes that the vehicle had when the export began. */
function emptyGraph(revision: number, size: number): Omit<Graph, 'pyramid'> {
  const numbers = () => new Float64Array(size);
  return {
    revision,
    size,
    sequence: numbers(),
    fraction: new Float32Array(size),
    time: numbers(),
    travelled: numbers(),
    x: numbers(),
    y: numbers(),
    heading: numbers(),
    covariance: new Float64Array(3 * size),
    joined: new Uint8Array(size),
    closures: new Uint32Array(0),
  };
}

function addNode(graph: Omit<Graph, 'pyramid'>, node: Node): void {
  const i = Number(node.index);
  graph.sequence[i] = Number(node.sequence);
  graph.fraction[i] = node.fraction;
  graph.time[i] = node.stamp ? timestampMs(node.stamp) : NaN;
  graph.travelled[i] = node.travelledMeters;
  graph.x[i] = node.pose!.xMeters;
  graph.y[i] = node.pose!.yMeters;
  graph.heading[i] = node.pose!.headingRadians;
  const {form, values} = node.covariance!;
  const yy = form === CovarianceForm.SPATIAL_10 ? 4 : 3;
  graph.covariance.set([values[0], values[1], values[yy]], 3 * i);
}

function addEdge(graph: Omit<Graph, 'pyramid'>, closures: number[],
                 edge: Edge): void {
  if (edge.kind === EdgeKind.CONSECUTIVE) {
    graph.joined[Number(edge.toIndex)] = 1;
  } else if (edge.kind === EdgeKind.LOOP_CLOSURE) {
    closures.push(Number(edge.fromIndex), Number(edge.toIndex));
  }
}

async function load({vehicle, origin, headers}: GraphRequest): Promise<void> {
  const service = createClient(
      PoseGraphService,
      createConnectTransport({baseUrl: origin, useBinaryFormat: true}));
  let graph: Omit<Graph, 'pyramid'>|undefined;
  const closures: number[] = [];
  let nodes = 0;
  for await (const part of service.exportPoseGraph({vehicle}, {headers})) {
    if (part.vehicle) {
      graph = emptyGraph(Number(part.vehicle.revision),
                         Number(part.vehicle.nodeCount));
    }
    for (const node of part.nodes) addNode(graph!, node);
    for (const edge of part.edges) addEdge(graph!, closures, edge);
    nodes += part.nodes.length;
    post({kind: 'progress', nodes});
  }
  if (!graph) throw new Error('The export has no vehicle.');
  graph.closures = Uint32Array.from(closures);
  const pyramid = buildPyramid(graph.x, graph.y, graph.joined);
  const whole: Graph = {...graph, pyramid};
  const arrays = [...Object.values(graph), ...Object.values(pyramid),
                  ...pyramid.levels.flatMap(
                      level => [level.nodes, level.starts])];
  const buffers = new Set<ArrayBuffer>();
  for (const value of arrays) {
    if (ArrayBuffer.isView(value)) buffers.add(value.buffer as ArrayBuffer);
  }
  post({kind: 'graph', graph: whole}, [...buffers]);
}

self.onmessage = ({data}: MessageEvent<GraphRequest>) => {
  load(data).catch((error: unknown) => {
    if (!(error instanceof ConnectError)) console.error(error);
    const {code, rawMessage: message} = ConnectError.from(error);
    post({kind: 'error', code, message});
  });
};
