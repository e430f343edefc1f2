"""Wrong arguments are refused before anything is sent, by their names."""

import asyncio
import re

import numpy as np
import pytest

import revisit
from revisit import v1

#: Nothing listens there: a call that is sent ends with Unavailable.
NOWHERE = "127.0.0.1:1"
INTEGER = r"expected an integer in \[0, 2\^64 - 1\]"
VEHICLE = "expected the id or the resource name of a vehicle"
POSES = "expected revisit.Poses or v1.Pose messages"
PAIR = ("shuttle-7", 1)

#: A call of the client, the error, and what it says.
CALLS = [
    (lambda c: c.create_vehicle(7), TypeError, "vehicle_id is 7: expected a string"),
    (lambda c: c.create_vehicle("a", labels=["north"]), TypeError,
     r"labels is \['north'\]: expected a mapping of strings"),
    (lambda c: c.create_vehicle("a", labels={"depot": 1}), TypeError,
     "labels is {'depot': 1}: expected a mapping of strings"),
    (lambda c: c.create_vehicle("a", display_name=3), TypeError,
     "display_name is 3: expected a string"),
    (lambda c: c.create_vehicle("a", 3), TypeError,
     "settings is 3: expected a v1.VehicleSettings"),
    (lambda c: c.create_vehicle("a", {"max_candidate": 3}), TypeError,
     "there is no setting max_candidate; did you mean max_candidates"),
    (lambda c: c.create_vehicle("a", max_candidates="3"), TypeError,
     "max_candidates is '3': expected an integer"),
    (lambda c: c.create_vehicle("a", correlation_model=1.5), TypeError,
     "correlation_model is 1.5: expected one of DEAD_RECKONING,"),
    (lambda c: c.get_vehicle(None), TypeError, f"vehicle is None: {VEHICLE}"),
    (lambda c: c.get_vehicle(v1.Vehicle(name="vehicles/a")), TypeError,
     f"vehicle is a Vehicle: {VEHICLE}"),
    (lambda c: c.update_vehicle("a", labels=["north"]), TypeError,
     r"labels is \['north'\]: expected a mapping"),
    (lambda c: c.accept_data_loss("a", "7"), TypeError,
     f"durable_sequence is '7': {INTEGER}"),
    (lambda c: c.append_poses("a", None), TypeError, f"poses is None: {POSES}"),
    (lambda c: c.append_poses("a", "drive.csv"), TypeError,
     f"poses is 'drive.csv': {POSES}"),
    (lambda c: c.append_poses("a", v1.Pose()), TypeError, f"poses is a Pose: {POSES}"),
    (lambda c: c.append_poses("a", [{"x": 1}]), TypeError,
     r"poses\[0\] is {'x': 1}: expected a v1.Pose"),
    (lambda c: c.append_poses("a", [], vehicle_uid=3), TypeError,
     "vehicle_uid is 3: expected a string"),
    (lambda c: c.poses("a", 1.5), TypeError, f"first_sequence is 1.5: {INTEGER}"),
    (lambda c: c.poses("a", -1), ValueError, f"first_sequence is -1: {INTEGER}"),
    (lambda c: c.revise_poses("a", [], "x"), TypeError,
     f"expected_revision is 'x': {INTEGER}"),
    (lambda c: c.find_candidates("a", 2**64), ValueError,
     f"sequence is {2**64}: {INTEGER}"),
    (lambda c: c.find_candidates("a", options="either"), TypeError,
     "options is 'either': expected a v1.CandidateOptions"),
    (lambda c: c.find_candidates("a", group=7), TypeError,
     "group is 7: expected the id"),
    (lambda c: c.find_candidates("a", group="g", vehicles=7), TypeError,
     "vehicles is 7: expected ids or resource names"),
    (lambda c: c.add_loop_closure("a", "3", 2), TypeError,
     "query is '3': expected a sequence, a v1.Candidate or a v1.LoopClosure"),
    (lambda c: c.add_loop_closure("a", 3, 2, note=5), TypeError,
     "note is 5: expected a string"),
    (lambda c: c.add_loop_closure("a", 3, 2, score="x"), TypeError,
     "score is 'x': expected a number"),
    (lambda c: c.add_loop_closure("a", 3, 2, relative=("x", 2, 3),
                                  covariance=np.eye(3)), TypeError,
     r"relative is \('x', 2, 3\): expected numbers"),
    (lambda c: c.reject_candidate("a", 3.5, 2), TypeError,
     "query is 3.5: expected a sequence, a v1.Candidate or a v1.RejectedCandidate"),
    (lambda c: c.delete_loop_closure(7), TypeError, "name is 7: expected a string"),
    (lambda c: c.stream_poses("a", {"batch_poses": 1}), TypeError,
     "options is {'batch_poses': 1}: expected revisit.StreamOptions"),
    (lambda c: c.watch(7), TypeError, "vehicles is 7: expected ids or resource names"),
    (lambda c: c.watch(cursor=7), TypeError, "cursor is 7: expected a string"),
    (lambda c: c.watch(states=7.5), TypeError, "states is 7.5: expected one of OPEN,"),
    (lambda c: c.watch(least_probability="x"), TypeError,
     "least_probability is 'x': expected a number"),
    (lambda c: c.create_group(7), TypeError, "group_id is 7: expected a string"),
    (lambda c: c.add_group_member("g", 7), TypeError, f"vehicle is 7: {VEHICLE}"),
    (lambda c: c.add_group_member("g", "a", 7), TypeError,
     "datum is 7: expected a v1.Datum"),
    (lambda c: c.add_inter_vehicle_loop_closure("g", 7, PAIR), TypeError,
     r"query is 7: expected \(vehicle, sequence\)"),
    (lambda c: c.call("GetVehicl", v1.GetVehicleRequest()), ValueError,
     "there is no unary method GetVehicl; did you mean GetVehicle?"),
    (lambda c: c.call("StreamPoses", v1.StreamPosesRequest()), ValueError,
     "there is no unary method StreamPoses"),
    (lambda c: c.call("GetVehicle", {"name": "a"}), TypeError,
     "request is {'name': 'a'}: expected a v1.GetVehicleRequest"),
    (lambda c: c.call("GetVehicle", v1.GetVehicleRequest(), deadline="x"), TypeError,
     "deadline is 'x': expected seconds"),
]

