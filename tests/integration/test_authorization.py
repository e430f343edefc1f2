"""Who may see and do what."""

import re

import pytest

from caller_identities import METHODS, SERVICE, As, Code, ask, create, list_vehicles
from grouping import group_requests
from revisit_server import Server
from stubs import api
from watching import list_checks, wait_until_paid
from wire import PoseStream, append, failure_of, get, laps, straight

pytest_plugins = ("caller_identities",)


def request_about(method, vehicle):
    """A request of the method that names the vehicle, and the same request for
    all vehicles else."""
    pair = vehicle + "/{}/a"
    vehicle_id = vehicle.split("/")[1]
    pose = straight(1)[0]
    return {
        "AcceptDataLoss": lambda: api.AcceptDataLossRequest(name=vehicle),
        "AddLoopClosure": lambda: api.AddLoopClosureRequest(
            parent=vehicle, loop_closure=api.LoopClosure(
                query_sequence=2, matched_sequence=1)),
        "AppendPoses": lambda: api.AppendPosesRequest(
            vehicle=vehicle, poses=[pose]),
        "CreateVehicle": lambda: api.CreateVehicleRequest(
            vehicle_id=vehicle_id),
        "DeleteLoopClosure": lambda: api.DeleteLoopClosureRequest(
            name=pair.format("loopClosures")),
        "DeleteRejectedCandidate": lambda: api.DeleteRejectedCandidateRequest(
            name=pair.format("rejectedCandidates")),
        "DeleteVehicle": lambda: api.DeleteVehicleRequest(name=vehicle),
        "ExportPoseGraph": lambda: api.ExportPoseGraphRequest(
            vehicle=vehicle),
        "FindCandidates": lambda: api.FindCandidatesRequest(vehicle=vehicle),
        "FindContradictions": lambda: api.FindContradictionsRequest(
            vehicle=vehicle),
        "GetCheck": lambda: api.GetCheckRequest(name=vehicle + "/checks/1"),
        "GetServerInfo": lambda: api.GetServerInfoRequest(),
        "GetVehicle": lambda: api.GetVehicleRequest(name=vehicle),
        "ListChecks": lambda: api.ListChecksRequest(parent=vehicle),
        "ListDeletedPosePairs": lambda: api.ListDeletedPosePairsRequest(
            parent=vehicle),
        "ListLoopClosures": lambda: api.ListLoopClosuresRequest(
            parent=vehicle),
        "ListPoses": lambda: api.ListPosesRequest(parent=vehicle),
        "ListRecordings": lambda: api.ListRecordingsRequest(parent=vehicle),
        "ListRejectedCandidates": lambda: api.ListRejectedCandidatesRequest(
            parent=vehicle),
        "ListVehicles": lambda: api.ListVehiclesRequest(),
        "RejectCandidate": lambda: api.RejectCandidateRequest(
            parent=vehicle, rejected_candidate=api.RejectedCandidate(
                query_sequence=2, matched_sequence=1)),
        "RevisePoses": lambda: api.RevisePosesRequest(
            vehicle=vehicle, poses=[pose]),
        "StreamPoses": lambda: api.StreamPosesRequest(
            open=api.StreamPosesOpen(vehicle=vehicle)),
        "UpdateVehicle": lambda: api.UpdateVehicleRequest(
            vehicle=api.Vehicle(name=vehicle, settings=api.VehicleSettings(
                max_candidates=3)),
            update_mask={"paths": ["settings.max_candidates"]}),
        # Begun behind the last event: the cursor of none is refused.
        "WatchCandidates": lambda: api.WatchCandidatesRequest(
            filter=api.CandidateFilter(vehicles=[vehicle])),
        **{name: lambda request=request: request
           for name, request in group_requests(
               f"groups/{vehicle_id}", vehicle, vehicle + "0").items()},
    }[method]()


def call(stub, method, vehicle):
    """Calls any method about a vehicle; answers all that comes back."""
    request = request_about(method, vehicle)
    kind = SERVICE.methods_by_name[method]
    answer = getattr(stub, method)(
        iter([request]) if kind.client_streaming else request, timeout=20)
    return list(answer) if kind.server_streaming else answer


@pytest.mark.parametrize("method", METHODS)
def test_every_method_needs_credentials(token_server, method):
    failure = failure_of(
        lambda: call(As(token_server.stub(), None), method, "vehicles/acme-1"))
    assert (failure.code, failure.reason) == (
        Code.UNAUTHENTICATED, "CREDENTIALS_MISSING")


# --- Tenants.

# Methods that are not about one vehicle; those of groups are tested in
# test_group_rights.py.
ABOUT_NONE = {"GetServerInfo", "ListVehicles", "WatchCandidates",
              *group_requests("groups/g", "vehicles/a", "vehicles/b")}


