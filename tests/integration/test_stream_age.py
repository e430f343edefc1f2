"""--max-stream-age-seconds: streams end in order and go on, so that a balancer can
give them to other servers."""

import json
import math
import signal
import subprocess
import time

import grpc
import pytest

from revisit_server import BIN, RUN_SECONDS, Server, clean_environment
from stubs import api
from wire import PoseStream, append, decode_failure, get, list_poses, straight

PACE, SECONDS = 2000, 5
POSES = PACE * SECONDS


def line(index):
    # Rounds of 400 m, so that there is something to find.
    angle = index * 0.5 * 2 * math.pi / 400
    radius = 200 / math.pi
    yaw = math.remainder(angle + math.pi / 2, 2 * math.pi)
    return (f"{index / 20},{radius * math.cos(angle)},"
            f"{radius * math.sin(angle)},{yaw}\n")


def stream(server, pace, output):
    """Streams the drive through a pipe, by the clock if there is a pace; answers
    the summary."""
    with open(output, "w") as file:
        process = subprocess.Popen(
            [BIN / "revisit", "stream", "-", "--vehicle", "aged", "--create",
             "--candidates", "--json", "--server", server.address],
            stdin=subprocess.PIPE, stdout=file, stderr=subprocess.PIPE,
            text=True, env=clean_environment())
    process.stdin.write("t_s,est_x,est_y,est_yaw\n")
    start = time.monotonic()
    for index in range(POSES):
        if pace and index % 100 == 0:
            process.stdin.flush()
            time.sleep(max(0.0, start + index / pace - time.monotonic()))
        process.stdin.write(line(index))
    errors = process.communicate(timeout=RUN_SECONDS)[1]
    assert process.returncode == 0, errors
    return json.loads(output.read_text().splitlines()[-1])


def test_stream_that_outlives_the_age_loses_neither_poses_nor_checks(tmp_path):
    with Server(tmp_path / "young") as server:
        expected = stream(server, None, tmp_path / "young.json")
    with Server(tmp_path / "aged", "--max-stream-age-seconds=1") as server:
        summary = stream(server, PACE, tmp_path / "aged.json")
        # More than one; how many fit into the stream depends on the machine.
        assert summary["reconnects"] >= 2
        server.logged("STREAM_AGE", count=summary["reconnects"])
        stored = list_poses(server.stub(), "vehicles/aged")
    assert summary["durableSequence"] == POSES
    assert [pose.sequence for pose in stored] == list(range(1, POSES + 1))
    assert expected["checks"] > 0
    assert summary["checks"] == expected["checks"]


@pytest.fixture(scope="module")
def aged(tmp_path_factory):
    with Server(tmp_path_factory.mktemp("aged") / "store",
                "--max-stream-age-seconds=2", "--log-format=json") as server:
        yield server


@pytest.fixture(scope="module")
def vehicle(aged):
    aged.stub().CreateVehicle(api.CreateVehicleRequest(vehicle_id="raw"))
    return "vehicles/raw"


def until_the_end(stream):
    """The highest sequence that was acknowledged, and how the stream ended."""
    acked = 0
    with pytest.raises(grpc.RpcError) as raised:
        while True:
            kind, message = stream.receive()
            if kind == "ack":
                acked = message.durable_sequence
    return acked, decode_failure(raised.value)


def test_what_was_taken_is_acknowledged_before_the_end(aged, vehicle):
    stub = aged.stub()
    # More than are sent in that time.
    poses = straight(60_000)
    with PoseStream(stub, vehicle) as stream:
        for pose in poses:
            stream.send([pose])
        acked, failure = until_the_end(stream)
    assert failure.code == grpc.StatusCode.UNAVAILABLE
    assert failure.reason == "STREAM_AGE"
    assert 0 < failure.retry_seconds <= 1
    assert acked > 0
    assert get(stub, vehicle).durable_sequence == acked
    # Nobody else is held up.
    next_one = straight(1, first=acked + 1)
    assert append(stub, vehicle, next_one).durable_sequence == acked + 1


def test_idle_streams_end_too_but_not_all_together(aged, vehicle):
    streams = [PoseStream(aged.stub(), vehicle) for _ in range(20)]
    for stream in streams:
        stream.receive_kind("opened")
    for stream in streams:
        with stream:
            assert until_the_end(stream)[1].reason == "STREAM_AGE"
    calls = [json.loads(call) for call in
             aged.logged("STREAM_AGE", count=len(streams))]
    ages = sorted(call["duration_ms"] for call in calls)[-len(streams):]
    assert ages[0] >= 1800
    assert ages[-1] - ages[0] > 40


def test_stream_ends_well_before_its_age(aged, vehicle):
    with PoseStream(aged.stub(), vehicle) as stream:
        stream.receive_kind("opened")
        stream.half_close()
        assert stream.receive_all() == []


def test_server_does_not_wait_for_streams_to_get_their_age(tmp_path):
    with Server(tmp_path / "store", "--max-stream-age-seconds=100000") as server:
        stub = server.stub()
        stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id="raw"))
        with PoseStream(stub, "vehicles/raw") as stream:
            stream.receive_kind("opened")
            server.process.send_signal(signal.SIGTERM)
            assert until_the_end(stream)[1].reason == "SERVER_DRAINING"
        server.close_channels()
        assert server.process.wait(20) == 0
