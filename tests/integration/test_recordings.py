"""revisit stream on recordings of other tools: axes and units that are wrong,
pipes, several files, receivers' fixes."""

import csv
import gzip
import json
import math
import statistics
import subprocess
import time

import grpc
import pytest

from revisit_server import BIN, RUN_SECONDS, clean_environment, run, wait_until
from stubs import ROOT, api
from wire import BOREAS

LOCAL_FAULT = 1
USAGE = 64


@pytest.fixture(name="stream", scope="module")
def fixture_stream(server):
    def call(*arguments):
        return run("revisit", "stream", *arguments, "--server", server.address)
    return call


@pytest.fixture(name="boreas", scope="module")
def fixture_boreas():
    """Estimates of the shipped drive: t, x, y, yaw."""
    with open(BOREAS, encoding="utf-8") as file:
        return [tuple(float(row[name])
                      for name in ("t_s", "est_x", "est_y", "est_yaw"))
                for row in csv.DictReader(file)]


def vehicle(stub, name):
    return stub.GetVehicle(
        api.GetVehicleRequest(name=f"vehicles/{name}")).vehicle


def is_there(stub, name):
    try:
        return bool(vehicle(stub, name))
    except grpc.RpcError as error:
        assert error.code() == grpc.StatusCode.NOT_FOUND
        return False


def write(path, rows, header=None, separator=" "):
    lines = [] if header is None else [header]
    lines += [separator.join(row if isinstance(row, str) else f"{value:.9f}"
                             for value in row) for row in rows]
    path.write_text("\n".join(lines) + "\n")
    return path


def tum(poses, camera=False, w_first=False):
    """The poses as TUM; a camera's axes are x right, y down, z forward."""
    for t, x, y, yaw in poses:
        s, c = math.sin(yaw / 2), math.cos(yaw / 2)
        position, q = (x, y, 0.0), (0.0, 0.0, s, c)
        if camera:
            position, q = (-y, 0.0, x), (0.0, -s, 0.0, c)
        yield (t, *position, *((q[3], *q[:3]) if w_first else q))


def candidates(result):
    """Of each check: the query, and what matched with which verdict."""
    assert result.returncode == 0, result.stderr
    sets = [json.loads(line) for line in result.stdout.splitlines()[:-1]]
    return [(one["query"]["sequence"],
             [(candidate["matched"]["sequence"], candidate["verdict"])
              for candidate in one.get("candidates", [])]) for one in sets]


def degrees(poses):
    return ((t, x, y, math.degrees(yaw)) for t, x, y, yaw in poses)


PLAIN = "t_s,est_x,est_y,est_yaw"


@pytest.mark.parametrize("name, right, wrong, flag", [
    ("camera", lambda path, poses: write(path, tum(poses)),
     lambda path, poses: write(path, tum(poses, camera=True)),
     ["--axes", "camera"]),
    ("w-first", lambda path, poses: write(path, tum(poses)),
     lambda path, poses: write(path, tum(poses, w_first=True)),
     ["--quaternion", "wxyz"]),
    ("degrees", lambda path, poses: write(path, poses, PLAIN, ","),
     lambda path, poses: write(path, degrees(poses), PLAIN, ","),
     ["--angles", "degrees"]),
])
def test_wrong_convention_is_refused_and_its_flag_gives_the_same_candidates(
        name, right, wrong, flag, boreas, stub, stream, tmp_path):
    wrong_file = wrong(tmp_path / "wrong.txt", boreas)
    refused = stream(wrong_file, "--vehicle", f"{name}-bad", "--create")
    assert refused.returncode == LOCAL_FAULT
    assert refused.stderr.startswith(f"revisit: {wrong_file}:")
    assert " ".join(flag) in refused.stderr
    assert not is_there(stub, f"{name}-bad")

    # Searches without a belief tell as much of axes and units, in less time.
    for kind in ("mended", "right"):
        stub.CreateVehicle(api.CreateVehicleRequest(
            vehicle_id=f"{name}-{kind}", vehicle=api.Vehicle(
                settings=api.VehicleSettings(use_belief=False))))
    mended = stream(wrong_file, *flag, "--vehicle", f"{name}-mended",
                    "--candidates", "--json")
    plain = stream(right(tmp_path / "right.txt", boreas), "--vehicle",
                   f"{name}-right", "--candidates", "--json")
    assert candidates(mended) == candidates(plain)
    assert sum(1 for _, found in candidates(plain)
               if found and found[0][1] == "VERDICT_ACCEPTED") > 50


