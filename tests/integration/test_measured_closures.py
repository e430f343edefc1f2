"""Loop closures with what a verifier measured: validation, agreement with the
graph, repetition, and how they last."""

import math

import grpc
import numpy
import pytest

from revisit_server import Server, run
from stubs import api
from wire import (LOOP_CLOSURES, REJECTED_CANDIDATES, append, failure_of, get,
                  list_poses, pose)

INVALID = grpc.StatusCode.INVALID_ARGUMENT
FORMS = {6: api.COVARIANCE_FORM_PLANAR_6, 10: api.COVARIANCE_FORM_SPATIAL_10,
         36: api.COVARIANCE_FORM_ROS_36}
# Standard deviations of 0.2 m and 0.02 rad.
SMALL = (0.04, 0.0, 0.0, 0.04, 0.0, 0.0004)


def measured(x=0.0, y=0.0, heading=0.0, covariance=SMALL, **fields):
    return api.LoopClosureMeasurement(
        x_meters=x, y_meters=y, heading_radians=heading,
        covariance=api.Covariance(form=FORMS[len(covariance)],
                                  values=covariance), **fields)


def close(stub, vehicle, query, matched, closure_id="", **content):
    return stub.AddLoopClosure(api.AddLoopClosureRequest(
        parent=vehicle, loop_closure_id=closure_id,
        loop_closure=api.LoopClosure(query_sequence=query,
                                     matched_sequence=matched, **content)))


def lever(dx, dy):
    """What dead reckoning over this step makes of an error before it."""
    return numpy.array([[1, 0, -dy], [0, 1, dx], [0, 0, 1.0]])


def turn(angle):
    c, s = math.cos(angle), math.sin(angle)
    return numpy.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def symmetric(values):
    matrix = numpy.zeros((3, 3))
    matrix[numpy.triu_indices(3)] = values
    return matrix + numpy.triu(matrix, 1).T


def dead_reckoning(count, rng, spacing=0.7):
    """Poses on a winding road, with covariances as dead reckoning has them."""
    x, y, heading = 3.0, -2.0, 0.4
    covariance = numpy.diag([0.01, 0.01, 1e-4])
    poses = []
    for sequence in range(1, count + 1):
        upper = covariance[numpy.triu_indices(3)]
        poses.append(pose(sequence, x, y, heading, list(upper)))
        heading += 0.05 * math.sin(sequence / 30)
        dx, dy = spacing * math.cos(heading), spacing * math.sin(heading)
        x, y = x + dx, y + dy
        noise = rng.normal(size=(3, 3)) * [[0.02], [0.02], [0.002]]
        covariance = (lever(dx, dy) @ covariance @ lever(dx, dy).T
                      + noise @ noise.T)
    return poses


@pytest.fixture
def driven(stub, new_vehicle):
    """A vehicle with 400 poses by dead reckoning; nodes lie between poses."""
    def make(**settings):
        vehicle = new_vehicle(**settings)
        append(stub, vehicle, dead_reckoning(400, numpy.random.default_rng(7)))
        return vehicle
    return make


def squared_distance(stub, vehicle, query, matched, relative, covariance,
                     inflation=1.0):
    """By the definition in the proto, from what the server lists."""
    poses = {pose.sequence: pose for pose in list_poses(stub, vehicle)}

    def state(sequence):
        p = poses[sequence]
        return numpy.array([p.local.x_meters, p.local.y_meters,
                            p.heading_radians])
    q, m = state(query), state(matched)
    s_q, s_m = (inflation ** 2 * symmetric(poses[n].covariance.values)
                for n in (query, matched))
    rotation = turn(m[2])
    step = rotation @ relative
    y = q - (m + step)
    y[2] = math.remainder(y[2], 2 * math.pi)
    swung = lever(*step[:2])
    # The error at the match, carried along the road to the query.
    cross = lever(*(q - m)[:2]) @ s_m @ swung.T
    c = (s_q + swung @ s_m @ swung.T - cross - cross.T
         + rotation @ symmetric(covariance) @ rotation.T)
    return y @ numpy.linalg.solve(c, y)


def chi_squared_above(value):
    """P(X > value) with 3 degrees of freedom."""
    root = math.sqrt(value / 2)
    return math.erfc(root) + 2 / math.sqrt(math.pi) * root * math.exp(
        -value / 2)


