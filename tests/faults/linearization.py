"""Decides whether a history of concurrent operations could have come from a
sequential object: whether each operation can be given one moment between its
call and its return, so that all answers are those that the object gives when
the operations are done one at a time, in that order (Herlihy and Wing).

The search is that of Wing and Gong with Lowe's memory of what was seen, run
just in time: events are taken in their order, and kept is every pair of a
state that the object may be in, and the operations under way that have had
their moment. When an operation returns, those remain in which it has had it,
or can have it now after some of the others that are under way. If none
remains, there is no such order.

An operation whose outcome nobody knows may have its moment at any time, or
never: until it is known to be over, or until the end of its part of the
history.
"""

import collections
import dataclasses
import typing

# A history that leaves more possibilities than this is not decided.
MOST_CONFIGURATIONS = 20000


@dataclasses.dataclass(eq=False)
class Operation:
    """`result` is None where the outcome is not known, and `returned` where it
    is not known to be over."""

    kind: str
    arguments: tuple
    called: float
    returned: typing.Optional[float]
    result: typing.Optional[tuple]
    client: str = ""

    def __str__(self):
        end = " " * 10
        if self.returned is not None:
            end = f"{self.returned:10.4f}"
        result = "not known" if self.result is None else self.result
        text = (f"{self.called:10.4f} {end} {self.client:8} "
                f"{self.kind}{self.arguments} -> {result}")
        return text if len(text) < 500 else text[:500] + "..."


class Violation(Exception):
    """No order of the operations explains the answer of `failed`. At its call
    the object could be in one of `states`; `window` are the operations that
    were under way from then on, and `before` those that had returned last."""

    def __init__(self, failed, states, before, window):
        super().__init__(f"no order of the operations explains\n  {failed}")
        self.failed, self.states = failed, states
        self.before, self.window = before, window

    def explain(self):
        header = "    called   returned client   operation"
        return "\n".join([
            "before:", header, *map(str, self.before),
            f"it could be ({len(self.states)} states):",
            *(f"  {state}" for state in list(self.states)[:6]),
            "then:", header,
            *map(str, sorted(self.window, key=lambda each: each.called)),
            str(self)])


class Undecided(Exception):
    """There are too many possibilities."""


def check(model, states, operations, seen=()):
    """The states in which the object may be at the end, given those in which it
    may be at the beginning. Violation if there is none. `seen` are reads that
    were made after the end, one after the other.

    `model.apply(state, operation)` answers the states that the operation may
    lead to with the result that it had: none if it cannot have it. With a
    result that is not known, it answers those to which it leads if it took
    place.
    `model.may_become(state, read)` is whether a state can still come to be as
    the read shows it.
    """
    # A configuration: a state, and the pending operations that have had their
    # moment.
    configurations = {(state, frozenset()) for state in states}
    pending = {}
    # What there was at the calls of those that are pending.
    at_call = {}
    returned = collections.deque(maxlen=8)
    for _, is_return, number, operation in _events(model, operations):
        if not is_return:
            pending[number] = operation
            at_call[number] = configurations
            continue
        remaining = set()
        explored = set()
        for configuration in configurations:
            _reach(model, configuration, number, pending, explored, remaining)
        if operation.result is None:
            remaining |= configurations
        if not remaining:
            raise Violation(operation, {state for state, _ in at_call[number]},
                            list(returned), _window(operation, operations))
        del pending[number], at_call[number]
        returned.append(operation)
        configurations = {(state, done - {number})
                          for state, done in remaining}
    ends = set()
    explored = set()
    for configuration in configurations:
        _reach(model, configuration, None, pending, explored, ends, seen[:1])
    states = {state for state, _ in ends}
    for read in seen:
        after = {after for state in states
                 for after in model.apply(state, read)}
        if not after:
            raise Violation(read, states or
                            {state for state, _ in configurations},
                            list(returned), [*pending.values(), read])
        states = after
    return states


def _window(failed, operations):
    """What may have had its moment while it was under way."""
    return [each for each in operations if each.called <= failed.returned and
            (each.returned is None or each.returned >= failed.called)]


def _events(model, operations):
    """(time, 0 for a call and 1 for a return, operation), in order. At one
    moment calls come before returns: then the two are side by side."""
    events = []
    for number, operation in enumerate(operations):
        if operation.result is None and model.is_read(operation):
            # It told nothing and changed nothing.
            continue
        events.append((operation.called, 0, number, operation))
        if operation.returned is not None:
            events.append((operation.returned, 1, number, operation))
    events.sort(key=lambda event: event[:3])
    return events


def _reach(model, configuration, wanted, pending, explored, reached, seen=()):
    """Adds the configurations in which `wanted` has had its moment, at once or
    after others that are pending; if None is wanted, all that may still become
    what was seen."""
    todo = [configuration]
    while todo:
        current = todo.pop()
        if current in explored:
            continue
        explored.add(current)
        if len(explored) > MOST_CONFIGURATIONS:
            raise Undecided(f"more than {MOST_CONFIGURATIONS} configurations")
        state, done = current
        if wanted is None or wanted in done:
            reached.add(current)
            # What has had its moment need not wait, and what follows can have
            # its own at the next return.
            if wanted is not None:
                continue
        # A read that changes nothing takes its moment as soon as it can.
        for number, operation in pending.items():
            if number not in done and model.is_read(operation) \
                    and state in model.apply(state, operation):
                done = done | {number}
        if done != current[1]:
            todo.append((state, done))
            continue
        for number, operation in pending.items():
            if number in done:
                continue
            for after in model.apply(state, operation):
                if seen and not model.may_become(after, seen[0]):
                    continue
                todo.append((after, done | {number}))
