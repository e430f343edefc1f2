"""Candidates that are stored, told once, and never lost, where several servers share a
database: against kill -9 of servers, handovers, and a database that is restarted."""

import contextlib
import os
import pathlib
import random
import shutil
import time

import grpc

from own_postgres import own_shared_store
from revisit_server import START_SECONDS, wait_until, wait_until_none_left
from stubs import api
from three_servers import SERVERS, Cluster, append_up_to, served, vehicle_of
from watching import (Watcher, change_pairs, count_stale, expect_each_check_once,
                      expect_states_follow, list_checks, wait_until_as_searched_now)
from wire import boreas, decode_failure

VEHICLES = [f"vehicles/truck-{number}" for number in range(4)]


def create_storing(cluster, rng, name):
    settings = api.VehicleSettings(checks=api.STORED_CHECKS_STORED)
    served(cluster, rng, lambda stub: stub.CreateVehicle(
        api.CreateVehicleRequest(vehicle_id=name.split("/")[1],
                                 vehicle=api.Vehicle(settings=settings)),
        timeout=10))


def wait_until_paid_in(cluster, rng, name):
    wait_until_none_left(lambda: vehicle_of(cluster, rng, name).check_debt,
                         f"checks of {name}", seconds=2 * START_SECONDS)


def test_second_searches_end_as_searches_find_them_whatever_servers_are_killed(
        tmp_path, request, seed):
    kills = max(6, request.config.getoption("--kills") // 8)
    rng = random.Random(seed)
    poses, _ = boreas()
    names = VEHICLES[:2]
    with own_shared_store() as database, contextlib.ExitStack() as stack:
        cluster = Cluster(database.url("revisit"), tmp_path)
        stack.callback(cluster.close)
        for name in names:
            create_storing(cluster, rng, name)
        watcher = Watcher(cluster.addresses, seed)
        assert watcher.begun.wait(30)
        pairs = {name: [] for name in names}
        for kill in range(kills):
            for name in names:
                append_up_to(cluster, rng, name,
                             poses[:len(poses) * (kill + 1) // kills])
                # An answer that is lost leaves a pair that is not known here.
                served(cluster, rng, lambda stub, name=name: change_pairs(
                    stub, name, rng, pairs[name]))
            time.sleep(rng.choice([0.0, rng.uniform(0.0, 0.3)]))
            number = rng.randrange(SERVERS)
            cluster.kill(number)
            cluster.start(number)
        for name in names:
            append_up_to(cluster, rng, name, poses)

            wait_until_paid_in(cluster, rng, name)
            wait_until_none_left(
                lambda name=name: served(
                    cluster, rng, lambda stub: count_stale(stub, name)),
                f"second searches of {name}", seconds=2 * START_SECONDS)
            again = served(cluster, rng, lambda stub, name=name:
                           wait_until_as_searched_now(stub, name))
            uid = vehicle_of(cluster, rng, name).uid
            last = max(state.event_number for check in served(
                cluster, rng, lambda stub, name=name: list_checks(stub, name))[0]
                for state in check.states)
            wait_until(lambda uid=uid, last=last: watcher.failure or
                       len(watcher.told[uid]) >= last, "all events",
                       seconds=2 * START_SECONDS)
            assert watcher.failure is None, watcher.failure
            served(cluster, rng, lambda stub, name=name, uid=uid:
                   expect_states_follow(stub, name, watcher.told[uid]))
            assert again > 0
            print(f"{name}: {again} checks searched again, {len(pairs[name])} "
                  f"pairs, {last} events")
        watcher.stop()


def test_checks_are_told_once_whatever_servers_are_killed(tmp_path, request, seed):
    kills = max(6, request.config.getoption("--kills") // 8)
    rng = random.Random(seed)
    poses, _ = boreas()
    with own_shared_store() as database, contextlib.ExitStack() as stack:
        cluster = Cluster(database.url("revisit"), tmp_path)
        stack.callback(cluster.close)
        for name in VEHICLES:
            create_storing(cluster, rng, name)
        watchers = [Watcher(cluster.addresses, seed + n) for n in range(3)]
        for watcher in watchers:
            assert watcher.begun.wait(30)
        step = len(poses) // kills + 1
        for kill in range(kills):
            for name in VEHICLES:
                # Asked of any server, so that vehicles move.
                durable = vehicle_of(cluster, rng, name).durable_sequence
                batch = poses[durable:durable + step]
                if batch:
                    served(cluster, rng, lambda stub, name=name, batch=batch:
                           stub.AppendPoses(api.AppendPosesRequest(
                               vehicle=name, poses=batch), timeout=10))
            time.sleep(rng.choice([0.0, rng.uniform(0.0, 0.3)]))
            number = rng.randrange(SERVERS)
            cluster.kill(number)
            if kill == kills // 2:
                database.process.stop()
                database.start()
            cluster.start(number)
        for name in VEHICLES:
            append_up_to(cluster, rng, name, poses)
            wait_until_paid_in(cluster, rng, name)
        total = sum(len(check.states) for check in served(
            cluster, rng, list_checks)[0])
        for watcher in watchers:
            wait_until(lambda w=watcher: w.failure or sum(
                map(len, w.told.values())) >= total, "all events",
                seconds=2 * START_SECONDS)
            watcher.stop()
            assert watcher.failure is None, watcher.failure
        for name in VEHICLES:
            uid = vehicle_of(cluster, rng, name).uid
            for watcher in watchers[1:]:
                assert watcher.told[uid] == watchers[0].told[uid]
            due, kept = served(cluster, rng, lambda stub, name=name, uid=uid:
                               expect_each_check_once(
                                   stub, name, watchers[0].told[uid]))
            assert kept > 100
            print(f"{name}: {due} checks due, {kept} kept")
        print(f"{kills} kills of {SERVERS} servers, {total} events, watchers broken "
              f"off {[w.breaks for w in watchers]} times, events told again "
              f"{[w.repeated for w in watchers]}")


def test_a_cursor_of_a_database_that_lost_its_last_events_is_refused(tmp_path, seed):
    """As after a failover to a standby that lacked the last commits."""
    rng = random.Random(seed)
    poses, _ = boreas()
    name = "vehicles/a"
    with own_shared_store() as database, contextlib.ExitStack() as stack:
        cluster = Cluster(database.url("revisit"), tmp_path)
        stack.callback(cluster.close)
        create_storing(cluster, rng, name)

        def append_to(count):
            while (durable := vehicle_of(cluster, rng, name).durable_sequence) < count:
                served(cluster, rng, lambda stub: stub.AppendPoses(
                    api.AppendPosesRequest(vehicle=name, poses=poses[durable:count]),
                    timeout=20))
            wait_until_paid_in(cluster, rng, name)

        append_to(1500)
        data = pathlib.Path(database.sockets) / "data"
        copy = tmp_path / "standby"
        database.process.stop()
        # The owner of the files is the user of the database.
        shutil.copytree(data, copy)
        database.start()
        append_to(len(poses))
        _, cursor = served(cluster, rng, list_checks)
        known = served(cluster, rng, lambda stub: watched_from(stub, ""))
        assert known is not None
        owner = data.stat()
        database.process.stop()
        shutil.rmtree(data)
        shutil.copytree(copy, data)
        for path in (data, *data.rglob("*")):
            os.chown(path, owner.st_uid, owner.st_gid)
        data.chmod(0o700)
        database.start()
        # What it has lost is sent again, and makes other events than before.
        append_to(len(poses))
        refused = served(cluster, rng, lambda stub: watched_from(stub, cursor))
        assert (refused.code, refused.reason) == (
            grpc.StatusCode.OUT_OF_RANGE, "CURSOR_UNKNOWN")
        checks, cursor = served(cluster, rng, list_checks)
        assert served(cluster, rng, lambda stub: watched_from(stub, cursor)) == cursor
        told = served(cluster, rng, lambda stub: stub.GetCheck(
            api.GetCheckRequest(name=checks[-1].name), timeout=10)).check
        assert told == checks[-1]


def watched_from(stub, cursor):
    """The first cursor of a watch, or why it is refused."""
    call = stub.WatchCandidates(api.WatchCandidatesRequest(cursor=cursor), timeout=10)
    try:
        return next(call).cursor
    except grpc.RpcError as error:
        if error.code() != grpc.StatusCode.OUT_OF_RANGE:
            raise
        return decode_failure(error)
    finally:
        call.cancel()
