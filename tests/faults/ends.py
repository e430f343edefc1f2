"""Rows in which the server is told to stop, and started again, in the middle of
trouble: it ends within the drain timeout and a second, and is back within
five."""

import contextlib
import os
import signal
import subprocess
import sys
import time

from devices import fill, small_disk
from drive_client import VEHICLE, Drive, create
from kills import SETTINGS, preloaded
from revisit_server import (BIN, Server, clean_environment, free_port,
                            wait_until)
from stubs import api
from wire import append, as_bytes, get, list_poses

DRAIN_SECONDS = 2.0
# Seconds that the promise adds to the drain timeout.
END_SECONDS = 1.0
START_SECONDS = 5.0


class Times:
    """How long ends and starts took."""

    def __init__(self, drain_seconds=DRAIN_SECONDS):
        self.drain_seconds = drain_seconds
        self.ends, self.starts = [], []

    def start(self, *arguments, **options):
        begun = time.monotonic()
        server = Server(*arguments, "--drain-timeout-seconds",
                        self.drain_seconds,
                        **options)
        self.starts.append(time.monotonic() - begun)
        assert self.starts[-1] <= START_SECONDS, self
        return server

    def stop(self, server):
        """By SIGTERM; the clients stay."""
        begun = time.monotonic()
        server.process.send_signal(signal.SIGTERM)
        code = server.process.wait(60)
        self.ends.append(time.monotonic() - begun)
        assert code == 0, (code, server.log())
        assert self.ends[-1] <= self.drain_seconds + END_SECONDS, self

    def __repr__(self):
        return (f"ended in {max(self.ends, default=0):.2f} s, started in "
                f"{max(self.starts, default=0):.2f} s at most")


def stored(server, drive, acked):
    stub = server.stub()
    assert get(stub, VEHICLE).durable_sequence == acked
    assert as_bytes(list_poses(stub, VEHICLE)) == as_bytes(drive[0:acked])


def again_and_again(run, times, start, drive, acked):
    """Stops, starts, kills and starts; each time with more poses."""
    rounds = run.rounds(short=2, long=10)
    for number in range(rounds):
        with start() as server:
            stub = server.stub()
            acked = append(stub, VEHICLE,
                           drive[acked:acked + 20]).durable_sequence
            if number % 2 == 0:
                times.stop(server)
            else:
                server.kill()
    with start() as server:
        stored(server, drive, acked)
        times.stop(server)
    return rounds, str(times)


# ---- A log that nobody reads

@contextlib.contextmanager
def blocked_pipe():
    """The writing end of a pipe that is full."""
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    with contextlib.suppress(BlockingIOError):
        while True:
            os.write(writer, b"x" * 4096)
    os.set_blocking(writer, True)
    try:
        yield writer
    finally:
        os.close(writer)
        os.close(reader)


def blocked_log(run):
    drive = Drive(run.seed)
    store = run.new("log") / "s"
    times = Times()
    with Server(store) as server:
        create(server.stub(), **SETTINGS)
        acked = append(server.stub(), VEHICLE, drive[0:20]).durable_sequence
    with blocked_pipe() as pipe:
        def start():
            return times.start(store, stderr=pipe)

        with start() as server:
            # Far more lines than a queue would hold, by as many calls at a time as
            # a vehicle may have.
            stub = server.stub()
            for _ in range(50):
                calls = [stub.GetVehicle.future(
                    api.GetVehicleRequest(name=VEHICLE), timeout=60,
                    metadata=[("x-request-id", "a" * 200)])
                    for _ in range(100)]
                for call in calls:
                    assert call.result().vehicle.durable_sequence == acked
            times.stop(server)
        return again_and_again(run, times, start, drive, acked)


# ---- A backup that runs

def running_backup(run):
    drive = Drive(run.seed)
    store = run.new("backup") / "s"
    times = Times()
    with Server(store) as server:
        stub = server.stub()
        create(stub, **SETTINGS)
        acked = 0
        # As much as a backup does not copy in a moment.
        for first in range(0, 40000, 4000):
            acked = append(stub, VEHICLE,
                           drive[first:first + 4000]).durable_sequence
        to = store.parent / "backup.sqlite"
        backup = subprocess.Popen(
            [BIN / "revisitd", "backup", "--store", store, "--to", to],
            env=clean_environment(), stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE, text=True)
        try:
            # Held in the middle of its work.
            wait_until(lambda: any(
                file.stat().st_size > 0 for file in store.parent.iterdir()
                if file.name.startswith(to.name)), "backup's file")
            backup.send_signal(signal.SIGSTOP)
            assert backup.poll() is None and not to.exists()
            times.stop(server)
            result = again_and_again(run, times, lambda: times.start(store),
                                     drive, acked)
        finally:
            backup.send_signal(signal.SIGCONT)
            _, error = backup.communicate(timeout=60)
        assert backup.returncode == 0, error
    return result


# ---- More connections than can be accepted

FLOOD = """
import socket, sys
address = ("127.0.0.1", int(sys.argv[1]))
while True:
    kept = []
    for _ in range(200):
        one = socket.socket()
        one.setblocking(False)
        one.connect_ex(address)
        kept.append(one)
    for one in kept:
        one.close()
"""


@contextlib.contextmanager
def connect_flood(port, processes=4):
    floods = [subprocess.Popen([sys.executable, "-c", FLOOD, str(port)])
              for _ in range(processes)]
    try:
        # Until they have begun; nothing announces it.
        time.sleep(0.5)
        yield
        assert all(flood.poll() is None for flood in floods)
    finally:
        for flood in floods:
            flood.kill()
            flood.wait()


