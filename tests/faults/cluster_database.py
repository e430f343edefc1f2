"""Rows of a cluster whose database is restarted, replaced, cut off, or full."""

import time

import grpc

import hosts
from cluster import (LEASE_SECONDS, TAKEOVER_SECONDS, Cluster,
                     back_seconds)
from postgres import Postgres, url_of
from stubs import api
from wire import failure_of

STANDBY = "standby"


def restarted(run):
    """Every three seconds."""
    rounds = run.rounds(short=3, long=40)
    slowest = 0.0
    with Cluster(run) as cluster:
        cluster.fleet.start()
        cluster.fleet.wait_for_acks(TAKEOVER_SECONDS)
        for number in range(rounds):
            begun = time.monotonic()
            cluster.database.restart(("fast", "immediate", "kill")[number % 3])
            slowest = max(slowest, cluster.fleet.wait_for_acks(back_seconds()))
            cluster.fleet.sleep(begun + 3.0 - time.monotonic())
        seen = cluster.judge()
    return rounds, f"{seen}; all served {slowest:.1f} s after a start at most"


def away(run):
    """For longer than the leases: when it is back, every server lives, although
    none could say so meanwhile."""
    rounds = run.rounds(short=1, long=6)
    slowest = 0.0
    with Cluster(run) as cluster:
        cluster.fleet.start()
        cluster.fleet.wait_for_acks(TAKEOVER_SECONDS)
        moved = 0
        for number in range(rounds):
            before = cluster.moves()
            cluster.database.stop(("fast", "immediate", "kill")[number % 3])
            cluster.fleet.sleep(LEASE_SECONDS + 1.0)
            cluster.database.start()
            slowest = max(slowest, cluster.fleet.wait_for_acks(back_seconds()))
            moved += cluster.moves() - before
        buried = sum(server.log().count("was silent for its lease")
                     for server in cluster.servers.values())
        seen = cluster.judge()
    assert buried == 0, f"{buried} servers that live were taken for dead"
    return rounds, f"{seen}; {moved} of them then, all served {slowest:.1f} s after"


def stopped(run):
    """Every process of it, for longer than the leases: connections stay, and
    nothing comes from them."""
    rounds = run.rounds(short=1, long=6)
    slowest = 0.0
    with Cluster(run) as cluster:
        fleet = cluster.fleet
        fleet.start()
        fleet.wait_for_acks(TAKEOVER_SECONDS)
        for _ in range(rounds):
            cluster.database.pause()
            fleet.sleep(LEASE_SECONDS)
            check_silence(fleet)
            cluster.database.resume()
            slowest = max(slowest, fleet.wait_for_acks(back_seconds()))
        seen = cluster.judge()
    return rounds, (f"{seen}; no ack and no read from memory after the lease, all "
                    f"served {slowest:.1f} s after it woke")


def check_silence(fleet):
    """Nobody is acknowledged anything, and nothing is answered from memory."""
    acked = fleet.acked()
    begun = time.monotonic()
    fleet.sleep(1.0)
    late = [read for vehicle in fleet.vehicles for read in vehicle.history.reads
            if read.called > begun and read.what == "GetVehicle"]
    assert not late, late[:3]
    assert fleet.acked() == acked


class Pair:
    """A primary and its standby; the servers know both."""

    def __init__(self, run, replicates):
        directory = run.new(f"pair{run.rng.randrange(10**9)}")
        self.primary = Postgres(directory / "a")
        try:
            self.standby = Postgres(directory / "b", primary=self.primary)
        except BaseException:
            self.primary.close()
            raise
        # Both are named, for the setting does not follow to a promoted standby.
        self.url = url_of(self.primary.address, self.standby.address,
                          connect_timeout=2)
        if replicates:
            self.primary.set(synchronous_standby_names=STANDBY)
            self.primary.wait_for_standby("sync")
        else:
            self.primary.wait_for_standby("async")

    def close(self):
        self.standby.close()
        self.primary.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()


