"""The calls of the service as the clients make them: what is asked, and what of the
answer is handed out. The blocking client and that of asyncio make the same ones."""

from __future__ import annotations

import collections
import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Callable, Generic, Optional, TypeVar, Union

import numpy as np
from google.protobuf import field_mask_pb2
from numpy.typing import ArrayLike

from revisit import v1
from revisit._arguments import check_call, instance, message, numbers, refuse, text
from revisit._names import Vehicles, vehicle_name, vehicle_names
from revisit._pose_columns import arrays_of, columns_of, sequence_at
from revisit._settings import merged, number_of
from revisit.arrays import Poses, PosesLike, pose_messages, to_covariances
from revisit.errors import Internal, InvalidArgument, located
from revisit.tables import PoseGraph, edge_table, node_table

_T = TypeVar("_T")
#: One value of an enum or several, by number or by name as in settings.
Words = Union[str, int, Iterable[Union[str, int]], None]
_Pair = TypeVar("_Pair", v1.LoopClosure, v1.RejectedCandidate)

#: Calls of which two are not the same as one: between two attempts another caller
#: may have changed the same thing.
_NEVER_REPEATED = frozenset({
    "UpdateVehicle", "DeleteVehicle", "DeleteLoopClosure", "DeleteRejectedCandidate",
    "AcceptDataLoss", "UpdateGroup", "DeleteGroup", "UpdateGroupMember",
    "RemoveGroupMember", "DeleteInterVehicleLoopClosure",
    "DeleteInterVehicleRejectedCandidate"})

#: Changes of a group, which may be made again if they lost to those of others, unless
#: they are for one revision.
_CHANGES_OF_GROUPS = frozenset({
    "UpdateGroup", "DeleteGroup", "AddGroupMember", "UpdateGroupMember",
    "RemoveGroupMember", "AddInterVehicleLoopClosure", "DeleteInterVehicleLoopClosure",
    "RejectInterVehicleCandidate", "DeleteInterVehicleRejectedCandidate"})

#: Poses in a message of RevisePoses.
_REVISED_POSES = 1000
#: Poses and pairs on a page of a list.
_POSES_PAGE = 10_000
PAGE = 1000
#: Deleted pairs, which may be larger.
_DELETED_PAGE = 500
#: Checks on a page, which have all candidates of a search.
_CHECKS_PAGE = 200
#: Empty pages that may follow each other. The service sends none before the last, but
#: of what groups have, where the caller may not read it.
_MOST_EMPTY_PAGES = 100
#: The same of checks, of which a filter may leave out many pages.
_MOST_EMPTY_PAGES_OF_CHECKS = 100_000


def _messages(poses: PosesLike) -> Iterable[v1.Pose]:
    return poses.to_messages() if isinstance(poses, Poses) else pose_messages(poses)


@dataclasses.dataclass(frozen=True)
class Call(Generic[_T]):
    """One call. What the stub answers goes to `unpack`: a message, or the list of
    those that a stream brought."""

    method: str
    #: A message, or what makes the iterator of a stream of them for each attempt.
    request: Union[Any, Callable[[], Iterator[Any]]]
    unpack: Callable[[Any], _T]
    #: Whether doing it twice is the same as doing it once.
    is_safe: bool = True
    #: Whether it may be made again if it lost to changes of others.
    takes_any_revision: bool = False
    #: Whether it has the time of exports and revisions.
    is_bulk: bool = False
    #: Whether it answers a stream.
    answers_stream: bool = False

    def start(self, stub: Any, arguments: dict[str, Any]) -> Any:
        """Begins the call. Returns the answer, or gRPC's handle of the call."""
        request = self.request() if callable(self.request) else self.request
        return getattr(stub, self.method)(request, **arguments)


def unary(method: str, request: Any,
          unpack: Callable[[Any], _T] = lambda answer: answer) -> Call[_T]:
    return Call(method, request, unpack, is_safe=method not in _NEVER_REPEATED,
                takes_any_revision=method in _CHANGES_OF_GROUPS
                and getattr(request, "expected_revision", 0) == 0)


