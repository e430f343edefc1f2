#!/usr/bin/env python3
"""Tables of RESULTS.md that take more than one command, in Markdown.

    tables.py [--revisit PROGRAM] [--nagoya DIR] [--drives DIR] [--kitti DIR]
              [TABLE ...] [--sessions DRIVE DRIVE ... [--register]]

  height      drives with heights, by planar and by spatial vehicles
  filter      a filter's poses under each of the three models of correlation
  lengths     Nagoya with sequences of 100 to 400 m
  claims      covariances as estimators and drivers send them (claims.py)
  situations  straight roads, symmetric corners and what helps (situations.py)
  recordings  sessions of one town as recordings of one vehicle, of which each asks
              once for places in the others

Without names, all of them are printed, but recordings only with its sessions. They
need, besides the shipped drive:

  --nagoya  spp_2023.pos, spp_2024.pos, reference_2023.csv, reference_2024.csv
            (or the same with .gz)
  --drives  the development drives, such as kitti_00.csv, that of each file in
            --kitti among them
  --kitti   true poses of KITTI's odometry benchmark, such as 00.txt, and what
            estimators made of them, such as 00_sptam.txt: 12 numbers a line
  --sessions  drive files whose truths are in one frame or, with --register, are laid
            over each other first (registration.py); "boreas" stands for the two days
            of the shipped drive

Needs Python 3.8 or newer and numpy.
"""

import argparse
import csv
import math
import pathlib
import sys
import tempfile

import claims
import filtered_drive
import registration
import situations
from reports import REVISIT, ROOT, decimals, markdown, report_of

BOREAS = ROOT / "tests/data/boreas"
LENGTHS = (100, 150, 200, 300, 400)
ALIGNMENTS = {"relative": "relative", "paper's": "composite"}
MODELS = ("filter", "dead-reckoning", "independent")
# Receivers' fixes as they come, and one each two minutes, as where buildings or
# tunnels hide the sky: what is then believed of each is what it states.
FIXES = {"each second": (filtered_drive.FIX_SCALE, 0.0),
         "each 120 s": (1.0, 120.0)}
FILTER_SEEDS = range(1, 6)
DEVELOPMENT = ("kitti_00", "kitti_02", "kitti_05", "kitti_06", "mulran_DCC_01",
               "mulran_DCC_02", "mulran_DCC_03")
#: Seconds without poses between the two days of the shipped drive.
NIGHT = 3600.0
#: What is known of the frames: the words of --recordings, and what else is asked for.
#: Overlaps are twice as long as sequences.
SEQUENCE = ("--sequence-length", 300)
RELATIONS = {
    "datum 10 m, 1 degree": ("datum:10m,1deg", *SEQUENCE),
    "50 m, 1 degree": ("datum:50m,1deg", *SEQUENCE),
    "200 m, 5 degrees": ("datum:200m,5deg", *SEQUENCE),
    "10 m, from the first link on": ("datum:10m,1deg", "--verify", *SEQUENCE),
    "200 m, from the first link on": ("datum:200m,5deg", "--verify", *SEQUENCE),
    "unknown, overlaps of 600 m": ("unknown", *SEQUENCE),
    "unknown, overlaps of 1,000 m": ("unknown", "--sequence-length", 500),
    "datum 10 m, claims of odometry x 0.5": (
        "datum:10m,1deg", "--claimed-scale", 0.5, *SEQUENCE),
    "datum 10 m, claims of odometry x 2": (
        "datum:10m,1deg", "--claimed-scale", 2, *SEQUENCE),
}


def with_interval(total, name):
    """A figure of a report, with where 95 of 100 such figures lie."""
    interval = total[f"{name}_95"]
    cell = decimals(total[name])
    return cell if interval is None else (
        f"{cell} ({decimals(interval[0])} to {decimals(interval[1])})")


def figures(total):
    """Cells of TITLES for the counts of a report."""
    return [f"{total['true_loops']} / {total['checks']}", total["accepted"],
            total["accepted_correct"], with_interval(total, "precision"),
            with_interval(total, "recall"), with_interval(total, "f1"),
            decimals(total["sure_recall"]),
            with_interval(total, "positive_calibration_error")]


TITLES = ["true loops / checks", "accepted", "right", "precision", "recall",
          "F1", "p ≥ 0.9", "ECE ≥ 0.1"]


def find(folder, name):
    """The file of this name, compressed or not."""
    for path in (folder / name, folder / f"{name}.gz"):
        if path.exists():
            return path
    sys.exit(f"{folder / name}: not found")


