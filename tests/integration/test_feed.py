"""Candidates that are stored, told once, and never lost: against kill -9, restored
stores, and other tenants."""

import random
import shutil
import threading
import time

import grpc
import pytest

from drive_client import create
from revisit_server import Server, wait_until
from stubs import api
from watching import (Watcher, expect_each_check_once, list_checks,
                      wait_until_paid)
from wire import (LOOP_CLOSURES, REJECTED_CANDIDATES, append, boreas, failure_of,
                  get, laps)

BY_VALUE = api.LIST_CHECKS_ORDER_BY_VALUE
STORING = {"checks": api.STORED_CHECKS_STORED}
# Short, so that many checks are due.
SHORT = {"sequence_length_meters": 20.0, "check_interval_meters": 10.0,
         "node_spacing_meters": 1.0}


def watch(stub, cursor="", **filters):
    return stub.WatchCandidates(api.WatchCandidatesRequest(
        cursor=cursor, filter=api.CandidateFilter(**filters)))


def take(call, count):
    """The next events, without beats."""
    events = []
    for answer in call:
        if answer.WhichOneof("event") != "beat":
            events.append(answer)
            if len(events) == count:
                return events
    raise AssertionError(f"the watch ended after {len(events)} events")


def take_decided(call):
    """The next event that is not of a second search."""
    while True:
        event = take(call, 1)[0].candidate
        if event.candidate.cause != api.CANDIDATE_CAUSE_SEARCH:
            return event


@pytest.fixture
def lap(new_vehicle, stub):
    """A vehicle that has driven the same lap twice, with all checks stored."""
    vehicle = new_vehicle(**STORING, **SHORT)
    append(stub, vehicle, laps(760))
    wait_until_paid(stub, vehicle)
    return vehicle


