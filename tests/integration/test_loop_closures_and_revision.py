"""What a caller does with a graph: loop closures, rejected candidates, revised
poses, pages, exports, changed settings, geodetic positions."""

import math
import random
import threading

import grpc
import pytest
from google.protobuf import field_mask_pb2

from revisit_server import Server
from stubs import api
from wire import (LOOP_CLOSURES, PAIR_KINDS, REJECTED_CANDIDATES, append,
                  as_bytes, batches, failure_of, get, laps, list_poses, pose,
                  straight)


def export(stub, vehicle):
    """(vehicle, nodes, edges), after checking how the parts come."""
    parts = list(stub.ExportPoseGraph(
        api.ExportPoseGraphRequest(vehicle=vehicle)))
    assert parts[0].HasField("vehicle")
    assert not any(part.HasField("vehicle") for part in parts[1:])
    nodes = [node for part in parts for node in part.nodes]
    edges = [edge for part in parts for edge in part.edges]
    first_edges = next((i for i, part in enumerate(parts) if part.edges),
                       len(parts))
    assert not any(part.nodes for part in parts[first_edges + 1:])
    return parts[0].vehicle, nodes, edges


@pytest.fixture
def driven(stub, new_vehicle):
    """A vehicle that has driven 100 m, a pose and a node each metre."""
    def make(**settings):
        vehicle = new_vehicle(**{
            "node_spacing_meters": 1.0, "sequence_length_meters": 20.0,
            "check_interval_meters": 10.0, **settings})
        append(stub, vehicle, straight(101))
        return vehicle
    return make


# ---- Vehicles


def test_created_vehicle_shows_every_setting(stub, new_vehicle):
    settings = get(stub, new_vehicle()).settings
    assert settings == api.VehicleSettings(
        state_space=api.STATE_SPACE_PLANAR,
        correlation_model=api.CORRELATION_MODEL_DEAD_RECKONING,
        likelihood_form=api.LIKELIHOOD_FORM_GAUSSIAN,
        coordinate_frame=api.COORDINATE_FRAME_LOCAL,
        node_spacing_meters=2.0, sequence_length_meters=150.0,
        check_interval_meters=50.0, max_step_meters=100.0,
        gate_probability=0.95,
        place_tolerance=api.PlaceTolerance(position_meters=2.0,
                                           heading_radians=0.1),
        candidate_separation_meters=10.0, max_candidates=5,
        alignment=api.ALIGNMENT_RELATIVE, acceptance_probability=0.45,
        road_spacing_meters=200.0,
        shape_tolerance=api.PlaceTolerance(position_meters=1.0,
                                           heading_radians=0.06),
        shape_correlation_meters=20.0, apply_inflation=False,
        max_inflation=10.0, use_belief=True,
        fix_correlation_meters=300.0,
        checks=api.STORED_CHECKS_ON_REQUEST, keep_probability=0.05)
    # There, not only equal to nothing.
    for field in ("acceptance_probability", "road_spacing_meters",
                  "shape_correlation_meters", "apply_inflation",
                  "max_inflation", "use_belief",
                  "fix_correlation_meters"):
        assert settings.HasField(field)


OTHER_SETTINGS = {
    "alignment": api.ALIGNMENT_COMPOSITE, "acceptance_probability": 0.75,
    "road_spacing_meters": 80.0,
    "shape_tolerance": api.PlaceTolerance(position_meters=0.5,
                                          heading_radians=0.03),
    "shape_correlation_meters": 25.0, "apply_inflation": True,
    "max_inflation": 4.0, "use_belief": False,
    "correlation_model": api.CORRELATION_MODEL_CORRELATED_FIXES,
    "fix_correlation_meters": 75.0}


def test_settings_of_the_search_are_kept_as_they_were_given(stub, new_vehicle):
    settings = get(stub, new_vehicle(**OTHER_SETTINGS)).settings
    for field, value in OTHER_SETTINGS.items():
        assert getattr(settings, field) == value, field


def test_settings_of_the_search_change_without_a_new_graph(stub, driven):
    vehicle = driven()
    before = get(stub, vehicle)
    graph = as_bytes(export(stub, vehicle)[1])
    for field, value in OTHER_SETTINGS.items():
        if field == "correlation_model":
            continue
        after = update(stub, vehicle, field, **{field: value})
        assert getattr(after.settings, field) == value, field
        assert after.node_count == before.node_count
    assert as_bytes(export(stub, vehicle)[1]) == graph
    # Other models take claims as they are.
    after = update(stub, vehicle, "correlation_model",
                   correlation_model=OTHER_SETTINGS["correlation_model"])
    assert after.node_count == before.node_count
    assert after.consistency.applied
    for node in export(stub, vehicle)[1]:
        assert list(node.covariance.values) == pytest.approx(
            [0.01, 0, 0, 0.01, 0, 1e-4])
    # Named but left out: the default.
    after = update(stub, vehicle, *OTHER_SETTINGS)
    assert after.settings == before.settings


def test_creating_again_with_the_same_settings_answers_the_existing_one(
        stub, driven):
    vehicle = driven()
    request = api.CreateVehicleRequest(
        vehicle_id=vehicle.split("/")[1],
        vehicle=api.Vehicle(settings=get(stub, vehicle).settings))
    assert stub.CreateVehicle(request).vehicle == get(stub, vehicle)
    # Defaults may be left out.
    request.vehicle.settings.ClearField("max_candidates")
    assert stub.CreateVehicle(request).vehicle.durable_sequence == 101


