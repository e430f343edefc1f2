#!/usr/bin/env python3
"""How often a place can be right along its road, given fixes with correlated
errors: what bounds `revisit evaluate DRIVES --fix-noise M,S`.

The road is taken to be known. Then, at every fix, the part of the two passes'
difference that lies across the road is known, to within a lane or so, and the
part along it is not: on a straight it looks the same everywhere. A corner shows
it, and from there on it wanders off again. A Kalman filter carries the
covariance of the difference, a Gauss-Markov process in x and y, over the last
kilometre that the vehicle has driven before; the probability that its error
along the road is within 10 m at the end is averaged over the true loops.

Needs numpy: build/python/bin/python tests/evaluation/fix_ceiling.py 10 30 DRIVES
"""

import argparse
import csv
import math

import numpy

# As `revisit evaluate` has it: a fix each second, unless the vehicle stands;
# checks, what is no history, and what is a true loop.
PERIOD = 1.0
STANDSTILL = 0.5
FIRST_CHECK, INTERVAL, EXCLUDED = 300.0, 50.0, 150.0
RIGHT_METERS, RIGHT_RADIANS = 10.0, math.pi / 4
# How far two passes of one road lie apart, and what is known of that.
SAME_ROAD, LANE = 15.0, 1.0
OVERLAP = 1000.0


def fixes_of(path):
    """Time, x, y, heading of the truth at each fix."""
    with open(path, encoding="ascii") as file:
        rows = [[float(row[name]) for name in ("t_s", "gt_x", "gt_y", "gt_yaw")]
                for row in csv.DictReader(file)]
    fixes = [rows[0]]
    for row in rows:
        last = fixes[-1]
        if (row[0] - last[0] > PERIOD - 1e-6
                and math.dist(row[1:3], last[1:3]) >= STANDSTILL):
            fixes.append(row)
    return numpy.array(fixes)


def probabilities(fixes, sigma, seconds):
    """For each true loop, that of an error along the road within 10 m."""
    t, x, y, heading = fixes.T
    travelled = numpy.concatenate(
        [[0.0], numpy.cumsum(numpy.hypot(numpy.diff(x), numpy.diff(y)))])
    # Both passes have errors.
    stationary = 2.0 * sigma ** 2 * numpy.eye(2)
    for check in numpy.arange(FIRST_CHECK, travelled[-1], INTERVAL):
        end = int(numpy.searchsorted(travelled, check))
        old = numpy.flatnonzero(travelled < travelled[end] - EXCLUDED)

        def distances(i):
            return numpy.hypot(x[old] - x[i], y[old] - y[i])

        turn = numpy.cos(heading[old] - heading[end])
        if not numpy.any((distances(end) < RIGHT_METERS)
                         & (turn > math.cos(RIGHT_RADIANS))):
            continue
        first = end
        while (first > 0 and travelled[end] - travelled[first] < OVERLAP
               and distances(first).min() < SAME_ROAD):
            first -= 1
        covariance = stationary
        for i in range(first, end + 1):
            if i > first:
                kept = math.exp(-2.0 * (t[i] - t[i - 1]) / seconds)
                covariance = kept * covariance + (1.0 - kept) * stationary
            across = numpy.array([-math.sin(heading[i]), math.cos(heading[i])])
            seen = covariance @ across
            covariance = covariance - numpy.outer(seen, seen) / (
                across @ seen + LANE ** 2)
        along = numpy.array([math.cos(heading[end]), math.sin(heading[end])])
        yield math.erf(RIGHT_METERS
                       / math.sqrt(2.0 * along @ covariance @ along))


def main():
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])
    parser.add_argument("meters", type=float, help="as in --fix-noise")
    parser.add_argument("seconds", type=float, help="as in --fix-noise")
    parser.add_argument("drives", nargs="+", help="drive files with the truth")
    options = parser.parse_args()
    found = [p for drive in options.drives
             for p in probabilities(fixes_of(drive), options.meters,
                                    options.seconds)]
    print(f"{len(found)} true loops, {numpy.mean(found):.3f} of them can be "
          "right")


if __name__ == "__main__":
    main()
