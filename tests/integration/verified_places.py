"""What a verifier finds of two poses of a drive whose truth is known, and how good a
trajectory is that an optimiser makes of it."""

import math
import subprocess
import sys

import pytest

GTSAM = "gtsam==4.3.0"
INSTALL_SECONDS = 300

# The noise of the measurements, as of matched scans.
SIGMA_METERS = 0.1
SIGMA_RADIANS = math.radians(0.2)

# How far apart two scans may have been taken: a dual carriageway, and a pose each
# second.
REACH_METERS = 30.0

BETTER_BY = 5.0


def install_gtsam(directory):
    """Installs the optimiser for this Python into a directory of its own; skips the
    test where it has no wheel."""
    installed = subprocess.run(
        [sys.executable, "-m", "pip", "install", "--quiet",
         "--disable-pip-version-check", "--only-binary", ":all:",
         "--target", directory, GTSAM],
        capture_output=True, text=True, timeout=INSTALL_SECONDS, check=False)
    if installed.returncode != 0:
        pytest.skip(f"{GTSAM}: no wheel could be installed: "
                    f"{installed.stderr.strip().splitlines()[-1:]}")


def measured(truth, query, matched, draw):
    """The query as seen from the match (sequences), with noise."""
    (xq, yq, hq), (xm, ym, hm) = truth[query - 1], truth[matched - 1]
    c, s = math.cos(hm), math.sin(hm)
    return (c * (xq - xm) + s * (yq - ym) + draw.gauss(0, SIGMA_METERS),
            -s * (xq - xm) + c * (yq - ym) + draw.gauss(0, SIGMA_METERS),
            math.remainder(hq - hm, math.tau) + draw.gauss(0, SIGMA_RADIANS))


def is_one_place(relative):
    """Near enough for two scans to be matched, passed either way."""
    x, y, heading = relative
    return (math.hypot(x, y) < REACH_METERS
            and abs(math.sin(heading)) < math.sin(math.pi / 4))


def position_error(poses, truth):
    """Root mean square of the distances after the best rigid motion of the
    plane."""
    points = [complex(p.local.x_meters, p.local.y_meters) for p in poses]
    true = [complex(x, y) for x, y, _ in truth]
    assert len(points) == len(true)
    count = len(points)
    middle, true_middle = sum(points) / count, sum(true) / count
    turn = sum((t - true_middle) * (p - middle).conjugate()
               for p, t in zip(points, true))
    turn /= abs(turn)
    return math.sqrt(sum(
        abs(t - true_middle - turn * (p - middle)) ** 2
        for p, t in zip(points, true)) / count)
