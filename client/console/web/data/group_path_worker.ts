// Exports a member's pose graph, and keeps of it what a map of many shows.
import {ConnectError} from '@connectrpc/connect';

import {buildPyramid} from '../geometry/pyramid.js';
import {thin} from '../geometry/thin.js';
import {nodeAt} from './graph.js';
import {readGraph} from './graph_export.js';
import type {PathMessage, PathRequest} from './group_path_store.js';
import type {MemberPath} from './group_paths.js';

function post(message: PathMessage, transfer: Transferable[] = []): void {
  (self as unknown as Worker).postMessage(message, transfer);
}

async function read({mostPoints, poses, ...request}: PathRequest):
    Promise<MemberPath> {
  const {vehicle, nodes} = await readGraph(
      {...request, nodesId: '', size: 0}, () => undefined);
  const graph = {...nodes, size: nodes.x.length};
  const {nodes: kept, joined, toleranceMeters, isCut} =
      thin(buildPyramid(nodes.x, nodes.y, nodes.joined), mostPoints);
  const pick = (numbers: Float64Array) =>
      Float64Array.from(kept, node => numbers[node]);
  return {
    title: vehicle.displayName,
    revision: vehicle.revision,
    travelled: vehicle.travelledMeters,
    x: pick(nodes.x), y: pick(nodes.y), sequence: pick(nodes.sequence),
    joined, toleranceMeters, isCut,
    poses: new Map(poses.map(pose => {
      const node = nodeAt(graph, pose);
      return [pose, node < 0 ? undefined : [nodes.x[node], nodes.y[node]]];
    })),
  };
}

self.onmessage = ({data}: MessageEvent<PathRequest>) => {
  read(data).then(
      path => post({kind: 'path', path},
                   [path.x, path.y, path.sequence, path.joined].map(
                       ({buffer}) => buffer as ArrayBuffer)),
      (error: unknown) => {
        if (!(error instanceof ConnectError)) console.error(error);
        const {code, rawMessage: message} = ConnectError.from(error);
        post({kind: 'error', code, message});
      });
};
