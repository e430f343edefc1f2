"""A very long vehicle in PostgreSQL: how long it takes to load, with and without its
snapshot, what it takes in the database, and how long appends of another vehicle wait
while the snapshot is written. Starts a PostgreSQL of its own; prints one table; ends by
itself; leaves nothing behind."""

import argparse
import contextlib
import pathlib
import shutil
import statistics
import sys
import tempfile
import time

import fleet
import revisit_server

sys.path.insert(0, str(fleet.ROOT / "deploy/cluster"))

import private_cluster

FEWEST_APPENDS = 2000


class Bench:
    def __init__(self, directory, processes):
        self._log = directory / "server.log"
        self.database = private_cluster.Postgres(processes)
        made = revisit_server.run("revisitd", "migrate", "--store",
                                  self.database.url("revisit_owner"))
        assert made.returncode == 0, made.stderr

    def server(self, *flags):
        return revisit_server.Server(
            self.database.url("revisit"), "--log-level", "warning",
            "--advertise-address", "bench:1", *flags, log_path=self._log)

    def number(self, sql):
        return int(self.database.ask(f"SELECT coalesce(({sql}), 0)"))

    def await_snapshot(self, sequence):
        deadline = time.monotonic() + 300
        while self.number("SELECT max(last_sequence) FROM snapshots") < sequence:
            assert time.monotonic() < deadline, "no snapshot was written"
            time.sleep(0.1)


@contextlib.contextmanager
def own_bench(parser):
    """Yields a Bench of its own, of which nothing is left. Ends the program whose
    arguments these are with 77 where there is no PostgreSQL."""
    if private_cluster.find_postgres() is None:
        parser.exit(77, "there is no PostgreSQL: Debian's package postgresql\n")
    directory = pathlib.Path(tempfile.mkdtemp(prefix="shared-store-"))
    # PostgreSQL may have to enter it as another user.
    directory.chmod(0o711)
    try:
        with private_cluster.Processes(directory) as processes:
            yield Bench(directory, processes)
    finally:
        shutil.rmtree(directory, ignore_errors=True)


def stream(bench, name, poses):
    """Without a snapshot, so that the next server has to write one."""
    with bench.server("--snapshot-poses", 0) as server:
        client = fleet.Client(server)
        client.create(name)
        for batch in fleet.batches(poses):
            client.append(name, batch)


def loads(bench, name, count, *flags):
    """(milliseconds until the first answer, milliseconds of CPU of the server)"""
    waits, work = [], []
    for _ in range(count):
        with bench.server(*flags) as server:
            client = fleet.Client(server)
            client.info()
            before = revisit_server.processor_seconds(server.pid)
            waits.append(fleet.seconds_of(client.touch, name) * 1e3)
            work.append((revisit_server.processor_seconds(server.pid) - before) * 1e3)
    return waits, work


def appends(bench, name, beside, *flags):
    """Seconds of appends of one pose each to a new vehicle, while the server does
    what is due for another; and the parts of a snapshot that came meanwhile."""
    with bench.server("--store-connections", 1, *flags) as server:
        client = fleet.Client(server)
        client.create(name)
        one_by_one = list(_single(FEWEST_APPENDS))
        client.append(name, one_by_one[0])
        parts = bench.number("SELECT count(*) FROM snapshot_parts")
        client.touch(beside)
        took = []
        for pose in one_by_one[1:]:
            took.append(fleet.seconds_of(client.append, name, pose))
            time.sleep(0.002)
        return took, bench.number("SELECT count(*) FROM snapshot_parts") - parts


def _single(count):
    batch, fleet.BATCH = fleet.BATCH, 1
    try:
        yield from fleet.batches(count)
    finally:
        fleet.BATCH = batch


def show_loads(what, waits, work):
    fleet.row(what, f"{min(waits):.0f} to {max(waits):.0f} ms",
              f"{statistics.median(waits):.0f} ms", f"{statistics.median(work):.0f} ms")


def show_appends(what, took, parts):
    ordered = sorted(took)
    at = [int(share * (len(ordered) - 1)) for share in (0.5, 0.99, 0.999, 1.0)]
    fleet.row(what, *(f"{ordered[place] * 1e3:.1f} ms" for place in at), parts)


def measure(bench, poses, repeats):
    stream(bench, "long", poses)
    fleet.row("appends of another vehicle: p50, p99, p99.9, most, parts",
              "", "", "", "", "")
    for turn in range(repeats):
        show_appends("  nothing beside", *appends(
            bench, f"alone-{turn}", "long", "--snapshot-poses", 0))
        show_appends("  a snapshot is written", *appends(
            bench, f"beside-{turn}", "long"))
        bench.database.ask(
            "TRUNCATE snapshots, snapshot_parts, deleted_snapshots")
    with bench.server() as server:
        fleet.Client(server).touch("long")
        bench.await_snapshot(poses - fleet.SNAPSHOT_POSES)
    def share(sql):
        return f"{bench.number(sql) / poses:.1f}"

    fleet.row("rows: bytes a pose, with all that the table takes",
              share("SELECT sum(length(payload)) FROM batches"),
              share("SELECT pg_total_relation_size('batches')"))
    fleet.row("snapshot: bytes a pose, with all that the table takes",
              share("SELECT sum(length(payload)) FROM snapshot_parts"),
              share("SELECT pg_total_relation_size('snapshot_parts')"))
    fleet.row("loads: from, to; median; median of the server's CPU", "", "", "")
    show_loads("  from the snapshot", *loads(bench, "long", 2 * repeats + 1))
    # The first of these removes the snapshot.
    show_loads("  from its poses", *loads(bench, "long", 2 * repeats + 1,
                                          "--snapshot-poses", 0))


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--poses", type=int, default=1_000_000)
    parser.add_argument("--repeats", type=int, default=2)
    arguments = parser.parse_args()
    with own_bench(parser) as bench:
        measure(bench, arguments.poses, arguments.repeats)


if __name__ == "__main__":
    main()
