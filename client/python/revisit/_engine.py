"""The connections of a stream of poses, one after the other, in threads: one makes
the connections and watches over them, `Engine._run()`; each connection has one that
reads its answers and runs the callbacks, and gRPC has one that asks
`Engine._requests()` for the next message.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Optional

import grpc

from revisit import v1
from revisit._condition import INTERRUPT_SECONDS, Condition
from revisit._stream_state import Connection, StreamState
from revisit.channel import Caller, Channels, Lease, owner_route, stub_of
from revisit.errors import Cancelled, Error, from_rpc_error

#: How long gRPC may take to end a call that was cancelled, in seconds.
CANCEL_SECONDS = 10.0


class Engine:
    """The threads that move a stream. Its state, and each connection once it has
    begun, is guarded by the lock of `changed`, which is notified of all that
    somebody may wait for."""

    def __init__(self, channels: Channels, caller: Caller, state: StreamState) -> None:
        self._channels = channels
        self._caller = caller
        self.changed = Condition()
        self._state = state
        # Daemons, so that a stream that nobody ends does not keep the program.
        self._thread = threading.Thread(target=self._run, daemon=True,
                                        name=f"revisit {state.vehicle}")
        self._reader: Optional[threading.Thread] = None

    def start(self) -> None:
        self._thread.start()

    def join(self) -> None:
        """Waits until no callback runs, unless a callback asks for it."""
        if threading.current_thread() in (self._thread, self._reader):
            return
        while self._thread.is_alive():
            self._thread.join(INTERRUPT_SECONDS)
        if self._reader is not None:
            # It ends with its call; only one that gRPC forgets stays.
            self._reader.join(CANCEL_SECONDS)

    def _run(self) -> None:
        error: Optional[BaseException] = None
        while True:
            connection = Connection(owner_route(error))
            error = self._hold(connection)
            with self.changed:
                wait = self._state.wait_before_next(connection, error)
                if wait is None:
                    self.changed.notify_all()
                    return
            try:
                if self._state.callbacks.disconnected is not None:
                    assert isinstance(error, Error)
                    self._state.callbacks.disconnected(error, wait)
            except BaseException as raised:
                with self.changed:
                    self._state.end(raised)
                    self.changed.notify_all()
                return
            with self.changed:
                self.changed.wait_for(lambda: self._state.cancelled, wait)

    def _hold(self, connection: Connection) -> Optional[BaseException]:
        """Holds one connection until it is over. None if the server ended it in
        answer to our half-close."""
        try:
            with self._channels.lease() as lease:
                error = self._hold_on(lease, connection)
                if isinstance(error, Error):
                    self._channels.report(lease, error)
                return error
        except Error as error:
            return error

    def _hold_on(self, lease: Lease,
                 connection: Connection) -> Optional[BaseException]:
        with self.changed:
            if self._state.cancelled:
                return Cancelled("the stream was cancelled")
            self._state.pending.start_over()
        connection.request_id, metadata = self._caller.metadata()
        try:
            connection.call = stub_of(lease.channel).StreamPoses(
                self._requests(connection), metadata=metadata + connection.route)
        except ValueError as error:
            # gRPC refuses calls on a channel that was closed meanwhile.
            return Cancelled(f"the stream cannot be opened: {error}")
        self._reader = threading.Thread(
            target=self._read, args=(connection,), daemon=True,
            name=f"revisit answers of {self._state.vehicle}")
        self._reader.start()
        with self.changed:
            while self._state.is_to_be_watched(connection):
                left = self._state.seconds_to_stall(connection)
                if connection.verdict is None:
                    self.changed.wait(left)
        if connection.verdict is not None or self._state.cancelled:
            connection.call.cancel()
        with self.changed:
            self._wait_for_end(connection)
            return self._state.over(connection)

    def _wait_for_end(self, connection: Connection) -> None:
        """Waits for the reader of a connection that has ended or was cancelled."""
        deadline = time.monotonic() + CANCEL_SECONDS
        self.changed.notify_all()
        while not connection.over:
            left = deadline - time.monotonic()
            if connection.in_callback:
                self.changed.wait()
                deadline = time.monotonic() + CANCEL_SECONDS
            elif left > 0.0:
                self.changed.wait(left)
            else:
                # gRPC did not even end the call that was cancelled.
                connection.over = True
                self.changed.notify_all()

    def _requests(self, connection: Connection) -> Iterator[v1.StreamPosesRequest]:
        with self.changed:
            opening = self._state.opening()
        yield opening
        while True:
            with self.changed:
                self.changed.wait_for(lambda: self._state.may_send(connection))
                request = self._state.next_request(connection)
                self.changed.notify_all()
            if request is None:
                return
            yield request

    def _read(self, connection: Connection) -> None:
        error: Optional[BaseException] = None
        try:
            for response in connection.call:
                with self.changed:
                    if connection.over:
                        return
                    resumed = self._state.digest(connection, response)
                    connection.in_callback = True
                    self.changed.notify_all()
                try:
                    self._hand_out(connection, response, resumed)
                except BaseException as raised:
                    with self.changed:
                        connection.verdict = raised
                with self.changed:
                    connection.in_callback = False
                    if connection.verdict is not None:
                        return
                    connection.quiet_since = time.monotonic()
                    self.changed.notify_all()
        except grpc.RpcError as raised:
            error = from_rpc_error(raised, connection.request_id)
        except BaseException as raised:
            error = raised
        finally:
            with self.changed:
                connection.error = error
                connection.over = True
                self.changed.notify_all()

    def _hand_out(self, connection: Connection, response: v1.StreamPosesResponse,
                  resumed: bool) -> None:
        for call in self._state.hearers(response, resumed):
            call()
        if response.HasField("candidates") and self._state.callbacks.candidates is None:
            self._keep(connection, response.candidates)

    def _keep(self, connection: Connection, answer: v1.CandidateSet) -> None:
        """Waits for room among the answers that wait to be taken."""
        state = self._state
        with self.changed:
            if not state.has_room_for_answer():
                state.reader_waits = True
                self.changed.notify_all()
                self.changed.wait_for(lambda: state.has_room_for_answer()
                                      or state.cancelled or connection.over)
                state.reader_waits = False
            state.waiting.append(answer)
            self.changed.notify_all()
