"""The connections of a stream of poses, one after the other.

Threads: one makes the connections and watches over them, `Engine._run()`; each
connection has one that reads its answers and runs the callbacks, and gRPC has one
that asks `Engine._requests()` for the next message.
"""

from __future__ import annotations

import collections
import logging
import threading
import time
from collections.abc import Iterator
from typing import Any, Optional

import grpc

from revisit import v1
from revisit._pending import PendingPoses
from revisit.backoff import Backoff
from revisit.channel import (
    Caller, Channels, Lease, Metadata, owner_route, stub_of)
from revisit.errors import (
    Aborted, Cancelled, DataLoss, Error, ResourceExhausted, Unauthenticated,
    Unavailable, VehicleReplaced, from_rpc_error, is_cut,
    was_elsewhere)
from revisit.stream_options import StreamCallbacks, StreamOptions

_log = logging.getLogger("revisit")

#: How long gRPC may take to end a call that was cancelled, in seconds.
CANCEL_SECONDS = 10.0
#: Jumps that are kept, the newest.
_MAX_JUMPS = 10_000


def _worth_another_connection(error: BaseException, was_opened: bool) -> bool:
    if isinstance(error, Unauthenticated):
        # Whoever renews tokens may be late.
        return was_opened and error.reason == "TOKEN_EXPIRED"
    if isinstance(error, ResourceExhausted):
        return error.retry_delay is not None
    return isinstance(error, (Unavailable, Aborted)) or (
        isinstance(error, Error) and is_cut(error))


class _Connection:
    """One call. Guarded by the engine's lock once it has begun."""

    def __init__(self, route: Metadata) -> None:
        #: Metadata of this connection only.
        self.route = route
        self.call: Any = None
        self.request_id = ""
        self.opened = False
        #: Whether it was worth making: something became durable or was answered,
        #: or nothing waits.
        self.progressed = False
        self.half_closed = False
        self.in_callback = False
        self.batch_poses = 1
        self.quiet_since = time.monotonic()
        #: The reason for which this side ends it.
        self.verdict: Optional[BaseException] = None
        #: The status with which the other side ended it; None for OK.
        self.error: Optional[BaseException] = None
        #: Nothing more comes of it; what does nevertheless is ignored.
        self.over = False


