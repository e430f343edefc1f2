"""Stored checks are searched again when something changes that they depend on: what
is told then, the order by value, and closures that contradict others."""

import math
import random
import time

import pytest

from drive_client import create
from revisit_server import Server, wait_until
from stubs import api
from watching import (Watcher, change_pairs, expect_states_follow, list_checks,
                      wait_until_as_searched_now, wait_until_settled)
from wire import LOOP_CLOSURES, append, boreas, get, laps

STORING = {"checks": api.STORED_CHECKS_STORED}
SHORT = {"sequence_length_meters": 20.0, "check_interval_meters": 10.0,
         "node_spacing_meters": 1.0}
BY_VALUE = api.LIST_CHECKS_ORDER_BY_VALUE
OPEN = api.CANDIDATE_STATE_OPEN


def drifting_laps(count):
    """Laps of dead reckoning whose positions become less sure with every metre."""
    poses = laps(count)
    for each in poses:
        variance = 0.01 + 0.002 * each.sequence
        del each.covariance.values[:]
        each.covariance.values.extend([variance, 0, 0, variance, 0, 1e-6])
    return poses


@pytest.fixture
def lap(new_vehicle, stub):
    """A vehicle that has driven the same lap three times, with all checks stored."""
    vehicle = new_vehicle(**STORING, **SHORT)
    append(stub, vehicle, drifting_laps(1140))
    wait_until_settled(stub, vehicle)
    return vehicle


