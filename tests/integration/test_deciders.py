"""Who made a loop closure or a rejection: told as the server knows its callers,
whatever is sent, and for as long as the decision lasts."""

import pytest

from caller_identities import As, create, secure_stub
from own_postgres import own_postgres
from revisit_server import Server, run
from stubs import api
from wire import PAIR_KINDS, append, straight

pytest_plugins = ("caller_identities",)


def decided(stub, vehicle):
    """(name, decider) of all decisions about a vehicle."""
    return [(pair.name, pair.decided_by) for kind in PAIR_KINDS
            for pair in kind.page(stub, vehicle)[0]]


def decide(stub, vehicle, decider, query=91):
    """One of each kind, which claims that another one decided."""
    names = []
    for n, kind in enumerate(PAIR_KINDS):
        pair, _ = kind.add(stub, vehicle, query, 11 + n,
                           decided_by="token:somebody-else", note="seen")
        assert pair.decided_by == decider
        names.append(pair.name)
    return names


def test_the_callers_of_tokens_are_told_and_repetitions_leave_the_first(called_by):
    acme, other = called_by("acme"), called_by("vehicle:7")
    vehicle = create(acme, "acme-7")
    append(acme, vehicle, straight(100))
    names = decide(acme, vehicle, "token:acme")
    for n, kind in enumerate(PAIR_KINDS):
        again, _ = kind.add(other, vehicle, 91, 11 + n, note="seen")
        assert again.decided_by == "token:acme"
    others = decide(other, vehicle, "token:vehicle:7", query=95)
    assert decided(called_by("acme-reader"), vehicle) == [
        (names[0], "token:acme"), (others[0], "token:vehicle:7"),
        (names[1], "token:acme"), (others[1], "token:vehicle:7")]


def test_the_callers_of_certificates_are_told(tls_server, identities):
    bus = "spiffe://fleet.example/acme/9"
    shown = identities.authority.issue(bus, "bus-9.example")
    with secure_stub(tls_server, identities.authority.pem, shown) as stub:
        vehicle = create(stub, "acme-9")
        append(stub, vehicle, straight(100))
        decide(stub, vehicle, f"certificate:{bus}")


def test_nobody_is_told_where_nobody_is_asked(stub, new_vehicle):
    vehicle = new_vehicle()
    append(stub, vehicle, straight(100))
    decide(stub, vehicle, "")


def assert_kept(store, identities, expected, *flags, **more):
    """Of what the store holds, whoever is asked knows who decided."""
    with Server(store, *identities.token_flags, *flags, **more) as server:
        stub = As(server.stub(), identities.key.token("acme"))
        assert decided(stub, "vehicles/acme-1") == expected


def test_deciders_last_over_kill_9_revisions_and_copies(identities, tmp_path):
    file, back = tmp_path / "store", tmp_path / "back"
    with Server(file, *identities.token_flags) as server:
        stub = As(server.stub(), identities.key.token("acme"))
        vehicle = create(stub, "acme-1")
        append(stub, vehicle, straight(100))
        expected = [(name, "token:acme")
                    for name in decide(stub, vehicle, "token:acme")]
        stub.RevisePoses(iter([api.RevisePosesRequest(
            vehicle=vehicle, poses=straight(100, spacing=1.1))]))
        assert decided(stub, vehicle) == expected
        server.kill()
    assert_kept(file, identities, expected)
    with own_postgres() as postgres:
        if postgres is None:
            pytest.skip("there is no PostgreSQL: tests/run installs it")
        owner, served = postgres.url("revisit_owner"), postgres.url("revisit")
        assert run("revisitd", "migrate", "--store", owner).returncode == 0
        into = run("revisitd", "import", "--store", owner, "--from", file)
        assert into.returncode == 0, into.stderr
        assert_kept(served, identities, expected, "--advertise-address", "host-a:1",
                    log_path=tmp_path / "shared.log")
        out = run("revisitd", "import", "--store", back, "--from", owner)
        assert out.returncode == 0, out.stderr
    assert_kept(back, identities, expected)


def test_deciders_are_stored_in_a_database_itself(identities, tmp_path):
    with own_postgres() as postgres:
        if postgres is None:
            pytest.skip("there is no PostgreSQL: tests/run installs it")
        owner, served = postgres.url("revisit_owner"), postgres.url("revisit")
        assert run("revisitd", "migrate", "--store", owner).returncode == 0
        flags = ("--advertise-address", "host-a:1")
        log = {"log_path": tmp_path / "shared.log"}
        with Server(served, *identities.token_flags, *flags, **log) as server:
            stub = As(server.stub(), identities.key.token("acme"))
            vehicle = create(stub, "acme-1")
            append(stub, vehicle, straight(100))
            expected = [(name, "token:acme")
                        for name in decide(stub, vehicle, "token:acme")]
        assert_kept(served, identities, expected, *flags, **log)


def test_the_command_line_lists_who_decided(identities, token_server, called_by,
                                            tmp_path):
    acme = called_by("acme")
    vehicle = create(acme, "acme-listed")
    append(acme, vehicle, straight(100))
    decide(acme, vehicle, "token:acme")
    token = tmp_path / "token"
    token.write_text(identities.key.token("acme-reader"))
    for group in ("closures", "rejections"):
        listed = run("revisit", "--server", token_server.address, "--token-file", token,
                     group, "list", "acme-listed")
        assert listed.returncode == 0, listed.stderr
        head, row = listed.stdout.splitlines()
        assert head.split()[-2:] == ["DECIDED_BY", "NOTE"]
        assert row.split()[-2:] == ["token:acme", "seen"]