def test_longitude_and_latitude_are_refused_and_taken_as_such(
        boreas, stub, stream, tmp_path):
    file = write(tmp_path / "lonlat.csv",
                 ((t, -79.46 + x / 80300.0, 43.79 + y / 111100.0, yaw)
                  for t, x, y, yaw in boreas[:500]), PLAIN, ",")
    refused = stream(file, "--vehicle", "lonlat-bad", "--create")
    assert refused.returncode == LOCAL_FAULT
    assert "--frame geodetic" in refused.stderr
    assert not is_there(stub, "lonlat-bad")
    taken = stream(file, "--frame", "geodetic", "--vehicle", "lonlat",
                   "--create")
    assert taken.returncode == 0, taken.stderr
    settings = vehicle(stub, "lonlat").settings
    assert settings.coordinate_frame == api.COORDINATE_FRAME_GEODETIC
    assert settings.geodetic_origin.latitude_degrees == pytest.approx(
        43.79 + boreas[0][2] / 111100.0)


def test_suspicious_file_is_taken_when_accepted(boreas, stub, stream, tmp_path):
    file = write(tmp_path / "back.csv", [*boreas[:50], *boreas[:10]], PLAIN,
                 ",")
    refused = stream(file, "--vehicle", "back", "--create")
    assert f"{file}:52: the time runs back by" in refused.stderr
    assert stream(file, "--vehicle", "back", "--create",
                  "--accept-suspicious").returncode == 0
    assert vehicle(stub, "back").durable_sequence == 60


def test_pose_of_a_pipe_is_durable_within_a_second(server, stub):
    with subprocess.Popen(
            [BIN / "revisit", "stream", "-", "--vehicle", "pipe", "--create",
             "--server", server.address], stdin=subprocess.PIPE,
            stdout=subprocess.PIPE, text=True,
            env=clean_environment()) as process:
        process.stdin.write(PLAIN + "\n")
        times = []
        for i in range(1, 9):
            process.stdin.write(f"{i},{i},0,0\n")
            process.stdin.flush()
            written = time.monotonic()
            wait_until(lambda i=i: is_there(stub, "pipe") and vehicle(
                stub, "pipe").durable_sequence == i, f"pose {i}")
            times.append(time.monotonic() - written)
        out, _ = process.communicate()
    assert process.returncode == 0
    assert "durable sequence  8" in out
    # The first one also starts the program and makes the vehicle, and on a busy
    # machine one or the other is late.
    assert statistics.median(times) < 1.0


def test_wrong_recording_through_a_pipe_sends_nothing(
        boreas, server, stub, tmp_path):
    file = write(tmp_path / "wrong.txt", tum(boreas, camera=True))
    with open(file, encoding="utf-8") as piped, subprocess.Popen(
            ["cat"], stdin=piped, stdout=subprocess.PIPE) as cat:
        refused = subprocess.run(
            [BIN / "revisit", "stream", "-", "--vehicle", "wrong-pipe",
             "--create", "--server", server.address], stdin=cat.stdout,
            capture_output=True, text=True, env=clean_environment(),
            timeout=RUN_SECONDS, check=False)
    assert refused.returncode == LOCAL_FAULT
    assert "--axes camera" in refused.stderr
    assert not is_there(stub, "wrong-pipe")


