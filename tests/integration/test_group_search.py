"""Searches in the histories of a group's vehicles: places are found wherever the
vehicles are, and answers are the same to the bit wherever these are in memory."""

import contextlib
import math
import time

import grpc
import pytest

from group_site import (FRAMES, PARTS, datum_of, make_site, make_vehicle, moved,
                        name_of, search)
from grouping import add_link, add_member, create_group, remove_member
from own_postgres import own_postgres
from private_cluster import find_postgres
from revisit_server import START_SECONDS, Server, run, wait_until
from scraped import scrape
from stubs import api
from wire import append, batches, boreas, decode_failure, failure_of, get

pytest_plugins = ("caller_identities",)

QUERIES = (700, 1000, 1300, 1700)
TRIES = int(10 * START_SECONDS)


@pytest.fixture(name="drive", scope="module")
def fixture_drive():
    return boreas()


def ready(call):
    """What a search answers once the histories are read."""
    for _ in range(TRIES):
        try:
            return call()
        except grpc.RpcError as error:
            failure = decode_failure(error)
            if failure.reason not in ("GROUP_NOT_READY", "NOT_OWNER"):
                raise
            # Nothing announces that a server has read what it was asked for.
            time.sleep(min(failure.retry_seconds, 0.1))
    raise AssertionError("the group never became ready")


def answers(stub):
    """All that is the same wherever the histories come from, as bytes."""
    texts = []
    for sequence in QUERIES:
        for scope in ({}, {"exclude_own": True},
                      {"vehicles": [name_of("three")]}):
            found = ready(lambda: search(stub, sequence=sequence, **scope))
            found.ClearField("search_duration")
            for searched in found.searched:
                assert searched.lag.ToTimedelta().total_seconds() < 60
                searched.ClearField("lag")
            texts.append(found.SerializeToString(deterministic=True))
    return texts


@pytest.fixture(name="site", scope="module")
def fixture_site(stub, drive):
    for vehicle in FRAMES:
        make_vehicle(stub, drive, vehicle)
    return make_site(stub)


def test_finds_places_in_the_histories_of_others(stub, drive, site):
    truth = drive[1]
    accepted = 0
    for sequence in QUERIES:
        found = ready(lambda: search(stub, sequence=sequence, exclude_own=True))
        assert [each.vehicle for each in found.searched] == [
            "vehicles/three", "vehicles/two"]
        assert not found.unsearched
        assert found.group_revision == 4
        for searched in found.searched:
            assert searched.last_sequence == get(
                stub, searched.vehicle).durable_sequence
        for candidate in found.candidates:
            vehicle = candidate.matched_vehicle.split("/")[1]
            assert vehicle in ("two", "three")
            assert candidate.matched_vehicle_uid == get(
                stub, candidate.matched_vehicle).uid
            assert candidate.recording_of_match == (
                f"{candidate.matched_vehicle}/recordings/1")
            assert candidate.frame_state == api.FRAME_STATE_DATUM
            assert candidate.difference.covariance.values
        best = found.candidates[0]
        if best.verdict != api.VERDICT_ACCEPTED:
            continue
        accepted += 1
        first = PARTS[best.matched_vehicle.split("/")[1]][0]
        at = truth[first + best.matched.sequence - 1]
        there = truth[sequence - 1]
        assert math.hypot(at[0] - there[0], at[1] - there[1]) < 20.0
    assert accepted >= 3


def test_the_own_history_counts_unless_it_is_left_out(stub, site):
    own = stub.FindCandidates(api.FindCandidatesRequest(
        vehicle=name_of("one"), sequence=1700)).candidates
    with_own = ready(lambda: search(stub, sequence=1700))
    without = ready(lambda: search(stub, sequence=1700, exclude_own=True))
    assert with_own.nodes_considered + with_own.nodes_pruned == (
        own.nodes_considered + own.nodes_pruned
        + without.nodes_considered + without.nodes_pruned)
    assert not own.searched and not own.group_revision


def test_only_named_vehicles_are_searched(stub, site):
    found = ready(lambda: search(stub, sequence=1000,
                                 vehicles=[name_of("two")], exclude_own=True))
    assert [each.vehicle for each in found.searched] == ["vehicles/two"]
    assert {each.matched_vehicle for each in found.candidates} == {"vehicles/two"}


def test_says_why_a_member_is_not_searched(stub, site):
    found = ready(lambda: search(
        stub, sequence=1000,
        options=api.CandidateOptions(alignment=api.ALIGNMENT_COMPOSITE)))
    assert [(each.vehicle, each.reason) for each in found.unsearched] == [
        ("vehicles/three", api.UNSEARCHED_REASON_ALIGNMENT),
        ("vehicles/two", api.UNSEARCHED_REASON_ALIGNMENT)]


