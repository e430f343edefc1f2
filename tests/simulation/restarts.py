"""A rolling restart of a cell: what vehicles see, and where they end up."""

import math

import cluster
import parameters
import tables

# Seconds from the end of a process to the start of the next one.
_AWAY = 1.0
# Seconds after a start before nothing waiting means that nothing will.
_SETTLE = 5.0


def roll(setup, pause, after=60.0):
    """Restarts one server after the other, `pause` seconds between; None: the next
    one once nothing waits for a load any more."""
    cell = cluster.Cluster(setup)
    cell.run(12.0)
    begun = cell.kernel.now
    left = list(cell.servers)
    done_at = []

    def restarted():
        if pause is None:
            # Streams come back within some seconds, then their loads.
            cell.kernel.after(_SETTLE, when_loaded)
        else:
            cell.kernel.after(pause, next_one)

    def when_loaded():
        if any(server.loads_waiting() for server in cell.servers):
            cell.kernel.after(1.0, when_loaded)
        else:
            next_one()

    def next_one():
        if left:
            cell.restart(left.pop(0), _AWAY, restarted)
        else:
            done_at.append(cell.kernel.now)

    next_one()
    while not done_at:
        cell.run(10.0)
    gaps = cell.gaps()
    took = done_at[0] - begun
    cell.run(after)
    gaps = cell.gaps()
    held = [len(server.seats) for server in cell.servers]
    moves = [len(times) - 1 for times in cell.oracle.owned_at.values()]
    return {
        "minutes": took / 60,
        "gap p50": cluster.quantile(gaps, 0.5),
        "gap p99": cluster.quantile(gaps, 0.99),
        "gap most": gaps[-1],
        "moves a vehicle": sum(moves) / len(moves),
        "most": max(moves),
        "handovers": cell.oracle.handovers,
        "fullest server": cell.most_held * len(cell.servers) / len(moves),
        "emptiest at the end": min(held) * len(cell.servers) / len(moves),
        "waiting": cell.waiting(),
    }


def setup_of(seed, part, days=7, age=math.inf, policy=None):
    return cluster.Setup(seed=seed, part=part, message_s=10.0, history_days=days,
                         max_stream_age=age, policy=policy or parameters.Policy())


def run(seeds, part):
    table = tables.Table(
        "Rolling restart of a cell of 10 servers with 25,000 streams (seconds)",
        ("pause, days of history, stream age", "minutes", "gap p50", "gap p99",
         "gap most", "moves a vehicle", "most", "handovers", "fullest server",
         "emptiest at the end"),
        note="Pause: from a new process to the next SIGTERM; until loaded: until no "
             "server has a vehicle to load. Gaps beyond the 10 s "
             "between messages. Fullest, emptiest: vehicles as a multiple of an even "
             "share.")
    for name, pause, days, age in (
            ("none, 1 day, for ever", 0.0, 1, math.inf),
            ("none, 7 days, for ever", 0.0, 7, math.inf),
            ("none, 30 days, for ever", 0.0, 30, math.inf),
            ("30 s, 7 days, for ever", 30.0, 7, math.inf),
            ("30 s, 30 days, for ever", 30.0, 30, math.inf),
            ("until loaded, 7 days, for ever", None, 7, math.inf),
            ("until loaded, 30 days, for ever", None, 30, math.inf),
            ("30 s, 7 days, 15 min", 30.0, 7, 900.0),
            ("60 s, 7 days, 2 min", 60.0, 7, 120.0)):
        figures = tables.over(seeds, lambda seed, pa=pause, d=days, a=age: roll(
            setup_of(seed, part, d, a), pa))
        table.add(**{table.columns[0]: name},
                  **{key: value for key, value in figures.items()
                     if key in table.columns})
    return [table]
