import { setTimeout as sleep } from "node:timers/promises";

import { ClientError, Status } from "nice-grpc";

import { Candidate, CandidateSet, Node, Verdict } from "../gen/revisit/v1/candidate.js";
import { Pose } from "../gen/revisit/v1/geometry.js";
import {
  PoseGraphServiceClient,
  StreamPosesOpen,
  StreamPosesOpened,
  StreamPosesRequest,
} from "../gen/revisit/v1/pose_graph_service.js";
import { Vehicle } from "../gen/revisit/v1/vehicle.js";
import { waitBeforeRetry } from "./details.js";
import { columnsOf } from "./drive.js";

const BATCH = 64;

/**
 * Streams the poses until all are durable, over as many connections as it takes;
 * resolves to the accepted candidates that came.
 */
export async function stream(
  client: PoseGraphServiceClient,
  vehicle: Vehicle,
  poses: Pose[],
): Promise<Candidate[]> {
  const accepted: Candidate[] = [];
  // Whoever outlives this program keeps uid and acked sequence, beside the poses.
  const opening = StreamPosesOpen.fromPartial({
    vehicle: vehicle.name,
    vehicleUid: vehicle.uid,
    sendCandidates: true,
  });
  for (let attempt = 1; ; ++attempt) {
    const opened = deferred<StreamPosesOpened | undefined>();
    try {
      for await (const answer of client.streamPoses(
        requests(opening, poses, opened.promise),
      )) {
        if (answer.opened) {
          opening.ackedSequence = answer.opened.durableSequence;
          console.log(`stream: open, durable up to ${opening.ackedSequence}`);
          opened.resolve(answer.opened);
        } else if (answer.ack) {
          opening.ackedSequence = answer.ack.durableSequence;
          attempt = 0;
        } else if (answer.candidates) {
          accepted.push(...report(answer.candidates));
        }
      }
      return accepted;
    } catch (error) {
      const wait =
        error instanceof ClientError ? waitBeforeRetry(error, attempt) : undefined;
      if (wait === undefined) {
        throw error;
      }
      console.log(
        `stream: lost at ${opening.ackedSequence} ` +
          `(${Status[(error as ClientError).code]}), again in ${(wait / 1e3).toFixed(1)} s`,
      );
      await sleep(wait);
    } finally {
      // Lets the requests of a stream that was never opened come to their end.
      opened.resolve(undefined);
    }
  }
}

/** One stream's requests, taken no faster than the server reads them. */
async function* requests(
  opening: StreamPosesOpen,
  poses: Pose[],
  opened: Promise<StreamPosesOpened | undefined>,
): AsyncIterable<StreamPosesRequest> {
  yield StreamPosesRequest.fromPartial({ open: opening });
  const answer = await opened;
  if (answer === undefined) {
    return;
  }
  for (let next = Number(answer.durableSequence); next < poses.length; next += BATCH) {
    const part = poses.slice(next, next + BATCH);
    // Servers that know no columns take the same poses as messages.
    const batch = answer.takesPoseColumns ? { columns: columnsOf(part) } : { poses: part };
    yield StreamPosesRequest.fromPartial({ batch });
  }
}

/** Prints the candidates that are worth a verifier's look, and returns them. */
function report(set: CandidateSet): Candidate[] {
  const accepted = set.candidates.filter(
    (candidate) => candidate.verdict === Verdict.VERDICT_ACCEPTED,
  );
  for (const { query, matched, probability } of accepted) {
    console.log(
      `candidate: ${place(query!)} is ${place(matched!)}, ` +
        `probability ${probability!.toFixed(3)}`,
    );
  }
  return accepted;
}

function place({ sequence, stamp }: Node): string {
  const milliseconds = Number(stamp!.seconds) * 1e3 + stamp!.nanos / 1e6;
  return `${sequence} at ${new Date(milliseconds).toISOString()}`;
}

function deferred<T>() {
  let resolve!: (value: T) => void;
  const promise = new Promise<T>((settle) => (resolve = settle));
  return { promise, resolve };
}
