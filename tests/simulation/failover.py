"""The primary of a cell's PostgreSQL dies at the peak."""

import cluster
import parameters
import tables

# Seconds that are simulated after the outage; vehicles that have lost poses are loaded
# anew before their clients are told.
_AFTER = 60.0
_AFTER_LOSS = 150.0


def fail_over(setup, outage, after=_AFTER):
    cell = cluster.Cluster(setup)
    cell.run(12.0)
    joins = sum(server.joins for server in cell.servers)
    loads = len(cell.oracle.loads)
    at = cell.kernel.now
    cell.fail_over(outage)
    # Acknowledgements that were on their way arrive.
    cell.run(0.1)
    set_back = sum(cell.oracle.set_back.values())
    vehicles_set_back = len(cell.oracle.set_back)
    cell.run(outage + after - 0.1)
    gaps = cell.gaps()
    return {
        "gap p50": cluster.quantile(gaps, 0.5),
        "gap p99": cluster.quantile(gaps, 0.99),
        "gap most": gaps[-1],
        "servers buried": sum(server.joins for server in cell.servers) - joins,
        "loads": (len(cell.oracle.loads) - loads) / setup.part,
        "last loaded": max((t for t, _ in cell.oracle.loads), default=at) - at,
        "no reads, server s": cell.stale_lease_s,
        "poses lost": set_back / setup.part,
        "vehicles": vehicles_set_back / setup.part,
        "told": len(cell.oracle.told) / setup.part,
        "untold": len(cell.oracle.set_back) / setup.part,
        "waiting": cell.waiting(),
    }


def setup_of(seed, part, policy=None, lag=None, days=7, message_s=5.0):
    return cluster.Setup(seed=seed, part=part, message_s=message_s, history_days=days,
                         standby_lag=lag, policy=policy or parameters.Policy())


def run(seeds, part):
    table = tables.Table(
        "Failover of a cell's PostgreSQL at the peak: 10 servers, 25,000 streams, "
        "7 days of history (seconds)",
        ("outage, standby", "gap p50", "gap p99", "gap most", "servers buried",
         "loads", "last loaded", "no reads, server s", "poses lost", "vehicles",
         "told", "untold"),
        note="Gaps beyond the 5 s between messages. No reads: server seconds in which "
             "answers from memory are refused, their lease having run out.")
    policy = parameters.Policy
    for name, outage, lag, rules in (
            ("1 s, synchronous", 1.0, None, policy()),
            ("5 s, synchronous", 5.0, None, policy()),
            ("15 s, synchronous", 15.0, None, policy()),
            ("30 s, synchronous", 30.0, None, policy()),
            ("15 s, the same beat counts through the outage", 15.0, None,
             policy(watch_anew=False)),
            ("  and claimed anew is loaded anew", 15.0, None,
             policy(watch_anew=False, keep_graph=False)),
            ("5 s, own back-off where longer", 5.0, None,
             policy(retry_info_rules=False)),
            ("15 s, own back-off where longer", 15.0, None,
             policy(retry_info_rules=False)),
            ("5 s, claimed anew is loaded anew", 5.0, None, policy(keep_graph=False)),
            ("5 s, 0.1 s behind", 5.0, 0.1, policy()),
            ("5 s, 1 s behind", 5.0, 1.0, policy()),
            ("5 s, 10 s behind", 5.0, 10.0, policy())):
        figures = tables.over(seeds, lambda seed, o=outage, la=lag, r=rules: fail_over(
            setup_of(seed, part, r, la), o,
            _AFTER if la is None else _AFTER_LOSS))
        table.add(**{table.columns[0]: name},
                  **{key: value for key, value in figures.items()
                     if key in table.columns})
    return [table]
