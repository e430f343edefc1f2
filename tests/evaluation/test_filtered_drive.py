"""The filter of GNSS fixes and odometry: what it claims is what is true."""

import math
import pathlib
import random
import sys

import numpy as np
import pytest

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import filtered_drive
from filtered_drive import Filter, Fix, Frame

SIGMA = 2.0  # of fixes, metres


def bends(poses):
    """A path at 10 m/s and 5 Hz that turns left and right: [(t, pose), ...]."""
    x, y, heading = 3.0, -5.0, 0.4
    for number in range(poses):
        yield 0.2 * number, (x, y, math.remainder(heading, math.tau))
        turn = 0.05 * math.sin(number / 40.0)
        x += 2.0 * math.cos(heading + turn / 2.0)
        y += 2.0 * math.sin(heading + turn / 2.0)
        heading += turn


def fixes_along(truth, rng, sigma=SIGMA):
    """A fix each second, with errors of `sigma` in either axis."""
    for t, (x, y, heading) in truth[::5]:
        speed = 10.0
        direction = heading + rng.gauss(0.0, 0.02)
        yield Fix(t, (x + rng.gauss(0.0, sigma), y + rng.gauss(0.0, sigma)),
                  sigma ** 2 * np.eye(2),
                  speed * np.array([math.cos(direction), math.sin(direction)]),
                  (0.02 * speed) ** 2 * np.eye(2))


def errors(estimates, truth):
    true = dict(truth)
    return [filtered_drive.squared_error(one, true[one.t])
            for one in estimates]


def test_covariances_are_as_large_as_the_errors():
    last = []
    for seed in range(60):
        rng = random.Random(seed)
        truth = list(bends(300))
        estimates = filtered_drive.run_filter(
            list(fixes_along(truth, rng)), truth, rng, fix_scale=1.0)
        last.append(errors(estimates, truth)[-1])
    # Three degrees of freedom, so 3 in the mean with a variance of 6; four
    # standard deviations of the mean.
    assert abs(np.mean(last) - 3.0) < 4.0 * math.sqrt(6.0 / len(last))


def test_error_transitions_carry_errors_as_the_filter_does():
    # Two filters see the same steps and the same fixes, and differ in where
    # they begin by too little for what is not linear. Fixes are where the one
    # is: an innovation would count by its gain, which differs a little too.
    rng = random.Random(7)
    truth = list(bends(60))
    begin = np.array(truth[0][1])
    apart = np.array([1e-4, -2e-4, 1e-6])
    one, other = (Filter(pose, np.diag([4.0, 4.0, 0.01]))
                  for pose in (begin, begin + apart))
    for state in (one, other):
        state.take(0.0)
    carried = apart
    for (_, before), (t, after) in zip(truth, truth[1:]):
        step = filtered_drive.draw_step(
            filtered_drive.between(before, after), rng)
        for state in (one, other):
            state.step(*step)
        if round(5 * t) % 5 == 0:
            fix = one.pose[:2].copy()
            for state in (one, other):
                assert state.correct(fix, SIGMA ** 2 * np.eye(2))
        taken = one.take(t)
        carried = taken.transition @ carried
        difference = other.take(t).pose - taken.pose
        assert np.allclose(carried, difference, rtol=1e-3, atol=1e-8)
    # The fixes have taken away most of it.
    assert np.linalg.norm(carried[:2]) < 0.5 * np.linalg.norm(apart[:2])


def test_first_pose_knows_nothing_of_an_error_before():
    truth = list(bends(20))
    estimates = filtered_drive.run_filter(
        list(fixes_along(truth, random.Random(1))), truth, random.Random(1))
    assert not estimates[0].transition.any()
    assert np.linalg.det(estimates[1].transition) == pytest.approx(1.0)
    # The fix is believed three times less than it says.
    assert estimates[0].covariance[0, 0] == pytest.approx(9.0 * SIGMA ** 2)


def test_fix_that_is_too_far_off_is_left_out():
    state = Filter((0.0, 0.0, 0.0), np.diag([1.0, 1.0, 0.01]))
    limit = math.sqrt(filtered_drive.INNOVATION_GATE * 2.0)
    assert not state.correct(np.array([1.01 * limit, 0.0]), np.eye(2))
    assert state.pose.tolist() == [0.0, 0.0, 0.0]
    assert state.correct(np.array([0.99 * limit, 0.0]), np.eye(2))
    # Both are believed alike.
    assert state.pose[0] == pytest.approx(0.99 * limit / 2.0)


