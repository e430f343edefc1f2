#!/usr/bin/env python3
"""How many looks at candidates it takes until the trajectory is good, by the order in
which a verifier takes them.

    looks.py [--orders ORDER,...] [--shuffles N] [--seed N] [--jobs N] [--curve FILE]
             DRIVE ...

A real server (REVISIT_BIN) gets each drive whole, and stores its checks. A verifier
that knows the truth then looks at one open candidate after the other, until none is
left:

  value        the one with the greatest CheckCandidate.value_square_meters
  probability  the most probable one
  time         the earliest one, by the sequence of its check
  random       any one, drawn with the seed: the mean of so many shuffles

If the true poses lie within 10 m and 45 degrees, it confirms with the relative pose,
with errors of 0.1 m and 0.2 degrees; if not, it rejects. After each look the server
has up to two seconds to search again what depends on it. After each confirmation
GTSAM optimises the poses with all closures so far; the error is the root mean square
of the distances to the truth after the best rigid motion.

The reduction of a drive is that from its error without closures to its error with a
closure for each right one of the candidates that were open before the first look. A
share of it is reached with the first look at which the error is that low. Prints one
line for each drive and order, and a table of the looks until 80 % are reached;
--curve writes the mean of the drives' shares after so many looks at each.

Needs Python 3.8 or newer, what tests/integration/requirements.txt names, and GTSAM.
"""

import argparse
import collections
import concurrent.futures
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

from reports import markdown  # noqa: E402
from revisit_server import Server, run, wait_until_none_left  # noqa: E402
from stubs import api  # noqa: E402
from verified_places import (SIGMA_METERS, SIGMA_RADIANS,  # noqa: E402
                             measured)
from watching import list_checks  # noqa: E402
from wire import get  # noqa: E402

VEHICLE = "vehicles/driven"
# As the protocol of RESULTS.md: a right candidate, and the drift that is claimed, of
# each square root of a metre along, across and in heading.
PLACE_METERS, PLACE_RADIANS = 10.0, math.pi / 4.0
DRIFT = (0.1, 0.05, math.radians(0.1))
# A vehicle that stands has steps of no length, whose variance must not be 0.
LEAST_STEP_METERS = 1e-3
SHARE = 0.8
SETTLE_SECONDS, POLL_SECONDS = 2.0, 0.1

ORDERS = ("value", "probability", "time", "random")


def read_drive(path):
    """The true poses and the estimated ones, x, y, heading."""
    with open(path, encoding="ascii", newline="") as file:
        rows = list(csv.DictReader(file))
    return [np.array([[float(row[f"{kind}_{name}"]) for name in ("x", "y", "yaw")]
                      for row in rows]) for kind in ("gt", "est")]


def position_error(poses, truth):
    """Root mean square of the distances after the best rigid motion of the plane."""
    points, true = (at[:, 0] + 1j * at[:, 1] for at in (poses, truth))
    points, true = points - points.mean(), true - true.mean()
    turn = np.vdot(points, true)
    if turn != 0.0:
        points = points * (turn / abs(turn))
    return math.sqrt(np.mean(np.abs(true - points) ** 2))


class Trajectory:
    """A drive's poses and their optimum, given the closures so far."""

    def __init__(self, truth, estimate):
        # The tests of this script run where there is no GTSAM.
        import gtsam
        self._gtsam = gtsam
        self._truth = truth
        self._graph = gtsam.NonlinearFactorGraph()
        self._values = gtsam.Values()
        self._count = len(estimate)
        poses = [gtsam.Pose2(*pose) for pose in estimate]
        self._graph.add(gtsam.PriorFactorPose2(
            0, poses[0], gtsam.noiseModel.Diagonal.Sigmas(np.full(3, 1e-6))))
        for key, pose in enumerate(poses):
            self._values.insert(key, pose)
            if key > 0:
                step = poses[key - 1].between(pose)
                root = math.sqrt(max(math.hypot(step.x(), step.y()),
                                     LEAST_STEP_METERS))
                self._graph.add(gtsam.BetweenFactorPose2(
                    key - 1, key, step, gtsam.noiseModel.Diagonal.Sigmas(
                        root * np.array(DRIFT))))
        self._measured = gtsam.noiseModel.Diagonal.Sigmas(
            np.array([SIGMA_METERS, SIGMA_METERS, SIGMA_RADIANS]))

    def close(self, query, matched, relative):
        """Adds a closure between two sequences."""
        self._graph.add(self._gtsam.BetweenFactorPose2(
            matched - 1, query - 1, self._gtsam.Pose2(*relative), self._measured))

    def optimise(self):
        self._values = self._gtsam.LevenbergMarquardtOptimizer(
            self._graph, self._values).optimize()

    def error(self):
        poses = np.array([[pose.x(), pose.y()] for pose in
                          (self._values.atPose2(key) for key in range(self._count))])
        return position_error(poses, self._truth)


