"""The checker of histories, on histories that are known to have an order, or
none."""

import random

import pytest

import linearization
import vehicle_model
from linearization import Operation, Undecided, Violation, check
from vehicle_model import ABSENT, Summary

SETTINGS = (5, 1.0)


def did(kind, *arguments, at, result, client=""):
    """An operation of `at` = (called, returned)."""
    return Operation(kind, arguments, at[0], at[1], result, client)


def summary(revision, durable=0, settings=SETTINGS, loss=False, closures=0,
            uid="u"):
    return "vehicle", Summary(uid, durable, revision, settings, loss, closures)


def create(at=(0, 1), uid="u"):
    return did("create", SETTINGS, at=at, result=summary(1, uid=uid))


def append(first, *codes, at, result, uid=""):
    return did("append", first, codes, uid, at=at, result=result)


def read(at, result):
    return did("read vehicle", at=at, result=result)


def read_poses(at, *codes):
    return did("read poses", 1, 100, at=at, result=("poses", codes))


def decide(*operations, states=frozenset({None}), seen=()):
    return check(vehicle_model, set(states), list(operations), seen)


def refused(*operations, **more):
    with pytest.raises(Violation) as raised:
        decide(*operations, **more)
    assert raised.value.explain()
    return raised.value


def test_one_call_after_the_other_has_an_order():
    states = decide(
        create(), append(1, 1, 1, at=(2, 3), result=("ack", 2, 2)),
        read((4, 5), summary(2, 2)), read_poses((6, 7), 1, 1))
    assert {len(state.current) for state in states} == {2}


def test_calls_side_by_side_may_have_any_order():
    first = append(1, 1, at=(2, 5), result=("ack", 1, 2))
    for seen in (summary(1), summary(2, 1)):
        decide(create(), first, read((3, 4), seen))


def test_read_that_misses_what_was_acknowledged_before_is_refused():
    violation = refused(
        create(), append(1, 1, at=(2, 3), result=("ack", 1, 2)),
        read((4, 5), summary(1)))
    assert violation.failed.called == 4


def test_reads_that_go_back_are_refused_though_a_change_is_under_way():
    change = append(1, 1, at=(2, 9), result=("ack", 1, 2))
    new, old = summary(2, 1), summary(1)
    decide(create(), change, read((3, 4), old), read((5, 6), new))
    refused(create(), change, read((3, 4), new), read((5, 6), old))


def test_new_poses_with_the_old_revision_after_them_are_refused():
    before = [create(), append(1, 1, at=(2, 3), result=("ack", 1, 2))]
    revise = did("revise", ((1, 77),), 0, at=(4, 9), result=("revised", 3))
    decide(*before, revise, read_poses((5, 6), 77),
           read((7, 8), summary(3, 1)))
    violation = refused(*before, revise, read_poses((5, 6), 77),
                        read((7, 8), summary(2, 1)))
    assert violation.failed.called == 7
    assert any(each is revise for each in violation.window)


@pytest.mark.parametrize("in_loss, sequence, expected, told", [
    (False, 1, 1, ("other revision", 2)), (False, 2, 1, ("no pose",)),
    (False, 2, 2, ("no pose",)), (False, 2, 0, ("no pose",)),
    (False, 1, 3, ("other revision", 2)), (False, 2, 3, ("other revision", 2)),
    (True, 1, 0, ("loss", 1)), (True, 1, 2, ("loss", 1)),
    (True, 2, 0, ("no pose",)), (True, 2, 3, ("no pose",)),
    (True, 2, 4, ("other revision", 3))])
def test_revision_that_cannot_be_made_has_one_answer(
        in_loss, sequence, expected, told):
    def revise(result):
        return did("revise", ((sequence, 77),), expected, at=(6, 7),
                   result=result)

    before = [create(), append(1, 1, at=(2, 3), result=("ack", 1, 2))]
    if in_loss:
        before.append(did("open", 9, "u", at=(4, 5), result=("loss", 1)))
    decide(*before, revise(told))
    for another in {("other revision", 2), ("other revision", 3), ("no pose",),
                    ("loss", 1), ("revised", 3), ("revised", 4)}:
        if another != told:
            refused(*before, revise(another))


def test_acknowledgement_that_is_dropped_leaves_both_outcomes():
    lost = append(1, 1, at=(2, None), result=None)
    for after in (summary(1), summary(2, 1)):
        decide(create(), lost, read((3, 4), after))
    states = decide(create(), lost)
    assert {len(state.current) for state in states} == {0, 1}


def test_outcome_once_seen_stays():
    lost = append(1, 1, at=(2, None), result=None)
    refused(create(), lost, read((3, 4), summary(2, 1)),
            read((5, 6), summary(1)))
    refused(create(), lost, seen=[read((3, 4), summary(2, 1)),
                                  read((5, 6), summary(1))])


