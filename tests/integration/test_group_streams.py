"""Checks of streams that search in the histories of a group's vehicles: each finds what
FindCandidates finds at its pose, for those who may know of it, and no acknowledgement
waits for it."""

import json
import time

import grpc
import pytest

from caller_identities import POLICY
from group_site import FRAMES, datum_of, make_site, make_vehicle, moved, name_of, search
from grouping import (add_link, add_member, add_vehicle, create_group, delete_group,
                      remove_member)
from identities import replace
from revisit_server import Server, wait_until
from stubs import api
from test_group_checks import as_found
from test_group_search import ready
from wire import (PoseStream, append, batches, boreas, decode_failure, failure_of, get,
                  laps, straight)

pytest_plugins = ("caller_identities",)

# Poses of the vehicle that streams, before it does, and in all.
FIRST, LAST = 600, 1700
# A history that takes long to read beside a check.
LONG = 60000
# Short sequences, so that short drives have checks: one in so many poses.
SHORT = {"sequence_length_meters": 40.0, "check_interval_meters": 20.0}
STEP = 20


@pytest.fixture(name="drive", scope="module")
def fixture_drive():
    return boreas()


def open_stream(stub, vehicle, group, **scope):
    return PoseStream(stub, vehicle, metadata=getattr(stub, "metadata", None),
                      send_candidates=True, candidate_options=api.CandidateOptions(
                          scope=api.SearchScope(group=group, **scope)))


def opened(stub, vehicle, group, **scope):
    """A stream that was opened once the histories were read."""
    def call():
        stream = open_stream(stub, vehicle, group, **scope)
        stream.receive_kind("opened")
        return stream
    return ready(call)


def make_streaming(stub, drive, vehicle):
    """A vehicle that has driven the first part; answers the poses of the rest."""
    stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id=vehicle))
    poses = moved(drive[0][0:LAST], FRAMES["one"])
    for batch in batches(poses[:FIRST], 256):
        append(stub, name_of(vehicle), batch)
    return poses[FIRST:]


def streamed(stream, poses):
    """The candidates of the checks of these poses."""
    for batch in batches(poses, 64):
        stream.send(batch)
    stream.half_close()
    responses = stream.receive_all()
    acked = 0
    for kind, message in responses:
        if kind == "ack":
            acked = message.durable_sequence
        else:
            assert asked_at(message) <= acked
    assert acked == poses[-1].sequence
    return [message for kind, message in responses if kind == "candidates"]


def asked_at(found):
    """The pose with which the node came at which was searched."""
    return found.query.sequence + (1 if found.query.fraction > 0.0 else 0)


@pytest.fixture(name="site", scope="module")
def fixture_site(stub, drive):
    for vehicle in ("two", "three"):
        make_vehicle(stub, drive, vehicle)
    return make_site(stub, ["two", "three"])


def make_member(stub, drive, group, vehicle):
    """A member that a loop closure ties to another; its name, and the poses that it
    has not sent."""
    rest = make_streaming(stub, drive, vehicle)
    add_member(stub, group, name_of(vehicle), datum_of(FRAMES["one"]))
    revision = add_link(stub, group, (name_of(vehicle), 500),
                        (name_of("two"), 500)).revision
    wait_until(lambda: ready(lambda: search(
        stub, vehicle, group=group)).group_revision == revision, "the link is seen")
    return name_of(vehicle), rest


@pytest.mark.parametrize("scope", [
    {}, {"exclude_own": True, "allow_partial": True},
    {"vehicles": [name_of("three")]}], ids=["all", "others", "some"])
def test_each_check_finds_what_a_call_at_its_pose_finds(stub, drive, site, scope,
                                                        request):
    vehicle, rest = make_member(stub, drive, site, f"one-{request.node.callspec.id}")
    with opened(stub, vehicle, site, **scope) as stream:
        sets = streamed(stream, rest)
    sequences = [asked_at(found) for found in sets]
    assert sequences == sorted(set(sequences)) and len(sets) > 50
    assert any(candidate.matched_vehicle for found in sets
               for candidate in found.candidates)
    assert any(candidate.frame_state == api.FRAME_STATE_PROVISIONAL for found in sets
               for candidate in found.candidates) != ("vehicles" in scope)
    for found in sets[::6]:
        same = ready(lambda found=found: search(
            stub, vehicle.split("/")[1], asked_at(found), site, **scope))
        assert as_found(found) == as_found(same), asked_at(found)


