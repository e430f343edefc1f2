"""Rows with a second server, and with the end of the first."""

import asyncio
import collections
import os
import signal
import sqlite3
import time

import grpc
from grpc._cython import cygrpc

from devices import GONE
from drive_client import VEHICLE, Drive, create
from revisit_server import Server, free_port, run as run_program
from stubs import PoseGraphServiceStub, api
from wire import append, as_bytes, decode_failure, get, list_poses

STREAMS = 300
CHANNELS = 10
# Share of the streams that the server has to tell that it ends. gRPC cuts the
# rest: those that come just as the connections are closed.
LEAST_TOLD = 0.9
# Share of the streams whose end gRPC for Python may keep to itself: now and then
# it makes up a status of its own, or none at all on a busy machine.
MOST_DEAF = 0.02


def second_server(run):
    store = run.new("second") / "s"
    with Server(store) as first:
        stub = first.stub()
        create(stub)
        append(stub, VEHICLE, Drive(run.seed)[0:10])
        alias = store.parent / "alias"
        alias.symlink_to(store)
        for path in (store, alias, store / "revisit.sqlite"):
            result = run_program("revisitd", "--listen", "127.0.0.1:0",
                                 "--store", path)
            assert result.returncode == 73, result
            assert str(first.pid) in result.stderr, result
        append(stub, VEHICLE, Drive(run.seed)[10:20])
        # A lock file that a dead server left, naming somebody else.
        first.kill()
    (store / "revisit.sqlite.lock").write_text(f"{os.getpid()}\n")
    with Server(store) as third:
        assert get(third.stub(), VEHICLE).durable_sequence == 20
    return 4, "exit 73 naming the first's pid, by any name; stale lock: served"


def killed_beside_a_backup(run):
    """A backup that goes on holds the log of the killed server."""
    drive = Drive(run.seed)
    rounds = run.rounds(short=2, long=10)
    store = run.new("beside") / "s"
    slowest = 0.0
    acked = 0
    with Server(store) as server:
        create(server.stub())
    for _ in range(rounds):
        with Server(store) as server:
            acked = append(server.stub(), VEHICLE,
                           drive[acked:acked + 300]).durable_sequence
            # Reads as a backup does, for as long as it likes.
            backup = sqlite3.connect(
                f"file:{store}/revisit.sqlite?mode=ro", uri=True,
                isolation_level=None)
            backup.execute("BEGIN")
            batches = backup.execute("SELECT count(*) FROM batches").fetchone()
            acked = append(server.stub(), VEHICLE,
                           drive[acked:acked + 300]).durable_sequence
            server.kill()
        for _ in range(2):
            begun = time.monotonic()
            with Server(store) as server:
                slowest = max(slowest, time.monotonic() - begun)
                stub = server.stub()
                assert as_bytes(list_poses(stub, VEHICLE)) == as_bytes(
                    drive[0:acked])
                acked = append(stub, VEHICLE,
                               drive[acked:acked + 30]).durable_sequence
                server.kill()
        assert batches == backup.execute(
            "SELECT count(*) FROM batches").fetchone()
        backup.execute("COMMIT")
        backup.close()
        with Server(store) as server:
            assert get(server.stub(), VEHICLE).durable_sequence == acked
    assert slowest < 5.0, slowest
    verified = run_program("revisitd", "verify", "--store", store)
    assert verified.returncode == 0, verified
    return 2 * rounds, f"back after {slowest:.2f} s at most, nothing lost"


