"""Every error that a caller can make, through the wire: the exact code, reason
and fields; nothing is stored or half applied; the server lives on."""

import dataclasses
import math
import typing

import grpc
import pytest
from google.protobuf import field_mask_pb2, timestamp_pb2

from stubs import api
from wire import (LOOP_CLOSURES, PAIR_KINDS, REJECTED_CANDIDATES, PoseStream,
                  append, as_bytes, failure_of, get, list_poses, pose, straight)

INVALID = grpc.StatusCode.INVALID_ARGUMENT
NAN, INF = math.nan, math.inf

STORED = 3  # Poses of every vehicle before a bad call.


def spatial_pose(number, **fields):
    return pose_with(number, **{"covariance": api.Covariance(
        form=api.COVARIANCE_FORM_SPATIAL_10,
        values=[1, 0, 0, 0, 1, 0, 0, 1, 0, 0.01]), **fields})


def pose_with(number, **fields):
    """A good pose with some fields set otherwise; None clears one."""
    good = pose(number, x=float(number))
    for name, value in fields.items():
        good.ClearField(name)
        if value is None:
            continue
        if hasattr(value, "SerializeToString"):
            getattr(good, name).CopyFrom(value)
        elif isinstance(value, (list, tuple)):
            getattr(good, name).extend(value)
        else:
            setattr(good, name, value)
    return good


def local(x=0.0, y=0.0, z=0.0):
    return api.LocalPosition(x_meters=x, y_meters=y, z_meters=z)


def geodetic(latitude=43.8, longitude=-79.5, height=150.0):
    return api.GeodeticPosition(latitude_degrees=latitude,
                                longitude_degrees=longitude,
                                height_meters=height)


def planar(*values):
    return api.Covariance(form=api.COVARIANCE_FORM_PLANAR_6, values=values)


def quaternion(x, y, z, w):
    return {"quaternion": api.Quaternion(x=x, y=y, z=z, w=w)}


def ros(changes):
    """A good 6x6 with some entries set otherwise."""
    values = [0.0] * 36
    for i in range(6):
        values[7 * i] = 1.0
    for index, value in changes.items():
        values[index] = value
    return api.Covariance(form=api.COVARIANCE_FORM_ROS_36, values=values)


GOOD_6 = (0.01, 0.0, 0.0, 0.01, 0.0, 1e-4)
SPATIAL = {"state_space": api.STATE_SPACE_SPATIAL}
GEODETIC = {"coordinate_frame": api.COORDINATE_FRAME_GEODETIC}
FILTER = {"correlation_model": api.CORRELATION_MODEL_FILTER}
IDENTITY_9 = (1, 0, 0, 0, 1, 0, 0, 0, 1)


@dataclasses.dataclass
class BadPose:
    """The second pose of a batch of two, and what is said of it."""

    name: str
    changes: dict
    reason: str
    # Below poses[1].
    field: str
    settings: dict = dataclasses.field(default_factory=dict)

    def __str__(self):
        return self.name


