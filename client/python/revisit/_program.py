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

_VARIABLES = {"revisit": "REVISIT_PROGRAM", "revisitd": "REVISIT_SERVER_PROGRAM"}
_USAGE = 64
_LOCAL = 1
_PROGRESS = re.compile(r" \w+  \d+/s( |$)")
_SERVERS_WORDS = re.compile(r"(?:revisit: )?([A-Z_]+)(?: \((\w+)\))?: (.*)", re.DOTALL)


class RecordingError(ValueError):
    """A file that cannot be read as a recording, or looks wrong. The message names
    file and line, and the flag that may mend it."""


def find_program(name: str) -> str:
    """The path of `revisit` or `revisitd`: what its variable of the environment names,
    else the one that was installed with this package or this Python, else the one on
    PATH. FileNotFoundError if there is none."""
    variable = _VARIABLES[name]
    named = os.environ.get(variable)
    if named:
        if shutil.which(named) is None:
            raise FileNotFoundError(f"{variable} is {named}, which is no program")
        return named
    for place in _places_of_scripts():
        found = shutil.which(name, path=os.fspath(place))
        if found is not None:
            return found
    found = shutil.which(name)
    if found is None:
        raise FileNotFoundError(
            f"the program {name} is needed, and is neither beside this package or "
            f"Python, nor on PATH, nor named by {variable}: pip install "
            "revisit-server, the Debian package revisit-server, or cmake --install "
            "brings it")
    return found


def _places_of_scripts() -> list[pathlib.Path]:
    """Where an installer puts programs that it installs beside this package: below the
    folder of `pip install --target`, below the prefix of lib/pythonX.Y/site-packages
    (also that of `--user`), and beside Python."""
    packages = pathlib.Path(__file__).absolute().parents[1]
    places = [packages / "bin"]
    if packages.name in ("site-packages", "dist-packages"):
        places.append(packages.parents[2] / "bin")
    if sys.executable:
        places.append(pathlib.Path(sys.executable).parent)
    return places


def without_settings() -> dict[str, str]:
    """The environment for a program whose arguments alone say what it does."""
    return {name: value for name, value in os.environ.items()
            if not name.startswith("REVISIT_")}


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
    with tempfile.TemporaryFile() as said, subprocess.Popen(
            [find_program("revisit"), *arguments], stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE, stderr=said, env=without_settings()) as program:
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

