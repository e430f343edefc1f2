"""Rows in which the power is lost.

What a server does to its files is recorded, and what their device may then hold
is made from it (crash_states.h): thousands of states of one recording, each
opened as a start opens it (power_states.cc), some by a real revisitd. What a
client was told before that moment must be there (power_model.py).
"""

import collections
import concurrent.futures
import contextlib
import fcntl
import json
import os
import pathlib
import random
import shutil
import sqlite3
import subprocess
import tempfile
import time

from power_model import Fleet, Vehicle, agree, observe
from revisit_server import BIN, Server, clean_environment, run as run_program
from wire import append

FILE = "revisit.sqlite"


@contextlib.contextmanager
def scratch(run):
    """A directory whose flushes take no time, where there is one."""
    memory = pathlib.Path("/dev/shm")
    parent = memory if os.access(memory, os.W_OK) else run.directory
    with tempfile.TemporaryDirectory(prefix="revisit-power-",
                                     dir=parent) as directory:
        yield pathlib.Path(directory)


class Recording:
    """What programs do to the files below `root`. What is there when the first
    begins is on the device."""

    def __init__(self, run, name, store="store"):
        self.directory = run.new(name)
        self.root = self.directory / "root"
        self.root.mkdir()
        self.store = self.root / store
        self.file = self.directory / "recording"
        self.environment = clean_environment(
            LD_PRELOAD=str(BIN / "fault_shim.so"),
            REVISIT_TEST_RECORD=str(self.file),
            REVISIT_TEST_RECORD_BELOW=str(self.root))

        # When first a server said that it listened.
        self.listening = None

    def server(self, *flags):
        server = Server(self.store, *flags, env=self.environment,
                        log_path=self.directory / "server.log")
        self.listening = self.listening or time.monotonic_ns()
        return server

    def kill(self, server):
        """So that nothing was done that is not recorded."""
        with open(self.file, "rb") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            server.process.kill()
            server.process.wait()

    def check(self):
        """Whether the recording has all that was done."""
        result = subprocess.run([BIN / "power_states", "check", self.file],
                                capture_output=True, text=True, check=False)
        assert result.returncode == 0, result

    def states(self, run, count, kept=0, keep_in=None, **settings):
        """Of `count` crash states what power_states prints; `kept` of them stay
        as they were made in `keep_in`, and their lines say where."""
        jobs = (os.cpu_count() or 1) if count >= 200 else 1

        def make(job):
            states = count // jobs + (job < count % jobs)
            keep = kept // jobs + (job < kept % jobs)
            with scratch(run) as directory:
                named = {
                    "directory": directory, "states": states,
                    "store": self.store.relative_to(self.root),
                    "seed": seeds[job],
                    "keep_every": max(1, states // keep) if keep else 0,
                    **settings}
                result = subprocess.run(
                    [BIN / "power_states", "open", self.file,
                     *(f"{name}={value}" for name, value in named.items())],
                    stdout=subprocess.PIPE, text=True, check=True)
                lines = [json.loads(line)
                         for line in result.stdout.splitlines()]
                for line in lines:
                    made = directory / f"kept-{line['state']}"
                    if made.exists():
                        line["kept"] = keep_in / f"{job}-{line['state']}"
                        shutil.copytree(made, line["kept"])
            assert len(lines) == states
            return lines
        seeds = [run.rng.randrange(2**63) for _ in range(jobs)]
        with concurrent.futures.ThreadPoolExecutor(jobs) as pool:
            return [line for lines in pool.map(make, range(jobs))
                    for line in lines]


def fleet_of(run, count=3):
    return Fleet(Vehicle(f"vehicles/truck-{n}",
                         random.Random(run.rng.random()))
                 for n in range(count))


def judged(recording, fleet, lines):
    """How many states held, were refused, or had lost something, and the first
    that did not hold."""
    seen = collections.Counter()
    bad = None
    for line in lines:
        if "refused" in line["store"]:
            verdict = "refused"
        else:
            verdict = fleet.verdict(line["store"]["vehicles"], line["time"])
        if (verdict == "held" and line["verified"] != "OK"
                and line["time"] > recording.listening):
            verdict = "not verified"
        seen[verdict] += 1
        if verdict != "held" and bad is None:
            bad = (verdict, line)
    return seen, bad


def all_hold(recording, fleet, lines):
    seen, bad = judged(recording, fleet, lines)
    assert bad is None, (dict(seen), bad)


def served(run, recording, fleet, lines):
    """The states that were kept, by a real server and over its API: the same as
    the storage said, and written to. Answers how many."""
    kept = [line for line in lines if "kept" in line]
    for line in kept:
        store = line["kept"] / recording.store.relative_to(recording.root)
        with Server(store, log_path=run.directory / "server.log") as server:
            stub = server.stub()
            for name, vehicle in fleet.vehicles.items():
                content = observe(stub, vehicle.name)
                facts = content and content.facts()
                assert agree(facts, line["store"]["vehicles"].get(name)), line
                assert vehicle.verdict(facts, line["time"]) == "held", line
                if content is not None:
                    poses = vehicle.drive[len(content.poses):
                                          len(content.poses) + 2]
                    assert append(stub, vehicle.name, poses
                                  ).durable_sequence == poses[-1].sequence
            server.kill()
        with Server(store, log_path=run.directory / "server.log") as server:
            for vehicle in fleet.vehicles.values():
                observe(server.stub(), vehicle.name)
        shutil.rmtree(line["kept"])
    return len(kept)


def hold(run, recording, fleet, count, **settings):
    """Makes states of a recording and holds them against the contract; answers
    what they were, and what became of them in words."""
    recording.check()
    assert fleet.acked > 0
    lines = []
    real = 0
    while len(lines) < count:
        # No more at a time than there is memory to keep some of.
        states = min(count - len(lines), 400)
        with scratch(run) as kept:
            some = recording.states(run, states, kept=max(1, states // 20),
                                    keep_in=kept, **settings)
            all_hold(recording, fleet, some)
            real += served(run, recording, fleet, some)
        lines += some
    return lines, (f"0 lost, 0 refused of {count} after {fleet.acked} acks, "
                   f"{real} of them served")


def record_writes(run, name, operations):
    """Lives of a store, from its making on, some ended in order and some killed.
    The longest begins its log anew when that has been copied."""
    recording = Recording(run, name, store="var/lib/store")
    fleet = fleet_of(run)
    for share, is_killed in ((0.1, False), (0.6, True), (0.2, True),
                             (0.1, False)):
        with recording.server() as server:
            fleet.resolve(server)
            fleet.work(server, round(share * operations),
                       end=lambda: is_killed and recording.kill(server))
    return recording, fleet


def while_written(run):
    count = run.rounds(short=60, long=4000)
    recording, fleet = record_writes(
        run, "writes", run.rounds(short=500, long=2000))
    _, seen = hold(run, recording, fleet, count)
    return count, seen


def while_made(run):
    """A store that is made, with its directory and what is above it."""
    count = run.rounds(short=40, long=1500)
    recording = Recording(run, "new", store="var/lib/store")
    fleet = fleet_of(run, 2)
    with recording.server() as server:
        fleet.work(server, 12, end=lambda: recording.kill(server))
    _, seen = hold(run, recording, fleet, count)
    return count, seen


def make_format_4(path):
    """Only the tables are those of such a store; its rows are a test of the
    storage."""
    database = sqlite3.connect(path)
    for table in ("snapshots", "snapshot_parts", "deleted_snapshots",
                  "deleted_pose_pairs", "check_heads", "checks", "events",
                  "dropped_events", "vehicle_groups", "group_members",
                  "group_links"):
        database.execute(f"DROP TABLE {table}")
    database.execute("PRAGMA user_version = 4")
    database.close()


def while_upgraded(run):
    count = run.rounds(short=30, long=1200)
    recording = Recording(run, "upgrade")
    fleet = fleet_of(run, 2)
    with Server(recording.store,
                log_path=recording.directory / "server.log") as server:
        fleet.work(server, 60)
    make_format_4(recording.store / FILE)
    with recording.server() as server:
        fleet.work(server, 10)
    with recording.server() as server:
        fleet.work(server, 10, end=lambda: recording.kill(server))
    # Half of them in the start that does it, which is soon over.
    half = (count + 1) // 2
    starting, seen = hold(run, recording, fleet, half,
                          to=recording.listening)
    later, seen_later = hold(run, recording, fleet, half)
    return len(starting) + len(later), f"while starting: {seen}; {seen_later}"


def while_backed_up(run):
    count = run.rounds(short=30, long=1200)
    recording = Recording(run, "backup")
    backups = recording.root / "backups"
    backups.mkdir()
    fleet = fleet_of(run)
    made = {}

    def back_up():
        for number in range(3):
            name = f"copy-{number}.sqlite"
            begun = time.monotonic_ns()
            result = run_program(
                "revisitd", "backup", "--store", recording.store, "--to",
                backups / name, env=recording.environment)
            assert result.returncode == 0, result
            made[name] = (begun, time.monotonic_ns())
    with recording.server() as server:
        fleet.work(server, 100)
        fleet.work(server, 100, meanwhile=back_up,
                   end=lambda: recording.kill(server))
    lines, seen = hold(run, recording, fleet, count, backups="backups")
    there = 0
    for line in lines:
        for name, (begun, ended) in made.items():
            found = line["backups"].get(name)
            if found is None:
                assert line["time"] <= ended, (name, line)
                continue
            # Whoever finds a copy of that name may rely on it.
            there += 1
            assert "refused" not in found, (name, found, line)
            assert fleet.verdict(found["vehicles"], line["time"],
                                 since=begun) == "held", (name, line)
    assert there
    return count, f"{seen}; {there} copies there, all whole"


def while_dropped(run):
    """A damaged log, of which what can be read is kept."""
    count = run.rounds(short=20, long=1000)
    recording = Recording(run, "drop")
    before = fleet_of(run, 2)
    with Server(recording.store,
                log_path=recording.directory / "server.log") as server:
        before.work(server, 60)
        server.kill()
    log = recording.store / f"{FILE}-wal"
    content = bytearray(log.read_bytes())
    content[len(content) * 3 // 4] ^= 1
    log.write_bytes(content)
    with recording.server("--damaged-log", "drop") as server:
        # What is left is what counts from now on.
        fleet = Fleet(
            Vehicle(vehicle.name, vehicle.rng,
                    observe(server.stub(), vehicle.name), vehicle.drive)
            for vehicle in before.vehicles.values())
        fleet.work(server, 15, end=lambda: recording.kill(server))
    recording.check()
    dropped = recording.states(run, count, drop_damaged_log=1)
    all_hold(recording, fleet, dropped)
    # Whoever saw it start need not tell it again. Right after the start nothing
    # has been written yet that would be flushed with the log.
    half = (count + 1) // 2
    after = [*recording.states(run, half, **{"from": recording.listening,
                                                   "to": recording.listening}),
             *recording.states(run, half,
                               **{"from": recording.listening})]
    assert min(line["time"] for line in after) > recording.listening
    all_hold(recording, fleet, after)
    return len(dropped) + len(after), (
        f"0 lost, 0 refused of {len(dropped)} told to drop, and of "
        f"{len(after)} not told so later")


def while_recovering(run):
    """Again, while a server starts on what the first loss left."""
    first = run.rounds(short=2, long=20)
    count = run.rounds(short=20, long=1100)
    recording, fleet = record_writes(run, "first", 150)
    acked = made = 0
    with scratch(run) as kept:
        lines = recording.states(run, first, kept=first, keep_in=kept)
        all_hold(recording, fleet, lines)
        for number, line in enumerate(lines):
            again = Recording(run, f"again-{number}", store="var/lib/store")
            shutil.rmtree(again.root)
            shutil.copytree(line["kept"], again.root)
            with again.server() as server:
                rest = Fleet(
                    Vehicle(vehicle.name, vehicle.rng,
                            observe(server.stub(), vehicle.name),
                            vehicle.drive)
                    for vehicle in fleet.vehicles.values())
                for name, vehicle in rest.vehicles.items():
                    facts = vehicle.operations[0].facts
                    assert agree(facts, line["store"]["vehicles"].get(name))
                rest.work(server, 10, end=lambda: again.kill(server))
            again.check()
            states = again.states(run, count // first)
            all_hold(again, rest, states)
            made += len(states)
            acked += rest.acked
    return made, f"0 lost, 0 refused of {made} after {first} losses before"


def control(run):
    """A device that does not honour flushes must lose: else nothing above
    proves anything."""
    count = run.rounds(short=40, long=200)
    recording, fleet = record_writes(run, "control", 300)
    words = []
    for files, dishonour in (("the log", "-wal"), ("the database", FILE),
                             ("directories", "/")):
        seen, bad = judged(recording, fleet, recording.states(
            run, count, dishonour=dishonour))
        assert bad is not None, f"flushes of {files} are of no use"
        words.append(f"{files}: " + ", ".join(
            f"{seen[verdict]} {verdict}" for verdict in sorted(seen)))
    return 3 * count, f"of {count} each without flushes of " + "; ".join(words)


ROWS = [
    ("power lost while written", "14", "0 lost, 0 refused", while_written),
    ("power lost while a store is made", "14", "0 lost, 0 refused", while_made),
    ("power lost while the format is brought up to date", "14, 62",
     "0 lost, 0 refused", while_upgraded),
    ("power lost while backed up", "14, 62",
     "0 lost, 0 refused; the copy absent or whole", while_backed_up),
    ("power lost while a damaged log is dropped", "14, 5", "0 lost, 0 refused",
     while_dropped),
    ("power lost while recovering", "14, 3", "0 lost, 0 refused",
     while_recovering),
    ("power lost, flushes not honoured", "14", "loses: the rows above see it",
     control),
]
