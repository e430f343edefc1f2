"""Whatever callers put into names, ids and metadata: it never becomes a path, and
every line of the log stays one line of JSON."""

import json

import grpc
import pytest

from raw_http2 import SERVICE, RawConnection, call_headers, message
from revisit_server import Server
from stubs import api
from wire import PoseStream, append, failure_of, pose

HOSTILE = {
    "up": "../../../../tmp/revisit-was-here",
    "absolute": "/tmp/revisit-was-here",
    "percent": "%2e%2e%2fa", "double percent": "%252e%252e",
    "zero byte": "a\0../b", "look-alike": "\u0430bc", "full stop": "\uff0e\uff0e",
    "right to left": "\u202egpj.exe", "10 kB": "a" * 10000,
    "line breaks": "a\r\n{\"level\":\"error\"}\n", "colours": "\x1b[31mred\x1b[0m",
    "quotes": "\",\"admin\":true,\"x\":\"", "backslashes": "\\\\\\u0000",
    "format": "%s%n%x{}{0}", "separators": "\u2028\u2029\u0085",
    "beyond the plane": "\U0001f4a3", "SQL": "'; DROP TABLE vehicles; --",
    "blank": " ", "dots": "..", "capital": "A",
}


@pytest.fixture(scope="module")
def logged(tmp_path_factory):
    store = tmp_path_factory.mktemp("names") / "store"
    with Server(store, "--log-format=json", "--log-level=debug") as server:
        yield server


@pytest.mark.parametrize("kind", HOSTILE)
def test_id_of_a_caller_is_refused_and_touches_no_file(kind, logged):
    text = HOSTILE[kind]
    stub = logged.stub()
    before = {path.name for path in logged.store.parent.rglob("*")}
    ask = [
        ("vehicle_id", lambda: stub.CreateVehicle(
            api.CreateVehicleRequest(vehicle_id=text))),
        ("name", lambda: stub.GetVehicle(
            api.GetVehicleRequest(name=f"vehicles/{text}"))),
        ("name", lambda: stub.DeleteVehicle(
            api.DeleteVehicleRequest(name=f"vehicles/{text}"))),
        ("vehicle", lambda: append(stub, f"vehicles/{text}", [pose(1)])),
        ("open.vehicle", lambda: PoseStream(
            stub, f"vehicles/{text}").receive()),
        ("name", lambda: stub.DeleteLoopClosure(api.DeleteLoopClosureRequest(
            name=f"vehicles/a/loopClosures/{text}"))),
    ]
    for field, call in ask:
        failure = failure_of(call)
        assert failure.code == grpc.StatusCode.INVALID_ARGUMENT
        assert failure.reason == "INVALID_RESOURCE_NAME"
        assert failure.fields == [field]
        assert failure.message.isascii() and failure.message.isprintable()
    assert {path.name for path in logged.store.parent.rglob("*")} == before


def test_every_line_of_the_log_is_one_event_of_json(logged):
    stub = logged.stub()
    for text in HOSTILE.values():
        header = text.encode("unicode_escape")[:100]
        with pytest.raises(grpc.RpcError):
            stub.GetVehicle(api.GetVehicleRequest(name=text),
                            metadata=[("x-request-id", header)])
    # What no client library sends: bytes that are no text, in a header, in a
    # message, and instead of one.
    for extra, body in (
            ([("x-request-id", b"\xff\n\x1b[31m")], b""),
            ([], b"\x0a\x04\xff\xfe\n\x1b"), ([], b"\x0a\xff\xff\xff\xff\x0f")):
        with RawConnection(logged.port) as connection:
            connection.request(
                call_headers(path=f"{SERVICE}/GetVehicle", extra=extra),
                message(body))
            assert connection.outcome().startswith("status ")
    stub.GetServerInfo(api.GetServerInfoRequest(),
                       metadata=[("x-request-id", "the-last-one")])
    logged.logged("the-last-one")
    raw = logged.log_path.read_bytes()
    assert not [byte for byte in raw if byte < 0x20 and byte != 0x0a or
                byte > 0x7e]
    lines = raw.decode("ascii").splitlines()
    assert len(lines) > len(HOSTILE)
    for line in lines:
        event = json.loads(line)
        assert {"time", "level", "event"} <= set(event)
        assert event["level"] in ("debug", "info", "warning"), line
        assert "admin" not in event
