"""Who may see and do what with groups of vehicles."""

import json

import pytest

from caller_identities import METHODS, POLICY, As, Code
from grouping import (add_link, add_member, add_vehicle, create_group, delete_group,
                      frame_pages, get_group, group_pages, group_requests, links_of,
                      members_of, reject, rejected_of, remove_member, update_group,
                      update_member)
from identities import replace
from revisit_server import Server
from stubs import api
from wire import failure_of

pytest_plugins = ("caller_identities",)

ABOUT_GROUPS = sorted(group_requests("groups/g", "vehicles/a", "vehicles/b"))
# Methods that name a group.
NAMING = sorted(set(ABOUT_GROUPS) - {"ListGroups"})
READS = {"GetGroup", "ListFrameTransforms", "ListGroupMembers",
         "ListInterVehicleLoopClosures", "ListInterVehicleRejectedCandidates"}


def frames_of(stub, group, vehicle, **fields):
    """The members whose frames are told, with one recording each."""
    return [one.vehicle for page in frame_pages(stub, group, vehicle, **fields)
            for one in page]


def call(stub, method, group, vehicle="vehicles/acme-a", other="vehicles/acme-b"):
    return getattr(stub, method)(group_requests(group, vehicle, other)[method],
                                 timeout=20)


def test_every_method_of_groups_is_asked_about_here():
    assert ABOUT_GROUPS == [name for name in METHODS
                            if "Group" in name or "InterVehicle" in name
                            or "Frame" in name]


@pytest.mark.parametrize("method", NAMING)
def test_groups_of_others_are_as_if_they_were_not_there(called_by, method):
    umbra = called_by("umbra")
    create_group(umbra, "umbra-there-1")

    def answer(group, subject="acme"):
        failure = failure_of(lambda: call(called_by(subject), method, group))
        del failure.metadata["request_id"]
        # As long as each other, so that nothing else can differ.
        failure.message = failure.message.replace(group.split("/")[1], "it")
        return failure

    of_others = answer("groups/umbra-there-1")
    assert answer("groups/umbra-gone-1") == of_others
    assert answer("groups/nobodys-1") == of_others
    if method == "CreateGroup":
        assert (of_others.code, of_others.reason) == (
            Code.PERMISSION_DENIED, "NOT_GRANTED")
    else:
        assert (of_others.code, of_others.reason) == (
            Code.NOT_FOUND, "GROUP_NOT_FOUND")
    # Not even within the tenant, where not all of it is granted.
    assert answer("groups/acme-other-1", "vehicle:7") == of_others


# One's own that is not there says the same.
@pytest.mark.parametrize("method", sorted(
    set(NAMING) - {"CreateGroup", "AddGroupMember", "AddInterVehicleLoopClosure",
                   "RejectInterVehicleCandidate"}))
def test_own_group_that_is_not_there_is_not_told_from_others(called_by, method):
    failures = [failure_of(lambda group=group: call(called_by("acme"), method, group))
                for group in ("groups/acme-gone-1", "groups/umbra-gone-1")]
    for failure in failures:
        del failure.metadata["request_id"]
        failure.message = failure.message.replace("acme", "umbra")
    assert failures[0] == failures[1]


@pytest.mark.parametrize("method", NAMING)
def test_verbs_are_checked_whether_the_group_is_there_or_not(called_by, method):
    needed = ("read" if method in READS else
              "admin" if method == "DeleteGroup" else "write")
    other = "acme-writer" if needed == "read" else "acme-reader"
    create_group(called_by("acme"), "acme-verbs-1")
    for name in ("groups/acme-verbs-1", "groups/acme-nothing-1"):
        failure = failure_of(lambda name=name: call(called_by(other), method, name))
        assert (failure.code, failure.reason) == (
            Code.PERMISSION_DENIED, "NOT_GRANTED")
        assert failure.metadata["verb"] == needed
        if needed == "admin":
            failure = failure_of(
                lambda name=name: call(called_by("acme-writer"), method, name))
            assert failure.metadata["verb"] == "admin"


def test_writer_is_told_nothing_of_a_group_but_what_it_wrote(called_by):
    owner, writer = called_by("acme"), called_by("acme-writer")
    made = create_group(owner, "acme-unread-1", "secret", fix_bias_meters=2.0)
    told = create_group(writer, "acme-unread-1", fix_bias_meters=2.0)
    assert told == api.Group(name=made.name, uid=made.uid, settings=made.settings)
    told = update_group(writer, made.name, "settings.fix_bias_meters",
                        settings=api.GroupSettings(fix_bias_meters=3.0))
    assert told == api.Group(name=made.name, uid=made.uid,
                             settings=api.GroupSettings(fix_bias_meters=3.0))
    assert get_group(owner, made.name).display_name == "secret"


