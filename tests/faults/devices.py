"""Rows in which the device fails, is slow, or has no room."""

import contextlib
import os
import random
import sqlite3
import subprocess
import time

import grpc
from grpc_health.v1 import health_pb2, health_pb2_grpc

from drive_client import VEHICLE, Client, Drive, create
from kills import SETTINGS, preloaded
from revisit_server import Server, run as run_program, wait_until
from skipped import Skipped
from stubs import api
from wire import append, as_bytes, decode_failure, failure_of, get, list_poses

MIB = 1 << 20
# Codes that gRPC itself answers with at the end of a server; CANCELLED where a call
# comes just as the connections are closed.
GONE = (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.CANCELLED)


@contextlib.contextmanager
def small_disk(run, mebibytes):
    """A file system of its own."""
    if os.geteuid() != 0:
        raise Skipped("needs root, to mount a tmpfs")
    path = run.new("disk")
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={mebibytes}m", "tmpfs", path],
        capture_output=True, text=True, check=False)
    if mounted.returncode != 0:
        raise Skipped(f"cannot mount a tmpfs: {mounted.stderr.strip()}")
    try:
        yield path
    finally:
        subprocess.run(["umount", "--lazy", path], check=True)


def free_bytes(path):
    status = os.statvfs(path)
    return status.f_bavail * status.f_frsize


def fill(path, leave):
    """Takes up all but so many bytes."""
    with open(path / "ballast", "ab", buffering=0) as ballast:
        while (room := free_bytes(path) - leave) > 0:
            try:
                ballast.write(bytes(min(room, MIB)))
            except OSError:
                return


def full_failure(call):
    failure = failure_of(call)
    assert failure.code == grpc.StatusCode.RESOURCE_EXHAUSTED, failure
    assert failure.reason == "STORAGE_FULL", failure
    assert failure.retry_seconds == 30, failure
    return failure


def append_all(stub, poses, first, last):
    """In batches; answers the last sequence acknowledged and how it ended."""
    acked = first
    while acked < last:
        try:
            acked = append(stub, VEHICLE,
                           poses[acked:min(acked + 200, last)]).durable_sequence
        except grpc.RpcError as error:
            return acked, decode_failure(error)
    return acked, None


class Health:
    """What the health service says of everything, of the service, and of
    writes."""

    SERVING = health_pb2.HealthCheckResponse.SERVING
    NOT_SERVING = health_pb2.HealthCheckResponse.NOT_SERVING
    NAMES = ("", "revisit.v1.PoseGraphService",
             "revisit.v1.PoseGraphService/write")

    def __init__(self, server):
        self.stub = health_pb2_grpc.HealthStub(server.channel())

    def statuses(self):
        return [self.stub.Check(health_pb2.HealthCheckRequest(service=name),
                                timeout=30).status for name in self.NAMES]

    def await_writes(self, status):
        """Reads are served all the time."""
        wait_until(lambda: self.statuses() == [self.SERVING, self.SERVING,
                                               status], f"writes {status}")


def watermark(run):
    drive = Drive(run.seed)
    with small_disk(run, 48) as disk:
        with Server(disk / "s", "--min-free-bytes", 16 * MIB) as server:
            stub = server.stub()
            create(stub, **SETTINGS)
            acked = append(stub, VEHICLE, drive[0:200]).durable_sequence
            rounds = run.rounds(short=2, long=10)
            health = Health(server)
            for _ in range(rounds):
                health.await_writes(Health.SERVING)
                fill(disk, leave=15 * MIB)
                # Also before anybody tries to write.
                health.await_writes(Health.NOT_SERVING)
                full_failure(lambda: append(stub, VEHICLE,
                                            drive[acked:acked + 200]))
                full_failure(lambda: create(stub, "vehicles/another"))
                # Reads go on, and nothing was half done.
                assert get(stub, VEHICLE).durable_sequence == acked
                assert as_bytes(list_poses(stub, VEHICLE)) == as_bytes(
                    drive[0:acked])
                stub.FindCandidates(api.FindCandidatesRequest(vehicle=VEHICLE))
                # A little room is not enough; a quarter more than the mark is.
                os.truncate(disk / "ballast", (disk / "ballast").stat().st_size
                            - 2 * MIB)
                full_failure(lambda: append(stub, VEHICLE,
                                            drive[acked:acked + 200]))
                (disk / "ballast").unlink()
                acked = append(stub, VEHICLE,
                               drive[acked:acked + 200]).durable_sequence
            fill(disk, leave=15 * MIB)
            # What makes room is not refused.
            create_refused = full_failure(lambda: create(stub, "vehicles/b"))
            assert str(16 * MIB + 4 * MIB) in create_refused.message
            stub.DeleteVehicle(api.DeleteVehicleRequest(name=VEHICLE))
    return rounds, ("writes STORAGE_FULL with 30 s and not healthy, reads go on, "
                    "back by itself")


