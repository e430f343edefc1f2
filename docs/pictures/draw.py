#!/usr/bin/env python3
"""Draws the pictures of the documents: docs/pictures/draw.py. Those of real drives
ask a server of their own, of the programs in REVISIT_BIN (build/release/bin); that of
looks shows looks.csv, which tests/evaluation/looks.py measures on drives that cannot be
shipped; the curves of performance.md show performance.json, which tests/bench/run
measures; the others are diagrams. A test compares the files with what this draws."""

import csv
import json
import math
import os
import pathlib
import re
import subprocess
import sys
import tempfile
import time

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

import performance  # noqa: E402
from picture import Picture  # noqa: E402

ROOT = HERE.parents[1]
BIN = pathlib.Path(os.environ.get("REVISIT_BIN", ROOT / "build/release/bin"))
DRIVE = ROOT / "tests/data/boreas/boreas_glen_shields.csv"
# Rows from here on are of the second day.
SECOND_DAY = 1079


class Map:
    """Metres east and north of a rectangle of a picture."""

    def __init__(self, corner, scale, at):
        self._corner, self.scale, self._at = corner, scale, at

    def __call__(self, x, y):
        return (self._at[0] + (x - self._corner[0]) * self.scale,
                self._at[1] - (y - self._corner[1]) * self.scale)

    def bar(self, picture, at, meters):
        end = (at[0] + meters * self.scale, at[1])
        picture.path([(at[0], at[1] - 4), at, end, (end[0], end[1] - 4)], "soft")
        picture.text(((at[0] + end[0]) / 2, at[1] - 8), f"{meters} m", "soft small",
                     "middle")


# ---- Diagrams


def along(points, step, first=0.0):
    """Points each `step` along a polyline."""
    found, left = [], first
    for (x0, y0), (x1, y1) in zip(points, points[1:]):
        length = math.hypot(x1 - x0, y1 - y0)
        while left <= length:
            share = left / length
            found.append((x0 + share * (x1 - x0), y0 + share * (y1 - y0)))
            left += step
        left -= length
    return found


def poses_and_nodes():
    picture = Picture(760, 270, "Poses become nodes, evenly spaced along the path")
    curve = [(40 + t, 150 - 45 * math.sin(t / 75)) for t in range(0, 471, 2)]
    after = [(595 + t, 118 + 40 * math.sin(t / 60)) for t in range(0, 131, 2)]
    nodes, later = along(curve, 24.0), along(after, 24.0)
    for part in (curve, after):
        picture.path(part, "line")
    picture.path([curve[-1], after[0]], "red dashed")
    for part in (nodes, later):
        for at in part:
            picture.dot(at, 5, "blue hollow")
    rows = [0, 14, 37, 52, 60, 66, 70, 72, 73, 74, 75, 77, 80, 95, 112, 120, 142, 165,
            178, 200, 213, 235]
    for at in [curve[row] for row in rows] + [after[row] for row in (0, 19, 38, 57)]:
        picture.dot(at, 2.6, "orange")
    picture.path([(nodes[12][0], 214), (nodes[12][0], nodes[12][1] + 8)], "green")
    picture.dot(nodes[12], 8, "green hollow")
    picture.dot(nodes[12], 4, "green")
    picture.text((nodes[12][0], 230), "a check: “where have I been before?”",
                 "green bold", "middle")
    picture.path([(curve[73][0], 60), (curve[73][0], curve[73][1] - 9)], "orange")
    picture.text((curve[73][0] - 20, 50), "poses while it stands add no node",
                 "orange", "middle")
    picture.text((555, 70), "jump: cut here,", "red", "middle")
    picture.text((555, 86), "no edge", "red", "middle")
    picture.dot((40, 252), 2.6, "orange")
    picture.text((50, 256), "pose, as it was sent")
    picture.dot((205, 252), 5, "blue hollow")
    picture.text((217, 256), "node, every 2 m of path")
    picture.path([(395, 252), (425, 252)], "line")
    picture.text((433, 256), "edge between neighbours")
    return picture