def test_error_in_a_pipe_says_what_is_durable(server, stub):
    with subprocess.Popen(
            [BIN / "revisit", "stream", "-", "--vehicle", "broken-pipe",
             "--create", "--server", server.address], stdin=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True,
            env=clean_environment()) as process:
        process.stdin.write(PLAIN + "\n1,1,0,0\n2,2,0,0\n")
        process.stdin.flush()
        wait_until(lambda: is_there(stub, "broken-pipe") and vehicle(
            stub, "broken-pipe").durable_sequence == 2, "two poses")
        _, words = process.communicate("3,3,0,0\n4,x,0,0\n")
    assert process.returncode == LOCAL_FAULT
    assert words == (
        'revisit: -:5: expected a finite number for est_x, got "x"; '
        "vehicles/broken-pipe has 3 durable poses\n")


def test_second_recording_continues_the_vehicle(boreas, stub, stream, tmp_path):
    first = write(tmp_path / "1.csv", boreas[:100], PLAIN, ",")
    second = tmp_path / "2.csv.gz"
    second.write_bytes(gzip.compress(
        write(tmp_path / "2.csv", boreas[100:150], PLAIN, ",").read_bytes()))
    both = stream(first, second, "--vehicle", "both", "--create")
    assert both.returncode == 0, both.stderr
    assert vehicle(stub, "both").durable_sequence == 150
    # Once more: compared, and nothing to add.
    again = stream(first, second, "both", "--json")
    assert json.loads(again.stdout)["alreadyDurable"] == 150

    assert stream(first, "--vehicle", "appended", "--create").returncode == 0
    refused = stream(second, "--vehicle", "appended")
    assert refused.returncode == LOCAL_FAULT
    assert "--append adds these behind them" in refused.stderr
    added = stream(second, "--vehicle", "appended", "--append")
    assert added.returncode == 0, added.stderr

    def poses(name):
        return [(pose.sequence, pose.local.x_meters, pose.stamp.seconds,
                 [round(value, 9) for value in pose.covariance.values])
                for pose in stub.ListPoses(api.ListPosesRequest(
                    parent=f"vehicles/{name}")).poses]
    assert poses("appended") == poses("both")


def test_sessions_keep_the_range_of_each_recording(
        boreas, stub, stream, tmp_path):
    first = write(tmp_path / "monday.txt", tum(boreas[:300]))
    second = write(tmp_path / "tuesday.txt", tum(boreas[300:500]))
    command = ["--vehicle", "sessions", "--append", "--create"]
    assert stream(first, *command, "--session", "monday").returncode == 0
    assert stream(second, *command, "--session", "tuesday").returncode == 0
    assert dict(vehicle(stub, "sessions").labels) == {
        "session.monday": "1-300", "session.tuesday": "301-500"}
    # A name is taken once, before anything is sent.
    taken = stream(second, *command, "--session", "monday")
    assert taken.returncode == LOCAL_FAULT
    assert "poses 1-300 of vehicles/sessions are the session monday" in \
        taken.stderr
    assert vehicle(stub, "sessions").durable_sequence == 500
    wrong = stream(second, *command, "--session", "Monday")
    assert wrong.returncode == USAGE
    assert 'got "Monday"' in wrong.stderr


def test_warnings_of_the_server_are_shown(boreas, stream, tmp_path):
    turned = [(t, x, y, yaw + math.pi / 2) for t, x, y, yaw in boreas[:600]]
    result = stream(write(tmp_path / "turned.txt", tum(turned)), "--vehicle",
                    "warned", "--create", "--accept-suspicious")
    assert result.returncode == 0, result.stderr
    assert "warning: " in result.stderr


def test_missing_second_file_shows_before_the_first_is_sent(
        boreas, stub, stream, tmp_path):
    first = write(tmp_path / "1.csv", boreas[:10], PLAIN, ",")
    refused = stream(first, tmp_path / "2.csv", "--vehicle", "one-of-two",
                     "--create")
    assert refused.returncode == LOCAL_FAULT
    assert "2.csv: No such file or directory" in refused.stderr
    assert not is_there(stub, "one-of-two")


