"""The connections of a stream of poses, one after the other, in tasks: one makes the
connections and watches over them, `Engine._run()`; each connection has one that reads
its answers and runs the callbacks, and gRPC has one that asks `Engine._requests()` for
the next message."""

from __future__ import annotations

import asyncio
import inspect
import time
from collections.abc import AsyncIterator
from typing import Any, Callable, Optional

import grpc

from revisit import v1
from revisit._stream_state import Connection, StreamState
from revisit.aio._channels import AioChannels
from revisit.aio._signal import Signal
from revisit.channel import Caller, Lease, owner_route, stub_of
from revisit.errors import Cancelled, Error, from_rpc_error

#: How long gRPC may take to end a call that was cancelled, in seconds.
CANCEL_SECONDS = 10.0


async def _run(call: Callable[[], object]) -> None:
    answer = call()
    if inspect.isawaitable(answer):
        await answer


class Engine:
    """The tasks that move a stream; `changed` is notified of all that somebody may
    wait for."""

    def __init__(self, channels: AioChannels, caller: Caller,
                 state: StreamState) -> None:
        self._channels = channels
        self._caller = caller
        self._state = state
        self.changed = Signal()
        self._task: Optional[asyncio.Task[None]] = None
        self._reader: Optional[asyncio.Task[None]] = None

    def start(self) -> None:
        self._task = asyncio.get_running_loop().create_task(self._run())

    async def join(self) -> None:
        """Waits until no callback runs, unless a callback asks for it."""
        here = asyncio.current_task()
        for task in (self._task, self._reader):
            if task is not None and here not in (self._task, self._reader):
                # The reader ends with its call; only one that gRPC forgets stays.
                await asyncio.wait({task}, timeout=None if task is self._task
                                   else CANCEL_SECONDS)

    async def _run(self) -> None:
        error: Optional[BaseException] = None
        try:
            while True:
                connection = Connection(owner_route(error))
                error = await self._hold(connection)
                wait = self._state.wait_before_next(connection, error)
                if wait is None:
                    return
                heard = self._state.callbacks.disconnected
                if heard is not None:
                    assert isinstance(error, Error)
                    lost, seconds = error, wait
                    await _run(lambda: heard(lost, seconds))
                await self.changed.wait_for(lambda: self._state.cancelled, wait)
        except asyncio.CancelledError:
            self._state.end(Cancelled("the tasks of the event loop were cancelled"))
            raise
        except BaseException as raised:
            self._state.end(raised)
        finally:
            self.changed.notify()

    async def _hold(self, connection: Connection) -> Optional[BaseException]:
        """Holds one connection until it is over. None if the server ended it in
        answer to our half-close."""
        try:
            with self._channels.lease() as lease:
                error = await self._hold_on(lease, connection)
                if isinstance(error, Error):
                    self._channels.report(lease, error)
                return error
        except Error as error:
            return error

    async def _hold_on(self, lease: Lease,
                       connection: Connection) -> Optional[BaseException]:
        state = self._state
        if state.cancelled:
            return Cancelled("the stream was cancelled")
        state.pending.start_over()
        connection.request_id, metadata = self._caller.metadata()
        connection.call = stub_of(lease.channel).StreamPoses(
            self._requests(connection), metadata=metadata + connection.route)
        self._reader = asyncio.get_running_loop().create_task(self._read(connection))
        try:
            while state.is_to_be_watched(connection):
                left = state.seconds_to_stall(connection)
                if connection.verdict is None:
                    await self.changed.wait(left)
            if connection.verdict is not None or state.cancelled:
                connection.call.cancel()
            await self._wait_for_end(connection)
        except asyncio.CancelledError:
            self._reader.cancel()
            connection.call.cancel()
            raise
        finally:
            connection.over = True
            self.changed.notify()
        return state.over(connection)

    async def _wait_for_end(self, connection: Connection) -> None:
        """Waits for the reader of a connection that has ended or was cancelled."""
        deadline = time.monotonic() + CANCEL_SECONDS
        self.changed.notify()
        while not connection.over:
            left = deadline - time.monotonic()
            if connection.in_callback:
                await self.changed.wait()
                deadline = time.monotonic() + CANCEL_SECONDS
            elif left > 0.0:
                await self.changed.wait(left)
            else:
                # gRPC did not even end the call that was cancelled.
                assert self._reader is not None
                self._reader.cancel()
                return

    async def _requests(self, connection: Connection
                        ) -> AsyncIterator[v1.StreamPosesRequest]:
        yield self._state.opening()
        while True:
            await self.changed.wait_for(lambda: self._state.may_send(connection))
            request = self._state.next_request(connection)
            self.changed.notify()
            if request is None:
                return
            yield request

    async def _read(self, connection: Connection) -> None:
        error: Optional[BaseException] = None
        try:
            await self._read_all(connection)
        except grpc.RpcError as raised:
            error = from_rpc_error(raised, connection.request_id)
        except asyncio.CancelledError:
            # The call was, by whoever has a reason, or its channel was closed.
            error = Cancelled("the client is closed")
        except BaseException as raised:
            error = raised
        connection.error = error
        connection.over = True
        self.changed.notify()

    async def _read_all(self, connection: Connection) -> None:
        response: Any
        async for response in connection.call:
            if connection.over:
                return
            resumed = self._state.digest(connection, response)
            connection.in_callback = True
            self.changed.notify()
            try:
                for call in self._state.hearers(response, resumed):
                    await _run(call)
                if (response.HasField("candidates")
                        and self._state.callbacks.candidates is None):
                    await self._keep(connection, response.candidates)
            except asyncio.CancelledError:
                raise
            except BaseException as raised:
                connection.verdict = raised
            finally:
                connection.in_callback = False
            if connection.verdict is not None:
                return
            connection.quiet_since = time.monotonic()
            self.changed.notify()

    async def _keep(self, connection: Connection, answer: v1.CandidateSet) -> None:
        """Waits for room among the answers that wait to be taken."""
        state = self._state
        if not state.has_room_for_answer():
            state.reader_waits = True
            self.changed.notify()
            await self.changed.wait_for(lambda: state.has_room_for_answer()
                                        or state.cancelled or connection.over)
            state.reader_waits = False
        state.waiting.append(answer)
        self.changed.notify()
