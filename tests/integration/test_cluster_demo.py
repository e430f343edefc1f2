"""deploy/cluster/demo, with fewer vehicles: a server that is killed costs no pose and
changes no candidate, and nothing is left of the cluster in the end."""

import contextlib
import os
import pathlib
import re
import signal
import subprocess

import pytest

from envoy_proxy import directory_of_cluster, skip_without_envoy
from revisit_server import wait_until
from stubs import ROOT

DEMO = ROOT / "deploy/cluster/demo"


@pytest.fixture(scope="module", autouse=True)
def envoy():
    skip_without_envoy()


@pytest.fixture
def directory():
    with directory_of_cluster() as made:
        yield made


@contextlib.contextmanager
def running_demo(directory, *arguments):
    """The demo with its temporary files in this directory."""
    process = subprocess.Popen(
        [DEMO, *arguments], stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, text=True, start_new_session=True,
        env={**os.environ, "TMPDIR": str(directory)})
    try:
        yield process
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGTERM)
            process.communicate(timeout=60)


def check_nothing_is_left(directory):
    assert list(directory.iterdir()) == []
    for commands in pathlib.Path("/proc").glob("[0-9]*/cmdline"):
        with contextlib.suppress(FileNotFoundError, ProcessLookupError):
            assert str(directory).encode() not in commands.read_bytes()


@pytest.mark.release_build
def test_killed_server_costs_no_pose_and_changes_no_candidate(directory):
    with running_demo(directory, "--vehicles", "9", "--seconds", "6") as process:
        output = process.communicate(timeout=600)[0]
    print(output)
    assert process.returncode == 0
    assert "kill -9 of revisitd-" in output
    assert int(re.search(r"^cut off by the kill +(\d+)", output,
                         re.MULTILINE).group(1)) >= 3
    assert " 0 lost or changed" in output
    assert ": 0 answered otherwise " in output
    fleet = re.search(r": (\d+) answers, (\d+) candidates accepted, 0 answered "
                      r"otherwise", output)
    assert int(fleet.group(1)) == 4 * 8 and int(fleet.group(2)) >= 3 * 8
    check_nothing_is_left(directory)


@pytest.mark.release_build
def test_interrupt_stops_everything(directory):
    with running_demo(directory, "--seconds", "60") as process:

        def has_begun():
            line = process.stdout.readline()
            assert line, f"it ended with {process.wait()}"
            return line.startswith("== ") and "through Envoy" in line

        wait_until(has_begun, "stream", 300)
        # As a terminal does.
        os.killpg(process.pid, signal.SIGINT)
        process.communicate(timeout=60)
    assert process.returncode == 130
    check_nothing_is_left(directory)
