"""What comes out of a vehicle: poses and graphs as files, maps, and optimised
poses that come back."""

import csv
import io
import json
import math
import re
import xml.etree.ElementTree

import grpc
import pytest

from revisit_server import run
from stubs import api
from wire import BOREAS, append, boreas, get, laps, list_poses, pose

USAGE = 64
SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def revisit(server):
    """Runs `revisit` against the server; answers the finished process."""
    def call(*arguments):
        return run("revisit", *arguments, "--server", server.address)
    return call


@pytest.fixture(scope="module")
def output_of(revisit):
    def call(*arguments):
        result = revisit(*arguments)
        assert result.returncode == 0, result.stderr
        return result.stdout
    return call


@pytest.fixture(scope="module")
def driven(output_of):
    """A vehicle with the shipped drive, two closures and a rejection."""
    output_of("stream", BOREAS, "--uncertainty", "file", "--vehicle", "drive",
              "--create")
    output_of("confirm", "drive", "2068", "1072")
    output_of("confirm", "drive", "1990", "995", "--relative",
              "-1.5,0.25,-0.01", "--covariance", "0.04,0,0,0.04,0,0.0004")
    output_of("reject", "drive", "2068", "1155", "--note", "another road")
    return "drive"


@pytest.fixture(scope="module")
def geodetic(stub, new_vehicle):
    """A vehicle that drives a circle three times, near 60 degrees north."""
    name = new_vehicle(coordinate_frame=api.COORDINATE_FRAME_GEODETIC)
    poses = laps(1131)
    for each in poses:
        x, y = each.local.x_meters, each.local.y_meters
        each.geodetic.latitude_degrees = 60.0 + y / 111412.0
        each.geodetic.longitude_degrees = 10.0 + x / 55800.0
        each.stamp.seconds = 1606417097 + each.sequence
    append(stub, name, poses)
    return name


def rows_of(text):
    return list(csv.DictReader(io.StringIO(text)))




# ---- export


def test_exported_trajectories_are_the_stored_poses(stub, driven, output_of):
    stored = list_poses(stub, f"vehicles/{driven}")
    tum = [line.split() for line in
           output_of("export", driven, "--format", "tum").splitlines()]
    kitti = [[float(word) for word in line.split()] for line in
             output_of("export", driven, "--format", "kitti").splitlines()]
    rows = rows_of(output_of("export", driven, "--format", "csv"))
    assert len(tum) == len(kitti) == len(rows) == len(stored) == 2076
    for each, line, matrix, row in zip(stored, tum, kitti, rows):
        x, y = each.local.x_meters, each.local.y_meters
        heading = math.remainder(each.heading_radians, math.tau)
        seconds, _, fraction = line[0].partition(".")
        assert int(seconds) == each.stamp.seconds
        assert int(fraction.ljust(9, "0")) == each.stamp.nanos
        # To the bit.
        assert [float(word) for word in line[1:4]] == [x, y, 0.0]
        assert math.isclose(2 * math.atan2(float(line[6]), float(line[7])),
                            heading, abs_tol=1e-12)
        assert (matrix[3], matrix[7], matrix[11]) == (x, y, 0.0)
        assert math.isclose(math.atan2(matrix[4], matrix[0]), heading,
                            abs_tol=1e-12)
        assert int(row["sequence"]) == each.sequence
        assert [float(row[name]) for name in
                ("pxx", "pxy", "pxt", "pyy", "pyt", "ptt")] == list(
                    each.covariance.values)
        assert row["pzz"] == ""


@pytest.mark.parametrize("words, flags", [
    ("csv", ["--uncertainty", "file"]), ("tum", ["--format", "tum"]),
    ("kitti", ["--format", "kitti", "--rate", "1"]),
    ("g2o", ["--format", "g2o"])])
def test_exported_poses_can_be_streamed_again(
        words, flags, stub, driven, output_of, tmp_path):
    path = tmp_path / "poses"
    output_of("export", driven, "--format", words, "--output", path)
    output_of("stream", path, *flags, "--vehicle", f"again-{words}", "--create")
    again = list_poses(stub, f"vehicles/again-{words}")
    assert ([(each.local.x_meters, each.local.y_meters) for each in again]
            == [(each.local.x_meters, each.local.y_meters)
                for each in list_poses(stub, f"vehicles/{driven}")])