BAD_POSES = [
    BadPose("x is NaN", {"local": local(x=NAN)}, "NOT_FINITE",
            "local.x_meters"),
    BadPose("y is infinite", {"local": local(y=INF)}, "NOT_FINITE",
            "local.y_meters"),
    BadPose("z of a planar vehicle is infinite", {"local": local(z=-INF)},
            "NOT_FINITE", "local.z_meters"),
    BadPose("x beyond range", {"local": local(x=1.001e8)}, "INVALID_FIELD",
            "local.x_meters"),
    BadPose("z beyond range", {"local": local(z=-1.001e8)}, "INVALID_FIELD",
            "local.z_meters"),
    BadPose("no position", {"local": None}, "INVALID_FIELD", "position"),
    BadPose("geodetic position of a local vehicle", {"geodetic": geodetic()},
            "INVALID_FIELD", "geodetic"),
    BadPose("local position of a geodetic vehicle", {"local": local()},
            "INVALID_FIELD", "local", GEODETIC),
    BadPose("latitude beyond the pole",
            {"geodetic": geodetic(latitude=90.0001)}, "INVALID_FIELD",
            "geodetic.latitude_degrees", GEODETIC),
    BadPose("latitude is NaN", {"geodetic": geodetic(latitude=NAN)},
            "NOT_FINITE", "geodetic.latitude_degrees", GEODETIC),
    BadPose("longitude beyond range",
            {"geodetic": geodetic(longitude=-180.0001)}, "INVALID_FIELD",
            "geodetic.longitude_degrees", GEODETIC),
    BadPose("height beyond range", {"geodetic": geodetic(height=100001.0)},
            "INVALID_FIELD", "geodetic.height_meters", GEODETIC),
    BadPose("height is infinite", {"geodetic": geodetic(height=INF)},
            "NOT_FINITE", "geodetic.height_meters", GEODETIC),

    BadPose("no orientation", {"heading_radians": None}, "INVALID_FIELD",
            "orientation"),
    BadPose("heading is NaN", {"heading_radians": NAN}, "NOT_FINITE",
            "heading_radians"),
    BadPose("heading beyond range", {"heading_radians": -1.001e6},
            "INVALID_FIELD", "heading_radians"),
    BadPose("quaternion is zero", quaternion(0, 0, 0, 0),
            "QUATERNION_INVALID", "quaternion"),
    BadPose("quaternion too long", quaternion(0, 0, 0, 1.0011),
            "QUATERNION_INVALID", "quaternion"),
    BadPose("quaternion too short", quaternion(0, 0, 0.9989, 0),
            "QUATERNION_INVALID", "quaternion"),
    BadPose("quaternion points straight up",
            quaternion(0, -math.sqrt(0.5), 0, math.sqrt(0.5)),
            "QUATERNION_INVALID", "quaternion"),
    BadPose("quaternion points straight down",
            quaternion(0, math.sqrt(0.5), 0, math.sqrt(0.5)),
            "QUATERNION_INVALID", "quaternion"),
    BadPose("quaternion holds a NaN", quaternion(0, 0, NAN, 1), "NOT_FINITE",
            "quaternion.z"),

    BadPose("no covariance", {"covariance": None}, "INVALID_FIELD",
            "covariance"),
    BadPose("covariance without a form",
            {"covariance": api.Covariance(values=GOOD_6)}, "INVALID_FIELD",
            "covariance.form"),
    BadPose("covariance of an unknown form",
            {"covariance": api.Covariance(form=99, values=GOOD_6)},
            "INVALID_FIELD", "covariance.form"),
    BadPose("planar covariance of a spatial vehicle",
            {"covariance": planar(*GOOD_6)}, "INVALID_FIELD",
            "covariance.form", SPATIAL),
    BadPose("covariance with too few numbers",
            {"covariance": planar(*GOOD_6[:5])}, "COVARIANCE_SIZE",
            "covariance.values"),
    BadPose("covariance without numbers", {"covariance": planar()},
            "COVARIANCE_SIZE", "covariance.values"),
    BadPose("covariance with 100000 numbers",
            {"covariance": planar(*[1.0] * 100000)}, "COVARIANCE_SIZE",
            "covariance.values"),
    BadPose("covariance holds a NaN",
            {"covariance": planar(0.01, 0, NAN, 0.01, 0, 1e-4)}, "NOT_FINITE",
            "covariance.values[2]"),
    BadPose("covariance holds an infinity",
            {"covariance": planar(INF, 0, 0, 0.01, 0, 1e-4)}, "NOT_FINITE",
            "covariance.values[0]"),
    BadPose("infinity in an unused entry of the 6x6",
            {"covariance": ros({22: INF})}, "NOT_FINITE",
            "covariance.values[22]"),
    BadPose("6x6 is not symmetric", {"covariance": ros({1: 0.1, 6: 0.2})},
            "COVARIANCE_NOT_SYMMETRIC", "covariance.values"),
    BadPose("6x6 is only just not symmetric",
            {"covariance": ros({5: 0.1, 30: 0.1 + 2e-9})},
            "COVARIANCE_NOT_SYMMETRIC", "covariance.values"),
    BadPose("covariance is zero", {"covariance": planar(0, 0, 0, 0, 0, 0)},
            "COVARIANCE_NOT_POSITIVE_DEFINITE", "covariance.values"),
    BadPose("variance is negative",
            {"covariance": planar(0.01, 0, 0, -0.01, 0, 1e-4)},
            "COVARIANCE_NOT_POSITIVE_DEFINITE", "covariance.values"),
    BadPose("correlation above 1",
            {"covariance": planar(0.01, 0.011, 0, 0.01, 0, 1e-4)},
            "COVARIANCE_NOT_POSITIVE_DEFINITE", "covariance.values"),
    BadPose("heading tied to position beyond measure",
            {"covariance": planar(0.01, 0, 1.01e-3, 0.01, 0, 1e-4)},
            "COVARIANCE_NOT_POSITIVE_DEFINITE", "covariance.values"),
    BadPose("6x6 that is singular in the state",
            {"covariance": ros({35: 0.0})},
            "COVARIANCE_NOT_POSITIVE_DEFINITE", "covariance.values"),
    BadPose("6x6 of a planar producer for a spatial vehicle",
            {"covariance": ros({14: 0.0})},
            "COVARIANCE_NOT_POSITIVE_DEFINITE", "covariance.values", SPATIAL),
    BadPose("standard deviation beyond range",
            {"covariance": planar(1.1e18, 0, 0, 0.01, 0, 1e-4)},
            "INVALID_FIELD", "covariance.values"),

    BadPose("stamp after 2261",
            {"stamp": timestamp_pb2.Timestamp(seconds=9214646400)},
            "INVALID_FIELD", "stamp.seconds"),
    BadPose("stamp before 1678",
            {"stamp": timestamp_pb2.Timestamp(seconds=-9214646400)},
            "INVALID_FIELD", "stamp.seconds"),
    BadPose("stamp with negative nanoseconds",
            {"stamp": timestamp_pb2.Timestamp(seconds=1, nanos=-1)},
            "INVALID_FIELD", "stamp.nanos"),
    BadPose("stamp with a second of nanoseconds",
            {"stamp": timestamp_pb2.Timestamp(seconds=1, nanos=10**9)},
            "INVALID_FIELD", "stamp.nanos"),

    BadPose("transition without a filter", {"error_transition": IDENTITY_9},
            "INVALID_FIELD", "error_transition"),
    BadPose("filter without a transition", {"error_transition": None},
            "INVALID_FIELD", "error_transition", FILTER),
    BadPose("transition of the wrong size",
            {"error_transition": [1.0] * 16}, "INVALID_FIELD",
            "error_transition", FILTER),
    BadPose("transition holds a NaN",
            {"error_transition": [1, 0, 0, NAN, 1, 0, 0, 0, 1]}, "NOT_FINITE",
            "error_transition[3]", FILTER),
    BadPose("transition beyond range",
            {"error_transition": [1, 0, 0, 0, 1.1e9, 0, 0, 0, 1]},
            "INVALID_FIELD", "error_transition", FILTER),

    BadPose("sequence 0", {"sequence": 0}, "INVALID_FIELD", "sequence"),
    BadPose("sequence beyond range", {"sequence": 2**63}, "INVALID_FIELD",
            "sequence"),
    BadPose("the largest sequence there is", {"sequence": 2**64 - 1},
            "INVALID_FIELD", "sequence"),
    BadPose("stamp in the year 9999",
            {"stamp": timestamp_pb2.Timestamp(seconds=253402300799)},
            "INVALID_FIELD", "stamp.seconds"),
    BadPose("x as large as a number can be",
            {"local": local(x=1.7976931348623157e308)}, "INVALID_FIELD",
            "local.x_meters"),
    BadPose("covariance as large as a number can be",
            {"covariance": planar(1.7976931348623157e308, 0, 0,
                                  1.7976931348623157e308, 0, 1e-4)},
            "INVALID_FIELD", "covariance.values"),
    BadPose("sequence that repeats", {"sequence": STORED + 1},
            "INVALID_FIELD", "sequence"),
    BadPose("sequence that leaves one out", {"sequence": STORED + 3},
            "INVALID_FIELD", "sequence"),
    BadPose("sequence that goes back", {"sequence": STORED}, "INVALID_FIELD",
            "sequence"),
]


def good_pose(number, settings, **changes):
    """A pose that a vehicle of these settings takes."""
    fields = {}
    if settings is GEODETIC:
        fields["geodetic"] = geodetic(latitude=43.8 + number * 1e-5)
    if settings is FILTER and number > 1:
        fields["error_transition"] = IDENTITY_9
    make = spatial_pose if settings is SPATIAL else pose_with
    return make(number, **{**fields, **changes})


@pytest.fixture
def filled(stub, new_vehicle):
    """Makes a vehicle with a few poses."""
    def make(settings):
        vehicle = new_vehicle(**settings)
        append(stub, vehicle, [good_pose(n, settings)
                               for n in range(1, STORED + 1)])
        return vehicle
    return make


@pytest.fixture
def unchanged(stub):
    """Checks at the end that vehicles are as they were."""
    before = {}

    def watch(vehicle):
        before[vehicle] = (get(stub, vehicle),
                           as_bytes(list_poses(stub, vehicle)))
        return vehicle

    yield watch
    for vehicle, (summary, poses) in before.items():
        assert get(stub, vehicle) == summary
        assert as_bytes(list_poses(stub, vehicle)) == poses


def bad_batch(case):
    return [good_pose(STORED + 1, case.settings),
            good_pose(STORED + 2, case.settings, **case.changes)]


