"""Poses from recordings of ROS: rosbag2 (SQLite, MCAP) and ROS 1 bags.

    with client.stream_poses("shuttle-7") as stream:
        durable = stream.wait_until_opened()
        for batch in revisit.rosbag.iter_poses("drive", after=durable):
            stream.append(batch)

Topics of nav_msgs/Odometry and geometry_msgs/PoseWithCovarianceStamped become
local poses with their orientation and their 36 numbers of covariance.
sensor_msgs/NavSatFix becomes geodetic poses, for a vehicle whose coordinate frame is
GEODETIC and whose correlation model is INDEPENDENT. A fix has no heading: it is the
course from an earlier fix, and fixes that have hardly moved are left out.

An odometry that began anew while the bag was written, and leaps back to its start or to
the origin without a larger covariance, begins a recording there (Pose.recording_start,
"after"): the poses behind it are in a frame of their own. A logged line says so.

Needs the package rosbags, the extra `rosbag` of this one.
"""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import math
import os
import pathlib
from collections.abc import Callable, Iterator
from typing import Any, Optional, Union

import numpy as np
from numpy.typing import ArrayLike, NDArray

from revisit._text import printable
from revisit.arrays import Poses
from revisit.recording_starts import recording_start

_log = logging.getLogger("revisit")

Float = NDArray[np.float64]
PathLike = Union[str, "os.PathLike[str]"]

ODOMETRY = "nav_msgs/msg/Odometry"
POSE = "geometry_msgs/msg/PoseWithCovarianceStamped"
FIX = "sensor_msgs/msg/NavSatFix"
#: Message types that become poses.
SUPPORTED = (ODOMETRY, POSE, FIX)

_NANOSECONDS = 1_000_000_000
# WGS84: semi-major axis in metres, first eccentricity squared.
_SEMI_MAJOR = 6_378_137.0
_ECCENTRICITY_SQUARED = 6.69437999014e-3
#: From a fix farther away than this the course is not known, in metres.
_LONGEST_CHORD = 100.0
#: sensor_msgs/NavSatFix and NavSatStatus.
_COVARIANCE_TYPE_UNKNOWN = 0
_STATUS_NO_FIX = -1
# When an odometry began anew, as the service tells a new frame from poses.
_LEAP_METERS = 20.0
_USUAL_STEPS = 4.0
_RETURN_METERS = 1.0
_RETURN_RADIANS = 0.2
_FALL = 4.0


@dataclasses.dataclass
class _Row:
    """A pose that a message makes."""

    stamp: int
    position: tuple[float, float, float]
    covariance: Float
    quaternion: Optional[tuple[float, float, float, float]] = None
    heading: float = math.nan
    #: Whether an odometry began anew with it.
    restarts: bool = False


def iter_poses(path: PathLike, topic: Optional[str] = None, *,
               covariance: Optional[ArrayLike] = None, course_step: float = 5.0,
               after: int = 0, batch: int = 1000,
               recordings: bool = True) -> Iterator[Poses]:
    """The poses of a topic in the order in which they were recorded, numbered from
    1, some at a time.

    `path` is the folder of a rosbag2 or a ROS 1 file; newer versions of rosbags
    open a single .mcap or .db3 file too. Without `topic`, the bag must have one
    topic of a supported type. `covariance` stands in where messages state none (all
    zeros, or of unknown type): 6x6 as in ROS for poses, 3x3 over east, north and up
    for fixes. `course_step` is the least distance in metres over which the course of
    fixes is taken. Poses up to the sequence `after` are left out, to go on where a
    vehicle stands.

    Without `recordings`, an odometry that began anew is taken for one frame.

    ImportError without rosbags; ValueError if the bag cannot be read or has no such
    topic, or if a message states no covariance."""
    rows: list[_Row] = []
    is_geodetic = False
    sequence = 0
    for is_geodetic, row in _marked(
            _rows(path, topic, covariance, course_step), path, recordings):
        sequence += 1
        if sequence <= after:
            continue
        rows.append(row)
        if len(rows) == batch:
            yield _poses(rows, is_geodetic, sequence)
            rows = []
    if rows:
        yield _poses(rows, is_geodetic, sequence)


def read_poses(path: PathLike, topic: Optional[str] = None, *,
               covariance: Optional[ArrayLike] = None,
               course_step: float = 5.0, recordings: bool = True) -> Poses:
    """All poses of a topic at once, as `iter_poses()` describes."""
    rows, is_geodetic = [], False
    for is_geodetic, row in _marked(
            _rows(path, topic, covariance, course_step), path, recordings):
        rows.append(row)
    if not rows:
        raise ValueError(f"{os.fspath(path)} has no usable message of the topic")
    return _poses(rows, is_geodetic, len(rows))


def topics(path: PathLike) -> dict[str, str]:
    """The types of the topics that can become poses, by name."""
    with _open(path) as reader:
        return {connection.topic: connection.msgtype
                for connection in reader.connections
                if connection.msgtype in SUPPORTED}


