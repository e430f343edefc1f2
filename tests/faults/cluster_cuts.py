"""Rows of a cluster whose network is cut: each server, the database and the
clients are hosts of their own."""

import time

from cluster import (LEASE_SECONDS, TAKEOVER_SECONDS, Cluster, back_seconds,
                     short_of_lease_seconds)
from envoy_front import EnvoyFront
from hosts import Network
from postgres import Postgres
from revisit_server import wait_until

SERVERS = ["server0", "server1", "server2"]
DATABASE = "database"
CLIENTS = "clients"
PROXY = "proxy"


def away_seconds():
    """Within which others serve the vehicles of a server that is cut off. Beyond the
    lease: until the server has seen that it has run out, Envoy has asked its health
    twice, others have looked twice, and clients have come to them. With the lease of
    10 s that servers have by default it makes the 15 s that docs/scale.md promises."""
    return LEASE_SECONDS + back_seconds()


class Hosts:
    """A network, a database on a host of its own, and a cluster on others: behind
    Envoy, which has one of its own too, if that is said here or of all rows.
    `fleet`: further arguments of Fleet."""

    def __init__(self, run, behind_envoy=False, fleet=None):
        self.network = Network([*SERVERS, DATABASE, PROXY])
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
                    fleet=fleet, **self._front(run, behind_envoy))
            except BaseException:
                self._database.close()
                raise
        except BaseException:
            self.network.close()
            raise

    def _front(self, run, behind_envoy):
        if not behind_envoy and not run.behind_envoy:
            return {"flags": ["--insecure-allow-remote", "on"]}
        return {"front": EnvoyFront(run, self.network.address(PROXY),
                                    self.network.on(PROXY))}

    def __enter__(self):
        return self.network, self.cluster

    def __exit__(self, *failure):
        self.network.heal()
        self.cluster.__exit__(*failure)
        self._database.close()
        self.network.close()


def cut_from_database(run, cut):
    """`cut(network, host)` parts a server from the database; clients still reach it,
    by way of Envoy. It is not healed before others serve its vehicles, and then they
    are served on until it is over."""
    rounds = run.rounds(short=1, long=8)
    lasting = run.rounds(short=10, long=20)
    slowest = silence = 0.0
    # Clients wait for an answer as long as it takes: they do not go away by
    # themselves.
    with Hosts(run, behind_envoy=True, fleet={
            "answer_seconds": 10 * TAKEOVER_SECONDS}) as (network, cluster):
        fleet = cluster.fleet
        fleet.start()
        fleet.wait_for_acks(TAKEOVER_SECONDS)
        for _ in range(rounds):
            victim = cluster.any_owner()
            wait_until(lambda: any(
                vehicle.streams for vehicle in cluster.vehicles_of(victim)),
                "stream to the one that is cut off")
            told = fleet.outcomes["UNAVAILABLE LEASE_STALE"]
            begun = time.monotonic()
            cut(network, SERVERS[victim])
            slowest = max(slowest, fleet.wait_for_acks(away_seconds()))
            served = time.monotonic()
            fleet.sleep(max(1.0, begun + lasting - served))
            silence = max(silence, fleet.longest_silence(served))
            # The one that is cut off has said so to those that it had.
            assert fleet.outcomes["UNAVAILABLE LEASE_STALE"] > told
            network.heal()
            fleet.wait_for_acks(TAKEOVER_SECONDS)
            wait_until(lambda: cluster.lives(victim), "server that is back")
            fleet.sleep(1.0)
        seen = cluster.judge()
        stale = fleet.outcomes["UNAVAILABLE LEASE_STALE"]
    assert silence < short_of_lease_seconds(), silence
    return rounds, (f"{seen}; all served after {slowest:.1f} s at most, the cut of "
                    f"{lasting} s going on, and then nobody waits for more than "
                    f"{silence:.1f} s; {stale} told LEASE_STALE")


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


def before_servers(run):
    """The host that calls the servers."""
    return PROXY if run.behind_envoy else CLIENTS


