"""The verifier of the examples that runs as a service measures what it should on scans
that are made here, and decides each candidate once in effect."""

import importlib.util
import itertools

import grpc
import numpy as np
import pytest

import revisit
from conftest import ROOT
from fake_feed import FakeFeed, check
from fake_service import Fault, serving
from revisit import BackoffOptions, v1

PATH = ROOT / "client/python/examples/scan_verifier.py"
QUICK = BackoffOptions(initial=0.01, max=0.05)
SEED = 20101018
#: A planar lidar.
BEAMS, RANGE_METERS, NOISE_METERS = 360, 25.0, 0.02


@pytest.fixture(scope="module")
def example():
    spec = importlib.util.spec_from_file_location("scan_verifier", PATH)
    made = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


def walls(seed):
    """A street of houses with gaps between them, and posts: segments (N, 2, 2)."""
    random = np.random.default_rng(seed)
    made = []
    for side in (-1.0, 1.0):
        along = -60.0
        while along < 60.0:
            width, depth = random.uniform(4.0, 11.0), random.uniform(3.0, 8.0)
            front = side * random.uniform(6.0, 10.0)
            corners = [(along, front + side * depth), (along, front),
                       (along + width, front), (along + width, front + side * depth)]
            made += itertools.pairwise(corners)
            along += width + random.uniform(1.5, 6.0)
    for x, y in zip(random.uniform(-30, 30, 12), random.choice((-4.0, 4.0), 12)):
        made += [((x - 0.3, y), (x + 0.3, y)), ((x, y - 0.3), (x, y + 0.3))]
    return np.array(made)


def scan(segments, pose, random):
    """What a lidar at this pose sees: the nearest wall of each beam."""
    x, y, heading = pose
    angles = np.linspace(-np.pi, np.pi, BEAMS, endpoint=False)
    rays = np.column_stack([np.cos(angles + heading), np.sin(angles + heading)])
    starts, ways = segments[:, 0] - (x, y), segments[:, 1] - segments[:, 0]
    # start + s way = range ray, for each ray and segment; none where they are parallel.
    across = rays[:, :1] * ways[:, 1] - rays[:, 1:] * ways[:, 0]
    across[across == 0.0] = np.nan
    ranges = (starts[:, 0] * ways[:, 1] - starts[:, 1] * ways[:, 0]) / across
    along = (starts[:, 0] * rays[:, 1:] - starts[:, 1] * rays[:, :1]) / across
    ranges[~((ranges > 0) & (along >= 0) & (along <= 1))] = np.inf
    nearest = ranges.min(axis=1)
    seen = nearest < RANGE_METERS
    nearest = nearest[seen] + random.normal(0.0, NOISE_METERS, seen.sum())
    return nearest[:, np.newaxis] * np.column_stack([np.cos(angles), np.sin(angles)]
                                                    )[seen]


def as_seen_from(there, here):
    """The pose `here` in the frame of `there`: x, y, heading."""
    c, s = np.cos(there[2]), np.sin(there[2])
    x, y = np.subtract(here[:2], there[:2])
    return np.array([c * x + s * y, -s * x + c * y, here[2] - there[2]])


def measured(matrix):
    return np.array([*matrix[:2, 2], np.arctan2(matrix[1, 0], matrix[0, 0])])


def turned(difference):
    return (difference + np.pi) % (2 * np.pi) - np.pi


def test_scans_of_one_place_tell_the_relative_pose_within_the_covariance(example):
    print(f"seed {SEED}")
    random = np.random.default_rng(SEED)
    squares = []
    for number in range(20):
        street = walls(SEED + number)
        there = np.array([*random.uniform(-1, 1, 2), random.uniform(-0.1, 0.1)])
        here = there + [*random.uniform(-2, 2, 2), random.uniform(-0.15, 0.15)]
        is_opposite = number % 3 == 0
        here[2] += np.pi * is_opposite
        matrix, covariance, fit = example.compare(
            scan(street, here, random), scan(street, there, random), is_opposite)
        error = measured(matrix) - as_seen_from(there, here)
        error[2] = turned(error[2])
        assert fit >= 0.8 > example.ENOUGH, number
        assert np.hypot(*error[:2]) < 0.15 and abs(error[2]) < 0.01, (number, error)
        squares.append(error @ np.linalg.solve(covariance, error))
    # 3 in the mean if the covariance is honest.
    assert 0.3 < np.mean(squares) < 4.5


def test_scans_of_two_places_are_not_taken_for_one(example):
    print(f"seed {SEED}")
    random = np.random.default_rng(SEED)
    fits = [example.compare(scan(walls(SEED + number), (0.0, 0.0, 0.0), random),
                            scan(walls(SEED - 1 - number), (0.0, 0.0, 0.0), random))[2]
            for number in range(20)]
    assert max(fits) <= example.TOO_LITTLE


def test_the_verifier_decides_each_candidate_once_in_effect(example, tmp_path, capsys):
    """Although its server goes away in the middle, and it is itself killed between a
    decision and the next event."""
    random = np.random.default_rng(SEED)
    street, other = walls(SEED), walls(SEED + 1000)
    folder = tmp_path / "scans"
    (folder / "a").mkdir(parents=True)
    there, here = (0.0, 0.0, 0.0), (1.0, -0.5, 0.1)
    # As the feed tells them: number N has the query 10 N and the match N.
    for number, (first, second) in enumerate(
            [(street, street), (street, other), (street, street)], start=1):
        np.save(folder / f"a/{number}.npy", scan(first, there, random))
        np.save(folder / f"a/{10 * number}.npy", scan(second, here, random))
    feed = FakeFeed()
    feed.checks = [check("a", 10, v1.CANDIDATE_STATE_OPEN)]
    feed.ends = [(1, Fault(grpc.StatusCode.UNAVAILABLE))]

    class Killed(Exception):
        pass

    class Mortal:
        """A client whose program dies after so many events were decided."""

        def __init__(self, client, events):
            self.client, self.events = client, events

        def watch(self, **arguments):
            watch = self.client.watch(**arguments)
            for count, event in enumerate(watch, start=1):
                yield event
                if count == 1 and not feed.events:
                    feed.tell("a", 2)
                    feed.tell("a", 3)
                if count == self.events:
                    raise Killed

    with serving(feed) as address, revisit.Client(address, backoff=QUICK) as client:
        with pytest.raises(Killed):
            example.verify(Mortal(client, 3), folder, tmp_path / "cursor")
        feed.tell_deletion("b", 1)
        with pytest.raises(Killed):
            example.verify(Mortal(client, 2), folder, tmp_path / "cursor")
    name = "vehicles/a/checks/{}/candidates/1".format
    assert [one.candidate for one in feed.decisions] == [
        name(10), name(20), name(30), name(30)]
    kinds = [type(one).__name__ for one in feed.decisions]
    assert kinds == ["AddLoopClosureRequest", "RejectCandidateRequest",
                     "AddLoopClosureRequest", "AddLoopClosureRequest"]
    # The server takes a repetition of the same content for what it has.
    assert feed.decisions[2] == feed.decisions[3]
    measurement = feed.decisions[0].loop_closure.measurement
    assert measurement.x_meters == pytest.approx(1.0, abs=0.1)
    assert measurement.heading_radians == pytest.approx(0.1, abs=0.01)
    assert capsys.readouterr().out.count("confirmed") == 3