def test_fixes_of_a_receiver_make_a_geodetic_vehicle(stub, stream):
    pos = ROOT / "tests/data/formats/nagoya_spp.pos"
    taken = stream(pos, "--vehicle", "nagoya", "--create")
    assert taken.returncode == 0, taken.stderr
    made = vehicle(stub, "nagoya")
    assert made.settings.coordinate_frame == api.COORDINATE_FRAME_GEODETIC
    assert (made.settings.correlation_model
            == api.CORRELATION_MODEL_INDEPENDENT)
    pose = stub.ListPoses(api.ListPosesRequest(
        parent="vehicles/nagoya", page_size=1)).poses[0]
    # About as large as RTKLIB says of itself.
    assert 1.0 < pose.covariance.values[0] < 100.0
    assert pose.geodetic.latitude_degrees == pytest.approx(35.165, abs=1e-2)
    # The same metres east and north.
    local = stream(pos, "--vehicle", "nagoya-local", "--create", "--frame",
                   "local")
    assert local.returncode == 0, local.stderr
    refused = stream(pos, "--vehicle", "nagoya-local")
    assert refused.returncode == LOCAL_FAULT
    assert "--frame local" in refused.stderr


def test_error_transitions_go_to_a_vehicle_with_a_filter(
        stub, stream, tmp_path):
    header = (PLAIN + ",pxx,pxy,pxt,pyy,pyt,ptt,fxx,fxy,fxt,fyx,fyy,fyt,ftx,"
              "fty,ftt")
    rows = [(i, 2.0 * i, 0, 0, 1, 0, 0, 1, 0, 0.01, 1, 0, 0, 0, 1, 2, 0, 0, 1)
            for i in range(30)]
    file = write(tmp_path / "filter.csv", rows, header, ",")
    taken = stream(file, "--vehicle", "filter", "--create",
                   "--correlation-model", "filter")
    assert taken.returncode == 0, taken.stderr
    poses = stub.ListPoses(api.ListPosesRequest(parent="vehicles/filter")).poses
    assert list(poses[5].error_transition) == list(rows[5][10:])
    assert list(poses[5].covariance.values) == list(rows[5][4:10])
    plain = write(tmp_path / "plain.csv", [row[:4] for row in rows], PLAIN, ",")
    refused = stream(plain, "--vehicle", "filter")
    assert refused.returncode == LOCAL_FAULT
    assert "(columns fxx, fxy," in refused.stderr


def test_evaluate_takes_the_truth_from_another_file(boreas, tmp_path):
    estimate = write(tmp_path / "estimate.txt", tum(boreas))
    with open(BOREAS, encoding="utf-8") as file:
        truth = write(tmp_path / "truth.txt", tum(
            tuple(float(row[name]) for name in ("t_s", "gt_x", "gt_y",
                                                "gt_yaw"))
            for row in csv.DictReader(file)))
    of_tum, of_csv = (
        run("revisit", "evaluate", *drive, "--no-use-belief", "--json",
            env=clean_environment())
        for drive in ([estimate, "--truth", truth], [BOREAS]))
    assert of_tum.returncode == 0, of_tum.stderr
    for key in ("checks", "true_loops", "accepted", "accepted_correct"):
        assert (json.loads(of_tum.stdout)["total"][key]
                == json.loads(of_csv.stdout)["total"][key])


def test_truth_has_flags_of_its_own_and_may_end_early(boreas, tmp_path):
    with open(BOREAS, encoding="utf-8") as file:
        true = [tuple(float(row[name])
                      for name in ("t_s", "gt_x", "gt_y", "gt_yaw"))
                for row in csv.DictReader(file)]
    estimate = write(tmp_path / "estimate.txt", tum(boreas))
    truth = write(tmp_path / "truth.txt", tum(true[:-40], camera=True))

    def evaluate(*flags):
        return run("revisit", "evaluate", estimate, "--truth", truth,
                   "--no-use-belief", *flags, env=clean_environment())
    refused = evaluate()
    assert refused.returncode == LOCAL_FAULT
    assert "they agree with --truth-axes camera" in refused.stderr
    report = evaluate("--truth-axes", "camera", "--json")
    assert report.returncode == 0, report.stderr
    assert json.loads(report.stdout)["total"]["poses"] == len(boreas) - 40
    text = evaluate("--truth-axes", "camera")
    assert "estimate: 40 poses, " in text.stdout
    assert "after the truth ends are left out." in " ".join(text.stdout.split())


