"""Calls of revisit.v1.PoseGraphService, with deadlines and retries."""

from __future__ import annotations

import dataclasses
import time
import weakref
from collections.abc import Callable, Iterable, Iterator
from types import TracebackType
from typing import Any, Optional, TypeVar, Union

import grpc
from google.protobuf import field_mask_pb2

from revisit import v1
from revisit.arrays import Poses
from revisit.backoff import Backoff, BackoffOptions
from revisit.channel import (
    Caller, ChannelOptions, Channels, PathLike, owner_route, stub_of)
from revisit.errors import (
    Error, Internal, ResourceExhausted, Unavailable, from_rpc_error, is_cut,
    was_elsewhere)
from revisit.pose_stream import PoseStream, PosesLike
from revisit.stream_options import StreamCallbacks, StreamOptions
from revisit.tables import Table, edge_table, node_table

_T = TypeVar("_T")
_Pair = TypeVar("_Pair", v1.LoopClosure, v1.RejectedCandidate)

#: Calls of which two are not the same as one: between two attempts another caller
#: may have changed the same thing.
_NEVER_REPEATED = frozenset({
    "UpdateVehicle", "DeleteVehicle", "DeleteLoopClosure", "DeleteRejectedCandidate",
    "AcceptDataLoss"})

#: Poses in a message of RevisePoses.
_REVISED_POSES = 1000
#: Poses and pairs on a page of a list.
_POSES_PAGE = 10_000
_PAGE = 1000
#: Empty pages that may follow each other. The service sends none before the last.
_MOST_EMPTY_PAGES = 100


@dataclasses.dataclass(frozen=True)
class PoseGraph:
    """A vehicle's graph at one revision."""

    vehicle: v1.Vehicle
    #: As `node_table()` makes it.
    nodes: Table
    #: As `edge_table()` makes it.
    edges: Table


def vehicle_name(vehicle: str) -> str:
    """The resource name: "vehicles/shuttle-7", also of the id "shuttle-7"."""
    return vehicle if "/" in vehicle else f"vehicles/{vehicle}"


def _messages(poses: PosesLike) -> Iterable[v1.Pose]:
    return poses.to_messages() if isinstance(poses, Poses) else poses


def _finding(pair: Union[v1.Candidate, _Pair], kind: type[_Pair],
             note: str) -> _Pair:
    """The message that reports a finding about a candidate, unless the caller has
    made it."""
    if isinstance(pair, v1.Candidate):
        return kind(query_sequence=pair.query.sequence,
                    matched_sequence=pair.matched.sequence, note=note)
    if note:
        raise ValueError(f"note: got {note!r} beside a {kind.__name__}, which has "
                         "a note of its own")
    return pair


def _may_repeat(error: Error, is_safe: bool) -> bool:
    if isinstance(error, ResourceExhausted):
        # The server says that it did nothing, and when to send the same again.
        return error.retry_delay is not None
    return was_elsewhere(error) or (
        is_safe and (isinstance(error, Unavailable) or is_cut(error)))


