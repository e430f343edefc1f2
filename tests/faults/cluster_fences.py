"""Rows in which what keeps the promises is taken away: the judge of the other rows
has to find that they are broken, for one that cannot fail is none."""

from cluster import TAKEOVER_SECONDS, Broken, Cluster
from cluster_cuts import DATABASE, SERVERS, Hosts
from cluster_servers import stops
from revisit_server import wait_until
from skipped import Skipped

# Cut out of the SQL of the append.
_FENCE = ("AND v.owner = a.o AND v.epoch = a.e AND v.revision = a.was "
          "AND v.durable_sequence = a.f - 1 ")
# More than a read that is stale: what is stored is not what was acknowledged.
_LOSSES = {"LOST", "GAP", "DOUBLE", "WRONG", "DAMAGED"}


def without_fence(run):
    """A server stops between check and commit, as in the row that holds, but the
    database does not compare who writes."""
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
        # Else the key of a row would stop some of what the fence stops.
        cluster.database.sql(
            "ALTER TABLE batches DROP CONSTRAINT batches_pkey; "
            "CREATE INDEX ON batches (vehicle_key, first_sequence)")
        # Where a vehicle is at home follows from addresses, and a server may be no
        # vehicle's: it would not write, nor stop.
        victim = max(cluster.servers, key=cluster.count_of)
        for server in cluster.servers:
            cluster.kill(server)
            cluster.start(server, **stops(without=_FENCE, **(
                {"stop_before": run.rng.randint(10, 30)} if server == victim
                else {})))
        # What clients meet with is not at issue here.
        fleet.accepts_all = True
        # Commits take long, so that more rows wait behind the one at which the
        # server stops.
        cluster.proxy.delay = 0.05
        fleet.start()
        wait_until(lambda: cluster.is_paused(victim), "the server stops", 60)
        cluster.proxy.delay = 0.0
        cluster.wait_until_dead(victim)
        fleet.wait_for_acks(TAKEOVER_SECONDS)
        cluster.resume(victim)
        fleet.sleep(2.0)
        try:
            cluster.judge()
        except Broken as broken:
            return broken.texts
    return []


def without_lease(run):
    """A server whose clock stands still is cut from the database, and goes on to
    answer from memory while others write its vehicles."""
    if run.behind_envoy:
        raise Skipped("readers choose the server and writers do not go there, which "
                      "Envoy does not know")
    # What waits for the database would keep the server from answering.
    with Hosts(run, fleet={"list_share": 0.0, "stray": 0.0}) as (
            network, cluster):
        fleet = cluster.fleet
        victim = cluster.any_owner()
        cluster.terminate(victim)
        cluster.start(victim, **stops(no_boottime=1))
        fleet.start()
        wait_until(lambda: cluster.count_of(victim) > 0,
                   "vehicles at the server", 2 * TAKEOVER_SECONDS)
        with fleet.without_writes():
            fleet.not_for_writers = cluster.servers[victim].address
            network.cut(SERVERS[victim], DATABASE)
        cluster.wait_until_dead(victim)
        fleet.wait_for_acks(TAKEOVER_SECONDS)
        fleet.sleep(1.0)
        network.heal()
        try:
            cluster.judge()
        except Broken as broken:
            stale = [text for text in broken.texts if " STALE " in text]
            assert stale, broken
            return 1, f"{len(stale)} stale reads found"
    raise AssertionError("no stale read was found without leases")


ROWS = [
    ("servers: no fence at all", "21", "the judge finds what is broken",
     without_fence),
    ("network: no lease at all", "22", "the judge finds what is broken",
     without_lease),
]
