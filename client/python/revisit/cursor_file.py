"""A file that keeps how far a watch of candidates has come."""

from __future__ import annotations

import os
import pathlib
import threading
from typing import Union


class CursorFile:
    """Keeps a cursor over restarts, for one watch at a time. The file holds the old
    cursor or the new one, whole, whenever program or machine stop. Thread-safe."""

    def __init__(self, path: Union[str, os.PathLike[str]]) -> None:
        self.path = pathlib.Path(path)
        self._lock = threading.Lock()

    def load(self) -> str:
        """The cursor that was stored last; empty if there is no file. ValueError if
        there is one without a cursor: to go on from now would leave out what came
        since."""
        try:
            cursor = self.path.read_text(encoding="utf-8").strip()
        except FileNotFoundError:
            return ""
        if not cursor:
            raise ValueError(f"{self.path} holds no cursor: remove it to begin anew")
        return cursor

    def store(self, cursor: str) -> None:
        """Replaces the cursor. It is on the device once this returns."""
        partial = self.path.with_name(self.path.name + ".partial")
        with self._lock:
            with open(partial, "w", encoding="utf-8") as file:
                file.write(cursor + "\n")
                file.flush()
                os.fsync(file.fileno())
            os.replace(partial, self.path)
            self._sync_folder()

    def _sync_folder(self) -> None:
        """Without it the file may have its old content after a loss of power."""
        if not hasattr(os, "O_DIRECTORY"):
            return  # Windows has no such thing.
        folder = os.open(self.path.parent, os.O_RDONLY | os.O_DIRECTORY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)
