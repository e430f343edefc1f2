"""A watch of stored candidates brings every event at least once, in order, whatever
happens to the connection, the cursor or the program; blocking and with asyncio."""

import asyncio
import contextlib
import gc
import inspect
import os
import pathlib
import threading
import time

import grpc
import pytest

import revisit
from conftest import LONG
from fake_feed import FakeFeed, check, closure, searched_again
from fake_service import Fault, serving
from revisit import BackoffOptions, CursorFile, aio, v1

QUICK = BackoffOptions(initial=0.01, max=0.05)
Code = grpc.StatusCode
OPEN = v1.CANDIDATE_STATE_OPEN
CONFIRMED = v1.CANDIDATE_STATE_CONFIRMED
WITHDRAWN = v1.CANDIDATE_STATE_WITHDRAWN


class InLoop:
    """Something of `revisit.aio` whose methods and iterations are waited for, while
    its event loop runs in another thread."""

    def __init__(self, run, wrapped):
        self.run, self.wrapped = run, wrapped

    def _shown(self, answer):
        if isinstance(answer, (aio.Watch, aio.CheckList, aio.WatchEvent)):
            return InLoop(self.run, answer)
        return answer

    def __getattr__(self, name):
        member = getattr(self.wrapped, name)
        if not callable(member):
            return member

        def call(*arguments, **keywords):
            async def body():
                answer = member(*arguments, **keywords)
                return await answer if inspect.isawaitable(answer) else answer
            return self._shown(self.run(body()))
        return call

    def __iter__(self):
        async def body():
            self.wrapped.__aiter__()
        self.run(body())
        return self

    def __next__(self):
        try:
            return self._shown(self.run(self.wrapped.__anext__()))
        except StopAsyncIteration:
            raise StopIteration from None


@contextlib.contextmanager
def blocking(address):
    with revisit.Client(address, backoff=QUICK, max_attempts=2) as client:
        yield client


@contextlib.contextmanager
def awaited(address):
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever)
    thread.start()

    def run(coroutine):
        return asyncio.run_coroutine_threadsafe(coroutine, loop).result(LONG)

    async def make():
        return aio.Client(address, backoff=QUICK, max_attempts=2)
    client = run(make())
    try:
        yield InLoop(run, client)
    finally:
        run(client.close())
        loop.call_soon_threadsafe(loop.stop)
        thread.join()
        loop.close()


@pytest.fixture(params=[blocking, awaited], ids=["blocking", "asyncio"])
def connect(request):
    return request.param


@pytest.fixture
def feed():
    return FakeFeed()


@pytest.fixture
def client(feed, connect):
    with serving(feed) as address, connect(address) as made:
        # A loop that waits for what does not come ends with Cancelled.
        rescue = threading.Timer(LONG, made.close)
        rescue.start()
        yield made
        rescue.cancel()


def seen(watch, count):
    """Vehicles and numbers of so many events, all of them worked off."""
    found = []
    for event in watch:
        found.append((event.vehicle.removeprefix("vehicles/"), event.number))
        if len(found) == count:
            watch.done()
            return found


def begun(client, feed, **arguments):
    """A watch from now that has begun: what is told after this comes in it."""
    return client.watch(cursor=feed.cursor(), **arguments)


def test_events_say_what_became_of_a_candidate(client, feed):
    watch = begun(client, feed)
    feed.tell("a", 1)
    feed.tell("a", 2, CONFIRMED)
    feed.tell_deletion("a", 3)
    first, second, last = [next(watch) for _ in range(3)]
    assert first.candidate.name == "vehicles/a/checks/10/candidates/1"
    assert (first.candidate.state, second.candidate.state) == (OPEN, CONFIRMED)
    assert first.evidence.query.sequence == 10
    assert (first.vehicle, first.vehicle_uid, first.number, first.revision) == (
        "vehicles/a", "uid-a", 1, 7)
    assert [one.cursor for one in (first, second, last)] == ["one:1", "one:2", "one:3"]
    assert [one.vehicle_deleted for one in (first, second, last)] == [
        False, False, True]
    assert (last.candidate, last.evidence, last.vehicle) == (None, None, "vehicles/a")
    assert not first.resynchronised


