"""Loop closures and rejections that were deleted: what was decided, and who undid it
when, for as long as the vehicle is there."""

import sqlite3

import grpc
import pytest

from caller_identities import As, create
from own_postgres import own_postgres
from revisit_server import Server, run
from stubs import api
from wire import (
    LOOP_CLOSURES, PAIR_KINDS, REJECTED_CANDIDATES, append, deletions_page,
    failure_of, get, straight)

pytest_plugins = ("caller_identities",)


@pytest.fixture
def driven(stub, new_vehicle):
    """A vehicle with 100 poses."""
    vehicle = new_vehicle()
    append(stub, vehicle, straight(100))
    return vehicle


def undo(stub, kind, vehicle, query, matched, **content):
    """Decides and undoes it; answers the decision as it was."""
    decided, _ = kind.add(stub, vehicle, query, matched, **content)
    kind.delete(stub, decided.name)
    return decided


def test_what_was_deleted_is_listed_the_last_first(stub, driven):
    assert deletions_page(stub, driven) == ([], "")
    measured = api.LoopClosureMeasurement(
        x_meters=1.5, covariance=api.Covariance(
            form=api.COVARIANCE_FORM_PLANAR_6, values=[1, 0, 0, 1, 0, 1]))
    closure = undo(stub, LOOP_CLOSURES, driven, 91, 11, note="icp", score=0.5,
                   measurement=measured)
    rejection = undo(stub, REJECTED_CANDIDATES, driven, 91, 11, note="a bridge")
    page, token = deletions_page(stub, driven)
    assert token == ""
    assert [one.name for one in page] == [
        f"{driven}/deletedPosePairs/2", f"{driven}/deletedPosePairs/1"]
    assert [one.WhichOneof("pair") for one in page] == [
        "rejected_candidate", "loop_closure"]
    assert page[0].rejected_candidate == rejection
    assert page[1].loop_closure == closure
    for one in page:
        decided = getattr(one, one.WhichOneof("pair")).create_time
        assert one.delete_time.ToNanoseconds() > decided.ToNanoseconds()


def test_a_deletion_that_fails_is_not_listed(stub, driven):
    undo(stub, LOOP_CLOSURES, driven, 91, 11)
    failure = failure_of(
        lambda: LOOP_CLOSURES.delete(stub, f"{driven}/loopClosures/91-11"))
    assert failure.code == grpc.StatusCode.NOT_FOUND
    assert len(deletions_page(stub, driven)[0]) == 1


def test_pages_hold_each_deletion_once(stub, driven):
    for n in range(7):
        undo(stub, PAIR_KINDS[n % 2], driven, 90, 10 + n)
    pages, token = [], ""
    while not pages or token:
        page, token = deletions_page(stub, driven, page_size=3, page_token=token)
        pages.append([one.name.split("/")[-1] for one in page])
        # What is deleted meanwhile comes on no further page.
        undo(stub, LOOP_CLOSURES, driven, 99, 1 + len(pages))
    assert pages == [["7", "6", "5"], ["4", "3", "2"], ["1"]]
    assert len(deletions_page(stub, driven, page_size=100_000)[0]) == 10


def test_the_last_thousand_are_kept(stub, driven):
    for n in range(1002):
        undo(stub, REJECTED_CANDIDATES, driven, 2 + n % 99, 1)
    first, token = deletions_page(stub, driven, page_size=1000)
    assert len(first) == 500
    rest, token = deletions_page(stub, driven, page_size=1000, page_token=token)
    assert (len(rest), token) == (500, "")
    numbers = [int(one.name.split("/")[-1]) for one in [*first, *rest]]
    assert numbers == list(range(1002, 2, -1))


def test_who_may_list_decisions_may_list_what_was_deleted(called_by):
    acme = called_by("acme")
    vehicle = create(acme, "acme-deletions")
    append(acme, vehicle, straight(100))
    decided, _ = LOOP_CLOSURES.add(acme, vehicle, 91, 11)
    LOOP_CLOSURES.delete(called_by("acme-writer"), decided.name)
    [undone], _ = deletions_page(called_by("acme-reader"), vehicle)
    assert (undone.loop_closure.decided_by, undone.deleted_by) == (
        "token:acme", "token:acme-writer")
    failure = failure_of(lambda: deletions_page(called_by("acme-writer"), vehicle))
    assert (failure.code, failure.reason) == (
        grpc.StatusCode.PERMISSION_DENIED, "NOT_GRANTED")


def make_deletions(stub):
    """A vehicle with one of each kind."""
    vehicle = create(stub, "acme-1")
    append(stub, vehicle, straight(100))
    for n, kind in enumerate(PAIR_KINDS):
        undo(stub, kind, vehicle, 91, 11 + n, note="mistaken")
    return vehicle, deletions_page(stub, vehicle)[0]