def nagoya(options):
    """Solutions and references, each in order."""
    return [[find(options.nagoya, f"{kind}_{year}.{ending}")
             for year in (2023, 2024)]
            for kind, ending in (("spp", "pos"), ("reference", "csv"))]


def nagoya_flags(options):
    solutions, references = nagoya(options)
    return [*solutions, "--one-vehicle", "--truth", *references]


def add_column(drive, out, name, values):
    """The drive file with one more column."""
    lines = drive.read_text().splitlines()
    if len(lines) != len(values) + 1:
        raise ValueError(f"{drive} has {len(lines) - 1} poses, "
                         f"and there are {len(values)} heights")
    column = [name, *(f"{value:.3f}" for value in values)]
    out.write_text("".join(f"{line},{value}\n"
                           for line, value in zip(lines, column)))
    return out


def boreas_heights():
    for day in ("boreas-2021-08-05-13-34", "boreas-2021-09-02-11-42"):
        with open(BOREAS / day / "lidar_poses_1hz.csv",
                  encoding="ascii") as file:
            for row in csv.DictReader(file):
                yield float(row["altitude"])


def read_kitti(path):
    """Poses (x, y, z, yaw) with x forward, y left and z up at the first one; the
    file has x right, y down and z forward."""
    for line in path.read_text().split("\n"):
        if line:
            m = [float(word) for word in line.split()]
            yield m[11], -m[3], -m[7], math.atan2(-m[2], m[10])


def write_estimates(drive, poses, out):
    """A drive file with the truth of another one and these estimates."""
    with open(drive, encoding="ascii") as file:
        rows = list(csv.DictReader(file))
    if len(rows) != len(poses):
        raise ValueError(f"{drive} has {len(rows)} poses, "
                         f"and there are {len(poses)} estimates")
    truth = ("t_s", "gt_x", "gt_y", "gt_yaw")
    lines = [",".join([*truth, "est_x,est_y,est_z,est_yaw"])]
    lines += [",".join([*(row[name] for name in truth),
                        *(f"{number:.6f}" for number in pose)])
              for row, pose in zip(rows, poses)]
    out.write_text("\n".join(lines) + "\n")
    return out


def drives_with_height(options, folder):
    """(what a drive is, the arguments of `revisit evaluate` for it)."""
    boreas = add_column(BOREAS / "boreas_glen_shields.csv",
                        folder / "boreas.csv", "gt_z", list(boreas_heights()))
    yield "shipped drive, 5 seeds", [boreas, "--simulate", "1-5"]
    for path in sorted(options.kitti.glob("[0-9][0-9]*.txt")):
        number, _, estimator = path.stem.partition("_")
        drive = find(options.drives, f"kitti_{number}.csv")
        poses = list(read_kitti(path))
        if estimator:
            yield f"{drive.stem}, {estimator}", [write_estimates(
                drive, poses, folder / f"{path.stem}.csv")]
        else:
            heights = [z for _, _, z, _ in poses]
            yield f"{drive.stem}, 40 seeds", [
                add_column(drive, folder / drive.name, "gt_z", heights),
                "--simulate", "1-40"]
    yield "Nagoya", nagoya_flags(options)


def height(options, folder):
    rows = []
    for drive, arguments in drives_with_height(options, folder):
        for alignment, word in ALIGNMENTS.items():
            for space in ("planar", "spatial"):
                report = report_of(options.revisit, *arguments, "--alignment",
                                   word, "--state-space", space)
                rows.append([drive, alignment, space.upper(),
                             *figures(report["total"])])
    return markdown(["drive", "alignment", "state", *TITLES], rows)


def filtered_poses(options, folder):
    rows = []
    for fixes, (scale, seconds) in FIXES.items():
        drives = []
        for seed in FILTER_SEEDS:
            drives.append(folder / f"filtered_{seconds:g}_{seed}.csv")
            filtered_drive.write_drive(drives[-1], filtered_drive.filtered(
                *nagoya(options), seed, scale, seconds))
        for alignment, word in ALIGNMENTS.items():
            for model in MODELS:
                report = report_of(
                    options.revisit, *drives, "--alignment", word,
                    "--correlation-model", model, "--uncertainty", "fixes")
                rows.append([fixes, alignment,
                             model.upper().replace("-", "_"),
                             *figures(report["total"])])
    return markdown(["fixes", "alignment", "claimed", *TITLES], rows)


