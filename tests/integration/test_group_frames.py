"""Where the recordings of a group's members lie to each other: by datums, by loop
closures and over third members, as a vehicle's own recordings are told, wherever the
histories are."""

import grpc
import numpy as np
import pytest

from grouping import (PLANAR, add_link, add_member, add_vehicle, create_group, datum,
                      frame_pages, remove_member)
from revisit_server import START_SECONDS, Server, run, wait_until
from stubs import api
from wire import append, decode_failure, failure_of, pose, straight

TRIES = int(10 * START_SECONDS)
# A quarter turn.
TURN = np.pi / 2


def matrix(x, y, heading):
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s, x], [s, c, y], [0.0, 0.0, 1.0]])


def matrix_of(state):
    return matrix(state.x_meters, state.y_meters, state.heading_radians)


def begun(poses, **start):
    """The poses as a recording that this start begins."""
    poses[0].recording_start.CopyFrom(api.RecordingStart(**start))
    return poses


def frames(stub, group, vehicle, **fields):
    """By recording, without `vehicles/`."""
    for _ in range(TRIES):
        try:
            pages = frame_pages(stub, group, vehicle, **fields)
        except grpc.RpcError as error:
            if decode_failure(error).reason != "GROUP_NOT_READY":
                raise
            continue
        listed = [one for page in pages for one in page]
        assert listed == sorted(listed, key=lambda one: one.vehicle)
        return {one.recording.removeprefix("vehicles/"): one for one in listed}
    raise AssertionError("the group never became ready")


def linked(stub, group, revision, vehicle):
    """The frames of a group once the revision is seen."""
    def seen():
        request = api.ListFrameTransformsRequest(parent=group, vehicle=vehicle)
        return stub.ListFrameTransforms(request).group_revision >= revision
    wait_until(seen, "frames of the group as it is now")
    return frames(stub, group, vehicle)


def test_own_recordings_lie_where_the_vehicle_itself_says(stub):
    vehicle = add_vehicle(stub, "walker", poses=0)
    append(stub, vehicle, straight(30))
    append(stub, vehicle, begun(straight(30, first=31), after=PLANAR))
    append(stub, vehicle, begun(straight(30, first=61), unknown=True))
    append(stub, vehicle, begun(straight(30, first=91), after=PLANAR))
    stub.AddLoopClosure(api.AddLoopClosureRequest(
        parent=vehicle, loop_closure=api.LoopClosure(
            query_sequence=100, matched_sequence=10)))
    other = add_vehicle(stub, "walked")
    group = create_group(stub, "walks").name
    for member in (vehicle, other):
        add_member(stub, group, member)
    told = frames(stub, group, vehicle)
    own = stub.ListRecordings(api.ListRecordingsRequest(parent=vehicle)).recordings
    assert {recording.frame_state for recording in own} == {
        api.FRAME_STATE_SAME, api.FRAME_STATE_AFTER, api.FRAME_STATE_PROVISIONAL}
    uid = stub.GetVehicle(api.GetVehicleRequest(name=vehicle)).vehicle.uid
    for recording in own:
        transform = told.pop(recording.name.removeprefix("vehicles/"))
        assert (transform.vehicle, transform.vehicle_uid) == (vehicle, uid)
        for field in ("frame_state", "frame_pose", "frame_covariance",
                      "frame_reference"):
            assert getattr(transform, field) == getattr(recording, field), field
            if field != "frame_state":
                assert transform.HasField(field) == recording.HasField(field), field
    (alone,) = told.values()
    assert alone == api.FrameTransform(
        vehicle=other, recording=f"{other}/recordings/1",
        vehicle_uid=stub.GetVehicle(api.GetVehicleRequest(name=other)).vehicle.uid,
        frame_state=api.FRAME_STATE_NONE)


