"""Commits at the peak: how large groups get, how long acknowledgements take, and what
PostgreSQL's processors and log have to do."""

import dataclasses

import cluster
import database
import kernel as kernels
import parameters
import tables


class Writers:
    """One server's queue of rows and the connections that commit them in groups."""

    def __init__(self, kernel, p, store, connections, poses_a_row):
        self._kernel = kernel
        self._p = p
        self._store = store
        self._idle = connections
        self._poses = poses_a_row
        # Times at which the rows that wait came.
        self._rows = []
        self.latencies = []
        self.commits = 0

    def add(self):
        self._rows.append(self._kernel.now)
        self._commit()

    def _commit(self):
        while self._idle and self._rows:
            most = int(self._p.rows_per_commit)
            group, self._rows = self._rows[:most], self._rows[most:]
            self._idle -= 1
            cpu = (self._p.statement_cpu_s + len(group)
                   * (self._p.row_cpu_s + self._poses * self._p.pose_cpu_s))
            self._store.execute(database.Statement(
                cpu, (), _written, lambda _, g=group: self._committed(g)))

    def _committed(self, group):
        self._idle += 1
        self.commits += 1
        now = self._kernel.now
        self.latencies += [now - came for came in group]
        self._commit()


def _written(_):
    # Any row will do: what counts is that there is something to flush.
    return True, [("handovers", 0, 0)]


def ingest(seed, p, servers, poses_per_second, poses_a_row, synchronous=True,
           seconds=1.0):
    """Open arrivals: rows come as a Poisson process."""
    kernel = kernels.Kernel(seed)
    store = database.Database(kernel, p, None if synchronous else 0.0)
    writers = [Writers(kernel, p, store, int(p.writers), poses_a_row)
               for _ in range(servers)]
    rate = poses_per_second / poses_a_row

    def arrive():
        kernel.random.choice(writers).add()
        kernel.after(kernel.random.expovariate(rate), arrive)

    arrive()
    kernel.run(seconds)
    latencies = sorted(x for writer in writers for x in writer.latencies)
    commits = sum(writer.commits for writer in writers)
    busy = store._cpu.busy_seconds / seconds / p.database_cores
    return {
        "commits a second": commits / seconds,
        "rows a commit": len(latencies) / max(1, commits),
        "ack p50 ms": 1e3 * cluster.quantile(latencies, 0.5),
        "ack p99 ms": 1e3 * cluster.quantile(latencies, 0.99),
        "CPU of PostgreSQL %": 100 * min(1.0, busy),
        "kept up %": 100 * len(latencies) / (rate * seconds),
    }


def closed_loop(seed, p, connections, rows, seconds=5.0):
    """Thousand poses a second of `connections` that always have a group ready, as in
    the measurement; rows of 64 poses, no standby."""
    kernel = kernels.Kernel(seed)
    store = database.Database(kernel, p, standby_lag=0.0)
    commits = 0
    cpu = p.statement_cpu_s + rows * (p.row_cpu_s + 64 * p.pose_cpu_s)

    def commit(_=None):
        nonlocal commits
        commits += 1
        store.execute(database.Statement(cpu, (), _written, commit))

    for _ in range(connections):
        commit()
    kernel.run(seconds)
    return (commits - connections) * rows * 64 / seconds / 1e3


def run(seeds, part):
    del part
    measured = tables.Table(
        "The model of PostgreSQL beside the measurement: 2 cores, fdatasync 3.1 ms, "
        "thousand poses a second",
        ("rows a commit, connections", "measured (median)", "model", "model/measured"),
        note="The machine had other work, load 8 to 15 on 2 cores. The model has none.")
    two_cores = dataclasses.replace(parameters.Parameters(), database_cores=2,
                                    hop_s=0.00005)
    for rows, connections, thousand, _ in parameters.MEASURED_INGEST:
        model = closed_loop(seeds[0], two_cores, connections, rows)
        measured.add(**{
            measured.columns[0]: f"{rows}, {connections}",
            "measured (median)": thousand, "model": model,
            "model/measured": model / thousand})
    p = parameters.Parameters()
    table = tables.Table(
        "Commits at the peak, synchronous standby",
        ("primary of, poses a row", "commits a second", "rows a commit", "ack p50 ms",
         "ack p99 ms", "CPU of PostgreSQL %", "kept up %"),
        note=f"{p.database_cores} cores, a flush takes {1e3 * p.flush_s} ms. Streams "
             "that send one pose a second make rows of one pose.")
    peak = p.vehicles * p.hours_a_day / 24 * p.peak_to_mean * p.pose_hz
    for name, servers, poses_a_row, share, cores in (
            ("1 cell (10 servers), 64", 10, 64, 0.1, 16),
            ("1 cell (10 servers), 1", 10, 1, 0.1, 16),
            ("  on 2 cores", 10, 1, 0.1, 2),
            ("100 servers, 64", 100, 64, 1.0, 16),
            ("100 servers, 8", 100, 8, 1.0, 16),
            ("100 servers, 1", 100, 1, 1.0, 16),
            ("  on 8 cores", 100, 1, 1.0, 8),
            ("  on 4 cores", 100, 1, 1.0, 4)):
        figures = tables.over(seeds, lambda seed, n=servers, k=poses_a_row, s=share,
                              c=cores: ingest(
                                  seed, dataclasses.replace(p, database_cores=c), n,
                                  peak * s, k))
        table.add(**{table.columns[0]: name}, **figures)
    return [measured, table]