def test_checks_are_made_once_and_told_once_however_often_server_is_killed(
        tmp_path, request, seed):
    kills = request.config.getoption("--kills")
    rng = random.Random(seed)
    store = tmp_path / "store"
    addresses = []
    poses, _ = boreas()
    vehicles = ["vehicles/a", "vehicles/b"]
    with Server(store) as server:
        for vehicle in vehicles:
            create(server.stub(), vehicle, **STORING)
        addresses[:] = [server.address]
        watchers = [Watcher(lambda: list(addresses), seed + n) for n in range(2)]
        for watcher in watchers:
            assert watcher.begun.wait(30)
    sent = dict.fromkeys(vehicles, 0)
    step = max(1, len(poses) // kills)
    for _ in range(kills):
        with Server(store) as server:
            addresses[:] = [server.address]
            stub = server.stub()
            for vehicle in vehicles:
                sent[vehicle] = get(stub, vehicle).durable_sequence
                batch = poses[sent[vehicle]:sent[vehicle] + step]
                if batch:
                    append(stub, vehicle, batch)
            # Before, within or after the checks of these poses.
            time.sleep(rng.choice([0.0, rng.uniform(0.0, 0.02),
                                   rng.uniform(0.0, 0.3)]))
            server.kill()
    with Server(store) as server:
        addresses[:] = [server.address]
        stub = server.stub()
        for vehicle in vehicles:
            rest = poses[get(stub, vehicle).durable_sequence:]
            if rest:
                append(stub, vehicle, rest)
            wait_until_paid(stub, vehicle)
        total = sum(len(check.states) for check in list_checks(stub)[0])
        for watcher in watchers:
            wait_until(lambda w=watcher: w.failure or sum(
                map(len, w.told.values())) >= total, "all events")
            watcher.stop()
            assert watcher.failure is None, watcher.failure
        for vehicle in vehicles:
            uid = get(stub, vehicle).uid
            assert watchers[0].told[uid] == watchers[1].told[uid]
            due, kept = expect_each_check_once(stub, vehicle,
                                               watchers[0].told[uid])
            assert kept > 100
            print(f"{vehicle}: {due} checks due, {kept} kept")
    print(f"{kills} kills, {total} events, watchers broken off "
          f"{[w.breaks for w in watchers]} times, events told again "
          f"{[w.repeated for w in watchers]}")


def test_a_list_and_a_watch_from_its_cursor_leave_nothing_out(stub, new_vehicle):
    vehicle = new_vehicle(**STORING, **SHORT)
    poses = laps(760)
    append(stub, vehicle, poses[:500])
    appending = threading.Thread(target=lambda: [
        append(stub, vehicle, poses[n:n + 20]) for n in range(500, 760, 20)])
    appending.start()
    checks, cursor = list_checks(stub, vehicle)
    appending.join()
    wait_until_paid(stub, vehicle)
    everything = {state.name: state.event_number
                  for check in list_checks(stub, vehicle)[0]
                  for state in check.states}
    assert len(everything) > 20
    seen = {state.name for check in checks for state in check.states}
    call = watch(stub, cursor, vehicles=[vehicle])
    while len(seen) < len(everything):
        event = take(call, 1)[0].candidate
        assert everything[event.candidate.name] == event.number
        assert event.vehicle_uid == get(stub, vehicle).uid
        seen.add(event.candidate.name)
    call.cancel()
    assert seen == everything.keys()


@pytest.mark.parametrize("kind", [LOOP_CLOSURES, REJECTED_CANDIDATES], ids=str)
def test_a_decision_changes_the_candidates_at_its_places_until_it_is_deleted(
        stub, lap, kind):
    check = list_checks(stub, lap)[0][-1]
    best = check.candidates.candidates[check.states[0].rank - 1]
    _, cursor = list_checks(stub, lap)
    call = watch(stub, cursor, vehicles=[lap])
    added, _ = kind.add(stub, lap, best.query.sequence, best.matched.sequence)
    told = []
    while check.states[0].name not in [event.candidate.name for event in told]:
        told.append(take_decided(call))
    state = (api.CANDIDATE_STATE_CONFIRMED if kind is LOOP_CLOSURES
             else api.CANDIDATE_STATE_REJECTED)
    assert {event.candidate.state for event in told} == {state}
    assert {event.candidate.decision for event in told} == {added.name}
    assert told[-1].evidence == best or best in [event.evidence for event in told]
    stored = stub.GetCheck(api.GetCheckRequest(name=check.name)).check
    assert stored.states[0].state == state
    assert stored.states[0].decision == added.name
    # Only those that are open, or only others.
    for states, expected in (([api.CANDIDATE_STATE_OPEN], False), ([state], True)):
        names = [one.name for one in list_checks(
            stub, lap, filter=api.CandidateFilter(states=states))[0]]
        assert (check.name in names) == expected or len(stored.states) > 1
    before = {event.candidate.name for event in told}
    kind.delete(stub, added.name)
    again = [take_decided(call) for _ in before]
    call.cancel()
    assert {event.candidate.name for event in again} == before
    assert {(event.candidate.state, event.candidate.cause) for event in again} == {
        (api.CANDIDATE_STATE_OPEN, api.CANDIDATE_CAUSE_DELETION)}


def test_a_verifier_names_the_candidate_that_it_answers(stub, lap):
    check = list_checks(stub, lap)[0][0]
    name = check.states[0].name
    # Its poses are far from the candidate's.
    request = LOOP_CLOSURES.request(lap, 700, 100)
    request.candidate = name
    closure = stub.AddLoopClosure(request).loop_closure
    stored = stub.GetCheck(api.GetCheckRequest(name=check.name)).check
    assert stored.states[0].decision == closure.name
    assert stored.states[0].event_number > check.states[0].event_number
    # The same again, as after a lost answer.
    assert stub.AddLoopClosure(request).loop_closure == closure
    assert stub.GetCheck(api.GetCheckRequest(name=check.name)).check == stored
    # It may answer another one as well.
    other = next(check for check in reversed(list_checks(stub, lap)[0])
                 if check.states[0].state == api.CANDIDATE_STATE_OPEN)
    request.candidate = other.states[0].name
    assert stub.AddLoopClosure(request).loop_closure == closure
    stored = stub.GetCheck(api.GetCheckRequest(name=other.name)).check
    assert (stored.states[0].state, stored.states[0].decision) == (
        api.CANDIDATE_STATE_CONFIRMED, closure.name)


@pytest.mark.parametrize("candidate, code, reason", [
    ("{vehicle}/checks/1/candidates/1", grpc.StatusCode.NOT_FOUND,
     "CHECK_NOT_FOUND"),
    ("{check}/candidates/99", grpc.StatusCode.NOT_FOUND, "CHECK_NOT_FOUND"),
    ("{check}/candidates/0", grpc.StatusCode.INVALID_ARGUMENT,
     "INVALID_RESOURCE_NAME"),
    ("{check}", grpc.StatusCode.INVALID_ARGUMENT, "INVALID_RESOURCE_NAME"),
    ("vehicles/another/checks/9/candidates/1", grpc.StatusCode.INVALID_ARGUMENT,
     "INVALID_FIELD"),
])
@pytest.mark.parametrize("kind", [LOOP_CLOSURES, REJECTED_CANDIDATES], ids=str)
def test_a_candidate_that_is_not_there_cannot_be_answered(
        stub, lap, kind, candidate, code, reason):
    check = list_checks(stub, lap)[0][0]
    request = kind.request(lap, 700, 100)
    request.candidate = candidate.format(vehicle=lap, check=check.name)
    failure = failure_of(lambda: kind.call_add(stub, request))
    assert (failure.code, failure.reason) == (code, reason)
    # Nothing half: neither the pair nor a change of a candidate.
    assert kind.page(stub, lap)[0] == []
    assert list_checks(stub, lap)[0][0] == check


def test_what_a_caller_gets_wrong_is_said(stub, lap):
    for call, field in (
            (lambda: stub.GetCheck(api.GetCheckRequest(name=lap)), "name"),
            (lambda: stub.GetCheck(api.GetCheckRequest(
                name=f"{lap}/checks/007")), "name"),
            (lambda: stub.ListChecks(api.ListChecksRequest(parent="x")), "parent"),
            (lambda: stub.ListChecks(api.ListChecksRequest(
                parent=lap, filter=api.CandidateFilter(least_probability=2))),
             "filter.least_probability"),
            (lambda: stub.ListChecks(api.ListChecksRequest(
                parent=lap, filter=api.CandidateFilter(states=[0]))),
             "filter.states[0]"),
            (lambda: stub.ListChecks(api.ListChecksRequest(
                parent=lap, filter=api.CandidateFilter(
                    least_value_square_meters=-1))),
             "filter.least_value_square_meters"),
            (lambda: stub.ListChecks(api.ListChecksRequest(
                parent="vehicles/-", order=BY_VALUE)), "order"),
            (lambda: stub.ListChecks(api.ListChecksRequest(
                parent=lap, order=9)), "order"),
            (lambda: stub.ListChecks(api.ListChecksRequest(
                parent=lap, looks_per_kilometer=3)), "looks_per_kilometer"),
            (lambda: stub.ListChecks(api.ListChecksRequest(
                parent=lap, order=BY_VALUE, looks_per_kilometer=1001)),
             "looks_per_kilometer"),
            (lambda: stub.ListChecks(api.ListChecksRequest(
                parent=lap, page_token="no")), "page_token"),
            (lambda: next(watch(stub, "no")), "cursor"),
            (lambda: next(watch(stub, vehicles=["no"])), "filter.vehicles[0]"),
            (lambda: next(watch(stub, verdicts=[77])), "filter.verdicts[0]"),
            (lambda: create(stub, "vehicles/never", keep_probability=1.5),
             "vehicle.settings.keep_probability"),
            (lambda: create(stub, "vehicles/never", checks=9),
             "vehicle.settings.checks")):
        failure = failure_of(call)
        assert failure.code == grpc.StatusCode.INVALID_ARGUMENT
        assert failure.fields == [field]
    for name, reason in ((f"{lap}/checks/3", "CHECK_NOT_FOUND"),
                         ("vehicles/none/checks/3", "VEHICLE_NOT_FOUND")):
        failure = failure_of(
            lambda n=name: stub.GetCheck(api.GetCheckRequest(name=n)))
        assert (failure.code, failure.reason) == (
            grpc.StatusCode.NOT_FOUND, reason)


def test_pages_of_all_vehicles_checks_hold_each_once(stub, lap, new_vehicle):
    other = new_vehicle(**STORING, **SHORT)
    append(stub, other, laps(760))
    wait_until_paid(stub, other)
    names, token = [], ""
    while True:
        page = stub.ListChecks(api.ListChecksRequest(
            parent="vehicles/-", page_size=7, page_token=token))
        names += [check.name for check in page.checks]
        assert bool(page.watch_cursor) == (token == "")
        token = page.next_page_token
        if not token:
            break
    assert len(names) == len(set(names))
    by_vehicle = {}
    for name in names:
        by_vehicle.setdefault(name.rsplit("/", 2)[0], []).append(name)
    assert list(by_vehicle) == sorted(by_vehicle)
    for vehicle in (lap, other):
        assert by_vehicle[vehicle] == [
            check.name for check in list_checks(stub, vehicle)[0]]


def test_a_deleted_vehicle_is_told_and_its_candidates_are_gone(stub, lap):
    _, cursor = list_checks(stub, lap)
    first = watch(stub, cursor)
    uid = get(stub, lap).uid
    stub.DeleteVehicle(api.DeleteVehicleRequest(name=lap))
    deleted = take(first, 1)[0].vehicle_deleted
    first.cancel()
    assert (deleted.vehicle, deleted.vehicle_uid) == (lap, uid)
    assert list_checks(stub)[0] == [] or all(
        not check.name.startswith(lap + "/") for check in list_checks(stub)[0])
    # Who read up to there before goes on behind it.
    again = watch(stub, cursor)
    assert take(again, 1)[0].vehicle_deleted == deleted
    again.cancel()


def test_a_cursor_of_a_store_that_was_set_back_is_refused(tmp_path):
    store, copy = tmp_path / "store", tmp_path / "copy"
    with Server(store) as server:
        create(server.stub(), "vehicles/a", **STORING, **SHORT)
    shutil.copytree(store, copy)
    with Server(store) as server:
        stub = server.stub()
        append(stub, "vehicles/a", laps(760))
        wait_until_paid(stub, "vehicles/a")
        _, cursor = list_checks(stub)
    with Server(copy) as server:
        stub = server.stub()
        failure = failure_of(lambda: next(watch(stub, cursor)))
        assert (failure.code, failure.reason) == (
            grpc.StatusCode.OUT_OF_RANGE, "CURSOR_UNKNOWN")
        # From the list and its cursor on, it has all.
        append(stub, "vehicles/a", laps(400))
        checks, cursor = list_checks(stub)
        append(stub, "vehicles/a", laps(360, first=401))
        wait_until_paid(stub, "vehicles/a")
        seen = {state.name for check in checks for state in check.states}
        wanted = {state.name for check in list_checks(stub)[0]
                  for state in check.states}
        call = watch(stub, cursor)
        while seen != wanted:
            seen.add(take(call, 1)[0].candidate.candidate.name)
        call.cancel()


def test_a_server_may_store_checks_of_new_vehicles_by_default(tmp_path):
    with Server(tmp_path / "store", "--default-checks=stored") as server:
        stub = server.stub()
        assert create(stub, "vehicles/a").settings.checks == \
            api.STORED_CHECKS_STORED
        asked = create(stub, "vehicles/b", checks=api.STORED_CHECKS_ON_REQUEST)
        assert asked.settings.checks == api.STORED_CHECKS_ON_REQUEST
        # Again is once.
        assert create(stub, "vehicles/a").uid == get(stub, "vehicles/a").uid


def test_a_drained_server_ends_watches_so_that_they_go_on_elsewhere(tmp_path):
    with Server(tmp_path / "store") as server:
        call = watch(server.stub())
        assert next(call).WhichOneof("event") == "beat"
        server.process.terminate()
        failure = failure_of(lambda: list(call))
        assert (failure.code, failure.reason) == (
            grpc.StatusCode.UNAVAILABLE, "SERVER_DRAINING")
