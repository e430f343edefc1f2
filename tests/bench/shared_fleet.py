"""What GetServerInfo costs a PostgreSQL that has very many vehicles, and what calls
beside it cost others. Starts a PostgreSQL of its own, whose tables are filled by SQL;
prints one table; ends by itself; leaves nothing behind. REVISIT_BIN says which build is
measured."""

import argparse
import statistics
import threading
import time

import fleet
from revisit_server import processor_seconds
from shared_history import own_bench

# Nobody reads these rows, so they need not be those of real vehicles.
_FILL = """
INSERT INTO vehicles SELECT i, 'made-' || i, 0, 1, 0, ''
  FROM generate_series(1, {count}) i;
SELECT setval(pg_get_serial_sequence('vehicles', 'key'), {count});
INSERT INTO heads (key, owner, epoch, revision) SELECT i, s.incarnation, 1, 1
  FROM generate_series(1, {count}) i,
       (SELECT incarnation FROM servers WHERE state = 'live' LIMIT 1) s;
"""


def backends(bench):
    """Processes of the sessions of servers, which stay while they are used."""
    return bench.database.ask("SELECT pid FROM pg_stat_activity WHERE "
                              "usename = 'revisit'").split()


def show(what, seconds):
    fleet.row(what, f"{statistics.median(seconds) * 1e3:.2f} ms",
              f"{max(seconds) * 1e3:.1f} ms")


def measure(bench, vehicles, calls, callers):
    with bench.server() as server:
        bench.database.ask(_FILL.format(count=vehicles))
        bench.database.ask("VACUUM ANALYZE vehicles, heads")
        client = fleet.Client(server)
        client.info()
        fleet.row(f"{vehicles} vehicles: median, longest", "", "")
        # The processes that answer have to be there when they are first counted.
        pids = backends(bench)
        before = sum(map(processor_seconds, pids))
        show(f"GetServerInfo, {calls} calls one after the other", [
            fleet.seconds_of(client.info) for _ in range(calls)])
        spent = (sum(map(processor_seconds, pids)) - before) / calls
        fleet.row("  processor time of PostgreSQL a call", f"{spent * 1e3:.2f} ms")
        show("CreateVehicle, nothing beside", creations(client, "alone", calls))
        stopped = threading.Event()

        def call():
            while not stopped.is_set():
                client.info()

        threads = [threading.Thread(target=call) for _ in range(callers)]
        for thread in threads:
            thread.start()
        # By then all of them are at it.
        time.sleep(1.0)
        beside = creations(client, "beside", calls)
        stopped.set()
        for thread in threads:
            thread.join()
        show(f"CreateVehicle beside {callers} callers of GetServerInfo", beside)


def creations(client, name, count):
    return [fleet.seconds_of(client.create, f"{name}-{i}") for i in range(count)]


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vehicles", type=int, default=1_000_000)
    parser.add_argument("--calls", type=int, default=20)
    parser.add_argument("--callers", type=int, default=12)
    arguments = parser.parse_args()
    with own_bench(parser) as bench:
        measure(bench, arguments.vehicles, arguments.calls, arguments.callers)


if __name__ == "__main__":
    main()
