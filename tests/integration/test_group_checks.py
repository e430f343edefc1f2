"""Stored checks that search in the histories of a group's vehicles: found once, told
once, and told only to those who may know of the other vehicle."""

import contextlib

import grpc
import pytest
from google.protobuf import field_mask_pb2

from grouping import (add_link, add_member, create_group, delete_group, delete_link,
                      delete_rejected, reject, remove_member)
from own_postgres import own_postgres
from private_cluster import find_postgres
from revisit_server import Server, run, wait_until, wait_until_none_left
from stubs import api
from test_group_search import FRAMES, PARTS, datum_of, moved, ready, search
from watching import list_checks, wait_until_paid, without_times
from wire import append, batches, boreas, failure_of, get

pytest_plugins = ("caller_identities",)

# The one that is checked, and the one in whose history it is checked too.
CHECKED, OTHER = "one", "two"
HALF = 1000


@pytest.fixture(name="drive", scope="module")
def fixture_drive():
    return boreas()[0]


def name_of(vehicle, prefix=""):
    return f"vehicles/{prefix}{vehicle}"


def poses_of(drive, vehicle):
    first, last = PARTS[vehicle]
    return moved(drive[first:last], FRAMES[vehicle])


def send(stub, vehicle, poses):
    for batch in batches(poses, 256):
        append(stub, vehicle, batch)


def make_pair(stub, drive, prefix="", **settings):
    """The vehicle that is checked, without poses, and the group."""
    stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id=prefix + OTHER))
    send(stub, name_of(OTHER, prefix), poses_of(drive, OTHER))
    group = create_group(stub, f"{prefix}site").name
    settings.setdefault("check_group", group)
    checked = stub.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id=prefix + CHECKED, vehicle=api.Vehicle(
            settings=api.VehicleSettings(checks=api.STORED_CHECKS_STORED,
                                         **settings)))).vehicle.name
    for vehicle in (OTHER, CHECKED):
        add_member(stub, group, name_of(vehicle, prefix), datum_of(FRAMES[vehicle]))
    return checked, group


def told_since(stub, cursor, count, **filters):
    events = []
    for answer in stub.WatchCandidates(api.WatchCandidatesRequest(
            cursor=cursor, filter=api.CandidateFilter(**filters)), timeout=60):
        if answer.WhichOneof("event") == "candidate":
            events.append(answer.candidate)
        if len(events) == count:
            return events
    raise AssertionError(f"the watch ended after {len(events)} events")


def evidence_of(check, state):
    return next(one for one in check.candidates.candidates if one.rank == state.rank)


def sequence_of(check):
    return int(check.name.split("/")[-1])


def in_other(checks):
    """(check, state, evidence) of the candidates in the history of another."""
    return [(check, state, evidence_of(check, state)) for check in checks
            for state in check.states if evidence_of(check, state).matched_vehicle]


def as_found(found):
    """Without what depends on when it was found."""
    copy = without_times(found)
    for searched in copy.searched:
        searched.ClearField("lag")
    return copy


def expect_found_and_told_once(stub, checked, group, cursor):
    checks, _ = list_checks(stub, checked)
    assert in_other(checks)
    for check in checks:
        found = ready(lambda sequence=sequence_of(check): search(
            stub, checked.split("/")[1], sequence, group))
        assert as_found(check.candidates) == as_found(found), check.name
        assert [each.vehicle for each in check.candidates.searched] == [
            name_of(OTHER)]
    for _, state, evidence in in_other(checks):
        assert evidence.matched_vehicle_uid == get(
            stub, evidence.matched_vehicle).uid
        assert state.value_square_meters == 0.0
        assert state.state == api.CANDIDATE_STATE_OPEN
    count = sum(len(check.states) for check in checks)
    events = told_since(stub, cursor, count)
    assert [event.number for event in events] == list(range(1, count + 1))
    assert {event.candidate.name for event in events} == {
        state.name for check in checks for state in check.states}
    assert {(event.candidate.name, event.evidence.matched_vehicle)
            for event in events if event.evidence.matched_vehicle} == {
        (state.name, evidence.matched_vehicle)
        for _, state, evidence in in_other(checks)}


