"""A drive goes in, candidates come out and are verified, an optimiser closes the
loops, and its poses come back: the trajectory is then several times better.

The optimiser is GTSAM, in a process of its own. REVISIT_TEST_DRIVES may name a
directory with more drives (kitti_00.csv); the shipped one is always driven."""

import json
import math
import os
import pathlib
import random
import subprocess
import sys

import pytest

from revisit_server import Server, clean_environment, run
from stubs import ROOT
from test_shipped_drive import rows
from wire import BOREAS, list_poses

GTSAM = "gtsam==4.3.0"
OPTIMISE = ROOT / "tests/integration/optimise_g2o.py"
INSTALL_SECONDS = 300

# The noise of the measurements, as of matched scans.
SIGMA_METERS = 0.1
SIGMA_RADIANS = math.radians(0.2)

# How far apart two scans may have been taken: a dual carriageway, and a pose each
# second.
REACH_METERS = 30.0

BETTER_BY = 5.0


@pytest.fixture(scope="module")
def optimiser(tmp_path_factory):
    """The environment in which Python has GTSAM."""
    target = tmp_path_factory.mktemp("gtsam")
    installed = subprocess.run(
        [sys.executable, "-m", "pip", "install", "--quiet",
         "--disable-pip-version-check", "--only-binary", ":all:",
         "--target", target, GTSAM],
        capture_output=True, text=True, timeout=INSTALL_SECONDS, check=False)
    if installed.returncode != 0:
        pytest.skip(f"{GTSAM}: no wheel could be installed: "
                    f"{installed.stderr.strip().splitlines()[-1:]}")
    return clean_environment(PYTHONPATH=str(target))


def kitti():
    directory = os.environ.get("REVISIT_TEST_DRIVES")
    path = pathlib.Path(directory or "") / "kitti_00.csv"
    if not directory or not path.is_file():
        pytest.skip("kitti_00.csv: its licence does not allow to ship it; "
                    "REVISIT_TEST_DRIVES names the directory that has it")
    return path


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


class Circle:
    """The way around, with one vehicle."""

    def __init__(self, server, drive, work):
        self.server = server
        self.drive = drive
        self.work = work
        self.truth = [(row["gt_x"], row["gt_y"], row["gt_yaw"])
                      for row in rows(drive)]

    def revisit(self, *arguments):
        result = run("revisit", *arguments, "--server", self.server.address)
        assert result.returncode == 0, result.stderr
        return result.stdout

    def stream(self, *settings):
        self.revisit("vehicle", "create", "v", *settings)
        lines = self.revisit("stream", self.drive, "--uncertainty", "file",
                             "--vehicle", "v").splitlines()
        assert lines

    def candidates(self, check_interval):
        """Pairs of sequences that were accepted, as the map has them."""
        page = self.revisit("map", "v", "--direction", "either",
                            "--check-interval", check_interval,
                            "--searches-per-second", "10000")
        data = json.loads(page.split('id="data">')[1].split("</script>")[0])
        sequence = data["nodes"]["sequence"]
        return {(sequence[check["node"]], sequence[candidate["node"]])
                for check in data["checks"]
                for candidate in check["candidates"][:1]
                if candidate["verdict"] == "ACCEPTED"}

    def confirm(self, pairs, spatial):
        """Confirms those that are true, as a verifier would."""
        draw = random.Random(20101018)
        p, h = SIGMA_METERS ** 2, SIGMA_RADIANS ** 2
        covariance = ([p, 0, 0, 0, p, 0, 0, p, 0, h] if spatial
                      else [p, 0, 0, p, 0, h])
        confirmed = 0
        for query, matched in sorted(pairs):
            x, y, heading = measured(self.truth, query, matched, draw)
            if not is_one_place((x, y, heading)):
                continue
            relative = [x, y, 0.0, heading] if spatial else [x, y, heading]
            said = self.revisit(
                "confirm", "v", query, matched,
                "--relative", ",".join(map(repr, relative)),
                "--covariance", ",".join(map(repr, covariance)))
            assert "agreement with the graph" in said
            confirmed += 1
        return confirmed

    def optimise(self, environment):
        """Answers what GTSAM says: the sum of squared, whitened errors."""
        self.revisit("export", "v", "--format", "g2o", "--output",
                     self.work / "graph.g2o")
        done = subprocess.run(
            [sys.executable, OPTIMISE, self.work / "graph.g2o",
             self.work / "optimised.g2o"], env=environment,
            capture_output=True, text=True, timeout=300, check=False)
        assert done.returncode == 0, done.stderr
        self.revisit("revise", "v", self.work / "optimised.g2o", "--format",
                     "g2o")
        return json.loads(done.stdout)

    def error(self):
        return position_error(list_poses(self.server.stub(), "vehicles/v"),
                              self.truth)


@pytest.mark.parametrize("drive, space, check_interval", [
    (lambda: BOREAS, "planar", 50), (lambda: BOREAS, "spatial", 100),
    (kitti, "planar", 20)],
    ids=["boreas-planar", "boreas-spatial", "kitti_00"])
def test_optimised_poses_come_back_better(drive, space, check_interval,
                                          optimiser, tmp_path):
    path = drive()
    with Server(tmp_path / "store") as server:
        circle = Circle(server, path, tmp_path)
        circle.stream("--state-space", space)
        before = circle.error()
        pairs = circle.candidates(check_interval)
        confirmed = circle.confirm(pairs, space == "spatial")
        said = circle.optimise(optimiser)
        after = circle.error()
        print(f"{path.stem} {space}: {confirmed} of {len(pairs)} candidates are "
              f"true, error {before:.2f} m before, {after:.2f} m after, {said}")
        assert confirmed > 0.9 * len(pairs) > 20
        assert after * BETTER_BY <= before
        # Each closure adds as many numbers as the state has, and the errors
        # are as large as the covariances of steps and closures say.
        size = 3 if space == "planar" else 4
        assert 0.3 < said["after"] / (size * confirmed) < 3.0
