"""What the server makes of stored checks after they were found, as the package shows
it: values, second searches, and loop closures that contradict others."""

import pytest

import revisit
from revisit_server import wait_until

OPEN = revisit.v1.CANDIDATE_STATE_OPEN
CONFIRMED = revisit.v1.CANDIDATE_STATE_CONFIRMED


@pytest.fixture
def driven(client, new_vehicle, boreas):
    """A vehicle that has driven the shipped drive, with its checks stored."""
    vehicle = new_vehicle(checks=revisit.v1.STORED_CHECKS_STORED)
    with client.stream_poses(vehicle) as stream:
        stream.append(boreas[0])
    wait_until(lambda: client.get_vehicle(vehicle).check_debt == 0, "all checks")
    return vehicle


def best_of(check):
    return max((one.value_square_meters for one in check.states
                if one.state == OPEN), default=-1.0)


def evidence(check):
    return revisit.evidence_of(check, check.states[0])


def confirm(client, vehicle, check):
    found = evidence(check)
    return client.add_loop_closure(vehicle, found, candidate=check.states[0].name)


def test_checks_come_by_value_with_the_looks_that_there_is_time_for(client, driven):
    by_time = list(client.list_checks(driven, states="open"))
    by_value = list(client.list_checks(driven, states="open", order="value",
                                       looks_per_kilometer=1))
    values = [best_of(check) for check in by_value]
    assert values == sorted(values, reverse=True)
    assert values[0] > values[-1] > 0.0
    assert {one.name for one in by_value} == {one.name for one in by_time}
    looks = [one for check in by_value for one in check.states if one.recommended]
    assert 0 < len(looks) < len(by_value)
    assert by_value[0].name in {one.name.rpartition("/candidates/")[0]
                                for one in looks}
    least = values[len(values) // 2]
    assert {one.name for one in client.list_checks(
        driven, states="open", least_value=least)} == {
            one.name for one in by_value if best_of(one) >= least}
    with pytest.raises(revisit.InvalidArgument, match="BY_VALUE"):
        next(client.list_checks(driven, looks_per_kilometer=1))


def test_a_decision_has_others_searched_again(client, driven):
    before = best_of(next(client.list_checks(driven, states="open", order="value")))
    # What comes after it depends on it.
    confirm(client, driven, next(client.list_checks(driven, states="open")))

    def searched_again():
        return [check for check in client.list_checks(driven, fresh_only=True)
                if check.HasField("latest")]

    wait_until(searched_again, "second searches")
    again = searched_again()
    states = [(check, one) for check in again for one in check.states
              if one.latest_rank]
    assert states
    for check, one in states:
        found = revisit.evidence_of(check, one)
        assert found in check.latest.candidates
        assert found.rank == one.latest_rank
    after = next(client.list_checks(driven, states="open", order="value"))
    assert best_of(after) < before


def test_a_contradicted_closure_comes_once_more_and_is_upheld(client, driven):
    checks = [check for check in client.list_checks(driven, states="open")
              if evidence(check).probability > 0.99]
    for check in checks[::2]:
        confirm(client, driven, check)
    assert client.find_contradictions(driven) == []
    last = [check for check in client.list_checks(driven, states="open")
            if check.states[0].state == OPEN][-1]
    watch = client.watch(driven, cursor=client.list_checks(driven).watch_cursor())
    query = evidence(last).query.sequence
    # As far along the road as no two places that are one.
    wrong = client.add_loop_closure(driven, query, query - 120,
                                    candidate=last.states[0].name).loop_closure
    [found] = client.find_contradictions(driven)
    assert found.loop_closure == wrong.name
    assert found.p_value < 0.01
    event = next(one for one in watch if one.is_contradicted)
    assert event.candidate.name == last.states[0].name
    assert event.contradicted_closure() == wrong
    event.uphold()
    watch.done()
    upheld = next(one for one in watch if one.candidate.name == event.candidate.name)
    assert (upheld.candidate.state, upheld.candidate.decision) == (
        CONFIRMED, wrong.name)
    assert [one.name for one in client.list_loop_closures(driven)].count(
        wrong.name) == 1
    # It contradicts the others as before, but nobody is asked about it once more.
    [found] = client.find_contradictions(driven)
    assert found.loop_closure == wrong.name
    state = next(one for one in client.get_check(last.name).states
                 if one.name == event.candidate.name)
    assert state.state == CONFIRMED