@pytest.mark.parametrize("case", BAD_POSES, ids=str)
def test_append_refuses_a_pose_where(case, stub, filled, unchanged):
    vehicle = unchanged(filled(case.settings))
    failure = failure_of(lambda: append(stub, vehicle, bad_batch(case)))
    assert (failure.code, failure.reason) == (INVALID, case.reason)
    assert set(failure.fields) == {f"poses[1].{case.field}"}
    assert all(words for _, words in failure.violations)
    assert failure.fields[0] in failure.message


@pytest.mark.parametrize("case", BAD_POSES, ids=str)
def test_stream_refuses_a_pose_where(case, stub, filled, unchanged):
    vehicle = unchanged(filled(case.settings))
    with PoseStream(stub, vehicle) as stream:
        assert stream.receive_kind("opened").durable_sequence == STORED
        stream.send(bad_batch(case))
        failure = failure_of(stream.receive)
    assert (failure.code, failure.reason) == (INVALID, case.reason)
    assert set(failure.fields) == {f"batch.poses[1].{case.field}"}


@pytest.mark.parametrize("settings", [{}, SPATIAL, GEODETIC, FILTER])
def test_the_same_pose_without_the_fault_is_taken(settings, stub, filled):
    vehicle = filled(settings)
    ack = append(stub, vehicle, [good_pose(STORED + 1, settings),
                                 good_pose(STORED + 2, settings)])
    assert ack.durable_sequence == STORED + 2


@pytest.mark.parametrize("changes", [
    {"local": local(1e8, -1e8, 1e8)},
    {"local": local(-0.0, 5e-324, 0.0)},
    # The smallest variances there are.
    {"covariance": planar(5e-324, 0, 0, 5e-324, 0, 5e-324)},
    {"heading_radians": 1e6},
    quaternion(0, 0, 0, 0.9991),
    quaternion(0, 0, 0, -1.0009),
    {"covariance": planar(1e18, 0, 0, 1e18, 0, 1.0)},
    {"covariance": ros({1: 0.1, 6: 0.1 + 5e-10})},
    # Planar producers leave z and the other rotations at zero.
    {"covariance": ros({14: 0.0, 21: 0.0, 28: 0.0})},
    {"stamp": timestamp_pb2.Timestamp(seconds=-9000000000, nanos=999999999)},
], ids=repr)
def test_the_edge_of_what_is_allowed_is_taken_and_kept_to_the_bit(
        changes, stub, filled):
    vehicle = filled({})
    edge = pose_with(STORED + 1, **changes)
    assert append(stub, vehicle, [edge]).durable_sequence == STORED + 1
    stored = list_poses(stub, vehicle, first_sequence=STORED + 1)
    assert as_bytes(stored) == as_bytes([edge])


def test_all_wrong_fields_of_a_batch_are_named(stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: append(stub, vehicle, [
        pose_with(STORED + 1, local=local(x=2e8, y=3e8)),
        pose_with(STORED + 2, heading_radians=2e6, covariance=planar(1.0)),
    ]))
    assert failure.code == INVALID
    assert failure.fields == [
        "poses[0].local.x_meters", "poses[0].local.y_meters",
        "poses[1].heading_radians", "poses[1].covariance.values"]


def test_first_pose_of_a_filter_may_come_without_a_transition(stub, filled):
    assert get(stub, filled(FILTER)).durable_sequence == STORED


# ---- Batches and sequences


@pytest.fixture(scope="module")
def limits(stub):
    return stub.GetServerInfo(api.GetServerInfoRequest())


def test_append_refuses_an_empty_batch(stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: append(stub, vehicle, []))
    assert (failure.code, failure.reason) == (INVALID, "BATCH_SIZE")
    assert failure.fields == ["poses"]


def test_append_refuses_an_oversized_batch(stub, filled, unchanged, limits):
    vehicle = unchanged(filled({}))
    poses = straight(limits.max_batch_poses + 1, first=STORED + 1)
    failure = failure_of(lambda: append(stub, vehicle, poses))
    assert (failure.code, failure.reason) == (INVALID, "BATCH_SIZE")
    assert failure.fields == ["poses"]


def test_append_takes_the_largest_batch(stub, filled, limits):
    vehicle = filled({})
    poses = straight(limits.max_batch_poses, first=STORED + 1)
    ack = append(stub, vehicle, poses)
    assert ack.durable_sequence == STORED + limits.max_batch_poses


@pytest.mark.parametrize("count", ["none", "too many"])
def test_stream_refuses_a_batch_of_the_wrong_size(
        count, stub, filled, unchanged, limits):
    vehicle = unchanged(filled({}))
    poses = [] if count == "none" else straight(limits.max_batch_poses + 1,
                                                first=STORED + 1)
    with PoseStream(stub, vehicle) as stream:
        stream.receive_kind("opened")
        stream.send(poses)
        failure = failure_of(stream.receive)
    assert (failure.code, failure.reason) == (INVALID, "BATCH_SIZE")
    assert failure.fields == ["batch.poses"]