class Engine:
    """The state of a stream, and the threads that move it. Attributes without an
    underscore are guarded by the lock of `changed`, which is notified of all that
    somebody may wait for."""

    def __init__(self, channels: Channels, caller: Caller, vehicle: str,
                 options: StreamOptions, callbacks: StreamCallbacks) -> None:
        self._channels = channels
        self._caller = caller
        self._vehicle = vehicle
        self._options = options
        self._callbacks = callbacks
        self.changed = threading.Condition()
        self.pending = PendingPoses(options.max_pending_poses,
                                    options.max_pending_bytes)
        self.acked_sequence = options.acked_sequence
        self.vehicle_uid = options.vehicle_uid
        self.first_durable: Optional[int] = None
        self.reconnects = 0
        self.jumps: collections.deque[v1.Jump] = collections.deque(maxlen=_MAX_JUMPS)
        #: Answers of checks that nobody has taken yet.
        self.waiting: collections.deque[v1.CandidateSet] = collections.deque()
        #: Whether reading has stopped until some of them are taken.
        self.waits_for_taker = False
        self.finishing = False
        self.cancelled = False
        self.ended = False
        #: The error that ended it; None if it ended well.
        self.error: Optional[BaseException] = None
        # Daemons, so that a stream that nobody ends does not keep the program.
        self._thread = threading.Thread(target=self._run, daemon=True,
                                        name=f"revisit {vehicle}")
        self._reader: Optional[threading.Thread] = None

    def start(self) -> None:
        self._thread.start()

    def join(self) -> None:
        """Waits until no callback runs, unless a callback asks for it."""
        for thread in (self._thread, self._reader):
            if thread is not None and thread is not threading.current_thread():
                # The reader ends with its call; only one that gRPC forgets stays.
                thread.join(None if thread is self._thread else CANCEL_SECONDS)

    def _run(self) -> None:
        backoff = Backoff(self._options.backoff)
        last_progress = time.monotonic()
        error: Optional[BaseException] = None
        while True:
            connection = _Connection(owner_route(error))
            error = self._hold(connection)
            with self.changed:
                if error is None or self.cancelled or not _worth_another_connection(
                        error, self.first_durable is not None):
                    self._end(error)
                    return
                assert isinstance(error, Error)
                if connection.progressed or was_elsewhere(error):
                    # The server says when a vehicle that is elsewhere may be asked
                    # for again.
                    backoff.reset()
                if connection.progressed:
                    last_progress = time.monotonic()
                wait = backoff.next(error.retry_delay)
                limit = self._options.give_up_after
                if (limit is not None
                        and time.monotonic() + wait - last_progress > limit):
                    self._end(error)
                    return
                self.reconnects += 1
            _log.info("%s: connecting again in %.1f s: %s", self._vehicle, wait,
                      error)
            try:
                if self._callbacks.disconnected is not None:
                    self._callbacks.disconnected(error, wait)
            except BaseException as raised:
                with self.changed:
                    self._end(raised)
                return
            with self.changed:
                self.changed.wait_for(lambda: self.cancelled, wait)

    def _end(self, error: Optional[BaseException]) -> None:
        self.error = error
        self.ended = True
        self.changed.notify_all()

    def _hold(self, connection: _Connection) -> Optional[BaseException]:
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
                 connection: _Connection) -> Optional[BaseException]:
        with self.changed:
            if self.cancelled:
                return Cancelled("the stream was cancelled")
            self.pending.start_over()
        connection.request_id, metadata = self._caller.metadata()
        try:
            connection.call = stub_of(lease.channel).StreamPoses(
                self._requests(connection), metadata=metadata + connection.route)
        except ValueError as error:
            # gRPC refuses calls on a channel that was closed meanwhile.
            return Cancelled(f"the stream cannot be opened: {error}")
        self._reader = threading.Thread(
            target=self._read, args=(connection,), daemon=True,
            name=f"revisit answers of {self._vehicle}")
        self._reader.start()
        with self.changed:
            self._watch(connection)
        if connection.verdict is not None or self.cancelled:
            connection.call.cancel()
        with self.changed:
            self._wait_for_end(connection)
            if connection.opened and len(self.pending) == 0:
                connection.progressed = True
            if self.cancelled:
                return Cancelled("the stream was cancelled")
            if connection.verdict is not None:
                return connection.verdict
            if connection.error is not None:
                return connection.error
            if connection.half_closed and len(self.pending) == 0:
                return None
            return Unavailable("the server ended the stream too early")

    def _watch(self, connection: _Connection) -> None:
        """Waits until the connection is over or to be ended from this side."""
        timeout = self._options.answer_timeout
        while not (connection.over or self.cancelled or connection.verdict):
            due = (not connection.opened or self.pending.sent > 0
                   or connection.half_closed)
            if not due or connection.in_callback:
                self.changed.wait()
                continue
            left = connection.quiet_since + timeout - time.monotonic()
            if left > 0.0:
                self.changed.wait(left)
            else:
                connection.verdict = Unavailable(
                    f"no answer for {timeout:g} s", request_id=connection.request_id)

    def _wait_for_end(self, connection: _Connection) -> None:
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

    def _requests(self, connection: _Connection) -> Iterator[v1.StreamPosesRequest]:
        options = self._options
        with self.changed:
            opening = v1.StreamPosesOpen(
                vehicle=self._vehicle, acked_sequence=self.acked_sequence,
                vehicle_uid=self.vehicle_uid,
                send_candidates=options.send_candidates)
        if options.send_candidates and options.candidate_options is not None:
            opening.candidate_options.CopyFrom(options.candidate_options)
        yield v1.StreamPosesRequest(open=opening)
        while True:
            with self.changed:
                self.changed.wait_for(lambda: connection.over or (
                    connection.opened
                    and (self.pending.unsent > 0 or self.finishing)))
                if connection.over:
                    return
                if self.pending.sent == 0:
                    connection.quiet_since = time.monotonic()
                if self.pending.unsent == 0:
                    connection.half_closed = True
                    connection.quiet_since = time.monotonic()
                    self.changed.notify_all()
                    return
                batch = self.pending.next_batch(connection.batch_poses)
                self.changed.notify_all()
            yield v1.StreamPosesRequest(batch=batch)

    def _read(self, connection: _Connection) -> None:
        error: Optional[BaseException] = None
        try:
            for response in connection.call:
                with self.changed:
                    if connection.over:
                        return
                    resumed = self._digest(connection, response)
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

    def _digest(self, connection: _Connection,
                response: v1.StreamPosesResponse) -> bool:
        """Notes what an answer says; whether it opens a connection after the
        first."""
        if response.HasField("opened"):
            return not connection.opened and self._open(connection, response.opened)
        connection.progressed = True
        if response.HasField("ack"):
            self.acked_sequence = max(self.acked_sequence,
                                      response.ack.durable_sequence)
            self.pending.drop_acknowledged(response.ack.durable_sequence)
            self.jumps.extend(response.ack.jumps)
        return False

    def _open(self, connection: _Connection, opened: v1.StreamPosesOpened) -> bool:
        durable = opened.durable_sequence
        # Before anything counts as durable because another vehicle has its
        # sequence.
        self.vehicle_uid = self.vehicle_uid or opened.vehicle_uid
        if self.vehicle_uid != opened.vehicle_uid:
            connection.verdict = VehicleReplaced(
                f"{self._vehicle} has the uid {opened.vehicle_uid}, but the stream "
                f"began with {self.vehicle_uid}: it was deleted and made again",
                request_id=connection.request_id)
            return False
        if durable < self.acked_sequence:
            connection.verdict = DataLoss(
                f"the server has poses up to sequence {durable}, but acknowledged up "
                f"to {self.acked_sequence}", request_id=connection.request_id)
            return False
        if durable > self.acked_sequence:
            connection.progressed = True
        connection.opened = True
        self.acked_sequence = durable
        connection.batch_poses = self._options.batch_poses
        if opened.max_batch_poses > 0:
            connection.batch_poses = min(connection.batch_poses,
                                         opened.max_batch_poses)
        self.pending.resume(durable)
        resumed = self.first_durable is not None
        if not resumed:
            self.first_durable = durable
        return resumed

    def _hand_out(self, connection: _Connection, response: v1.StreamPosesResponse,
                  resumed: bool) -> None:
        callbacks = self._callbacks
        if response.HasField("ack"):
            for jump in response.ack.jumps:
                _log.warning("%s: jump of %.1f m before sequence %d", self._vehicle,
                             jump.distance_meters, jump.sequence)
            if callbacks.ack is not None:
                callbacks.ack(response.ack)
        elif response.HasField("candidates"):
            if callbacks.candidates is not None:
                callbacks.candidates(response.candidates)
            else:
                self._keep(connection, response.candidates)
        elif resumed and callbacks.resumed is not None:
            callbacks.resumed(response.opened.durable_sequence)

    def _keep(self, connection: _Connection, answer: v1.CandidateSet) -> None:
        """Waits for room among the answers that wait to be taken."""
        with self.changed:
            room = self._options.max_waiting_candidates
            if len(self.waiting) >= room:
                self.waits_for_taker = True
                self.changed.notify_all()
                self.changed.wait_for(lambda: len(self.waiting) < room
                                      or self.cancelled or connection.over)
                self.waits_for_taker = False
            self.waiting.append(answer)
            self.changed.notify_all()
