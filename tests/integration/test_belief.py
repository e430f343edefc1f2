"""A search that begins with a belief answers by the poses up to the query, the
loop closures and the rejections, whenever and however often it is asked."""

import math
import random

import numpy
import pytest

from revisit_server import Server
from stubs import api
from wire import (LOOP_CLOSURES, REJECTED_CANDIDATES, PoseStream, append,
                  batches, get, pose)

POSES = 2300
# Standard deviations per metre: what the estimator adds, and what it claims.
DRIFT = (0.02, 0.002)
CLAIMED = 0.5


def course(angle):
    """A closed road of some 900 m whose bends differ from each other."""
    radius = (130.0 + 18.0 * math.sin(3.0 * angle + 0.4)
              + 12.0 * math.sin(5.0 * angle) + 6.0 * math.cos(8.0 * angle))
    return numpy.array([radius * math.cos(angle), radius * math.sin(angle)])


def drive(seed=20101018):
    """Two laps and a half at a metre a pose, as an odometer reckons them."""
    rng = random.Random(seed)
    poses, angle = [], 0.0
    x = y = heading = 0.0
    last = None
    covariance = numpy.diag([0.01, 0.01, 1e-4])
    for sequence in range(1, POSES + 1):
        poses.append(pose(sequence, x, y, math.remainder(heading, math.tau),
                          covariance[numpy.triu_indices(3)]))
        here = course(angle)
        angle += 1.0 / math.hypot(*((course(angle + 1e-4) - here) / 1e-4))
        step = course(angle) - here
        direction = math.atan2(step[1], step[0])
        turned = 0.0 if last is None else math.remainder(direction - last,
                                                         math.tau)
        last = direction
        length = math.hypot(*step) + rng.gauss(0.0, DRIFT[0])
        heading += turned + rng.gauss(0.0, DRIFT[1])
        dx, dy = length * math.cos(heading), length * math.sin(heading)
        x, y = x + dx, y + dy
        lever = numpy.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
        covariance = lever @ covariance @ lever.T + CLAIMED ** 2 * numpy.diag(
            [DRIFT[0] ** 2, DRIFT[0] ** 2, DRIFT[1] ** 2])
    return poses


DRIVE = drive()


def create(stub, name="car", **settings):
    return stub.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id=name, vehicle=api.Vehicle(
            settings=api.VehicleSettings(**settings)))).vehicle.name


def said(answer):
    """The answer, but for how long it took, the vehicle's name and last change."""
    kept = api.CandidateSet()
    kept.CopyFrom(answer)
    kept.ClearField("search_duration")
    for candidate in kept.candidates:
        # It has the vehicle's name.
        candidate.ClearField("recording_of_match")
    kept.ClearField("revision")
    return kept


def streamed(stub, vehicle, size):
    """What the checks of a stream answer, by their nodes."""
    with PoseStream(stub, vehicle, send_candidates=True) as stream:
        stream.receive_kind("opened")
        for batch in batches(DRIVE, size):
            stream.send(batch)
        stream.half_close()
        return {message.query.index: said(message)
                for kind, message in stream.receive_all()
                if kind == "candidates"}


def asked(stub, vehicle, checks, seed, **options):
    """What the same checks answer when they are asked for one by one, in an
    order of the seed's."""
    answers = {}
    for node in random.Random(seed).sample(sorted(checks), len(checks)):
        query = checks[node].query
        # Poses are closer to each other than nodes: the first that is not before
        # the node is before the next.
        answers[node] = said(stub.FindCandidates(api.FindCandidatesRequest(
            vehicle=vehicle, sequence=query.sequence + (query.fraction > 0.0),
            options=api.CandidateOptions(**options))).candidates)
    return answers


def first_accepted(checks):
    return next(one.candidates[0] for _, one in sorted(checks.items())
                if one.candidates
                and one.candidates[0].verdict == api.VERDICT_ACCEPTED)


@pytest.fixture(scope="module")
def driven(stub):
    """A vehicle that has streamed the drive, and what its checks answered."""
    vehicle = create(stub)
    return vehicle, streamed(stub, vehicle, 64)


def test_every_answer_states_the_scale_and_every_candidate_its_interval(driven):
    _, checks = driven
    assert len(checks) > 30
    for answer in checks.values():
        estimate = answer.scale_estimate
        assert 0.0 < estimate.low < estimate.scale < estimate.high
        for candidate in answer.candidates:
            interval = candidate.place_interval
            assert 0.0 <= interval.meters_before <= 40.0
            assert 0.0 <= interval.meters_after <= 40.0
    # The first lap shows nothing; later ones show that the claims are too small.
    first, last = checks[min(checks)], checks[max(checks)]
    assert not first.candidates
    assert first.scale_estimate.scale == pytest.approx(1.0, rel=0.2)
    assert last.scale_estimate.scale > 1.2
    assert last.candidates[0].verdict == api.VERDICT_ACCEPTED
    assert last.candidates[0].probability > 0.9


