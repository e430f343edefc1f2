import type {IncomingMessage} from 'node:http';

import type {DescMessage, DescMethod, DescMethodServerStreaming,
             DescMethodUnary, MessageInitShape} from '@bufbuild/protobuf';
import {EmptySchema} from '@bufbuild/protobuf/wkt';
import {Code, ConnectError, type ConnectRouter, type HandlerContext} from
    '@connectrpc/connect';

import {Health} from '../gen/grpc/health/v1/health_pb.js';
import {PoseGraphService} from '../gen/revisit/v1/pose_graph_service_pb.js';
import {type Cluster, type Route, vehicleOf} from './cluster.js';
import {nameOf, RECORD} from './record.js';
import type {Telemetry} from './telemetry.js';

// All that the page may call. Streams of poses, revisions, and what cannot be
// undone are not among them, whatever the caller's token would allow.
const calls = PoseGraphService.method;
const UNARY: DescMethodUnary[] = [
  calls.getVehicle, calls.listVehicles, calls.listRecordings,
  calls.findCandidates, calls.listChecks,
  calls.addLoopClosure, calls.listLoopClosures, calls.deleteLoopClosure,
  calls.rejectCandidate, calls.listRejectedCandidates,
  calls.deleteRejectedCandidate, calls.listDeletedPosePairs, calls.listPoses,
  calls.getGroup, calls.listGroups, calls.listGroupMembers,
  calls.addInterVehicleLoopClosure, calls.listInterVehicleLoopClosures,
  calls.deleteInterVehicleLoopClosure, calls.rejectInterVehicleCandidate,
  calls.listInterVehicleRejectedCandidates,
  calls.deleteInterVehicleRejectedCandidate, calls.listFrameTransforms,
  calls.getServerInfo, Health.method.check,
];
const STREAMS: DescMethodServerStreaming[] =
    [calls.exportPoseGraph, calls.watchCandidates];
/** Streams that never end by themselves: the console's end is theirs, since
 * waiting for them would be in vain, and the page goes on from its cursor. */
const ENDLESS = new Set<DescMethod>([calls.watchCandidates]);

/** Methods that leave revisitd as it is. */
const READING = /^(Get|List|Find|Export|Watch|Check)/;

/** The bytes that gRPC counts for a header beside its name and its value. */
const HEADER_BYTES = 32;

/** How many bytes of a caller's headers a call takes to revisitd. A call with
 * more than revisitd allows ends the connection, and with it everybody's calls:
 * whoever calls `forward` has to see to that. */
export function metadataBytes({headers}: IncomingMessage): number {
  return headers.authorization === undefined ? 0 : HEADER_BYTES +
      'authorization'.length + Buffer.byteLength(headers.authorization);
}

function passedOn(context: HandlerContext, {headers: added}: Route): Headers {
  const headers = new Headers(added);
  const authorization = context.requestHeader.get('authorization');
  if (authorization !== null) headers.set('authorization', authorization);
  const trace = context.values.get(RECORD)?.trace;
  if (trace) {
    headers.set('x-request-id', trace.requestId);
    headers.set('traceparent', trace.traceParent);
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

/** Notes one call from its beginning on. Returns what notes its end. */
function begin(telemetry: Telemetry, method: DescMethod,
               context: HandlerContext): (error?: ConnectError) => void {
  const began = performance.now();
  const record = context.values.get(RECORD);
  if (record) record.changes = !READING.test(method.name);
  const streams = method.methodKind !== 'unary';
  if (streams) telemetry.streamBegan();
  return error => {
    if (streams) telemetry.streamEnded();
    telemetry.called(method.name, error ? nameOf(error.code) : 'OK',
                     (performance.now() - began) / 1000);
    record?.ended(error?.code, error?.rawMessage);
  };
}

function forwardUnary<I extends DescMessage, O extends DescMessage>(
    router: ConnectRouter, cluster: Cluster, telemetry: Telemetry,
    method: DescMethodUnary<I, O>): void {
  router.rpc(method, async (request, context) => {
    const end = begin(telemetry, method, context);
    try {
      const answer = await cluster.call(
          vehicleOf(request),
          route => route.transport.unary(
              method, context.signal, context.timeoutMs(),
              passedOn(context, route), request as MessageInitShape<I>));
      end();
      return answer.message as MessageInitShape<O>;
    } catch (error) {
      const told = answerTo(context, error);
      end(told);
      throw told;
    }
  });
}

// Graphs have millions of nodes, so the parts of the answer are not decoded:
// all that they hold is unknown to an empty message, which keeps it as bytes.
function forwardStream(router: ConnectRouter, cluster: Cluster,
                       telemetry: Telemetry, stopping: AbortSignal,
                       decoded: DescMethodServerStreaming): void {
  const method = {...decoded, output: EmptySchema};
  router.rpc(method, async function*(request, context) {
    const end = begin(telemetry, method, context);
    let told: ConnectError|undefined =
        new ConnectError('the caller went away', Code.Canceled);
    try {
      // An answer that begins comes from the owner.
      const {first, rest, heard} = await cluster.call(vehicleOf(request),
                                                      async route => {
        const answer = await route.transport.stream(
            method, context.signal, context.timeoutMs(),
            passedOn(context, route), one(request as never));
        const messages = answer.message[Symbol.asyncIterator]();
        return {first: await messages.next(), rest: messages,
                heard: route.heard};
      });
      for (let part = first; !part.done; part = await rest.next()) {
        heard();
        yield part.value;
      }
      told = undefined;
    } catch (error) {
      told = answerTo(context, error);
      throw told;
    } finally {
      end(told);
    }
  }, ENDLESS.has(decoded) ? {shutdownSignal: stopping} : {});
}

/** Makes the router answer each call with what the cluster answers; `stopping`
 * ends those that never end by themselves. */
export function forward(router: ConnectRouter, cluster: Cluster,
                        telemetry: Telemetry, stopping: AbortSignal): void {
  for (const method of UNARY) forwardUnary(router, cluster, telemetry, method);
  for (const method of STREAMS) {
    forwardStream(router, cluster, telemetry, stopping, method);
  }
}
