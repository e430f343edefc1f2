"""A stream holds no more than it is allowed to, waits for a server that is slow, and
leaves a connection on which nothing comes any more."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
import time

import pytest

import revisit
from conftest import LONG, straight
from revisit import BackoffOptions, StreamCallbacks, StreamOptions
from revisit_server import wait_until

WAITING = """
import sys, threading, time
import numpy as np
import revisit
client = revisit.Client(sys.argv[1])
count = 100_000
poses = revisit.Poses.local(*np.zeros((3, count)), np.tile([1.0, 0, 0, 1, 0, 1],
                            (count, 1)), sequence=np.arange(1, count + 1))
try:
    with client.stream_poses(sys.argv[2], revisit.StreamOptions(
            max_pending_poses=10)) as stream:
        stream.wait_until_opened()
        print("opened", flush=True)
        sys.stdin.readline()

        def tell():
            while stream.pending_poses < 10:
                time.sleep(0.001)
            print("full", flush=True)

        threading.Thread(target=tell, daemon=True).start()
        stream.append(poses)
except KeyboardInterrupt:
    print("interrupted,", stream.acked_sequence, "acknowledged", flush=True)
"""


@contextlib.contextmanager
def over_a_stopped_server(source, server, vehicle):
    """A program that has opened a stream, after which its server was stopped."""
    program = subprocess.Popen(
        [sys.executable, "-c", source, server.address, vehicle],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert program.stdout.readline() == "opened\n"
        os.kill(server.pid, signal.SIGSTOP)
        yield program
    finally:
        os.kill(server.pid, signal.SIGCONT)
        program.kill()
        program.wait()


def test_a_program_that_waits_for_room_can_be_interrupted(server, new_vehicle):
    with over_a_stopped_server(WAITING, server, new_vehicle()) as program:
        program.stdin.write("\n")
        program.stdin.flush()
        assert program.stdout.readline() == "full\n"
        program.send_signal(signal.SIGINT)
        rest, _ = program.communicate(timeout=LONG)
    assert rest == "interrupted, 0 acknowledged\n"


#: What the main thread may wait for; it is told first that the server has been stopped.
WAITS = {
    "opening": "client.stream_poses(vehicle).wait_until_opened()",
    "room": "stream.append(poses)",
    "the end": "stream.append(poses[:5]); stream.finish()",
    "candidates": "next(stream.candidates())",
    "events": "next(watch)",
}
LOST = """
import _thread, sys, threading, time
import numpy as np
import revisit
client = revisit.Client(sys.argv[1])
vehicle = sys.argv[2]
poses = revisit.Poses.local(*np.zeros((3, 100)), np.tile([1.0, 0, 0, 1, 0, 1],
                            (100, 1)), sequence=np.arange(1, 101))
stream = client.stream_poses(vehicle, revisit.StreamOptions(
    max_pending_poses=10, send_candidates=True))
stream.wait_until_opened()
watch = client.watch(vehicle)
print("opened", flush=True)
sys.stdin.readline()

def interrupt():
    # As the system interrupts, but it wakes nobody who waits for a lock.
    time.sleep(0.2)
    _thread.interrupt_main()

threading.Thread(target=interrupt, daemon=True).start()
try:
    WAIT
except KeyboardInterrupt:
    print("interrupted", flush=True)
"""


@pytest.mark.parametrize("what", WAITS)
def test_an_interrupt_is_heard_that_comes_as_a_wait_begins(server, new_vehicle, what):
    source = LOST.replace("WAIT", WAITS[what])
    with over_a_stopped_server(source, server, new_vehicle()) as program:
        rest, _ = program.communicate("\n", timeout=LONG)
    assert rest == "interrupted\n"


def test_a_slow_server_makes_append_wait(server, client, new_vehicle, in_thread):
    vehicle = new_vehicle()
    options = StreamOptions(max_pending_poses=100, batch_poses=10, answer_timeout=LONG)
    with client.stream_poses(vehicle, options) as stream:
        stream.wait_until_opened(LONG)
        os.kill(server.pid, signal.SIGSTOP)
        try:
            appended = threading.Event()

            def append():
                stream.append(straight(1000))
                appended.set()

            done = in_thread(append)
            wait_until(lambda: stream.pending_poses == 100, "full stream")
            assert not appended.wait(0.5)
            assert stream.pending_poses == 100
        finally:
            os.kill(server.pid, signal.SIGCONT)
        done()
        stream.finish()
        assert stream.reconnects == 0
    assert len(client.poses(vehicle)) == 1000


def test_try_append_takes_all_poses_or_none(server, client, new_vehicle):
    vehicle = new_vehicle()
    with client.stream_poses(vehicle, StreamOptions(max_pending_poses=10)) as stream:
        stream.wait_until_opened(LONG)
        os.kill(server.pid, signal.SIGSTOP)
        try:
            assert stream.try_append(straight(6))
            assert not stream.try_append(straight(6, first=7))
            assert stream.try_append(straight(4, first=7))
            assert not stream.try_append(straight(1, first=11))
        finally:
            os.kill(server.pid, signal.SIGCONT)
        stream.append(straight(10, first=11))
    assert len(client.poses(vehicle)) == 20


@pytest.mark.parametrize("form", [lambda poses: poses,
                                  lambda poses: list(poses.to_messages())],
                         ids=["arrays", "messages"])
def test_bytes_bound_what_is_held_as_poses_do(server, client, new_vehicle, in_thread,
                                              form):
    vehicle = new_vehicle()
    with client.stream_poses(vehicle, StreamOptions(max_pending_bytes=5000)) as stream:
        stream.wait_until_opened(LONG)
        os.kill(server.pid, signal.SIGSTOP)
        try:
            done = in_thread(stream.append, form(straight(500)))
            wait_until(lambda: stream.pending_bytes > 4500, "full stream")
            time.sleep(0.2)
            assert stream.pending_bytes <= 5000
        finally:
            os.kill(server.pid, signal.SIGCONT)
        done()
    assert len(client.poses(vehicle)) == 500
    with client.stream_poses(vehicle, StreamOptions(max_pending_bytes=10)) as stream:
        with pytest.raises(revisit.InvalidArgument, match="sequence 501 takes"):
            stream.append(form(straight(1, first=501)))


def test_a_server_that_stands_still_is_left_for_a_new_connection(
        server, client, new_vehicle):
    vehicle = new_vehicle()
    lost = []
    options = StreamOptions(answer_timeout=0.3,
                            backoff=BackoffOptions(initial=0.01, max=0.2))
    callbacks = StreamCallbacks(disconnected=lambda error, wait: lost.append(error))
    with client.stream_poses(vehicle, options, callbacks) as stream:
        stream.wait_until_opened(LONG)
        os.kill(server.pid, signal.SIGSTOP)
        try:
            stream.append(straight(10))
            wait_until(lambda: stream.reconnects >= 2, "new connection")
        finally:
            os.kill(server.pid, signal.SIGCONT)
        stream.finish()
    assert isinstance(lost[0], revisit.Unavailable)
    assert lost[0].message == "no answer for 0.3 s"
    assert lost[0].request_id
    assert len(client.poses(vehicle)) == 10


def test_an_idle_stream_is_not_taken_for_a_stall(client, new_vehicle):
    with client.stream_poses(
            new_vehicle(), StreamOptions(answer_timeout=0.2)) as stream:
        stream.append(straight(10))
        wait_until(lambda: stream.acked_sequence == 10, "acknowledgement")
        # A busy machine may have been late with it.
        before = stream.reconnects
        time.sleep(0.7)
        assert stream.reconnects == before
        stream.append(straight(10, first=11))
        stream.finish()
