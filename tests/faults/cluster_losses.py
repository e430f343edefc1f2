"""A failover to a standby that lacks what was changed last: every kind of change, on
a vehicle of its own, so that nothing else tells of the loss."""

import dataclasses
import time
import typing
from concurrent import futures

import grpc

from cluster import TAKEOVER_SECONDS, Cluster
from cluster_database import Pair
from revisit_server import wait_until
from stubs import api
from wire import (LOOP_CLOSURES, REJECTED_CANDIDATES, append, get, list_poses,
                  straight)


@dataclasses.dataclass(frozen=True)
class Change:
    """`make(stub, vehicle)` makes it, whether it is there already or not; `sql`
    has a row where it is stored; `shown(stub, vehicle)` is whether a server shows
    it. The vehicle is one that `prepare()` made, if it is `prepared`."""

    name: str
    make: typing.Callable
    sql: str
    shown: typing.Callable
    prepared: bool = True

    def is_stored(self, database, vehicle):
        return bool(database.sql(
            self.sql.replace("THIS", f"v.id = '{vehicle.split('/')[1]}'")))

    def vehicles(self):
        """One that is looked at after the loss, and one that is changed again."""
        return [f"vehicles/{self.name}-{use}" for use in ("shown", "again")]


def create(stub, vehicle):
    stub.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id=vehicle.split("/")[1]))


def exists(stub, vehicle):
    try:
        return bool(get(stub, vehicle).name)
    except grpc.RpcError as error:
        if error.code() == grpc.StatusCode.NOT_FOUND:
            return False
        raise


def deletes(delete):
    """What is gone already counts as deleted."""
    def make(stub, vehicle):
        try:
            delete(stub, vehicle)
        except grpc.RpcError as error:
            if error.code() != grpc.StatusCode.NOT_FOUND:
                raise
    return make


def prepare(stub, vehicle):
    create(stub, vehicle)
    append(stub, vehicle, straight(10))
    LOOP_CLOSURES.add(stub, vehicle, 9, 1, "kept")
    REJECTED_CANDIDATES.add(stub, vehicle, 8, 2, "kept")


def update(stub, vehicle, path, **fields):
    stub.UpdateVehicle(api.UpdateVehicleRequest(
        vehicle=api.Vehicle(name=vehicle, **fields),
        update_mask={"paths": [path]}))


def revise(stub, vehicle):
    moved = straight(10)[4:6]
    for pose in moved:
        pose.local.y_meters += 0.5
    stub.RevisePoses(iter([api.RevisePosesRequest(vehicle=vehicle, poses=moved)]))


def changes_of(kind, table):
    """A pair of poses that is added, and one that is deleted."""
    def has(name):
        return lambda stub, vehicle: any(
            pair.name.endswith(f"/{name}") for pair in kind.page(stub, vehicle)[0])

    def row(name):
        return (f"SELECT 1 FROM {table} p JOIN vehicles v ON v.key = p.vehicle_key "
                f"WHERE THIS AND p.id = '{name}'")

    yield Change(f"{kind.field}-added".replace("_", "-"),
                 lambda stub, vehicle: kind.add(stub, vehicle, 7, 3, "lost"),
                 row("lost"), has("lost"))
    yield Change(f"{kind.field}-deleted".replace("_", "-"),
                 deletes(lambda stub, vehicle: kind.delete(
                     stub, f"{vehicle}/{kind.collection}/kept")),
                 f"SELECT 1 WHERE NOT EXISTS ({row('kept')})",
                 lambda stub, vehicle: not has("kept")(stub, vehicle))