def test_vehicles_are_listed_by_name_page_by_page(tmp_path):
    with Server(tmp_path / "store") as server:
        stub = server.stub()
        names = [f"v{n:03}" for n in range(25)]
        for name in random.Random(1).sample(names, len(names)):
            stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id=name))
        listed, token, pages = [], "", 0
        while True:
            page = stub.ListVehicles(api.ListVehiclesRequest(
                page_size=10, page_token=token))
            listed += [vehicle.name for vehicle in page.vehicles]
            pages += 1
            token = page.next_page_token
            if not token:
                break
            # What comes or goes meanwhile does not make others appear twice.
            stub.CreateVehicle(api.CreateVehicleRequest(
                vehicle_id=f"a-late-{pages}"))
            if pages == 1:
                stub.DeleteVehicle(api.DeleteVehicleRequest(
                    name="vehicles/v003"))
        assert listed == [f"vehicles/{name}" for name in names]
        assert pages == 3


def test_deleted_vehicle_is_gone_with_all_it_had(stub, driven):
    vehicle = driven()
    for n, kind in enumerate(PAIR_KINDS):
        kind.add(stub, vehicle, 90 + n, 10, "a")
    stub.DeleteVehicle(api.DeleteVehicleRequest(name=vehicle))
    for call in (lambda: get(stub, vehicle),
                 lambda: list_poses(stub, vehicle),
                 lambda: append(stub, vehicle, straight(1)),
                 lambda: LOOP_CLOSURES.page(stub, vehicle),
                 lambda: REJECTED_CANDIDATES.page(stub, vehicle)):
        assert failure_of(call).reason == "VEHICLE_NOT_FOUND"
    made = stub.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id=vehicle.split("/")[1])).vehicle
    assert made.durable_sequence == made.loop_closure_count == 0
    assert made.consistency.rejected_count == 0
    assert list_poses(stub, vehicle) == []
    for kind in PAIR_KINDS:
        assert kind.page(stub, vehicle) == ([], "")


def update(stub, vehicle, *paths, **settings):
    return stub.UpdateVehicle(api.UpdateVehicleRequest(
        vehicle=api.Vehicle(name=vehicle,
                            settings=api.VehicleSettings(**settings)),
        update_mask=field_mask_pb2.FieldMask(
            paths=[f"settings.{path}" for path in paths]))).vehicle


def test_update_changes_what_the_mask_names_and_nothing_else(stub, driven):
    vehicle = driven()
    before = get(stub, vehicle)
    after = update(stub, vehicle, "max_candidates", max_candidates=7,
                   gate_probability=0.5)
    expected = api.VehicleSettings()
    expected.CopyFrom(before.settings)
    expected.max_candidates = 7
    assert after.settings == expected
    assert after.revision > before.revision
    assert get(stub, vehicle) == after
    # Named but left out: the default.
    assert update(stub, vehicle,
                  "max_candidates").settings.max_candidates == 5


def test_update_of_the_node_spacing_rebuilds_the_graph(stub, driven):
    vehicle = driven()
    assert get(stub, vehicle).node_count == 101
    LOOP_CLOSURES.add(stub, vehicle, 91, 11, "a")
    after = update(stub, vehicle, "node_spacing_meters",
                   node_spacing_meters=4.0)
    assert after.node_count == 26
    _, nodes, edges = export(stub, vehicle)
    assert [node.travelled_meters for node in nodes] == pytest.approx(
        [4.0 * i for i in range(26)])
    # Sequence 91 lies at 90 m, 11 at 10 m: nearest nodes 22 or 23, 2 or 3.
    loops = [edge for edge in edges
             if edge.kind == api.EDGE_KIND_LOOP_CLOSURE]
    assert len(loops) == 1
    assert loops[0].from_index in (2, 3) and loops[0].to_index in (22, 23)
    # The same graph as if it had been so from the start.
    fresh = driven(node_spacing_meters=4.0)
    assert as_bytes(export(stub, fresh)[1]) == as_bytes(nodes)


# ---- Loop closures and rejected candidates


@pytest.mark.parametrize("kind", PAIR_KINDS, ids=str)
def test_pair_is_answered_as_it_is_stored(kind, stub, driven):
    vehicle = driven()
    before = get(stub, vehicle)
    added, revision = kind.add(stub, vehicle, 91, 11, "first")
    assert added.name == f"{vehicle}/{kind.collection}/first"
    assert added.query_sequence == 91
    assert added.matched_sequence == 11
    assert added.create_time.seconds > 1_600_000_000
    assert revision > before.revision
    after = get(stub, vehicle)
    assert after.revision == revision
    assert kind.count(after) == 1
    assert kind.page(stub, vehicle) == ([added], "")


def test_loop_closure_becomes_an_edge_of_the_graph(stub, driven):
    vehicle = driven()
    LOOP_CLOSURES.add(stub, vehicle, 91, 11)
    _, _, edges = export(stub, vehicle)
    assert [(edge.from_index, edge.to_index) for edge in edges
            if edge.kind == api.EDGE_KIND_LOOP_CLOSURE] == [(10, 90)]


def test_rejected_candidate_leaves_the_graph_as_it_is(stub, driven):
    vehicle = driven()
    before = export(stub, vehicle)
    REJECTED_CANDIDATES.add(stub, vehicle, 91, 11)
    after = export(stub, vehicle)
    assert (as_bytes(after[1]), as_bytes(after[2])) == (
        as_bytes(before[1]), as_bytes(before[2]))
    assert after[0].loop_closure_count == 0


@pytest.mark.parametrize("kind", PAIR_KINDS, ids=str)
def test_adding_a_pair_again_answers_the_existing_one(kind, stub, driven):
    vehicle = driven()
    first = kind.add(stub, vehicle, 91, 11, "same")
    assert kind.add(stub, vehicle, 91, 11, "same") == first
    failure = failure_of(lambda: kind.add(stub, vehicle, 92, 11, "same"))
    assert failure.code == grpc.StatusCode.ALREADY_EXISTS
    assert failure.reason == f"{kind.reason}_EXISTS"
    assert failure.message == (
        f"{kind.field.replace('_', ' ')} 'same' names sequences 91 and 11, got "
        "92 and 11")
    assert kind.count(get(stub, vehicle)) == 1


