"""Calls of revisit.v1.PoseGraphService, with deadlines and retries."""

from __future__ import annotations

import functools
import time
import weakref
from collections.abc import Iterable, Iterator, Mapping
from types import TracebackType
from typing import TYPE_CHECKING, Any, Optional, TypeVar, Union

import grpc
from numpy.typing import ArrayLike

from revisit import _calls, _group_calls, maps, v1
from revisit._calls import Call, Pages, Words
from revisit._group_calls import MemberPose
from revisit._names import Vehicles, search_scope, vehicle_name
from revisit._retries import CallOptions
from revisit._stream_state import StreamState, log_warnings
from revisit._watch_state import WatchState
from revisit.arrays import Poses, PosesLike, joined
from revisit.backoff import BackoffOptions
from revisit.channel import Caller, ChannelOptions, Channels, PathLike, stub_of
from revisit.cursor_file import CursorFile
from revisit.errors import InvalidArgument, from_rpc_error
from revisit.pose_stream import PoseStream
from revisit.stream_options import ProgressBar, StreamCallbacks, StreamOptions
from revisit.tables import PoseGraph
from revisit.watch import CheckList, Watch, WatchEvent

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from revisit.v1.keywords import (
        CandidateKeywords, GroupKeywords, SettingsKeywords)

