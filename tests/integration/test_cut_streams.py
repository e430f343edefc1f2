"""Streams whose server dies behind a proxy, which resets them: that is no word of
the server's, and they go on with the next one."""

import contextlib

import grpc
import pytest

import killed_server
from resetting_proxy import ResettingProxy
from revisit_server import Server, free_port
from stubs import PoseGraphServiceStub, api
from wire import PoseStream, get


def test_stream_goes_on_after_a_proxy_has_reset_it(tmp_path):
    port = free_port()
    drive = killed_server.write_drive(tmp_path / "drive.csv")
    with contextlib.ExitStack() as stack:

        def start():
            return stack.enter_context(
                Server(tmp_path / "store", listen=f"127.0.0.1:{port}"))

        server = start()
        proxy = stack.enter_context(ResettingProxy(port))
        summary = killed_server.stream_through_a_kill(
            drive, "cut", ["--create", "--server", proxy.address],
            lambda stub=server.stub(): get(stub, "vehicles/cut").durable_sequence,
            server.kill, start)
        assert proxy.resets >= 1
        with grpc.insecure_channel(f"127.0.0.1:{port}") as channel:
            killed_server.check_all_is_stored_once(
                summary, PoseGraphServiceStub(channel), "vehicles/cut")


def test_a_reset_is_internal_without_details(tmp_path):
    with Server(tmp_path / "store") as server, \
            ResettingProxy(server.port) as proxy, \
            grpc.insecure_channel(proxy.address) as channel:
        server.stub().CreateVehicle(
            api.CreateVehicleRequest(vehicle_id="cut"))
        with PoseStream(PoseGraphServiceStub(channel), "vehicles/cut") as stream:
            stream.receive_kind("opened")
            server.kill()
            with pytest.raises(grpc.RpcError) as raised:
                stream.receive()
        killed_server.check_is_reset(raised.value)
