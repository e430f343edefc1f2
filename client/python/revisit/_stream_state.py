"""The state of a stream of poses, and what each event makes of it: the same whether
threads or tasks of asyncio move it. Nothing here waits or is thread-safe."""

from __future__ import annotations

import collections
import functools
import logging
import time
from typing import Any, Callable, Optional, Union

import numpy as np
from numpy.typing import NDArray

from revisit import v1
from revisit._arguments import instance
from revisit._pending import Held, PendingPoses, held_arrays, held_messages
from revisit._pose_columns import sequence_at
from revisit._text import printable
from revisit._warnings import kind_of, text_of
from revisit.arrays import Poses, PosesLike, pose_messages
from revisit.backoff import Backoff
from revisit.channel import Metadata
from revisit.errors import (
    Aborted, Cancelled, DataLoss, Error, FailedPrecondition, InvalidArgument,
    ResourceExhausted, Unauthenticated, Unavailable, VehicleReplaced, is_cut, located,
    reads_histories, was_elsewhere)
from revisit.stream_options import StreamCallbacks, StreamOptions

log = logging.getLogger("revisit")

#: Jumps and warnings that are kept, the newest.
_MOST_KEPT = 10_000


def worth_another_connection(error: BaseException, was_opened: bool) -> bool:
    """Whether a stream that ended with this error may go on over a new connection."""
    if isinstance(error, Unauthenticated):
        # Whoever renews tokens may be late.
        return was_opened and error.reason == "TOKEN_EXPIRED"
    if isinstance(error, ResourceExhausted):
        return error.retry_delay is not None
    return isinstance(error, (Unavailable, Aborted)) or (
        isinstance(error, Error) and is_cut(error))


class Connection:
    """One call."""

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
        self.takes_columns = False
        self.quiet_since = time.monotonic()
        #: The reason for which this side ends it.
        self.verdict: Optional[BaseException] = None
        #: The status with which the other side ended it; None for OK.
        self.error: Optional[BaseException] = None
        #: Nothing more comes of it; what does nevertheless is ignored.
        self.over = False


