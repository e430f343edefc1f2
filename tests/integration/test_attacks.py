"""Attacks of strangers on revisitd itself, which asks for tokens: what one and 40
connections of each cost, with TLS and without, and that a caller is served beside
them. floods.py measures more of them, more often."""

import contextlib

import grpc
import pytest

import attacks
import floods
from raw_http2 import RawConnection
from revisit_server import Server
from stubs import api

# Bytes as promised: of one connection, and of all.
MB_OF_ONE, MB_OF_ALL = 64, 256
CONNECTIONS = 40
SECONDS = 2.0
# Those that bring most within a record of TLS.
BY_TLS = ["empty headers", "headers of one byte", "indexed calls",
          "indexed resets", "pings"]


@pytest.fixture
def target(tmp_path):
    with contextlib.ExitStack() as stack:
        def make(tls):
            running = floods.Target(tmp_path, tls)
            stack.callback(running.server.close)
            return running
        yield make


@pytest.mark.release_build
@pytest.mark.parametrize("attack, tls, connections, promised", [
    *((attack, False, CONNECTIONS, MB_OF_ALL)
      for attack in sorted(attacks.ATTACKS)),
    *((attack, tls, 1, MB_OF_ONE) for attack in BY_TLS
      for tls in (False, True)),
    *((attack, True, CONNECTIONS, MB_OF_ALL) for attack in BY_TLS)])
def test_flood_of_strangers_is_bounded_and_callers_are_served(
        attack, tls, connections, promised, target):
    running = target(tls)
    run = floods.one_run(running, running.server, attack, connections, SECONDS,
                         tls)
    print(floods.line_of(run))
    assert run["most"] < promised
    # All but what any server of this age keeps is given back.
    assert run["left"] < MB_OF_ONE
    _, during, after = run["calls"]
    for calls in during + after:
        assert None not in calls, "calls of honest callers failed"


def test_refused_calls_start_no_count_anew(target):
    """Each brings 30 MB of headers, none of their frames too much."""
    server = target(tls=False).server
    with attacks.Watcher(server.pid) as watcher:
        with RawConnection(server.port) as connection:
            attacks.long_headers(lambda **_: connection)
    assert watcher.most[0] < MB_OF_ONE * 1e6


def test_oldest_of_strangers_makes_room_and_callers_stay(tmp_path):
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
