"""Poses that come as columns are stored and found as those that come as messages, and
refused by the place of what is wrong."""

import grpc
import pytest
from google.protobuf import timestamp_pb2

from caller_poses import GEODETIC, NAN, geodetic
from stubs import api
from watching import without_times
from wire import (PoseStream, as_bytes, batches, boreas, columns_of, failure_of, get,
                  list_poses, straight)


def with_stamps(poses):
    for each in poses:
        each.stamp.CopyFrom(timestamp_pb2.Timestamp(
            seconds=each.sequence // 10, nanos=each.sequence % 10 * 100_000_000 + 7))
    return poses


def append_columns(stub, vehicle, columns):
    return stub.AppendPoses(
        api.AppendPosesRequest(vehicle=vehicle, columns=columns)).ack


def find(stub, vehicle):
    """The candidates, and all that is the same for each vehicle with these poses."""
    found = stub.FindCandidates(api.FindCandidatesRequest(vehicle=vehicle)).candidates
    return found.candidates, str(without_times(found)).replace(vehicle, "it")


def test_a_drive_of_columns_is_the_drive_of_messages(stub, new_vehicle):
    poses = with_stamps(boreas()[0])
    plain, columns = new_vehicle(), new_vehicle()
    with PoseStream(stub, plain) as stream:
        opened = stream.receive_kind("opened")
        assert opened.takes_pose_columns
        for batch in batches(poses):
            stream.send(batch)
        stream.half_close()
        stream.receive_all()
    with PoseStream(stub, columns) as stream:
        stream.receive_kind("opened")
        for batch in batches(poses):
            stream.put(api.StreamPosesRequest(
                batch=api.PoseBatch(columns=columns_of(batch))))
        stream.half_close()
        acks = [ack for kind, ack in stream.receive_all() if kind == "ack"]
    assert acks[-1].durable_sequence == len(poses)
    assert as_bytes(list_poses(stub, columns)) == as_bytes(list_poses(stub, plain))
    candidates, found = find(stub, columns)
    assert candidates
    assert found == find(stub, plain)[1]


def test_who_sends_poses_again_may_use_the_other_form(stub, new_vehicle):
    vehicle = new_vehicle()
    poses = with_stamps(straight(20))
    columns = columns_of(poses)
    assert append_columns(stub, vehicle, columns).durable_sequence == 20
    ack = stub.AppendPoses(
        api.AppendPosesRequest(vehicle=vehicle, poses=poses)).ack
    assert ack.durable_sequence == 20
    assert append_columns(stub, vehicle, columns) == ack
    columns.x_meters[4] += 0.5
    failure = failure_of(lambda: append_columns(stub, vehicle, columns))
    assert failure.reason == "SEQUENCE_CONTENT_MISMATCH"


def test_geodetic_positions_come_as_columns_too(stub, new_vehicle):
    vehicle = new_vehicle(**GEODETIC)
    poses = straight(3)
    for each in poses:
        each.geodetic.CopyFrom(geodetic(latitude=47.0 + each.sequence * 1e-5))
    append_columns(stub, vehicle, columns_of(poses))
    assert as_bytes(list_poses(stub, vehicle)) == as_bytes(poses)


@pytest.mark.parametrize("change, reason, field", [
    (lambda c: c.x_meters.append(1.0), "COLUMN_SIZE", "x_meters"),
    (lambda c: c.heading_radians.__setitem__(2, NAN), "NOT_FINITE",
     "heading_radians[2]"),
    (lambda c: c.covariances.__setitem__(13, NAN), "NOT_FINITE", "covariances[13]"),
    (lambda c: c.ClearField("covariance_form"), "INVALID_FIELD", "covariance_form"),
    (lambda c: setattr(c, "pose_count", 2**31 - 1), "BATCH_SIZE", "pose_count"),
])
def test_one_wrong_number_refuses_all_and_is_named(
        stub, new_vehicle, change, reason, field):
    vehicle = new_vehicle()
    columns = columns_of(straight(5))
    change(columns)
    failure = failure_of(lambda: append_columns(stub, vehicle, columns))
    assert (failure.code, failure.reason) == (
        grpc.StatusCode.INVALID_ARGUMENT, reason)
    assert [name for name, _ in failure.violations] == [f"columns.{field}"]
    with PoseStream(stub, vehicle) as stream:
        stream.receive_kind("opened")
        stream.put(api.StreamPosesRequest(batch=api.PoseBatch(columns=columns)))
        failure = failure_of(stream.receive_all)
    assert [name for name, _ in failure.violations] == [f"batch.columns.{field}"]
    assert get(stub, vehicle).durable_sequence == 0


def test_a_batch_has_one_of_the_two_forms(stub, new_vehicle):
    vehicle = new_vehicle()
    poses = straight(2)
    failure = failure_of(lambda: stub.AppendPoses(api.AppendPosesRequest(
        vehicle=vehicle, poses=poses, columns=columns_of(poses))))
    assert [name for name, _ in failure.violations] == ["columns"]
    failure = failure_of(lambda: append_columns(stub, vehicle, api.PoseColumns()))
    assert failure.reason == "BATCH_SIZE"


def test_the_server_tells_that_it_takes_columns(stub):
    assert stub.GetServerInfo(api.GetServerInfoRequest()).takes_pose_columns
