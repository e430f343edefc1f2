"""revisit health: the probe of a container."""

import json
import signal

import pytest

from revisit_server import Server, run

NOT_FOUND = 64 + 5
UNAVAILABLE = 64 + 14


def health(server, *flags):
    return run("revisit", "--server", server.address, "health", *flags)


@pytest.mark.parametrize("service", ["", "revisit.v1.PoseGraphService",
                                     "revisit.v1.PoseGraphService/write"])
def test_probe_succeeds_while_the_service_serves(service, server):
    shown = health(server, "--service", service)
    assert (shown.returncode, shown.stdout) == (0, "SERVING\n"), shown.stderr


def test_probe_answers_as_json(server):
    assert json.loads(health(server, "--json").stdout) == {"status": "SERVING"}


def test_probe_fails_for_a_service_that_there_is_not(server):
    assert health(server, "--service", "nobody").returncode == NOT_FOUND


@pytest.mark.parametrize("seconds", ["0", "-1"])
def test_probe_needs_time(seconds, server):
    assert health(server, "--timeout", seconds).returncode == 64


def test_probe_fails_while_the_server_gives_notice_and_once_it_is_gone(tmp_path):
    with Server(tmp_path / "store", "--drain-notice-seconds", 600) as server:
        assert health(server).returncode == 0
        server.process.send_signal(signal.SIGTERM)
        server.logged("notice_of_drain")
        refused = health(server)
        assert refused.returncode == UNAVAILABLE
        assert "is not serving" in refused.stderr
        server.process.send_signal(signal.SIGTERM)
        assert server.process.wait(30) == 0
        assert health(server).returncode == UNAVAILABLE


def test_probe_does_not_wait_for_ever(tmp_path):
    with Server(tmp_path / "store") as server:
        assert health(server).returncode == 0
        server.process.send_signal(signal.SIGSTOP)
        try:
            late = health(server, "--timeout", "0.5")
        finally:
            server.process.send_signal(signal.SIGCONT)
        assert late.returncode == 64 + 4
