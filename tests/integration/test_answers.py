"""What answers hold, how large they are, and who waits for whom."""

import base64
import ctypes
import ctypes.util
import threading

import grpc
import pytest

import scraped
from revisit_server import Server, wait_until
from stubs import api
from wire import (PoseStream, append, as_bytes, batches, failure_of, laps,
                  list_poses, pose, straight)

EXHAUSTED = grpc.StatusCode.RESOURCE_EXHAUSTED
# Bytes that a client of gRPC takes in one message unless it is told otherwise.
DEFAULT_BYTES = 4 << 20


def create(stub, name="car", **settings):
    return stub.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id=name, vehicle=api.Vehicle(
            settings=api.VehicleSettings(**settings)))).vehicle.name


# ---- What this version does not know


def with_unknown_fields(message, size):
    """The message, and each that it holds, with a field of a later version."""
    for field, value in message.ListFields():
        if field.type == field.TYPE_MESSAGE:
            with_unknown_fields(value, size)
    # Field 1000, of bytes.
    content = b"\x55" * size
    length = bytes([size & 0x7f | 0x80, size >> 7])
    message.MergeFromString(b"\xc2\x3e" + length + content)
    return message


@pytest.mark.parametrize("how", ["append", "stream", "revise"])
def test_fields_that_are_not_known_are_not_kept(how, stub, new_vehicle):
    vehicle = new_vehicle()
    known = straight(10)
    marked = [with_unknown_fields(p, 1000) for p in straight(10)]
    assert marked[0].ByteSize() > known[0].ByteSize() + 3000
    if how == "append":
        append(stub, vehicle, marked)
    elif how == "stream":
        with PoseStream(stub, vehicle) as stream:
            stream.receive_kind("opened")
            stream.send(marked)
            assert stream.receive_kind("ack").durable_sequence == 10
    else:
        append(stub, vehicle, straight(10, spacing=2.0))
        stub.RevisePoses(iter([api.RevisePosesRequest(
            vehicle=vehicle, poses=marked)]))
    assert as_bytes(list_poses(stub, vehicle)) == as_bytes(known)
    # Sent again, with them or without, it is the same.
    if how != "revise":
        assert append(stub, vehicle, known).durable_sequence == 10
        assert append(stub, vehicle, marked).durable_sequence == 10


# ---- Size


def test_page_of_poses_fits_a_client_that_was_told_nothing(stub, new_vehicle):
    vehicle = new_vehicle(
        correlation_model=api.CORRELATION_MODEL_FILTER,
        state_space=api.STATE_SPACE_SPATIAL)
    transition = [1.0 if i % 5 == 0 else 1e-9 for i in range(16)]
    covariance = [1e-4 if i % 7 == 0 else 1e-12 for i in range(36)]
    poses = [api.Pose(
        sequence=n, local=api.LocalPosition(x_meters=n, y_meters=1, z_meters=1),
        quaternion=api.Quaternion(w=1.0), error_transition=transition,
        covariance=api.Covariance(form=api.COVARIANCE_FORM_ROS_36,
                                  values=covariance))
        for n in range(1, 9001)]
    for batch in batches(poses, 3000):
        append(stub, vehicle, batch)
    assert sum(p.ByteSize() for p in poses) > DEFAULT_BYTES
    page = stub.ListPoses(api.ListPosesRequest(parent=vehicle, page_size=10000))
    assert 0 < page.ByteSize() < DEFAULT_BYTES
    assert page.next_page_token
    assert as_bytes(list_poses(stub, vehicle)) == as_bytes(poses)