# How a round trip goes: name, what it does, place of its box.
BOXES = (("vehicle", "odometry, filter or fixes", 30, 40),
         ("revisit", "one pose graph per vehicle", 290, 40),
         ("your verifier", "compares images or scans", 550, 40),
         ("your optimiser", "GTSAM, Ceres, g2o …", 290, 215))


def round_trip():
    picture = Picture(760, 300, "Poses in, candidates out, reports back")
    for name, work, x, y in BOXES:
        classes = "blue pale" if name == "revisit" else "soft"
        picture.box(x, y, 180, 62, classes)
        picture.text((x + 90, y + 27), name, "bold", "middle")
        picture.text((x + 90, y + 47), work, "soft small", "middle")
    picture.arrow((210, 71), (290, 71), "ink")
    picture.text((250, 60), "poses", "", "middle")
    picture.arrow((470, 58), (550, 58), "ink")
    picture.text((510, 48), "candidates", "", "middle")
    picture.arrow((550, 88), (470, 88), "green")
    picture.text((510, 108), "confirm,", "green", "middle")
    picture.text((510, 124), "reject", "green", "middle")
    picture.arrow((350, 102), (350, 215), "ink")
    picture.text((340, 155), "graph with", "", "end")
    picture.text((340, 171), "loop closures", "", "end")
    picture.arrow((410, 215), (410, 102), "green")
    picture.text((420, 155), "optimised poses,", "green")
    picture.text((420, 171), "if you want", "green")
    picture.text((30, 135), "Each report improves", "soft small")
    picture.text((30, 151), "the searches after it.", "soft small")
    return picture


def gate():
    picture = Picture(760, 300, "The gate: is the difference within the covariance?")
    centre, axes, turn = (250, 150), (165, 78), -0.45
    picture.ellipse(centre, axes, turn, "blue pale")

    def at(radius, angle):
        x, y = radius * axes[0] * math.cos(angle), radius * axes[1] * math.sin(angle)
        return (centre[0] + x * math.cos(turn) - y * math.sin(turn),
                centre[1] + x * math.sin(turn) + y * math.cos(turn))

    inside = at(math.sqrt(5.27 / 7.81), 0.15)
    beyond = at(math.sqrt(22.66 / 7.81), 1.15)
    for end, colour in ((inside, "green"), (beyond, "red")):
        picture.arrow(centre, end, colour)
        picture.dot(end, 4, colour)
    picture.dot(centre, 4, "ink")
    picture.text((centre[0] - 10, centre[1] - 8), "no difference", "", "end")
    picture.text((inside[0] + 36, inside[1] + 4), "D2 = 5.27: within", "green bold")
    picture.text((beyond[0] + 12, beyond[1] + 4), "D2 = 22.66: beyond", "red bold")
    picture.path([(545, 116), (390, 130)], "blue thin")
    for row, (words, classes) in enumerate((
            ("the threshold, D2 = 7.81:", "blue bold"),
            ("19 of 20 true revisits", "blue"),
            ("lie within this ellipse", "blue"))):
        picture.text((550, 120 + 18 * row), words, classes)
    picture.text((550, 40), "D2 is the difference,", "soft small")
    picture.text((550, 56), "measured in standard", "soft small")
    picture.text((550, 72), "deviations and squared.", "soft small")
    return picture


