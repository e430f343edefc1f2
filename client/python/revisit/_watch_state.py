"""The state of a watch of candidates, and what each answer makes of it: the same
whether threads or tasks of asyncio move it. Nothing here waits or is thread-safe."""

from __future__ import annotations

import collections
import dataclasses
import logging
from collections.abc import Iterator
from typing import Any, Callable, Generic, Optional, TypeVar, Union

from google.protobuf.timestamp_pb2 import Timestamp

from revisit import v1
from revisit._arguments import instance
from revisit._calls import CheckPages, evidence_of, vehicle_of
from revisit._stream_state import worth_another_connection
from revisit.backoff import Backoff, BackoffOptions
from revisit.channel import PathLike
from revisit.cursor_file import CursorFile
from revisit.errors import DeadlineExceeded, Error, Internal, OutOfRange

log = logging.getLogger("revisit")

#: A connection that has brought nothing for so many seconds is given up for a new one:
#: the server tells something every 10 s or so, and gRPC may miss its end.
ANSWER_SECONDS = 60.0
#: Vehicles of which the number of the last event is remembered, the newest.
_MOST_VEHICLES = 100_000


@dataclasses.dataclass(frozen=True)
class EventFields:
    """A candidate came into a state, or a vehicle was deleted with its candidates."""

    #: `vehicles/{vehicle}`.
    vehicle: str
    #: The candidate as it is from this event on, with its name and its state. None if
    #: the vehicle was deleted.
    candidate: Optional[v1.CheckCandidate]
    #: What the last search that found it did, with the nodes of both places. None with
    #: `candidate`.
    evidence: Optional[v1.Candidate]
    #: The revision at which it was found; 0 if the vehicle was deleted.
    revision: int
    #: Whether the vehicle was deleted.
    vehicle_deleted: bool
    #: v1.Vehicle.uid.
    vehicle_uid: str
    #: Number among the events of the vehicle, without gaps but for events that the
    #: watch does not ask for. If `resynchronised`, that of the last event about the
    #: candidate.
    number: int
    #: Where a watch goes on behind this event. If `resynchronised`, where one lists
    #: again, but for the last of the list.
    cursor: str
    #: Whether it comes of a list of what is stored: the candidate as it is now, however
    #: often it changed. So a watch begins `from_start`, and so it goes on where its
    #: cursor cannot be served; vehicles that were deleted before are not told then.
    resynchronised: bool
    event_time: Timestamp

    @property
    def is_contradicted(self) -> bool:
        """Whether the candidate is open once more because the loop closure that
        confirmed it contradicts others, which agree with each other."""
        return (self.candidate is not None
                and self.candidate.state == v1.CANDIDATE_STATE_OPEN
                and self.candidate.cause == v1.CANDIDATE_CAUSE_CONTRADICTION)


_Event = TypeVar("_Event", bound=EventFields)


def _vehicle_deleted(response: v1.WatchCandidatesResponse) -> dict[str, Any]:
    told = response.vehicle_deleted
    return {"vehicle": told.vehicle, "candidate": None, "evidence": None,
            "revision": 0, "vehicle_deleted": True, "vehicle_uid": told.vehicle_uid,
            "number": told.number, "cursor": response.cursor,
            "resynchronised": False, "event_time": told.event_time}


def _changed(response: v1.WatchCandidatesResponse) -> dict[str, Any]:
    told = response.candidate
    return {"vehicle": vehicle_of(told.check), "candidate": told.candidate,
            "evidence": told.evidence, "revision": told.revision,
            "vehicle_deleted": False, "vehicle_uid": told.vehicle_uid,
            "number": told.number, "cursor": response.cursor,
            "resynchronised": False, "event_time": told.event_time}


def _matches(wanted: v1.CandidateFilter, candidate: v1.CheckCandidate,
             evidence: v1.Candidate) -> bool:
    return ((not wanted.states or candidate.state in wanted.states)
            and (not wanted.verdicts or evidence.verdict in wanted.verdicts)
            and evidence.probability >= wanted.least_probability
            and candidate.value_square_meters >= wanted.least_value_square_meters)


def _listed(check: v1.Check, wanted: v1.CandidateFilter) -> Iterator[dict[str, Any]]:
    """The candidates of a check that match, without the cursor."""
    for candidate in check.states:
        evidence = evidence_of(check, candidate)
        if evidence is None:
            if candidate.rank or candidate.latest_rank:
                raise Internal(f"{candidate.name} has the ranks {candidate.rank} and "
                               f"{candidate.latest_rank}, which its check has not")
            # Neither the first search of the check nor the last one found it.
            evidence = v1.Candidate()
        found = check.latest if candidate.latest_rank else check.candidates
        if _matches(wanted, candidate, evidence):
            yield {"vehicle": vehicle_of(check.name), "candidate": candidate,
                   "evidence": evidence, "revision": found.revision,
                   "vehicle_deleted": False, "vehicle_uid": check.vehicle_uid,
                   "number": candidate.event_number,
                   "resynchronised": True, "event_time": candidate.update_time}


