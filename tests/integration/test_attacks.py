"""Attacks of strangers on revisitd itself, which asks for tokens: what 40
connections of each cost together. Those that gRPC 1.51 cannot be kept from
(headers of a byte each, calls that are reset or stay) are not among them:
SECURITY.md has their figures, and test_edge.py runs all against what stands in
front of strangers."""

import json

import grpc
import pytest

import attacks
from identities import AUDIENCE, ISSUER, TokenKey, bearer, key_set, replace
from raw_http2 import RawConnection
from revisit_server import Server
from stubs import api

CONNECTIONS = 40
BOUNDED = sorted(set(attacks.ATTACKS) - {
    "headers of one byte", "resets", "calls that stay", "reflection streams"})


@pytest.fixture
def key():
    return TokenKey("ES256", "key")


@pytest.fixture
def server(key, tmp_path):
    policy = replace(tmp_path / "policy.json", json.dumps({
        "version": 1,
        "tenants": [{"name": "acme", "vehicle_prefix": "acme-"}],
        "grants": [{"token_subject": "acme", "tenant": "acme",
                    "vehicles": ["*"], "verbs": ["read"]}]}))
    with Server(tmp_path / "store",
                "--token-keys", replace(tmp_path / "keys", key_set(key)),
                "--token-issuer", ISSUER, "--token-audience", AUDIENCE,
                "--policy", policy, "--log-level=warning") as running:
        yield running
        assert running.is_running(), running.log()


@pytest.mark.release_build
@pytest.mark.parametrize("attack", BOUNDED)
def test_attack_of_strangers_is_bounded_and_callers_are_served(
        attack, server, key):
    def ask():
        server.stub().GetServerInfo(
            api.GetServerInfoRequest(), timeout=20, wait_for_ready=True,
            metadata=bearer(key.token("acme")))

    ask()
    with attacks.Watcher(server.pid) as watcher:
        attacks.run(attacks.ATTACKS[attack],
                    lambda **more: RawConnection(server.port, **more),
                    CONNECTIONS)
    print(f"{attack}: {watcher.most[0] / 1e6:.0f} MB")
    assert watcher.most[0] < 256e6
    ask()


def test_refused_calls_start_no_count_anew(server):
    """Each brings 30 MB of headers, none of their frames too much."""
    with attacks.Watcher(server.pid) as watcher:
        with RawConnection(server.port) as connection:
            attacks.long_headers(lambda **_: connection)
    assert watcher.most[0] < 128e6


def test_oldest_of_strangers_makes_room_and_callers_stay(key, tmp_path):
    with Server(tmp_path / "store",
                "--max-unadmitted-connections=10") as server:
        with server.channel() as channel:
            grpc.channel_ready_future(channel).result(timeout=20)
            stub = server.stub()
            stub.GetServerInfo(api.GetServerInfoRequest(), timeout=20)
            with attacks.half_open(server.port, 40):
                for _ in range(20):
                    stub.GetServerInfo(api.GetServerInfoRequest(), timeout=20,
                                       wait_for_ready=True)
            server.logged("max-unadmitted-connections")
