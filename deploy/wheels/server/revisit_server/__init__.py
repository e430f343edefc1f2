"""Where the programs of revisit are that were installed with this package."""

from __future__ import annotations

import importlib.metadata
import pathlib

__all__ = ["revisit", "revisitd"]


def revisit() -> pathlib.Path:
    """The command line. FileNotFoundError if it is no longer there."""
    return _program("revisit")


def revisitd() -> pathlib.Path:
    """The server. FileNotFoundError if it is no longer there."""
    return _program("revisitd")


def _program(name: str) -> pathlib.Path:
    places = []
    # The installer's list of files knows the folder of programs, which is another one
    # for each kind of environment.
    for file in importlib.metadata.files("revisit-server") or ():
        if file.parts[-2:] == ("bin", name):
            places.append(pathlib.Path(str(file.locate())).resolve())
    # `pip install --target` moves the programs after it has written that list.
    places.append(pathlib.Path(__file__).resolve().parent.parent / "bin" / name)
    for place in places:
        if place.is_file():
            return place
    raise FileNotFoundError(
        f"{name} is not where revisit-server was installed, "
        f"{' or '.join(map(str, places))}: install that package anew")