@pytest.mark.parametrize("size", [1000, 37])
def test_answers_do_not_depend_on_how_the_poses_came(size, stub, driven):
    _, checks = driven
    assert streamed(stub, create(stub, f"by-{size}"), size) == checks


def test_answers_are_the_same_on_the_stream_and_asked_for_later(stub, driven):
    vehicle, checks = driven
    assert asked(stub, vehicle, checks, 1) == checks
    assert asked(stub, vehicle, checks, 2) == checks


def test_answers_are_the_same_after_a_kill(tmp_path):
    store = tmp_path / "store"
    with Server(store) as server:
        stub = server.stub()
        vehicle = create(stub)
        checks = streamed(stub, vehicle, 64)
        server.kill()
    with Server(store) as server:
        stub = server.stub()
        assert asked(stub, vehicle, checks, 3) == checks
        best = first_accepted(checks)
        LOOP_CLOSURES.add(stub, vehicle, best.query.sequence,
                          best.matched.sequence)
        REJECTED_CANDIDATES.add(stub, vehicle, best.query.sequence + 400,
                                best.matched.sequence + 400)
        verified = asked(stub, vehicle, checks, 4)
        # What lies before the closure is as before, what follows has learned.
        before = {node for node in checks if node < best.query.index}
        assert before
        assert all(verified[node] == checks[node] for node in before)
        assert any(verified[node] != checks[node]
                   for node in checks.keys() - before)
        server.kill()
    with Server(store) as server:
        assert asked(server.stub(), vehicle, checks, 5) == verified


def test_settings_and_revised_poses_are_learned_anew(stub):
    def update(field, **settings):
        stub.UpdateVehicle(api.UpdateVehicleRequest(
            vehicle=api.Vehicle(name=vehicle,
                                settings=api.VehicleSettings(**settings)),
            update_mask={"paths": [f"settings.{field}"]}))

    vehicle = create(stub, "changed", road_spacing_meters=150.0)
    checks = streamed(stub, vehicle, 64)
    update("road_spacing_meters", road_spacing_meters=50.0)
    others = asked(stub, vehicle, checks, 6)
    assert others != checks
    # As if they had always been so.
    always = create(stub, "always", road_spacing_meters=50.0)
    assert others == streamed(stub, always, 64)
    # Revised poses that claim half as much: what is learned is twice as much.
    halved = []
    for one in DRIVE:
        half = api.Pose()
        half.CopyFrom(one)
        half.covariance.values[:] = [0.25 * value
                                     for value in one.covariance.values]
        halved.append(half)
    stub.RevisePoses(iter(
        api.RevisePosesRequest(vehicle=vehicle if first == 0 else "",
                               poses=halved[first:first + 500])
        for first in range(0, POSES, 500)))
    revised = asked(stub, vehicle, checks, 7)
    last = max(checks)
    assert revised[last].scale_estimate.scale \
        > 1.3 * others[last].scale_estimate.scale
    fresh = create(stub, "fresh", road_spacing_meters=50.0)
    for batch in batches(halved, 500):
        append(stub, fresh, batch)
    assert asked(stub, fresh, checks, 8) == revised


def test_a_search_without_a_belief_has_no_scale(stub, driven):
    vehicle, checks = driven
    last = max(checks)
    only = {last: checks[last]}

    def without(name=vehicle, **options):
        return asked(stub, name, only, 9, **options)[last]

    plain = without(use_belief=False)
    assert not plain.HasField("scale_estimate")
    assert {one.gate.inflation for one in plain.candidates} == {1.0}
    assert all(one.HasField("place_interval") for one in plain.candidates)
    # Neither has one by another model or alignment.
    independent = api.CORRELATION_MODEL_INDEPENDENT
    assert not without(correlation_model=independent).HasField("scale_estimate")
    composite = without(alignment=api.ALIGNMENT_COMPOSITE)
    assert composite.candidates
    assert not composite.HasField("scale_estimate")
    assert not any(one.HasField("place_interval")
                   for one in composite.candidates)
    # A vehicle may do without; a search of it may still begin with one.
    claims = create(stub, "claims", use_belief=False, apply_inflation=True)
    assert streamed(stub, claims, 64)[last].candidates[0].gate.inflation > 1.0
    assert without(claims, use_belief=True) == checks[last]


def test_inflation_is_applied_where_searches_begin_without_a_belief(stub):
    def applied(name, **settings):
        return get(stub, create(stub, name, apply_inflation=True,
                                **settings)).consistency.applied

    assert not applied("believing")
    assert applied("plain", use_belief=False)
    assert applied("fixes", correlation_model=api.CORRELATION_MODEL_INDEPENDENT)
