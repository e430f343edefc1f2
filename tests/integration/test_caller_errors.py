"""Every other error that a caller can make (test_pose_errors.py has those of poses),
through the wire: the exact code, reason and fields; nothing is stored or half applied;
the server lives on."""

import dataclasses
import typing

import grpc
import pytest
from google.protobuf import field_mask_pb2

from caller_poses import GEODETIC, INF, INVALID, NAN, STORED, geodetic
from stubs import api
from wire import (
    LOOP_CLOSURES, PAIR_KINDS, REJECTED_CANDIDATES, PoseStream, append,
    deletions_page, failure_of, get, list_poses, pose, straight)

# ---- Names

BAD_IDS = ["", "A", "Vehicle-1", "-a", "a-", "-", "a_b", "a.b", "a b", "a/b",
           "../x", "..", "%2e%2e", "a\0b", "\0", "a\n", "ä", "а",
           "a" * 64, "a" * 10000]


@pytest.mark.parametrize("bad", BAD_IDS, ids=lambda bad: repr(bad)[:20])
def test_create_refuses_the_id(bad, stub):
    failure = failure_of(lambda: stub.CreateVehicle(
        api.CreateVehicleRequest(vehicle_id=bad)))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_RESOURCE_NAME")
    assert failure.fields == ["vehicle_id"]
    # What the caller sent comes back, if at all, without control characters.
    assert failure.message.isprintable()


@pytest.mark.parametrize("good", ["a", "0", "a" * 63, "a-b", "0-9", "a--b"])
def test_create_takes_the_id(good, stub):
    made = stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id=good)).vehicle
    assert made.name == f"vehicles/{good}"
    stub.DeleteVehicle(api.DeleteVehicleRequest(name=made.name))


BAD_NAMES = ["", "a", "vehicles", "vehicles/", "vehicles//", "/vehicles/a",
             "Vehicles/a", "vehicles/a/", "vehicles/a/b", "vehicles/A",
             "vehicles/../x", "vehicles/a\0", "vehicles/" + "a" * 64]

# Every call with the field that says which vehicle.
CALLS = {
    "GetVehicle": ("name", lambda stub, name: stub.GetVehicle(
        api.GetVehicleRequest(name=name))),
    "UpdateVehicle": ("vehicle.name", lambda stub, name: stub.UpdateVehicle(
        api.UpdateVehicleRequest(
            vehicle=api.Vehicle(name=name),
            update_mask=mask("settings.max_candidates")))),
    "DeleteVehicle": ("name", lambda stub, name: stub.DeleteVehicle(
        api.DeleteVehicleRequest(name=name))),
    "AppendPoses": ("vehicle", lambda stub, name: append(
        stub, name, straight(1))),
    "StreamPoses": ("open.vehicle", lambda stub, name: PoseStream(
        stub, name).receive()),
    "FindCandidates": ("vehicle", lambda stub, name: stub.FindCandidates(
        api.FindCandidatesRequest(vehicle=name))),
    "FindContradictions": ("vehicle", lambda stub, name:
                           stub.FindContradictions(
                               api.FindContradictionsRequest(vehicle=name))),
    "AddLoopClosure": ("parent", lambda stub, name: LOOP_CLOSURES.add(
        stub, name, 2, 1)),
    "ListLoopClosures": ("parent", lambda stub, name: LOOP_CLOSURES.page(
        stub, name)),
    "RejectCandidate": ("parent", lambda stub, name: REJECTED_CANDIDATES.add(
        stub, name, 2, 1)),
    "ListRejectedCandidates": (
        "parent", lambda stub, name: REJECTED_CANDIDATES.page(stub, name)),
    "ListDeletedPosePairs": (
        "parent", lambda stub, name: deletions_page(stub, name)),
    "RevisePoses": ("vehicle", lambda stub, name: stub.RevisePoses(iter([
        api.RevisePosesRequest(vehicle=name, poses=straight(1))]))),
    "ListPoses": ("parent", lambda stub, name: stub.ListPoses(
        api.ListPosesRequest(parent=name))),
    "ListRecordings": ("parent", lambda stub, name: stub.ListRecordings(
        api.ListRecordingsRequest(parent=name))),
    "ExportPoseGraph": ("vehicle", lambda stub, name: list(
        stub.ExportPoseGraph(api.ExportPoseGraphRequest(vehicle=name)))),
    "AcceptDataLoss": ("name", lambda stub, name: stub.AcceptDataLoss(
        api.AcceptDataLossRequest(name=name, durable_sequence=1))),
}


