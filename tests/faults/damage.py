"""Rows in which the store's files are damaged while no server runs."""

import collections
import random
import shutil
import sqlite3
import threading

import grpc

from drive_client import VEHICLE, Client, Drive, create
from revisit_server import Server, run as run_program, wait_until
from wire import (PAIR_KINDS, PoseStream, append, as_bytes, batches,
                  decode_failure, failure_of, get, list_poses)

VEHICLES = [f"vehicles/truck-{n}" for n in range(3)]
# The meaning of an exit: damaged, or not a store of this version.
REFUSALS = (65, 73)


class Base:
    """A store with three vehicles in which everything was acknowledged: one that
    was stopped, or one that was killed, with the last commits in the log."""

    def __init__(self, run, killed):
        self.killed = killed
        self.store = run.new(f"base-{'killed' if killed else 'stopped'}") / "s"
        self.poses = {}
        with Server(self.store) as server:
            stub = server.stub()
            for number, vehicle in enumerate(VEHICLES):
                create(stub, vehicle)
                self.poses[vehicle] = Drive(run.seed + number)[0:400]
            # All vehicles in turns, as they come.
            for parts in zip(*(batches(poses, 16)
                               for poses in self.poses.values())):
                for vehicle, part in zip(VEHICLES, parts):
                    append(stub, vehicle, part)
            for vehicle in VEHICLES:
                for k, kind in enumerate(PAIR_KINDS):
                    for n in range(5):
                        kind.add(stub, vehicle, 300 + n, 10 + 5 * k + n,
                                 f"pair-{n}")
            self.state = {vehicle: state_of(stub, vehicle)
                          for vehicle in VEHICLES}
            if killed:
                server.kill()
        self.log = self.store / "revisit.sqlite-wal"
        if killed:
            assert self.log.stat().st_size > 100_000

    def copy(self, run):
        store = run.new("damaged") / "s"
        shutil.copytree(self.store, store)
        return store


def state_of(stub, vehicle):
    return (as_bytes(list_poses(stub, vehicle)),
            [as_bytes(kind.page(stub, vehicle)[0]) for kind in PAIR_KINDS])


class Outcome:
    """What became of a store: refused, or what each vehicle answers."""

    def __init__(self, store, base, *flags):
        self.exit = None
        self.damaged = []
        self.short = {}
        with Server(store, *flags, wait=False) as server:
            try:
                server.wait_until_listening()
            except AssertionError:
                self.exit = server.process.wait()
                self.message = server.log()
                assert self.exit in REFUSALS, (self.exit, self.message)
                return
            stub = server.stub()
            for vehicle in VEHICLES:
                try:
                    state = state_of(stub, vehicle)
                except grpc.RpcError as error:
                    failure = decode_failure(error)
                    # A vehicle that is not there at all is checked by callers.
                    if failure.reason == "VEHICLE_NOT_FOUND":
                        self.short[vehicle] = 0
                        continue
                    assert failure.code == grpc.StatusCode.DATA_LOSS, failure
                    assert failure.reason == "STORE_CORRUPT", failure
                    self.damaged.append(vehicle)
                    continue
                if state == base.state[vehicle]:
                    continue
                # Less than was acknowledged: then at least a prefix.
                sent = as_bytes(base.poses[vehicle])
                assert state[0] == sent[:len(state[0])], "other poses than sent"
                self.short[vehicle] = len(state[0])

    @property
    def told(self):
        return self.exit is not None or bool(self.damaged)

    @property
    def kind(self):
        if self.exit is not None:
            return f"exit {self.exit}"
        if self.short:
            return "less"
        return "DATA_LOSS of its vehicle" if self.damaged else "harmless"


def counted(outcomes):
    return ", ".join(f"{count} {kind}" for kind, count in
                     sorted(collections.Counter(outcomes).items()))


def handshake_tells(store, base, short):
    """A client that says what it has had acknowledged learns of every loss."""
    with Server(store) as server:
        stub = server.stub()
        for vehicle, durable in short.items():
            acked = len(base.poses[vehicle])
            if durable == acked:
                continue  # Only pairs, which no client counts.
            with PoseStream(stub, vehicle, acked_sequence=acked) as stream:
                failure = failure_of(stream.receive)
            if failure.reason == "VEHICLE_NOT_FOUND":
                continue
            assert failure.code == grpc.StatusCode.DATA_LOSS
            assert failure.reason == "DURABLE_SEQUENCE_REGRESSED"
            assert failure.metadata["durable_sequence"] == str(durable)