def test_change_that_is_over_comes_no_more():
    over = append(1, 1, at=(2, 3), result=None)
    decide(create(), over, read((4, 5), summary(1)))
    decide(create(), over, read((4, 5), summary(2, 1)))
    refused(create(), over, read((4, 5), summary(1)),
            read((6, 7), summary(2, 1)))


def test_states_are_carried_from_one_life_to_the_next():
    lost = append(1, 1, at=(2, None), result=None)
    between = decide(create(), lost)
    assert decide(read((10, 11), summary(2, 1)), states=between)
    narrowed = decide(states=between, seen=[read((10, 11), summary(1))])
    refused(read((12, 13), summary(2, 1)), states=narrowed)


def test_acknowledged_poses_that_a_kill_takes_are_refused():
    before = decide(create(), append(1, 1, at=(2, 3), result=("ack", 1, 2)))
    refused(states=before, seen=[read((10, 11), summary(1))])


def test_what_nobody_sent_is_refused():
    refused(create(), append(1, 1, at=(2, 3), result=("ack", 1, 2)),
            read_poses((4, 5), 9))


def test_vehicle_made_anew_is_another():
    life = [create(), did("delete", at=(2, 3), result=("deleted",)),
            read((4, 5), ABSENT), create(at=(6, 7), uid="v")]
    decide(*life, read((8, 9), summary(1, uid="v")))
    refused(*life, read((8, 9), summary(1, uid="u")))
    decide(*life, append(1, 1, uid="u", at=(8, 9), result=("replaced", "v")))
    refused(*life, append(1, 1, uid="u", at=(8, 9), result=("ack", 1, 2)))


def test_creation_never_finds_nothing():
    refused(create(), did("create", SETTINGS, at=(2, 3), result=ABSENT))


def test_revision_that_is_given_twice_is_refused():
    refused(create(), append(1, 1, at=(2, 5), result=("ack", 1, 2)),
            did("update", 0, 8, at=(3, 6), result=summary(
                2, settings=(8, 1.0))))


def test_claim_of_more_than_is_stored_stops_writes_until_it_is_accepted():
    loss = [create(), did("open", 9, "u", at=(2, 3), result=("loss", 0)),
            append(1, 1, at=(4, 5), result=("loss", 0))]
    decide(*loss, did("accept", 0, at=(6, 7), result=summary(3)),
           append(1, 1, at=(8, 9), result=("ack", 1, 4)))
    refused(*loss, append(1, 1, at=(8, 9), result=("ack", 1, 3)))


def random_history(rng, length):
    """Clients side by side, each call at its one moment between call and
    return: so that it has an order."""
    state, operations, moment = None, [], 0.0
    while len(operations) < length:
        moment += rng.uniform(0.1, 1.0)
        durable = len(state.current) if state else 0
        attempt = rng.choice([
            lambda: ("create", (SETTINGS,), summary(1, uid=str(moment))),
            lambda: ("append", (durable + 1, (rng.randint(1, 9),), ""),
                     ("ack", durable + 1, state.revision + 1)),
            lambda: ("revise", (((rng.randint(1, durable),
                                  rng.randint(10, 99)),), 0),
                     ("revised", state.revision + 1)),
            lambda: ("read vehicle", (), summary(
                state.revision, durable, uid=state.uid)),
            lambda: ("read poses", (1, 100), ("poses", state.current.values)),
        ])
        try:
            kind, arguments, result = attempt()
        except (AttributeError, ValueError):
            continue
        operation = Operation(kind, arguments, moment - rng.uniform(0, 3),
                              moment + rng.uniform(0, 3), result)
        after = vehicle_model.apply(state, operation)
        if not after:
            continue
        state = after[0]
        if not vehicle_model.is_read(operation) and rng.random() < 0.1:
            operation.result = operation.returned = None
        operations.append(operation)
    return operations


@pytest.mark.parametrize("seed", range(20))
def test_random_histories_with_an_order_are_taken(seed):
    assert decide(*random_history(random.Random(seed), 120))


@pytest.mark.parametrize("seed", range(20))
def test_random_histories_with_two_reads_swapped_are_refused(seed):
    rng = random.Random(seed)
    operations = random_history(rng, 120)
    reads = [each for each in operations if each.kind == "read vehicle"]
    while True:
        first, second = rng.sample(reads, 2)
        if first.returned < second.called and first.result != second.result:
            break
    first.result, second.result = second.result, first.result
    refused(*operations)


@pytest.mark.parametrize("seed", range(10))
def test_random_histories_without_one_of_the_changes_are_refused(seed):
    operations = random_history(random.Random(seed), 120)
    changes = [each for each in operations[:60]
               if each.result and each.kind in ("append", "revise")]
    operations.remove(random.Random(seed).choice(changes))
    refused(*operations)


def test_too_many_possibilities_are_not_called_an_order(monkeypatch):
    monkeypatch.setattr(linearization, "MOST_CONFIGURATIONS", 50)
    lost = [did("update", 0, value, at=(2, None), result=None)
            for value in range(10)]
    with pytest.raises(Undecided):
        decide(create(), *lost)
