"""What searches have learned from a vehicle's marks is stored: the first search after a
load takes as many comparisons as the second, and answers the same bytes."""

import json
import sqlite3

import grpc
import pytest

from own_postgres import own_shared_store
from revisit_server import Server, wait_until
from stubs import api
from test_belief import DRIVE, create, said
from wire import append, batches

VEHICLE = "vehicles/car"
# Every call is logged, with the comparisons of its search and its marks.
FLAGS = ("--log-format", "json", "--slow-call-seconds", 1e-6)


def searches(server):
    """The comparisons of each call that has searched, the oldest first."""
    lines = map(json.loads, filter(None, server.log().splitlines()))
    return [line["comparisons"] for line in lines
            if line.get("method") == "FindCandidates" and "comparisons" in line]


def search(server, stub, sequence=0):
    """A search at the newest pose: the bytes of its answer, and its comparisons."""
    before = len(searches(server))
    answer = stub.FindCandidates(api.FindCandidatesRequest(
        vehicle=VEHICLE, sequence=sequence)).candidates
    wait_until(lambda: len(searches(server)) > before, "search in the log")
    return (said(answer).SerializeToString(deterministic=True),
            searches(server)[-1])


def drive(stub, poses):
    for batch in batches(poses, 500):
        append(stub, VEHICLE, batch)


def learn(server, stub):
    """Drives and searches; answers what the second search answers, and the
    comparisons of the first."""
    create(stub)
    drive(stub, DRIVE)
    answer, all_of_them = search(server, stub)
    again, few = search(server, stub)
    assert again == answer
    assert all_of_them > 10 * few
    return (answer, few), all_of_them


def restarted(store, *flags):
    return Server(store, *FLAGS, *flags)


def test_the_first_search_after_a_restart_searches_no_marks(tmp_path):
    store = tmp_path / "store"
    with restarted(store) as server:
        known, _ = learn(server, server.stub())
    for _ in range(2):
        with restarted(store) as server:
            assert search(server, server.stub()) == known


def test_what_was_learned_before_a_kill_is_learned_again(tmp_path):
    store = tmp_path / "store"
    with restarted(store) as server:
        (answer, few), all_of_them = learn(server, server.stub())
        server.kill()
    with restarted(store) as server:
        stub = server.stub()
        assert search(server, stub) == (answer, all_of_them)
        assert search(server, stub) == (answer, few)


def test_a_kill_loses_nothing_that_was_learned_before_an_unload(tmp_path):
    store = tmp_path / "store"
    with restarted(store, "--idle-unload-minutes", 0.01, "--admin-listen",
                   "127.0.0.1:0") as server:
        known, _ = learn(server, server.stub())
        wait_until(lambda: stored_marks(store) == 1, "marks in the store")
        server.kill()
    with restarted(store) as server:
        assert search(server, server.stub()) == known


def stored_marks(store):
    database = sqlite3.connect(f"file:{store}/revisit.sqlite?mode=ro", uri=True)
    try:
        return database.execute("SELECT count(*) FROM snapshot_parts WHERE "
                                "number = 0x7fffffff").fetchone()[0]
    finally:
        database.close()


def test_a_snapshot_brings_the_marks_with_it(tmp_path):
    store = tmp_path / "store"
    with restarted(store, "--snapshot-poses", 1000) as server:
        stub = server.stub()
        create(stub)
        drive(stub, DRIVE[:1200])
        search(server, stub, 1200)
        known = search(server, stub, 1200)
        drive(stub, DRIVE[1200:])
        wait_until(lambda: stored_marks(store) == 1, "marks in the store")
        server.kill()
    with restarted(store, "--snapshot-poses", 1000) as server:
        assert search(server, server.stub(), 1200) == known


def test_damaged_marks_are_left_out_with_a_warning(tmp_path):
    store = tmp_path / "store"
    with restarted(store) as server:
        known, all_of_them = learn(server, server.stub())
    database = sqlite3.connect(store / "revisit.sqlite")
    with database:
        database.execute("UPDATE snapshot_parts SET payload = "
                         "substr(payload, 1, length(payload) - 1) || x'00'")
    database.close()
    with restarted(store) as server:
        stub = server.stub()
        assert search(server, stub) == (known[0], all_of_them)
        assert search(server, stub) == known
        server.logged("is loaded without its marks: row of stored marks fails")
    with restarted(store) as server:
        assert search(server, server.stub()) == known


def test_a_vehicle_that_is_created_again_begins_without_marks(tmp_path):
    store = tmp_path / "store"
    with restarted(store) as server:
        known, all_of_them = learn(server, server.stub())
    with restarted(store) as server:
        stub = server.stub()
        stub.DeleteVehicle(api.DeleteVehicleRequest(name=VEHICLE))
        create(stub)
        drive(stub, DRIVE)
        assert search(server, stub) == (known[0], all_of_them)


@pytest.fixture(name="postgres", scope="module")
def shared_store():
    with own_shared_store() as postgres:
        yield postgres


def test_a_vehicle_that_is_handed_over_brings_its_marks(postgres, tmp_path):
    url = postgres.url("revisit")

    def member(name):
        return Server(url, *FLAGS, "--advertise-address", f"{name}:1",
                      log_path=tmp_path / f"{name}.log")

    def search_once_owned(server, stub):
        try:
            return search(server, stub)
        except grpc.RpcError as error:
            assert error.code() == grpc.StatusCode.UNAVAILABLE
            return None

    with member("host-a") as first, member("host-b") as second:
        known, _ = learn(first, first.stub())
        stub = second.stub()
        assert wait_until(lambda: search_once_owned(second, stub),
                          "handover") == known
    with member("host-c") as server:
        assert search(server, server.stub()) == known
