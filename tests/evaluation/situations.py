#!/usr/bin/env python3
"""The situations in which the paper's method goes wrong and right, drawn small.

    situations.py [--revisit PROGRAM] [--seeds SEEDS]

Nieto, Agamennoni and Vidal-Calleja (2010) show by their Figs. 6 and 7 where the
shape of a path tells a place and where it does not. Here each situation is a
drive over roads made of straights and corners, which ends about 25 m behind the
check that it is named after:

  curve still in the sequence   100 m behind a curve, on a straight of 700 m
  straight road                 550 m behind it: nothing but the straight is left
  recovery further on           100 m behind the next curve
  symmetric corners             60 m behind the second of two equal corners, which
                                lie 40 m from each other

All four ways have been driven before, some 3 km earlier. `revisit
evaluate` draws the estimates with the noise that is claimed, once for each
seed, and the last check counts. Printed is a table in Markdown of what its first
candidate is, for the relative alignment and for the paper's.

Needs nothing but Python 3.8 or newer.
"""

import argparse
import collections
import math
import pathlib
import statistics
import tempfile

from reports import REVISIT, decimals, markdown, report_of
from road_drives import Pose, write_drive

STEP = 1.0  # metres between samples
RADIUS = 15.0  # of corners, metres
# Checks come each 50 m of the estimate's path. A drive that ends half-way
# between two has the same last check whatever its noise.
CHECK_INTERVAL, BEHIND_CHECK = 50.0, 25.0

# One lap: a curve to the left at CURVE, 700 m straight, a curve to the right at
# NEXT_CURVE, and another way back.
START, CURVE = (0.0, 0.0), (150.0, 0.0)
NEXT_CURVE = (150.0 + 700.0 * math.cos(math.radians(50.0)),
              700.0 * math.sin(math.radians(50.0)))
LAP = [START, CURVE, NEXT_CURVE, (835.0, 451.0), (900.0, 150.0),
       (600.0, -120.0), (250.0, -200.0), (-150.0, -160.0), (-200.0, 0.0)]

# Two streets to the north, 40 m apart, that end at one street to the east.
CORNERS = [(0.0, -300.0), (0.0, 0.0), (400.0, 0.0), (500.0, -150.0),
           (420.0, -420.0), (40.0, -480.0), (40.0, 0.0), (500.0, 0.0),
           (800.0, -250.0), (900.0, -800.0), (450.0, -1000.0), (40.0, -840.0),
           (40.0, 0.0)]


def beyond(start, end, meters):
    """The point so far behind `end` on the line from `start`."""
    length = math.dist(start, end)
    return tuple(b + (b - a) / length * meters for a, b in zip(start, end))


def towards(start, end, meters):
    """The point so far from `start` on the line to `end`."""
    return beyond(end, start, -meters)


def again(*rest):
    """A lap, and the way along it once more through these points."""
    return [*LAP, START, CURVE, *rest]


WAYS = {
    "curve still in the sequence":
        again(towards(CURVE, NEXT_CURVE, 100.0 + BEHIND_CHECK)),
    "straight road":
        again(towards(CURVE, NEXT_CURVE, 550.0 + BEHIND_CHECK)),
    "recovery further on":
        again(NEXT_CURVE, towards(NEXT_CURVE, LAP[3], 100.0 + BEHIND_CHECK)),
    "symmetric corners": [*CORNERS, (40.0 + 60.0 + BEHIND_CHECK, 0.0)],
}


def drive_along(corners, radius=RADIUS):
    """Poses each STEP along straight lines with rounded corners."""
    # Each piece: where it begins, its heading, its length and its curvature.
    pieces = []
    at = corners[0]
    for before, corner, after in zip(corners, corners[1:], corners[2:]):
        heading = direction(before, corner)
        turn = math.remainder(direction(corner, after) - heading, math.tau)
        cut = radius * math.tan(abs(turn) / 2.0)
        arc = towards(corner, before, cut)
        pieces.append((at, heading, math.dist(at, arc), 0.0))
        pieces.append((arc, heading, radius * abs(turn),
                       math.copysign(1.0 / radius, turn)))
        at = towards(corner, after, cut)
    pieces.append((at, direction(corners[-2], corners[-1]),
                   math.dist(at, corners[-1]), 0.0))
    return list(sample(pieces))


def direction(start, end):
    return math.atan2(end[1] - start[1], end[0] - start[0])


