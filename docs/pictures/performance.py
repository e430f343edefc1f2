#!/usr/bin/env python3
"""Draws the curves of docs/performance.md, and writes its tables, from figures that
`tests/bench/run --curves` measured: nothing here measures anything.

The page's text between <!-- figures: NAME --> and <!-- end of figures --> is what
tables() has under this name."""

import argparse
import json
import pathlib
import re
import sys

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))

import chart  # noqa: E402
from chart import Linear, Series, words_of  # noqa: E402
from picture import Picture  # noqa: E402

FIGURES = HERE / "performance.json"
PAGE = HERE.parent / "performance.md"
# Figures of one's own go here unless the caller names a folder.
OWN = HERE.parents[1] / "build/curves"
# A file of another format is refused.
FORMAT = 1
BLOCK = re.compile(r"(<!-- figures: ([a-z]+) -->\n).*?(<!-- end of figures -->)",
                   re.DOTALL)
WIDTH = 760
LEFT, RIGHT = (72, 354), (446, 728)
# Streams send poses in these forms, each of which has its colour.
FORMS = {"messages": "orange", "columns": "blue"}


def column(rows, x, *path):
    """Points of a value of each row, which lies at the path of keys."""
    points = []
    for row in rows:
        value = row
        for key in path:
            value = None if value is None else value.get(key)
        points.append((row[x], value))
    return points


def two_charts(title, left, right):
    """A picture of two charts, each with what chart.draw() takes."""
    rows = max(len(left["series"]), len(right["series"]))
    picture = Picture(WIDTH, chart.height_of(rows), title)
    for place, one in ((LEFT, left), (RIGHT, right)):
        chart.draw(picture, *place, **one)
    return picture


# ---- Pictures


def of_errors(figures, errors):
    return [call for call in figures["calls"] if call["errors"] == errors]


def searches(figures):
    reckoned, fixes = (of_errors(figures, errors) for errors in ("reckoned", "fixes"))
    core = figures["core"]
    calls = [
        Series("first one by dead reckoning", "orange dashed",
               column(reckoned, "nodes", "first_ms")),
        Series("dead reckoning", "orange", column(reckoned, "nodes", "call_ms")),
        Series("satellite fixes", "blue", column(fixes, "nodes", "call_ms")),
        Series("a call that does nothing", "soft dashed",
               column(reckoned, "nodes", "empty_ms"))]
    checks = [
        Series("all nodes compared", "soft dashed", core["dense_reckoned"]),
        Series("dead reckoning, with its mark", "orange", core["check_reckoned"]),
        Series("satellite fixes", "blue", core["check_fixes"])]
    return two_charts(
        "How long a search takes by the length of the history",
        {"title": "A call of FindCandidates, ms", "x_words": "nodes of history",
         "series": calls},
        {"title": "A check of a stream, ms of one core",
         "x_words": "nodes of history", "series": checks})


def messages(figures):
    forms = {form: [row for row in figures["messages"] if row["form"] == form]
             for form in FORMS}
    rates, costs = [], []
    for form, colour in FORMS.items():
        rates.append(Series(f"poses as {form}", colour, column(
            forms[form], "batch_poses", "revisit", "poses_per_second")))
        costs.append(Series(f"poses as {form}", colour, column(
            forms[form], "batch_poses", "revisit", "server_cpu_us_per_pose")))
    for form, colour in FORMS.items():
        rates.append(Series(f"gRPC alone, {form}", f"{colour} dashed", column(
            forms[form], "batch_poses", "empty", "poses_per_second")))
        costs.append(Series(f"gRPC alone, {form}", f"{colour} dashed", column(
            forms[form], "batch_poses", "empty", "server_cpu_us_per_pose")))
    rates.append(Series("SQLite alone", "green dashed", column(
        forms["messages"], "batch_poses", "sqlite", "poses_per_second")))
    return two_charts(
        "Durable poses by the number of poses in a message",
        {"title": "Durable poses a second", "x_words": "poses a message",
         "series": rates},
        {"title": "The server's processor, μs a pose", "x_words": "poses a message",
         "series": costs})


def vehicles(figures):
    rows, pace = figures["vehicles"], figures["pace"]
    return two_charts(
        "Durable poses and acknowledgements by the number of vehicles",
        {"title": "Durable poses a second, all they can", "x_words": "vehicles",
         "series": [
             Series("revisit", "orange", column(
                 rows, "vehicles", "revisit", "poses_per_second")),
             Series("gRPC alone", "orange dashed", column(
                 rows, "vehicles", "empty", "poses_per_second")),
             Series("SQLite alone", "green dashed", column(
                 rows, "vehicles", "sqlite", "poses_per_second"))]},
        {"title": "Acknowledgements at a steady pace, ms",
         "x_words": "vehicles",
         "series": [
             Series("99 of 100 are faster", "blue dashed",
                    column(pace, "vehicles", "p99_ms")),
             Series("half are faster", "blue", column(pace, "vehicles", "p50_ms"))]})


