"""A million vehicles: arithmetic with the measured costs, what share of which resource
it takes, and which resource ends first."""

import math
import typing

import parameters
import tables


def between(points, x):
    """y at x of measured points (x, y): between two by a power law, beyond the last by
    its slope, before the first as there."""
    for (x0, y0), (x1, y1) in zip(points, points[1:]):
        if x <= x1:
            break
    slope = math.log(y1 / y0) / math.log(x1 / x0)
    return y0 * (max(x, points[0][0]) / x0) ** slope


def check_seconds(nodes, model="reckoned"):
    """One check on a history of so many nodes."""
    return between(parameters.CHECK_S[model], nodes)


def message_seconds(part, poses, rate):
    """CPU of this part for a message of so many poses, where so many come a second."""
    return between(parameters.MESSAGE_S[part, poses], rate)


class Fleet(typing.NamedTuple):
    vehicles: float
    servers: int
    primaries: int
    days: float
    # Share of the history that retention keeps.
    kept: float = 1.0
    poses_a_row: int = 64
    checks: str = "reckoned"
    snapshots: bool = False


def paper(p):
    """The figures of the fleet as a whole: {name: (value, unit)}."""
    driving = p.vehicles * p.hours_a_day / 24
    poses = driving * p.pose_hz
    per_day = poses * 86400
    nodes = p.hours_a_day * 3600 * p.speed_mps / p.node_m
    per_server = p.vehicles / p.servers
    return {
        "poses a second, mean": (poses, ""),
        "poses a second, peak": (poses * p.peak_to_mean, ""),
        "poses a day": (per_day / 1e9, "G"),
        "disk a day, rows filled": (per_day * p.disk_pose_80 / 1e9, "GB"),
        "WAL a day, rows filled": (per_day * p.wal_pose_64 / 1e9, "GB"),
        "disk a day, 1 pose a row": (per_day * p.disk_row_1 / 1e12, "TB"),
        "WAL a day, 1 pose a row": (per_day * p.wal_row_1 / 1e12, "TB"),
        "rows of 64 a second, peak": (poses * p.peak_to_mean / 64, ""),
        "connections": (p.servers * p.connections, ""),
        "nodes a vehicle and day": (nodes, ""),
        "memory a vehicle and day": (nodes * p.node_B / 1e6, "MB"),
        "memory a server and day, all vehicles":
            (per_server * nodes * p.node_B / 1e9, "GB"),
        "memory a server and day, those that stream at the peak":
            (per_server * p.hours_a_day / 24 * p.peak_to_mean * nodes * p.node_B / 1e9,
             "GB"),
        "a dead server's rows, 30 days, all vehicles":
            (per_server * 30 * p.hours_a_day * 3600 * p.pose_hz * p.disk_pose_80 / 1e9,
             "GB"),
        "a dead server's rows, 30 days, those that stream at the peak":
            (per_server * p.hours_a_day / 24 * p.peak_to_mean * 30 * p.hours_a_day
             * 3600 * p.pose_hz * p.disk_pose_80 / 1e9, "GB"),
    }


# Share of each resource's capacity that may be in use at the peak.
ALLOWED = {
    "CPU of a server, acks": 0.6,
    "CPU of Envoy": 0.6,
    "CPU of a server, checks": 0.6,
    "memory of a server": 0.8,
    "reload after a death, of 60 s": 1.0,
    "first searches after it, of 60 s": 1.0,
    "CPU of PostgreSQL": 0.6,
    "WAL of PostgreSQL": 0.6,
    "disk of PostgreSQL": 0.8,
    "connections of PostgreSQL": 1.0,
}