@pytest.mark.parametrize("method", sorted(set(METHODS) - ABOUT_NONE))
def test_vehicles_of_others_are_as_if_they_were_not_there(called_by, method):
    umbra = called_by("umbra")
    there = create(umbra, "umbra-there-1")
    append(umbra, there, straight(3))

    def answer(vehicle, subject="acme"):
        failure = failure_of(
            lambda: call(called_by(subject), method, vehicle))
        del failure.metadata["request_id"]
        assert vehicle.split("/")[1] in failure.message or (
            method == "CreateVehicle")
        # As long as each other, so that nothing else can differ.
        failure.message = failure.message.replace(
            vehicle.split("/")[1], "it")
        return failure

    of_others = answer(there)
    assert answer("vehicles/umbra-gone-1") == of_others
    assert answer("vehicles/nobodys-1") == of_others
    if method == "CreateVehicle":
        assert (of_others.code, of_others.reason) == (
            Code.PERMISSION_DENIED, "NOT_GRANTED")
    else:
        assert (of_others.code, of_others.reason) == (
            Code.NOT_FOUND, "VEHICLE_NOT_FOUND")
        # What is not there of one's own says the same.
        assert answer("vehicles/acme-gone-1") == of_others
    # Not even within the tenant, where not all of it is granted.
    assert answer("vehicles/acme-other-1", "vehicle:7") == of_others
    assert umbra.GetVehicle(
        api.GetVehicleRequest(name=there)).vehicle.durable_sequence == 3


@pytest.mark.parametrize("method", sorted(set(METHODS) - ABOUT_NONE))
def test_verbs_are_checked_whether_the_vehicle_is_there_or_not(
        called_by, method):
    reads = {"ExportPoseGraph", "FindCandidates", "FindContradictions",
             "GetCheck", "GetVehicle", "ListChecks", "ListDeletedPosePairs",
             "ListLoopClosures", "ListPoses", "ListRecordings",
             "ListRejectedCandidates"}
    admin = {"AcceptDataLoss", "DeleteVehicle"}
    needed = ("read" if method in reads else
              "admin" if method in admin else "write")
    other = "acme-writer" if needed == "read" else "acme-reader"
    vehicle = create(called_by("acme"), "acme-verbs-1")
    for name in (vehicle, "vehicles/acme-nothing-1"):
        failure = failure_of(lambda: call(called_by(other), method, name))
        assert (failure.code, failure.reason) == (
            Code.PERMISSION_DENIED, "NOT_GRANTED")
        assert failure.metadata["verb"] == needed
        if needed == "admin":
            failure = failure_of(
                lambda: call(called_by("acme-writer"), method, name))
            assert failure.metadata["verb"] == "admin"


# Creating a vehicle again answered its summary, and so did changing it.
def test_writer_is_told_nothing_of_a_vehicle_but_what_it_wrote(called_by):
    owner, writer = called_by("acme"), called_by("acme-writer")
    vehicle = create(owner, "acme-unread-1")
    append(owner, vehicle, straight(20))
    uid = get(owner, vehicle).uid
    request = api.CreateVehicleRequest(vehicle_id="acme-unread-1")
    told = writer.CreateVehicle(request).vehicle
    settings = get(owner, vehicle).settings
    assert told == api.Vehicle(name=vehicle, uid=uid, settings=settings)
    # A new one looks the same.
    request.vehicle_id = "acme-unread-2"
    new = writer.CreateVehicle(request).vehicle
    assert new == api.Vehicle(name="vehicles/acme-unread-2", uid=new.uid,
                              settings=settings)
    told = writer.UpdateVehicle(api.UpdateVehicleRequest(
        vehicle=api.Vehicle(name=vehicle, settings=api.VehicleSettings(
            max_candidates=3)),
        update_mask={"paths": ["settings.max_candidates"]})).vehicle
    assert told == api.Vehicle(
        name=vehicle, uid=uid,
        settings=api.VehicleSettings(max_candidates=3))
    assert owner.UpdateVehicle(api.UpdateVehicleRequest(
        vehicle=api.Vehicle(name=vehicle, settings=api.VehicleSettings(
            max_candidates=4)),
        update_mask={"paths": ["settings.max_candidates"]})
        ).vehicle == get(owner, vehicle)


def test_how_much_is_on_the_server_is_told_to_callers_of_no_tenant(called_by):
    owner = called_by("acme")
    append(owner, create(owner, "acme-counted-1"), straight(20))
    told = ask(called_by("op", groups=["operators"]))
    assert told.over_all_tenants
    assert told.resident_vehicle_count >= 1 and told.resident_bytes > 0
    for subject in ("acme", "acme-few", "vehicle:13"):
        info = ask(called_by(subject))
        assert not info.over_all_tenants
        assert (info.resident_vehicle_count, info.resident_node_count,
                info.resident_bytes, len(info.servers)) == (0, 0, 0, 0)
        assert info.version == told.version