def test_message_beyond_the_limit_is_refused_by_the_transport(
        stub, filled, unchanged, limits):
    vehicle = unchanged(filled({}))
    huge = pose_with(STORED + 1, covariance=planar(
        *[1.0] * (limits.max_message_bytes // 8 + 1)))
    with pytest.raises(grpc.RpcError) as raised:
        append(stub, vehicle, [huge])
    assert raised.value.code() == grpc.StatusCode.RESOURCE_EXHAUSTED
    assert "larger than max" in raised.value.details()


def gap(failure):
    assert failure.code == grpc.StatusCode.FAILED_PRECONDITION
    assert failure.reason == "SEQUENCE_GAP"
    assert failure.metadata["expected_sequence"] == str(STORED + 1)


def mismatch(failure):
    assert failure.code == grpc.StatusCode.ALREADY_EXISTS
    assert failure.reason == "SEQUENCE_CONTENT_MISMATCH"
    assert failure.metadata["sequence"] == str(STORED)


@pytest.mark.parametrize("poses, check", [
    (straight(2, first=STORED + 2), gap),
    ([pose(2**63 - 1)], gap),
    ([pose(STORED, x=STORED + 1e-9)], mismatch),
    # A stamp is content too.
    ([pose(STORED, x=STORED, stamp=timestamp_pb2.Timestamp(nanos=1))],
     mismatch),
    # Good poses before and after it change nothing.
    ([*straight(STORED - 1), pose(STORED, x=-0.5),
      *straight(2, first=STORED + 1)], mismatch),
], ids=["gap", "gap of all but one", "other position", "other stamp",
        "in the midst of good ones"])
@pytest.mark.parametrize("how", ["append", "stream"])
def test_sequence_is_kept_whole(how, poses, check, stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    if how == "append":
        check(failure_of(lambda: append(stub, vehicle, poses)))
        return
    with PoseStream(stub, vehicle) as stream:
        stream.receive_kind("opened")
        stream.send(poses)
        check(failure_of(stream.receive))


def test_other_content_is_told_by_the_sign_of_zero(stub, new_vehicle):
    vehicle = new_vehicle()
    append(stub, vehicle, [pose(1, x=0.0)])
    failure = failure_of(lambda: append(stub, vehicle, [pose(1, x=-0.0)]))
    assert failure.reason == "SEQUENCE_CONTENT_MISMATCH"


# ---- The order of a stream's messages


def test_stream_must_begin_with_open(stub, filled, unchanged):
    unchanged(filled({}))
    with PoseStream(stub) as stream:
        stream.send(straight(1, first=STORED + 1))
        failure = failure_of(stream.receive)
    assert (failure.code, failure.reason) == (INVALID, "STREAM_PROTOCOL")


def test_stream_must_not_be_opened_twice(stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    with PoseStream(stub, vehicle) as stream:
        stream.receive_kind("opened")
        stream.put(api.StreamPosesRequest(
            open=api.StreamPosesOpen(vehicle=vehicle)))
        failure = failure_of(stream.receive)
    assert (failure.code, failure.reason) == (INVALID, "STREAM_PROTOCOL")


def test_stream_refuses_an_empty_message(stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    with PoseStream(stub, vehicle) as stream:
        stream.receive_kind("opened")
        stream.put(api.StreamPosesRequest())
        failure = failure_of(stream.receive)
    assert (failure.code, failure.reason) == (INVALID, "STREAM_PROTOCOL")


def test_stream_that_ends_before_it_is_opened_is_refused(stub):
    with PoseStream(stub) as stream:
        stream.half_close()
        failure = failure_of(stream.receive)
    assert (failure.code, failure.reason) == (INVALID, "STREAM_PROTOCOL")


def test_what_came_before_a_bad_batch_is_acknowledged(stub, filled):
    vehicle = filled({})
    with PoseStream(stub, vehicle) as stream:
        stream.receive_kind("opened")
        stream.send(straight(4, first=STORED + 1))
        stream.send([pose(STORED + 5, x=NAN)])
        assert (stream.receive_kind("ack").durable_sequence == STORED + 4)
        failure = failure_of(stream.receive)
    assert failure.reason == "NOT_FINITE"
    assert get(stub, vehicle).durable_sequence == STORED + 4


def test_stream_refuses_candidate_options_before_any_batch(
        stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    with PoseStream(stub, vehicle, send_candidates=True,
                    candidate_options=api.CandidateOptions(
                        gate_probability=1.5)) as stream:
        failure = failure_of(stream.receive_all)
    assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
    assert failure.fields == ["open.candidate_options.gate_probability"]


# ---- A client that remembers more than the store


def test_claim_beyond_the_store_stops_writes_until_it_is_accepted(
        stub, filled):
    vehicle = filled({})
    data_loss = grpc.StatusCode.DATA_LOSS
    with PoseStream(stub, vehicle, acked_sequence=STORED + 7,
                    vehicle_uid=get(stub, vehicle).uid) as stream:
        failure = failure_of(stream.receive)
    assert failure.code == data_loss
    assert failure.reason == "DURABLE_SEQUENCE_REGRESSED"
    assert failure.metadata["durable_sequence"] == str(STORED)
    assert failure.metadata["acked_sequence"] == str(STORED + 7)

    # Reads go on, writes of any kind do not.
    assert get(stub, vehicle).state == api.VEHICLE_STATE_DATA_LOSS
    assert len(list_poses(stub, vehicle)) == STORED
    stub.FindCandidates(api.FindCandidatesRequest(vehicle=vehicle))
    for write in (
            lambda: append(stub, vehicle, straight(1, first=STORED + 1)),
            lambda: append(stub, vehicle, straight(1)),
            lambda: stub.AddLoopClosure(api.AddLoopClosureRequest(
                parent=vehicle, loop_closure=api.LoopClosure(
                    query_sequence=3, matched_sequence=1))),
            lambda: stub.RevisePoses(iter([api.RevisePosesRequest(
                vehicle=vehicle, poses=straight(1))]))):
        failure = failure_of(write)
        assert failure.code == data_loss, failure
        assert failure.reason == "DURABLE_SEQUENCE_REGRESSED"

    failure = failure_of(lambda: stub.AcceptDataLoss(
        api.AcceptDataLossRequest(name=vehicle, durable_sequence=STORED + 1)))
    assert failure.code == grpc.StatusCode.FAILED_PRECONDITION
    assert failure.reason == "DURABLE_SEQUENCE_MISMATCH"
    assert get(stub, vehicle).state == api.VEHICLE_STATE_DATA_LOSS

    accepted = stub.AcceptDataLoss(api.AcceptDataLossRequest(
        name=vehicle, durable_sequence=STORED)).vehicle
    assert accepted.state == api.VEHICLE_STATE_ACTIVE
    ack = append(stub, vehicle, straight(1, first=STORED + 1))
    assert ack.durable_sequence == STORED + 1


# A client that had kept nothing but a number put the vehicle that was made in
# place of its own into DATA_LOSS, and went on behind poses of somebody else.
def test_claim_about_a_vehicle_that_was_replaced_changes_nothing(
        stub, filled):
    vehicle = filled({})
    old = get(stub, vehicle).uid
    stub.DeleteVehicle(api.DeleteVehicleRequest(name=vehicle))
    stub.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id=vehicle.removeprefix("vehicles/")))
    append(stub, vehicle, straight(STORED))
    new = get(stub, vehicle).uid
    assert new != old
    before = get(stub, vehicle)
    for acked in (0, STORED, STORED + 7):
        with PoseStream(stub, vehicle, acked_sequence=acked,
                        vehicle_uid=old) as stream:
            failure = failure_of(stream.receive)
        assert failure.code == grpc.StatusCode.FAILED_PRECONDITION
        assert failure.reason == "VEHICLE_REPLACED"
        assert failure.metadata["vehicle_uid"] == new
        assert failure.metadata["expected_vehicle_uid"] == old
    failure = failure_of(lambda: stub.AppendPoses(api.AppendPosesRequest(
        vehicle=vehicle, vehicle_uid=old,
        poses=straight(1, first=STORED + 1))))
    assert failure.reason == "VEHICLE_REPLACED"
    # Nobody can tell which vehicle this claim is about.
    with PoseStream(stub, vehicle, acked_sequence=2**63 - 1) as stream:
        failure = failure_of(stream.receive)
    assert failure.code == grpc.StatusCode.DATA_LOSS
    assert failure.reason == "DURABLE_SEQUENCE_REGRESSED"
    assert get(stub, vehicle) == before
    with PoseStream(stub, vehicle, acked_sequence=STORED,
                    vehicle_uid=new) as stream:
        assert stream.receive_kind("opened").vehicle_uid == new


def test_uid_that_no_vehicle_can_have_is_refused(stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    uid = get(stub, vehicle).uid
    for bad in (uid.upper(), uid[:-1], uid + "0", "x" * 36, "0" * 100000):
        with PoseStream(stub, vehicle, vehicle_uid=bad) as stream:
            failure = failure_of(stream.receive)
        assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
        assert failure.fields == ["open.vehicle_uid"]
        failure = failure_of(lambda bad=bad: stub.AppendPoses(
            api.AppendPosesRequest(vehicle=vehicle, vehicle_uid=bad,
                                   poses=straight(1))))
        assert failure.fields == ["vehicle_uid"]


def test_claim_of_what_no_sequence_can_be_is_refused(stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    with PoseStream(stub, vehicle, acked_sequence=2**63) as stream:
        failure = failure_of(stream.receive)
    assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
    assert failure.fields == ["open.acked_sequence"]
    assert "got 9223372036854775808; allowed is [0, " in failure.message
    assert get(stub, vehicle).state == api.VEHICLE_STATE_ACTIVE


def test_claim_of_exactly_what_is_stored_is_fine(stub, filled):
    with PoseStream(stub, filled({}), acked_sequence=STORED) as stream:
        assert stream.receive_kind("opened").durable_sequence == STORED


def test_data_loss_is_accepted_only_where_there_is_one(
        stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: stub.AcceptDataLoss(
        api.AcceptDataLossRequest(name=vehicle, durable_sequence=STORED)))
    assert failure.code == grpc.StatusCode.FAILED_PRECONDITION
    assert failure.reason == "NO_DATA_LOSS"


# ---- Names

BAD_IDS = ["", "A", "Vehicle-1", "-a", "a-", "-", "a_b", "a.b", "a b", "a/b",
           "../x", "..", "%2e%2e", "a\0b", "\0", "a\n", "ä", "а",
           "a" * 64, "a" * 10000]


@pytest.mark.parametrize("bad", BAD_IDS, ids=lambda bad: repr(bad)[:20])
def test_create_refuses_the_id(bad, stub):
    failure = failure_of(lambda: stub.CreateVehicle(
        api.CreateVehicleRequest(vehicle_id=bad)))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_RESOURCE_NAME")
    assert failure.fields == ["vehicle_id"]
    # What the caller sent comes back, if at all, without control characters.
    assert failure.message.isprintable()


@pytest.mark.parametrize("good", ["a", "0", "a" * 63, "a-b", "0-9", "a--b"])
def test_create_takes_the_id(good, stub):
    made = stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id=good)).vehicle
    assert made.name == f"vehicles/{good}"
    stub.DeleteVehicle(api.DeleteVehicleRequest(name=made.name))


BAD_NAMES = ["", "a", "vehicles", "vehicles/", "vehicles//", "/vehicles/a",
             "Vehicles/a", "vehicles/a/", "vehicles/a/b", "vehicles/A",
             "vehicles/../x", "vehicles/a\0", "vehicles/" + "a" * 64]

# Every call with the field that says which vehicle.
CALLS = {
    "GetVehicle": ("name", lambda stub, name: stub.GetVehicle(
        api.GetVehicleRequest(name=name))),
    "UpdateVehicle": ("vehicle.name", lambda stub, name: stub.UpdateVehicle(
        api.UpdateVehicleRequest(
            vehicle=api.Vehicle(name=name),
            update_mask=mask("settings.max_candidates")))),
    "DeleteVehicle": ("name", lambda stub, name: stub.DeleteVehicle(
        api.DeleteVehicleRequest(name=name))),
    "AppendPoses": ("vehicle", lambda stub, name: append(
        stub, name, straight(1))),
    "StreamPoses": ("open.vehicle", lambda stub, name: PoseStream(
        stub, name).receive()),
    "FindCandidates": ("vehicle", lambda stub, name: stub.FindCandidates(
        api.FindCandidatesRequest(vehicle=name))),
    "AddLoopClosure": ("parent", lambda stub, name: LOOP_CLOSURES.add(
        stub, name, 2, 1)),
    "ListLoopClosures": ("parent", lambda stub, name: LOOP_CLOSURES.page(
        stub, name)),
    "RejectCandidate": ("parent", lambda stub, name: REJECTED_CANDIDATES.add(
        stub, name, 2, 1)),
    "ListRejectedCandidates": (
        "parent", lambda stub, name: REJECTED_CANDIDATES.page(stub, name)),
    "RevisePoses": ("vehicle", lambda stub, name: stub.RevisePoses(iter([
        api.RevisePosesRequest(vehicle=name, poses=straight(1))]))),
    "ListPoses": ("parent", lambda stub, name: stub.ListPoses(
        api.ListPosesRequest(parent=name))),
    "ExportPoseGraph": ("vehicle", lambda stub, name: list(
        stub.ExportPoseGraph(api.ExportPoseGraphRequest(vehicle=name)))),
    "AcceptDataLoss": ("name", lambda stub, name: stub.AcceptDataLoss(
        api.AcceptDataLossRequest(name=name, durable_sequence=1))),
}


def mask(*paths):
    return field_mask_pb2.FieldMask(paths=paths)


@pytest.mark.parametrize("call", CALLS)
def test_call_refuses_names_that_are_none(call, stub):
    field, make = CALLS[call]
    for name in BAD_NAMES:
        failure = failure_of(lambda: make(stub, name))
        assert (failure.code, failure.reason) == (
            INVALID, "INVALID_RESOURCE_NAME"), name
        assert failure.fields == [field], name


@pytest.mark.parametrize("call", CALLS)
def test_call_says_that_there_is_no_such_vehicle(call, stub):
    failure = failure_of(lambda: CALLS[call][1](stub, "vehicles/nobody"))
    assert failure.code == grpc.StatusCode.NOT_FOUND
    assert failure.reason == "VEHICLE_NOT_FOUND"
    assert "nobody" in failure.message


@pytest.mark.parametrize("kind", PAIR_KINDS, ids=str)
def test_name_of_a_pair_must_be_one(kind, stub):
    own, other = kind.collection, next(
        k.collection for k in PAIR_KINDS if k is not kind)
    for name in ("", "vehicles/a", f"vehicles/a/{own}", f"vehicles/a/{own}/",
                 f"vehicles/a/{own}/B", f"vehicles/../{own}/b",
                 f"vehicles/a/{own.lower()}/b", f"vehicles/a/{own}/b/c",
                 f"vehicles/a/{other}/b"):
        failure = failure_of(lambda: kind.delete(stub, name))
        assert (failure.code, failure.reason) == (
            INVALID, "INVALID_RESOURCE_NAME"), name
        assert failure.fields == ["name"], name


# ---- Settings


@dataclasses.dataclass
class BadSetting:
    field: str
    settings: dict
    reason: str = "INVALID_FIELD"

    def __str__(self):
        shown = str(list(self.settings.values())[-1]).split()
        return " ".join([self.field, *shown])


def tolerance(position=2.0, heading=0.1):
    return {"place_tolerance": api.PlaceTolerance(position_meters=position,
                                                  heading_radians=heading)}


def shape(position=1.0, heading=0.06):
    return {"shape_tolerance": api.PlaceTolerance(position_meters=position,
                                                  heading_radians=heading)}


BAD_SETTINGS = [
    BadSetting("state_space", {"state_space": 17}),
    BadSetting("correlation_model", {"correlation_model": 17}),
    BadSetting("likelihood_form", {"likelihood_form": 17}),
    BadSetting("coordinate_frame", {"coordinate_frame": 17}),
    BadSetting("geodetic_origin", {"geodetic_origin": geodetic()}),
    BadSetting("geodetic_origin.latitude_degrees",
               {**GEODETIC, "geodetic_origin": geodetic(latitude=-91.0)}),
    BadSetting("geodetic_origin.longitude_degrees",
               {**GEODETIC, "geodetic_origin": geodetic(longitude=NAN)},
               "NOT_FINITE"),
    BadSetting("geodetic_origin.height_meters",
               {**GEODETIC, "geodetic_origin": geodetic(height=-10001.0)}),
    BadSetting("node_spacing_meters", {"node_spacing_meters": 0.0}),
    BadSetting("node_spacing_meters", {"node_spacing_meters": NAN},
               "NOT_FINITE"),
    BadSetting("node_spacing_meters", {"sequence_length_meters": 1001.0,
                                       "check_interval_meters": 1001.0,
                                       "node_spacing_meters": 1001.0}),
    BadSetting("sequence_length_meters", {"sequence_length_meters": 2001.0}),
    BadSetting("sequence_length_meters", {"sequence_length_meters": -150.0}),
    BadSetting("sequence_length_meters", {"sequence_length_meters": INF},
               "NOT_FINITE"),
    BadSetting("check_interval_meters", {"check_interval_meters": 1.0}),
    BadSetting("check_interval_meters", {"check_interval_meters": 100001.0}),
    BadSetting("max_step_meters", {"max_step_meters": 0.001}),
    BadSetting("max_step_meters", {"max_step_meters": 1.1e6}),
    BadSetting("max_step_meters", {"max_step_meters": 2001.0}),
    BadSetting("gate_probability", {"gate_probability": 0.0}),
    BadSetting("gate_probability", {"gate_probability": 1.0}),
    BadSetting("gate_probability", {"gate_probability": NAN}, "NOT_FINITE"),
    BadSetting("place_tolerance.position_meters", tolerance(position=-1.0)),
    BadSetting("place_tolerance.position_meters", tolerance(position=1001.0)),
    BadSetting("place_tolerance.heading_radians", tolerance(heading=3.1)),
    BadSetting("place_tolerance.heading_radians", tolerance(heading=NAN),
               "NOT_FINITE"),
    BadSetting("candidate_separation_meters",
               {"candidate_separation_meters": -1.0}),
    BadSetting("max_candidates", {"max_candidates": 0}),
    BadSetting("max_candidates", {"max_candidates": 101}),
    BadSetting("alignment", {"alignment": 3}),
    BadSetting("alignment", {"alignment": -1}),
    BadSetting("acceptance_probability", {"acceptance_probability": 0.0}),
    BadSetting("acceptance_probability", {"acceptance_probability": 1.0}),
    BadSetting("acceptance_probability", {"acceptance_probability": NAN},
               "NOT_FINITE"),
    BadSetting("road_spacing_meters", {"road_spacing_meters": 0.9}),
    BadSetting("road_spacing_meters", {"road_spacing_meters": 1.1e6}),
    BadSetting("road_spacing_meters", {"road_spacing_meters": INF},
               "NOT_FINITE"),
    BadSetting("shape_tolerance.position_meters", shape(position=0.009)),
    BadSetting("shape_tolerance.position_meters", shape(position=1001.0)),
    BadSetting("shape_tolerance.position_meters", shape(position=NAN),
               "NOT_FINITE"),
    BadSetting("shape_tolerance.heading_radians", shape(heading=0.0)),
    BadSetting("shape_tolerance.heading_radians", shape(heading=3.1)),
    BadSetting("shape_correlation_meters", {"shape_correlation_meters": 0.0}),
    BadSetting("shape_correlation_meters", {"shape_correlation_meters": 1.1e6}),
    BadSetting("shape_correlation_meters", {"shape_correlation_meters": NAN},
               "NOT_FINITE"),
    BadSetting("fix_correlation_meters", {"fix_correlation_meters": 0.5}),
    BadSetting("fix_correlation_meters", {"fix_correlation_meters": 1.1e6}),
    BadSetting("fix_correlation_meters", {"fix_correlation_meters": NAN},
               "NOT_FINITE"),
    BadSetting("max_inflation", {"max_inflation": 0.5}),
    BadSetting("max_inflation", {"max_inflation": 101.0}),
    BadSetting("max_inflation", {"max_inflation": INF}, "NOT_FINITE"),
]


@pytest.mark.parametrize("case", BAD_SETTINGS, ids=str)
def test_create_refuses_the_setting(case, stub):
    failure = failure_of(lambda: stub.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id="never",
        vehicle=api.Vehicle(settings=api.VehicleSettings(**case.settings)))))
    assert (failure.code, failure.reason) == (INVALID, case.reason)
    assert failure.fields == [f"vehicle.settings.{case.field}"]
    absent = failure_of(lambda: get(stub, "vehicles/never"))
    assert absent.code == grpc.StatusCode.NOT_FOUND


def test_default_that_does_not_go_with_what_is_given_is_called_one(stub):
    failure = failure_of(lambda: stub.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id="never", vehicle=api.Vehicle(
            settings=api.VehicleSettings(node_spacing_meters=0.05)))))
    assert failure.fields == ["vehicle.settings.sequence_length_meters"]
    assert ("got 150; allowed is [0.05, 50] (left out: its default)"
            in failure.message)


SEARCH_FIELDS = {"likelihood_form", "sequence_length_meters",
                 "gate_probability", "place_tolerance.position_meters",
                 "place_tolerance.heading_radians",
                 "candidate_separation_meters", "max_candidates", "alignment",
                 "acceptance_probability", "road_spacing_meters",
                 "shape_tolerance.position_meters",
                 "shape_tolerance.heading_radians", "shape_correlation_meters"}


@pytest.mark.parametrize(
    "case", [case for case in BAD_SETTINGS if case.field in SEARCH_FIELDS],
    ids=str)
def test_find_refuses_the_option(case, stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: stub.FindCandidates(api.FindCandidatesRequest(
        vehicle=vehicle, options=api.CandidateOptions(**case.settings))))
    assert (failure.code, failure.reason) == (INVALID, case.reason)
    assert failure.fields == [f"options.{case.field}"]


@pytest.mark.parametrize("direction", [4, -1])
def test_find_refuses_a_direction_that_is_none(
        direction, stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: stub.FindCandidates(api.FindCandidatesRequest(
        vehicle=vehicle, options=api.CandidateOptions(direction=direction))))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
    assert failure.fields == ["options.direction"]


@pytest.mark.parametrize("model", [api.CORRELATION_MODEL_FILTER, 17])
def test_find_refuses_a_model_the_vehicle_does_not_have(
        model, stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: stub.FindCandidates(api.FindCandidatesRequest(
        vehicle=vehicle,
        options=api.CandidateOptions(correlation_model=model))))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
    assert failure.fields == ["options.correlation_model"]


def update(stub, vehicle, paths, **settings):
    return stub.UpdateVehicle(api.UpdateVehicleRequest(
        vehicle=api.Vehicle(name=vehicle,
                            settings=api.VehicleSettings(**settings)),
        update_mask=mask(*paths))).vehicle


@pytest.mark.parametrize("paths", [
    [], ["name"], ["state"], ["settings.no_such"], ["max_candidates"],
    ["settings.max_candidates.x"], ["*"], [""], ["revision"],
], ids=repr)
def test_update_refuses_the_mask(paths, stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: update(stub, vehicle, paths,
                                        max_candidates=7))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
    assert failure.fields == [
        f"update_mask.paths[{len(paths) - 1}]" if paths else "update_mask"]


@pytest.mark.parametrize("field, value", [
    ("max_candidates", 0), ("node_spacing_meters", -2.0),
    # Out of range only together with the sequence length that stays.
    ("node_spacing_meters", 0.1),
    ("alignment", 9), ("acceptance_probability", 1.0),
    ("road_spacing_meters", 0.0), ("shape_correlation_meters", -1.0),
    ("max_inflation", 0.0), ("fix_correlation_meters", 0.0),
])
def test_update_refuses_the_setting(field, value, stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: update(stub, vehicle, [f"settings.{field}"],
                                        **{field: value}))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
    assert len(failure.fields) == 1
    assert failure.fields[0].startswith("vehicle.settings.")


@pytest.mark.parametrize("field, value", [
    ("state_space", api.STATE_SPACE_SPATIAL),
    ("coordinate_frame", api.COORDINATE_FRAME_GEODETIC),
    ("correlation_model", api.CORRELATION_MODEL_FILTER),
])
def test_update_refuses_what_is_fixed_once_there_are_poses(
        field, value, stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: update(stub, vehicle, [f"settings.{field}"],
                                        **{field: value}))
    assert failure.code == grpc.StatusCode.FAILED_PRECONDITION
    assert failure.reason == "SETTING_FIXED"
    assert field in failure.message


def test_create_refuses_a_name_that_is_taken_with_other_settings(
        stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: stub.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id=vehicle.split("/")[1],
        vehicle=api.Vehicle(settings=api.VehicleSettings(max_candidates=9)))))
    assert failure.code == grpc.StatusCode.ALREADY_EXISTS
    assert failure.reason == "VEHICLE_EXISTS"


