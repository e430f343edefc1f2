"""Poses as columns of the API, there and back: neither way needs a Python object for
each pose of arrays."""

from __future__ import annotations

import dataclasses
import re
from typing import Any, Optional, Union

import numpy as np
from numpy.typing import NDArray

from revisit import v1
from revisit.arrays import (
    COVARIANCE_SIZES, NANOSECONDS, Float, Poses, recording_rows, rows_with)
from revisit.errors import Internal

#: A message that has poses in one of the two forms of the API.
Batch = Union[v1.PoseBatch, v1.AppendPosesRequest]
Integers = NDArray[np.int64]

_LOCAL = ("x_meters", "y_meters", "z_meters")
_GEODETIC = ("latitude_degrees", "longitude_degrees", "height_meters")
#: Where the variances are among the numbers of a form, and where the others are.
_VARIANCES: dict[int, list[int]] = {
    v1.COVARIANCE_FORM_PLANAR_6: [0, 3, 5],
    v1.COVARIANCE_FORM_SPATIAL_10: [0, 4, 7, 9],
    v1.COVARIANCE_FORM_ROS_36: list(range(0, 36, 7))}
_OTHERS = {form: [place for place in range(COVARIANCE_SIZES[form])
                  if place not in places] for form, places in _VARIANCES.items()}
#: How many numbers an error transition has in the two state spaces.
_TRANSITIONS = (9, 16)
#: Field numbers, by which packed columns are written.
_NUMBERS = {field.name: field.number for field in v1.PoseColumns.DESCRIPTOR.fields}


def _are_zeros(values: Float) -> bool:
    """Whether all are zeros to the bit, as -0.0 is not."""
    return not np.ascontiguousarray(values).view(np.int64).any()


def _varint(value: int) -> bytes:
    made = bytearray()
    while value > 0x7F:
        made.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*made, value])


def _zigzag_varints(values: Integers) -> bytes:
    """The numbers as a packed field of sint64 has them, one after the other."""
    zigzag = ((values << 1) ^ (values >> 63)).view(np.uint64)[:, np.newaxis]
    shifts = np.arange(0, 64, 7, dtype=np.uint64)
    groups = zigzag >> shifts
    last = np.maximum((groups != 0).sum(axis=1), 1)[:, np.newaxis] - 1
    places = np.arange(len(shifts))
    with_flags = (groups & np.uint64(0x7F)) | np.where(
        places < last, np.uint64(0x80), np.uint64(0))
    made: NDArray[np.uint8] = with_flags.astype(np.uint8)[places <= last]
    return made.tobytes()


def _packed(name: str, content: bytes) -> bytes:
    """A packed field of PoseColumns."""
    return _varint(_NUMBERS[name] << 3 | 2) + _varint(len(content)) + content


def _doubles(name: str, values: Float) -> bytes:
    return _packed(name, np.ascontiguousarray(values, dtype="<f8").tobytes())


@dataclasses.dataclass(frozen=True)
class _Alike:
    """Poses that are alike in what they have, a row each."""

    first_sequence: int
    #: Nanoseconds since 1970; None if there are no stamps.
    stamps: Optional[Integers]
    is_geodetic: bool
    position: Float
    #: A column of headings, or four of quaternions.
    orientation: Float
    form: int
    covariance: Float
    #: May have one row less: the first pose then has none. None if no pose has any.
    transitions: Optional[Float]
    start: Optional[v1.RecordingStart]

    def columns(self) -> Optional[v1.PoseColumns]:
        """None if the time between two stamps has more than 64 bits."""
        made = v1.PoseColumns(
            first_sequence=self.first_sequence, pose_count=len(self.position),
            covariance_form=v1.CovarianceForm.Name(self.form),
            recording_start=self.start)
        parts = [self._places(), self._turns(), self._covariances()]
        if self.stamps is not None:
            steps = np.diff(self.stamps)
            if np.any((steps < 0) != (self.stamps[1:] < self.stamps[:-1])):
                return None
            made.first_stamp.seconds, made.first_stamp.nanos = divmod(
                int(self.stamps[0]), NANOSECONDS)
            parts.append(_packed("stamp_step_nanos", _zigzag_varints(steps)))
        if self.transitions is not None:
            parts.append(_doubles("error_transitions", self.transitions))
        made.MergeFromString(b"".join(parts))
        return made

    def _places(self) -> bytes:
        first, second, third = _GEODETIC if self.is_geodetic else _LOCAL
        heights = self.position[:, 2]
        return (_doubles(first, self.position[:, 0])
                + _doubles(second, self.position[:, 1])
                + (b"" if _are_zeros(heights) else _doubles(third, heights)))

    def _turns(self) -> bytes:
        return _doubles("heading_radians" if self.orientation.shape[1] == 1
                        else "quaternions", self.orientation)

    def _covariances(self) -> bytes:
        """One of those that are all the same, and the variances of diagonal ones."""
        numbers = np.ascontiguousarray(self.covariance)
        bits = numbers.view(np.int64)
        if np.array_equal(bits, np.broadcast_to(bits[0], bits.shape)):
            numbers = numbers[:1]
        if _are_zeros(np.take(numbers, _OTHERS[self.form], axis=1)):
            return _doubles("covariance_diagonals",
                            np.take(numbers, _VARIANCES[self.form], axis=1))
        return _doubles("covariances", numbers)