def without_shrinking(store):
    """As other programs may leave it: the file keeps its room."""
    database = sqlite3.connect(store / "revisit.sqlite", isolation_level=None)
    database.execute("PRAGMA journal_mode = DELETE")
    database.execute("PRAGMA auto_vacuum = NONE")
    database.execute("VACUUM")
    assert database.execute("PRAGMA auto_vacuum").fetchone()[0] == 0
    database.close()


def deletion(run):
    """Fills the disk with vehicles, and makes room by deleting alone: in a store
    that shrinks, and in one that does not."""
    drive = Drive(run.seed)
    seen = []
    for shrinks in (True, False):
        with small_disk(run, 64) as disk:
            flags = ("--min-free-bytes", 16 * MIB)
            with Server(disk / "s", *flags) as server:
                for number in range(4):
                    create(server.stub(), f"vehicles/v-{number}")
            if not shrinks:
                without_shrinking(disk / "s")
            with Server(disk / "s", *flags) as server:
                stub = server.stub()
                acked = [0] * 4
                failure = None
                while failure is None:
                    vehicle = acked.index(min(acked))
                    try:
                        first = acked[vehicle]
                        acked[vehicle] = append(
                            stub, f"vehicles/v-{vehicle}",
                            drive[first:first + 400]).durable_sequence
                    except grpc.RpcError as error:
                        failure = decode_failure(error)
                assert failure.reason == "STORAGE_FULL", failure
                full = free_bytes(disk)
                for number in range(3):
                    stub.DeleteVehicle(api.DeleteVehicleRequest(
                        name=f"vehicles/v-{number}"))

                def takes_writes():
                    try:
                        acked[3] = append(
                            stub, "vehicles/v-3",
                            drive[acked[3]:acked[3] + 10]).durable_sequence
                        return True
                    except grpc.RpcError as error:
                        assert decode_failure(error).reason == "STORAGE_FULL"
                        return False

                wait_until(takes_writes, "room from deleting")
                if shrinks:
                    wait_until(lambda: free_bytes(disk) > full + 10 * MIB,
                               "room on the disk")
                    seen.append(f"{(free_bytes(disk) - full) // MIB} MiB back")
                # And not just once: what was freed can be filled again.
                more = 0
                while more < 100 and takes_writes():
                    more += 1
                assert more == 100, more
                server.kill()
            with Server(disk / "s", *flags) as server:
                assert as_bytes(list_poses(server.stub(), "vehicles/v-3")) == \
                    as_bytes(drive[0:acked[3]])
            before = free_bytes(disk)
            compacted = run_program("revisitd", "compact", "--store", disk / "s")
            assert compacted.returncode == 0, compacted
            verified = run_program("revisitd", "verify", "--store", disk / "s")
            assert verified.returncode == 0, verified
            if not shrinks:
                assert free_bytes(disk) > before + 10 * MIB, before
                seen.append("an older store compacted: "
                            f"{(free_bytes(disk) - before) // MIB} MiB back")
            with Server(disk / "s", *flags) as server:
                assert as_bytes(list_poses(server.stub(), "vehicles/v-3")) == \
                    as_bytes(drive[0:acked[3]])
    return 2, "writes taken again after deleting; " + ", ".join(seen)


def deletion_at_the_last_byte(run):
    """Others have taken all there was: deleting works, and gives them room."""
    drive = Drive(run.seed)
    with small_disk(run, 64) as disk:
        flags = ("--min-free-bytes", 8 * MIB)
        with Server(disk / "s", *flags) as server:
            stub = server.stub()
            for name in ("vehicles/a", "vehicles/b"):
                create(stub, name)
                acked = 0
                while acked < 12000:
                    acked = append(stub, name,
                                   drive[acked:acked + 400]).durable_sequence
        with Server(disk / "s", *flags) as server:
            stub = server.stub()
            fill(disk, leave=0)
            full_failure(lambda: append(stub, "vehicles/a",
                                        drive[acked:acked + 400]))
            stub.DeleteVehicle(api.DeleteVehicleRequest(name="vehicles/b"))
            wait_until(lambda: free_bytes(disk) > MIB, "room on the disk")
            given = free_bytes(disk)
            assert as_bytes(list_poses(stub, "vehicles/a")) == as_bytes(
                drive[0:acked])
        with Server(disk / "s") as server:
            assert as_bytes(list_poses(server.stub(), "vehicles/a")) == \
                as_bytes(drive[0:acked])
    return 1, f"deleted at 0 bytes left, {given // 1024} kB back at once"


