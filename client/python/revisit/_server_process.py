"""A revisitd that this process runs for itself."""

from __future__ import annotations

import contextlib
import numbers
import os
import pathlib
import re
import secrets
import select
import shutil
import subprocess
import tempfile
import threading
import time
import weakref
from collections.abc import Mapping
from typing import Any, Optional

import grpc

from revisit._arguments import did_you_mean
from revisit._program import find_program, flags_of, without_settings
from revisit._text import printable
from revisit.channel import PathLike
from revisit.errors import Error

_USAGE = 64
#: The settings by which the server ends with this process, and the store with the
#: server.
_END_WITH_INPUT = "end-with-input"
_TEMPORARY_STORE = "temporary-store"
_OWN = ("listen", "store", _END_WITH_INPUT, _TEMPORARY_STORE)
#: What settings begin with that keep a client without TLS and tokens out.
_CLOSED_TO_US = ("tls-", "token-", "policy")
_SETTING = re.compile(r"^([\w-]+) = ", re.MULTILINE)
_ANNOUNCEMENT = re.compile(rb"^listening on (\S+)\n", re.MULTILINE)
#: How long a server may take to end, in seconds, before it is killed. It cuts the calls
#: of others after its drain-timeout-seconds.
_PATIENCE = 30.0
_KEPT_LOG = 1 << 20
_LOG_END = 2000


class ServerEnded(Error):
    """The server that `serve()` started does not start, or has ended by itself.
    `exit_code` is negative if a signal ended it: -9 for SIGKILL. `log` is the end of
    what it has logged."""

    code = grpc.StatusCode.UNAVAILABLE

    def __init__(self, exit_code: int, log: str) -> None:
        how = (f"signal {-exit_code}" if exit_code < 0 else f"exit code {exit_code}")
        super().__init__(f"revisitd ended with {how}; its log ends:\n{log}")
        self.exit_code = exit_code
        self.log = log

    def __reduce__(self) -> tuple[type[ServerEnded], tuple[int, str]]:
        return ServerEnded, (self.exit_code, self.log)

    def __str__(self) -> str:
        return "\n".join(map(printable, self.message.splitlines()))


class ServerProcess:
    """One revisitd on a free port of 127.0.0.1. It ends with `close()`, with the
    interpreter, once nobody refers to it any more, and by the end of its standard
    input however else this process ends. It has a session of its own, so that Ctrl-C
    does not reach it before us. Thread-safe; a fork of this process neither keeps nor
    ends it."""

    def __init__(self, store: Optional[PathLike], settings: Mapping[str, Any],
                 start_deadline: float) -> None:
        """Starts the server and waits until it takes calls. What is wrong with the
        arguments is raised before anything is made: see `serve()`."""
        kept = _checked_store(store)
        if not start_deadline > 0.0:
            raise ValueError(f"start_deadline is {start_deadline} s: it is positive")
        program = find_program("revisitd")
        flags = _checked_flags(program, settings)
        self._owner = os.getpid()
        self._lock = threading.Lock()
        self._log = tempfile.TemporaryFile()
        self._log_when_closed: Optional[str] = None
        #: Where it keeps what it has.
        self.store = kept or _new_directory()
        if kept is None:
            flags.append(f"--{_TEMPORARY_STORE}=on")
        self._ended = threading.Event()
        with contextlib.ExitStack() as failed:
            failed.callback(self._log.close)
            self.store.parent.mkdir(parents=True, exist_ok=True)
            # A server whose start is interrupted here ends with its input.
            self._process = subprocess.Popen(
                [program, "--listen=127.0.0.1:0", f"--store={self.store}",
                 f"--{_END_WITH_INPUT}=on", *flags],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=self._log,
                env=without_settings(), start_new_session=True)
            self._end = weakref.finalize(self, _end, self._process, self._ended,
                                         self.store if kept is None else None,
                                         self._owner)
            failed.pop_all()
        try:
            threading.Thread(target=_await_end, args=(self._process, self._ended),
                             daemon=True, name="revisit server").start()
            _running.add(self)
            #: HOST:PORT.
            self.address = self._read_address(time.monotonic() + start_deadline)
        except BaseException:
            self.close()
            raise

    def _read_address(self, deadline: float) -> str:
        output = self._process.stdout
        assert output is not None
        poll = select.poll()
        poll.register(output, select.POLLIN)
        said = b""
        with output:
            while not (found := _ANNOUNCEMENT.search(said)):
                left = deadline - time.monotonic()
                if left <= 0.0:
                    raise TimeoutError("revisitd takes no calls after start_deadline; "
                                       f"its log ends:\n{self.log[-_LOG_END:]}")
                # Not for long: a signal that comes just before it does not end it.
                if not poll.poll(min(left, 1.0) * 1000.0):
                    continue
                part = os.read(output.fileno(), 4096)
                if not part:
                    raise self._why_not_started()
                said += part
        return found[1].decode()

    def _why_not_started(self) -> Exception:
        self._ended.wait(_PATIENCE)
        if self._process.returncode == _USAGE:
            complaint = self.log.partition("\nTry: ")[0]
            return ValueError(complaint.removeprefix("revisitd: ").strip())
        return self._server_ended()

    def _server_ended(self) -> ServerEnded:
        return ServerEnded(self._process.returncode, self.log[-_LOG_END:].strip())

    @property
    def log(self) -> str:
        """What the server has logged so far or, once it is closed, until its end: the
        last megabyte."""
        with self._lock:
            if self._log_when_closed is not None:
                return self._log_when_closed
            return self._read_log()

    def _read_log(self) -> str:
        size = os.fstat(self._log.fileno()).st_size
        # Its place in the file is the server's too.
        text = os.pread(self._log.fileno(), _KEPT_LOG, max(size - _KEPT_LOG, 0))
        return text.decode(errors="replace")

    @property
    def is_ours(self) -> bool:
        """Whether this is the process that has started it, and not a fork."""
        return os.getpid() == self._owner

    def check(self) -> None:
        """ServerEnded if it has ended by itself; RuntimeError in a fork, where
        connections of its parent cannot be used."""
        if not self.is_ours:
            raise RuntimeError(
                f"this client is of process {self._owner}, which has started the "
                "server; a fork makes one of its own: "
                f'revisit.Client("{self.address}")')
        if self._ended.is_set() and self._end.alive:
            raise self._server_ended()

    def why_ended(self, seconds: float) -> Optional[ServerEnded]:
        """That it has ended by itself, or does within so many seconds."""
        if self._ended.wait(seconds) and self._end.alive:
            return self._server_ended()
        return None

    def close(self) -> None:
        """Ends the server, by force if it takes long, and removes its store if that is
        temporary. Nothing if it was done before."""
        with self._lock:
            if self._log_when_closed is not None:
                return
            self._end()
            self._log_when_closed = self._read_log()
            self._log.close()

    def leave_to_parent(self) -> None:
        """In a fork: closes what would keep the server after this process's parent."""
        assert self._process.stdin is not None
        self._process.stdin.close()


