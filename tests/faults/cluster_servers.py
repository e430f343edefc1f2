"""Rows of a cluster whose servers end, stop, come and go."""

import time

import grpc

from cluster import (LEASE_SECONDS, TAKEOVER_SECONDS, Cluster,
                     back_seconds, short_of_lease_seconds)
from cluster_history import Read
from revisit_server import BIN, wait_until
from stubs import api



def stops(**plan):
    """An environment in which a server stops at a statement; see
    statement_shim.cc."""
    return {"LD_PRELOAD": str(BIN / "statement_shim.so"),
            "REVISIT_TEST_STATEMENT": "append",
            **{f"REVISIT_TEST_{name.upper()}": str(value)
               for name, value in plan.items()}}


def killed(run):
    rounds = run.rounds(short=2, long=20)
    slowest = 0.0
    with Cluster(run) as cluster:
        cluster.fleet.start()
        cluster.fleet.wait_for_acks(TAKEOVER_SECONDS)
        for _ in range(rounds):
            cluster.fleet.sleep(run.rng.uniform(0.2, 1.5))
            victim = cluster.any_owner()
            cluster.kill(victim)
            if run.rng.random() < 0.5:
                cluster.start(victim)
            slowest = max(slowest, cluster.fleet.wait_for_acks(TAKEOVER_SECONDS))
            if not cluster.servers[victim].is_running():
                cluster.start(victim)
        seen = cluster.judge()
    return rounds, f"{seen}; all served again after {slowest:.1f} s at most"


def paused(run):
    rounds = run.rounds(short=2, long=24)
    slowest = 0.0
    with Cluster(run) as cluster:
        cluster.fleet.start()
        cluster.fleet.wait_for_acks(TAKEOVER_SECONDS)
        asked = 0
        for number in range(rounds):
            victim = cluster.any_owner()
            reads = ReadsAcrossAPause(cluster, victim)
            cluster.pause(victim)
            if number % 2:
                # Others have its vehicles before it wakes.
                cluster.wait_until_dead(victim)
                slowest = max(slowest,
                              cluster.fleet.wait_for_acks(TAKEOVER_SECONDS))
                reads.ask()
            else:
                cluster.fleet.sleep(run.rng.uniform(0.3, LEASE_SECONDS))
            cluster.resume(victim)
            asked += reads.answered()
            cluster.fleet.wait_for_acks(TAKEOVER_SECONDS)
        seen = cluster.judge()
    assert asked > 0 or rounds == 1
    return rounds, (f"{seen}; {asked} reads waited for one to wake; all served "
                    f"again after {slowest:.1f} s at most")


class ReadsAcrossAPause:
    """Reads that wait at a stopped server, which it answers first of all when it
    wakes: before it can have learned that others have its vehicles."""

    def __init__(self, cluster, number):
        self._vehicles = cluster.vehicles_of(number)
        self._stub = cluster.stub(number)
        # The connection has to be there before the server stops.
        self._stub.GetServerInfo(api.GetServerInfoRequest())
        self._asked = []

    def ask(self):
        for vehicle in self._vehicles:
            self._asked.append((vehicle, time.monotonic(),
                                self._stub.GetVehicle.future(
                                    api.GetVehicleRequest(name=vehicle.name),
                                    timeout=TAKEOVER_SECONDS)))

    def answered(self):
        """Adds those that show something to what is judged; answers how many
        were asked."""
        for vehicle, called, call in self._asked:
            if call.exception() is None:
                vehicle.history.reads.append(Read(
                    called, time.monotonic(),
                    call.result().vehicle.durable_sequence, "GetVehicle"))
            else:
                assert call.code() in (grpc.StatusCode.UNAVAILABLE,
                                       grpc.StatusCode.ABORTED), call
        return len(self._asked)


def paused_at_append(run, when):
    """The server stops at a statement that it has decided to send, its vehicles
    are taken, and it wakes."""
    rounds = run.rounds(short=1, long=12)
    with Cluster(run) as cluster:
        cluster.fleet.start()
        cluster.fleet.wait_for_acks(TAKEOVER_SECONDS)
        for _ in range(rounds):
            victim = cluster.any_owner()
            cluster.kill(victim)
            cluster.start(victim, **stops(**{when: run.rng.randint(2, 60)}))
            wait_until(lambda: cluster.is_paused(victim), "the server stops", 60)
            cluster.wait_until_dead(victim)
            cluster.fleet.wait_for_acks(TAKEOVER_SECONDS)
            found = deaths(cluster, victim)
            cluster.resume(victim)
            wait_until(lambda: deaths(cluster, victim) > found,
                       "server that finds itself dead")
            cluster.fleet.wait_for_acks(TAKEOVER_SECONDS)
        seen = cluster.judge()
    return rounds, f"{seen}; {rounds} servers woke up dead"