class Verifier:
    """Knows the truth. What it measures of a pair does not depend on the order."""

    def __init__(self, truth, seed):
        self._truth = truth
        self._seed = seed

    def look(self, query, matched):
        """The query as seen from the match (sequences); None if it is elsewhere."""
        apart = self._truth[query - 1] - self._truth[matched - 1]
        if (math.hypot(apart[0], apart[1]) > PLACE_METERS
                or abs(math.remainder(apart[2], math.tau)) > PLACE_RADIANS):
            return None
        return measured(self._truth, query, matched,
                        random.Random(f"{self._seed} {query} {matched}"))


class Open:
    """An open candidate of a stored check, with what was found of it last."""

    def __init__(self, check, state):
        found, rank = ((check.latest, state.latest_rank) if state.latest_rank
                       else (check.candidates, state.rank))
        evidence = next(one for one in found.candidates if one.rank == rank)
        self.name = state.name
        _, _, _, sequence, _, number = state.name.split("/")
        self.place_in_time = int(sequence), int(number)
        self.value = state.value_square_meters
        self.probability = evidence.probability
        self.query = evidence.query.sequence
        self.matched = evidence.matched.sequence


def open_candidates(checks, looked_at):
    """Those that are open, by time. One that is open again because its closure
    contradicts others has had its look: the answer would be the same."""
    found = [Open(check, state) for check in checks for state in check.states
             if state.state == api.CANDIDATE_STATE_OPEN
             and state.cause != api.CANDIDATE_CAUSE_CONTRADICTION
             and state.name not in looked_at]
    return sorted(found, key=lambda one: one.place_in_time)


def choose(order, candidates, draw):
    """The next look; of equals, the earliest."""
    if order == "value":
        return max(candidates, key=lambda one: one.value)
    if order == "probability":
        return max(candidates, key=lambda one: one.probability)
    return candidates[0] if order == "time" else draw.choice(candidates)


def settled_checks(stub):
    """All checks, once none waits to be searched again and no value changes, or
    after two seconds."""
    deadline = time.monotonic() + SETTLE_SECONDS
    before = None
    while True:
        time.sleep(POLL_SECONDS)
        checks = list_checks(stub, VEHICLE, page_size=1000)[0]
        now = [state.SerializeToString(deterministic=True)
               for check in checks for state in check.states]
        is_still = now == before and not any(check.stale for check in checks)
        if is_still or time.monotonic() > deadline:
            return checks, is_still
        before = now


def answer(stub, candidate, relative):
    """Confirms with what was measured, or rejects."""
    pair = {"query_sequence": candidate.query, "matched_sequence": candidate.matched}
    if relative is None:
        stub.RejectCandidate(api.RejectCandidateRequest(
            parent=VEHICLE, candidate=candidate.name,
            rejected_candidate=api.RejectedCandidate(**pair)))
        return
    x, y, heading = relative
    p, h = SIGMA_METERS ** 2, SIGMA_RADIANS ** 2
    stub.AddLoopClosure(api.AddLoopClosureRequest(
        parent=VEHICLE, candidate=candidate.name,
        loop_closure=api.LoopClosure(**pair, measurement=api.LoopClosureMeasurement(
            x_meters=x, y_meters=y, heading_radians=heading,
            covariance=api.Covariance(form=api.COVARIANCE_FORM_PLANAR_6,
                                      values=[p, 0, 0, p, 0, h])))))


def all_closed(trajectory, verifier, candidates):
    """(error of a trajectory with each right candidate closed, how many there are)"""
    count = 0
    for pair in sorted({(one.query, one.matched) for one in candidates}):
        relative = verifier.look(*pair)
        if relative is not None:
            trajectory.close(*pair, relative)
            count += 1
    trajectory.optimise()
    return trajectory.error(), count


def send(server, path):
    """Streams the drive, and waits until all of its checks are stored."""
    for words in (("vehicle", "create", "driven", "--checks", "stored"),
                  ("stream", path, "--vehicle", "driven",
                   "--uncertainty", "model")):
        done = run("revisit", *words, "--server", server.address)
        if done.returncode != 0:
            raise RuntimeError(f"revisit {words[0]} failed: {done.stderr}")
    wait_until_none_left(lambda: get(server.stub(), VEHICLE).check_debt,
                         "checks of the drive")


