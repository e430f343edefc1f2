"""RevisePoses as sequences of messages: what comes empty, late or too large."""

import random
import threading

import grpc
import pytest

from revisit_server import Server, open_files, wait_until
from stubs import api
from wire import (append, as_bytes, batches, decode_failure, failure_of, get,
                  list_poses, pose, straight)

STORED = 20


@pytest.fixture
def driven(stub, new_vehicle):
    vehicle = new_vehicle()
    append(stub, vehicle, straight(STORED))
    return vehicle


def message(vehicle="", poses=(), **fields):
    return api.RevisePosesRequest(vehicle=vehicle, poses=poses, **fields)


def moved(first, count):
    return [pose(n, x=float(n), y=1.0) for n in range(first, first + count)]


# ---- Messages of no bytes


@pytest.mark.parametrize("places", [(1,), (2,), (1, 3), (1,) * 50], ids=[
    "between", "last", "both", "many"])
def test_empty_messages_of_a_revision_mean_nothing(places, stub, driven):
    messages = [message(driven, moved(1, 10)), message(poses=moved(11, 10))]
    for place in places:
        messages.insert(place, message())
    assert messages[places[0]].ByteSize() == 0
    assert stub.RevisePoses(iter(messages)).revised_count == STORED
    assert as_bytes(list_poses(stub, driven)) == as_bytes(moved(1, STORED))


def test_empty_message_after_one_of_a_vehicle_that_is_not_there(stub, driven):
    failure = failure_of(lambda: stub.RevisePoses(iter([
        message("vehicles/nowhere", moved(1, 1)), message()])))
    assert failure.code == grpc.StatusCode.NOT_FOUND
    assert get(stub, driven).revision > 0


def test_revision_that_begins_with_an_empty_message_is_refused(stub, driven):
    failure = failure_of(lambda: stub.RevisePoses(iter([
        message(), message(driven, moved(1, 1))])))
    assert failure.fields == ["vehicle"]


def test_revision_that_is_given_up_after_an_empty_message_leaves_no_trace(
        stub, driven):
    sent, given_up = threading.Event(), threading.Event()

    def messages():
        yield message(driven, moved(1, 10))
        yield message()
        sent.set()
        given_up.wait(20)

    before = get(stub, driven)
    call = stub.RevisePoses.future(messages())
    assert sent.wait(20)
    call.cancel()
    given_up.set()
    with pytest.raises(grpc.FutureCancelledError):
        call.result()
    assert get(stub, driven) == before


def test_call_that_sends_an_empty_message_to_any_method_is_told_why(
        server, stub, driven):
    """Every method wants at least a name."""
    before = get(stub, driven)
    service = api.GetServerInfoRequest.DESCRIPTOR.file.services_by_name[
        "PoseGraphService"]
    with server.channel() as channel:
        for method in service.methods:
            path = f"/{service.full_name}/{method.name}"
            kind = "_".join("stream" if streaming else "unary" for streaming in
                            (method.client_streaming, method.server_streaming))
            call = getattr(channel, kind)(path)
            nothing = iter([b"", b""]) if method.client_streaming else b""
            if method.name in ("ListVehicles", "ListGroups", "GetServerInfo"):
                call(nothing, timeout=20)
                continue
            if method.name == "WatchCandidates":
                # Watches all, from now on.
                watching = call(nothing, timeout=20)
                assert next(watching)
                watching.cancel()
                continue
            failure = failure_of(lambda: [*call(nothing, timeout=20)]
                                 if method.server_streaming
                                 else call(nothing, timeout=20))
            assert failure.code == grpc.StatusCode.INVALID_ARGUMENT, method.name
    assert get(stub, driven) == before


# ---- Revisions larger than what the server holds in memory


def large_revision(vehicle, poses, size):
    for first in range(0, len(poses), size):
        yield message(vehicle if first == 0 else "", poses[first:first + size])


def test_revision_may_be_as_large_as_is_allowed_and_no_larger(tmp_path):
    poses = straight(6000)
    revised = [pose(p.sequence, x=p.local.x_meters, y=1.0) for p in poses]
    requests = list(large_revision("vehicles/car", revised, 100))
    allowed = sum(request.ByteSize() for request in requests)
    # A vehicle may have far less than that waiting, and so may the server.
    with Server(tmp_path / "store", f"--max-revision-bytes={allowed}",
                f"--max-queued-bytes-per-vehicle={allowed // 8}",
                f"--max-queued-bytes={allowed // 4}") as server:
        stub = server.stub()
        stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id="car"))
        for batch in batches(poses, 500):
            append(stub, "vehicles/car", batch)
        before = get(stub, "vehicles/car")
        extra = message(expected_revision=0, vehicle="vehicles/car")
        failure = failure_of(lambda: stub.RevisePoses(iter([*requests, extra])))
        assert (failure.code, failure.reason) == (
            grpc.StatusCode.INVALID_ARGUMENT, "BATCH_SIZE")
        assert str(allowed) in failure.message
        assert get(stub, "vehicles/car") == before
        assert as_bytes(list_poses(stub, "vehicles/car")) == as_bytes(poses)

        answer = stub.RevisePoses(iter(requests))
        assert answer.revised_count == len(poses)
        assert answer.revision == before.revision + 1
        assert as_bytes(list_poses(stub, "vehicles/car")) == as_bytes(revised)


