"""The attempts of one call, however a client waits between them."""

from __future__ import annotations

import dataclasses
import time
from typing import Any, Optional

from revisit._arguments import at_least, instance, seconds
from revisit._calls import Call
from revisit.backoff import Backoff, BackoffOptions
from revisit.channel import Caller, Metadata, owner_route
from revisit.errors import (
    Error, ResourceExhausted, Unavailable, is_cut, lost_to_others, reads_histories,
    was_elsewhere)


def _may_repeat(error: Error, is_safe: bool, takes_any_revision: bool) -> bool:
    if isinstance(error, ResourceExhausted):
        # The server says that it did nothing, and when to send the same again.
        return error.retry_delay is not None
    return was_elsewhere(error) or (takes_any_revision and lost_to_others(error)) or (
        is_safe and (isinstance(error, Unavailable) or is_cut(error)))


@dataclasses.dataclass(frozen=True)
class CallOptions:
    """How long and how often a client tries its calls."""

    #: Seconds for a call with all its attempts and waits.
    deadline: float
    #: The same for exports and revisions.
    bulk_deadline: float
    #: The first one counts.
    max_attempts: int
    backoff: BackoffOptions

    def __post_init__(self) -> None:
        seconds("deadline", self.deadline)
        seconds("bulk_deadline", self.bulk_deadline)
        at_least("max_attempts", self.max_attempts, 1)
        instance("backoff", self.backoff, BackoffOptions, "revisit.BackoffOptions")

    def attempts(self, caller: Caller, call: Call[Any], deadline: Optional[float],
                 request_id: Optional[str]) -> Attempts:
        """The attempts of one call; `deadline` counts before the client's own."""
        if deadline is None:
            deadline = self.bulk_deadline if call.is_bulk else self.deadline
        else:
            seconds("deadline", deadline)
        return Attempts(caller, self.backoff, self.max_attempts, is_safe=call.is_safe,
                        takes_any_revision=call.takes_any_revision,
                        seconds=deadline, request_id=request_id)


class Attempts:
    """Which attempt is the next, and whether there is one. Not thread-safe."""

    def __init__(self, caller: Caller, backoff: BackoffOptions, max_attempts: int, *,
                 is_safe: bool, seconds: float, request_id: Optional[str],
                 takes_any_revision: bool = False) -> None:
        """`is_safe`: doing it twice is the same as doing it once. `takes_any_revision`:
        where others were first, nothing was done, and it may be done again. `seconds`
        are for all attempts and the waits between them."""
        self._caller = caller
        self._backoff = Backoff(backoff)
        self._max_attempts = max_attempts
        self._is_safe = is_safe
        self._takes_any_revision = takes_any_revision
        self._deadline = time.monotonic() + seconds
        self._count = 1
        self._route: Metadata = ()
        #: The same for all attempts, once the first has begun.
        self.request_id = request_id

    def begin(self) -> dict[str, Any]:
        """Begins the next attempt. Returns the arguments that gRPC gets with it."""
        self.request_id, metadata = self._caller.metadata(self.request_id)
        return {"timeout": max(self._deadline - time.monotonic(), 0.0),
                "metadata": metadata + self._route}

    def wait_after(self, error: Error) -> float:
        """How many seconds to wait after an attempt that failed; raises the error if
        there is no other attempt."""
        if was_elsewhere(error) or reads_histories(error):
            # Until the deadline: after a server has died, others say so until its
            # lease has run out, and the histories of a group may be long.
            self._count -= 1
            self._backoff.reset()
        if self._count >= self._max_attempts or not _may_repeat(
                error, self._is_safe, self._takes_any_revision):
            raise error
        wait = self._backoff.next(error.retry_delay)
        if time.monotonic() + wait >= self._deadline:
            raise error
        self._count += 1
        self._route = owner_route(error)
        return wait