def test_passes_in_the_opposite_direction_are_counted(tmp_path):
    # There and back on one winding road.
    road = [(2.0 * i, 150 * math.sin(i / 150)) for i in range(1500)]
    path = road + [(x, y + 1.0) for x, y in reversed(road)]
    rows = []
    for i, (x, y) in enumerate(path):
        a, b = path[max(i - 1, 0)], path[min(i + 1, len(path) - 1)]
        yaw = math.atan2(b[1] - a[1], b[0] - a[0])
        rows.append((i / 5, x, y, yaw, x, y, yaw))
    drive = write(tmp_path / "back.csv", rows,
                  PLAIN + ",gt_x,gt_y,gt_yaw", ",")
    same, either = (
        run("revisit", "evaluate", drive, "--no-use-belief", "--accept-suspicious",
            *flags, env=clean_environment())
        for flags in ((), ("--direction", "either")))
    assert same.returncode == 0, same.stderr
    words = " ".join(same.stdout.split())
    assert " checks that are no true loops here lie where the vehicle " in words
    assert "--direction either looks for these passes too" in words
    assert "Direction: " not in either.stdout


PLANAR = ",pxx,pxy,pxt,pyy,pyt,ptt"


def streamed_covariance(stub, name, sequence):
    return list(stub.ListPoses(api.ListPosesRequest(
        parent=f"vehicles/{name}", first_sequence=sequence,
        page_size=1)).poses[0].covariance.values)


def test_covariances_that_grow_are_claimed_and_others_are_not(
        boreas, stub, stream, tmp_path):
    def recording(name, variance):
        return write(tmp_path / name, [
            (*pose, variance(i), 0, 0, variance(i), 0, 1e-4)
            for i, pose in enumerate(boreas[:200])], PLAIN + PLANAR, ",")
    growing = recording("growing.csv", lambda i: 0.01 * i)
    taken = stream(growing, "--vehicle", "growing", "--create")
    assert taken.returncode == 0, taken.stderr
    assert "its covariances are claimed" in taken.stderr
    assert "uncertainty       file\n" in taken.stdout
    given = stream(growing, "--vehicle", "given", "--create", "--uncertainty",
                   "file", "--json")
    assert json.loads(given.stdout)["uncertainty"] == "file"
    assert "covariances" not in given.stderr
    assert (streamed_covariance(stub, "growing", 200)
            == streamed_covariance(stub, "given", 200))

    # As of a receiver: a little up and down, and more at the end by chance.
    wavering = stream(recording(
        "wavering.csv", lambda i: 0.01 + 0.001 * (i % 2)), "--vehicle",
        "wavering", "--create", "--json")
    assert json.loads(wavering.stdout)["uncertainty"] == "model"
    constant = stream(recording("constant.csv", lambda i: 0.01), "--vehicle",
                      "constant", "--create", "--json")
    assert constant.returncode == 0, constant.stderr
    assert "do not grow along the drive" in constant.stderr
    assert json.loads(constant.stdout)["uncertainty"] == "model"