def memory(figures):
    rows = figures["memory"]
    return two_charts(
        "Memory of a node, and how long a vehicle takes to load",
        {"title": "Bytes a node", "x_words": "nodes of a vehicle", "y_axis": Linear,
         "series": [
             Series("as streamed", "blue", column(rows, "nodes", "streamed_bytes")),
             Series("as loaded", "orange", column(rows, "nodes", "loaded_bytes")),
             Series("of which the graph", "soft dashed",
                    column(rows, "nodes", "graph_bytes"))]},
        {"title": "Load of a vehicle, ms", "x_words": "nodes of a vehicle",
         "series": [
             Series("from its poses", "orange", column(rows, "nodes", "poses", "ms")),
             Series("of which the processor", "orange dashed",
                    column(rows, "nodes", "poses", "cpu_ms")),
             Series("from its snapshot", "blue",
                    column(rows, "nodes", "snapshot", "ms")),
             Series("of which the processor", "blue dashed",
                    column(rows, "nodes", "snapshot", "cpu_ms"))]})


def pictures(figures):
    """By their names, the files as they are to be."""
    made = {"searches": searches, "messages": messages, "vehicles": vehicles,
            "memory": memory}
    return {f"performance-{name}.svg": draw(figures).svg()
            for name, draw in made.items()}


# ---- Tables


def table(head, rows):
    """Rows of cells that are words, numbers, or None for what was not measured."""
    lines = [head, ["---"] * len(head)]
    lines += [["" if cell is None else cell if isinstance(cell, str)
               else words_of(cell) for cell in row] for row in rows]
    return "".join(f"| {' | '.join(line)} |\n" for line in lines)


def machine_words(figures):
    machine = figures["machine"]
    return (f"Measured on {figures['date']} at revision {figures['revision']}: "
            f"{machine['processor']}, {machine['cores']} cores, "
            f"{machine['memory_gib']} GiB; load before it began "
            f"{figures['load']:.1f}, {figures['minutes']:.0f} minutes.\n")


def search_table(figures):
    core = {name: dict(points) for name, points in figures["core"].items()}
    return table(
        ["nodes", "errors", "call, ms", "of which search", "first call, ms",
         "check of a stream, ms", "all nodes compared, ms"],
        [[call["nodes"],
          "dead reckoning" if call["errors"] == "reckoned" else "fixes",
          call["call_ms"], call["search_ms"], call["first_ms"],
          core[f"check_{call['errors']}"].get(call["nodes"]),
          core[f"dense_{call['errors']}"].get(call["nodes"])]
         for call in figures["calls"]])


def ingest_cells(row):
    revisit, empty = row["revisit"], row["empty"]
    return [revisit["poses_per_second"], revisit["server_cpu_us_per_pose"],
            revisit["p50_ms"], revisit["p99_ms"], empty["poses_per_second"],
            empty["server_cpu_us_per_pose"], row["sqlite"]["poses_per_second"]]


INGEST_HEAD = ["durable poses a second", "CPU, μs a pose", "ack p50, ms", "p99",
               "gRPC alone", "its CPU", "SQLite alone"]


def message_table(figures):
    return table(["poses a message", "form", *INGEST_HEAD],
                 [[row["batch_poses"], row["form"], *ingest_cells(row)]
                  for row in figures["messages"]])


def vehicle_table(figures):
    return table(
        ["vehicles", *INGEST_HEAD, "streams a connection"],
        [[row["vehicles"], *ingest_cells(row), row["revisit"]["vehicles_a_connection"]]
         for row in figures["vehicles"]])


def pace_table(figures):
    return table(
        ["vehicles", "poses a second wanted", "taken", "ack p50, ms", "p99",
         "the server's cores", "CPU, μs a message", "KiB an idle vehicle"],
        [[row["vehicles"], row["wanted_poses_per_second"], row["poses_per_second"],
          row["p50_ms"], row["p99_ms"], row["server_cores"],
          1e6 * row["server_cores"] * row["batch_poses"] / row["poses_per_second"],
          row["idle_bytes_per_vehicle"] / 1024]
         for row in figures["pace"]])


def memory_table(figures):
    return table(
        ["nodes", "bytes a node as streamed", "as loaded", "of which the graph",
         "load from poses, ms", "CPU", "from a snapshot, ms", "CPU"],
        [[row["nodes"], row["streamed_bytes"], row["loaded_bytes"],
          row["graph_bytes"], row["poses"]["ms"], row["poses"]["cpu_ms"],
          *([row["snapshot"]["ms"], row["snapshot"]["cpu_ms"]]
            if row["snapshot"] else [None, None])]
         for row in figures["memory"]])


