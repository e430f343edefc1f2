"""A synchronous standby that stops answering for a while."""

import cluster
import parameters
import tables


def stall(setup, seconds, after=20.0):
    cell = cluster.Cluster(setup)
    cell.run(12.0)
    joins = sum(server.joins for server in cell.servers)
    before = sum(vehicle.attempts for vehicle in cell.vehicles.values())
    cell.database.stall_standby(seconds)
    cell.run(seconds)
    settled = 0.0
    while settled < after:
        waiting = sum(vehicle.produced - vehicle.acked > 2 * setup.message_s + 1
                      for vehicle in cell.vehicles.values())
        if waiting == 0:
            break
        cell.run(0.25)
        settled += 0.25
    cell.run(after - settled)
    gaps = cell.gaps()
    return {
        "gap p50": cluster.quantile(gaps, 0.5),
        "gap most": gaps[-1],
        "caught up after": settled,
        "no reads, server s": cell.stale_lease_s,
        "servers buried": sum(server.joins for server in cell.servers) - joins,
        "streams anew": (sum(vehicle.attempts for vehicle in cell.vehicles.values())
                         - before) / setup.part,
        "loads": len(cell.oracle.loads) / setup.part,
        "waiting": cell.waiting(),
    }


def setup_of(seed, part, policy=None, message_s=2.0):
    return cluster.Setup(seed=seed, part=part, message_s=message_s, history_days=7,
                         policy=policy or parameters.Policy())


def run(seeds, part):
    table = tables.Table(
        "A synchronous standby that does not answer: 10 servers, 25,000 streams "
        "(seconds)",
        ("for, beats", "gap p50", "gap most", "caught up after", "no reads, server s",
         "servers buried", "streams anew", "loads"),
        note="Gaps beyond the 2 s between messages.")
    for seconds in (0.5, 5.0, 15.0, 45.0):
        for replicated, beats in ((True, "replicated"), (False, "local")):
            figures = tables.over(seeds, lambda seed, s=seconds, r=replicated: stall(
                setup_of(seed, part, parameters.Policy(replicated_beats=r)), s))
            table.add(**{table.columns[0]: f"{seconds:g} s, {beats}"},
                      **{key: value for key, value in figures.items()
                         if key in table.columns})
    return [table]