@pytest.mark.parametrize("kind", PAIR_KINDS, ids=str)
def test_pair_without_an_id_is_named_after_its_poses(kind, stub, driven):
    vehicle = driven()
    first = kind.add(stub, vehicle, 91, 11)
    assert first[0].name == f"{vehicle}/{kind.collection}/91-11"
    assert kind.add(stub, vehicle, 91, 11) == first
    other = kind.add(stub, vehicle, 92, 11)
    assert other[0].name != first[0].name
    assert kind.count(get(stub, vehicle)) == 2


def test_kinds_of_pairs_do_not_get_in_each_others_way(stub, driven):
    vehicle = driven()
    closure, _ = LOOP_CLOSURES.add(stub, vehicle, 91, 11, "same")
    rejected, _ = REJECTED_CANDIDATES.add(stub, vehicle, 92, 12, "same")
    LOOP_CLOSURES.delete(stub, closure.name)
    assert LOOP_CLOSURES.page(stub, vehicle) == ([], "")
    assert REJECTED_CANDIDATES.page(stub, vehicle) == ([rejected], "")


@pytest.mark.parametrize("kind", PAIR_KINDS, ids=str)
def test_pairs_are_listed_page_by_page(kind, stub, driven):
    vehicle = driven()
    ids = [f"c{n:02}" for n in range(23)]
    for n, name in enumerate(ids):
        kind.add(stub, vehicle, 50 + n, 1 + n, name)
    listed, token = [], ""
    while True:
        pairs, token = kind.page(stub, vehicle, page_size=10, page_token=token)
        assert len(pairs) <= 10
        listed += [pair.name for pair in pairs]
        if not token:
            break
    assert listed == [f"{vehicle}/{kind.collection}/{name}" for name in ids]


def test_page_token_is_good_for_its_own_kind_only(stub, driven):
    vehicle = driven()
    for n, kind in enumerate(PAIR_KINDS):
        for query in (90, 91):
            kind.add(stub, vehicle, query, 1 + n)
    _, token = LOOP_CLOSURES.page(stub, vehicle, page_size=1)
    failure = failure_of(lambda: REJECTED_CANDIDATES.page(
        stub, vehicle, page_token=token))
    assert failure.reason == "INVALID_PAGE_TOKEN"


@pytest.mark.parametrize("kind", PAIR_KINDS, ids=str)
def test_deleted_pair_takes_all_it_did_along(kind, stub, driven):
    vehicle = driven()
    before = as_bytes(export(stub, vehicle)[2])
    name = kind.add(stub, vehicle, 91, 11)[0].name
    revision = get(stub, vehicle).revision
    assert kind.delete(stub, name) > revision
    assert kind.count(get(stub, vehicle)) == 0
    assert as_bytes(export(stub, vehicle)[2]) == before
    failure = failure_of(lambda: kind.delete(stub, name))
    assert failure.reason == f"{kind.reason}_NOT_FOUND"


def find(stub, vehicle, **options):
    return stub.FindCandidates(api.FindCandidatesRequest(
        vehicle=vehicle, options=api.CandidateOptions(**options))).candidates


@pytest.mark.parametrize("alignment", [api.ALIGNMENT_RELATIVE,
                                       api.ALIGNMENT_COMPOSITE],
                         ids=api.Alignment.Name)
def test_rejected_candidate_is_not_offered_again(alignment, stub, new_vehicle):
    # Three laps, each exactly over the last, so there are two places to offer.
    vehicle = new_vehicle(alignment=alignment, sequence_length_meters=40.0,
                          check_interval_meters=20.0)
    append(stub, vehicle, laps(1100))
    before = find(stub, vehicle)
    assert before.candidates
    best = before.candidates[0]
    rejected, _ = REJECTED_CANDIDATES.add(
        stub, vehicle, best.query.sequence, best.matched.sequence)

    def near(candidate):
        # Candidates are 10 m apart; a pose stands for a node within 2 m of it.
        return abs(candidate.matched.travelled_meters
                   - best.matched.travelled_meters) < 7.0
    after = find(stub, vehicle)
    assert after.revision > before.revision
    assert not any(map(near, after.candidates))
    REJECTED_CANDIDATES.delete(stub, rejected.name)
    assert any(map(near, find(stub, vehicle).candidates))


@pytest.mark.parametrize("alignment", [api.ALIGNMENT_RELATIVE,
                                       api.ALIGNMENT_COMPOSITE],
                         ids=api.Alignment.Name)
def test_candidates_say_what_their_alignment_knows(
        alignment, stub, new_vehicle):
    vehicle = new_vehicle(sequence_length_meters=40.0,
                          check_interval_meters=20.0)
    append(stub, vehicle, laps(760))
    answer = find(stub, vehicle, alignment=alignment,
                  candidate_separation_meters=25.0)
    relative = alignment == api.ALIGNMENT_RELATIVE
    assert answer.HasField("new_place_probability") == relative
    assert answer.candidates
    for candidate in answer.candidates:
        assert candidate.verdict != api.VERDICT_UNSPECIFIED
        assert candidate.direction == api.DIRECTION_SAME
        assert relative or candidate.gate.inflation == 1.0
        for field in ("probability", "path_gate", "shape", "place_interval"):
            assert candidate.HasField(field) == relative, field
        # Two passes of one place may each be almost certain.
        assert 0.0 <= candidate.probability \
            <= 1.0 - answer.new_place_probability + 1e-9
    assert answer.HasField("scale_estimate") == relative
    if relative:
        assert 0.0 <= answer.new_place_probability <= 1.0
        best = answer.candidates[0]
        assert 0.0 <= best.shape.overlap_meters <= 80.0
        assert best.shape.log_likelihood_ratio >= 0.0
        assert best.path_gate.degrees_of_freedom >= 3.0
    else:
        assert not answer.candidates[0].HasField("odds_to_runner_up")


