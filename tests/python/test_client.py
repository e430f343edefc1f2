"""Calls do what their methods say, and errors say all that the server says."""

import socket

import numpy as np
import pytest

import revisit
from conftest import straight
from revisit import v1


def test_vehicles_are_made_listed_changed_and_deleted(client):
    made = client.create_vehicle("crud", v1.VehicleSettings(max_candidates=3))
    assert (made.name, made.settings.max_candidates) == ("vehicles/crud", 3)
    assert client.create_vehicle("vehicles/crud", v1.VehicleSettings(
        max_candidates=3)).uid == made.uid
    assert client.create_vehicle("crud", {"max_candidates": 3}).uid == made.uid
    with pytest.raises(revisit.AlreadyExists) as caught:
        client.create_vehicle("crud")
    assert caught.value.reason == "VEHICLE_EXISTS"
    changed = client.update_vehicle(
        "crud", v1.VehicleSettings(max_candidates=9), ["max_candidates"])
    assert changed.settings.max_candidates == 9
    assert "vehicles/crud" in [one.name for one in client.list_vehicles()]
    client.delete_vehicle("crud")
    with pytest.raises(revisit.NotFound) as caught:
        client.get_vehicle("crud")
    assert caught.value.reason == "VEHICLE_NOT_FOUND"


def test_pages_are_walked_to_the_end(client, new_vehicle):
    vehicle = new_vehicle()
    with client.stream_poses(vehicle) as stream:
        stream.append(straight(25_000))
    poses = client.poses(vehicle)
    assert poses.sequence.tolist() == list(range(1, 25_001))
    assert len(client.poses(vehicle, first_sequence=24_990)) == 11


def test_a_request_that_fails_says_which_fields_and_why(client, new_vehicle):
    vehicle = new_vehicle()
    with pytest.raises(revisit.InvalidArgument) as caught:
        client.append_poses(vehicle, [v1.Pose(sequence=1), v1.Pose(sequence=2)])
    error = caught.value
    fields = [one.field for one in error.field_violations]
    assert {"poses[0].position", "poses[1].position"} <= set(fields)
    text = str(error)
    assert text.startswith(f"INVALID_ARGUMENT ({error.reason}): ")
    for one in error.field_violations:
        assert f"{one.field}: {one.description}" in text
    assert client.get_vehicle(vehicle).durable_sequence == 0


def test_request_ids_are_the_callers_or_new(client, server):
    with pytest.raises(revisit.NotFound) as caught:
        client.call("GetVehicle", v1.GetVehicleRequest(name="vehicles/nobody"),
                    request_id="my-own 7")
    assert caught.value.request_id == "my-own 7"
    with pytest.raises(revisit.NotFound) as first:
        client.get_vehicle("nobody")
    with pytest.raises(revisit.NotFound) as second:
        client.get_vehicle("nobody")
    assert first.value.request_id != second.value.request_id
    for wrong in ("naïve", "a\nb", "x" * 129):
        with pytest.raises(ValueError, match="request id"):
            client.call("GetServerInfo", v1.GetServerInfoRequest(), request_id=wrong)


def test_a_deadline_ends_a_call(client):
    with socket.socket() as silent:
        silent.bind(("127.0.0.1", 0))
        silent.listen()
        address = "127.0.0.1:%d" % silent.getsockname()[1]
        with revisit.Client(address, deadline=0.5) as patient:
            with pytest.raises(revisit.DeadlineExceeded) as caught:
                patient.server_info()
            assert caught.value.request_id


def test_candidates_are_confirmed_and_rejected(client, new_vehicle, boreas):
    vehicle = new_vehicle()
    with client.stream_poses(vehicle) as stream:
        stream.append(boreas[0])
    answer = client.find_candidates(vehicle, options=v1.CandidateOptions(
        max_candidates=2, exhaustive=True))
    best, other = answer.candidates
    added = client.add_loop_closure(vehicle, best, note="icp")
    assert added.loop_closure.matched_sequence == best.matched.sequence
    client.reject_candidate(vehicle, other, note="a bridge above")
    [closure] = client.list_loop_closures(vehicle)
    [rejected] = client.list_rejected_candidates(vehicle)
    assert rejected.matched_sequence == other.matched.sequence
    assert (closure.note, rejected.note) == ("icp", "a bridge above")
    graph = client.export_pose_graph(vehicle)
    assert graph.vehicle.loop_closure_count == 1
    assert graph.edges["kind"].tolist().count("LOOP_CLOSURE") == 1
    client.delete_loop_closure(closure.name)
    client.delete_rejected_candidate(rejected.name)
    assert list(client.list_loop_closures(vehicle)) == []
    assert list(client.list_rejected_candidates(vehicle)) == []
    undone, before = client.list_deleted_pose_pairs(vehicle)
    assert undone.rejected_candidate == rejected
    assert before.loop_closure == closure
    assert undone.delete_time.ToNanoseconds() >= before.delete_time.ToNanoseconds()
    assert (undone.deleted_by, before.deleted_by) == ("", "")


