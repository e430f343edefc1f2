"""revisit evaluate on real servers: tables, drawings, drift, the verifier."""

import contextlib
import json
import math
import re
import socket
import sys
import threading
import xml.etree.ElementTree

import pytest

from made_drives import write_drive, write_filtered_drive, write_gnss_laps
from revisit_server import BIN, Server, clean_environment, run
from stubs import ROOT
from wire import BOREAS

sys.path.insert(0, str(ROOT / "tests/evaluation"))
import leave_one_out

USAGE = 64
SVG = "{http://www.w3.org/2000/svg}"

METHODS = ["paper, independent", "paper, dead reckoning", "single pose",
           "relative", "nearest position"]
DRIVE_KEYS = {
    "drive", "checks", "true_loops", "accepted", "accepted_correct",
    "top1_correct", "top5_correct", "precision", "recall", "f1", "top1",
    "recall_at_5", "sure_correct", "sure_recall", "candidates_to_verify",
    "loops_found", "candidates_per_loop_found", "looks", "loops_seen",
    "looks_per_loop_seen", "accepted_holding", "interval_precision",
    "interval_recall", "positive_calibration_error",
    "expected_calibration_error", "confirmed", "rejected", "jumps",
    "query_ms_p50", "query_ms_p99", "poses", "poses_per_second"}


def evaluate(*arguments):
    return run("revisit", "evaluate", *arguments, env=clean_environment())


def report_of(*arguments):
    result = evaluate(*arguments, "--json")
    assert result.returncode == 0, result.stderr
    return json.loads(result.stdout)


def without_times(part):
    return {key: value for key, value in part.items()
            if key not in ("query_ms_p50", "query_ms_p99", "poses_per_second")}


def texts_of(path):
    """All text of a drawing that is well-formed and stands on its own."""
    root = xml.etree.ElementTree.parse(path).getroot()
    assert root.tag == f"{SVG}svg"
    for element in root.iter():
        for name, value in element.attrib.items():
            assert "href" not in name
            assert "http" not in value and "nan" not in value
    return ["".join(element.itertext()) for element in root.iter(f"{SVG}text")]


@pytest.mark.release_build
def test_baselines_stand_beside_the_settings(tmp_path):
    report = report_of(BOREAS, "--uncertainty", "file", "--baselines",
                       "--check-interval", "150",
                       "--plots", tmp_path / "made/plots")
    assert [method["method"] for method in report["methods"]] == METHODS
    for method in report["methods"]:
        assert method["sequence_length_meters"] == 150.0
        assert len(method["drives"]) == 1
        for part in (*method["drives"], method["total"]):
            assert DRIVE_KEYS <= part.keys()
        # The truth does not depend on the method.
        for key in ("checks", "true_loops", "poses"):
            assert method["total"][key] == report["total"][key]
        recalls = [point["recall"] for point in method["precision_recall"]]
        assert recalls == sorted(recalls)
        assert math.isclose(recalls[-1], method["total"]["top1"])
    relative = report["methods"][METHODS.index("relative")]
    assert relative["total"] == report["total"]
    assert report["total"]["checks"] > 100
    stated = relative["reliability"]
    assert len(stated) == 10
    assert 0 < sum(bin["count"] for bin in stated) <= report["total"]["checks"]
    assert 0.0 <= report["total"]["expected_calibration_error"] \
        <= report["total"]["positive_calibration_error"] <= 1.0
    assert 0.0 < report["total"]["sure_recall"] <= report["total"]["top1"]
    for method in report["methods"]:
        if method is not relative:
            assert method["reliability"] is None
            for key in ("expected_calibration_error",
                        "positive_calibration_error", "sure_recall"):
                assert method["total"][key] is None
    nearest = report["methods"][-1]["total"]
    assert nearest["query_ms_p50"] is None
    assert nearest["accepted"] > 0

    curves = texts_of(tmp_path / "made/plots/precision_recall.svg")
    assert set(METHODS) <= set(curves)
    assert "recall: right, of the true loops" in curves
    assert "precision: right, of those chosen" in curves
    reliability = texts_of(tmp_path / "made/plots/reliability.svg")
    assert "probability stated for the first candidate" in reliability
    assert "share of these candidates that are right" in reliability


