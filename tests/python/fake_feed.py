"""A service with stored checks, whose watches end when and as a test says."""

import threading
import time

import grpc
from fake_service import Fault, FakeService

from revisit import v1

UID = "uid-{}"
#: Seconds between two looks for what there is to tell.
LOOK = 0.005


def check(vehicle, sequence, *states, probability=0.9):
    """A check whose candidates have these states, the less probable the later."""
    name = f"vehicles/{vehicle}/checks/{sequence}"
    made = v1.Check(name=name)
    made.candidates.revision = 100 + sequence
    for rank, state in enumerate(states, start=1):
        made.candidates.candidates.add(
            rank=rank, probability=probability / rank, verdict=v1.VERDICT_ACCEPTED,
            query=v1.Node(sequence=sequence), matched=v1.Node(sequence=rank))
        made.states.add(name=f"{name}/candidates/{rank}", rank=rank, state=state)
    return made


def searched_again(made, number, probability, value):
    """Has a later search, at the revision 200, find this candidate of a check alone."""
    state = made.states[number - 1]
    made.latest.revision = 200
    made.latest.candidates.add(
        rank=1, probability=probability, verdict=v1.VERDICT_ACCEPTED,
        query=v1.Node(sequence=7), matched=v1.Node(sequence=number))
    state.latest_rank, state.value_square_meters = 1, value
    return made


def closure(vehicle, closure_id, query, matched):
    return v1.LoopClosure(name=f"vehicles/{vehicle}/loopClosures/{closure_id}",
                          query_sequence=query, matched_sequence=matched, note="icp")


class FakeFeed(FakeService):
    """Its cursors are "STORE:COUNT": behind so many events of a store."""

    def __init__(self):
        super().__init__()
        self.store = "one"
        #: What is told, in order.
        self.events = []
        #: Events below are kept no longer.
        self.oldest = 0
        #: How the watches end, one after the other: after so many answers of its own,
        #: with this fault, or with OK if it is None. A watch for which there is none
        #: goes on.
        self.ends = []
        #: Tells each event so often.
        self.copies = 1
        self.watches = []
        #: Where they come from.
        self.peers = []
        #: Whether one of them has ended.
        self.ended = threading.Event()
        self.checks = []
        self.lists = []
        self.list_faults = []
        self.page_size = 1
        self.decisions = []
        self.closures = []
        self.contradictions = []

    # What there is to tell.

    def _response(self):
        self.events.append(v1.WatchCandidatesResponse())
        self.events[-1].cursor = self.cursor()
        return self.events[-1]

    def cursor(self):
        return f"{self.store}:{len(self.events)}"

    def tell(self, vehicle, number, state=v1.CANDIDATE_STATE_OPEN):
        told = self._response().candidate
        told.check = f"vehicles/{vehicle}/checks/{10 * number}"
        told.number, told.vehicle_uid = number, UID.format(vehicle)
        told.candidate.name = f"{told.check}/candidates/1"
        told.candidate.rank, told.candidate.state = 1, state
        told.evidence.rank, told.evidence.probability = 1, 0.9
        told.evidence.query.sequence = 10 * number
        told.evidence.matched.sequence = number
        told.revision = 7

    def tell_deletion(self, vehicle, number):
        told = self._response().vehicle_deleted
        told.vehicle, told.number = f"vehicles/{vehicle}", number
        told.vehicle_uid = UID.format(vehicle)

    # The service.

    def _start(self, cursor, context):
        if not cursor:
            return len(self.events)
        store, _, count = cursor.partition(":")
        if store != self.store:
            Fault(grpc.StatusCode.OUT_OF_RANGE, reason="CURSOR_UNKNOWN").end(context)
        if int(count) < self.oldest:
            Fault(grpc.StatusCode.OUT_OF_RANGE, reason="CURSOR_TOO_OLD").end(context)
        return int(count)

    def WatchCandidates(self, request, context):
        self._note(context)
        self.watches.append(request)
        self.peers.append(context.peer())
        context.add_callback(self.ended.set)
        after, fault = self.ends.pop(0) if self.ends else (None, None)
        position = self._start(request.cursor, context)
        yield v1.WatchCandidatesResponse(cursor=f"{self.store}:{position}",
                                         beat=v1.WatchBeat())
        answers = 0
        while context.is_active():
            if answers == after:
                if fault is not None:
                    fault.end(context)
                return
            if position == len(self.events):
                if after is None or answers < after:
                    time.sleep(LOOK)
                continue
            for _ in range(self.copies):
                yield self.events[position]
            position += 1
            answers += 1

    def ListChecks(self, request, context):
        self._note(context)
        kept = v1.ListChecksRequest()
        kept.CopyFrom(request)
        self.lists.append(kept)
        if self.list_faults:
            self.list_faults.pop(0).end(context)
        first = int(request.page_token or 0)
        following = first + self.page_size
        answer = v1.ListChecksResponse(checks=self.checks[first:following])
        if first == 0:
            answer.watch_cursor = self.cursor()
        if following < len(self.checks):
            answer.next_page_token = str(following)
        return answer

    def GetCheck(self, request, context):
        self._note(context)
        [found] = [one for one in self.checks if one.name == request.name]
        return v1.GetCheckResponse(check=found)

    def ListLoopClosures(self, request, context):
        self._note(context)
        return v1.ListLoopClosuresResponse(loop_closures=self.closures)

    def FindContradictions(self, request, context):
        self._note(context)
        return v1.FindContradictionsResponse(contradictions=self.contradictions)

    def AddLoopClosure(self, request, context):
        self._note(context)
        self.decisions.append(request)
        return v1.AddLoopClosureResponse(loop_closure=request.loop_closure)

    def RejectCandidate(self, request, context):
        self._note(context)
        self.decisions.append(request)
        return v1.RejectCandidateResponse(
            rejected_candidate=request.rejected_candidate)