def interval():
    picture = Picture(760, 260, "The place interval of a candidate along the road")
    road, unit = 165, 7.4

    def x(meters):
        return 380 + unit * meters

    picture.box(x(-42), road - 13, 84 * unit, 26, "line")
    for meters in range(-40, 41, 2):
        height = 78 * math.exp(-0.5 * ((meters - 10) / 8.5) ** 2)
        picture.box(x(meters) - 4, road - 20 - height, 8, max(height, 0.5),
                    "blue filled")
        picture.dot((x(meters), road), 2.2, "soft")
    picture.dot((x(0), road), 5.5, "green")
    for meters in (0, 20):
        picture.path([(x(meters - 10), road + 34), (x(meters - 10), road + 28),
                      (x(meters + 10), road + 28), (x(meters + 10), road + 34)],
                     "orange")
        picture.text((x(meters), road + 48), f"look at {meters:+d} m" if meters
                     else "look at the match", "orange small", "middle")
    picture.arrow((x(10), 46), (x(-4), 46), "ink")
    picture.arrow((x(10), 46), (x(26), 46), "ink")
    for meters in (-4, 26):
        picture.path([(x(meters), 40), (x(meters), road - 14)], "ink dashed thin")
    picture.text((x(11), 32), "ALONG m: -4.0 to +26.0", "bold", "middle")
    picture.text((x(-42), 100), "how probable each node is", "blue")
    picture.text((x(-42), road + 32), "the stretch of road,", "soft small")
    picture.text((x(-42), road + 47), "40 m to either side", "soft small")
    picture.text((x(0), road + 78), "the matched node: SEQUENCE, X, Y", "green",
                 "middle")
    picture.path([(x(0), road + 64), (x(0), road + 53)], "green")
    picture.path([(x(0), road + 26), (x(0), road + 8)], "green")
    return picture


# In their order: a question, the answer that ends here, and the verdict that it gives.
QUESTIONS = (
    ("Can the covariance of the difference be inverted?", "no", "ILL_CONDITIONED",
     "soft"),
    ("Is the difference at the end within its gate?", "no", "REJECTED_BY_GATE", "red"),
    ("Is the whole aligned path within its gate?", "no", "REJECTED_BY_SHAPE", "red"),
    ("Is its stretch of road probable enough?", "yes", "ACCEPTED", "green"),
    ("Is it, together with a place about as good?", "yes", "AMBIGUOUS", "orange"),
    ("Could even a perfect match have proved it?", "no", "UNINFORMATIVE", "orange"),
    ("Then another place, old or new, explains it better:", "", "REJECTED_BY_SHAPE",
     "red"),
)


def verdicts():
    picture = Picture(760, 48 * len(QUESTIONS) + 30, "The order of the verdicts")
    for row, (question, answer, verdict, colour) in enumerate(QUESTIONS):
        y = 20 + 48 * row
        picture.box(30, y, 390, 32, "soft")
        picture.text((44, y + 21), question)
        picture.arrow((420, y + 16), (520, y + 16), colour)
        if answer:
            picture.text((466, y + 10), answer, colour, "middle")
        picture.text((530, y + 21), verdict, f"{colour} bold")
        if row + 1 < len(QUESTIONS):
            picture.arrow((120, y + 32), (120, y + 48), "soft")
            picture.text((130, y + 45), "no" if answer == "yes" else "yes",
                         "soft small")
    return picture


# ---- Measurements


# By the columns of looks.csv: how each line is drawn, and what it is called.
ORDERS = {"value": ("blue", "by value"), "probability": ("orange", "by probability"),
          "time": ("green", "by time"), "random": ("soft dashed", "at random")}
LOOKS_SHOWN = 30


def looks():
    with open(HERE / "looks.csv", encoding="ascii", newline="") as file:
        rows = [{name: float(value) for name, value in row.items()}
                for row in csv.DictReader(file)][:LOOKS_SHOWN + 1]
    picture = Picture(760, 330, "How much of the drift is gone after so many looks")

    def at(count, share):
        return 90 + 21 * count, 270 - 220 * share

    for percent in range(0, 101, 20):
        y = at(0, percent / 100)[1]
        picture.path([(90, y), (720, y)], "ink dashed thin" if percent == 80
                     else "line thin")
        picture.text((82, y + 4), f"{percent} %", "soft small", "end")
    for count in range(0, LOOKS_SHOWN + 1, 5):
        picture.text((at(count, 0)[0], 288), str(count), "soft small", "middle")
    picture.text((405, 312), "looks at each drive", "soft", "middle")
    picture.text((90, 30), "How much is gone of the error that loop closures take away",
                 "bold")
    for row, (order, (classes, words)) in enumerate(ORDERS.items()):
        picture.path([at(row["looks"], row[order]) for row in rows], classes)
        y = 197 + 22 * row
        picture.path([(560, y - 4), (590, y - 4)], classes)
        picture.text((600, y), words, classes.split()[0])
    return picture


