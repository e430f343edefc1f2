"""A signal that tasks of one event loop wait for."""

from __future__ import annotations

import asyncio
import time
from typing import Callable, Optional


class Signal:
    """A condition without a lock: nothing runs beside a task until it waits."""

    def __init__(self) -> None:
        self._waiters: set[asyncio.Future[None]] = set()

    def notify(self) -> None:
        """Wakes all that wait."""
        for waiter in self._waiters:
            if not waiter.done():
                waiter.set_result(None)
        self._waiters.clear()

    async def wait(self, timeout: Optional[float] = None) -> None:
        """Waits until notified, or so many seconds."""
        waiter: asyncio.Future[None] = asyncio.get_running_loop().create_future()
        self._waiters.add(waiter)
        try:
            await asyncio.wait({waiter}, timeout=timeout)
        finally:
            self._waiters.discard(waiter)

    async def wait_for(self, condition: Callable[[], bool],
                       timeout: Optional[float] = None) -> bool:
        """Waits until the condition holds, or so many seconds; whether it does."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while not condition():
            left = None if deadline is None else deadline - time.monotonic()
            if left is not None and left <= 0.0:
                return False
            await self.wait(left)
        return True
