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