def _poses(rows: list[_Row], is_geodetic: bool, last_sequence: int) -> Poses:
    position = np.array([row.position for row in rows])
    numbers = np.array([row.covariance for row in rows])
    stamps = np.array([row.stamp for row in rows]).astype("datetime64[ns]")
    sequence = np.arange(last_sequence - len(rows) + 1, last_sequence + 1)
    if is_geodetic:
        return Poses.geodetic(
            position[:, 0], position[:, 1], [row.heading for row in rows], numbers,
            height=position[:, 2], stamps=stamps, sequence=sequence)
    poses = Poses.local(
        position[:, 0], position[:, 1], None, numbers, z=position[:, 2],
        stamps=stamps, sequence=sequence,
        quaternion=np.array([row.quaternion for row in rows]))
    for place, row in enumerate(rows):
        if row.restarts:
            poses.recording_start[place] = recording_start("after")
    return poses


def _marked(rows: Iterator[tuple[bool, _Row]], path: PathLike,
            recordings: bool) -> Iterator[tuple[bool, _Row]]:
    """The rows, marked where an odometry began anew."""
    watch = _Restarts()
    for number, (is_geodetic, row) in enumerate(rows, 1):
        if recordings and not is_geodetic and watch.observe(row):
            row.restarts = True
            _log.warning(
                "%s: the odometry is back at its start with pose %d, so it began anew: "
                "another recording begins (recordings=False: it is in the same frame)",
                printable(os.fspath(path)), number)
        yield is_geodetic, row


def _yaw(turn: tuple[float, float, float, float]) -> float:
    x, y, z, w = turn
    return math.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))


class _Restarts:
    """Watches for where an odometry began anew: it is back at its first pose or at the
    origin, heading as there, and has leapt there while nothing says that more is
    uncertain, or its covariance has fallen, which errors that add up do not allow."""

    def __init__(self) -> None:
        self._first: Optional[_Row] = None
        self._last: Optional[_Row] = None
        self._last_step = 0.0

    def observe(self, row: _Row) -> bool:
        step = 0.0
        if self._last is not None:
            step = math.dist(self._last.position[:2], row.position[:2])
        restarts = self._last is not None and self._is_restart(self._last, row, step)
        if restarts or self._first is None:
            self._first = row
        self._last, self._last_step = row, 0.0 if restarts else step
        return restarts

    def _is_restart(self, last: _Row, row: _Row, step: float) -> bool:
        assert self._first is not None
        assert self._first.quaternion is not None and row.quaternion is not None
        yaw = _yaw(row.quaternion)
        places = ((self._first.position[:2], _yaw(self._first.quaternion)),
                  ((0.0, 0.0), 0.0))
        if not any(math.dist(place, row.position[:2]) <= _RETURN_METERS
                   and abs(math.remainder(yaw - heading, math.tau)) <= _RETURN_RADIANS
                   for place, heading in places):
            return False
        was, now = last.covariance, row.covariance
        # Positions vary in x and y, headings about z.
        variance_was, variance_now = was[0] + was[7], now[0] + now[7]
        turn_was, turn_now = was[35], now[35]
        if step >= _LEAP_METERS and step >= _USUAL_STEPS * self._last_step:
            return bool(variance_now <= variance_was and turn_now <= turn_was)
        dx = row.position[0] - last.position[0]
        dy = row.position[1] - last.position[1]
        carried = (variance_was + 2.0 * (dx * was[11] - dy * was[5])
                   + (dx * dx + dy * dy) * turn_was)
        return bool(_FALL * variance_now < min(variance_was, carried)
                    and _FALL * turn_now < turn_was)


def _open(path: PathLike) -> Any:
    try:
        from rosbags.highlevel import AnyReader, AnyReaderError
        from rosbags.typesys import Stores, get_typestore
    except ImportError as error:
        raise ImportError("reading bags needs the package rosbags: install "
                          "revisit[rosbag]") from error
    bag = pathlib.Path(path)
    try:
        # Bags of ROS 2 before Iron do not describe their messages; those of these
        # types have stayed the same.
        reader = AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
        reader.open()
    except (AnyReaderError, UnicodeError) as error:
        raise ValueError(f"{bag} cannot be read as a bag (of rosbag2, the folder with "
                         f"metadata.yaml): {error}") from error
    return contextlib.closing(reader)


def _choose(reader: Any, path: PathLike, topic: Optional[str]) -> list[Any]:
    """The connections of one topic."""
    usable = {connection.topic: connection.msgtype for connection in reader.connections
              if connection.msgtype in SUPPORTED}
    known = ", ".join(f"{name} ({kind})" for name, kind in sorted(usable.items()))
    if topic is None and len(usable) != 1:
        raise ValueError(
            f"{os.fspath(path)} has {len(usable)} topics that can become poses"
            + (f": {known}; name one of them" if usable else
               f": there is none of {', '.join(SUPPORTED)}"))
    if topic is None:
        topic = next(iter(usable))
    if topic not in usable:
        raise ValueError(f"{os.fspath(path)} has no topic {topic} of a type that can "
                         f"become poses; it has {known or 'none'}")
    return [connection for connection in reader.connections
            if connection.topic == topic]