def test_largest_set_of_candidates_fits_a_client_that_was_told_nothing(
        stub, new_vehicle):
    """Their number and the length of the sequence are bounded."""
    vehicle = new_vehicle(sequence_length_meters=1000.0,
                          node_spacing_meters=1.0, max_candidates=100)
    for batch in batches(laps(5000, radius=60.0), 2500):
        append(stub, vehicle, batch)
    answer = stub.FindCandidates(api.FindCandidatesRequest(
        vehicle=vehicle, options=api.CandidateOptions(
            alignment=api.ALIGNMENT_COMPOSITE, exhaustive=True,
            candidate_separation_meters=0, include_aligned_path=True)))
    paths = [candidate.aligned_path
             for candidate in answer.candidates.candidates]
    assert len(paths) == 100 and len(paths[0]) == 1000
    assert answer.ByteSize() < DEFAULT_BYTES // 2


# ---- Page tokens


def sealed(list_name, key):
    """A token as the server makes it; how is no secret."""
    library = ctypes.CDLL(ctypes.util.find_library("xxhash")
                          or pytest.skip("needs libxxhash"))
    library.XXH3_64bits.restype = ctypes.c_uint64
    text = list_name.encode() + b"\n" + key
    seal = library.XXH3_64bits(text, ctypes.c_size_t(len(text)))
    return base64.urlsafe_b64encode(
        b"1" + seal.to_bytes(8, "little") + key).rstrip(b"=").decode()


def test_page_token_of_a_callers_own_making_is_worth_nothing(tmp_path):
    with Server(tmp_path / "store") as server:
        stub = server.stub()
        vehicle = create(stub)
        append(stub, vehicle, straight(30))
        issued = stub.ListPoses(api.ListPosesRequest(
            parent=vehicle, page_size=10)).next_page_token
        name = f"ListPoses {vehicle}"
        assert issued.rstrip("=") == sealed(name, b"10")
        for key in (b"0", b"-1", b"18446744073709551615", b"9" * 40, b"x",
                    b"1\0", b"\xff", b"010"):
            failure = failure_of(lambda: stub.ListPoses(api.ListPosesRequest(
                parent=vehicle, page_token=sealed(name, key))))
            assert (failure.code, failure.reason) == (
                grpc.StatusCode.INVALID_ARGUMENT, "INVALID_PAGE_TOKEN"), key
        # Beyond the end lies nothing.
        for key in (b"30", b"31", b"9223372036854775807"):
            page = stub.ListPoses(api.ListPosesRequest(
                parent=vehicle, page_token=sealed(name, key)))
            assert not page.poses and not page.next_page_token
        failure = failure_of(lambda: stub.ListVehicles(api.ListVehiclesRequest(
            page_token=sealed("ListVehicles", b"\xff' OR 1=1"))))
        assert failure.reason == "INVALID_PAGE_TOKEN"
    assert "error" not in server.log()


def test_listing_goes_on_over_a_restart(tmp_path):
    with Server(tmp_path / "store") as server:
        vehicle = create(server.stub())
        append(server.stub(), vehicle, straight(30))
        page = server.stub().ListPoses(api.ListPosesRequest(
            parent=vehicle, page_size=10))
    with Server(tmp_path / "store") as server:
        rest = server.stub().ListPoses(api.ListPosesRequest(
            parent=vehicle, page_token=page.next_page_token))
        assert [p.sequence for p in rest.poses] == list(range(11, 31))


# ---- Exports that go on from an earlier one


def exported(stub, vehicle, before=None, count=0):
    """Identity and first index of the nodes, their indices, and the edges."""
    parts = list(stub.ExportPoseGraph(api.ExportPoseGraphRequest(
        vehicle=vehicle, nodes_id=before or "", first_node_index=count)))
    return (parts[0].nodes_id, parts[0].first_node_index,
            [node.index for part in parts for node in part.nodes],
            [(edge.from_index, edge.to_index, edge.kind)
             for part in parts for edge in part.edges])


