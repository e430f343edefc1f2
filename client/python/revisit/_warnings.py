"""The texts of a server's warnings about poses, for whoever wrote the program."""

from __future__ import annotations

import math
from typing import Optional

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
    v1.WARNING_REASON_COVARIANCES_KEPT:
        "give Poses larger covariances, which grow along the path if errors are those "
        "of dead reckoning",
    v1.WARNING_REASON_FINDING: "update_vehicle() takes settings as keywords",
}


#: For findings that no setting mends.
_FINDING_ADVICE = {
    v1.FindingCode.Name(v1.FINDING_CODE_NEW_FRAME):
        'let the first pose in the new frame begin a recording: '
        'poses.as_recording("after") if the vehicle stayed about where it was, '
        '"datum:10m,1deg" if the frame was placed in one that all share, "unknown" '
        "otherwise; read_recording([first, second], recording=...) takes the same "
        "words",
    v1.FindingCode.Name(v1.FINDING_CODE_COVARIANCES_WITHOUT_LEVER):
        "searches carry the heading's variance along the path themselves; give Poses "
        "covariances that are propagated, with those of position and heading, to have "
        "yours count",
    v1.FindingCode.Name(v1.FINDING_CODE_COVARIANCES_RESET):
        'give Poses covariances that add up along the path, or, if the odometry began '
        'anew there, begin a recording: poses.as_recording("after")',
}


def _advice(warning: v1.Warning) -> Optional[str]:
    if warning.reason == v1.WARNING_REASON_HEADING_OFF_COURSE:
        return _off_course(warning)
    return (_FINDING_ADVICE.get(warning.metadata.get("finding", ""))
            or _ADVICE.get(warning.reason))


def kind_of(warning: v1.Warning) -> str:
    """What tells warnings apart: each new frame is one of its own."""
    finding = warning.metadata.get("finding", "")
    return (f"{finding} {warning.metadata.get('sequence', '')}"
            if finding in _FINDING_ADVICE else finding or str(warning.reason))


def text_of(warning: v1.Warning) -> str:
    """The server's words, and what to do in the words of this package. Fit for a
    terminal."""
    advice = _advice(warning)
    said = printable(warning.message)
    return f"{said}. What to do: {advice}" if advice else said