def first_cursor(stub):
    return stub.ListChecks(api.ListChecksRequest(parent="vehicles/-")).watch_cursor


@contextlib.contextmanager
def shared_store():
    with own_postgres() as postgres:
        migrated = run("revisitd", "migrate", "--store",
                       postgres.url("revisit_owner"))
        assert migrated.returncode == 0, migrated.stderr
        yield postgres.url("revisit"), ["--advertise-address", "host:1"]


@contextlib.contextmanager
def store_of(engine, directory):
    if engine == "sqlite":
        yield directory / "store", []
        return
    if find_postgres() is None:
        pytest.skip("there is no PostgreSQL")
    with shared_store() as shared:
        yield shared


@pytest.mark.parametrize("engine", ["sqlite", "postgresql"])
def test_checks_find_places_in_the_histories_of_others_once(tmp_path, drive, engine):
    with store_of(engine, tmp_path) as (store, flags):
        poses = poses_of(drive, CHECKED)
        with Server(store, *flags, log_path=tmp_path / "first.log") as server:
            stub = server.stub()
            checked, group = make_pair(stub, drive)
            cursor = first_cursor(stub)
            send(stub, checked, poses[:HALF])
            wait_until_paid(stub, checked)
            assert in_other(list_checks(stub, checked)[0])
        # The other one's history has to be read from the store first: the checks wait
        # for that, and the acknowledgements do not.
        with Server(store, *flags, log_path=tmp_path / "second.log") as server:
            stub = server.stub()
            send(stub, checked, poses[HALF:])
            wait_until_paid(stub, checked)
            expect_found_and_told_once(stub, checked, group, cursor)


def state_of(stub, name):
    check = stub.GetCheck(api.GetCheckRequest(name=name.split("/candidates/")[0])).check
    return next(state for state in check.states if state.name == name)


def wait_for_state(stub, name, state, cause):
    wait_until(lambda: (state_of(stub, name).state, state_of(stub, name).cause)
               == (state, cause), f"{name} comes into state {state}")
    return state_of(stub, name)


def told_of(stub, cursor, name):
    """What was told of a candidate, up to its last event."""
    check = name.split("/candidates/")[0]
    last = state_of(stub, name).event_number
    told = []
    for answer in stub.WatchCandidates(api.WatchCandidatesRequest(
            cursor=cursor), timeout=60):
        event = answer.candidate
        if answer.WhichOneof("event") != "candidate" or event.check != check:
            continue
        if event.candidate.name == name:
            told.append((event.candidate.state, event.candidate.cause))
            if event.number == last:
                return told
    raise AssertionError("the watch ended")


OPEN = (api.CANDIDATE_STATE_OPEN, api.CANDIDATE_CAUSE_CHECK)
CONFIRMED = (api.CANDIDATE_STATE_CONFIRMED, api.CANDIDATE_CAUSE_LOOP_CLOSURE)
REJECTED = (api.CANDIDATE_STATE_REJECTED, api.CANDIDATE_CAUSE_REJECTION)
UNDONE = (api.CANDIDATE_STATE_OPEN, api.CANDIDATE_CAUSE_DELETION)
GONE = (api.CANDIDATE_STATE_WITHDRAWN, api.CANDIDATE_CAUSE_RETENTION)


def is_undecided(check):
    return any(state.state == api.CANDIDATE_STATE_OPEN for state in check.states)