_T = TypeVar("_T")


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
    often as the deadline allows, and goes to the owner if a proxy routes by it; so is a
    search after GROUP_NOT_READY, while the server reads histories. A change of a group
    without an expected revision is made again too where it lost to those of others
    (REVISION_MISMATCH), which changes nothing.

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
        self._options = CallOptions(deadline, bulk_deadline, max_attempts, backoff)
        self._caller = Caller(token_file)
        self._channels = Channels(ChannelOptions(
            address, tls_authorities, tls_certificate, tls_key, token_file))
        self._streams: weakref.WeakSet[PoseStream] = weakref.WeakSet()
        self._watches: weakref.WeakSet[Watch] = weakref.WeakSet()

    def close(self) -> None:
        """Ends the streams and the connection. Calls that run and loops over watches
        end with Cancelled."""
        for stream in list(self._streams):
            stream.close()
        self._channels.close()
        for watch in list(self._watches):
            watch.close()

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
        return self._run(_calls.named(method, request), deadline, request_id)

    def _run(self, call: Call[_T], deadline: Optional[float] = None,
             request_id: Optional[str] = None) -> _T:
        """Makes a call until it succeeds or must not be repeated."""
        attempts = self._options.attempts(self._caller, call, deadline, request_id)
        while True:
            arguments = attempts.begin()
            with self._channels.lease() as lease:
                try:
                    answer = call.start(stub_of(lease.channel), arguments)
                    return call.unpack(list(answer) if call.answers_stream else answer)
                except grpc.RpcError as raised:
                    error = from_rpc_error(raised, attempts.request_id or "")
                self._channels.report(lease, error)
            error = self._channels.explained(error)
            time.sleep(attempts.wait_after(error))

    def _pages(self, pages: Pages[_T]) -> Iterator[_T]:
        """The items of all pages of a list."""
        while True:
            page = self._run(pages.call())
            yield from pages.items(page)
            if not pages.turn(page):
                return

    # Vehicles.

    def create_vehicle(self, vehicle_id: str,
                       settings: Optional[v1.VehicleSettings] = None, *,
                       display_name: str = "",
                       labels: Optional[Mapping[str, str]] = None,
                       **keywords: Unpack[SettingsKeywords]) -> v1.Vehicle:
        """Creates a vehicle, or returns the one of this name with these settings.
        AlreadyExists if there is one with others.

            client.create_vehicle("shuttle-7", correlation_model="independent",
                                  labels={"depot": "north"})

        `keywords` are the fields of v1.VehicleSettings and count before `settings`;
        words of the command line stand for the values of enums. TypeError for a name
        that is no setting."""
        return self._run(_calls.create_vehicle(vehicle_id, settings, display_name,
                                               labels, keywords))

    def get_vehicle(self, vehicle: str) -> v1.Vehicle:
        """The vehicle with its settings and the summary of its graph."""
        return self._run(_calls.get_vehicle(vehicle))

    def list_vehicles(self) -> Iterator[v1.Vehicle]:
        """All vehicles that the caller may read, by name, page by page."""
        return self._pages(_calls.list_vehicles())

    def update_vehicle(self, vehicle: str,
                       settings: Optional[v1.VehicleSettings] = None,
                       names: Iterable[str] = (), *,
                       display_name: Optional[str] = None,
                       labels: Optional[Mapping[str, Optional[str]]] = None,
                       **keywords: Unpack[SettingsKeywords]) -> v1.Vehicle:
        """Changes the settings that are keywords, and those of `settings` that
        `names` has, such as "max_candidates"; one that is None, or absent from
        `settings`, goes back to its default. Changes the labels that are named, or
        removes them with None, and leaves the others."""
        return self._run(_calls.update_vehicle(vehicle, settings, names, display_name,
                                               labels, keywords))

    def delete_vehicle(self, vehicle: str) -> None:
        """Deletes a vehicle with all it has. It cannot be undone."""
        self._run(_calls.delete_vehicle(vehicle))

    def accept_data_loss(self, vehicle: str, durable_sequence: int) -> v1.Vehicle:
        """For operators: accepts that poses after this sequence are gone."""
        return self._run(_calls.accept_data_loss(vehicle, durable_sequence))

    # Poses.

    def stream_poses(self, vehicle: str, options: StreamOptions = StreamOptions(),
                     callbacks: StreamCallbacks = StreamCallbacks()) -> PoseStream:
        """Starts a stream of poses that survives the connection."""
        stream = PoseStream(self._channels, self._caller, StreamState(
            vehicle_name(vehicle), options, callbacks))
        self._streams.add(stream)
        return stream

    def append_poses(self, vehicle: str, poses: PosesLike, *,
                     vehicle_uid: str = "") -> v1.Ack:
        """Appends one batch with sequences, of at most as many poses as
        `server_info().max_batch_poses`. Returns when it is durable; the warnings of
        the acknowledgement are logged too."""
        appending = _calls.Appending(vehicle, poses, vehicle_uid)
        while True:
            try:
                ack = self._run(appending.call())
            except InvalidArgument as error:
                appending.after(error)
            else:
                log_warnings(vehicle_name(vehicle), ack, set())
                return ack

    def list_poses(self, vehicle: str, first_sequence: int = 1, *,
                   as_sent: bool = False) -> Iterator[v1.Pose]:
        """Stored poses by sequence, as they were last revised or as they were
        sent."""
        return self._pages(_calls.list_poses(vehicle, first_sequence, as_sent))

    def poses(self, vehicle: str, first_sequence: int = 1, *,
              as_sent: bool = False,
              progress: Optional[ProgressBar] = None) -> Poses:
        """Stored poses as arrays, as they were last revised or as they were sent.
        `progress` is told of each that was read."""
        parts = []
        for part in self._pages(_calls.list_arrays(vehicle, first_sequence, as_sent)):
            parts.append(part)
            if progress is not None:
                progress.update(len(part))
        return joined(parts)

    def list_recordings(self, vehicle: str) -> Iterator[v1.Recording]:
        """A vehicle's recordings, the oldest first, with where the frame of each lies
        in that of the last one; `recording_table()` makes columns of them."""
        return self._pages(_calls.list_recordings(vehicle))

    def revise_poses(self, vehicle: str, poses: PosesLike,
                     expected_revision: int = 0, *,
                     common_frame: bool = False) -> v1.RevisePosesResponse:
        """Replaces the estimates of poses in one step, after an optimiser ran. With
        the revision that the optimiser started from, Aborted if the vehicle has
        another one by now. Poses stay in the frames of their recordings or, with
        `common_frame`, all of the vehicle's are in one from now on, as a single
        recording. The warnings of the answer are logged too."""
        answer = self._run(_calls.revise_poses(vehicle, poses, expected_revision,
                                               common_frame))
        log_warnings(vehicle_name(vehicle), answer, set())
        return answer

    def export_pose_graph(self, vehicle: str, *, as_sent: bool = False) -> PoseGraph:
        """The whole graph at one revision, of poses as they were last revised or as
        they were sent. The nodes of the two are others, by index and by number."""
        return self._run(_calls.export_pose_graph(vehicle, as_sent))

    # Files and maps, by the program revisit.

    def export(self, vehicle: str, path: PathLike, *, format: str = "") -> None:
        """Writes a vehicle's poses or graph to a file, by `revisit export`: g2o, tum,
        kitti, csv, geojson or jsonl, by the ending of its name unless `format` says
        which (also nodes-csv, edges-csv). Numbers read back to the same bits. A file
        of this name is replaced once the export is complete."""
        maps.export(self._channels.options, vehicle, path, format)

    def map(self, vehicle: str, *, format: str = "html", **flags: Any) -> maps.Map:
        """Draws a vehicle's trajectory with its candidates, by `revisit map`, for a
        notebook or a file: as a page that moves and zooms ("html"), a drawing ("svg")
        or "geojson". `flags` are the program's, such as `direction="either"` and
        `check_interval=200`. It asks for candidates along the whole path, which may
        take minutes."""
        return maps.draw(self._channels.options, vehicle, format, flags)

    # Candidates, and what a verifier found of them.

    def find_candidates(self, vehicle: str, sequence: int = 0,
                        options: Optional[v1.CandidateOptions] = None, *,
                        group: str = "", vehicles: Vehicles = None,
                        exclude_own: bool = False, allow_partial: bool = False,
                        **keywords: Unpack[CandidateKeywords]) -> v1.CandidateSet:
        """Where the vehicle has probably been before, asked at a pose; 0 means the
        newest. `keywords` are the fields of v1.CandidateOptions, such as
        `direction="either"`, and count before `options`.

        With a `group`, the search looks in the histories of its members too, or of
        those that `vehicles` names, and with `exclude_own` not in that of the vehicle
        itself. A candidate's `matched_vehicle` is then the other vehicle. The server
        may have to read the histories first: the call waits for that until its
        deadline, then raises Unavailable (GROUP_NOT_READY). With `allow_partial` it
        answers with those that are at hand; `unsearched` names the others."""
        return self._run(_calls.find_candidates(
            vehicle, sequence, options,
            search_scope(group, vehicles, exclude_own, allow_partial), keywords))

    def add_loop_closure(self, vehicle: str,
                         query: Union[int, v1.Candidate, v1.LoopClosure],
                         matched: Optional[int] = None, *,
                         relative: Optional[ArrayLike] = None,
                         covariance: Optional[ArrayLike] = None,
                         score: Optional[float] = None, note: str = "",
                         loop_closure_id: str = "", candidate: str = ""
                         ) -> v1.AddLoopClosureResponse:
        """Reports that a verifier found two poses to be one place: those of a
        candidate, or those of two sequences, the later one first.

            client.add_loop_closure("shuttle-7", 2068, 1072,
                                    relative=(1.2, -0.3, 0.02),
                                    covariance=np.diag([0.01, 0.01, 1e-4]))

        `relative` is the pose of the query as seen from the match: x forward, y left,
        heading, or x, y, z, heading; or a matrix that maps the query's body into the
        match's, (3, 3) or (4, 4), as registrations answer. `covariance` is that of
        its errors, as `to_covariances()` takes it for one pose. Without them nothing
        more is assumed than one place, some 10 m wide. The answer's `agreement` says
        how well they fit the graph.

        A v1.LoopClosure is taken as it is; ValueError for a note beside it, since it
        has its own.

        `candidate` is the name of the stored candidate that this answers
        (v1.CheckCandidate.name), which becomes CONFIRMED. So do, without a name, all
        whose two places are within 10 m of these."""
        return self._run(_calls.add_loop_closure(
            vehicle, query, matched, relative, covariance, score, note,
            loop_closure_id, candidate))

    def list_loop_closures(self, vehicle: str) -> Iterator[v1.LoopClosure]:
        """A vehicle's loop closures, by name."""
        return self._pages(_calls.list_loop_closures(vehicle))

    def delete_loop_closure(self, name: str) -> None:
        """Removes a loop closure, by its resource name, and its edge."""
        self._run(_calls.delete_loop_closure(name))

    def find_contradictions(self, vehicle: str) -> list[v1.Contradiction]:
        """The loop closures of a vehicle that contradict others which agree with each
        other, the least probable first: most likely the verifier was wrong. Nothing is
        changed."""
        return self._run(_calls.find_contradictions(vehicle))

    def reject_candidate(self, vehicle: str,
                         query: Union[int, v1.Candidate, v1.RejectedCandidate],
                         matched: Optional[int] = None, *, note: str = "",
                         rejected_candidate_id: str = "", candidate: str = ""
                         ) -> v1.RejectCandidateResponse:
        """Reports that a verifier found a candidate, or the poses of two sequences,
        not to be a revisit: it is not offered again. The note is for people, as for
        `add_loop_closure()`; `candidate` is the stored one, which becomes REJECTED."""
        return self._run(_calls.reject_candidate(vehicle, query, matched, note,
                                                 rejected_candidate_id, candidate))

    def list_rejected_candidates(self, vehicle: str
                                 ) -> Iterator[v1.RejectedCandidate]:
        """A vehicle's rejected candidates, by name."""
        return self._pages(_calls.list_rejected_candidates(vehicle))

    def delete_rejected_candidate(self, name: str) -> None:
        """Removes a rejection, by its resource name: the candidate may be offered
        again."""
        self._run(_calls.delete_rejected_candidate(name))

    def list_deleted_pose_pairs(self, vehicle: str) -> Iterator[v1.DeletedPosePair]:
        """A vehicle's last 1000 loop closures and rejections that were deleted, the
        last one first: what was decided, and who undid it when."""
        return self._pages(_calls.list_deleted_pose_pairs(vehicle))

    # Groups of vehicles.

    def create_group(self, group_id: str,
                     settings: Optional[v1.GroupSettings] = None, *,
                     display_name: str = "",
                     **keywords: Unpack[GroupKeywords]) -> v1.Group:
        """Creates a group of vehicles whose histories are searched together, without
        members, or returns the one of this name with these settings. AlreadyExists if
        there is one with others. `keywords` are the fields of v1.GroupSettings.

            client.create_group("depot", fix_bias_meters=3.0)
            client.add_group_member("depot", "shuttle-7")
            client.find_candidates("shuttle-8", group="depot")"""
        return self._run(_group_calls.create_group(group_id, settings, display_name,
                                                   keywords))

    def get_group(self, group: str) -> v1.Group:
        """The group with its settings, by id or resource name."""
        return self._run(_group_calls.get_group(group))

    def list_groups(self) -> Iterator[v1.Group]:
        """All groups that the caller may read, by name, page by page."""
        return self._pages(_group_calls.list_groups())

    def update_group(self, group: str, settings: Optional[v1.GroupSettings] = None,
                     names: Iterable[str] = (), *, display_name: Optional[str] = None,
                     expected_revision: int = 0,
                     **keywords: Unpack[GroupKeywords]) -> v1.Group:
        """Changes the settings that are keywords, and those of `settings` that `names`
        has; one that is None, or absent from `settings`, goes back to its default.
        With a revision, Aborted if the group has another one by now."""
        return self._run(_group_calls.update_group(
            group, settings, names, display_name, expected_revision, keywords))

    def delete_group(self, group: str, *, expected_revision: int = 0) -> None:
        """Deletes a group with the loop closures between its members, which stay. It
        cannot be undone."""
        self._run(_group_calls.delete_group(group, expected_revision))

    def add_group_member(self, group: str, vehicle: str,
                         datum: Optional[v1.Datum] = None
                         ) -> v1.AddGroupMemberResponse:
        """Adds a vehicle to a group, with where its frame lies in that of the group
        (`revisit.datum()`), if it is known and the vehicle has no fixes. Again with the
        same datum: the existing member. AlreadyExists if it has another one."""
        return self._run(_group_calls.add_group_member(group, vehicle, datum))

    def update_group_member(self, group: str, vehicle: str, datum: Optional[v1.Datum],
                            *, expected_revision: int = 0
                            ) -> v1.UpdateGroupMemberResponse:
        """Replaces the datum of a member, or removes it with None."""
        return self._run(_group_calls.update_group_member(group, vehicle, datum,
                                                          expected_revision))

    def remove_group_member(self, group: str, vehicle: str) -> None:
        """Removes a vehicle from a group, with its loop closures to the others."""
        self._run(_group_calls.remove_group_member(group, vehicle))

    def list_group_members(self, group: str) -> Iterator[v1.GroupMember]:
        """The members of a group that the caller may read, by vehicle."""
        return self._pages(_group_calls.list_group_members(group))

    def add_inter_vehicle_loop_closure(
            self, group: str, query: Union[MemberPose, str],
            matched: Union[MemberPose, v1.Candidate], *,
            relative: Optional[ArrayLike] = None,
            covariance: Optional[ArrayLike] = None, score: Optional[float] = None,
            note: str = "", loop_closure_id: str = ""
            ) -> v1.AddInterVehicleLoopClosureResponse:
        """Reports that a verifier found two poses of two members to be one place: two
        pairs of a vehicle and a sequence, or the vehicle that asked and a candidate in
        another one.

            client.add_inter_vehicle_loop_closure("depot", "shuttle-8", candidate)
            client.add_inter_vehicle_loop_closure(
                "depot", ("shuttle-8", 310), ("shuttle-7", 1072),
                relative=(1.2, -0.3, 0.02), covariance=np.diag([0.01, 0.01, 1e-4]))

        It ties the frames of the two recordings. The rest is as for
        `add_loop_closure()`."""
        return self._run(_group_calls.add_inter_vehicle_loop_closure(
            group, query, matched, relative, covariance, score, note, loop_closure_id))

    def list_inter_vehicle_loop_closures(
            self, group: str) -> Iterator[v1.InterVehicleLoopClosure]:
        """The loop closures of a group of which the caller may read both vehicles, by
        name."""
        return self._pages(_group_calls.list_inter_vehicle_loop_closures(group))

    def delete_inter_vehicle_loop_closure(self, name: str) -> None:
        """Removes a loop closure from its group, by its resource name."""
        self._run(_group_calls.delete_inter_vehicle_loop_closure(name))

    def reject_inter_vehicle_candidate(
            self, group: str, query: Union[MemberPose, str],
            matched: Union[MemberPose, v1.Candidate], *, note: str = "",
            rejected_candidate_id: str = ""
            ) -> v1.RejectInterVehicleCandidateResponse:
        """Reports that a verifier found two poses of two members not to be one place,
        named as for `add_inter_vehicle_loop_closure()`: searches in the group do not
        offer the candidate again."""
        return self._run(_group_calls.reject_inter_vehicle_candidate(
            group, query, matched, note, rejected_candidate_id))

    def list_inter_vehicle_rejected_candidates(
            self, group: str) -> Iterator[v1.InterVehicleRejectedCandidate]:
        """The rejected candidates of a group of which the caller may read both
        vehicles, by name."""
        return self._pages(_group_calls.list_inter_vehicle_rejected_candidates(group))

    def delete_inter_vehicle_rejected_candidate(self, name: str) -> None:
        """Removes a rejected candidate from its group, by its resource name."""
        self._run(_group_calls.delete_inter_vehicle_rejected_candidate(name))

    def list_frame_transforms(self, group: str, vehicle: str, *,
                              vehicles: Vehicles = None, allow_partial: bool = False
                              ) -> Iterator[v1.FrameTransform]:
        """Where the recordings of a group's members, or of those that `vehicles` names,
        lie in the frame of the last recording of `vehicle`, with the errors: by these
        the members can be drawn in one map. Waits for the histories, as
        `find_candidates()` in a group does, unless `allow_partial`. Aborted if the
        group changes from page to page."""
        return self._pages(_group_calls.list_frame_transforms(
            group, vehicle, vehicles, allow_partial))

    # Checks that are stored, of vehicles whose setting `checks` asks for it.

    def get_check(self, name: str) -> v1.Check:
        """A stored check with what became of its candidates, by its resource name.
        NotFound where none was made, where it found nothing worth keeping, and once it
        is kept no longer."""
        return self._run(_calls.get_check(name))

    def list_checks(self, vehicle: str = "-", *, states: Words = None,
                    verdicts: Words = None, least_probability: Optional[float] = None,
                    least_value: Optional[float] = None,
                    order: Union[str, int, None] = None, fresh_only: bool = False,
                    looks_per_kilometer: int = 0) -> CheckList:
        """Stored checks of a vehicle by sequence, or of all vehicles that the caller
        may read, that have a candidate of one of these states and verdicts, at least so
        probable, of which a look is worth at least so much
        (v1.CheckCandidate.value_square_meters). Each has all of its candidates:
        `evidence_of(check, state)` is what the last search found of one.

            open_ones = client.list_checks("shuttle-7", states="open", order="value")

        The order is by "time" or, of one vehicle, by "value": the most valuable open
        candidate first. Then `looks_per_kilometer` marks the most valuable of each
        kilometre as `recommended`. A check that moves while the list is read comes
        once. `fresh_only` leaves out those that wait to be searched again.

        The list's `watch_cursor()` is where `watch()` goes on."""
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
        """Every change of a stored candidate, without end: of these vehicles, at most
        100, or of all that the caller may read; those of a vehicle in their order.

            for event in client.watch(cursor_file="verifier.cursor", states="open"):
                if event.candidate is not None:
                    print(event.candidate.name, event.evidence.probability)

        Goes on behind a cursor that was kept, `event.cursor` or `watch.cursor`, or
        behind that of a file, which is kept there once an event was worked off: when
        the loop asks for the next one. So an event on which the program dies comes
        again. An event that the server repeats is left out. Without a cursor the watch
        begins now or, with `from_start`, with all candidates that are stored.

        Where the connection is lost, and where the loop took so long that the server
        gave up (SLOW_CONSUMER), it is made again with the client's back-off, however
        often. Where the cursor cannot be served (CURSOR_TOO_OLD, CURSOR_UNKNOWN), all
        stored candidates come as events that are `resynchronised`, then what changes
        from then on. Deletions of vehicles come whatever the states, verdicts,
        probability and value are. Connects once it is iterated; the first connection is
        tried for ever too."""
        watch = Watch(self, self._channels, self._caller, WatchState(
            _calls.candidate_filter(vehicles, states, verdicts, least_probability,
                                    least_value),
            cursor=cursor, cursor_file=cursor_file, from_start=from_start,
            backoff=self._options.backoff,
            make=functools.partial(WatchEvent, client=self)))
        self._watches.add(watch)
        return watch

    def server_info(self) -> v1.GetServerInfoResponse:
        """Version, limits, and what an acknowledgement is worth."""
        return self._run(_calls.server_info())
