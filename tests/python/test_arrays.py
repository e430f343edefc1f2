"""Poses go from arrays to the server and back without the loss of a bit, and arrays
that do not fit are refused before anything is sent."""

import datetime

import matplotlib
import numpy as np
import pandas
import pytest

import revisit
from conftest import as_bytes, straight
from drive_client import Drive
from revisit import Poses, v1

COLUMNS = ("sequence", "stamp", "position", "is_geodetic", "heading", "quaternion",
           "covariance", "covariance_form", "error_transition")


def identical(one, other):
    return [name for name in COLUMNS
            if getattr(one, name).tobytes() != getattr(other, name).tobytes()] == []


def random_matrices(rng, count, order):
    roots = rng.normal(size=(count, order, order))
    made = roots @ roots.transpose(0, 2, 1) + np.eye(order)
    return (made + made.transpose(0, 2, 1)) / 2


def test_arrays_come_back_to_the_bit(client, new_vehicle):
    rng = np.random.default_rng(20101018)
    count = 2000
    matrices = random_matrices(rng, count, 3)
    stamps = (rng.integers(0, 2**62, count)).astype("datetime64[ns]")
    stamps[::7] = np.datetime64("NaT")
    x = rng.normal(size=count) * 1e3
    x[:3] = -0.0, 5e-324, 1e8
    poses = Poses.local(x, rng.normal(size=count), rng.normal(size=count) * 9,
                        matrices, z=rng.normal(size=count), stamps=stamps,
                        sequence=np.arange(1, count + 1))
    vehicle = new_vehicle()
    with client.stream_poses(vehicle) as stream:
        stream.append(poses)
    back = client.poses(vehicle)
    assert identical(back, poses)
    upper = matrices[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    assert back.covariance.tobytes() == upper.tobytes()


def test_every_kind_of_pose_comes_back(client, new_vehicle):
    """Orientations and forms of covariance in any mixture."""
    messages = Drive(7)[0:300]
    vehicle = new_vehicle()
    with client.stream_poses(vehicle) as stream:
        stream.append(Poses.from_messages(messages))
    assert as_bytes(client.list_poses(vehicle)) == as_bytes(messages)
    assert as_bytes(client.poses(vehicle).to_messages()) == as_bytes(messages)


def test_geodetic_poses_with_transitions_come_back(client, new_vehicle):
    rng = np.random.default_rng(1)
    count = 50
    transitions = np.tile(np.eye(3).ravel(), (count, 1))
    transitions[0] = np.nan
    poses = Poses.geodetic(
        43.7 + np.arange(count) * 1e-5, np.full(count, -79.4), rng.normal(size=count),
        random_matrices(rng, count, 4), height=rng.normal(size=count),
        sequence=np.arange(1, count + 1), error_transition=transitions)
    vehicle = new_vehicle(
        coordinate_frame=v1.COORDINATE_FRAME_GEODETIC,
        correlation_model=v1.CORRELATION_MODEL_FILTER)
    with client.stream_poses(vehicle) as stream:
        stream.append(poses)
    assert identical(client.poses(vehicle), poses)


@pytest.mark.parametrize("shape, form", [
    ((6,), v1.COVARIANCE_FORM_PLANAR_6), ((10,), v1.COVARIANCE_FORM_SPATIAL_10),
    ((36,), v1.COVARIANCE_FORM_ROS_36), ((3, 3), v1.COVARIANCE_FORM_PLANAR_6),
    ((4, 4), v1.COVARIANCE_FORM_SPATIAL_10), ((6, 6), v1.COVARIANCE_FORM_ROS_36)])
def test_covariances_are_taken_in_every_form(shape, form):
    numbers = np.ones((5, *shape))
    poses = Poses.local(*np.zeros((3, 5)), numbers)
    [first, *_] = poses.to_messages()
    assert first.covariance.form == form
    assert set(first.covariance.values) == {1.0}


def test_a_matrix_is_sent_by_the_upper_triangle():
    matrix = np.array([[[1.0, 2, 3], [2, 4, 5], [3, 5, 6]]])
    assert Poses.local([0], [0], [0], matrix).covariance.tolist() == [
        [1, 2, 3, 4, 5, 6]]


def good(**changed):
    fields = {"x": np.zeros(4), "y": np.zeros(4), "heading": np.zeros(4),
              "covariance": np.ones((4, 6))}
    return Poses.local(**{**fields, **changed})


@pytest.mark.parametrize("wrong, message", [
    ({"y": np.zeros(3)}, r"y has the shape \(3,\): expected \(4,\)"),
    ({"x": np.zeros((4, 1))}, r"x has the shape \(4, 1\)"),
    ({"covariance": np.ones((4, 9))}, r"covariance has the shape \(4, 9\)"),
    ({"covariance": np.ones((3, 6))}, r"covariance has the shape \(3, 6\)"),
    ({"covariance": np.ones((6,))}, r"covariance has the shape \(6,\)"),
    ({"covariance": np.arange(36.0).reshape(4, 3, 3)}, r"covariance\[0\] is not sym"),
    ({"quaternion": np.zeros((4, 4))}, "either a heading or a quaternion"),
    ({"heading": None}, "either a heading or a quaternion"),
    ({"heading": None, "quaternion": np.zeros((4, 3))}, "quaternion has the shape"),
    ({"stamps": [1, 2, 3, 4]}, "int64: give datetime64, datetimes with a time zone"),
    ({"stamps": np.zeros(3)}, r"stamps have the shape \(3,\)"),
    ({"stamps": [1e300] * 4}, "seconds since 1970"),
    ({"stamps": np.array(["3000"] * 4, "datetime64[Y]")}, "outside of the years"),
    ({"sequence": [0, 1, 2, 3]}, "0 to 3"),
    ({"sequence": [1.0, 2.0, 3.0, 4.0]}, "float64"),
    ({"error_transition": np.zeros((4, 4))}, "error_transition has the shape")])
def test_arrays_that_do_not_fit_are_refused(wrong, message):
    with pytest.raises((ValueError, TypeError), match=message):
        good(**wrong)


def test_stamps_are_seconds_or_dates():
    seconds = good(stamps=[0.0, 1.5, -0.25, float("nan")]).stamp
    assert seconds.astype(np.int64)[:3].tolist() == [0, 1_500_000_000, -250_000_000]
    assert np.isnat(seconds[3])
    dates = good(stamps=np.array(["2021-08-05T13:34", "NaT", "1970-01-01",
                                  "1969-12-31T23:59:59"], "datetime64[s]"))
    messages = list(dates.to_messages())
    assert messages[0].stamp.ToJsonString() == "2021-08-05T13:34:00Z"
    assert not messages[1].HasField("stamp")
    assert messages[2].HasField("stamp")
    assert (messages[3].stamp.seconds, messages[3].stamp.nanos) == (-1, 0)
    assert np.isnat(good().stamp).all()


def test_no_poses_are_no_poses():
    empty = Poses.from_messages([])
    assert len(empty) == 0 and list(empty.to_messages()) == []
    assert len(Poses.local([], [], [], np.zeros((0, 6)))) == 0


def test_pandas_get_a_column_per_number(client, new_vehicle, boreas):
    poses, columns = boreas
    frame = poses.to_pandas()
    assert frame.index.name == "sequence" and frame.index[0] == 1
    assert frame["x"].tolist() == columns["est_x"].tolist()
    assert frame["covariance_xh"].tolist() == columns["pxt"].tolist()
    assert frame["covariance_hh"].tolist() == columns["ptt"].tolist()
    vehicle = new_vehicle()
    with client.stream_poses(vehicle, revisit.StreamOptions(
            send_candidates=True)) as stream:
        stream.append(poses)
        stream.finish()
        answers = stream.take_candidates()
    graph = client.export_pose_graph(vehicle)
    nodes = graph.nodes.to_pandas()
    assert len(nodes) == graph.vehicle.node_count
    assert nodes["travelled"].is_monotonic_increasing
    assert str(nodes["stamp"].dtype) == "datetime64[ns, UTC]"
    assert str(frame["stamp"].dtype) == "datetime64[ns, UTC]"
    assert {"covariance_xx", "covariance_yh"} <= set(nodes.columns)
    assert (graph.edges.to_pandas()["kind"] == "CONSECUTIVE").all()
    found = revisit.candidate_table(answers).to_pandas()
    checks = revisit.check_table(answers).to_pandas()
    assert checks["candidates"].sum() == len(found)
    assert (checks.loc[checks["candidates"] == 0, "empty_reason"] != "").all()
    for number, row in checks[checks["candidates"] > 0].iterrows():
        estimate = answers[number].scale_estimate
        assert (row["scale_low"], row["scale_estimate"], row["scale_high"]) \
            == (estimate.low, estimate.scale, estimate.high)
    # A table says the same as the messages.
    for _, row in found[found["rank"] == 1].iterrows():
        one = answers[row["check"]].candidates[0]
        assert row["probability"] == one.probability
        assert row["meters_after"] == one.place_interval.meters_after
        assert row["verdict"] == v1.Verdict.Name(one.verdict)[len("VERDICT_"):]
        assert row["matched_sequence"] == one.matched.sequence
        assert row["difference_covariance_xy"] == one.difference.covariance.values[1]
        assert row["path_gate_p_value"] == one.path_gate.p_value


def test_tables_of_nothing_have_their_columns():
    full = {"check", "verdict", "probability", "query_x", "difference_covariance"}
    table = revisit.candidate_table([])
    assert len(table) == 0 and full <= set(table)
    assert len(revisit.check_table([])) == len(revisit.node_table([])) == 0
    assert revisit.edge_table([]).to_pandas().empty


def test_answers_without_probability_are_tables_too(client, new_vehicle, boreas):
    vehicle = new_vehicle(alignment=v1.ALIGNMENT_COMPOSITE)
    with client.stream_poses(vehicle) as stream:
        stream.append(boreas[0])
    table = revisit.candidate_table([client.find_candidates(vehicle)])
    assert len(table) > 0
    assert np.isnan(table["probability"]).all()
    assert np.isnan(table["meters_before"]).all()
    assert set(table["path_gate_verdict"]) == {"UNSPECIFIED"}
    best = table.where(table["rank"] == 1)
    assert len(best) == 1 and best["score"][0] == table["score"].max()


def test_rows_are_chosen_as_in_numpy():
    poses = straight(10)
    assert poses[3:5].sequence.tolist() == [4, 5]
    assert poses[[0, 9]].sequence.tolist() == [1, 10]
    assert poses[poses.position[:, 0] > 8].sequence.tolist() == [9, 10]
    assert poses.numbered(101).sequence.tolist() == list(range(101, 111))


def stamped(stamps):
    count = len(stamps)
    return Poses.local(*np.zeros((3, count)), np.ones((count, 6)), stamps=stamps)


def test_datetimes_with_a_time_zone_are_taken_and_answered():
    east = datetime.timezone(datetime.timedelta(hours=2))
    moment = datetime.datetime(2026, 7, 1, 12, 0, 0, 123_456, tzinfo=east)
    before_1970 = datetime.datetime(1969, 12, 31, 23, 59, 59, 999_999,
                                    tzinfo=datetime.timezone.utc)
    poses = stamped([moment, None, before_1970])
    assert poses.stamp[0] == np.datetime64("2026-07-01T10:00:00.123456")
    assert poses.times() == [moment, None, before_1970]
    assert poses.times()[0].tzinfo is datetime.timezone.utc
    assert [one.stamp.seconds for one in poses.to_messages()] == [
        1_782_900_000, 0, -1]


def test_times_of_pandas_keep_their_nanoseconds():
    moments = pandas.to_datetime(["2026-07-01T12:00:00.123456789+02:00", None])
    for given in (moments, pandas.Series(moments)):
        poses = stamped(given)
        assert poses.stamp[0] == np.datetime64("2026-07-01T10:00:00.123456789")
        assert np.isnat(poses.stamp[1])
    assert poses.to_pandas()["stamp"].tolist()[0] == moments[0]


def test_a_datetime_without_a_time_zone_is_refused_with_what_to_write():
    naive = datetime.datetime(2026, 7, 1, 12)
    with pytest.raises(ValueError, match=r"no time zone: .*timezone.utc\) says"):
        stamped([naive.replace(tzinfo=datetime.timezone.utc), naive])
    with pytest.raises(TypeError, match="is no datetime"):
        stamped([naive.replace(tzinfo=datetime.timezone.utc), "now"])


def test_a_table_is_as_long_as_it_has_rows(client, new_vehicle):
    vehicle = new_vehicle()
    client.append_poses(vehicle, straight(60))
    table = client.export_pose_graph(vehicle).nodes
    assert len(table) == client.get_vehicle(vehicle).node_count == len(table["x"])
    assert list(table) == list(dict(table)) and "x" in table and "q" not in table


def test_tables_and_poses_show_themselves_in_a_notebook():
    poses = straight(30)
    poses.stamp[0] = np.datetime64("2026-07-01T10:00:00.5")
    page = poses._repr_html_()
    assert page.count("<tr>") == 1 + 5 + 1 + 5 and "30 poses" in page
    assert "2026-07-01T10:00:00.500Z" in page
    table = revisit.Table({"name": np.array(["<b>"]), "numbers": np.ones((1, 2))})
    page = table._repr_html_()
    assert "<td>&lt;b&gt;</td><td>1 1</td>" in page


def test_a_pose_graph_is_plotted_without_roads_over_jumps(client, new_vehicle):
    matplotlib.use("agg")
    vehicle = new_vehicle()
    poses = straight(60)
    poses.position[30:, 1] += 500.0
    client.append_poses(vehicle, poses)
    client.add_loop_closure(vehicle, 59, 31)
    graph = client.export_pose_graph(vehicle)
    lines = graph.plot().get_lines()
    assert np.isnan(lines[0].get_xdata()).sum() == 1
    assert len(lines) == 2 and len(lines[1].get_xdata()) == 2


def rotation(quaternion):
    x, y, z, w = quaternion
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]])