def flooded(run):
    drive = Drive(run.seed)
    store = run.new("flood") / "s"
    times = Times()
    listen = f"127.0.0.1:{free_port()}"
    with Server(store, listen=listen) as server:
        create(server.stub(), **SETTINGS)
        acked = append(server.stub(), VEHICLE, drive[0:20]).durable_sequence
        with connect_flood(server.port):
            times.stop(server)
            rounds = run.rounds(short=2, long=10)
            for _ in range(rounds):
                server = times.start(store, listen=listen)
                with server:
                    time.sleep(0.3)
                    times.stop(server)
    with Server(store) as server:
        stored(server, drive, acked)
    return rounds, str(times)


# ---- A disk without room

def full_disk(run):
    drive = Drive(run.seed)
    times = Times()
    rounds = run.rounds(short=2, long=10)
    with small_disk(run, 24) as disk:
        with Server(disk / "s", "--min-free-bytes", 0) as server:
            create(server.stub(), **SETTINGS)
            acked = append(server.stub(), VEHICLE,
                           drive[0:4000]).durable_sequence
            fill(disk, leave=0)
            times.stop(server)
        for number in range(rounds):
            with times.start(disk / "s", "--min-free-bytes", 0) as server:
                stored(server, drive, acked)
                if number % 2 == 0:
                    times.stop(server)
                else:
                    server.kill()
    return rounds, str(times)


# ---- Much to read before the server can answer

LONG = 300000


def pose_bytes(sequence):
    """As AppendPosesRequest.poses holds it, put together by hand: as many poses
    as a replay takes long for would take a library longer."""
    head = api.Pose(sequence=sequence).SerializeToString()
    tail = api.Pose(
        local=api.LocalPosition(x_meters=2.0 * sequence),
        heading_radians=0.0, covariance=api.Covariance(
            form=api.COVARIANCE_FORM_PLANAR_6,
            values=(0.01, 0.0, 0.0, 0.01, 0.0, 1e-4))).SerializeToString()
    return api.AppendPosesRequest(
        poses=[api.Pose.FromString(head + tail)]).SerializeToString()


def append_many(server, count):
    send = server.channel().unary_unary(
        "/revisit.v1.PoseGraphService/AppendPoses",
        request_serializer=bytes,
        response_deserializer=api.AppendPosesResponse.FromString)
    vehicle = api.AppendPosesRequest(vehicle=VEHICLE).SerializeToString()
    for first in range(1, count + 1, 4000):
        last = min(first + 3999, count)
        ack = send(vehicle + b"".join(map(pose_bytes, range(first, last + 1))))
        assert ack.ack.durable_sequence == last


def long_replay(run):
    """The vehicle is asked for and its graph made anew when SIGTERM comes; and
    the log that a kill left is long."""
    count = run.rounds(short=LONG, long=4 * LONG)
    store = run.new("replay") / "s"
    # Who waits for the replay is not waited for.
    times = Times(drain_seconds=0.0)
    with Server(store) as server:
        create(server.stub())
        append_many(server, count)
        server.kill()
    rounds = run.rounds(short=3, long=10)
    for number in range(rounds):
        with times.start(store) as server:
            waiting = server.stub().GetVehicle.future(
                api.GetVehicleRequest(name=VEHICLE))
            if number > 0:
                time.sleep(run.rng.uniform(0.0, 0.2))
            times.stop(server)
            waiting.exception()
    with times.start(store) as server:
        begun = time.monotonic()
        assert get(server.stub(), VEHICLE).durable_sequence == count
        took = time.monotonic() - begun
    return rounds, f"{times}; the replay of {count} poses takes {took:.2f} s"


def slow_start(run):
    """A device so slow that the start alone takes long."""
    store = run.new("start") / "s"
    with Server(store) as server:
        create(server.stub(), **SETTINGS)
        server.kill()
    seconds = 20.0
    rounds = run.rounds(short=2, long=10)
    longest = 0.0
    for number in range(rounds):
        with Server(store, wait=False, env=preloaded(
                slow_sync=int(seconds * 1e6))) as server:
            # It blocks the signals first of all.
            status = f"/proc/{server.pid}/status"
            wait_until(lambda: blocks_sigterm(status), "blocked signals")
            time.sleep(0.1 * number)
            begun = time.monotonic()
            server.process.send_signal(signal.SIGTERM)
            assert server.process.wait(60) == 0, server.log()
            longest = max(longest, time.monotonic() - begun)
    assert longest <= END_SECONDS, longest
    with Server(store) as server:
        assert get(server.stub(), VEHICLE).durable_sequence == 0
    return rounds, f"ended in {longest:.2f} s where a start takes {seconds} s"


def blocks_sigterm(status):
    with open(status) as file:
        for line in file:
            if line.startswith("SigBlk:"):
                return int(line.split()[1], 16) >> (signal.SIGTERM - 1) & 1
    return False


EXPECTED = (f"SIGTERM ends it within the drain timeout + {END_SECONDS:.0f} s, "
            f"start <= {START_SECONDS:.0f} s")

ROWS = [
    ("end and start while nobody reads the log", "10",
     "calls go on; " + EXPECTED, blocked_log),
    ("end and start while a backup runs", "10", EXPECTED, running_backup),
    ("end and start in a flood of connections", "10", EXPECTED, flooded),
    ("end and start on a full disk", "10", EXPECTED, full_disk),
    ("end and start in a long replay", "10", EXPECTED, long_replay),
    ("end while it starts", "10", "SIGTERM ends it within 1 s", slow_start),
]
