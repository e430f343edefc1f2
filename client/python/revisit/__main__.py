"""Runs the program `revisit`: `python -m revisit ARGUMENT...`."""

from __future__ import annotations

import os
import sys

from revisit._program import find_program


def main() -> None:
    try:
        program = find_program("revisit")
    except FileNotFoundError as error:
        sys.exit(f"revisit: {error}")
    os.execv(program, ["revisit", *sys.argv[1:]])


if __name__ == "__main__":
    main()