@pytest.mark.parametrize("axes, yaw, columns", [
    # Where forward, left and up lie in the axes of the body that was recorded.
    ("flu", 0.0, [(1, 0, 0), (0, 1, 0), (0, 0, 1)]),
    ("camera", 0.0, [(0, 0, 1), (-1, 0, 0), (0, -1, 0)]),
    ("frd", 0.0, [(1, 0, 0), (0, -1, 0), (0, 0, -1)]),
    ("flu", np.pi / 2, [(0, 1, 0), (-1, 0, 0), (0, 0, 1)]),
    ("camera", np.pi / 2, [(-1, 0, 0), (0, 0, -1), (0, -1, 0)])])
def test_a_body_of_other_axes_is_turned(axes, yaw, columns):
    rng = np.random.default_rng(3)
    quaternions = rng.normal(size=(20, 4))
    quaternions /= np.linalg.norm(quaternions, axis=1)[:, np.newaxis]
    poses = Poses.local(*np.zeros((2, 20)), None, np.ones((20, 6)),
                        quaternion=quaternions)
    turned = poses.with_body(axes, yaw=yaw)
    for before, after in zip(quaternions, turned.quaternion):
        assert np.allclose(rotation(after), rotation(before) @ np.transpose(columns))


def test_headings_are_turned_by_a_yaw_and_by_nothing_else(client, new_vehicle):
    poses = straight(200)
    poses.heading[:] = -np.pi / 2
    mended = poses.with_body(yaw=np.pi / 2)
    assert mended.heading.tolist() == [0.0] * 200
    with pytest.raises(ValueError, match="200 poses have only a heading"):
        poses.with_body("camera")
    with pytest.raises(ValueError, match="expected one of flu, camera, frd"):
        poses.with_body("ned")
    with client.stream_poses(new_vehicle()) as stream:
        stream.append(poses)
        stream.finish()
        [warning] = stream.warnings
    assert warning.reason == v1.WARNING_REASON_HEADING_OFF_COURSE
    with client.stream_poses(new_vehicle()) as stream:
        stream.append(mended)
        stream.finish()
        assert stream.warnings == []


