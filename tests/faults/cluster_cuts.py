"""Rows of a cluster whose network is cut: each server, the database and the
clients are hosts of their own."""

import time

from cluster import LEASE_SECONDS, TAKEOVER_SECONDS, Cluster
from hosts import Network
from postgres import Postgres

SERVERS = ["server0", "server1", "server2"]
DATABASE = "database"
CLIENTS = "clients"


class Hosts:
    """A network, a database on a host of its own, and a cluster on others."""

    def __init__(self, run):
        self.network = Network([*SERVERS, DATABASE])
        try:
            self._database = Postgres(
                run.new(f"hosts{run.rng.randrange(10**9)}") / "database",
                host=self.network.address(DATABASE),
                launch=self.network.on(DATABASE))
            try:
                self.cluster = Cluster(
                    run, database=self._database, host_of=lambda number: (
                        self.network.address(SERVERS[number]),
                        self.network.on(SERVERS[number])),
                    flags=["--insecure-allow-remote", "on"])
            except BaseException:
                self._database.close()
                raise
        except BaseException:
            self.network.close()
            raise

    def __enter__(self):
        return self.network, self.cluster

    def __exit__(self, *failure):
        self.network.heal()
        self.cluster.__exit__(*failure)
        self._database.close()
        self.network.close()


def cut_from_database(run, cut):
    """`cut(network, host)` parts a server from the database, for longer than its
    lease; clients still reach it."""
    rounds = run.rounds(short=1, long=8)
    slowest = 0.0
    with Hosts(run) as (network, cluster):
        fleet = cluster.fleet
        fleet.start()
        fleet.wait_for_acks(TAKEOVER_SECONDS)
        for number in range(rounds):
            victim = number % len(SERVERS)
            cut(network, SERVERS[victim])
            slowest = max(slowest, fleet.wait_for_acks(TAKEOVER_SECONDS))
            # Clients learn from the one that is cut off that it knows nothing.
            fleet.sleep(LEASE_SECONDS)
            network.heal()
            fleet.wait_for_acks(TAKEOVER_SECONDS)
            fleet.sleep(1.0)
        seen = cluster.judge()
        stale = fleet.outcomes["UNAVAILABLE LEASE_STALE"]
    return rounds, (f"{seen}; all served after {slowest:.1f} s at most, "
                    f"{stale} told LEASE_STALE")


def servers_cut_from_each_other(run):
    """They meet in the database only."""
    with Hosts(run) as (network, cluster):
        fleet = cluster.fleet
        fleet.start()
        fleet.wait_for_acks(TAKEOVER_SECONDS)
        for one in SERVERS:
            for other in SERVERS:
                if one < other:
                    network.cut(one, other)
        begun = time.monotonic()
        fleet.sleep(run.rounds(short=LEASE_SECONDS + 2, long=30))
        silence = fleet.longest_silence(begun)
        assert silence < LEASE_SECONDS, silence
        network.heal()
        seen = cluster.judge()
    return 1, f"{seen}; longest time without an ack {silence:.1f} s"


def clients_cut_from_server(run, cut):
    """Its clients cannot tell it from one that died; it goes on for others."""
    rounds = run.rounds(short=1, long=8)
    slowest = 0.0
    with Hosts(run) as (network, cluster):
        fleet = cluster.fleet
        fleet.start()
        fleet.wait_for_acks(TAKEOVER_SECONDS)
        for number in range(rounds):
            victim = number % len(SERVERS)
            cut(network, SERVERS[victim])
            # Asked for elsewhere, its vehicles are handed over, not at once.
            slowest = max(slowest, fleet.wait_for_acks(3 * TAKEOVER_SECONDS))
            network.heal()
            fleet.wait_for_acks(TAKEOVER_SECONDS)
        seen = cluster.judge()
    return rounds, f"{seen}; all served after {slowest:.1f} s at most"


ROWS = [
    ("cluster: server cut from PostgreSQL", "26", "no ack, others take over",
     lambda run: cut_from_database(
         run, lambda network, host: network.cut(host, DATABASE))),
    ("cluster: what PostgreSQL sends is lost", "25", "the same",
     lambda run: cut_from_database(
         run, lambda network, host: network.cut_one_way(DATABASE, host))),
    ("cluster: what a server sends to PostgreSQL is lost", "25", "the same",
     lambda run: cut_from_database(
         run, lambda network, host: network.cut_one_way(host, DATABASE))),
    ("cluster: servers cut from each other", "24", "nobody notices",
     servers_cut_from_each_other),
    ("cluster: server cut from its clients", "24", "others take over",
     lambda run: clients_cut_from_server(
         run, lambda network, host: network.cut(host, CLIENTS))),
    ("cluster: what a server sends to clients is lost", "25", "the same",
     lambda run: clients_cut_from_server(
         run, lambda network, host: network.cut_one_way(host, CLIENTS))),
]
