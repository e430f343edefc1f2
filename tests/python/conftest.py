"""Fixtures of the tests of the Python package, which run on real servers and on the
package as it was installed."""

import contextlib
import itertools
import os
import pathlib
import signal
import sys
import tempfile
import threading

import numpy as np
import pytest

import revisit

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests/integration"))

from revisit_server import BIN, Server, free_port, wait_until  # noqa: E402

BOREAS = ROOT / "tests/data/boreas/boreas_glen_shields.csv"
#: Longer than anything here takes on a busy machine, in seconds.
LONG = 60.0


os.environ.setdefault("REVISIT_PROGRAM", str(BIN / "revisit"))
os.environ.setdefault("REVISIT_SERVER_PROGRAM", str(BIN / "revisitd"))


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """One server for all tests of a file that do not stop it."""
    with Server(tmp_path_factory.mktemp("server") / "store") as running:
        yield running
        assert running.is_running(), running.log()


@pytest.fixture(scope="module")
def client(server):
    with revisit.Client(server.address) as made:
        yield made


@pytest.fixture(scope="module")
def new_vehicle(client):
    """Creates a vehicle of its own for a test; returns its id."""
    numbers = itertools.count(1)

    def create(**settings):
        name = f"vehicle-{next(numbers)}"
        client.create_vehicle(name, revisit.v1.VehicleSettings(**settings))
        return name

    return create


@contextlib.contextmanager
def stopped(server):
    """A server of which no thread runs meanwhile."""
    tasks = pathlib.Path(f"/proc/{server.pid}/task")
    os.kill(server.pid, signal.SIGSTOP)
    try:
        wait_until(lambda: all(
            (task / "stat").read_text().rpartition(")")[2].split()[0] == "T"
            for task in tasks.iterdir()), "stopped server")
        yield
    finally:
        os.kill(server.pid, signal.SIGCONT)


class Restarted:
    """A server that comes back at its address, over its store."""

    def __init__(self, store):
        self.store = store
        self.address = f"127.0.0.1:{free_port()}"
        self.server = None
        self.start()

    def start(self):
        self.server = Server(self.store, listen=self.address)

    def kill(self):
        self.server.kill()

    def stop(self):
        self.server.close()


@pytest.fixture
def restarted(tmp_path):
    made = Restarted(tmp_path / "store")
    yield made
    made.stop()


@pytest.fixture
def in_thread():
    """Starts functions beside the test; their errors fail it. A function that was
    started is waited for by calling what it returns."""
    threads = []

    def start(function, *arguments):
        outcome = []

        def body():
            try:
                outcome.append((function(*arguments), None))
            except BaseException as error:
                outcome.append((None, error))

        thread = threading.Thread(target=body, daemon=True)
        thread.start()
        threads.append(thread)

        def wait():
            thread.join(LONG)
            assert outcome, "it did not end"
            value, error = outcome[0]
            if error is not None:
                raise error
            return value

        return wait

    yield start
    for thread in threads:
        thread.join(LONG)


@pytest.fixture
def scratch(tmp_path, monkeypatch):
    """A folder for temporary files, in which nothing is left."""
    made = tmp_path / "scratch"
    made.mkdir()
    monkeypatch.setenv("TMPDIR", str(made))
    monkeypatch.setattr(tempfile, "tempdir", None)
    yield made
    assert list(made.iterdir()) == []


@pytest.fixture(scope="session")
def boreas():
    """The shipped drive: poses, and the columns of its file."""
    columns = np.genfromtxt(BOREAS, delimiter=",", names=True)
    covariance = np.column_stack([columns[name] for name in (
        "pxx", "pxy", "pxt", "pyy", "pyt", "ptt")])
    poses = revisit.Poses.local(
        columns["est_x"], columns["est_y"], columns["est_yaw"], covariance,
        stamps=columns["t_s"], sequence=np.arange(1, len(columns) + 1))
    return poses, columns


def straight(count, first=1, spacing=1.0):
    """Poses along +x, the pose of sequence n at x = n * spacing."""
    sequence = np.arange(first, first + count)
    return revisit.Poses.local(
        sequence * spacing, np.zeros(count), np.zeros(count),
        np.tile([0.01, 0, 0, 0.01, 0, 1e-4], (count, 1)), sequence=sequence)


def as_bytes(messages):
    """Exact content: equal if and only if every number is, to the bit."""
    return [message.SerializeToString(deterministic=True) for message in messages]