def named(method: str, request: Any) -> Call[Any]:
    """Any unary call, as the caller names it."""
    check_call(method, request)
    return unary(method, request)


class Pages(Generic[_T]):
    """A list that is read page by page: `request` is for the next one."""

    def __init__(self, method: str, request: Any,
                 field: Union[str, Callable[[Any], Iterable[_T]]],
                 order: Callable[[Any], Any] = lambda item: item.name,
                 most_empty_pages: int = _MOST_EMPTY_PAGES,
                 is_changing: bool = False) -> None:
        """`field` of an answer, by its name or as a function of the answer, has what is
        on a page, in ascending `order`; or, where the order `is_changing` while the
        pages are read, in any: then what comes twice is left out the second time."""
        self._method = method
        self._request = request
        self._field = field
        self._order = order
        self._most_empty_pages = most_empty_pages
        self._last: Any = None
        self._seen: Optional[set[Any]] = set() if is_changing else None
        self._empty_pages = 0
        self._has_brought = False

    def call(self) -> Call[Any]:
        return unary(self._method, self._request)

    def items(self, page: Any) -> Iterator[_T]:
        """The items of a page. Internal if the list does not go on in its order, as
        when the server sends a page again, or consists of pages that are empty or
        bring nothing new: it might never end."""
        self._has_brought = False
        found = (getattr(page, self._field) if isinstance(self._field, str)
                 else self._field(page))
        for item in found:
            key = self._order(item)
            if self._seen is not None:
                if key in self._seen:
                    continue
                self._seen.add(key)
            elif self._last is not None and key <= self._last:
                raise Internal(f"the server's list does not go on: {key} comes "
                               f"after {self._last}")
            self._last = key
            self._has_brought = True
            yield item

    def turn(self, page: Any) -> bool:
        """Asks for the page after this one; whether there is one."""
        if not page.next_page_token:
            return False
        self._empty_pages = 0 if self._has_brought else self._empty_pages + 1
        if self._empty_pages > self._most_empty_pages:
            raise Internal(f"the server's list does not go on: {self._empty_pages} "
                           "pages that bring nothing new follow each other, and each "
                           "names another")
        self._request.page_token = page.next_page_token
        return True


# Vehicles.


def _vehicle_of(answer: Any) -> v1.Vehicle:
    vehicle: v1.Vehicle = answer.vehicle
    return vehicle


def create_vehicle(vehicle_id: str, settings: Optional[v1.VehicleSettings],
                   display_name: str, labels: Optional[Mapping[str, str]],
                   keywords: Mapping[str, Any]) -> Call[v1.Vehicle]:
    return unary("CreateVehicle", message(
        v1.CreateVehicleRequest,
        vehicle_id=text("vehicle_id", vehicle_id).removeprefix("vehicles/"),
        vehicle=message(
            v1.Vehicle, settings=merged(v1.VehicleSettings, settings, keywords),
            display_name=display_name, labels=labels)), _vehicle_of)


def get_vehicle(vehicle: str) -> Call[v1.Vehicle]:
    return unary("GetVehicle", v1.GetVehicleRequest(name=vehicle_name(vehicle)),
                 _vehicle_of)


def list_vehicles() -> Pages[v1.Vehicle]:
    return Pages("ListVehicles", v1.ListVehiclesRequest(page_size=PAGE), "vehicles")


def changed_paths(names: Iterable[str], keywords: Mapping[str, Any],
                  display_name: Optional[str]) -> list[str]:
    """The settings that change, and the display name unless it is None, as masks name
    them."""
    names = [names] if isinstance(names, str) else names
    return [*(f"settings.{name}" for name in (*names, *keywords)),
            *(["display_name"] if display_name is not None else [])]