# ---- Real drives


class Server:
    """A server of its own, for as long as the pictures are asked for."""

    def __init__(self, directory):
        self._process = subprocess.Popen(
            [BIN / "revisitd", "--listen", "127.0.0.1:0", "--store",
             f"{directory}/store"], stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT, text=True, env=_environment())
        for line in self._process.stdout:
            if found := re.match(r"listening on (\S+?)[,;]?\s", line):
                self.address = found[1]
                return
        raise RuntimeError("revisitd does not listen")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._process.terminate()
        self._process.communicate()


def _environment():
    return {name: value for name, value in os.environ.items()
            if not name.startswith("REVISIT_")}


def ask(address, *words):
    """The JSON lines that a command of revisit prints."""
    printed = subprocess.run(
        [BIN / "revisit", *map(str, words), "--server", address, "--json"],
        check=True, capture_output=True, text=True, env=_environment()).stdout
    try:
        return [json.loads(printed)]
    except json.JSONDecodeError:
        return [json.loads(line) for line in printed.splitlines()]


def rows_of_drive():
    with open(DRIVE, encoding="utf-8") as file:
        return [{name: float(value) for name, value in row.items()}
                for row in csv.DictReader(file)]


def stream(address, vehicle, file):
    return [answer for answer in ask(
        address, "stream", file, "--uncertainty", "file", "--vehicle", vehicle,
        "--create", "--candidates") if "query" in answer]


def accepted(checks):
    for check in checks:
        if check["candidates"]:
            best = check["candidates"][0]
            if best["verdict"] == "VERDICT_ACCEPTED":
                yield best


def place(node):
    return node["pose"]["xMeters"], node["pose"]["yMeters"]


def drift(rows, checks):
    picture = Picture(760, 470, "Drift on the shipped drive, and its candidates")
    whole = Map((-1400, -60), 0.172, (30, 424))
    near = Map((-330, -75), 1.06, (345, 385))
    truth = [(row["gt_x"], row["gt_y"]) for row in rows]
    days = [[(row["est_x"], row["est_y"]) for row in part]
            for part in (rows[:SECOND_DAY], rows[SECOND_DAY:])]
    picture.path([whole(*at) for at in truth[::3]], "line thick")
    for day, colour in zip(days, ("blue", "orange")):
        picture.path([whole(*at) for at in day[::3]], colour)
    picture.text((30, 30), "the whole drive, 15.9 km", "bold")
    whole.bar(picture, (30, 448), 500)
    picture.text((340, 30), "where both days begin and end, from nearby", "bold")
    inside = [(-320, -65), (55, 245)]

    def is_inside(at):
        return all(low <= value <= high
                   for low, value, high in zip(inside[0], at, inside[1]))

    for best in accepted(checks):
        ends = place(best["query"]), place(best["matched"])
        if all(map(is_inside, ends)):
            picture.path([near(*end) for end in ends], "green")
    for points, classes in ((truth, "line thick"), (days[0], "blue"),
                            (days[1], "orange")):
        for stretch in stretches(points, is_inside):
            picture.path([near(*at) for at in stretch], classes)
    near.bar(picture, (345, 448), 100)
    for row, (words, classes) in enumerate((
            ("where it truly was", "line thick"), ("day 1, as it believes", "blue"),
            ("day 2, as it believes", "orange"),
            ("accepted candidates", "green"))):
        at = (545, 402 + 17 * row)
        picture.path([(at[0] - 36, at[1] - 4), (at[0] - 10, at[1] - 4)], classes)
        picture.text(at, words, "small")
    return picture


