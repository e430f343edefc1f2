"""Servers that a test has started by `revisit.serve()`, as processes."""

import os
import pathlib
import pickle
import signal

from revisit_server import wait_until


def pid_of(client):
    return client._server._process.pid


def is_gone(pid):
    """Whether the process has ended; one whose parent has not asked is no more."""
    try:
        status = pathlib.Path(f"/proc/{pid}/stat").read_text()
    except (FileNotFoundError, ProcessLookupError):
        return True
    return status.rpartition(")")[2].split()[0] == "Z"


def killed(client):
    # The log is written beside the calls.
    wait_until(lambda: " serving " in client.log, "log")
    os.kill(pid_of(client), signal.SIGKILL)


def check_ended(raised):
    assert raised.value.exit_code == -signal.SIGKILL
    assert str(raised.value).startswith("revisitd ended with signal 9; its log ends:\n")
    assert raised.value.log and raised.value.log in raised.value.message
    copy = pickle.loads(pickle.dumps(raised.value))
    assert (copy.exit_code, copy.log) == (-signal.SIGKILL, raised.value.log)