def no_space(run):
    """Without the watermark, up to the last byte."""
    drive = Drive(run.seed)
    rounds = run.rounds(short=2, long=20)
    acked = 0
    with small_disk(run, 24) as disk:
        with Server(disk / "s", "--min-free-bytes", 0) as server:
            stub = server.stub()
            create(stub, **SETTINGS)
            for _ in range(rounds):
                fill(disk, leave=run.rng.randrange(MIB // 2))
                acked, failure = append_all(stub, drive, acked, acked + 20000)
                assert failure is not None, "the disk never got full"
                assert failure.code == grpc.StatusCode.RESOURCE_EXHAUSTED
                assert failure.reason == "STORAGE_FULL"
                Health(server).await_writes(Health.NOT_SERVING)
                assert get(stub, VEHICLE).durable_sequence == acked
                assert as_bytes(list_poses(stub, VEHICLE)) == as_bytes(
                    drive[0:acked])
                (disk / "ballast").unlink()
                Health(server).await_writes(Health.SERVING)
                acked, failure = append_all(stub, drive, acked, acked + 400)
                assert failure is None, failure
            fill(disk, leave=0)
            server.kill()
        (disk / "ballast").unlink()
        with Server(disk / "s") as server:
            assert as_bytes(list_poses(server.stub(), VEHICLE)) == as_bytes(
                drive[0:acked])
    return rounds, (f"STORAGE_FULL each time, 0 of {acked} acked lost, back by "
                    "itself")


def start_on_full_disk(run):
    drive = Drive(run.seed)
    rounds = run.rounds(short=2, long=10)
    for number in range(rounds):
        with small_disk(run, 24) as disk:
            with Server(disk / "s", "--min-free-bytes", 0) as server:
                create(server.stub(), **SETTINGS)
                acked, _ = append_all(server.stub(), drive, 0, 10000)
                if number % 2 == 0:
                    server.kill()
            # The log of a killed server has yet to be copied into the database.
            fill(disk, leave=0)
            with Server(disk / "s", "--min-free-bytes",
                        0 if number % 4 < 2 else MIB) as server:
                stub = server.stub()
                assert get(stub, VEHICLE).durable_sequence == acked
                assert as_bytes(list_poses(stub, VEHICLE)) == as_bytes(
                    drive[0:acked])
                _, failure = append_all(stub, drive, acked, acked + 20000)
                assert failure is not None and failure.reason == "STORAGE_FULL"
                stored = get(stub, VEHICLE).durable_sequence
                (disk / "ballast").unlink()
                last, failure = append_all(stub, drive, stored, stored + 400)
                assert failure is None, failure
            with Server(disk / "s") as server:
                assert as_bytes(list_poses(server.stub(), VEHICLE)) == as_bytes(
                    drive[0:last])
    return rounds, "serves reads, writes STORAGE_FULL, and is back by itself"


def failing_calls(run):
    """The Nth flush or write fails, once or from there on."""
    rounds = run.rounds(short=24, long=2000)
    ends = {74: 0, 0: 0}
    acked_total = started = 0
    for number in range(rounds):
        sync = number % 4 != 3
        nth = 1 + (number if not run.long else run.rng.randrange(60))
        store = run.new("failing") / "s"
        count = store.parent / "count"
        client = Client(Drive(run.seed + number), random.Random(number))
        with Server(store) as server:
            create(server.stub(), **SETTINGS)
            append(server.stub(), VEHICLE, client.drive[0:5])
            client.acked = client.sent = 5
            # Half of them start on a log that has to be copied first.
            if number % 2:
                server.kill()
        plan = {"fail_sync" if sync else "fail_write": nth, "count": count}
        if run.rng.random() < 0.5:
            plan["sticky"] = 1
        with Server(store, env=preloaded(**plan), wait=False) as server:
            try:
                server.wait_until_listening()
            except AssertionError:
                assert count.exists(), server.log()
                assert server.process.wait() == 74, server.log()
                ends[74] += 1
            else:
                started += 1
                failure = stream_until_failure(client, server.stub(), nth + 30)
                if failure is not None and failure.reason == "STORE_SYNC_FAILED":
                    assert sync
                    assert server.process.wait(20) == 74, server.log()
                    ends[74] += 1
                elif failure is not None:
                    assert failure.reason in ("STORAGE_FULL",
                                              "SERVER_DRAINING"), failure
                server.process.terminate()
                code = server.process.wait(20)
                if failure is None or failure.reason != "STORE_SYNC_FAILED":
                    assert code in (0, 74), server.log()
                    ends[code] += 1
        with Server(store) as server:
            stored = client.verify(server.stub(), whole=True)
            acked_total += client.acked
            # And on it goes, with the same poses again.
            assert append(server.stub(), VEHICLE,
                          client.drive[client.acked:stored + 5]
                          ).durable_sequence == stored + 5
    return rounds, (f"{started} started; {ends[74]} ended with 74, {ends[0]} "
                    f"went on; lost: 0 of {acked_total} acked")


def stream_until_failure(client, stub, appends):
    """Appends in single calls, so that each is one commit; answers what the
    first one that was refused said. What comes after it must be refused too, if
    a flush has failed."""
    failure = None
    for _ in range(appends):
        first = client.acked
        client.sent = max(client.sent, first + 3)
        try:
            ack = append(stub, VEHICLE, client.drive[first:first + 3])
        except grpc.RpcError as error:
            if "grpc-status-details-bin" not in dict(error.trailing_metadata()
                                                     or ()):
                # The server has gone, or is going.
                assert error.code() in GONE, error
                return failure
            told = decode_failure(error)
            failure = failure or told
            if told.reason == "SERVER_DRAINING":
                return failure
            continue
        assert failure is None or failure.reason != "STORE_SYNC_FAILED", \
            "acknowledged after a failed flush"
        client.acked = ack.durable_sequence
    return failure


def slow_flush(run):
    rounds = run.rounds(short=3, long=20)
    delay = 0.3
    drive = Drive(run.seed)
    store = run.new("slow") / "s"
    plan = preloaded(slow_sync=int(delay * 1e6), file="-wal")
    with Server(store, env=plan) as server:
        stub = server.stub()
        create(stub, **SETTINGS)
        for number in range(rounds):
            begun = time.monotonic()
            append(stub, VEHICLE, drive[5 * number:5 * number + 5])
            assert time.monotonic() - begun >= delay
        # A caller that cannot wait gives up; the pose may be stored or not.
        with_deadline = failure_code(
            lambda: append(stub, VEHICLE,
                           drive[5 * rounds:5 * rounds + 5], timeout=0.1))
        assert with_deadline == grpc.StatusCode.DEADLINE_EXCEEDED
        assert append(stub, VEHICLE, drive[5 * rounds:5 * rounds + 5]
                      ).durable_sequence == 5 * rounds + 5
        # Others' acknowledgements wait for the same flush, not one each.
        calls = [stub.AppendPoses.future(api.AppendPosesRequest(
            vehicle=VEHICLE, poses=drive[n:n + 1]))
            for n in range(5 * rounds + 5, 5 * rounds + 65)]
        begun = time.monotonic()
        for call in calls:
            try:
                call.result()
            except grpc.RpcError as error:
                assert decode_failure(error).reason == "SEQUENCE_GAP"
        assert time.monotonic() - begun < 60 * delay / 2
    return rounds, f"no ack before {delay} s; deadlines kept; one flush for many"


def failure_code(call):
    try:
        call()
    except grpc.RpcError as error:
        return error.code()
    return None


ROWS = [
    ("disk below the watermark", "8",
     "RESOURCE_EXHAUSTED STORAGE_FULL, reads go on, back by itself", watermark),
    ("disk full, vehicles deleted", "8",
     "room in the file counts, and is given back", deletion),
    ("vehicle deleted on a disk without a byte", "8",
     "deleted, and room given back", deletion_at_the_last_byte),
    ("disk full to the last byte", "8", "the same; nothing acked lost",
     no_space),
    ("start on a full disk", "9", "reads served, writes STORAGE_FULL, no abort",
     start_on_full_disk),
    ("Nth flush or write fails", "10",
     "no ack after a failed flush, UNAVAILABLE STORE_SYNC_FAILED, exit 74; "
     "nothing acked lost", failing_calls),
    ("slow flush", "12", "late acks, none early", slow_flush),
]