def columns_of(poses: Poses) -> Optional[v1.PoseColumns]:
    """Columns that say what these poses say, to the bit; None where there are none,
    such as for poses of which some have stamps and others have not, for one that begins
    a recording behind others, for sequences that do not follow each other, or for those
    that no server takes anyway. There is at least one pose."""
    form = int(poses.covariance_form[0])
    size = COVARIANCE_SIZES.get(form)
    stamped, geodetic, turned, carried = (
        ~np.isnat(poses.stamp), poses.is_geodetic, rows_with(poses.quaternion),
        rows_with(poses.error_transition))
    if (size is None or size > poses.covariance.shape[1]
            or (poses.covariance_form != form).any()
            or any((flags != flags[0]).any() for flags in (stamped, geodetic, turned))
            or (carried[1:] != carried[-1]).any() or carried[0] > carried[-1]
            or (np.diff(poses.sequence) != 1).any()
            or any(row > 0 for row in recording_rows(poses))):
        return None
    width = poses.error_transition.shape[1]
    if carried[-1] and width not in _TRANSITIONS:
        return None
    return _Alike(
        int(poses.sequence[0]), poses.stamp.view(np.int64) if stamped[0] else None,
        bool(geodetic[0]), poses.position,
        poses.quaternion if turned[0] else poses.heading[:, np.newaxis], form,
        poses.covariance[:, :size],
        poses.error_transition[0 if carried[0] else 1:] if carried[-1] else None,
        poses.recording_start[0]).columns()


def sequence_at(field: str, batch: Batch) -> Optional[int]:
    """The sequence of the pose that a field of a batch belongs to, such as
    "batch.columns.x_meters[3]" or "poses[3].stamp"; of what all poses have in common,
    that of the first. None for a field of no pose."""
    found = re.search(r"\bposes\[(\d+)\]", field)
    if found and int(found[1]) < len(batch.poses):
        return int(batch.poses[int(found[1])].sequence)
    found = re.search(r"\bcolumns\.(\w+)\[(\d+)\]", field)
    if found and found[1] in _NUMBERS:
        return int(batch.columns.first_sequence) + _row_of(
            found[1], int(found[2]), batch.columns)
    found = re.search(r"\bcolumns\.(first_stamp|recording_start)\b", field)
    return int(batch.columns.first_sequence) if found else None


def _row_of(column: str, place: int, columns: v1.PoseColumns) -> int:
    """The row of a number, by its place in its column."""
    count = columns.pose_count
    if column == "stamp_step_nanos":
        return place + 1
    if column == "error_transitions":
        given = len(columns.error_transitions)
        if given % count == 0 and given // count in _TRANSITIONS:
            return place // (given // count)
        return place // (given // (count - 1)) + 1
    form = columns.covariance_form
    width = {"quaternions": 4, "covariances": COVARIANCE_SIZES.get(form, 1),
             "covariance_diagonals": len(_VARIANCES.get(form, [0]))}.get(column, 1)
    return place // width