def test_checks_of_a_member_that_names_no_group_are_those_of_its_own_history(
        stub, drive, site):
    vehicle, rest = make_member(stub, drive, site, "one-alone")
    make_streaming(stub, drive, "lone")

    def texts(name):
        with PoseStream(stub, name, send_candidates=True) as stream:
            stream.receive_kind("opened")
            sets = streamed(stream, rest)
        for found in sets:
            found.ClearField("search_duration")
            for candidate in found.candidates:
                assert candidate.recording_of_match == f"{name}/recordings/1"
                candidate.ClearField("recording_of_match")
        return [found.SerializeToString(deterministic=True) for found in sets]

    assert texts(vehicle) == texts("vehicles/lone")


def test_refuses_scopes_that_are_not_there(stub, site):
    def refusal(**scope):
        return failure_of(lambda: open_stream(
            stub, name_of("two"), **{"group": site, **scope}).receive())

    missing = refusal(group="groups/elsewhere")
    assert (missing.code, missing.reason) == (grpc.StatusCode.NOT_FOUND,
                                              "GROUP_NOT_FOUND")
    stranger = refusal(vehicles=["vehicles/nobody"])
    assert (stranger.code, stranger.reason) == (grpc.StatusCode.NOT_FOUND,
                                                "MEMBER_NOT_FOUND")
    for scope, field in ((dict(group=""), "group"),
                         (dict(vehicles=["nobody"]), "vehicles[0]")):
        wrong = refusal(**scope)
        assert wrong.code == grpc.StatusCode.INVALID_ARGUMENT
        assert wrong.fields == [f"open.candidate_options.scope.{field}"]


@pytest.mark.parametrize("harm, reason", [
    (lambda stub, group: delete_group(stub, group), "GROUP_NOT_FOUND"),
    (lambda stub, group: remove_member(stub, f"{group}/members/two"),
     "MEMBER_NOT_FOUND")], ids=["group", "member"])
def test_a_scope_that_goes_ends_the_stream_and_leaves_the_poses(
        stub, drive, site, harm, reason, request):
    case = request.node.callspec.id
    group = create_group(stub, f"gone-{case}").name
    add_member(stub, group, name_of("two"), datum_of(FRAMES["two"]))
    vehicle = f"leaves-{case}"
    rest = make_streaming(stub, drive, vehicle)
    scope = {"group": group, "vehicles": [name_of("two")]}
    with opened(stub, name_of(vehicle), **scope) as stream:
        stream.send(rest[:200])
        responses = [stream.receive() for _ in range(2)]
        assert [kind for kind, _ in responses] == ["ack", "candidates"]
        harm(stub, group)
        wait_until(lambda: reason_of(lambda: search(stub, vehicle, **scope)) == reason,
                   "the group was looked at")
        stream.send(rest[200:600])
        acked = FIRST + 200
        with pytest.raises(grpc.RpcError) as ended:
            for kind, message in iter(stream.receive, None):
                if kind == "ack":
                    acked = message.durable_sequence
        assert decode_failure(ended.value).reason == reason
    # A check of the first poses may have ended it before the others came.
    assert acked in (FIRST + 200, FIRST + 600)
    assert acked == get(stub, name_of(vehicle)).durable_sequence


def reason_of(call):
    try:
        call()
    except grpc.RpcError as error:
        return decode_failure(error).reason
    return ""


def searched_by(found):
    return [each.vehicle for each in found.searched]


def step(stream, poses):
    """Sends poses of which one has a check; answers its candidates."""
    stream.send(poses)
    assert stream.receive_kind("ack").durable_sequence == poses[-1].sequence
    return stream.receive_kind("candidates")