def test_measurement_is_answered_and_listed_as_it_was_sent(stub, driven):
    vehicle = driven()
    content = {"measurement": measured(1.5, -2.0, 0.1, z_meters=0.5),
               "note": "lidar ICP\n\t412 inliers, caf\u00e9", "score": -0.25}
    stored = close(stub, vehicle, 350, 20, "a", **content).loop_closure
    expected = api.LoopClosure(
        name=f"{vehicle}/loopClosures/a", query_sequence=350,
        matched_sequence=20, create_time=stored.create_time, **content)
    assert stored == expected
    assert LOOP_CLOSURES.page(stub, vehicle) == ([expected], "")
    # A score of 0 is one.
    assert close(stub, vehicle, 351, 20, score=0.0).loop_closure.HasField(
        "score")
    plain = close(stub, vehicle, 352, 20).loop_closure
    assert not plain.HasField("measurement") and not plain.HasField("score")


@pytest.mark.parametrize("query, matched", [(350, 20), (201, 200), (399, 1)])
def test_agreement_is_the_test_of_the_innovation(query, matched, stub, driven):
    vehicle = driven()
    rng = numpy.random.default_rng(query)
    poses = {pose.sequence: pose for pose in list_poses(stub, vehicle)}
    q, m = poses[query], poses[matched]
    apart = turn(-m.heading_radians) @ [
        q.local.x_meters - m.local.x_meters,
        q.local.y_meters - m.local.y_meters,
        q.heading_radians - m.heading_radians]
    for n, scale in enumerate((0.0, 0.5, 5.0)):
        relative = apart + scale * rng.normal(size=3) * [1, 1, 0.05]
        root = rng.normal(size=(3, 3)) * [[0.3], [0.3], [0.02]]
        covariance = list((root @ root.T)[numpy.triu_indices(3)])
        agreement = close(
            stub, vehicle, query, matched, f"c{n}",
            measurement=measured(*relative, covariance)).agreement
        expected = squared_distance(stub, vehicle, query, matched, relative,
                                    covariance)
        assert agreement.squared_mahalanobis_distance == pytest.approx(
            expected, rel=1e-6, abs=1e-9)
        assert agreement.degrees_of_freedom == 3
        assert agreement.p_value == pytest.approx(chi_squared_above(expected),
                                                  rel=1e-6, abs=1e-300)
        assert agreement.inflation == 1.0


def test_agreement_takes_the_inflation_that_searches_apply(stub, driven):
    vehicle = driven(apply_inflation=True, use_belief=False)
    before = get(stub, vehicle).consistency.inflation
    assert before > 1.0
    relative = (200.0, 10.0, 0.2)
    agreement = close(stub, vehicle, 350, 20,
                      measurement=measured(*relative)).agreement
    assert agreement.inflation == before
    assert agreement.squared_mahalanobis_distance == pytest.approx(
        squared_distance(stub, vehicle, 350, 20, relative, SMALL, before),
        rel=1e-6)


def test_there_is_no_agreement_without_a_measurement(stub, driven):
    vehicle = driven()
    answer = close(stub, vehicle, 350, 20, note="seen", score=1.0)
    assert not answer.HasField("agreement")


def test_there_is_no_agreement_where_it_is_ill_conditioned(stub, new_vehicle):
    # No dead reckoning becomes so much surer of itself, over a leap by which an error
    # may have been taken back.
    vehicle = new_vehicle()
    append(stub, vehicle, [
        pose(n, x=x, covariance=[v, 0, 0, v, 0, 1e-2 * v])
        for n, x, v in ((1, 0.0, 100.0), (2, 40.0, 1e-4), (3, 41.0, 1e-4))])
    answer = close(stub, vehicle, 3, 1, measurement=measured(41.0))
    assert not answer.HasField("agreement")
    assert answer.loop_closure.measurement.x_meters == 41.0


def test_measurement_counts_in_the_consistency(stub, driven):
    vehicle = driven()
    relative = (150.0, 20.0, 0.2)
    agreement = close(stub, vehicle, 350, 20,
                      measurement=measured(*relative)).agreement
    consistency = get(stub, vehicle).consistency
    assert consistency.confirmed_count == 1
    assert consistency.mean_normalized_innovation_squared == pytest.approx(
        agreement.squared_mahalanobis_distance)


