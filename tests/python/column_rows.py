"""Poses that are alike as columns want them."""

import numpy as np

from revisit import Poses
from wire import COVARIANCE_PLACES

def random_poses(rng, count, first=1):
    """Poses that are alike in some way."""
    def numbers(*shape):
        made = rng.normal(size=shape) * 10.0 ** rng.integers(-3, 3)
        return np.where(rng.random(shape) < 0.1, rng.choice([0.0, -0.0, 5e-324]), made)

    def coin():
        return rng.random() < 0.5

    form = int(rng.integers(1, 4))
    size, places = COVARIANCE_PLACES[form]
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
