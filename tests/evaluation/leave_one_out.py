#!/usr/bin/env python3
"""Leave-one-out: what the relative alignment's settings are worth on drives
that had no say in choosing them.

Runs the real `revisit evaluate --json` once for each point of a small grid
over --road-spacing, --shape-correlation and --acceptance-probability. Then, for
each drive, takes the point that has the best F1 over all the other drives, and
counts what that point does on the drive that was left out. The sum over the
drives is the held-out total. Where points tie, the one nearer to the defaults
wins.

With `--by data-set`, all drives of the data set of a drive are left out with
it: settings that are chosen on one city are judged in another. The data set is
the drive's name up to the first underscore.

    leave_one_out.py [--revisit PROGRAM] [--by drive|data-set]
                     [--road-spacing M,M,...]
                     [--shape-correlation M,M,...]
                     [--acceptance-probability P,P,...] [--json]
                     DRIVE.csv DRIVE.csv ... [-- FLAGS OF revisit evaluate]

Needs nothing but Python 3.8 or newer.
"""

import argparse
import itertools
import json
import pathlib
import sys

from reports import REVISIT, report_of

# Flag, values that are tried, default of the service.
SETTINGS = {
    "road-spacing": ((100.0, 200.0, 400.0), 200.0),
    "shape-correlation": ((10.0, 20.0, 40.0), 20.0),
    "acceptance-probability": ((0.35, 0.45, 0.55), 0.45),
}

COUNTS = ("checks", "true_loops", "accepted", "accepted_correct",
          "top1_correct")


def total(counts):
    """Sums of counts over drives."""
    counts = list(counts)
    return {name: sum(one[name] for one in counts) for name in COUNTS}


def ratio(numerator, denominator):
    return numerator / denominator if denominator > 0 else None


def f1(counts):
    return ratio(2 * counts["accepted_correct"],
                 counts["accepted"] + counts["true_loops"])


def data_set(drive):
    return drive.split("_", 1)[0]


GROUPS = {"drive": lambda drive: drive, "data-set": data_set}


def hold_out(results, group=GROUPS["drive"]):
    """For each drive: (drive, point chosen by the others, counts on the drive).

    `results` has for each point of the grid, the preferred first, the counts of
    each drive: {point: {drive: counts}}. The others are the drives of which
    `group` answers otherwise.
    """
    drives = list(next(iter(results.values())))
    held_out = []
    for drive in drives:
        def others_f1(point):
            score = f1(total(counts for name, counts in results[point].items()
                             if group(name) != group(drive)))
            return -1.0 if score is None else score
        # max() keeps the first of those that tie.
        chosen = max(results, key=others_f1)
        held_out.append((drive, chosen, results[chosen][drive]))
    return held_out


def grid(values, defaults):
    """All points, the fewest departures from the defaults first."""
    points = itertools.product(*values)
    return sorted(points, key=lambda point: sum(
        value != default for value, default in zip(point, defaults)))


def evaluate(program, drives, point, flags):
    settings = [word for name, value in zip(SETTINGS, point)
                for word in (f"--{name}", repr(value))]
    counts = {}
    for drive in report_of(program, *drives, *flags, *settings)["drives"]:
        # Seeds of a simulated drive are left out together.
        before = counts.get(drive["drive"])
        counts[drive["drive"]] = total([drive] + ([before] if before else []))
    return counts


def text(value):
    return "-" if value is None else f"{value:.3f}"


def line(name, counts, point=()):
    return "  ".join([
        f"{name:24}", f"{counts['checks']:6}", f"{counts['true_loops']:5}",
        f"{counts['accepted']:8}", f"{counts['accepted_correct']:5}",
        f"{text(ratio(counts['accepted_correct'], counts['accepted'])):>9}",
        f"{text(ratio(counts['accepted_correct'], counts['true_loops'])):>6}",
        f"{text(f1(counts)):>5}",
        f"{text(ratio(counts['top1_correct'], counts['true_loops'])):>5}",
        ", ".join(f"{value:g}" for value in point)]).rstrip()


def numbers(argument):
    return tuple(float(value) for value in argument.split(","))


def main():
    parser = argparse.ArgumentParser(
        description=__doc__.split("\n\n", maxsplit=1)[0])
    parser.add_argument("--revisit", default=REVISIT)
    for name, (values, _) in SETTINGS.items():
        parser.add_argument(f"--{name}", type=numbers, default=values)
    parser.add_argument("--by", choices=GROUPS, default="drive",
                        help="what is left out together")
    parser.add_argument("--json", action="store_true")
    parser.add_argument("drives", nargs="+", metavar="DRIVE.csv")
    arguments = sys.argv[1:]
    flags = []
    if "--" in arguments:
        at = arguments.index("--")
        arguments, flags = arguments[:at], arguments[at + 1:]
    options = parser.parse_args(arguments)
    if len(options.drives) < 2:
        parser.error("expected two drives at least")
    group = GROUPS[options.by]
    if len({group(pathlib.Path(drive).stem) for drive in options.drives}) < 2:
        parser.error(f"--by {options.by}: expected drives of two at least")

    values = [getattr(options, name.replace("-", "_")) for name in SETTINGS]
    points = grid(values, [default for _, default in SETTINGS.values()])
    results = {}
    for number, point in enumerate(points, start=1):
        print(f"{number} of {len(points)}: {point}", file=sys.stderr)
        results[point] = evaluate(options.revisit, options.drives, point, flags)

    held_out = hold_out(results, group)
    held_out_total = total(counts for _, _, counts in held_out)
    totals = {point: total(drives.values())
              for point, drives in results.items()}
    best = max(totals, key=lambda point: f1(totals[point]) or 0.0)
    first = points[0]
    if options.json:
        print(json.dumps({
            "settings": list(SETTINGS),
            "held_out": [{"drive": drive, "point": point, **counts}
                         for drive, point, counts in held_out],
            "held_out_total": held_out_total,
            "points": [{"point": point, **counts}
                       for point, counts in totals.items()],
        }, indent=1))
        return
    print(f"{'':24}  CHECKS  LOOPS  ACCEPTED  RIGHT  PRECISION  RECALL     F1"
          f"  TOP-1  {', '.join(SETTINGS)}")
    for drive, point, counts in held_out:
        print(line(drive, counts, point))
    print(line("held out, total", held_out_total))
    print(line("nearest to the defaults", totals[first], first))
    print(line("best in hindsight", totals[best], best))


if __name__ == "__main__":
    main()