class Vehicle:
    """One stream, kept up over restarts, and what it has been told."""

    def __init__(self, number, seed):
        self.name = f"vehicles/fleet-{number}"
        self.drive = Drive(seed * 1000 + number)
        self.acked = 0
        self.sent = 0
        # When it was last answered, and why each stream ended.
        self.opened_at = []
        self.ends = []
        self.call = None
        self.is_forgotten = False

    async def live(self, stub, stop):
        while not stop.is_set():
            call = self.call = stub.StreamPoses(wait_for_ready=True)
            try:
                await self.stream(call, stop)
            except asyncio.CancelledError:
                if not self.is_forgotten:
                    raise
                self.is_forgotten = False
                self.ends.append("library")
            except (grpc.aio.AioRpcError, asyncio.InvalidStateError):
                # Whatever it hit upon, the status tells why.
                error = await error_of(call)
                assert error.code() in GONE or is_of_the_library(error), error
                details = dict(error.trailing_metadata() or ())
                self.ends.append(
                    decode_failure(error).reason
                    if "grpc-status-details-bin" in details
                    else "library" if is_of_the_library(error)
                    else "transport")
                await asyncio.sleep(0.02)

    def cancel_forgotten_call(self):
        """Cancels a call whose server has ended, should gRPC for Python not end
        it: now and then, on a busy machine, it hears nothing of the end."""
        print(f"gRPC did not notice the end of the server: {self.name}")
        self.is_forgotten = True
        self.call.cancel()

    async def stream(self, call, stop):
        await call.write(api.StreamPosesRequest(open=api.StreamPosesOpen(
            vehicle=self.name, acked_sequence=self.acked)))
        opened = (await self.read(call)).opened
        self.opened_at.append(time.monotonic())
        assert self.acked <= opened.durable_sequence <= self.sent
        next_sequence = opened.durable_sequence + 1
        self.acked = opened.durable_sequence
        while not stop.is_set():
            last = next_sequence + 4
            self.sent = max(self.sent, last)
            await write(call, api.StreamPosesRequest(batch=api.PoseBatch(
                poses=self.drive[next_sequence - 1:last])))
            next_sequence = last + 1
            while self.acked < last:
                response = await self.read(call)
                if response.WhichOneof("message") == "ack":
                    self.acked = response.ack.durable_sequence
            await asyncio.sleep(0.05)
        await call.done_writing()
        while (response := await call.read()) is not grpc.aio.EOF:
            if response.WhichOneof("message") == "ack":
                self.acked = response.ack.durable_sequence

    @staticmethod
    async def read(call):
        response = await call.read()
        if response is grpc.aio.EOF:
            raise await error_of(call)
        return response


async def write(call, request):
    """As call.write(), but for a call that has just ended: there that one makes up
    a status, by which nobody learns any more what the server has said."""
    try:
        await call._cython_call.send_serialized_message(
            request.SerializeToString())
    except cygrpc.InternalError:
        raise await error_of(call) from None


def is_of_the_library(error):
    """What grpc.aio makes up by itself when an operation comes too late for a
    call that has just ended: no status of the server's."""
    return (error.code() == grpc.StatusCode.INTERNAL
            and error.details() == "Internal error from Core")


async def error_of(call):
    # As pairs, which is how callers that do not wait get them.
    trailing = tuple(await call.trailing_metadata() or ())
    return grpc.aio.AioRpcError(
        await call.code(), await call.initial_metadata(), trailing,
        await call.details())


class Lateness:
    """How late the client itself comes to what it has to do."""

    def __init__(self):
        self.seconds = 0.0

    async def watch(self):
        while True:
            due = time.monotonic() + 0.01
            await asyncio.sleep(0.01)
            self.seconds += time.monotonic() - due


def rolling_restart(run):
    rounds = run.rounds(short=2, long=20)
    store = run.new("rolling") / "s"
    seen = asyncio.run(restart(run, store, rounds))
    return rounds, seen


async def wait_for_all(tasks, vehicles, condition):
    """Waits until a condition holds for the number of each vehicle; returns the
    numbers of those that had to be helped."""
    begun = time.monotonic()
    forgotten = []
    while missing := [n for n in range(len(vehicles)) if not condition(n)]:
        for task in tasks:
            if task.done():
                task.result()
        waited = time.monotonic() - begun
        assert waited < 30, [vehicles[n].name for n in missing]
        if waited > 10 and not forgotten:
            forgotten = missing
            for n in forgotten:
                vehicles[n].cancel_forgotten_call()
        await asyncio.sleep(0.01)
    return forgotten


