"""The small drives of the paper's situations are what their names say."""

import math
import pathlib
import sys

import pytest

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import situations

SEQUENCE = 150  # metres, one pose each


def before_check(name):
    """The poses of the sequence at the check that the situation is about."""
    poses = situations.situation(name)[:-int(situations.BEHIND_CHECK)]
    return poses[-SEQUENCE:]


def turned(poses):
    """How far the path turns, radians, to both sides together."""
    return sum(abs(math.remainder(after.heading - before.heading, math.tau))
               for before, after in zip(poses, poses[1:]))


@pytest.mark.parametrize("name", situations.WAYS)
def test_drives_have_even_steps_along_their_headings(name):
    poses = situations.situation(name)
    steps = [math.dist(before[:2], after[:2])
             for before, after in zip(poses, poses[1:])]
    # The chord of an arc of 1 m with a radius of 15 m is 0.2 mm shorter.
    assert min(steps) > 0.9997
    assert max(steps) < 1.0 + 1e-9
    for before, after in zip(poses, poses[1:]):
        direction = math.atan2(after.y - before.y, after.x - before.x)
        assert abs(math.remainder(direction - before.heading,
                                  math.tau)) < 0.6 / situations.RADIUS


@pytest.mark.parametrize("name", situations.WAYS)
def test_drives_end_half_way_between_two_checks(name):
    meters = len(situations.situation(name)) - 1
    assert meters % situations.CHECK_INTERVAL == situations.BEHIND_CHECK


@pytest.mark.parametrize("name", situations.WAYS)
def test_way_to_the_check_has_been_driven_before(name):
    poses = situations.situation(name)
    history = poses[:-1000]
    for pose in before_check(name)[::10]:
        there = min(history, key=lambda old: math.dist(old[:2], pose[:2]))
        assert math.dist(there[:2], pose[:2]) < 1.0
        assert abs(math.remainder(there.heading - pose.heading,
                                  math.tau)) < 0.1


def test_sequences_turn_where_they_should():
    curve = math.radians(50.0)
    assert turned(before_check("curve still in the sequence")) \
        == pytest.approx(curve, abs=0.07)
    assert turned(before_check("straight road")) == 0.0
    assert turned(before_check("recovery further on")) > curve
    assert turned(before_check("symmetric corners")) \
        == pytest.approx(math.pi / 2.0, abs=0.07)


def test_symmetric_corners_look_alike_from_both_streets():
    poses = situations.situation("symmetric corners")
    here = before_check("symmetric corners")
    # The same shape 40 m to the west is among the first poses.
    for pose in here:
        assert min(math.dist((old.x + 40.0, old.y), pose[:2])
                   for old in poses[:700]) < 1.0


def check(*candidates):
    return {"candidates": [
        {"correct": correct, "verdict": verdict, "probability": probability,
         "meters_before": 2.0, "meters_after": meters}
        for correct, verdict, probability, meters in candidates]}


def test_outcomes_count_what_comes_first():
    one = situations.outcome([
        check((True, "ACCEPTED", 0.95, 4.0), (False, "ACCEPTED", 0.5, 0.0)),
        check((False, "ACCEPTED", 0.9, 30.0),
              (True, "REJECTED_BY_SHAPE", 0.1, 0.0)),
        check((True, "AMBIGUOUS", 0.35, 6.0)), check()])
    assert one == situations.Outcome(
        checks=4, accepted_right=1, accepted_wrong=1,
        not_accepted={"AMBIGUOUS": 1}, none=1, first=2, among_five=3,
        stated=pytest.approx((0.95 + 0.9 + 0.35) / 3), sure_wrong=1,
        interval=8.0)
    row = situations.row("a place", "relative", one)
    assert row == ["a place", "relative", 1, 1, "AMBIGUOUS 1, no candidate 1",
                   2, 3, "0.73", 1, "8"]
    paper = situations.outcome([check((True, "ACCEPTED", None, 0.0))])
    assert situations.row("a place", "paper's", paper)[-3:] == ["-"] * 3
