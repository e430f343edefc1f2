"""What the tables of RESULTS.md are made of."""

import argparse
import csv
import math
import pathlib
import sys

import numpy as np
import pytest

sys.path.insert(0, str(pathlib.Path(__file__).parent))
import registration
import reports
import tables

DRIVE = ("t_s,gt_x,gt_y,gt_yaw,est_x,est_y,est_yaw\n"
         "0,0,0,0,0,0,0\n"
         "1,2,0.5,0.25,2.1,0.4,0.2\n")


def kitti_line(forward, left, up, yaw):
    """A pose as KITTI has it: x right, y down, z forward."""
    c, s = math.cos(yaw), math.sin(yaw)
    return " ".join(map(str, (c, 0, -s, -left, 0, 1, 0, -up, s, 0, c, forward)))


@pytest.fixture(name="folders")
def fixture_folders(tmp_path):
    for name in ("drives", "kitti", "nagoya", "out"):
        (tmp_path / name).mkdir()
    (tmp_path / "drives/kitti_42.csv").write_text(DRIVE)
    (tmp_path / "kitti/42.txt").write_text(
        kitti_line(0, 0, 0, 0) + "\n" + kitti_line(2.0, 0.5, 0.75, 0.25) + "\n")
    (tmp_path / "kitti/42_vo.txt").write_text(
        kitti_line(0, 0, 0, 0) + "\n" + kitti_line(1.9, 0.6, 0.7, 0.3) + "\n")
    for name in ("spp_2023.pos", "spp_2024.pos.gz", "reference_2023.csv",
                 "reference_2024.csv"):
        (tmp_path / "nagoya" / name).touch()
    return argparse.Namespace(
        drives=tmp_path / "drives", kitti=tmp_path / "kitti",
        nagoya=tmp_path / "nagoya", out=tmp_path / "out")


def rows_of(path):
    with open(path, encoding="ascii") as file:
        return list(csv.DictReader(file))


def test_drives_get_the_heights_that_were_published_beside_them(folders):
    drives = dict(tables.drives_with_height(folders, folders.out))
    assert list(drives) == ["shipped drive, 5 seeds", "kitti_42, 40 seeds",
                            "kitti_42, vo", "Nagoya"]
    published = rows_of(drives["kitti_42, 40 seeds"][0])
    assert [float(row["gt_z"]) for row in published] == [0.0, 0.75]
    assert published[1]["est_x"] == "2.1"
    estimated = rows_of(drives["kitti_42, vo"][0])[1]
    assert float(estimated["gt_x"]) == 2.0
    assert [float(estimated[f"est_{name}"]) for name in ("x", "y", "z", "yaw")] \
        == pytest.approx([1.9, 0.6, 0.7, 0.3])
    solutions = drives["Nagoya"][:2]
    assert [path.name for path in solutions] \
        == ["spp_2023.pos", "spp_2024.pos.gz"]


def test_shipped_drive_has_the_heights_of_its_source(folders):
    shipped = rows_of(next(tables.drives_with_height(folders, folders.out))[1][0])
    heights = [float(row["gt_z"]) for row in shipped]
    assert len(heights) == 2076
    assert 148.0 < min(heights) < max(heights) < 160.0
    # The second day begins 3.8 m from where the first one ended.
    assert abs(heights[1079] - heights[1078]) < 0.5


def test_heights_of_another_drive_are_refused(folders):
    drive = folders.drives / "kitti_42.csv"
    with pytest.raises(ValueError, match="has 2 poses, and there are 3 heights"):
        tables.add_column(drive, folders.out / "z.csv", "gt_z", [1, 2, 3])