def test_datums_tie_as_computed_by_hand(stub):
    group = create_group(stub, "surveyed").name
    one, two = (add_vehicle(stub, name, poses=0) for name in ("left", "right"))
    for vehicle in (one, two):
        append(stub, vehicle, [pose(n, x=float(n - 1)) for n in range(1, 6)])
    for vehicle, y in ((one, 0.0), (two, 5.0)):
        placed = api.Datum(covariance=api.Covariance(
            form=api.COVARIANCE_FORM_PLANAR_6, values=[1, 0, 0, 4, 0, 0.01]))
        placed.pose.CopyFrom(api.StatePose(
            x_meters=10.0, y_meters=y, heading_radians=TURN))
        add_member(stub, group, vehicle, placed)
    told = frames(stub, group, one)
    assert told["left/recordings/1"].frame_state == api.FRAME_STATE_SAME
    there = told["right/recordings/1"]
    assert there.frame_state == api.FRAME_STATE_DATUM
    assert there.loop_closure_count == 0
    # Five metres along the shared y, to which both have turned x.
    np.testing.assert_allclose(matrix_of(there.frame_pose), matrix(5.0, 0.0, 0.0),
                               atol=1e-9)
    np.testing.assert_allclose(matrix_of(there.frame_reference), np.eye(3), atol=1e-9)
    # Both datums err by 2 m along x and by 1 m along y of the frames, and a heading
    # of 0.1 rad moves a place that is 5 m ahead by 0.5 m to the side.
    assert there.frame_covariance.form == api.COVARIANCE_FORM_PLANAR_6
    xx, xy, xh, yy, yh, hh = there.frame_covariance.values
    np.testing.assert_allclose([xx, xy, xh, yy, abs(yh), hh],
                               [8.0, 0.0, 0.0, 2.25, 0.05, 0.02], atol=1e-9)


def test_measured_links_tie_also_over_a_third_member(stub):
    group = create_group(stub, "chained").name
    names = [add_vehicle(stub, name, poses=60) for name in ("ada", "bea", "cyd")]
    for name in names:
        add_member(stub, group, name)
    ada, bea, cyd = names
    measured = api.LoopClosureMeasurement(
        x_meters=1.0, y_meters=2.0, heading_radians=TURN, covariance=PLANAR)
    add_link(stub, group, (bea, 10), (ada, 30), measurement=measured)
    revision = add_link(stub, group, (cyd, 20), (bea, 40),
                        measurement=measured).revision
    told = linked(stub, group, revision, ada)
    # Poses lie on x, a metre apart.
    step = matrix(1.0, 2.0, TURN)
    to_bea = matrix(30, 0, 0) @ step @ np.linalg.inv(matrix(10, 0, 0))
    to_cyd = to_bea @ matrix(40, 0, 0) @ step @ np.linalg.inv(matrix(20, 0, 0))
    for recording, wanted, count in (("bea/recordings/1", to_bea, 1),
                                     ("cyd/recordings/1", to_cyd, 0)):
        assert told[recording].frame_state == api.FRAME_STATE_PROVISIONAL
        assert told[recording].loop_closure_count == count
        np.testing.assert_allclose(matrix_of(told[recording].frame_pose), wanted,
                                   atol=1e-6)
    # What is measured errs; a way over two errs more.
    near, far = (told[name].frame_covariance.values[5]
                 for name in ("bea/recordings/1", "cyd/recordings/1"))
    assert near == pytest.approx(0.01) and far > 0.02 - 1e-12
    # From the other end the same chain is walked back.
    back = frames(stub, group, cyd)["ada/recordings/1"]
    np.testing.assert_allclose(matrix_of(back.frame_pose), np.linalg.inv(to_cyd),
                               atol=1e-6)
    # Whoever is not asked for ties all the same.
    assert list(frames(stub, group, ada, vehicles=[cyd])) == ["cyd/recordings/1"]
    assert frames(stub, group, ada, vehicles=[cyd])[
        "cyd/recordings/1"] == told["cyd/recordings/1"]
    revision = remove_member(stub, f"{group}/members/bea")
    told = linked(stub, group, revision, ada)
    assert told["cyd/recordings/1"].frame_state == api.FRAME_STATE_NONE


