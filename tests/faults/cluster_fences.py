"""The row in which the database does not compare who writes: the judge of the
other rows has to find that poses are lost, doubled, or read stale."""

from cluster import TAKEOVER_SECONDS, Broken, Cluster
from cluster_servers import stops
from revisit_server import wait_until

# Cut out of the SQL of the append.
_FENCE = "AND v.owner = a.o AND v.epoch = a.e AND v.durable_sequence = a.f - 1 "


# More than a read that is stale: what is stored is not what was acknowledged.
_LOSSES = {"LOST", "GAP", "DOUBLE", "WRONG"}


def without_fence(run):
    """A server stops between check and commit, as in the row that holds."""
    rounds = run.rounds(short=4, long=8)
    for number in range(1, rounds + 1):
        broken = broken_without_fence(run)
        kinds = {word for text in broken for word in text.split()[1:2]}
        if kinds & _LOSSES:
            return number, (f"{len(broken)} broken promises found in round "
                            f"{number}: {', '.join(sorted(kinds))}")
    raise AssertionError(f"no loss was found in {rounds} rounds without a fence")


def broken_without_fence(run):
    with Cluster(run, proxied=True, fleet={
            "max_batch": 60, "window": 40, "pause_seconds": 0.0}) as cluster:
        fleet = cluster.fleet
        for server in cluster.servers:
            cluster.kill(server)
            cluster.start(server, **stops(without=_FENCE, **(
                {"stop_before": run.rng.randint(10, 30)} if server == 0 else {})))
        # What clients meet with is not at issue here.
        fleet.accepts_all = True
        # Commits take long, so that more rows wait behind the one at which the
        # server stops.
        cluster.proxy.delay = 0.05
        fleet.start()
        wait_until(lambda: cluster.is_paused(0), "the server stops", 60)
        cluster.proxy.delay = 0.0
        cluster.wait_until_dead(0)
        fleet.wait_for_acks(TAKEOVER_SECONDS)
        cluster.resume(0)
        fleet.sleep(2.0)
        try:
            cluster.judge()
        except Broken as broken:
            return broken.texts
    return []


ROWS = [
    ("servers: no fence at all", "21", "the judge finds what is broken",
     without_fence),
]
