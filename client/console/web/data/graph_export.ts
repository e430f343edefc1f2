// The export of a pose graph, read into arrays: in a worker, since that takes a while.
import {timestampMs} from '@bufbuild/protobuf/wkt';
import {createClient} from '@connectrpc/connect';
import {createConnectTransport} from '@connectrpc/connect-web';

import type {Node} from '../../gen/revisit/v1/candidate_pb.js';
import {CovarianceForm} from '../../gen/revisit/v1/geometry_pb.js';
import {type Edge, EdgeKind, PoseGraphService} from
    '../../gen/revisit/v1/pose_graph_service_pb.js';
import type {Vehicle} from '../../gen/revisit/v1/vehicle_pb.js';
import {type GraphRequest, type Nodes, noNodes} from './graph.js';

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
export interface GraphExport {
  /** The vehicle as it was then. */
  vehicle: Vehicle;
  nodesId: string;
  /** Index of its first node. */
  from: number;
  nodes: Nodes;
  closures: Uint32Array;
}

/** Exports a graph; `onProgress` is told how many nodes have come. */
export async function readGraph(
    {vehicle, origin, headers, nodesId, size}: GraphRequest,
    onProgress: (nodes: number) => void): Promise<GraphExport> {
  const service = createClient(
      PoseGraphService,
      createConnectTransport({baseUrl: origin, useBinaryFormat: true}));
  let read: GraphExport|undefined;
  const closures: number[] = [];
  let count = 0;
  const request = {vehicle, nodesId, firstNodeIndex: BigInt(size)};
  for await (const part of service.exportPoseGraph(request, {headers})) {
    if (part.vehicle) {
      const from = Number(part.firstNodeIndex);
      read = {
        vehicle: part.vehicle,
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
    onProgress(count);
  }
  if (!read) throw new Error('The export has no vehicle.');
  return {...read, closures: Uint32Array.from(closures)};
}
