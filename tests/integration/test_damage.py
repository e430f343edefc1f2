"""Damaged rows of one vehicle cost that vehicle what is damaged, and nobody
anything else."""

import sqlite3

import grpc
import pytest

import scraped
from drive_client import create
from grouping import add_link, add_member, create_group, get_group, links_of
from own_postgres import own_postgres
from revisit_server import Server, run, wait_until
from stubs import api
from wire import (LOOP_CLOSURES, REJECTED_CANDIDATES, PoseStream, append,
                  as_bytes, batches, failure_of, get, list_poses, straight)

DAMAGED = "vehicles/truck-2"
VEHICLES = ["vehicles/truck-1", DAMAGED, "vehicles/truck-3"]
STORED = 40


def row_of(table, condition=""):
    return (f"UPDATE {table} SET checksum = checksum + 1 WHERE vehicle_key = "
            f"(SELECT key FROM vehicles WHERE id = 'truck-2') {condition}")


# What is damaged, and how many poses come before it: None if nobody can tell.
DAMAGES = {
    "first batch": (row_of("batches", "AND first_sequence = 1"), 0),
    "batch in the middle": (row_of("batches", "AND first_sequence = 21"), 20),
    "last batch": (row_of("batches", "AND first_sequence = 31"), 30),
    "revised batch": (row_of("revised_batches"), 10),
    "loop closure": (row_of("loop_closures"), STORED),
    "rejected candidate": (row_of("rejected_candidates"), STORED),
    "vehicle": ("UPDATE vehicles SET checksum = checksum + 1 "
                "WHERE id = 'truck-2'", None),
}


@pytest.fixture(params=list(DAMAGES.items()), ids=lambda item: item[0])
def damaged(request, tmp_path):
    """(a server over a store with one damaged vehicle, its sound poses)"""
    sql, sound = request.param[1]
    with Server(tmp_path / "store") as server:
        stub = server.stub()
        for vehicle in VEHICLES:
            create(stub, vehicle)
            for part in batches(straight(STORED), 10):
                append(stub, vehicle, part)
            stub.RevisePoses(iter([api.RevisePosesRequest(
                vehicle=vehicle, poses=straight(5, first=12, spacing=1.01))]))
            LOOP_CLOSURES.add(stub, vehicle, 9, 2)
            REJECTED_CANDIDATES.add(stub, vehicle, 39, 2)
    database = sqlite3.connect(tmp_path / "store" / "revisit.sqlite")
    with database:
        assert database.execute(sql).rowcount == 1
    database.close()
    with Server(tmp_path / "store") as server:
        yield server.stub(), sound


def assert_corrupt(failure):
    assert failure.code == grpc.StatusCode.DATA_LOSS, failure
    assert failure.reason == "STORE_CORRUPT"
    assert failure.metadata["vehicle"] == "truck-2"
    assert "truck-2" in failure.message


def listed(stub):
    vehicles = stub.ListVehicles(api.ListVehiclesRequest()).vehicles
    assert [vehicle.name for vehicle in vehicles] == VEHICLES
    assert [vehicle.state for vehicle in (vehicles[0], vehicles[2])] == [
        api.VEHICLE_STATE_ACTIVE] * 2
    assert vehicles[0].durable_sequence == STORED
    return vehicles[1]


def sound_poses(stub):
    """What pages give until one fails, and how that one fails."""
    request = api.ListPosesRequest(parent=DAMAGED, page_size=7)
    poses = []
    while True:
        try:
            page = stub.ListPoses(request)
        except grpc.RpcError:
            return poses, failure_of(lambda: stub.ListPoses(request))
        poses.extend(page.poses)
        assert page.next_page_token, "ended as if nothing were missing"
        request.page_token = page.next_page_token