class WatchState(Generic[_Event]):
    """A watch, over all of its connections. First there may be a list to read, as long
    as `pages` are there; then it connects."""

    def __init__(self, wanted: v1.CandidateFilter, *, cursor: Optional[str],
                 cursor_file: Union[CursorFile, PathLike, None], from_start: bool,
                 backoff: BackoffOptions, make: Callable[..., _Event]) -> None:
        if cursor is not None and cursor_file is not None:
            raise ValueError("cursor and cursor_file: a watch goes on from one of them")
        instance("cursor", cursor, (str, type(None)), "a string")
        if cursor_file is not None and not isinstance(cursor_file, CursorFile):
            cursor_file = CursorFile(cursor_file)
        self.file = cursor_file
        #: Behind what was worked off. Empty before anything is known.
        self.cursor = cursor_file.load() if cursor_file is not None else cursor or ""
        #: The list that is being read.
        self.pages: Optional[CheckPages] = None
        self._wanted = wanted
        self._from_start = from_start
        self._make = make
        self._backoff = Backoff(backoff)
        #: The event that was handed out and is not worked off.
        self._in_hand: Optional[_Event] = None
        #: Events of the list that are to be handed out.
        self._listed: collections.deque[dict[str, Any]] = collections.deque()
        #: The number of the last event of each vehicle that was worked off, by uid.
        self._numbers: collections.OrderedDict[str, int] = collections.OrderedDict()
        self._was_opened = False
        self._answers = 0
        self.begin()

    def begin(self) -> None:
        """Goes back to the event in hand, if there is one."""
        self._in_hand = None
        self.pages = None
        self._listed.clear()
        if self._from_start and not self.cursor:
            self._list()

    # What was worked off.

    @property
    def cursor_to_keep(self) -> str:
        """Where a watch goes on once the event in hand is worked off."""
        return self.cursor if self._in_hand is None else self._in_hand.cursor

    def worked_off(self) -> None:
        """Nothing is in hand any more, and `cursor` is behind what was."""
        done, self._in_hand = self._in_hand, None
        if done is not None and not done.resynchronised:
            self._numbers[done.vehicle_uid] = done.number
            self._numbers.move_to_end(done.vehicle_uid)
            if len(self._numbers) > _MOST_VEHICLES:
                self._numbers.popitem(last=False)

    # The list.

    def _list(self) -> None:
        self.pages = CheckPages("-", self._wanted)
        self._listed.clear()
        # A store that was restored counts again from where it was.
        self._numbers.clear()

    @property
    def needs_page(self) -> bool:
        """Whether `next_listed()` needs another page: it knows the last event of the
        list by its end."""
        return (self.pages is not None and not self.pages.is_read
                and len(self._listed) < 2)

    def take_page(self, page: v1.ListChecksResponse) -> None:
        assert self.pages is not None
        self.pages.take(page)
        if not self.pages.watch_cursor:
            raise Internal("the server's list of checks has no watch_cursor")
        while self.pages.checks:
            self._listed.extend(_listed(self.pages.checks.popleft(), self._wanted))

    def next_listed(self) -> Optional[_Event]:
        """The next event of the list. None if it is over: then the cursor is that of
        the list."""
        assert self.pages is not None
        if not self._listed:
            self.pages = None
            return None
        fields = self._listed.popleft()
        cursor = self.cursor
        if not self._listed and self.pages.is_read:
            cursor = self.pages.watch_cursor or cursor
            self.pages = None
        self._in_hand = self._make(**fields, cursor=cursor)
        return self._in_hand

    # The connections, one after the other.

    def request(self) -> v1.WatchCandidatesRequest:
        """For the next connection."""
        self._answers = 0
        return v1.WatchCandidatesRequest(filter=self._wanted, cursor=self.cursor)

    def take(self, response: v1.WatchCandidatesResponse) -> Optional[_Event]:
        """The event that an answer tells, unless it was told before: then the answer
        is worked off."""
        self._was_opened = True
        self._answers += 1
        if response.HasField("candidate"):
            fields = _changed(response)
        elif response.HasField("vehicle_deleted"):
            fields = _vehicle_deleted(response)
        else:
            if self._answers > 1:
                self._backoff.reset()
            return None
        if fields["number"] <= self._numbers.get(fields["vehicle_uid"], 0):
            return None
        self._backoff.reset()
        self._in_hand = self._make(**fields)
        return self._in_hand

    def wait_after(self, error: Error) -> float:
        """How many seconds to wait before another connection, after one that ended
        with this error; raises it if there is none."""
        wait = self._backoff.next(error.retry_delay)
        if (isinstance(error, OutOfRange) and self.pages is None
                and error.reason in ("CURSOR_TOO_OLD", "CURSOR_UNKNOWN")):
            log.warning("watch: events may be missing, all candidates are listed: %s",
                        error)
            self._list()
        elif (worth_another_connection(error, self._was_opened)
                or error.reason == "SLOW_CONSUMER"
                or (self.pages is not None and isinstance(error, DeadlineExceeded))):
            log.info("watch: connecting again in %.1f s: %s", wait, error)
        else:
            raise error
        return wait
