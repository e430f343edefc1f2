"""A stream of poses that survives the connection, for asyncio."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterable, AsyncIterator, Iterable
from types import TracebackType
from typing import Any, Callable, Optional, Union

from revisit import pose_stream, v1
from revisit._pending import Held
from revisit._stream_state import StreamState
from revisit.aio._channels import AioChannels
from revisit.aio._engine import Engine
from revisit.arrays import Poses, PosesLike
from revisit.channel import Caller
from revisit.errors import Cancelled


async def _each(batches: Union[Iterable[PosesLike], AsyncIterable[PosesLike]]
                ) -> AsyncIterator[PosesLike]:
    if isinstance(batches, AsyncIterable):
        async for batch in batches:
            yield batch
    else:
        for batch in batches:
            yield batch


class PoseStream:
    """Made by `Client.stream_poses()`: a `revisit.PoseStream` whose methods are
    awaited. Any number of tasks of its event loop may use it, but poses come in one
    order, so appending is for one at a time. An asynchronous context manager: leaving
    it finishes the stream, or cancels it if an exception leaves it."""

    def __init__(self, channels: AioChannels, caller: Caller,
                 state: StreamState) -> None:
        self._state = state
        self._engine = Engine(channels, caller, state)
        self._changed = self._engine.changed
        self._taker: Optional[asyncio.Task[Any]] = None
        self._engine.start()

    # Poses in.

    async def wait_until_opened(self, timeout: Optional[float] = None) -> int:
        state = self._state
        await self._changed.wait_for(
            lambda: state.first_durable is not None or state.ended, timeout)
        if state.first_durable is not None:
            return state.first_durable
        if not state.ended:
            raise TimeoutError(f"no stream was opened within {timeout} s")
        raise state.why_ended()

    async def append(self, poses: PosesLike) -> None:
        for held in await self._checked(poses):
            while rest := self._state.take(held):
                await self._wait_for_room(rest)
                held = rest
            self._changed.notify()
            # So that what is taken is sent meanwhile, also by a loop that never waits.
            await asyncio.sleep(0)

    async def try_append(self, poses: PosesLike) -> bool:
        parts = await self._checked(poses)
        self._state.check_open()
        if not self._state.pending.has_room(parts):
            return False
        for held in parts:
            self._state.take(held)
        self._changed.notify()
        return True

    async def finish(self) -> None:
        self._state.finishing = True
        self._changed.notify()
        await self._wait_while(lambda: not self._state.ended)
        if self._state.error is not None:
            raise self._state.why_ended()

    def cancel(self) -> None:
        self._state.cancelled = True
        self._changed.notify()

    async def close(self) -> None:
        self.cancel()
        await self._engine.join()

    async def __aenter__(self) -> PoseStream:
        return self

    async def __aexit__(self, kind: Optional[type[BaseException]],
                        error: Optional[BaseException],
                        trace: Optional[TracebackType]) -> None:
        try:
            if kind is None:
                await self.finish()
        finally:
            await self.close()

    async def _checked(self, poses: PosesLike) -> list[Held]:
        if isinstance(poses, Poses) and len(poses) > 0 and not poses.sequence.any():
            poses = poses.numbered((self._state.last_taken
                                    or await self.wait_until_opened()) + 1)
        return self._state.held(poses)

    async def _wait_for_room(self, held: Held) -> None:
        state = self._state
        self._changed.notify()
        await self._wait_while(lambda: not (state.pending.room_for(held)
                                            or state.ended or state.finishing))

    async def _wait_while(self, condition: Callable[[], bool]) -> None:
        """Waits, unless that would be for ever."""
        while condition():
            if self._state.waits_for_taker and self._taker in (
                    None, asyncio.current_task()):
                raise self._state.needs_taker("task")
            await self._changed.wait()

    # Answers out.

    async def candidates(self) -> AsyncIterator[v1.CandidateSet]:
        state = self._state
        while True:
            self._take_candidates_here()
            await self._changed.wait_for(lambda: bool(state.waiting) or state.ended)
            if not state.waiting:
                if state.error is not None:
                    raise state.why_ended()
                return
            answer = state.waiting.popleft()
            self._changed.notify()
            yield answer

    def take_candidates(self) -> list[v1.CandidateSet]:
        self._take_candidates_here()
        taken = list(self._state.waiting)
        self._state.waiting.clear()
        self._changed.notify()
        return taken

    def _take_candidates_here(self) -> None:
        self._state.check_keeps_candidates()
        self._taker = asyncio.current_task()

    async def run(self, batches: Union[Iterable[PosesLike], AsyncIterable[PosesLike]]
                  ) -> AsyncIterator[v1.CandidateSet]:
        """Appends all batches, which may come asynchronously, beside the caller,
        finishes, and yields the answers of checks meanwhile. An error of the stream or
        of `batches` is raised; a loop that is left early cancels the stream, at the
        latest when the stream is closed."""
        self._take_candidates_here()
        failed: list[BaseException] = []

        async def feed() -> None:
            try:
                async for batch in _each(batches):
                    await self.append(batch)
                await self.finish()
            except BaseException as error:
                failed.append(error)
                self.cancel()

        feeder = asyncio.get_running_loop().create_task(feed())
        try:
            async for answer in self.candidates():
                yield answer
        except Cancelled as error:
            if failed:
                raise failed[0] from None
            raise error
        finally:
            feeder.cancel()
            await self.close()
            await asyncio.wait({feeder})

    # The state of the stream.

    @property
    def jumps(self) -> list[v1.Jump]:
        return list(self._state.jumps)

    @property
    def warnings(self) -> list[v1.Warning]:
        return list(self._state.warnings)

    @property
    def acked_sequence(self) -> int:
        return self._state.acked_sequence

    @property
    def vehicle_uid(self) -> str:
        return self._state.vehicle_uid

    @property
    def reconnects(self) -> int:
        return self._state.reconnects

    @property
    def pending_poses(self) -> int:
        return len(self._state.pending)

    @property
    def pending_bytes(self) -> int:
        return self._state.pending.bytes


def document(made: type, model: type) -> None:
    """Gives the members of a class that have no description those of its model."""
    for name, member in vars(made).items():
        if not name.startswith("_") and not member.__doc__:
            member.__doc__ = getattr(model, name).__doc__


document(PoseStream, pose_stream.PoseStream)
