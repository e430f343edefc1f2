"""How a stream of poses behaves, and who hears of what."""

from __future__ import annotations

import dataclasses
from typing import Callable, Optional, Protocol

from revisit import v1
from revisit._arguments import at_least, instance, seconds, text
from revisit._names import Vehicles, search_scope
from revisit.backoff import BackoffOptions
from revisit.errors import Error


class ProgressBar(Protocol):
    """Something that shows progress, such as `tqdm.tqdm(total=len(poses))`."""

    def update(self, n: int, /) -> object:
        """So many more are done."""


@dataclasses.dataclass(frozen=True)
class StreamOptions:
    """Options of a `PoseStream`. Times are in seconds."""

    #: Whether the server answers with candidates at every check, and how.
    send_candidates: bool = False
    candidate_options: Optional[v1.CandidateOptions] = None
    #: The group in whose histories the checks search too, of those that `vehicles`
    #: names, and with `exclude_own` not in that of the vehicle itself. The server may
    #: have to read the histories first: the stream then opens later, unless
    #: `allow_partial`. With `send_candidates` only.
    group: str = ""
    vehicles: Vehicles = None
    exclude_own: bool = False
    allow_partial: bool = False
    #: Highest sequence that this client knows to be durable from an earlier
    #: life; 0 if it keeps no such record. The stream ends with DataLoss if the
    #: server has less.
    acked_sequence: int = 0
    #: `PoseStream.vehicle_uid` of that earlier life; the stream ends with
    #: VehicleReplaced if the vehicle is another by now. Empty: whichever vehicle
    #: has the name when the stream is first opened.
    vehicle_uid: str = ""
    #: Most poses in a message; fewer where the server says so. At least 1.
    batch_poses: int = 64
    #: Unacknowledged poses that are held. At least 1.
    max_pending_poses: int = 65_536
    #: Bytes that the held poses may take: of arrays those of a row, of messages the
    #: serialised ones. A single pose that needs more is refused.
    max_pending_bytes: int = 32 << 20
    #: Answers of checks that wait to be taken, if there is no callback for them.
    #: While there is no room, nothing more is read from the server.
    max_waiting_candidates: int = 10_000
    backoff: BackoffOptions = BackoffOptions()
    #: A connection on which an answer is due and none has come for so long is
    #: given up for a new one: gRPC may miss the end of a server. Time spent in
    #: callbacks, or waiting for room for candidates, does not count.
    answer_timeout: float = 60.0
    #: How long to reconnect without progress before the stream ends with the
    #: last error. Progress means that something became durable or was answered,
    #: or that a connection was opened and nothing waits. None: for ever.
    give_up_after: Optional[float] = None

    def __post_init__(self) -> None:
        for name in ("batch_poses", "max_pending_poses", "max_pending_bytes",
                     "max_waiting_candidates"):
            at_least(name, getattr(self, name), 1)
        at_least("acked_sequence", self.acked_sequence, 0)
        text("vehicle_uid", self.vehicle_uid)
        instance("candidate_options", self.candidate_options,
                 (v1.CandidateOptions, type(None)), "a v1.CandidateOptions")
        instance("backoff", self.backoff, BackoffOptions, "revisit.BackoffOptions")
        if self.group and not self.send_candidates:
            raise ValueError(f"group is {self.group!r} without send_candidates: there "
                             "are no checks that could search in it")
        # Says what is wrong with them.
        self.search_scope()
        seconds("answer_timeout", self.answer_timeout)
        if self.give_up_after is not None:
            seconds("give_up_after", self.give_up_after)

    def search_scope(self) -> Optional[v1.SearchScope]:
        """Where else than in the vehicle's own history the checks search; None without
        a group."""
        return search_scope(self.group, self.vehicles, self.exclude_own,
                            self.allow_partial)


@dataclasses.dataclass(frozen=True)
class StreamCallbacks:
    """Called one at a time, in the order of the server's messages: on a thread of
    this package, without locks held, or by a stream of `revisit.aio` in its event
    loop, which awaits what a callback returns if that can be awaited.

    While one runs no further answers are read, so a slow one slows the server
    down. They may use the properties of the stream and `cancel()`, nothing that
    waits for the stream. An exception from one ends the stream and is raised by its
    methods."""

    ack: Optional[Callable[[v1.Ack], object]] = None
    #: Takes the answers of checks, which then are not kept for
    #: `PoseStream.candidates()`.
    candidates: Optional[Callable[[v1.CandidateSet], object]] = None
    #: The connection was lost, and will be made again after so many seconds. May
    #: run beside the others.
    disconnected: Optional[Callable[[Error, float], object]] = None
    #: The stream goes on behind this durable sequence. Not called for the first
    #: connection.
    resumed: Optional[Callable[[int], object]] = None
    #: Hears how many more of the poses that the stream took became durable.
    progress: Optional[ProgressBar] = None
