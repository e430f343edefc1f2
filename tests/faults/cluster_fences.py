"""The row in which the database does not compare who writes: the judge of the
other rows has to find that poses are lost, doubled, or read stale."""

from cluster import TAKEOVER_SECONDS, Broken, Cluster
from cluster_servers import stops
from revisit_server import wait_until

# Cut out of the SQL of the append.
_FENCE = "AND v.owner = a.o AND v.epoch = a.e AND v.durable_sequence = a.f - 1 "


def without_fence(run):
    """A server stops between check and commit, as in the row that holds."""
    rounds = run.rounds(short=4, long=8)
    for number in range(1, rounds + 1):
        with Cluster(run, fleet={
                "max_batch": 60, "window": 40, "pause_seconds": 0.0}) as cluster:
            fleet = cluster.fleet
            for server in cluster.servers:
                cluster.kill(server)
                cluster.start(server, **stops(without=_FENCE, **(
                    {"stop_before": run.rng.randint(20, 90)} if server == 0
                    else {})))
            # What clients meet with is not at issue here.
            fleet.accepts_all = True
            fleet.start()
            wait_until(lambda: cluster.is_paused(0), "the server stops", 60)
            cluster.wait_until_dead(0)
            fleet.wait_for_acks(TAKEOVER_SECONDS)
            cluster.resume(0)
            fleet.sleep(3.0)
            try:
                cluster.judge()
            except Broken as broken:
                kinds = sorted({text.split(": ")[1].split()[0]
                                for text in broken.texts})
                return number, (f"{len(broken.texts)} broken promises found in "
                                f"round {number}: {', '.join(kinds)}")
    raise AssertionError(f"nothing was found in {rounds} rounds without a fence")


ROWS = [
    ("servers: no fence at all", "21", "the judge finds what is broken",
     without_fence),
]
