"""Poses of a vehicle in Parquet files, which pandas, DuckDB and others read.

    archived = revisit.archive.write("shuttle-7.parquet", client, "shuttle-7",
                                     before=np.datetime64("2026-01-01"))
    poses = revisit.archive.read("shuttle-7.parquet")

A file has its name only once what is in it was compared with what is stored, so poses
that are in one may go from the server. Needs pyarrow.

Columns, with null where a pose has none: `sequence`, `stamp` (nanoseconds, UTC), `x`,
`y`, `z` in metres, or `latitude`, `longitude` in degrees and `height` in metres,
`heading` in radians, `quaternion` (x, y, z, w), `covariance_form` (the name in the
API), `covariance`, `error_transition`, `recording_start` (a serialised
revisit.v1.RecordingStart). The metadata have `vehicle` and `vehicle_uid`.
"""

from __future__ import annotations

import dataclasses
import datetime
import itertools
import os
import pathlib
from collections.abc import Iterable, Iterator
from typing import Any, Optional, Union

import numpy as np
import pyarrow
from pyarrow import parquet

from revisit import v1
from revisit.arrays import Poses, nanoseconds_of
from revisit.client import Client

_NANOSECONDS = 1_000_000_000
#: Poses that are in memory at a time, and in a row group.
_ROWS = 20_000
_NUMBERS = pyarrow.list_(pyarrow.float64())
_PLACES = {"local": (("x", "x_meters"), ("y", "y_meters"), ("z", "z_meters")),
           "geodetic": (("latitude", "latitude_degrees"),
                        ("longitude", "longitude_degrees"),
                        ("height", "height_meters"))}
_TURN = ("x", "y", "z", "w")


class Mismatch(Exception):
    """What was written is not what is stored: the file was not kept."""


@dataclasses.dataclass(frozen=True)
class Archived:
    """What a file holds."""

    path: pathlib.Path
    count: int
    #: 0 if there are none.
    first_sequence: int
    last_sequence: int


def write(path: Union[str, os.PathLike[str]], client: Client, vehicle: str, *,
          first_sequence: int = 1, last_sequence: Optional[int] = None,
          before: Union[np.datetime64, datetime.datetime, None] = None) -> Archived:
    """Writes the poses of a vehicle as they are stored, from `first_sequence` up to
    `last_sequence` and up to the first pose whose stamp is not before `before` (a
    datetime has a time zone, a datetime64 is UTC), then compares the file with the
    store, and gives it its name.

    Raises FileExistsError if there is such a file, and Mismatch if poses were revised
    meanwhile or the file does not read back the same."""
    final = pathlib.Path(path)
    if final.exists():
        raise FileExistsError(f"{final} is there already")
    partial = final.with_name(final.name + ".partial")
    bounds = (first_sequence, last_sequence, _end_of(before))
    try:
        _write(partial, client.get_vehicle(vehicle),
               _stored(client, vehicle, *bounds))
        archived = dataclasses.replace(
            _compare(partial, _stored(client, vehicle, *bounds)), path=final)
        # Fails where another was made meanwhile.
        os.link(partial, final)
    finally:
        partial.unlink(missing_ok=True)
    return archived


def read(path: Union[str, os.PathLike[str]]) -> Poses:
    """The poses of a file, the same to the bit."""
    return Poses.from_messages(_messages(pathlib.Path(path)))


def _end_of(before: Union[np.datetime64, datetime.datetime, None]) -> Optional[int]:
    if before is None:
        return None
    if isinstance(before, datetime.datetime):
        return nanoseconds_of(before)
    return int(before.astype("datetime64[ns]").astype(np.int64))


def _stored(client: Client, vehicle: str, first_sequence: int,
            last_sequence: Optional[int], end: Optional[int]) -> Iterator[v1.Pose]:
    for pose in client.list_poses(vehicle, first_sequence):
        if last_sequence is not None and pose.sequence > last_sequence:
            return
        if end is not None and pose.HasField("stamp") and _stamp(pose) >= end:
            return
        yield pose


def _stamp(pose: v1.Pose) -> int:
    return pose.stamp.seconds * _NANOSECONDS + pose.stamp.nanos


def _schema(vehicle: v1.Vehicle, place: str) -> pyarrow.Schema:
    numbers = [(name, pyarrow.float64()) for name, _ in _PLACES[place]]
    return pyarrow.schema(
        [("sequence", pyarrow.uint64()), ("stamp", pyarrow.timestamp("ns", tz="UTC")),
         *numbers, ("heading", pyarrow.float64()), ("quaternion", _NUMBERS),
         ("covariance_form", pyarrow.string()), ("covariance", _NUMBERS),
         ("error_transition", _NUMBERS), ("recording_start", pyarrow.binary())],
        metadata={"vehicle": vehicle.name, "vehicle_uid": vehicle.uid})


