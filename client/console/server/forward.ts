import type {DescMessage, DescMethodServerStreaming, DescMethodUnary,
             MessageInitShape} from '@bufbuild/protobuf';
import {EmptySchema} from '@bufbuild/protobuf/wkt';
import {Code, ConnectError, type ConnectRouter, type HandlerContext} from
    '@connectrpc/connect';

import {Health} from '../gen/grpc/health/v1/health_pb.js';
import {PoseGraphService} from '../gen/revisit/v1/pose_graph_service_pb.js';
import {type Cluster, type Route, vehicleOf} from './cluster.js';

// All that the page may call. Streams of poses, revisions, and what cannot be
// undone are not among them, whatever the caller's token would allow.
const calls = PoseGraphService.method;
const UNARY: DescMethodUnary[] = [
  calls.getVehicle, calls.listVehicles, calls.findCandidates,
  calls.addLoopClosure, calls.listLoopClosures, calls.deleteLoopClosure,
  calls.rejectCandidate, calls.listRejectedCandidates,
  calls.deleteRejectedCandidate, calls.listPoses, calls.getServerInfo,
  Health.method.check,
];
const STREAMS: DescMethodServerStreaming[] = [calls.exportPoseGraph];

const PASSED_ON = ['authorization', 'x-request-id'];

function passedOn(context: HandlerContext, {headers: added}: Route): Headers {
  const headers = new Headers(added);
  for (const name of PASSED_ON) {
    const value = context.requestHeader.get(name);
    if (value !== null) headers.set(name, value);
  }
  return headers;
}

/** The error with its code, message and details, but without the transport's
 * own headers. A connection that was reset is reported by the transport like a
 * call that the caller gave up; the caller is told which of the two it was. */
function answerTo(context: HandlerContext, error: unknown): ConnectError {
  const received = ConnectError.from(error);
  const wasReset =
      received.code === Code.Canceled && !context.signal.aborted;
  const answer = new ConnectError(
      received.rawMessage, wasReset ? Code.Unavailable : received.code);
  answer.details = received.details;
  return answer;
}

async function* one<T>(message: T): AsyncIterable<T> {
  yield message;
}

function forwardUnary<I extends DescMessage, O extends DescMessage>(
    router: ConnectRouter, cluster: Cluster,
    method: DescMethodUnary<I, O>): void {
  router.rpc(method, async (request, context) => {
    try {
      const answer = await cluster.call(
          vehicleOf(request),
          route => route.transport.unary(
              method, context.signal, context.timeoutMs(),
              passedOn(context, route), request as MessageInitShape<I>));
      return answer.message as MessageInitShape<O>;
    } catch (error) {
      throw answerTo(context, error);
    }
  });
}

// Graphs have millions of nodes, so the parts of the answer are not decoded:
// all that they hold is unknown to an empty message, which keeps it as bytes.
function forwardStream(router: ConnectRouter, cluster: Cluster,
                       decoded: DescMethodServerStreaming): void {
  const method = {...decoded, output: EmptySchema};
  router.rpc(method, async function*(request, context) {
    try {
      // An answer that begins comes from the owner.
      const {first, rest} = await cluster.call(vehicleOf(request),
                                               async route => {
        const answer = await route.transport.stream(
            method, context.signal, context.timeoutMs(),
            passedOn(context, route), one(request as never));
        const messages = answer.message[Symbol.asyncIterator]();
        return {first: await messages.next(), rest: messages};
      });
      for (let part = first; !part.done; part = await rest.next()) {
        yield part.value;
      }
    } catch (error) {
      throw answerTo(context, error);
    }
  });
}

/** Makes the router answer each call with what the cluster answers. */
export function forward(router: ConnectRouter, cluster: Cluster): void {
  for (const method of UNARY) forwardUnary(router, cluster, method);
  for (const method of STREAMS) forwardStream(router, cluster, method);
}
