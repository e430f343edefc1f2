"""Stored candidates as they are found and decided."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Iterator
from types import TracebackType
from typing import TYPE_CHECKING, Any, Optional, Union

import grpc
from numpy.typing import ArrayLike

from revisit import v1
from revisit._calls import CheckPages
from revisit._condition import Condition
from revisit._watch_state import ANSWER_SECONDS, EventFields, WatchState
from revisit.channel import Caller, Channels, Lease, stub_of
from revisit.errors import Cancelled, Error, Unavailable, from_rpc_error

if TYPE_CHECKING:
    from revisit.client import Client


class CheckList(Iterator[v1.Check]):
    """Made by `Client.list_checks()`: the checks, read page by page as they are
    taken."""

    def __init__(self, client: Client, pages: CheckPages) -> None:
        self._client = client
        self._pages = pages

    def watch_cursor(self) -> str:
        """Where `Client.watch()` goes on, so that the list and the watch leave nothing
        out between them; what changed while the list was read comes in both."""
        if self._pages.watch_cursor is None:
            self._read()
        return self._pages.watch_cursor or ""

    def _read(self) -> None:
        self._pages.take(self._client._run(self._pages.call()))

    def __next__(self) -> v1.Check:
        while not self._pages.checks:
            if self._pages.is_read:
                raise StopIteration
            self._read()
        return self._pages.checks.popleft()


@dataclasses.dataclass(frozen=True)
class WatchEvent(EventFields):
    """A candidate came into a state, or a vehicle was deleted with its candidates."""

    client: Client = dataclasses.field(repr=False, compare=False)

    def confirm(self, relative: Optional[ArrayLike] = None,
                covariance: Optional[ArrayLike] = None, *,
                score: Optional[float] = None, note: str = ""
                ) -> v1.AddLoopClosureResponse:
        """Reports that a verifier found the two poses of the candidate to be one place:
        `Client.add_loop_closure()`. To do it again with the same arguments is the same
        as to do it once; with another measurement it is AlreadyExists."""
        name, evidence = decided(self)
        return self.client.add_loop_closure(
            self.vehicle, evidence, relative=relative, covariance=covariance,
            score=score, note=note, candidate=name)

    def reject(self, note: str = "") -> v1.RejectCandidateResponse:
        """Reports that a verifier found the candidate not to be a revisit:
        `Client.reject_candidate()`, as `confirm()`."""
        name, evidence = decided(self)
        return self.client.reject_candidate(self.vehicle, evidence, note=note,
                                            candidate=name)


    def contradicted_closure(self) -> v1.LoopClosure:
        """The loop closure that `is_contradicted`. ValueError if none is, LookupError
        if it is gone. To give it up, delete it:

            client.delete_loop_closure(event.contradicted_closure().name)
        """
        name = contradicted(self)
        for closure in self.client.list_loop_closures(self.vehicle):
            if closure.name == name:
                return closure
        raise LookupError(f"{name} is gone")

    def uphold(self) -> v1.AddLoopClosureResponse:
        """Reports that a second look at a contradicted loop closure found it right: it
        is added again as it is, in the name of the candidate, which is confirmed. A
        closure is contradicted once."""
        closure = self.contradicted_closure()
        return self.client.add_loop_closure(
            self.vehicle, closure, candidate=decided(self)[0],
            loop_closure_id=closure.name.rpartition("/")[2])


def contradicted(event: EventFields) -> str:
    """The name of the loop closure that contradicts others."""
    decided(event)
    if event.candidate is None or not event.is_contradicted:
        raise ValueError(f"no loop closure of {event.vehicle} is contradicted by this "
                         "event")
    return event.candidate.decision


def decided(event: EventFields) -> tuple[str, v1.Candidate]:
    """The name of the candidate that is decided, and what was found."""
    if event.candidate is None or event.evidence is None:
        raise ValueError(f"{event.vehicle} was deleted: there is nothing to decide")
    return event.candidate.name, event.evidence


class _Connection:
    """One call, and the thread that reads it: gRPC cannot be asked to wait for an
    answer for so long."""

    def __init__(self, channels: Channels, caller: Caller,
                 request: v1.WatchCandidatesRequest) -> None:
        self._channels = channels
        self._caller = caller
        self._request = request
        self._changed = Condition()
        self._call: Any = None
        self._lease: Optional[Lease] = None
        self._waiting: Optional[v1.WatchCandidatesResponse] = None
        self._error: Optional[BaseException] = None
        self._closed = False
        # A daemon, so that a call that never ends does not keep the program.
        threading.Thread(target=self._hold, daemon=True,
                         name="revisit watch").start()

    def read(self) -> v1.WatchCandidatesResponse:
        """The next answer. Raises why there is none."""
        deadline = time.monotonic() + ANSWER_SECONDS
        with self._changed:
            while self._waiting is None and self._error is None and not self._closed:
                left = deadline - time.monotonic()
                if left <= 0.0:
                    self._error = Unavailable(f"no answer for {ANSWER_SECONDS:g} s")
                else:
                    self._changed.wait(left)
            if self._waiting is None:
                raise self._error or Cancelled("the watch is closed")
            answer, self._waiting = self._waiting, None
            self._changed.notify_all()
            return answer

    def report(self, error: Error) -> None:
        """Lets the next connection have a new channel if this error asks for it."""
        if self._lease is not None:
            self._channels.report(self._lease, error)

    def close(self) -> None:
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        if self._call is not None:
            self._call.cancel()

    def _hold(self) -> None:
        error: BaseException = Unavailable("the server ended the watch")
        request_id = ""
        try:
            request_id, metadata = self._caller.metadata()
            with self._channels.lease() as self._lease:
                # Without the lock: gRPC has locks of its own.
                call = stub_of(self._lease.channel).WatchCandidates(
                    self._request, metadata=metadata)
                self._call = call
                if self._closed:
                    call.cancel()
                self._read_all(call)
        except grpc.RpcError as raised:
            error = from_rpc_error(raised, request_id)
        except ValueError as raised:
            # gRPC refuses calls on a channel that was closed meanwhile.
            error = Cancelled(f"the watch cannot be opened: {raised}")
        except BaseException as raised:
            error = raised
        with self._changed:
            self._error = self._error or error
            self._changed.notify_all()

    def _read_all(self, call: Any) -> None:
        for answer in call:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting is None or self._closed)
                if self._closed:
                    return
                self._waiting = answer
                self._changed.notify_all()


class Watch(Iterator[WatchEvent]):
    """Made by `Client.watch()`: the events of stored candidates, without end, over as
    many connections as it takes. For one thread at a time, but for `close()`.

    An event is worked off once the loop asks for the next one. A loop that is left by
    an exception or by `break` has not worked off its last event: the next loop over
    this watch, or a watch from the same cursor, begins with it. Whoever has to leave
    one in good order calls `done()` before."""

    _connection: Optional[_Connection] = None

    def __init__(self, client: Client, channels: Channels, caller: Caller,
                 state: WatchState[WatchEvent]) -> None:
        self._client = client
        self._channels = channels
        self._caller = caller
        self._state = state
        self._closing = threading.Event()

    @property
    def cursor(self) -> str:
        """Behind the last event that was worked off. Empty before the server has told
        where a watch that goes on from now begins."""
        return self._state.cursor

    def done(self) -> None:
        """Says that the event in hand is worked off, as asking for the next one
        does."""
        self._keep(self._state.cursor_to_keep)
        self._state.worked_off()

    def close(self) -> None:
        """Ends the loop and the connection; the event in hand is not worked off by
        that. From any thread."""
        self._closing.set()
        connection = self._connection
        if connection is not None:
            connection.close()

    def __enter__(self) -> Watch:
        return self

    def __exit__(self, kind: Optional[type[BaseException]],
                 error: Optional[BaseException],
                 trace: Optional[TracebackType]) -> None:
        self.close()

    def __del__(self) -> None:
        self._drop()

    def __iter__(self) -> Watch:
        self._drop()
        self._state.begin()
        return self

    def __next__(self) -> WatchEvent:
        self.done()
        while True:
            if self._channels.is_closed:
                raise Cancelled("the client is closed")
            if self._closing.is_set():
                raise StopIteration
            pages = self._state.pages
            found = self._read() if pages is None else self._list(pages)
            if isinstance(found, WatchEvent):
                return found
            if found is not None and not self._closing.is_set():
                self._closing.wait(self._state.wait_after(found))

    def _list(self, pages: CheckPages) -> Union[WatchEvent, Error, None]:
        """A step on through the list."""
        if self._state.needs_page:
            try:
                page = self._client._run(pages.call())
            except Error as error:
                return error
            self._state.take_page(page)
            return None
        event = self._state.next_listed()
        if event is None:
            self._keep(pages.watch_cursor)
        return event

    def _read(self) -> Union[WatchEvent, Error, None]:
        """Waits for an answer."""
        if self._connection is None:
            self._connection = _Connection(self._channels, self._caller,
                                           self._state.request())
        try:
            answer = self._connection.read()
        except Error as error:
            self._connection.report(error)
            self._drop()
            return error
        event = self._state.take(answer)
        if event is None:
            self._keep(answer.cursor)
        return event

    def _keep(self, cursor: Optional[str]) -> None:
        """Moves the cursor, in the file first."""
        if cursor and cursor != self._state.cursor:
            if self._state.file is not None:
                self._state.file.store(cursor)
            self._state.cursor = cursor

    def _drop(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()