def test_what_is_wanted_is_asked_for(client, feed):
    watch = client.watch(["a", "vehicles/b"], cursor=feed.cursor(),
                         states=["open", CONFIRMED], verdicts="accepted",
                         least_probability=0.25, least_value=0.5)
    feed.tell("a", 1)
    next(watch)
    assert feed.watches == [v1.WatchCandidatesRequest(
        cursor="one:0", filter=v1.CandidateFilter(
            vehicles=["vehicles/a", "vehicles/b"], states=[OPEN, CONFIRMED],
            verdicts=[v1.VERDICT_ACCEPTED], least_probability=0.25,
            least_value_square_meters=0.5))]
    with pytest.raises(ValueError, match="OPEN, CONFIRMED"):
        client.watch(states="opened")


@pytest.mark.parametrize("fault", [
    Fault(Code.UNAVAILABLE), Fault(Code.UNAVAILABLE, reason="SERVER_DRAINING"),
    Fault(Code.UNAVAILABLE, reason="STREAM_AGE"), Fault(Code.INTERNAL), None,
    Fault(Code.RESOURCE_EXHAUSTED, reason="SLOW_CONSUMER"),
    Fault(Code.UNAUTHENTICATED, reason="TOKEN_EXPIRED"),
], ids=lambda fault: f"{fault.code.name}-{fault.reason}" if fault else "OK")
def test_a_watch_resumes_from_the_last_event_that_was_worked_off(client, feed, fault):
    feed.ends = [(2, fault), (0, fault), (1, fault)]
    watch = begun(client, feed)
    for number in range(1, 6):
        feed.tell("a", number)
    assert seen(watch, 5) == [("a", number) for number in range(1, 6)]
    cursors = [one.cursor for one in feed.watches]
    assert len(cursors) == 4
    assert cursors == sorted(cursors)
    assert watch.cursor == "one:5"


@pytest.mark.parametrize("fault", [
    Fault(Code.INTERNAL, reason="INTERNAL"),
    Fault(Code.INVALID_ARGUMENT, reason="INVALID_CURSOR"),
    Fault(Code.OUT_OF_RANGE, reason="LIMIT_EXCEEDED"),
    Fault(Code.RESOURCE_EXHAUSTED, reason="STREAM_QUOTA"),
    Fault(Code.PERMISSION_DENIED, reason="NOT_GRANTED"),
], ids=lambda fault: fault.reason)
def test_a_watch_ends_with(client, feed, fault):
    feed.ends = [(0, fault)]
    with pytest.raises(revisit.Error) as caught:
        next(begun(client, feed))
    assert (caught.value.code, caught.value.reason) == (fault.code, fault.reason)
    assert len(feed.watches) == 1


def test_a_connection_that_brings_nothing_is_given_up(client, feed, monkeypatch):
    for module in ("revisit.watch", "revisit.aio.watch"):
        monkeypatch.setattr(f"{module}.ANSWER_SECONDS", 0.2)
    watch = begun(client, feed)
    threading.Timer(1.0, feed.tell, ("a", 1)).start()
    assert seen(watch, 1) == [("a", 1)]
    assert len(feed.watches) > 1
    # Over a new channel: the old one may lead to what is no more.
    assert len(set(feed.peers)) == len(feed.peers)


def test_events_that_come_again_are_dropped(client, feed):
    feed.copies = 3
    watch = begun(client, feed)
    feed.tell("a", 1)
    feed.tell("b", 1)
    feed.tell("a", 2)
    feed.tell("a", 1)
    feed.tell_deletion("b", 2)
    feed.tell("c", 1)
    assert seen(watch, 5) == [("a", 1), ("b", 1), ("a", 2), ("b", 2), ("c", 1)]
    assert watch.cursor == "one:6"


def test_the_cursor_moves_on_when_the_next_event_is_asked_for(client, feed):
    watch = begun(client, feed)
    feed.tell("a", 1)
    feed.tell("a", 2)
    assert watch.cursor == "one:0"
    assert next(watch).number == 1
    assert watch.cursor == "one:0"
    assert next(watch).number == 2
    assert watch.cursor == "one:1"
    watch.done()
    assert watch.cursor == "one:2"