def clients_cut_from_server(run, cut):
    """Its clients cannot tell it from one that died; it goes on for others."""
    rounds = run.rounds(short=1, long=8)
    slowest = 0.0
    with Hosts(run) as (network, cluster):
        fleet = cluster.fleet
        fleet.start()
        fleet.wait_for_acks(TAKEOVER_SECONDS)
        for _ in range(rounds):
            victim = cluster.any_owner()
            cut(network, SERVERS[victim])
            # Asked for elsewhere, its vehicles are handed over, not at once.
            slowest = max(slowest, fleet.wait_for_acks(3 * TAKEOVER_SECONDS))
            network.heal()
            fleet.wait_for_acks(TAKEOVER_SECONDS)
        seen = cluster.judge()
    return rounds, f"{seen}; all served after {slowest:.1f} s at most"


def killed_behind_envoy(run):
    rounds = run.rounds(short=1, long=10)
    slowest = 0.0
    with Hosts(run, behind_envoy=True) as (_, cluster):
        fleet = cluster.fleet
        fleet.start()
        fleet.wait_for_acks(TAKEOVER_SECONDS)
        for _ in range(rounds):
            victim = cluster.any_owner()
            wait_until(lambda: any(
                vehicle.streams for vehicle in cluster.vehicles_of(victim)),
                "stream to the one that is killed")
            cluster.kill(victim)
            slowest = max(slowest, fleet.wait_for_acks(TAKEOVER_SECONDS))
            cluster.start(victim)
            fleet.sleep(2.0)
        # How Envoy tells of calls whose server died.
        resets = fleet.outcomes["INTERNAL"] + fleet.outcomes["UNAVAILABLE"]
        assert resets > 0, fleet.summary()
        seen = cluster.judge()
    return rounds, (f"{seen}; {resets} calls cut, all served after "
                    f"{slowest:.1f} s at most")


def cut_from_envoy(run, cut):
    """Calls wait or end; what was acknowledged by then is kept."""
    rounds = run.rounds(short=1, long=10)
    back = 0.0
    with Hosts(run, behind_envoy=True) as (network, cluster):
        fleet = cluster.fleet
        fleet.start()
        fleet.wait_for_acks(TAKEOVER_SECONDS)
        for _ in range(rounds):
            cut(network)
            # Longer than clients wait for an answer.
            fleet.sleep(run.rng.uniform(3.5, 5.0))
            network.heal()
            back = max(back, fleet.wait_for_acks(TAKEOVER_SECONDS))
        seen = cluster.judge()
    return rounds, f"{seen}; all served {back:.1f} s after the cut"


ROWS = [
    ("network: server cut from PostgreSQL", "26",
     "it sends its clients away, others serve them while the cut goes on",
     lambda run: cut_from_database(
         run, lambda network, host: network.cut(host, DATABASE))),
    ("network: what PostgreSQL sends is lost", "25", "the same",
     lambda run: cut_from_database(
         run, lambda network, host: network.cut_one_way(DATABASE, host))),
    ("network: what a server sends to PostgreSQL is lost", "25", "the same",
     lambda run: cut_from_database(
         run, lambda network, host: network.cut_one_way(host, DATABASE))),
    ("network: servers cut from each other", "24", "nobody notices",
     servers_cut_from_each_other),
    ("network: server cut from its clients", "24", "others take over",
     lambda run: clients_cut_from_server(
         run, lambda network, host: network.cut(host, before_servers(run)))),
    ("network: what a server sends to clients is lost", "25", "the same",
     lambda run: clients_cut_from_server(
         run, lambda network, host: network.cut_one_way(
             host, before_servers(run)))),
    ("network: kill -9 behind Envoy", "1",
     "every acked pose, once, in order", killed_behind_envoy),
    ("network: clients cut from Envoy", "24", "they resume",
     lambda run: cut_from_envoy(
         run, lambda network: network.cut(CLIENTS, PROXY))),
    ("network: what Envoy sends to clients is lost", "25", "they resume",
     lambda run: cut_from_envoy(
         run, lambda network: network.cut_one_way(PROXY, CLIENTS))),
    ("network: what clients send to Envoy is lost", "25", "they resume",
     lambda run: cut_from_envoy(
         run, lambda network: network.cut_one_way(CLIENTS, PROXY))),
]