#: Something that is made from arguments, the error, and what it says.
MADE = [
    (lambda: revisit.Client(None), TypeError, "address is None: expected a string"),
    (lambda: revisit.Client(""), ValueError, "address is empty"),
    (lambda: revisit.Client(NOWHERE, deadline="x"), TypeError,
     "deadline is 'x': expected seconds"),
    (lambda: revisit.Client(NOWHERE, bulk_deadline=-1), ValueError,
     "bulk_deadline is -1 s: it is positive and finite"),
    (lambda: revisit.Client(NOWHERE, deadline=float("nan")), ValueError,
     "deadline is nan s: it is positive and finite"),
    (lambda: revisit.Client(NOWHERE, max_attempts=1.5), TypeError,
     "max_attempts is 1.5: expected an integer of at least 1"),
    (lambda: revisit.Client(NOWHERE, token_file=7), TypeError,
     "token_file is 7: expected the path of a file"),
    (lambda: revisit.Client(NOWHERE, backoff=3), TypeError,
     "backoff is 3: expected revisit.BackoffOptions"),
    (lambda: revisit.StreamOptions(batch_poses="x"), TypeError,
     "batch_poses is 'x': expected an integer of at least 1"),
    (lambda: revisit.StreamOptions(batch_poses=0), ValueError,
     "batch_poses is 0: it is at least 1"),
    (lambda: revisit.StreamOptions(candidate_options={"direction": 1}), TypeError,
     "candidate_options is {'direction': 1}: expected a v1.CandidateOptions"),
    (lambda: revisit.StreamOptions(give_up_after=-1), ValueError,
     "give_up_after is -1 s: it is positive"),
    (lambda: revisit.datum("x", np.eye(3)), TypeError, "pose is 'x': expected numbers"),
]


@pytest.mark.parametrize(("call", "kind", "message"), CALLS)
def test_calls_name_the_argument_that_is_wrong(call, kind, message):
    with revisit.Client(NOWHERE) as client, pytest.raises(kind) as refused:
        call(client)
    assert re.match(message, str(refused.value)), refused.value


@pytest.mark.parametrize(("call", "kind", "message"), CALLS)
def test_asyncio_says_the_same(call, kind, message):
    async def refusal():
        async with revisit.aio.Client(NOWHERE) as client:
            with pytest.raises(kind) as refused:
                answer = call(client)
                if asyncio.iscoroutine(answer):
                    await answer
        return str(refused.value)

    assert re.match(message, asyncio.run(refusal()))


@pytest.mark.parametrize(("make", "kind", "message"), MADE)
def test_options_name_the_one_that_is_wrong(make, kind, message):
    with pytest.raises(kind) as refused:
        make()
    assert re.match(message, str(refused.value)), refused.value


@pytest.mark.parametrize("poses, message", [
    (None, f"poses is None: {POSES}"),
    (np.zeros((3, 3)), r"poses\[0\] is array\(\[0., 0., 0.\]\): expected a v1.Pose"),
    ([v1.Pose(sequence=1), 2], r"poses\[1\] is 2: expected a v1.Pose")])
def test_a_stream_takes_nothing_of_poses_that_are_none(poses, message):
    with revisit.Client(NOWHERE) as client:
        stream = client.stream_poses("a")
        with pytest.raises(TypeError) as refused:
            stream.append(poses)
        assert re.match(message, str(refused.value)), refused.value
        assert stream.pending_poses == 0


def test_integers_of_numpy_are_sequences():
    with revisit.Client(NOWHERE, max_attempts=1) as client:
        with pytest.raises(revisit.Unavailable):
            client.add_loop_closure("a", np.uint64(3), np.int64(2))
