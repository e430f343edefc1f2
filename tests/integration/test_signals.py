"""Signals: which ones end the server, and which ones do not. What SIGHUP does
is in test_identity.py."""

import signal

import pytest

from revisit_server import Server
from stubs import api


def info(stub):
    return stub.GetServerInfo(api.GetServerInfoRequest(), timeout=30)


@pytest.mark.parametrize("number", [signal.SIGHUP, signal.SIGUSR1,
                                    signal.SIGUSR2, signal.SIGPIPE],
                         ids=lambda number: number.name)
def test_signal_that_asks_for_no_end_brings_none(number, tmp_path):
    with Server(tmp_path / "store") as server:
        stub = server.stub()
        for _ in range(3):
            server.process.send_signal(number)
            info(stub)
        server.process.send_signal(signal.SIGTERM)
        assert server.process.wait(30) == 0, server.log()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT],
                         ids=lambda number: number.name)
def test_signal_that_asks_for_the_end_drains(number, tmp_path):
    with Server(tmp_path / "store") as server:
        info(server.stub())
        server.process.send_signal(number)
        assert server.process.wait(30) == 0, server.log()
        assert " stopped " in server.log()
