"""Rows in which more comes than the server, or its device, has room for."""

import collections
import os
import resource
import socket
import statistics
import threading
import time

import grpc

from drive_client import VEHICLE, Drive, create
from kills import preloaded
from raw_http2 import (DATA, GOAWAY, RST_STREAM, SERVICE, RawConnection,
                       call_headers, frame, message)
from revisit_server import Server, wait_until
from stubs import PoseGraphServiceStub, api
from wire import (PoseStream, append, as_bytes, batches, decode_failure,
                  failure_of, get, list_poses, straight)

KIB, MIB = 1 << 10, 1 << 20
EXHAUSTED = grpc.StatusCode.RESOURCE_EXHAUSTED
UNAVAILABLE = grpc.StatusCode.UNAVAILABLE


class Skipped(Exception):
    """Replaced by the matrix's own."""


def milliseconds(seconds):
    return f"{seconds * 1e3:.1f} ms"


def p99(times):
    return sorted(times)[int(0.99 * (len(times) - 1))]


def seconds_of(call):
    begun = time.monotonic()
    call()
    return time.monotonic() - begun


def settled_bytes(server):
    """Resident memory, once it has stopped changing."""
    before = server.resident_bytes()
    for _ in range(50):
        time.sleep(0.1)
        now = server.resident_bytes()
        if abs(now - before) < 64 * KIB:
            break
        before = now
    return now


# ---- A device that takes a second to flush

FLUSH_SECONDS = 1.0
DEADLINE_SECONDS = 0.4
BATCH = 200
# Of what is sent at a time, the tenth part.
QUEUE_BYTES = MIB
QUEUE_BYTES_PER_VEHICLE = 256 * KIB


class Sender(threading.Thread):
    """Sends the drive to one vehicle, as fast as it is taken, and does what
    refusals say; never slower for a device that is."""

    def __init__(self, server, vehicle, poses, stop, timeout):
        super().__init__(daemon=True)
        self.stub = PoseGraphServiceStub(server.channel())
        self.vehicle, self.poses = vehicle, poses
        self.stop, self.timeout = stop, timeout
        self.acked = self.sent = 0
        # Whether what comes next may be stored already.
        self.in_doubt = False
        # How long acks took, of what was not in doubt.
        self.acks = []
        self.refusals = collections.Counter()
        # How long calls took that ended by their deadline.
        self.late = []
        self.error = None

    def run(self):
        try:
            while not self.stop.is_set():
                self.send()
        except Exception as error:  # pylint: disable=broad-except
            self.error = error
            self.stop.set()

    def send(self):
        last = self.acked + BATCH
        self.sent = max(self.sent, last)
        begun = time.monotonic()
        try:
            ack = append(self.stub, self.vehicle, self.poses[self.acked:last],
                         timeout=self.timeout)
        except grpc.RpcError as error:
            if error.code() == grpc.StatusCode.DEADLINE_EXCEEDED:
                self.late.append(time.monotonic() - begun)
                self.in_doubt = True
            else:
                self.wait_as_told(error)
            return
        self.acked = ack.durable_sequence
        if not self.in_doubt:
            self.acks.append(time.monotonic() - begun)
        self.in_doubt = False

    def wait_as_told(self, error):
        failure = decode_failure(error)
        code, subject = {
            "OVERLOADED": (UNAVAILABLE, "queued_bytes"),
            "QUEUE_FULL": (EXHAUSTED, self.vehicle),
        }[failure.reason]
        assert failure.code == code, failure
        assert failure.quota_subjects == [subject], failure
        assert 0.0 < failure.retry_seconds <= 3.0, failure
        self.refusals[failure.reason] += 1
        self.stop.wait(failure.retry_seconds)


class Streamer(Sender):
    """The same on streams, many batches at a time without waiting for acks,
    which is more than one vehicle may have waiting."""

    WINDOW = 16

    def send(self):
        try:
            with PoseStream(self.stub, self.vehicle,
                            acked_sequence=self.acked) as stream:
                self.stream(stream)
        except grpc.RpcError as error:
            self.wait_as_told(error)

    def stream(self, stream):
        durable = stream.receive_kind("opened").durable_sequence
        assert self.acked <= durable <= self.sent
        self.acked = durable
        sent_at = {}
        for first in range(durable, durable + self.WINDOW * BATCH, BATCH):
            self.sent = max(self.sent, first + BATCH)
            sent_at[first + BATCH] = time.monotonic()
            stream.send(self.poses[first:first + BATCH])
        stream.half_close()
        for _, ack in iter(stream.receive, None):
            self.acked = ack.durable_sequence
            self.acks.append(time.monotonic() - sent_at[self.acked])


