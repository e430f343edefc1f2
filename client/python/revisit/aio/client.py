"""Calls of revisit.v1.PoseGraphService, for asyncio."""

from __future__ import annotations

import asyncio
import functools
import weakref
from collections.abc import AsyncIterator, Iterable, Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any, Optional, TypeVar, Union

import grpc
from numpy.typing import ArrayLike

from revisit import _calls, _group_calls, client, maps, v1
from revisit._calls import Call, Pages, Words
from revisit._group_calls import MemberPose
from revisit._names import Vehicles, search_scope, vehicle_name
from revisit._retries import CallOptions
from revisit._stream_state import StreamState, log_warnings
from revisit._watch_state import WatchState
from revisit.aio._channels import AioChannels
from revisit.aio.pose_stream import PoseStream, document
from revisit.aio.watch import CheckList, Watch, WatchEvent
from revisit.arrays import Poses, PosesLike, joined
from revisit.backoff import BackoffOptions
from revisit.channel import Caller, ChannelOptions, PathLike, stub_of
from revisit.cursor_file import CursorFile
from revisit.errors import Cancelled, InvalidArgument, from_rpc_error
from revisit.stream_options import ProgressBar, StreamCallbacks, StreamOptions
from revisit.tables import PoseGraph

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from revisit.v1.keywords import (
        CandidateKeywords, GroupKeywords, SettingsKeywords)

_T = TypeVar("_T")


def _is_being_cancelled() -> bool:
    """Whether it is the caller's task that was cancelled. Pythons before 3.11 do not
    tell."""
    cancelling = getattr(asyncio.current_task(), "cancelling", None)
    return cancelling is not None and cancelling() > 0