def test_export_goes_on_where_the_last_one_ended(stub, new_vehicle):
    vehicle = new_vehicle()
    poses = straight(300)
    append(stub, vehicle, poses[:200])
    nodes_id, first, nodes, edges = exported(stub, vehicle)
    count = len(nodes)
    assert (first, nodes) == (0, list(range(count)))
    assert exported(stub, vehicle, nodes_id, count) == (nodes_id, count, [], [])
    append(stub, vehicle, poses[200:])
    stub.AddLoopClosure(api.AddLoopClosureRequest(
        parent=vehicle, loop_closure=api.LoopClosure(
            query_sequence=150, matched_sequence=10)))
    _, _, all_nodes, all_edges = exported(stub, vehicle)
    new_id, first, added, more = exported(stub, vehicle, nodes_id, count)
    assert (new_id, first) == (nodes_id, count)
    assert nodes + added == all_nodes
    assert len(added) > 10
    assert sorted(edges + more) == sorted(all_edges)
    # Of a graph that has fewer nodes than are known, all come.
    assert exported(stub, vehicle, nodes_id, len(all_nodes) + 1)[1] == 0
    assert exported(stub, vehicle, nodes_id, -1)[1] == 0


def test_export_begins_anew_after_a_revision(stub, new_vehicle):
    vehicle = new_vehicle()
    append(stub, vehicle, straight(200))
    nodes_id, _, nodes, _ = exported(stub, vehicle)
    stub.RevisePoses(iter([api.RevisePosesRequest(
        vehicle=vehicle, poses=[pose(100, x=100.0, y=0.5)])]))
    other, first, again, _ = exported(stub, vehicle, nodes_id, len(nodes))
    assert other != nodes_id
    assert (first, len(again)) == (0, len(nodes))


def test_export_begins_anew_with_another_vehicle_of_the_name(
        stub, new_vehicle):
    vehicle = new_vehicle()
    append(stub, vehicle, straight(200))
    nodes_id, _, nodes, _ = exported(stub, vehicle)
    stub.DeleteVehicle(api.DeleteVehicleRequest(name=vehicle))
    create(stub, vehicle.split("/")[1])
    append(stub, vehicle, straight(200))
    other, first, again, _ = exported(stub, vehicle, nodes_id, len(nodes))
    assert other != nodes_id
    assert (first, again) == (0, nodes)


# ---- Exports that nobody reads


def stalled_export(server, vehicle):
    """An export of which nothing more is read after the first message."""
    channel = server.channel(("grpc.use_local_subchannel_pool", 1),
                             ("grpc.http2.lookahead_bytes", 1024),
                             ("grpc.http2.bdp_probe", 0))
    call = channel.unary_stream(
        "/revisit.v1.PoseGraphService/ExportPoseGraph",
        request_serializer=lambda m: m.SerializeToString(),
        response_deserializer=bytes)(
            api.ExportPoseGraphRequest(vehicle=vehicle))
    next(call)
    return call


def fill(stub, vehicle, nodes):
    for batch in batches(straight(nodes, spacing=2.0), 4000):
        append(stub, vehicle, batch)


@pytest.mark.release_build
def test_stalled_exports_of_one_revision_share_one_copy(tmp_path):
    with Server(tmp_path / "store", "--slow-consumer-seconds=600",
                "--max-streams-per-vehicle=100") as server:
        stub = server.stub()
        vehicle = create(stub)
        fill(stub, vehicle, 60000)
        calls = [stalled_export(server, vehicle)]
        before = server.resident_bytes()
        calls += [stalled_export(server, vehicle) for _ in range(30)]
        # A copy each came to 6 MB.
        assert server.resident_bytes() - before < 60 << 20
        for call in calls:
            call.cancel()


def test_client_that_does_not_read_its_export_is_told_and_let_go(tmp_path):
    with Server(tmp_path / "store", "--slow-consumer-seconds=0.5",
                "--max-streams-per-vehicle=1") as server:
        stub = server.stub()
        vehicle = create(stub)
        fill(stub, vehicle, 20000)
        call = stalled_export(server, vehicle)
        server.logged("SLOW_CONSUMER")
        # The place is free again.
        exported = wait_until(lambda: _export(stub, vehicle), "another export")
        assert exported == 20000
        call.cancel()


