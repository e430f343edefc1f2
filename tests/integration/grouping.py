"""Groups of vehicles as tests from outside call them."""

from google.protobuf import field_mask_pb2

from stubs import api
from wire import append, straight

PLANAR = api.Covariance(form=api.COVARIANCE_FORM_PLANAR_6,
                        values=[1.0, 0.0, 0.0, 1.0, 0.0, 0.01])


def add_vehicle(stub, vehicle_id, poses=5, **settings):
    """Makes a vehicle with a few poses; answers its name."""
    name = stub.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id=vehicle_id, vehicle=api.Vehicle(
            settings=api.VehicleSettings(**settings)))).vehicle.name
    if poses:
        append(stub, name, straight(poses))
    return name


def create_group(stub, group_id, display_name="", **settings):
    return stub.CreateGroup(api.CreateGroupRequest(
        group_id=group_id, group=api.Group(
            display_name=display_name,
            settings=api.GroupSettings(**settings)))).group


def get_group(stub, name):
    return stub.GetGroup(api.GetGroupRequest(name=name)).group


def update_group(stub, name, *paths, expected_revision=0, **fields):
    return stub.UpdateGroup(api.UpdateGroupRequest(
        group=api.Group(name=name, **fields),
        update_mask=field_mask_pb2.FieldMask(paths=paths),
        expected_revision=expected_revision)).group


def delete_group(stub, name, expected_revision=0):
    stub.DeleteGroup(api.DeleteGroupRequest(
        name=name, expected_revision=expected_revision))


def datum(x=0.0, covariance=PLANAR, **fields):
    return api.Datum(pose=api.StatePose(x_meters=x), covariance=covariance,
                     **fields)


def add_member(stub, group, vehicle, placed=None):
    return stub.AddGroupMember(api.AddGroupMemberRequest(
        parent=group, member=api.GroupMember(vehicle=vehicle, datum=placed)))


def update_member(stub, name, placed=None, expected_revision=0):
    return stub.UpdateGroupMember(api.UpdateGroupMemberRequest(
        member=api.GroupMember(name=name, datum=placed),
        expected_revision=expected_revision))


def remove_member(stub, name):
    return stub.RemoveGroupMember(
        api.RemoveGroupMemberRequest(name=name)).revision


def link(query, matched, **content):
    """Each pose as (vehicle, sequence)."""
    return api.InterVehicleLoopClosure(
        query=api.MemberPose(vehicle=query[0], sequence=query[1]),
        matched=api.MemberPose(vehicle=matched[0], sequence=matched[1]),
        **content)


def add_link(stub, group, query, matched, link_id="", **content):
    return stub.AddInterVehicleLoopClosure(api.AddInterVehicleLoopClosureRequest(
        parent=group, loop_closure_id=link_id,
        loop_closure=link(query, matched, **content)))


def delete_link(stub, name):
    return stub.DeleteInterVehicleLoopClosure(
        api.DeleteInterVehicleLoopClosureRequest(name=name)).revision


def reject(stub, group, query, matched, rejected_id="", note=""):
    return stub.RejectInterVehicleCandidate(api.RejectInterVehicleCandidateRequest(
        parent=group, rejected_candidate_id=rejected_id,
        rejected_candidate=api.InterVehicleRejectedCandidate(
            query=api.MemberPose(vehicle=query[0], sequence=query[1]),
            matched=api.MemberPose(vehicle=matched[0], sequence=matched[1]),
            note=note)))


def delete_rejected(stub, name):
    return stub.DeleteInterVehicleRejectedCandidate(
        api.DeleteInterVehicleRejectedCandidateRequest(name=name)).revision


def _pages(call, request, field):
    while True:
        page = call(request)
        yield list(getattr(page, field))
        if not page.next_page_token:
            return
        request.page_token = page.next_page_token


def group_pages(stub, page_size=0):
    return list(_pages(stub.ListGroups, api.ListGroupsRequest(
        page_size=page_size), "groups"))


def member_pages(stub, group, page_size=0):
    return list(_pages(stub.ListGroupMembers, api.ListGroupMembersRequest(
        parent=group, page_size=page_size), "members"))


def link_pages(stub, group, page_size=0):
    return list(_pages(
        stub.ListInterVehicleLoopClosures,
        api.ListInterVehicleLoopClosuresRequest(
            parent=group, page_size=page_size), "loop_closures"))


def rejected_pages(stub, group, page_size=0):
    return list(_pages(
        stub.ListInterVehicleRejectedCandidates,
        api.ListInterVehicleRejectedCandidatesRequest(
            parent=group, page_size=page_size), "rejected_candidates"))


def rejected_of(stub, group):
    return [one for page in rejected_pages(stub, group) for one in page]


def frame_pages(stub, group, vehicle, page_size=0, **fields):
    return list(_pages(stub.ListFrameTransforms, api.ListFrameTransformsRequest(
        parent=group, vehicle=vehicle, page_size=page_size, **fields),
        "frame_transforms"))


def members_of(stub, group):
    """The names of the vehicles."""
    return [member.vehicle for page in member_pages(stub, group)
            for member in page]


def links_of(stub, group):
    return [closure for page in link_pages(stub, group) for closure in page]


def group_requests(group, vehicle, other):
    """By method, a request about the group, with one of its members, or two."""
    name = vehicle.split("/")[1]
    return {
        "AddGroupMember": api.AddGroupMemberRequest(
            parent=group, member=api.GroupMember(vehicle=vehicle)),
        "AddInterVehicleLoopClosure": api.AddInterVehicleLoopClosureRequest(
            parent=group, loop_closure=link((vehicle, 1), (other, 1))),
        "CreateGroup": api.CreateGroupRequest(group_id=group.split("/")[1]),
        "DeleteGroup": api.DeleteGroupRequest(name=group),
        "DeleteInterVehicleLoopClosure": api.DeleteInterVehicleLoopClosureRequest(
            name=f"{group}/loopClosures/a"),
        "DeleteInterVehicleRejectedCandidate":
            api.DeleteInterVehicleRejectedCandidateRequest(
                name=f"{group}/rejectedCandidates/a"),
        "GetGroup": api.GetGroupRequest(name=group),
        "ListFrameTransforms": api.ListFrameTransformsRequest(
            parent=group, vehicle=vehicle),
        "ListGroupMembers": api.ListGroupMembersRequest(parent=group),
        "ListGroups": api.ListGroupsRequest(),
        "ListInterVehicleLoopClosures": api.ListInterVehicleLoopClosuresRequest(
            parent=group),
        "ListInterVehicleRejectedCandidates":
            api.ListInterVehicleRejectedCandidatesRequest(parent=group),
        "RejectInterVehicleCandidate": api.RejectInterVehicleCandidateRequest(
            parent=group, rejected_candidate=api.InterVehicleRejectedCandidate(
                query=api.MemberPose(vehicle=vehicle, sequence=1),
                matched=api.MemberPose(vehicle=other, sequence=1))),
        "RemoveGroupMember": api.RemoveGroupMemberRequest(
            name=f"{group}/members/{name}"),
        "UpdateGroup": api.UpdateGroupRequest(
            group=api.Group(name=group),
            update_mask=field_mask_pb2.FieldMask(paths=["display_name"])),
        "UpdateGroupMember": api.UpdateGroupMemberRequest(
            member=api.GroupMember(name=f"{group}/members/{name}")),
    }
