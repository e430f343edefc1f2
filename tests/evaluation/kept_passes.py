#!/usr/bin/env python3
"""How well candidates are found among the passes that a vehicle keeps.

    kept_passes.py [--laps N] [--passes P,P,...] [--deviation METERS] [--seed N]

Drives the shipped drive N times, each time in a lane that is 0.5 m off (one standard
deviation), with fixes whose errors have this standard deviation (1.5 m) and change
slowly: a Gauss-Markov process over 300 m, another one in each lap. A real server
(REVISIT_BIN) takes all of it once for all passes, and once for each P of
`settings.retention.max_passes`; every 50 m it is asked for candidates.

A check is a true loop if an earlier true pose, 150 m of path before it or more, lies
within 10 m and 45 degrees; the first candidate is right by the same test, and counts if
it is accepted. Prints a line for each: poses that were dropped, nodes and bytes of the
graph, bytes of the store, precision, recall, and what a check takes in milliseconds.

Needs Python 3.8 or newer, and what tests/integration/requirements.txt names.
"""

import argparse
import csv
import math
import pathlib
import random
import sys
import tempfile
import time

import numpy as np

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests/integration"))

from revisit_server import Server  # noqa: E402
from stubs import api  # noqa: E402
from wire import pose  # noqa: E402

DRIVE = ROOT / "tests/data/boreas/boreas_glen_shields.csv"
CORRELATION_METERS = 300.0
HEADING_DEVIATION = 0.02
LANE_DEVIATION = 0.5
CHECK_METERS, RECENT_METERS = 50.0, 150.0
PLACE_METERS, PLACE_RADIANS = 10.0, math.pi / 4.0
BATCH_POSES = 8


def drive(laps, deviation, rng):
    """The true poses (x, y, heading), and the poses that are sent."""
    with open(DRIVE, newline="") as file:
        shipped = [tuple(float(row[name]) for name in ("gt_x", "gt_y", "gt_yaw"))
                   for row in csv.DictReader(file)]
    covariance = (deviation ** 2, 0.0, 0.0, deviation ** 2, 0.0,
                  HEADING_DEVIATION ** 2)
    truth, sent = [], []
    for _ in range(laps):
        lane = rng.gauss(0.0, LANE_DEVIATION)
        error = [rng.gauss(0.0, deviation), rng.gauss(0.0, deviation)]
        before = shipped[0]
        for x, y, yaw in shipped:
            kept = math.exp(-math.hypot(x - before[0], y - before[1])
                            / CORRELATION_METERS)
            before = (x, y, yaw)
            fresh = deviation * math.sqrt(1.0 - kept * kept)
            error = [kept * e + rng.gauss(0.0, fresh) for e in error]
            truth.append((x - lane * math.sin(yaw), y + lane * math.cos(yaw), yaw))
            sent.append(pose(len(truth), truth[-1][0] + error[0],
                             truth[-1][1] + error[1],
                             math.remainder(yaw + rng.gauss(0.0, HEADING_DEVIATION),
                                            math.tau), covariance))
    return np.array(truth), sent


def size_of(store):
    if store.is_dir():
        return sum(file.stat().st_size for file in store.iterdir())
    return sum(file.stat().st_size for file in store.parent.glob(store.name + "*"))


class Judge:
    """Tells what candidates are worth."""

    def __init__(self, truth):
        self.truth = truth
        steps = np.hypot(*np.diff(truth[:, :2], axis=0).T)
        self.path = np.concatenate(([0.0], np.cumsum(steps)))
        self.checks = self.loops = self.accepted = self.right = 0
        self.times = []

    def at(self, node):
        """The true pose at a node, which lies between two that were sent."""
        before = self.truth[node.sequence - 1]
        after = self.truth[min(node.sequence, len(self.truth) - 1)]
        step = after - before
        step[2] = math.remainder(step[2], math.tau)
        return before + node.fraction * step

    @staticmethod
    def same(poses, now):
        """Whether these true poses are of the place of this one."""
        apart = poses - now
        turn = np.abs((apart[..., 2] + math.pi) % math.tau - math.pi)
        return ((np.hypot(apart[..., 0], apart[..., 1]) <= PLACE_METERS)
                & (turn <= PLACE_RADIANS))

    def look(self, now, found, seconds):
        self.checks += 1
        self.times.append(1000.0 * seconds)
        history = int(np.searchsorted(self.path, self.path[now] - RECENT_METERS))
        self.loops += bool(np.any(self.same(self.truth[:history],
                                            self.truth[now])))
        first = found.candidates[0] if found.candidates else None
        if first is None or first.verdict != api.VERDICT_ACCEPTED:
            return
        self.accepted += 1
        self.right += bool(self.same(self.at(first.matched), self.at(first.query)))


def measure(truth, sent, passes, folder):
    judge = Judge(truth)
    store = folder / f"store-{passes}"
    name = "vehicles/driven"
    settings = api.VehicleSettings(
        correlation_model=api.CORRELATION_MODEL_CORRELATED_FIXES)
    settings.retention.max_passes = passes
    with Server(store) as server:
        stub = server.stub()
        stub.CreateVehicle(api.CreateVehicleRequest(
            vehicle_id="driven", vehicle=api.Vehicle(settings=settings)))
        due = 2.0 * RECENT_METERS
        for begin in range(0, len(sent), BATCH_POSES):
            batch = sent[begin:begin + BATCH_POSES]
            stub.AppendPoses(api.AppendPosesRequest(vehicle=name, poses=batch))
            now = begin + len(batch) - 1
            if judge.path[now] < due:
                continue
            due = judge.path[now] + CHECK_METERS
            start = time.perf_counter()
            found = stub.FindCandidates(api.FindCandidatesRequest(
                vehicle=name)).candidates
            judge.look(now, found, time.perf_counter() - start)
        vehicle = stub.GetVehicle(api.GetVehicleRequest(name=name)).vehicle
        resident = stub.GetServerInfo(api.GetServerInfoRequest()).resident_bytes
    return judge, vehicle, resident, size_of(store)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--laps", type=int, default=20)
    parser.add_argument("--passes", default="2,3,4")
    parser.add_argument("--deviation", type=float, default=1.5)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    truth, sent = drive(options.laps, options.deviation,
                        random.Random(options.seed))
    print(f"{'passes':>6} {'poses':>7} {'dropped':>7} {'nodes':>7} "
          f"{'graph MB':>8} {'store MB':>8} {'loops':>6} {'precision':>9} "
          f"{'recall':>6} {'p50 ms':>6} {'p99 ms':>6}")
    with tempfile.TemporaryDirectory() as folder:
        for passes in [0] + [int(p) for p in options.passes.split(",")]:
            judge, vehicle, resident, stored = measure(
                truth, sent, passes, pathlib.Path(folder))
            print(f"{passes or 'all':>6} {vehicle.durable_sequence:7} "
                  f"{vehicle.dropped_pose_count:7} {vehicle.node_count:7} "
                  f"{resident / 1e6:8.2f} {stored / 1e6:8.2f} {judge.loops:6} "
                  f"{judge.right / max(1, judge.accepted):9.4f} "
                  f"{judge.right / max(1, judge.loops):6.4f} "
                  f"{np.percentile(judge.times, 50):6.2f} "
                  f"{np.percentile(judge.times, 99):6.2f}", flush=True)


if __name__ == "__main__":
    main()
