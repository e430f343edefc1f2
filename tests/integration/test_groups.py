"""Groups of vehicles, their members, and the loop closures between them."""

import concurrent.futures
import contextlib
import sqlite3

import grpc
import pytest

from grouping import (PLANAR, add_link, add_member, add_vehicle, create_group, datum,
                      delete_group, delete_link, delete_rejected, frame_pages,
                      get_group, group_pages, link_pages, links_of, member_pages,
                      members_of, reject, rejected_pages, remove_member, update_group,
                      update_member)
from own_postgres import exit_without_postgres, own_shared_store
from revisit_server import Server
from stubs import api
from wire import append, failure_of, straight

Code = grpc.StatusCode
MOST_MEMBERS = 1000


def measured(x=1.0):
    return api.LoopClosureMeasurement(x_meters=x, covariance=PLANAR)


@pytest.fixture
def linked(stub, request):
    """(group, car, truck): a group of two vehicles that have five poses each."""
    stem = str(abs(hash(request.node.name)))
    car, truck = (add_vehicle(stub, f"{kind}-{stem}") for kind in ("car", "truck"))
    group = create_group(stub, f"g-{stem}").name
    add_member(stub, group, car)
    add_member(stub, group, truck)
    return group, car, truck


# ---- Groups


def test_group_is_what_it_was_made_and_changed_to(stub):
    origin = api.GeodeticPosition(latitude_degrees=59.9, longitude_degrees=10.7)
    made = create_group(stub, "made", display_name="Night", geodetic_origin=origin,
                        fix_bias_meters=1.5)
    assert (made.name, made.display_name, made.revision) == ("groups/made", "Night", 1)
    assert made.settings == api.GroupSettings(geodetic_origin=origin,
                                              fix_bias_meters=1.5)
    assert made.uid and made.create_time.seconds > 0
    assert get_group(stub, made.name) == made
    changed = update_group(stub, made.name, "settings.fix_bias_meters",
                           display_name="not named", settings=api.GroupSettings(
                               fix_bias_meters=2.5))
    assert changed.revision == 2
    assert changed.display_name == "Night"
    assert changed.settings == api.GroupSettings(geodetic_origin=origin,
                                                 fix_bias_meters=2.5)
    # What is named and absent goes back to its default.
    changed = update_group(stub, made.name, "settings", "display_name")
    assert (changed.display_name, changed.settings) == (
        "", api.GroupSettings(fix_bias_meters=0.0))
    assert get_group(stub, made.name) == changed
    delete_group(stub, made.name)
    failure = failure_of(lambda: get_group(stub, made.name))
    assert (failure.code, failure.reason) == (Code.NOT_FOUND, "GROUP_NOT_FOUND")
    assert create_group(stub, "made").uid != made.uid


def test_group_is_created_once(stub):
    made = create_group(stub, "once", fix_bias_meters=1.0)
    # Display names are not compared, and 0 is the default.
    assert create_group(stub, "once", "else", fix_bias_meters=1.0) == made
    failure = failure_of(lambda: create_group(stub, "once"))
    assert (failure.code, failure.reason) == (Code.ALREADY_EXISTS, "GROUP_EXISTS")
    assert create_group(stub, "plain") == create_group(stub, "plain",
                                                       fix_bias_meters=0.0)


def test_what_is_wrong_with_a_group_is_told_at_once(stub):
    failure = failure_of(lambda: create_group(
        stub, "wrong", "a\nb", fix_bias_meters=-1.0,
        geodetic_origin=api.GeodeticPosition(latitude_degrees=91.0)))
    assert failure.code == Code.INVALID_ARGUMENT
    assert failure.fields == [
        "group.display_name", "group.settings.geodetic_origin.latitude_degrees",
        "group.settings.fix_bias_meters"]
    failure = failure_of(lambda: create_group(stub, "-"))
    assert (failure.reason, failure.fields) == ("INVALID_RESOURCE_NAME", ["group_id"])
    name = create_group(stub, "masked").name
    failure = failure_of(lambda: update_group(stub, name, "uid", "settings.x"))
    assert failure.fields == ["update_mask.paths[0]", "update_mask.paths[1]"]
    assert failure_of(lambda: update_group(stub, name)).fields == ["update_mask"]
    assert get_group(stub, name).revision == 1