def slow_device(run):
    seconds = run.rounds(short=4, long=60)
    # A stream gets a few batches through at each flush.
    poses = Drive(run.seed)[0:(4 * seconds + Streamer.WINDOW) * BATCH]
    store = run.new("slow") / "s"
    names = [f"vehicles/v{number}" for number in range(48)]
    with Server(store) as server:
        for name in (*names, VEHICLE):
            create(server.stub(), name)
        append(server.stub(), VEHICLE, poses[0:BATCH])
    plan = preloaded(slow_sync=int(FLUSH_SECONDS * 1e6), file="-wal")
    with Server(store, "--max-queued-bytes", QUEUE_BYTES,
                "--max-queued-bytes-per-vehicle", QUEUE_BYTES_PER_VEHICLE,
                env=plan) as server:
        stop = threading.Event()
        # A fourth of them cannot wait for a flush, a fourth streams.
        senders = [Streamer(server, name, poses, stop, None)
                   if number % 4 == 1 else
                   Sender(server, name, poses, stop,
                          DEADLINE_SECONDS if number % 4 == 0 else None)
                   for number, name in enumerate(names)]
        stub = server.stub()
        list_poses(stub, VEHICLE)
        start_bytes = settled_bytes(server)
        for sender in senders:
            sender.start()
        begun = time.monotonic()
        reads, peaks = [], [0, 0]
        while (passed := time.monotonic() - begun) < seconds \
                and not stop.wait(0.02):
            reads.append(seconds_of(lambda: list_poses(stub, VEHICLE)))
            half = int(passed >= seconds / 2)
            peaks[half] = max(peaks[half], server.resident_bytes())
        stop.set()
        for sender in senders:
            sender.join(30)
            assert not sender.is_alive(), sender.vehicle
            if sender.error is not None:
                raise sender.error
        nodes = stub.GetServerInfo(api.GetServerInfoRequest()).resident_bytes
        server.kill()

    acks = [took for sender in senders for took in sender.acks]
    late = [took for sender in senders for took in sender.late]
    refusals = sum((sender.refusals for sender in senders),
                   collections.Counter())
    assert min(acks) >= FLUSH_SECONDS, min(acks)
    assert max(late) < DEADLINE_SECONDS + 0.5, max(late)
    assert set(refusals) == {"OVERLOADED", "QUEUE_FULL"}, refusals
    # Who waits for the device does not hold up those who read.
    assert statistics.median(reads) < FLUSH_SECONDS / 4
    grown = max(peaks) - start_bytes - nodes
    assert grown < 32 * QUEUE_BYTES, grown
    assert peaks[1] - nodes < peaks[0] + 8 * QUEUE_BYTES, peaks
    acked = 0
    with Server(store) as server:
        stub = server.stub()
        for sender in senders:
            durable = get(stub, sender.vehicle).durable_sequence
            assert sender.acked <= durable <= sender.sent
            assert as_bytes(list_poses(stub, sender.vehicle)) == as_bytes(
                poses[0:durable])
            acked += sender.acked
    return seconds, (
        f"{len(acks)} acks after {min(acks):.2f} to {max(acks):.2f} s; shed: "
        f"{refusals['OVERLOADED']} OVERLOADED, {refusals['QUEUE_FULL']} "
        f"QUEUE_FULL; {len(late)} deadlines of {DEADLINE_SECONDS} s kept within "
        f"{milliseconds(max(late) - DEADLINE_SECONDS)}; reads "
        f"{milliseconds(statistics.median(reads))}; at most {grown / MIB:.0f} "
        f"MiB with a queue of {QUEUE_BYTES / MIB:.0f}; lost: 0 of {acked} acked")


# ---- Streams that say nothing

STREAM_HEADERS = call_headers(f"{SERVICE}/StreamPoses")
PER_VEHICLE = 20


class IdleStreams:
    """Streams that were opened and say nothing. Put together by hand: a library
    would keep more for each than the server does."""

    def __init__(self, server, per_connection):
        self.server, self.per_connection = server, per_connection
        self.connections = []

    def open(self, vehicles, source="127.0.0.1"):
        """A stream for each name, so many a connection; returns when all have
        been told that they are open."""
        for names in batches(vehicles, self.per_connection):
            connection = RawConnection(self.server.port, source=source)
            connection.socket.setsockopt(socket.IPPROTO_TCP,
                                         socket.TCP_NODELAY, 1)
            self.connections.append(connection)
            for number, name in enumerate(names):
                begin_stream(connection, 2 * number + 1, name)
            opened = {received.stream_id
                      for received in messages(connection, len(names))}
            assert len(opened) == len(names)

    def close(self):
        for connection in self.connections:
            connection.close()
        self.connections.clear()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


def begin_stream(connection, stream, vehicle):
    request = api.StreamPosesRequest(open=api.StreamPosesOpen(vehicle=vehicle))
    connection.request(STREAM_HEADERS, message(request.SerializeToString()),
                       stream, end=0)


def append_on(connection, poses):
    """On the first stream of a connection; answers what is durable."""
    request = api.StreamPosesRequest(batch=api.PoseBatch(poses=poses))
    connection.send(frame(DATA, message(request.SerializeToString()), stream=1))
    answer, = messages(connection, 1)
    return api.StreamPosesResponse.FromString(
        answer.data[5:]).ack.durable_sequence