def test_consistency_counts_what_was_verified(stub, new_vehicle):
    vehicle = new_vehicle(
        correlation_model=api.CORRELATION_MODEL_INDEPENDENT,
        sequence_length_meters=40.0, check_interval_meters=20.0,
        max_inflation=3.0)
    append(stub, vehicle, laps(760))
    before = get(stub, vehicle).consistency
    assert (before.confirmed_count, before.rejected_count) == (0, 0)
    assert not before.HasField("mean_normalized_innovation_squared")
    assert before.degrees_of_freedom == 3
    # What the prior takes filters for.
    assert 1.0 < before.inflation < 3.0
    assert not before.applied
    best = find(stub, vehicle).candidates[0]
    LOOP_CLOSURES.add(stub, vehicle, best.query.sequence,
                      best.matched.sequence)
    REJECTED_CANDIDATES.add(stub, vehicle, 700, 100)
    after = get(stub, vehicle).consistency
    assert (after.confirmed_count, after.rejected_count) == (1, 1)
    assert after.HasField("mean_normalized_innovation_squared")
    assert after.mean_normalized_innovation_squared >= 0.0
    assert 1.0 <= after.inflation <= 3.0


# ---- Revised poses


def revise(stub, vehicle, *messages, **first):
    requests = [api.RevisePosesRequest(poses=poses) for poses in messages]
    requests[0].vehicle = vehicle
    for name, value in first.items():
        setattr(requests[0], name, value)
    return stub.RevisePoses(iter(requests))


def bent(first, count):
    """The straight drive, bent to the left by an optimiser."""
    return [pose(n, x=float(n), y=0.001 * n * n, heading=0.002 * n,
                 covariance=(0.02, 0.001, 0, 0.03, 0, 2e-4))
            for n in range(first, first + count)]


def test_revised_poses_replace_the_old_ones_under_one_revision(stub, driven):
    vehicle = driven()
    before = get(stub, vehicle)
    answer = revise(stub, vehicle, bent(1, 50), bent(51, 51))
    assert answer.revised_count == 101
    assert answer.revision > before.revision
    assert get(stub, vehicle).revision == answer.revision
    assert as_bytes(list_poses(stub, vehicle)) == as_bytes(bent(1, 101))
    _, nodes, _ = export(stub, vehicle)
    for node in nodes:
        # Within what lies between two poses.
        assert node.pose.y_meters == pytest.approx(
            0.001 * node.pose.x_meters ** 2, abs=0.01)


def as_sent(stub, vehicle, **fields):
    return list_poses(stub, vehicle, view=api.POSE_VIEW_AS_SENT, **fields)


def test_poses_are_had_as_they_were_sent_however_often_they_are_revised(
        stub, driven):
    vehicle = driven()
    for moved in (bent(1, 101), bent(31, 20)):
        revise(stub, vehicle, moved)
        assert as_bytes(as_sent(stub, vehicle)) == as_bytes(straight(101))
    # Poses that come later are in both views as they are sent.
    append(stub, vehicle, straight(10, first=102))
    assert as_bytes(as_sent(stub, vehicle)) == as_bytes(straight(111))
    assert (as_bytes(list_poses(stub, vehicle, first_sequence=100))
            == as_bytes(bent(100, 2) + straight(10, first=102)))
    assert (as_bytes(list_poses(stub, vehicle, view=api.POSE_VIEW_CURRENT))
            == as_bytes(list_poses(stub, vehicle)))


def test_page_token_is_good_for_its_own_view_only(stub, driven):
    vehicle = driven()
    revise(stub, vehicle, bent(1, 101))
    page = stub.ListPoses(api.ListPosesRequest(
        parent=vehicle, page_size=50, view=api.POSE_VIEW_AS_SENT))
    failure = failure_of(lambda: stub.ListPoses(api.ListPosesRequest(
        parent=vehicle, page_token=page.next_page_token)))
    assert failure.reason == "INVALID_PAGE_TOKEN"
    rest = as_sent(stub, vehicle, page_token=page.next_page_token)
    assert as_bytes(list(page.poses) + rest) == as_bytes(straight(101))


def test_unknown_view_is_refused(stub, driven):
    vehicle = driven()
    failure = failure_of(
        lambda: stub.ListPoses(api.ListPosesRequest(parent=vehicle, view=7)))
    assert failure.code == grpc.StatusCode.INVALID_ARGUMENT
    assert failure.fields == ["view"]


def graph_of(stub, vehicle, view):
    parts = list(stub.ExportPoseGraph(api.ExportPoseGraphRequest(
        vehicle=vehicle, view=view)))
    return ([node for part in parts for node in part.nodes],
            [edge for part in parts for edge in part.edges])


def test_the_graph_is_had_as_it_was_sent_however_often_poses_are_revised(
        stub, driven):
    vehicle = driven()
    stub.AddLoopClosure(api.AddLoopClosureRequest(
        parent=vehicle, loop_closure=api.LoopClosure(
            query_sequence=90, matched_sequence=10)))
    before = graph_of(stub, vehicle, api.POSE_VIEW_CURRENT)
    as_it_was = [as_bytes(part) for part in before]
    assert any(edge.kind == api.EDGE_KIND_LOOP_CLOSURE for edge in before[1])
    for moved in (bent(1, 101), bent(31, 20)):
        revise(stub, vehicle, moved)
        assert [as_bytes(part) for part in graph_of(
            stub, vehicle, api.POSE_VIEW_AS_SENT)] == as_it_was
        assert as_bytes(graph_of(
            stub, vehicle, api.POSE_VIEW_CURRENT)[0]) != as_it_was[0]
    # Poses that come later are in it too.
    append(stub, vehicle, straight(10, first=102))
    assert len(graph_of(stub, vehicle, api.POSE_VIEW_AS_SENT)[0]) > len(before[0])


