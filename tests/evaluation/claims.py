#!/usr/bin/env python3
"""A drive file with covariances as estimators and drivers send them.

    claims.py DRIVE.csv SHAPE --out CLAIMED.csv

The result has the truth and the estimates of the drive, and covariances that come
from those of dead reckoning by the protocol's noise: 0.1 m along, 0.05 m across and
0.1 degree per square root of a metre, 0.1 m and 0.01 rad at the start. SHAPE is one
of

  propagated  these covariances
  diagonal    their diagonals, as from drivers with a variance per axis
  isotropic   the mean variance of x and y for both, likewise
  share       1 % of the way in position, beside the propagated heading
  constant    1 m and 0.1 rad all along
  up-and-down the same, but each variance times e^(0.6 n), n normal, at each pose
  begun-anew  propagated, but begun again at the start's each kilometre
  wheel       propagated; and each step from the middle of the way on is 1 % longer

Send them as they are: revisit evaluate CLAIMED.csv --uncertainty fixes
--correlation-model dead-reckoning.

Needs Python 3.8 or newer and numpy.
"""

import argparse
import csv
import math
import pathlib

import numpy as np

ALONG, ACROSS, HEADING = 0.1, 0.05, math.radians(0.1)
START = np.diag([0.1 ** 2, 0.1 ** 2, 0.01 ** 2])
SHARE = 0.01
CONSTANT = np.diag([1.0, 1.0, 0.1 ** 2])
BEGUN_ANEW_METERS = 1000.0
WHEEL = 1.01
UP_AND_DOWN = 0.6
POSE = ("est_x", "est_y", "est_yaw")
ENTRIES = {"pxx": (0, 0), "pxy": (0, 1), "pxt": (0, 2), "pyy": (1, 1),
           "pyt": (1, 2), "ptt": (2, 2)}


def read(path):
    """Rows as written, and the estimates as numbers."""
    with open(path, encoding="ascii", newline="") as file:
        rows = list(csv.DictReader(file))
    return rows, np.array([[float(row[name]) for name in POSE] for row in rows])


def way_of(poses):
    """Metres along the path at each pose."""
    steps = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    return np.concatenate([[0.0], np.cumsum(steps)])


def propagated(poses, begun_anew_meters=math.inf):
    """The covariance of dead reckoning at each pose; at each multiple of so many
    metres it begins again."""
    way = way_of(poses)
    covariances = [START]
    for before, after, start, end in zip(poses, poses[1:], way, way[1:]):
        if end // begun_anew_meters > start // begun_anew_meters:
            covariances.append(START)
            continue
        dx, dy = after[:2] - before[:2]
        transition = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
        c, s = math.cos(before[2]), math.sin(before[2])
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        noise = np.diag([ALONG ** 2, ACROSS ** 2, HEADING ** 2]) * (end - start)
        covariances.append(transition @ covariances[-1] @ transition.T
                           + turn @ noise @ turn.T)
    return np.array(covariances)


def with_variances(covariances, position):
    """Diagonals: these variances of x and y, and the headings' own."""
    diagonals = np.zeros_like(covariances)
    diagonals[:, 0, 0], diagonals[:, 1, 1] = position
    diagonals[:, 2, 2] = covariances[:, 2, 2]
    return diagonals


def diagonal(poses):
    covariances = propagated(poses)
    return with_variances(covariances,
                          (covariances[:, 0, 0], covariances[:, 1, 1]))


def isotropic(poses):
    covariances = propagated(poses)
    mean = (covariances[:, 0, 0] + covariances[:, 1, 1]) / 2
    return with_variances(covariances, (mean, mean))


def share(poses):
    variance = START[0, 0] + (SHARE * way_of(poses)) ** 2
    return with_variances(propagated(poses), (variance, variance))


def constant(poses):
    return np.broadcast_to(CONSTANT, (len(poses), 3, 3))


def up_and_down(poses):
    rng = np.random.default_rng(len(poses))
    factors = np.exp(UP_AND_DOWN * rng.normal(size=(len(poses), 3)))
    return np.array([CONSTANT * np.diag(each) for each in factors])


def with_worn_wheel(poses):
    """The estimates of an odometer whose wheels wear off half-way."""
    way = way_of(poses)
    steps = np.diff(poses[:, :2], axis=0)
    steps[way[1:] > way[-1] / 2] *= WHEEL
    worn = poses.copy()
    worn[1:, :2] = poses[0, :2] + np.cumsum(steps, axis=0)
    return worn


SHAPES = {"propagated": propagated, "diagonal": diagonal, "isotropic": isotropic,
          "share": share, "constant": constant, "up-and-down": up_and_down,
          "begun-anew": lambda poses: propagated(poses, BEGUN_ANEW_METERS),
          "wheel": propagated}


def write_claimed(drive, shape, out):
    """The drive with covariances of this shape, in the file `out`."""
    rows, poses = read(drive)
    if shape == "wheel":
        poses = with_worn_wheel(poses)
    covariances = SHAPES[shape](poses)
    kept = [name for name in rows[0] if name not in ENTRIES]
    with open(out, "w", encoding="ascii", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*kept, *ENTRIES])
        for row, pose, covariance in zip(rows, poses, covariances):
            row.update((name, f"{value:.5f}") for name, value in zip(POSE, pose))
            writer.writerow([*(row[name] for name in kept),
                             *(f"{covariance[at]:.8g}" for at in ENTRIES.values())])
    return out


def main():
    parser = argparse.ArgumentParser(
        description=__doc__.split("\n\n", maxsplit=1)[0])
    parser.add_argument("drive", type=pathlib.Path, metavar="DRIVE.csv")
    parser.add_argument("shape", choices=SHAPES, metavar="SHAPE",
                        help=", ".join(SHAPES))
    parser.add_argument("--out", type=pathlib.Path, required=True)
    options = parser.parse_args()
    write_claimed(options.drive, options.shape, options.out)


if __name__ == "__main__":
    main()
