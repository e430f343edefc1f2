"""What the machines at hand cannot hold: a hundred servers, a million vehicles.

A simulation in discrete events of the protocol by which servers share one PostgreSQL:
leases with beats, claims with epochs, handovers, fenced appends in groups, loads after
a claim; Envoy's maglev table and health checks; the client library's streams and
back-off. What things cost is measured elsewhere and stands in parameters.py with its
source; what nobody measured is called "assumed" there.

    tests/simulation/run                    every scenario, one seed
    tests/simulation/run --seeds 3 death    medians and ranges of three seeds
    tests/simulation/run --parameters       every figure that goes in, with its source

After every event an oracle (cluster.py) holds the vehicles that it touched against the
promises: at most one server would answer for a vehicle from memory; what it would
answer with holds every acknowledged pose; every acknowledged pose is in the store; the
store only grows. Poses that an asynchronous failover takes back have to be told to the
client that holds the acknowledgement. A broken promise ends the run with an error.

Left out: the network but for a fixed delay (no bandwidth but PostgreSQL's, no loss);
searches, and so what they and loads take from each other's CPU (sizing.py adds them
up); vacuum, checkpoints, index growth and everything else by which PostgreSQL gets
slower with its size; memory limits (what would be held is reported); calls other than
streams and one verifier's; more than one fault at a time but where a scenario says so;
deliberate attacks. Servers, vehicles and their histories are all alike, which real
fleets are not: the tail of long histories will come before the mean.
"""

import argparse
import time

import death
import failover
import ingest
import opinions
import parameters
import restarts
import sizing
import standby
import tables

SCENARIOS = {
    "sizing": sizing.run,
    "ingest": ingest.run,
    "death": death.run,
    "restarts": restarts.run,
    "failover": failover.run,
    "opinions": opinions.run,
    "standby": standby.run,
}


def parameter_table():
    table = tables.Table("Figures that go in", ("name", "value", "unit", "source"))
    for name, figure in parameters.FIGURES.items():
        table.add(name=name, value=f"{figure.value:g}", unit=figure.unit,
                  source=figure.source)
    for model, points in parameters.CHECK_S.items():
        if model != "none":
            table.add(name=f"check, {model}", unit="ms",
                      value=" ".join(f"{1e3 * t:g}" for _, t in points),
                      source="tests/bench/RESULTS.md, tests/bench/run --core; at "
                      + " ".join(f"{n:g}" for n, _ in points) + " nodes")
    for (part, poses), points in parameters.MESSAGE_S.items():
        table.add(name=f"message of {poses}, {part}", unit="us",
                  value=" ".join(f"{1e6 * t:g}" for _, t in points),
                  source="tests/simulation/measure.py, 2026-11-24; at "
                  + " ".join(f"{n:g}" for n, _ in points) + " messages a second")
    return table


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("scenarios", nargs="*", metavar="SCENARIO",
                        help=f"of {', '.join(SCENARIOS)}; default all")
    parser.add_argument("--seeds", type=int, default=1, metavar="N",
                        help="seeds 1 to N: median (range)")
    parser.add_argument("--part", type=float, default=0.125, metavar="SHARE",
                        help="share of each server's vehicles that is simulated, on as "
                        "small a share of its\nthreads and of PostgreSQL; default 1/8, "
                        "one thread of eight")
    parser.add_argument("--parameters", action="store_true",
                        help="print the figures that go in, with their sources")
    arguments = parser.parse_args()
    unknown = set(arguments.scenarios) - set(SCENARIOS)
    if unknown:
        parser.error(f"no scenario {', '.join(sorted(unknown))}; "
                     f"there are {', '.join(SCENARIOS)}")
    if not 0.02 <= arguments.part <= 1.0:
        parser.error(f"--part {arguments.part}: from 0.02 to 1")
    if arguments.seeds < 1:
        parser.error(f"--seeds {arguments.seeds}: at least 1")
    if arguments.parameters:
        print(parameter_table().text())
        return
    seeds = range(1, arguments.seeds + 1)
    for name in arguments.scenarios or SCENARIOS:
        begun = time.monotonic()
        for table in SCENARIOS[name](seeds, arguments.part):
            print(table.text(), flush=True)
        print(f"({name}: {time.monotonic() - begun:.1f} s, seeds 1 to "
              f"{arguments.seeds}, part {arguments.part:g})\n", flush=True)


if __name__ == "__main__":
    main()