BAD_NAMES = ["", "g", "groups/", "groups/A", "groups/a/", "vehicles/a", "groups/a/b"]
GROUP_CALLS = {
    "GetGroup": ("name", get_group),
    "UpdateGroup": ("group.name", lambda stub, name: update_group(
        stub, name, "display_name")),
    "DeleteGroup": ("name", delete_group),
    "AddGroupMember": ("parent", lambda stub, name: add_member(
        stub, name, "vehicles/a")),
    "ListFrameTransforms": ("parent", lambda stub, name: frame_pages(
        stub, name, "vehicles/a")),
    "ListGroupMembers": ("parent", member_pages),
    "AddInterVehicleLoopClosure": ("parent", lambda stub, name: add_link(
        stub, name, ("vehicles/a", 1), ("vehicles/b", 1))),
    "ListInterVehicleLoopClosures": ("parent", link_pages),
    "RejectInterVehicleCandidate": ("parent", lambda stub, name: reject(
        stub, name, ("vehicles/a", 1), ("vehicles/b", 1))),
    "ListInterVehicleRejectedCandidates": ("parent", rejected_pages),
}
CALLS_IN_GROUPS = {
    "UpdateGroupMember": ("member.name", "members", update_member),
    "RemoveGroupMember": ("name", "members", remove_member),
    "DeleteInterVehicleLoopClosure": ("name", "loopClosures", delete_link),
    "DeleteInterVehicleRejectedCandidate": (
        "name", "rejectedCandidates", delete_rejected),
}


@pytest.mark.parametrize("call", GROUP_CALLS)
def test_call_refuses_names_that_are_none(call, stub):
    field, make = GROUP_CALLS[call]
    for name in BAD_NAMES:
        failure = failure_of(lambda: make(stub, name))
        assert failure.reason == "INVALID_RESOURCE_NAME", name
        assert failure.fields == [field], name
    if call not in ("AddGroupMember", "AddInterVehicleLoopClosure",
                    "RejectInterVehicleCandidate"):
        failure = failure_of(lambda: make(stub, "groups/nobodys"))
        assert (failure.code, failure.reason) == (Code.NOT_FOUND, "GROUP_NOT_FOUND")


@pytest.mark.parametrize("call", CALLS_IN_GROUPS)
def test_call_refuses_names_that_are_none_in_a_group(call, stub):
    field, collection, make = CALLS_IN_GROUPS[call]
    for name in ("", f"groups/a/{collection}/", f"groups/a/{collection}/A",
                 f"vehicles/a/{collection}/b", "groups/a", "groups/a/members/b/c"):
        failure = failure_of(lambda: make(stub, name))
        assert failure.reason == "INVALID_RESOURCE_NAME", name
        assert failure.fields == [field], name
    failure = failure_of(lambda: make(stub, f"groups/nobodys/{collection}/b"))
    assert (failure.code, failure.reason) == (Code.NOT_FOUND, "GROUP_NOT_FOUND")


def test_groups_are_listed_page_by_page(tmp_path):
    with Server(tmp_path / "store") as server:
        stub = server.stub()
        names = [create_group(stub, f"g-{number}").name for number in range(7)]
        pages = group_pages(stub, page_size=3)
        assert [len(page) for page in pages] == [3, 3, 1]
        assert [group.name for page in pages for group in page] == names
        assert pages[0][0] == get_group(stub, names[0])
        # A token is good for its own list.
        token = stub.ListGroups(api.ListGroupsRequest(page_size=1)).next_page_token
        for call in (lambda: stub.ListVehicles(
                         api.ListVehiclesRequest(page_token=token)),
                     lambda: stub.ListGroups(api.ListGroupsRequest(page_token="x"))):
            assert failure_of(call).reason == "INVALID_PAGE_TOKEN"
        failure = failure_of(lambda: group_pages(stub, page_size=-1))
        assert failure.fields == ["page_size"]


