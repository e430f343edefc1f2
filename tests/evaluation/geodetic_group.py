#!/usr/bin/env python3
"""What vehicles with receivers find in each other's histories, with nothing but their
fixes to tie their frames.

    geodetic_group.py [--deviation METERS] [--correlation METERS] [--bias METERS]
                      [--seeds N] [--sessions DRIVE DRIVE ... [--register]]
                      [--nagoya DIR]

Each drive is a vehicle of one group, whose coordinate frame is GEODETIC. Each is asked
once, every 50 m, where in the histories of the others it is; nobody verifies.

  --sessions   drive files with truth in one frame or, with --register, laid over each
               other first (registration.py). The truth is driven again with fixes each
               second: their errors change slowly along the way (a Gauss-Markov process
               over the --correlation, 300 m, with the --deviation, 3 m; with 0, they do
               not depend on each other), beside an offset that a vehicle keeps (the
               --bias in x and in y, 0 m), which the group's settings tell
               (fix_bias_meters). Vehicles are of the model CORRELATED_FIXES, or
               INDEPENDENT.
  --nagoya     two drives around Nagoya station a year apart with real fixes
               (spp_2023.pos, spp_2024.pos, reference_2023.csv, reference_2024.csv, or
               the same with .gz), model INDEPENDENT

A check is a true loop if another vehicle's true path passes within 10 m and 45 degrees;
the first candidate is right by the same test. Prints a line of Markdown for each.

Needs Python 3.8 or newer, and what tests/integration/requirements.txt names;
REVISIT_BIN says where the programs are.
"""

import argparse
import csv
import gzip
import math
import pathlib
import random
import sys
import tempfile
import time

import grpc
import numpy as np

import registration

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests/integration"))

from grouping import add_member, create_group  # noqa: E402
from revisit_server import Server, run  # noqa: E402
from stubs import api  # noqa: E402
from wire import decode_failure  # noqa: E402

CHECK_METERS, SEQUENCE_METERS = 50.0, 150.0
PLACE_METERS, PLACE_RADIANS = 10.0, math.pi / 4.0
VELOCITY_DEVIATION = 0.1
# Where the simulated town lies.
LATITUDE, LONGITUDE = 36.35, 127.39
# WGS84.
EQUATOR, FLATTENING = 6378137.0, 1.0 / 298.257223563
# Seconds from the epoch of GPS to that of Unix.
GPS_EPOCH = 315964800


class Truth:
    """The true path of a drive, x to the east and y to the north."""

    def __init__(self, times, poses):
        self.times, self.poses = np.asarray(times), np.asarray(poses)
        self._turns = np.unwrap(self.poses[:, 2])

    def at(self, seconds):
        return np.array([np.interp(seconds, self.times, column) for column in
                         (self.poses[:, 0], self.poses[:, 1], self._turns)])

    def passes(self, place):
        """Whether the path has this place."""
        return bool(np.any(same(self.poses, place)))


def same(poses, place):
    apart = poses - place
    turn = np.abs((apart[..., 2] + math.pi) % math.tau - math.pi)
    return ((np.hypot(apart[..., 0], apart[..., 1]) <= PLACE_METERS)
            & (turn <= PLACE_RADIANS))


def radii(latitude):
    """Metres of a radian to the north and, on the equator's circle, to the east."""
    squared = FLATTENING * (2.0 - FLATTENING)
    across = EQUATOR / math.sqrt(1.0 - squared * math.sin(latitude) ** 2)
    along = across * (1.0 - squared) / (1.0 - squared * math.sin(latitude) ** 2)
    return along, across * math.cos(latitude)


