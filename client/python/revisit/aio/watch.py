"""Stored candidates as they are found and decided, for asyncio."""

from __future__ import annotations

import asyncio
import contextlib
import dataclasses
from collections.abc import AsyncIterator
from types import TracebackType
from typing import TYPE_CHECKING, Any, Optional, Union

import grpc
from numpy.typing import ArrayLike

from revisit import v1, watch
from revisit._calls import CheckPages
from revisit._watch_state import ANSWER_SECONDS, EventFields, WatchState
from revisit.aio._channels import AioChannels
from revisit.aio._signal import Signal
from revisit.aio.pose_stream import document
from revisit.channel import Caller, Lease, stub_of
from revisit.errors import Cancelled, Error, Unavailable, from_rpc_error
from revisit.watch import contradicted, decided

if TYPE_CHECKING:
    from revisit.aio.client import Client


class CheckList(AsyncIterator[v1.Check]):
    """Made by `Client.list_checks()`: the checks, read page by page as they are
    taken."""

    def __init__(self, client: Client, pages: CheckPages) -> None:
        self._client = client
        self._pages = pages

    async def watch_cursor(self) -> str:
        if self._pages.watch_cursor is None:
            await self._read()
        return self._pages.watch_cursor or ""

    async def _read(self) -> None:
        self._pages.take(await self._client._run(self._pages.call()))

    async def __anext__(self) -> v1.Check:
        while not self._pages.checks:
            if self._pages.is_read:
                raise StopAsyncIteration
            await self._read()
        return self._pages.checks.popleft()


@dataclasses.dataclass(frozen=True)
class WatchEvent(EventFields):
    """A candidate came into a state, or a vehicle was deleted with its candidates."""

    client: Client = dataclasses.field(repr=False, compare=False)

    async def confirm(self, relative: Optional[ArrayLike] = None,
                      covariance: Optional[ArrayLike] = None, *,
                      score: Optional[float] = None, note: str = ""
                      ) -> v1.AddLoopClosureResponse:
        name, evidence = decided(self)
        return await self.client.add_loop_closure(
            self.vehicle, evidence, relative=relative, covariance=covariance,
            score=score, note=note, candidate=name)

    async def reject(self, note: str = "") -> v1.RejectCandidateResponse:
        name, evidence = decided(self)
        return await self.client.reject_candidate(self.vehicle, evidence, note=note,
                                                  candidate=name)

    async def contradicted_closure(self) -> v1.LoopClosure:
        name = contradicted(self)
        async for closure in self.client.list_loop_closures(self.vehicle):
            if closure.name == name:
                return closure
        raise LookupError(f"{name} is gone")

    async def uphold(self) -> v1.AddLoopClosureResponse:
        closure = await self.contradicted_closure()
        return await self.client.add_loop_closure(
            self.vehicle, closure, candidate=decided(self)[0],
            loop_closure_id=closure.name.rpartition("/")[2])


class _Connection:
    """One call, and the task that reads it."""

    def __init__(self, channels: AioChannels, caller: Caller,
                 request: v1.WatchCandidatesRequest) -> None:
        self._channels = channels
        self._caller = caller
        self._request = request
        self._changed = Signal()
        self._lease: Optional[Lease] = None
        self._waiting: Optional[v1.WatchCandidatesResponse] = None
        self._error: Optional[BaseException] = None
        self._loop = asyncio.get_running_loop()
        self._task = self._loop.create_task(self._hold())

    async def read(self) -> v1.WatchCandidatesResponse:
        """The next answer. Raises why there is none."""
        await self._changed.wait_for(
            lambda: self._waiting is not None or self._error is not None,
            ANSWER_SECONDS)
        if self._waiting is None:
            raise self._error or Unavailable(f"no answer for {ANSWER_SECONDS:g} s")
        answer, self._waiting = self._waiting, None
        self._changed.notify()
        return answer

    def report(self, error: Error) -> None:
        """Lets the next connection have a new channel if this error asks for it."""
        if self._lease is not None:
            self._channels.report(self._lease, error)

    def close(self) -> None:
        # Also by the collector of garbage, in any thread, when the loop may be over.
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._task.cancel)

    async def _hold(self) -> None:
        error: BaseException = Unavailable("the server ended the watch")
        request_id = ""
        try:
            request_id, metadata = self._caller.metadata()
            with self._channels.lease() as self._lease:
                await self._read_all(stub_of(self._lease.channel).WatchCandidates(
                    self._request, metadata=metadata))
        except grpc.RpcError as raised:
            error = from_rpc_error(raised, request_id)
        except asyncio.CancelledError:
            # The task was, or the call, since its channel was closed.
            error = Cancelled("the watch is closed")
        except BaseException as raised:
            error = raised
        self._error = error
        self._changed.notify()

    async def _read_all(self, call: Any) -> None:
        try:
            async for answer in call:
                await self._changed.wait_for(lambda: self._waiting is None)
                self._waiting = answer
                self._changed.notify()
        finally:
            call.cancel()