def test_table_has_a_row_for_each_method_drive_and_total(tmp_path):
    one = write_drive(tmp_path / "one.csv", 2)
    two = write_drive(tmp_path / "two.csv", 1.5)
    result = evaluate(one, two, "--baselines")
    assert result.returncode == 0, result.stderr
    for method in METHODS:
        for drive in ("one", "two", "total"):
            assert re.search(rf"^{method} +{drive} +\d+ ", result.stdout,
                             re.MULTILINE), result.stdout


def test_sequence_lengths_exclude_as_much_as_they_are_long(tmp_path):
    drive = write_drive(tmp_path / "drive.csv", 2)
    report = report_of(drive, "--sequence-lengths", "100,150,200")
    lengths = [method["sequence_length_meters"] for method in report["methods"]]
    assert lengths == [100.0, 150.0, 200.0]
    # At 1200 m there are checks from 300 m, or two lengths, on.
    assert [method["total"]["checks"] for method in report["methods"]] == [
        18, 18, 16]
    # The settings' own length is the one that counts.
    assert report["total"] == report["methods"][1]["total"]
    assert any("sequence" in note for note in report["notes"])


def test_claimed_scales_are_each_what_the_scale_alone_is(tmp_path):
    drives = [write_drive(tmp_path / f"{name}.csv", 2) for name in "ab"]
    flags = (*drives, "--simulate", "3-4")
    report = report_of(*flags, "--claimed-scales", "0.25,1,4")
    assert [method["claimed_scale"] for method in report["methods"]] \
        == [0.25, 1.0, 4.0]
    for method in report["methods"]:
        alone = report_of(*flags, "--claimed-scale",
                          str(method["claimed_scale"]))
        assert without_times(method["total"]) == without_times(alone["total"])
        assert alone["methods"][0]["claimed_scale"] is None
        assert len(method["drives"]) == 4
    # The honest scale is the one that counts.
    assert report["total"] == report["methods"][1]["total"]
    table = evaluate(*flags, "--claimed-scales", "0.25,1,4")
    assert table.returncode == 0, table.stderr
    assert re.findall(r"^relative, claimed x (\S+) +total ", table.stdout,
                      re.MULTILINE) == ["0.25", "1", "4"]


def test_simulated_drives_are_the_same_again_and_differ_by_seed(tmp_path):
    drive = write_drive(tmp_path / "drive.csv", 2)
    first = report_of(drive, "--simulate", "3,5-6", "--verbose")
    assert [one["seed"] for one in first["drives"]] == [3, 5, 6]

    def paths(report):
        return [[check["travelled_meters"] for check in one["check_list"]]
                + [candidate["squared_mahalanobis_distance"]
                   for check in one["check_list"]
                   for candidate in check["candidates"]]
                for one in report["drives"]]
    again = report_of(drive, "--simulate", "3,5-6", "--verbose")
    assert paths(first) == paths(again)
    assert len({tuple(path) for path in paths(first)}) == 3
    # A claim half as large makes distances larger.
    proud = report_of(drive, "--simulate", "3", "--claimed-scale", "0.5",
                      "--alignment", "composite", "--verbose")
    honest = report_of(drive, "--simulate", "3", "--alignment", "composite",
                       "--verbose")
    largest = [max(paths(report)[0][-20:]) for report in (proud, honest)]
    assert largest[0] > largest[1]


def test_gyro_bias_makes_estimates_miss_where_they_were_right(tmp_path):
    drive = write_drive(tmp_path / "drive.csv", 3)
    plain = report_of(drive)
    # Samples are a second apart, so that each turns by 2 degrees too many and
    # a lap does not close any more.
    biased = report_of(drive, "--gyro-bias", "2")
    assert biased["total"]["checks"] == plain["total"]["checks"]
    assert biased["total"]["true_loops"] == plain["total"]["true_loops"]
    assert biased["total"]["top1_correct"] < plain["total"]["top1_correct"]
    assert any(note.startswith("Gyro bias: estimates turn by 2.0000 degrees")
               for note in biased["notes"])
    assert without_times(report_of(drive, "--gyro-bias", "0")["total"]) \
        == without_times(plain["total"])