def update_vehicle(vehicle: str, settings: Optional[v1.VehicleSettings],
                   names: Iterable[str], display_name: Optional[str],
                   labels: Optional[Mapping[str, Optional[str]]],
                   keywords: Mapping[str, Any]) -> Call[v1.Vehicle]:
    instance("labels", labels, (Mapping, type(None)), "a mapping of strings")
    labels = labels or {}
    changed = message(
        v1.Vehicle, name=vehicle_name(vehicle), display_name=display_name,
        settings=merged(v1.VehicleSettings, settings, keywords),
        labels={key: value for key, value in labels.items() if value is not None})
    paths = [*changed_paths(names, keywords, display_name),
             *(f"labels.{key}" for key in labels)]
    return unary("UpdateVehicle", message(
        v1.UpdateVehicleRequest,
        vehicle=changed, update_mask=field_mask_pb2.FieldMask(paths=paths)),
        _vehicle_of)


def delete_vehicle(vehicle: str) -> Call[Any]:
    return unary("DeleteVehicle", v1.DeleteVehicleRequest(name=vehicle_name(vehicle)))


def accept_data_loss(vehicle: str, durable_sequence: int) -> Call[v1.Vehicle]:
    return unary("AcceptDataLoss", message(
        v1.AcceptDataLossRequest, name=vehicle_name(vehicle),
        durable_sequence=durable_sequence), _vehicle_of)


# Poses.


class Appending:
    """A batch by AppendPoses: arrays as columns, where there are any, or as messages
    for a server that knows no columns."""

    def __init__(self, vehicle: str, poses: PosesLike, vehicle_uid: str) -> None:
        self._poses = poses
        self._request = message(
            v1.AppendPosesRequest,
            vehicle=vehicle_name(vehicle), vehicle_uid=vehicle_uid)
        columns = (columns_of(poses)
                   if isinstance(poses, Poses) and len(poses) > 0 else None)
        if columns is None:
            self._request.poses.extend(_messages(poses))
        else:
            self._request.columns.CopyFrom(columns)

    def call(self) -> Call[v1.Ack]:
        def ack(answer: v1.AppendPosesResponse) -> v1.Ack:
            return answer.ack

        return unary("AppendPoses", self._request, ack)

    def after(self, error: InvalidArgument) -> None:
        """Goes on to messages, if the server has not seen the columns: to one that does
        not know them, there are no poses. Raises any other error."""
        saw_none = error.reason == "BATCH_SIZE" and [
            one.field for one in error.field_violations] == ["poses"]
        if not saw_none or not self._request.HasField("columns"):
            raise located(error, lambda field: sequence_at(field, self._request))
        self._request.ClearField("columns")
        self._request.poses.extend(_messages(self._poses))


def _poses_request(vehicle: str, first_sequence: int, as_sent: bool,
                   as_columns: bool) -> v1.ListPosesRequest:
    return message(
        v1.ListPosesRequest, parent=vehicle_name(vehicle), page_size=_POSES_PAGE,
        first_sequence=first_sequence, view=_view(as_sent), as_columns=as_columns)


def list_poses(vehicle: str, first_sequence: int, as_sent: bool) -> Pages[v1.Pose]:
    return Pages("ListPoses", _poses_request(vehicle, first_sequence, as_sent, False),
                 "poses", order=lambda pose: pose.sequence)


def list_arrays(vehicle: str, first_sequence: int, as_sent: bool) -> Pages[Poses]:
    """The poses of `list_poses()`, some at a time."""
    def parts(page: v1.ListPosesResponse) -> Iterable[Poses]:
        # Servers that do not know columns answer with messages.
        if page.poses:
            yield Poses.from_messages(page.poses)
        yield from map(arrays_of, page.columns)

    return Pages("ListPoses", _poses_request(vehicle, first_sequence, as_sent, True),
                 parts, order=lambda part: int(part.sequence[0]))


def list_recordings(vehicle: str) -> Pages[v1.Recording]:
    return Pages("ListRecordings", v1.ListRecordingsRequest(
        parent=vehicle_name(vehicle), page_size=PAGE), "recordings",
        order=lambda recording: recording.first_sequence)


