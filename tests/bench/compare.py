"""Runs the benchmarks of two builds in turn, and prints one table of ratios: what a
change costs. See tests/bench/run --help."""

import argparse
import json
import math
import re
import statistics
import subprocess
import sys

# Rows of the bench's own arithmetic, in which nothing of the core is measured.
OWN_ARITHMETIC = re.compile(r"Limit/|Eigen|Scalar|AlignLiteral")

MICROSECONDS = {"ns": 1e-3, "us": 1.0, "ms": 1e3, "s": 1e6}


class Core:
    """Rows of a revisit_bench: CPU time of its thread, a process for each."""

    def __init__(self, program, pattern):
        self.program = program
        listed = subprocess.run(
            [program, "--benchmark_list_tests"], check=True, text=True,
            stdout=subprocess.PIPE).stdout.split()
        rows = {re.sub(r"^BM_|/iterations:\d+", "", name): name for name in listed}
        # The names that the program gives its rows, by those in the table.
        self.rows = {row: name for row, name in rows.items()
                     if re.search(pattern, row)
                     and not OWN_ARITHMETIC.search(row)}

    def measure(self, row):
        result = json.loads(subprocess.run(
            [self.program, f"--benchmark_filter=^{re.escape(self.rows[row])}$",
             "--benchmark_format=json", "--benchmark_min_time=0.3"],
            check=True, text=True, stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL).stdout)
        (run,) = result["benchmarks"]
        return run["cpu_time"] * MICROSECONDS[run["time_unit"]]


class Server:
    """Rows of a revisit_server_bench: CPU time of the server a pose, and latencies
    of calls. One process measures all rows of a part."""

    PARTS = ("ingest", "query")

    def __init__(self, program, pattern, flags):
        self.program = program
        self.flags = flags
        self.rows = [part for part in self.PARTS if re.search(pattern, part)]

    @staticmethod
    def rows_of(one):
        """The rows of one round of the program's answer."""
        rows = {}
        for case in one.get("ingest", []):
            head = f"ingest/{case['vehicles']}/{case['batch_poses']}"
            rows[head + "/cpu_a_pose"] = (
                case["revisit"]["server_cpu_us_per_pose"])
        for head, call in one.get("query", {}).items():
            if head in ("find", "find_without_belief", "info"):
                rows[f"query/{head}/p50"] = 1e3 * call["p50_ms"]
                if "search_p50_ms" in call:
                    rows[f"query/{head}/search_p50"] = 1e3 * call["search_p50_ms"]
        return rows

    def measure(self, part):
        result = json.loads(subprocess.run(
            [self.program, "--only", part, "--rounds", "1", *self.flags],
            check=True, text=True, stdout=subprocess.PIPE).stdout)
        return self.rows_of(result["rounds"][0])


def text(microseconds):
    if microseconds >= 1e4:
        return f"{microseconds / 1e3:.1f} ms"
    return f"{microseconds:.{max(0, 3 - len(str(int(microseconds))))}f} us"


class Row:
    """What was measured of one row, a pair for each round."""

    def __init__(self):
        self.pairs = []

    def ratios(self):
        return [now / before if before else math.inf
                for before, now in self.pairs]

    def ratio(self):
        return statistics.median(self.ratios())

    def line(self, name, bound):
        before, now = (statistics.median(side) for side in zip(*self.pairs))
        ratios = self.ratios()
        return (f"{name:34}{text(before):>12}{text(now):>12}{self.ratio():8.2f}x "
                f"({min(ratios):.2f} to {max(ratios):.2f}, {len(ratios)})"
                + ("  BEYOND" if self.ratio() > bound else ""))


def measure(sides, names, rounds, rows):
    """Adds so many rounds of these names, the sides in turn and neither always
    the first."""
    for i in range(rounds):
        for name in names:
            results = {}
            for side in (sides if i % 2 == 0 else sides[::-1]):
                values = side.measure(name)
                results[side] = values if isinstance(values, dict) else {
                    name: values}
            before, now = (results[side] for side in sides)
            for row in now:
                if row in before:
                    rows.setdefault((name, row), Row()).pairs.append(
                        (before[row], now[row]))


def compare(sides, rounds, bound):
    """Rows by (what measures it, its name), and what only one side has."""
    before, now = (side.rows for side in sides)
    common = [name for name in now if name in before]
    rows = {}
    measure(sides, common, rounds, rows)
    # Noise that makes a row worse once hardly does so twice.
    suspects = list(dict.fromkeys(
        name for (name, _), row in rows.items() if row.ratio() > bound))
    measure(sides, suspects, rounds, rows)
    return rows, [name for name in [*before, *now] if name not in common]


def print_table(kind, revision, rows, bound):
    print(f"\n{kind}, this tree against {revision} in turn: medians, and of the "
          f"ratios of the rounds\nthe median, least and greatest, and how many; beyond "
          f"{bound:g} is too slow")
    print(f"{'':34}{revision:>12}{'this tree':>12}{'ratio':>9}")
    for (_, name), row in rows.items():
        print(row.line(name, bound))


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    for kind in ("core", "server"):
        parser.add_argument(f"--{kind}", nargs=2, metavar=("BEFORE", "NOW"))
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--bound", type=float, default=1.1)
    parser.add_argument("--filter", default=".")
    parser.add_argument("--revision", required=True)
    parser.add_argument("--server-flag", action="append", default=[])
    options = parser.parse_args()
    kinds = {}
    if options.core:
        kinds["core"] = [Core(program, options.filter)
                         for program in options.core]
    if options.server:
        kinds["server"] = [Server(program, options.filter, options.server_flag)
                           for program in options.server]
    measured = []
    for kind, sides in kinds.items():
        rows, alone = compare(sides, options.rounds, options.bound)
        if rows:
            print_table(kind, options.revision, rows, options.bound)
        if alone:
            print("Not compared, since only one of the two has it: "
                  + ", ".join(alone))
        measured += rows.values()
    if not measured:
        sys.exit(f"tests/bench/run: no row of both {options.revision} and this "
                 f"tree matches {options.filter}")
    slow = sum(row.ratio() > options.bound for row in measured)
    if slow:
        sys.exit(f"tests/bench/run: {slow} of {len(measured)} rows are beyond "
                 f"{options.bound:g} times {options.revision}")


if __name__ == "__main__":
    main()