def test_refuses_scopes_that_are_not_there(stub, site):
    missing = failure_of(lambda: search(stub, group="groups/elsewhere"))
    assert (missing.code, missing.reason) == (grpc.StatusCode.NOT_FOUND,
                                              "GROUP_NOT_FOUND")
    stranger = failure_of(lambda: search(stub, vehicles=["vehicles/nobody"]))
    assert (stranger.code, stranger.reason) == (grpc.StatusCode.NOT_FOUND,
                                                "MEMBER_NOT_FOUND")
    for scope, field in ((dict(group=""), "options.scope.group"),
                         (dict(vehicles=["nobody"]), "options.scope.vehicles[0]")):
        wrong = failure_of(lambda: search(stub, **scope))
        assert wrong.code == grpc.StatusCode.INVALID_ARGUMENT
        assert wrong.violations[0][0] == field


def test_all_histories_count_against_the_limit_of_steps(tmp_path, drive):
    with Server(tmp_path / "store", "--max-search-steps", 600000) as server:
        stub = server.stub()
        for vehicle in FRAMES:
            make_vehicle(stub, drive, vehicle)
        make_site(stub)
        options = api.CandidateOptions(use_belief=False)
        stub.FindCandidates(api.FindCandidatesRequest(
            vehicle=name_of("one"), sequence=1000, options=options))
        beyond = failure_of(lambda: search(stub, sequence=1000, options=options))
        assert (beyond.code, beyond.reason) == (grpc.StatusCode.OUT_OF_RANGE,
                                                "LIMIT_EXCEEDED")


def test_answers_are_the_same_wherever_the_histories_come_from(tmp_path, drive):
    store = tmp_path / "store"
    with Server(store) as server:
        stub = server.stub()
        for vehicle in FRAMES:
            make_vehicle(stub, drive, vehicle)
        group = make_site(stub)
        add_link(stub, group, (name_of("one"), 500), (name_of("two"), 500))
        wait_until(lambda: ready(lambda: search(stub)).group_revision == 5,
                   "the link is seen")
        in_memory = answers(stub)
        # Others on the same roads are no part of it.
        for vehicle in FRAMES:
            make_vehicle(stub, drive, vehicle, prefix="other-")
        make_site(stub, prefix="other-")
        assert answers(stub) == in_memory
    with Server(store) as server:
        stub = server.stub()
        assert answers(stub) == in_memory
        # Nobody but the one that asks was loaded for it.
        assert stub.GetServerInfo(
            api.GetServerInfoRequest()).resident_vehicle_count == 1
        for vehicle in FRAMES:
            get(stub, name_of(vehicle))
        stub.FindCandidates(api.FindCandidatesRequest(vehicle=name_of("two")))
        assert answers(stub) == in_memory
    if find_postgres() is None:
        pytest.skip("there is no PostgreSQL for the servers that share a store")
    with shared_servers(tmp_path) as (here, there):
        for stub, vehicle in ((here, "one"), (here, "two"), (there, "three")):
            make_vehicle(stub, drive, vehicle)
        group = make_site(there)
        add_link(there, group, (name_of("one"), 500), (name_of("two"), 500))
        wait_until(lambda: ready(lambda: search(here)).group_revision == 5,
                   "the link is seen")
        assert in_any_store(answers(here)) == in_any_store(in_memory)


def in_any_store(texts):
    """Another store has other uids, and divides batches otherwise."""
    result = []
    for found in map(api.CandidateSet.FromString, texts):
        found.ClearField("revision")
        for candidate in found.candidates:
            candidate.ClearField("matched_vehicle_uid")
        result.append(found.SerializeToString(deterministic=True))
    return result


@contextlib.contextmanager
def shared_store():
    with own_postgres() as postgres:
        migrated = run("revisitd", "migrate", "--store",
                       postgres.url("revisit_owner"))
        assert migrated.returncode == 0, migrated.stderr
        yield postgres.url("revisit")


def sharing(url, directory, number, *flags):
    return Server(url, "--advertise-address", f"host-{number}:1",
                  "--lease-seconds", 1, *flags,
                  log_path=directory / f"server-{number}.log")


@contextlib.contextmanager
def shared_servers(directory):
    with shared_store() as url, contextlib.ExitStack() as servers:
        yield [servers.enter_context(sharing(url, directory, number)).stub()
               for number in range(2)]