# ---- Pages and masks


PAGED = {
    "ListVehicles": lambda stub, vehicle, **fields: stub.ListVehicles(
        api.ListVehiclesRequest(**fields)),
    "ListPoses": lambda stub, vehicle, **fields: stub.ListPoses(
        api.ListPosesRequest(parent=vehicle, **fields)),
    "ListLoopClosures": LOOP_CLOSURES.page,
    "ListRejectedCandidates": REJECTED_CANDIDATES.page,
}


@pytest.mark.parametrize("call", PAGED)
@pytest.mark.parametrize("token", ["x", "0", "AAAA", "-1", "é", "a" * 5000],
                         ids=lambda token: token[:10])
def test_page_token_must_be_one_of_ours(token, call, stub, filled):
    failure = failure_of(lambda: PAGED[call](stub, filled({}),
                                             page_token=token))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_PAGE_TOKEN")
    assert failure.fields == ["page_token"]


def test_page_token_is_good_for_its_own_vehicle_only(stub, filled):
    one, other = filled({}), filled({})
    page = stub.ListPoses(api.ListPosesRequest(parent=one, page_size=1))
    assert page.next_page_token
    failure = failure_of(lambda: stub.ListPoses(api.ListPosesRequest(
        parent=other, page_token=page.next_page_token)))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_PAGE_TOKEN")


