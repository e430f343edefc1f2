"""Recordings of any format that the program `revisit` reads, as poses:

    poses = revisit.read_recording("drive.csv", axes="camera", times="times.txt")

The readers are the program's: `revisit help convert` lists their flags, which are
keywords here, with underscores. What looks like wrong axes, units or orders is refused,
and the message says which flag mends it.
"""

from __future__ import annotations

import logging
import os
import pathlib
from collections.abc import Iterator, Sequence
from typing import IO, Any, Optional, Union

from google.protobuf.message import DecodeError

from revisit import v1
from revisit._program import RecordingError, flags_of, running
from revisit.arrays import Poses
from revisit.channel import PathLike
from revisit.stream_options import ProgressBar

__all__ = ["RecordingError", "iter_recording", "read_recording", "shipped_drive"]

#: No message of the program is larger.
_MOST_BYTES = 64 << 20


def shipped_drive() -> pathlib.Path:
    """The path of a recording that comes with this package: two drives of a real car
    over the same roads, 15.9 km with covariances, for a first try.

        drive = revisit.read_recording(revisit.shipped_drive(), uncertainty="file")

    It is of the Boreas dataset, under CC BY 4.0: NOTICE beside it says whose it is and
    what was changed."""
    return pathlib.Path(__file__).parent / "drives" / "boreas_glen_shields.csv"


def read_recording(path: Union[PathLike, Sequence[PathLike]], *,
                   progress: Optional[ProgressBar] = None, **flags: Any) -> Poses:
    """The poses of a recording, or of several one after the other, as `revisit stream`
    would send them: with sequences from 1, and with the uncertainty that the flags
    name or, without any, the one that the program chooses by the file; where the file
    has covariances, a logged line says what became of them.

    A file that does not go on where the one before it ended begins a recording, in a
    frame of its own, and so does an odometry of ROS that is back at its start; a logged
    line says so, and `recording` ("after", "datum:10m,1deg", "unknown", "same") what is
    known of the frame.

    `flags` are those of `revisit convert`: `format`, `columns` (a mapping, or text such
    as "t=time,x=east,y=north,yaw=psi"), `times`, `rate`, `time_unit`, `axes`, `angles`,
    `quaternion`, `frame`, `accept_suspicious`; `recording`; `uncertainty`,
    `sigma_along` and the other sigmas; `state_space` and `correlation_model` of the
    vehicle that the poses are for. `progress` is told of each pose.

    RecordingError if a file is malformed or suspicious; FileNotFoundError and
    PermissionError, also if there is no program; ValueError for a wrong flag."""
    read = []
    for batch in _batches(path, flags):
        read += batch
        if progress is not None:
            progress.update(len(batch))
    return Poses.from_messages(read)


def iter_recording(path: Union[PathLike, Sequence[PathLike]], *, after: int = 0,
                   progress: Optional[ProgressBar] = None,
                   **flags: Any) -> Iterator[Poses]:
    """The same in batches of a thousand, as they are read: memory does not grow with
    the file. Poses up to the sequence `after` are left out, to go on where a vehicle
    stands. What came before an error of the file was handed out by then."""
    for batch in _batches(path, flags):
        if batch[-1].sequence > after:
            yield Poses.from_messages(
                pose for pose in batch if pose.sequence > after)
        if progress is not None:
            progress.update(len(batch))


def _batches(path: Union[PathLike, Sequence[PathLike]],
             flags: dict[str, Any]) -> Iterator[list[v1.Pose]]:
    paths = [path] if isinstance(path, (str, os.PathLike)) else path
    names = [os.fspath(one) for one in paths]
    # A name that begins with a dash would be a flag.
    files = [os.path.join(os.curdir, name) if name.startswith("-") else name
             for name in names]
    # A note says what is claimed of a file where no flag does.
    with running(["convert", *files, "--json", "--to", "messages", *flags_of(flags)],
                 level=logging.WARNING) as output:
        while (size := _size(output)) is not None:
            serialised = output.read(size)
            if len(serialised) < size:
                break
            try:
                batch = v1.PoseBatch.FromString(serialised)
            except DecodeError as error:
                raise RecordingError(
                    f"the program revisit wrote no poses: {error}") from error
            yield list(batch.poses)
    # Where the program has failed, that was raised by now.
    if size is not None:
        raise RecordingError("the program revisit wrote only a part of the poses")


def _size(output: IO[bytes]) -> Optional[int]:
    """A varint; None at the end."""
    size = shift = 0
    while byte := output.read(1):
        size |= (byte[0] & 0x7F) << shift
        shift += 7
        if size > _MOST_BYTES or shift > 35:
            raise RecordingError("the program revisit wrote no poses")
        if byte[0] < 0x80:
            return size
    return None