#: Those of this process, which its forks leave to it.
_running: weakref.WeakSet[ServerProcess] = weakref.WeakSet()


def _leave_all_to_parent() -> None:
    for server in list(_running):
        server.leave_to_parent()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_leave_all_to_parent)


def _await_end(process: subprocess.Popen[bytes], ended: threading.Event) -> None:
    process.wait()
    ended.set()


def _end(process: subprocess.Popen[bytes], ended: threading.Event,
         temporary: Optional[pathlib.Path], owner: int) -> None:
    """Not a method, which would keep its object for ever."""
    if os.getpid() != owner:
        return
    assert process.stdin is not None
    try:
        process.terminate()
        ended.wait(_PATIENCE)
    finally:
        if not ended.is_set():
            process.kill()
            ended.wait(_PATIENCE)
        process.stdin.close()
        if temporary is not None:
            # There is something left where the server was killed.
            shutil.rmtree(temporary, ignore_errors=True)


def _new_directory() -> pathlib.Path:
    """A path that nobody else has: the server makes the directory."""
    return pathlib.Path(os.path.abspath(tempfile.gettempdir()),
                        f"revisit-{secrets.token_hex(8)}")


def _checked_store(store: Optional[PathLike]) -> Optional[pathlib.Path]:
    """The directory as an absolute path."""
    if store is None:
        return None
    path = os.fspath(store) if isinstance(store, (str, os.PathLike)) else store
    if not isinstance(path, str):
        raise TypeError(f"store is {store!r}: it is the path of a directory, or None "
                        "for one that goes with the server")
    if re.match("postgres(ql)?:", path):
        raise ValueError(f"store is {path!r}: a server of this process alone keeps its "
                         "store in a directory")
    if not path or "\0" in path:
        raise ValueError(f"store is {path!r}, which is no path of a directory")
    made = pathlib.Path(os.path.abspath(path))
    if made.exists() and not made.is_dir():
        raise NotADirectoryError(f"store is {path!r}, which is no directory")
    return made


def _checked_flags(program: str, settings: Mapping[str, Any]) -> list[str]:
    """The flags of settings that are revisitd's, whatever their values."""
    printed = subprocess.run([program, "--print-config"], stdin=subprocess.DEVNULL,
                             capture_output=True, env=without_settings(), check=False)
    if printed.returncode != 0:
        raise ServerEnded(printed.returncode,
                          printed.stderr.decode(errors="replace")[-_LOG_END:])
    known = _SETTING.findall(printed.stdout.decode(errors="replace"))
    for name in _OWN:
        if name not in known:
            raise RuntimeError(f"{program} is too old for this package: it has no "
                               f"setting {name}")
    return flags_of({name: _checked_value(name, value, known)
                     for name, value in settings.items()})


def _checked_value(name: str, value: Any, known: list[str]) -> Any:
    key = name.replace("_", "-")
    if key in _OWN or key.startswith(_CLOSED_TO_US):
        raise TypeError(f"{name} is not for a server of this process alone, which "
                        "listens on 127.0.0.1 without TLS and tokens")
    if key not in known:
        near = did_you_mean(name, (one.replace("-", "_") for one in known))
        raise TypeError(f"revisitd has no setting {name}{near}")
    if isinstance(value, bool):
        return "on" if value else "off"
    if not isinstance(value, (str, numbers.Real, os.PathLike)):
        raise TypeError(f"{name} is {value!r}: a setting is a number, a text, a path, "
                        "True or False")
    return value