def test_revision_that_was_expected_is_required(stub, linked):
    group, car, _ = linked
    revision = get_group(stub, group).revision
    for call in (lambda: update_group(stub, group, "display_name",
                                      expected_revision=revision - 1),
                 lambda: update_member(stub, f"{group}/members/{car.split('/')[1]}",
                                       expected_revision=revision - 1),
                 lambda: delete_group(stub, group, expected_revision=revision + 1)):
        failure = failure_of(call)
        assert (failure.code, failure.reason) == (Code.ABORTED, "REVISION_MISMATCH")
        assert failure.metadata["revision"] == str(revision)
    assert get_group(stub, group).revision == revision
    assert update_group(stub, group, "display_name", display_name="x",
                        expected_revision=revision).revision == revision + 1
    delete_group(stub, group, expected_revision=revision + 1)
    assert failure_of(lambda: get_group(stub, group)).code == Code.NOT_FOUND


# ---- Members


def test_member_is_added_changed_and_removed(stub):
    car = add_vehicle(stub, "member-car", poses=0)
    group = create_group(stub, "members").name
    added = add_member(stub, group, car, datum(5.0, datum_id="gate"))
    assert added.revision == 2
    assert added.member == api.GroupMember(
        name=f"{group}/members/member-car", vehicle=car,
        datum=datum(5.0, datum_id="gate"))
    assert member_pages(stub, group) == [[added.member]]
    # Again: nothing changes.
    assert add_member(stub, group, car, datum(5.0, datum_id="gate")) == added
    failure = failure_of(lambda: add_member(stub, group, car))
    assert (failure.code, failure.reason) == (Code.ALREADY_EXISTS, "MEMBER_EXISTS")
    changed = update_member(stub, added.member.name, datum(6.0))
    assert (changed.revision, changed.member.datum) == (3, datum(6.0))
    changed = update_member(stub, added.member.name, expected_revision=3)
    assert changed.revision == 4 and not changed.member.HasField("datum")
    assert remove_member(stub, added.member.name) == 5
    assert members_of(stub, group) == []
    for call in (lambda: remove_member(stub, added.member.name),
                 lambda: update_member(stub, added.member.name)):
        failure = failure_of(call)
        assert (failure.code, failure.reason) == (Code.NOT_FOUND, "MEMBER_NOT_FOUND")
        assert "member-car" in failure.message
    failure = failure_of(lambda: add_member(stub, group, "vehicles/nobody"))
    assert (failure.code, failure.reason) == (Code.NOT_FOUND, "VEHICLE_NOT_FOUND")
    failure = failure_of(lambda: add_member(stub, "groups/nobodys", car))
    assert (failure.code, failure.reason) == (Code.NOT_FOUND, "GROUP_NOT_FOUND")
    failure = failure_of(lambda: add_member(stub, group, "member-car"))
    assert (failure.reason, failure.fields) == ("INVALID_RESOURCE_NAME",
                                                ["member.vehicle"])


def test_datum_fits_its_vehicle(stub):
    group = create_group(stub, "datums").name
    geodetic = add_vehicle(stub, "datum-geodetic", poses=0,
                           coordinate_frame=api.COORDINATE_FRAME_GEODETIC)
    failure = failure_of(lambda: add_member(stub, group, geodetic, datum()))
    assert (failure.code, failure.fields) == (Code.INVALID_ARGUMENT, ["member.datum"])
    add_member(stub, group, geodetic)
    failure = failure_of(lambda: update_member(
        stub, f"{group}/members/datum-geodetic", datum()))
    assert failure.fields == ["member.datum"]
    spatial = add_vehicle(stub, "datum-spatial", poses=0,
                          state_space=api.STATE_SPACE_SPATIAL)
    failure = failure_of(lambda: add_member(stub, group, spatial, datum()))
    assert failure.fields == ["member.datum.covariance.form"]
    failure = failure_of(lambda: add_member(stub, group, spatial, api.Datum(
        datum_id="a\nb", pose=api.StatePose(x_meters=1e9))))
    assert failure.fields == ["member.datum.datum_id", "member.datum.pose.x_meters",
                              "member.datum.covariance"]
    assert members_of(stub, group) == [geodetic]


