// Turns an exported pose graph into arrays.
import {ConnectError} from '@connectrpc/connect';

import {buildPyramid} from '../geometry/pyramid.js';
import type {GraphMessage, GraphRequest} from './graph.js';
import {readGraph} from './graph_export.js';

function post(message: GraphMessage, transfer: Transferable[] = []): void {
  (self as unknown as Worker).postMessage(message, transfer);
}

async function load(request: GraphRequest): Promise<void> {
  const {vehicle, nodesId, from, nodes, closures} = await readGraph(
      request, count => post({kind: 'progress', nodes: count}));
  const revision = Number(vehicle.revision);
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