def test_answers_name_only_durable_poses_while_owners_are_killed(tmp_path, drive):
    if find_postgres() is None:
        pytest.skip("there is no PostgreSQL for the servers that share a store")
    poses = moved(drive[0][0:1100], FRAMES["two"])
    with (shared_store() as url,
          sharing(url, tmp_path, 0, "--admin-listen", "127.0.0.1:0") as asking):
        stub = asking.stub()
        make_vehicle(stub, drive, "one")
        stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id="two"))
        make_site(stub, ["one", "two"])
        seen, durable = 0, 0
        for _ in range(2):
            with sharing(url, tmp_path, 1) as owner:
                for batch in batches(poses[durable:durable + 256], 32):
                    last = batch[-1].sequence
                    ready(lambda batch=batch: append(owner.stub(), name_of("two"),
                                                     batch))
                    found = ready(lambda: search(stub, sequence=1000))
                    assert found.searched[0].last_sequence >= seen
                    seen = found.searched[0].last_sequence
                    assert seen <= last
                    for candidate in found.candidates:
                        assert candidate.matched.sequence <= (
                            seen if candidate.matched_vehicle else 1000)
                owner.kill()
            # The other server goes on with what is stored.
            wait_until(lambda: ready(lambda: search(stub)).searched[0].last_sequence
                       == last, "all that was acknowledged")
            with sharing(url, tmp_path, 1) as owner:
                durable = ready(
                    lambda: get(owner.stub(), name_of("two"))).durable_sequence
            assert durable == last
        # Poses were only added, so that nothing was made twice.
        metrics = scrape(asking)
        assert metrics.value("revisit_followed_drives_total") == 1
        assert metrics.value("revisit_followed_vehicles") == 1


def test_callers_search_what_they_may_read(called_by, drive):
    acme, few = called_by("acme"), called_by("acme-few")
    for vehicle in ("one", "two"):
        make_vehicle(acme, drive, vehicle, prefix="acme-1")
    make_vehicle(acme, drive, "three", prefix="acme-")
    group = create_group(acme, "acme-1-site").name
    for vehicle in ("1one", "1two", "three"):
        add_member(acme, group, name_of(f"acme-{vehicle}"),
                   datum_of(FRAMES[vehicle.lstrip("1")]))

    def found(stub):
        answer = ready(lambda: search(stub, vehicle="acme-1one", sequence=1000,
                                      group=group))
        answer.ClearField("search_duration")
        answer.ClearField("group_revision")
        for searched in answer.searched:
            searched.ClearField("lag")
        return answer

    everything = found(acme)
    assert [each.vehicle for each in everything.searched] == [
        "vehicles/acme-1two", "vehicles/acme-three"]
    part = found(few)
    assert [each.vehicle for each in part.searched] == ["vehicles/acme-1two"]
    hidden = failure_of(lambda: search(few, vehicle="acme-1one", group=group,
                                       vehicles=["vehicles/acme-three"]))
    assert hidden.reason == "MEMBER_NOT_FOUND"
    # Other tenants' vehicles on the same roads change nothing.
    umbra = called_by("umbra")
    for vehicle in FRAMES:
        make_vehicle(umbra, drive, vehicle, prefix="umbra-")
    make_site(umbra, prefix="umbra-")
    ready(lambda: search(umbra, vehicle="umbra-one", group="groups/umbra-site"))
    assert found(acme) == everything
    for theirs in ("groups/umbra-site", "groups/umbra-gone"):
        strange = failure_of(lambda theirs=theirs: search(
            acme, vehicle="acme-1one", group=theirs))
        assert strange.reason == "GROUP_NOT_FOUND"
    # As if the member had left.
    remove_member(acme, f"{group}/members/acme-three")
    wait_until(lambda: len(found(acme).searched) == 1, "the member has left")
    assert found(acme) == part


def test_sees_what_becomes_of_members(stub, drive, site):
    make_vehicle(stub, drive, "two", prefix="extra-")
    add_member(stub, site, name_of("extra-two"), datum_of(FRAMES["two"]))

    def searched():
        return {each.vehicle: each.last_sequence for each in
                ready(lambda: search(stub, sequence=1000)).searched}

    wait_until(lambda: name_of("extra-two") in searched(), "the new member")
    last = moved(drive[0][0:1110], FRAMES["two"])[1100:]
    append(stub, name_of("extra-two"), last)
    wait_until(lambda: searched()[name_of("extra-two")] == 1110, "its new poses")
    stub.DeleteVehicle(api.DeleteVehicleRequest(name=name_of("extra-two")))
    wait_until(lambda: name_of("extra-two") not in searched(), "that it is gone")
    make_vehicle(stub, drive, "three", prefix="extra-")
    add_member(stub, site, name_of("extra-three"), datum_of(FRAMES["three"]))
    wait_until(lambda: name_of("extra-three") in searched(), "another member")
    remove_member(stub, f"{site}/members/extra-three")
    wait_until(lambda: name_of("extra-three") not in searched(),
               "that it has left")
