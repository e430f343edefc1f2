"""Recordings are read by the program: the poses are those that it would stream, and
what it finds wrong is raised."""

import os
import signal
import stat
import subprocess
import sys

import numpy as np
import pytest

import revisit
from conftest import BOREAS, LONG, ROOT, as_bytes
from revisit import _program

FORMATS = ROOT / "tests/data/formats"


def streamed(server, client, vehicle, *arguments):
    """The poses that the program's own stream has stored."""
    subprocess.run([_program.find_program("revisit"), "stream", *map(str, arguments),
                    "--vehicle", vehicle, "--create", "--server", server.address],
                   check=True, capture_output=True)
    return as_bytes(client.list_poses(vehicle))


@pytest.mark.parametrize("vehicle, path, flags, words", [
    ("drive", BOREAS, {}, []),
    ("modelled", BOREAS, {"uncertainty": "model", "sigma_along": 0.2},
     ["--uncertainty", "model", "--sigma-along", "0.2"]),
    ("kitti", FORMATS / "uq_kitti.txt", {"axes": "camera", "rate": 10},
     ["--axes", "camera", "--rate", "10"]),
    ("rtklib", FORMATS / "nagoya_spp.pos", {}, []),
    ("rtklib-local", FORMATS / "nagoya_spp.pos", {"frame": "local", "fix_sigma": 2.5},
     ["--frame", "local", "--fix-sigma", "2.5"])])
def test_poses_are_those_that_the_program_streams(server, client, vehicle, path, flags,
                                                  words):
    poses = revisit.read_recording(path, **flags)
    assert len(poses) > 40
    assert as_bytes(poses.to_messages()) == streamed(server, client, vehicle, path,
                                                     *words)


def test_what_is_claimed_of_the_files_covariances_is_logged(caplog):
    own = revisit.read_recording(BOREAS)
    assert "its covariances are claimed (--uncertainty file" in caplog.text
    caplog.clear()
    assert as_bytes(own.to_messages()) == as_bytes(
        revisit.read_recording(BOREAS, uncertainty="file").to_messages())
    assert caplog.text == ""


def test_positions_without_a_heading_need_to_be_told_of_their_errors(tmp_path):
    path = tmp_path / "positions.csv"
    path.write_text("t,x,y\n" + "".join(f"{n},{2 * n},0\n" for n in range(100)))
    columns = "t=t,x=x,y=y"
    with pytest.raises(revisit.RecordingError, match="--uncertainty fixes if each"):
        revisit.read_recording(path, columns=columns)
    assert len(revisit.read_recording(path, columns=columns,
                                      uncertainty="model")) > 90


def test_a_spatial_vehicle_gets_spatial_covariances():
    poses = revisit.read_recording(BOREAS, state_space="spatial")
    assert set(poses.covariance_form) == {revisit.v1.COVARIANCE_FORM_SPATIAL_10}


def test_files_follow_each_other_and_columns_are_named(tmp_path):
    path = tmp_path / "-drive.csv"
    path.write_text("when,east,north,psi\n" + "".join(
        f"{n},{2 * n},0,0\n" for n in range(1500)))
    columns = {"t": "when", "x": "east", "y": "north", "yaw": "psi"}
    poses = revisit.read_recording([path, str(path)], columns=columns)
    assert poses.sequence.tolist() == list(range(1, 3001))
    assert poses.position[1501, 0] == 2.0
    batches = list(revisit.iter_recording(path, columns=columns))
    assert [len(batch) for batch in batches] == [1000, 500]
    [rest] = revisit.iter_recording(path, columns=columns, after=1200)
    assert rest.sequence.tolist() == list(range(1201, 1501))


def test_a_name_that_begins_with_a_dash_is_no_flag(tmp_path, monkeypatch):
    (tmp_path / "--help").write_text("t,x,y,yaw\n" + "".join(
        f"{n},{2 * n},0,0\n" for n in range(20)))
    monkeypatch.chdir(tmp_path)
    assert len(revisit.read_recording("--help", columns="t=t,x=x,y=y,yaw=yaw")) == 20