def test_pages_have_all_in_order_and_are_of_one_list(stub):
    group = create_group(stub, "paged").name
    # Ten comes behind nine.
    walked = add_vehicle(stub, "paged-a", poses=0)
    for number in range(1, 13):
        poses = [pose(number, x=float(number))]
        append(stub, walked, begun(poses, unknown=True) if number > 1 else poses)
    names = [walked, add_vehicle(stub, "paged-b"), add_vehicle(stub, "paged", poses=0)]
    other = add_vehicle(stub, "paged-drone", poses=0,
                        state_space=api.STATE_SPACE_SPATIAL)
    for name in (*names, other):
        add_member(stub, group, name)
    whole = frames(stub, group, walked)
    assert list(whole) == [f"paged-a/recordings/{n}" for n in range(1, 13)] + [
        "paged-b/recordings/1"]
    for size in (1, 5, 12):
        assert frames(stub, group, walked, page_size=size) == whole
    # One without poses has no last recording.
    assert frames(stub, group, "vehicles/paged") == {}
    request = api.ListFrameTransformsRequest(parent=group, vehicle=walked, page_size=1)
    page = stub.ListFrameTransforms(request)
    assert page.group_revision == 5
    for other_list in ({"vehicle": names[1]}, {"vehicles": names[:1]}):
        other = api.ListFrameTransformsRequest(page_token=page.next_page_token)
        other.MergeFrom(request)
        for field, value in other_list.items():
            if field == "vehicles":
                other.vehicles.extend(value)
            else:
                setattr(other, field, value)
        failure = failure_of(lambda o=other: stub.ListFrameTransforms(o))
        assert failure.reason == "INVALID_PAGE_TOKEN"


def test_what_is_no_member_and_too_many_are_refused(stub):
    group = create_group(stub, "asked").name
    member = add_vehicle(stub, "asked-a")
    stranger = add_vehicle(stub, "asked-b")
    add_member(stub, group, member)
    for vehicle, asked in ((stranger, []), (member, [stranger]),
                           ("vehicles/nobody", [])):
        failure = failure_of(lambda v=vehicle, a=asked: frame_pages(
            stub, group, v, vehicles=a))
        assert (failure.code, failure.reason) == (
            grpc.StatusCode.NOT_FOUND, "MEMBER_NOT_FOUND")
    for fields, field in (({"vehicle": "a"}, "vehicle"),
                          ({"vehicle": member, "vehicles": [member, "b"]},
                           "vehicles[1]"),
                          ({"vehicle": member, "vehicles": [member] * 101},
                           "vehicles")):
        failure = failure_of(lambda f=fields: frame_pages(stub, group, **f))
        assert failure.code == grpc.StatusCode.INVALID_ARGUMENT
        assert failure.fields == [field]
    assert frames(stub, group, member, vehicles=[member] * 100)


def test_any_server_answers_from_the_store_without_a_vehicle_in_memory(tmp_path):
    store = tmp_path / "store"
    with Server(store) as server:
        stub = server.stub()
        group = create_group(stub, "depot").name
        names = [add_vehicle(stub, f"car-{n}", poses=200) for n in range(3)]
        for number, name in enumerate(names):
            add_member(stub, group, name, datum(x=10.0 * number))
        before = frames(stub, group, names[1])
        assert len(before) == 3
    with Server(store) as server:
        stub = server.stub()
        # Only what is asked from has to be there.
        partial = frames(stub, group, names[1], allow_partial=True)
        assert partial["car-1/recordings/1"] == before["car-1/recordings/1"]
        assert partial.items() <= before.items()
        assert frames(stub, group, names[1]) == before
        info = stub.GetServerInfo(api.GetServerInfoRequest())
        assert info.resident_vehicle_count == 0
        listed = run("revisit", "group", "frames", "depot", "--from", "car-1",
                     "-o", "name", "--server", server.address)
        assert listed.stdout.splitlines() == [one.recording
                                              for one in before.values()]