def revise_poses(vehicle: str, poses: PosesLike, expected_revision: int,
                 common_frame: bool) -> Call[v1.RevisePosesResponse]:
    revised = list(_messages(poses))
    first = message(v1.RevisePosesRequest, vehicle=vehicle_name(vehicle),
                    expected_revision=expected_revision, common_frame=common_frame)
    other = v1.RevisePosesRequest(vehicle=first.vehicle)

    def requests() -> Iterator[v1.RevisePosesRequest]:
        for start in range(0, max(len(revised), 1), _REVISED_POSES):
            part = v1.RevisePosesRequest(poses=revised[start:start + _REVISED_POSES])
            part.MergeFrom(first if start == 0 else other)
            yield part

    return Call("RevisePoses", requests, lambda answer: answer,
                is_safe=expected_revision != 0, is_bulk=True)


def _view(as_sent: bool) -> v1.PoseView:
    return v1.POSE_VIEW_AS_SENT if as_sent else v1.POSE_VIEW_CURRENT


def export_pose_graph(vehicle: str, as_sent: bool) -> Call[PoseGraph]:
    def graph(parts: list[v1.ExportPoseGraphResponse]) -> PoseGraph:
        return PoseGraph(
            parts[0].vehicle if parts else v1.Vehicle(),
            node_table(node for part in parts for node in part.nodes),
            edge_table(edge for part in parts for edge in part.edges))

    return Call("ExportPoseGraph",
                v1.ExportPoseGraphRequest(vehicle=vehicle_name(vehicle),
                                          view=_view(as_sent)), graph,
                is_bulk=True, answers_stream=True)


# Candidates, and what a verifier found of them.


def find_candidates(vehicle: str, sequence: int,
                    options: Optional[v1.CandidateOptions],
                    scope: Optional[v1.SearchScope],
                    keywords: Mapping[str, Any]) -> Call[v1.CandidateSet]:
    def candidates(answer: v1.FindCandidatesResponse) -> v1.CandidateSet:
        return answer.candidates

    if scope is not None:
        keywords = {**keywords, "scope": scope}
    return unary("FindCandidates", message(
        v1.FindCandidatesRequest, vehicle=vehicle_name(vehicle), sequence=sequence,
        options=merged(v1.CandidateOptions, options, keywords)), candidates)


def _pair(query: Union[int, v1.Candidate, _Pair], matched: Optional[int],
          kind: type[_Pair], note: str) -> _Pair:
    """The message that reports a finding, unless the caller has made it."""
    if isinstance(query, (int, np.integer)):
        if matched is None:
            raise TypeError("matched is missing: two sequences, or a candidate")
        return message(kind, query_sequence=query, matched_sequence=matched, note=note)
    if not isinstance(query, (v1.Candidate, kind)):
        refuse("query", query, f"a sequence, a v1.Candidate or a v1.{kind.__name__}")
    if matched is not None:
        raise TypeError(f"matched: got {matched!r} beside a {type(query).__name__}, "
                        "which has both poses")
    if isinstance(query, v1.Candidate):
        return message(kind, query_sequence=query.query.sequence,
                       matched_sequence=query.matched.sequence, note=note)
    if note:
        raise ValueError(f"note: got {note!r} beside a {kind.__name__}, which has "
                         "a note of its own")
    return query


def coordinates_of(coordinates: ArrayLike, name: str, maps: str) -> dict[str, float]:
    """x, y, z and heading as messages have them, of (x, y, heading), (x, y, z, heading)
    or a matrix that `maps` something."""
    array = numbers(name, coordinates)
    if array.shape in ((3, 3), (4, 4)):
        turn = np.arctan2(array[1, 0], array[0, 0])
        array = np.append(array[:-1, -1], turn)
    if array.shape not in ((3,), (4,)):
        raise ValueError(
            f"{name} has the shape {array.shape}: expected x, y, heading, or x, y, "
            f"z, heading, or a matrix (3, 3) or (4, 4) that maps {maps}")
    x, y, *z, heading = array.tolist()
    return {"x_meters": x, "y_meters": y, "z_meters": z[0] if z else 0.0,
            "heading_radians": heading}


