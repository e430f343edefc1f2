import { existsSync } from "node:fs";
import { open, readFile, rename, rm } from "node:fs/promises";
import { setTimeout as sleep } from "node:timers/promises";

import { ClientError, Status } from "nice-grpc";

import { candidateStateToJSON, CheckCandidate } from "../gen/revisit/v1/check.js";
import {
  PoseGraphServiceClient,
  WatchCandidatesResponse,
} from "../gen/revisit/v1/pose_graph_service.js";
import { detailsOf, waitBeforeRetry } from "./details.js";

/**
 * Prints what becomes of stored candidates, and goes on where it was after whatever
 * broke, this program too: the file keeps the cursor of what was worked off.
 */
export async function watch(
  client: PoseGraphServiceClient,
  path: string,
): Promise<never> {
  // By uid of the vehicle: the number of its last event that was worked off.
  const told = new Map<string, bigint>();
  for (let attempt = 1; ; ++attempt) {
    try {
      if (!existsSync(path)) {
        // The events of a store that was restored from a backup have lower numbers.
        told.clear();
        await keep(path, await listAll(client));
      }
      const cursor = await readFile(path, "utf8");
      for await (const answer of client.watchCandidates({ cursor })) {
        const event = answer.candidate ?? answer.vehicleDeleted;
        if (event && event.number > (told.get(event.vehicleUid) ?? 0n)) {
          report(answer);
          told.set(event.vehicleUid, event.number);
        }
        await keep(path, answer.cursor);
        attempt = 0;
      }
      // A watch never ends by itself.
      throw new ClientError(
        "WatchCandidates",
        Status.UNAVAILABLE,
        "the server ended the watch",
      );
    } catch (error) {
      if (!(error instanceof ClientError)) {
        throw error;
      }
      const reason = detailsOf(error).info?.reason;
      let wait = waitBeforeRetry(error, attempt);
      if (reason === "CURSOR_TOO_OLD" || reason === "CURSOR_UNKNOWN") {
        await rm(path);
        wait = 100;
      } else if (reason === "SLOW_CONSUMER") {
        wait = 100;
      }
      if (wait === undefined) {
        throw error;
      }
      console.log(
        `watch: lost (${reason ?? Status[error.code]}), ` +
          `again in ${(wait / 1e3).toFixed(1)} s`,
      );
      await sleep(wait);
    }
  }
}

/** Prints what is stored; resolves to the cursor from which a watch goes on. */
async function listAll(client: PoseGraphServiceClient): Promise<string> {
  let cursor = "";
  let pageToken = "";
  do {
    const page = await client.listChecks({ parent: "vehicles/-", pageToken });
    // Only the first page has it.
    cursor ||= page.watchCursor;
    for (const candidate of page.checks.flatMap((check) => check.states)) {
      console.log(`listed: ${textOf(candidate)}`);
    }
    pageToken = page.nextPageToken;
  } while (pageToken !== "");
  return cursor;
}

/**
 * This is where a verifier works. What it does comes to the same if done twice: an event
 * comes again if the program ends before its cursor is kept.
 */
function report({ candidate, vehicleDeleted }: WatchCandidatesResponse): void {
  if (candidate) {
    console.log(`event: ${candidate.number} ${textOf(candidate.candidate!)}`);
  } else if (vehicleDeleted) {
    console.log(`event: ${vehicleDeleted.number} ${vehicleDeleted.vehicle} DELETED`);
  }
}

function textOf({ name, state }: CheckCandidate): string {
  return `${name} ${candidateStateToJSON(state).replace("CANDIDATE_STATE_", "")}`;
}

/** Replaces the file, so that it is never without a cursor. */
async function keep(path: string, cursor: string): Promise<void> {
  const partial = `${path}.partial`;
  const file = await open(partial, "w");
  try {
    await file.writeFile(cursor);
    await file.sync();
  } finally {
    await file.close();
  }
  await rename(partial, path);
}
