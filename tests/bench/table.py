"""Prints the JSON of revisit_bench as one table with ratios."""

import json
import math
import platform
import sys

SEQUENCE = 75
ERRORS = ("reckoned", "confirmed", "fixes")


def processor():
    with open("/proc/cpuinfo", encoding="ascii") as info:
        for line in info:
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


class Figures:
    def __init__(self, result):
        self.context = result["context"]
        # Seconds of one item, by name and n; rows that count none have no entry.
        self.items = {}
        # All there is of a run, its counters among it.
        self.counters = {}
        # Seconds of one call.
        self.calls = {}
        for run in result["benchmarks"]:
            name = run["name"].removeprefix("BM_").split("/iterations:")[0]
            head, _, n = name.rpartition("/")
            key = (head, int(n)) if n.isdigit() else (name, 0)
            if "items_per_second" in run:
                self.items[key] = 1.0 / run["items_per_second"]
            self.counters[key] = run
            unit = {"ns": 1e-9, "us": 1e-6, "ms": 1e-3, "s": 1.0}
            self.calls[key] = run["cpu_time"] * unit[run["time_unit"]]

    def sizes(self, head):
        return sorted(n for name, n in self.calls if name == head)


def ratio(slow, fast):
    return f"{slow / fast:7.1f}x" if slow and fast else " " * 8


def kernel_table(figures):
    print("\nSimilarity of one query with n nodes, ns a pair")
    print(f"{'':10}{'n':>8}{'kernel':>9}{'Eigen':>9}{'ratio':>9}"
          f"{'dynamic':>9}{'ratio':>9}{'scalar':>9}{'ratio':>9}")
    for label, name in (("planar", "LogSimilarity"),
                        ("spatial", "LogSimilaritySpatial")):
        for n in figures.sizes(name):
            kernel = figures.items[name, n]
            line = f"{label:10}{n:8}{kernel * 1e9:9.2f}"
            for other in ("Eigen", "EigenDynamic", "Scalar"):
                seconds = figures.items.get((name + other, n))
                if seconds:
                    line += f"{seconds * 1e9:9.2f}{ratio(seconds, kernel):>9}"
            print(line)


def limit_table(figures):
    context = figures.context
    operations = float(context["kernel_operations"])
    divisions = float(context["kernel_divisions"])
    operation = figures.items["Limit/MultiplyAndAdd", 0]
    division = figures.items["Limit/Divide", 0]
    print(f"\nLimits of this machine with {context['vectors']} vectors: "
          f"{1e-9 / operation:.1f} G additions and multiplications a second, "
          f"{1e-9 / division:.2f} G divisions.")
    print(f"The planar kernel needs {operations:.0f} and {divisions:.0f} of "
          f"them a pair and reads 72 bytes: ns a pair, were it nothing else. "
          f"The limit is the greatest of the three; one by one, none overlaps "
          f"with another.")
    print(f"{'n':>8}{'kernel':>9}{'arith.':>9}{'divide':>9}{'memory':>9}"
          f"{'of limit':>10}{'one by one':>12}")
    for n in figures.sizes("Limit/ReadNodes"):
        kernel = figures.items.get(("LogSimilarity", n))
        if not kernel:
            continue
        parts = (operations * operation, divisions * division,
                 figures.items["Limit/ReadNodes", n])
        print(f"{n:8}{kernel * 1e9:9.2f}" +
              "".join(f"{part * 1e9:9.2f}" for part in parts) +
              f"{max(parts) / kernel:10.0%}{sum(parts) / kernel:12.0%}")


def slope(figures, name):
    sizes = figures.sizes(name)
    if len(sizes) < 2:
        return "     "
    first, last = sizes[0], sizes[-1]
    return "%5.2f" % (
        math.log(figures.calls[name, last] / figures.calls[name, first]) /
        math.log(last / first))


def align_line(figures, head, against):
    """Milliseconds by n, with the ratio to what it is set against."""
    line = f"{head:26}"
    for n in figures.sizes(head):
        seconds = figures.calls[head, n]
        other = figures.calls.get((against, n))
        line += f"{seconds * 1e3:10.3f} {ratio(other, seconds):>8}"
    print(line + f"   {slope(figures, head)}")


def align_table(figures):
    sizes = figures.sizes("Align/dense/reckoned")
    top = f"{'':26}" + "".join(f"{n:>19}" for n in sizes) + "   slope"
    print(f"\nAlignment of {SEQUENCE} nodes with n, ms "
          "(and ratio to literal Algorithm 1)")
    print(top)
    align_line(figures, "AlignLiteral", "AlignLiteral")
    align_line(figures, "Align/dense/composite", "AlignLiteral")
    for errors in ERRORS:
        align_line(figures, "Align/dense/" + errors, "AlignLiteral")
    print("\nThe same where ends that cannot be accepted are left out, ms "
          "(and ratio to dense),\nwith the shares of nodes that pass the gate "
          "at the end pose and that were considered;\nstreaming: a whole check "
          "of the drive after one more node")
    print(top)
    for errors in ERRORS:
        align_line(figures, "Align/pruned/" + errors, "Align/dense/" + errors)
        for counter in ("in_gate", "considered"):
            print(f"{'  ' + counter:26}" + "".join(
                f"{figures.counters['Align/pruned/' + errors, n][counter]:19.4%}"
                for n in sizes))
    align_line(figures, "Align/streaming/fixes", "Align/dense/fixes")
    align_line(figures, "Align/streaming/believed", "Align/dense/reckoned")


def main():
    with open(sys.argv[1], encoding="utf-8") as result:
        figures = Figures(json.load(result))
    context = figures.context
    print(f"{context['host_name']}: {processor()}, {context['num_cpus']} cores "
          f"at {context['mhz_per_cpu']} MHz, load "
          f"{context['load_avg'][0]:.1f}, {context['date']}")
    kernel_table(figures)
    limit_table(figures)
    align_table(figures)


if __name__ == "__main__":
    main()