def test_client_that_comes_back_to_its_export_learns_why_it_ended(tmp_path):
    with Server(tmp_path / "store", "--slow-consumer-seconds=3",
                "--admin-listen=127.0.0.1:0") as server:
        stub = server.stub()
        vehicle = create(stub)
        fill(stub, vehicle, 20000)
        call = stalled_export(server, vehicle)
        # The copy goes when the client is found to be slow. It has as much time
        # again to hear of it.
        wait_until(lambda: scraped.scrape(server).value(
            "revisit_limit_used_ratio", limit="max-export-bytes") == 0,
            "end of the copy")
        failure = failure_of(lambda: list(call))
        assert (failure.code, failure.reason) == (EXHAUSTED, "SLOW_CONSUMER")
        server.logged("SLOW_CONSUMER")


def _export(stub, vehicle):
    try:
        return sum(len(part.nodes) for part in stub.ExportPoseGraph(
            api.ExportPoseGraphRequest(vehicle=vehicle)))
    except grpc.RpcError:
        return None


def test_exports_of_many_revisions_are_bounded_in_bytes(tmp_path):
    with Server(tmp_path / "store", "--slow-consumer-seconds=600",
                "--max-export-bytes=8000000") as server:
        stub = server.stub()
        vehicle = create(stub)
        fill(stub, vehicle, 10000)
        other = create(stub, "other")
        fill(stub, other, 1000)
        calls = [stalled_export(server, vehicle)]
        refused = None
        for n in range(10001, 10011):
            # Another revision, of which there is no copy yet.
            append(stub, vehicle, [pose(n, x=n * 2.0)])
            try:
                calls.append(stalled_export(server, vehicle))
            except grpc.RpcError as error:
                refused = error
                break
        assert refused is not None
        failure = failure_of(lambda: list(stub.ExportPoseGraph(
            api.ExportPoseGraphRequest(vehicle=vehicle))))
        assert (failure.code, failure.reason) == (EXHAUSTED, "STREAM_QUOTA")
        assert failure.quota_subjects == [vehicle]
        # Others have room.
        assert _export(stub, other) == 1000
        for call in calls:
            call.cancel()
        assert wait_until(lambda: _export(stub, vehicle), "room") > 10000


# ---- Who waits for searches

SLOW = {"alignment": api.ALIGNMENT_COMPOSITE,
        "direction": api.DIRECTION_EITHER}


@pytest.mark.release_build
def test_reads_and_creation_do_not_queue_behind_searches(tmp_path):
    """While searches wait for their threads, other vehicles are created, loaded
    and read."""
    vehicles = 6
    with Server(tmp_path / "store", "--search-threads=1",
                "--max-searches=100", "--max-calls=1000") as server:
        stub = server.stub()
        names = [create(stub, f"busy-{n}", sequence_length_meters=1000.0)
                 for n in range(vehicles)]
        for name in names:
            for batch in batches(laps(12000, radius=200.0), 4000):
                append(stub, name, batch)
        quiet = create(stub, "quiet")
        append(stub, quiet, straight(100))
        request = [api.FindCandidatesRequest(
            vehicle=name, options=api.CandidateOptions(**SLOW, exhaustive=True))
            for name in names]
        futures = [stub.FindCandidates.future(request[n % vehicles], timeout=240)
                   for n in range(10 * vehicles)]
        done = [threading.Event() for _ in futures]
        for future, event in zip(futures, done):
            future.add_done_callback(lambda _, event=event: event.set())
        done[0].wait(60)

        def left():
            return sum(not event.is_set() for event in done)

        waiting = left()
        assert waiting > 30, "the searches are too fast to tell"
        for n in range(8):
            assert len(list_poses(stub, quiet)) == 100
            create(stub, f"new-{n}")
        # Each would have waited for a search of every vehicle.
        assert left() > waiting // 2
        for future in futures:
            future.cancel()
