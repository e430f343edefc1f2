import { readFileSync } from "node:fs";

import { CovarianceForm, Pose } from "../gen/revisit/v1/geometry.js";
import { PoseColumns } from "../gen/revisit/v1/pose_columns.js";

const COVARIANCE = ["pxx", "pxy", "pxt", "pyy", "pyt", "ptt"];

/** Reads the poses of a drive, which number from 1 in the order of the file. */
export function readDrive(path: string): Pose[] {
  const [header, ...lines] = readFileSync(path, "utf8").trimEnd().split(/\r?\n/);
  const names = header.split(",");
  return lines.map((line, index) => {
    const fields = line.split(",");
    return makePose(BigInt(index + 1), (name) => {
      const number = Number.parseFloat(fields[names.indexOf(name)]);
      if (Number.isNaN(number)) {
        throw new Error(`${path}:${index + 2}: no number in column ${name}`);
      }
      return number;
    });
  });
}

function makePose(sequence: bigint, column: (name: string) => number): Pose {
  const time = column("t_s");
  const seconds = Math.floor(time);
  return Pose.fromPartial({
    sequence,
    stamp: { seconds: BigInt(seconds), nanos: Math.round((time - seconds) * 1e9) },
    local: { xMeters: column("est_x"), yMeters: column("est_y") },
    headingRadians: column("est_yaw"),
    covariance: {
      form: CovarianceForm.COVARIANCE_FORM_PLANAR_6,
      values: COVARIANCE.map(column),
    },
  });
}

/**
 * The poses as columns, which take less to send and to read. All poses of this drive
 * have the same fields, or they would be messages.
 */
export function columnsOf(poses: Pose[]): PoseColumns {
  const stamps = poses.map(
    ({ stamp }) => stamp!.seconds * 1_000_000_000n + BigInt(stamp!.nanos),
  );
  return PoseColumns.fromPartial({
    firstSequence: poses[0].sequence,
    poseCount: poses.length,
    firstStamp: poses[0].stamp,
    stampStepNanos: stamps.slice(1).map((stamp, index) => stamp - stamps[index]),
    xMeters: poses.map(({ local }) => local!.xMeters),
    yMeters: poses.map(({ local }) => local!.yMeters),
    headingRadians: poses.map(({ headingRadians }) => headingRadians!),
    covarianceForm: CovarianceForm.COVARIANCE_FORM_PLANAR_6,
    covariances: poses.flatMap(({ covariance }) => covariance!.values),
  });
}
