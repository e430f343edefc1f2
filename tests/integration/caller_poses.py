"""Poses that a server takes, and those that are wrong in one thing."""

import math

import grpc

from stubs import api
from wire import pose

INVALID = grpc.StatusCode.INVALID_ARGUMENT
NAN, INF = math.nan, math.inf

STORED = 3  # Poses of every vehicle before a bad call.


def spatial_pose(number, **fields):
    return pose_with(number, **{"covariance": api.Covariance(
        form=api.COVARIANCE_FORM_SPATIAL_10,
        values=[1, 0, 0, 0, 1, 0, 0, 1, 0, 0.01]), **fields})


def pose_with(number, **fields):
    """A good pose with some fields set otherwise; None clears one."""
    good = pose(number, x=float(number))
    for name, value in fields.items():
        good.ClearField(name)
        if value is None:
            continue
        if hasattr(value, "SerializeToString"):
            getattr(good, name).CopyFrom(value)
        elif isinstance(value, (list, tuple)):
            getattr(good, name).extend(value)
        else:
            setattr(good, name, value)
    return good


def local(x=0.0, y=0.0, z=0.0):
    return api.LocalPosition(x_meters=x, y_meters=y, z_meters=z)


def geodetic(latitude=43.8, longitude=-79.5, height=150.0):
    return api.GeodeticPosition(latitude_degrees=latitude,
                                longitude_degrees=longitude,
                                height_meters=height)


def planar(*values):
    return api.Covariance(form=api.COVARIANCE_FORM_PLANAR_6, values=values)


def quaternion(x, y, z, w):
    return {"quaternion": api.Quaternion(x=x, y=y, z=z, w=w)}


def ros(changes):
    """A good 6x6 with some entries set otherwise."""
    values = [0.0] * 36
    for i in range(6):
        values[7 * i] = 1.0
    for index, value in changes.items():
        values[index] = value
    return api.Covariance(form=api.COVARIANCE_FORM_ROS_36, values=values)


GOOD_6 = (0.01, 0.0, 0.0, 0.01, 0.0, 1e-4)
SPATIAL = {"state_space": api.STATE_SPACE_SPATIAL}
GEODETIC = {"coordinate_frame": api.COORDINATE_FRAME_GEODETIC}
FILTER = {"correlation_model": api.CORRELATION_MODEL_FILTER}
IDENTITY_9 = (1, 0, 0, 0, 1, 0, 0, 0, 1)


def good_pose(number, settings, **changes):
    """A pose that a vehicle of these settings takes."""
    fields = {}
    if settings is GEODETIC:
        fields["geodetic"] = geodetic(latitude=43.8 + number * 1e-5)
    if settings is FILTER and number > 1:
        fields["error_transition"] = IDENTITY_9
    make = spatial_pose if settings is SPATIAL else pose_with
    return make(number, **{**fields, **changes})