def messages(connection, count):
    """The next ones from the server, as frames."""
    left = count
    for received in connection.frames(seconds=30):
        assert received is not None, "the connection was closed"
        assert received.type not in (GOAWAY, RST_STREAM), received
        if received.type == DATA:
            yield received
            left -= 1
            if left == 0:
                return
    raise AssertionError(f"{left} of {count} messages did not come")


def check_refused(stub, vehicle, reason, subject, limit):
    with PoseStream(stub, vehicle) as stream:
        failure = failure_of(stream.receive)
    assert failure.reason == reason, failure
    assert failure.code == (UNAVAILABLE if reason == "OVERLOADED"
                            else EXHAUSTED), failure
    assert failure.quota_subjects == [subject], failure
    assert failure.metadata["limit"] == str(limit), failure
    assert 1.0 <= failure.retry_seconds <= 3.0, failure


def need_descriptors(count):
    """Lets this process, and the servers it starts, open so many files."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft >= count:
        return
    try:
        resource.setrlimit(resource.RLIMIT_NOFILE, (count, max(hard, count)))
    except (ValueError, OSError):
        raise Skipped(f"needs {count} descriptors, may have {hard}") from None


def idle_streams(run, count, per_connection):
    # The server gives three quarters of its descriptors to connections.
    need_descriptors(count // per_connection * 4 // 3 + 200)
    # Few: what a vehicle takes is another matter.
    vehicles = [f"vehicles/v{number}" for number in range(count // PER_VEHICLE)]
    names = vehicles * PER_VEHICLE
    with Server(run.new("idle") / "s", "--max-streams", count,
                "--max-streams-per-caller", count - 10,
                "--max-streams-per-vehicle", PER_VEHICLE,
                "--max-concurrent-streams", per_connection,
                "--keepalive-seconds", 3600) as server:
        stub = server.stub()
        for name in (*vehicles, VEHICLE):
            create(stub, name)
        append(stub, VEHICLE, straight(1))
        with IdleStreams(server, per_connection) as idle:
            idle.open(names[:1])
            empty = settled_bytes(server)
            files = count_files(server)
            begun = time.monotonic()
            idle.open(names[1:-11])
            took = time.monotonic() - begun
            full = settled_bytes(server)
            each = (full - empty) / (count - 12)

            check_refused(stub, names[0], "STREAM_QUOTA", names[0], PER_VEHICLE)
            idle.open(names[-11:-10])
            check_refused(stub, VEHICLE, "STREAM_QUOTA", "caller", count - 10)
            # Another caller may still have some, until the server has enough.
            idle.open(names[-10:], source="127.0.0.2")
            check_refused(stub, VEHICLE, "OVERLOADED", "streams", count)
            # More than a connection may carry costs that connection.
            broken = idle.connections.pop(1)
            begin_stream(broken, 2 * per_connection + 1, VEHICLE)
            assert broken.outcome(2 * per_connection + 1) == "closed"
            broken.close()

            # Who sends is served as ever, and who comes finds room again.
            calls = [seconds_of(lambda n=n: append(stub, VEHICLE,
                                                   straight(1, first=n)))
                     for n in range(2, 302)]
            for connection in run.rng.sample(idle.connections,
                                             min(100, len(idle.connections))):
                assert append_on(connection, straight(1)) == 1
            with PoseStream(stub, VEHICLE) as stream:
                stream.receive_kind("opened")
            # They come and go, and it takes no more each time.
            again = []
            for _ in range(3):
                idle.close()
                wait_until(lambda: count_files(server) <= files, "end of all")
                left = settled_bytes(server) - empty
                idle.open(names[:-10])
                again.append(settled_bytes(server) - empty)
            assert again[2] < 1.15 * again[1] + MIB, again
    return count, (
        f"{each / KIB:.1f} KiB a stream, {per_connection} to a connection; all "
        f"open in {took:.1f} s; p99 of an append beside them "
        f"{milliseconds(p99(calls))}; {left / MIB:.0f} MiB left when they were "
        f"gone; opened again: {again[2] / (count - 10) / KIB:.1f} KiB each; shed: "
        "STREAM_QUOTA of vehicle and caller, OVERLOADED; one too many on a "
        "connection: that one is closed")


def count_files(server):
    return len(os.listdir(f"/proc/{server.pid}/fd"))


def many_a_connection(run):
    return idle_streams(run, 20000 if run.long else 1000, 200)


def one_a_connection(run):
    return idle_streams(run, 10000 if run.long else 400, 1)


ROWS = [
    ("more than a slow device takes", "12",
     "acks late, memory bounded, too much shed with RetryInfo, deadlines kept; "
     "nothing acked lost", slow_device),
    ("idle streams, many a connection", "45",
     "caps shed with QuotaFailure and RetryInfo, others served; so many bytes "
     "each", many_a_connection),
    ("idle streams, one a connection", "45", "the same", one_a_connection),
]
