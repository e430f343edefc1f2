"""A drive goes in, candidates come out and are verified, an optimiser closes the
loops, and its poses come back: the trajectory is then several times better.

The optimiser is GTSAM, in a process of its own. REVISIT_TEST_DRIVES may name a
directory with more drives (kitti_00.csv); the shipped one is always driven."""

import json
import os
import pathlib
import random
import subprocess
import sys

import pytest

from revisit_server import Server, clean_environment, run
from stubs import ROOT, api
from test_shipped_drive import rows
from verified_places import (BETTER_BY, SIGMA_METERS, SIGMA_RADIANS,
                             install_gtsam, is_one_place, measured,
                             position_error)
from wire import BOREAS, list_poses

OPTIMISE = ROOT / "tests/integration/optimise_g2o.py"


@pytest.fixture(scope="module")
def optimiser(tmp_path_factory):
    """The environment in which Python has GTSAM."""
    target = tmp_path_factory.mktemp("gtsam")
    install_gtsam(target)
    return clean_environment(PYTHONPATH=str(target))


def kitti():
    directory = os.environ.get("REVISIT_TEST_DRIVES")
    path = pathlib.Path(directory or "") / "kitti_00.csv"
    if not directory or not path.is_file():
        pytest.skip("kitti_00.csv: its licence does not allow to ship it; "
                    "REVISIT_TEST_DRIVES names the directory that has it")
    return path


class Circle:
    """The way around, with one vehicle."""

    def __init__(self, server, drive, work):
        self.server = server
        self.drive = drive
        self.work = work
        self.confirmed = set()
        self.revisions = 0
        self.truth = [(row["gt_x"], row["gt_y"], row["gt_yaw"])
                      for row in rows(drive)]

    def revisit(self, *arguments):
        result = run("revisit", *arguments, "--server", self.server.address)
        assert result.returncode == 0, result.stderr
        return result.stdout

    def create(self, *settings):
        self.revisit("vehicle", "create", "v", *settings)

    def stream(self, poses=None):
        """Streams the drive up to that pose, or all of it, from where the vehicle
        is."""
        lines = self.drive.read_text().splitlines(keepends=True)
        end = len(lines) if poses is None else poses + 1
        part = self.work / "part.csv"
        part.write_text("".join(lines[:end]))
        assert self.revisit("stream", part, "--uncertainty", "file",
                            "--vehicle", "v")

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
            if (query, matched) in self.confirmed or not is_one_place(
                    (x, y, heading)):
                continue
            self.confirmed.add((query, matched))
            relative = [x, y, 0.0, heading] if spatial else [x, y, heading]
            said = self.revisit(
                "confirm", "v", query, matched,
                "--relative", ",".join(map(repr, relative)),
                "--covariance", ",".join(map(repr, covariance)))
            # Between revised poses with covariances as they were sent, there may be
            # none.
            assert self.revisions > 0 or "agreement with the graph" in said
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
        self.revisions += 1
        return json.loads(done.stdout)

    def steps(self):
        """The edges from each pose to the next, as they were exported last."""
        edges = [line for line in (self.work / "graph.g2o").read_text().splitlines()
                 if line.startswith("EDGE")]
        return [edge for edge in edges
                if int(edge.split()[2]) == int(edge.split()[1]) + 1]

    def error(self, view=api.POSE_VIEW_CURRENT):
        poses = list_poses(self.server.stub(), "vehicles/v", view=view)
        return position_error(poses, self.truth[:len(poses)])


@pytest.mark.parametrize("drive, space, check_interval", [
    (lambda: BOREAS, "planar", 50), (lambda: BOREAS, "spatial", 100),
    (kitti, "planar", 20)],
    ids=["boreas-planar", "boreas-spatial", "kitti_00"])
def test_optimised_poses_come_back_better(drive, space, check_interval,
                                          optimiser, tmp_path):
    path = drive()
    with Server(tmp_path / "store") as server:
        circle = Circle(server, path, tmp_path)
        circle.create("--state-space", space)
        circle.stream()
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


def test_rounds_with_new_drives_between_them_converge(optimiser, tmp_path):
    """Poses are revised while the vehicle drives on in the frame of its odometry.
    The steps that were measured stay the edges of every round, so that no round
    takes what the optimiser before it has made for a measurement."""
    with Server(tmp_path / "store") as server:
        circle = Circle(server, BOREAS, tmp_path)
        circle.create()
        steps = []
        for poses in (1400, 1740, len(circle.truth)):
            circle.stream(poses)
            circle.confirm(circle.candidates(check_interval=50), spatial=False)
            said = circle.optimise(optimiser)
            drifted = circle.error(api.POSE_VIEW_AS_SENT)
            after = circle.error()
            print(f"{poses} poses: error {drifted:.2f} m as sent, {after:.2f} m "
                  f"after {len(circle.confirmed)} closures, {said}")
            assert after * BETTER_BY <= drifted
            assert 0.3 < said["after"] / (3 * len(circle.confirmed)) < 3.0
            assert circle.steps()[:len(steps)] == steps
            steps = circle.steps()
            assert len(steps) == poses - 1
