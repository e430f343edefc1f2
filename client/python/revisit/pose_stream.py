"""A stream of poses that survives the connection.

Poses go in, in the order of their sequences; the stream keeps each until the
server has acknowledged it as durable, reconnects as often as needed, and goes on
where the server says it stands. Every pose that was taken arrives exactly once,
in order, or `finish()` raises why not.

    with client.stream_poses("shuttle-7") as stream:
        durable = stream.wait_until_opened()
        stream.append(poses[durable:])      # waits while there is no room

Reconnecting: after UNAVAILABLE, ABORTED, RESOURCE_EXHAUSTED with a RetryInfo,
INTERNAL without a reason (gRPC or a proxy reset the stream), an end that was not
asked for, or silence longer than `answer_timeout`, with exponential back-off that
starts over after progress. An expired token is no end either once the stream was
opened: the next connection reads it anew. Any other error ends the stream, among
them DataLoss (the server has less than was acknowledged), VehicleReplaced (the
vehicle was deleted and made again under the stream; no pose counts as durable
because the new vehicle has its sequence), AlreadyExists (a sequence is stored with
other content), FailedPrecondition (a gap), InvalidArgument and NotFound.

Candidates: the server sends the answer of a check once, on the stream on which
the check's batch became durable. If the connection breaks after that and before
the answer arrives, the answer is lost. So are answers that pile up on a server
whose client takes them too slowly: it ends the call with SLOW_CONSUMER.
`reconnects` > 0 therefore means that answers may be missing;
`Client.find_candidates()` can be asked for them.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Iterator
from types import TracebackType
from typing import Callable, Optional, Union

import numpy as np
from numpy.typing import NDArray

from revisit import v1
from revisit._engine import Engine
from revisit.arrays import Poses
from revisit.channel import Caller, Channels
from revisit.errors import Cancelled, FailedPrecondition, InvalidArgument
from revisit.stream_options import StreamCallbacks, StreamOptions

#: Rows of arrays that become messages at a time.
_CHUNK_ROWS = 1000
#: No pose of arrays is larger when serialised.
_LARGEST_ROW_BYTES = 1024

PosesLike = Union[Poses, Iterable[v1.Pose]]
_Sized = list[tuple[v1.Pose, int]]


class PoseStream:
    """Made by `Client.stream_poses()`. Thread-safe, but poses come in one order,
    so appending is for one thread at a time. A context manager: leaving it
    finishes the stream, or cancels it if an exception leaves it."""

    def __init__(self, channels: Channels, caller: Caller, vehicle: str,
                 options: StreamOptions, callbacks: StreamCallbacks) -> None:
        self._options = options
        self._takes_candidates = (options.send_candidates
                                  and callbacks.candidates is None)
        self._engine = Engine(channels, caller, vehicle, options, callbacks)
        self._changed = self._engine.changed
        # Guarded by the lock of _changed.
        self._last_taken = 0
        self._taker: Optional[int] = None
        self._engine.start()

    # Poses in.

    def wait_until_opened(self, timeout: Optional[float] = None) -> int:
        """Waits for the first connection. Returns the highest durable sequence at
        that moment: go on behind it. Poses up to it may be appended again; the
        server then compares them with what it has. TimeoutError after so many
        seconds; the error of the stream if it has ended."""
        engine = self._engine
        with self._changed:
            self._changed.wait_for(
                lambda: engine.first_durable is not None or engine.ended, timeout)
            if engine.first_durable is not None:
                return engine.first_durable
            if not engine.ended:
                raise TimeoutError(f"no stream was opened within {timeout} s")
            raise self._why_ended()

    def append(self, poses: PosesLike) -> None:
        """Takes poses whose sequences follow each other and the last one taken,
        and waits while there is no room. To return means taken, not durable.

        Arrays without sequences are numbered behind the last pose that was taken
        or, before the first, behind what is durable: only for poses that the
        vehicle does not have yet.

        InvalidArgument, with nothing taken, if sequences do not follow or a pose
        is larger than max_pending_bytes; FailedPrecondition after `finish()`, or
        if there is no more room for candidates and nobody but the calling thread
        takes any; the error of the stream if it has ended."""
        for chunk in self._checked(poses):
            with self._changed:
                for pose, size in chunk:
                    if not self._engine.pending.has_room(1, size):
                        self._wait_for_room(size)
                    self._check_open()
                    self._take(pose, size)
                self._changed.notify_all()

    def try_append(self, poses: PosesLike) -> bool:
        """Does what `append()` does, but never waits for room: takes all poses, or
        none and returns False."""
        sized = [one for chunk in self._checked(poses) for one in chunk]
        with self._changed:
            self._check_open()
            if not self._engine.pending.has_room(len(sized),
                                                 sum(size for _, size in sized)):
                return False
            for pose, size in sized:
                self._take(pose, size)
            self._changed.notify_all()
            return True

    def finish(self) -> None:
        """Takes no more poses and waits until all are durable and the server has
        answered all checks. Raises why the stream ended, if not well. May be
        called again."""
        with self._changed:
            self._engine.finishing = True
            self._changed.notify_all()
            self._wait_while(lambda: not self._engine.ended)
            if self._engine.error is not None:
                raise self._why_ended()

    def cancel(self) -> None:
        """Ends the stream with Cancelled unless it has ended. Does not wait."""
        with self._changed:
            self._engine.cancelled = True
            self._changed.notify_all()

    def close(self) -> None:
        """Cancels the stream unless it has ended, and waits until no callback
        runs any more."""
        self.cancel()
        self._engine.join()

    def __enter__(self) -> PoseStream:
        return self

    def __exit__(self, kind: Optional[type[BaseException]],
                 error: Optional[BaseException],
                 trace: Optional[TracebackType]) -> None:
        try:
            if kind is None:
                self.finish()
        finally:
            self.close()

    def _check_open(self) -> None:
        if self._engine.ended and self._engine.error is not None:
            raise self._why_ended()
        if self._engine.ended or self._engine.finishing:
            raise FailedPrecondition("the stream is finished")

    def _why_ended(self) -> BaseException:
        assert self._engine.error is not None
        # Else each raise would add to one traceback.
        return self._engine.error.with_traceback(None)

    def _checked(self, poses: PosesLike) -> Iterator[_Sized]:
        """The poses with their sizes, some at a time, after all were checked."""
        if isinstance(poses, Poses):
            if len(poses) > 0 and not poses.sequence.any():
                poses = poses.numbered(self._next_sequence())
            self._check_order(poses.sequence)
            if self._options.max_pending_bytes >= _LARGEST_ROW_BYTES:
                for row in range(0, len(poses), _CHUNK_ROWS):
                    yield [(pose, pose.ByteSize()) for pose in
                           poses[row:row + _CHUNK_ROWS].to_messages()]
                return
            sized = [(pose, pose.ByteSize()) for pose in poses.to_messages()]
        else:
            sized = []
            for pose in poses:
                # The caller may go on using its own.
                copy = v1.Pose()
                copy.CopyFrom(pose)
                sized.append((copy, copy.ByteSize()))
            self._check_order(np.array([pose.sequence for pose, _ in sized],
                                       np.uint64))
        limit = self._options.max_pending_bytes
        for pose, size in sized:
            if size > limit:
                raise InvalidArgument(
                    f"the pose of sequence {pose.sequence} takes {size} bytes, more "
                    f"than max_pending_bytes allows ({limit})")
        yield sized

    def _next_sequence(self) -> int:
        with self._changed:
            if self._last_taken > 0:
                return self._last_taken + 1
        return self.wait_until_opened() + 1

    def _check_order(self, sequences: NDArray[np.uint64]) -> None:
        if len(sequences) == 0:
            return
        with self._changed:
            self._check_open()
            first = self._last_taken + 1 if self._last_taken > 0 else max(
                int(sequences[0]), 1)
        expected = np.arange(first, first + len(sequences), dtype=np.uint64)
        wrong = np.flatnonzero(sequences != expected)
        if wrong.size:
            raise InvalidArgument(f"sequence {sequences[wrong[0]]} where "
                                  f"{expected[wrong[0]]} comes next")

    def _take(self, pose: v1.Pose, size: int) -> None:
        self._last_taken = pose.sequence
        self._engine.pending.take(pose, size)

    def _wait_for_room(self, size: int) -> None:
        engine = self._engine
        self._changed.notify_all()
        self._wait_while(lambda: not (engine.pending.has_room(1, size) or engine.ended
                                      or engine.finishing))

    def _wait_while(self, condition: Callable[[], bool]) -> None:
        """Waits, unless that would be for ever."""
        engine = self._engine
        while condition():
            if engine.waits_for_taker and self._taker in (None,
                                                          threading.get_ident()):
                raise FailedPrecondition(
                    f"{len(engine.waiting)} answers of checks wait, and nobody but "
                    f"this thread takes any; poses up to sequence {self._last_taken} "
                    "were taken. Call take_candidates() between smaller appends, "
                    "iterate candidates() in another thread, let run() append, or "
                    "give the stream a callback")
            self._changed.wait()

    # Answers out.

    def candidates(self) -> Iterator[v1.CandidateSet]:
        """The answers of checks as they come, until the stream has ended; raises
        why, if not well. For a thread of its own beside the one that appends;
        `run()` needs none."""
        engine = self._engine
        while True:
            with self._changed:
                self._take_candidates_here()
                self._changed.wait_for(lambda: bool(engine.waiting) or engine.ended)
                if not engine.waiting:
                    if engine.error is not None:
                        raise self._why_ended()
                    return
                answer = engine.waiting.popleft()
                self._changed.notify_all()
            yield answer

    def take_candidates(self) -> list[v1.CandidateSet]:
        """The answers of checks that have come and were not taken yet. Does not
        wait."""
        with self._changed:
            self._take_candidates_here()
            taken = list(self._engine.waiting)
            self._engine.waiting.clear()
            self._changed.notify_all()
            return taken

    def _take_candidates_here(self) -> None:
        if not self._takes_candidates:
            raise FailedPrecondition(
                "the stream keeps no candidates: StreamOptions.send_candidates asks "
                "for them, and StreamCallbacks.candidates takes them")
        self._taker = threading.get_ident()

    def run(self, batches: Iterable[PosesLike]) -> Iterator[v1.CandidateSet]:
        """Appends all batches beside the caller, finishes, and yields the answers
        of checks meanwhile. An error of the stream or of `batches` is raised; a
        loop that is left early cancels the stream."""
        with self._changed:
            self._take_candidates_here()
        failed: list[BaseException] = []

        def feed() -> None:
            try:
                for batch in batches:
                    self.append(batch)
                self.finish()
            except BaseException as error:
                failed.append(error)
                self.cancel()

        feeder = threading.Thread(target=feed, daemon=True, name="revisit feeder")
        feeder.start()
        try:
            yield from self.candidates()
        except Cancelled as error:
            if failed:
                raise failed[0] from None
            raise error
        finally:
            self.close()

    # The state of the stream.

    @property
    def jumps(self) -> list[v1.Jump]:
        """Jumps that acknowledgements reported, where the trajectory is cut: the
        newest 10,000."""
        with self._changed:
            return list(self._engine.jumps)

    @property
    def acked_sequence(self) -> int:
        """Highest sequence known to be durable. A client that keeps it over
        restarts, with the uid, and hands both in by StreamOptions, learns of data
        loss."""
        with self._changed:
            return self._engine.acked_sequence

    @property
    def vehicle_uid(self) -> str:
        """Which vehicle it is (v1.Vehicle.uid). Empty until it is known: by the
        options or the first connection."""
        with self._changed:
            return self._engine.vehicle_uid

    @property
    def reconnects(self) -> int:
        """Connections after the first one."""
        with self._changed:
            return self._engine.reconnects

    @property
    def pending_poses(self) -> int:
        """Unacknowledged poses that are held now."""
        with self._changed:
            return len(self._engine.pending)

    @property
    def pending_bytes(self) -> int:
        """Serialised bytes of the poses that are held now."""
        with self._changed:
            return self._engine.pending.bytes
