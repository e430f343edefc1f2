"""Rounds of stream, verify, optimise and revise through the package, with GTSAM: each
leaves the trajectory several times better than its odometry, although the vehicle goes
on in the frame of that. The command line's are in
tests/integration/test_closing_the_circle.py."""

import importlib
import math
import random
import sys

import numpy as np
import pytest

import revisit
from revisit import v1
from verified_places import (
    BETTER_BY,
    SIGMA_METERS,
    SIGMA_RADIANS,
    install_gtsam,
    is_one_place,
    measured,
    position_error,
)

CLOSURE = np.diag([SIGMA_METERS ** 2, SIGMA_METERS ** 2, SIGMA_RADIANS ** 2])
UPPER = np.triu_indices(3)


@pytest.fixture(scope="module")
def gtsam(tmp_path_factory):
    """The optimiser, behind the packages of the tests' own environment."""
    target = tmp_path_factory.mktemp("gtsam")
    install_gtsam(target)
    sys.path.append(str(target))
    try:
        yield importlib.import_module("gtsam")
    finally:
        sys.path.remove(str(target))


def states(poses):
    """x, y, heading of each pose."""
    return np.column_stack([poses.position[:, :2], poses.heading])


def covariances(poses):
    full = np.zeros((len(poses), 3, 3))
    full[:, UPPER[0], UPPER[1]] = poses.covariance
    full[:, UPPER[1], UPPER[0]] = poses.covariance
    return full


def steps(sent):
    """From each pose to the next as it was sent: relative pose, and the covariance that
    the step adds, both in the axes of the earlier body."""
    at, claimed = states(sent), covariances(sent)
    for i in range(len(at) - 1):
        dx, dy, turn = at[i + 1] - at[i]
        carry = np.array([[1, 0, -dy], [0, 1, dx], [0, 0, 1.0]])
        added = claimed[i + 1] - carry @ claimed[i] @ carry.T
        c, s = math.cos(at[i, 2]), math.sin(at[i, 2])
        body = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1.0]])
        # A vehicle that stands adds nothing, and numbers are rounded.
        yield (body @ [dx, dy, turn],
               body @ added @ body.T + np.diag([1e-6, 1e-6, 1e-10]))


def optimised(gtsam, client, vehicle):
    """(poses, sum of squared, whitened errors): the vehicle's graph after GTSAM."""
    sent = client.poses(vehicle, as_sent=True)
    now = states(client.poses(vehicle))
    graph, initial = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for i, pose in enumerate(now):
        initial.insert(i, gtsam.Pose2(*pose))
    graph.add(gtsam.PriorFactorPose2(0, initial.atPose2(0),
                                     gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)))
    noise = gtsam.noiseModel.Gaussian.Covariance
    for i, (step, covariance) in enumerate(steps(sent)):
        graph.add(gtsam.BetweenFactorPose2(i, i + 1, gtsam.Pose2(*step),
                                           noise(covariance)))
    for closure in client.list_loop_closures(vehicle):
        seen = closure.measurement
        graph.add(gtsam.BetweenFactorPose2(
            closure.matched_sequence - 1, closure.query_sequence - 1,
            gtsam.Pose2(seen.x_meters, seen.y_meters, seen.heading_radians),
            noise(CLOSURE)))
    result = gtsam.LevenbergMarquardtOptimizer(graph, initial).optimize()
    found = [result.atPose2(i) for i in range(len(now))]
    return (revisit.Poses.local(
        x=[p.x() for p in found], y=[p.y() for p in found],
        heading=[p.theta() for p in found], covariance=covariances(sent),
        sequence=sent.sequence), 2.0 * graph.error(result))


def test_rounds_with_new_drives_between_them_converge(gtsam, client, new_vehicle,
                                                      boreas):
    vehicle = new_vehicle()
    drive, columns = boreas
    truth = list(zip(columns["gt_x"].tolist(), columns["gt_y"].tolist(),
                     columns["gt_yaw"].tolist()))
    asked = revisit.StreamOptions(
        send_candidates=True,
        candidate_options=v1.CandidateOptions(direction=v1.DIRECTION_EITHER))
    draw = random.Random(20101018)
    start = confirmed = 0
    for end in (1400, 1740, len(drive)):
        with client.stream_poses(vehicle, asked) as stream:
            stream.append(drive[start:end])
            stream.finish()
            answers = stream.take_candidates()
        start = end
        for candidate in (answer.candidates[0] for answer in answers
                          if answer.candidates):
            pair = candidate.query.sequence, candidate.matched.sequence
            relative = measured(truth, *pair, draw)
            if candidate.verdict != v1.VERDICT_ACCEPTED or not is_one_place(relative):
                continue
            client.add_loop_closure(vehicle, candidate, relative=relative,
                                    covariance=CLOSURE)
            confirmed += 1
        revision = client.get_vehicle(vehicle).revision
        poses, error = optimised(gtsam, client, vehicle)
        client.revise_poses(vehicle, poses, expected_revision=revision)
        drifted = position_error(list(client.list_poses(vehicle, as_sent=True)),
                                 truth[:end])
        after = position_error(list(client.list_poses(vehicle)), truth[:end])
        print(f"{end} poses: error {drifted:.2f} m as sent, {after:.2f} m after "
              f"{confirmed} closures, sum of squares {error:.0f}")
        assert after * BETTER_BY <= drifted
        assert 0.3 < error / (3 * confirmed) < 3.0
        # The graph of nodes is had both ways, too.
        now = client.export_pose_graph(vehicle).nodes
        sent = client.export_pose_graph(vehicle, as_sent=True).nodes
        drift = np.hypot(now["x"][-1] - sent["x"][-1], now["y"][-1] - sent["y"][-1])
        assert drift > after