def expect_searched_again_behind(stub, checked, group, sequence):
    """The checks from a pose on, and no others, come to hold what is found now."""
    def behind():
        return [check for check in list_checks(stub, checked)[0]
                if sequence_of(check) >= sequence and is_undecided(check)]

    wait_until_none_left(
        lambda: sum(not check.HasField("latest") for check in behind()),
        "checks behind the link")
    assert behind()
    for check in behind():
        found = ready(lambda sequence=sequence_of(check): search(
            stub, checked.split("/")[1], sequence, group))
        assert as_found(check.latest) == as_found(found), check.name
    assert not any(check.HasField("latest")
                   for check in list_checks(stub, checked)[0]
                   if sequence_of(check) < sequence)


def checked_pair(stub, drive):
    """A vehicle whose checks were made in the history of another one, their group, and
    a cursor from before the checks."""
    checked, group = make_pair(stub, drive)
    cursor = first_cursor(stub)
    send(stub, checked, poses_of(drive, CHECKED))
    wait_until_paid(stub, checked)
    return checked, group, cursor


def test_links_decide_on_what_was_found_once_and_until_they_go(tmp_path, drive):
    store = tmp_path / "store"
    with Server(store, log_path=tmp_path / "first.log") as server:
        stub = server.stub()
        checked, group, cursor = checked_pair(stub, drive)
        found = in_other(list_checks(stub, checked)[0])
        # Far from each other along both paths.
        (_, tied, tied_evidence), (_, denied, denied_evidence) = (
            found[len(found) // 2], found[-1])
        link = add_link(stub, group, (tied_evidence.matched_vehicle,
                                      tied_evidence.matched.sequence),
                        (checked, tied_evidence.query.sequence),
                        link_id="tie").loop_closure.name
        rejection = reject(stub, group, (checked, denied_evidence.query.sequence),
                           (denied_evidence.matched_vehicle,
                            denied_evidence.matched.sequence),
                           rejected_id="tie").rejected_candidate.name
        decided = wait_for_state(stub, tied.name, *CONFIRMED)
        assert decided.decision == link == f"{group}/loopClosures/tie"
        assert told_of(stub, cursor, tied.name) == [OPEN, CONFIRMED]
        decided = wait_for_state(stub, denied.name, *REJECTED)
        assert decided.decision == rejection
        # Those elsewhere stay open.
        assert any(state.state == api.CANDIDATE_STATE_OPEN for _, state, _
                   in in_other(list_checks(stub, checked)[0]))
        expect_searched_again_behind(stub, checked, group,
                                     tied_evidence.query.sequence)
    with Server(store, log_path=tmp_path / "second.log") as server:
        stub = server.stub()
        get(stub, checked)
        delete_link(stub, link)
        delete_rejected(stub, rejection)
        for name in (tied.name, denied.name):
            decided = wait_for_state(stub, name, *UNDONE)
            assert not decided.decision
        remove_member(stub, f"{group}/members/{OTHER}")
        for name, state in ((tied.name, CONFIRMED), (denied.name, REJECTED)):
            wait_for_state(stub, name, *GONE)
            assert told_of(stub, cursor, name) == [OPEN, state, UNDONE, GONE]


def search_in(stub, checked, group):
    stub.UpdateVehicle(api.UpdateVehicleRequest(
        vehicle=api.Vehicle(name=checked, settings=api.VehicleSettings(
            check_group=group)),
        update_mask=field_mask_pb2.FieldMask(paths=["settings.check_group"])))


def test_the_group_in_which_it_was_found_decides_whichever_is_searched_since(
        tmp_path, drive):
    store = tmp_path / "store"
    with Server(store, log_path=tmp_path / "first.log") as server:
        stub = server.stub()
        checked, group, cursor = checked_pair(stub, drive)
        checks = list_checks(stub, checked)[0]
        for check in checks:
            for state in check.states:
                is_own = not evidence_of(check, state).matched_vehicle
                assert state.group == ("" if is_own else group)
        for event in told_since(stub, cursor, sum(len(check.states)
                                                  for check in checks)):
            assert event.candidate.group == (
                group if event.evidence.matched_vehicle else "")
        found = in_other(checks)
        (_, tied, evidence), (_, unsaid, elsewhere) = found[len(found) // 2], found[-1]
        ends = ((evidence.matched_vehicle, evidence.matched.sequence),
                (checked, evidence.query.sequence))
        another = create_group(stub, "another").name
        for vehicle in (OTHER, CHECKED):
            add_member(stub, another, name_of(vehicle), datum_of(FRAMES[vehicle]))
        search_in(stub, checked, another)
        # Another group speaks about what was found there.
        add_link(stub, another, (elsewhere.matched_vehicle,
                                 elsewhere.matched.sequence),
                 (checked, elsewhere.query.sequence))
        link = add_link(stub, group, *ends).loop_closure.name
        assert wait_for_state(stub, tied.name, *CONFIRMED).decision == link
        assert state_of(stub, unsaid.name).state != api.CANDIDATE_STATE_CONFIRMED
    # Whoever loads the vehicle finds the group by its candidates, also where none
    # is searched.
    with Server(store, log_path=tmp_path / "second.log") as server:
        stub = server.stub()
        search_in(stub, checked, "")
        delete_link(stub, link)
        assert not wait_for_state(stub, tied.name, *UNDONE).decision
        rejection = reject(stub, group, *reversed(ends)).rejected_candidate.name
        decided = wait_for_state(stub, tied.name, *REJECTED)
        assert (decided.decision, decided.group) == (rejection, group)


def test_without_a_membership_the_own_history_alone_is_searched(tmp_path, drive):
    with Server(tmp_path / "store") as server:
        stub = server.stub()
        plain = stub.CreateVehicle(api.CreateVehicleRequest(
            vehicle_id="plain", vehicle=api.Vehicle(settings=api.VehicleSettings(
                checks=api.STORED_CHECKS_STORED)))).vehicle.name
        checked, group = make_pair(stub, drive)
        remove_member(stub, f"{group}/members/{CHECKED}")
        poses = poses_of(drive, CHECKED)
        for vehicle in (plain, checked):
            send(stub, vehicle, poses[:HALF])
            wait_until_paid(stub, vehicle)
        delete_group(stub, group)
        for vehicle in (plain, checked):
            send(stub, vehicle, poses[HALF:])
            wait_until_paid(stub, vehicle)

        def texts(vehicle):
            return [str(without_times(check.candidates)).replace(vehicle, "it")
                    for check in list_checks(stub, vehicle)[0]]

        assert texts(plain)
        assert texts(checked) == texts(plain)


def test_a_group_beyond_the_limit_of_steps_finds_nothing(tmp_path, drive):
    with Server(tmp_path / "store", "--max-search-steps", 1000) as server:
        stub = server.stub()
        checked, _ = make_pair(stub, drive)
        send(stub, checked, poses_of(drive, CHECKED)[:HALF])
        wait_until_paid(stub, checked)
        assert not list_checks(stub, checked)[0]


def test_who_may_not_read_the_other_vehicle_is_told_nothing_of_it(
        token_server, called_by, drive):
    everyone = called_by("acme")
    # "acme-few" may read acme-1* alone.
    other = everyone.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id="acme-2-van")).vehicle.name
    send(everyone, other, poses_of(drive, OTHER))
    group = create_group(everyone, "acme-1-site").name
    checked = everyone.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id="acme-1-truck", vehicle=api.Vehicle(
            settings=api.VehicleSettings(checks=api.STORED_CHECKS_STORED,
                                         check_group=group)))).vehicle.name
    add_member(everyone, group, other, datum_of(FRAMES[OTHER]))
    add_member(everyone, group, checked, datum_of(FRAMES[CHECKED]))
    cursor = first_cursor(everyone)
    send(everyone, checked, poses_of(drive, CHECKED))
    wait_until_paid(everyone, checked)

    few = called_by("acme-few")
    checks, _ = list_checks(everyone, checked)
    hidden = {state.name for _, state, _ in in_other(checks)}
    assert hidden
    seen = [state for check in checks for state in check.states
            if state.name not in hidden]
    assert seen
    for order in (api.LIST_CHECKS_ORDER_UNSPECIFIED, api.LIST_CHECKS_ORDER_BY_VALUE):
        shown, _ = list_checks(few, checked, order=order)
        assert "acme-2-van" not in str(shown)
        assert sorted(state.name for check in shown for state in check.states) == (
            sorted(state.name for state in seen))
    assert "acme-2-van" not in str(list_checks(few)[0])
    for check in checks:
        request = api.GetCheckRequest(name=check.name)
        left = [state for state in check.states if state.name not in hidden]
        if left:
            shown = few.GetCheck(request).check
            assert list(shown.states) == left
            assert "acme-2-van" not in str(shown)
        else:
            failure = failure_of(lambda request=request: few.GetCheck(request))
            assert failure.reason == "CHECK_NOT_FOUND"
    told = told_since(few, cursor, len(seen))
    assert {event.candidate.name for event in told} == {
        state.name for state in seen}
    assert "acme-2-van" not in str(told)


