// Exports a pose graph and turns it into arrays.
import {timestampMs} from '@bufbuild/protobuf/wkt';
import {ConnectError, createClient} from '@connectrpc/connect';
import {createConnectTransport} from '@connectrpc/connect-web';

import {CovarianceForm} from '../../gen/revisit/v1/geometry_pb.js';
import {EdgeKind, type Edge, PoseGraphService} from
    '../../gen/revisit/v1/pose_graph_service_pb.js';
import type {Node} from '../../gen/revisit/v1/candidate_pb.js';
import {buildPyramid} from '../geometry/pyramid.js';
import {type GraphMessage, type GraphRequest, type Nodes, noNodes} from
    './graph.js';

function post(message: GraphMessage, transfer: Transferable[] = []): void {
  (self as unknown as Worker).postMessage(message, transfer);
}

/** Puts node number `from + i` of the vehicle at place i. */
function addNode(nodes: Nodes, from: number, node: Node): void {
  const i = Number(node.index) - from;
  nodes.sequence[i] = Number(node.sequence);
  nodes.fraction[i] = node.fraction;
  nodes.time[i] = node.stamp ? timestampMs(node.stamp) : NaN;
  nodes.travelled[i] = node.travelledMeters;
  nodes.x[i] = node.pose!.xMeters;
  nodes.y[i] = node.pose!.yMeters;
  nodes.heading[i] = node.pose!.headingRadians;
  const {form, values} = node.covariance!;
  const yy = form === CovarianceForm.SPATIAL_10 ? 4 : 3;
  nodes.covariance.set([values[0], values[1], values[yy]], 3 * i);
}

function addEdge(nodes: Nodes, from: number, closures: number[], edge: Edge):
    void {
  if (edge.kind === EdgeKind.CONSECUTIVE) {
    nodes.joined[Number(edge.toIndex) - from] = 1;
  } else if (edge.kind === EdgeKind.LOOP_CLOSURE) {
    closures.push(Number(edge.fromIndex), Number(edge.toIndex));
  }
}

/** The answer of one export. */
interface Export {
  revision: number;
  nodesId: string;
  /** Index of its first node. */
  from: number;
  nodes: Nodes;
  closures: Uint32Array;
}

async function read({vehicle, origin, headers, nodesId, size}: GraphRequest):
    Promise<Export> {
  const service = createClient(
      PoseGraphService,
      createConnectTransport({baseUrl: origin, useBinaryFormat: true}));
  let read: Export|undefined;
  const closures: number[] = [];
  let count = 0;
  const request = {vehicle, nodesId, firstNodeIndex: BigInt(size)};
  for await (const part of service.exportPoseGraph(request, {headers})) {
    if (part.vehicle) {
      const from = Number(part.firstNodeIndex);
      read = {
        revision: Number(part.vehicle.revision),
        nodesId: part.nodesId,
        from,
        nodes: noNodes(Number(part.vehicle.nodeCount) - from),
        closures: new Uint32Array(0),
      };
    }
    for (const node of part.nodes) addNode(read!.nodes, read!.from, node);
    for (const edge of part.edges) {
      addEdge(read!.nodes, read!.from, closures, edge);
    }
    count += part.nodes.length;
    post({kind: 'progress', nodes: count});
  }
  if (!read) throw new Error('The export has no vehicle.');
  return {...read, closures: Uint32Array.from(closures)};
}

async function load(request: GraphRequest): Promise<void> {
  const {revision, nodesId, from, nodes, closures} = await read(request);
  const buffers = new Set(
      Object.values(nodes).map(({buffer}) => buffer as ArrayBuffer));
  if (from > 0) {
    post({kind: 'growth', growth: {revision, nodes, closures}}, [...buffers]);
    return;
  }
  const pyramid = buildPyramid(nodes.x, nodes.y, nodes.joined);
  const levels = pyramid.levels.flatMap(level => [level.nodes, level.starts]);
  for (const {buffer} of [pyramid.first, pyramid.last, pyramid.boxes,
                          ...levels]) {
    buffers.add(buffer as ArrayBuffer);
  }
  post({kind: 'graph', graph: {...nodes, revision, nodesId, closures, pyramid,
                               size: nodes.x.length}}, [...buffers]);
}

self.onmessage = ({data}: MessageEvent<GraphRequest>) => {
  load(data).catch((error: unknown) => {
    if (!(error instanceof ConnectError)) console.error(error);
    const {code, rawMessage: message} = ConnectError.from(error);
    post({kind: 'error', code, message});
  });
};