_VEHICLE = "SELECT 1 FROM vehicles v WHERE THIS"
CHANGES = [
    Change("poses", lambda stub, vehicle: append(
        stub, vehicle, straight(15)[10:]),
        "SELECT 1 FROM heads h JOIN vehicles v USING (key) WHERE THIS AND "
        "h.durable_sequence = 15",
        lambda stub, vehicle: get(stub, vehicle).durable_sequence == 15),
    *changes_of(LOOP_CLOSURES, "loop_closures"),
    *changes_of(REJECTED_CANDIDATES, "rejected_candidates"),
    Change("name", lambda stub, vehicle: update(
        stub, vehicle, "display_name", display_name="Lost"),
        _VEHICLE + " AND position('Lost'::bytea IN v.payload) > 0",
        lambda stub, vehicle: get(stub, vehicle).display_name == "Lost"),
    Change("settings", lambda stub, vehicle: update(
        stub, vehicle, "settings.gate_probability",
        settings=api.VehicleSettings(gate_probability=0.875)),
        # A double, little endian.
        _VEHICLE + " AND position('\\x000000000000ec3f'::bytea IN v.payload) > 0",
        lambda stub, vehicle:
            get(stub, vehicle).settings.gate_probability == 0.875),
    Change("revision", revise,
           "SELECT 1 FROM revised_batches r JOIN vehicles v ON "
           "v.key = r.vehicle_key WHERE THIS",
           lambda stub, vehicle:
               list_poses(stub, vehicle)[4].local.y_meters == 0.5),
    Change("created", create, _VEHICLE, exists, prepared=False),
    Change("deleted", deletes(lambda stub, vehicle: stub.DeleteVehicle(
        api.DeleteVehicleRequest(name=vehicle))),
        f"SELECT 1 WHERE NOT EXISTS ({_VEHICLE})",
        lambda stub, vehicle: not exists(stub, vehicle)),
]


def failover_that_loses_changes(run):
    """Whoever makes the change again is told OK when it is stored, and not
    before; and what the server shows is soon what is stored."""
    rounds = run.rounds(short=1, long=5)
    refused = 0
    for _ in range(rounds):
        with Pair(run, replicates=False) as pair, Cluster(
                run, servers=1, database=pair.primary, url=pair.url,
                fleet={"vehicles": 0}) as cluster:
            stub = cluster.stub(0)
            for change in CHANGES:
                for vehicle in change.vehicles() if change.prepared else ():
                    prepare(stub, vehicle)
            pair.primary.wait_for_replay(pair.standby)
            pair.standby.stop("fast")
            for change in CHANGES:
                for vehicle in change.vehicles():
                    change.make(stub, vehicle)
                    assert change.is_stored(pair.primary, vehicle), vehicle
                    assert change.shown(stub, vehicle), vehicle
            pair.primary.stop("kill")
            with futures.ThreadPoolExecutor(len(CHANGES)) as callers:
                # From when there is none to ask: what is in memory is no promise.
                again = [callers.submit(make_again, change, stub)
                         for change in CHANGES]
                pair.standby.start()
                pair.standby.promote()
                refused += sum(each.result() for each in again)
            cluster.database = pair.standby
            for change in CHANGES:
                shown, again = change.vehicles()
                assert change.is_stored(pair.standby, again), \
                    f"{again}: told OK, but not stored"
                assert not change.is_stored(pair.standby, shown), shown
                wait_until(lambda: shows(change, stub, shown) is False,
                           f"{shown} as it is stored", TAKEOVER_SECONDS)
            assert not cluster.verify()
    return rounds * len(CHANGES), (
        f"each told OK again once it was stored, after {refused} refusals in all; "
        "shown as it is stored")


def make_again(change, stub):
    """Until it is told OK; answers how often it was refused."""
    _, vehicle = change.vehicles()
    deadline = time.monotonic() + 2 * TAKEOVER_SECONDS
    refused = 0
    while True:
        try:
            change.make(stub, vehicle)
        except grpc.RpcError as error:
            check_passes(error)
            refused += 1
            assert time.monotonic() < deadline, (vehicle, error)
            time.sleep(0.05)
        else:
            return refused


def shows(change, stub, vehicle):
    """None if the server does not say now."""
    try:
        return change.shown(stub, vehicle)
    except grpc.RpcError as error:
        check_passes(error)
        return None


def check_passes(error):
    """A caller tries again, or is told of the loss."""
    assert error.code() in (grpc.StatusCode.UNAVAILABLE,
                            grpc.StatusCode.ABORTED,
                            grpc.StatusCode.DATA_LOSS), error


ROWS = [
    ("database: failover that loses one change of any kind", "18",
     "told OK again only once it is stored, shown as it is stored",
     failover_that_loses_changes),
]