def lengths(options, _):
    rows = {length: [f"{length}"] for length in LENGTHS}
    for number, word in enumerate(ALIGNMENTS.values()):
        report = report_of(
            options.revisit, *nagoya_flags(options), "--alignment", word,
            "--sequence-lengths", ",".join(map(str, LENGTHS)))
        for method in report["methods"]:
            cells = figures(method["total"])
            # What is true does not depend on the alignment.
            row = rows[round(method["sequence_length_meters"])]
            row += cells[:1] if number == 0 else []
            row += [f"{cells[3]} / {cells[4]}", cells[5]]
            row += cells[6:] if word == "relative" else []
    return markdown(
        ["sequence, m", TITLES[0], "relative: precision / recall",
         *TITLES[5:], "paper: precision / recall", "F1"], rows.values())


def right_where_sure(report):
    """Of the first candidates that are stated at 0.9 or more, those that are right."""
    sure = [first for drive in report["drives"] for check in drive["check_list"]
            for first in check["candidates"][:1] if first["probability"] >= 0.9]
    return f"{sum(first['correct'] for first in sure)} of {len(sure)}"


def claimed_shapes(options, folder):
    rows = []
    for shape in claims.SHAPES:
        drives = [claims.write_claimed(find(options.drives, f"{name}.csv"), shape,
                                       folder / f"{name}_{shape}.csv")
                  for name in DEVELOPMENT]
        report = report_of(options.revisit, *drives, "--uncertainty", "fixes",
                           "--correlation-model", "dead-reckoning", "--verbose")
        rows.append([shape, *figures(report["total"]), right_where_sure(report)])
    return markdown(["claims", *TITLES, "right of those stated at 0.9 and more"],
                    rows)


def days_of_boreas(folder):
    """The two days of the shipped drive, each as a file of its own."""
    lines = (BOREAS / "boreas_glen_shields.csv").read_text().splitlines()
    times = [float(line.split(",")[1]) for line in lines[1:]]
    night = next(i for i in range(1, len(times)) if times[i] - times[i - 1] > NIGHT)
    days = []
    for name, part in (("day_1", lines[1:night + 1]), ("day_2", lines[night + 1:])):
        days.append(folder / f"boreas_{name}.csv")
        days[-1].write_text("\n".join([lines[0], *part]) + "\n")
    return days


def sessions_of(options, folder):
    """The drive files, and what is to be said of their truths."""
    if [str(one) for one in options.sessions] == ["boreas"]:
        return days_of_boreas(folder), ""
    if not options.register:
        return options.sessions, ""
    drives, apart = registration.write_registered(options.sessions, folder)
    return drives, "".join(
        f"{drive.stem}: its truth lies {off:.1f} m beside that of "
        f"{drives[0].stem} (median)\n" for drive, off in zip(drives[1:], apart[1:]))


def recordings(options, folder):
    drives, notes = sessions_of(options, folder)
    rows = []
    for relation, arguments in RELATIONS.items():
        total = report_of(options.revisit, *drives, "--one-vehicle", "--recordings",
                          *arguments)["total"]
        rows.append([relation, *figures(total),
                     f"{total['new_road_accepted']} of {total['new_road_checks']}"])
    return notes + markdown(["frames", *TITLES, "accepted at new roads"], rows)


def all_situations(options, _):
    return situations.table(options.revisit, "1-40")


# Each with the folders that it needs.
TABLES = {"height": (height, ("nagoya", "drives", "kitti")),
          "filter": (filtered_poses, ("nagoya",)),
          "lengths": (lengths, ("nagoya",)),
          "claims": (claimed_shapes, ("drives",)),
          "situations": (all_situations, ()),
          "recordings": (recordings, ("sessions",))}


def main():
    parser = argparse.ArgumentParser(
        description=__doc__.split("\n\n", maxsplit=1)[0])
    parser.add_argument("--revisit", default=REVISIT)
    for folder in ("nagoya", "drives", "kitti"):
        parser.add_argument(f"--{folder}", type=pathlib.Path, metavar="DIR")
    parser.add_argument("--sessions", type=pathlib.Path, nargs="+", metavar="DRIVE")
    parser.add_argument("--register", action="store_true")
    parser.add_argument("tables", nargs="*", metavar="TABLE",
                        help=", ".join(TABLES))
    options = parser.parse_args()
    chosen = options.tables or [name for name in TABLES
                                if name != "recordings" or options.sessions]
    for name in chosen:
        if name not in TABLES:
            parser.error(f"expected tables among {', '.join(TABLES)}, "
                         f"got {name}")
        for folder in TABLES[name][1]:
            if getattr(options, folder) is None:
                kind = "DRIVE ..." if folder == "sessions" else "DIR"
                parser.error(f"{name}: needs --{folder} {kind}")
    for name in chosen:
        with tempfile.TemporaryDirectory() as folder:
            print(f"{name}:\n\n{TABLES[name][0](options, pathlib.Path(folder))}"
                  "\n", flush=True)


if __name__ == "__main__":
    main()