def test_progress_is_told_of_each_pose():
    done = []

    class Bar:
        update = staticmethod(done.append)

    assert len(revisit.read_recording(BOREAS, progress=Bar)) == sum(done) == 2076


def test_what_is_wrong_with_a_file_is_raised(tmp_path):
    bad = tmp_path / "bad.csv"
    bad.write_text("t,x,y,yaw\n0,0,0,0\n1,one,0,0\n")
    with pytest.raises(revisit.RecordingError, match=r"bad\.csv:3"):
        revisit.read_recording(bad, columns="t=t,x=x,y=y,yaw=yaw")
    with pytest.raises(FileNotFoundError, match="nowhere.csv: No such file"):
        revisit.read_recording(tmp_path / "nowhere.csv")
    with pytest.raises(ValueError, match="did you mean --axes"):
        revisit.read_recording(BOREAS, axis="camera")
    with pytest.raises(ValueError, match='--axes: got "up"; allowed is'):
        revisit.read_recording(BOREAS, axes="up")
    turned = tmp_path / "turned.csv"
    turned.write_text("t,x,y,yaw\n" + "".join(
        f"{n},{2 * n},0,1.5708\n" for n in range(100)))
    columns = "t=t,x=x,y=y,yaw=yaw"
    with pytest.raises(revisit.RecordingError, match="--accept-suspicious"):
        revisit.read_recording(turned, columns=columns)
    assert len(revisit.read_recording(turned, columns=columns,
                                      accept_suspicious=True)) == 100


def test_poses_before_an_error_are_handed_out(tmp_path):
    path = tmp_path / "cut.csv"
    path.write_text("t,x,y,yaw\n" + "".join(
        f"{n},{2 * n},0,0\n" for n in range(6000)) + "6000,one,0,0\n")
    read = []
    with pytest.raises(revisit.RecordingError, match=r"cut\.csv:6002"):
        for batch in revisit.iter_recording(path, columns="t=t,x=x,y=y,yaw=yaw"):
            read += batch.sequence.tolist()
    assert read == list(range(1, 6001))


def test_a_loop_that_is_left_early_ends_the_program(tmp_path, monkeypatch):
    started = []

    class Noted(subprocess.Popen):
        def __init__(self, *arguments, **fields):
            super().__init__(*arguments, **fields)
            started.append(self)

    monkeypatch.setattr(subprocess, "Popen", Noted)
    path = tmp_path / "long.csv"
    path.write_text("t,x,y,yaw\n" + "".join(
        f"{n},{2 * n},0,0\n" for n in range(200_000)))
    for batch in revisit.iter_recording(path, columns="t=t,x=x,y=y,yaw=yaw"):
        assert len(batch) == 1000
        break
    [program] = started
    assert program.returncode == -signal.SIGKILL


def made_program(path, text=""):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


@pytest.mark.parametrize("name, variable", [
    ("revisit", "REVISIT_PROGRAM"), ("revisitd", "REVISIT_SERVER_PROGRAM")])
def test_programs_are_found_in_the_documented_order(name, variable, tmp_path,
                                                    monkeypatch):
    def found():
        return _program.find_program(name)

    def installed_in(folder):
        monkeypatch.setattr(_program, "__file__",
                            str(tmp_path / folder / "revisit/_program.py"))

    monkeypatch.delenv(variable)
    monkeypatch.setenv("PATH", str(tmp_path / "on-path"))
    monkeypatch.setattr(sys, "executable", str(tmp_path / "beside/python"))
    installed_in("user/lib/python3.11/site-packages")
    with pytest.raises(FileNotFoundError, match=(
            f"{name} is needed, .* nor named by {variable}: pip install "
            "revisit-server, the Debian package revisit-server, or cmake --install")):
        found()
    on_path = made_program(tmp_path / "on-path" / name)
    assert found() == on_path
    beside = made_program(tmp_path / "beside" / name)
    assert found() == beside
    # Where pip install --user and --target put programs.
    of_user = made_program(tmp_path / "user/bin" / name)
    assert found() == of_user
    installed_in("target")
    assert found() == beside
    of_target = made_program(tmp_path / "target/bin" / name)
    assert found() == of_target
    monkeypatch.setenv(variable, str(tmp_path / "named"))
    with pytest.raises(FileNotFoundError, match="named, which is no program"):
        found()
    named = made_program(tmp_path / "other" / name)
    monkeypatch.setenv(variable, named)
    assert found() == named