def test_a_loop_whose_body_raises_gets_the_event_again(client, feed):
    watch = begun(client, feed)
    for number in (1, 2, 3):
        feed.tell("a", number)
    found = []
    with pytest.raises(ZeroDivisionError):
        for event in watch:
            found.append(event.number)
            if event.number == 2:
                raise ZeroDivisionError
    assert found == [1, 2]
    assert seen(watch, 2) == [("a", 2), ("a", 3)]


def test_a_beat_moves_the_cursor_of_a_watch_that_is_told_nothing(client, feed):
    watch = client.watch()
    feed.events = [v1.WatchCandidatesResponse(cursor="one:1", beat=v1.WatchBeat())]
    feed.ends = [(0, Fault(Code.UNAVAILABLE))]
    waiting = threading.Thread(target=next, args=(watch, None))
    waiting.start()
    deadline = time.monotonic() + LONG
    while len(feed.watches) < 2 and time.monotonic() < deadline:
        time.sleep(0.001)
    feed.tell("a", 1)
    waiting.join(LONG)
    # The first connection said where now is; the second did not begin anew.
    assert [one.cursor for one in feed.watches] == ["", "one:1"]


@pytest.mark.parametrize("reason", ["CURSOR_TOO_OLD", "CURSOR_UNKNOWN"])
def test_a_cursor_that_cannot_be_served_is_answered_by_a_list(client, feed, reason):
    watch = begun(client, feed, states=["open", "withdrawn"], least_probability=0.4,
                  verdicts=["accepted", "ambiguous"])
    for number in range(1, 6):
        feed.tell("a", number)
    assert seen(watch, 5)[-1] == ("a", 5)
    feed.checks = [check("a", 10, OPEN, CONFIRMED, OPEN), check("a", 200, CONFIRMED),
                   check("b", 30, CONFIRMED, WITHDRAWN), check("b", 40, CONFIRMED)]
    if reason == "CURSOR_UNKNOWN":
        # A store that was restored has less, and counts again from where it was.
        feed.store, feed.events = "two", feed.events[:2]
    else:
        feed.tell("a", 6)
        feed.oldest = len(feed.events)
    resumed = len(feed.events)
    watch = iter(watch)
    first, second = next(watch), next(watch)
    assert [(one.candidate.name, one.candidate.state) for one in (first, second)] == [
        ("vehicles/a/checks/10/candidates/1", OPEN),
        ("vehicles/b/checks/30/candidates/2", WITHDRAWN)]
    assert (second.evidence.rank, second.evidence.matched.sequence) == (2, 2)
    assert second.revision == 130
    assert first.resynchronised and second.resynchronised
    # Only behind the last one of the list nothing of it is missing.
    assert (first.cursor, second.cursor) == ("one:5", f"{feed.store}:{resumed}")
    assert feed.lists[0].parent == "vehicles/-"
    assert feed.lists[0].filter == feed.watches[0].filter
    # Told with a number that was told before, by another history.
    number = 3 if reason == "CURSOR_UNKNOWN" else 7
    feed.tell("a", number)
    event = next(watch)
    assert (event.number, event.resynchronised) == (number, False)
    assert feed.watches[-1].cursor == f"{feed.store}:{resumed}"


def test_a_list_in_which_nothing_matches_moves_the_cursor(client, feed):
    feed.oldest = 1
    feed.checks = [check("a", 10, CONFIRMED), check("a", 20, OPEN)]
    watch = client.watch(cursor="one:0", states=["open", "rejected"],
                         verdicts="ambiguous")
    feed.tell("a", 1)
    feed.ends = [(0, None), (0, Fault(Code.UNAVAILABLE))]
    threading.Timer(0.3, feed.tell, ("a", 2)).start()
    assert seen(watch, 1) == [("a", 2)]
    assert [one.cursor for one in feed.watches] == ["one:0", "one:1", "one:1"]


def test_a_list_is_read_on_when_the_server_comes_back(client, feed):
    feed.checks = [check("a", sequence, OPEN) for sequence in (1, 2, 3)]
    feed.list_faults = [Fault(Code.UNAVAILABLE)] * 7 + [Fault(Code.DEADLINE_EXCEEDED)]
    watch = client.watch(from_start=True)
    names = [next(watch).candidate.name for _ in range(3)]
    assert names == [f"vehicles/a/checks/{sequence}/candidates/1"
                     for sequence in (1, 2, 3)]