def test_a_graph_as_sent_of_a_vehicle_without_poses_is_empty(stub, new_vehicle):
    assert graph_of(stub, new_vehicle(), api.POSE_VIEW_AS_SENT) == ([], [])


def test_unknown_view_of_a_graph_is_refused(stub, driven):
    failure = failure_of(lambda: graph_of(stub, driven(), 7))
    assert failure.code == grpc.StatusCode.INVALID_ARGUMENT
    assert failure.fields == ["view"]


def test_poses_that_outrun_the_covariances_they_keep_are_warned_of(stub, driven):
    vehicle = driven()

    def revised(poses):
        return stub.RevisePoses(iter([api.RevisePosesRequest(
            vehicle=vehicle, poses=poses)])).warnings

    moved = straight(101)
    for p in moved[50:]:
        p.local.y_meters += 0.2  # Two standard deviations.
    assert not revised(moved)
    for p in moved[50:]:
        p.local.y_meters += 5.0 + 0.01 * p.sequence
    warnings = revised(moved)
    assert [w.reason for w in warnings] == [api.WARNING_REASON_COVARIANCES_KEPT]
    assert warnings[0].metadata["poses"] == "51"
    assert warnings[0].metadata["sequence"] == "101"
    assert float(warnings[0].metadata["meters"]) == pytest.approx(6.01)
    assert "51 of 51 poses have moved farther" in warnings[0].message
    # With covariances of their own they say what they claim.
    for p in moved:
        p.local.y_meters += 5.0
        p.covariance.values[0] = p.covariance.values[3] = 25.0
    assert not revised(moved)


def test_poses_not_named_keep_what_they_have(stub, driven):
    vehicle = driven()
    expected = straight(101)
    expected[41:43] = bent(42, 2)
    assert revise(stub, vehicle, bent(42, 2)).revised_count == 2
    assert as_bytes(list_poses(stub, vehicle)) == as_bytes(expected)


def test_poses_may_be_revised_in_any_order(stub, driven):
    vehicle = driven()
    shuffled = bent(1, 101)
    random.Random(7).shuffle(shuffled)
    revise(stub, vehicle, shuffled[:30], shuffled[30:])
    assert as_bytes(list_poses(stub, vehicle)) == as_bytes(bent(1, 101))


def test_one_bad_pose_and_nothing_changes(stub, driven):
    vehicle = driven()
    before = (get(stub, vehicle), as_bytes(list_poses(stub, vehicle)),
              as_bytes(export(stub, vehicle)[1]))
    bad = bent(101, 1)
    bad[0].covariance.values[0] = -1.0
    failure = failure_of(lambda: revise(stub, vehicle, bent(1, 100), bad))
    assert failure.reason == "COVARIANCE_NOT_POSITIVE_DEFINITE"
    assert failure.fields == ["poses[100].covariance.values"]
    assert before == (get(stub, vehicle), as_bytes(list_poses(stub, vehicle)),
                      as_bytes(export(stub, vehicle)[1]))


def test_revision_that_is_not_the_expected_one_aborts(stub, driven):
    vehicle = driven()
    expected = get(stub, vehicle).revision
    revise(stub, vehicle, bent(1, 10), expected_revision=expected)
    before = as_bytes(list_poses(stub, vehicle))
    failure = failure_of(lambda: revise(
        stub, vehicle, bent(1, 101), expected_revision=expected))
    assert failure.code == grpc.StatusCode.ABORTED
    assert failure.reason == "REVISION_MISMATCH"
    assert failure.metadata["revision"] == str(get(stub, vehicle).revision)
    assert as_bytes(list_poses(stub, vehicle)) == before


@pytest.mark.parametrize("off, reason", [
    (-1, "POSE_NOT_FOUND"), (0, "POSE_NOT_FOUND"), (1, "REVISION_MISMATCH")])
def test_revision_of_a_pose_that_is_not_there_says_so_unless_it_is_ahead(
        off, reason, stub, driven):
    vehicle = driven()
    revise(stub, vehicle, bent(1, 10))
    expected = get(stub, vehicle).revision + off
    before = as_bytes(list_poses(stub, vehicle))
    failure = failure_of(lambda: revise(
        stub, vehicle, bent(101, 2), expected_revision=expected))
    assert failure.reason == reason
    assert as_bytes(list_poses(stub, vehicle)) == before


# Whoever did not get the answer could not tell it from a conflict.
def test_revision_whose_answer_got_lost_is_answered_again(stub, driven):
    vehicle = driven()
    append(stub, vehicle, straight(20, first=102))
    expected = get(stub, vehicle).revision
    answer = revise(stub, vehicle, bent(90, 20), expected_revision=expected)
    assert answer.revision == expected + 1
    for _ in range(2):
        again = revise(stub, vehicle, bent(90, 20), expected_revision=expected)
        assert again == answer
        # Also when other things have happened since.
        LOOP_CLOSURES.add(stub, vehicle, 99, 2)
    # Another change from the same revision is a conflict, and so is this one
    # once another came on top of it.
    for poses in (bent(90, 19) + straight(1, first=109), bent(90, 20)):
        failure = failure_of(lambda poses=poses: revise(
            stub, vehicle, poses, expected_revision=expected))
        assert failure.reason == "REVISION_MISMATCH"
        revise(stub, vehicle, straight(1, first=95))