def _rows(path: PathLike, topic: Optional[str], covariance: Optional[ArrayLike],
          course_step: float) -> Iterator[tuple[bool, _Row]]:
    with _open(path) as reader:
        connections = _choose(reader, path, topic)
        is_fix = connections[0].msgtype == FIX
        order = 3 if is_fix else 6
        stand_in: Optional[Float] = None
        if covariance is not None:
            stand_in = np.asarray(covariance, dtype=np.float64).reshape(-1)
            if stand_in.shape != (order * order,):
                raise ValueError(f"the covariance has the shape "
                                 f"{np.shape(covariance)}: for "
                                 f"{connections[0].msgtype} it is {order}x{order}")
        convert: Callable[[Any, int, Float], Optional[_Row]] = (
            _Courses(course_step).row if is_fix else _pose_row)
        for number, (connection, time, data) in enumerate(
                reader.messages(connections=connections)):
            message = reader.deserialize(data, connection.msgtype)
            own = _own_covariance(message, is_fix)
            if own is None:
                own = stand_in
            if own is None:
                raise ValueError(
                    f"message {number} of {connection.topic} states no covariance: "
                    f"give one that stands in, {order}x{order}")
            row = convert(message, _stamp(message, time), own)
            if row is not None:
                yield is_fix, row


def _own_covariance(message: Any, is_fix: bool) -> Optional[Float]:
    """None where the message states none."""
    if is_fix and message.position_covariance_type == _COVARIANCE_TYPE_UNKNOWN:
        return None
    numbers = np.array(message.position_covariance if is_fix
                       else message.pose.covariance, dtype=np.float64)
    # Drivers that do not know send zeros or, in the first number, -1.
    return numbers if numbers.any() and numbers[0] != -1.0 else None


def _stamp(message: Any, recorded: int) -> int:
    """Nanoseconds since 1970: of the measurement or, where it is not stamped, of
    the recording."""
    stamp = message.header.stamp
    return int(stamp.sec) * _NANOSECONDS + int(stamp.nanosec) or recorded


def _pose_row(message: Any, stamp: int, covariance: Float) -> _Row:
    pose = message.pose.pose
    turn = pose.orientation
    return _Row(stamp, (pose.position.x, pose.position.y, pose.position.z), covariance,
                quaternion=(turn.x, turn.y, turn.z, turn.w))


def _east_north(origin: tuple[float, float, float],
                position: tuple[float, float, float]) -> tuple[float, float]:
    """Metres east and north of a position nearby."""
    latitude = math.radians(origin[0])
    curved = 1.0 - _ECCENTRICITY_SQUARED * math.sin(latitude) ** 2
    across = _SEMI_MAJOR / math.sqrt(curved) + origin[2]
    along = (_SEMI_MAJOR * (1.0 - _ECCENTRICITY_SQUARED) / curved ** 1.5) + origin[2]
    turned = math.remainder(position[1] - origin[1], 360.0)
    return (math.radians(turned) * across * math.cos(latitude),
            math.radians(position[0] - origin[0]) * along)


class _Courses:
    """Headings of fixes, for a vehicle that faces where it moves."""

    def __init__(self, least_meters: float) -> None:
        if not least_meters > 0.0:
            raise ValueError(f"course_step is {least_meters} m: it is positive")
        self._least = least_meters
        self._from: Optional[tuple[tuple[float, float, float], Float]] = None

    def row(self, message: Any, stamp: int, covariance: Float) -> Optional[_Row]:
        """The pose of a fix, or None while its course is not known.

        The variance of the course is that of the chord's ends across it, as if
        their errors were independent, over the chord's length squared."""
        # Receivers without a height send NaN; it matters little to what is planar.
        position = (float(message.latitude), float(message.longitude),
                    float(np.nan_to_num(message.altitude)))
        if message.status.status == _STATUS_NO_FIX or math.isnan(sum(position)):
            return None
        start, self._from = self._from, (position, covariance)
        if start is None:
            return None
        east, north = _east_north(start[0], position)
        length = math.hypot(east, north)
        if length > _LONGEST_CHORD:
            return None
        if length < self._least:
            self._from = start
            return None
        left = np.array([-north, east]) / length
        both = (start[1] + covariance).reshape(3, 3)[:2, :2]
        variance = float(left @ both @ left) / length ** 2
        ee, en, eu, _, nn, nu, _, _, uu = covariance.tolist()
        return _Row(stamp, position,
                    np.array([ee, en, eu, 0.0, nn, nu, 0.0, uu, 0.0, variance]),
                    heading=math.atan2(north, east))