# One row of one vehicle made ListVehicles fail for everybody.
def test_damage_is_told_and_what_comes_before_it_is_read(damaged):
    stub, sound = damaged
    # Before it is loaded, too, where the list meets it.
    listed(stub)
    vehicle = get(stub, DAMAGED)
    assert vehicle.state == api.VEHICLE_STATE_DAMAGED
    assert vehicle.durable_sequence == (sound or 0)
    assert vehicle.HasField("settings") == (sound is not None)
    assert listed(stub) == vehicle
    poses, failure = sound_poses(stub)
    assert_corrupt(failure)
    assert as_bytes(poses) == as_bytes(
        list_poses(stub, VEHICLES[0])[:sound or 0])

    exported = []
    with pytest.raises(grpc.RpcError):
        for part in stub.ExportPoseGraph(
                api.ExportPoseGraphRequest(vehicle=DAMAGED)):
            exported.append(part)
    assert exported[0].vehicle == vehicle
    assert sum(len(part.nodes) for part in exported) == vehicle.node_count
    assert_corrupt(failure_of(lambda: list(stub.ExportPoseGraph(
        api.ExportPoseGraphRequest(vehicle=DAMAGED)))))

    assert_corrupt(failure_of(lambda: stub.FindCandidates(
        api.FindCandidatesRequest(vehicle=DAMAGED))))
    assert_corrupt(failure_of(lambda: append(
        stub, DAMAGED, straight(1, first=STORED + 1))))
    with PoseStream(stub, DAMAGED, acked_sequence=STORED) as stream:
        assert_corrupt(failure_of(stream.receive))
    # The others are served.
    for other in (VEHICLES[0], VEHICLES[2]):
        assert append(stub, other, straight(1, first=STORED + 1)
                      ).durable_sequence == STORED + 1


def test_damaged_vehicle_can_be_deleted_and_made_again(damaged):
    stub, _ = damaged
    stub.DeleteVehicle(api.DeleteVehicleRequest(name=DAMAGED))
    create(stub, DAMAGED)
    assert get(stub, DAMAGED).state == api.VEHICLE_STATE_ACTIVE
    append(stub, DAMAGED, straight(STORED))
    assert len(list_poses(stub, DAMAGED)) == STORED
    assert listed(stub).state == api.VEHICLE_STATE_ACTIVE


def test_damage_is_accepted_by_giving_up_what_comes_after_it(damaged):
    stub, sound = damaged
    before = get(stub, DAMAGED)

    def accept(durable_sequence):
        return stub.AcceptDataLoss(api.AcceptDataLossRequest(
            name=DAMAGED, durable_sequence=durable_sequence)).vehicle

    if sound is None:
        assert_corrupt(failure_of(lambda: accept(0)))
        return
    assert failure_of(
        lambda: accept(sound + 1)).reason == "DURABLE_SEQUENCE_MISMATCH"
    accepted = accept(sound)
    assert accepted.state == api.VEHICLE_STATE_ACTIVE
    assert accepted.revision > before.revision >= 8
    assert accepted.uid == before.uid
    append(stub, DAMAGED, straight(5, first=sound + 1))
    assert len(list_poses(stub, DAMAGED)) == sound + 5
    stub.FindCandidates(api.FindCandidatesRequest(vehicle=DAMAGED))


class FileStore:
    """A store in a file, that is changed while no server has it."""

    def __init__(self, directory):
        self._directory = directory

    def serve(self, *flags):
        return Server(self._directory, *flags)

    def change(self, sql):
        database = sqlite3.connect(self._directory / "revisit.sqlite")
        with database:
            assert database.execute(sql).rowcount == 1
        database.close()


class SharedStore:
    """A store in a database of PostgreSQL."""

    def __init__(self, database, directory):
        self._database = database
        self._log = directory / "shared.log"
        migrated = run("revisitd", "migrate", "--store",
                       database.url("revisit_owner"))
        assert migrated.returncode == 0, migrated.stderr

    def serve(self, *flags):
        return Server(self._database.url("revisit"), "--advertise-address",
                      "host-a:1", *flags, log_path=self._log)

    def change(self, sql):
        assert self._database.ask(sql) == "UPDATE 1"


@pytest.fixture(params=["file", "shared"])
def store(request, tmp_path):
    if request.param == "file":
        yield FileStore(tmp_path / "store")
        return
    with own_postgres() as database:
        if database is None:
            pytest.skip("there is no PostgreSQL: tests/run installs it")
        yield SharedStore(database, tmp_path)