def mask(*paths):
    return field_mask_pb2.FieldMask(paths=paths)


@pytest.mark.parametrize("call", CALLS)
def test_call_refuses_names_that_are_none(call, stub):
    field, make = CALLS[call]
    for name in BAD_NAMES:
        failure = failure_of(lambda: make(stub, name))
        assert (failure.code, failure.reason) == (
            INVALID, "INVALID_RESOURCE_NAME"), name
        assert failure.fields == [field], name


@pytest.mark.parametrize("call", CALLS)
def test_call_says_that_there_is_no_such_vehicle(call, stub):
    failure = failure_of(lambda: CALLS[call][1](stub, "vehicles/nobody"))
    assert failure.code == grpc.StatusCode.NOT_FOUND
    assert failure.reason == "VEHICLE_NOT_FOUND"
    assert "nobody" in failure.message


@pytest.mark.parametrize("kind", PAIR_KINDS, ids=str)
def test_name_of_a_pair_must_be_one(kind, stub):
    own, other = kind.collection, next(
        k.collection for k in PAIR_KINDS if k is not kind)
    for name in ("", "vehicles/a", f"vehicles/a/{own}", f"vehicles/a/{own}/",
                 f"vehicles/a/{own}/B", f"vehicles/../{own}/b",
                 f"vehicles/a/{own.lower()}/b", f"vehicles/a/{own}/b/c",
                 f"vehicles/a/{other}/b"):
        failure = failure_of(lambda: kind.delete(stub, name))
        assert (failure.code, failure.reason) == (
            INVALID, "INVALID_RESOURCE_NAME"), name
        assert failure.fields == ["name"], name


# ---- Settings


@dataclasses.dataclass
class BadSetting:
    field: str
    settings: dict
    reason: str = "INVALID_FIELD"

    def __str__(self):
        shown = str(list(self.settings.values())[-1]).split()
        return " ".join([self.field, *shown])


def tolerance(position=2.0, heading=0.1):
    return {"place_tolerance": api.PlaceTolerance(position_meters=position,
                                                  heading_radians=heading)}


def shape(position=1.0, heading=0.06):
    return {"shape_tolerance": api.PlaceTolerance(position_meters=position,
                                                  heading_radians=heading)}