def simulated(drive, out, options, rng):
    """Writes fixes of a drive file with truth; answers its truth."""
    rows = registration.read(drive)
    times = np.array([float(row["t_s"]) for row in rows])
    truth = Truth(times - times[0], [[float(row[name]) for name in
                                      ("gt_x", "gt_y", "gt_yaw")] for row in rows])
    north, east = radii(math.radians(LATITUDE))
    deviation = options.deviation
    offset = [rng.gauss(0.0, options.bias), rng.gauss(0.0, options.bias)]
    error = [rng.gauss(0.0, deviation), rng.gauss(0.0, deviation)]
    before = truth.at(0.0)
    with open(out, "w", encoding="ascii", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(("t", "lat", "lon", "ve", "vn", "sdx", "sdy"))
        for second in range(1, int(truth.times[-1])):
            now = truth.at(float(second))
            step = now - before
            kept = (math.exp(-math.hypot(*step[:2]) / options.correlation)
                    if options.correlation else 0.0)
            fresh = deviation * math.sqrt(1.0 - kept * kept)
            error = [kept * e + rng.gauss(0.0, fresh) for e in error]
            x, y = (now[k] + error[k] + offset[k] for k in range(2))
            writer.writerow((second, f"{LATITUDE + math.degrees(y / north):.9f}",
                             f"{LONGITUDE + math.degrees(x / east):.9f}",
                             *(f"{step[k] + rng.gauss(0.0, VELOCITY_DEVIATION):.3f}"
                               for k in range(2)), deviation, deviation))
            before = now
    return truth


def reference(path):
    """The truth that was recorded beside a receiver; the frame is the same for all."""
    with (gzip.open(path, "rt") if path.suffix == ".gz" else open(
            path, encoding="ascii")) as file:
        next(file)
        rows = [[float(field) for field in line.split(",")] for line in file]
    north, east = radii(math.radians(35.17))
    table = np.array(rows)
    return Truth(GPS_EPOCH + table[:, 1] * 604800.0 + table[:, 0], np.column_stack([
        np.radians(table[:, 3] - 136.88) * east,
        np.radians(table[:, 2] - 35.17) * north,
        np.radians(90.0 - table[:, 10])]))


def seconds_of(node):
    return node.stamp.seconds + 1e-9 * node.stamp.nanos


def when_ready(call):
    while True:
        try:
            return call()
        except grpc.RpcError as error:
            if decode_failure(error).reason != "GROUP_NOT_READY":
                raise
            time.sleep(0.05)


class Judge:
    def __init__(self, truths):
        self._truths = truths
        self.checks = self.loops = self.accepted = self.right = 0
        self.new = self.accepted_at_new = 0

    def look(self, asking, found):
        now = self._truths[asking].at(seconds_of(found.query))
        is_loop = any(truth.passes(now) for name, truth in self._truths.items()
                      if name != asking)
        self.checks += 1
        self.loops += is_loop
        self.new += not is_loop
        best = found.candidates[0] if found.candidates else None
        if best is None or best.verdict != api.VERDICT_ACCEPTED:
            return
        self.accepted += 1
        self.accepted_at_new += not is_loop
        there = self._truths[best.matched_vehicle.split("/")[1]].at(
            seconds_of(best.matched))
        self.right += bool(same(there, now))

    def row(self, name):
        precision = self.right / max(1, self.accepted)
        recall = self.right / max(1, self.loops)
        return (f"| {name} | {self.loops} / {self.checks} | {self.accepted} | "
                f"{self.right} | {precision:.3f} | {recall:.3f} | "
                f"{self.accepted_at_new} of {self.new} |")


def stream(server, vehicle, path, *flags):
    done = run("revisit", "stream", path, "--server", server.address, "--vehicle",
               vehicle, "--create", "--frame", "geodetic", *flags)
    assert done.returncode == 0, done.stderr


def ask(stub, vehicle, judge):
    """At the checks of its path."""
    name = f"vehicles/{vehicle}"
    request = api.FindCandidatesRequest(vehicle=name)
    request.options.scope.CopyFrom(api.SearchScope(
        group="groups/town", exclude_own=True))
    last = stub.GetVehicle(api.GetVehicleRequest(name=name)).vehicle.durable_sequence
    due = SEQUENCE_METERS
    for sequence in range(1, last + 1):
        request.sequence = sequence
        found = when_ready(lambda: stub.FindCandidates(request)).candidates
        if found.query.travelled_meters < due:
            continue
        due = found.query.travelled_meters + CHECK_METERS
        judge.look(vehicle, found)


def measure(vehicles, truths, bias, folder, judge):
    """`vehicles`: (id, file, flags) of each."""
    with Server(folder / "store") as server:
        stub = server.stub()
        group = create_group(stub, "town", fix_bias_meters=bias).name
        for vehicle, path, flags in vehicles:
            stream(server, vehicle, path, *flags)
            add_member(stub, group, f"vehicles/{vehicle}")
        for vehicle in truths:
            ask(stub, vehicle, judge)


def sessions(options):
    loops = None
    for seed in range(options.seeds):
        with tempfile.TemporaryDirectory() as made:
            folder = pathlib.Path(made)
            drives = options.sessions
            if options.register:
                drives, _ = registration.write_registered(drives, folder)
            rng = random.Random(1000 + seed)
            vehicles, truths = [], {}
            for number, drive in enumerate(drives):
                out = folder / f"fixes-{number}.csv"
                truths[f"v{number}"] = simulated(drive, out, options, rng)
                vehicles.append((f"v{number}", out, (
                    "--correlation-model",
                    "correlated-fixes" if options.correlation else "independent",
                    "--columns", "t=t,lat=lat,lon=lon,ve=ve,vn=vn,sdx=sdx,sdy=sdy")))
            judge = Judge(truths)
            measure(vehicles, truths, options.bias, folder, judge)
            loops = loops or Judge({})
            for name in ("checks", "loops", "accepted", "right", "new",
                         "accepted_at_new"):
                setattr(loops, name, getattr(loops, name) + getattr(judge, name))
    print(loops.row(f"{len(options.sessions)} sessions, fixes of "
                    f"{options.deviation:g} m over {options.correlation:g} m, bias "
                    f"{options.bias:g} m"), flush=True)


def nagoya(options):
    def found(name):
        plain = options.nagoya / name
        return plain if plain.exists() else plain.with_name(name + ".gz")

    vehicles, truths = [], {}
    for year in ("2023", "2024"):
        truths[f"y{year}"] = reference(found(f"reference_{year}.csv"))
        vehicles.append((f"y{year}", found(f"spp_{year}.pos"), ()))
    judge = Judge(truths)
    with tempfile.TemporaryDirectory() as folder:
        measure(vehicles, truths, options.bias, pathlib.Path(folder), judge)
    print(judge.row(f"Nagoya, two days, bias {options.bias:g} m"), flush=True)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--deviation", type=float, default=3.0)
    parser.add_argument("--correlation", type=float, default=300.0)
    parser.add_argument("--bias", type=float, default=0.0)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--sessions", nargs="+", type=pathlib.Path)
    parser.add_argument("--register", action="store_true")
    parser.add_argument("--nagoya", type=pathlib.Path)
    options = parser.parse_args()
    print("| drives | loops / checks | accepted | right | P | R | accepted where no "
          "other has been |\n|---|---|---|---|---|---|---|", flush=True)
    if options.sessions:
        sessions(options)
    if options.nagoya:
        nagoya(options)


if __name__ == "__main__":
    main()
