"""The fault matrix: harms a real revisitd and says what became of it.

Every row harms the server or its store in one way and holds it against the
contract of acknowledgements: what was acknowledged is there, bit for bit; what
is there is a prefix of what was sent; damage is told, never passed over; what
was sent again is acknowledged again. RESULTS.md says what each row was seen to
fail by.
"""

import argparse
import dataclasses
import os
import pathlib
import random
import shutil
import sys
import tempfile
import time
import traceback

import pytest

import cluster_cuts
import cluster_database
import cluster_fences
import cluster_losses
import cluster_servers
import crowds
import damage
import devices
import ends
import hosts
import kills
import linearizable
import power
import restarts
from skipped import Skipped

ROWS = [*kills.ROWS, *power.ROWS, *damage.ROWS, *devices.ROWS,
        *restarts.ROWS, *ends.ROWS, *crowds.ROWS, *linearizable.ROWS]
CLUSTER_ROWS = [*cluster_servers.ROWS, *cluster_database.ROWS,
                *cluster_losses.ROWS, *cluster_cuts.ROWS, *cluster_fences.ROWS]

# How a row fails. What pytest raises is no Exception.
FAILURES = (Exception, pytest.fail.Exception)


@dataclasses.dataclass
class Run:
    """What a row is given."""

    directory: pathlib.Path
    rng: random.Random
    seed: int
    # How often, in the short and in the long profile.
    long: bool
    scale: float
    # Whether Envoy stands before the servers of every cluster.
    behind_envoy: bool

    def rounds(self, short, long):
        return max(1, round((long if self.long else short) * self.scale))

    def new(self, name):
        """A directory of its own, empty."""
        path = self.directory / name
        shutil.rmtree(path, ignore_errors=True)
        path.mkdir(parents=True)
        return path


def scratch(arguments):
    """Where the directories of the rows are made. The files of databases are in
    memory where there is room: what a disk does to them is none of the rows'
    business."""
    memory = pathlib.Path("/dev/shm")
    return memory if arguments.cluster and os.access(memory, os.W_OK) and \
        shutil.disk_usage(memory).free > 4 << 30 else None


def keep_logs(run, target, name):
    """Of a row that failed, if anybody wants them."""
    if target is None:
        return
    kept = pathlib.Path(target) / f"{run.seed} {name}".replace("/", "-")
    for log in run.directory.rglob("*.log"):
        to = kept / log.relative_to(run.directory)
        to.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(log, to)


def run_rows(arguments, seed, where):
    """The lines of the table, as each row ends."""
    for name, number, expected, row in (
            CLUSTER_ROWS if arguments.cluster else ROWS):
        if arguments.only and not any(word in name for word in arguments.only):
            continue
        if any(word in name for word in arguments.but):
            continue
        start = time.monotonic()
        with tempfile.TemporaryDirectory(prefix="row-", dir=where) as directory:
            run = Run(pathlib.Path(directory), random.Random(f"{seed} {name}"),
                      seed, arguments.long, arguments.scale,
                      arguments.envoy)
            try:
                rounds, seen = row(run)
                verdict = "holds"
            except Skipped as skipped:
                rounds, seen, verdict = 0, str(skipped), "SKIPPED"
            except FAILURES as error:
                traceback.print_exc()
                rounds, seen, verdict = "", f"{error!r}"[:200], "FAILED"
                keep_logs(run, arguments.logs, name)
        seconds = time.monotonic() - start
        print(f"{verdict:8} {name} ({seconds:.1f} s): {seen}", flush=True)
        yield number, name, expected, seen, rounds, verdict


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--long", action="store_true",
                        help="200 kills, 10,000 power losses, 2,000 failing "
                        "calls, 500 damaged stores, 20,000 streams, 100,000 "
                        "vehicles; some 50 minutes, more on a busy machine")
    parser.add_argument("--scale", type=float, default=1.0,
                        help="multiplies the rounds of every row")
    parser.add_argument("--seed", type=int, default=None,
                        help="of all random choices (default: 20101018; with "
                        "--long: a new one)")
    parser.add_argument("--only", metavar="WORD", action="append",
                        help="only rows whose name has this in it; may be "
                        "given several times")
    parser.add_argument("--but", metavar="WORD", action="append", default=[],
                        help="all rows but those whose name has this in it; "
                        "may be given several times")
    parser.add_argument("--cluster", action="store_true",
                        help="the rows of several servers over one PostgreSQL, "
                        "instead of those of one server: some five minutes, "
                        "with --long some 30")
    parser.add_argument("--envoy", action="store_true",
                        help="with --cluster: clients call by way of the real "
                        "Envoy, with the\nconfiguration of deploy/cluster, in every "
                        "row")
    parser.add_argument("--logs", metavar="DIRECTORY",
                        help="where the logs of rows that fail are kept")
    parser.add_argument("--seeds", type=int, default=1,
                        help="repeats all rows with so many seeds, one after "
                        "the other")
    arguments = parser.parse_args()
    if arguments.cluster:
        hosts.enter()
    seed = arguments.seed
    if seed is None:
        seed = random.SystemRandom().randrange(2**32) if arguments.long \
            else 20101018
    failures = skips = 0
    table = []
    with tempfile.TemporaryDirectory(prefix="revisit-faults-",
                                     dir=scratch(arguments)) as where:
        for each in range(seed, seed + arguments.seeds):
            print(f"seed {each}", flush=True)
            for line in run_rows(arguments, each, where):
                failures += line[-1] == "FAILED"
                skips += line[-1] == "SKIPPED"
                table.append(line)

    print("\n| rows | tried | expected | seen | rounds | |\n|-|-|-|-|-|-|")
    for row in table:
        print("| " + " | ".join(str(cell) for cell in row) + " |")
    print(f"\n{len(table)} faults, {failures} failed, {skips} skipped")
    sys.stdout.flush()
    # Threads of gRPC that a failed row has left would hold up the end.
    os._exit(1 if failures or not table else 0)


if __name__ == "__main__":
    main()