def test_exported_g2o_has_an_edge_for_each_step_and_each_closure(
        driven, revisit, stub):
    result = revisit("export", driven, "--format", "g2o")
    assert result.returncode == 0, result.stderr
    lines = [line.split() for line in result.stdout.splitlines()]
    vertices = [line for line in lines if line[0] == "VERTEX_SE2"]
    edges = [line for line in lines if line[0] == "EDGE_SE2"]
    assert len(vertices) + len(edges) == len(lines)
    assert [int(line[1]) for line in vertices] == list(range(1, 2077))
    assert [line[1:3] for line in edges[:2075]] == [
        [str(n), str(n + 1)] for n in range(1, 2076)]
    # Sorted by name: the measured one, and one at one place.
    (measured,) = [line for line in edges[2075:] if line[2] == "1990"]
    assert measured[1] == "995"
    assert [float(word) for word in measured[3:6]] == [-1.5, 0.25, -0.01]
    assert math.isclose(float(measured[6]), 25.0)
    (unmeasured,) = [line for line in edges[2075:] if line[2] == "2068"]
    assert [float(word) for word in unmeasured[3:6]] == [0.0, 0.0, 0.0]
    for line in edges:
        xx, xy, xh, yy, yh, hh = map(float, line[6:])
        determinant = (xx * (yy * hh - yh * yh) - xy * (xy * hh - yh * xh)
                       + xh * (xy * yh - yy * xh))
        assert xx > 0 and xx * yy > xy * xy and determinant > 0
    revision = get(stub, f"vehicles/{driven}").revision
    assert (f"revision {revision}, poses: 2076, jumps: 0, loop closures: 2, "
            "without a measurement: 1\n") in result.stderr


def test_spatial_vehicle_is_exported_with_its_full_orientation(
        stub, new_vehicle, output_of):
    vehicle = new_vehicle(state_space=api.STATE_SPACE_SPATIAL)
    poses = []
    for n in range(1, 4):
        each = pose(n, x=float(n))
        each.local.z_meters = 0.5 * n
        each.quaternion.CopyFrom(api.Quaternion(y=0.1, w=math.sqrt(0.99)))
        variance = 0.01 * n
        each.covariance.CopyFrom(api.Covariance(
            form=api.COVARIANCE_FORM_SPATIAL_10,
            values=[variance, 0, 0, 0, variance, 0, 0, variance, 0, variance]))
        poses.append(each)
    append(stub, vehicle, poses)
    lines = [line.split() for line in
             output_of("export", vehicle, "--format", "g2o").splitlines()]
    assert [line[0] for line in lines] == [
        "VERTEX_SE3:QUAT", "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT",
        "VERTEX_SE3:QUAT", "EDGE_SE3:QUAT"]
    assert [float(word) for word in lines[3][2:]] == pytest.approx(
        [3.0, 0.0, 1.5, 0.0, 0.1, 0.0, math.sqrt(0.99)])
    # One metre ahead and half a metre up, seen from a body that is pitched
    # down by 2 asin(0.1); both bodies are turned alike.
    pitch = 2 * math.asin(0.1)
    edge = [float(word) for word in lines[4][3:]]
    assert edge[:7] == pytest.approx([
        math.cos(pitch) - 0.5 * math.sin(pitch), 0.0,
        math.sin(pitch) + 0.5 * math.cos(pitch), 0.0, 0.0, 0.0, 1.0])
    assert len(edge) == 7 + 21


def test_tum_of_poses_without_stamps_is_refused(stub, new_vehicle, revisit):
    vehicle = new_vehicle()
    append(stub, vehicle, [pose(1), pose(2, x=1.0)])
    result = revisit("export", vehicle, "--format", "tum")
    assert result.returncode == 1
    assert "pose 1 has no stamp" in result.stderr
    assert "--format g2o" in result.stderr
    assert revisit("export", vehicle, "--format", "csv").returncode == 0


def test_geojson_is_for_geodetic_vehicles(driven, geodetic, revisit, output_of):
    refused = revisit("export", driven, "--format", "geojson")
    assert refused.returncode == 1
    assert "RFC 7946" in refused.stderr
    (feature,) = json.loads(
        output_of("export", geodetic, "--format", "geojson"))["features"]
    assert feature["properties"]["kind"] == "trajectory"
    (line,) = feature["geometry"]["coordinates"]
    for longitude, latitude in line:
        assert abs(longitude - 10.0) < 0.002
        assert abs(latitude - 60.0) < 0.001


def test_exported_poses_of_a_geodetic_vehicle_are_local(geodetic, output_of):
    rows = rows_of(output_of("export", geodetic, "--format", "csv"))
    # The origin is the first pose, on the circle of 60 m.
    assert float(rows[0]["est_x"]) == float(rows[0]["est_y"]) == 0.0
    middle = (float(rows[0]["est_x"]) - 60.0, 0.0)
    for row in rows[::50]:
        away = math.hypot(float(row["est_x"]) - middle[0],
                          float(row["est_y"]) - middle[1])
        assert math.isclose(away, 60.0, abs_tol=1.5)


