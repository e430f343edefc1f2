"""One server of many dies at the peak: who waits how long, and for what."""

import dataclasses

import cluster
import parameters
import tables

# Seconds after the death that are simulated, and before.
_AFTER = 150.0
_BEFORE = 12.0
# Share of PostgreSQL's CPU that 100 servers take at the peak with rows of one pose
# (ingest.py).
_BUSY = 0.44


def die(setup, dead=(3,), after=_AFTER):
    """Figures of the vehicles of the servers that died together."""
    cell = cluster.Cluster(setup)
    cell.run(_BEFORE + cell.parameters.beat_s * cell.kernel.random.random())
    at = cell.kernel.now
    for i in dead:
        cell.kill(cell.servers[i])
    cell.run(after)
    harmed = [vehicle for key, vehicle in cell.vehicles.items()
              if cell.oracle.owned_at[key][0][1] in
              {cell.servers[i].address for i in dead}]
    gaps = sorted(max(vehicle.longest_gap, cell.kernel.now - vehicle.last_ack)
                  for vehicle in harmed)
    alive = [server for server in cell.servers if server.running]
    return {
        "buried after": max(cell.oracle.burials, default=at) - at,
        "gap p50": cluster.quantile(gaps, 0.5),
        "gap p99": cluster.quantile(gaps, 0.99),
        "gap most": gaps[-1],
        "last loaded": max((t for t, _ in cell.oracle.loads), default=at) - at,
        "loads": len(cell.oracle.loads),
        "GB read": cell.database.bytes_read / setup.part / 1e9,
        "GB more, one server": max(
            sum(1 for key in server.seats if key in cell.vehicles)
            for server in alive) * setup.nodes * cell.parameters.node_B
            / setup.part / 1e9,
        "refusals a vehicle": sum(cell.oracle.refusals.values()) / len(harmed),
        "timeouts": cell.oracle.refusals["TIMEOUT"],
        "waiting": cell.waiting(),
    }


def setup_of(seed, servers, days, part, policy=None, **changes):
    """`changes` of figures of the parameters, and of the history and `busy`."""
    history = {name: changes.pop(name) for name in ("kept", "snapshots", "busy")
               if name in changes}
    return cluster.Setup(
        seed=seed, servers=servers, part=part, message_s=2.0, history_days=days,
        **history, only_of=3, policy=policy or parameters.Policy(),
        parameters=dataclasses.replace(parameters.Parameters(), **changes))