def test_the_package_runs_as_the_program(tmp_path):
    def run(*arguments, **variables):
        return subprocess.run(
            [sys.executable, "-m", "revisit", *arguments], capture_output=True,
            text=True, env={**os.environ, **variables}, timeout=LONG, check=False)

    shown = run("convert", str(BOREAS), "--to", "tum", "--uncertainty", "file")
    assert (shown.returncode, shown.stderr) == (0, "")
    assert len(shown.stdout.splitlines()) > 2000
    wrong = run("convert", "--no-such-flag")
    assert wrong.returncode == 64 and "no-such-flag" in wrong.stderr
    missing = run("convert", REVISIT_PROGRAM=str(tmp_path / "none"))
    assert missing.returncode == 1
    assert missing.stderr == (f"revisit: REVISIT_PROGRAM is {tmp_path}/none, which is "
                              "no program\n")


def test_the_shipped_drive_comes_with_whose_it_is():
    path = revisit.shipped_drive()
    assert path.is_absolute() and path.read_bytes() == BOREAS.read_bytes()
    assert "CC BY 4.0" in (path.parent / "NOTICE").read_text()
    assert len(revisit.read_recording(path, uncertainty="file")) == 2076


@pytest.mark.parametrize("answer, problem", [
    (b"\x80\x80\x80\x80\x80\x80\x80\x01", "wrote no poses"),
    (b"\x03\xff\xff\xff", "wrote no poses"), (b"usage: what\n", "only a part")])
def test_a_program_that_is_another_is_noticed(tmp_path, monkeypatch, answer, problem):
    other = tmp_path / "revisit"
    other.write_text(f"#!{sys.executable}\nimport sys\n"
                     f"sys.stdout.buffer.write({answer!r})\n")
    other.chmod(0o755)
    monkeypatch.setenv("REVISIT_PROGRAM", str(other))
    with pytest.raises(revisit.RecordingError, match=problem):
        revisit.read_recording(BOREAS)


def test_flags_are_made_of_keywords():
    assert _program.flags_of({
        "axes": "camera", "rate": 10, "accept_suspicious": True, "times": None,
        "frame": False, "columns": {"t": "time", "x": 3}, "body_yaw": -90.0,
        "sigmas": (1, 2)}) == [
        "--axes=camera", "--rate=10", "--accept-suspicious", "--columns=t=time,x=3",
        "--body-yaw=-90.0", "--sigmas=1,2"]


def test_times_are_those_of_the_file(tmp_path):
    path = tmp_path / "drive.csv"
    path.write_text("t,x,y,yaw\n" + "".join(
        f"{1_700_000_000 + n}.25,{2 * n},0,0\n" for n in range(20)))
    poses = revisit.read_recording(path, columns="t=t,x=x,y=y,yaw=yaw")
    assert poses.stamp[3] == np.datetime64(1_700_000_003_250_000_000, "ns")


def test_second_day_begins_a_recording_and_a_line_says_so(tmp_path, caplog):
    days = []
    for day in range(2):
        days.append(tmp_path / f"day{day}.csv")
        days[-1].write_text("t_s,est_x,est_y,est_yaw\n" + "".join(
            f"{86400 * day + i},{2 * i},0,0\n" for i in range(40)))

    def starts(**flags):
        poses = revisit.read_recording(days, **flags)
        return [(row, start.label, start.WhichOneof("relation"))
                for row, start in enumerate(poses.recording_start)
                if start is not None]

    assert starts() == [(40, "day1", None)]
    assert any("another recording begins" in record.getMessage()
               for record in caplog.records)
    assert starts(recording="datum:10m,1deg") == [
        (0, "day0", "datum"), (40, "day1", "datum")]
    assert starts(recording="unknown") == [(40, "day1", "unknown")]
    assert starts(recording="same") == []
    with pytest.raises(ValueError, match="METERSm"):
        starts(recording="datum:10,1")