def test_fixes_are_drawn_along_the_truth_with_a_seed(tmp_path):
    drive = write_drive(tmp_path / "drive.csv", 3, step_meters=5.0)
    report = report_of(drive, "--fix-noise", "1,60")
    assert [one["seed"] for one in report["drives"]] == [1]
    # Samples are a second apart, so that each brings a fix.
    assert report["drives"][0]["poses"] == 360
    assert report["total"]["true_loops"] > 10
    assert report["total"]["recall"] > 0.5
    assert any("correlated over 60 s" in note for note in report["notes"])
    again = report_of(drive, "--fix-noise", "1,60", "--simulate", "1-2")
    assert [one["seed"] for one in again["drives"]] == [1, 2]
    assert without_times(again["drives"][0]) \
        == without_times(report["drives"][0])
    alone = report_of(drive, "--fix-noise", "1")
    assert any("in x and y, independent," in note for note in alone["notes"])


def test_verifier_confirms_what_is_right_and_rejects_what_is_wrong(tmp_path):
    drive = write_drive(tmp_path / "drive.csv", 3)
    report = report_of(drive, "--verify", "--alignment", "composite",
                       "--repeat", "2")
    total = report["total"]
    # The estimate is the truth, and nearly all of the second and third lap is
    # a revisit.
    assert total["confirmed"] >= total["accepted_correct"] > 10
    assert total["rejected"] >= total["accepted"] - total["accepted_correct"]
    assert report["drives"][0]["inflation"] >= 1.0
    assert report["repeats"] == 2
    assert any(note.startswith("Repeated: 2 times, all answers the same")
               for note in report["notes"])
    table = evaluate(drive, drive, "--verify", "--no-use-belief",
                     "--apply-inflation")
    assert table.returncode == 0, table.stderr
    assert "No belief: every search begins with" in table.stdout
    assert re.search(r"CONFIRMED +REJECTED +INFLATION", table.stdout)


def test_verifier_errs_as_it_is_told_to(tmp_path):
    drive = write_drive(tmp_path / "drive.csv", 3)
    right = report_of(drive, "--verify")["total"]
    assert right["rejected"] == 0 < right["confirmed"]
    liar = report_of(drive, "--verify", "--verify-wrong", "1")["total"]
    assert liar["confirmed"] == 0 < liar["rejected"]
    mute = report_of(drive, "--verify", "--verify-silent", "1")["total"]
    assert mute["confirmed"] == mute["rejected"] == 0
    # Closures with measurements are stored as such: the server refuses those that
    # are none.
    measured = report_of(drive, "--verify", "--verify-measured", "0.3,0.5",
                         "--repeat", "2")
    assert measured["total"]["confirmed"] == right["confirmed"]
    assert any("closures were measured to 0.30 m and 0.50 degrees" in note
               for note in measured["notes"])


@pytest.mark.parametrize("flags, message", [
    (("--verify", "--verify-wrong", "1.5"),
     "--verify-wrong: expected a share in [0, 1], such as 0.1; got 1.5"),
    (("--verify-silent", "0.1"), "--verify-silent: goes with --verify"),
    (("--verify", "--verify-measured", "1"),
     "--verify-measured: expected metres and degrees, such as 0.5,1"),
    (("--verify", "--verify-measured", "1,1", "--state-space", "spatial"),
     "--verify-measured: does not go with --state-space spatial"),
])
def test_a_verifier_that_cannot_be_is_refused(flags, message, tmp_path):
    drive = write_drive(tmp_path / "drive.csv", 1)
    refused = evaluate(drive, *flags)
    assert refused.returncode == 64
    assert message in refused.stderr


def test_repeats_change_nothing_but_times(tmp_path):
    drive = write_drive(tmp_path / "drive.csv", 2)
    once = report_of(drive)
    thrice = report_of(drive, "--repeat", "3")
    assert without_times(once["total"]) == without_times(thrice["total"])