def test_repetition_compares_all_that_was_sent(stub, driven):
    vehicle = driven()
    content = {"measurement": measured(1.0), "note": "n", "score": 2.0}
    first = close(stub, vehicle, 350, 20, "a", **content)
    again = close(stub, vehicle, 350, 20, "a", **content)
    assert again.loop_closure == first.loop_closure
    assert again.revision == first.revision
    assert again.HasField("agreement")
    for other in ({"measurement": measured(1.5)}, {"note": "m"},
                  {"score": 2.5},
                  {"measurement": measured(1.0, covariance=(
                      0.05, 0.0, 0.0, 0.04, 0.0, 0.0004))}):
        failure = failure_of(lambda other=other: close(
            stub, vehicle, 350, 20, "a", **{**content, **other}))
        assert failure.code == grpc.StatusCode.ALREADY_EXISTS
        assert failure.reason == "LOOP_CLOSURE_EXISTS"
        assert "another measurement, note or score" in failure.message
    failure = failure_of(lambda: close(stub, vehicle, 350, 20, "a"))
    assert failure.reason == "LOOP_CLOSURE_EXISTS"
    assert get(stub, vehicle).revision == first.revision


BAD_CONTENT = {
    "x is not finite": (
        {"measurement": measured(math.nan)}, "NOT_FINITE",
        ["measurement.x_meters"]),
    "y is too far": (
        {"measurement": measured(0.0, 10001.0)}, "INVALID_FIELD",
        ["measurement.y_meters"]),
    "z is not finite": (
        {"measurement": measured(z_meters=math.inf)}, "NOT_FINITE",
        ["measurement.z_meters"]),
    "heading is too large": (
        {"measurement": measured(heading=2e6)}, "INVALID_FIELD",
        ["measurement.heading_radians"]),
    "no covariance": (
        {"measurement": api.LoopClosureMeasurement(x_meters=1.0)},
        "INVALID_FIELD", ["measurement.covariance"]),
    "covariance of no form": (
        {"measurement": api.LoopClosureMeasurement(
            covariance=api.Covariance(values=SMALL))},
        "INVALID_FIELD", ["measurement.covariance.form"]),
    "covariance of another size": (
        {"measurement": api.LoopClosureMeasurement(covariance=api.Covariance(
            form=api.COVARIANCE_FORM_PLANAR_6, values=SMALL[:5]))},
        "COVARIANCE_SIZE", ["measurement.covariance.values"]),
    "covariance is not finite": (
        {"measurement": measured(covariance=(math.inf,) + SMALL[1:])},
        "NOT_FINITE", ["measurement.covariance.values[0]"]),
    "covariance is negative": (
        {"measurement": measured(covariance=(-0.04,) + SMALL[1:])},
        "COVARIANCE_NOT_POSITIVE_DEFINITE", ["measurement.covariance.values"]),
    "covariance of zeros": (
        {"measurement": measured(covariance=(0.0,) * 36)},
        "COVARIANCE_NOT_POSITIVE_DEFINITE", ["measurement.covariance.values"]),
    "covariance is not symmetric": (
        {"measurement": measured(covariance=(
            0.04, 0.01, *([0.0] * 5), 0.04, *([0.0] * 27), 0.0004))},
        "COVARIANCE_NOT_SYMMETRIC", ["measurement.covariance.values"]),
    "score is not finite": (
        {"score": math.nan}, "NOT_FINITE", ["score"]),
    "all at once": (
        {"measurement": measured(math.nan, 1e9), "note": "\0",
         "score": math.inf}, "NOT_FINITE",
        ["measurement.x_meters", "measurement.y_meters", "note", "score"]),
}


@pytest.mark.parametrize("name", BAD_CONTENT)
def test_bad_content_is_refused_and_changes_nothing(name, stub, driven):
    content, reason, fields = BAD_CONTENT[name]
    vehicle = driven()
    before = get(stub, vehicle)
    failure = failure_of(lambda: close(stub, vehicle, 350, 20, **content))
    assert (failure.code, failure.reason) == (INVALID, reason)
    assert failure.fields == [f"loop_closure.{field}" for field in fields]
    assert failure.message.isascii() and failure.message.isprintable()
    assert get(stub, vehicle) == before
    assert LOOP_CLOSURES.page(stub, vehicle) == ([], "")