def _table(poses: list[v1.Pose], schema: pyarrow.Schema,
           place: str) -> pyarrow.Table:
    columns: dict[str, list[Any]] = {
        "sequence": [pose.sequence for pose in poses],
        "stamp": [_stamp(pose) if pose.HasField("stamp") else None for pose in poses],
        "heading": [pose.heading_radians if pose.HasField("heading_radians") else None
                    for pose in poses],
        "quaternion": [[getattr(pose.quaternion, axis) for axis in _TURN]
                       if pose.HasField("quaternion") else None for pose in poses],
        "covariance_form": [v1.CovarianceForm.Name(pose.covariance.form)
                            for pose in poses],
        "covariance": [list(pose.covariance.values) for pose in poses],
        "error_transition": [list(pose.error_transition) or None for pose in poses],
        "recording_start": [
            pose.recording_start.SerializeToString(deterministic=True)
            if pose.HasField("recording_start") else None for pose in poses],
    }
    for name, field in _PLACES[place]:
        columns[name] = [getattr(getattr(pose, place), field) for pose in poses]
    return pyarrow.table(
        [pyarrow.array(columns[field.name], field.type) for field in schema],
        schema=schema)


def _chunks(poses: Iterable[v1.Pose]) -> Iterator[list[v1.Pose]]:
    iterator = iter(poses)
    while chunk := list(itertools.islice(iterator, _ROWS)):
        yield chunk


def _write(path: pathlib.Path, vehicle: v1.Vehicle,
           poses: Iterable[v1.Pose]) -> None:
    place = ("geodetic" if vehicle.settings.coordinate_frame ==
             v1.COORDINATE_FRAME_GEODETIC else "local")
    schema = _schema(vehicle, place)
    with open(path, "xb") as file:
        with parquet.ParquetWriter(file, schema, compression="zstd") as writer:
            for chunk in _chunks(poses):
                writer.write_table(_table(chunk, schema, place))
        file.flush()
        os.fsync(file.fileno())


def _messages(path: pathlib.Path) -> Iterator[v1.Pose]:
    with parquet.ParquetFile(path) as file:
        place = "local" if "x" in file.schema_arrow.names else "geodetic"
        for batch in file.iter_batches(_ROWS):
            stamps = batch.column("stamp").cast(pyarrow.int64()).to_pylist()
            names = [name for name in batch.schema.names if name != "stamp"]
            rows = zip(*(batch.column(name).to_pylist() for name in names))
            for stamp, row in zip(stamps, rows):
                yield _message(dict(zip(names, row)), stamp, place)


def _message(row: dict[str, Any], stamp: Optional[int], place: str) -> v1.Pose:
    pose = v1.Pose(sequence=row["sequence"])
    if stamp is not None:
        pose.stamp.seconds, pose.stamp.nanos = divmod(stamp, _NANOSECONDS)
    where = getattr(pose, place)
    for name, field in _PLACES[place]:
        setattr(where, field, row[name])
    where.SetInParent()
    if row["quaternion"] is not None:
        for axis, value in zip(_TURN, row["quaternion"]):
            setattr(pose.quaternion, axis, value)
    elif row["heading"] is not None:
        pose.heading_radians = row["heading"]
    pose.covariance.CopyFrom(v1.Covariance(form=row["covariance_form"],
                                           values=row["covariance"]))
    pose.error_transition.extend(row["error_transition"] or ())
    # Files of earlier versions have none.
    if row.get("recording_start") is not None:
        pose.recording_start.ParseFromString(row["recording_start"])
        pose.recording_start.SetInParent()
    return pose


def _compare(path: pathlib.Path, stored: Iterable[v1.Pose]) -> Archived:
    """What the file holds, if that is what is stored."""
    first = last = count = 0
    for written, pose in itertools.zip_longest(_messages(path), stored):
        if written != pose or (
                written.SerializeToString(deterministic=True) !=
                pose.SerializeToString(deterministic=True)):
            sequence = (written or pose).sequence
            raise Mismatch(f"the pose of sequence {sequence} is not stored as it was "
                           f"written to {path}: it was changed meanwhile, or the "
                           "file is damaged")
        first = first or pose.sequence
        last = pose.sequence
        count += 1
    return Archived(path, count, first, last)
