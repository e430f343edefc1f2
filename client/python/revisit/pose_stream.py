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
from typing import Callable, Optional

from revisit import v1
from revisit._engine import Engine
from revisit._pending import Held
from revisit._stream_state import StreamState
from revisit.arrays import Poses, PosesLike
from revisit.channel import Caller, Channels
from revisit.errors import Cancelled


class PoseStream:
    """Made by `Client.stream_poses()`. Thread-safe, but poses come in one order,
    so appending is for one thread at a time. A context manager: leaving it
    finishes the stream, or cancels it if an exception leaves it."""

    def __init__(self, channels: Channels, caller: Caller, state: StreamState) -> None:
        self._state = state
        self._engine = Engine(channels, caller, state)
        self._changed = self._engine.changed
        # Guarded by the lock of _changed, as is the state.
        self._taker: Optional[int] = None
        self._engine.start()

    # Poses in.

    def wait_until_opened(self, timeout: Optional[float] = None) -> int:
        """Waits for the first connection. Returns the highest durable sequence at
        that moment: go on behind it. Poses up to it may be appended again; the
        server then compares them with what it has. TimeoutError after so many
        seconds; the error of the stream if it has ended."""
        state = self._state
        with self._changed:
            self._changed.wait_for(
                lambda: state.first_durable is not None or state.ended, timeout)
            if state.first_durable is not None:
                return state.first_durable
            if not state.ended:
                raise TimeoutError(f"no stream was opened within {timeout} s")
            raise state.why_ended()

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
        for held in self._checked(poses):
            with self._changed:
                while rest := self._state.take(held):
                    self._wait_for_room(rest)
                    held = rest
                self._changed.notify_all()

    def try_append(self, poses: PosesLike) -> bool:
        """Does what `append()` does, but never waits for room: takes all poses, or
        none and returns False."""
        parts = self._checked(poses)
        with self._changed:
            self._state.check_open()
            if not self._state.pending.has_room(parts):
                return False
            for held in parts:
                self._state.take(held)
            self._changed.notify_all()
            return True

    def finish(self) -> None:
        """Takes no more poses and waits until all are durable and the server has
        answered all checks. Raises why the stream ended, if not well. May be
        called again."""
        with self._changed:
            self._state.finishing = True
            self._changed.notify_all()
            self._wait_while(lambda: not self._state.ended)
            if self._state.error is not None:
                raise self._state.why_ended()

    def cancel(self) -> None:
        """Ends the stream with Cancelled unless it has ended. Does not wait."""
        with self._changed:
            self._state.cancelled = True
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

    def _checked(self, poses: PosesLike) -> list[Held]:
        if isinstance(poses, Poses) and len(poses) > 0 and not poses.sequence.any():
            poses = poses.numbered(self._next_sequence())
        # Only the thread that appends changes what the checks read.
        return self._state.held(poses)

    def _next_sequence(self) -> int:
        with self._changed:
            if self._state.last_taken > 0:
                return self._state.last_taken + 1
        return self.wait_until_opened() + 1

    def _wait_for_room(self, held: Held) -> None:
        """Waits until one of the poses may be taken."""
        state = self._state
        self._changed.notify_all()
        self._wait_while(lambda: not (state.pending.room_for(held) or state.ended
                                      or state.finishing))

    def _wait_while(self, condition: Callable[[], bool]) -> None:
        """Waits, unless that would be for ever."""
        while condition():
            if self._state.waits_for_taker and self._taker in (
                    None, threading.get_ident()):
                raise self._state.needs_taker("thread")
            self._changed.wait()

    # Answers out.

    def candidates(self) -> Iterator[v1.CandidateSet]:
        """The answers of checks as they come, until the stream has ended; raises
        why, if not well. For a thread of its own beside the one that appends;
        `run()` needs none."""
        state = self._state
        while True:
            with self._changed:
                self._take_candidates_here()
                self._changed.wait_for(lambda: bool(state.waiting) or state.ended)
                if not state.waiting:
                    if state.error is not None:
                        raise state.why_ended()
                    return
                answer = state.waiting.popleft()
                self._changed.notify_all()
            yield answer

    def take_candidates(self) -> list[v1.CandidateSet]:
        """The answers of checks that have come and were not taken yet. Does not
        wait."""
        with self._changed:
            self._take_candidates_here()
            taken = list(self._state.waiting)
            self._state.waiting.clear()
            self._changed.notify_all()
            return taken

    def _take_candidates_here(self) -> None:
        self._state.check_keeps_candidates()
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
            return list(self._state.jumps)

    @property
    def warnings(self) -> list[v1.Warning]:
        """Signs of wrong axes, units or settings that acknowledgements reported: the
        newest 10,000. Each kind is logged when it first comes, with what to do."""
        with self._changed:
            return list(self._state.warnings)

    @property
    def acked_sequence(self) -> int:
        """Highest sequence known to be durable. A client that keeps it over
        restarts, with the uid, and hands both in by StreamOptions, learns of data
        loss."""
        with self._changed:
            return self._state.acked_sequence

    @property
    def vehicle_uid(self) -> str:
        """Which vehicle it is (v1.Vehicle.uid). Empty until it is known: by the
        options or the first connection."""
        with self._changed:
            return self._state.vehicle_uid

    @property
    def reconnects(self) -> int:
        """Connections after the first one."""
        with self._changed:
            return self._state.reconnects

    @property
    def pending_poses(self) -> int:
        """Unacknowledged poses that are held now."""
        with self._changed:
            return len(self._state.pending)

    @property
    def pending_bytes(self) -> int:
        """Bytes that the poses that are held now take."""
        with self._changed:
            return self._state.pending.bytes
