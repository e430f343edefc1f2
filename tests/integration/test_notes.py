"""Notes on loop closures and rejected candidates: what is taken, and how it lasts."""

import grpc
import pytest

from own_postgres import own_postgres
from revisit_server import Server, run
from stubs import api
from wire import (PAIR_KINDS, REJECTED_CANDIDATES, append, failure_of, get,
                  straight)

GOOD_NOTES = {
    "of many lines": "a bridge\n\tabove the road, caf\u00e9",
    "as long as it may be": "\u00e9" * 512,
    "of many scripts": "\u0645\u06cc\u200c\u062e\u0648\u0627\u0647\u0645 "
                       "\u0915\u094d\u200d\u0937 "
                       "\u200f\u05e9\u05dc\u05d5\u05dd\u200e "
                       "\U0001f469\u200d\U0001f527",
    "that turns around": "\u202egpj.exe\u2066\u200b\ufeff",
}
BAD_NOTES = {
    "too long": "a" * 1025,
    "too long in bytes": "\u00e9" * 513,
    "with colours": "\x1b[31mred",
    "with a carriage return": "a\rb",
    "with a C1 control character": "a\u0085b",
}


@pytest.fixture
def driven(stub, new_vehicle):
    """A vehicle with 100 poses."""
    vehicle = new_vehicle()
    append(stub, vehicle, straight(100))
    return vehicle


@pytest.mark.parametrize("kind", PAIR_KINDS, ids=str)
@pytest.mark.parametrize("name", GOOD_NOTES)
def test_note_is_answered_and_listed_as_it_was_sent(name, kind, stub, driven):
    note = GOOD_NOTES[name]
    added, _ = kind.add(stub, driven, 91, 11, note=note)
    assert added.note == note
    plain, _ = kind.add(stub, driven, 92, 11)
    assert plain.note == ""
    assert kind.page(stub, driven) == ([added, plain], "")


@pytest.mark.parametrize("kind", PAIR_KINDS, ids=str)
@pytest.mark.parametrize("name", BAD_NOTES)
def test_bad_note_is_refused_and_changes_nothing(name, kind, stub, driven):
    before = get(stub, driven)
    failure = failure_of(
        lambda: kind.add(stub, driven, 91, 11, note=BAD_NOTES[name]))
    assert (failure.code, failure.reason) == (
        grpc.StatusCode.INVALID_ARGUMENT, "INVALID_FIELD")
    assert failure.fields == [f"{kind.field}.note"]
    assert failure.message.isascii() and failure.message.isprintable()
    assert get(stub, driven) == before
    assert kind.page(stub, driven) == ([], "")


@pytest.mark.parametrize("kind", PAIR_KINDS, ids=str)
def test_another_note_is_no_repetition(kind, stub, driven):
    first = kind.add(stub, driven, 91, 11, note="one")
    assert kind.add(stub, driven, 91, 11, note="one") == first
    for other in ("two", ""):
        failure = failure_of(
            lambda other=other: kind.add(stub, driven, 91, 11, note=other))
        assert failure.code == grpc.StatusCode.ALREADY_EXISTS
        assert failure.reason == f"{kind.reason}_EXISTS"
        assert "note" in failure.message
        assert "delete it first" in failure.message
    assert get(stub, driven).revision == first[1]
    # Under another id it is another finding about the same poses.
    kind.add(stub, driven, 91, 11, "second", note="two")
    assert [pair.note for pair in kind.page(stub, driven)[0]] == ["one", "two"]


def test_rejection_is_not_said_to_have_a_measurement(stub, driven):
    REJECTED_CANDIDATES.add(stub, driven, 91, 11, note="one")
    failure = failure_of(
        lambda: REJECTED_CANDIDATES.add(stub, driven, 91, 11, note="two"))
    assert failure.message == (
        "rejected candidate '91-11' has another note; to replace it, delete it "
        "first")


def notes_of(stub, vehicle):
    return [[(pair.name, pair.note) for pair in kind.page(stub, vehicle)[0]]
            for kind in PAIR_KINDS]


def make_findings(stub):
    """A vehicle with findings of both kinds, with and without notes."""
    vehicle = stub.CreateVehicle(
        api.CreateVehicleRequest(vehicle_id="a")).vehicle.name
    append(stub, vehicle, straight(100))
    for n, kind in enumerate(PAIR_KINDS):
        kind.add(stub, vehicle, 91, 11 + n, note=f"seen by {kind}\nat noon")
        kind.add(stub, vehicle, 92, 11 + n)
    return vehicle


def assert_sound(store):
    verified = run("revisitd", "verify", "--store", store)
    assert verified.returncode == 0, verified.stderr
    assert verified.stdout.endswith("sound\n")


def test_notes_survive_kill_9_and_backup(tmp_path):
    store, backup = tmp_path / "store", tmp_path / "backup"
    backup.mkdir()
    with Server(store) as server:
        vehicle = make_findings(server.stub())
        before = notes_of(server.stub(), vehicle)
        server.kill()
    with Server(store) as server:
        assert notes_of(server.stub(), vehicle) == before
        result = run("revisitd", "backup", "--store", store,
                     "--to", backup / "revisit.sqlite")
        assert result.returncode == 0, result.stderr
    with Server(backup) as server:
        assert notes_of(server.stub(), vehicle) == before
    assert_sound(store)
    assert_sound(backup)


def test_notes_come_into_a_database_and_back(tmp_path):
    file, back = tmp_path / "store", tmp_path / "back"
    with own_postgres() as postgres:
        if postgres is None:
            pytest.skip("there is no PostgreSQL: tests/run installs it")
        with Server(file) as server:
            vehicle = make_findings(server.stub())
            before = notes_of(server.stub(), vehicle)
        owner, served = postgres.url("revisit_owner"), postgres.url("revisit")
        assert run("revisitd", "migrate", "--store", owner).returncode == 0
        into = run("revisitd", "import", "--store", owner, "--from", file)
        assert into.returncode == 0, into.stderr
        # One more is written to the database itself, and read after a restart.
        for n in range(2):
            with Server(served, "--advertise-address", "host-a:1",
                        log_path=tmp_path / f"shared-{n}.log") as server:
                stub = server.stub()
                added, _ = REJECTED_CANDIDATES.add(stub, vehicle, 99, 1,
                                                   note="tunnel")
                assert notes_of(stub, vehicle) == [
                    before[0], [*before[1], (added.name, "tunnel")]]
        assert_sound(served)
        out = run("revisitd", "import", "--store", back, "--from", owner)
        assert out.returncode == 0, out.stderr
    with Server(back) as server:
        assert notes_of(server.stub(), vehicle) == [
            before[0], [*before[1], (added.name, "tunnel")]]
    assert_sound(back)
