"""Rows in which the server is killed."""

import random
import shutil
import signal
import time

from drive_client import VEHICLE, Client, Drive, create
from revisit_server import BIN, Server, clean_environment
from wire import append, as_bytes, get, list_poses

# Short, so that kills also fall into searches.
SETTINGS = {"sequence_length_meters": 20.0, "check_interval_meters": 10.0,
            "node_spacing_meters": 1.0}


def preloaded(**plan):
    """An environment in which calls fail; see shim.cc."""
    return clean_environment(
        LD_PRELOAD=str(BIN / "fault_shim.so"),
        **{f"REVISIT_TEST_{name.upper()}": str(value)
           for name, value in plan.items()})


def new_client(run):
    return Client(Drive(run.seed), random.Random(run.rng.random()))


def kill_in_stream(run):
    rounds = run.rounds(short=12, long=200)
    store = run.new("kill") / "store"
    client = new_client(run)
    with Server(store) as server:
        create(server.stub(), **SETTINGS)
    longest = 0.0
    in_stream = unacknowledged = 0
    for number in range(rounds):
        begun = time.monotonic()
        with Server(store, wait=False) as server:
            if number % 8 == 7:
                # While it starts and looks at what the last kill left.
                time.sleep(run.rng.uniform(0.0, 0.04))
                server.kill()
                continue
            server.wait_until_listening()
            longest = max(longest, time.monotonic() - begun)
            stub = server.stub()
            durable = client.verify(stub, whole=number % 10 == 9)
            unacknowledged += durable - client.acked
            assert not client.stream(server, kill_after=run.rng.uniform(
                0.05, 3.0 if run.long else 0.3))
            assert server.process.wait() == -signal.SIGKILL
            in_stream += 1
    with Server(store) as server:
        end = client.sent + 100
        client.verify(server.stub(), whole=True)
        assert client.stream(server, until=end)
        assert client.verify(server.stub(), whole=True) == end
    assert longest < 5.0
    return rounds, (f"0 lost of {client.acked} acked; {in_stream} kills in "
                    f"mid-stream; {unacknowledged} stored before their ack; "
                    f"longest start {longest * 1e3:.0f} ms")


def kill_before_ack(run):
    rounds = run.rounds(short=4, long=50)
    resent = 0
    for number in range(rounds):
        store = run.new("ack") / "store"
        client = Client(Drive(run.seed + number), run.rng)
        with Server(store) as server:
            create(server.stub(), **SETTINGS)
        # Only flushes of the log count: a kill between a commit and its
        # acknowledgement. The first flush is that of the log's header.
        plan = preloaded(file="-wal", kill_sync=run.rng.randint(2, 20))
        with Server(store, env=plan) as server:
            assert not client.stream(server)
            assert server.process.wait() == -signal.SIGKILL
        with Server(store) as server:
            stub = server.stub()
            durable = client.verify(stub, whole=True)
            resent += durable - client.acked
            # What was not acknowledged is sent again, as it was.
            revision = get(stub, VEHICLE).revision
            poses = client.drive[client.acked:durable]
            assert poses, "nothing was committed before the kill"
            assert append(stub, VEHICLE, poses).durable_sequence == durable
            assert get(stub, VEHICLE).revision == revision
            assert as_bytes(list_poses(stub, VEHICLE)) == as_bytes(
                client.drive[0:durable])
    return rounds, (f"{resent} poses committed and not acked; sent again: the "
                    "same ack, nothing doubled")


def kill_while_starting(run):
    """At each flush of a start on what a kill left, twice in a row."""
    rounds = 0
    client = new_client(run)
    left = run.new("start") / "store"
    with Server(left) as server:
        create(server.stub(), **SETTINGS)
        client.stream(server, kill_after=0.3)
        server.process.wait()
    for nth in range(1, 40):
        store = run.new("again") / "store"
        shutil.copytree(left, store)
        for _ in range(2):
            with Server(store, wait=False,
                        env=preloaded(kill_sync=nth)) as server:
                try:
                    server.wait_until_listening()
                    survived = True
                except AssertionError:
                    survived = False
                server.kill()
            rounds += 1
        with Server(store) as server:
            client.verified = 0
            client.verify(server.stub(), whole=True)
        if survived:
            break
    assert survived and nth > 1, "no flush was hit"
    return rounds, (f"killed at each of {nth - 1} flushes, then again; next "
                    "start works")


ROWS = [
    ("kill -9 in mid-stream", "1", "every acked pose, a prefix, start <= 5 s",
     kill_in_stream),
    ("kill between commit and ack", "2", "sent again: same ack, no doubles",
     kill_before_ack),
    ("kill at every flush of a start", "3", "next start works",
     kill_while_starting),
]