def test_adding_takes_rights_to_the_vehicles_too(called_by):
    acme, umbra = called_by("acme"), called_by("umbra")
    car, truck = (add_vehicle(acme, f"acme-rights-{name}")
                  for name in ("car", "truck"))
    others = add_vehicle(umbra, "umbra-rights-1")
    group = create_group(acme, "acme-rights").name
    for vehicle in (others, "vehicles/umbra-gone-1", "vehicles/acme-gone-1"):
        failure = failure_of(lambda v=vehicle: add_member(acme, group, v))
        assert (failure.code, failure.reason) == (
            Code.NOT_FOUND, "VEHICLE_NOT_FOUND"), vehicle
    for vehicle in (car, truck):
        add_member(called_by("acme-writer"), group, vehicle)
    failure = failure_of(lambda: add_link(
        called_by("acme-writer"), group, (car, 1), (truck, 1)))
    assert (failure.code, failure.metadata["verb"]) == (
        Code.PERMISSION_DENIED, "read")
    failure = failure_of(lambda: add_link(acme, group, (car, 1), (others, 1)))
    assert (failure.code, failure.reason) == (Code.NOT_FOUND, "VEHICLE_NOT_FOUND")
    added = add_link(acme, group, (car, 1), (truck, 1)).loop_closure
    assert added.decided_by == "token:acme"


def test_vehicle_joins_groups_of_its_own_tenant_only(called_by):
    operator = called_by("op", groups=["operators"])
    group = create_group(operator, "acme-joined").name
    own, others, nobodys = (add_vehicle(operator, name, poses=0) for name in (
        "acme-joining", "umbra-joining", "nobodys-joining"))
    for vehicle in (others, nobodys):
        failure = failure_of(lambda v=vehicle: add_member(operator, group, v))
        assert (failure.code, failure.fields) == (
            Code.INVALID_ARGUMENT, ["member.vehicle"])
    add_member(operator, group, own)
    add_member(operator, create_group(operator, "nobodys-group").name, nobodys)


@pytest.fixture
def site_server(identities, tmp_path):
    """A server whose policy has lists of groups, and a maker of its callers."""
    grants = [
        {"token_subject": "planner", "tenant": "acme", "vehicles": ["acme-1*"],
         "groups": ["acme-site-*"], "verbs": ["read", "write"]},
        {"token_subject": "driver:*", "tenant": "acme", "vehicles": ["acme-{match}"],
         "groups": [], "verbs": ["read", "write"]}]
    policy = replace(tmp_path / "policy.json", json.dumps(
        {**POLICY, "grants": POLICY["grants"] + grants}))
    flags = [policy if flag == identities.policy_file else flag
             for flag in identities.token_flags]
    with Server(tmp_path / "store", *flags) as server:
        stub = server.stub()
        yield lambda subject: As(stub, identities.key.token(subject))


def test_lists_of_groups_are_granted_beside_those_of_vehicles(site_server):
    acme, planner, driver = (site_server(name)
                             for name in ("acme", "planner", "driver:10"))
    seen, unseen = create_group(acme, "acme-site-1").name, create_group(
        acme, "acme-1").name
    car, truck, hidden = (add_vehicle(acme, name)
                          for name in ("acme-10", "acme-11", "acme-20"))
    assert [group.name for page in group_pages(acme) for group in page] == [
        unseen, seen]
    assert [group.name for page in group_pages(planner, page_size=1)
            for group in page] == [seen]
    assert failure_of(lambda: get_group(planner, unseen)).reason == "GROUP_NOT_FOUND"
    assert failure_of(lambda: get_group(driver, seen)).reason == "GROUP_NOT_FOUND"
    assert group_pages(driver) == [[]]
    for vehicle in (car, truck):
        add_member(planner, seen, vehicle)
    failure = failure_of(lambda: add_member(planner, seen, hidden))
    assert failure.reason == "VEHICLE_NOT_FOUND"
    add_member(acme, seen, hidden)
    shown = add_link(planner, seen, (car, 1), (truck, 1)).loop_closure
    add_link(acme, seen, (car, 1), (hidden, 1))
    # What the planner may not read leaves no trace in its lists.
    assert members_of(planner, seen) == [car, truck]
    assert links_of(planner, seen) == [shown]
    assert len(links_of(acme, seen)) == 2
    refused = failure_of(lambda: reject(planner, seen, (car, 2), (hidden, 2)))
    assert refused.reason == "VEHICLE_NOT_FOUND"
    told = reject(planner, seen, (car, 2), (truck, 2)).rejected_candidate
    assert told.decided_by == "token:planner"
    reject(acme, seen, (car, 2), (hidden, 2))
    assert rejected_of(planner, seen) == [told]
    assert len(rejected_of(acme, seen)) == 2
    assert frames_of(planner, seen, car) == [car, truck]
    assert frames_of(acme, seen, car) == [car, truck, hidden]
    for vehicle, asked in ((hidden, []), (car, [hidden])):
        failure = failure_of(lambda v=vehicle, a=asked: frames_of(
            planner, seen, v, vehicles=a))
        gone = failure_of(lambda v=vehicle, a=asked: frames_of(
            planner, seen, v.replace("20", "99"),
            vehicles=[one.replace("20", "99") for one in a]))
        assert (failure.code, failure.reason) == (
            Code.NOT_FOUND, "MEMBER_NOT_FOUND")
        assert failure.message.replace("acme-20", "acme-99") == gone.message
    for change in (update_member, remove_member):
        told = [failure_of(lambda c=change, n=name: c(planner, f"{seen}/members/{n}"))
                for name in ("acme-20", "acme-99")]
        assert {(failure.code, failure.reason) for failure in told} == {
            (Code.NOT_FOUND, "MEMBER_NOT_FOUND")}
        assert told[0].message.replace("acme-20", "acme-99") == told[1].message
    assert members_of(acme, seen) == [car, truck, hidden]
    failure = failure_of(lambda: delete_group(planner, seen))
    assert failure.metadata["verb"] == "admin"
    delete_group(acme, seen)