def covariance_of(covariance: ArrayLike) -> v1.Covariance:
    """The covariance of one error, as `to_covariances()` takes those of poses."""
    values, form = to_covariances(numbers("covariance", covariance)[np.newaxis], 1)
    return v1.Covariance(form=v1.CovarianceForm.Name(form), values=values[0])


def _measurement(relative: ArrayLike,
                 covariance: Optional[ArrayLike]) -> v1.LoopClosureMeasurement:
    if covariance is None:
        raise TypeError("relative needs its covariance: nothing is assumed of it")
    return v1.LoopClosureMeasurement(
        **coordinates_of(relative, "relative", "the query's body into the match's"),
        covariance=covariance_of(covariance))


def add_findings(closure: Union[v1.LoopClosure, v1.InterVehicleLoopClosure],
                 relative: Optional[ArrayLike], covariance: Optional[ArrayLike],
                 score: Optional[float]) -> None:
    """Writes what a verifier measured into a loop closure."""
    if relative is not None:
        closure.measurement.CopyFrom(_measurement(relative, covariance))
    elif covariance is not None:
        raise TypeError("covariance is that of relative, which is missing")
    if score is not None:
        found: Any = message(type(closure), score=score)
        closure.MergeFrom(found)


def add_loop_closure(vehicle: str, query: Union[int, v1.Candidate, v1.LoopClosure],
                     matched: Optional[int], relative: Optional[ArrayLike],
                     covariance: Optional[ArrayLike], score: Optional[float],
                     note: str, loop_closure_id: str, candidate: str
                     ) -> Call[v1.AddLoopClosureResponse]:
    made = v1.LoopClosure()
    made.CopyFrom(_pair(query, matched, v1.LoopClosure, note))
    add_findings(made, relative, covariance, score)
    return unary("AddLoopClosure", message(
        v1.AddLoopClosureRequest,
        parent=vehicle_name(vehicle), loop_closure_id=loop_closure_id,
        loop_closure=made, candidate=candidate))


def list_loop_closures(vehicle: str) -> Pages[v1.LoopClosure]:
    return Pages("ListLoopClosures", v1.ListLoopClosuresRequest(
        parent=vehicle_name(vehicle), page_size=PAGE), "loop_closures")


def delete_loop_closure(name: str) -> Call[Any]:
    return unary("DeleteLoopClosure", message(v1.DeleteLoopClosureRequest, name=name))


def find_contradictions(vehicle: str) -> Call[list[v1.Contradiction]]:
    def contradictions(answer: v1.FindContradictionsResponse
                       ) -> list[v1.Contradiction]:
        return list(answer.contradictions)

    return unary("FindContradictions", v1.FindContradictionsRequest(
        vehicle=vehicle_name(vehicle)), contradictions)


def reject_candidate(vehicle: str,
                     query: Union[int, v1.Candidate, v1.RejectedCandidate],
                     matched: Optional[int], note: str, rejected_candidate_id: str,
                     candidate: str) -> Call[v1.RejectCandidateResponse]:
    return unary("RejectCandidate", message(
        v1.RejectCandidateRequest,
        parent=vehicle_name(vehicle), rejected_candidate_id=rejected_candidate_id,
        rejected_candidate=_pair(query, matched, v1.RejectedCandidate, note),
        candidate=candidate))


def list_rejected_candidates(vehicle: str) -> Pages[v1.RejectedCandidate]:
    return Pages("ListRejectedCandidates", v1.ListRejectedCandidatesRequest(
        parent=vehicle_name(vehicle), page_size=PAGE), "rejected_candidates")


def delete_rejected_candidate(name: str) -> Call[Any]:
    return unary("DeleteRejectedCandidate",
                 message(v1.DeleteRejectedCandidateRequest, name=name))


def _deletion_order(pair: v1.DeletedPosePair) -> int:
    """The number that the name ends with, which becomes smaller."""
    number = pair.name.rpartition("/")[2]
    return -int(number) if number.isdecimal() else 0