def test_positions_without_a_heading_need_a_word_on_their_errors(
        boreas, stub, stream, tmp_path):
    file = write(tmp_path / "positions.txt", [
        (t, x, y) for t, x, y, _ in boreas[:300]])
    columns = ["--columns", "t=1,x=2,y=3", "--create"]
    refused = stream(file, *columns, "--vehicle", "asked")
    assert refused.returncode == LOCAL_FAULT
    assert "--uncertainty fixes if each has its own" in refused.stderr
    assert "--uncertainty model if they add up" in refused.stderr
    assert not is_there(stub, "asked")
    for word, model in (
            ("fixes", api.CORRELATION_MODEL_INDEPENDENT),
            ("model", api.CORRELATION_MODEL_DEAD_RECKONING)):
        taken = stream(file, *columns, "--vehicle", f"asked-{word}",
                       "--uncertainty", word)
        assert taken.returncode == 0, taken.stderr
        assert vehicle(stub, f"asked-{word}").settings.correlation_model == \
            model


def test_summary_says_how_long_the_drive_is_and_what_was_left_out(
        stream, tmp_path):
    rows = [(i, min(10 * i, 990), 0) for i in range(110)]
    file = write(tmp_path / "slow.csv", rows, "t,x,y", ",")
    arguments = [file, "--columns", "t=t,x=x,y=y", "--uncertainty", "fixes",
                 "--create"]
    text = stream(*arguments, "--vehicle", "summary")
    assert text.returncode == 0, text.stderr
    assert "drive             990.0 m in 99.0 s, 10.00 m/s on average" in \
        text.stdout
    assert "left out          10 positions at which the vehicle stood" in \
        text.stdout
    summary = json.loads(stream(*arguments, "--vehicle", "summary-json",
                                "--json").stdout)
    assert summary["lengthMeters"] == pytest.approx(990.0)
    assert summary["durationSeconds"] == pytest.approx(99.0)
    assert summary["pausedSeconds"] == 0
    assert summary["leftOut"] == {"standing": 10, "wrongChecksums": 0}


def test_summary_leaves_pauses_out_of_the_mean_speed(stream, tmp_path):
    # Two days in one file: 90 m in 9 s, 10 m until the next day, 90 m in 9 s.
    rows = [(day * 86400 + i, 10 * (10 * day + i), 0, 0)
            for day in range(2) for i in range(10)]
    file = write(tmp_path / "days.csv", rows, "t,x,y,yaw", ",")
    arguments = [file, "--create"]
    text = stream(*arguments, "--vehicle", "days")
    assert text.returncode == 0, text.stderr
    assert ("drive             190.0 m in 86409.0 s, 10.00 m/s on average "
            "without pauses of 86391.0 s\n") in text.stdout
    summary = json.loads(stream(*arguments, "--vehicle", "days-json",
                                "--json").stdout)
    assert summary["pausedSeconds"] == pytest.approx(86391.0)


def test_candidates_of_a_stream_may_be_of_either_direction(
        stub, stream, tmp_path):
    # Round two blocks, and back the same way.
    corners = [(0, 0), (200, 0), (200, 90), (420, 90), (420, 240), (90, 240)]
    path = []
    for (ax, ay), (bx, by) in zip(corners, corners[1:]):
        steps = int(math.hypot(bx - ax, by - ay) / 2)
        path += [(ax + (bx - ax) * i / steps, ay + (by - ay) * i / steps)
                 for i in range(steps)]
    path += [(x, y + 0.5) for x, y in reversed(path)]
    rows = []
    for i, (x, y) in enumerate(path[:-1]):
        yaw = math.atan2(path[i + 1][1] - y, path[i + 1][0] - x)
        rows.append((i, x, y, yaw))
    file = write(tmp_path / "back.csv", rows, "t,x,y,yaw", ",")
    directions = {}
    for word in ("same", "either"):
        found = stream(file, "--vehicle", f"to-{word}", "--create",
                       "--accept-suspicious", "--candidates", "--direction",
                       word)
        assert found.returncode == 0, found.stderr
        directions[word] = found.stdout.count("opposite direction, ")
        assert ("--direction either looks at both" in found.stdout) == (
            word == "same")
    assert directions["same"] == 0
    assert directions["either"] > 0
    wrong = stream(file, "--vehicle", "to-same", "--direction", "either")
    assert wrong.returncode == USAGE
    assert "--direction: goes with --candidates" in wrong.stderr