# It was ACTIVE again in lists once it had left memory, and the alert resolved.
def test_damage_that_was_found_is_known_until_somebody_decides(store):
    flags = ("--admin-listen", "127.0.0.1:0", "--idle-unload-minutes", 0.01)
    damaged_row = row_of("batches", "AND first_sequence = 21")

    def states(server):
        vehicles = server.stub().ListVehicles(api.ListVehiclesRequest()).vehicles
        return [api.VehicleState.Name(vehicle.state).removeprefix(
            "VEHICLE_STATE_").lower() for vehicle in vehicles]

    def counted(server, **expected):
        """Once all vehicles are counted."""
        wait_until(lambda: {
            dict(labels)["state"]: count for labels, count in
            scraped.scrape(server).series("revisit_vehicles").items()} == {
                "active": 0, "data_loss": 0, "damaged": 0, **expected}, "count")

    def unloaded(server):
        wait_until(lambda: scraped.scrape(server).value(
            "revisit_resident_vehicles") == 0, "unloading")

    with store.serve(*flags) as server:
        stub = server.stub()
        for vehicle in VEHICLES:
            create(stub, vehicle)
            for part in batches(straight(STORED), 10):
                append(stub, vehicle, part)
        counted(server, active=3)
    store.change(damaged_row)
    with store.serve(*flags) as server:
        # Nobody has looked yet.
        assert states(server) == ["active"] * 3
        assert get(server.stub(), DAMAGED).state == api.VEHICLE_STATE_DAMAGED
        unloaded(server)
        assert states(server) == ["active", "damaged", "active"]
        counted(server, active=2, damaged=1)
        revision = get(server.stub(), VEHICLES[0]).revision
    # Somebody mends what was damaged, and the server asks all the same.
    store.change(damaged_row.replace("checksum + 1", "checksum - 1"))
    with store.serve(*flags) as server:
        counted(server, active=2, damaged=1)
        assert states(server) == ["active", "damaged", "active"]
        stub = server.stub()
        vehicle = get(stub, DAMAGED)
        assert vehicle.state == api.VEHICLE_STATE_DAMAGED
        # To note the damage was no change of the vehicle.
        assert (vehicle.durable_sequence, vehicle.revision) == (STORED, revision)
        assert_corrupt(failure_of(lambda: append(
            stub, DAMAGED, straight(1, first=STORED + 1))))
        stub.AcceptDataLoss(api.AcceptDataLossRequest(
            name=DAMAGED, durable_sequence=STORED))
        counted(server, active=3)
        assert append(stub, DAMAGED, straight(1, first=STORED + 1)
                      ).durable_sequence == STORED + 1
        unloaded(server)
        assert states(server) == ["active"] * 3
        assert len(list_poses(stub, DAMAGED)) == STORED + 1
        stub.DeleteVehicle(api.DeleteVehicleRequest(name=DAMAGED))
        counted(server, active=2)


def test_loop_closures_of_groups_that_name_lost_poses_are_lost_too(store):
    with store.serve() as server:
        stub = server.stub()
        group = create_group(stub, "g").name
        for vehicle in VEHICLES:
            create(stub, vehicle)
            for part in batches(straight(STORED), 10):
                append(stub, vehicle, part)
            add_member(stub, group, vehicle)
        one, _, three = VEHICLES
        kept = [add_link(stub, group, *poses).loop_closure for poses in (
            ((DAMAGED, 20), (one, STORED)), ((one, 30), (three, 30)))]
        for poses in (((DAMAGED, 21), (one, 1)), ((three, 1), (DAMAGED, STORED))):
            add_link(stub, group, *poses)
    store.change(row_of("batches", "AND first_sequence = 21"))
    with store.serve() as server:
        stub = server.stub()
        assert get(stub, DAMAGED).state == api.VEHICLE_STATE_DAMAGED
        # They stay until somebody decides.
        assert len(links_of(stub, group)) == 4
        revision = get_group(stub, group).revision
        stub.AcceptDataLoss(api.AcceptDataLossRequest(
            name=DAMAGED, durable_sequence=20))
        assert sorted(link.name for link in links_of(stub, group)) == sorted(
            link.name for link in kept)
        assert get_group(stub, group).revision == revision + 1
        failure = failure_of(lambda: add_link(
            stub, group, (DAMAGED, 21), (one, 1)))
        assert failure.reason == "POSE_NOT_FOUND"