@pytest.mark.parametrize("call", PAGED)
def test_page_size_must_not_be_negative(call, stub, filled):
    failure = failure_of(lambda: PAGED[call](stub, filled({}), page_size=-1))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
    assert failure.fields == ["page_size"]


@pytest.mark.parametrize("path", ["no_such", "local.no_such", "*",
                                  "covariance.values.x"])
def test_read_mask_must_name_fields_of_a_pose(path, stub, filled):
    failure = failure_of(lambda: list_poses(stub, filled({}),
                                            read_mask=mask("sequence", path)))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
    assert failure.fields == ["read_mask.paths[1]"]


# ---- Candidates, loop closures, revisions


def test_find_says_that_there_is_no_such_pose(stub, filled):
    failure = failure_of(lambda: stub.FindCandidates(
        api.FindCandidatesRequest(vehicle=filled({}), sequence=STORED + 1)))
    assert failure.code == grpc.StatusCode.NOT_FOUND
    assert failure.reason == "POSE_NOT_FOUND"


@pytest.mark.parametrize("kind", PAIR_KINDS, ids=str)
@pytest.mark.parametrize("query, matched, field", [
    (0, 1, "query_sequence"), (2, 0, "matched_sequence"),
    (2, 2, "matched_sequence"), (1, 2, "matched_sequence"),
])
def test_pair_must_be_of_a_pose_and_an_earlier_one(
        query, matched, field, kind, stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: kind.add(stub, vehicle, query, matched))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
    assert failure.fields == [f"{kind.field}.{field}"]


