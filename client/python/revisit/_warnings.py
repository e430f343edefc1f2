"""The texts of a server's warnings about poses, for whoever wrote the program."""

from __future__ import annotations

import math

from revisit import v1
from revisit._text import printable


def _off_course(warning: v1.Warning) -> str:
    try:
        turned = math.radians(float(warning.metadata["turned_degrees"]))
    except (KeyError, ValueError):
        return ("heading is counter-clockwise from +x, in radians; a quaternion is x, "
                "y, z, w, with the body's axes forward, left, up: poses.with_body() "
                "turns others")
    return (f"poses.with_body(yaw={-turned:.4f}) turns them, if the vehicle drives "
            "forwards")


_ADVICE = {
    v1.WARNING_REASON_HEADING_BEYOND_TURN: "np.radians() makes radians of degrees",
    v1.WARNING_REASON_STAMPS_BACKWARDS:
        "give stamps in the order of the sequence, in one unit: datetime64, datetime, "
        "or seconds since 1970",
    v1.WARNING_REASON_IMPLAUSIBLE_SPEED:
        "give positions in metres, and stamps as datetime64, datetime, or seconds "
        "since 1970",
    v1.WARNING_REASON_POSITIONS_LIKE_DEGREES:
        'create the vehicle with coordinate_frame="geodetic" and make its poses by '
        "Poses.geodetic()",
    v1.WARNING_REASON_STEEP_PATH:
        "turn positions and orientations into axes whose z points up: of a camera's "
        "x, y, z, they are z, -x, -y",
    v1.WARNING_REASON_FINDING: "update_vehicle() takes settings as keywords",
}


def text_of(warning: v1.Warning) -> str:
    """The server's words, and what to do in the words of this package. Fit for a
    terminal."""
    advice = (_off_course(warning)
              if warning.reason == v1.WARNING_REASON_HEADING_OFF_COURSE
              else _ADVICE.get(warning.reason))
    said = printable(warning.message)
    return f"{said}. What to do: {advice}" if advice else said