def shares(p, fleet):
    """{resource: share of its capacity at the peak}, with one server of a cell down."""
    streams = fleet.vehicles * p.hours_a_day / 24 * p.peak_to_mean
    alive = fleet.servers - fleet.primaries
    per_server = streams / alive
    poses = streams * p.pose_hz
    nodes = (p.hours_a_day * 3600 * p.speed_mps / p.node_m * fleet.days * fleet.kept)
    check = check_seconds(nodes, fleet.checks)
    dead = streams / fleet.servers
    survivors = fleet.servers / fleet.primaries - 1
    if fleet.snapshots:
        stored, load_node = nodes * p.snapshot_node_B, p.snapshot_node_s
    else:
        stored = (p.hours_a_day * 3600 * p.pose_hz * fleet.days * fleet.kept
                  * (p.disk_pose_80 if fleet.poses_a_row > 1 else p.disk_row_1))
        load_node = p.load_node_s
    reload_s = max(dead * stored / p.database_send_Bps,
                   dead * nodes * load_node / (survivors * p.server_cores))
    first_s = dead * p.first_search_checks * check / (survivors * p.server_cores)
    rows = poses / fleet.poses_a_row / fleet.primaries
    wal = poses / fleet.primaries * (p.wal_row_1 if fleet.poses_a_row == 1
                                     else p.wal_pose_64)
    day_disk = (fleet.vehicles / fleet.primaries * p.hours_a_day * 3600 * p.pose_hz
                * (p.disk_row_1 if fleet.poses_a_row == 1 else p.disk_pose_80))
    messages = per_server * p.pose_hz / fleet.poses_a_row
    ack_s, envoy_s = (message_seconds(part, fleet.poses_a_row, messages)
                      for part in ("revisitd", "Envoy"))
    return {
        "CPU of a server, acks": messages * ack_s / p.server_cores,
        "CPU of Envoy": messages * alive / fleet.primaries * envoy_s / p.envoy_cores,
        "CPU of a server, checks":
            per_server * p.speed_mps / p.check_m * check / p.server_cores,
        "memory of a server": per_server * nodes * p.node_B / p.server_memory_B,
        "reload after a death, of 60 s": reload_s / p.answer_timeout_s,
        "first searches after it, of 60 s": first_s / p.answer_timeout_s,
        "CPU of PostgreSQL": rows * (p.row_cpu_s + fleet.poses_a_row * p.pose_cpu_s)
            / p.database_cores,
        "WAL of PostgreSQL": wal / p.database_wal_Bps,
        "disk of PostgreSQL": day_disk * fleet.days * fleet.kept / p.database_disk_B,
        "connections of PostgreSQL":
            fleet.servers / fleet.primaries * p.connections / p.database_connections,
    }


def first_to_break(p, fleet):
    """(resource, share of what it may be at most) of the fullest resource."""
    used = shares(p, fleet)
    worst = max(used, key=lambda name: used[name] / ALLOWED[name])
    return worst, used[worst] / ALLOWED[worst]


def vehicles_per_server(p, fleet):
    """The most at which nothing breaks, and what would break next. Servers per
    primary stay."""
    low, high = 0.0, 1e9
    for _ in range(80):
        middle = 0.5 * (low + high)
        name, share = first_to_break(p, fleet._replace(vehicles=middle))
        low, high = (middle, high) if share <= 1 else (low, middle)
    name, _ = first_to_break(p, fleet._replace(vehicles=high))
    return low / fleet.servers, name


def run(seeds, part):
    del seeds, part
    p = parameters.Parameters()
    total = tables.Table("The fleet on paper", ("figure", "value", "unit"))
    for name, (value, unit) in paper(p).items():
        total.add(figure=name, value=value, unit=unit)

    one = Fleet(p.vehicles, int(p.servers), 1, 1)
    cells = one._replace(primaries=10)
    columns = (
        ("one primary, 1 day", one),
        ("the same, 1 pose a row", one._replace(poses_a_row=1)),
        ("cells, 1 day", cells),
        ("that, 1 pose a row", cells._replace(poses_a_row=1)),
        ("cells, 7 days", cells._replace(days=7)),
        ("cells, 30 days", cells._replace(days=30)),
        ("9 % of 30 kept", cells._replace(days=30, kept=0.091)),
        ("that, fixes", cells._replace(days=30, kept=0.091, checks="fixes")),
    )
    share_table = tables.Table(
        "Per cent of capacity at the peak, one server of each primary down; ! where "
        "more than allowed",
        ("resource (allowed)", *(name for name, _ in columns)),
        note="One primary: 100 servers. Cells: 10 servers each, 10 cells. Checks under "
             "dead reckoning unless fixes are said. Rows of 64 poses unless said.")
    used = [shares(p, fleet) for _, fleet in columns]
    for name, allowed in ALLOWED.items():
        share_table.add(**{
            share_table.columns[0]: f"{name} ({100 * allowed:.0f})",
            **{column: tables.number(100 * each[name])
                       + ("!" if each[name] > allowed else "")
               for (column, _), each in zip(columns, used)}})
    breaks = tables.Table(
        "The most vehicles per server, in cells of 10, and what breaks first beyond",
        ("history", "vehicles a server", "streams at the peak", "breaks first"))
    for name, fleet in (
            ("1 day", cells), ("3 days", cells._replace(days=3)),
            ("7 days", cells._replace(days=7)), ("30 days", cells._replace(days=30)),
            ("30 days, fixes", cells._replace(days=30, checks="fixes")),
            ("9 % of 30 days", cells._replace(days=30, kept=0.091)),
            ("9 % of 30 days, fixes",
             cells._replace(days=30, kept=0.091, checks="fixes")),
            ("9 % of 365 days, fixes",
             cells._replace(days=365, kept=0.091, checks="fixes")),
            ("1 day, no checks asked for", cells._replace(checks="none")),
            ("7 days, no checks asked for", cells._replace(days=7, checks="none")),
            ("30 days, no checks asked for", cells._replace(days=30, checks="none"))):
        most, why = vehicles_per_server(p, fleet)
        breaks.add(**{"history": name, "vehicles a server": round(most),
                      "streams at the peak": round(
                          most * p.hours_a_day / 24 * p.peak_to_mean),
                      "breaks first": why})
    return [total, share_table, breaks]