def as_acme(server, identities):
    return As(server.stub(), identities.key.token("acme"))


def assert_kept(store, identities, expected, *flags, **more):
    with Server(store, *identities.token_flags, *flags, **more) as server:
        page, _ = deletions_page(as_acme(server, identities), "vehicles/acme-1")
        assert page == expected


def test_deletions_last_over_kill_9_revisions_and_retention(identities, tmp_path):
    with Server(tmp_path / "store", *identities.token_flags) as server:
        stub = as_acme(server, identities)
        vehicle, expected = make_deletions(stub)
        assert [one.deleted_by for one in expected] == ["token:acme"] * 2
        stub.RevisePoses(iter([api.RevisePosesRequest(
            vehicle=vehicle, poses=straight(100, spacing=1.1))]))
        stub.UpdateVehicle(api.UpdateVehicleRequest(
            vehicle=api.Vehicle(name=vehicle, settings=api.VehicleSettings(
                node_spacing_meters=2.0, retention=api.Retention(max_passes=1))),
            update_mask={"paths": ["settings.node_spacing_meters",
                                   "settings.retention"]}))
        assert deletions_page(stub, vehicle)[0] == expected
        server.kill()
    assert_kept(tmp_path / "store", identities, expected)


def test_deletions_go_with_their_vehicle(stub, new_vehicle):
    vehicle = new_vehicle()
    append(stub, vehicle, straight(100))
    undo(stub, LOOP_CLOSURES, vehicle, 91, 11)
    stub.DeleteVehicle(api.DeleteVehicleRequest(name=vehicle))
    failure = failure_of(lambda: deletions_page(stub, vehicle))
    assert failure.code == grpc.StatusCode.NOT_FOUND
    stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id=vehicle.split("/")[1]))
    assert deletions_page(stub, vehicle) == ([], "")


def test_a_database_keeps_them_and_copies_do(identities, tmp_path):
    file, back = tmp_path / "store", tmp_path / "back"
    with Server(file, *identities.token_flags) as server:
        stub = as_acme(server, identities)
        vehicle, expected = make_deletions(stub)
    with own_postgres() as postgres:
        if postgres is None:
            pytest.skip("there is no PostgreSQL: tests/run installs it")
        owner, served = postgres.url("revisit_owner"), postgres.url("revisit")
        assert run("revisitd", "migrate", "--store", owner).returncode == 0
        into = run("revisitd", "import", "--store", owner, "--from", file)
        assert into.returncode == 0, into.stderr
        flags = ("--advertise-address", "host-a:1")
        log = {"log_path": tmp_path / "shared.log"}
        with Server(served, *identities.token_flags, *flags, **log) as server:
            stub = as_acme(server, identities)
            assert deletions_page(stub, vehicle)[0] == expected
            undo(stub, LOOP_CLOSURES, vehicle, 95, 15, note="in the database")
            expected = deletions_page(stub, vehicle)[0]
            assert [one.name.split("/")[-1] for one in expected] == ["3", "2", "1"]
        assert_kept(served, identities, expected, *flags, **log)
        verified = run("revisitd", "verify", "--store", served)
        assert verified.returncode == 0, verified.stderr
        assert "deletions 3\n" in verified.stdout
        out = run("revisitd", "import", "--store", back, "--from", owner)
        assert out.returncode == 0, out.stderr
    assert_kept(back, identities, expected)


def test_damage_of_one_is_told_behind_the_sound_ones_and_given_up(tmp_path):
    with Server(tmp_path / "store") as server:
        stub = server.stub()
        vehicle, expected = make_deletions(stub)
    database = sqlite3.connect(tmp_path / "store/revisit.sqlite")
    database.execute("UPDATE deleted_pose_pairs SET payload = 'x' WHERE number = 2")
    database.commit()
    database.close()
    with Server(tmp_path / "store") as server:
        stub = server.stub()
        page, token = deletions_page(stub, vehicle)
        assert page == expected[1:]
        failure = failure_of(lambda: deletions_page(stub, vehicle, page_token=token))
        assert (failure.code, failure.reason) == (
            grpc.StatusCode.DATA_LOSS, "STORE_CORRUPT")
        assert get(stub, vehicle).state == api.VEHICLE_STATE_DAMAGED
        stub.AcceptDataLoss(api.AcceptDataLossRequest(
            name=vehicle, durable_sequence=100))
        assert deletions_page(stub, vehicle) == (expected[1:], "")
        assert get(stub, vehicle).durable_sequence == 100
