#!/usr/bin/env python3
"""Makes boreas_glen_shields.csv from the two recorded drives beside this file.

Truth: the recorded path, both days in one frame, east and north of the first
pose. Estimate: simulated dead reckoning. Each step of the truth, seen from the
vehicle, is given seeded Gaussian noise of the model below, and the covariance
is propagated along the estimate with the same model, so that the claim is an
honest one. README.md says what comes out of it.

    make_drive.py [--output FILE]

Needs nothing but Python 3.8 or newer.
"""

import argparse
import csv
import math
import pathlib
import random
import sys

HERE = pathlib.Path(__file__).resolve().parent
DRIVES = (
    "boreas-2021-08-05-13-34/lidar_poses_1hz.csv",
    "boreas-2021-09-02-11-42/lidar_poses_1hz.csv",
)

SEED = 20210805

# Standard deviations of odometry per square root of a metre travelled, as of
# wheel encoders and a good gyroscope.
ALONG_METERS = 0.05
ACROSS_METERS = 0.02
HEADING_RADIANS = math.radians(0.01)

# Standard deviations of the first pose.
START_POSITION_METERS = 0.1
START_HEADING_RADIANS = 0.01

# Below this the vehicle counts as standing, and dead reckoning adds nothing; the
# motion is not lost but goes into the next step that is longer.
STANDSTILL_METERS = 0.05

# A vehicle's trajectory is cut where two poses are farther apart than this
# (VehicleSettings.max_step_meters); the drive must hold no such step.
MAX_STEP_METERS = 100.0

# The recorded "heading" is that of the LiDAR, clockwise; its zero is turned from
# east by this. It agrees with the course of the recorded velocity: see
# check_heading().
LIDAR_TURN_DEGREES = 46.9

HEADER = (
    "frame,t_s,gt_x,gt_y,gt_yaw,est_x,est_y,est_yaw,pxx,pxy,pxt,pyy,pyt,ptt"
)


def wrap(angle):
    return math.remainder(angle, 2.0 * math.pi)


def read_truth():
    """(seconds, east, north, heading, (v_east, v_north)) of both drives."""
    poses = []
    for name in DRIVES:
        with open(HERE / name, newline="") as file:
            for row in csv.DictReader(file):
                poses.append((
                    int(row["GPSTime"]) * 1e-6,
                    float(row["easting"]),
                    float(row["northing"]),
                    wrap(math.radians(LIDAR_TURN_DEGREES)
                         - float(row["heading"])),
                    (float(row["vel_east"]), float(row["vel_north"])),
                ))
    return poses


def check_heading(poses):
    """Refuses a heading that is not that of the velocity, where it moves."""
    differences = sorted(
        abs(wrap(math.atan2(velocity[1], velocity[0]) - heading))
        for _, _, _, heading, velocity in poses
        if math.hypot(*velocity) > 3.0)
    median = math.degrees(differences[len(differences) // 2])
    if median > 1.0:
        sys.exit(f"heading is {median:.1f} degrees off the course")


def compound(pose, step):
    x, y, heading = pose
    cos, sin = math.cos(heading), math.sin(heading)
    return (x + cos * step[0] - sin * step[1],
            y + sin * step[0] + cos * step[1],
            wrap(heading + step[2]))


def between(a, b):
    """Pose b as seen from pose a."""
    dx, dy = b[0] - a[0], b[1] - a[1]
    cos, sin = math.cos(a[2]), math.sin(a[2])
    return (cos * dx + sin * dy, -sin * dx + cos * dy, wrap(b[2] - a[2]))


def propagate(covariance, before, after, length):
    """P <- F P F^T + G Q G^T, to first order, for one step of dead reckoning.

    F = [1 0 -(y' - y); 0 1 x' - x; 0 0 1]: an error of heading swings the step.
    G turns the step's noise from the vehicle's axes into those of the frame.
    """
    a, b = -(after[1] - before[1]), after[0] - before[0]
    xx, xy, xt, yy, yt, tt = covariance
    cos, sin = math.cos(before[2]), math.sin(before[2])
    along = ALONG_METERS ** 2 * length
    across = ACROSS_METERS ** 2 * length
    return (
        xx + 2.0 * a * xt + a * a * tt
        + cos * cos * along + sin * sin * across,
        xy + b * xt + a * yt + a * b * tt + cos * sin * (along - across),
        xt + a * tt,
        yy + 2.0 * b * yt + b * b * tt
        + sin * sin * along + cos * cos * across,
        yt + b * tt,
        tt + HEADING_RADIANS ** 2 * length,
    )


def is_positive_definite(covariance):
    xx, xy, xt, yy, yt, tt = covariance
    return (xx > 0.0 and xx * yy - xy * xy > 0.0
            and xx * (yy * tt - yt * yt) - xy * (xy * tt - yt * xt)
            + xt * (xy * yt - yy * xt) > 0.0)


def make_rows():
    recorded = read_truth()
    check_heading(recorded)
    noise = random.Random(SEED)
    start_time, start_east, start_north = recorded[0][:3]
    truth = [(east - start_east, north - start_north, heading)
             for _, east, north, heading, _ in recorded]
    estimate = (noise.gauss(truth[0][0], START_POSITION_METERS),
                noise.gauss(truth[0][1], START_POSITION_METERS),
                noise.gauss(truth[0][2], START_HEADING_RADIANS))
    covariance = (START_POSITION_METERS ** 2, 0.0, 0.0,
                  START_POSITION_METERS ** 2, 0.0, START_HEADING_RADIANS ** 2)
    # True pose up to which dead reckoning has counted.
    counted = truth[0]
    for frame, pose in enumerate(truth):
        motion = between(counted, pose)
        length = math.hypot(motion[0], motion[1])
        if length > MAX_STEP_METERS:
            sys.exit(f"frame {frame}: a step of {length:.1f} m")
        if length >= STANDSTILL_METERS:
            root = math.sqrt(length)
            measured = (noise.gauss(motion[0], ALONG_METERS * root),
                        noise.gauss(motion[1], ACROSS_METERS * root),
                        noise.gauss(motion[2], HEADING_RADIANS * root))
            moved = compound(estimate, measured)
            covariance = propagate(covariance, estimate, moved, length)
            estimate = moved
            counted = pose
        claimed = [f"{entry:.7g}" for entry in covariance]
        if not is_positive_definite([float(entry) for entry in claimed]):
            sys.exit(f"frame {frame}: covariance is not positive definite")
        yield ",".join([
            str(frame), f"{recorded[frame][0] - start_time:.3f}",
            f"{pose[0]:.3f}", f"{pose[1]:.3f}", f"{pose[2]:.5f}",
            f"{estimate[0]:.3f}", f"{estimate[1]:.3f}", f"{estimate[2]:.5f}",
            *claimed])


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--output", type=pathlib.Path,
                        default=HERE / "boreas_glen_shields.csv")
    output = parser.parse_args().output
    output.write_text("\n".join([HEADER, *make_rows()]) + "\n")


if __name__ == "__main__":
    main()