def test_starts_of_recordings_come_back_and_go_with_their_rows():
    poses = straight(6)
    assert list(poses.recording_start) == [None] * 6
    begun = poses[3:].as_recording("datum:10m,1deg,map", label="tuesday")
    # What was there stays as it was.
    assert poses.recording_start[3] is None
    messages = [*poses[:3].to_messages(), *begun.to_messages()]
    assert [message.HasField("recording_start") for message in messages] == [
        False, False, False, True, False, False]
    start = messages[3].recording_start
    assert (start.label, start.datum.datum_id) == ("tuesday", "map")
    back = Poses.from_messages(messages)
    assert as_bytes(back.to_messages()) == as_bytes(messages)
    assert back[3:4].recording_start[0] == start
    assert back[4:].recording_start.tolist() == [None, None]
    whole = v1.RecordingStart(unknown=True)
    assert poses.as_recording(whole).recording_start[0] is whole
    with pytest.raises(ValueError, match="no pose"):
        poses[:0].as_recording()


def test_starts_of_recordings_are_said_in_the_words_of_the_command_line():
    plain = revisit.recording_start("after", label="a")
    assert plain == v1.RecordingStart(label="a")
    after = revisit.recording_start("after:5m,17.5deg").after
    assert after.form == v1.COVARIANCE_FORM_SPATIAL_10
    assert after.values[0] == after.values[4] == after.values[7] == 25.0
    assert after.values[9] == pytest.approx(np.radians(17.5) ** 2)
    datum = revisit.recording_start("datum:1e1m,1deg,a, b",
                                    datum_pose=(1.0, -2.0, 0.5)).datum
    assert datum.datum_id == "a, b"
    assert datum.pose == v1.StatePose(x_meters=1.0, y_meters=-2.0, heading_radians=0.5)
    assert not revisit.recording_start("datum:1m,1deg").datum.HasField("pose")
    assert revisit.recording_start("unknown").unknown
    for wrong in ("", "same", "after:5,17", "after:5m", "after:5m,17deg,map", "datum",
                  "datum:10m,1", "datum:10m,1deg,", "datum:-1m,1deg", "datum:0m,1deg",
                  "unknown:1m,1deg", "after:5m,17deg "):
        with pytest.raises(ValueError, match="relation is"):
            revisit.recording_start(wrong)
    with pytest.raises(ValueError, match="datum_pose"):
        revisit.recording_start("after", datum_pose=(0.0, 0.0, 0.0))