async def restart(run, store, rounds):
    port = free_port()
    server = Server(store, listen=f"127.0.0.1:{port}")
    vehicles = [Vehicle(number, run.seed) for number in range(STREAMS)]
    for vehicle in vehicles:
        create(server.stub(), vehicle.name)
    server.close_channels()
    options = [("grpc.initial_reconnect_backoff_ms", 50),
               ("grpc.min_reconnect_backoff_ms", 50),
               ("grpc.max_reconnect_backoff_ms", 200),
               ("grpc.use_local_subchannel_pool", 1)]
    channels = [grpc.aio.insecure_channel(f"127.0.0.1:{port}", options=options)
                for _ in range(CHANNELS)]
    stubs = [PoseGraphServiceStub(channel) for channel in channels]
    stop = asyncio.Event()
    tasks = [asyncio.create_task(vehicle.live(stubs[n % CHANNELS], stop))
             for n, vehicle in enumerate(vehicles)]
    lateness = Lateness()
    tasks.append(asyncio.create_task(lateness.watch()))
    slowest_back = slowest_end = started = late_before = 0.0
    ends, forgotten = [], []
    loop = asyncio.get_running_loop()
    try:
        for number in range(rounds + 1):
            await wait_for_all(
                tasks, vehicles, lambda n: len(vehicles[n].opened_at) > number)
            if number > 0:
                back = max(vehicle.opened_at[number]
                           for n, vehicle in enumerate(vehicles)
                           if n not in forgotten) - started
                # What 300 streams in one busy process take for themselves is
                # none of the server's.
                slowest_back = max(slowest_back,
                                   back - (lateness.seconds - late_before))
            if number == rounds:
                break
            await asyncio.sleep(0.5)
            begun = time.monotonic()
            ends_before = [len(vehicle.ends) for vehicle in vehicles]
            server.process.send_signal(signal.SIGTERM)
            code = await loop.run_in_executor(None, server.process.wait, 30)
            assert code == 0, server.log()
            slowest_end = max(slowest_end, time.monotonic() - begun)
            server.close()
            server = await loop.run_in_executor(
                None, lambda: Server(store, listen=f"127.0.0.1:{port}"))
            started = time.monotonic()
            late_before = lateness.seconds
            # The first of each: some try the server again that is ending.
            forgotten = await wait_for_all(
                tasks, vehicles,
                lambda n: len(vehicles[n].ends) > ends_before[n])
            ends += [vehicle.ends[before]
                     for vehicle, before in zip(vehicles, ends_before)]
        stop.set()
        tasks.pop().cancel()
        await asyncio.wait_for(asyncio.gather(*tasks), 30)
        for channel in channels:
            await channel.close()
        stub = server.stub()
        poses = 0
        for vehicle in vehicles:
            durable = get(stub, vehicle.name).durable_sequence
            # Drained, not cut: what was stored was acknowledged too.
            assert durable == vehicle.acked > 0, (durable, vehicle.acked)
            assert as_bytes(list_poses(stub, vehicle.name)) == as_bytes(
                vehicle.drive[0:durable])
            poses += durable
    finally:
        for task in tasks:
            task.cancel()
        server.close()
    # Each stream has heard of each end in one of these ways.
    heard = collections.Counter(ends)
    assert heard.keys() <= {"SERVER_DRAINING", "transport", "library"}, heard
    told, cut, deaf = (heard[way] for way in (
        "SERVER_DRAINING", "transport", "library"))
    every = STREAMS * rounds
    assert told + cut + deaf == every, heard
    assert told >= LEAST_TOLD * every, heard
    assert deaf <= MOST_DEAF * every, heard
    assert slowest_end <= 20
    assert slowest_back <= 1.0, slowest_back
    return (f"{STREAMS} streams, {poses} poses: none lost, none doubled; drained "
            f"in {slowest_end:.2f} s, all back {slowest_back:.2f} s after the "
            f"start; {told} told SERVER_DRAINING, {cut} cut by gRPC, {deaf} told "
            "nothing by gRPC for Python")


ROWS = [
    ("second server on the store", "13", "exit 73 naming the pid, first unharmed",
     second_server),
    ("killed beside a backup", "1", "back within 5 s, nothing lost",
     killed_beside_a_backup),
    ("rolling restart under 300 streams", "16",
     "no ack lost, no pose doubled, back within 1 s", rolling_restart),
]
