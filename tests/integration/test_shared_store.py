"""The tasks of revisitd with a store in PostgreSQL, and the way into it and back."""

import pytest

from own_postgres import exit_without_postgres, own_postgres
from revisit_server import Server, run
from stubs import api
from wire import append, get, list_poses, straight

USAGE, STORE_IN_USE = 64, 73


@pytest.fixture
def database():
    """A PostgreSQL of a test's own, with an empty database."""
    exit_without_postgres()
    with own_postgres() as postgres:
        yield postgres


@pytest.fixture
def owner(database):
    return database.url("revisit_owner")


def serve(url, tmp_path, *flags):
    return Server(url, "--advertise-address", "host-a:1", *flags,
                  log_path=tmp_path / "shared.log")


def assert_refused(result, code, *words):
    assert result.returncode == code, result.stderr + result.stdout
    for word in words:
        assert word in result.stderr


def test_a_database_without_tables_is_refused_until_it_is_migrated(
        database, owner, tmp_path):
    served = database.url("revisit")
    assert_refused(run("revisitd", "--store", served), STORE_IN_USE,
                   "revisitd migrate")
    assert_refused(run("revisitd", "migrate", "--store", served), STORE_IN_USE,
                   "permission denied")
    first = run("revisitd", "migrate", "--store", owner)
    assert (first.returncode, first.stdout) == (
        0, "version before 0\nversion after 7\n"), first.stderr
    again = run("revisitd", "migrate", "--store", owner)
    assert again.stdout == "version before 7\nversion after 7\n"
    with serve(served, tmp_path) as server:
        stub = server.stub()
        stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id="truck"))
        assert append(stub, "vehicles/truck", straight(3)).durable_sequence == 3
    verified = run("revisitd", "verify", "--store", served)
    assert verified.returncode == 0, verified.stderr
    assert "poses 3\n" in verified.stdout and verified.stdout.endswith("sound\n")


def test_rows_of_a_large_message_stay_in_their_pages(database, owner, tmp_path):
    assert run("revisitd", "migrate", "--store", owner).returncode == 0
    with serve(database.url("revisit"), tmp_path) as server:
        stub = server.stub()
        for name, poses in (("truck", 4000), ("car", 10)):
            stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id=name))
            append(stub, f"vehicles/{name}", straight(poses))
        assert len(list_poses(stub, "vehicles/truck")) == 4000
        assert get(stub, "vehicles/truck").durable_sequence == 4000
    with serve(database.url("revisit"), tmp_path) as server:
        assert get(server.stub(), "vehicles/truck").durable_sequence == 4000
    rows = database.ask(
        "SELECT count(*), sum(count), max(length(payload)) <= 7900, "
        "pg_relation_size((SELECT reltoastrelid FROM pg_class "
        "WHERE relname = 'batches')) FROM batches")
    count, poses, are_small, moved_out = rows.split("|")
    assert int(count) > 20
    assert (poses, are_small, moved_out) == ("4010", "t", "0")


def test_tasks_that_are_for_the_other_kind_of_store_say_what_to_do(owner, tmp_path):
    assert_refused(run("revisitd", "backup", "--store", owner, "--to",
                       tmp_path / "copy"), USAGE, "pg_basebackup")
    assert_refused(run("revisitd", "compact", "--store", owner), USAGE, "VACUUM")
    assert_refused(run("revisitd", "migrate", "--store", tmp_path), USAGE,
                   "brought up to date when it is opened")


def test_commits_that_no_standby_has_can_be_refused(owner):
    assert run("revisitd", "migrate", "--store", owner).returncode == 0
    assert_refused(run("revisitd", "--store", owner, "--require-replicated", "on"),
                   STORE_IN_USE, "require-replicated", "synchronous_standby_names=''")


def test_a_store_comes_into_a_database_and_back(database, owner, tmp_path):
    file, back = tmp_path / "store", tmp_path / "back"
    with Server(file) as server:
        stub = server.stub()
        stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id="truck"))
        append(stub, "vehicles/truck", straight(100))
        sent = list_poses(stub, "vehicles/truck")
        # Nothing may be written while it is copied.
        assert_refused(run("revisitd", "import", "--store", owner, "--from", file),
                       STORE_IN_USE)
    assert_refused(run("revisitd", "import", "--store", owner, "--from", file),
                   STORE_IN_USE, "revisitd migrate")
    assert run("revisitd", "migrate", "--store", owner).returncode == 0
    into = run("revisitd", "import", "--store", owner, "--from", file)
    assert into.returncode == 0, into.stderr
    assert "vehicles 1\nposes 100\n" in into.stdout
    assert_refused(run("revisitd", "import", "--store", owner, "--from", file),
                   STORE_IN_USE, "is not empty")
    with serve(database.url("revisit"), tmp_path) as server:
        stub = server.stub()
        assert list_poses(stub, "vehicles/truck") == sent
        assert get(stub, "vehicles/truck").durable_sequence == 100
        append(stub, "vehicles/truck", straight(10, first=101))
        assert_refused(run("revisitd", "import", "--store", back, "--from", owner),
                       STORE_IN_USE, "is in use by the server")
    out = run("revisitd", "import", "--store", back, "--from", owner)
    assert out.returncode == 0, out.stderr
    with Server(back) as server:
        stub = server.stub()
        assert list_poses(stub, "vehicles/truck")[:100] == sent
        assert get(stub, "vehicles/truck").durable_sequence == 110
