"""What the scripts beside this one share: the report of `revisit evaluate`, and
tables in Markdown."""

import json
import pathlib
import subprocess
import sys

ROOT = pathlib.Path(__file__).resolve().parents[2]
REVISIT = ROOT / "build/release/bin/revisit"


def report_of(program, *arguments):
    """What `revisit evaluate --json` prints. Ends the script if it fails."""
    command = [str(word) for word in (program, "evaluate", *arguments, "--json")]
    done = subprocess.run(command, stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE, text=True, check=False)
    if done.returncode != 0:
        sys.exit(f"{' '.join(command)}:\n{done.stderr}")
    return json.loads(done.stdout)


def decimals(value, digits=3):
    return "-" if value is None else f"{value:.{digits}f}"


def markdown(header, rows):
    lines = [f"| {' | '.join(map(str, cells))} |" for cells in (header, *rows)]
    return "\n".join([lines[0], "|---" * len(header) + "|", *lines[1:]])