def test_figures_that_are_not_there_are_dashes():
    counts = {"true_loops": 3, "checks": 9, "accepted": 4,
              "accepted_correct": 2, "precision": 0.5, "recall": 2 / 3,
              "f1": 4 / 7, "sure_recall": None,
              "positive_calibration_error": None, "precision_95": [0.25, 0.75],
              "recall_95": None, "f1_95": None,
              "positive_calibration_error_95": None}
    cells = tables.figures(counts)
    assert cells == ["3 / 9", 4, 2, "0.500 (0.250 to 0.750)", "0.667", "0.571",
                     "-", "-"]
    assert reports.markdown(["a", "b"], [[1, "x"]]) \
        == "| a | b |\n|---|---|\n| 1 | x |"
    assert len(cells) == len(tables.TITLES)


def test_days_of_the_shipped_drive_are_told_apart_by_the_night_between(tmp_path):
    first, second = (rows_of(path) for path in tables.days_of_boreas(tmp_path))
    assert (len(first), len(second)) == (1079, 997)
    assert float(second[0]["t_s"]) - float(first[-1]["t_s"]) > 86400.0
    assert list(first[0]) == list(second[0])


def street(turns, begin=(0.0, 0.0, 0.0), step=2.0):
    """The truth of a drive that turns so far every 100 m: rows of a drive file."""
    x, y, heading = begin
    rows = []
    for turn in turns:
        for _ in range(int(100.0 / step)):
            rows.append({"t_s": f"{len(rows)}", "gt_x": f"{x:.3f}", "gt_y": f"{y:.3f}",
                         "gt_yaw": f"{heading:.5f}", "est_x": "0", "est_y": "0",
                         "est_yaw": "0"})
            x += step * math.cos(heading)
            y += step * math.sin(heading)
        heading += turn
    return rows


TURNS = [0.0, 1.5, 0.4, -1.2, 0.0, 1.1, 1.6, -0.5, -0.5, 0.9, -1.5, 0.0, 0.7, -1.4]


def bent(rows, turn, x, y):
    """The truth in a frame that lies so in that of the rows, whose drift bends it by
    8 m."""
    back = registration.rotation(-turn)
    made = []
    for number, row in enumerate(rows):
        drift = 8.0 * math.sin(number / len(rows) * math.pi)
        place = back @ [float(row["gt_x"]) + drift - x, float(row["gt_y"]) - y]
        made.append({**row, "gt_x": f"{place[0]:.3f}", "gt_y": f"{place[1]:.3f}",
                     "gt_yaw": f"{float(row['gt_yaw']) - turn:.5f}"})
    return made


def write_rows(path, rows):
    with open(path, "w", encoding="ascii", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    return path


def test_truths_of_other_frames_are_laid_over_the_first(tmp_path):
    whole = street(TURNS)
    (tmp_path / "out").mkdir()
    first = write_rows(tmp_path / "first.csv", whole)
    second = write_rows(tmp_path / "second.csv",
                        bent(whole[150:600], 2.1, 400.0, -90.0))
    drives, apart = registration.write_registered([first, second], tmp_path / "out")
    assert drives[0] == first and apart[0] == 0.0
    assert apart[1] < 1.0
    off = [math.dist((float(row["gt_x"]), float(row["gt_y"])),
                     (float(true["gt_x"]), float(true["gt_y"])))
           for row, true in zip(rows_of(drives[1]), whole[150:600])]
    # What lies along a straight street shows at its ends alone.
    assert np.median(off) < 2.0 and max(off) < 8.0
    turned = [math.remainder(float(row["gt_yaw"]) - float(true["gt_yaw"]), math.tau)
              for row, true in zip(rows_of(drives[1]), whole[150:600])]
    assert max(map(abs, turned)) < 0.05


def test_drives_of_different_streets_are_not_laid_over_each_other():
    with pytest.raises(ValueError, match="too few streets"):
        registration.register(
            registration.path_of(street([0.3] * 12)),
            registration.path_of(street(TURNS)))


def test_recordings_need_sessions(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["tables.py", "recordings"])
    with pytest.raises(SystemExit):
        tables.main()
    assert "recordings: needs --sessions DRIVE ..." in capsys.readouterr().err