def stretches(points, is_inside):
    """The stretches of a path that are inside, of two points at least."""
    found, now = [], []
    for at in [*points, None]:
        if at is not None and is_inside(at):
            now.append(at)
        else:
            if len(now) > 1:
                found.append(now)
            now = []
    return found


def candidate(address, vehicle):
    [check] = ask(address, "find", vehicle, "--aligned-path")
    best = check["candidates"][0]
    graph = [line["node"] for line in ask(
        address, "export", vehicle, "--format", "jsonl") if "node" in line]
    picture = Picture(760, 420, "A candidate, and the paths that were aligned for it")
    scale = Map((-200, -65), 1.42, (30, 400))
    nodes = {int(node["index"]): place(node) for node in graph}
    first = min(pair["matchedIndex"] for pair in best["alignedPath"])
    picture.path([scale(*nodes[i]) for i in
                  range(int(first) - 30, int(best["matched"]["index"]) + 20)], "line")
    pairs = [(nodes[int(pair["queryIndex"])], nodes[int(pair["matchedIndex"])])
             for pair in best["alignedPath"]]
    for pair in pairs[::5]:
        picture.path([scale(*at) for at in pair], "soft thin")
    for side, colour in enumerate(("orange", "blue")):
        picture.path([scale(*pair[side]) for pair in pairs], f"{colour} thick")
    query, matched = scale(*place(best["query"])), scale(*place(best["matched"]))
    picture.ellipse(query, *axes_of(best["difference"]["covariance"], scale),
                    "green pale")
    picture.arrow(matched, query, "ink")
    picture.dot(query, 6, "orange")
    picture.dot(matched, 6, "blue")
    return label_candidate(picture, scale, query, matched)


def label_candidate(picture, scale, query, matched):
    picture.text((query[0] + 12, query[1] - 8), "query: where it is", "orange bold")
    picture.text((matched[0] + 14, matched[1] + 22), "match: where it may",
                 "blue bold")
    picture.text((matched[0] + 14, matched[1] + 38), "be again", "blue bold")
    for row, (words, classes) in enumerate((
            ("the way to the query", "orange thick"),
            ("the older path that agrees with it", "blue thick"),
            ("pairs of nodes that were aligned", "soft thin"),
            ("the difference of the two ends", "ink"),
            ("what drift explains, 95 %", "green"))):
        y = 70 + 22 * row
        picture.path([(450, y - 4), (480, y - 4)], classes)
        picture.text((490, y), words)
    scale.bar(picture, (30, 400), 50)
    return picture


def axes_of(covariance, scale):
    """Half axes in pixels of the ellipse of 95 %, and its turn in the picture."""
    xx, xy, _, yy, _, _ = covariance["values"]
    middle, spread = (xx + yy) / 2, math.hypot((xx - yy) / 2, xy)
    quantile = math.sqrt(5.991)
    return (tuple(scale.scale * quantile * math.sqrt(value)
                  for value in (middle + spread, middle - spread)),
            -0.5 * math.atan2(2 * xy, xx - yy))


def write_quarter(path):
    """The drive with a quarter of the standard deviations that are true."""
    with open(DRIVE, encoding="utf-8") as file:
        table = list(csv.DictReader(file))
    for row in table:
        for name in ("pxx", "pxy", "pxt", "pyy", "pyt", "ptt"):
            row[name] = f"{float(row[name]) / 16:.12g}"
    with open(path, "w", encoding="utf-8", newline="") as file:
        writer = csv.DictWriter(file, table[0])
        writer.writeheader()
        writer.writerows(table)


