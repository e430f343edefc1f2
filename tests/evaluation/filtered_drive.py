#!/usr/bin/env python3
"""A drive as a loosely coupled Kalman filter of GNSS fixes and odometry has it.

    filtered_drive.py SOLUTION.pos ... --truth REFERENCE.csv ... --out DRIVE.csv
                      [--seed N] [--fix-scale FACTOR]

The result is a drive file with truth, covariances and error transitions for
`revisit evaluate --correlation-model filter`: metres east and north of the
first true position, radians, seconds. SOLUTION is what RTKLIB makes of a
receiver (.pos with standard deviations and velocities), REFERENCE what was
recorded beside it, with the columns "GPS TOW (s)" and so on that `revisit
evaluate --truth` reads; both may be compressed (.gz). Several pairs are
one drive after the other, in one frame; the filter begins anew with each.

The fixes are the receiver's own, with their errors between high buildings and
with the covariances that it states. Odometry was not recorded: it is the step
of the reference from one epoch (5 Hz) to the next as the vehicle sees it, with
noise of 0.1 m along, 0.05 m across and 0.1 degree per square root of a metre,
drawn with the seed.

The state is (x, y, heading). A step carries error and covariance on by F, and a
fix corrects both with the gain K:

    P <- F P F' + G Q G'          P <- (I - K H) P (I - K H)' + K R K'
    e <- F e + noise              e <- (I - K H) e + noise

so that the error transition of a pose is the product of the F and (I - K H) since
the pose before. The filter begins at the first fix at which the vehicle moves at
2 m/s, since the heading is that of the velocity. A fix counts when the vehicle
has moved 0.5 m since the last one, for errors of a vehicle that stands do not
change; one that is too far from where the filter is (chi-square, 99 %) is left
out. Errors of fixes last for many seconds, as if there were fewer fixes than there
are, so that a filter that believes them each second is overconfident:
`--fix-scale` (3) multiplies their standard deviations.

Needs Python 3.8 or newer and numpy.
"""

import argparse
import collections
import csv
import datetime
import gzip
import math
import pathlib
import random
import sys

import numpy as np

from road_drives import ACROSS, ALONG, HEADING

GPS_EPOCH = datetime.datetime(1980, 1, 6)
WEEK = 7 * 86400.0

LEAST_SPEED = 2.0  # metres per second, at which a velocity tells a heading
LEAST_MOTION = 0.5  # metres between fixes that count
STANDSTILL = 0.05  # metres; less is not counted as motion
FIX_SCALE = 3.0
# The chi-square quantile of 0.99 with two degrees of freedom.
INNOVATION_GATE = -2.0 * math.log(0.01)

HEADER = ("t_s,gt_x,gt_y,gt_yaw,est_x,est_y,est_yaw,pxx,pxy,pxt,pyy,pyt,ptt,"
          "fxx,fxy,fxt,fyx,fyy,fyt,ftx,fty,ftt")

# Seconds of GPS time; degrees and metres; metres per second and their
# covariance, east before north.
Fix = collections.namedtuple(
    "Fix", "t place covariance velocity velocity_covariance")
# Radians counter-clockwise from east.
Reference = collections.namedtuple("Reference", "t place heading")
# A pose that the filter states, with the error transition from the one before.
Estimate = collections.namedtuple("Estimate", "t pose covariance transition")


def open_text(path):
    opener = gzip.open if str(path).endswith(".gz") else open
    return opener(path, "rt", encoding="ascii")


def signed_square(value):
    return value * abs(value)


def covariance_of(row, east, north, mixed):
    """Of RTKLIB's deviations, whose mixed one is a signed square root."""
    both = signed_square(row[mixed])
    return np.array([[row[east] ** 2, both], [both, row[north] ** 2]])


def read_fixes(path):
    columns, fixes = None, []
    with open_text(path) as file:
        for line in file:
            words = line.lstrip("%").split()
            if line.startswith("%"):
                columns = words if words[:1] == ["GPST"] else columns
                continue
            at = datetime.datetime.strptime(" ".join(words[:2]),
                                            "%Y/%m/%d %H:%M:%S.%f")
            row = dict(zip(columns[1:], map(float, words[2:])))
            fixes.append(Fix(
                (at - GPS_EPOCH).total_seconds(),
                (row["latitude(deg)"], row["longitude(deg)"], row["height(m)"]),
                covariance_of(row, "sde(m)", "sdn(m)", "sdne(m)"),
                np.array([row["ve(m/s)"], row["vn(m/s)"]]),
                covariance_of(row, "sdve", "sdvn", "sdvne")))
    return fixes


