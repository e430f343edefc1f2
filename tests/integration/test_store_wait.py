"""revisitd waits for a PostgreSQL that starts, recovers or ends its session, up to
--store-wait-seconds, and then ends as it always did."""

import signal
import time

import pytest

from own_postgres import own_postgres, own_shared_store
from postgres_proxy import PostgresProxy
from revisit_server import Server, run, wait_until
from stubs import api
from wire import append, straight

STORE_FAILED = 74
WAITING = "waiting for the store"
# More than what a busy machine needs; the tests that reach it have failed.
PATIENCE = ("--store-wait-seconds", "120")


@pytest.fixture(scope="module")
def migrated():
    """A PostgreSQL of this file's own, with a store in it."""
    with own_shared_store() as postgres:
        yield postgres


@pytest.fixture
def standby():
    """A PostgreSQL of a test's own that can become one that takes no writes."""
    with own_shared_store() as postgres:
        yield postgres


def begin(url, tmp_path, *flags):
    """A server that may not listen yet."""
    return Server(url, "--advertise-address", "host-a:1", *flags, wait=False,
                  log_path=tmp_path / "server.log")


def assert_serves(server):
    stub = server.stub()
    name = stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id="truck")).vehicle.name
    append(stub, name, straight(3))
    stub.DeleteVehicle(api.DeleteVehicleRequest(name=name))


@pytest.mark.parametrize("hot_standby", ["off", "on"])
def test_a_database_in_recovery_is_awaited_until_it_takes_writes(
        hot_standby, standby, tmp_path):
    standby.stand_by(f"hot_standby={hot_standby}")
    with begin(standby.url("revisit"), tmp_path, *PATIENCE) as server:
        said = server.logged(WAITING)
        assert "cannot connect to postgresql" in said[0]
        assert server.is_running() and server.port is None
        standby.promote()
        server.wait_until_listening()
        assert_serves(server)


def test_a_database_that_is_not_there_is_awaited(standby, tmp_path):
    standby.process.stop()
    with begin(standby.url("revisit"), tmp_path, *PATIENCE) as server:
        server.logged(WAITING)
        standby.start()
        server.wait_until_listening()
        assert_serves(server)


def test_a_database_that_starts_is_awaited(migrated, tmp_path):
    with PostgresProxy(migrated.sockets, refusals=3) as proxy, \
            begin(migrated.url("revisit", proxy.sockets), tmp_path,
                  *PATIENCE) as server:
        server.wait_until_listening()
        assert proxy.refused == 3
        # The same reason is told once.
        assert len(server.logged("the database system is starting up")) == 1
        assert_serves(server)


def statements_of_a_start(migrated, tmp_path):
    with PostgresProxy(migrated.sockets) as proxy:
        with begin(migrated.url("revisit", proxy.sockets), tmp_path,
                   *PATIENCE) as server:
            server.wait_until_listening()
            return proxy.statements


@pytest.mark.parametrize("too_late", [False, True],
                         ids=["told with 57P01", "after the statement, untold"])
def test_a_session_that_is_ended_at_any_statement_of_a_start_is_begun_again(
        too_late, migrated, tmp_path):
    count = statements_of_a_start(migrated, tmp_path)
    assert count >= 8
    for number in range(1, count + 1):
        with PostgresProxy(migrated.sockets, end_at=number,
                           too_late=too_late) as proxy:
            with begin(migrated.url("revisit", proxy.sockets), tmp_path,
                       *PATIENCE) as server:
                server.wait_until_listening()
                wait_until(lambda: proxy.ended == 1, f"statement {number}")
                assert_serves(server)




TASKS = {
    "migrate": ("revisit_owner", ("migrate",)),
    "verify": ("revisit", ("verify",)),
}


@pytest.mark.parametrize("task", TASKS)
def test_a_session_that_is_ended_at_any_statement_of_a_task_is_begun_again(
        task, migrated):
    role, words = TASKS[task]
    number, count = 0, 1
    while number < count:
        number += 1
        with PostgresProxy(migrated.sockets, end_at=number) as proxy:
            done = run("revisitd", *words, "--store",
                       migrated.url(role, proxy.sockets), *PATIENCE)
            assert done.returncode == 0, (number, done.stderr)
            assert proxy.ended == 1
            assert WAITING in done.stderr
            if number == 1:
                # The first statement of the first session came once more.
                count = proxy.statements - 1


