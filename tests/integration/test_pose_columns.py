"""Poses that come as columns are stored and found as those that come as messages, and
refused by the place of what is wrong."""

import sqlite3

import grpc
import pytest
from google.protobuf import field_mask_pb2, timestamp_pb2

from caller_poses import GEODETIC, NAN, geodetic
from drive_client import Drive
from revisit_server import Server, run
from stubs import api
from watching import without_times
from wire import (PoseStream, append, as_bytes, batches, boreas, columns_of, expanded,
                  failure_of, get, list_poses, straight)


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


def test_small_batches_of_both_forms_share_rows_and_are_read_again(tmp_path):
    store = tmp_path / "store"
    poses = with_stamps(boreas()[0][:900])
    with Server(store, "--snapshot-poses", "0") as server:
        stub = server.stub()
        vehicle = stub.CreateVehicle(api.CreateVehicleRequest(
            vehicle_id="car")).vehicle.name
        with PoseStream(stub, vehicle) as stream:
            stream.receive_kind("opened")
            for number, batch in enumerate(batches(poses, size=7)):
                stream.put(api.StreamPosesRequest(batch=api.PoseBatch(
                    **({"poses": batch} if number % 3 == 0
                       else {"columns": columns_of(batch)}))))
            stream.half_close()
            stream.receive_all()
        # Sent again, cut in other places and in the other form.
        for batch in batches(poses, size=100):
            append_columns(stub, vehicle, columns_of(batch))
        stored = as_bytes(list_poses(stub, vehicle))
        assert stored == as_bytes(poses)
        candidates, found = find(stub, vehicle)
        moved = [api.Pose.FromString(each.SerializeToString()) for each in poses[40:60]]
        for each in moved:
            each.local.x_meters += 0.125
            each.ClearField("stamp")
    rows = sqlite3.connect(next(store.glob("*.sqlite"))).execute(
        "SELECT max(count) FROM batches").fetchone()
    assert rows[0] > 7
    with Server(store, "--snapshot-poses", "0") as server:
        stub = server.stub()
        assert as_bytes(list_poses(stub, vehicle)) == stored
        assert find(stub, vehicle)[1] == found
        stub.RevisePoses(iter([api.RevisePosesRequest(vehicle=vehicle, poses=moved)]))
        revised = list_poses(stub, vehicle)
        assert [each.local.x_meters for each in revised[40:60]] == [
            each.local.x_meters for each in moved]
        assert [each.stamp for each in revised] == [each.stamp for each in poses]
        assert as_bytes(revised[:40] + revised[60:]) == stored[:40] + stored[60:]
        assert as_bytes(list_poses(
            stub, vehicle, view=api.POSE_VIEW_AS_SENT)) == stored
    assert run("revisitd", "verify", "--store", store).returncode == 0


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


# Lists.


def both_forms(stub, vehicle, **fields):
    """The pages of a list in both forms, as pairs."""
    request = api.ListPosesRequest(parent=vehicle, **fields)
    while True:
        request.as_columns = False
        messages = stub.ListPoses(request)
        request.as_columns = True
        columns = stub.ListPoses(request)
        assert not messages.columns and not columns.poses
        assert columns.next_page_token == messages.next_page_token
        yield messages.poses, columns.columns
        if not messages.next_page_token:
            return
        request.page_token = messages.next_page_token


@pytest.mark.parametrize("page_size", [1, 7, 100, 0])
def test_a_page_of_columns_has_the_poses_of_the_page_of_messages(
        stub, new_vehicle, page_size):
    vehicle = new_vehicle()
    poses = Drive(11)[0:300]
    for row, each in enumerate(poses):
        if row % 40 < 30:
            each.ClearField("stamp")
        if row % 70 == 69:
            each.recording_start.unknown = True
    for batch in batches(poses):
        append(stub, vehicle, batch)
    for view in (api.POSE_VIEW_CURRENT, api.POSE_VIEW_AS_SENT):
        pages = list(both_forms(stub, vehicle, page_size=page_size, view=view))
        for messages, columns in pages:
            assert as_bytes(messages) == as_bytes(
                pose for each in columns for pose in expanded(each))
            assert page_size < 100 or len(columns) < len(messages)
        assert as_bytes(poses) == as_bytes(
            pose for messages, _ in pages for pose in messages)


def test_pages_that_are_full_of_bytes_end_at_the_same_pose(stub, new_vehicle):
    """A page has 2 MiB at most, as messages, and columns take less."""
    vehicle = new_vehicle()
    poses = straight(9000)
    for each in poses:
        each.covariance.form = api.COVARIANCE_FORM_ROS_36
        each.covariance.values[:] = [
            1e-2 if place % 7 == 0 else 1e-5 for place in range(36)]
    for batch in batches(poses, 3000):
        append(stub, vehicle, batch)
    pages = list(both_forms(stub, vehicle, page_size=10000))
    assert len(pages) > 1
    for messages, columns in pages:
        assert sum(each.pose_count for each in columns) == len(messages)
        assert sum(each.ByteSize() for each in columns) < 2**20
    assert sum(len(messages) for messages, _ in pages) == 9000


def test_columns_of_fields_that_are_masked_are_empty(stub, new_vehicle):
    vehicle = new_vehicle()
    append(stub, vehicle, with_stamps(straight(5)))
    for mask, filled in [
            (["sequence"], {"first_sequence"}),
            (["stamp", "heading_radians"],
             {"first_stamp", "stamp_step_nanos", "heading_radians"}),
            (["local.y_meters"], {"y_meters"}),
            (["covariance", "quaternion"],
             {"covariance_form", "covariance_diagonals"})]:
        answer = stub.ListPoses(api.ListPosesRequest(
            parent=vehicle, as_columns=True,
            read_mask=field_mask_pb2.FieldMask(paths=mask)))
        [columns] = answer.columns
        assert columns.pose_count == 5
        assert {field.name for field, _ in columns.ListFields()} == (
            filled | {"pose_count"})


def test_a_list_as_columns_can_be_sent_as_it_came(stub, new_vehicle):
    vehicle, other = new_vehicle(), new_vehicle()
    poses = with_stamps(boreas()[0])
    for batch in batches(poses, 3000):
        append(stub, vehicle, batch)
    limit = stub.GetServerInfo(api.GetServerInfoRequest()).max_batch_poses
    [page] = [columns for _, columns in both_forms(stub, vehicle, page_size=10000)]
    assert [each.pose_count for each in page] == [
        min(limit, len(poses) - first) for first in range(0, len(poses), limit)]
    for columns in page:
        append_columns(stub, other, columns)
    assert as_bytes(list_poses(stub, other)) == as_bytes(poses)