BAD_SETTINGS = [
    BadSetting("state_space", {"state_space": 17}),
    BadSetting("correlation_model", {"correlation_model": 17}),
    BadSetting("likelihood_form", {"likelihood_form": 17}),
    BadSetting("coordinate_frame", {"coordinate_frame": 17}),
    BadSetting("geodetic_origin", {"geodetic_origin": geodetic()}),
    BadSetting("geodetic_origin.latitude_degrees",
               {**GEODETIC, "geodetic_origin": geodetic(latitude=-91.0)}),
    BadSetting("geodetic_origin.longitude_degrees",
               {**GEODETIC, "geodetic_origin": geodetic(longitude=NAN)},
               "NOT_FINITE"),
    BadSetting("geodetic_origin.height_meters",
               {**GEODETIC, "geodetic_origin": geodetic(height=-10001.0)}),
    BadSetting("node_spacing_meters", {"node_spacing_meters": 0.0}),
    BadSetting("node_spacing_meters", {"node_spacing_meters": NAN},
               "NOT_FINITE"),
    BadSetting("node_spacing_meters", {"sequence_length_meters": 1001.0,
                                       "check_interval_meters": 1001.0,
                                       "node_spacing_meters": 1001.0}),
    BadSetting("sequence_length_meters", {"sequence_length_meters": 2001.0}),
    BadSetting("sequence_length_meters", {"sequence_length_meters": -150.0}),
    BadSetting("sequence_length_meters", {"sequence_length_meters": INF},
               "NOT_FINITE"),
    BadSetting("check_interval_meters", {"check_interval_meters": 1.0}),
    BadSetting("check_interval_meters", {"check_interval_meters": 100001.0}),
    BadSetting("max_step_meters", {"max_step_meters": 0.001}),
    BadSetting("max_step_meters", {"max_step_meters": 1.1e6}),
    BadSetting("max_step_meters", {"max_step_meters": 2001.0}),
    BadSetting("gate_probability", {"gate_probability": 0.0}),
    BadSetting("gate_probability", {"gate_probability": 1.0}),
    BadSetting("gate_probability", {"gate_probability": NAN}, "NOT_FINITE"),
    BadSetting("place_tolerance.position_meters", tolerance(position=-1.0)),
    BadSetting("place_tolerance.position_meters", tolerance(position=1001.0)),
    BadSetting("place_tolerance.heading_radians", tolerance(heading=3.1)),
    BadSetting("place_tolerance.heading_radians", tolerance(heading=NAN),
               "NOT_FINITE"),
    BadSetting("candidate_separation_meters",
               {"candidate_separation_meters": -1.0}),
    BadSetting("max_candidates", {"max_candidates": 0}),
    BadSetting("max_candidates", {"max_candidates": 101}),
    BadSetting("alignment", {"alignment": 3}),
    BadSetting("alignment", {"alignment": -1}),
    BadSetting("acceptance_probability", {"acceptance_probability": 0.0}),
    BadSetting("acceptance_probability", {"acceptance_probability": 1.0}),
    BadSetting("acceptance_probability", {"acceptance_probability": NAN},
               "NOT_FINITE"),
    BadSetting("road_spacing_meters", {"road_spacing_meters": 0.9}),
    BadSetting("road_spacing_meters", {"road_spacing_meters": 1.1e6}),
    BadSetting("road_spacing_meters", {"road_spacing_meters": INF},
               "NOT_FINITE"),
    BadSetting("shape_tolerance.position_meters", shape(position=0.009)),
    BadSetting("shape_tolerance.position_meters", shape(position=1001.0)),
    BadSetting("shape_tolerance.position_meters", shape(position=NAN),
               "NOT_FINITE"),
    BadSetting("shape_tolerance.heading_radians", shape(heading=0.0)),
    BadSetting("shape_tolerance.heading_radians", shape(heading=3.1)),
    BadSetting("shape_correlation_meters", {"shape_correlation_meters": 0.0}),
    BadSetting("shape_correlation_meters", {"shape_correlation_meters": 1.1e6}),
    BadSetting("shape_correlation_meters", {"shape_correlation_meters": NAN},
               "NOT_FINITE"),
    BadSetting("fix_correlation_meters", {"fix_correlation_meters": 0.5}),
    BadSetting("fix_correlation_meters", {"fix_correlation_meters": 1.1e6}),
    BadSetting("fix_correlation_meters", {"fix_correlation_meters": NAN},
               "NOT_FINITE"),
    BadSetting("max_inflation", {"max_inflation": 0.5}),
    BadSetting("max_inflation", {"max_inflation": 101.0}),
    BadSetting("max_inflation", {"max_inflation": INF}, "NOT_FINITE"),
]


@pytest.mark.parametrize("case", BAD_SETTINGS, ids=str)
def test_create_refuses_the_setting(case, stub):
    failure = failure_of(lambda: stub.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id="never",
        vehicle=api.Vehicle(settings=api.VehicleSettings(**case.settings)))))
    assert (failure.code, failure.reason) == (INVALID, case.reason)
    assert failure.fields == [f"vehicle.settings.{case.field}"]
    absent = failure_of(lambda: get(stub, "vehicles/never"))
    assert absent.code == grpc.StatusCode.NOT_FOUND