def test_a_watch_from_the_start_begins_with_what_is_stored(client, feed, tmp_path):
    feed.tell("a", 1)
    feed.checks = [check("a", 10, OPEN), check("a", 20, OPEN)]
    path = tmp_path / "cursor"
    found = []
    with pytest.raises(ZeroDivisionError):
        for event in client.watch(cursor_file=path, from_start=True):
            found.append(event.candidate.name[-15:])
            if len(found) == 2:
                raise ZeroDivisionError
    # The list was not worked off, so there is no cursor yet.
    assert not path.exists()
    for event in client.watch(cursor_file=path, from_start=True):
        found.append(event.candidate.name[-15:])
        if not event.resynchronised:
            break
        feed.tell("a", 2)
    assert found == ["10/candidates/1", "20/candidates/1"] * 2 + ["20/candidates/1"]
    assert path.read_text() == "one:1\n"
    # It has a cursor by now, and goes on there.
    lists = len(feed.lists)
    assert seen(client.watch(cursor_file=path, from_start=True), 1) == [("a", 2)]
    assert len(feed.lists) == lists


def test_a_list_without_a_cursor_ends_the_watch(client, feed, monkeypatch):
    monkeypatch.setattr(feed, "cursor", lambda: "")
    with pytest.raises(revisit.Internal, match="no watch_cursor"):
        next(client.watch(from_start=True))


def test_a_cursor_is_kept_once_the_next_event_is_asked_for(client, feed, tmp_path):
    path = tmp_path / "x.cursor"
    path.write_text("one:0\n")
    for number in (1, 2, 3):
        feed.tell("a", number)
    kept = []
    with pytest.raises(ZeroDivisionError):
        for event in client.watch(cursor_file=path):
            kept.append((event.number, path.read_text()))
            if event.number == 3:
                raise ZeroDivisionError
    assert kept == [(1, "one:0\n"), (2, "one:1\n"), (3, "one:2\n")]
    assert seen(client.watch(cursor_file=CursorFile(path)), 1) == [("a", 3)]
    assert path.read_text() == "one:3\n"
    with pytest.raises(ValueError, match="from one of them"):
        client.watch(cursor="one:0", cursor_file=path)


def test_an_event_whose_cursor_cannot_be_kept_is_not_worked_off(client, feed,
                                                                tmp_path):
    path = tmp_path / "away" / "x.cursor"
    feed.tell("a", 1)
    path.parent.mkdir()
    path.write_text("one:0\n")
    watch = client.watch(cursor_file=path)
    assert next(watch).number == 1
    path.unlink()
    path.parent.rmdir()
    with pytest.raises(FileNotFoundError):
        next(watch)
    assert watch.cursor == "one:0"
    path.parent.mkdir()
    assert seen(watch, 1) == [("a", 1)]


def test_a_watch_that_is_closed_ends_its_loop(client, feed):
    watch = begun(client, feed)
    feed.tell("a", 1)
    closing = threading.Timer(0.3, watch.close)
    closing.start()
    assert [event.number for event in watch] == [1]
    assert watch.cursor == "one:1"
    closing.join()


def test_a_client_that_is_closed_ends_the_loops_of_its_watches(feed, connect):
    with serving(feed) as address, connect(address) as client:
        feed.ends = [(0, Fault(Code.UNAVAILABLE, retry=50))] * 2
        threading.Timer(0.3, client.close).start()
        begin = time.monotonic()
        with pytest.raises(revisit.Cancelled, match="the client is closed"):
            next(begun(client, feed))
        assert time.monotonic() - begin < 40


def test_a_loop_that_is_left_ends_its_connection(client, feed):
    feed.tell("a", 1)
    for _ in client.watch(cursor="one:0"):
        break
    gc.collect()
    assert feed.ended.wait(LONG)


