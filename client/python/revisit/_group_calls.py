"""The calls about groups as the clients make them (see `_calls.py`)."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Optional, Union

from google.protobuf import field_mask_pb2
from numpy.typing import ArrayLike

from revisit import v1
from revisit._arguments import message, refuse, text
from revisit._calls import (
    PAGE, Call, Pages, add_findings, changed_paths, coordinates_of, covariance_of,
    unary)
from revisit._names import Vehicles, group_name, vehicle_name, vehicle_names
from revisit._settings import merged
from revisit.errors import Aborted

#: A pose of a vehicle: its id or name, and the sequence.
MemberPose = tuple[str, int]


def datum(pose: ArrayLike, covariance: ArrayLike, *, datum_id: str = "") -> v1.Datum:
    """Where the frame of a vehicle's first recording lies in the one that the datums of
    a group share: x, y, heading of a planar vehicle, or x, y, z, heading of a spatial
    one, or a matrix (3, 3) or (4, 4) that maps the vehicle's frame into the shared one.
    `covariance` is that of its error at the recording's first pose, as
    `to_covariances()` takes it for one pose. Vehicles whose datums have the same
    `datum_id` have that error in common."""
    return message(
        v1.Datum, datum_id=datum_id, covariance=covariance_of(covariance),
        pose=v1.StatePose(**coordinates_of(
            pose, "pose", "the vehicle's frame into the shared one")))


def _member_name(group: str, vehicle: str) -> str:
    return f"{group_name(group)}/members/{vehicle_name(vehicle).rpartition('/')[2]}"


def _group_of(answer: Any) -> v1.Group:
    group: v1.Group = answer.group
    return group


def create_group(group_id: str, settings: Optional[v1.GroupSettings],
                 display_name: str, keywords: Mapping[str, Any]) -> Call[v1.Group]:
    return unary("CreateGroup", message(
        v1.CreateGroupRequest,
        group_id=text("group_id", group_id).removeprefix("groups/"),
        group=message(v1.Group, settings=merged(v1.GroupSettings, settings, keywords),
                       display_name=display_name)), _group_of)


def get_group(group: str) -> Call[v1.Group]:
    return unary("GetGroup", v1.GetGroupRequest(name=group_name(group)), _group_of)


def list_groups() -> Pages[v1.Group]:
    return Pages("ListGroups", v1.ListGroupsRequest(page_size=PAGE), "groups")


def update_group(group: str, settings: Optional[v1.GroupSettings],
                 names: Iterable[str], display_name: Optional[str],
                 expected_revision: int,
                 keywords: Mapping[str, Any]) -> Call[v1.Group]:
    changed = message(v1.Group, name=group_name(group), display_name=display_name,
                      settings=merged(v1.GroupSettings, settings, keywords))
    paths = changed_paths(names, keywords, display_name)
    return unary("UpdateGroup", message(
        v1.UpdateGroupRequest,
        group=changed, update_mask=field_mask_pb2.FieldMask(paths=paths),
        expected_revision=expected_revision), _group_of)


def delete_group(group: str, expected_revision: int) -> Call[Any]:
    return unary("DeleteGroup", message(
        v1.DeleteGroupRequest,
        name=group_name(group), expected_revision=expected_revision))


def add_group_member(group: str, vehicle: str, placed: Optional[v1.Datum]
                     ) -> Call[v1.AddGroupMemberResponse]:
    return unary("AddGroupMember", v1.AddGroupMemberRequest(
        parent=group_name(group),
        member=message(v1.GroupMember, vehicle=vehicle_name(vehicle), datum=placed)))


def update_group_member(group: str, vehicle: str, placed: Optional[v1.Datum],
                        expected_revision: int
                        ) -> Call[v1.UpdateGroupMemberResponse]:
    return unary("UpdateGroupMember", message(
        v1.UpdateGroupMemberRequest,
        member=message(v1.GroupMember, name=_member_name(group, vehicle), datum=placed),
        expected_revision=expected_revision))


def remove_group_member(group: str, vehicle: str) -> Call[Any]:
    return unary("RemoveGroupMember", v1.RemoveGroupMemberRequest(
        name=_member_name(group, vehicle)))


def list_group_members(group: str) -> Pages[v1.GroupMember]:
    return Pages("ListGroupMembers", v1.ListGroupMembersRequest(
        parent=group_name(group), page_size=PAGE), "members")


def _end(name: str, pose: MemberPose) -> v1.MemberPose:
    if not isinstance(pose, (tuple, list)) or len(pose) != 2:
        refuse(name, pose, "(vehicle, sequence)")
    vehicle, sequence = pose
    return message(v1.MemberPose, vehicle=vehicle_name(vehicle), sequence=sequence)


def _poses_of(query: Union[MemberPose, str], matched: Union[MemberPose, v1.Candidate],
              own_call: str) -> tuple[v1.MemberPose, v1.MemberPose]:
    """The two poses. The vehicle that asked, and what its search has found, stand for
    them too."""
    if not isinstance(matched, v1.Candidate):
        if isinstance(query, str):
            raise TypeError(f"query is {query!r}: with a pose, expected (vehicle, "
                            "sequence)")
        return _end("query", query), _end("matched", matched)
    if not isinstance(query, str):
        raise TypeError(f"query is {query!r}: with a candidate, which has the "
                        "sequence, expected the vehicle that asked")
    if not matched.matched_vehicle:
        raise ValueError("matched is a candidate in the vehicle's own history: "
                         f"{own_call} takes it")
    return (_end("query", (query, matched.query.sequence)),
            _end("matched", (matched.matched_vehicle, matched.matched.sequence)))


def add_inter_vehicle_loop_closure(
        group: str, query: Union[MemberPose, str],
        matched: Union[MemberPose, v1.Candidate], relative: Optional[ArrayLike],
        covariance: Optional[ArrayLike], score: Optional[float], note: str,
        loop_closure_id: str) -> Call[v1.AddInterVehicleLoopClosureResponse]:
    asked, found = _poses_of(query, matched, "add_loop_closure()")
    made = message(v1.InterVehicleLoopClosure, query=asked, matched=found, note=note)
    add_findings(made, relative, covariance, score)
    return unary("AddInterVehicleLoopClosure", message(
        v1.AddInterVehicleLoopClosureRequest,
        parent=group_name(group), loop_closure_id=loop_closure_id, loop_closure=made))


def list_inter_vehicle_loop_closures(group: str) -> Pages[v1.InterVehicleLoopClosure]:
    return Pages("ListInterVehicleLoopClosures", v1.ListInterVehicleLoopClosuresRequest(
        parent=group_name(group), page_size=PAGE), "loop_closures")


def reject_inter_vehicle_candidate(
        group: str, query: Union[MemberPose, str],
        matched: Union[MemberPose, v1.Candidate], note: str,
        rejected_candidate_id: str) -> Call[v1.RejectInterVehicleCandidateResponse]:
    asked, found = _poses_of(query, matched, "reject_candidate()")
    return unary("RejectInterVehicleCandidate", message(
        v1.RejectInterVehicleCandidateRequest,
        parent=group_name(group), rejected_candidate_id=rejected_candidate_id,
        rejected_candidate=message(
            v1.InterVehicleRejectedCandidate, query=asked, matched=found, note=note)))


def list_inter_vehicle_rejected_candidates(
        group: str) -> Pages[v1.InterVehicleRejectedCandidate]:
    return Pages("ListInterVehicleRejectedCandidates",
                 v1.ListInterVehicleRejectedCandidatesRequest(
                     parent=group_name(group), page_size=PAGE), "rejected_candidates")


def delete_inter_vehicle_rejected_candidate(name: str) -> Call[Any]:
    return unary("DeleteInterVehicleRejectedCandidate",
                 message(v1.DeleteInterVehicleRejectedCandidateRequest, name=name))


class _FrameTransforms(Pages[v1.FrameTransform]):
    """Pages of frames, which must all be of one revision of the group."""

    _revision: Optional[int] = None

    def items(self, page: v1.ListFrameTransformsResponse
              ) -> Iterator[v1.FrameTransform]:
        if self._revision not in (None, page.group_revision):
            raise Aborted("the group changed while its frames were listed: list them "
                          "again")
        self._revision = page.group_revision
        return super().items(page)


def _place_of(transform: v1.FrameTransform) -> tuple[str, int]:
    vehicle, _, first = transform.recording.rpartition("/recordings/")
    return vehicle, int(first) if first.isdigit() else 0


def list_frame_transforms(group: str, vehicle: str, vehicles: Vehicles,
                          allow_partial: bool) -> Pages[v1.FrameTransform]:
    return _FrameTransforms("ListFrameTransforms", message(
        v1.ListFrameTransformsRequest,
        parent=group_name(group), vehicle=vehicle_name(vehicle),
        vehicles=vehicle_names(vehicles), allow_partial=allow_partial, page_size=PAGE),
        "frame_transforms", order=_place_of)


def delete_inter_vehicle_loop_closure(name: str) -> Call[Any]:
    return unary("DeleteInterVehicleLoopClosure",
                 message(v1.DeleteInterVehicleLoopClosureRequest, name=name))
