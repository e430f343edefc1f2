"""Signals: which ones end the server, and which ones do not. What SIGHUP does
is in test_identity.py."""

import signal
import subprocess
import time

import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from drive_client import VEHICLE, create
from revisit_server import Server
from stubs import api
from wire import PoseStream, append, failure_of, straight

SERVING = health_pb2.HealthCheckResponse.SERVING
NOT_SERVING = health_pb2.HealthCheckResponse.NOT_SERVING
HEALTH_NAMES = ["", "revisit.v1.PoseGraphService",
                "revisit.v1.PoseGraphService/write"]


def info(stub):
    return stub.GetServerInfo(api.GetServerInfoRequest(), timeout=30)


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGUSR1,
                                    signal.SIGUSR2, signal.SIGPIPE],
                         ids=lambda number: number.name)
def test_signal_that_asks_for_no_end_brings_none(number, tmp_path):
    with Server(tmp_path / "store") as server:
        stub = server.stub()
        for _ in range(3):
            server.process.send_signal(number)
            info(stub)
        server.process.send_signal(signal.SIGTERM)
        assert server.process.wait(30) == 0, server.log()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT],
                         ids=lambda number: number.name)
def test_signal_that_asks_for_the_end_drains(number, tmp_path):
    with Server(tmp_path / "store") as server:
        info(server.stub())
        server.process.send_signal(number)
        assert server.process.wait(30) == 0, server.log()
        assert " stopped " in server.log()


def test_end_of_the_input_drains_where_it_is_asked_for(tmp_path):
    with Server(tmp_path / "store", "--end-with-input", "on",
                stdin=subprocess.PIPE) as server:
        # It says nothing to the server that is written there.
        server.process.stdin.write("words\n" * 100)
        server.process.stdin.flush()
        create(server.stub())
        with PoseStream(server.stub(), VEHICLE) as stream:
            stream.receive_kind("opened")
            stream.send(straight(1))
            assert stream.receive_kind("ack").durable_sequence == 1
            assert server.is_running() and "input_ended" not in server.log()
            server.process.stdin.close()
            assert failure_of(stream.receive).reason == "SERVER_DRAINING"
        server.close_channels()
        assert server.process.wait(30) == 0, server.log()
        assert " input_ended" in server.log() and " stopped " in server.log()


def test_end_of_the_input_is_nothing_to_a_server_by_itself(tmp_path):
    with Server(tmp_path / "store", stdin=subprocess.PIPE) as server:
        server.process.stdin.close()
        info(server.stub())
        server.process.send_signal(signal.SIGTERM)
        assert server.process.wait(30) == 0
        assert "input_ended" not in server.log()


def test_input_that_has_ended_ends_a_start(tmp_path):
    with Server(tmp_path / "store", "--end-with-input", "on", wait=False) as server:
        assert server.process.wait(30) == 0, server.log()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT],
                         ids=lambda number: number.name)
def test_server_that_gives_notice_still_serves_until_a_second_signal(
        number, tmp_path):
    with Server(tmp_path / "store", "--drain-notice-seconds", 600) as server:
        stub = server.stub()
        create(stub)
        health = health_pb2_grpc.HealthStub(server.channel())
        watch = health.Watch(health_pb2.HealthCheckRequest(), timeout=60)
        assert next(watch).status == SERVING
        with PoseStream(stub, VEHICLE) as stream:
            stream.receive_kind("opened")
            server.process.send_signal(number)
            assert next(watch).status == NOT_SERVING
            for name in HEALTH_NAMES:
                assert health.Check(health_pb2.HealthCheckRequest(
                    service=name), timeout=30).status == NOT_SERVING
            watch.cancel()
            # Poses are taken by calls, by the stream, and by new streams.
            assert append(stub, VEHICLE, straight(1)).durable_sequence == 1
            stream.send(straight(1, first=2))
            assert stream.receive_kind("ack").durable_sequence == 2
            with PoseStream(stub, VEHICLE) as late:
                assert late.receive_kind("opened").durable_sequence == 2
            # Other signals mean what they meant.
            server.process.send_signal(signal.SIGHUP)
            server.logged("looking_at_files")
            info(stub)
            assert "draining" not in server.log()
            server.process.send_signal(number)
            assert failure_of(stream.receive).reason == "SERVER_DRAINING"
        server.close_channels()
        assert server.process.wait(30) == 0, server.log()


def test_notice_ends_by_itself(tmp_path):
    with Server(tmp_path / "store", "--drain-notice-seconds", 1.5) as server:
        info(server.stub())
        server.close_channels()
        begin = time.monotonic()
        server.process.send_signal(signal.SIGTERM)
        assert server.process.wait(30) == 0, server.log()
        assert time.monotonic() - begin >= 1.5
        server.logged("notice_of_drain")
        server.logged(" stopped ")