def test_candidates_are_decided_by_name(client, feed):
    watch = begun(client, feed)
    feed.tell("a", 1)
    feed.tell_deletion("a", 2)
    event = next(watch)
    event.confirm((1.0, 2.0, 0.1), [0.01, 0.0, 0.0, 0.01, 0.0, 0.001], note="icp")
    event.reject(note="a bridge")
    name = "vehicles/a/checks/10/candidates/1"
    client.add_loop_closure("a", 7, 3, candidate=name)
    client.reject_candidate("a", 7, 3, candidate=name)
    confirmed, rejected, added, refused = feed.decisions
    assert {one.candidate for one in feed.decisions} == {name}
    assert {one.parent for one in feed.decisions} == {"vehicles/a"}
    assert confirmed.loop_closure.query_sequence == 10
    assert confirmed.loop_closure.measurement.heading_radians == 0.1
    assert (confirmed.loop_closure.note, rejected.rejected_candidate.note) == (
        "icp", "a bridge")
    assert rejected.rejected_candidate.matched_sequence == 1
    assert (added.loop_closure.query_sequence,
            refused.rejected_candidate.matched_sequence) == (7, 3)
    with pytest.raises(ValueError, match="vehicles/a was deleted"):
        next(watch).reject()


def test_an_event_has_the_value_of_its_candidate(client, feed):
    watch = begun(client, feed)
    feed.tell("a", 1)
    feed.events[-1].candidate.candidate.value_square_meters = 2.5
    assert next(watch).candidate.value_square_meters == 2.5


def test_a_list_tells_what_the_last_search_found(client, feed):
    feed.checks = [
        searched_again(check("a", 9, OPEN, OPEN), 2, probability=0.7, value=2.5),
        searched_again(check("a", 10, OPEN), 1, probability=0.2, value=0.5)]
    # Only a search between the first one and the last one found it.
    feed.checks[1].states.add(name="vehicles/a/checks/10/candidates/2", state=OPEN)
    events = client.watch(from_start=True)
    told = [next(events) for _ in range(4)]
    assert [one.evidence.probability for one in told] == [0.9, 0.7, 0.2, 0.0]
    assert [one.revision for one in told] == [109, 200, 200, 110]
    events = client.watch(from_start=True, least_probability=0.5)
    assert [next(events).evidence.probability for _ in range(2)] == [0.9, 0.7]
    events = client.watch(from_start=True, least_value=2.0)
    assert next(events).evidence.probability == 0.7
    assert revisit.evidence_of(feed.checks[1], feed.checks[1].states[1]) is None


def contradicted(client, feed):
    """The event of a candidate whose loop closure others contradict."""
    watch = begun(client, feed)
    feed.tell("a", 1)
    feed.closures = [closure("a", "other", 90, 80), closure("a", "wrong", 11, 1)]
    told = feed.events[-1].candidate.candidate
    told.cause = v1.CANDIDATE_CAUSE_CONTRADICTION
    told.decision = feed.closures[1].name
    return next(watch)


def test_a_contradicted_closure_is_upheld_as_it_is(client, feed):
    event = contradicted(client, feed)
    assert event.is_contradicted
    event.uphold()
    [added] = feed.decisions
    assert (added.parent, added.loop_closure_id) == ("vehicles/a", "wrong")
    assert added.loop_closure == feed.closures[1]
    assert added.candidate == "vehicles/a/checks/10/candidates/1"


def test_a_contradicted_closure_that_is_gone_is_not_replaced(client, feed):
    event = contradicted(client, feed)
    assert event.contradicted_closure() == feed.closures.pop()
    with pytest.raises(LookupError, match="loopClosures/wrong is gone"):
        event.uphold()
    assert feed.decisions == []


def test_only_a_contradicted_closure_is_upheld(client, feed):
    watch = begun(client, feed)
    feed.tell("a", 1)
    feed.tell_deletion("a", 2)
    event = next(watch)
    assert not event.is_contradicted
    with pytest.raises(ValueError, match="no loop closure of vehicles/a"):
        event.uphold()
    with pytest.raises(ValueError, match="vehicles/a was deleted"):
        next(watch).uphold()
    assert feed.decisions == []


def test_contradictions_are_found(client, feed):
    feed.contradictions = [v1.Contradiction(loop_closure="x", p_value=0.001),
                           v1.Contradiction(loop_closure="y", p_value=0.002)]
    assert client.find_contradictions("a") == feed.contradictions