def test_gnss_drives_of_one_vehicle_have_one_frame(tmp_path):
    names = write_gnss_laps(tmp_path)
    report = report_of(names[0], names[2], "--one-vehicle", "--truth",
                       names[1], names[3], "--map", tmp_path / "map.svg")
    (drive,) = report["drives"]
    assert drive["drive"] == "spp_2023+spp_2024"
    assert drive["poses"] == 200
    # The second lap, 800 m, is a revisit throughout; checks every 50 m.
    assert 14 <= drive["true_loops"] <= 17
    assert drive["top1_correct"] >= 12
    texts_of(tmp_path / "map.svg")
    # Errors are drawn and added in metres.
    for flag, value in (("--simulate", "1"), ("--gyro-bias", "1"),
                        ("--fix-noise", "1")):
        result = evaluate(names[0], "--truth", names[1], flag, value)
        assert result.returncode == 1
        assert f"{flag} goes with local positions" in result.stderr


def test_floors_of_a_car_park_are_places_of_their_own_in_space(tmp_path):
    drive = write_drive(tmp_path / "park.csv", 3, climb_meters=15.0)
    planar = report_of(drive)["total"]
    # A belief would rather take the first laps for errors of height of more than
    # was claimed.
    spatial = report_of(drive, "--state-space", "spatial",
                        "--no-use-belief")["total"]
    # In the plane each lap is where the one before was, and is judged so.
    assert planar["true_loops"] == spatial["true_loops"] > 15
    assert planar["accepted_correct"] > 15
    assert spatial["accepted"] == 0
    # On one level the two agree.
    level = write_drive(tmp_path / "level.csv", 3, climb_meters=0.0)
    flat = report_of(level, "--state-space", "spatial")["total"]
    assert flat["accepted_correct"] == planar["accepted_correct"]


def test_simulated_heights_leave_the_plane_as_it_was(tmp_path):
    flags = ("--simulate", "3", "--verbose")
    level = report_of(write_drive(tmp_path / "drive.csv", 2), *flags)
    (tmp_path / "hill").mkdir()
    hill = report_of(write_drive(tmp_path / "hill/drive.csv", 2,
                                 climb_meters=3.0), *flags)
    assert [check["candidates"] for check in level["drives"][0]["check_list"]] \
        == [check["candidates"] for check in hill["drives"][0]["check_list"]]
    spatial = report_of(tmp_path / "hill/drive.csv", *flags, "--state-space",
                        "spatial")
    assert spatial["total"]["true_loops"] == hill["total"]["true_loops"]
    assert spatial["drives"][0]["check_list"] \
        != hill["drives"][0]["check_list"]


@pytest.mark.parametrize("alignment", ["relative", "composite"])
def test_filter_without_fixes_is_dead_reckoning(alignment, tmp_path):
    drive = write_filtered_drive(tmp_path / "filtered.csv", 2)

    def candidates(*flags):
        report = report_of(drive, "--alignment", alignment, "--exhaustive",
                           "--verbose", "--no-use-belief", *flags)
        # A filter may have other places that are out of the question.
        return [candidate for check in report["drives"][0]["check_list"]
                for candidate in check["candidates"]
                if candidate["probability"] is None
                or candidate["probability"] > 1e-6]
    filtered = candidates("--correlation-model", "filter")
    reckoned = candidates("--correlation-model", "dead-reckoning",
                          "--uncertainty", "fixes")
    independent = candidates("--correlation-model", "independent",
                             "--uncertainty", "fixes")
    assert len(filtered) == len(reckoned) > 10
    for one, other in zip(filtered, reckoned):
        for key in ("matched_node", "verdict", "gate", "correct"):
            assert one[key] == other[key]
        # A filter's shapes are compared by its own claims, reckoned ones by the
        # noise of odometers: places are alike, numbers nearly.
        for key, tolerance in (("squared_mahalanobis_distance", 1e-6),
                               ("probability", 1e-3)):
            assert (one[key] is None) == (other[key] is None)
            assert math.isclose(one[key] or 0.0, other[key] or 0.0,
                                rel_tol=1e-6, abs_tol=tolerance)
    assert filtered != independent


def test_filter_needs_an_error_transition_with_every_pose(tmp_path):
    drive = write_filtered_drive(tmp_path / "poses.csv", 1,
                                 with_transitions=False)
    result = evaluate(drive, "--correlation-model", "filter")
    assert result.returncode == 1
    assert "poses: expected an error transition with every pose" \
        in result.stderr
    drive = write_filtered_drive(tmp_path / "filtered.csv", 1)
    for flags, words in [
            (("--simulate", "1"), "that are drawn anew have none"),
            (("--fix-noise", "1"), "that are drawn anew have none"),
            (("--state-space", "spatial"), "goes with --state-space planar")]:
        result = evaluate(drive, "--correlation-model", "filter", *flags)
        assert result.returncode == 1
        assert words in result.stderr