class Client:
    """One server, for one event loop: a `revisit.Client` whose methods are awaited,
    and whose lists are iterated with `async for`. Any number of tasks may call at the
    same time.

        async with revisit.aio.Client("127.0.0.1:50051") as client:
            await client.create_vehicle("shuttle-7")
    """

    def __init__(self, address: str, *, tls_authorities: Optional[PathLike] = None,
                 tls_certificate: Optional[PathLike] = None,
                 tls_key: Optional[PathLike] = None,
                 token_file: Optional[PathLike] = None, deadline: float = 30.0,
                 bulk_deadline: float = 600.0, max_attempts: int = 6,
                 backoff: BackoffOptions = BackoffOptions()) -> None:
        """The arguments are those of `revisit.Client`."""
        self._options = CallOptions(deadline, bulk_deadline, max_attempts, backoff)
        self._caller = Caller(token_file)
        self._channels = AioChannels(ChannelOptions(
            address, tls_authorities, tls_certificate, tls_key, token_file))
        self._closed = False
        self._streams: weakref.WeakSet[PoseStream] = weakref.WeakSet()
        self._watches: weakref.WeakSet[Watch] = weakref.WeakSet()

    async def close(self) -> None:
        self._closed = True
        for stream in list(self._streams):
            await stream.close()
        await self._channels.aclose()
        for watch in list(self._watches):
            await watch.close()

    async def __aenter__(self) -> Client:
        return self

    async def __aexit__(self, kind: Optional[type[BaseException]],
                        error: Optional[BaseException],
                        trace: Optional[TracebackType]) -> None:
        await self.close()

    # Any call.

    async def call(self, method: str, request: Any, *,
                   deadline: Optional[float] = None,
                   request_id: Optional[str] = None) -> Any:
        return await self._run(_calls.named(method, request), deadline, request_id)

    async def _run(self, call: Call[_T], deadline: Optional[float] = None,
                   request_id: Optional[str] = None) -> _T:
        """Makes a call until it succeeds or must not be repeated."""
        attempts = self._options.attempts(self._caller, call, deadline, request_id)
        while True:
            arguments = attempts.begin()
            with self._channels.lease() as lease:
                try:
                    handle = call.start(stub_of(lease.channel), arguments)
                    return call.unpack([part async for part in handle]
                                       if call.answers_stream else await handle)
                except grpc.RpcError as raised:
                    error = from_rpc_error(raised, attempts.request_id or "")
                except asyncio.CancelledError:
                    if self._closed and not _is_being_cancelled():
                        raise Cancelled("the client is closed") from None
                    raise
                self._channels.report(lease, error)
            error = await self._channels.explain(error)
            await asyncio.sleep(attempts.wait_after(error))

    async def _pages(self, pages: Pages[_T]) -> AsyncIterator[_T]:
        while True:
            page = await self._run(pages.call())
            for item in pages.items(page):
                yield item
            if not pages.turn(page):
                return

    # Vehicles.

    async def create_vehicle(self, vehicle_id: str,
                             settings: Optional[v1.VehicleSettings] = None, *,
                             display_name: str = "",
                             labels: Optional[Mapping[str, str]] = None,
                             **keywords: Unpack[SettingsKeywords]) -> v1.Vehicle:
        return await self._run(_calls.create_vehicle(
            vehicle_id, settings, display_name, labels, keywords))

    async def get_vehicle(self, vehicle: str) -> v1.Vehicle:
        return await self._run(_calls.get_vehicle(vehicle))

    def list_vehicles(self) -> AsyncIterator[v1.Vehicle]:
        return self._pages(_calls.list_vehicles())

    async def update_vehicle(self, vehicle: str,
                             settings: Optional[v1.VehicleSettings] = None,
                             names: Iterable[str] = (), *,
                             display_name: Optional[str] = None,
                             labels: Optional[Mapping[str, Optional[str]]] = None,
                             **keywords: Unpack[SettingsKeywords]) -> v1.Vehicle:
        return await self._run(_calls.update_vehicle(
            vehicle, settings, names, display_name, labels, keywords))

    async def delete_vehicle(self, vehicle: str) -> None:
        await self._run(_calls.delete_vehicle(vehicle))

    async def accept_data_loss(self, vehicle: str, durable_sequence: int) -> v1.Vehicle:
        return await self._run(_calls.accept_data_loss(vehicle, durable_sequence))

    # Poses.

    def stream_poses(self, vehicle: str, options: StreamOptions = StreamOptions(),
                     callbacks: StreamCallbacks = StreamCallbacks()) -> PoseStream:
        """Starts a stream of poses that survives the connection, in the event loop
        that runs."""
        stream = PoseStream(self._channels, self._caller, StreamState(
            vehicle_name(vehicle), options, callbacks))
        self._streams.add(stream)
        return stream

    async def append_poses(self, vehicle: str, poses: PosesLike, *,
                           vehicle_uid: str = "") -> v1.Ack:
        appending = _calls.Appending(vehicle, poses, vehicle_uid)
        while True:
            try:
                ack = await self._run(appending.call())
            except InvalidArgument as error:
                appending.after(error)
            else:
                log_warnings(vehicle_name(vehicle), ack, set())
                return ack

    def list_poses(self, vehicle: str, first_sequence: int = 1, *,
                   as_sent: bool = False) -> AsyncIterator[v1.Pose]:
        return self._pages(_calls.list_poses(vehicle, first_sequence, as_sent))

    async def poses(self, vehicle: str, first_sequence: int = 1, *,
                    as_sent: bool = False,
                    progress: Optional[ProgressBar] = None) -> Poses:
        parts = []
        async for part in self._pages(
                _calls.list_arrays(vehicle, first_sequence, as_sent)):
            parts.append(part)
            if progress is not None:
                progress.update(len(part))
        return joined(parts)

    def list_recordings(self, vehicle: str) -> AsyncIterator[v1.Recording]:
        return self._pages(_calls.list_recordings(vehicle))

    async def revise_poses(self, vehicle: str, poses: PosesLike,
                           expected_revision: int = 0, *,
                           common_frame: bool = False) -> v1.RevisePosesResponse:
        answer = await self._run(_calls.revise_poses(
            vehicle, poses, expected_revision, common_frame))
        log_warnings(vehicle_name(vehicle), answer, set())
        return answer

    async def export_pose_graph(self, vehicle: str, *,
                                as_sent: bool = False) -> PoseGraph:
        return await self._run(_calls.export_pose_graph(vehicle, as_sent))

    # Files and maps, by the program revisit.

    async def export(self, vehicle: str, path: PathLike, *, format: str = "") -> None:
        await asyncio.to_thread(maps.export, self._channels.options, vehicle, path,
                                format)

    async def map(self, vehicle: str, *, format: str = "html",
                  **flags: Any) -> maps.Map:
        return await asyncio.to_thread(maps.draw, self._channels.options, vehicle,
                                       format, flags)

    # Candidates, and what a verifier found of them.

    async def find_candidates(self, vehicle: str, sequence: int = 0,
                              options: Optional[v1.CandidateOptions] = None, *,
                              group: str = "", vehicles: Vehicles = None,
                              exclude_own: bool = False, allow_partial: bool = False,
                              **keywords: Unpack[CandidateKeywords]
                              ) -> v1.CandidateSet:
        return await self._run(_calls.find_candidates(
            vehicle, sequence, options,
            search_scope(group, vehicles, exclude_own, allow_partial), keywords))

    async def add_loop_closure(self, vehicle: str,
                               query: Union[int, v1.Candidate, v1.LoopClosure],
                               matched: Optional[int] = None, *,
                               relative: Optional[ArrayLike] = None,
                               covariance: Optional[ArrayLike] = None,
                               score: Optional[float] = None, note: str = "",
                               loop_closure_id: str = "", candidate: str = ""
                               ) -> v1.AddLoopClosureResponse:
        return await self._run(_calls.add_loop_closure(
            vehicle, query, matched, relative, covariance, score, note,
            loop_closure_id, candidate))

    def list_loop_closures(self, vehicle: str) -> AsyncIterator[v1.LoopClosure]:
        return self._pages(_calls.list_loop_closures(vehicle))

    async def delete_loop_closure(self, name: str) -> None:
        await self._run(_calls.delete_loop_closure(name))

    async def find_contradictions(self, vehicle: str) -> list[v1.Contradiction]:
        return await self._run(_calls.find_contradictions(vehicle))

    async def reject_candidate(self, vehicle: str,
                               query: Union[int, v1.Candidate, v1.RejectedCandidate],
                               matched: Optional[int] = None, *, note: str = "",
                               rejected_candidate_id: str = "", candidate: str = ""
                               ) -> v1.RejectCandidateResponse:
        return await self._run(_calls.reject_candidate(
            vehicle, query, matched, note, rejected_candidate_id, candidate))

    def list_rejected_candidates(self, vehicle: str
                                 ) -> AsyncIterator[v1.RejectedCandidate]:
        return self._pages(_calls.list_rejected_candidates(vehicle))

    async def delete_rejected_candidate(self, name: str) -> None:
        await self._run(_calls.delete_rejected_candidate(name))

    def list_deleted_pose_pairs(self, vehicle: str
                                ) -> AsyncIterator[v1.DeletedPosePair]:
        return self._pages(_calls.list_deleted_pose_pairs(vehicle))

    # Groups of vehicles.

    async def create_group(self, group_id: str,
                           settings: Optional[v1.GroupSettings] = None, *,
                           display_name: str = "",
                           **keywords: Unpack[GroupKeywords]) -> v1.Group:
        return await self._run(_group_calls.create_group(
            group_id, settings, display_name, keywords))

    async def get_group(self, group: str) -> v1.Group:
        return await self._run(_group_calls.get_group(group))

    def list_groups(self) -> AsyncIterator[v1.Group]:
        return self._pages(_group_calls.list_groups())

    async def update_group(self, group: str,
                           settings: Optional[v1.GroupSettings] = None,
                           names: Iterable[str] = (), *,
                           display_name: Optional[str] = None,
                           expected_revision: int = 0,
                           **keywords: Unpack[GroupKeywords]) -> v1.Group:
        return await self._run(_group_calls.update_group(
            group, settings, names, display_name, expected_revision, keywords))

    async def delete_group(self, group: str, *, expected_revision: int = 0) -> None:
        await self._run(_group_calls.delete_group(group, expected_revision))

    async def add_group_member(self, group: str, vehicle: str,
                               datum: Optional[v1.Datum] = None
                               ) -> v1.AddGroupMemberResponse:
        return await self._run(_group_calls.add_group_member(group, vehicle, datum))

    async def update_group_member(self, group: str, vehicle: str,
                                  datum: Optional[v1.Datum], *,
                                  expected_revision: int = 0
                                  ) -> v1.UpdateGroupMemberResponse:
        return await self._run(_group_calls.update_group_member(
            group, vehicle, datum, expected_revision))

    async def remove_group_member(self, group: str, vehicle: str) -> None:
        await self._run(_group_calls.remove_group_member(group, vehicle))

    def list_group_members(self, group: str) -> AsyncIterator[v1.GroupMember]:
        return self._pages(_group_calls.list_group_members(group))

    async def add_inter_vehicle_loop_closure(
            self, group: str, query: Union[MemberPose, str],
            matched: Union[MemberPose, v1.Candidate], *,
            relative: Optional[ArrayLike] = None,
            covariance: Optional[ArrayLike] = None, score: Optional[float] = None,
            note: str = "", loop_closure_id: str = ""
            ) -> v1.AddInterVehicleLoopClosureResponse:
        return await self._run(_group_calls.add_inter_vehicle_loop_closure(
            group, query, matched, relative, covariance, score, note, loop_closure_id))

    def list_inter_vehicle_loop_closures(
            self, group: str) -> AsyncIterator[v1.InterVehicleLoopClosure]:
        return self._pages(_group_calls.list_inter_vehicle_loop_closures(group))

    async def delete_inter_vehicle_loop_closure(self, name: str) -> None:
        await self._run(_group_calls.delete_inter_vehicle_loop_closure(name))

    async def reject_inter_vehicle_candidate(
            self, group: str, query: Union[MemberPose, str],
            matched: Union[MemberPose, v1.Candidate], *, note: str = "",
            rejected_candidate_id: str = ""
            ) -> v1.RejectInterVehicleCandidateResponse:
        return await self._run(_group_calls.reject_inter_vehicle_candidate(
            group, query, matched, note, rejected_candidate_id))

    def list_inter_vehicle_rejected_candidates(
            self, group: str) -> AsyncIterator[v1.InterVehicleRejectedCandidate]:
        return self._pages(_group_calls.list_inter_vehicle_rejected_candidates(group))

    async def delete_inter_vehicle_rejected_candidate(self, name: str) -> None:
        await self._run(_group_calls.delete_inter_vehicle_rejected_candidate(name))

    def list_frame_transforms(self, group: str, vehicle: str, *,
                              vehicles: Vehicles = None, allow_partial: bool = False
                              ) -> AsyncIterator[v1.FrameTransform]:
        return self._pages(_group_calls.list_frame_transforms(
            group, vehicle, vehicles, allow_partial))

    # Checks that are stored, of vehicles whose setting `checks` asks for it.

    async def get_check(self, name: str) -> v1.Check:
        return await self._run(_calls.get_check(name))

    def list_checks(self, vehicle: str = "-", *, states: Words = None,
                    verdicts: Words = None, least_probability: Optional[float] = None,
                    least_value: Optional[float] = None,
                    order: Union[str, int, None] = None, fresh_only: bool = False,
                    looks_per_kilometer: int = 0) -> CheckList:
        wanted = _calls.candidate_filter(None, states, verdicts, least_probability,
                                         least_value)
        return CheckList(self, _calls.CheckPages(vehicle, wanted, order, fresh_only,
                                                 looks_per_kilometer))

    def watch(self, vehicles: Vehicles = None, *, cursor: Optional[str] = None,
              cursor_file: Union[CursorFile, PathLike, None] = None,
              states: Words = None, verdicts: Words = None,
              least_probability: Optional[float] = None,
              least_value: Optional[float] = None,
              from_start: bool = False) -> Watch:
        watch = Watch(self, self._channels, self._caller, WatchState(
            _calls.candidate_filter(vehicles, states, verdicts, least_probability,
                                    least_value),
            cursor=cursor, cursor_file=cursor_file, from_start=from_start,
            backoff=self._options.backoff,
            make=functools.partial(WatchEvent, client=self)))
        self._watches.add(watch)
        return watch

    async def server_info(self) -> v1.GetServerInfoResponse:
        return await self._run(_calls.server_info())


document(Client, client.Client)