def test_revisions_that_never_end_leave_room_for_those_of_others(tmp_path):
    with Server(tmp_path / "store", f"--max-revision-bytes={3 << 20}",
                f"--max-draft-bytes={4 << 20}") as server:
        stub = server.stub()
        for name in ("car", "bus"):
            stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id=name))
            append(stub, f"vehicles/{name}", straight(STORED))
        release = threading.Event()
        started = threading.Semaphore(0)

        def messages():
            yield message("vehicles/car", moved(1, STORED))
            started.release()
            release.wait(60)

        def revise(name):
            return stub.RevisePoses(iter([message(
                f"vehicles/{name}", moved(1, STORED))]))
        calls = [stub.RevisePoses.future(messages()) for _ in range(3)]
        for _ in calls:
            assert started.acquire(timeout=20)
        # Sooner, another revision could take the room of one of them.
        wait_until(lambda: open_files(server.pid).count("/.revision-") == 3,
                   "three drafts")
        failure = _failure(lambda: revise("car"))
        assert (failure.code, failure.reason) == (
            grpc.StatusCode.RESOURCE_EXHAUSTED, "QUEUE_FULL")
        assert failure.quota_subjects == ["vehicles/car"]
        assert revise("bus").revised_count == STORED
        release.set()
        for call in calls:
            assert call.result(timeout=20).revised_count == STORED
        assert revise("car").revised_count == STORED


def _failure(call):
    try:
        call()
    except grpc.RpcError as error:
        return decode_failure(error)
    return None


def test_poses_of_a_revision_may_come_in_any_order_over_its_messages(
        stub, driven):
    shuffled = moved(1, STORED)
    random.Random(5).shuffle(shuffled)
    answer = stub.RevisePoses(large_revision(driven, shuffled, 3))
    assert answer.revised_count == STORED
    assert as_bytes(list_poses(stub, driven)) == as_bytes(moved(1, STORED))


def test_revision_leaves_no_file_behind(tmp_path):
    with Server(tmp_path / "store") as server:
        stub = server.stub()
        stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id="car"))
        append(stub, "vehicles/car", straight(STORED))
        files = sorted(path.name for path in (tmp_path / "store").iterdir())
        arrived = threading.Event()

        def messages():
            yield message("vehicles/car", moved(1, 10))
            yield message(poses=moved(11, 1))
            arrived.wait(20)
        call = stub.RevisePoses.future(messages())
        wait_until(lambda: "/.revision-" in open_files(server.pid),
                   "the draft")
        # It is unlinked a moment after it is opened.
        wait_until(lambda: sorted(path.name for path in
                                  (tmp_path / "store").iterdir()) == files,
                   "store without the draft's name")
        call.cancel()
        arrived.set()
        wait_until(lambda: "/.revision-" not in open_files(server.pid),
                   "the end of the draft")


def test_revision_is_refused_where_it_would_fill_the_disk(tmp_path):
    with Server(tmp_path / "store") as server:
        stub = server.stub()
        stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id="car"))
        append(stub, "vehicles/car", straight(STORED))
    with Server(tmp_path / "store", f"--min-free-bytes={2**50}") as server:
        stub = server.stub()
        before = get(stub, "vehicles/car")
        failure = failure_of(lambda: stub.RevisePoses(iter([
            message("vehicles/car", moved(1, 1))])))
        assert (failure.code, failure.reason) == (
            grpc.StatusCode.RESOURCE_EXHAUSTED, "STORAGE_FULL")
        assert get(stub, "vehicles/car") == before


def test_pose_that_is_not_stored_is_told_before_all_have_come(stub, driven):
    """Whoever sends for long learns early that it is in vain."""
    release = threading.Event()

    def messages():
        yield message(driven, moved(STORED, 2))
        release.wait(20)
    failure = failure_of(lambda: stub.RevisePoses(messages(), timeout=15))
    release.set()
    assert (failure.code, failure.reason) == (
        grpc.StatusCode.NOT_FOUND, "POSE_NOT_FOUND")