# ListPoses read the store, all else the memory, which is behind while the graph
# is rebuilt.
def test_reads_of_all_methods_go_forward_only(stub, new_vehicle):
    vehicle = new_vehicle()
    for part in batches(straight(20000), 1000):
        append(stub, vehicle, part)
    base = get(stub, vehicle).revision
    done = threading.Event()

    def revise_often():
        for number in range(1, 9):
            moved = straight(1)[0]
            moved.local.y_meters = number / 100
            revise(stub, vehicle, [moved])
        done.set()

    reviser = threading.Thread(target=revise_often)
    reviser.start()
    seen = 0
    while not done.is_set():
        first = stub.ListPoses(api.ListPosesRequest(
            parent=vehicle, page_size=1)).poses[0]
        seen = max(seen, round(first.local.y_meters * 100))
        assert get(stub, vehicle).revision >= base + seen
    reviser.join()
    assert get(stub, vehicle).revision == base + 8


def test_resent_pose_is_compared_with_what_was_first_sent(stub, driven):
    vehicle = driven()
    revise(stub, vehicle, bent(1, 101))
    assert append(stub, vehicle, straight(101)).durable_sequence == 101
    assert as_bytes(list_poses(stub, vehicle)) == as_bytes(bent(1, 101))
    failure = failure_of(lambda: append(stub, vehicle, bent(50, 1)))
    assert failure.reason == "SEQUENCE_CONTENT_MISMATCH"


def test_stamps_stay_as_they_were_sent(stub, new_vehicle):
    vehicle = new_vehicle()
    stamped = pose(1)
    stamped.stamp.seconds = 1234
    append(stub, vehicle, [stamped])
    moved = pose(1, x=5.0)
    moved.stamp.seconds = 9999
    revise(stub, vehicle, [moved])
    stored = list_poses(stub, vehicle)[0]
    assert (stored.stamp.seconds, stored.local.x_meters) == (1234, 5.0)


def test_poses_appended_after_a_revision_go_on_from_it(stub, driven):
    vehicle = driven()
    revise(stub, vehicle, bent(1, 101))
    append(stub, vehicle, bent(102, 20))
    assert as_bytes(list_poses(stub, vehicle)) == as_bytes(bent(1, 121))
    fresh = driven()
    stub.DeleteVehicle(api.DeleteVehicleRequest(name=fresh))
    stub.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id=fresh.split("/")[1],
        vehicle=api.Vehicle(settings=get(stub, vehicle).settings)))
    append(stub, fresh, bent(1, 121))
    assert (as_bytes(export(stub, fresh)[1])
            == as_bytes(export(stub, vehicle)[1]))


def test_revision_closes_the_loop_for_the_search(stub, new_vehicle):
    # Two laps of a circle that drift: 25 m to the side on the second, with a
    # covariance that will not have it.
    vehicle = new_vehicle(alignment=api.ALIGNMENT_COMPOSITE,
                          sequence_length_meters=40.0,
                          check_interval_meters=20.0)
    true = laps(760)
    drifted = laps(760)
    for n, one in enumerate(drifted):
        one.local.x_meters += 25.0 * n / 760
    append(stub, vehicle, drifted)

    def best():
        return stub.FindCandidates(api.FindCandidatesRequest(
            vehicle=vehicle)).candidates.candidates[0]
    assert best().gate.verdict == api.GATE_VERDICT_REJECTED
    revise(stub, vehicle, true)
    assert best().gate.verdict == api.GATE_VERDICT_ACCEPTED


def test_revision_grows_with_every_change_and_over_restarts(tmp_path):
    store = tmp_path / "store"
    vehicle = "vehicles/a"
    seen = []

    def note(stub):
        seen.append(get(stub, vehicle).revision)

    for round_number in range(3):
        with Server(store) as server:
            stub = server.stub()
            if seen:
                # Nothing has happened: not even a restart counts.
                assert get(stub, vehicle).revision == seen[-1]
            else:
                stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id="a"))
            first = 10 * round_number + 1
            append(stub, vehicle, straight(10, first=first))
            note(stub)
            revise(stub, vehicle, bent(first, 5))
            note(stub)
            for kind in PAIR_KINDS:
                name = kind.add(stub, vehicle, first + 8, first)[0].name
                note(stub)
                kind.delete(stub, name)
                note(stub)
            update(stub, vehicle, "max_candidates",
                   max_candidates=10 + round_number)
            note(stub)
            if round_number == 1:
                server.kill()
    assert seen == sorted(set(seen))
    assert len(seen) == 21


# ---- Lists and exports


def test_poses_are_listed_page_by_page(stub, new_vehicle):
    vehicle = new_vehicle()
    poses = straight(57)
    # Stored in batches that no page agrees with.
    for first, last in ((0, 5), (5, 6), (6, 40), (40, 57)):
        append(stub, vehicle, poses[first:last])
    for page_size in (1, 7, 57, 100):
        listed, token = [], ""
        while True:
            page = stub.ListPoses(api.ListPosesRequest(
                parent=vehicle, page_size=page_size, page_token=token))
            assert len(page.poses) <= page_size
            listed.extend(page.poses)
            token = page.next_page_token
            if not token:
                break
        assert as_bytes(listed) == as_bytes(poses)


def test_list_begins_where_it_is_told(stub, new_vehicle):
    vehicle = new_vehicle()
    append(stub, vehicle, straight(20))
    assert [one.sequence for one in list_poses(
        stub, vehicle, first_sequence=15)] == list(range(15, 21))
    assert list_poses(stub, vehicle, first_sequence=21) == []