def test_checks_of_a_new_route_do_not_count_where_only_revisits_do(tmp_path):
    drive = write_drive(tmp_path / "drive.csv", 2)
    every = report_of(drive, "--verbose")
    revisits = report_of(drive, "--only-revisited", "--verbose")
    loops = [check["true_loop"] for check in every["drives"][0]["check_list"]]
    first = loops.index(True)
    assert first > 0
    assert revisits["total"]["checks"] == len(loops) - first
    assert revisits["total"]["true_loops"] == every["total"]["true_loops"]
    assert revisits["drives"][0]["check_list"][0]["true_loop"]


@pytest.mark.parametrize("flags, words", [
    (["--simulate", "4-2"], "expected seeds such as 7, 1-5 or 1,4,8-10"),
    (["--simulate", "1", "--uncertainty", "file"],
     "goes with --uncertainty model only"),
    (["--truth", "x.csv", "y.csv"], "expected one for each FILE"),
    (["--map", "m.svg", "--simulate", "1-2"], "takes one drive only"),
    (["--vehicle", "v", "--baselines"], "takes one vehicle only"),
    (["--vehicle", "v", "--repeat", "2"], "takes one vehicle only"),
    (["--claimed-scale", "0"], "must be positive"),
    (["--claimed-scales", "1,0"], "--claimed-scales"),
    (["--gyro-bias", "1", "--uncertainty", "file"],
     "goes with --uncertainty model only"),
    (["--fix-noise", "0"], "--fix-noise"),
    (["--fix-noise", "1,2,3"], "expected metres, or metres and seconds"),
    (["--fix-noise", "1", "--gyro-bias", "1"], "does not go with --gyro-bias"),
    (["--fix-noise", "1", "--state-space", "spatial"],
     "fixes are drawn in the plane"),
    (["--fix-noise", "1", "--uncertainty", "model"],
     "does not go with --uncertainty"),
    (["--claimed-scales", "1,2", "--claimed-scale", "2"],
     "stands in place of --claimed-scale"),
    (["--claimed-scales", "1,2", "--sequence-lengths", "100,150"],
     "does not go with --sequence-lengths"),
    (["--vehicle", "v", "--claimed-scales", "1,2"], "takes one vehicle only"),
    (["--repeat", "0"], "--repeat"),
    (["--sequence-lengths", "100,0"], "--sequence-lengths"),
    (["--alignment", "best"], "--alignment"),
])
def test_flags_that_do_not_go_together_are_refused(flags, words):
    result = evaluate(BOREAS, *flags)
    assert result.returncode == USAGE
    assert words in result.stderr
    assert result.stdout == ""


def test_plots_that_cannot_be_written_are_an_error(tmp_path):
    drive = write_drive(tmp_path / "drive.csv", 1)
    (tmp_path / "file").write_text("")
    result = evaluate(drive, "--plots", tmp_path / "file/plots")
    assert result.returncode == 1
    assert str(tmp_path / "file/plots") in result.stderr


# ---- tests/evaluation/leave_one_out.py


def counts(loops, accepted, right):
    return {"checks": 10, "true_loops": loops, "accepted": accepted,
            "accepted_correct": right, "top1_correct": right}


def test_each_drive_is_judged_by_what_the_others_chose():
    results = {
        "near": {"a": counts(4, 4, 4), "b": counts(4, 4, 1),
                 "c": counts(4, 4, 1)},
        "far": {"a": counts(4, 4, 0), "b": counts(4, 4, 3),
                "c": counts(4, 4, 3)},
    }
    held_out = leave_one_out.hold_out(results)
    # b and c prefer "far", which is bad for a. Without b, as without c, "near"
    # has 5 right and "far" 3.
    assert [(drive, point) for drive, point, _ in held_out] == [
        ("a", "far"), ("b", "near"), ("c", "near")]
    total = leave_one_out.total(one for _, _, one in held_out)
    assert total == {"checks": 30, "true_loops": 12, "accepted": 12,
                     "accepted_correct": 2, "top1_correct": 2}
    assert leave_one_out.f1(total) == 4 / 24


