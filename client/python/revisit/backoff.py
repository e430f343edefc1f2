"""How long to wait before trying again."""

from __future__ import annotations

import dataclasses
import random
from typing import Optional


@dataclasses.dataclass(frozen=True)
class BackoffOptions:
    """An exponential back-off with jitter. Times are in seconds."""

    initial: float = 0.1
    max: float = 10.0
    #: Each wait is this many times the one before. At least 1.
    multiplier: float = 2.0
    #: A wait is drawn evenly from [(1 - jitter) * wait, wait], so that many
    #: clients do not come back at once. Range [0, 1].
    jitter: float = 0.5

    def __post_init__(self) -> None:
        if not 0.0 <= self.initial <= self.max:
            raise ValueError(f"initial is {self.initial} s: it lies between 0 and max, "
                             f"which is {self.max} s")
        if not self.multiplier >= 1.0:
            raise ValueError(f"multiplier is {self.multiplier}: it is at least 1")
        if not 0.0 <= self.jitter <= 1.0:
            raise ValueError(f"jitter is {self.jitter}: it lies in [0, 1]")


class Backoff:
    """The waits of one call or stream. Not thread-safe."""

    def __init__(self, options: BackoffOptions) -> None:
        self._options = options
        self._random = random.Random()
        self._wait = options.initial

    def next(self, at_least: Optional[float] = None) -> float:
        """The next wait in seconds: at least `at_least`, where the server asked
        for it; the jitter then comes on top."""
        longest = min(self._wait, self._options.max)
        shortest = (1.0 - self._options.jitter) * longest
        own = self._random.uniform(shortest, longest)
        self._wait = min(self._wait * self._options.multiplier, self._options.max)
        asked = at_least or 0.0
        return own if asked <= own else asked + (own - shortest)

    def reset(self) -> None:
        """Starts over, after success."""
        self._wait = self._options.initial