def test_read_mask_leaves_out_what_it_does_not_name(stub, new_vehicle):
    vehicle = new_vehicle()
    append(stub, vehicle, straight(3))
    listed = list_poses(stub, vehicle, read_mask=field_mask_pb2.FieldMask(
        paths=["sequence", "local.x_meters", "covariance.form"]))
    assert as_bytes(listed) == as_bytes(
        api.Pose(sequence=n, local=api.LocalPosition(x_meters=n),
                 covariance=api.Covariance(
                     form=api.COVARIANCE_FORM_PLANAR_6))
        for n in (1, 2, 3))


def test_export_holds_the_whole_graph(stub, driven):
    vehicle = driven()
    LOOP_CLOSURES.add(stub, vehicle, 91, 11)
    exported, nodes, edges = export(stub, vehicle)
    assert exported == get(stub, vehicle)
    assert [node.index for node in nodes] == list(range(101))
    for node in nodes:
        assert node.travelled_meters == pytest.approx(node.index, abs=1e-9)
        # The pose of sequence n lies at x = n and is n - 1 metres along.
        assert node.pose.x_meters == pytest.approx(1.0 + node.index)
        assert (node.sequence + node.fraction
                == pytest.approx(1.0 + node.index))
        assert 0.0 <= node.fraction < 1.0
        assert node.covariance.form == api.COVARIANCE_FORM_PLANAR_6
        # Claims that stay the same are carried on with the noise of a usual
        # odometer: 0.1 degree per square root of a metre.
        assert node.covariance.values[5] == pytest.approx(
            1e-4 + math.radians(0.1) ** 2 * node.index)
    assert list(nodes[0].covariance.values) == pytest.approx(
        [0.01, 0, 0, 0.01, 0, 1e-4])
    consecutive = [(edge.from_index, edge.to_index) for edge in edges
                   if edge.kind == api.EDGE_KIND_CONSECUTIVE]
    assert consecutive == [(i, i + 1) for i in range(100)]
    assert len(edges) == 101


def test_export_of_a_large_graph_comes_in_parts(stub, new_vehicle):
    vehicle = new_vehicle(node_spacing_meters=0.05, sequence_length_meters=20.0,
                          check_interval_meters=10000.0)
    for first in range(1, 2001, 500):
        append(stub, vehicle, straight(500, first=first))
    limit = stub.GetServerInfo(api.GetServerInfoRequest()).max_message_bytes
    parts = list(stub.ExportPoseGraph(
        api.ExportPoseGraphRequest(vehicle=vehicle)))
    # The longest step that is bridged follows the spacing if not given.
    assert parts[0].vehicle.settings.max_step_meters == pytest.approx(50.0)
    assert sum(len(part.nodes) for part in parts) == 39981
    assert len(parts) > 2
    assert max(part.ByteSize() for part in parts) < limit


def test_export_of_a_vehicle_without_poses_is_the_vehicle(stub, new_vehicle):
    vehicle = new_vehicle()
    exported, nodes, edges = export(stub, vehicle)
    assert (exported.name, nodes, edges) == (vehicle, [], [])


# ---- Forms of one and the same pose


SIGMAS = (0.2, 0.3, 0.02)


def planar_from(covariance, **orientation):
    made = pose(1, x=3.0, y=4.0)
    made.covariance.CopyFrom(covariance)
    for name, value in orientation.items():
        if name == "quaternion":
            made.quaternion.CopyFrom(value)
        else:
            setattr(made, name, value)
    return made


def first_node(stub, vehicle):
    return export(stub, vehicle)[1][0]


def test_all_forms_of_a_pose_mean_the_same(stub, new_vehicle):
    heading, roll = 2.0, 0.4
    xx, xy, xh, yy, yh, hh = 0.04, 0.01, 0.001, 0.09, -0.002, 4e-4
    planar = api.Covariance(form=api.COVARIANCE_FORM_PLANAR_6,
                            values=[xx, xy, xh, yy, yh, hh])
    spatial = api.Covariance(
        form=api.COVARIANCE_FORM_SPATIAL_10,
        values=[xx, xy, 9, xh, yy, 9, yh, -9, 9, hh])
    ros = [0.0] * 36
    for (r, c), value in {(0, 0): xx, (0, 1): xy, (0, 5): xh, (1, 1): yy,
                          (1, 5): yh, (5, 5): hh, (2, 2): 7, (3, 3): 8,
                          (0, 3): 0.5}.items():
        ros[6 * r + c] = ros[6 * c + r] = value
    ros = api.Covariance(form=api.COVARIANCE_FORM_ROS_36, values=ros)
    # Turned by the heading about z, then rolled about the body's own x axis,
    # which does not move the forward axis.
    a, b = heading / 2, roll / 2
    quaternion = api.Quaternion(
        x=math.cos(a) * math.sin(b), y=math.sin(a) * math.sin(b),
        z=math.sin(a) * math.cos(b), w=math.cos(a) * math.cos(b))
    negated = api.Quaternion(x=-quaternion.x, y=-quaternion.y,
                             z=-quaternion.z, w=-quaternion.w)
    for made in (planar_from(planar, heading_radians=heading),
                 planar_from(spatial, heading_radians=heading + 4 * math.pi),
                 planar_from(ros, quaternion=quaternion),
                 planar_from(planar, quaternion=negated)):
        vehicle = new_vehicle()
        append(stub, vehicle, [made])
        node = first_node(stub, vehicle)
        assert node.pose.x_meters == 3.0
        assert node.pose.y_meters == 4.0
        assert node.pose.heading_radians == pytest.approx(heading, abs=1e-12)
        assert list(node.covariance.values) == pytest.approx(
            [xx, xy, xh, yy, yh, hh])


# ---- Geodetic positions. The expectation is worked out from the definition of
# the ellipsoid, in no way that the server uses.