class Client:
    """One server. Thread-safe: any number of threads may call at the same time.

        with revisit.Client("127.0.0.1:50051") as client:
            client.create_vehicle("shuttle-7")

    Vehicles are named by id or resource name. Every method raises `Error`, with
    the server's reason and field violations; a request that failed has changed
    nothing.

    Retries: a call is made again after UNAVAILABLE, and after INTERNAL or
    CANCELLED without a reason, if doing it twice is the same as doing it once; and
    after RESOURCE_EXHAUSTED with a RetryInfo. It waits with exponential back-off
    and jitter, no shorter than the server's RetryInfo, and only while the wait ends
    before the deadline. Never repeated otherwise: updates, deletions,
    `accept_data_loss()`, and `revise_poses()` without an expected revision. After
    NOT_OWNER and EPOCH_FENCED, which change nothing, every call is made again as
    often as the deadline allows, and goes to the owner if a proxy routes by it.

    Each call sends an `x-request-id`, which names it in the server's log; errors
    have it as `request_id`.
    """

    def __init__(self, address: str, *, tls_authorities: Optional[PathLike] = None,
                 tls_certificate: Optional[PathLike] = None,
                 tls_key: Optional[PathLike] = None,
                 token_file: Optional[PathLike] = None, deadline: float = 30.0,
                 bulk_deadline: float = 600.0, max_attempts: int = 6,
                 backoff: BackoffOptions = BackoffOptions()) -> None:
        """The first arguments are those of ChannelOptions. `deadline` is the time
        in seconds for a call with all its attempts and waits, `bulk_deadline` that
        of exports and revisions; `max_attempts` counts the first attempt. Connects
        on first use."""
        if max_attempts < 1:
            raise ValueError(f"max_attempts is {max_attempts}: it is at least 1")
        options = ChannelOptions(address, tls_authorities, tls_certificate, tls_key,
                                 token_file)
        self._caller = Caller(token_file)
        self._channels = Channels(options)
        self._deadline = deadline
        self._bulk_deadline = bulk_deadline
        self._max_attempts = max_attempts
        self._backoff = backoff
        self._streams: weakref.WeakSet[PoseStream] = weakref.WeakSet()

    def close(self) -> None:
        """Ends the streams and the connection. Calls that run end with
        Cancelled."""
        for stream in list(self._streams):
            stream.close()
        self._channels.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, kind: Optional[type[BaseException]],
                 error: Optional[BaseException],
                 trace: Optional[TracebackType]) -> None:
        self.close()

    # Any call.

    def call(self, method: str, request: Any, *, deadline: Optional[float] = None,
             request_id: Optional[str] = None) -> Any:
        """Calls a unary method of the service by its name in the proto, with the
        deadline and the retries that all have: `call("GetVehicle",
        v1.GetVehicleRequest(name="vehicles/a"))` returns a
        v1.GetVehicleResponse."""
        return self._repeat(
            lambda stub, call: getattr(stub, method)(request, **call),
            method not in _NEVER_REPEATED,
            self._deadline if deadline is None else deadline, request_id)

    def _repeat(self, attempt: Callable[[Any, dict[str, Any]], _T], is_safe: bool,
                seconds: float, request_id: Optional[str] = None) -> _T:
        """Runs `attempt(stub, what every call is given)` until it succeeds or must
        not be repeated."""
        deadline = time.monotonic() + seconds
        backoff = Backoff(self._backoff)
        count = 1
        error: Optional[Error] = None
        while True:
            request_id, metadata = self._caller.metadata(request_id)
            metadata += owner_route(error)
            left = max(deadline - time.monotonic(), 0.0)
            with self._channels.lease() as lease:
                try:
                    return attempt(stub_of(lease.channel),
                                   {"timeout": left, "metadata": metadata})
                except grpc.RpcError as raised:
                    error = from_rpc_error(raised, request_id)
                self._channels.report(lease, error)
            if was_elsewhere(error):
                # Until the deadline: after a server has died, others say so until its
                # lease has run out.
                count -= 1
                backoff.reset()
            if count >= self._max_attempts or not _may_repeat(error, is_safe):
                raise error
            wait = backoff.next(error.retry_delay)
            if time.monotonic() + wait >= deadline:
                raise error
            time.sleep(wait)
            count += 1

    def _pages(self, method: str, request: Any, field: str, order: str = "name"
               ) -> Iterator[Any]:
        """What is on all pages of a list, which is ordered by that field. Internal if
        it does not go on in that order, as when the server sends a page again, or
        consists of empty pages: it might never end."""
        last = None
        empty_pages = 0
        while True:
            page = self.call(method, request)
            items = getattr(page, field)
            for item in items:
                key = getattr(item, order)
                if last is not None and key <= last:
                    raise Internal(f"the server's list does not go on: {key} comes "
                                   f"after {last}")
                last = key
                yield item
            if not page.next_page_token:
                return
            empty_pages = 0 if items else empty_pages + 1
            if empty_pages > _MOST_EMPTY_PAGES:
                raise Internal(f"the server's list does not go on: {empty_pages} empty "
                               "pages follow each other, and each names another")
            request.page_token = page.next_page_token

    # Vehicles.

    def create_vehicle(self, vehicle_id: str,
                       settings: Optional[v1.VehicleSettings] = None) -> v1.Vehicle:
        """Creates a vehicle, or returns the one of this name with these settings.
        AlreadyExists if there is one with others."""
        request = v1.CreateVehicleRequest(
            vehicle_id=vehicle_id.removeprefix("vehicles/"),
            vehicle=v1.Vehicle(settings=settings))
        made: v1.CreateVehicleResponse = self.call("CreateVehicle", request)
        return made.vehicle

    def get_vehicle(self, vehicle: str) -> v1.Vehicle:
        """The vehicle with its settings and the summary of its graph."""
        found: v1.GetVehicleResponse = self.call(
            "GetVehicle", v1.GetVehicleRequest(name=vehicle_name(vehicle)))
        return found.vehicle

    def list_vehicles(self) -> Iterator[v1.Vehicle]:
        """All vehicles that the caller may read, by name, page by page."""
        return self._pages("ListVehicles", v1.ListVehiclesRequest(page_size=_PAGE),
                           "vehicles")

    def update_vehicle(self, vehicle: str, settings: v1.VehicleSettings,
                       names: Iterable[str]) -> v1.Vehicle:
        """Changes the settings of these names, such as "max_candidates"; one that is
        absent from `settings` goes back to its default."""
        request = v1.UpdateVehicleRequest(
            vehicle=v1.Vehicle(name=vehicle_name(vehicle), settings=settings),
            update_mask=field_mask_pb2.FieldMask(
                paths=[f"settings.{name}" for name in names]))
        changed: v1.UpdateVehicleResponse = self.call("UpdateVehicle", request)
        return changed.vehicle

    def delete_vehicle(self, vehicle: str) -> None:
        """Deletes a vehicle with all it has. It cannot be undone."""
        self.call("DeleteVehicle", v1.DeleteVehicleRequest(name=vehicle_name(vehicle)))

    def accept_data_loss(self, vehicle: str, durable_sequence: int) -> v1.Vehicle:
        """For operators: accepts that poses after this sequence are gone."""
        accepted: v1.AcceptDataLossResponse = self.call(
            "AcceptDataLoss", v1.AcceptDataLossRequest(
                name=vehicle_name(vehicle), durable_sequence=durable_sequence))
        return accepted.vehicle

    # Poses.

    def stream_poses(self, vehicle: str, options: StreamOptions = StreamOptions(),
                     callbacks: StreamCallbacks = StreamCallbacks()) -> PoseStream:
        """Starts a stream of poses that survives the connection."""
        stream = PoseStream(self._channels, self._caller, vehicle_name(vehicle),
                            options, callbacks)
        self._streams.add(stream)
        return stream

    def append_poses(self, vehicle: str, poses: PosesLike, *,
                     vehicle_uid: str = "") -> v1.Ack:
        """Appends one batch with sequences, of at most as many poses as
        `server_info().max_batch_poses`. Returns when it is durable."""
        appended: v1.AppendPosesResponse = self.call(
            "AppendPoses", v1.AppendPosesRequest(
                vehicle=vehicle_name(vehicle), poses=_messages(poses),
                vehicle_uid=vehicle_uid))
        return appended.ack

    def list_poses(self, vehicle: str, first_sequence: int = 1, *,
                   as_sent: bool = False) -> Iterator[v1.Pose]:
        """Stored poses by sequence, as they were last revised or as they were
        sent."""
        request = v1.ListPosesRequest(
            parent=vehicle_name(vehicle), page_size=_POSES_PAGE,
            first_sequence=first_sequence,
            view=(v1.POSE_VIEW_AS_SENT if as_sent else v1.POSE_VIEW_CURRENT))
        return self._pages("ListPoses", request, "poses", order="sequence")

    def poses(self, vehicle: str, first_sequence: int = 1, *,
              as_sent: bool = False) -> Poses:
        """Stored poses as arrays, as they were last revised or as they were sent."""
        return Poses.from_messages(
            self.list_poses(vehicle, first_sequence, as_sent=as_sent))

    def revise_poses(self, vehicle: str, poses: PosesLike,
                     expected_revision: int = 0) -> v1.RevisePosesResponse:
        """Replaces the estimates of poses in one step, after an optimiser ran. With
        the revision that the optimiser started from, Aborted if the vehicle has
        another one by now."""
        revised = list(_messages(poses))

        def requests() -> Iterator[v1.RevisePosesRequest]:
            for start in range(0, max(len(revised), 1), _REVISED_POSES):
                yield v1.RevisePosesRequest(
                    vehicle=vehicle_name(vehicle),
                    expected_revision=expected_revision if start == 0 else 0,
                    poses=revised[start:start + _REVISED_POSES])

        response: v1.RevisePosesResponse = self._repeat(
            lambda stub, call: stub.RevisePoses(requests(), **call),
            expected_revision != 0, self._bulk_deadline)
        return response

    def export_pose_graph(self, vehicle: str) -> PoseGraph:
        """The whole graph at one revision."""
        request = v1.ExportPoseGraphRequest(vehicle=vehicle_name(vehicle))
        parts: list[v1.ExportPoseGraphResponse] = self._repeat(
            lambda stub, call: list(stub.ExportPoseGraph(request, **call)), True,
            self._bulk_deadline)
        return PoseGraph(
            parts[0].vehicle if parts else v1.Vehicle(),
            node_table(node for part in parts for node in part.nodes),
            edge_table(edge for part in parts for edge in part.edges))

    # Candidates, and what a verifier found of them.

    def find_candidates(self, vehicle: str, sequence: int = 0,
                        options: Optional[v1.CandidateOptions] = None
                        ) -> v1.CandidateSet:
        """Where the vehicle has probably been before, asked at a pose; 0 means the
        newest."""
        found: v1.FindCandidatesResponse = self.call(
            "FindCandidates", v1.FindCandidatesRequest(
                vehicle=vehicle_name(vehicle), sequence=sequence, options=options))
        return found.candidates

    def add_loop_closure(self, vehicle: str,
                         pair: Union[v1.Candidate, v1.LoopClosure], *,
                         loop_closure_id: str = "", note: str = ""
                         ) -> v1.AddLoopClosureResponse:
        """Reports that a verifier found two poses to be one place: those of a
        candidate, with a note for people, or a loop closure with all that was found
        out. ValueError for a note beside a loop closure, which has its own."""
        added: v1.AddLoopClosureResponse = self.call(
            "AddLoopClosure", v1.AddLoopClosureRequest(
                parent=vehicle_name(vehicle), loop_closure_id=loop_closure_id,
                loop_closure=_finding(pair, v1.LoopClosure, note)))
        return added

    def list_loop_closures(self, vehicle: str) -> Iterator[v1.LoopClosure]:
        """A vehicle's loop closures, by name."""
        return self._pages("ListLoopClosures", v1.ListLoopClosuresRequest(
            parent=vehicle_name(vehicle), page_size=_PAGE), "loop_closures")

    def delete_loop_closure(self, name: str) -> None:
        """Removes a loop closure, by its resource name, and its edge."""
        self.call("DeleteLoopClosure", v1.DeleteLoopClosureRequest(name=name))

    def reject_candidate(self, vehicle: str,
                         pair: Union[v1.Candidate, v1.RejectedCandidate], *,
                         rejected_candidate_id: str = "", note: str = ""
                         ) -> v1.RejectCandidateResponse:
        """Reports that a verifier found a candidate not to be a revisit: it is not
        offered again. The note is for people, as for `add_loop_closure()`."""
        rejected: v1.RejectCandidateResponse = self.call(
            "RejectCandidate", v1.RejectCandidateRequest(
                parent=vehicle_name(vehicle),
                rejected_candidate_id=rejected_candidate_id,
                rejected_candidate=_finding(pair, v1.RejectedCandidate, note)))
        return rejected

    def list_rejected_candidates(self, vehicle: str
                                 ) -> Iterator[v1.RejectedCandidate]:
        """A vehicle's rejected candidates, by name."""
        return self._pages("ListRejectedCandidates", v1.ListRejectedCandidatesRequest(
            parent=vehicle_name(vehicle), page_size=_PAGE), "rejected_candidates")

    def delete_rejected_candidate(self, name: str) -> None:
        """Removes a rejection, by its resource name: the candidate may be offered
        again."""
        self.call("DeleteRejectedCandidate",
                  v1.DeleteRejectedCandidateRequest(name=name))

    def server_info(self) -> v1.GetServerInfoResponse:
        """Version, limits, and what an acknowledgement is worth."""
        info: v1.GetServerInfoResponse = self.call("GetServerInfo",
                                                   v1.GetServerInfoRequest())
        return info
