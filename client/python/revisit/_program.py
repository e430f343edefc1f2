"""The program `revisit`, which reads recordings, draws maps and writes the files of
optimisers and viewers: there is one implementation of each, and it is there."""

from __future__ import annotations

import contextlib
import json
import logging
import os
import pathlib
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from typing import IO, Any, NoReturn

import grpc

from revisit.channel import ChannelOptions
from revisit.errors import FieldViolation, error_class

_log = logging.getLogger("revisit")

_USAGE = 64
_LOCAL = 1
_PROGRESS = re.compile(r" \w+  \d+/s( |$)")
_SERVERS_WORDS = re.compile(r"(?:revisit: )?([A-Z_]+)(?: \((\w+)\))?: (.*)", re.DOTALL)


class RecordingError(ValueError):
    """A file that cannot be read as a recording, or looks wrong. The message names
    file and line, and the flag that may mend it."""


def find_program() -> str:
    """The path of the program: what REVISIT_PROGRAM names, else the one beside this
    package or this Python, else the one on PATH. FileNotFoundError if there is
    none."""
    named = os.environ.get("REVISIT_PROGRAM")
    if named:
        if shutil.which(named) is None:
            raise FileNotFoundError(f"REVISIT_PROGRAM is {named}, which is no program")
        return named
    for place in (pathlib.Path(__file__).parent / "bin",
                  pathlib.Path(sys.executable).parent):
        found = shutil.which("revisit", path=os.fspath(place))
        if found is not None:
            return found
    found = shutil.which("revisit")
    if found is None:
        raise FileNotFoundError(
            "the program revisit is needed, and is neither on PATH nor named by "
            "REVISIT_PROGRAM: cmake --install or the Debian package of revisit brings "
            "it")
    return found


def flags_of(keywords: Mapping[str, Any]) -> list[str]:
    """The flags of keywords: `rate=10` is --rate 10, `accept_suspicious=True` is
    --accept-suspicious, and a mapping is t=time,x=east."""
    flags = []
    for name, value in keywords.items():
        flag = "--" + name.replace("_", "-")
        if value is None or value is False:
            continue
        if value is True:
            flags.append(flag)
        elif isinstance(value, Mapping):
            words = ",".join(f"{key}={one}" for key, one in value.items())
            flags.append(f"{flag}={words}")
        elif isinstance(value, (list, tuple)):
            flags.append(f"{flag}={','.join(str(one) for one in value)}")
        else:
            # In one word, so that a value may begin with a dash.
            flags.append(f"{flag}={value}")
    return flags


def server_flags(options: ChannelOptions) -> list[str]:
    """The flags by which the program reaches the server that a client is of."""
    return flags_of({
        "server": options.address, "tls_ca": options.tls_authorities,
        "tls_cert": options.tls_certificate, "tls_key": options.tls_key,
        "token_file": options.token_file})


@contextlib.contextmanager
def running(arguments: Sequence[str],
            level: int = logging.INFO) -> Iterator[IO[bytes]]:
    """The standard output of the program, whose notes are logged with this level. Ends
    the program where the block is left early. Raises what it reports: ValueError for a
    wrong flag, FileNotFoundError, PermissionError or RecordingError for a file, `Error`
    for what a server answered."""
    # The arguments alone say which server is asked, and who asks.
    environment = {name: value for name, value in os.environ.items()
                   if not name.startswith("REVISIT_")}
    with tempfile.TemporaryFile() as said, subprocess.Popen(
            [find_program(), *arguments], stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=said, env=environment) as program:
        assert program.stdout is not None
        try:
            yield program.stdout
            # Nobody reads the rest of what it has to say.
            program.stdout.close()
            code = program.wait()
        except BaseException:
            program.kill()
            raise
        said.seek(0)
        text = said.read().decode(errors="replace").strip()
        if code != 0:
            _fail(code, text)
        for line in text.splitlines():
            is_progress = _PROGRESS.search(line) is not None
            _log.log(logging.DEBUG if is_progress else level, "%s", line)


def run(arguments: Sequence[str]) -> bytes:
    """All that the program writes to its standard output, with the errors of
    `running()`."""
    with running(arguments) as output:
        return output.read()


def _fail(code: int, text: str) -> NoReturn:
    found = _described(text)
    message = found["message"] + (f"\n{found['hint']}" if found.get("hint") else "")
    if code == _USAGE:
        raise ValueError(message)
    if code == _LOCAL:
        made: type[Exception] = {
            "NOT_FOUND": FileNotFoundError, "PERMISSION_DENIED": PermissionError,
        }.get(found["code"], RecordingError)
        raise made(message)
    for status in grpc.StatusCode:
        if status.value[0] == code - _USAGE:
            raise error_class(status, found["reason"])(
                found["message"], code=status, reason=found["reason"],
                domain="revisit" if found["reason"] else "",
                metadata=found.get("metadata"),
                field_violations=tuple(
                    FieldViolation(one["field"], one["description"])
                    for one in found.get("fieldViolations", ())))
    raise RuntimeError(f"the program revisit ended with {code}: {text}")


def _described(text: str) -> dict[str, Any]:
    """The parts of an error, which is JSON in the last line or in words."""
    last = text.splitlines()[-1] if text else ""
    if last.startswith("{"):
        with contextlib.suppress(ValueError, KeyError):
            error: dict[str, Any] = json.loads(last)["error"]
            return error
    matched = _SERVERS_WORDS.fullmatch(text)
    if matched and hasattr(grpc.StatusCode, matched[1]):
        return {"code": matched[1], "reason": matched[2] or "", "message": matched[3]}
    return {"code": "", "reason": "", "message": text.removeprefix("revisit: ")}

