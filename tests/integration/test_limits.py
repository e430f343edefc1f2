"""What one caller may take of the server, and what the others still get."""

import contextlib
import statistics
import threading
import time

import grpc
import pytest

from revisit_server import Server, wait_until
from stubs import api
from wire import (PoseStream, append, batches, decode_failure, failure_of, get,
                  laps, straight)

EXHAUSTED = grpc.StatusCode.RESOURCE_EXHAUSTED
UNAVAILABLE = grpc.StatusCode.UNAVAILABLE


def create(stub, name="car", **settings):
    return stub.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id=name, vehicle=api.Vehicle(
            settings=api.VehicleSettings(**settings)))).vehicle.name


def fill(stub, vehicle, poses):
    for batch in batches(poses, 1000):
        append(stub, vehicle, batch)


def search(vehicle, **options):
    return api.FindCandidatesRequest(
        vehicle=vehicle, options=api.CandidateOptions(**options))


def outcomes(futures):
    """The answers, and the failures by reason."""
    answers, failures = [], {}
    for future in futures:
        try:
            answers.append(future.result())
        except grpc.RpcError as error:
            failure = decode_failure(error)
            failures.setdefault(failure.reason, []).append(failure)
    return answers, failures


# ---- Streams


@pytest.mark.parametrize("flag, code, reason", [
    ("--max-streams=2", UNAVAILABLE, "OVERLOADED"),
    ("--max-streams-per-vehicle=2", EXHAUSTED, "STREAM_QUOTA"),
    ("--max-streams-per-caller=2", EXHAUSTED, "STREAM_QUOTA"),
])
def test_stream_too_many_is_refused_until_one_ends(
        flag, code, reason, tmp_path):
    with Server(tmp_path / "store", flag) as server:
        stub = server.stub()
        vehicle = create(stub)
        with contextlib.ExitStack() as stack:
            streams = [stack.enter_context(PoseStream(stub, vehicle))
                       for _ in range(2)]
            for stream in streams:
                stream.receive_kind("opened")
            delays = set()
            for _ in range(5):
                with PoseStream(stub, vehicle) as stream:
                    failure = failure_of(stream.receive)
                assert (failure.code, failure.reason) == (code, reason)
                assert failure.metadata["limit"] == "2"
                assert 1 <= failure.retry_seconds <= 3
                delays.add(failure.retry_seconds)
            # Not all come back at once.
            assert len(delays) > 1
            # Those that are there go on.
            streams[0].send(straight(3))
            assert streams[0].receive_kind("ack").durable_sequence == 3
            streams[1].half_close()
            assert streams[1].receive() is None

            def opens():
                with PoseStream(stub, vehicle) as again:
                    try:
                        return again.receive_kind("opened")
                    except grpc.RpcError:
                        return None

            wait_until(opens, "room for a stream")


def test_revisions_and_exports_count_as_streams(tmp_path):
    with Server(tmp_path / "store", "--max-streams-per-vehicle=1") as server:
        stub = server.stub()
        vehicle = create(stub)
        append(stub, vehicle, straight(3))
        with PoseStream(stub, vehicle) as stream:
            stream.receive_kind("opened")
            for call in (
                    lambda: list(stub.ExportPoseGraph(
                        api.ExportPoseGraphRequest(vehicle=vehicle))),
                    lambda: stub.RevisePoses(iter([api.RevisePosesRequest(
                        vehicle=vehicle, poses=straight(1))]))):
                failure = failure_of(call)
                assert (failure.code, failure.reason) == (
                    EXHAUSTED, "STREAM_QUOTA")


def test_client_that_does_not_read_its_candidates_is_cut_and_can_resume(
        tmp_path):
    with Server(tmp_path / "store", "--max-unread-bytes=100000",
                "--max-streams-per-vehicle=2") as server:
        stub = server.stub()
        vehicle = create(stub, check_interval_meters=2.0,
                         sequence_length_meters=20.0)
        poses = laps(4000)
        with PoseStream(stub, vehicle, send_candidates=True,
                        candidate_options=api.CandidateOptions(
                            max_candidates=100, candidate_separation_meters=0,
                            include_aligned_path=True)) as stream:
            stream.receive_kind("opened")
            sent = 0
            # The server reads on, since acknowledgements are all written.
            for batch in batches(poses, 64):
                stream.send(batch)
                sent += len(batch)
            with pytest.raises(grpc.RpcError) as raised:
                # Comes to read only when the server has given up.
                wait_until(lambda: "SLOW_CONSUMER" in server.log(), "the cut")
                while stream.receive():
                    pass
        failure = decode_failure(raised.value)
        assert (failure.code, failure.reason) == (EXHAUSTED, "SLOW_CONSUMER")
        durable = get(stub, vehicle).durable_sequence
        assert int(failure.metadata["durable_sequence"]) <= durable <= sent
        with PoseStream(stub, vehicle) as stream:
            assert stream.receive_kind("opened").durable_sequence == durable
            if durable < len(poses):
                stream.send(poses[durable:durable + 10])
                assert (stream.receive_kind("ack").durable_sequence
                        == durable + 10)