# ---- confirm with a measurement


def test_confirm_says_how_well_the_measurement_agrees(driven, revisit):
    result = revisit("confirm", driven, "1995", "1000", "--relative",
                     "-1.5,0.25,-0.01", "--covariance",
                     "0.04,0,0,0.04,0,0.0004", "--note", "icp")
    assert result.returncode == 0, result.stderr
    assert re.search(r"agreement with the graph: d2 \d+\.\d\d of 3 degrees of "
                     r"freedom, p-value [01]\.\d{4}\n", result.stdout)
    assert revisit("closures", "delete", driven, "1995-1000").returncode == 0
    half = revisit("confirm", driven, "1995", "1000", "--relative", "1,2,3")
    assert half.returncode == USAGE
    assert "--covariance" in half.stderr


# ---- map


def test_map_shows_candidates_by_verdict_and_what_was_verified(
        driven, revisit, tmp_path):
    path = tmp_path / "map.svg"
    result = revisit("map", driven, "--svg", "--direction", "either",
                     "--check-interval", "200", "--searches-per-second",
                     "10000", "--output", path)
    assert (result.returncode, result.stdout) == (0, ""), result.stderr
    counted = re.search(r"(\d+) searches, accepted: (\d+),",
                        result.stderr)
    assert 70 < int(counted[1]) < 90
    assert 20 < int(counted[2]) < int(counted[1])
    root = xml.etree.ElementTree.parse(path).getroot()
    texts = ["".join(element.itertext()) for element in root.iter(f"{SVG}text")]
    assert {f"accepted: {counted[2]}", "confirmed: 2", "rejected: 1",
            "vehicles/drive"} <= set(texts)
    assert "true trajectory" not in texts


def test_page_of_a_map_holds_all_that_it_needs(driven, output_of):
    page = output_of("map", driven, "--check-interval", "500",
                     "--searches-per-second", "10000")
    data = json.loads(re.search(
        r'<script type="application/json" id="data">(.*?)</script>', page,
        re.DOTALL)[1])
    assert len(data["nodes"]["x"]) > 7000
    assert len(data["checks"]) > 25
    shown = [candidate for check in data["checks"]
             for candidate in check["candidates"]]
    assert {"ACCEPTED"} <= {candidate["verdict"] for candidate in shown}
    assert [(pair["name"], pair["note"]) for pair in data["rejections"]] == [
        ("vehicles/drive/rejectedCandidates/2068-1155", "another road")]
    assert "href" not in page and "src=" not in page
    assert page.count("http") == 1


def test_map_of_a_geodetic_vehicle_lies_on_the_earth(geodetic, output_of):
    features = json.loads(output_of("map", geodetic, "--geojson"))["features"]
    kinds = [feature["properties"]["kind"] for feature in features]
    assert kinds.count("check") == kinds.count("uncertainty") >= 10
    accepted = [feature for feature in features
                if feature["properties"].get("verdict") == "ACCEPTED"]
    assert accepted
    for feature in accepted:
        assert feature["geometry"]["type"] == "LineString"
        properties = feature["properties"]
        assert properties["query_sequence"] > properties["matched_sequence"]
        assert properties["query_time"].startswith("2020-11-26T")


def test_map_of_nothing_is_refused(new_vehicle, revisit):
    result = revisit("map", new_vehicle())
    assert result.returncode == 1
    assert "there is nothing to draw" in result.stderr
    both = revisit("map", "v", "--svg", "--html")
    assert both.returncode == USAGE


# ---- revise


@pytest.fixture
def copied(stub, new_vehicle):
    """A new vehicle with the first 100 poses of the shipped drive, stamped."""
    vehicle = new_vehicle()
    poses = boreas()[0][:100]
    for each in poses:
        each.stamp.seconds = 1606417097 + each.sequence
        each.stamp.nanos = 528000000
    append(stub, vehicle, poses)
    return vehicle


@pytest.mark.parametrize("words", ["tum", "g2o", "csv"])
def test_poses_that_come_back_as_they_were_exported_stay_as_they_are(
        words, stub, copied, output_of, tmp_path):
    before = list_poses(stub, copied)
    revision = get(stub, copied).revision
    path = tmp_path / "poses"
    output_of("export", copied, "--format", words, "--output", path)
    said = output_of("revise", copied, path, "--format", words)
    assert said == (f"revised 100 poses of {copied}, revision "
                    f"{revision + 1}\n")
    for old, new in zip(before, list_poses(stub, copied)):
        assert (new.sequence, new.stamp, new.local) == (
            old.sequence, old.stamp, old.local)
        assert new.covariance == old.covariance
        # TUM brings a quaternion.
        heading = (2 * math.atan2(new.quaternion.z, new.quaternion.w)
                   if new.HasField("quaternion") else new.heading_radians)
        assert math.isclose(math.remainder(heading - old.heading_radians,
                                           math.tau), 0.0, abs_tol=1e-9)