def failover_to_replica(run):
    rounds = run.rounds(short=2, long=6)
    slowest = 0.0
    for number in range(rounds):
        with Pair(run, replicates=True) as pair, Cluster(
                run, database=pair.primary, url=pair.url) as cluster:
            cluster.fleet.start()
            cluster.fleet.wait_for_acks(TAKEOVER_SECONDS)
            cluster.fleet.sleep(run.rng.uniform(0.5, 2.0))
            # Where it goes first, it has what was acknowledged by then, and
            # nothing may be acknowledged any more.
            goes_first = number % 2 == 0
            if goes_first:
                pair.standby.stop("fast")
                cluster.fleet.sleep(run.rng.uniform(0.5, 2.0))
            pair.primary.stop(("kill", "immediate")[number // 2 % 2])
            if goes_first:
                pair.standby.start()
            pair.standby.promote()
            cluster.database = pair.standby
            slowest = max(slowest, cluster.fleet.wait_for_acks(TAKEOVER_SECONDS))
            cluster.fleet.sleep(1.0)
            seen = cluster.judge()
    return rounds, f"{seen}; all served {slowest:.1f} s after the promotion"


def failover_that_loses(run):
    """The standby lacks what was acknowledged last."""
    with Pair(run, replicates=False) as pair, Cluster(
            run, database=pair.primary, url=pair.url,
            fleet={"may_lose": True, "stream_share": 1.0}) as cluster:
        fleet = cluster.fleet
        fleet.start()
        fleet.wait_for_acks(TAKEOVER_SECONDS)
        pair.standby.stop("fast")
        fleet.wait_for_acks(TAKEOVER_SECONDS)
        fleet.sleep(1.0)
        pair.primary.stop("kill")
        lost_at = time.monotonic()
        # What was acknowledged before is still on its way.
        fleet.sleep(0.5)
        acked = {vehicle.name: vehicle.history.acked
                 for vehicle in fleet.vehicles}
        pair.standby.start()
        stored = {f"vehicles/{name}": int(head) for name, head in
                  pair.standby.sql("SELECT id, durable_sequence FROM heads "
                                   "JOIN vehicles USING (key)")}
        pair.standby.promote()
        cluster.database = pair.standby
        regressed = [vehicle for vehicle in fleet.vehicles
                     if acked[vehicle.name] > stored[vehicle.name]]
        assert regressed
        deadline = time.monotonic() + 2 * TAKEOVER_SECONDS
        while silent := [vehicle for vehicle in regressed
                         if not vehicle.told_of_loss]:
            fleet.check()
            assert time.monotonic() < deadline, (
                f"not told of a loss: {[vehicle.name for vehicle in silent]}; "
                f"{fleet.summary()}")
            time.sleep(0.05)
        # Nobody was acknowledged more before that was told.
        for vehicle in regressed:
            assert vehicle.history.acked == acked[vehicle.name], vehicle.name
        fleet.stop()
        accept_losses(cluster, regressed, stored)
        seen = cluster.judge(lost_at)
    lost = sum(acked[vehicle.name] - stored[vehicle.name]
               for vehicle in regressed)
    return 1, (f"{len(regressed)} vehicles lacked {lost} acked poses: every one "
               f"answered DATA_LOSS until accepted; else {seen}")


def accept_losses(cluster, vehicles, stored):
    """Writes are refused until an operator accepts the loss, then go on."""
    owners = cluster.owners()
    stubs = {server.address: cluster.stub(number)
             for number, server in cluster.servers.items()}
    for vehicle in vehicles:
        stub = stubs[owners[vehicle.name]]
        head = stored[vehicle.name]
        request = api.AppendPosesRequest(
            vehicle=vehicle.name, poses=vehicle.drive[head:head + 5])
        refused = failure_of(lambda: stub.AppendPoses(request))
        assert refused.code == grpc.StatusCode.DATA_LOSS, refused
        stub.AcceptDataLoss(api.AcceptDataLossRequest(
            name=vehicle.name, durable_sequence=head))
        assert stub.AppendPoses(request).ack.durable_sequence == head + 5


def wait_for_silence(fleet):
    """Until nobody is acknowledged any more; answers how many were."""
    before = -1
    deadline = time.monotonic() + 2 * TAKEOVER_SECONDS
    while (now := fleet.acked()) != before:
        assert time.monotonic() < deadline, "acknowledgements go on"
        before = now
        fleet.sleep(1.0)
    return now


def standby_gone(run):
    """Commits wait for a standby that is not there."""
    with Pair(run, replicates=True) as pair, Cluster(
            run, database=pair.primary, url=pair.url) as cluster:
        fleet = cluster.fleet
        fleet.start()
        fleet.wait_for_acks(TAKEOVER_SECONDS)
        pair.standby.stop("fast")
        wait_for_silence(fleet)
        # Longer than the lease: nothing is answered from memory either.
        fleet.sleep(LEASE_SECONDS)
        check_silence(fleet)
        pair.standby.start()
        back = fleet.wait_for_acks(TAKEOVER_SECONDS)
        seen = cluster.judge()
    return 1, (f"{seen}; no ack and no read from memory while it was away, all "
               f"served {back:.1f} s after it is back")


def wait_ended_by_operator(run, function):
    """The wait for the standby is ended, by which the commit returns although
    nothing was replicated; then the standby takes over."""
    rounds = run.rounds(short=6, long=20)
    ended = 0
    with Pair(run, replicates=True) as pair, Cluster(
            run, database=pair.primary, url=pair.url) as cluster:
        fleet = cluster.fleet
        fleet.start()
        fleet.wait_for_acks(TAKEOVER_SECONDS)
        pair.standby.stop("fast")
        acked = wait_for_silence(fleet)
        for _ in range(rounds):
            ended += len(pair.primary.sql(
                f"SELECT {function}(pid) FROM pg_stat_activity WHERE "
                "wait_event = 'SyncRep'"))
            fleet.sleep(0.3)
        assert ended >= rounds, ended
        assert fleet.acked() == acked, "acknowledged, but not replicated"
        pair.primary.stop("kill")
        pair.standby.start()
        pair.standby.promote()
        cluster.database = pair.standby
        back = fleet.wait_for_acks(TAKEOVER_SECONDS)
        fleet.sleep(1.0)
        seen = cluster.judge()
    return ended, (f"{seen}; {ended} waits ended, none acked; all served "
                   f"{back:.1f} s after the promotion")


def answer_eaten(run):
    """The commit takes place, and whoever waits for it never hears of it."""
    rounds = run.rounds(short=2, long=12)
    with Cluster(run, proxied=True) as cluster:
        proxy = cluster.proxy
        cluster.fleet.start()
        cluster.fleet.wait_for_acks(TAKEOVER_SECONDS)
        for _ in range(rounds):
            for statement in ("append", "claim", "beat", "append_with_vehicle",
                              "release"):
                if not proxy.executed.get(statement):
                    continue
                for _ in range(4 if statement == "append" else 1):
                    proxy.eat_answer(statement)
                    if statement == "claim":
                        # Somebody has to claim: all connections end.
                        proxy.cut()
                    cluster.fleet.sleep(0.4)
            cluster.fleet.wait_for_acks(TAKEOVER_SECONDS)
        eaten = proxy.eaten
        seen = cluster.judge()
    assert eaten >= 4 * rounds, eaten
    return eaten, f"{seen}; {eaten} answers lost"


def slow_database(run):
    """Answers take long, so that many rows of a vehicle wait together."""
    with Cluster(run, servers=2, proxied=True, fleet={
            "vehicles": 3, "max_batch": 60, "window": 40,
            "pause_seconds": 0.0, "answer_seconds": 15.0}) as cluster:
        proxy = cluster.proxy
        proxy.delay = 0.1
        cluster.fleet.start()
        cluster.fleet.wait_for_acks(TAKEOVER_SECONDS)
        before = dict(proxy.executed)
        begun = time.monotonic()
        cluster.fleet.sleep(run.rounds(short=4, long=20))
        statements = proxy.executed["append"] - before["append"]
        seconds = time.monotonic() - begun
        # In the middle of a group of many rows.
        cluster.kill(0)
        cluster.start(0)
        cluster.fleet.wait_for_acks(TAKEOVER_SECONDS)
        proxy.delay = 0.0
        seen = cluster.judge()
    return statements, f"{seen}; {statements} statements in {seconds:.0f} s"


def groups_against_claims(run):
    """Servers are declared dead while they write, so that claims and groups of
    the same vehicles meet in any order."""
    rounds = run.rounds(short=12, long=100)
    with Cluster(run, fleet={
            "vehicles": 12, "readers": 0, "pause_seconds": 0.0,
            # From the memory of such a server; see below.
            "passing": {(grpc.StatusCode.FAILED_PRECONDITION,
                         "SEQUENCE_GAP")}}) as cluster:
        cluster.fleet.start()
        cluster.fleet.wait_for_acks(TAKEOVER_SECONDS)
        for _ in range(rounds):
            address = run.rng.choice(cluster.addresses())
            cluster.database.sql("UPDATE servers SET state = 'dead' WHERE "
                                 f"address = '{address}' AND state = 'live'")
            cluster.fleet.sleep(run.rng.uniform(0.1, 0.6))
        back = cluster.fleet.wait_for_acks(TAKEOVER_SECONDS)
        deadlocks = cluster.database.log().count("deadlock detected")
        # Who is declared dead although it beats answers from memory until its next
        # beat: leases promise nothing about that.
        for vehicle in cluster.fleet.vehicles:
            vehicle.history.reads.clear()
        seen = cluster.judge()
    return rounds, (f"{seen}; {deadlocks} deadlocks, all served {back:.1f} s "
                    "after the last")


def disk_full(run):
    hosts.skip_unless_permitted("a small disk")
    rounds = run.rounds(short=1, long=4)
    with Cluster(run, mount=lambda path: hosts.mount_small_disk(path, 160),
                 settings={"max_wal_size": "32MB", "min_wal_size": "32MB",
                           "wal_keep_size": "0"},
                 fleet={"passing": {(grpc.StatusCode.RESOURCE_EXHAUSTED,
                                     "STORAGE_FULL")},
                        "max_batch": 60, "window": 20,
                        "pause_seconds": 0.0}) as cluster:
        fleet = cluster.fleet
        fleet.start()
        fleet.wait_for_acks(TAKEOVER_SECONDS)
        ballast = cluster.database.data / "ballast"
        for _ in range(rounds):
            with open(ballast, "wb") as file:
                # As much as there is room for, but for a little.
                while (free := cluster.database.free_bytes()) > 512 << 10:
                    file.write(bytes(min(free // 2, 4 << 20)))
                    file.flush()
            acked = wait_for_silence(fleet)
            crashed = not cluster.database.is_running()
            ballast.unlink()
            if crashed:
                cluster.database.start()
            back = fleet.wait_for_acks(TAKEOVER_SECONDS)
        told = fleet.outcomes["RESOURCE_EXHAUSTED STORAGE_FULL"]
        # Where PostgreSQL ends, nobody is left to say why.
        assert told > 0 or crashed, fleet.summary()
        assert fleet.acked() > acked
        seen = cluster.judge()
    return rounds, (f"{seen}; {told} told STORAGE_FULL, PostgreSQL "
                    f"{'ended' if crashed else 'went on'}; all served "
                    f"{back:.1f} s after there is room")


ROWS = [
    ("database: restarts", "17", "back within 5 s, nothing lost",
     restarted),
    ("database: away for longer than the leases", "26",
     "back within 5 s, vehicles stay where they are", away),
    ("database: stopped for longer than the leases", "26",
     "no ack, no stale read, back within 5 s", stopped),
    ("database: failover to a synchronous standby", "18", "nothing lost",
     failover_to_replica),
    ("database: failover to an asynchronous standby", "18",
     "what is lost is told as DATA_LOSS, never passed over",
     failover_that_loses),
    ("database: synchronous standby gone", "18", "no ack until it is back",
     standby_gone),
    ("database: pg_cancel_backend in the wait for the standby", "18",
     "no ack of what is not replicated",
     lambda run: wait_ended_by_operator(run, "pg_cancel_backend")),
    ("database: pg_terminate_backend in the wait for the standby", "18",
     "no ack of what is not replicated",
     lambda run: wait_ended_by_operator(run, "pg_terminate_backend")),
    ("database: answer of a commit lost", "19", "settled before anything goes on",
     answer_eaten),
    ("database: many rows of a vehicle in a group", "20", "all of them, in order",
     slow_database),
    ("database: groups against claims", "21", "one epoch wins, no deadlock stays",
     groups_against_claims),
    ("database: disk full", "8",
     "refused, reads go on, recovers alone", disk_full),
]
