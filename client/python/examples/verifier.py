#!/usr/bin/env python3
"""Verifies candidates as they are found, on the shipped drive: docs/verifier.md.

    verifier.py --server 127.0.0.1:50051 --vehicle shuttle-8

Everything but `StandIn` is what a verifier of your own needs too. `StandIn` takes the
place of a matcher of images or scans: the drive has neither, so it looks at the truth,
which no vehicle has, and answers what a matcher with a short range would measure."""

import argparse
import dataclasses
import enum
import math
import pathlib

import numpy as np

import revisit

DRIVE = (pathlib.Path(__file__).resolve().parents[3]
         / "tests/data/boreas/boreas_glen_shields.csv")
#: The vehicle asks after so many poses, some 60 m of this drive.
POSES_PER_CHECK = 8
#: A look at one pose finds what lies within 10 m of it, so the next is 20 m on.
LOOK_METERS = 20.0


class Answer(enum.Enum):
    """What a look at two poses tells."""
    SAME_PLACE = "one place"
    OTHER_PLACE = "another place"
    CANNOT_TELL = "cannot tell"


@dataclasses.dataclass(frozen=True)
class Look:
    """The answer about two poses and, if they are one place, the query as seen from
    the match: metres ahead, metres to the left, radians to the left, with the
    covariance of these."""
    answer: Answer
    relative: tuple = ()
    covariance: tuple = ()


class StandIn:
    """Stands in for a matcher. Write yours with the same `look()`."""

    POSITION_METERS, HEADING_RADIANS = 0.05, 0.003
    RANGE_METERS = 10.0
    #: In one of so many places there is too little to be seen.
    DARK_EVERY = 7

    def __init__(self, rows):
        self._truth = np.column_stack([rows[name]
                                       for name in ("gt_x", "gt_y", "gt_yaw")])
        self._random = np.random.default_rng(1)

    def look(self, query, matched):
        """Compares what was recorded at two sequences."""
        if query % self.DARK_EVERY == 0:
            return Look(Answer.CANNOT_TELL)
        there, here = self._truth[matched - 1], self._truth[query - 1]
        ahead, left = np.array([[math.cos(there[2]), math.sin(there[2])],
                                [-math.sin(there[2]), math.cos(there[2])]]) @ (
            here[:2] - there[:2])
        turned = math.remainder(here[2] - there[2], 2.0 * math.pi)
        if math.hypot(ahead, left) > self.RANGE_METERS:
            return Look(Answer.OTHER_PLACE)
        sigmas = np.array([self.POSITION_METERS, self.POSITION_METERS,
                           self.HEADING_RADIANS])
        measured = np.array([ahead, left, turned]) + sigmas * (
            self._random.standard_normal(3))
        return Look(Answer.SAME_PLACE, tuple(measured), tuple(np.diag(sigmas**2)))


class Verifier:
    """Looks at candidates and reports what it finds."""

    def __init__(self, client, vehicle, matcher, travelled):
        self._client, self._vehicle, self._matcher = client, vehicle, matcher
        #: Metres from the first pose, by sequence - 1.
        self._travelled = travelled
        self.counts = dict.fromkeys(Answer, 0)
        self.looks = 0
        self.doubtful = 0
        self._last_query = 0

    def verify(self, found):
        """Looks at what one search has found, best first, until one is confirmed."""
        if found.query.sequence == self._last_query:
            return  # It stands.
        self._last_query = found.query.sequence
        for candidate in found.candidates:
            if candidate.verdict != revisit.v1.VERDICT_ACCEPTED:
                continue
            answer = self._verify_one(candidate)
            self.counts[answer] += 1
            if answer is Answer.SAME_PLACE:
                return

    def _verify_one(self, candidate):
        query = self._nearest(candidate.query.travelled_meters)
        answers = set()
        for matched in self._places(candidate, query):
            look = self._matcher.look(query, matched)
            self.looks += 1
            answers.add(look.answer)
            if look.answer is Answer.SAME_PLACE:
                self._confirm(query, matched, look)
                return look.answer
        if answers == {Answer.OTHER_PLACE}:
            self._client.reject_candidate(self._vehicle, candidate, note="stand-in")
            return Answer.OTHER_PLACE
        return Answer.CANNOT_TELL

    def _nearest(self, travelled):
        """The sequence of the pose that is nearest along the path. Nodes lie between
        poses: `sequence` is that of the pose before one."""
        return int(np.abs(self._travelled - travelled).argmin()) + 1

    def _places(self, candidate, query):
        """Sequences to look at: the match, then others along its interval, each as
        far from its node as the query is from the query's."""
        ahead = self._travelled[query - 1] - candidate.query.travelled_meters
        if candidate.direction == revisit.v1.DIRECTION_OPPOSITE:
            ahead = -ahead
        at = candidate.matched.travelled_meters + ahead
        interval = candidate.place_interval
        offsets = [0.0]
        for far, sign in ((interval.meters_before, -1.0),
                          (interval.meters_after, 1.0)):
            offsets += [sign * step * LOOK_METERS for step in range(
                1, 1 + math.ceil(max(0.0, far / LOOK_METERS - 0.5)))]
        nearest = dict.fromkeys(self._nearest(at + offset)
                                for offset in sorted(offsets, key=abs))
        return [sequence for sequence in nearest if sequence < query]

    def _confirm(self, query, matched, look):
        added = self._client.add_loop_closure(
            self._vehicle, query, matched, relative=look.relative,
            covariance=np.array(look.covariance), note="stand-in")
        if added.agreement.p_value < 0.001:
            self.doubtful += 1


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--server", default="127.0.0.1:50051")
    parser.add_argument("--vehicle", required=True)
    arguments = parser.parse_args()
    rows = np.genfromtxt(DRIVE, delimiter=",", names=True)
    poses = revisit.Poses.local(
        rows["est_x"], rows["est_y"], rows["est_yaw"],
        np.column_stack([rows[name] for name in
                         ("pxx", "pxy", "pxt", "pyy", "pyt", "ptt")]),
        stamps=rows["t_s"], sequence=np.arange(1, len(rows) + 1))
    steps = np.hypot(np.diff(rows["est_x"]), np.diff(rows["est_y"]))
    with revisit.Client(arguments.server) as client:
        client.create_vehicle(arguments.vehicle)
        verifier = Verifier(client, arguments.vehicle, StandIn(rows),
                            np.concatenate([[0.0], np.cumsum(steps)]))
        for row in range(0, len(poses), POSES_PER_CHECK):
            client.append_poses(arguments.vehicle, poses[row:row + POSES_PER_CHECK])
            verifier.verify(client.find_candidates(arguments.vehicle,
                                                   direction="either"))
        consistency = client.get_vehicle(arguments.vehicle).consistency
    for answer, count in verifier.counts.items():
        print(f"{answer.value:14} {count}")
    print(f"{'looks':14} {verifier.looks}")
    print(f"{'doubtful':14} {verifier.doubtful}")
    print(f"innovation     {consistency.mean_normalized_innovation_squared:.2f} in "
          f"the mean, {consistency.degrees_of_freedom} if covariances are honest")


if __name__ == "__main__":
    main()