def steps(stream, poses, what, holds):
    """Sends poses until the candidates of a check hold this; answers them, and the
    poses that are left."""
    for number, batch in enumerate(batches(poses, STEP), 1):
        found = step(stream, batch)
        if holds(found):
            return found, poses[number * STEP:]
        # Groups and rights are looked at from time to time.
        time.sleep(0.05)
    raise AssertionError(f"no check tells of {what}")


def test_members_that_the_caller_may_not_read_are_no_part_of_it(
        called_by, identities, drive):
    acme, few = called_by("acme"), called_by("vehicle:1one")
    poses = laps(4000)
    one = acme.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id="acme-1one", vehicle=api.Vehicle(
            settings=api.VehicleSettings(**SHORT)))).vehicle.name
    append(acme, one, poses[:STEP * 5])
    rest = poses[STEP * 5:]
    for vehicle in ("two", "three"):
        make_vehicle(acme, drive, vehicle, prefix="acme-")
    # The vehicle may read the group, which has its name.
    group = create_group(acme, "acme-1one").name
    others = [name_of("acme-three"), name_of("acme-two")]
    for vehicle in (one, *others):
        add_member(acme, group, vehicle)
    with opened(acme, one, group) as stream:
        found = step(stream, rest[:STEP])
        assert searched_by(found) == others
    rest = rest[STEP:]
    named = failure_of(lambda: open_stream(few, one, group,
                                           vehicles=others).receive())
    assert named.reason == "MEMBER_NOT_FOUND"
    create_group(called_by("umbra"), "umbra-site")
    theirs = failure_of(lambda: open_stream(few, one, "groups/umbra-site").receive())
    assert theirs.reason == "GROUP_NOT_FOUND"
    with opened(few, one, group) as stream:
        found = step(stream, rest[:STEP])
        assert not found.searched and not found.unsearched
        assert as_found(found) == as_found(search(
            few, one.split("/")[1], asked_at(found), group))
        # Rights that come, and go, while it streams.
        grant = {"token_subject": "vehicle:1one", "tenant": "acme",
                 "vehicles": ["acme-two"], "verbs": ["read"]}
        policy = {**POLICY, "grants": [*POLICY["grants"], grant]}
        replace(identities.policy_file, json.dumps(policy))
        _, rest = steps(stream, rest[STEP:], "what may be read now",
                        lambda found: searched_by(found) == [name_of("acme-two")])
        replace(identities.policy_file, json.dumps(POLICY))
        steps(stream, rest, "what may be read no more",
              lambda found: not found.searched)


def test_histories_that_are_not_read_yet(tmp_path):
    store = tmp_path / "store"
    poses = laps(4000)
    with Server(store) as server:
        stub = server.stub()
        one = add_vehicle(stub, "one", 0, **SHORT)
        append(stub, one, poses[:STEP * 5])
        group = create_group(stub, "yard").name
        for vehicle in ("first", "second"):
            add_vehicle(stub, vehicle, 0)
            for batch in batches(straight(LONG), 1000):
                append(stub, name_of(vehicle), batch)
        add_member(stub, group, name_of("first"))
        # So that none leaves a snapshot, which would be read sooner.
        server.kill()
    with Server(store) as server:
        stub = server.stub()
        with open_stream(stub, one, group) as early:
            early.send(poses[STEP * 5:STEP * 6])
            early.half_close()
            failure = failure_of(early.receive)
        assert (failure.code, failure.reason) == (grpc.StatusCode.UNAVAILABLE,
                                                  "GROUP_NOT_READY")
        assert failure.retry_seconds > 0.0
        assert get(stub, one).durable_sequence == STEP * 5
        with opened(stub, one, group) as stream:
            found = step(stream, poses[STEP * 5:STEP * 6])
            assert searched_by(found) == [name_of("first")]
            # Nobody has asked for its history yet.
            revision = add_member(stub, group, name_of("second")).revision
            found, rest = steps(stream, poses[STEP * 6:], "the new member",
                                lambda found: found.group_revision == revision)
            assert searched_by(found) == [name_of("first")]
            assert [(each.vehicle, each.reason) for each in found.unsearched] == [
                (name_of("second"), api.UNSEARCHED_REASON_NOT_READY)]
            found, _ = steps(stream, rest, "its history",
                             lambda found: len(found.searched) == 2)
            assert not found.unsearched
