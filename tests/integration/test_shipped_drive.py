"""The shipped drive is what its script makes, and claims what is true."""

import csv
import math
import subprocess
import sys

from stubs import ROOT

DATA = ROOT / "tests/data/boreas"
DRIVE = DATA / "boreas_glen_shields.csv"


def rows(path):
    with open(path, newline="") as file:
        return [{name: float(value) for name, value in row.items()}
                for row in csv.DictReader(file)]


def test_script_makes_the_shipped_drive_again(tmp_path):
    made = tmp_path / "drive.csv"
    subprocess.run([sys.executable, DATA / "make_drive.py", "--output", made],
                   check=True, timeout=60)
    shipped, again = rows(DRIVE), rows(made)
    assert len(shipped) == len(again) == 1079 + 997
    # Not byte for byte: another C library may round the last digit otherwise.
    for a, b in zip(shipped, again):
        assert a.keys() == b.keys()
        for name in a:
            assert math.isclose(a[name], b[name], rel_tol=1e-6, abs_tol=2e-3)


def test_drive_is_as_long_as_the_recording_and_holds_no_jump():
    path = rows(DRIVE)
    steps = [math.hypot(b["gt_x"] - a["gt_x"], b["gt_y"] - a["gt_y"])
             for a, b in zip(path, path[1:])]
    assert math.isclose(sum(steps), 15.9e3, rel_tol=0.01)
    # VehicleSettings.max_step_meters by default: nowhere is the path cut, not
    # even between the two days.
    assert max(steps) < 100.0
    assert path[0]["gt_x"] == path[0]["gt_y"] == 0.0


def test_heading_is_the_course_of_the_path():
    path = rows(DRIVE)
    off = []
    for a, b in zip(path, path[1:]):
        dx, dy = b["gt_x"] - a["gt_x"], b["gt_y"] - a["gt_y"]
        if math.hypot(dx, dy) > 5.0:
            turn = math.remainder(b["gt_yaw"] - a["gt_yaw"], 2 * math.pi)
            off.append(abs(math.remainder(
                math.atan2(dy, dx) - (a["gt_yaw"] + turn / 2), 2 * math.pi)))
    assert len(off) > 1000
    assert math.degrees(sorted(off)[len(off) // 2]) < 1.0


def test_estimate_stands_still_where_the_vehicle_does():
    path = rows(DRIVE)
    names = ("est_x", "est_y", "est_yaw", "pxx", "ptt")
    stills = [all(a[name] == b[name] for name in names)
              for a, b in zip(path, path[1:])
              if a["gt_x"] == b["gt_x"] and a["gt_y"] == b["gt_y"]]
    assert len(stills) > 100
    assert all(stills)


def test_claimed_covariance_is_honest():
    # Errors of one drive are one draw with long memory, but what is new in each
    # stretch is independent of what was before. So the heading error gained
    # over each 100 m must have the variance that the claim gains.
    path = rows(DRIVE)
    gains, start, travelled = [], path[0], 0.0
    for a, b in zip(path, path[1:]):
        travelled += math.hypot(b["gt_x"] - a["gt_x"], b["gt_y"] - a["gt_y"])
        if travelled >= 100.0:
            error = math.remainder(
                (b["est_yaw"] - b["gt_yaw"])
                - (start["est_yaw"] - start["gt_yaw"]), 2 * math.pi)
            gains.append(error ** 2 / (b["ptt"] - start["ptt"]))
            start, travelled = b, 0.0
    # Mean of n squares of unit normals: 1, standard deviation sqrt(2 / n).
    assert len(gains) > 100
    assert abs(sum(gains) / len(gains) - 1.0) < 4.0 * math.sqrt(2 / len(gains))


def test_final_error_agrees_with_its_covariance():
    last = rows(DRIVE)[-1]
    dx, dy = last["est_x"] - last["gt_x"], last["est_y"] - last["gt_y"]
    determinant = last["pxx"] * last["pyy"] - last["pxy"] ** 2
    squared_distance = (last["pyy"] * dx * dx - 2 * last["pxy"] * dx * dy
                        + last["pxx"] * dy * dy) / determinant
    # Quantile 0.99 of chi-square with 2 degrees of freedom.
    assert squared_distance < 9.21