def test_checks_end_as_searches_find_them_however_often_server_is_killed(
        tmp_path, request, seed):
    kills = request.config.getoption("--kills")
    rng = random.Random(seed)
    store = tmp_path / "store"
    poses, _ = boreas()
    vehicle = "vehicles/a"
    addresses = []
    with Server(store) as server:
        create(server.stub(), vehicle, **STORING)
        addresses[:] = [server.address]
        watcher = Watcher(lambda: list(addresses), seed)
        assert watcher.begun.wait(30)
    pairs = []
    step = max(1, len(poses) // kills)
    for _ in range(kills):
        with Server(store) as server:
            addresses[:] = [server.address]
            stub = server.stub()
            sent = get(stub, vehicle).durable_sequence
            if poses[sent:sent + step]:
                append(stub, vehicle, poses[sent:sent + step])
            change_pairs(stub, vehicle, rng, pairs)
            # Before, within or after the searches that follow.
            time.sleep(rng.choice([0.0, rng.uniform(0.0, 0.02),
                                   rng.uniform(0.0, 0.3)]))
            server.kill()
    with Server(store) as server:
        addresses[:] = [server.address]
        stub = server.stub()
        rest = poses[get(stub, vehicle).durable_sequence:]
        if rest:
            append(stub, vehicle, rest)
        wait_until_settled(stub, vehicle)
        again = wait_until_as_searched_now(stub, vehicle)
        while again == 0:
            # Each server was killed before it had stored a check.
            change_pairs(stub, vehicle, rng, pairs)
            wait_until_settled(stub, vehicle)
            again = wait_until_as_searched_now(stub, vehicle)
        last = max(state.event_number for check in list_checks(stub, vehicle)[0]
                   for state in check.states)
        uid = get(stub, vehicle).uid
        wait_until(lambda: watcher.failure or len(watcher.told[uid]) >= last,
                   "all events")
        watcher.stop()
        assert watcher.failure is None, watcher.failure
        expect_states_follow(stub, vehicle, watcher.told[uid])
    print(f"{kills} kills, {again} checks searched again, {len(pairs)} pairs, "
          f"{last} events")


def best_of(check):
    return max((state.value_square_meters for state in check.states
                if state.state == OPEN), default=-1.0)


def test_the_list_by_value_is_that_by_time_in_another_order(stub, lap):
    by_time = list_checks(stub, lap)[0]
    by_value = list_checks(stub, lap, order=BY_VALUE, page_size=3)[0]
    assert {check.name: check for check in by_value} == {
        check.name: check for check in by_time}
    values = [best_of(check) for check in by_value]
    assert values == sorted(values, reverse=True)
    assert values[0] > 0.0
    # What is closed is worth less than before.
    best = by_value[0]
    state = max((state for state in best.states if state.state == OPEN),
                key=lambda state: state.value_square_meters)
    candidate = next(one for one in best.candidates.candidates
                     if one.rank == state.rank)
    LOOP_CLOSURES.add(stub, lap, candidate.query.sequence,
                      candidate.matched.sequence)
    wait_until(lambda: best_of(list_checks(stub, lap, order=BY_VALUE)[0][0])
               < 0.7 * values[0], "values after the closure")


def test_so_many_looks_are_recommended_of_each_kilometer(stub, lap):
    for looks in (0, 1, 3):
        chosen, others = {}, {}
        for check in list_checks(stub, lap, order=BY_VALUE,
                                 looks_per_kilometer=looks)[0]:
            kilometer = math.floor(
                check.candidates.query.travelled_meters / 1000.0)
            for state in check.states:
                if state.state == OPEN:
                    (chosen if state.recommended else others).setdefault(
                        kilometer, []).append(state.value_square_meters)
                else:
                    assert not state.recommended
        for kilometer, values in chosen.items():
            assert len(values) <= looks
            assert min(values) >= max(others.get(kilometer, [0.0]))
            assert len(values) == looks or kilometer not in others
        assert bool(chosen) == (looks > 0)


def test_a_least_value_leaves_out_what_is_worth_less(stub, lap):
    values = sorted(best_of(check) for check in list_checks(stub, lap)[0])
    least = values[len(values) // 2]
    listed = list_checks(stub, lap, filter=api.CandidateFilter(
        states=[OPEN], least_value_square_meters=least))[0]
    assert listed
    assert {check.name for check in listed} == {
        check.name for check in list_checks(stub, lap)[0]
        if best_of(check) >= least}


@pytest.fixture
def contradicted(stub, lap):
    """The vehicle with closures that agree, and one that contradicts them: (vehicle,
    the wrong closure, the candidate that it has confirmed)."""
    checks = list_checks(stub, lap)[0]
    right = checks[::4]
    for check in right:
        best = check.candidates.candidates[0]
        LOOP_CLOSURES.add(stub, lap, best.query.sequence, best.matched.sequence)
    wait_until_settled(stub, lap)
    check = next(check for check in reversed(list_checks(stub, lap)[0])
                 if any(state.state == OPEN for state in check.states))
    state = next(state for state in check.states if state.state == OPEN)
    request = LOOP_CLOSURES.request(
        lap, check.candidates.query.sequence,
        # Half a lap away from all that agree.
        check.candidates.query.sequence - 190)
    request.candidate = state.name
    wrong = stub.AddLoopClosure(request).loop_closure
    return lap, wrong, state.name, request


def state_of(stub, name):
    check = stub.GetCheck(api.GetCheckRequest(
        name=name.rsplit("/candidates/", 1)[0])).check
    return next(state for state in check.states if state.name == name)


def test_a_closure_that_contradicts_others_is_found_and_asked_about_once(
        stub, contradicted):
    vehicle, wrong, candidate, request = contradicted
    found = stub.FindContradictions(api.FindContradictionsRequest(vehicle=vehicle))
    assert [one.loop_closure for one in found.contradictions] == [wrong.name]
    assert 0.0 <= found.contradictions[0].p_value < 0.01
    assert found.revision == get(stub, vehicle).revision
    wait_until(lambda: state_of(stub, candidate).state == OPEN, "second look")
    state = state_of(stub, candidate)
    assert (state.cause, state.decision) == (
        api.CANDIDATE_CAUSE_CONTRADICTION, wrong.name)
    # It comes before all others.
    first = list_checks(stub, vehicle, order=BY_VALUE)[0][0]
    assert candidate in [state.name for state in first.states]
    # Whoever looked again upholds it, and is not asked once more.
    assert stub.AddLoopClosure(request).loop_closure == wrong
    state = state_of(stub, candidate)
    assert (state.state, state.decision) == (
        api.CANDIDATE_STATE_CONFIRMED, wrong.name)
    # Another closure has all judged anew.
    LOOP_CLOSURES.add(stub, vehicle, 900, 520)
    wait_until_settled(stub, vehicle)
    time.sleep(6.0)
    assert state_of(stub, candidate) == state


def test_a_contradicted_closure_that_is_deleted_leaves_its_candidate_open(
        stub, contradicted):
    vehicle, wrong, candidate, _ = contradicted
    wait_until(lambda: state_of(stub, candidate).state == OPEN, "second look")
    LOOP_CLOSURES.delete(stub, wrong.name)
    state = state_of(stub, candidate)
    assert (state.state, state.cause) == (OPEN, api.CANDIDATE_CAUSE_DELETION)
    found = stub.FindContradictions(api.FindContradictionsRequest(vehicle=vehicle))
    assert not found.contradictions