def test_members_are_listed_page_by_page(stub):
    group = create_group(stub, "paged").name
    vehicles = [add_vehicle(stub, f"paged-{number}", poses=0) for number in range(5)]
    for vehicle in reversed(vehicles):
        add_member(stub, group, vehicle)
    pages = member_pages(stub, group, page_size=2)
    assert [len(page) for page in pages] == [2, 2, 1]
    assert [member.vehicle for page in pages for member in page] == vehicles
    other = create_group(stub, "paged-other").name
    token = stub.ListGroupMembers(api.ListGroupMembersRequest(
        parent=group, page_size=1)).next_page_token
    failure = failure_of(lambda: stub.ListGroupMembers(api.ListGroupMembersRequest(
        parent=other, page_token=token)))
    assert failure.reason == "INVALID_PAGE_TOKEN"


def test_vehicle_that_is_deleted_leaves_its_groups(stub, linked):
    group, car, truck = linked
    add_link(stub, group, (car, 1), (truck, 1))
    before = get_group(stub, group).revision
    stub.DeleteVehicle(api.DeleteVehicleRequest(name=car))
    assert members_of(stub, group) == [truck]
    assert links_of(stub, group) == []
    assert get_group(stub, group).revision == before + 1
    # One that is made in its place is no member.
    add_vehicle(stub, car.split("/")[1], poses=0)
    assert members_of(stub, group) == [truck]


# ---- Loop closures


def test_link_is_added_listed_and_deleted(stub, linked):
    group, car, truck = linked
    answer = add_link(stub, group, (car, 5), (truck, 2), "gate",
                      measurement=measured(), note="icp", score=0.0)
    added = answer.loop_closure
    assert added.name == f"{group}/loopClosures/gate"
    assert (added.query.vehicle, added.query.sequence) == (car, 5)
    assert (added.matched.vehicle, added.matched.sequence) == (truck, 2)
    assert added.measurement == measured()
    assert (added.note, added.HasField("score"), added.decided_by) == ("icp", True, "")
    assert answer.revision == get_group(stub, group).revision
    # Again: nothing changes.
    assert add_link(stub, group, (car, 5), (truck, 2), "gate",
                    measurement=measured(), note="icp", score=0.0) == answer
    for change in ({"note": "else"}, {"measurement": measured(2.0)}, {"score": 1.0}):
        failure = failure_of(lambda change=change: add_link(
            stub, group, (car, 5), (truck, 2), "gate",
            **{"measurement": measured(), "note": "icp", "score": 0.0, **change}))
        assert (failure.code, failure.reason) == (
            Code.ALREADY_EXISTS, "LOOP_CLOSURE_EXISTS")
    second = add_link(stub, group, (car, 5), (truck, 2), "again").loop_closure
    assert links_of(stub, group) == [second, added]
    assert delete_link(stub, added.name) == answer.revision + 2
    assert links_of(stub, group) == [second]
    failure = failure_of(lambda: delete_link(stub, added.name))
    assert (failure.code, failure.reason) == (
        Code.NOT_FOUND, "LOOP_CLOSURE_NOT_FOUND")


def test_link_without_an_id_is_added_once(stub, linked):
    group, car, truck = linked
    first = add_link(stub, group, (car, 1), (truck, 1))
    assert add_link(stub, group, (car, 1), (truck, 1)) == first
    others = [add_link(stub, group, *poses).loop_closure.name for poses in (
        ((car, 1), (truck, 2)), ((car, 2), (truck, 1)), ((truck, 1), (car, 1)))]
    assert len({first.loop_closure.name, *others}) == 4
    assert len(links_of(stub, group)) == 4