class Watch(AsyncIterator[WatchEvent]):
    """Made by `Client.watch()`: a `revisit.Watch` that is iterated with `async for`, by
    one task at a time. It keeps its cursor the same way: also a loop whose task is
    cancelled has not worked off its last event."""

    _connection: Optional[_Connection] = None

    def __init__(self, client: Client, channels: AioChannels, caller: Caller,
                 state: WatchState[WatchEvent]) -> None:
        self._client = client
        self._channels = channels
        self._caller = caller
        self._state = state
        self._closed = False
        self._changed = Signal()

    @property
    def cursor(self) -> str:
        return self._state.cursor

    async def done(self) -> None:
        await self._keep(self._state.cursor_to_keep)
        self._state.worked_off()

    async def close(self) -> None:
        self._closed = True
        self._changed.notify()
        if self._connection is not None:
            self._connection.close()

    async def __aenter__(self) -> Watch:
        return self

    async def __aexit__(self, kind: Optional[type[BaseException]],
                        error: Optional[BaseException],
                        trace: Optional[TracebackType]) -> None:
        await self.close()

    def __del__(self) -> None:
        self._drop()

    def __aiter__(self) -> Watch:
        self._drop()
        self._state.begin()
        return self

    async def __anext__(self) -> WatchEvent:
        await self.done()
        while True:
            if self._channels.is_closed:
                raise Cancelled("the client is closed")
            if self._closed:
                raise StopAsyncIteration
            pages = self._state.pages
            found = await (self._read() if pages is None else self._list(pages))
            if isinstance(found, WatchEvent):
                return found
            if found is not None and not self._closed:
                await self._changed.wait_for(lambda: self._closed,
                                             self._state.wait_after(found))

    async def _list(self, pages: CheckPages) -> Union[WatchEvent, Error, None]:
        """A step on through the list."""
        if self._state.needs_page:
            try:
                page = await self._client._run(pages.call())
            except Error as error:
                return error
            self._state.take_page(page)
            return None
        event = self._state.next_listed()
        if event is None:
            await self._keep(pages.watch_cursor)
        return event

    async def _read(self) -> Union[WatchEvent, Error, None]:
        """Waits for an answer."""
        if self._connection is None:
            self._connection = _Connection(self._channels, self._caller,
                                           self._state.request())
        try:
            answer = await self._connection.read()
        except Error as error:
            self._connection.report(error)
            self._drop()
            return error
        event = self._state.take(answer)
        if event is None:
            await self._keep(answer.cursor)
        return event

    async def _keep(self, cursor: Optional[str]) -> None:
        """Moves the cursor, in the file first."""
        if cursor and cursor != self._state.cursor:
            if self._state.file is not None:
                # To wait for the device keeps the event loop from nothing.
                await asyncio.to_thread(self._state.file.store, cursor)
            self._state.cursor = cursor

    def _drop(self) -> None:
        connection, self._connection = self._connection, None
        if connection is not None:
            connection.close()


for own in (CheckList, WatchEvent, Watch):
    document(own, getattr(watch, own.__name__))