# The fleet that is sized as an example: so many vehicles, each with so many nodes in
# memory and a pose each 0.1 s, sent ten at a time, at 10 m/s with a check each 50 m.
FLEET = {"vehicles": 1000, "nodes": 10_000}
METERS_PER_SECOND, METERS_A_CHECK = 10.0, 50.0


def row_at(rows, name, value):
    return min(rows, key=lambda row: abs(row[name] - value))


def needs(figures):
    """Cores and bytes that the fleet of the example takes."""
    pace = row_at(figures["pace"], "vehicles", FLEET["vehicles"])
    checks = FLEET["vehicles"] * METERS_PER_SECOND / METERS_A_CHECK
    bytes_a_node = row_at(figures["memory"], "nodes", FLEET["nodes"])["streamed_bytes"]

    def check_ms(errors):
        return min(figures["core"][f"check_{errors}"],
                   key=lambda point: abs(point[0] - FLEET["nodes"]))[1]

    return {
        "poses": pace["server_cores"] * FLEET["vehicles"] / pace["vehicles"],
        "reckoned": checks * check_ms("reckoned") / 1e3,
        "fixes": checks * check_ms("fixes") / 1e3,
        "nodes_bytes": FLEET["vehicles"] * FLEET["nodes"] * bytes_a_node,
        "streams_bytes": FLEET["vehicles"] * pace["idle_bytes_per_vehicle"]}


def sizing_table(figures):
    need = needs(figures)
    return table(["for that fleet", "takes"], [
        ["taking poses", f"{words_of(need['poses'])} cores"],
        ["checks, dead reckoning", f"{words_of(need['reckoned'])} cores"],
        ["checks, satellite fixes", f"{words_of(need['fixes'])} cores"],
        ["nodes in memory", f"{words_of(need['nodes_bytes'] / 2**20)} MiB"],
        ["open streams", f"{words_of(need['streams_bytes'] / 2**20)} MiB"]])


def tables(figures):
    """By their names in the page, what stands between its marks."""
    return {"machine": machine_words(figures), "searches": search_table(figures),
            "messages": message_table(figures), "vehicles": vehicle_table(figures),
            "pace": pace_table(figures), "memory": memory_table(figures),
            "sizing": sizing_table(figures)}


def page(text, figures):
    """The page with the tables of these figures. Each has its place in it."""
    made = tables(figures)
    places = [name for _, name, _ in BLOCK.findall(text)]
    if sorted(places) != sorted(made):
        raise ValueError(f"the page has places for {places}, and the figures make "
                         f"{list(made)}")
    return BLOCK.sub(lambda block: f"{block[1]}\n{made[block[2]]}\n{block[3]}", text)


def rounded(figures):
    """The same with four digits of each number that has more behind its point."""
    if isinstance(figures, dict):
        return {key: rounded(value) for key, value in figures.items()}
    if isinstance(figures, list):
        return [rounded(value) for value in figures]
    if isinstance(figures, float):
        short = float(f"{figures:.4g}")
        return int(short) if short.is_integer() else short
    return figures


def refuse_small(is_small, directory):
    """Raises where figures that only show that they can be measured would become those
    of the documents."""
    if is_small and pathlib.Path(directory).resolve() == PAGE.parent:
        raise SystemExit("figures of --small are not for docs")


def write(figures, directory):
    """Writes the page, its pictures and the figures that they show below `directory`,
    as they lie in docs."""
    refuse_small(figures["small"], directory)
    folder = pathlib.Path(directory) / "pictures"
    folder.mkdir(parents=True, exist_ok=True)
    text = page(PAGE.read_text(encoding="utf-8"), figures)
    for name, picture in pictures(figures).items():
        (folder / name).write_text(picture, encoding="utf-8")
    (folder / FIGURES.name).write_text(json.dumps(figures, indent=1) + "\n",
                                       encoding="utf-8")
    (folder.parent / PAGE.name).write_text(text, encoding="utf-8")
    print(f"{folder.parent / PAGE.name}, pictures and figures in {folder}")


def read(path=FIGURES):
    figures = json.loads(pathlib.Path(path).read_text(encoding="utf-8"))
    if figures.get("format") != FORMAT:
        raise SystemExit(f"{path} has format {figures.get('format')}; it has to be "
                         f"{FORMAT}: measure anew")
    return figures


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--from", dest="source", default=FIGURES)
    parser.add_argument("--into", default=OWN)
    arguments = parser.parse_args()
    write(read(arguments.source), arguments.into)


if __name__ == "__main__":
    main()