def test_grid_begins_at_the_defaults_and_ties_stay_there():
    points = leave_one_out.grid([(1, 2, 3), (5, 6)], [2, 5])
    assert points[0] == (2, 5)
    assert len(points) == 6
    same = {point: {"a": counts(1, 1, 1), "b": counts(1, 1, 1)}
            for point in points}
    assert {point for _, point, _ in leave_one_out.hold_out(same)} == {(2, 5)}
    nothing = {point: {"a": counts(0, 0, 0), "b": counts(0, 0, 0)}
               for point in points}
    assert {point for _, point, _
            in leave_one_out.hold_out(nothing)} == {(2, 5)}


def test_data_sets_are_judged_by_what_the_other_data_sets_chose():
    results = {
        "near": {"kitti_00": counts(4, 4, 4), "kitti_02": counts(4, 4, 4),
                 "mulran_DCC_01": counts(4, 4, 1)},
        "far": {"kitti_00": counts(4, 4, 2), "kitti_02": counts(4, 4, 2),
                "mulran_DCC_01": counts(4, 4, 3)},
    }
    # The other drive of its data set would tell kitti_00 to take "near".
    by_drive = leave_one_out.hold_out(results)
    assert [point for _, point, _ in by_drive] == ["near", "near", "near"]
    by_set = leave_one_out.hold_out(results, leave_one_out.data_set)
    assert [(drive, point) for drive, point, _ in by_set] == [
        ("kitti_00", "far"), ("kitti_02", "far"), ("mulran_DCC_01", "near")]
    assert leave_one_out.total(
        one for _, _, one in by_set)["accepted_correct"] == 2 + 2 + 1


def test_one_data_set_alone_has_no_others_to_choose(tmp_path):
    drives = [write_drive(tmp_path / f"city_{name}.csv", 1) for name in "ab"]
    result = run(sys.executable, ROOT / "tests/evaluation/leave_one_out.py",
                 "--by", "data-set", *drives, env=clean_environment())
    assert result.returncode == 2
    assert "--by data-set: expected drives of two at least" in result.stderr


def test_leave_one_out_runs_the_real_evaluation(tmp_path):
    drives = [write_drive(tmp_path / f"{name}.csv", 1.5) for name in "ab"]
    result = run(sys.executable, ROOT / "tests/evaluation/leave_one_out.py",
                 "--revisit", BIN / "revisit", "--json",
                 "--road-spacing", "200", "--shape-correlation", "10",
                 "--acceptance-probability", "0.3,0.5", *drives, "--",
                 "--check-interval", "40", env=clean_environment())
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    assert [one["drive"] for one in report["held_out"]] == ["a", "b"]
    assert len(report["points"]) == 2
    assert report["held_out_total"]["checks"] > 20


class CuttingProxy:
    """Passes connections on to a server, and cuts the first of them after so
    many bytes of the client's."""

    def __init__(self, server, cuts, after_bytes):
        self.server, self.after_bytes = server, after_bytes
        self.cuts_left, self.cuts_made = cuts, 0
        self.listener = socket.create_server(("127.0.0.1", 0))
        threading.Thread(target=self.accept, daemon=True).start()

    @property
    def address(self):
        return f"127.0.0.1:{self.listener.getsockname()[1]}"

    def accept(self):
        while True:
            try:
                client, _ = self.listener.accept()
            except OSError:
                return
            server = socket.create_connection(("127.0.0.1", self.server.port))
            limit = None
            if self.cuts_left > 0:
                self.cuts_left -= 1
                limit = self.after_bytes
            for ends in ((client, server, limit), (server, client, None)):
                threading.Thread(target=self.pass_on, args=ends,
                                 daemon=True).start()

    def pass_on(self, source, sink, limit):
        passed = 0
        try:
            while data := source.recv(4096):
                passed += len(data)
                if limit is not None and passed > limit:
                    self.cuts_made += 1
                    break
                sink.sendall(data)
        except OSError:
            pass
        for end in (source, sink):
            with contextlib.suppress(OSError):
                end.shutdown(socket.SHUT_RDWR)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.listener.close()


