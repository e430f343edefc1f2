"""Those who watch candidates and keep a cursor, and what they must have seen."""

import collections
import random
import threading
import time

import grpc

from revisit_server import wait_until_none_left
from stubs import PoseGraphServiceStub, api
from wire import LOOP_CLOSURES, REJECTED_CANDIDATES, decode_failure, get


class Watcher:
    """Watches all candidates from the cursor that it keeps, over any of the servers
    at `addresses()`, and is itself broken off at random: then it works off again what
    came behind the last cursor that it kept. Ends on the first error that it cannot
    go on from."""

    def __init__(self, addresses, seed, cursor=""):
        self._addresses = addresses
        self._random = random.Random(seed)
        self._cursor = cursor
        self._stop = threading.Event()
        self._call = None
        # By uid, the events in the order in which they came, without those that came
        # again.
        self.told = collections.defaultdict(list)
        self.repeated = 0
        self.breaks = 0
        self.failure = None
        # Whether a watch was ever begun: from then on it misses nothing.
        self.begun = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self):
        while not self._stop.is_set():
            try:
                self._watch()
            except grpc.RpcError as error:
                if error.code() in (grpc.StatusCode.OUT_OF_RANGE,
                                    grpc.StatusCode.INVALID_ARGUMENT,
                                    grpc.StatusCode.INTERNAL,
                                    grpc.StatusCode.DATA_LOSS):
                    self.failure = error
                    return
                self._stop.wait(0.05)
            except Exception as error:  # Told to the test that asks.
                self.failure = error
                return

    def _watch(self):
        address = self._random.choice(self._addresses())
        with grpc.insecure_channel(address) as channel:
            # One whose server was killed is not heard of again, now and then.
            self._call = PoseGraphServiceStub(channel).WatchCandidates(
                api.WatchCandidatesRequest(cursor=self._cursor), timeout=20)
            limit = self._random.randrange(1, 60)
            for count, answer in enumerate(self._call):
                if self._stop.is_set():
                    return
                if answer.WhichOneof("event") == "candidate":
                    self._take(answer.candidate)
                    # Broken off after its work and before it has kept the cursor.
                    if self._random.random() < 0.05:
                        self.breaks += 1
                        return
                self._cursor = answer.cursor
                self.begun.set()
                if count == limit:
                    self.breaks += 1
                    return

    def _take(self, event):
        told = self.told[event.vehicle_uid]
        if event.number <= len(told):
            # The same again, to the last bit.
            assert event == told[event.number - 1], event
            self.repeated += 1
            return
        assert event.number == len(told) + 1, (
            f"event {event.number} after {len(told)}")
        told.append(event)

    def stop(self):
        self._stop.set()
        if self._call is not None:
            self._call.cancel()
        self._thread.join(30)
        assert not self._thread.is_alive()


def list_checks(stub, parent="vehicles/-", **fields):
    """(all checks, the cursor of the first page)"""
    checks, token, cursor = [], "", None
    while True:
        page = stub.ListChecks(api.ListChecksRequest(
            parent=parent, page_token=token, **fields))
        cursor = cursor or page.watch_cursor
        checks += page.checks
        token = page.next_page_token
        if not token:
            return checks, cursor


def without_times(found):
    """What was found, without how long it took, and when."""
    copy = type(found)()
    copy.CopyFrom(found)
    if isinstance(copy, api.CandidateSet):
        copy.ClearField("search_duration")
        copy.ClearField("revision")
    return copy


def wait_until_paid(stub, vehicle):
    """Waits until the vehicle owes no checks."""
    wait_until_none_left(lambda: get(stub, vehicle).check_debt,
                         f"checks of {vehicle}")


def wait_until_settled(stub, vehicle):
    """Waits until the vehicle owes no checks, and none is to be searched again."""
    wait_until_paid(stub, vehicle)
    wait_until_none_left(lambda: count_stale(stub, vehicle),
                         f"second searches of {vehicle}")


def count_stale(stub, parent="vehicles/-"):
    """How many checks wait to be searched again, as far as the rows say."""
    return sum(check.stale for check in list_checks(stub, parent)[0])


def expect_states_follow(stub, vehicle, told):
    """The rows say what the events have told, the last one of each candidate."""
    last = {event.candidate.name: event.candidate for event in told}
    stored = {state.name: state for check in list_checks(stub, vehicle)[0]
              for state in check.states}
    assert {name: (one.state, one.cause, one.decision, one.event_number)
            for name, one in last.items()} == {
        name: (one.state, one.cause, one.decision, one.event_number)
        for name, one in stored.items()}


