"""The packages for pip that tests/wheels/run has made."""

import os
import pathlib
import re
import subprocess

ROOT = pathlib.Path(__file__).resolve().parents[2]
MADE = ROOT / "build/wheels"
PROGRAMS = pathlib.Path(os.environ["REVISIT_PROGRAMS"])
#: Debians with Python and nothing else, each in a folder of its name.
ROOTS = pathlib.Path(os.environ["REVISIT_BARE_ROOTS"])
RELEASES = os.environ["REVISIT_BARE_RELEASES"].split()
ARCH = os.uname().machine
[VERSION] = re.findall(r"^project\(revisit VERSION ([\d.]+)",
                       (ROOT / "CMakeLists.txt").read_text(), re.MULTILINE)
CLIENT = MADE / f"revisit-{VERSION}-py3-none-any.whl"
SOURCES = MADE / f"revisit-{VERSION}.tar.gz"
SERVER = MADE / f"revisit_server-{VERSION}-py3-none-manylinux_2_31_{ARCH}.whl"
#: Seconds that nothing here takes, on however busy a machine.
LONG = 600


def run(*command, **options):
    return subprocess.run(list(map(str, command)), capture_output=True, text=True,
                          timeout=LONG, check=False, **options)


def do(*command, **options):
    """Runs a command that has to succeed; answers its output."""
    result = run(*command, **options)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout
