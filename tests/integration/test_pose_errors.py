"""Every pose, batch and order of a stream's messages that a server refuses, through the
wire: the exact code, reason and fields; nothing is stored or half applied."""

import dataclasses
import math

import grpc
import pytest
from google.protobuf import timestamp_pb2

from caller_poses import (
    FILTER, GEODETIC, GOOD_6, IDENTITY_9, INF, INVALID, NAN, SPATIAL, STORED, geodetic,
    good_pose, local, planar, pose_with, quaternion, ros)
from stubs import api
from wire import (
    PoseStream, append, as_bytes, failure_of, get, list_poses, pose, straight)


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
