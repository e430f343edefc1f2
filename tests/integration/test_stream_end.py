"""Streams of the command line that end early: what is durable is told, and the
same command goes on behind it."""

import json
import re
import signal
import subprocess
import time

import pytest

from revisit_server import (BIN, RUN_SECONDS, Server, clean_environment, run,
                            wait_until)
from wire import get

POSES = 200_000


@pytest.fixture(scope="module")
def drive(tmp_path_factory):
    """A drive that takes a while to be streamed pose by pose."""
    path = tmp_path_factory.mktemp("drive") / "drive.csv"
    with open(path, "w") as file:
        file.write("t_s,est_x,est_y,est_yaw\n")
        file.writelines(f"{i},{i * 0.5},0,0\n" for i in range(POSES))
    return path


@pytest.fixture
def server(tmp_path):
    """A server that a test may freeze."""
    with Server(tmp_path / "store") as running:
        yield running
        running.process.send_signal(signal.SIGCONT)


class Stream:
    """`revisit stream` of a drive, which has begun to become durable."""

    def __init__(self, server, drive, *flags):
        self.stub = server.stub()
        self.process = subprocess.Popen(
            [BIN / "revisit", "stream", drive, "--vehicle", "ends", "--create",
             "--batch", "1", "--server", server.address, *flags],
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
            env=clean_environment())
        wait_until(self.has_begun, "durable pose")

    def has_begun(self):
        try:
            return self.durable() > 0
        except Exception:
            # The vehicle is not created yet.
            return False

    def durable(self):
        return get(self.stub, "vehicles/ends").durable_sequence

    def end(self):
        """Exit code, and what was printed."""
        out, errors = self.process.communicate(timeout=RUN_SECONDS)
        return self.process.returncode, out, errors


def told(errors):
    """The durable sequence that the last line tells."""
    last = errors.strip().splitlines()[-1]
    found = re.match(r"poses 1 to (\d+) of vehicles/ends are durable; the same "
                     r"command again goes on behind them", last)
    assert found, errors
    return int(found[1])


@pytest.mark.parametrize("stop", [signal.SIGINT, signal.SIGTERM],
                         ids=["interrupt", "terminate"])
def test_interrupted_stream_says_what_is_durable_and_goes_on(
        stop, server, drive):
    stream = Stream(server, drive)
    stream.process.send_signal(stop)
    code, out, errors = stream.end()
    assert (code, out) == (130, ""), errors
    assert "revisit: interrupted\n" in errors
    # On a busy machine more may be on its way than is waited for.
    durable = stream.durable()
    assert 0 < told(errors) <= durable
    again = run("revisit", "stream", drive, "--vehicle", "ends", "--json",
                "--server", server.address)
    assert again.returncode == 0, again.stderr
    summary = json.loads(again.stdout)
    assert summary["alreadyDurable"] == durable
    assert summary["durableSequence"] == POSES


def test_interrupt_is_json_where_json_is_asked_for(server, drive):
    stream = Stream(server, drive, "--json")
    stream.process.send_signal(signal.SIGINT)
    code, out, errors = stream.end()
    assert (code, out) == (130, "")
    error = json.loads(errors.strip().splitlines()[-1])["error"]
    assert error["code"] == "CANCELLED"
    assert 0 < told(error["hint"]) <= stream.durable()


def test_interrupt_does_not_wait_for_a_frozen_server(server, drive):
    stream = Stream(server, drive)
    server.process.send_signal(signal.SIGSTOP)
    stream.process.send_signal(signal.SIGINT)
    begin = time.monotonic()
    code, _, errors = stream.end()
    assert code == 130
    assert time.monotonic() - begin < 20
    server.process.send_signal(signal.SIGCONT)
    # Poses that were on their way may have become durable since.
    assert 0 < told(errors) <= stream.durable()


def test_frozen_server_is_given_up_and_what_is_durable_told(server, drive):
    stream = Stream(server, drive, "--give-up-after", "6")
    server.process.send_signal(signal.SIGSTOP)
    begin = time.monotonic()
    code, out, errors = stream.end()
    assert (code, out) == (64 + 14, "")
    # Until then, and until the connection breaks that takes no bytes.
    assert time.monotonic() - begin < 50
    # Other connections were tried meanwhile.
    assert "connection lost, trying again" in errors
    server.process.send_signal(signal.SIGCONT)
    assert 0 < told(errors) <= stream.durable()