def test_default_that_does_not_go_with_what_is_given_is_called_one(stub):
    failure = failure_of(lambda: stub.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id="never", vehicle=api.Vehicle(
            settings=api.VehicleSettings(node_spacing_meters=0.05)))))
    assert failure.fields == ["vehicle.settings.sequence_length_meters"]
    assert ("got 150; allowed is [0.05, 50] (left out: its default)"
            in failure.message)


SEARCH_FIELDS = {"likelihood_form", "sequence_length_meters",
                 "gate_probability", "place_tolerance.position_meters",
                 "place_tolerance.heading_radians",
                 "candidate_separation_meters", "max_candidates", "alignment",
                 "acceptance_probability", "road_spacing_meters",
                 "shape_tolerance.position_meters",
                 "shape_tolerance.heading_radians", "shape_correlation_meters"}


@pytest.mark.parametrize(
    "case", [case for case in BAD_SETTINGS if case.field in SEARCH_FIELDS],
    ids=str)
def test_find_refuses_the_option(case, stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: stub.FindCandidates(api.FindCandidatesRequest(
        vehicle=vehicle, options=api.CandidateOptions(**case.settings))))
    assert (failure.code, failure.reason) == (INVALID, case.reason)
    assert failure.fields == [f"options.{case.field}"]


@pytest.mark.parametrize("direction", [4, -1])
def test_find_refuses_a_direction_that_is_none(
        direction, stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: stub.FindCandidates(api.FindCandidatesRequest(
        vehicle=vehicle, options=api.CandidateOptions(direction=direction))))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
    assert failure.fields == ["options.direction"]


@pytest.mark.parametrize("model", [api.CORRELATION_MODEL_FILTER, 17])
def test_find_refuses_a_model_the_vehicle_does_not_have(
        model, stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: stub.FindCandidates(api.FindCandidatesRequest(
        vehicle=vehicle,
        options=api.CandidateOptions(correlation_model=model))))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
    assert failure.fields == ["options.correlation_model"]


def update(stub, vehicle, paths, **settings):
    return stub.UpdateVehicle(api.UpdateVehicleRequest(
        vehicle=api.Vehicle(name=vehicle,
                            settings=api.VehicleSettings(**settings)),
        update_mask=mask(*paths))).vehicle


@pytest.mark.parametrize("paths", [
    [], ["name"], ["state"], ["settings.no_such"], ["max_candidates"],
    ["settings.max_candidates.x"], ["*"], [""], ["revision"],
], ids=repr)
def test_update_refuses_the_mask(paths, stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: update(stub, vehicle, paths,
                                        max_candidates=7))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
    assert failure.fields == [
        f"update_mask.paths[{len(paths) - 1}]" if paths else "update_mask"]


@pytest.mark.parametrize("field, value", [
    ("max_candidates", 0), ("node_spacing_meters", -2.0),
    # Out of range only together with the sequence length that stays.
    ("node_spacing_meters", 0.1),
    ("alignment", 9), ("acceptance_probability", 1.0),
    ("road_spacing_meters", 0.0), ("shape_correlation_meters", -1.0),
    ("max_inflation", 0.0), ("fix_correlation_meters", 0.0),
])
def test_update_refuses_the_setting(field, value, stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: update(stub, vehicle, [f"settings.{field}"],
                                        **{field: value}))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
    assert len(failure.fields) == 1
    assert failure.fields[0].startswith("vehicle.settings.")


@pytest.mark.parametrize("field, value", [
    ("state_space", api.STATE_SPACE_SPATIAL),
    ("coordinate_frame", api.COORDINATE_FRAME_GEODETIC),
    ("correlation_model", api.CORRELATION_MODEL_FILTER),
])
def test_update_refuses_what_is_fixed_once_there_are_poses(
        field, value, stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: update(stub, vehicle, [f"settings.{field}"],
                                        **{field: value}))
    assert failure.code == grpc.StatusCode.FAILED_PRECONDITION
    assert failure.reason == "SETTING_FIXED"
    assert field in failure.message