def test_revised_poses_move_and_others_may_be_left_out(
        stub, copied, revisit, tmp_path):
    path = tmp_path / "moved.tum"
    # As numpy writes doubles.
    path.write_text("".join(
        f"{1606417097.528 + n:.18e} {n} 2 0.5 0 0 0 1\n"
        for n in range(1, 51)))
    before = list_poses(stub, copied)
    refused = revisit("revise", copied, path)
    assert refused.returncode == 1
    assert "has 50 of the 100 poses" in refused.stderr
    assert "--partial" in refused.stderr
    assert list_poses(stub, copied) == before
    done = revisit("revise", copied, path, "--partial", "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["revisedCount"] == 50
    after = list_poses(stub, copied)
    assert after[50:] == before[50:]
    for n, each in enumerate(after[:50], 1):
        assert (each.local.x_meters, each.local.y_meters) == (n, 2.0)
        assert each.covariance == before[n - 1].covariance


@pytest.mark.parametrize("words, text, said", [
    ("g2o", "VERTEX_SE2 1 0 0 0\nVERTEX_SE2 101 0 0 0\n",
     r":2: \S+ has no pose of sequence 101"),
    ("g2o", "VERTEX_SE2 1 0 0 0\nVERTEX_SE2 1 0 0 0\n",
     ":2: line 1 is about sequence 1 too"),
    ("tum", "1606417098.528 0 0 0 0 0 0 1\n1606417098.6 0 0 0 0 0 0 1\n",
     r":2: \S+ has no pose of the stamp 1606417098.59999\S* s"),
    ("tum", "1606417098.528 0 0 0 0 0 0 1\n1606417098.528 1 0 0 0 0 0 1\n",
     ":2: line 1 has this stamp too"),
    ("csv", "sequence,est_x,est_y,est_yaw\n0,1,2,3\n",
     ":2: expected the sequence of a pose"),
])
def test_line_that_belongs_to_no_pose_is_refused_whole(
        words, text, said, stub, copied, revisit, tmp_path):
    path = tmp_path / "poses"
    path.write_text(text)
    before = get(stub, copied)
    result = revisit("revise", copied, path, "--format", words, "--partial")
    assert result.returncode == 1
    assert re.search(said, result.stderr), result.stderr
    assert get(stub, copied) == before


def test_revision_that_the_optimiser_did_not_start_from_is_refused(
        stub, copied, revisit, tmp_path):
    path = tmp_path / "poses.g2o"
    path.write_text("VERTEX_SE2 1 0 0 0\n")
    revision = get(stub, copied).revision
    result = revisit("revise", copied, path, "--format", "g2o", "--partial",
                     "--expected-revision", revision + 7)
    assert result.returncode == 64 + grpc.StatusCode.ABORTED.value[0]
    assert "REVISION_MISMATCH" in result.stderr
    assert get(stub, copied).revision == revision


def test_optimised_covariances_come_back_by_csv(
        stub, copied, output_of, tmp_path):
    path = tmp_path / "poses.csv"
    path.write_text("sequence,est_x,est_y,est_yaw,pxx,pxy,pxt,pyy,pyt,ptt\n"
                    "7,1.5,2.5,0.25,4,0,0,9,0,0.5\n")
    output_of("revise", copied, path, "--format", "csv", "--partial")
    (seventh,) = list_poses(stub, copied)[6:7]
    assert list(seventh.covariance.values) == [4, 0, 0, 9, 0, 0.5]
    assert seventh.heading_radians == 0.25


def test_geodetic_poses_come_back_in_the_local_frame(
        stub, geodetic, output_of, tmp_path):
    path = tmp_path / "poses.g2o"
    exported = output_of("export", geodetic, "--format", "g2o")
    path.write_text(exported)
    output_of("revise", geodetic, path, "--format", "g2o")
    revised = list_poses(stub, geodetic)
    assert len(revised) == 1131
    assert all(each.HasField("local") for each in revised)
    again = output_of("export", geodetic, "--format", "g2o")
    for old, new in zip(exported.splitlines(), again.splitlines()):
        if old.startswith("VERTEX"):
            assert [float(word) for word in new.split()[1:]] == pytest.approx(
                [float(word) for word in old.split()[1:]], abs=1e-9)