class StreamState:
    """A stream, over all of its connections."""

    def __init__(self, vehicle: str, options: StreamOptions,
                 callbacks: StreamCallbacks) -> None:
        instance("options", options, StreamOptions, "revisit.StreamOptions")
        instance("callbacks", callbacks, StreamCallbacks, "revisit.StreamCallbacks")
        self.vehicle = vehicle
        self.options = options
        self.callbacks = callbacks
        self.keeps_candidates = (options.send_candidates
                                 and callbacks.candidates is None)
        self.pending = PendingPoses(options.max_pending_poses,
                                    options.max_pending_bytes)
        #: Sequence of the last pose that was taken; 0 before the first.
        self.last_taken = 0
        self.acked_sequence = options.acked_sequence
        self.vehicle_uid = options.vehicle_uid
        self.first_durable: Optional[int] = None
        self.reconnects = 0
        self.jumps: collections.deque[v1.Jump] = collections.deque(maxlen=_MOST_KEPT)
        self.warnings: collections.deque[v1.Warning] = collections.deque(
            maxlen=_MOST_KEPT)
        self._warned_of: set[str] = set()
        #: Poses of this stream that became durable and were not told of yet.
        self._untold = 0
        #: Answers of checks that nobody has taken yet.
        self.waiting: collections.deque[v1.CandidateSet] = collections.deque()
        #: Whether reading has stopped until some of them are taken.
        self.reader_waits = False
        self.finishing = False
        self.cancelled = False
        self.ended = False
        #: The error that ended it; None if it ended well.
        self.error: Optional[BaseException] = None
        self._backoff = Backoff(options.backoff)
        self._last_progress = time.monotonic()

    # Poses in.

    def held(self, poses: PosesLike) -> list[Held]:
        """The poses as they are taken, after all were checked. InvalidArgument if one
        does not follow that before it, or is too large; the error of `check_open()`.
        Arrays have sequences by now."""
        if isinstance(poses, Poses):
            self._check_order(poses.sequence)
            parts = list(held_arrays(poses)) if len(poses) > 0 else []
        else:
            copies = []
            for pose in pose_messages(poses):
                # The caller may go on using its own.
                copy = v1.Pose()
                copy.CopyFrom(pose)
                copies.append(copy)
            self._check_order([pose.sequence for pose in copies])
            parts = list(held_messages(copies)) if copies else []
        limit = self.options.max_pending_bytes
        for part in parts:
            largest = max(part.sizes)
            if largest > limit:
                sequence = part.first_sequence + part.sizes.index(largest)
                raise InvalidArgument(
                    f"the pose of sequence {sequence} takes {largest} bytes, more than "
                    f"max_pending_bytes allows ({limit})")
        return parts

    def _check_order(self, sequences: Union[list[int], NDArray[np.uint64]]) -> None:
        if len(sequences) == 0:
            return
        self.check_open()
        first = self.last_taken + 1 if self.last_taken > 0 else max(
            int(sequences[0]), 1)
        # Spares most streams of single poses the arrays.
        if len(sequences) == 1 and sequences[0] == first:
            return
        expected = np.arange(first, first + len(sequences), dtype=np.uint64)
        wrong = np.flatnonzero(np.asarray(sequences, np.uint64) != expected)
        if wrong.size:
            raise InvalidArgument(f"sequence {sequences[wrong[0]]} where "
                                  f"{expected[wrong[0]]} comes next")

    def take(self, held: Held) -> Optional[Held]:
        """Takes as many as there is room for, and returns the others; None if there are
        none."""
        self.check_open()
        taken = self.pending.room_for(held)
        if taken > 0:
            self.last_taken = held.first_sequence + taken - 1
            self.pending.take(held.part(0, taken))
        return None if taken == len(held) else held.part(taken, len(held))

    def check_open(self) -> None:
        """Raises why no poses are taken, if none are."""
        if self.ended and self.error is not None:
            raise self.why_ended()
        if self.ended or self.finishing:
            raise FailedPrecondition("the stream is finished")

    def has_room_for_answer(self) -> bool:
        """Whether another answer of a check may be kept."""
        return len(self.waiting) < self.options.max_waiting_candidates

    @property
    def waits_for_taker(self) -> bool:
        """Whether nothing more is read before candidates are taken."""
        return self.reader_waits and not self.has_room_for_answer()

    def check_keeps_candidates(self) -> None:
        if not self.keeps_candidates:
            raise FailedPrecondition(
                "the stream keeps no candidates: StreamOptions.send_candidates asks "
                "for them, and StreamCallbacks.candidates takes them")

    def needs_taker(self, here: str) -> FailedPrecondition:
        """The error of a wait that would be for ever, since `here` waits and nobody
        else takes candidates."""
        return FailedPrecondition(
            f"{len(self.waiting)} answers of checks wait, and nobody but this {here} "
            f"takes any; poses up to sequence {self.last_taken} were taken. Call "
            "take_candidates() between smaller appends, iterate candidates() in "
            f"another {here}, let run() append, or give the stream a callback")

    def why_ended(self) -> BaseException:
        assert self.error is not None
        # Else each raise would add to one traceback.
        return self.error.with_traceback(None)

    # Requests.

    def opening(self) -> v1.StreamPosesRequest:
        """The first message of a connection."""
        opening = v1.StreamPosesOpen(
            vehicle=self.vehicle, acked_sequence=self.acked_sequence,
            vehicle_uid=self.vehicle_uid,
            send_candidates=self.options.send_candidates)
        if (self.options.send_candidates
                and self.options.candidate_options is not None):
            opening.candidate_options.CopyFrom(self.options.candidate_options)
        scope = self.options.search_scope()
        if scope is not None:
            opening.candidate_options.scope.CopyFrom(scope)
        return v1.StreamPosesRequest(open=opening)

    def may_send(self, connection: Connection) -> bool:
        """Whether `next_request()` has something to say."""
        return connection.over or (
            connection.opened and (self.pending.unsent > 0 or self.finishing))

    def next_request(self, connection: Connection) -> Optional[v1.StreamPosesRequest]:
        """The next batch; None to half-close."""
        if connection.over:
            return None
        if self.pending.sent == 0:
            connection.quiet_since = time.monotonic()
        if self.pending.unsent == 0:
            connection.half_closed = True
            connection.quiet_since = time.monotonic()
            return None
        return v1.StreamPosesRequest(
            batch=self.pending.next_batch(connection.batch_poses,
                                          connection.takes_columns))

    # Answers.

    def digest(self, connection: Connection,
               response: v1.StreamPosesResponse) -> bool:
        """Notes what an answer says; whether it opens a connection after the
        first."""
        if response.HasField("opened"):
            return not connection.opened and self._open(connection, response.opened)
        connection.progressed = True
        if response.HasField("ack"):
            self.acked_sequence = max(self.acked_sequence,
                                      response.ack.durable_sequence)
            self._untold += self.pending.drop_acknowledged(
                response.ack.durable_sequence)
            self.jumps.extend(response.ack.jumps)
            self.warnings.extend(response.ack.warnings)
        return False

    def _open(self, connection: Connection, opened: v1.StreamPosesOpened) -> bool:
        durable = opened.durable_sequence
        # Before anything counts as durable because another vehicle has its
        # sequence.
        self.vehicle_uid = self.vehicle_uid or opened.vehicle_uid
        if self.vehicle_uid != opened.vehicle_uid:
            connection.verdict = VehicleReplaced(
                f"{self.vehicle} has the uid {opened.vehicle_uid}, but the stream "
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
        connection.takes_columns = opened.takes_pose_columns
        connection.batch_poses = self.options.batch_poses
        if opened.max_batch_poses > 0:
            connection.batch_poses = min(connection.batch_poses,
                                         opened.max_batch_poses)
        self._untold += self.pending.resume(durable)
        resumed = self.first_durable is not None
        if not resumed:
            self.first_durable = durable
        return resumed

    def hearers(self, response: v1.StreamPosesResponse,
                resumed: bool) -> list[Callable[[], object]]:
        """Logs what an answer says to people, and returns the callbacks that hear of
        it. A set of candidates for which there is none is to be kept."""
        callbacks = self.callbacks
        calls: list[Callable[[], object]] = []
        if self._untold > 0 and callbacks.progress is not None:
            calls.append(functools.partial(callbacks.progress.update, self._untold))
        self._untold = 0
        if response.HasField("ack"):
            self._log(response.ack)
            if callbacks.ack is not None:
                calls.append(functools.partial(callbacks.ack, response.ack))
        elif response.HasField("candidates"):
            if callbacks.candidates is not None:
                calls.append(functools.partial(callbacks.candidates,
                                               response.candidates))
        elif resumed and callbacks.resumed is not None:
            calls.append(functools.partial(callbacks.resumed,
                                           response.opened.durable_sequence))
        return calls

    def _log(self, ack: v1.Ack) -> None:
        for jump in ack.jumps:
            log.warning("%s: jump of %.1f m before sequence %d",
                        printable(self.vehicle), jump.distance_meters, jump.sequence)
        log_warnings(self.vehicle, ack, self._warned_of)

    # The connections, one after the other.

    def over(self, connection: Connection) -> Optional[BaseException]:
        """The error of a connection that is over; None if the server ended it in
        answer to our half-close."""
        if connection.opened and len(self.pending) == 0:
            connection.progressed = True
        if self.cancelled:
            return Cancelled("the stream was cancelled")
        if connection.verdict is not None:
            return connection.verdict
        error = connection.error
        if isinstance(error, Error) and error.field_violations:
            # The server acknowledges all that comes before what it refuses.
            refused = self.pending.first_sent(connection.takes_columns)
            return located(error, lambda field: sequence_at(field, refused))
        if error is not None:
            return error
        if connection.half_closed and len(self.pending) == 0:
            return None
        return Unavailable("the server ended the stream too early")

    def is_to_be_watched(self, connection: Connection) -> bool:
        """Whether nothing has decided yet how the connection ends."""
        return not (connection.over or self.cancelled or connection.verdict)

    def seconds_to_stall(self, connection: Connection) -> Optional[float]:
        """How long to wait for an answer that is due; None if none is. What is due
        no longer ends the connection."""
        due = (not connection.opened or self.pending.sent > 0
               or connection.half_closed)
        if not due or connection.in_callback:
            return None
        timeout = self.options.answer_timeout
        left = connection.quiet_since + timeout - time.monotonic()
        if left <= 0.0:
            connection.verdict = Unavailable(
                f"no answer for {timeout:g} s", request_id=connection.request_id)
        return max(left, 0.0)

    def wait_before_next(self, connection: Connection,
                         error: Optional[BaseException]) -> Optional[float]:
        """How many seconds to wait before another connection, after one that ended
        with this error; None if the stream has ended."""
        if error is None or self.cancelled or not worth_another_connection(
                error, self.first_durable is not None):
            self.end(error)
            return None
        assert isinstance(error, Error)
        if (connection.progressed or was_elsewhere(error)
                or reads_histories(error)):
            # The server says when a vehicle that is elsewhere may be asked for
            # again, and when to ask whether histories were read.
            self._backoff.reset()
        if connection.progressed:
            self._last_progress = time.monotonic()
        wait = self._backoff.next(error.retry_delay)
        limit = self.options.give_up_after
        if (limit is not None
                and time.monotonic() + wait - self._last_progress > limit):
            self.end(error)
            return None
        self.reconnects += 1
        log.info("%s: connecting again in %.1f s: %s", printable(self.vehicle), wait,
                 error)
        return wait

    def end(self, error: Optional[BaseException]) -> None:
        self.error = error
        self.ended = True


def log_warnings(vehicle: str, answer: Union[v1.Ack, v1.RevisePosesResponse],
                 known: set[str]) -> None:
    """Logs the warnings of an answer, each kind once: `known` has those that were."""
    for warning in answer.warnings:
        kind = kind_of(warning)
        if kind not in known:
            known.add(kind)
            log.warning("%s: %s", printable(vehicle), text_of(warning))