def test_links_are_in_the_order_of_their_times(stub, linked):
    group, car, truck = linked
    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        added = list(pool.map(
            lambda n: add_link(stub, group, (car, n % 5 + 1), (truck, n // 5 + 1)),
            range(25)))
    assert len({answer.revision for answer in added}) == 25
    by_revision = sorted(added, key=lambda answer: answer.revision)
    times = [answer.loop_closure.create_time.ToNanoseconds() for answer in by_revision]
    assert times == sorted(set(times))
    pages = link_pages(stub, group, page_size=10)
    assert [len(page) for page in pages] == [10, 10, 5]
    names = [closure.name for page in pages for closure in page]
    assert names == sorted(answer.loop_closure.name for answer in added)


def test_link_is_between_two_members_and_stored_poses(stub, linked):
    group, car, truck = linked
    stranger = add_vehicle(stub, f"stranger-{car.split('-')[1]}")
    revision = get_group(stub, group).revision
    for poses, code, reason in (
            (((car, 1), (stranger, 1)), Code.NOT_FOUND, "MEMBER_NOT_FOUND"),
            (((car, 1), ("vehicles/nobody", 1)), Code.NOT_FOUND, "VEHICLE_NOT_FOUND"),
            (((car, 6), (truck, 1)), Code.NOT_FOUND, "POSE_NOT_FOUND"),
            (((car, 1), (truck, 6)), Code.NOT_FOUND, "POSE_NOT_FOUND"),
            (((car, 1), (car, 2)), Code.INVALID_ARGUMENT, "INVALID_FIELD")):
        failure = failure_of(lambda poses=poses: add_link(stub, group, *poses))
        assert (failure.code, failure.reason) == (code, reason), poses
        if reason == "POSE_NOT_FOUND":
            assert failure.metadata["durable_sequence"] == "5"
    failure = failure_of(lambda: stub.AddInterVehicleLoopClosure(
        api.AddInterVehicleLoopClosureRequest(parent=group, loop_closure_id="A")))
    assert failure.fields == [
        "loop_closure.query.vehicle", "loop_closure.query.sequence",
        "loop_closure.matched.vehicle", "loop_closure.matched.sequence",
        "loop_closure_id"]
    failure = failure_of(lambda: add_link(
        stub, group, (car, 1), (truck, 1), measurement=api.LoopClosureMeasurement(
            covariance=api.Covariance(form=api.COVARIANCE_FORM_PLANAR_6,
                                      values=[-1.0, 0, 0, 1, 0, 1]))))
    assert failure.reason == "COVARIANCE_NOT_POSITIVE_DEFINITE"
    assert get_group(stub, group).revision == revision
    assert links_of(stub, group) == []


def test_member_that_is_removed_takes_its_links_along(stub, linked):
    group, car, truck = linked
    van = add_vehicle(stub, f"van-{car.split('-')[1]}")
    add_member(stub, group, van)
    add_link(stub, group, (car, 1), (truck, 1))
    kept = add_link(stub, group, (van, 1), (truck, 1)).loop_closure
    remove_member(stub, f"{group}/members/{car.split('/')[1]}")
    assert links_of(stub, group) == [kept]


# ---- The store


def test_groups_outlive_their_server(tmp_path):
    with Server(tmp_path / "store") as server:
        stub = server.stub()
        car, truck = (add_vehicle(stub, name) for name in ("car", "truck"))
        group = create_group(stub, "g", "Night", fix_bias_meters=2.0).name
        add_member(stub, group, car, datum(3.0))
        add_member(stub, group, truck)
        add_link(stub, group, (car, 1), (truck, 1), note="icp", measurement=measured())

        def everything(to):
            return (get_group(to, group), member_pages(to, group),
                    link_pages(to, group))

        before = everything(stub)
        server.kill()
    with Server(tmp_path / "store") as server:
        assert everything(server.stub()) == before
        failure = failure_of(lambda: add_link(
            server.stub(), group, (car, 1), (truck, 1)))
        assert failure.reason == "LOOP_CLOSURE_EXISTS"


@pytest.fixture
def damaged(tmp_path):
    """Makes a server of a store with one damaged row: a group "g" with the members
    "car", "truck" and "van" and the links "one" and "two", and a group "h"."""
    with contextlib.ExitStack() as stack:
        def damage(table, condition):
            with Server(tmp_path / "store") as server:
                stub = server.stub()
                group = create_group(stub, "g").name
                create_group(stub, "h")
                vehicles = [add_vehicle(stub, name) for name in ("car", "truck", "van")]
                for vehicle in vehicles:
                    add_member(stub, group, vehicle)
                add_link(stub, group, (vehicles[0], 1), (vehicles[1], 1), "one")
                add_link(stub, group, (vehicles[1], 1), (vehicles[2], 1), "two")
            database = sqlite3.connect(tmp_path / "store" / "revisit.sqlite")
            with database:
                assert database.execute(
                    f"UPDATE {table} SET checksum = checksum + 1 WHERE {condition}"
                    ).rowcount == 1
            database.close()
            return stack.enter_context(Server(tmp_path / "store")).stub()
        yield damage


def is_data_loss(call):
    failure = failure_of(call)
    return (failure.code, failure.reason) == (Code.DATA_LOSS, "STORE_CORRUPT")


def test_damaged_group_is_listed_and_can_be_deleted(damaged):
    stub = damaged("vehicle_groups", "id = 'g'")
    listed, sound = group_pages(stub)[0]
    assert listed == api.Group(name="groups/g", uid=listed.uid, revision=6)
    assert sound == get_group(stub, "groups/h")
    assert is_data_loss(lambda: get_group(stub, "groups/g"))
    assert is_data_loss(lambda: update_group(stub, "groups/g", "display_name"))
    assert is_data_loss(lambda: create_group(stub, "g"))
    assert is_data_loss(lambda: add_member(stub, "groups/g", "vehicles/car"))
    assert members_of(stub, "groups/g") == [
        f"vehicles/{name}" for name in ("car", "truck", "van")]
    assert remove_member(stub, "groups/g/members/car") == 7
    delete_group(stub, "groups/g")
    assert create_group(stub, "g").revision == 1


def test_damaged_member_is_told_behind_all_others_and_can_be_replaced(damaged):
    stub = damaged("group_members", "vehicle_key = (SELECT key FROM vehicles "
                   "WHERE id = 'car')")
    page = stub.ListGroupMembers(api.ListGroupMembersRequest(parent="groups/g"))
    assert [member.vehicle for member in page.members] == [
        "vehicles/truck", "vehicles/van"]
    failure = failure_of(lambda: stub.ListGroupMembers(api.ListGroupMembersRequest(
        parent="groups/g", page_token=page.next_page_token)))
    assert (failure.code, failure.reason) == (Code.DATA_LOSS, "STORE_CORRUPT")
    assert "'car'" in failure.message
    assert is_data_loss(lambda: add_member(stub, "groups/g", "vehicles/car"))
    # Links name the vehicle, and are sound.
    assert len(links_of(stub, "groups/g")) == 2
    update_member(stub, "groups/g/members/car", datum())
    assert len(members_of(stub, "groups/g")) == 3


def test_damaged_link_is_told_behind_all_others_and_can_be_deleted(damaged):
    stub = damaged("group_links", "id = 'one'")
    page = stub.ListInterVehicleLoopClosures(
        api.ListInterVehicleLoopClosuresRequest(parent="groups/g", page_size=1))
    assert [closure.name for closure in page.loop_closures] == [
        "groups/g/loopClosures/two"]
    assert is_data_loss(lambda: stub.ListInterVehicleLoopClosures(
        api.ListInterVehicleLoopClosuresRequest(
            parent="groups/g", page_token=page.next_page_token)))
    assert is_data_loss(lambda: add_link(
        stub, "groups/g", ("vehicles/car", 1), ("vehicles/truck", 1), "one"))
    delete_link(stub, "groups/g/loopClosures/one")
    assert len(links_of(stub, "groups/g")) == 1
    add_link(stub, "groups/g", ("vehicles/car", 1), ("vehicles/truck", 1), "one")


@pytest.fixture(scope="module")
def two_servers(tmp_path_factory):
    """Stubs of two servers over one PostgreSQL."""
    exit_without_postgres()
    directory = tmp_path_factory.mktemp("shared")
    with own_shared_store() as database:
        servers = [Server(database.url("revisit"), "--advertise-address",
                          f"host-{number}:1", log_path=directory / f"{number}.log")
                   for number in range(2)]
        yield [server.stub() for server in servers]
        for server in servers:
            assert server.is_running(), server.log()
            server.close()


def test_any_server_changes_a_group(two_servers):
    one, two = two_servers
    # The first server owns the vehicles; the second one needs them not.
    car, truck = (add_vehicle(one, name) for name in ("any-car", "any-truck"))
    group = create_group(two, "any").name
    assert create_group(one, "any") == get_group(two, group)
    add_member(two, group, car, datum())
    assert add_member(one, group, truck).revision == 3
    added = add_link(two, group, (car, 5), (truck, 5))
    assert add_link(one, group, (car, 5), (truck, 5)) == added
    assert links_of(one, group) == [added.loop_closure]
    # What the owner stores, the other one finds.
    append(one, car, straight(2, first=6))
    assert add_link(two, group, (car, 7), (truck, 1)).revision == added.revision + 1
    assert update_group(two, group, "display_name", display_name="x").revision == (
        get_group(one, group).revision)
    one.DeleteVehicle(api.DeleteVehicleRequest(name=car))
    assert members_of(two, group) == [truck]


def test_links_that_two_servers_add_at_once_have_times_in_their_order(two_servers):
    car, truck = (add_vehicle(two_servers[0], name)
                  for name in ("times-car", "times-truck"))
    group = create_group(two_servers[0], "times").name
    for vehicle in (car, truck):
        add_member(two_servers[1], group, vehicle)
    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        added = list(pool.map(
            lambda n: add_link(two_servers[n % 2], group, (car, n % 5 + 1),
                               (truck, n // 5 + 1)), range(25)))
    by_revision = sorted(added, key=lambda answer: answer.revision)
    times = [answer.loop_closure.create_time.ToNanoseconds() for answer in by_revision]
    assert times == sorted(set(times))
    assert len(links_of(two_servers[0], group)) == 25


def test_members_that_two_servers_add_at_once_are_all_there_and_not_too_many(
        two_servers):
    group = create_group(two_servers[0], "crowd").name
    with concurrent.futures.ThreadPoolExecutor(16) as pool:
        vehicles = list(pool.map(
            lambda n: add_vehicle(two_servers[n % 2], f"crowd-{n}", poses=0),
            range(MOST_MEMBERS + 4)))

        def add(number):
            try:
                add_member(two_servers[number % 2], group, vehicles[number])
                return vehicles[number]
            except grpc.RpcError as error:
                return error

        answers = list(pool.map(add, range(len(vehicles))))
    added = [answer for answer in answers if isinstance(answer, str)]
    refused = [answer for answer in answers if not isinstance(answer, str)]
    assert {error.code() for error in refused} == {Code.FAILED_PRECONDITION}
    assert len(added) == MOST_MEMBERS
    assert members_of(two_servers[1], group) == sorted(added)
    left = next(vehicle for vehicle in vehicles if vehicle not in added)
    failure = failure_of(lambda: add_member(two_servers[0], group, left))
    assert (failure.code, failure.reason) == (
        Code.FAILED_PRECONDITION, "GROUP_LIMIT")
    assert failure.metadata["limit"] == str(MOST_MEMBERS)
    # There is room again once one has left, for one.
    others = [vehicle for vehicle in vehicles if vehicle not in added]
    for _ in range(20):
        remove_member(two_servers[1], f"{group}/members/{added[0].split('/')[1]}")
        with concurrent.futures.ThreadPoolExecutor(4) as pool:
            answers = list(pool.map(add, map(vehicles.index, others)))
        joined, = [answer for answer in answers if isinstance(answer, str)]
        others = [*(set(others) - {joined}), added.pop(0)]
        added.append(joined)
    assert members_of(two_servers[1], group) == sorted(added)