def measure(path, order, seed, shuffle):
    """One drive in one order: errors after 0, 1, ... looks, and what else is told."""
    truth, estimate = read_drive(path)
    verifier = Verifier(truth, seed)
    draw = random.Random(f"{seed} {shuffle} {path.stem}")
    trajectory = Trajectory(truth, estimate)
    told = {"drive": path.stem, "order": order, "errors": [trajectory.error()],
            "confirmed": 0, "unsettled": 0}
    looked_at = set()
    with tempfile.TemporaryDirectory() as folder, Server(
            pathlib.Path(folder) / "store") as server:
        stub = server.stub()
        send(server, path)
        checks, _ = settled_checks(stub)
        candidates = open_candidates(checks, looked_at)
        told["open"] = len(candidates)
        told["all"], told["right"] = all_closed(Trajectory(truth, estimate), verifier,
                                                candidates)
        while candidates:
            chosen = choose(order, candidates, draw)
            looked_at.add(chosen.name)
            relative = verifier.look(chosen.query, chosen.matched)
            answer(stub, chosen, relative)
            if relative is None:
                told["errors"].append(told["errors"][-1])
            else:
                told["confirmed"] += 1
                trajectory.close(chosen.query, chosen.matched, relative)
                trajectory.optimise()
                told["errors"].append(trajectory.error())
            checks, is_still = settled_checks(stub)
            told["unsettled"] += not is_still
            candidates = open_candidates(checks, looked_at)
    return told


def shares(told):
    """Of the reduction, after 0, 1, ... looks."""
    first = told["errors"][0]
    return [(first - error) / (first - told["all"]) for error in told["errors"]]


def looks_until(reached, share=SHARE):
    """The first look at which this share is reached; infinite if it never is."""
    return next((looks for looks, now in enumerate(reached) if now >= share), math.inf)


def mean_curve(curves):
    """The mean share after so many looks at each drive; one at which there is no
    look left stays as it is."""
    return [sum(curve[min(looks, len(curve) - 1)] for curve in curves) / len(curves)
            for looks in range(max(map(len, curves)))]


def write_curves(path, curves):
    """A row for each number of looks, a column for each order."""
    longest = max(map(len, curves.values()))
    with open(path, "w", encoding="ascii", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["looks", *curves])
        for looks in range(longest):
            writer.writerow([looks, *(
                f"{curve[min(looks, len(curve) - 1)]:.4f}"
                for curve in curves.values())])


def describe(told):
    until = looks_until(shares(told))
    return (f"{told['drive']} by {told['order']}: 80 % after {until} of "
            f"{len(told['errors']) - 1} looks, {told['confirmed']} confirmed; "
            f"{told['open']} open at first, {told['right']} right; error "
            f"{told['errors'][0]:.2f} m at first, {told['errors'][-1]:.2f} m in the "
            f"end, {told['all']:.2f} m with all closed; {told['unsettled']} times not "
            "settled after 2 s")


def table(results, drives, orders):
    """The looks of each drive and order until the share is reached, and their sums."""
    rows, sums = [], [0.0] * len(orders)
    for drive in drives:
        means = []
        for order in orders:
            tolds = results[drive, order]
            means.append(sum(looks_until(shares(told)) for told in tolds) / len(tolds))
        sums = [before + mean for before, mean in zip(sums, means)]
        told = results[drive, orders[0]][0]
        rows.append([drive, f"{told['right']} / {told['open']}",
                     f"{told['errors'][0]:.2f}", f"{told['all']:.2f}",
                     *(f"{mean:.3g}" for mean in means)])
    rows.append(["together", "", "", "", *(f"**{count:.3g}**" for count in sums)])
    return markdown(["drive", "right / open at first", "error before, m",
                     "after all, m", *orders], rows)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--orders", default=",".join(ORDERS))
    parser.add_argument("--shuffles", type=int, default=1)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=1)
    parser.add_argument("--curve", type=pathlib.Path, metavar="FILE")
    parser.add_argument("drives", type=pathlib.Path, nargs="+", metavar="DRIVE")
    options = parser.parse_args()
    orders = options.orders.split(",")
    if unknown := set(orders) - set(ORDERS):
        parser.error(f"expected orders among {', '.join(ORDERS)}, "
                     f"got {', '.join(sorted(unknown))}")
    results = collections.defaultdict(list)
    with concurrent.futures.ProcessPoolExecutor(options.jobs) as pool:
        for done in concurrent.futures.as_completed(
                [pool.submit(measure, path, order, options.seed, shuffle)
                 for path in options.drives for order in orders
                 for shuffle in range(options.shuffles if order == "random" else 1)]):
            told = done.result()
            results[told["drive"], told["order"]].append(told)
            print(describe(told), flush=True)
    drives = [path.stem for path in options.drives]
    print(f"\n{table(results, drives, orders)}")
    if options.curve:
        write_curves(options.curve, {
            order: mean_curve([shares(told) for drive in drives
                               for told in results[drive, order]])
            for order in orders})


if __name__ == "__main__":
    main()