@pytest.mark.parametrize("kind", PAIR_KINDS, ids=str)
def test_pair_is_required(kind, stub, filled, unchanged):
    request = kind.request(unchanged(filled({})))
    request.ClearField(kind.field)
    failure = failure_of(lambda: kind.call_add(stub, request))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
    assert failure.fields == [kind.field]


@pytest.mark.parametrize("kind", PAIR_KINDS, ids=str)
def test_pair_must_be_of_stored_poses(kind, stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: kind.add(stub, vehicle, STORED + 1, 1))
    assert failure.code == grpc.StatusCode.NOT_FOUND
    assert failure.reason == "POSE_NOT_FOUND"
    assert failure.metadata["sequence"] == str(STORED + 1)


@pytest.mark.parametrize("kind", PAIR_KINDS, ids=str)
@pytest.mark.parametrize("bad", ["A", "../x", "a" * 64, "a\0"], ids=repr)
def test_id_of_a_pair_must_be_one(bad, kind, stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: kind.add(stub, vehicle, 2, 1, bad))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_RESOURCE_NAME")
    assert failure.fields == [f"{kind.field}_id"]


@pytest.mark.parametrize("kind", PAIR_KINDS, ids=str)
def test_there_is_no_such_pair_to_delete(kind, stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: kind.delete(
        stub, f"{vehicle}/{kind.collection}/none"))
    assert failure.code == grpc.StatusCode.NOT_FOUND
    assert failure.reason == f"{kind.reason}_NOT_FOUND"


