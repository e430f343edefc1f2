"""Maps of vehicles, drawn by the program `revisit`."""

from __future__ import annotations

import dataclasses
import html
import os
import pathlib
from collections.abc import Mapping
from typing import Any

from revisit import _program
from revisit.channel import ChannelOptions, PathLike

#: Formats of `revisit export` by the ending of the file.
_FORMATS = {".g2o": "g2o", ".tum": "tum", ".kitti": "kitti", ".csv": "csv",
            ".geojson": "geojson", ".jsonl": "jsonl"}


@dataclasses.dataclass(frozen=True)
class Map:
    """A map that shows itself in a notebook: the page, which moves and zooms, or the
    drawing."""

    #: All of the file.
    text: str
    #: "html", "svg" or "geojson".
    format: str

    def _repr_html_(self) -> str:
        if self.format == "svg":
            return self.text
        if self.format == "geojson":
            return f"<pre>{html.escape(self.text[:1000])}</pre>"
        # Its scripts reach nothing of the notebook.
        return (f'<iframe srcdoc="{html.escape(self.text, quote=True)}" '
                'sandbox="allow-scripts" width="100%" height="600" '
                'style="border: 0"></iframe>')

    def __repr__(self) -> str:
        return f"<Map of {len(self.text)} characters of {self.format}>"

    def save(self, path: PathLike) -> None:
        """Writes the file."""
        pathlib.Path(path).write_text(self.text, encoding="utf-8")


def draw(options: ChannelOptions, vehicle: str, format: str,
         keywords: Mapping[str, Any]) -> Map:
    if format not in ("html", "svg", "geojson"):
        raise ValueError(f"format is {format!r}: expected html, svg or geojson")
    drawn = _program.run(["map", f"--vehicle={vehicle}", f"--{format}", "--json",
                          *_program.flags_of(keywords),
                          *_program.server_flags(options)])
    return Map(drawn.decode(), format)


def export(options: ChannelOptions, vehicle: str, path: PathLike, format: str) -> None:
    name = os.fspath(path)
    chosen = format or _FORMATS.get(pathlib.Path(name).suffix, "")
    if not chosen:
        raise ValueError(f"the ending of {name} is none of {', '.join(_FORMATS)}: "
                         "name the format")
    _program.run(["export", f"--vehicle={vehicle}", f"--format={chosen}",
                  f"--output={name}",
                  *_program.server_flags(options)])