def _array(columns: v1.PoseColumns, name: str, *shapes: tuple[int, ...]
           ) -> Optional[NDArray[Any]]:
    """A column in the first of these shapes that it fits; None if it is empty. Internal
    if it fits none: then the server's answer is damaged."""
    column = getattr(columns, name)
    if len(column) == 0:
        return None
    kind = np.int64 if name == "stamp_step_nanos" else np.float64
    for shape in shapes:
        if len(column) == np.prod(shape):
            return np.fromiter(column, kind, len(column)).reshape(shape)
    raise Internal(f"the server's columns do not fit: {columns.pose_count} poses and "
                   f"{len(column)} numbers of {name}")


def _positions(columns: v1.PoseColumns) -> tuple[Float, bool]:
    count = columns.pose_count
    is_geodetic = len(columns.latitude_degrees) > 0
    parts = [_array(columns, name, (count,))
             for name in (_GEODETIC if is_geodetic else _LOCAL)]
    if parts[0] is None or parts[1] is None or count < 1:
        raise Internal(f"the server's columns do not fit: {count} poses without "
                       "positions")
    return np.column_stack([np.zeros(count) if part is None else part
                            for part in parts]), is_geodetic


def _stamps(columns: v1.PoseColumns) -> NDArray[np.datetime64]:
    count = columns.pose_count
    if not columns.HasField("first_stamp"):
        return np.full(count, np.datetime64("NaT", "ns"))
    steps = _array(columns, "stamp_step_nanos", (count - 1,))
    first = columns.first_stamp.seconds * NANOSECONDS + columns.first_stamp.nanos
    if (steps is None) != (count == 1) or not -2**63 < first < 2**63:
        raise Internal(f"the server's columns do not fit: {count} poses with stamps")
    stamps = np.full(count, first, np.int64)
    if steps is not None:
        stamps[1:] += np.cumsum(steps)
    return stamps.view("datetime64[ns]")


def _covariances(columns: v1.PoseColumns) -> Float:
    count, form = columns.pose_count, columns.covariance_form
    size = COVARIANCE_SIZES.get(form, 0)
    numbers = _array(columns, "covariances", (count, size), (1, size))
    if numbers is not None:
        return np.array(np.broadcast_to(numbers, (count, size)))
    places = _VARIANCES.get(form, [])
    variances = _array(columns, "covariance_diagonals", (count, len(places)),
                       (1, len(places)))
    if variances is None:
        raise Internal("the server's columns do not fit: poses without covariances")
    made = np.zeros((count, size))
    made[:, places] = variances
    return made


def _transitions(columns: v1.PoseColumns) -> Float:
    count = columns.pose_count
    given = _array(columns, "error_transitions", *(
        (rows, width) for width in _TRANSITIONS for rows in (count, count - 1)))
    if given is None:
        return np.full((count, 0), np.nan)
    made = np.full((count, given.shape[1]), np.nan)
    made[count - len(given):] = given
    return made


def arrays_of(columns: v1.PoseColumns) -> Poses:
    """The poses of columns that a server answered; Internal if they do not fit each
    other."""
    # The positions bound what a wrong count can take.
    position, is_geodetic = _positions(columns)
    count = len(position)
    heading = _array(columns, "heading_radians", (count,))
    quaternion = _array(columns, "quaternions", (count, 4))
    if (heading is None) == (quaternion is None) or not (
            0 <= columns.first_sequence < 2**63):
        raise Internal(f"the server's columns do not fit: {count} poses from sequence "
                       f"{columns.first_sequence} with {len(columns.heading_radians)} "
                       "headings")
    starts = np.full(count, None)
    if columns.HasField("recording_start"):
        starts[0] = v1.RecordingStart()
        starts[0].CopyFrom(columns.recording_start)
    return Poses(
        sequence=np.arange(count, dtype=np.uint64) + np.uint64(columns.first_sequence),
        stamp=_stamps(columns), position=position,
        is_geodetic=np.full(count, is_geodetic),
        heading=np.full(count, np.nan) if heading is None else heading,
        quaternion=np.full((count, 4), np.nan) if quaternion is None else quaternion,
        covariance=_covariances(columns),
        covariance_form=np.full(count, columns.covariance_form, np.int32),
        error_transition=_transitions(columns), recording_start=starts)
