"""RevisePoses as sequences of messages: what comes empty, late or too large."""

import grpc
import pytest

from stubs import api
from wire import append, as_bytes, failure_of, get, list_poses, pose, straight

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
    def messages():
        yield message(driven, moved(1, 10))
        yield message()
        call.cancel()

    before = get(stub, driven)
    sending = messages()
    call = stub.RevisePoses.future(sending)
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
            if method.name in ("ListVehicles", "GetServerInfo"):
                call(nothing, timeout=20)
                continue
            failure = failure_of(lambda: [*call(nothing, timeout=20)]
                                 if method.server_streaming
                                 else call(nothing, timeout=20))
            assert failure.code == grpc.StatusCode.INVALID_ARGUMENT, method.name
    assert get(stub, driven) == before
