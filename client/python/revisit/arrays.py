"""Poses as numpy arrays, there and back without the loss of a bit."""

from __future__ import annotations

import dataclasses
import datetime
from collections.abc import Iterable, Iterator, Sequence
from typing import TYPE_CHECKING, Any, Optional, Union

import numpy as np
from numpy.typing import ArrayLike, NDArray

from revisit import v1
from revisit._arguments import refuse
from revisit._display import html_table, spread
from revisit.recording_starts import recording_start as start_of

if TYPE_CHECKING:
    import pandas

Float = NDArray[np.float64]
Index = Union[slice, NDArray[Any], list[int]]

#: How many numbers the forms of a covariance have.
COVARIANCE_SIZES: dict[int, int] = {
    v1.COVARIANCE_FORM_PLANAR_6: 6, v1.COVARIANCE_FORM_SPATIAL_10: 10,
    v1.COVARIANCE_FORM_ROS_36: 36}
_FORMS = {size: form for form, size in COVARIANCE_SIZES.items()}
#: Matrices by their order: as they are sent.
_MATRIX_FORMS = {3: v1.COVARIANCE_FORM_PLANAR_6, 4: v1.COVARIANCE_FORM_SPATIAL_10,
                 6: v1.COVARIANCE_FORM_ROS_36}
#: The server's bound of asymmetry, relative to a matrix's largest entry.
_SYMMETRY = 1e-9

NANOSECONDS = 1_000_000_000
_NO_STAMP = np.datetime64("NaT", "ns")
_EPOCH = datetime.datetime(1970, 1, 1, tzinfo=datetime.timezone.utc)


#: The rotation of a body's axes forward, left, up into those of its name: x, y, z, w.
_BODIES: dict[str, tuple[float, float, float, float]] = {
    "flu": (0.0, 0.0, 0.0, 1.0), "camera": (0.5, -0.5, 0.5, 0.5),
    "frd": (1.0, 0.0, 0.0, 0.0)}


def _multiplied(rotations: Float, turn: tuple[float, float, float, float]) -> Float:
    """The Hamilton product of quaternions (N, 4) with one on their right."""
    x, y, z, w = rotations.T
    a, b, c, d = turn
    return np.column_stack([
        w * a + x * d + y * c - z * b, w * b - x * c + y * d + z * a,
        w * c + x * b - y * a + z * d, w * d - x * a - y * b - z * c])


def _vector(values: ArrayLike, name: str, rows: Optional[int] = None) -> Float:
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.ndim != 1 or (rows is not None and len(array) != rows):
        expected = "(N,)" if rows is None else f"({rows},)"
        raise ValueError(f"{name} has the shape {array.shape}: expected {expected}")
    return array


def _table(values: Optional[ArrayLike], name: str, rows: int,
           widths: tuple[int, ...]) -> Float:
    """A two-dimensional array with one of the widths; empty rows for None."""
    if values is None:
        return np.full((rows, 0 if 0 in widths else widths[0]), np.nan)
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.ndim != 2 or array.shape[0] != rows or array.shape[1] not in widths:
        expected = " or ".join(f"({rows}, {width})" for width in widths if width)
        raise ValueError(f"{name} has the shape {array.shape}: expected {expected}")
    return array


def rows_with(table: Float) -> NDArray[np.bool_]:
    """Which rows of a table have numbers: absent ones are NaN throughout."""
    return ~np.asarray(np.isnan(table).all(axis=1), np.bool_)


def nanoseconds_of(value: datetime.datetime) -> int:
    """Nanoseconds since 1970 of a datetime that has a time zone. ValueError if it has
    none: it may be local time or UTC."""
    if value.tzinfo is None or value.utcoffset() is None:
        raise ValueError(
            f"the datetime {value} has no time zone: "
            "value.replace(tzinfo=datetime.timezone.utc) says that it is UTC, "
            "value.astimezone() that it is local time")
    # One of pandas has nanoseconds too.
    return ((value - _EPOCH) // datetime.timedelta(microseconds=1) * 1000
            + getattr(value, "nanosecond", 0))