def change_pairs(stub, vehicle, rng, pairs):
    """Adds a loop closure or a rejected candidate where a check has found something,
    or deletes one of `pairs`, which holds what was added."""
    kind = rng.choice([LOOP_CLOSURES, LOOP_CLOSURES, REJECTED_CANDIDATES])
    if pairs and rng.random() < 0.3:
        old_kind, name = pairs.pop(rng.randrange(len(pairs)))
        old_kind.delete(stub, name)
        return
    undecided = [(check, state) for check in list_checks(stub, vehicle)[0]
                 for state in check.states
                 if state.state == api.CANDIDATE_STATE_OPEN]
    if not undecided:
        return
    check, state = rng.choice(undecided)
    found = check.latest if state.latest_rank else check.candidates
    candidate = next(one for one in found.candidates
                     if one.rank == (state.latest_rank or state.rank))
    try:
        added, _ = kind.add(stub, vehicle, candidate.query.sequence,
                            candidate.matched.sequence)
    except grpc.RpcError as error:
        # Another pair decided on it and was deleted, and one of the other kind is
        # still there, until a second search withdraws the candidate.
        if error.code() is not grpc.StatusCode.FAILED_PRECONDITION:
            raise
        assert decode_failure(error).reason == "POSE_PAIR_CONFLICT"
        return
    # What was added again is there once.
    if (kind, added.name) not in pairs:
        pairs.append((kind, added.name))


UNDECIDED = (api.CANDIDATE_STATE_OPEN, api.CANDIDATE_STATE_WITHDRAWN)


def wait_until_as_searched_now(stub, vehicle, seconds=30):
    """Each check on which something is undecided comes to hold what a search at its
    pose finds now, and its open candidates to be among that. Returns how many were
    searched again."""
    deadline = time.monotonic() + seconds
    while True:
        try:
            return expect_as_searched_now(stub, vehicle)
        except AssertionError:
            # What became stale last may not have been looked at yet.
            if time.monotonic() > deadline:
                raise
        time.sleep(0.2)


def expect_as_searched_now(stub, vehicle):
    keep = get(stub, vehicle).settings.keep_probability
    again = 0
    for check in list_checks(stub, vehicle)[0]:
        undecided = [state for state in check.states
                     if state.state in UNDECIDED]
        if not undecided:
            continue
        last = (check.latest if check.HasField("latest") else check.candidates)
        again += check.HasField("latest")
        found = stub.FindCandidates(api.FindCandidatesRequest(
            vehicle=vehicle, sequence=last.query.sequence + (
                last.query.fraction > 0))).candidates
        assert without_times(last) == without_times(found), check.name
        ranks = {candidate.rank: candidate for candidate in found.candidates}
        for state in undecided:
            if state.state == api.CANDIDATE_STATE_OPEN:
                rank = (state.latest_rank if check.HasField("latest")
                        else state.rank)
                assert ranks[rank].probability >= keep, state.name
    return again


def due_checks(stub, vehicle, settings):
    """The poses at which checks are due, from the nodes of the graph and the rule of
    the API alone."""
    interval = settings.check_interval_meters
    least = 2.0 * settings.sequence_length_meters
    due, last = [], 0
    for part in stub.ExportPoseGraph(api.ExportPoseGraphRequest(vehicle=vehicle)):
        for node in part.nodes:
            reached = int(node.travelled_meters / interval + 1e-6)
            if reached > last and reached * interval >= least - 1e-6:
                due.append(node.sequence + (node.fraction > 0.0))
            last = max(last, reached)
    return due


def expect_each_check_once(stub, vehicle, told):
    """Each check that is due was made once: where a search at its pose finds what is
    worth keeping, it is stored and was told with just that, and no other is."""
    settings = stub.GetVehicle(api.GetVehicleRequest(name=vehicle)).vehicle.settings
    due = due_checks(stub, vehicle, settings)
    stored = {check.name: check for check in list_checks(stub, vehicle)[0]}
    opened = collections.defaultdict(list)
    for event in told:
        if event.candidate.cause == api.CANDIDATE_CAUSE_CHECK:
            opened[event.check].append(event)
    kept = 0
    for sequence in due:
        name = f"{vehicle}/checks/{sequence}"
        found = stub.FindCandidates(api.FindCandidatesRequest(
            vehicle=vehicle, sequence=sequence)).candidates
        worth = [candidate for candidate in found.candidates
                 if candidate.probability >= settings.keep_probability]
        if not worth:
            assert name not in stored and name not in opened, name
            continue
        kept += 1
        check = stored.pop(name)
        assert without_times(check.candidates) == without_times(found), name
        assert [state.rank for state in check.states] == [
            candidate.rank for candidate in worth]
        events = opened.pop(name)
        assert [event.candidate.name for event in events] == [
            f"{name}/candidates/{n}" for n in range(1, len(worth) + 1)]
        assert [event.evidence for event in events] == worth
        assert all(event.revision == check.candidates.revision
                   for event in events)
    assert not stored, stored.keys()
    assert not opened, opened.keys()
    return len(due), kept