def test_unknown_vehicle_and_absent_server_have_hints(stream, tmp_path):
    file = write(tmp_path / "a.csv", [(0, 0, 0, 0)], PLAIN, ",")
    unknown = stream(file, "--vehicle", "nobody")
    assert "--create makes the vehicle" in unknown.stderr
    absent = run("revisit", "info", "--server", "127.0.0.1:1")
    assert "(is revisitd running at 127.0.0.1:1?" in absent.stderr
    as_json = run("revisit", "info", "--server", "127.0.0.1:1", "--json")
    assert "is revisitd running" in json.loads(as_json.stderr)["error"]["hint"]


def test_stream_without_a_vehicle_is_wrong_usage(stream):
    refused = stream(BOREAS)
    assert refused.returncode == USAGE
    assert "--vehicle is required" in refused.stderr


def lap(day):
    """A lap of 600 poses, some 2 m apart, around a lake with bays, from the origin:
    t, x, y, yaw."""
    def at(i):
        angle = math.tau * i / 600.0
        radius = 190.0 * (1.0 + 0.12 * math.sin(2.0 * angle + 0.7)
                          + 0.06 * math.sin(5.0 * angle))
        return radius * math.cos(angle), radius * math.sin(angle)

    poses = []
    for i in range(600):
        (x, y), (before, after) = at(i), (at(i - 0.5), at(i + 0.5))
        poses.append((86400.0 * day + i, x - at(0)[0], y - at(0)[1],
                      math.atan2(after[1] - before[1], after[0] - before[0])))
    return poses


def recordings_of(stub, name):
    return list(stub.ListRecordings(api.ListRecordingsRequest(
        parent=f"vehicles/{name}")).recordings)


@pytest.mark.parametrize("words, state", [
    ([], api.FRAME_STATE_AFTER),
    (["--recording", "after:3m,5deg"], api.FRAME_STATE_AFTER),
    (["--recording", "datum:3m,5deg,depot"], api.FRAME_STATE_DATUM),
    (["--recording", "unknown"], api.FRAME_STATE_NONE),
], ids=["by itself", "after", "datum", "unknown"])
def test_second_day_finds_the_first_one_in_a_frame_of_its_own(
        stub, stream, tmp_path, words, state):
    name = f"days-{api.FrameState.Name(state)[12:].lower()}-{len(words)}"
    days = [write(tmp_path / f"day{day}.csv", lap(day), PLAIN, ",")
            for day in range(2)]
    done = stream(*days, "--vehicle", name, "--create", "--candidates", *words,
                  "--json")
    found = candidates(done)
    assert json.loads(done.stdout.splitlines()[-1])["recordings"] == (
        2 if state == api.FRAME_STATE_DATUM else 1)
    listed = recordings_of(stub, name)
    assert [(one.label, one.first_sequence) for one in listed] == [
        ("day0" if state == api.FRAME_STATE_DATUM else "", 1), ("day1", 601)]
    assert listed[0].frame_state == state
    accepted = [(query, best[0][0]) for query, best in found
                if query > 600 and best and best[0][1] == "VERDICT_ACCEPTED"]
    assert len(accepted) > 8
    # The same lap: 600 poses later, within 10 m.
    assert all(abs(query - 600 - matched) <= 5 for query, matched in accepted)
    # Once more: compared, also the starts, and nothing to add.
    again = stream(*days, "--vehicle", name, *words, "--json")
    assert json.loads(again.stdout)["alreadyDurable"] == 1200