def sample(pieces):
    offset = 0.0  # along the piece
    for (x, y), heading, length, curvature in pieces:
        while offset < length:
            turn = curvature * offset
            # The chord of an arc lies half-way between its two headings.
            chord = (offset if curvature == 0.0
                     else 2.0 / curvature * math.sin(turn / 2.0))
            yield Pose(x + chord * math.cos(heading + turn / 2.0),
                       y + chord * math.sin(heading + turn / 2.0),
                       math.remainder(heading + turn, math.tau))
            offset += STEP
        offset -= length


def situation(name):
    """The drive of a situation. Its first straight begins as much earlier as it
    takes for the drive to end half-way between two checks."""
    corners = list(WAYS[name])
    meters = STEP * (len(drive_along(corners)) - 1)
    lead = (BEHIND_CHECK - meters) % CHECK_INTERVAL
    corners[0] = beyond(corners[1], corners[0], lead)
    return drive_along(corners)


def write_situations(folder):
    """The files of all situations, by name."""
    files = {}
    for name in WAYS:
        files[name] = pathlib.Path(folder) / f"{name.replace(' ', '_')}.csv"
        poses = situation(name)
        write_drive(files[name], poses, poses)
    return files


def evaluate(program, files, seeds, *flags):
    """The last check of each situation with each seed: {name: [check, ...]}."""
    report = report_of(program, *files.values(), "--simulate", seeds,
                       "--verbose", *flags)
    names = {path.stem: name for name, path in files.items()}
    checks = {name: [] for name in files}
    for drive in report["drives"]:
        checks[names[drive["drive"]]].append(drive["check_list"][-1])
    return checks


Outcome = collections.namedtuple(
    "Outcome", "checks accepted_right accepted_wrong not_accepted none first "
               "among_five stated sure_wrong interval")


def outcome(checks):
    """What the first candidates of these checks are.

    `not_accepted` counts them by verdict; `first` and `among_five` are how often
    a right one is first, or among the first five, whatever the verdict; `stated`
    is the mean of the first one's probability, `sure_wrong` how often it is
    wrong and stated at 0.9 or more, and `interval` the median of the metres of
    road on which its place is said to lie.
    """
    firsts = [check["candidates"][0] for check in checks
              if check["candidates"]]
    accepted = collections.Counter(
        first["correct"] for first in firsts if first["verdict"] == "ACCEPTED")
    stated = [first["probability"] for first in firsts
              if first["probability"] is not None]
    return Outcome(
        checks=len(checks), accepted_right=accepted[True],
        accepted_wrong=accepted[False],
        not_accepted=collections.Counter(
            first["verdict"] for first in firsts
            if first["verdict"] != "ACCEPTED"),
        none=len(checks) - len(firsts),
        first=sum(first["correct"] for first in firsts),
        among_five=sum(any(one["correct"] for one in check["candidates"][:5])
                       for check in checks),
        stated=sum(stated) / len(stated) if stated else None,
        sure_wrong=sum((first["probability"] or 0.0) >= 0.9
                       and not first["correct"] for first in firsts),
        interval=statistics.median(
            first["meters_before"] + first["meters_after"]
            for first in firsts) if stated else None)


HEADER = ["situation", "alignment", "accepted, right", "accepted, wrong",
          "not accepted", "right first", "right among five",
          "mean p of the first", "wrong at p ≥ 0.9",
          "metres of its interval, median"]


def row(name, alignment, one):
    others = [f"{verdict} {count}"
              for verdict, count in sorted(one.not_accepted.items())]
    others += [f"no candidate {one.none}"] if one.none else []
    return [name, alignment, one.accepted_right, one.accepted_wrong,
            ", ".join(others) or "-", one.first, one.among_five,
            decimals(one.stated, 2),
            "-" if one.stated is None else one.sure_wrong,
            decimals(one.interval, 0)]


def table(program, seeds):
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        files = write_situations(folder)
        results = {
            name: evaluate(program, files, seeds, "--alignment", alignment)
            for name, alignment in (("relative", "relative"),
                                    ("paper's", "composite"))}
    for name in files:
        for alignment, checks in results.items():
            rows.append(row(name, alignment, outcome(checks[name])))
    return markdown(HEADER, rows)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__.split("\n\n", maxsplit=1)[0])
    parser.add_argument("--revisit", default=REVISIT)
    parser.add_argument("--seeds", default="1-40",
                        help="as of revisit evaluate --simulate (1-40)")
    options = parser.parse_args()
    print(table(options.revisit, options.seeds))


if __name__ == "__main__":
    main()
