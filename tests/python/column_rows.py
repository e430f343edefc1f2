"""Poses that are alike as columns want them, and the slow way from columns to
messages."""

import numpy as np

from revisit import Poses, v1

FORMS = {v1.COVARIANCE_FORM_PLANAR_6: (6, [0, 3, 5]),
         v1.COVARIANCE_FORM_SPATIAL_10: (10, [0, 4, 7, 9]),
         v1.COVARIANCE_FORM_ROS_36: (36, list(range(0, 36, 7)))}


def random_poses(rng, count, first=1):
    """Poses that are alike in some way."""
    def numbers(*shape):
        made = rng.normal(size=shape) * 10.0 ** rng.integers(-3, 3)
        return np.where(rng.random(shape) < 0.1, rng.choice([0.0, -0.0, 5e-324]), made)

    def coin():
        return rng.random() < 0.5

    form = int(rng.integers(1, 4))
    size, places = FORMS[form]
    covariance = numbers(count, size)
    if coin():
        covariance[:, [place for place in range(size) if place not in places]] = 0.0
    if coin():
        covariance[:] = covariance[0]
    fields = {"sequence": np.arange(first, first + count)}
    if coin():
        fields["stamps"] = rng.integers(-2**61, 2**61, count).astype("datetime64[ns]")
    if coin():
        fields["error_transition"] = numbers(count, int(rng.choice([9, 16])))
        if coin():
            fields["error_transition"][0] = np.nan
    heading = numbers(count) if coin() else None
    if heading is None:
        fields["quaternion"] = numbers(count, 4)
    name, make = (("z", Poses.local) if coin() else ("height", Poses.geodetic))
    if coin():
        fields[name] = numbers(count)
    made = make(numbers(count), numbers(count), heading, covariance, **fields)
    return made.as_recording("unknown", label="again") if coin() else made


def expanded(columns):
    """The poses of columns, one number after the other."""
    count = columns.pose_count
    size, places = FORMS[columns.covariance_form]
    given = len(columns.error_transitions)
    width = next((width for width in (9, 16)
                  if given > 0 and given in (width * count, width * (count - 1))), 0)
    without = count - given // width if width else 0
    stamp = columns.first_stamp.ToNanoseconds()
    for row in range(count):
        pose = v1.Pose(sequence=columns.first_sequence + row)
        if columns.HasField("first_stamp"):
            stamp += columns.stamp_step_nanos[row - 1] if row > 0 else 0
            pose.stamp.seconds, pose.stamp.nanos = divmod(stamp, 10**9)
        if columns.x_meters:
            pose.local.x_meters = columns.x_meters[row]
            pose.local.y_meters = columns.y_meters[row]
            pose.local.z_meters = columns.z_meters[row] if columns.z_meters else 0.0
        else:
            pose.geodetic.latitude_degrees = columns.latitude_degrees[row]
            pose.geodetic.longitude_degrees = columns.longitude_degrees[row]
            pose.geodetic.height_meters = (
                columns.height_meters[row] if columns.height_meters else 0.0)
        if columns.quaternions:
            turn = pose.quaternion
            turn.x, turn.y, turn.z, turn.w = columns.quaternions[4 * row:4 * row + 4]
        else:
            pose.heading_radians = columns.heading_radians[row]
        pose.covariance.form = columns.covariance_form
        values = [0.0] * size
        if columns.covariances:
            begin = 0 if len(columns.covariances) == size else row * size
            values = columns.covariances[begin:begin + size]
        else:
            begin = (0 if len(columns.covariance_diagonals) == len(places)
                     else row * len(places))
            for place, one in zip(places, columns.covariance_diagonals[begin:]):
                values[place] = one
        pose.covariance.values.extend(values)
        if width and row >= without:
            begin = (row - without) * width
            pose.error_transition.extend(columns.error_transitions[begin:begin + width])
        if row == 0 and columns.HasField("recording_start"):
            pose.recording_start.CopyFrom(columns.recording_start)
        yield pose