def _stamp_of(value: object) -> np.datetime64:
    # One of pandas that is absent is a datetime, but not equal to itself.
    if value is None or value != value:
        return _NO_STAMP
    if isinstance(value, datetime.datetime):
        return np.datetime64(nanoseconds_of(value), "ns")
    raise TypeError(f"the stamp {value!r} is no datetime")


def to_datetimes(stamps: NDArray[np.datetime64]) -> list[Optional[datetime.datetime]]:
    """Datetimes with the time zone UTC, None for NaT."""
    nanoseconds = stamps.astype("datetime64[ns]").astype(np.int64).tolist()
    return [None if absent else _EPOCH + datetime.timedelta(microseconds=count // 1000)
            for count, absent in zip(nanoseconds, np.isnat(stamps).tolist())]


def to_stamps(values: Optional[ArrayLike], rows: int) -> NDArray[np.datetime64]:
    """Stamps in nanoseconds from datetime64 of any unit, which is UTC; from datetimes
    with a time zone; or from seconds since 1970 as floats (of which a double resolves
    some 200 ns today). Absent stamps are NaT, None among datetimes, or NaN among
    seconds. Refused, since they may mean one thing or another: datetimes without a
    time zone (ValueError), and whole numbers (TypeError)."""
    stamps: NDArray[np.datetime64] = np.full(rows, _NO_STAMP)
    if values is None:
        return stamps
    array = np.asarray(values)
    if array.shape != (rows,):
        raise ValueError(f"stamps have the shape {array.shape}: expected ({rows},)")
    if array.dtype.kind == "M":
        stamps = array.astype("datetime64[ns]")
        if not np.array_equal(stamps.astype(array.dtype), array, equal_nan=True):
            raise ValueError("stamps lie outside of the years 1678 to 2261, or are "
                             "finer than nanoseconds")
        return stamps
    if array.dtype.kind == "O":
        for row, value in enumerate(array.tolist()):
            stamps[row] = _stamp_of(value)
        return stamps
    if array.dtype.kind != "f":
        raise TypeError(f"stamps are {array.dtype}: give datetime64, datetimes with a "
                        "time zone, or seconds since 1970 as floats; whole nanoseconds "
                        "become datetime64 by astype('datetime64[ns]')")
    seconds = array.astype(np.float64)
    missing = np.isnan(seconds)
    whole = np.floor(np.where(missing, 0.0, seconds))
    if np.any(np.abs(whole) >= 2**63 / NANOSECONDS):
        raise ValueError("stamps lie outside of the years 1678 to 2261: they are "
                         "seconds since 1970")
    part = np.rint((np.where(missing, 0.0, seconds) - whole) * NANOSECONDS)
    nanoseconds = whole.astype(np.int64) * NANOSECONDS + part.astype(np.int64)
    nanoseconds[missing] = _NO_STAMP.astype(np.int64)
    stamps = nanoseconds.astype("datetime64[ns]")
    return stamps


def _from_matrices(matrices: Float) -> Float:
    """The numbers that are sent of symmetric matrices (N, d, d)."""
    order = matrices.shape[1]
    if order == 6:
        return matrices.reshape(len(matrices), 36)
    largest = np.max(np.abs(matrices), axis=(1, 2), initial=0.0)
    skew = np.max(np.abs(matrices - matrices.transpose(0, 2, 1)), axis=(1, 2),
                  initial=0.0)
    wrong = np.flatnonzero(skew > _SYMMETRY * largest)
    if wrong.size:
        raise ValueError(f"covariance[{wrong[0]}] is not symmetric: entries across the "
                         f"diagonal differ by {skew[wrong[0]]:g}")
    rows, columns = np.triu_indices(order)
    return np.ascontiguousarray(matrices[:, rows, columns])


def to_covariances(values: ArrayLike, rows: int) -> tuple[Float, int]:
    """Covariances as rows of numbers, and their form.

    Takes (N, 6): xx, xy, xh, yy, yh, hh; (N, 10) and (N, 36) as the forms
    SPATIAL_10 and ROS_36 of the API; and matrices (N, 3, 3) over (x, y, heading),
    (N, 4, 4) over (x, y, z, heading), (N, 6, 6) as in ROS."""
    array = np.ascontiguousarray(values, dtype=np.float64)
    if array.ndim == 3 and array.shape in ((rows, d, d) for d in _MATRIX_FORMS):
        return _from_matrices(array), _MATRIX_FORMS[array.shape[1]]
    if array.ndim == 2 and array.shape[0] == rows and array.shape[1] in _FORMS:
        return array, _FORMS[array.shape[1]]
    raise ValueError(
        f"covariance has the shape {array.shape}: expected ({rows}, 6), ({rows}, 10), "
        f"({rows}, 36), ({rows}, 3, 3), ({rows}, 4, 4) or ({rows}, 6, 6)")


def _to_sequences(values: Optional[ArrayLike], rows: int) -> NDArray[np.uint64]:
    if values is None:
        return np.zeros(rows, dtype=np.uint64)
    array = np.asarray(values)
    if array.shape != (rows,) or (array.dtype.kind not in "ui" and rows > 0):
        raise ValueError(f"sequence is {array.dtype} of the shape {array.shape}: "
                         f"expected whole numbers of the shape ({rows},)")
    if rows > 0 and (array.min() < 1 or array.max() >= 2**63):
        raise ValueError(f"sequences lie in [1, 2^63 - 1], not {array.min()} to "
                         f"{array.max()}")
    return array.astype(np.uint64)


@dataclasses.dataclass(frozen=True, eq=False)
class Poses:
    """Poses of one vehicle as arrays, a row each. Metres and radians; frames as in
    geometry.proto. Made by `local()`, `geodetic()` or `from_messages()`."""

    #: Place in the vehicle's stream, from 1; 0 where a stream is to number them.
    sequence: NDArray[np.uint64]
    #: datetime64[ns], NaT where absent.
    stamp: NDArray[np.datetime64]
    #: (N, 3): x, y, z; or latitude and longitude in degrees, height in metres.
    position: Float
    #: Whether the position is geodetic.
    is_geodetic: NDArray[np.bool_]
    #: Counter-clockwise from +x (from east); NaN where there is a quaternion.
    heading: Float
    #: (N, 4): x, y, z, w; NaN where there is a heading.
    quaternion: Float
    #: (N, K): the numbers of the form, then NaN if another row's form has more.
    covariance: Float
    #: v1.CovarianceForm.
    covariance_form: NDArray[np.int32]
    #: (N, 9) or (N, 16), NaN where absent; (N, 0) if no pose has any.
    error_transition: Float
    #: v1.RecordingStart where a recording begins, None elsewhere.
    recording_start: NDArray[np.object_]

    @classmethod
    def local(cls, x: ArrayLike, y: ArrayLike, heading: Optional[ArrayLike],
              covariance: ArrayLike, *, z: Optional[ArrayLike] = None,
              stamps: Optional[ArrayLike] = None,
              sequence: Optional[ArrayLike] = None,
              quaternion: Optional[ArrayLike] = None,
              error_transition: Optional[ArrayLike] = None) -> Poses:
        """Poses in the vehicle's local frame. Covariances as `to_covariances()`,
        stamps as `to_stamps()` describes. Orientation is the heading or, if that
        is None, the quaternion (N, 4): x, y, z, w. Without `sequence`, a stream
        numbers the poses behind the last one that the vehicle has.

        ValueError or TypeError if shapes or kinds do not fit; values are for the
        server to judge."""
        xs = _vector(x, "x")
        rows = len(xs)
        position = np.column_stack([
            xs, _vector(y, "y", rows),
            np.zeros(rows) if z is None else _vector(z, "z", rows)])
        return cls._make(position, False, heading, covariance, stamps, sequence,
                         quaternion, error_transition)

    @classmethod
    def geodetic(cls, latitude: ArrayLike, longitude: ArrayLike,
                 heading: Optional[ArrayLike], covariance: ArrayLike, *,
                 height: Optional[ArrayLike] = None,
                 stamps: Optional[ArrayLike] = None,
                 sequence: Optional[ArrayLike] = None,
                 quaternion: Optional[ArrayLike] = None,
                 error_transition: Optional[ArrayLike] = None) -> Poses:
        """Poses on the WGS84 ellipsoid, in degrees and metres, for a vehicle whose
        coordinate frame is GEODETIC; covariances in East-North-Up. Otherwise as
        `local()`."""
        latitudes = _vector(latitude, "latitude")
        rows = len(latitudes)
        position = np.column_stack([
            latitudes, _vector(longitude, "longitude", rows),
            np.zeros(rows) if height is None else _vector(height, "height", rows)])
        return cls._make(position, True, heading, covariance, stamps, sequence,
                         quaternion, error_transition)

    @classmethod
    def _make(cls, position: Float, is_geodetic: bool, heading: Optional[ArrayLike],
              covariance: ArrayLike, stamps: Optional[ArrayLike],
              sequence: Optional[ArrayLike], quaternion: Optional[ArrayLike],
              error_transition: Optional[ArrayLike]) -> Poses:
        rows = len(position)
        if (heading is None) == (quaternion is None):
            raise ValueError("orientation is either a heading or a quaternion")
        numbers, form = to_covariances(covariance, rows)
        return cls(
            sequence=_to_sequences(sequence, rows), stamp=to_stamps(stamps, rows),
            position=position, is_geodetic=np.full(rows, is_geodetic),
            heading=(np.full(rows, np.nan) if heading is None
                     else _vector(heading, "heading", rows)),
            quaternion=_table(quaternion, "quaternion", rows, (4,)),
            covariance=numbers, covariance_form=np.full(rows, form, np.int32),
            error_transition=_table(error_transition, "error_transition", rows,
                                    (0, 9, 16)),
            recording_start=np.full(rows, None))

    @classmethod
    def from_messages(cls, messages: Iterable[v1.Pose]) -> Poses:
        """Poses as the API has them; every number stays as it is."""
        poses = list(messages)
        rows = len(poses)
        width = max((len(pose.covariance.values) for pose in poses), default=6)
        transition = max((len(pose.error_transition) for pose in poses), default=0)
        made = cls(
            sequence=np.array([pose.sequence for pose in poses], np.uint64),
            stamp=np.full(rows, _NO_STAMP), position=np.full((rows, 3), np.nan),
            is_geodetic=np.zeros(rows, np.bool_), heading=np.full(rows, np.nan),
            quaternion=np.full((rows, 4), np.nan),
            covariance=np.full((rows, width), np.nan),
            covariance_form=np.zeros(rows, np.int32),
            error_transition=np.full((rows, transition), np.nan),
            recording_start=np.full(rows, None))
        for row, pose in enumerate(poses):
            made._set(row, pose)
        return made

    def _set(self, row: int, pose: v1.Pose) -> None:
        if pose.HasField("stamp"):
            self.stamp[row] = np.datetime64(
                pose.stamp.seconds * NANOSECONDS + pose.stamp.nanos, "ns")
        if pose.HasField("geodetic"):
            self.is_geodetic[row] = True
            self.position[row] = (pose.geodetic.latitude_degrees,
                                  pose.geodetic.longitude_degrees,
                                  pose.geodetic.height_meters)
        elif pose.HasField("local"):
            self.position[row] = (pose.local.x_meters, pose.local.y_meters,
                                  pose.local.z_meters)
        if pose.HasField("quaternion"):
            turn = pose.quaternion
            self.quaternion[row] = (turn.x, turn.y, turn.z, turn.w)
        elif pose.HasField("heading_radians"):
            self.heading[row] = pose.heading_radians
        self.covariance_form[row] = pose.covariance.form
        self.covariance[row, :len(pose.covariance.values)] = pose.covariance.values
        self.error_transition[row, :len(pose.error_transition)] = (
            pose.error_transition)
        if pose.HasField("recording_start"):
            kept = v1.RecordingStart()
            kept.CopyFrom(pose.recording_start)
            self.recording_start[row] = kept

    def __len__(self) -> int:
        return len(self.sequence)

    def __getitem__(self, index: Index) -> Poses:
        """Some of the rows: a slice, a mask or a list of row numbers. As in numpy,
        a slice shares its numbers with these poses."""
        return Poses(*[getattr(self, name)[index] for name in COLUMNS])

    def numbered(self, first_sequence: int) -> Poses:
        """The same poses with consecutive sequences from this one on."""
        return dataclasses.replace(self, sequence=np.arange(
            first_sequence, first_sequence + len(self), dtype=np.uint64))

    def as_recording(self, start: Union[str, v1.RecordingStart] = "after", *,
                     label: str = "") -> Poses:
        """The same poses, of which the first begins a recording: from there on they
        are in a frame of their own. `start` is what is known of that frame, as
        `recording_start()` takes it, or the message itself. ValueError if there is no
        pose."""
        if len(self) == 0:
            raise ValueError("there is no pose that could begin a recording")
        starts = self.recording_start.copy()
        starts[0] = (start_of(start, label=label) if isinstance(start, str)
                     else start)
        return dataclasses.replace(self, recording_start=starts)

    def with_body(self, axes: str = "flu", *, yaw: float = 0.0) -> Poses:
        """The same poses, of a body whose axes are forward, left, up as the API wants
        them, where the orientations are of one with other axes: `axes` "camera" (x
        right, y down, z forward) or "frd" (forward, right, down), for quaternions only;
        then turned by `yaw` radians about its z, counter-clockwise. Positions and
        covariances are in fixed axes, and stay."""
        if axes not in _BODIES:
            raise ValueError(f"axes is {axes!r}: expected one of {', '.join(_BODIES)}")
        with_heading = ~np.isnan(self.heading)
        if axes != "flu" and with_heading.any():
            raise ValueError(f"axes {axes} are those of quaternions, and "
                             f"{with_heading.sum()} poses have only a heading")
        turn = (0.0, 0.0, np.sin(yaw / 2), np.cos(yaw / 2))
        return dataclasses.replace(
            self, heading=self.heading + yaw, quaternion=_multiplied(
                _multiplied(self.quaternion, _BODIES[axes]), turn))

    def to_messages(self) -> Iterator[v1.Pose]:
        """The poses as the API has them, one after the other."""
        sequences = self.sequence.tolist()
        stamps = self.stamp.astype(np.int64).tolist()
        absent = np.isnat(self.stamp).tolist()
        positions = self.position.tolist()
        geodetic = self.is_geodetic.tolist()
        headings = self.heading.tolist()
        turned = rows_with(self.quaternion).tolist()
        forms = self.covariance_form.tolist()
        carried = rows_with(self.error_transition).tolist()
        starts = self.recording_start.tolist()
        for row, sequence in enumerate(sequences):
            pose = v1.Pose(sequence=sequence)
            first, second, third = positions[row]
            if geodetic[row]:
                pose.geodetic.latitude_degrees = first
                pose.geodetic.longitude_degrees = second
                pose.geodetic.height_meters = third
            else:
                pose.local.x_meters = first
                pose.local.y_meters = second
                pose.local.z_meters = third
            if not absent[row]:
                pose.stamp.seconds, pose.stamp.nanos = divmod(stamps[row],
                                                              NANOSECONDS)
            if turned[row]:
                turn = pose.quaternion
                turn.x, turn.y, turn.z, turn.w = self.quaternion[row].tolist()
            else:
                pose.heading_radians = headings[row]
            pose.covariance.form = forms[row]
            size = COVARIANCE_SIZES.get(forms[row], self.covariance.shape[1])
            pose.covariance.values.extend(self.covariance[row, :size].tolist())
            if carried[row]:
                pose.error_transition.extend(self.error_transition[row].tolist())
            if starts[row] is not None:
                pose.recording_start.CopyFrom(starts[row])
            yield pose

    def times(self) -> list[Optional[datetime.datetime]]:
        """The stamps with the time zone UTC, to the microsecond that a datetime
        resolves; None where absent."""
        return to_datetimes(self.stamp)

    def _repr_html_(self) -> str:
        """The first and last rows, for a notebook."""
        columns: dict[str, NDArray[Any]] = {"sequence": self.sequence,
                                            "stamp": self.stamp}
        columns.update(zip(self._place_names(), self.position.T))
        columns["heading"] = self.heading
        return html_table(columns, f"{len(self)} poses")

    def _place_names(self) -> tuple[str, str, str]:
        return (("latitude", "longitude", "height")
                if len(self) and self.is_geodetic.all() else ("x", "y", "z"))

    def to_pandas(self) -> pandas.DataFrame:
        """A table with a row per pose, indexed by sequence, its stamps with the time
        zone UTC. Needs pandas."""
        import pandas

        columns: dict[str, Any] = {"stamp": pandas.DatetimeIndex(self.stamp, tz="UTC")}
        columns.update(zip(self._place_names(), self.position.T))
        columns["heading"] = self.heading
        if not np.isnan(self.quaternion).all():
            columns.update(spread("quaternion", self.quaternion))
        for name in ("covariance", "error_transition"):
            columns.update(spread(name, getattr(self, name)))
        return pandas.DataFrame(
            columns, index=pandas.Index(self.sequence, name="sequence"))


#: The arrays of poses, in the order in which `Poses` takes them.
COLUMNS = tuple(field.name for field in dataclasses.fields(Poses))


def recording_rows(poses: Poses) -> list[int]:
    """The rows that begin a recording."""
    return [row for row, start in enumerate(poses.recording_start.tolist())
            if start is not None]


def joined(parts: Sequence[Poses]) -> Poses:
    """The poses of all parts, one after the other."""
    if len(parts) == 1:
        return parts[0]
    if not parts:
        return Poses.from_messages([])
    columns = []
    for name in COLUMNS:
        arrays = [getattr(part, name) for part in parts]
        if name in ("covariance", "error_transition"):
            width = max(array.shape[1] for array in arrays)
            arrays = [_widened(array, width) for array in arrays]
        columns.append(np.concatenate(arrays))
    return Poses(*columns)


def _widened(table: Float, width: int) -> Float:
    """The table with columns of NaN up to this width."""
    missing = width - table.shape[1]
    return table if missing == 0 else np.pad(
        table, ((0, 0), (0, missing)), constant_values=np.nan)


PosesLike = Union[Poses, Iterable[v1.Pose]]


def pose_messages(poses: Iterable[v1.Pose]) -> Iterator[v1.Pose]:
    """Messages that a caller gave instead of `Poses`; TypeError for others."""
    if not isinstance(poses, Iterable) or isinstance(poses, str):
        refuse("poses", poses, "revisit.Poses or v1.Pose messages")
    for row, pose in enumerate(poses):
        if not isinstance(pose, v1.Pose):
            refuse(f"poses[{row}]", pose, "a v1.Pose, or for all of them revisit.Poses")
        yield pose
