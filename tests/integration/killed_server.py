"""A stream of the command line whose server is killed under it, behind a proxy."""

import json
import subprocess

import grpc

from revisit_server import BIN, RUN_SECONDS, clean_environment, wait_until
from wire import list_poses

# Enough that the kill comes long before the end.
POSES = 50_000


def write_drive(path):
    with open(path, "w") as file:
        file.write("t_s,est_x,est_y,est_yaw\n")
        file.writelines(f"{i},{i * 0.5},0,0\n" for i in range(POSES))
    return path


def stream_through_a_kill(drive, vehicle, flags, durable, kill, start):
    """Streams the drive by `revisit stream` with these flags. Kills the server by
    `kill()` once `durable()` tells of poses, and starts it again by `start()`;
    answers the summary that the stream ended with."""

    def has_begun():
        try:
            return durable() > 0
        except grpc.RpcError:
            # The vehicle is not created yet.
            return False

    process = subprocess.Popen(
        [BIN / "revisit", "stream", drive, "--vehicle", vehicle, "--batch", "1",
         "--json", *map(str, flags)],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env=clean_environment())
    try:
        wait_until(has_begun, "durable pose")
        kill()
        assert process.poll() is None, "the stream was over before the kill"
        start()
        out, errors = process.communicate(timeout=RUN_SECONDS)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 0, errors
    return json.loads(out)


def check_is_reset(error):
    """That this is how gRPC tells of a call that a proxy has reset."""
    assert error.code() == grpc.StatusCode.INTERNAL
    assert "grpc-status-details-bin" not in dict(error.trailing_metadata() or ())


def check_all_is_stored_once(summary, stub, vehicle):
    assert summary["reconnects"] >= 1
    assert summary["durableSequence"] == POSES
    stored = [(pose.sequence, pose.local.x_meters)
              for pose in list_poses(stub, vehicle)]
    assert stored == [(i + 1, i * 0.5) for i in range(POSES)]