def deaths(cluster, number):
    return cluster.servers[number].log().count("taken this one for dead")


def terminated(run, notice_seconds=1):
    rounds = run.rounds(short=2, long=20)
    silence = longest = 0.0
    with Cluster(run, flags=["--drain-notice-seconds", notice_seconds]) as cluster:
        cluster.fleet.start()
        cluster.fleet.wait_for_acks(TAKEOVER_SECONDS)
        for _ in range(rounds):
            cluster.fleet.sleep(run.rng.uniform(0.2, 1.5))
            victim = cluster.any_owner()
            begun = time.monotonic()
            longest = max(longest, cluster.terminate(victim))
            cluster.fleet.wait_for_acks(back_seconds())
            silence = max(silence, cluster.fleet.longest_silence(begun))
            cluster.start(victim)
        told = cluster.fleet.outcomes["UNAVAILABLE SERVER_DRAINING"]
        seen = cluster.judge()
    # In a long notice others have asked for all vehicles before it is over.
    assert told > 0 or notice_seconds > 1
    # Nobody waits for the lease of a server that was asked to end.
    assert silence < short_of_lease_seconds(), silence
    return rounds, (f"{seen}; ended within {longest:.1f} s, longest time without "
                    f"an ack {silence:.1f} s; {told} told SERVER_DRAINING")


def terminated_after_notice(run):
    """The notice of docs/scale.md: whoever comes back in it asks other servers for
    vehicles that this one still has."""
    return terminated(run, notice_seconds=5)


def rolling_restart(run):
    """Each server once, the next when the one before is back."""
    streams = 300 if run.long else 60
    slowest = 0.0
    with Cluster(run, flags=["--drain-notice-seconds", 1], fleet={
            "vehicles": streams, "readers": 6, "window": 1,
            "pause_seconds": 1.0}) as cluster:
        cluster.fleet.start()
        cluster.fleet.wait_for_acks(60)
        for number in list(cluster.servers):
            cluster.terminate(number, 60)
            cluster.start(number)
            slowest = max(slowest, cluster.fleet.wait_for_acks(60))
        seen = cluster.judge()
    return len(cluster.servers), (
        f"{streams} vehicles, {seen}; all served {slowest:.1f} s after a server "
        "is back")


def scaled(run):
    """2 -> 3 -> 2 servers."""
    rounds = run.rounds(short=1, long=4)
    most = 0
    # Many vehicles, for the third server's share follows from their names. Many
    # calls that stray, so that a vehicle that may move back at once does.
    with Cluster(run, servers=2, flags=["--drain-notice-seconds", 1], fleet={
            "vehicles": 24, "readers": 8, "pause_seconds": 0.2,
            "stray": 0.3}) as cluster:
        cluster.fleet.start()
        cluster.fleet.wait_for_acks(TAKEOVER_SECONDS)
        for _ in range(rounds):
            cluster.start(2)
            cluster.tell_of_servers()
            # Calls that stray there have vehicles handed over.
            wait_until(lambda: cluster.count_of(2) >= 2,
                       "vehicles at the third server", 3 * TAKEOVER_SECONDS)
            most = max(most, cluster.count_of(2))
            leaver = cluster.any_owner()
            cluster.terminate(leaver)
            del cluster.servers[leaver]
            cluster.tell_of_servers()
            cluster.fleet.wait_for_acks(back_seconds())
            if leaver != 2:
                cluster.servers[leaver] = cluster.servers.pop(2)
        seen = cluster.judge()
    return rounds, f"{seen}; the third server had {most} vehicles"


ROWS = [
    ("servers: kill -9", "1", "every acked pose, once, in order",
     killed),
    ("servers: stopped and woken", "22", "no ack, no stale read", paused),
    ("servers: stopped between check and commit", "22",
     "nothing written by whoever is no longer the owner",
     lambda run: paused_at_append(run, "stop_before")),
    ("servers: stopped between commit and ack", "22",
     "sent again elsewhere: stored once",
     lambda run: paused_at_append(run, "stop_after")),
    ("servers: SIGTERM", "16", "last acks, others have its vehicles "
     "at once", terminated),
    ("servers: SIGTERM with a long notice", "16",
     "others have its vehicles as soon as they ask", terminated_after_notice),
    ("servers: rolling restart", "16", "no ack lost", rolling_restart),
    ("servers: scale 2 -> 3 -> 2", "23",
     "vehicles move, each at most once in a lease", scaled),
]