@dataclasses.dataclass
class BadRevision:
    name: str
    # It takes the vehicle's name.
    requests: typing.Callable
    reason: str
    fields: list
    code: grpc.StatusCode = INVALID

    def __str__(self):
        return self.name


def revise(vehicle="", *poses, **fields):
    return api.RevisePosesRequest(vehicle=vehicle, poses=poses, **fields)


BAD_REVISIONS = [
    BadRevision("no message", lambda v: [], "INVALID_RESOURCE_NAME",
                ["vehicle"]),
    BadRevision("another vehicle in a later message",
                lambda v: [revise(v, pose(1)),
                           revise("vehicles/other", pose(2))],
                "INVALID_FIELD", ["vehicle"]),
    BadRevision("a revision in a later message",
                lambda v: [revise(v, pose(1)),
                           revise("", pose(2), expected_revision=1)],
                "INVALID_FIELD", ["expected_revision"]),
    BadRevision("a pose twice", lambda v: [revise(v, pose(1)),
                                           revise("", pose(2), pose(1))],
                "INVALID_FIELD", ["poses[2].sequence"]),
    BadRevision("sequence 0", lambda v: [revise(v, pose(1), pose(0))],
                "INVALID_FIELD", ["poses[1].sequence"]),
    BadRevision("a pose that is not stored",
                lambda v: [revise(v, pose(1), pose(STORED + 1))],
                "POSE_NOT_FOUND", [], grpc.StatusCode.NOT_FOUND),
    BadRevision("a bad number in the last message",
                lambda v: [revise(v, pose(1)), revise(v, pose(2)),
                           revise("", pose(3, x=NAN))],
                "NOT_FINITE", ["poses[2].local.x_meters"]),
    BadRevision("a covariance that is not positive definite",
                lambda v: [revise(v, pose(1, covariance=(0,) * 6))],
                "COVARIANCE_NOT_POSITIVE_DEFINITE",
                ["poses[0].covariance.values"]),
    BadRevision("another revision",
                lambda v: [revise(v, pose(1), expected_revision=10**6)],
                "REVISION_MISMATCH", [], grpc.StatusCode.ABORTED),
]


@pytest.mark.parametrize("case", BAD_REVISIONS, ids=str)
def test_revise_refuses(case, stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(
        lambda: stub.RevisePoses(iter(case.requests(vehicle))))
    assert (failure.code, failure.reason) == (case.code, case.reason)
    assert failure.fields == case.fields


# ---- What every error has


def test_request_id_of_the_caller_comes_back_in_the_error(stub):
    failure = failure_of(lambda: stub.GetVehicle(
        api.GetVehicleRequest(name="vehicles/nobody"),
        metadata=[("x-request-id", "ticket 4711")]))
    assert failure.metadata["request_id"] == "ticket 4711"


@pytest.mark.parametrize("metadata", [[], [("x-request-id", "")],
                                      [("x-request-id", "a" * 129)]],
                         ids=["none", "empty", "too long"])
def test_request_id_is_made_if_the_caller_has_no_good_one(metadata, stub):
    first, second = (
        failure_of(lambda: stub.GetVehicle(
            api.GetVehicleRequest(name="vehicles/nobody"), metadata=metadata)
        ).metadata["request_id"] for _ in range(2))
    assert first != second
    assert "a" * 129 not in (first, second)


def test_request_id_comes_back_with_an_answer(stub):
    _, call = stub.GetServerInfo.with_call(
        api.GetServerInfoRequest(), metadata=[("x-request-id", "r-1")])
    assert ("x-request-id", "r-1") in list(call.initial_metadata())


NO_PROTOBUF = b"\x0a\xff\xff\xff\xff\x0f not a message"


METHODS = api.GetServerInfoRequest.DESCRIPTOR.file.services_by_name[
    "PoseGraphService"].methods


@pytest.mark.parametrize(
    "method", [method for method in METHODS if not method.client_streaming],
    ids=lambda method: method.name)
def test_malformed_protobuf_is_the_callers_fault(
        method, server, filled, unchanged):
    unchanged(filled({}))
    channel = server.channel()
    path = f"/revisit.v1.PoseGraphService/{method.name}"
    if method.server_streaming:
        stream = channel.unary_stream(path)
        failure = failure_of(lambda: list(stream(NO_PROTOBUF, timeout=20)))
    else:
        call = channel.unary_unary(path)
        failure = failure_of(lambda: call(NO_PROTOBUF, timeout=20))
    assert (failure.code, failure.reason) == (INVALID, "MALFORMED_MESSAGE")
    assert method.input_type.full_name in failure.message


@pytest.mark.parametrize("method", ["StreamPoses", "RevisePoses"])
@pytest.mark.parametrize("well", [0, 1], ids=["first", "second"])
def test_malformed_protobuf_on_a_stream_is_the_callers_fault(
        well, method, server, filled, unchanged):
    vehicle = unchanged(filled({}))
    good = {
        "StreamPoses": api.StreamPosesRequest(
            open=api.StreamPosesOpen(vehicle=vehicle)),
        "RevisePoses": api.RevisePosesRequest(
            vehicle=vehicle, poses=[pose(1, x=5.0)])}[method]
    call = server.channel().stream_stream(
        f"/revisit.v1.PoseGraphService/{method}",
        request_serializer=bytes, response_deserializer=bytes)
    messages = [good.SerializeToString()] * well + [NO_PROTOBUF]
    failure = failure_of(lambda: list(call(
        iter(messages), metadata=[("x-request-id", f"bad-{method}-{well}")])))
    assert (failure.code, failure.reason) == (INVALID, "STREAM_PROTOCOL")
    assert "not a valid protobuf" in failure.message
    assert server.is_running()
    # No operator is called to look at it.
    own = server.logged(f"bad-{method}-{well}")
    assert len(own) == 1
    assert "INVALID_ARGUMENT" in own[0]
    assert "error" not in own[0].lower().split("message")[0]


def test_unknown_method_is_told(server):
    call = server.channel().unary_unary(
        "/revisit.v1.PoseGraphService/NoSuchMethod",
        request_serializer=bytes, response_deserializer=bytes)
    with pytest.raises(grpc.RpcError) as raised:
        call(b"")
    assert raised.value.code() == grpc.StatusCode.UNIMPLEMENTED
