"""Rows in which more comes than the server, or its device, has room for."""

import collections
import dataclasses
import functools
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
from skipped import Skipped
from stubs import PoseGraphServiceStub, api
from wire import (PoseStream, append, as_bytes, batches, decode_failure,
                  failure_of, get, list_poses, straight)

KIB, MIB = 1 << 10, 1 << 20
# How soon vehicles are unloaded, and what is freed is given back ten times as
# often.
IDLE_SECONDS = 1.5
EXHAUSTED = grpc.StatusCode.RESOURCE_EXHAUSTED
UNAVAILABLE = grpc.StatusCode.UNAVAILABLE


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


def in_window(calls, most=256):
    """Makes calls that return futures, so many at a time; answers what they
    said, in order."""
    waiting, said = [], []
    for call in calls:
        if len(waiting) == most:
            said += [future.result() for future in waiting[:most // 2]]
            del waiting[:most // 2]
        waiting.append(call())
    return said + [future.result() for future in waiting]


# ---- A device that takes a second to flush

FLUSH_SECONDS = 1.0
DEADLINE_SECONDS = 0.4
BATCH = 200
# The tenth part of what is sent at a time.
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
        except Exception as error:
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
    seconds = run.rounds(short=2, long=60)
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
        # One stream alone is more than its vehicle may have waiting; all
        # together they are more than the server may.
        senders[1].start()
        wait_until(lambda: senders[1].refusals or stop.is_set(), "QUEUE_FULL")
        for sender in senders:
            if sender is not senders[1]:
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
    assert max(late) < DEADLINE_SECONDS + 1.0, max(late)
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
                "--idle-unload-minutes", IDLE_SECONDS / 60.0,
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
                # But for what reads the store.
                wait_until(lambda: count_files(server) < files + 20,
                           "end of all")
                # To the system; connections leave some behind.
                wait_until(lambda: server.resident_bytes() - empty
                           < 8 * MIB + (full - empty) / 3, "memory given back")
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


# ---- Vehicles that nobody asks for


def add_vehicles(stub, first, last, poses):
    in_window(functools.partial(stub.CreateVehicle.future,
                                api.CreateVehicleRequest(vehicle_id=f"v{n}"))
              for n in range(first, last))
    acks = in_window(functools.partial(
        stub.AppendPoses.future,
        api.AppendPosesRequest(vehicle=f"vehicles/v{n}", poses=poses))
        for n in range(first, last))
    assert all(answer.ack.durable_sequence == len(poses) for answer in acks)


def list_all(stub):
    """How many there are, and how long each page took."""
    request = api.ListVehiclesRequest(page_size=1000)
    count, times = 0, []
    while True:
        begun = time.monotonic()
        page = stub.ListVehicles(request)
        times.append(time.monotonic() - begun)
        count += len(page.vehicles)
        if not page.next_page_token:
            return count, times
        request.page_token = page.next_page_token


@dataclasses.dataclass
class FleetFigures:
    start_seconds: float
    # Resident, before any vehicle is asked for.
    cold_bytes: int
    # What one takes that has been asked for.
    opened_bytes: float
    # Seconds: the first call on a vehicle, and a search and an append after it.
    first_calls: list
    calls: list
    pages: list


def fleet_figures(run, store, vehicles, poses):
    begun = time.monotonic()
    with Server(store, "--idle-unload-minutes", IDLE_SECONDS / 60.0) as server:
        stub = server.stub()
        assert resident(stub).resident_vehicle_count == 0
        start_seconds = time.monotonic() - begun
        count, pages = list_all(stub)
        assert count == vehicles
        # What a server takes for any vehicle at all.
        search(stub, "vehicles/v0")
        cold_bytes = settled_bytes(server)
        names = [f"vehicles/v{n}" for n in run.rng.sample(
            range(1, vehicles), 999 if run.long else 300)]
        first_calls = [seconds_of(lambda: get(stub, name)) for name in names]
        opened_bytes = (settled_bytes(server) - cold_bytes) / len(names)
        calls = []
        for name in names:
            calls.append(seconds_of(lambda: search(stub, name)))
            calls.append(seconds_of(lambda: append(stub, name, poses)))
        wait_until(lambda: resident(stub).resident_vehicle_count == 0,
                   "unloading")
    return FleetFigures(start_seconds, cold_bytes, opened_bytes, first_calls,
                        calls, pages)


def resident(stub):
    return stub.GetServerInfo(api.GetServerInfoRequest())


def search(stub, vehicle):
    return stub.FindCandidates(api.FindCandidatesRequest(vehicle=vehicle))


def grown_by_opening_all(store, vehicles, budget_mebibytes):
    """With a budget; answers by how much memory has grown at most."""
    with Server(store, "--memory-budget-mebibytes",
                budget_mebibytes) as server:
        stub = server.stub()
        search(stub, "vehicles/v0")
        start, peak = settled_bytes(server), 0
        for first in range(0, vehicles, 1000):
            in_window(functools.partial(
                stub.GetVehicle.future,
                api.GetVehicleRequest(name=f"vehicles/v{n}"))
                for n in range(first, min(first + 1000, vehicles)))
            peak = max(peak, server.resident_bytes())
        wait_until(lambda: resident(stub).resident_bytes
                   <= budget_mebibytes * MIB, "keeping of the budget")
        return peak - start


def cold_vehicles(run):
    few, many = 1000, 100000 if run.long else 3000
    poses = straight(20, spacing=3.0)
    store = run.new("fleet") / "s"
    figures = []
    for first, last in ((0, few), (few, many)):
        with Server(store, "--idle-unload-minutes",
                    IDLE_SECONDS / 60.0) as server:
            add_vehicles(server.stub(), first, last, poses)
        figures.append(fleet_figures(run, store, last, poses))
    size = sum(path.stat().st_size for path in store.iterdir())
    with_few, with_many = figures
    # As much as before, but for what SQLite caches.
    each = (with_many.cold_bytes - with_few.cold_bytes) / (many - few)
    assert with_many.cold_bytes < with_few.cold_bytes + 8 * MIB, each
    assert with_many.opened_bytes < with_few.opened_bytes + 8 * KIB
    # There are few pages, whose median is at the mercy of what else the machine
    # does; what grows with the number of vehicles is in the quickest too.
    for kind, typical in (("first_calls", statistics.median),
                          ("calls", statistics.median), ("pages", min)):
        times = [typical(getattr(of, kind)) for of in figures]
        assert times[1] < 3 * times[0] + 0.005, (kind, times)
    # A few thousand of these vehicles, and those of the second in which nobody
    # looks.
    grown = grown_by_opening_all(store, many, budget_mebibytes=4)
    assert grown < 128 * MIB, grown
    return many, (
        f"a cold vehicle takes {each:.0f} bytes ({with_few.cold_bytes / MIB:.1f} "
        f"MiB with {few}, {with_many.cold_bytes / MIB:.1f} with {many}), one "
        f"that was asked for {with_many.opened_bytes / KIB:.1f} KiB; start "
        f"{milliseconds(with_few.start_seconds)} and "
        f"{milliseconds(with_many.start_seconds)} ({size / MIB:.0f} MiB); p99 of "
        f"a first call {milliseconds(p99(with_few.first_calls))} and "
        f"{milliseconds(p99(with_many.first_calls))}, of those after "
        f"{milliseconds(p99(with_few.calls))} and "
        f"{milliseconds(p99(with_many.calls))}, of a page of 1,000 "
        f"{milliseconds(p99(with_many.pages))}; all asked for with a budget of "
        f"4 MiB of nodes: {grown / MIB:.0f} MiB at most")


ROWS = [
    ("more than a slow device takes", "12",
     "acks late, memory bounded, too much shed with RetryInfo, deadlines kept; "
     "nothing acked lost", slow_device),
    ("idle streams, many a connection", "45",
     "caps shed with QuotaFailure and RetryInfo, others served; so many bytes "
     "each", many_a_connection),
    ("idle streams, one a connection", "45", "the same", one_a_connection),
    ("very many vehicles", "46",
     "start, memory and calls as with few; so many bytes a cold one",
     cold_vehicles),
]