def test_recordings_are_listed_exported_and_drawn(server, stub, stream, tmp_path):
    days = [write(tmp_path / f"day{day}.txt", tum(lap(day)))
            for day in range(3)]
    done = stream(*days[:2], "--vehicle", "listed", "--create")
    assert done.returncode == 0, done.stderr
    done = stream(days[2], "--vehicle", "listed", "--append", "--recording", "unknown")
    assert done.returncode == 0, done.stderr

    def revisit(*arguments):
        result = run("revisit", *arguments, "--server", server.address)
        assert result.returncode == 0, result.stderr
        return result.stdout

    lines = revisit("recordings", "list", "listed").splitlines()
    assert lines[0].split()[:5] == ["FIRST", "LAST", "LABEL", "START", "FRAME"]
    assert [line.split()[:4] for line in lines[1:]] == [
        ["1", "600", "-", "-"], ["601", "1200", "day1", "after,"],
        ["1201", "1800", "day2", "unknown"]]
    assert "after, within 10 m and 17.2 degrees" in lines[2]
    listed = json.loads(revisit("recordings", "list", "listed", "--json"))
    assert [one["frameState"] for one in listed["recordings"]] == [
        "FRAME_STATE_NONE", "FRAME_STATE_NONE", "FRAME_STATE_SAME"]
    assert revisit("recordings", "list", "listed", "-o", "name").split() == [
        f"vehicles/listed/recordings/{first}" for first in (1, 601, 1201)]

    # There and back by the format of TUM, whose comments mark the starts.
    back = tmp_path / "back.txt"
    revisit("export", "listed", "--format", "tum", "--output", back)
    assert back.read_text().count("# recording ") == 2
    done = stream(back, "--vehicle", "by-tum", "--create")
    assert done.returncode == 0, done.stderr
    assert [(one.label, one.first_sequence, one.start)
            for one in recordings_of(stub, "by-tum")] == [
        (one.label, one.first_sequence, one.start)
        for one in recordings_of(stub, "listed")]

    g2o = revisit("export", "listed", "--format", "g2o")
    assert "EDGE_SE2 600 601 0 0 0 " in g2o
    assert "EDGE_SE2 1200 1201 " not in g2o
    for kind in ("--svg", "--html"):
        drawn = revisit("map", "listed", kind, "--check-interval", "400")
        assert "day1: tied by nothing, drawn beside the others" in drawn
        assert "day2: the last one" in drawn


def test_geodetic_vehicle_takes_no_recording_flag(stub, stream):
    pos = ROOT / "tests/data/formats/nagoya_spp.pos"
    refused = stream(pos, "--vehicle", "fixes", "--create", "--recording", "unknown",
                     "--append")
    assert refused.returncode == LOCAL_FAULT
    assert "--recording goes with local ones" in refused.stderr
    wrong = stream(pos, "--vehicle", "fixes", "--recording", "datum:10,1")
    assert wrong.returncode == USAGE
    assert "datum:10m,1deg" in wrong.stderr


def test_what_an_optimiser_joins_is_one_recording_whose_claims_grow(
        server, stub, stream, tmp_path):
    days = [write(tmp_path / f"day{day}.csv", lap(day), PLAIN, ",")
            for day in range(2)]
    done = stream(*days, "--vehicle", "joined", "--create")
    assert done.returncode == 0, done.stderr
    graph = tmp_path / "joined.g2o"
    for arguments in (["export", "joined", "--format", "g2o", "--output", graph],
                      ["revise", "joined", graph, "--format", "g2o",
                       "--common-frame"]):
        done = run("revisit", *arguments, "--server", server.address)
        assert done.returncode == 0, done.stderr
    assert [one.last_sequence for one in recordings_of(stub, "joined")] == [1200]
    assert not vehicle(stub, "joined").findings
    poses = stub.ListPoses(api.ListPosesRequest(
        parent="vehicles/joined", page_size=1200)).poses
    variances = [pose.covariance.values[0] + pose.covariance.values[3]
                 for pose in poses]
    # A lap back to the start has lost some of what its heading swung.
    assert variances[600] > 0.9 * variances[599] > 10 * variances[0]
    partial = run("revisit", "revise", "joined", graph, "--format", "g2o",
                  "--common-frame", "--partial", "--server", server.address)
    assert partial.returncode == USAGE
    assert "--partial" in partial.stderr