WGS84_A = 6378137.0
WGS84_F = 1 / 298.257223563


def ecef(latitude, longitude, height):
    phi, lam = math.radians(latitude), math.radians(longitude)
    e2 = WGS84_F * (2 - WGS84_F)
    n = WGS84_A / math.sqrt(1 - e2 * math.sin(phi) ** 2)
    return ((n + height) * math.cos(phi) * math.cos(lam),
            (n + height) * math.cos(phi) * math.sin(lam),
            (n * (1 - e2) + height) * math.sin(phi))


def enu_axes(latitude, longitude):
    phi, lam = math.radians(latitude), math.radians(longitude)
    return ((-math.sin(lam), math.cos(lam), 0.0),
            (-math.sin(phi) * math.cos(lam), -math.sin(phi) * math.sin(lam),
             math.cos(phi)),
            (math.cos(phi) * math.cos(lam), math.cos(phi) * math.sin(lam),
             math.sin(phi)))


def dot(a, b):
    return sum(x * y for x, y in zip(a, b))


def local_of(origin, position):
    offset = [b - a for a, b in zip(ecef(*origin), ecef(*position))]
    return [dot(axis, offset) for axis in enu_axes(*origin[:2])]


def heading_of(origin, position, heading):
    east, north, _ = enu_axes(*position[:2])
    forward = [math.cos(heading) * e + math.sin(heading) * n
               for e, n in zip(east, north)]
    x, y, _ = (dot(axis, forward) for axis in enu_axes(*origin[:2]))
    return math.atan2(y, x)


TORONTO = (43.782, -79.466, 155.0)


def geodetic_pose(position, heading, covariance):
    return api.Pose(
        sequence=1, heading_radians=heading, covariance=covariance,
        geodetic=api.GeodeticPosition(
            latitude_degrees=position[0], longitude_degrees=position[1],
            height_meters=position[2]))


@pytest.mark.parametrize("origin, position", [
    (TORONTO, TORONTO),
    (TORONTO, (43.80, -79.50, 140.0)),
    (TORONTO, (43.2, -80.1, 1200.0)),
    # Over the antimeridian, and near a pole.
    ((-17.0, 179.99, 0.0), (-17.01, -179.98, 50.0)),
    ((89.9, 10.0, 0.0), (89.95, -150.0, 20.0)),
], ids=str)
def test_geodetic_pose_is_put_into_the_local_frame(
        origin, position, stub, new_vehicle):
    heading = 0.7
    vehicle = new_vehicle(
        state_space=api.STATE_SPACE_SPATIAL,
        coordinate_frame=api.COORDINATE_FRAME_GEODETIC,
        geodetic_origin=api.GeodeticPosition(
            latitude_degrees=origin[0], longitude_degrees=origin[1],
            height_meters=origin[2]))
    sent = geodetic_pose(position, heading, api.Covariance(
        form=api.COVARIANCE_FORM_SPATIAL_10,
        values=[4, 0, 0, 0, 1, 0, 0, 9, 0, 0.01]))
    append(stub, vehicle, [sent])
    node = first_node(stub, vehicle)
    x, y, z = local_of(origin, position)
    assert node.pose.x_meters == pytest.approx(x, abs=1e-6)
    assert node.pose.y_meters == pytest.approx(y, abs=1e-6)
    assert node.pose.z_meters == pytest.approx(z, abs=1e-6)
    assert math.remainder(
        node.pose.heading_radians - heading_of(origin, position, heading),
        2 * math.pi) == pytest.approx(0.0, abs=1e-12)
    # The covariance turns with the axes; its trace over position stays.
    values = node.covariance.values
    assert values[0] + values[4] + values[7] == pytest.approx(14.0)
    turn = [[dot(a, b) for b in enu_axes(*position[:2])]
            for a in enu_axes(*origin[:2])]
    for (r, c), index in {(0, 0): 0, (0, 1): 1, (0, 2): 2, (1, 1): 4,
                          (1, 2): 5, (2, 2): 7}.items():
        expected = sum(turn[r][k] * turn[c][k] * variance
                       for k, variance in enumerate((4.0, 1.0, 9.0)))
        assert values[index] == pytest.approx(expected, abs=1e-9)
    # What is kept is what was sent.
    assert as_bytes(list_poses(stub, vehicle)) == as_bytes([sent])


def test_first_pose_of_a_geodetic_vehicle_is_its_origin(stub, new_vehicle):
    vehicle = new_vehicle(coordinate_frame=api.COORDINATE_FRAME_GEODETIC)
    assert not get(stub, vehicle).settings.HasField("geodetic_origin")
    append(stub, vehicle, [geodetic_pose(TORONTO, 0.5, api.Covariance(
        form=api.COVARIANCE_FORM_PLANAR_6,
        values=[0.01, 0, 0, 0.01, 0, 1e-4]))])
    origin = get(stub, vehicle).settings.geodetic_origin
    assert (origin.latitude_degrees, origin.longitude_degrees,
            origin.height_meters) == TORONTO
    node = first_node(stub, vehicle)
    assert (node.pose.x_meters, node.pose.y_meters) == pytest.approx(
        (0.0, 0.0), abs=1e-9)
    assert node.pose.heading_radians == pytest.approx(0.5)
    # Optimisers work in the local frame.
    revise(stub, vehicle, [pose(1, x=1.5, y=-2.5)])
    node = first_node(stub, vehicle)
    assert (node.pose.x_meters, node.pose.y_meters) == (1.5, -2.5)
    # The origin cannot move any more.
    failure = failure_of(lambda: update(
        stub, vehicle, "geodetic_origin",
        geodetic_origin=api.GeodeticPosition(latitude_degrees=1.0)))
    assert failure.reason == "SETTING_FIXED"