def belief(checks):
    picture = Picture(760, 320, "What the drive shows of the scale of its claims")

    def at(check, name):
        travelled = check["query"]["travelledMeters"]
        return (90 + travelled * 0.0395,
                190 - 30 * math.log2(check["scaleEstimate"][name]))

    for exponent in range(-3, 5):
        y = 190 - 30 * exponent
        picture.path([(90, y), (718, y)], "line thin")
        words = f"{2 ** exponent} x" if exponent >= 0 else f"1/{2 ** -exponent} x"
        picture.text((82, y + 4), words, "soft small", "end")
    for kilometres in range(0, 16, 2):
        picture.text((90 + 39.5 * kilometres, 304), f"{kilometres} km",
                     "soft small", "middle")
    low, high = ([at(check, name) for check in checks] for name in ("low", "high"))
    picture.path([*low, *reversed(high)], "blue pale thin", closed=True)
    picture.path([at(check, "scale") for check in checks], "blue")
    picture.path([(90, 130), (718, 130)], "green dashed")
    picture.text((440, 166), "dashed: the truth, 4 times what is claimed", "green")
    picture.text((100, 182), "no place passed again yet: nothing is known", "blue")
    picture.text((440, 40), "scale_estimate and its bounds", "blue")
    return picture


# Where the second day says that it began, in the frame of the first: x, y in metres
# and degrees, and how sure that is.
DATUM, DATUM_SIGMA = (18.0, -14.0, 2.0), "15m,2deg"


def write_day_two(path):
    """The second day as another vehicle, which counts from its own first pose."""
    rows = rows_of_drive()[SECOND_DAY:]
    first = rows[0]
    c, s = math.cos(first["est_yaw"]), math.sin(first["est_yaw"])
    with open(path, "w", encoding="utf-8") as file:
        print("t_s,est_x,est_y,est_yaw", file=file)
        for row in rows:
            dx, dy = row["est_x"] - first["est_x"], row["est_y"] - first["est_y"]
            print(row["t_s"], f"{c * dx + s * dy:.4f}", f"{c * dy - s * dx:.4f}",
                  f"{math.remainder(row['est_yaw'] - first['est_yaw'], math.tau):.6f}",
                  sep=",", file=file)
    return first


def write_day_one(path):
    with open(path, "w", encoding="utf-8") as file:
        print("t_s,est_x,est_y,est_yaw", file=file)
        for row in rows_of_drive()[:SECOND_DAY]:
            print(row["t_s"], row["est_x"], row["est_y"], row["est_yaw"], sep=",",
                  file=file)


def drive_both(address, directory):
    """Makes the two days two vehicles of a group; answers their paths, each in its own
    frame."""
    days = {name: pathlib.Path(directory) / f"{name}.csv"
            for name in ("shuttle-7", "shuttle-8")}
    write_day_one(days["shuttle-7"])
    first = write_day_two(days["shuttle-8"])
    ask(address, "group", "create", "depot")
    datum = (first["est_x"] + DATUM[0], first["est_y"] + DATUM[1],
             first["est_yaw"] + math.radians(DATUM[2]))
    for name, at in (("shuttle-7", (0, 0, 0)), ("shuttle-8", datum)):
        ask(address, "stream", days[name], "--vehicle", name, "--create")
        ask(address, "group", "add", "depot", name, "--datum",
            ",".join(f"{value:.4f}" for value in at), "--datum-sigma",
            DATUM_SIGMA if name == "shuttle-8" else "0.1m,0.1deg")
    return {name: [place(line["node"]) for line in ask(
        address, "export", name, "--format", "jsonl") if "node" in line]
        for name in days}


def frame_of_second(address, is_known):
    """Where the second vehicle lies in the frame of the first, once that is so."""
    while True:
        [frames] = ask(address, "group", "frames", "depot", "--from", "shuttle-7",
                       "--in", "shuttle-8")
        [frame] = frames["frameTransforms"]
        if is_known(frame):
            return frame
        time.sleep(0.1)


def carried(frame, at):
    pose = frame["framePose"]
    c, s = (of(pose.get("headingRadians", 0.0)) for of in (math.cos, math.sin))
    return (pose.get("xMeters", 0.0) + c * at[0] - s * at[1],
            pose.get("yMeters", 0.0) + s * at[0] + c * at[1])


