"""Vehicles that have driven the same streets, each in a frame of its own, and searches
in their group."""

import math

import numpy as np

from grouping import add_member, create_group
from stubs import api
from wire import append, batches

# The frames of the vehicles in that of the site: x, y, heading.
FRAMES = {"one": (0.0, 0.0, 0.0), "two": (300.0, -80.0, 0.7),
          "three": (-50.0, 900.0, -2.0)}
# Which of the drive's poses each has.
PARTS = {"one": (0, 2000), "two": (0, 1100), "three": (900, 2000)}


def name_of(vehicle):
    return f"vehicles/{vehicle}"


def moved(poses, frame):
    """The poses, numbered from 1, in a frame that lies there in theirs."""
    x0, y0, turn = frame
    c, s = math.cos(turn), math.sin(turn)
    back = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    upper = np.triu_indices(3)
    result = []
    for number, given in enumerate(poses, 1):
        pose = api.Pose()
        pose.CopyFrom(given)
        pose.sequence = number
        dx, dy = given.local.x_meters - x0, given.local.y_meters - y0
        pose.local.x_meters, pose.local.y_meters = c * dx + s * dy, c * dy - s * dx
        pose.heading_radians = math.remainder(given.heading_radians - turn,
                                              math.tau)
        full = np.zeros((3, 3))
        full[upper] = given.covariance.values
        full = full + np.triu(full, 1).T
        pose.covariance.values[:] = (back @ full @ back.T)[upper]
        result.append(pose)
    return result


def datum_of(frame):
    x, y, heading = frame
    return api.Datum(
        pose=api.StatePose(x_meters=x, y_meters=y, heading_radians=heading),
        covariance=api.Covariance(form=api.COVARIANCE_FORM_PLANAR_6,
                                  values=[9.0, 0.0, 0.0, 9.0, 0.0, 4e-4]))


def make_vehicle(stub, drive, vehicle, prefix=""):
    stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id=prefix + vehicle))
    first, last = PARTS[vehicle]
    for batch in batches(moved(drive[0][first:last], FRAMES[vehicle]), 256):
        append(stub, name_of(prefix + vehicle), batch)


def make_site(stub, vehicles=FRAMES, prefix=""):
    group = create_group(stub, f"{prefix}site").name
    for vehicle in vehicles:
        add_member(stub, group, name_of(prefix + vehicle),
                   datum_of(FRAMES[vehicle]))
    return group


def search(stub, vehicle="one", sequence=0, group="groups/site", options=None,
           timeout=60, **scope):
    request = api.FindCandidatesRequest(
        vehicle=name_of(vehicle), sequence=sequence,
        options=options or api.CandidateOptions())
    request.options.scope.CopyFrom(api.SearchScope(group=group, **scope))
    return stub.FindCandidates(request, timeout=timeout).candidates