def test_create_refuses_a_name_that_is_taken_with_other_settings(
        stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: stub.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id=vehicle.split("/")[1],
        vehicle=api.Vehicle(settings=api.VehicleSettings(max_candidates=9)))))
    assert failure.code == grpc.StatusCode.ALREADY_EXISTS
    assert failure.reason == "VEHICLE_EXISTS"


# ---- Pages and masks


PAGED = {
    "ListGroups": lambda stub, vehicle, **fields: stub.ListGroups(
        api.ListGroupsRequest(**fields)),
    "ListVehicles": lambda stub, vehicle, **fields: stub.ListVehicles(
        api.ListVehiclesRequest(**fields)),
    "ListPoses": lambda stub, vehicle, **fields: stub.ListPoses(
        api.ListPosesRequest(parent=vehicle, **fields)),
    "ListRecordings": lambda stub, vehicle, **fields: stub.ListRecordings(
        api.ListRecordingsRequest(parent=vehicle, **fields)),
    "ListLoopClosures": LOOP_CLOSURES.page,
    "ListRejectedCandidates": REJECTED_CANDIDATES.page,
    "ListDeletedPosePairs": deletions_page,
}


@pytest.mark.parametrize("call", PAGED)
@pytest.mark.parametrize("token", ["x", "0", "AAAA", "-1", "é", "a" * 5000],
                         ids=lambda token: token[:10])
def test_page_token_must_be_one_of_ours(token, call, stub, filled):
    failure = failure_of(lambda: PAGED[call](stub, filled({}),
                                             page_token=token))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_PAGE_TOKEN")
    assert failure.fields == ["page_token"]


def test_page_token_is_good_for_its_own_vehicle_only(stub, filled):
    one, other = filled({}), filled({})
    page = stub.ListPoses(api.ListPosesRequest(parent=one, page_size=1))
    assert page.next_page_token
    failure = failure_of(lambda: stub.ListPoses(api.ListPosesRequest(
        parent=other, page_token=page.next_page_token)))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_PAGE_TOKEN")


@pytest.mark.parametrize("call", PAGED)
def test_page_size_must_not_be_negative(call, stub, filled):
    failure = failure_of(lambda: PAGED[call](stub, filled({}), page_size=-1))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
    assert failure.fields == ["page_size"]


@pytest.mark.parametrize("path", ["no_such", "local.no_such", "*",
                                  "covariance.values.x"])
def test_read_mask_must_name_fields_of_a_pose(path, stub, filled):
    failure = failure_of(lambda: list_poses(stub, filled({}),
                                            read_mask=mask("sequence", path)))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
    assert failure.fields == ["read_mask.paths[1]"]


# ---- Candidates, loop closures, revisions


def test_find_says_that_there_is_no_such_pose(stub, filled):
    failure = failure_of(lambda: stub.FindCandidates(
        api.FindCandidatesRequest(vehicle=filled({}), sequence=STORED + 1)))
    assert failure.code == grpc.StatusCode.NOT_FOUND
    assert failure.reason == "POSE_NOT_FOUND"


@pytest.mark.parametrize("kind", PAIR_KINDS, ids=str)
@pytest.mark.parametrize("query, matched, field", [
    (0, 1, "query_sequence"), (2, 0, "matched_sequence"),
    (2, 2, "matched_sequence"), (1, 2, "matched_sequence"),
])
def test_pair_must_be_of_a_pose_and_an_earlier_one(
        query, matched, field, kind, stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: kind.add(stub, vehicle, query, matched))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
    assert failure.fields == [f"{kind.field}.{field}"]


