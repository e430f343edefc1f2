"""Where recordings of a vehicle begin, and what is known of their frames.

An odometry that was switched off and on again goes on in a frame of its own. The first
pose of such a recording says so, and searches look in the recordings before it:

    client.append_poses("shuttle-7", tuesday.as_recording("after"))
    client.append_poses("shuttle-7", wednesday.as_recording("datum:10m,1deg,map"))
"""

from __future__ import annotations

import math
import re
from typing import Optional

from revisit import v1

_NUMBER = r"[+-]?(?:\d+\.?\d*|\.\d+)(?:[eE][+-]?\d+)?"
_SIZE = re.compile(rf"({_NUMBER})m,({_NUMBER})deg(?:,(.+))?", re.DOTALL)
_ALLOWED = ('"after", "after:5m,17deg", "datum:10m,1deg", "datum:10m,1deg,map" or '
            '"unknown", with the units')


def recording_start(relation: str, *, label: str = "",
                    datum_pose: Optional[tuple[float, float, float]] = None
                    ) -> v1.RecordingStart:
    """What the first pose of a recording tells of its frame, in the words of
    `revisit stream --recording`:

    - "after": the recording begins where the one before it ended, within 10 m and 0.3
      rad, or within what "after:5m,17deg" says (standard deviations of each coordinate
      and of the heading);
    - "datum:10m,1deg": its frame was placed in one that other recordings share, within
      so much at its first pose. "datum:10m,1deg,map" names the datum, whose error is
      the same for all recordings of that name. `datum_pose` is the pose of the
      recording's frame in the shared one: x, y, heading; without it, the two are the
      same;
    - "unknown": nothing is known. Only shapes are compared until a loop closure ties
      the recording to another one.

    `label` is for people. ValueError for other words."""
    start = v1.RecordingStart(label=label)
    word, colon, size = relation.partition(":")
    if datum_pose is not None and word != "datum":
        raise ValueError(f"datum_pose: got one beside {relation!r}, which has no datum")
    if relation == "after":
        return start
    if relation == "unknown":
        start.unknown = True
        return start
    matched = _SIZE.fullmatch(size) if colon and word in ("after", "datum") else None
    if matched is None or (word == "after" and matched[3]):
        raise ValueError(f"relation is {relation!r}: expected {_ALLOWED}")
    meters, degrees = float(matched[1]), float(matched[2])
    if not (meters > 0.0 and degrees > 0.0):
        raise ValueError(f"relation is {relation!r}: standard deviations are positive")
    variance, turn = meters ** 2, math.radians(degrees) ** 2
    covariance = v1.Covariance(
        form=v1.COVARIANCE_FORM_SPATIAL_10,
        values=[variance, 0, 0, 0, variance, 0, 0, variance, 0, turn])
    if word == "after":
        start.after.CopyFrom(covariance)
        return start
    start.datum.covariance.CopyFrom(covariance)
    start.datum.datum_id = matched[3] or ""
    if datum_pose is not None:
        x, y, heading = datum_pose
        start.datum.pose.CopyFrom(v1.StatePose(x_meters=x, y_meters=y,
                                               heading_radians=heading))
    return start