def test_finding_has_one_note(client, new_vehicle):
    vehicle = new_vehicle()
    client.append_poses(vehicle, straight(50))
    finding = {"query_sequence": 40, "matched_sequence": 4, "note": "mine"}
    for add, pair in (
            (client.add_loop_closure, v1.LoopClosure(**finding)),
            (client.reject_candidate, v1.RejectedCandidate(**finding))):
        with pytest.raises(ValueError, match="note of its own"):
            add(vehicle, pair, note="yours")
    answer = client.reject_candidate(
        vehicle, v1.RejectedCandidate(**finding))
    assert answer.rejected_candidate.note == "mine"
    assert list(client.list_loop_closures(vehicle)) == []


def test_revised_poses_come_back_and_only_from_the_expected_revision(
        client, new_vehicle):
    vehicle = new_vehicle()
    client.append_poses(vehicle, straight(3000, spacing=0.5))
    poses = client.poses(vehicle)
    poses.position[:, 1] += 7.0
    revision = client.get_vehicle(vehicle).revision
    revised = client.revise_poses(vehicle, poses, revision)
    assert revised.revised_count == 3000
    assert np.array_equal(client.poses(vehicle).position, poses.position)
    with pytest.raises(revisit.Aborted) as caught:
        poses.position[:, 1] += 7.0
        client.revise_poses(vehicle, poses, revision)
    assert caught.value.reason == "REVISION_MISMATCH"


def test_operators_calls_answer(client, new_vehicle):
    assert client.server_info().max_batch_poses > 0
    with pytest.raises(revisit.FailedPrecondition) as caught:
        client.accept_data_loss(new_vehicle(), 0)
    assert caught.value.reason == "NO_DATA_LOSS"


def test_a_closed_client_says_so(server):
    client = revisit.Client(server.address)
    client.close()
    client.close()
    with pytest.raises(revisit.Cancelled, match="closed"):
        client.server_info()


def test_settings_are_keywords(client):
    made = client.create_vehicle(
        "keywords", v1.VehicleSettings(max_candidates=3, gate_probability=0.9),
        correlation_model="correlated-fixes", state_space=v1.STATE_SPACE_SPATIAL,
        coordinate_frame="COORDINATE_FRAME_GEODETIC", max_candidates=4,
        place_tolerance={"position_meters": 3.0, "heading_radians": 0.2})
    assert made.settings.correlation_model == v1.CORRELATION_MODEL_CORRELATED_FIXES
    assert made.settings.state_space == v1.STATE_SPACE_SPATIAL
    assert made.settings.coordinate_frame == v1.COORDINATE_FRAME_GEODETIC
    assert made.settings.max_candidates == 4
    assert made.settings.gate_probability == 0.9
    assert made.settings.place_tolerance.position_meters == 3.0
    changed = client.update_vehicle("keywords", max_candidates=9, gate_probability=None)
    assert changed.settings.max_candidates == 9
    assert changed.settings.gate_probability == 0.95
    assert changed.settings.state_space == v1.STATE_SPACE_SPATIAL


def test_a_keyword_that_is_no_setting_is_refused_with_the_one_it_may_be(client):
    with pytest.raises(TypeError, match="max_candidate; did you mean max_candidates"):
        client.create_vehicle("a", max_candidate=3)
    with pytest.raises(ValueError, match="expected one of DEAD_RECKONING, INDEPENDENT"):
        client.create_vehicle("a", correlation_model="odometry")
    with pytest.raises(ValueError, match="'unspecified': expected one of"):
        client.create_vehicle("a", correlation_model="unspecified")


def test_labels_are_set_one_by_one_and_removed(client):
    made = client.create_vehicle("labelled", display_name="The <old> one",
                                 labels={"depot": "north", "line": "7"})
    assert (made.display_name, dict(made.labels)) == (
        "The <old> one", {"depot": "north", "line": "7"})
    changed = client.update_vehicle("labelled", display_name="New",
                                    labels={"depot": "south", "line": None})
    assert (changed.display_name, dict(changed.labels)) == ("New", {"depot": "south"})


def test_candidates_are_asked_for_with_keywords(client, new_vehicle, boreas):
    vehicle = new_vehicle()
    with client.stream_poses(vehicle) as stream:
        stream.append(boreas[0])
    answer = client.find_candidates(vehicle, direction="either", exhaustive=True,
                                    max_candidates=20)
    assert {one.direction for one in answer.candidates} == {
        v1.DIRECTION_SAME, v1.DIRECTION_OPPOSITE}