@pytest.mark.parametrize("verify", [False, True], ids=["alone", "verified"])
def test_drive_whose_connection_breaks_is_streamed_again(verify, tmp_path):
    flags = [write_drive(tmp_path / "square.csv", 3)] + ["--verify"] * verify
    with Server(tmp_path / "store") as server:
        unbroken = report_of(*flags, "--server", server.address)
        with CuttingProxy(server, cuts=1, after_bytes=40000) as proxy:
            result = evaluate(*flags, "--json", "--server", proxy.address)
            assert result.returncode == 0, result.stderr
            assert proxy.cuts_made == 1
        assert result.stderr.count("streamed again from its start") == 1
        assert without_times(json.loads(result.stdout)["total"]) == \
            without_times(unbroken["total"])
        # One that breaks again and again is given up, and says why.
        with CuttingProxy(server, cuts=1000, after_bytes=40000) as proxy:
            result = evaluate(*flags, "--server", proxy.address)
            assert result.returncode == 64 + 14, result
            assert "the connection broke while square was streamed (" \
                in result.stderr


@pytest.fixture(name="days", scope="module")
def fixture_days(tmp_path_factory):
    """The two days of the shipped drive, whose truths are in one frame."""
    folder = tmp_path_factory.mktemp("days")
    lines = BOREAS.read_text().splitlines()
    times = [float(line.split(",")[1]) for line in lines[1:]]
    night = next(i for i in range(1, len(times)) if times[i] - times[i - 1] > 3600)
    paths = []
    for name, part in (("one", lines[1:night + 1]), ("two", lines[night + 1:])):
        paths.append(folder / f"{name}.csv")
        paths[-1].write_text("\n".join([lines[0], *part]) + "\n")
    return paths


def test_each_recording_asks_once_for_places_in_the_others(days):
    report = report_of(*days, "--one-vehicle", "--recordings", "datum:50m,1deg",
                       "--seeds", "2", "--check-interval", "200", "--verbose")
    assert [(drive["drive"], drive["seed"]) for drive in report["drives"]] == [
        ("one", 1), ("one", 2), ("two", 1), ("two", 2)]
    total = report["total"]
    assert total["precision"] > 0.95 and total["recall"] > 0.9
    # Both days went the same way.
    assert total["new_road_checks"] == total["new_road_accepted"] == 0
    for drive in report["drives"]:
        first = min(check["node"] for check in drive["check_list"])
        for check in drive["check_list"]:
            assert check["travelled_meters"] > 7000.0
            assert all(one["matched_node"] < first for one in check["candidates"])


def test_checks_of_recordings_count_behind_the_first_link(days):
    report = report_of(*days, "--one-vehicle", "--recordings", "datum:200m,5deg",
                       "--seeds", "1", "--check-interval", "200", "--verify")
    for drive in report["drives"]:
        assert drive["confirmed"] == 1 and drive["rejected"] == 0
        assert 100.0 <= drive["linked_after_meters"] < 2000.0
    assert report["total"]["recall"] > 0.95
    # Without datums there is nothing to draw.
    unknown = report_of(*days, "--one-vehicle", "--recordings", "unknown",
                        "--check-interval", "200", "--sequence-length", "300")
    assert [drive["seed"] for drive in unknown["drives"]] == [None, None]
    assert unknown["total"]["precision"] > 0.95


@pytest.mark.parametrize("arguments, words", [
    (["--recordings", "unknown"], "--one-vehicle"),
    (["--one-vehicle", "--recordings", "same"], "after, datum, unknown"),
    (["--one-vehicle", "--recordings", "after", "--seeds", "2"], "--seeds"),
    (["--one-vehicle", "--seeds", "2"], "--seeds"),
    (["--one-vehicle", "--recordings", "after", "--map", "a.svg"], "--map"),
    (["--one-vehicle", "--recordings", "after", "--simulate", "1"], "--simulate"),
    (["--one-vehicle", "--recordings", "datum:10,1"], "datum:10m,1deg"),
])
def test_recordings_go_with_what_has_a_meaning_for_them(days, arguments, words):
    refused = evaluate(*days, *arguments)
    assert refused.returncode == USAGE
    assert words in refused.stderr