def read_by_tasks(store):
    """What verifying and backing up say of a store before a server has it: the
    same; answers the exit code and whether vehicles were named."""
    copy = store.parent / "backup-of-damaged"
    copy.unlink(missing_ok=True)
    verified = run_program("revisitd", "verify", "--store", store)
    backed_up = run_program("revisitd", "backup", "--store", store, "--to", copy)
    assert backed_up.returncode == verified.returncode, (backed_up, verified)
    assert copy.exists() == (verified.returncode == 0)
    copy.unlink(missing_ok=True)
    return verified.returncode, "damaged vehicle: truck-" in verified.stdout


def forget_mark(store):
    """What a power failure may do: the mark was never flushed."""
    (store / "revisit.sqlite.mark").write_bytes(b"")


def cut_log(run):
    """Every acknowledged commit in the log was flushed: a cut loses some, unless
    it cuts nothing off."""
    rounds = run.rounds(short=6, long=250)
    base = Base(run, killed=True)
    size = base.log.stat().st_size
    seen = collections.Counter()
    for number in range(rounds):
        cut = (run.rng.randint(1, 4096) if number % 2
               else run.rng.randint(1, size))
        zeros = number % 3 == 0
        with_mark = number % 4 != 3
        store = base.copy(run)
        log = store / base.log.name
        content = log.read_bytes()[:size - cut]
        log.write_bytes(content + bytes(cut if zeros else 0))
        if with_mark:
            assert read_by_tasks(store)[0] == 65
            outcome = Outcome(store, base)
            assert outcome.exit == 65, (cut, zeros, outcome.kind)
            assert "the log" in outcome.message
            seen["refused"] += 1
        else:
            forget_mark(store)
            outcome = Outcome(store, base)
            assert outcome.exit is None and not outcome.damaged
            assert outcome.short
            handshake_tells(store, base, outcome.short)
            seen["without the mark: a prefix, told by the handshake"] += 1
    # And an unfinished tail, which was never acknowledged, is no damage.
    for number in range(rounds // 3 + 1):
        store = base.copy(run)
        with open(store / base.log.name, "ab") as log:
            log.write(run.rng.randbytes(run.rng.randint(1, 20000))
                      if number % 2 else bytes(run.rng.randint(1, 20000)))
        outcome = Outcome(store, base)
        assert outcome.kind == "harmless", outcome.kind
        seen["unfinished tail dropped, all acked there"] += 1
    return sum(seen.values()), ", ".join(
        f"{count} {what}" for what, count in seen.items())


def flip(run, path, bits=1):
    content = bytearray(path.read_bytes())
    at = run.rng.randrange(len(content))
    for _ in range(bits):
        content[at] ^= 1 << run.rng.randrange(8)
        at = run.rng.randrange(len(content))
    path.write_bytes(content)


def flipped_log(run):
    rounds = run.rounds(short=10, long=250)
    base = Base(run, killed=True)
    seen = []
    named = 0
    for number in range(rounds):
        store = base.copy(run)
        flip(run, store / base.log.name)
        with_mark = number % 4 != 3
        if not with_mark:
            forget_mark(store)
        code, names = read_by_tasks(store)
        outcome = Outcome(store, base)
        assert code == (outcome.exit or 0), outcome.kind
        assert names == (code != 0 and "truck-" in outcome.message)
        if with_mark:
            assert outcome.exit == 65 or outcome.kind == "harmless", outcome.kind
        elif outcome.short:
            # Only the very last transaction can be taken for unfinished.
            assert outcome.exit is None
            for vehicle, durable in outcome.short.items():
                assert durable >= len(base.poses[vehicle]) - 16
            handshake_tells(store, base, outcome.short)
        if outcome.exit is not None and "truck-" in outcome.message:
            named += 1
        seen.append(outcome.kind)
    assert named, counted(seen)
    # An operator who has no backup goes on with what is left, and clients learn
    # of it.
    store = base.copy(run)
    content = bytearray((store / base.log.name).read_bytes())
    content[len(content) // 2] ^= 1
    (store / base.log.name).write_bytes(content)
    assert Outcome(store, base).exit == 65
    outcome = Outcome(store, base, "--damaged-log", "drop")
    assert outcome.short and not outcome.damaged
    handshake_tells(store, base, outcome.short)
    return rounds, f"{counted(seen)}; vehicles named in {named}; less: 0 silent"


def flipped_database(run):
    rounds = run.rounds(short=14, long=500)
    base = Base(run, killed=False)
    seen = []
    others_served = 0
    for number in range(rounds):
        store = base.copy(run)
        flip(run, store / "revisit.sqlite", bits=1 if number % 3 else 8)
        outcome = Outcome(store, base)
        assert not outcome.short, outcome.short
        verified = run_program("revisitd", "verify", "--store", store)
        if outcome.told:
            assert verified.returncode in REFUSALS, (outcome.kind, verified)
        for vehicle in outcome.damaged:
            assert vehicle.split("/")[1] in verified.stdout, verified
        if outcome.damaged and len(outcome.damaged) < len(VEHICLES):
            others_served += 1
        seen.append(outcome.kind)
    return rounds, (f"{counted(seen)}; the other vehicles served in "
                    f"{others_served}; silent: 0")


def missing_files(run):
    base = Base(run, killed=True)
    # The log gone, emptied, or of an older moment.
    for harm in ("gone", "empty", "header"):
        store = base.copy(run)
        log = store / base.log.name
        if harm == "gone":
            log.unlink()
        elif harm == "empty":
            log.write_bytes(b"")
        else:
            content = bytearray(log.read_bytes())
            content[run.rng.randrange(32)] ^= 1
            log.write_bytes(content)
        outcome = Outcome(store, base)
        assert outcome.exit == 65, (harm, outcome.kind)
    # An old backup under clients that know more.
    old = run.new("old") / "s"
    with Server(old) as server:
        create(server.stub(), VEHICLES[0])
        append(server.stub(), VEHICLES[0], base.poses[VEHICLES[0]][:100])
    handshake_tells(old, base, {VEHICLES[0]: 100})
    # The database cut short, at a page and elsewhere.
    for size in (8192 * 3, 8192 * 5 + 100):
        store = Base(run, killed=False).copy(run)
        path = store / "revisit.sqlite"
        path.write_bytes(path.read_bytes()[:size])
        outcome = Outcome(store, base)
        assert outcome.exit == 65, outcome.kind
    return 6, "log gone, emptied, headless, database cut: exit 65; old " \
        "backup: DURABLE_SEQUENCE_REGRESSED"


def missing_database(run):
    """It was taken for a new store once, and the log of the old one removed."""
    base = Base(run, killed=True)
    tried = 0
    for harm in ("gone", "empty"):
        for kept in ("-wal", ".mark", ".lock", ""):
            store = base.copy(run)
            for path in store.iterdir():
                if kept and path.name not in ("revisit.sqlite",
                                              "revisit.sqlite" + kept):
                    path.unlink()
            (store / "revisit.sqlite").unlink()
            if harm == "empty":
                (store / "revisit.sqlite").touch()
            before = {path: path.read_bytes() for path in store.iterdir()}
            assert read_by_tasks(store)[0] == 65
            outcome = Outcome(store, base)
            assert outcome.exit == 65, (harm, kept, outcome.kind)
            assert "revisit.sqlite is " in outcome.message
            after = {path: path.read_bytes() for path in store.iterdir()}
            assert after == before
            tried += 1
    # Files of another store beside this one's.
    other = run.new("other") / "s"
    shutil.copytree(base.store, other)
    base = Base(run, killed=True)
    for strange in ("revisit.sqlite", "revisit.sqlite-wal",
                    "revisit.sqlite.mark", "revisit.sqlite.lock"):
        store = base.copy(run)
        shutil.copy(other / strange, store / strange)
        before = {path: path.read_bytes() for path in store.iterdir()}
        assert read_by_tasks(store)[0] == 65
        outcome = Outcome(store, base, "--damaged-log", "drop")
        assert outcome.exit == 65, (strange, outcome.kind)
        assert "is of another store" in outcome.message
        # Whoever locks a store writes its process id into the lock.
        after = {path: path.read_bytes() for path in store.iterdir()}
        assert after.keys() == before.keys()
        assert all(after[path] == before[path] for path in before
                   if path.suffix != ".lock")
        tried += 1
    return tried, "exit 65 each time, every file as it was"


def directory_goes(run):
    """Removed or replaced under the server: nothing is acknowledged that nobody
    would find again."""
    seen = []
    for harm in ("removed", "moved", "replaced"):
        store = run.new("goes") / "s"
        drive = Drive(run.seed)
        with Server(store) as server:
            stub = server.stub()
            create(stub, VEHICLE)
            append(stub, VEHICLE, drive[0:10])
            if harm == "removed":
                shutil.rmtree(store)
            else:
                store.rename(store.with_name("away"))
            if harm == "replaced":
                shutil.copytree(store.with_name("away"), store)
            failure = failure_of(lambda: append(stub, VEHICLE, drive[10:20]))
            assert failure.code == grpc.StatusCode.UNAVAILABLE, failure
            assert failure.reason == "STORE_UNAVAILABLE", failure
            assert server.process.wait(20) == 74, server.log()
            assert "revisit.sqlite" in server.log()
        if harm == "replaced":
            with Server(store) as server:
                assert get(server.stub(), VEHICLE).durable_sequence == 10
        seen.append(harm)
    return len(seen), f"{', '.join(seen)}: no ack, exit 74"


def stray_files(run):
    base = Base(run, killed=True)
    store = base.copy(run)
    (store / "lost+found").mkdir()
    (store / "notes.txt").write_text("hello")
    (store / "revisit.sqlite.partial").write_bytes(b"\0" * 100)
    (store / "revisit.sqlite-journal.bak").write_bytes(b"x")
    outcome = Outcome(store, base)
    assert outcome.kind == "harmless", outcome.kind
    assert (store / "notes.txt").read_text() == "hello"
    return 1, "served; they stay as they are"


def newer_format(run):
    base = Base(run, killed=False)
    store = base.copy(run)
    path = store / "revisit.sqlite"
    database = sqlite3.connect(path)
    found = database.execute("PRAGMA user_version").fetchone()[0]
    database.execute(f"PRAGMA user_version = {found + 1}")
    database.close()
    content = path.read_bytes()
    outcome = Outcome(store, base)
    assert outcome.exit == 73
    assert f"has format {found + 1}" in outcome.message
    assert "use a newer server" in outcome.message
    for task in (["verify"], ["backup", "--to", store.parent / "copy"]):
        result = run_program("revisitd", *task, "--store", store)
        assert result.returncode == 73, result
        assert f"has format {found + 1}" in result.stderr
    assert path.read_bytes() == content
    assert not (store.parent / "copy").exists()
    return 3, "serve, verify, backup: exit 73, the file as it was"


def backup(run):
    """While poses stream in; then restored, truncated, and restored again."""
    rounds = run.rounds(short=2, long=20)
    store = run.new("live") / "s"
    client = Client(Drive(run.seed), random.Random(run.rng.random()))
    with Server(store) as server:
        create(server.stub())
        streaming = threading.Thread(
            target=client.stream, args=(server, 20000 * rounds))
        streaming.start()
        copied = 0
        for number in range(rounds):
            wait_until(lambda: client.acked > copied, "more poses")
            before = client.acked
            copy = store.parent / f"copy-{number}.sqlite"
            result = run_program("revisitd", "backup", "--store", store,
                                 "--to", copy)
            assert result.returncode == 0, result
            sent = client.sent
            again = run_program("revisitd", "backup", "--store", store,
                                "--to", copy)
            assert again.returncode == 73, again
            assert "is there already" in again.stderr
            result = run_program("revisitd", "verify", "--store", copy)
            assert result.returncode == 0 and "sound" in result.stdout, result
            restored = run.new("restored")
            shutil.copy(copy, restored / "revisit.sqlite")
            with Server(restored) as second:
                stub = second.stub()
                durable = get(stub, VEHICLE).durable_sequence
                assert before <= durable <= sent
                copied = durable
                assert as_bytes(list_poses(stub, VEHICLE)) == as_bytes(
                    client.drive[0:durable])
                assert append(stub, VEHICLE, client.drive[durable:durable + 9]
                              ).durable_sequence == durable + 9
            # Cut anywhere it is refused.
            content = copy.read_bytes()
            copy.write_bytes(content[:run.rng.randrange(600, len(content))])
            result = run_program("revisitd", "verify", "--store", copy)
            assert result.returncode == 65, result
            result = run_program("revisitd", "--listen", "127.0.0.1:0",
                                 "--store", copy)
            assert result.returncode == 65, result
        # Also of the server that is running, beside it.
        result = run_program("revisitd", "verify", "--store", store)
        assert result.returncode == 0, result
        server.process.terminate()
        streaming.join()
    return rounds, "copied while streaming: a prefix with all acked before; " \
        "sound; restored and written to; truncated: exit 65"


ROWS = [
    ("log cut, with and without zeros", "4, 6",
     "acked commits cut off: exit 65, or told by the handshake; unfinished "
     "tail: served", cut_log),
    ("bits flipped in the log", "5", "exit 65 naming vehicles, never less",
     flipped_log),
    ("bits flipped in the database", "5, 11",
     "DATA_LOSS of its vehicles, or exit 65; never less", flipped_database),
    ("log missing, old backup, database cut", "6",
     "exit 65; DATA_LOSS DURABLE_SEQUENCE_REGRESSED", missing_files),
    ("database missing, files of another store", "6",
     "exit 65, nothing touched", missing_database),
    ("directory removed or replaced", "6", "no ack, exit 74", directory_goes),
    ("stray files", "7", "served", stray_files),
    ("newer format", "62", "refused, left as it is", newer_format),
    ("backup while running", "62", "sound copy; truncated: refused", backup),
]
