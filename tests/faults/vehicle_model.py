"""One vehicle as its callers are promised it, with one call at a time: the
object that linearization.py holds histories against.

A vehicle that is not there is None. Poses stand for what is in them by a
number: 1 to 9 as they were sent, more as they were revised.
"""

import typing


class Codes:
    """What is in poses, by sequence from 1 on. Hashed once, for there may be
    many."""

    __slots__ = ("values", "_hash")

    def __init__(self, values=()):
        self.values = values
        self._hash = hash(values)

    def __hash__(self):
        return self._hash

    def __eq__(self, other):
        return self is other or (self._hash == other._hash
                                 and self.values == other.values)

    def __len__(self):
        return len(self.values)

    def __add__(self, more):
        return Codes(self.values + more)

    def with_changes(self, changes):
        values = list(self.values)
        for sequence, code in changes:
            values[sequence - 1] = code
        return Codes(tuple(values))


class Vehicle(typing.NamedTuple):
    # Tells one vehicle from the next of its name; None until somebody saw it.
    uid: typing.Any
    revision: int
    settings: tuple
    sent: Codes
    current: Codes
    # Kinds of pairs: {(id, query, matched)} of each.
    closures: frozenset
    rejections: frozenset
    # Whether it refuses writes for a loss that was claimed.
    loss: bool

    def __str__(self):
        poses = "".join(f" {code}" for code in self.current.values[-12:])
        return (f"uid {self.uid} revision {self.revision} "
                f"settings {self.settings} "
                f"{len(self.current)} poses, the last{poses}; closures "
                f"{sorted(self.closures)} rejections {sorted(self.rejections)}"
                f"{' LOSS' if self.loss else ''}")


class Summary(typing.NamedTuple):
    """A vehicle as answers show it."""

    uid: typing.Any
    durable: int
    revision: int
    settings: tuple
    loss: bool
    closures: int


ABSENT = ("absent",)


def _if(condition, vehicle):
    """The states after an answer that changes nothing and says so much."""
    return [vehicle] if condition else []


def _see(vehicle, summary):
    """The vehicle, if it is as the summary says."""
    if vehicle is None:
        return []
    if (len(vehicle.current) != summary.durable
            or vehicle.settings != summary.settings
            or vehicle.loss != summary.loss
            or vehicle.revision != summary.revision
            or len(vehicle.closures) != summary.closures):
        return []
    if vehicle.uid is None:
        return [vehicle._replace(uid=summary.uid)]
    return _if(vehicle.uid == summary.uid, vehicle)


def _changed(vehicle, revision, **fields):
    """After a change, which takes the vehicle to the next revision: to this
    one, if the answer said so."""
    after = vehicle._replace(revision=vehicle.revision + 1, **fields)
    return _if(revision in (None, after.revision), after)


def _field(kind):
    return {"closure": "closures", "rejection": "rejections"}[kind]


def is_read(operation):
    return operation.kind.startswith("read ")


def apply(vehicle, operation):
    """See linearization.check."""
    result = operation.result
    if result == ABSENT:
        may_be = operation.kind != "create" and vehicle is None
        return _if(may_be, vehicle)
    handler = _HANDLERS[operation.kind]
    if operation.kind != "create" and vehicle is None:
        return []
    if operation.kind == "revise":
        refusal = _refusal_of_poses(vehicle, *operation.arguments)
        if refusal is not None:
            return _if(result == refusal, vehicle)
    if operation.kind in _WRITES and (
            vehicle.loss or result and result[0] == "loss"):
        refused = result is not None and result[0] == "loss" \
            and result[1] == len(vehicle.current)
        return _if(refused and vehicle.loss, vehicle)
    return handler(vehicle, result, *operation.arguments)


def may_become(vehicle, read):
    """Whether more changes may make it what a "read vehicle" shows. See
    linearization.check."""
    if read.result == ABSENT:
        return vehicle is None
    if vehicle is None:
        return True
    shown = read.result[1]
    return (vehicle.uid in (None, shown.uid)
            and len(vehicle.current) <= shown.durable
            and vehicle.revision <= shown.revision)


def _read_vehicle(vehicle, result):
    return _see(vehicle, result[1])


def _read_poses(vehicle, result, first, most):
    """A page of poses."""
    page = vehicle.current.values[first - 1:first - 1 + most]
    return _if(page == result[1], vehicle)


def _read_pairs(vehicle, result, kind):
    return _if(getattr(vehicle, _field(kind)) == result[1], vehicle)


def _read_revision(vehicle, result):
    return _if(vehicle.revision == result[1], vehicle)


def _create(vehicle, result, settings):
    if result == ("exists",):
        return _if(vehicle and vehicle.settings != settings, vehicle)
    if vehicle is not None:
        if result is None or vehicle.settings != settings:
            return []
        return _see(vehicle, result[1])
    made = Vehicle(None, 1, settings, Codes(), Codes(), frozenset(),
                   frozenset(), False)
    return [made] if result is None else _see(made, result[1])


def _update(vehicle, result, place, value):
    settings = list(vehicle.settings)
    settings[place] = value
    settings = tuple(settings)
    if result is None:
        return _changed(vehicle, None, settings=settings)
    return [after for changed in
            _changed(vehicle, result[1].revision, settings=settings)
            for after in _see(changed, result[1])]