def test_spatial_vehicle_takes_no_planar_covariance(stub, new_vehicle):
    vehicle = new_vehicle(
        state_space=api.STATE_SPACE_SPATIAL,
        correlation_model=api.CORRELATION_MODEL_INDEPENDENT)
    spatial = [0.04, 0, 0, 0, 0.04, 0, 0, 0.04, 0, 0.0004]
    poses = [pose(n, x=float(n)) for n in range(1, 60)]
    for p in poses:
        p.covariance.form = api.COVARIANCE_FORM_SPATIAL_10
        p.covariance.values[:] = [(1 + 0.1 * p.sequence) * v for v in spatial]
    append(stub, vehicle, poses)
    failure = failure_of(lambda: close(stub, vehicle, 50, 1,
                                       measurement=measured()))
    assert failure.fields == ["loop_closure.measurement.covariance.form"]
    answer = close(stub, vehicle, 50, 1, measurement=measured(
        49.0, covariance=spatial, z_meters=0.0))
    assert answer.agreement.degrees_of_freedom == 4
    assert answer.agreement.squared_mahalanobis_distance < 1e-9
    lifted = close(stub, vehicle, 51, 1, measurement=measured(
        50.0, covariance=spatial, z_meters=3.0))
    # Standard deviations of the two poses and the measurement, in z.
    assert lifted.agreement.squared_mahalanobis_distance == pytest.approx(
        3.0 ** 2 / (0.04 * ((1 + 5.1) + (1 + 0.1) + 1)))


def test_pose_pair_of_the_other_kind_is_a_conflict(stub, driven):
    vehicle = driven()
    closure = close(stub, vehicle, 350, 20, note="right").loop_closure
    rejected, _ = REJECTED_CANDIDATES.add(stub, vehicle, 350, 30)
    before = get(stub, vehicle)
    for call, name in (
            (lambda: REJECTED_CANDIDATES.add(stub, vehicle, 350, 20, "no"),
             closure.name),
            (lambda: close(stub, vehicle, 350, 30, "yes"), rejected.name)):
        failure = failure_of(call)
        assert failure.code == grpc.StatusCode.FAILED_PRECONDITION
        assert failure.reason == "POSE_PAIR_CONFLICT"
        assert failure.metadata["name"] == name
    assert get(stub, vehicle) == before
    # Undone, the other is taken; a pair beside it never conflicts.
    LOOP_CLOSURES.delete(stub, closure.name)
    REJECTED_CANDIDATES.add(stub, vehicle, 350, 20, "no")
    close(stub, vehicle, 350, 21)


def test_measurements_survive_kill_9_restart_and_backup(tmp_path):
    store = tmp_path / "store"
    backup = tmp_path / "backup"
    backup.mkdir()
    with Server(store) as server:
        stub = server.stub()
        vehicle = stub.CreateVehicle(api.CreateVehicleRequest(
            vehicle_id="a")).vehicle.name
        append(stub, vehicle, dead_reckoning(400, numpy.random.default_rng(7)))
        first = close(stub, vehicle, 350, 20, measurement=measured(
            150.0, 20.0, 0.2), note="first", score=1.0)
        close(stub, vehicle, 380, 30, measurement=measured(150.0, 20.0, 0.2))
        listed = LOOP_CLOSURES.page(stub, vehicle)
        consistency = get(stub, vehicle).consistency
        found = stub.FindCandidates(api.FindCandidatesRequest(
            vehicle=vehicle)).candidates.candidates
        server.kill()
    with Server(store) as server:
        stub = server.stub()
        assert LOOP_CLOSURES.page(stub, vehicle) == listed
        assert get(stub, vehicle).consistency == consistency
        assert stub.FindCandidates(api.FindCandidatesRequest(
            vehicle=vehicle)).candidates.candidates == found
        again = close(stub, vehicle, 350, 20, measurement=measured(
            150.0, 20.0, 0.2), note="first", score=1.0)
        assert again.loop_closure == first.loop_closure
        result = run("revisitd", "backup", "--store", store,
                     "--to", backup / "revisit.sqlite")
        assert result.returncode == 0, result.stderr
    with Server(backup) as server:
        stub = server.stub()
        assert LOOP_CLOSURES.page(stub, vehicle) == listed
        assert get(stub, vehicle).consistency == consistency


def test_revised_poses_are_what_a_measurement_is_held_against(stub, driven):
    vehicle = driven()
    relative = (150.0, 20.0, 0.2)
    close(stub, vehicle, 350, 20, measurement=measured(*relative))
    poses = list_poses(stub, vehicle)
    for p in poses[100:]:
        p.local.y_meters += 4.0
    stub.RevisePoses(iter([api.RevisePosesRequest(vehicle=vehicle,
                                                  poses=poses)]))
    consistency = get(stub, vehicle).consistency
    assert consistency.mean_normalized_innovation_squared == pytest.approx(
        squared_distance(stub, vehicle, 350, 20, relative, SMALL), rel=1e-6)
