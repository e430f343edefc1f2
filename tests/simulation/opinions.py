"""Two Envoys that disagree about who is healthy."""

import cluster
import parameters
import tables

# A verifier asks for candidates so often, and tries each call so many times more.
_EVERY = 5.0
_RETRIES = 4


def disagree(setup, seconds, callers_share, after=120.0):
    """The second Envoy cannot reach one server for `seconds`. All streams of that
    server's vehicles go through the first; `callers_share` of the vehicles also have
    a verifier that calls through the second."""
    cell = cluster.Cluster(setup)
    harmed = set(cell.vehicles)
    keys = sorted(harmed)[:round(callers_share * len(harmed))]
    for vehicle in cell.vehicles.values():
        vehicle.through(cell.envoys[0])
    cell.call_beside_streams(cell.envoys[1], keys, _EVERY, _RETRIES)
    cell.run(15.0)
    failed = sum(caller.failed for caller in cell.callers)
    calls = failed + sum(caller.answered for caller in cell.callers)
    at = cell.kernel.now
    loads, handovers = len(cell.oracle.loads), cell.oracle.handovers
    cell.envoys[1].cut.add(3)
    cell.run(seconds)
    cell.envoys[1].cut.discard(3)
    cell.run(after)
    failed = sum(caller.failed for caller in cell.callers) - failed
    calls = sum(caller.failed + caller.answered for caller in cell.callers) - calls
    moves = {key: [t for t, _ in cell.oracle.owned_at[key] if t > at]
             for key in harmed}
    shortest = min((b - a for times in moves.values()
                    for a, b in zip(times, times[1:])), default=float("inf"))
    gaps = sorted(cell.vehicles[key].longest_gap - setup.message_s for key in harmed)
    return {
        "moves a shared vehicle": (sum(len(moves[key]) for key in keys)
                                   / max(1, len(keys))),
        "moves of others": sum(len(moves[key]) for key in harmed.difference(keys)),
        "shortest stay": shortest,
        "handovers": cell.oracle.handovers - handovers,
        "loads": (len(cell.oracle.loads) - loads) / setup.part,
        "calls failed %": 100.0 * failed / max(1, calls),
        "gap p99": cluster.quantile(gaps, 0.99),
        "gap most": gaps[-1],
        "waiting": cell.waiting(),
    }


def setup_of(seed, part, policy=None):
    return cluster.Setup(seed=seed, part=part, message_s=2.0, history_days=7,
                         envoys=2, only_of=3, policy=policy or parameters.Policy())


def run(seeds, part):
    table = tables.Table(
        "Two Envoys, one of which does not reach one server of a cell (seconds)",
        ("for, vehicles with a caller at the other Envoy", "moves a shared vehicle",
         "moves of others", "shortest stay", "loads", "calls failed %", "gap p99",
         "gap most"),
        note="Moves of the 2,500 vehicles of that server. A call is tried five times. "
             "Gaps beyond the 2 s between messages.")
    header = parameters.Policy()
    none = parameters.Policy(owner_header=False)
    for name, seconds, share, policy in (
            ("60 s, none", 60.0, 0.0, header),
            ("60 s, a tenth", 60.0, 0.1, header),
            ("60 s, all", 60.0, 1.0, header),
            ("300 s, all", 300.0, 1.0, header),
            ("60 s, all, handovers not paced", 60.0, 1.0,
             parameters.Policy(paced_handovers=False)),
            ("60 s, all, no owner header", 60.0, 1.0, none),
            ("300 s, all, no owner header", 300.0, 1.0, none)):
        figures = tables.over(seeds, lambda seed, s=seconds, c=share, po=policy:
                              disagree(setup_of(seed, part, po), s, c))
        table.add(**{table.columns[0]: name},
                  **{key: value for key, value in figures.items()
                     if key in table.columns})
    return [table]