def test_vehicle_that_stands_gains_nothing_from_fixes():
    truth = list(bends(20))
    standing = [(4.0 + 0.2 * n, truth[-1][1]) for n in range(100)]
    truth += standing
    estimates = filtered_drive.run_filter(
        list(fixes_along(truth, random.Random(3))), truth, random.Random(3))
    assert len(estimates) == 120
    # The first fix behind the last motion may still count.
    assert np.array_equal(estimates[-1].covariance, estimates[25].covariance)
    assert np.array_equal(estimates[-1].transition, np.eye(3))


def test_fixes_may_be_as_rare_as_one_likes():
    truth = list(bends(600))
    traces = []
    for seconds in (0.0, 60.0):
        estimates = filtered_drive.run_filter(
            list(fixes_along(truth, random.Random(4))), truth,
            random.Random(4), 1.0, seconds)
        traces.append(np.trace(estimates[-6].covariance[:2, :2]))
    assert traces[1] > 3.0 * traces[0]


def test_frame_counts_metres_east_and_north():
    frame = Frame((35.0, 137.0, 40.0))
    assert np.allclose(frame.local((35.0, 137.0, 40.0)), 0.0)
    # Lengths of a degree on WGS84 at this latitude: of longitude and latitude.
    east, north = frame.local((35.001, 137.001, 40.0))
    assert east == pytest.approx(91.288, abs=0.01)
    assert north == pytest.approx(110.941, abs=0.01)


def test_recordings_are_read_in_one_time_and_one_frame(tmp_path):
    (tmp_path / "a.pos").write_text(
        "% program   : made up\n"
        "%  GPST latitude(deg) longitude(deg) height(m) Q sdn(m) sde(m) "
        "sdne(m) vn(m/s) ve(m/s) sdvn sdve sdvne\n"
        "2023/07/11 06:04:30.200 35.0 137.0 40.0 5 3.0 4.0 -1.5 "
        "3.0 -4.0 0.1 0.2 0.05\n")
    (fix,) = filtered_drive.read_fixes(tmp_path / "a.pos")
    assert fix.covariance.tolist() == [[16.0, -2.25], [-2.25, 9.0]]
    assert fix.velocity.tolist() == [-4.0, 3.0]
    assert fix.velocity_covariance[0, 0] == pytest.approx(0.04)
    (tmp_path / "a.csv").write_text(
        "GPS TOW (s),GPS Week,Latitude (deg),Longitude (deg),"
        "Ellipsoid Height (m),Heading (deg)\n"
        "194670.2, 2270, 35.0, 137.0, 40.0, 90.0\n")
    (one,) = filtered_drive.read_reference(tmp_path / "a.csv")
    # A Tuesday, and GPS weeks begin with Sunday.
    assert one.t == pytest.approx(fix.t, abs=1e-6)
    assert one.heading == 0.0
    heading, variance = filtered_drive.first_heading(fix)
    assert heading == pytest.approx(math.atan2(3.0, -4.0))
    assert variance == pytest.approx(
        (0.04 * 9 + 2 * 0.0025 * 12 + 0.01 * 16) / 25 / 25)


def test_the_file_has_what_a_filter_states(tmp_path):
    truth = list(bends(30))
    estimates = filtered_drive.run_filter(
        list(fixes_along(truth, random.Random(5))), truth, random.Random(5))
    rows = list(zip(estimates, (pose for _, pose in truth)))
    filtered_drive.write_drive(tmp_path / "d.csv", rows)
    lines = (tmp_path / "d.csv").read_text().splitlines()
    assert lines[0] == filtered_drive.HEADER
    assert len(lines) == 31
    numbers = dict(zip(lines[0].split(","), map(float, lines[11].split(","))))
    state = estimates[10]
    assert numbers["t_s"] == 2.0
    assert numbers["est_yaw"] == pytest.approx(state.pose[2])
    assert numbers["pyt"] == pytest.approx(state.covariance[1, 2])
    assert numbers["fyt"] == pytest.approx(state.transition[1, 2])
    assert numbers["gt_x"] == pytest.approx(truth[10][1][0])