@pytest.mark.parametrize("relative, covariance, numbers", [
    ((1.0, -2.0, 0.25), np.diag([0.01, 0.02, 1e-4]), (1.0, -2.0, 0.0, 0.25)),
    ((1.0, -2.0, 3.0, 0.25), np.diag([0.01, 0.02, 0.5, 1e-4]), (1.0, -2.0, 3.0, 0.25)),
    ([[0.0, -1.0, 1.0], [1.0, 0.0, -2.0], [0.0, 0.0, 1.0]], [0.01, 0, 0, 0.02, 0, 1e-4],
     (1.0, -2.0, 0.0, np.pi / 2)),
    ([[0.0, -1.0, 0, 1.0], [1.0, 0.0, 0, -2.0], [0, 0, 1.0, 3.0], [0, 0, 0, 1.0]],
     np.diag([0.01, 0.02, 0.5, 1, 1, 1e-4]), (1.0, -2.0, 3.0, np.pi / 2))])
def test_a_loop_closure_has_what_was_measured(client, new_vehicle, boreas, relative,
                                              covariance, numbers):
    vehicle = new_vehicle()
    client.append_poses(vehicle, boreas[0][:50])
    answer = client.add_loop_closure(vehicle, 40, 4, relative=relative,
                                     covariance=covariance, score=0.75, note="icp")
    stored = answer.loop_closure
    measured = stored.measurement
    assert (measured.x_meters, measured.y_meters, measured.z_meters,
            measured.heading_radians) == pytest.approx(numbers)
    assert measured.covariance.values[0] == 0.01
    assert (stored.query_sequence, stored.matched_sequence, stored.score,
            stored.note) == (40, 4, 0.75, "icp")
    assert answer.agreement.degrees_of_freedom == 3


def test_a_loop_closure_that_is_not_clear_is_refused(client, new_vehicle):
    vehicle = new_vehicle()
    for arguments, keywords, problem in (
            ((40,), {}, "matched is missing"),
            ((v1.LoopClosure(query_sequence=40), 4), {}, "beside a LoopClosure"),
            ((40, 4), {"relative": (1, 2, 3)}, "relative needs its covariance"),
            ((40, 4), {"covariance": np.eye(3)}, "relative, which is missing"),
            ((40, 4), {"relative": (1, 2), "covariance": np.eye(3)}, r"shape \(2,\)")):
        with pytest.raises((TypeError, ValueError), match=problem):
            client.add_loop_closure(vehicle, *arguments, **keywords)


def test_two_sequences_are_rejected(client, new_vehicle):
    vehicle = new_vehicle()
    client.append_poses(vehicle, straight(50))
    answer = client.reject_candidate(vehicle, 40, 4, note="a bridge")
    assert answer.rejected_candidate.matched_sequence == 4


def test_warnings_of_a_batch_are_returned_and_logged(client, new_vehicle, caplog):
    poses = straight(20)
    poses.heading[:] = 90.0
    ack = client.append_poses(new_vehicle(), poses)
    assert v1.WARNING_REASON_HEADING_BEYOND_TURN in [one.reason for one in ack.warnings]
    assert "What to do: np.radians()" in caplog.text


def test_recordings_are_listed_with_where_their_frames_lie(client, new_vehicle):
    vehicle = new_vehicle()
    client.append_poses(vehicle, straight(20))
    client.append_poses(vehicle, straight(20).numbered(21).as_recording(
        "after:3m,10deg", label="tuesday"))
    client.append_poses(vehicle, straight(20).numbered(41).as_recording("unknown"))
    table = revisit.recording_table(client.list_recordings(vehicle))
    assert table["name"].tolist() == [
        f"vehicles/{vehicle}/recordings/{first}" for first in (1, 21, 41)]
    assert table["last_sequence"].tolist() == [20, 40, 60]
    assert table["label"].tolist() == ["", "tuesday", ""]
    assert table["relation"].tolist() == ["", "after", "unknown"]
    assert table["frame_state"].tolist() == ["NONE", "NONE", "SAME"]
    assert np.isnan(table["frame_x"][:2]).all() and table["frame_x"][2] == 0.0


def test_revision_into_a_common_frame_leaves_one_recording(client, new_vehicle):
    vehicle = new_vehicle()
    client.append_poses(vehicle, straight(20))
    client.append_poses(vehicle, straight(20).numbered(21).as_recording("after"))
    with pytest.raises(revisit.InvalidArgument):
        client.revise_poses(vehicle, straight(39), common_frame=True)
    assert len(list(client.list_recordings(vehicle))) == 2
    client.revise_poses(vehicle, straight(40), common_frame=True)
    assert len(list(client.list_recordings(vehicle))) == 1