@pytest.mark.parametrize("kind", PAIR_KINDS, ids=str)
def test_pair_is_required(kind, stub, filled, unchanged):
    request = kind.request(unchanged(filled({})))
    request.ClearField(kind.field)
    failure = failure_of(lambda: kind.call_add(stub, request))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
    assert failure.fields == [kind.field]


@pytest.mark.parametrize("kind", PAIR_KINDS, ids=str)
def test_pair_must_be_of_stored_poses(kind, stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: kind.add(stub, vehicle, STORED + 1, 1))
    assert failure.code == grpc.StatusCode.NOT_FOUND
    assert failure.reason == "POSE_NOT_FOUND"
    assert failure.metadata["sequence"] == str(STORED + 1)


@pytest.mark.parametrize("kind", PAIR_KINDS, ids=str)
@pytest.mark.parametrize("bad", ["A", "../x", "a" * 64, "a\0"], ids=repr)
def test_id_of_a_pair_must_be_one(bad, kind, stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: kind.add(stub, vehicle, 2, 1, bad))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_RESOURCE_NAME")
    assert failure.fields == [f"{kind.field}_id"]


@pytest.mark.parametrize("kind", PAIR_KINDS, ids=str)
def test_there_is_no_such_pair_to_delete(kind, stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(lambda: kind.delete(
        stub, f"{vehicle}/{kind.collection}/none"))
    assert failure.code == grpc.StatusCode.NOT_FOUND
    assert failure.reason == f"{kind.reason}_NOT_FOUND"


@dataclasses.dataclass
class BadRevision:
    name: str
    # It takes the vehicle's name.
    requests: typing.Callable
    reason: str
    fields: list
    code: grpc.StatusCode = INVALID

    def __str__(self):
        return self.name


def revise(vehicle="", *poses, **fields):
    return api.RevisePosesRequest(vehicle=vehicle, poses=poses, **fields)


BAD_REVISIONS = [
    BadRevision("no message", lambda v: [], "INVALID_RESOURCE_NAME",
                ["vehicle"]),
    BadRevision("another vehicle in a later message",
                lambda v: [revise(v, pose(1)),
                           revise("vehicles/other", pose(2))],
                "INVALID_FIELD", ["vehicle"]),
    BadRevision("a revision in a later message",
                lambda v: [revise(v, pose(1)),
                           revise("", pose(2), expected_revision=1)],
                "INVALID_FIELD", ["expected_revision"]),
    BadRevision("a pose twice", lambda v: [revise(v, pose(1)),
                                           revise("", pose(2), pose(1))],
                "INVALID_FIELD", ["poses[2].sequence"]),
    BadRevision("sequence 0", lambda v: [revise(v, pose(1), pose(0))],
                "INVALID_FIELD", ["poses[1].sequence"]),
    BadRevision("a pose that is not stored",
                lambda v: [revise(v, pose(1), pose(STORED + 1))],
                "POSE_NOT_FOUND", [], grpc.StatusCode.NOT_FOUND),
    BadRevision("a bad number in the last message",
                lambda v: [revise(v, pose(1)), revise(v, pose(2)),
                           revise("", pose(3, x=NAN))],
                "NOT_FINITE", ["poses[2].local.x_meters"]),
    BadRevision("a covariance that is not positive definite",
                lambda v: [revise(v, pose(1, covariance=(0,) * 6))],
                "COVARIANCE_NOT_POSITIVE_DEFINITE",
                ["poses[0].covariance.values"]),
    BadRevision("another revision",
                lambda v: [revise(v, pose(1), expected_revision=10**6)],
                "REVISION_MISMATCH", [], grpc.StatusCode.ABORTED),
]


@pytest.mark.parametrize("case", BAD_REVISIONS, ids=str)
def test_revise_refuses(case, stub, filled, unchanged):
    vehicle = unchanged(filled({}))
    failure = failure_of(
        lambda: stub.RevisePoses(iter(case.requests(vehicle))))
    assert (failure.code, failure.reason) == (case.code, case.reason)
    assert failure.fields == case.fields


# ---- What every error has


def test_request_id_of_the_caller_comes_back_in_the_error(stub):
    failure = failure_of(lambda: stub.GetVehicle(
        api.GetVehicleRequest(name="vehicles/nobody"),
        metadata=[("x-request-id", "ticket 4711")]))
    assert failure.metadata["request_id"] == "ticket 4711"


@pytest.mark.parametrize("metadata", [[], [("x-request-id", "")],
                                      [("x-request-id", "a" * 129)]],
                         ids=["none", "empty", "too long"])
def test_request_id_is_made_if_the_caller_has_no_good_one(metadata, stub):
    first, second = (
        failure_of(lambda: stub.GetVehicle(
            api.GetVehicleRequest(name="vehicles/nobody"), metadata=metadata)
        ).metadata["request_id"] for _ in range(2))
    assert first != second
    assert "a" * 129 not in (first, second)


def test_request_id_comes_back_with_an_answer(stub):
    _, call = stub.GetServerInfo.with_call(
        api.GetServerInfoRequest(), metadata=[("x-request-id", "r-1")])
    assert ("x-request-id", "r-1") in list(call.initial_metadata())


NO_PROTOBUF = b"\x0a\xff\xff\xff\xff\x0f not a message"


METHODS = api.GetServerInfoRequest.DESCRIPTOR.file.services_by_name[
    "PoseGraphService"].methods


@pytest.mark.parametrize(
    "method", [method for method in METHODS if not method.client_streaming],
    ids=lambda method: method.name)
def test_malformed_protobuf_is_the_callers_fault(
        method, server, filled, unchanged):
    unchanged(filled({}))
    channel = server.channel()
    path = f"/revisit.v1.PoseGraphService/{method.name}"
    if method.server_streaming:
        stream = channel.unary_stream(path)
        failure = failure_of(lambda: list(stream(NO_PROTOBUF, timeout=20)))
    else:
        call = channel.unary_unary(path)
        failure = failure_of(lambda: call(NO_PROTOBUF, timeout=20))
    assert (failure.code, failure.reason) == (INVALID, "MALFORMED_MESSAGE")
    assert method.input_type.full_name in failure.message


@pytest.mark.parametrize("method", ["StreamPoses", "RevisePoses"])
@pytest.mark.parametrize("well", [0, 1], ids=["first", "second"])
def test_malformed_protobuf_on_a_stream_is_the_callers_fault(
        well, method, server, filled, unchanged):
    vehicle = unchanged(filled({}))
    good = {
        "StreamPoses": api.StreamPosesRequest(
            open=api.StreamPosesOpen(vehicle=vehicle)),
        "RevisePoses": api.RevisePosesRequest(
            vehicle=vehicle, poses=[pose(1, x=5.0)])}[method]
    call = server.channel().stream_stream(
        f"/revisit.v1.PoseGraphService/{method}",
        request_serializer=bytes, response_deserializer=bytes)
    messages = [good.SerializeToString()] * well + [NO_PROTOBUF]
    failure = failure_of(lambda: list(call(
        iter(messages), metadata=[("x-request-id", f"bad-{method}-{well}")])))
    assert (failure.code, failure.reason) == (INVALID, "STREAM_PROTOCOL")
    assert "not a valid protobuf" in failure.message
    assert server.is_running()
    # No operator is called to look at it.
    own = server.logged(f"bad-{method}-{well}")
    assert len(own) == 1
    assert "INVALID_ARGUMENT" in own[0]
    assert "error" not in own[0].lower().split("message")[0]


def test_unknown_method_is_told(server):
    call = server.channel().unary_unary(
        "/revisit.v1.PoseGraphService/NoSuchMethod",
        request_serializer=bytes, response_deserializer=bytes)
    with pytest.raises(grpc.RpcError) as raised:
        call(b"")
    assert raised.value.code() == grpc.StatusCode.UNIMPLEMENTED