def read_reference(path):
    with open_text(path) as file:
        rows = csv.DictReader(file, skipinitialspace=True)
        return [Reference(
            float(row["GPS Week"]) * WEEK + float(row["GPS TOW (s)"]),
            tuple(float(row[name]) for name in (
                "Latitude (deg)", "Longitude (deg)", "Ellipsoid Height (m)")),
            math.radians(90.0 - float(row["Heading (deg)"])))
            for row in rows]


class Frame:
    """East and north of an origin on WGS84, metres."""

    AXIS = 6378137.0
    FLATTENING = 1.0 / 298.257223563

    def __init__(self, origin):
        latitude, longitude = map(math.radians, origin[:2])
        self.origin = self.cartesian(origin)
        s, c = math.sin(latitude), math.cos(latitude)
        self.rows = np.array([
            [-math.sin(longitude), math.cos(longitude), 0.0],
            [-s * math.cos(longitude), -s * math.sin(longitude), c]])

    def cartesian(self, place):
        latitude, longitude = map(math.radians, place[:2])
        squared = self.FLATTENING * (2.0 - self.FLATTENING)
        s, c = math.sin(latitude), math.cos(latitude)
        across = self.AXIS / math.sqrt(1.0 - squared * s * s)
        return np.array([
            (across + place[2]) * c * math.cos(longitude),
            (across + place[2]) * c * math.sin(longitude),
            (across * (1.0 - squared) + place[2]) * s])

    def local(self, place):
        return self.rows @ (self.cartesian(place) - self.origin)


def turn_matrix(angle):
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s], [s, c]])


class Filter:
    """A Kalman filter over (x, y, heading) that knows its error transition."""

    def __init__(self, pose, covariance):
        self.pose = np.array(pose)
        self.covariance = np.array(covariance)
        # Nothing is left of the error before the filter began.
        self.transition = np.zeros((3, 3))

    def step(self, forward, left, turn):
        """A step as odometry has it: metres, and radians at its end."""
        length = math.hypot(forward, left)
        moved = turn_matrix(self.pose[2]) @ [forward, left]
        carried = np.eye(3)
        carried[:2, 2] = -moved[1], moved[0]
        noise = np.zeros((3, 3))
        turned = turn_matrix(self.pose[2] + turn / 2.0)
        noise[:2, :2] = turned @ np.diag(
            [ALONG ** 2 * length, ACROSS ** 2 * length]) @ turned.T
        noise[2, 2] = HEADING ** 2 * length
        self.pose[:2] += moved
        self.pose[2] = math.remainder(self.pose[2] + turn, math.tau)
        self.covariance = carried @ self.covariance @ carried.T + noise
        self.transition = carried @ self.transition

    def correct(self, position, covariance):
        """Takes a fix, unless it is too far off. Says whether it did."""
        innovation = position - self.pose[:2]
        expected = self.covariance[:2, :2] + covariance
        if innovation @ np.linalg.solve(expected, innovation) \
                > INNOVATION_GATE:
            return False
        gain = self.covariance[:, :2] @ np.linalg.inv(expected)
        kept = np.eye(3)
        kept[:, :2] -= gain
        self.pose += gain @ innovation
        self.pose[2] = math.remainder(self.pose[2], math.tau)
        self.covariance = (kept @ self.covariance @ kept.T
                           + gain @ covariance @ gain.T)
        self.transition = kept @ self.transition
        return True

    def take(self, t):
        """What the filter states now. Transitions count from here."""
        taken = Estimate(t, self.pose.copy(), self.covariance.copy(),
                         self.transition)
        self.transition = np.eye(3)
        return taken


def first_heading(fix):
    """The direction of a fix's velocity and its variance."""
    speed = np.linalg.norm(fix.velocity)
    left = np.array([-fix.velocity[1], fix.velocity[0]]) / speed
    return (math.atan2(fix.velocity[1], fix.velocity[0]),
            left @ fix.velocity_covariance @ left / speed ** 2)


def draw_step(seen, rng):
    """A step (forward, left, turn) as odometry with noise has it."""
    forward, left, turn = seen
    root = math.sqrt(math.hypot(forward, left))
    noise = turn_matrix(turn / 2.0) @ [rng.gauss(0.0, ALONG * root),
                                       rng.gauss(0.0, ACROSS * root)]
    return (forward + noise[0], left + noise[1],
            turn + rng.gauss(0.0, HEADING * root))


def between(before, after):
    """The pose (x, y, heading) `after` as seen from `before`."""
    x, y = turn_matrix(-before[2]) @ (np.array(after[:2]) - before[:2])
    return x, y, math.remainder(after[2] - before[2], math.tau)