def test_an_import_waits_for_both_stores(migrated, tmp_path):
    url = migrated.url("revisit_owner")
    with Server(migrated.url("revisit"), "--advertise-address", "host-a:1",
                log_path=tmp_path / "log") as server:
        stub = server.stub()
        stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id="car"))
        append(stub, "vehicles/car", straight(20))
    # Servers that other tests cut off at their start count as alive for a while.
    migrated.ask("UPDATE servers SET state = 'dead'")
    for number in (1, 3, 5):
        with PostgresProxy(migrated.sockets, end_at=number) as proxy:
            done = run("revisitd", "import", "--store", tmp_path / f"to-{number}",
                       "--from", migrated.url("revisit_owner", proxy.sockets),
                       *PATIENCE)
            assert done.returncode == 0, done.stderr
            assert proxy.ended == 1 and "poses 20\n" in done.stdout
    refused = run("revisitd", "import", "--store", url, "--from", tmp_path / "to-1",
                  *PATIENCE)
    assert "is not empty" in refused.stderr and WAITING not in refused.stderr


def test_a_verify_that_loses_the_database_finds_no_damage(migrated, tmp_path):
    """It said of a vehicle that could not be read that it is damaged."""
    with Server(migrated.url("revisit"), "--advertise-address", "host-a:1",
                log_path=tmp_path / "log") as server:
        stub = server.stub()
        stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id="bus"))
        append(stub, "vehicles/bus", straight(20))
    url = migrated.url("revisit")
    with PostgresProxy(migrated.sockets) as proxy:
        sound = run("revisitd", "verify", "--store",
                    migrated.url("revisit", proxy.sockets))
        assert sound.returncode == 0, sound.stderr
        count = proxy.statements
    for number in range(1, count + 1):
        with PostgresProxy(migrated.sockets, end_at=number) as proxy:
            lost = run("revisitd", "verify", "--store",
                       migrated.url("revisit", proxy.sockets),
                       "--store-wait-seconds", "0")
        assert "damage" not in lost.stdout + lost.stderr, (number, lost.stdout)
        assert lost.returncode in (0, STORE_FAILED), (number, lost.stderr)
    assert run("revisitd", "verify", "--store", url).stdout == sound.stdout


@pytest.mark.parametrize("words", [(), ("migrate",), ("verify",)], ids=str)
def test_after_the_wait_it_ends_as_without_one(words, tmp_path):
    url = f"postgresql:///revisit?host={tmp_path}"
    results = []
    for seconds in (0, 1):
        started = time.monotonic()
        results.append(run("revisitd", *words, "--store", url,
                           *(() if words else ("--advertise-address", "a:1")),
                           "--store-wait-seconds", str(seconds)))
        assert time.monotonic() - started >= seconds
    at_once, later = results
    assert at_once.returncode == later.returncode == STORE_FAILED
    assert at_once.stderr.startswith("revisitd: cannot connect to postgresql")
    assert WAITING not in at_once.stderr
    *waiting, last = later.stderr.splitlines()
    assert last + "\n" == at_once.stderr
    assert len(waiting) == 1 and WAITING in waiting[0]


def test_what_does_not_pass_by_itself_is_not_awaited(migrated, tmp_path):
    with own_postgres() as empty:
        for words in ((), ("verify",)):
            found = run("revisitd", *words, "--store", empty.url("revisit"),
                        *(() if words else ("--advertise-address", "a:1")), *PATIENCE)
            assert found.returncode == 73 and WAITING not in found.stderr
            assert "revisitd migrate" in found.stderr


def test_a_start_that_waits_can_be_stopped(tmp_path):
    with begin(f"postgresql:///revisit?host={tmp_path}", tmp_path,
               *PATIENCE) as server:
        server.logged(WAITING)
        server.process.send_signal(signal.SIGTERM)
        assert server.process.wait(30) == 0
