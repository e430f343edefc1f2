"""Covariances as estimators and drivers send them."""

import csv
import pathlib
import sys

import numpy as np
import pytest

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import claims

STEPS = 1500


@pytest.fixture(name="drive")
def fixture_drive(tmp_path):
    """A drive file of 3 km, two metres a step, that turns left all along."""
    angles = 0.002 * np.arange(STEPS)
    x, y = 1000 * np.sin(angles), 1000 * (1 - np.cos(angles))
    path = tmp_path / "drive.csv"
    with open(path, "w", encoding="ascii", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["frame", "t_s", "gt_x", "gt_y", "gt_yaw", "est_x", "est_y",
                         "est_yaw"])
        for n, row in enumerate(zip(x, y, angles)):
            writer.writerow([n, 0.2 * n, *row, *row])
    return path


def written(drive, shape):
    """Estimates and covariances of the file with claims of this shape."""
    out = claims.write_claimed(drive, shape, drive.with_name(f"{shape}.csv"))
    rows, poses = claims.read(out)
    covariances = np.zeros((len(rows), 3, 3))
    for name, (r, c) in claims.ENTRIES.items():
        covariances[:, r, c] = covariances[:, c, r] = [
            float(row[name]) for row in rows]
    assert [row["gt_x"] for row in rows] == [
        row["gt_x"] for row in claims.read(drive)[0]]
    return poses, covariances


def test_errors_that_are_drawn_have_the_propagated_covariance(drive):
    poses, covariances = written(drive, "propagated")
    rng = np.random.default_rng(1)
    lengths = np.hypot(*np.diff(poses[:, :2], axis=0).T)
    errors = rng.normal(0.0, np.sqrt(np.diag(claims.START)), (4000, 3))
    for before, after, length in zip(poses, poses[1:], lengths):
        dx, dy = after[:2] - before[:2]
        c, s = np.cos(before[2]), np.sin(before[2])
        along, across, turn = (rng.normal(0.0, sigma * length ** 0.5, 4000)
                               for sigma in (claims.ALONG, claims.ACROSS,
                                             claims.HEADING))
        errors += np.column_stack([-dy * errors[:, 2] + c * along - s * across,
                                   dx * errors[:, 2] + s * along + c * across, turn])
    whitened = np.linalg.solve(np.linalg.cholesky(covariances[-1]), errors.T)
    assert np.cov(whitened) == pytest.approx(np.eye(3), abs=0.1)


@pytest.mark.parametrize("shape", ["diagonal", "isotropic", "share", "constant",
                                   "up-and-down"])
def test_drivers_leave_the_lever_out(drive, shape):
    _, covariances = written(drive, shape)
    assert not covariances[:, 0, 2].any() and not covariances[:, 1, 2].any()
    assert (np.diagonal(covariances, axis1=1, axis2=2) > 0).all()


def test_variances_are_those_of_the_shape(drive):
    _, whole = written(drive, "propagated")
    _, diagonal = written(drive, "diagonal")
    _, isotropic = written(drive, "isotropic")
    _, share = written(drive, "share")
    assert np.trace(isotropic, axis1=1, axis2=2) == pytest.approx(
        np.trace(whole, axis1=1, axis2=2))
    assert diagonal[:, 1, 1] == pytest.approx(whole[:, 1, 1])
    assert share[-1, 0, 0] ** 0.5 == pytest.approx(0.01 * 2 * STEPS, rel=0.01)


def test_claims_begin_anew_each_kilometre_and_the_poses_go_on(drive):
    poses, whole = written(drive, "propagated")
    same, anew = written(drive, "begun-anew")
    assert (same == poses).all()
    begun = np.flatnonzero(anew[1:, 2, 2] < anew[:-1, 2, 2]) + 1
    assert len(begun) == 2
    for covariance in anew[begun]:
        assert covariance == pytest.approx(claims.START)
    assert anew[:begun[0]] == pytest.approx(whole[:begun[0]])


def test_a_worn_wheel_measures_too_much_from_half_way_on(drive):
    poses, _ = written(drive, "propagated")
    worn, _ = written(drive, "wheel")
    way, longer = claims.way_of(poses), claims.way_of(worn)
    assert longer[STEPS // 2] == pytest.approx(way[STEPS // 2], abs=0.05)
    assert longer[-1] == pytest.approx(1.005 * way[-1], rel=1e-3)
