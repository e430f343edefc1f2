"""What a service manager such as systemd hears of revisitd: sd_notify(3)."""

import contextlib
import signal
import socket
import statistics
import time

import pytest

from drive_client import VEHICLE, create
from held_threads import held, threads
from revisit_server import Server, clean_environment, run
from wire import append, straight


class Manager:
    """The manager's end of the socket."""

    def __init__(self, directory):
        self.path = directory / "notify"
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(self.path))

    def environment(self, watchdog_seconds=None):
        watchdog = {} if watchdog_seconds is None else {
            "WATCHDOG_USEC": str(int(1e6 * watchdog_seconds))}
        return clean_environment(NOTIFY_SOCKET=str(self.path), **watchdog)

    def next(self, seconds=30.0):
        """The next report; None if none comes within the time."""
        self._socket.settimeout(seconds)
        try:
            return self._socket.recv(4096).decode()
        except TimeoutError:
            return None

    def heard(self):
        """The reports that have come so far."""
        return list(iter(lambda: self.next(0.001), None))

    def close(self):
        self._socket.close()


@pytest.fixture
def manager(tmp_path):
    with contextlib.closing(Manager(tmp_path)) as made:
        yield made


def test_server_is_ready_when_it_takes_calls(manager, tmp_path):
    with Server(tmp_path / "store", env=manager.environment(),
                wait=False) as server:
        assert manager.next() == "READY=1"
        # It has said where it listens before that.
        server.wait_until_listening()
        create(server.stub())
        assert append(server.stub(), VEHICLE, straight(1)).durable_sequence == 1
        assert manager.heard() == []


@pytest.mark.parametrize("notice", [0, 0.5])
def test_server_reports_that_it_stops_before_it_drains(
        notice, manager, tmp_path):
    with Server(tmp_path / "store", "--drain-notice-seconds", notice,
                env=manager.environment()) as server:
        assert manager.next() == "READY=1"
        server.process.send_signal(signal.SIGTERM)
        assert manager.next() == "STOPPING=1"
        assert server.process.wait(30) == 0, server.log()
        assert manager.heard() == []


def test_server_that_cannot_start_is_never_ready(manager, tmp_path):
    (tmp_path / "store").mkdir()
    (tmp_path / "store/revisit.sqlite").write_bytes(b"no store" * 1000)
    failed = run("revisitd", "--listen", "127.0.0.1:0", "--store",
                 tmp_path / "store", env=manager.environment())
    assert failed.returncode == 73
    assert manager.heard() == []


@pytest.mark.parametrize("flags", [(), ("--serve-health", "off")])
def test_watchdog_hears_of_a_server_that_answers(flags, manager, tmp_path):
    with Server(tmp_path / "store", *flags,
                env=manager.environment(watchdog_seconds=1)) as server:
        assert manager.next() == "READY=1"
        times = []
        for _ in range(7):
            assert manager.next() == "WATCHDOG=1"
            times.append(time.monotonic())
        server.process.send_signal(signal.SIGTERM)
        assert server.process.wait(30) == 0, server.log()
    # On a busy machine one or the other is late.
    assert statistics.median(
        later - earlier for earlier, later in zip(times, times[1:])) < 1
    assert server.log().count("watchdog_not_answered") < len(times)


def test_watchdog_hears_nothing_while_the_threads_of_the_vehicles_hang(
        manager, tmp_path):
    with Server(tmp_path / "store", "--worker-threads", 2,
                env=manager.environment(watchdog_seconds=2)) as server:
        assert manager.next() == "READY=1"
        assert manager.next() == "WATCHDOG=1"
        workers = threads(server.pid, "vehicles")
        assert len(workers) == 2
        with held(workers):
            # A busy machine may have been late before.
            before = server.log().count("watchdog_not_answered")
            server.logged("watchdog_not_answered", before + 1)
            manager.heard()
            # All other threads go on, also the one that would report.
            assert manager.next(3.0) is None
        assert manager.next() == "WATCHDOG=1"
        create(server.stub())


def test_manager_that_is_gone_keeps_nobody_from_working(tmp_path):
    env = clean_environment(NOTIFY_SOCKET=str(tmp_path / "nobody"),
                            WATCHDOG_USEC="200000")
    with Server(tmp_path / "store", env=env) as server:
        create(server.stub())
        server.process.send_signal(signal.SIGTERM)
        assert server.process.wait(30) == 0, server.log()