def run(seeds, part):
    table = tables.Table(
        "Death of one server at the peak: its 2,500 streams (seconds)",
        ("servers, days of history", "buried after", "gap p50", "gap p99", "gap most",
         "GB read", "GB more, one server", "refusals a vehicle", "timeouts", "waiting"),
        note="Gaps are between two acknowledgements of a vehicle, messages come every "
             "2 s. GB more: what the survivor that got most of them has to hold. "
             f"Waiting: vehicles (of {round(2500 * part)}) without one {_AFTER:g} s "
             "after the death.")
    longest = parameters.Policy(retry_info_rules=False)
    rows = [
        ("100, 1 day", 100, 1, {"busy": _BUSY}),
        ("100, 7 days", 100, 7, {"busy": _BUSY}),
        ("100, 30 days", 100, 30, {"busy": _BUSY}),
        ("cell of 10, 1 day", 10, 1, {}),
        ("cell of 10, 7 days", 10, 7, {}),
        ("cell of 10, 30 days", 10, 30, {}),
        ("  4 passes a place kept (9 %)", 10, 30, {"kept": 0.091}),
        ("  snapshots", 10, 30, {"snapshots": True}),
        ("  100 Gbit/s", 10, 30, {"database_send_Bps": 12.5e9}),
        ("  100 Gbit/s and snapshots", 10, 30,
         {"database_send_Bps": 12.5e9, "snapshots": True}),
        ("cell of 10, 7 days, 5 poses a second", 10, 7, {"pose_hz": 5.0}),
        ("  snapshots", 10, 7, {"pose_hz": 5.0, "snapshots": True}),
        ("cell of 10, 7 days, 10 poses a second", 10, 7, {"pose_hz": 10.0}),
        ("  snapshots", 10, 7, {"pose_hz": 10.0, "snapshots": True}),
        ("cell of 10, 1 day, TTL 5 s", 10, 1, {"ttl_s": 5.0, "beat_s": 1.0}),
        ("  TTL 20 s", 10, 1, {"ttl_s": 20.0, "beat_s": 4.0}),
        ("  RetryInfo until the burial", 10, 1,
         {"policy": parameters.Policy(retry_after_burial=True)}),
        ("  own back-off where longer than RetryInfo", 10, 1, {"policy": longest}),
        ("  TTL 20 s and that", 10, 1,
         {"policy": longest, "ttl_s": 20.0, "beat_s": 4.0}),
        ("  at most 8 loads wait on a server", 10, 1,
         {"policy": parameters.Policy(load_queue=8)}),
        ("cell of 10, 30 days, at most 8 wait", 10, 30,
         {"policy": parameters.Policy(load_queue=8)}),
        ("  at most 64 wait", 10, 30, {"policy": parameters.Policy(load_queue=64)}),
    ]
    for name, servers, days, changes in rows:
        figures = tables.over(seeds, lambda seed, s=servers, d=days, c=changes: die(
            setup_of(seed, s, d, part, **dict(c))))
        row = {key: value for key, value in figures.items() if key in table.columns}
        table.add(**{table.columns[0]: name}, **row)
    return [table, _frozen(seeds, part)]


def freeze(setup, seconds, after=60.0):
    """SIGSTOP of one server."""
    cell = cluster.Cluster(setup)
    cell.run(_BEFORE + cell.parameters.beat_s * cell.kernel.random.random())
    server = cell.servers[3]
    joins = server.joins
    cell.freeze(server, seconds)
    cell.run(after)
    gaps = cell.gaps()
    return {
        "gap p50": cluster.quantile(gaps, 0.5),
        "gap most": gaps[-1],
        "buried": server.joins - joins,
        "moved %": 100 * sum(
            cell.oracle.owned_at[key][-1][1] != server.address
            for key in cell.vehicles) / len(cell.vehicles),
        "waiting": cell.waiting(),
    }


def _frozen(seeds, part):
    table = tables.Table(
        "SIGSTOP of one server of a cell: its 2,500 streams, 1 day of history "
        "(seconds)",
        ("for, TTL", "gap p50", "gap most", "buried", "moved %"),
        note="Gaps beyond the 2 s between messages. Envoy ejects it after 3 s and cuts "
             "each stream when a ping is not answered, after 4 to 17 s.")
    reloads = parameters.Policy(keep_graph=False)
    until = parameters.Policy(retry_after_burial=True)
    for name, seconds, ttl, policy in (
            ("3 s, 5 s", 3.0, 5.0, None), ("3 s, 10 s", 3.0, 10.0, None),
            ("3 s, 20 s", 3.0, 20.0, None), ("7 s, 5 s", 7.0, 5.0, None),
            ("7 s, 10 s", 7.0, 10.0, None),
            ("  claimed anew is loaded anew", 7.0, 10.0, reloads),
            ("  RetryInfo until the burial", 7.0, 10.0, until),
            ("7 s, 20 s", 7.0, 20.0, None), ("15 s, 5 s", 15.0, 5.0, None),
            ("15 s, 10 s", 15.0, 10.0, None), ("15 s, 20 s", 15.0, 20.0, None),
            ("30 s, 10 s", 30.0, 10.0, None)):
        figures = tables.over(
            seeds, lambda seed, s=seconds, t=ttl, po=policy: freeze(
                setup_of(seed, 10, 1, part, po, ttl_s=t, beat_s=t / 5), s))
        table.add(**{table.columns[0]: name},
                  **{key: value for key, value in figures.items()
                     if key in table.columns})
    return table
