/**
 * Streams a drive to revisit, prints where the vehicle has been before, and confirms
 * one of these places.
 *
 * usage: integrate.js ADDRESS FILE VEHICLE_ID
 *
 * With two arguments it prints what becomes of stored candidates instead.
 *
 * usage: integrate.js ADDRESS CURSOR_FILE
 */
import { ClientError, createChannel, createClientFactory, Status } from "nice-grpc";
import { errorDetailsClientMiddleware } from "nice-grpc-error-details";

import { Candidate } from "../gen/revisit/v1/candidate.js";
import { Pose } from "../gen/revisit/v1/geometry.js";
import {
  PoseGraphServiceClient,
  PoseGraphServiceDefinition,
} from "../gen/revisit/v1/pose_graph_service.js";
import { Vehicle } from "../gen/revisit/v1/vehicle.js";
import { detailsOf } from "./details.js";
import { readDrive } from "./drive.js";
import { stream } from "./stream.js";
import { watch } from "./watch.js";

async function main(address: string, path: string, vehicleId?: string): Promise<void> {
  const channel = createChannel(address, undefined, {
    // A connection whose other end has vanished is noticed after half a minute.
    "grpc.keepalive_time_ms": 20_000,
    "grpc.keepalive_timeout_ms": 10_000,
    "grpc.initial_reconnect_backoff_ms": 100,
    "grpc.max_reconnect_backoff_ms": 2_000,
  });
  const client: PoseGraphServiceClient = createClientFactory()
    .use(errorDetailsClientMiddleware)
    .create(PoseGraphServiceDefinition, channel);
  try {
    if (vehicleId === undefined) {
      await watch(client, path);
    } else {
      await integrate(client, path, vehicleId);
    }
  } finally {
    channel.close();
  }
}

async function integrate(
  client: PoseGraphServiceClient,
  path: string,
  vehicleId: string,
): Promise<void> {
  const poses = readDrive(path);
  const { vehicle } = await client.createVehicle({ vehicleId });
  console.log(`vehicle: ${vehicle!.name}, uid ${vehicle!.uid}`);
  const accepted = await stream(client, vehicle!, poses);
  console.log(`durable: all ${poses.length} poses`);
  if (accepted.length > 0) {
    await confirm(client, vehicle!, accepted);
  }
  await showError(client, vehicle!, poses[poses.length - 1]);
}

/**
 * Says of the most probable candidate that it is the same place, as a verifier would
 * after it compared images or scans.
 */
async function confirm(
  client: PoseGraphServiceClient,
  vehicle: Vehicle,
  accepted: Candidate[],
): Promise<void> {
  const best = accepted.reduce((a, b) => (b.probability! > a.probability! ? b : a));
  const { loopClosure } = await client.addLoopClosure({
    parent: vehicle.name,
    loopClosure: {
      querySequence: best.query!.sequence,
      matchedSequence: best.matched!.sequence,
    },
  });
  console.log(`confirmed: ${loopClosure!.name}`);
}

/**
 * Sends a pose with a variance below 0, which is refused and changes nothing, and
 * prints all that the error says.
 */
async function showError(
  client: PoseGraphServiceClient,
  vehicle: Vehicle,
  last: Pose,
): Promise<void> {
  const [, ...others] = last.covariance!.values;
  const pose = {
    ...last,
    sequence: last.sequence + 1n,
    covariance: { ...last.covariance, values: [-1, ...others] },
  };
  try {
    await client.appendPoses({
      vehicle: vehicle.name,
      vehicleUid: vehicle.uid,
      poses: [pose],
    });
  } catch (error) {
    if (!(error instanceof ClientError)) {
      throw error;
    }
    const { info, badRequest } = detailsOf(error);
    console.log(
      `refused: ${Status[error.code]}, reason ${info?.reason} of ${info?.domain}, ` +
        `request ${info?.metadata["request_id"]}: ${error.details}`,
    );
    for (const { field, description } of badRequest?.fieldViolations ?? []) {
      console.log(`  ${field}: ${description}`);
    }
  }
}

const [address, path, vehicleId, ...others] = process.argv.slice(2);
if (path === undefined || others.length > 0) {
  console.error(
    "usage: integrate.js ADDRESS FILE VEHICLE_ID | integrate.js ADDRESS CURSOR_FILE",
  );
  process.exit(64);
}
await main(address, path, vehicleId);