def test_checks_are_listed_by_value(client, feed):
    feed.checks = [check("a", 10, OPEN), check("a", 9, OPEN), check("a", 10, OPEN)]
    listed = client.list_checks("a", states="open", least_value=0.5, order="value",
                                fresh_only=True, looks_per_kilometer=2)
    # One that moved over the edge of a page comes once.
    assert [one.name[-2:] for one in listed] == ["10", "/9"]
    asked = feed.lists[0]
    assert (asked.order, asked.fresh_only, asked.looks_per_kilometer) == (
        v1.LIST_CHECKS_ORDER_BY_VALUE, True, 2)
    assert asked.filter.least_value_square_meters == 0.5
    with pytest.raises(ValueError, match="'size': expected one of time, value"):
        client.list_checks(order="size")
    # By time they are in order.
    with pytest.raises(revisit.Internal, match="does not go on"):
        list(client.list_checks("a", order="time"))


def test_checks_are_listed_page_by_page_with_the_cursor_of_the_first(client, feed):
    feed.checks = [check("a", 9, OPEN), check("a", 10, OPEN), check("b", 1, OPEN)]
    listed = client.list_checks(states="open", verdicts=["accepted", "ambiguous"],
                                least_probability=0.1)
    feed.tell("a", 1)
    assert listed.watch_cursor() == "one:1"
    feed.tell("a", 2)
    assert [one.name for one in listed] == [one.name for one in feed.checks]
    assert listed.watch_cursor() == "one:1"
    assert [one.page_token for one in feed.lists] == ["", "1", "2"]
    assert feed.lists[0].parent == "vehicles/-"
    assert feed.lists[0].filter == v1.CandidateFilter(
        states=[OPEN], verdicts=[v1.VERDICT_ACCEPTED, v1.VERDICT_AMBIGUOUS],
        least_probability=0.1)
    assert next(client.list_checks("a")) == feed.checks[0]
    assert feed.lists[-1].parent == "vehicles/a"
    assert client.get_check("vehicles/a/checks/10") == feed.checks[1]


def test_a_list_of_checks_that_does_not_go_on_ends_with_an_error(client, feed):
    feed.checks = [check("a", 10, OPEN), check("a", 9, OPEN)]
    with pytest.raises(revisit.Internal, match="does not go on"):
        list(client.list_checks())
    with pytest.raises(revisit.Internal, match="does not go on"):
        seen(client.watch(from_start=True), 2)


def test_a_cursor_file_holds_the_old_cursor_or_the_new_one(tmp_path, monkeypatch):
    file = CursorFile(tmp_path / "x.cursor")
    assert file.load() == ""
    file.store("one")
    assert file.load() == CursorFile(str(file.path)).load() == "one"
    synced, calls = [], []
    sync, replace = os.fsync, os.replace

    def noted_sync(descriptor):
        synced.append(pathlib.Path(f"/proc/self/fd/{descriptor}").resolve().name)
        sync(descriptor)

    def refused(partial, final):
        calls.append((pathlib.Path(partial).read_text(), list(synced)))
        raise OSError("the power is gone")

    monkeypatch.setattr(os, "fsync", noted_sync)
    monkeypatch.setattr(os, "replace", refused)
    with pytest.raises(OSError, match="power"):
        file.store("two")
    # What is about to get the name is whole, and on the device.
    assert calls == [("two\n", ["x.cursor.partial"])]
    assert file.load() == "one"
    monkeypatch.setattr(os, "replace", replace)
    file.store("three")
    assert synced[1:] == ["x.cursor.partial", tmp_path.name]
    assert file.load() == "three"
    assert [one.name for one in tmp_path.iterdir()] == ["x.cursor"]


def test_a_file_without_a_cursor_is_refused(tmp_path):
    (tmp_path / "x.cursor").write_text("\n")
    with pytest.raises(ValueError, match="holds no cursor"):
        CursorFile(tmp_path / "x.cursor").load()


@pytest.mark.parametrize("kind", ["CheckList", "Watch", "WatchEvent"])
def test_both_have_the_same_members_and_arguments(kind):
    made, other = getattr(revisit, kind), getattr(aio, kind)
    for name in {*vars(made), *vars(other)}:
        if name.startswith("_"):
            continue
        assert getattr(made, name).__doc__ == getattr(other, name).__doc__ != ""
        if callable(getattr(made, name)):
            assert (inspect.signature(getattr(made, name)).parameters
                    == inspect.signature(getattr(other, name)).parameters), name