def list_deleted_pose_pairs(vehicle: str) -> Pages[v1.DeletedPosePair]:
    return Pages("ListDeletedPosePairs", v1.ListDeletedPosePairsRequest(
        parent=vehicle_name(vehicle), page_size=_DELETED_PAGE), "deleted_pose_pairs",
        order=_deletion_order)


# Checks that are stored.


def candidate_filter(vehicles: Vehicles, states: Words, verdicts: Words,
                     least_probability: Optional[float],
                     least_value: Optional[float]) -> v1.CandidateFilter:
    return message(
        v1.CandidateFilter, vehicles=vehicle_names(vehicles),
        states=_numbers(v1.CandidateState, "states", states),
        verdicts=_numbers(v1.Verdict, "verdicts", verdicts),
        least_probability=least_probability,
        least_value_square_meters=least_value)


def evidence_of(check: v1.Check, candidate: v1.CheckCandidate
                ) -> Optional[v1.Candidate]:
    """What the last search that found a candidate of a check found of it: the check's
    latest search where that found it, or else its first one. None where neither did,
    as of a candidate that only a search between these found."""
    found, rank = ((check.latest, candidate.latest_rank) if candidate.latest_rank
                   else (check.candidates, candidate.rank))
    return next((one for one in found.candidates if one.rank == rank), None)


def _numbers(enum: Any, name: str, words: Words) -> list[Any]:
    if words is None:
        return []
    if isinstance(words, str) or not isinstance(words, Iterable):
        words = (words,)
    return [number_of(enum.DESCRIPTOR, name, word) for word in words]


def get_check(name: str) -> Call[v1.Check]:
    def check(answer: v1.GetCheckResponse) -> v1.Check:
        return answer.check

    return unary("GetCheck", message(v1.GetCheckRequest, name=name), check)


def vehicle_of(name: str) -> str:
    """The vehicle that something of this resource name belongs to."""
    return "/".join(name.split("/")[:2])


def _check_order(check: v1.Check) -> tuple[str, int]:
    number = check.name.rpartition("/")[2]
    return vehicle_of(check.name), int(number) if number.isdecimal() else 0


def _order_of(order: Union[str, int, None]) -> Any:
    """The order by its number, or by a word of the command line: "value"."""
    words = {"time": v1.LIST_CHECKS_ORDER_BY_TIME,
             "value": v1.LIST_CHECKS_ORDER_BY_VALUE}
    if isinstance(order, str) and order not in words:
        raise ValueError(f"order is {order!r}: expected one of {', '.join(words)}")
    return words[order] if isinstance(order, str) else order


class CheckPages:
    """The checks of a list, page by page."""

    def __init__(self, vehicle: str, wanted: v1.CandidateFilter,
                 order: Union[str, int, None] = None, fresh_only: bool = False,
                 looks_per_kilometer: int = 0) -> None:
        request = message(
            v1.ListChecksRequest,
            parent=vehicle_name(vehicle), page_size=_CHECKS_PAGE, filter=wanted,
            order=_order_of(order), fresh_only=fresh_only,
            looks_per_kilometer=looks_per_kilometer)
        self._pages: Pages[v1.Check] = Pages(
            "ListChecks", request, "checks", order=_check_order,
            most_empty_pages=_MOST_EMPTY_PAGES_OF_CHECKS,
            is_changing=request.order == v1.LIST_CHECKS_ORDER_BY_VALUE)
        #: Of the pages that were read, those that nobody has taken yet.
        self.checks: collections.deque[v1.Check] = collections.deque()
        #: Of the first page; None before it was read.
        self.watch_cursor: Optional[str] = None
        #: Whether the last page was read.
        self.is_read = False

    def call(self) -> Call[Any]:
        """For the next page."""
        return self._pages.call()

    def take(self, page: v1.ListChecksResponse) -> None:
        if self.watch_cursor is None:
            self.watch_cursor = page.watch_cursor
        self.checks.extend(self._pages.items(page))
        self.is_read = not self._pages.turn(page)


def server_info() -> Call[v1.GetServerInfoResponse]:
    return unary("GetServerInfo", v1.GetServerInfoRequest())