def run_filter(fixes, truth, rng, fix_scale=FIX_SCALE, fix_every=0.0):
    """Estimates at the times of `truth`, from the first fix that tells a
    heading on.

    Fixes are those of one drive with local positions in place of `place`;
    `truth` is (t, pose) in order.
    """
    def due(t):
        return fixes and fixes[0].t <= t + 1e-3

    fixes = collections.deque(fixes)
    while np.linalg.norm(fixes[0].velocity) < LEAST_SPEED:
        fixes.popleft()
    begin = fixes[0].t
    estimates = []
    state, counted, fixed_at, next_fix = None, None, None, begin + fix_every
    for t, pose in truth:
        if t < begin - 1e-3:
            continue
        if state is None:
            fix = fixes.popleft()
            heading, variance = first_heading(fix)
            covariance = np.zeros((3, 3))
            covariance[:2, :2] = fix_scale ** 2 * fix.covariance
            covariance[2, 2] = variance
            state = Filter([*fix.place, heading], covariance)
            counted = fixed_at = pose
        elif math.dist(pose[:2], counted[:2]) >= STANDSTILL:
            state.step(*draw_step(between(counted, pose), rng))
            counted = pose
        while due(t):
            fix = fixes.popleft()
            if (math.dist(pose[:2], fixed_at[:2]) >= LEAST_MOTION
                    and t >= next_fix - 1e-3):
                state.correct(fix.place, fix_scale ** 2 * fix.covariance)
                fixed_at, next_fix = pose, t + fix_every
        estimates.append(state.take(t))
    return estimates


def filtered(solutions, references, seed, fix_scale=FIX_SCALE, fix_every=0.0):
    """[(Estimate, true pose), ...] of all drives, one after the other."""
    rng = random.Random(seed)
    frame, rows = None, []
    for solution, reference in zip(solutions, references):
        recorded = read_reference(reference)
        frame = frame or Frame(recorded[0].place)
        truth = {one.t: (*frame.local(one.place), one.heading)
                 for one in recorded}
        fixes = [fix._replace(place=frame.local(fix.place))
                 for fix in read_fixes(solution)]
        rows += [(estimate, truth[estimate.t]) for estimate in run_filter(
            fixes, list(truth.items()), rng, fix_scale, fix_every)]
    return rows


def squared_error(estimate, pose):
    """The squared Mahalanobis distance of an estimate's error."""
    error = estimate.pose - pose
    error[2] = math.remainder(error[2], math.tau)
    return error @ np.linalg.solve(estimate.covariance, error)


def write_drive(path, rows):
    upper = np.triu_indices(3)
    with open(path, "w", encoding="ascii", newline="\n") as file:
        file.write(HEADER + "\n")
        begin = rows[0][0].t
        for estimate, pose in rows:
            numbers = [*pose, *estimate.pose, *estimate.covariance[upper],
                       *estimate.transition.ravel()]
            file.write(",".join([f"{estimate.t - begin:.3f}",
                                 *(f"{number:.12g}" for number in numbers)])
                       + "\n")


def main():
    parser = argparse.ArgumentParser(
        description=__doc__.split("\n\n", maxsplit=1)[0])
    parser.add_argument("solutions", nargs="+", type=pathlib.Path,
                        metavar="SOLUTION.pos")
    parser.add_argument("--truth", nargs="+", type=pathlib.Path, required=True,
                        metavar="REFERENCE.csv")
    parser.add_argument("--seed", type=int, default=1,
                        help="a seed gives the same odometry each time (1)")
    parser.add_argument("--fix-scale", type=float, default=FIX_SCALE,
                        help="standard deviations of fixes, times this "
                             f"({FIX_SCALE:g})")
    parser.add_argument("--fix-every", type=float, default=0.0,
                        metavar="SECONDS",
                        help="let the filter have no more fixes than that (0)")
    parser.add_argument("--out", type=pathlib.Path, required=True,
                        metavar="DRIVE.csv")
    options = parser.parse_args()
    if len(options.solutions) != len(options.truth):
        parser.error("--truth: expected one for each SOLUTION")
    rows = filtered(options.solutions, options.truth, options.seed,
                    options.fix_scale, options.fix_every)
    write_drive(options.out, rows)
    errors = [squared_error(*row) for row in rows]
    off = sorted(math.dist(estimate.pose[:2], pose[:2])
                 for estimate, pose in rows)
    # The chi-square quantile of 0.95 with three degrees of freedom.
    inside = sum(error <= 7.815 for error in errors) / len(errors)
    print(f"{len(rows)} poses; errors of {off[len(off) // 2]:.1f} m in the "
          f"median, {off[-1]:.1f} m at most; {inside:.2f} of them within the "
          "95 % of the stated covariance", file=sys.stderr)


if __name__ == "__main__":
    main()