def test_candidates_of_a_stream_need_to_be_readable(called_by):
    vehicle = create(called_by("acme"), "acme-candidates-1")
    writer = called_by("acme-writer")
    with PoseStream(writer, vehicle, metadata=writer.metadata) as stream:
        stream.receive_kind("opened")
    with PoseStream(writer, vehicle, metadata=writer.metadata,
                    send_candidates=True) as stream:
        failure = failure_of(stream.receive_all)
        assert (failure.code, failure.reason) == (
            Code.PERMISSION_DENIED, "NOT_GRANTED")
        assert failure.metadata["verb"] == "read"


def test_watches_and_lists_of_candidates_tell_nothing_of_other_tenants(called_by):
    storing = api.Vehicle(settings=api.VehicleSettings(
        checks=api.STORED_CHECKS_STORED, node_spacing_meters=1.0,
        sequence_length_meters=20.0, check_interval_meters=10.0))
    names = {}
    for tenant in ("acme", "umbra"):
        names[tenant] = called_by(tenant).CreateVehicle(api.CreateVehicleRequest(
            vehicle_id=f"{tenant}-watched-1", vehicle=storing)).vehicle.name
    _, cursor = list_checks(called_by("acme"))
    for tenant in ("umbra", "acme"):
        append(called_by(tenant), names[tenant], laps(760))
        wait_until_paid(called_by(tenant), names[tenant])
    for tenant in ("acme", "umbra"):
        checks, _ = list_checks(called_by(tenant))
        assert len(checks) > 20
        assert {check.name.rsplit("/", 2)[0] for check in checks} == {names[tenant]}
        states = sum(len(check.states) for check in checks)
        events = []
        watching = called_by(tenant).WatchCandidates(
            api.WatchCandidatesRequest(cursor=cursor))
        while len(events) < states:
            told = next(watching)
            if told.WhichOneof("event") == "candidate":
                events.append(told.candidate)
        watching.cancel()
        # Without a gap by which others' events could be counted.
        assert [event.number for event in events] == list(range(1, states + 1))
        assert {event.vehicle_uid for event in events} == {
            get(called_by(tenant), names[tenant]).uid}
    # Who names one of others is told what is told of none.
    for named in (names["umbra"], "vehicles/umbra-gone-9", "vehicles/nobodys-9"):
        failure = failure_of(lambda n=named: next(called_by("acme").WatchCandidates(
            api.WatchCandidatesRequest(filter=api.CandidateFilter(vehicles=[n])))))
        assert (failure.code, failure.reason) == (
            Code.NOT_FOUND, "VEHICLE_NOT_FOUND")
        assert list_checks(called_by("acme"), filter=api.CandidateFilter(
            vehicles=[named]))[0] == []


def test_lists_hold_what_may_be_read_and_nothing_of_the_rest(
        identities, tmp_path):
    with Server(tmp_path / "store", *identities.token_flags) as server:
        stub = server.stub()

        def called(subject, **claims):
            return As(stub, identities.key.token(subject, **claims))

        operator = called("op", groups=["operators"])
        ids = sorted(f"{tenant}-{number}" for number in range(1, 21)
                     for tenant in ("acme", "umbra", "zzz"))
        for vehicle_id in ids:
            create(operator, vehicle_id)
        acme = [name for name in ids if name.startswith("acme-")]
        few = [name for name in acme
               if re.fullmatch("acme-(1.*|7)", name)]
        assert len(few) == 12
        for subject, claims, expected in [
                ("op", {"groups": ["operators"]}, ids), ("acme", {}, acme),
                ("acme-few", {}, few), ("vehicle:13", {}, ["acme-13"]),
                ("vehicle:99", {}, []), ("acme-writer", {}, [])]:
            for size in (1, 3, 4, 12, 100):
                pages, tokens = list_vehicles(called(subject, **claims), size)
                assert sum(pages, []) == expected, (subject, size)
                # A page is full, or it is the last: what lies between leaves
                # no gap to be counted.
                assert all(len(page) == size for page in pages[:-1])
                assert pages[-1] or not expected
        # A token of others starts a list of one's own at most later.
        _, tokens = list_vehicles(called("umbra"), 5)
        page = called("acme").ListVehicles(
            api.ListVehiclesRequest(page_token=tokens[0]))
        assert not page.vehicles
        _, tokens = list_vehicles(called("acme"), 20)
        assert not tokens


def test_log_tells_who_called_and_keeps_no_token(token_server, identities):
    token = identities.key.token("acme")
    create(As(token_server.stub(), token), "acme-logged-1")
    bad = token[:-6] + "AAAAAA"
    failure_of(lambda: ask(As(token_server.stub(), bad)))
    token_server.logged("vehicle=acme-logged-1")
    token_server.logged("CREDENTIALS_INVALID")
    log = token_server.log()
    assert re.search("vehicle=acme-logged-1 tenant=acme caller=token:acme ",
                     log)
    for part in token.split(".")[1:]:
        assert part not in log
    assert bad.split(".")[2] not in log