def _delete(_, result):
    return [None] if result in (None, ("deleted",)) else []


def _means(vehicle, uid):
    """(whether a caller who means the vehicle of this uid may mean it, and it
    after that)."""
    if not uid or vehicle.uid == uid:
        return True, vehicle
    return vehicle.uid is None, vehicle._replace(uid=uid)


def _append(vehicle, result, first, codes, uid):
    if result is not None and result[0] == "replaced":
        return _see_replaced(vehicle, result, uid)
    meant, vehicle = _means(vehicle, uid)
    if not meant:
        return []
    durable = len(vehicle.current)
    kind = "ack" if result is None else result[0]
    if kind == "gap":
        right = first > durable + 1 and result[1] == durable + 1
        return _if(right, vehicle)
    if first > durable + 1:
        return []
    there = vehicle.sent.values[first - 1:]
    same = there[:len(codes)] == codes[:len(there)]
    if kind == "mismatch":
        return _if(not same, vehicle)
    if not same:
        return []
    new = codes[len(there):]
    if result is not None and result[1] != durable + len(new):
        return []
    revision = None if result is None else result[2]
    if not new:
        return _if(vehicle.revision == revision, vehicle)
    return _changed(vehicle, revision, sent=vehicle.sent + new,
                    current=vehicle.current + new)


def _see_replaced(vehicle, result, uid):
    if uid == result[1] or vehicle.uid not in (None, result[1]):
        return []
    return [vehicle._replace(uid=result[1])]


def _open(vehicle, result, acked, uid):
    durable = len(vehicle.current)
    if result is not None and result[0] == "replaced":
        return _see_replaced(vehicle, result, uid)
    meant, vehicle = _means(vehicle, uid)
    if not meant:
        return []
    if result is not None and result[0] == "opened":
        meant, vehicle = _means(vehicle, result[3])
        return _if(meant and acked <= durable and result[1] == durable
                   and result[2] == vehicle.revision, vehicle)
    if acked <= durable or result is not None and result[1] != durable:
        return []
    if vehicle.loss or not uid:
        # Who does not say of which vehicle the claim is ends nothing but the
        # stream.
        return [vehicle]
    return _changed(vehicle, None, loss=True)


def _refusal_of_poses(vehicle, revised, expected):
    """What a revision is told as its poses come, before anything else is looked
    at: that the vehicle has not come so far, or does not have a pose. That it has
    gone on since `expected`, or is in loss, is told once all have come."""
    if expected > vehicle.revision:
        return "other revision", vehicle.revision
    if max(sequence for sequence, _ in revised) > len(vehicle.current):
        return ("no pose",)
    return None


def _revise(vehicle, result, revised, expected):
    kind = "revised" if result is None else result[0]
    if kind == "other revision":
        return _if(expected != result[1] == vehicle.revision, vehicle)
    if kind == "no pose" or expected not in (0, vehicle.revision):
        return []
    revision = None if result is None else result[1]
    return _changed(vehicle, revision,
                    current=vehicle.current.with_changes(revised))


def _add(vehicle, result, kind, name, query, matched):
    field = _field(kind)
    pairs = getattr(vehicle, field)
    missing = query > len(vehicle.current)
    same_name = [pair for pair in pairs if pair[0] == name]
    others = getattr(vehicle, _field(
        "rejection" if kind == "closure" else "closure"))
    conflicts = any(pair[1:] == (query, matched) for pair in others)
    told = "pair" if result is None else result[0]
    if told == "no pose":
        return _if(missing, vehicle)
    if missing:
        return []
    if told == "conflict":
        return _if(conflicts and not same_name, vehicle)
    there = (name, query, matched) in pairs
    if told == "exists":
        return _if(same_name and not there, vehicle)
    if there:
        return _if(result in (None, ("pair", vehicle.revision)), vehicle)
    if same_name or conflicts:
        return []
    return _changed(vehicle, None if result is None else result[1],
                    **{field: pairs | {(name, query, matched)}})


def _remove(vehicle, result, kind, name):
    field = _field(kind)
    pairs = getattr(vehicle, field)
    left = frozenset(pair for pair in pairs if pair[0] != name)
    if result == ("no pair",):
        return _if(left == pairs, vehicle)
    if left == pairs:
        return []
    return _changed(vehicle, None if result is None else result[1],
                    **{field: left})


def _accept(vehicle, result, sequence):
    durable = len(vehicle.current)
    told = "vehicle" if result is None else result[0]
    if told == "no loss":
        return _if(not vehicle.loss, vehicle)
    if not vehicle.loss:
        return []
    if told == "other sequence":
        right = sequence != durable and result[1] == durable
        return _if(right, vehicle)
    if sequence != durable:
        return []
    if result is None:
        return _changed(vehicle, None, loss=False)
    return [after for changed in
            _changed(vehicle, result[1].revision, loss=False)
            for after in _see(changed, result[1])]


# Those that a vehicle refuses while it is in loss.
_WRITES = {"update", "append", "revise", "add", "remove"}

_HANDLERS = {
    "read vehicle": _read_vehicle, "read poses": _read_poses,
    "read pairs": _read_pairs, "read revision": _read_revision,
    "create": _create, "update": _update, "delete": _delete,
    "append": _append, "open": _open, "revise": _revise, "add": _add,
    "remove": _remove, "accept": _accept}