def measured_between(query, matched):
    """Where the second vehicle's pose lies as seen from the first one's, as a verifier
    would have measured it."""
    rows = rows_of_drive()
    seen, place_of = rows[SECOND_DAY + query - 1], rows[matched - 1]
    c, s = math.cos(place_of["gt_yaw"]), math.sin(place_of["gt_yaw"])
    dx, dy = (seen[name] - place_of[name] for name in ("gt_x", "gt_y"))
    turn = math.remainder(seen["gt_yaw"] - place_of["gt_yaw"], math.tau)
    return f"{c * dx + s * dy:.3f},{c * dy - s * dx:.3f},{turn:.4f}"


def two_vehicles(address, directory):
    paths = drive_both(address, directory)
    placed = frame_of_second(
        address, lambda frame: frame["frameState"] == "FRAME_STATE_DATUM")
    [check] = ask(address, "find", "shuttle-8", "--sequence", "52", "--group", "depot",
                  "--exclude-own")
    best = check["candidates"][0]
    query, matched = (int(best[end]["sequence"]) for end in ("query", "matched"))
    ask(address, "link", "add", "depot", f"shuttle-8@{query}", f"shuttle-7@{matched}",
        "--relative", measured_between(query, matched), "--covariance",
        "0.04,0,0,0.04,0,0.0001")
    tied = frame_of_second(
        address, lambda frame: frame["frameState"] == "FRAME_STATE_PROVISIONAL")
    picture = Picture(760, 400, "Two vehicles in one map, before and after a link")
    inside = [(-200, -75), (175, 215)]

    def is_inside(at):
        return all(low <= value <= high
                   for low, value, high in zip(inside[0], at, inside[1]))

    for left, frame, words in ((30, placed, "as a datum places the second"),
                               (395, tied, "after one loop closure between them")):
        scale = Map(inside[0], 0.88, (left, 335))
        picture.text((left, 30), words, "bold")
        moved = [carried(frame, at) for at in paths["shuttle-8"]]
        picture.ellipse(scale(*carried(frame, place({
            "pose": {"xMeters": 0.0, "yMeters": 0.0,
                     **frame.get("frameReference", {})}}))),
            *axes_of(frame["frameCovariance"], scale), "orange pale")
        for points, classes in ((paths["shuttle-7"], "blue"), (moved, "orange")):
            for stretch in stretches(points, is_inside):
                picture.path([scale(*at) for at in stretch], classes)
        if frame is tied:
            picture.dot(scale(*place(best["matched"])), 5, "green")
        scale.bar(picture, (left, 375), 100)
    for x, words, classes in ((180, "shuttle-7", "blue"), (290, "shuttle-8", "orange"),
                              (545, "where a verifier saw both", "green")):
        picture.path([(x, 371), (x + 26, 371)], f"{classes} thick")
        picture.text((x + 34, 375), words, "small")
    return picture


def pictures():
    """By their names, the files as they are to be."""
    made = {"poses-and-nodes": poses_and_nodes(), "round-trip": round_trip(),
            "gate": gate(), "interval": interval(), "verdicts": verdicts(),
            "looks": looks()}
    with tempfile.TemporaryDirectory() as directory, Server(directory) as server:
        checks = stream(server.address, "honest", DRIVE)
        made["drift"] = drift(rows_of_drive(), checks)
        made["candidate"] = candidate(server.address, "honest")
        quarter = pathlib.Path(directory) / "quarter.csv"
        write_quarter(quarter)
        made["belief"] = belief(stream(server.address, "quarter", quarter))
        made["two-vehicles"] = two_vehicles(server.address, directory)
    return {**{f"{name}.svg": picture.svg() for name, picture in made.items()},
            **performance.pictures(performance.read())}


if __name__ == "__main__":
    for name, text in pictures().items():
        (HERE / name).write_text(text, encoding="utf-8")
