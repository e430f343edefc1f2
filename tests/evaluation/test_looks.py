"""The figures about looks mean what they say."""

import csv
import math
import pathlib
import random
import sys
from types import SimpleNamespace

import numpy as np
import pytest

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import looks


def test_error_does_not_depend_on_where_the_trajectory_lies_as_a_whole():
    rng = np.random.default_rng(1)
    truth = rng.normal(0.0, 100.0, (50, 3))
    c, s = math.cos(2.0), math.sin(2.0)
    turned = truth[:, :2] @ np.array([[c, s], [-s, c]]) + (30.0, -7.0)
    assert looks.position_error(turned, truth) == pytest.approx(0.0, abs=1e-9)
    # Along a straight line of two metres a quarter more at each end.
    line = np.array([[-1.0, 0.0], [1.0, 0.0]])
    assert looks.position_error(1.25 * line, line) == pytest.approx(0.25)


def test_share_is_reached_with_the_first_look_that_reaches_it():
    told = {"errors": [10.0, 8.0, 3.5, 4.5, 2.0], "all": 2.0}
    assert looks.shares(told) == pytest.approx([0.0, 0.25, 0.8125, 0.6875, 1.0])
    assert looks.looks_until(looks.shares(told)) == 2
    assert looks.looks_until([0.0, 0.5]) == math.inf


def test_mean_keeps_what_drives_without_further_looks_have_reached(tmp_path):
    curve = looks.mean_curve([[0.0, 1.0], [0.0, 0.2, 0.6]])
    assert curve == pytest.approx([0.0, 0.6, 0.8])
    looks.write_curves(tmp_path / "looks.csv", {"value": curve, "time": [0.0, 0.5]})
    with open(tmp_path / "looks.csv", encoding="ascii", newline="") as file:
        assert [list(row.values()) for row in csv.DictReader(file)] == [
            ["0", "0.0000", "0.0000"], ["1", "0.6000", "0.5000"],
            ["2", "0.8000", "0.5000"]]


def test_each_order_takes_its_own_candidate():
    early, likely, valuable = (
        SimpleNamespace(value=value, probability=probability)
        for value, probability in ((1.0, 0.5), (2.0, 0.9), (3.0, 0.1)))
    candidates = [early, likely, valuable]
    draw = random.Random(1)
    assert looks.choose("value", candidates, draw) is valuable
    assert looks.choose("probability", candidates, draw) is likely
    assert looks.choose("time", candidates, draw) is early
    drawn = [looks.choose("random", candidates, draw) for _ in range(100)]
    assert all(one in drawn for one in candidates)


def test_verifier_finds_what_is_near_and_faces_the_same_way():
    truth = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 0.0], [9.0, 1.0, 0.1],
                      [11.0, 0.0, 0.0], [1.0, 0.0, math.pi]])
    verifier = looks.Verifier(truth, seed=1)
    assert verifier.look(3, 1) == pytest.approx((9.0, 1.0, 0.1), abs=0.6)
    assert verifier.look(3, 1) == verifier.look(3, 1)
    assert [verifier.look(query, 1) for query in (2, 4, 5)] == [None] * 3
