#!/usr/bin/env python3
"""How well candidates are found among the passes that a vehicle keeps.

    kept_passes.py [--laps N] [--passes P,P,...] [--deviation METERS] [--seed N]

Drives the shipped drive N times, with fixes whose errors have this standard
deviation (1.5 m) and change slowly: those of each lap are a Gauss-Markov process
over 300 m, apart from a lane that is 0.5 m off (one standard deviation). A real
server (REVISIT_BIN) takes the drive once for all passes and once for each P of
`settings.retention.max_passes`; `revisit evaluate` judges the candidates. Prints a
line for each: nodes and bytes of the graph, bytes of the store, precision and
recall, and what a check takes.

Needs Python 3.8 or newer, and what tests/integration/requirements.txt names.
"""

import argparse
import csv
import json
import math
import pathlib
import random
import subprocess
import sys
import tempfile

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests/integration"))

from revisit_server import BIN, Server, clean_environment  # noqa: E402
from stubs import api  # noqa: E402

DRIVE = ROOT / "tests/data/boreas/boreas_glen_shields.csv"
CORRELATION_METERS = 300.0
HEADING_DEVIATION = 0.02
LANE_DEVIATION = 0.5
VEHICLE = "driven"


def laps(count, deviation, rng):
    """Rows of the drive file: the true pose, and its fix."""
    with open(DRIVE, newline="") as file:
        truth = [tuple(float(row[name]) for name in
                       ("t_s", "gt_x", "gt_y", "gt_yaw"))
                 for row in csv.DictReader(file)]
    duration = truth[-1][0] + 60.0
    for lap in range(count):
        lane = rng.gauss(0.0, LANE_DEVIATION)
        error = [rng.gauss(0.0, deviation), rng.gauss(0.0, deviation)]
        before = truth[0]
        for t, x, y, yaw in truth:
            moved = math.hypot(x - before[1], y - before[2])
            before = (t, x, y, yaw)
            kept = math.exp(-moved / CORRELATION_METERS)
            fresh = deviation * math.sqrt(1.0 - kept * kept)
            error = [kept * e + rng.gauss(0.0, fresh) for e in error]
            gt_x = x - lane * math.sin(yaw)
            gt_y = y + lane * math.cos(yaw)
            yield (t + lap * duration, gt_x, gt_y, yaw, gt_x + error[0],
                   gt_y + error[1], yaw + rng.gauss(0.0, HEADING_DEVIATION),
                   deviation ** 2, 0, 0, deviation ** 2, 0,
                   HEADING_DEVIATION ** 2)


def write(path, rows):
    names = "t_s,gt_x,gt_y,gt_yaw,est_x,est_y,est_yaw,pxx,pxy,pxt,pyy,pyt,ptt"
    with open(path, "w") as file:
        file.write(names + "\n")
        for row in rows:
            file.write(",".join(f"{value:.6g}" if index else f"{value:.3f}"
                                for index, value in enumerate(row)) + "\n")


def size_of(store):
    if store.is_dir():
        return sum(file.stat().st_size for file in store.iterdir())
    return sum(file.stat().st_size for file in
               store.parent.glob(store.name + "*") if file.suffix != ".log")


def measure(drive, passes, folder):
    store = folder / f"store-{passes}"
    with Server(store) as server:
        result = subprocess.run(
            [BIN / "revisit", "--server", f"127.0.0.1:{server.port}", "--json",
             "evaluate", drive, "--correlation-model", "correlated-fixes",
             "--vehicle", VEHICLE, "--keep-vehicles", "--accept-suspicious"]
            + (["--max-passes", str(passes)] if passes else []),
            capture_output=True, text=True, env=clean_environment(), check=False)
        assert result.returncode == 0, result.stderr
        stub = server.stub()
        vehicle = stub.GetVehicle(api.GetVehicleRequest(
            name=f"vehicles/{VEHICLE}")).vehicle
        resident = stub.GetServerInfo(api.GetServerInfoRequest()).resident_bytes
    return vehicle, resident, size_of(store), json.loads(result.stdout)["total"]


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--laps", type=int, default=20)
    parser.add_argument("--passes", default="2,3,4")
    parser.add_argument("--deviation", type=float, default=1.5)
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = pathlib.Path(name)
        drive = folder / "laps.csv"
        write(drive, laps(options.laps, options.deviation,
                          random.Random(options.seed)))
        print(f"{'passes':>6} {'poses':>7} {'dropped':>7} {'nodes':>7} "
              f"{'graph MB':>8} {'store MB':>8} {'checks':>6} {'precision':>9} "
              f"{'recall':>6} {'p50 ms':>6} {'p99 ms':>6}")
        for passes in [0] + [int(p) for p in options.passes.split(",")]:
            vehicle, resident, stored, report = measure(drive, passes, folder)
            print(f"{passes or 'all':>6} {vehicle.durable_sequence:7} "
                  f"{vehicle.dropped_pose_count:7} {vehicle.node_count:7} "
                  f"{resident / 1e6:8.2f} {stored / 1e6:8.2f} "
                  f"{report['checks']:6} {report['precision']:9.4f} "
                  f"{report['recall']:6.4f} {report['query_ms_p50']:6.2f} "
                  f"{report['query_ms_p99']:6.2f}", flush=True)


if __name__ == "__main__":
    main()