def test_who_sets_the_group_may_read_it_and_both_are_of_one_tenant(called_by):
    acme, operator = called_by("acme"), called_by("op", groups=["operators"])
    group = create_group(acme, "acme-9-site").name
    foreign = create_group(called_by("umbra"), "umbra-9-site").name

    def creating(caller, vehicle_id, asked):
        return failure_of(lambda: caller.CreateVehicle(api.CreateVehicleRequest(
            vehicle_id=vehicle_id, vehicle=api.Vehicle(
                settings=api.VehicleSettings(check_group=asked)))))

    vehicle = acme.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id="acme-9-truck")).vehicle.name

    def setting(caller, asked, path="settings.check_group"):
        return caller.UpdateVehicle(api.UpdateVehicleRequest(
            vehicle=api.Vehicle(name=vehicle, settings=api.VehicleSettings(
                check_group=asked)),
            update_mask=field_mask_pb2.FieldMask(paths=[path]))).vehicle

    # One that is not there says the same as one that is not known to the caller.
    for unknown in (foreign, "groups/umbra-8-site"):
        created = creating(acme, "acme-9-no", unknown)
        assert (created.code, created.reason) == (
            grpc.StatusCode.PERMISSION_DENIED, "NOT_GRANTED")
        changed = failure_of(lambda asked=unknown: setting(acme, asked))
        assert (changed.code, changed.reason) == (
            grpc.StatusCode.NOT_FOUND, "GROUP_NOT_FOUND")
    # A caller of both tenants may not mix them.
    for failure in (creating(operator, "acme-9-no", foreign),
                    failure_of(lambda: setting(operator, foreign))):
        assert (failure.code, failure.reason) == (
            grpc.StatusCode.INVALID_ARGUMENT, "INVALID_FIELD")
        assert failure.violations[0][0] == "vehicle.settings.check_group"
    # Who may write and not read.
    failure = failure_of(lambda: setting(called_by("acme-writer"), group))
    assert (failure.code, failure.reason) == (
        grpc.StatusCode.PERMISSION_DENIED, "NOT_GRANTED")
    assert get(acme, vehicle).settings.check_group == ""
    assert setting(acme, group).settings.check_group == group
    # Who changes other settings leaves it as it is.
    called_by("acme-writer").UpdateVehicle(api.UpdateVehicleRequest(
        vehicle=api.Vehicle(name=vehicle, settings=api.VehicleSettings(
            max_candidates=3)),
        update_mask=field_mask_pb2.FieldMask(paths=["settings.max_candidates"])))
    assert get(acme, vehicle).settings.check_group == group
    setting(called_by("acme-writer"), "")
    assert not get(acme, vehicle).settings.HasField("check_group")
    malformed = failure_of(lambda: setting(acme, "site"))
    assert malformed.code == grpc.StatusCode.INVALID_ARGUMENT
    assert malformed.violations[0][0] == "vehicle.settings.check_group"
