"""A server that does not reach the shared store gets out of the way, so that others may
answer for its vehicles, and comes back by itself."""

import contextlib
import os
import pathlib
import signal

import grpc
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from own_postgres import own_shared_store
from revisit_server import Server, wait_until
from stubs import api
from wire import PoseStream, append, decode_failure, get, straight

SERVING = health_pb2.HealthCheckResponse.SERVING
NOT_SERVING = health_pb2.HealthCheckResponse.NOT_SERVING
SERVICE = "revisit.v1.PoseGraphService"
LEASE_SECONDS = 2
# Far beyond what is promised, below what a call waits for by itself.
SECONDS = 60


@pytest.fixture(name="database")
def _database():
    with own_shared_store() as postgres:
        yield postgres


@pytest.fixture(name="server")
def _server(database, tmp_path):
    with Server(database.url("revisit"), "--advertise-address", "host-a:1",
                "--lease-seconds", LEASE_SECONDS,
                log_path=tmp_path / "server.log") as server:
        yield server


@contextlib.contextmanager
def silent(database):
    """Every process of the database stops meanwhile: connections stay, and nothing
    comes from them."""
    pid = database.process.pid
    children = pathlib.Path(f"/proc/{pid}/task/{pid}/children")
    stopped = [pid, *map(int, children.read_text().split())]
    for each in stopped:
        os.kill(each, signal.SIGSTOP)
    try:
        yield
    finally:
        for each in stopped:
            with contextlib.suppress(ProcessLookupError):
                os.kill(each, signal.SIGCONT)


def health(server):
    """What the server says of itself, of the service and of writes."""
    stub = health_pb2_grpc.HealthStub(server.channel())
    return [stub.Check(health_pb2.HealthCheckRequest(service=name), timeout=10).status
            for name in ("", SERVICE, f"{SERVICE}/write")]


def check_is_stale(error):
    assert error.code() == grpc.StatusCode.UNAVAILABLE, error
    failure = decode_failure(error)
    assert failure.reason == "LEASE_STALE"


def check_ends(stream):
    with pytest.raises(grpc.RpcError) as ended:
        stream.receive_all()
    check_is_stale(ended.value)


def test_health_follows_the_lease(database, server):
    assert health(server) == [SERVING] * 3
    with silent(database):
        wait_until(lambda: health(server) == [NOT_SERVING] * 3, "end of the lease")
        # The server tells of itself all the same.
        info = server.stub().GetServerInfo(api.GetServerInfoRequest(), timeout=10)
        assert (info.over_all_tenants, list(info.servers)) == (True, [])
    wait_until(lambda: health(server) == [SERVING] * 3, "new lease")
    server.logged("store_in_reach_again")


def test_whoever_waits_for_the_store_is_sent_away(database, server):
    """Streams with a batch under way and without one, unary calls that read and that
    write: all of them waited for a database that did not answer."""
    stub = server.stub()
    names = [f"vehicles/{name}" for name in ("writing", "idle", "unary")]
    for name in names:
        stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id=name.split("/")[1]))
    writing, idle, unary = names
    append(stub, unary, straight(1))
    with PoseStream(stub, writing, timeout=SECONDS) as busy, \
            PoseStream(stub, idle, timeout=SECONDS) as quiet:
        for stream in (busy, quiet):
            stream.receive_kind("opened")
        busy.send(straight(3))
        assert busy.receive_kind("ack").durable_sequence == 3
        with silent(database):
            busy.send(straight(2, first=4))
            waiting = [
                stub.AppendPoses.future(api.AppendPosesRequest(
                    vehicle=unary, poses=straight(2)[1:]), timeout=SECONDS),
                stub.GetVehicle.future(api.GetVehicleRequest(
                    name="vehicles/unknown"), timeout=SECONDS)]
            check_ends(busy)
            check_ends(quiet)
            for call in waiting:
                check_is_stale(call.exception(SECONDS))
            with pytest.raises(grpc.RpcError) as refused:
                get(stub, idle)
            check_is_stale(refused.value)
            with PoseStream(stub, idle, timeout=SECONDS) as late:
                check_ends(late)
    wait_until(lambda: health(server) == [SERVING] * 3, "new lease")
    # The batch that was under way is stored whole or not at all, and the stream says
    # which.
    with PoseStream(stub, writing, timeout=SECONDS, acked_sequence=3) as resumed:
        stored = resumed.receive_kind("opened").durable_sequence
        assert stored in (3, 5)
        resumed.send(straight(6 - stored, first=stored + 1))
        assert resumed.receive_kind("ack").durable_sequence == 6
    assert append(stub, unary, straight(2)[1:]).durable_sequence == 2
