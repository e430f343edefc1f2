"""Measures the figures of docs/performance.md, by the other benchmarks of this folder,
and writes them with their page and its pictures: tests/bench/run --curves."""

import argparse
import datetime
import json
import os
import pathlib
import re
import statistics
import subprocess
import sys
import tempfile
import time

HERE = pathlib.Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path.insert(0, str(ROOT / "docs/pictures"))

import fleet  # noqa: E402
import performance  # noqa: E402
import table  # noqa: E402
from revisit_server import BIN  # noqa: E402

# The rows of revisit_bench that the page has, by their names there.
CORE = {"dense_reckoned": "Align/dense/reckoned", "dense_fixes": "Align/dense/fixes",
        "check_reckoned": "Align/streaming/believed",
        "check_fixes": "Align/streaming/fixes"}
# A plan names sizes, numbers and seconds. Vehicles whose memory is measured have so
# many nodes together, at least, so that what a process takes by itself is little beside
# them.
FULL = {"sizes": (1000, 10_000, 100_000, 1_000_000), "seconds": 1.0, "rounds": 3,
        "batches": (1, 4, 16, 64, 256, 512), "message_vehicles": 8,
        "vehicles": (1, 10, 100, 1000, 10_000), "pace": (100, 1000, 3000, 10_000),
        "core_seconds": 0.3, "pace_seconds": 5.0, "nodes_together": 500_000}
SMALL = {"sizes": (1000,), "seconds": 0.05, "rounds": 1, "batches": (1, 64),
         "message_vehicles": 2, "vehicles": (1, 100), "pace": (100,),
         "core_seconds": 0.0, "pace_seconds": 1.0, "nodes_together": 2000}
# A vehicle that keeps to its pace sends as many, in one message each second.
PACE_POSES_PER_SECOND = 10
# A round of as many vehicles takes a minute, most of which they take to connect.
MANY_VEHICLES = 10_000


def say(words):
    print(f"{time.strftime('%H:%M:%S')} {words}", file=sys.stderr, flush=True)


def bench_core(plan):
    """Milliseconds of one core by nodes, for each row."""
    names = "|".join(CORE.values())
    sizes = "|".join(map(str, plan["sizes"]))
    with tempfile.NamedTemporaryFile() as result:
        subprocess.run(
            [BIN / "revisit_bench", f"--benchmark_filter=({names})/({sizes})(/|$)",
             f"--benchmark_out={result.name}", "--benchmark_out_format=json",
             f"--benchmark_min_time={plan['core_seconds']}"],
            check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        figures = table.Figures(json.load(result))
    return {name: [[n, figures.calls[row, n] * 1e3] for n in figures.sizes(row)]
            for name, row in CORE.items()}


def bench_server(part, rounds, **flags):
    """What each round has of this part."""
    command = [BIN / "revisit_server_bench", "--only", part, "--rounds", str(rounds)]
    for name, value in flags.items():
        command += [f"--{name.replace('_', '-')}", str(value)]
    output = subprocess.run(command, check=True, stdout=subprocess.PIPE,
                            text=True).stdout
    return [one[part] for one in json.loads(output)["rounds"]]


def median_of(rounds):
    """The median of each number of dictionaries of the same form."""
    first = rounds[0]
    if isinstance(first, dict):
        return {key: median_of([one[key] for one in rounds]) for key in first}
    return statistics.median(rounds)


def measure_calls(plan):
    calls = []
    for errors in ("reckoned", "fixes"):
        for nodes in plan["sizes"]:
            say(f"searches by calls, {errors}, {nodes} nodes")
            found = median_of(bench_server(
                "query", 1, seconds=plan["seconds"], nodes=nodes, errors=errors))
            calls.append({
                "errors": errors, "nodes": nodes, "empty_ms": found["empty"]["p50_ms"],
                "call_ms": found["find"]["p50_ms"],
                "call_p99_ms": found["find"]["p99_ms"],
                "search_ms": found["find"]["search_p50_ms"],
                "first_ms": found["first"]["ms"],
                "first_calls": found["first"]["calls"]})
    return calls


def measure_ingest(plan, rounds, vehicles, batch_poses, form):
    say(f"poses of {vehicles} vehicles, {batch_poses} a message, {form}")
    return {"form": form, **median_of([cases[0] for cases in bench_server(
        "ingest", rounds, seconds=plan["seconds"], vehicles=vehicles,
        batch_poses=batch_poses, form=form)])}


def measure_messages(plan):
    return [measure_ingest(plan, plan["rounds"], plan["message_vehicles"], batch_poses,
                           form)
            for form in performance.FORMS for batch_poses in plan["batches"]]


def measure_vehicles(plan):
    rows = []
    for vehicles in plan["vehicles"]:
        rounds = 1 if vehicles >= MANY_VEHICLES else plan["rounds"]
        rows.append(measure_ingest(plan, rounds, vehicles, 64, "columns"))
    return rows


def measure_pace(plan):
    rows = []
    for vehicles in plan["pace"]:
        say(f"acknowledgements of {vehicles} vehicles at their pace")
        rows.append(median_of(bench_server(
            "pace", 1, streams=vehicles, seconds=plan["pace_seconds"],
            poses_per_second=PACE_POSES_PER_SECOND * vehicles)))
    return rows


def measure_memory(plan):
    rows = []
    with tempfile.TemporaryDirectory(prefix="revisit-curves-") as directory:
        for nodes in plan["sizes"]:
            vehicles = max(1, plan["nodes_together"] // nodes)
            say(f"memory and loads of {vehicles} vehicles of {nodes} nodes")
            rows.append(fleet.measure_kind(fleet.Stores(directory), nodes, vehicles))
    return rows


def revision():
    """The commit of the tree, and whether it has changes besides."""
    words = subprocess.run(
        ["git", "-C", ROOT, "describe", "--always", "--abbrev=10", "--dirty"],
        capture_output=True, text=True, check=False).stdout.strip()
    return words or "unknown"


def machine():
    memory = re.search(r"MemTotal: +(\d+) kB",
                       pathlib.Path("/proc/meminfo").read_text())
    return {"processor": table.processor(), "cores": os.cpu_count(),
            "memory_gib": round(int(memory[1]) / 2 ** 20),
            "kernel": os.uname().release}


def measure(plan, small):
    begun = time.monotonic()
    figures = {"format": performance.FORMAT, "small": small, "machine": machine(),
               "date": datetime.datetime.now(datetime.timezone.utc).date().isoformat(),
               "revision": revision(), "load": os.getloadavg()[0]}
    say("searches of the core")
    figures["core"] = bench_core(plan)
    figures["calls"] = measure_calls(plan)
    figures["messages"] = measure_messages(plan)
    figures["vehicles"] = measure_vehicles(plan)
    figures["pace"] = measure_pace(plan)
    figures["memory"] = measure_memory(plan)
    figures["minutes"] = (time.monotonic() - begun) / 60
    return performance.rounded(figures)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--small", action="store_true")
    parser.add_argument("--into", default=performance.OWN)
    arguments = parser.parse_args()
    # The refusal comes before minutes are spent.
    performance.refuse_small(arguments.small, arguments.into)
    performance.write(measure(SMALL if arguments.small else FULL, arguments.small),
                      arguments.into)


if __name__ == "__main__":
    main()
