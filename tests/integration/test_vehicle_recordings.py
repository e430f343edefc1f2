"""Recordings of one vehicle, each in a frame of its own: what is stored of them, told
and refused."""

import math
import sqlite3

import grpc
import numpy
import pytest
from google.protobuf import field_mask_pb2, timestamp_pb2

from caller_poses import (
    FILTER, GEODETIC, IDENTITY_9, INF, INVALID, NAN, geodetic, pose_with)
from own_postgres import own_postgres
from revisit_server import Server, run
from stubs import api
from test_retention import settled
from wire import (
    LOOP_CLOSURES, PoseStream, append, as_bytes, batches, failure_of, get, list_poses,
    pose, straight)

ADMIN = ("--admin-listen", "127.0.0.1:0")
PLANAR_6 = api.COVARIANCE_FORM_PLANAR_6
MOST = 1000


def covariance(meters=5.0, radians=0.2):
    variance, turn = meters**2, radians**2
    return api.Covariance(form=PLANAR_6,
                          values=[variance, 0, 0, variance, 0, turn])


def ros_36(meters=5.0, radians=0.2):
    values = [0.0] * 36
    for i in range(6):
        values[7 * i] = meters**2 if i < 3 else radians**2
    return api.Covariance(form=api.COVARIANCE_FORM_ROS_36, values=values)


AFTER = api.RecordingStart(label="tuesday.csv", after=covariance())
UNKNOWN = api.RecordingStart(unknown=True)
DATUM = api.RecordingStart(label="wednesday.csv", datum=api.Datum(
    datum_id="site", pose=api.StatePose(x_meters=10.0, y_meters=-20.0,
                                        heading_radians=0.5),
    covariance=covariance(10.0, 0.02)))
# All that can be sent of a start, and comes back as it came.
STARTS = {
    "nothing": api.RecordingStart(),
    "label": api.RecordingStart(label="Größe \u4e2d"),
    "after": AFTER,
    "after with 36 numbers": api.RecordingStart(after=ros_36()),
    "datum": DATUM,
    "datum without a name or a pose": api.RecordingStart(
        datum=api.Datum(covariance=covariance())),
    "datum with an empty pose": api.RecordingStart(datum=api.Datum(
        pose=api.StatePose(), covariance=api.Covariance(
            form=api.COVARIANCE_FORM_SPATIAL_10,
            values=[1, 0, 0, 0, 1, 0, 0, 1, 0, 0.01]))),
    "unknown": UNKNOWN,
}


def beginning(poses, start):
    """The poses, of which the first begins a recording."""
    poses[0].recording_start.CopyFrom(start)
    return poses


def course(first, meters, every=2.0, turned=0.0):
    """Dead reckoning along a road with bends that do not repeat, in the frame of one
    recording, whose axes are turned. Its claims begin small."""
    poses, x, y = [], 0.0, 0.0
    claims = numpy.diag([0.01, 0.01, 1e-5])
    for i in range(int(meters / every)):
        s = i * every
        heading = turned + 0.9 * math.sin(s / 70.0) + 0.6 * math.sin(s / 31.0 + 1.0)
        poses.append(pose(
            first + i, x, y, math.remainder(heading, math.tau),
            list(claims[numpy.triu_indices(3)]),
            stamp=timestamp_pb2.Timestamp(seconds=first + i)))
        step = every * math.cos(heading), every * math.sin(heading)
        lever = numpy.array([[1, 0, -step[1]], [0, 1, step[0]], [0, 0, 1]])
        claims = lever @ claims @ lever.T + every * numpy.diag([0.01, 0.0025, 3e-6])
        x, y = x + step[0], y + step[1]
    return poses


def create(stub, name, **settings):
    return stub.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id=name, vehicle=api.Vehicle(
            settings=api.VehicleSettings(**settings)))).vehicle.name


def send(stub, vehicle, poses, size=100):
    return [append(stub, vehicle, batch) for batch in batches(poses, size)]


def recordings(stub, vehicle, **fields):
    """All of a vehicle, page by page."""
    found = []
    request = api.ListRecordingsRequest(parent=vehicle, **fields)
    while True:
        page = stub.ListRecordings(request)
        found.extend(page.recordings)
        if not page.next_page_token:
            return found
        request.page_token = page.next_page_token


def ranges(stub, vehicle):
    return [(r.first_sequence, r.last_sequence) for r in recordings(stub, vehicle)]


def find(stub, vehicle, **fields):
    return stub.FindCandidates(api.FindCandidatesRequest(
        vehicle=vehicle, **fields)).candidates


def without_time(candidates):
    candidates.ClearField("search_duration")
    return candidates.SerializeToString(deterministic=True)


def export(stub, vehicle, **fields):
    nodes, edges = [], []
    for part in stub.ExportPoseGraph(
            api.ExportPoseGraphRequest(vehicle=vehicle, **fields)):
        nodes.extend(part.nodes)
        edges.extend(part.edges)
    return nodes, edges


# ---- In both stores


class FileStore:
    """A store in a file."""

    def __init__(self, directory):
        self.name = directory

    def serve(self, *flags):
        return Server(self.name, *flags)

    def verify(self):
        return run("revisitd", "verify", "--store", self.name)


class SharedStore:
    """A store in a database of PostgreSQL."""

    def __init__(self, database, directory):
        self.name = database.url("revisit_owner")
        self._url = database.url("revisit")
        self._log = directory / "shared.log"
        assert run("revisitd", "migrate", "--store", self.name).returncode == 0

    def serve(self, *flags, host="host-a:1"):
        return Server(self._url, "--advertise-address", host, *flags,
                      log_path=self._log)

    def verify(self):
        return run("revisitd", "verify", "--store", self.name)


@pytest.fixture(params=["file", "shared"])
def store(request, tmp_path):
    if request.param == "file":
        yield FileStore(tmp_path / "store")
        return
    with own_postgres() as database:
        if database is None:
            pytest.skip("there is no PostgreSQL: tests/run installs it")
        yield SharedStore(database, tmp_path)


def told(stub, vehicle):
    """All that a vehicle's recordings change, to the byte."""
    nodes, edges = export(stub, vehicle)
    sent = list_poses(stub, vehicle, view=api.POSE_VIEW_AS_SENT)
    summary = get(stub, vehicle)
    return [
        as_bytes(list_poses(stub, vehicle)), as_bytes(sent),
        as_bytes(recordings(stub, vehicle)), as_bytes(nodes), as_bytes(edges),
        without_time(find(stub, vehicle)),
        without_time(find(stub, vehicle, sequence=1000)),
        summary.SerializeToString(deterministic=True)]


def test_recordings_are_the_same_after_a_restart_and_a_copy(store, tmp_path):
    near = api.RecordingStart(datum=api.Datum(covariance=covariance(5.0, 0.05)))
    poses = [*beginning(course(1, 1000.0), near),
             *beginning(course(501, 1000.0, turned=0.02), near),
             *beginning(course(1001, 100.0), AFTER)]
    with store.serve() as server:
        stub = server.stub()
        vehicle = create(stub, "three", max_step_meters=20.0)
        acks = send(stub, vehicle, poses)
        # A start is no jump, and no finding.
        assert not [jump for ack in acks for jump in ack.jumps]
        assert not [w for ack in acks for w in ack.warnings]
        assert not get(stub, vehicle).findings
        assert as_bytes(list_poses(stub, vehicle)) == as_bytes(poses)
        assert ranges(stub, vehicle) == [(1, 500), (501, 1000), (1001, 1050)]
        # The vehicle is found in its past, which is in another frame.
        best = find(stub, vehicle, sequence=1000).candidates[0]
        assert best.verdict == api.VERDICT_ACCEPTED
        assert abs(best.matched.sequence - 500) < 10
        assert best.recording_of_match == f"{vehicle}/recordings/1"
        assert best.frame_state == api.FRAME_STATE_DATUM
        assert best.HasField("difference") and best.HasField("gate")
        before = told(stub, vehicle)
    # From the poses, and from the snapshot that the server left.
    for flags in (["--snapshot-poses", "0"], []):
        with store.serve(*flags) as server:
            assert told(server.stub(), vehicle) == before
    verified = store.verify()
    assert verified.stdout.endswith("sound\n"), verified.stdout
    copy = tmp_path / "copy"
    copied = run("revisitd", "import", "--store", copy, "--from", store.name)
    assert copied.returncode == 0, copied.stderr
    with Server(copy) as server:
        assert told(server.stub(), vehicle) == before


def test_recordings_are_handed_over_to_another_server(tmp_path):
    with own_postgres() as database:
        if database is None:
            pytest.skip("there is no PostgreSQL: tests/run installs it")
        store = SharedStore(database, tmp_path)
        with store.serve() as one, store.serve(host="host-b:1") as other:
            vehicle = create(one.stub(), "moved")
            send(one.stub(), vehicle, course(1, 600.0) + beginning(
                course(301, 600.0), UNKNOWN))
            before = as_bytes(recordings(one.stub(), vehicle))
            one.close()
            after = as_bytes(recordings(other.stub(), vehicle))
            assert after == before
            send(other.stub(), vehicle, beginning(course(601, 100.0), DATUM))
            assert ranges(other.stub(), vehicle) == [
                (1, 300), (301, 600), (601, 650)]


# ---- What is sent


@pytest.mark.parametrize("kind", STARTS)
def test_start_comes_back_as_it_was_sent(kind, stub, new_vehicle):
    vehicle = new_vehicle()
    poses = beginning(straight(3), STARTS[kind]) + beginning(
        straight(3, first=4), STARTS[kind])
    append(stub, vehicle, poses)
    assert as_bytes(list_poses(stub, vehicle)) == as_bytes(poses)
    mask = field_mask_pb2.FieldMask(paths=["recording_start.label"])
    assert list_poses(stub, vehicle, read_mask=mask)[3] == api.Pose(
        recording_start=api.RecordingStart(label=STARTS[kind].label))
    assert ranges(stub, vehicle) == [(1, 3), (4, 6)]
    # What is told of it has the form of the vehicle's state.
    start = recordings(stub, vehicle)[1].start
    assert start.label == STARTS[kind].label
    assert start.WhichOneof("relation") == (
        STARTS[kind].WhichOneof("relation") or "after")
    if start.HasField("after"):
        assert start.after.form == PLANAR_6
        if not STARTS[kind].HasField("after"):
            assert list(start.after.values) == [100, 0, 0, 100, 0, 0.3 * 0.3]
    if start.HasField("datum"):
        assert start.datum.covariance.form == PLANAR_6
        assert start.datum.HasField("pose")


def test_pose_that_comes_again_is_compared_with_its_start(stub, new_vehicle):
    vehicle = new_vehicle()
    append(stub, vehicle, straight(3))
    append(stub, vehicle, beginning(straight(3, first=4), AFTER))
    again = append(stub, vehicle, beginning(straight(3, first=4), AFTER))
    assert again.durable_sequence == 6
    before = get(stub, vehicle)
    for start in (None, UNKNOWN, api.RecordingStart(label="x", after=covariance()),
                  api.RecordingStart(label="tuesday.csv", after=ros_36())):
        poses = straight(3, first=4)
        if start is not None:
            beginning(poses, start)
        failure = failure_of(lambda: append(stub, vehicle, poses))
        assert failure.code == grpc.StatusCode.ALREADY_EXISTS
        assert failure.reason == "SEQUENCE_CONTENT_MISMATCH"
        assert failure.metadata["sequence"] == "4"
    assert failure_of(lambda: append(stub, vehicle, beginning(
        straight(1, first=2), AFTER))).metadata["sequence"] == "2"
    assert get(stub, vehicle) == before


def datum(**fields):
    return {"datum": api.Datum(**{"covariance": covariance(), **fields})}


INDEFINITE = api.Covariance(form=PLANAR_6, values=[1, 2, 0, 1, 0, 0.1])
BAD_STARTS = {
    "label too long": ({"label": "x" * 257}, "label", "INVALID_FIELD"),
    "label of two lines": ({"label": "a\nb"}, "label", "INVALID_FIELD"),
    "unknown that is false": ({"unknown": False}, "unknown", "INVALID_FIELD"),
    "after without a form": ({"after": api.Covariance()}, "after.form",
                             "INVALID_FIELD"),
    "after of two numbers": (
        {"after": api.Covariance(form=PLANAR_6, values=[1, 2])}, "after.values",
        "COVARIANCE_SIZE"),
    "after that is not finite": (
        {"after": api.Covariance(form=PLANAR_6, values=[1, 0, 0, INF, 0, 1])},
        "after.values[3]", "NOT_FINITE"),
    "after that is indefinite": ({"after": INDEFINITE}, "after.values",
                                 "COVARIANCE_NOT_POSITIVE_DEFINITE"),
    "datum without a covariance": ({"datum": api.Datum()}, "datum.covariance",
                                   "INVALID_FIELD"),
    "datum that is indefinite": (
        datum(covariance=INDEFINITE), "datum.covariance.values",
        "COVARIANCE_NOT_POSITIVE_DEFINITE"),
    "datum in the form of ROS": (datum(covariance=ros_36()),
                                 "datum.covariance.form", "INVALID_FIELD"),
    "datum with a long name": (datum(datum_id="d" * 129), "datum.datum_id",
                               "INVALID_FIELD"),
    "datum with a hidden name": (datum(datum_id="a\u200bb"), "datum.datum_id",
                                 "INVALID_FIELD"),
    "datum beyond range": (datum(pose=api.StatePose(x_meters=1.001e8)),
                           "datum.pose.x_meters", "INVALID_FIELD"),
    "datum that is NaN": (datum(pose=api.StatePose(heading_radians=NAN)),
                          "datum.pose.heading_radians", "NOT_FINITE"),
}


@pytest.mark.parametrize("kind", BAD_STARTS)
def test_start_that_is_wrong_is_refused_by_its_field(
        kind, stub, new_vehicle, unchanged):
    fields, field, reason = BAD_STARTS[kind]
    vehicle = new_vehicle()
    append(stub, vehicle, straight(3))
    unchanged(vehicle)
    poses = straight(2, first=4)
    poses[1].recording_start.CopyFrom(api.RecordingStart(**fields))
    failure = failure_of(lambda: append(stub, vehicle, poses))
    assert (failure.code, failure.reason) == (INVALID, reason)
    assert failure.fields == [f"poses[1].recording_start.{field}"]
    with PoseStream(stub, vehicle) as stream:
        stream.receive_kind("opened")
        stream.send(poses)
        failure = failure_of(stream.receive_all)
    assert (failure.code, failure.reason) == (INVALID, reason)
    assert failure.fields == [f"batch.poses[1].recording_start.{field}"]


def test_geodetic_vehicles_have_one_frame(stub, new_vehicle, unchanged):
    vehicle = unchanged(new_vehicle(**GEODETIC))
    for start in (api.RecordingStart(), DATUM):
        failure = failure_of(lambda: append(stub, vehicle, [pose_with(
            1, geodetic=geodetic(), recording_start=start)]))
        assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
        assert failure.fields == ["poses[0].recording_start"]
        assert "GEODETIC" in failure.message
    assert not recordings(stub, vehicle)


def each_begins(count, first=1):
    return [beginning([p], UNKNOWN)[0] for p in straight(count, first=first)]


def test_vehicle_has_a_thousand_recordings_at_most(tmp_path):
    with Server(tmp_path / "store") as server:
        stub = server.stub()
        vehicle = create(stub, "many")
        send(stub, vehicle, each_begins(MOST - 1))
        before = get(stub, vehicle)

        def assert_limited(call):
            failure = failure_of(call)
            assert failure.code == grpc.StatusCode.FAILED_PRECONDITION
            assert failure.reason == "RECORDING_LIMIT"
            assert failure.metadata["limit"] == "1000"

        # One of two fits, and none is stored.
        assert_limited(lambda: append(stub, vehicle, [
            *straight(1, first=MOST), *each_begins(2, first=MOST + 1)]))
        with PoseStream(stub, vehicle) as stream:
            stream.receive_kind("opened")
            stream.send(each_begins(1, first=MOST))
            stream.send(each_begins(1, first=MOST + 1))
            assert stream.receive_kind("ack").durable_sequence == MOST
            assert_limited(stream.receive_all)
        assert get(stub, vehicle).durable_sequence == MOST
        assert get(stub, vehicle).revision == before.revision + 1
        # Poses without a start go on.
        append(stub, vehicle, straight(5, first=MOST + 1))
        assert len(recordings(stub, vehicle)) == MOST
    with Server(tmp_path / "store") as server:
        stub = server.stub()
        assert_limited(lambda: append(
            stub, vehicle, each_begins(1, first=MOST + 6)))
        # In one frame there is room again.
        stub.RevisePoses(iter([api.RevisePosesRequest(
            vehicle=vehicle, common_frame=True, poses=straight(MOST + 5))]))
        append(stub, vehicle, each_begins(1, first=MOST + 6))
        assert ranges(stub, vehicle) == [(1, MOST + 5), (MOST + 6, MOST + 6)]


# ---- What is listed


def test_recordings_are_listed_in_pages(stub, new_vehicle):
    vehicle = new_vehicle()
    assert not recordings(stub, vehicle)
    append(stub, vehicle, straight(4))
    (only,) = recordings(stub, vehicle)
    assert only == api.Recording(
        name=f"{vehicle}/recordings/1", first_sequence=1, last_sequence=4,
        frame_state=api.FRAME_STATE_SAME, frame_pose=api.StatePose())
    append(stub, vehicle, beginning(straight(3, first=5), AFTER))
    append(stub, vehicle, beginning(straight(3, first=8), UNKNOWN))
    append(stub, vehicle, beginning(straight(3, first=11), AFTER))
    whole = recordings(stub, vehicle)
    assert [(r.name, r.label, r.last_sequence, r.frame_state) for r in whole] == [
        (f"{vehicle}/recordings/1", "", 4, api.FRAME_STATE_NONE),
        (f"{vehicle}/recordings/5", "tuesday.csv", 7, api.FRAME_STATE_NONE),
        (f"{vehicle}/recordings/8", "", 10, api.FRAME_STATE_AFTER),
        (f"{vehicle}/recordings/11", "tuesday.csv", 13, api.FRAME_STATE_SAME)]
    # Where a frame lies is told where it is known.
    assert [r.HasField("frame_pose") for r in whole] == [False, False, True, True]
    third = whole[2]
    assert third.frame_covariance.form == PLANAR_6
    assert third.HasField("frame_reference")
    # It ended where the last one began: at x = 10 and at x = 11.
    assert third.frame_pose.x_meters == pytest.approx(1.0)
    for size in (1, 2, 3, 4, 5):
        assert recordings(stub, vehicle, page_size=size) == whole
    page = stub.ListRecordings(api.ListRecordingsRequest(
        parent=vehicle, page_size=2))
    assert [r.first_sequence for r in page.recordings] == [1, 5]
    other = new_vehicle()
    failure = failure_of(lambda: stub.ListRecordings(api.ListRecordingsRequest(
        parent=other, page_token=page.next_page_token)))
    assert failure.reason == "INVALID_PAGE_TOKEN"


def test_damage_leaves_the_recordings_before_it(tmp_path):
    with Server(tmp_path / "store") as server:
        stub = server.stub()
        vehicle = create(stub, "truck")
        append(stub, vehicle, straight(10))
        append(stub, vehicle, beginning(straight(10, first=11), AFTER))
        append(stub, vehicle, beginning(straight(10, first=21), UNKNOWN))
        whole = recordings(stub, vehicle)
    database = sqlite3.connect(tmp_path / "store" / "revisit.sqlite")
    with database:
        assert database.execute("UPDATE batches SET checksum = checksum + 1 "
                                "WHERE first_sequence = 21").rowcount == 1
    database.close()
    with Server(tmp_path / "store", "--snapshot-poses", "0") as server:
        stub = server.stub()
        assert get(stub, vehicle).state == api.VEHICLE_STATE_DAMAGED
        assert [r.start for r in recordings(stub, vehicle)] == [
            r.start for r in whole[:2]]
        assert ranges(stub, vehicle) == [(1, 10), (11, 20)]
        stub.AcceptDataLoss(api.AcceptDataLossRequest(
            name=vehicle, durable_sequence=20))
        append(stub, vehicle, beginning(straight(10, first=21), DATUM))
        assert ranges(stub, vehicle) == [(1, 10), (11, 20), (21, 30)]


# ---- Revisions, exports, retention


def revise(stub, vehicle, poses, size=64, **first):
    return stub.RevisePoses(iter([
        api.RevisePosesRequest(poses=batch, **(
            {"vehicle": vehicle, **first} if i == 0 else {}))
        for i, batch in enumerate(batches(poses, size))]))


@pytest.fixture
def two(stub, new_vehicle):
    """A vehicle with two recordings of 10 poses each, of which the first one has a
    start as well."""
    vehicle = new_vehicle()
    append(stub, vehicle, beginning(straight(10), DATUM))
    append(stub, vehicle, beginning(straight(10, first=11), AFTER))
    return vehicle


def test_revision_leaves_the_starts_of_recordings_alone(stub, two):
    sent = list_poses(stub, two)
    revised = [pose(n, x=n + 0.5) for n in range(1, 21)]
    revised[10].recording_start.CopyFrom(UNKNOWN)
    revised[12].recording_start.CopyFrom(UNKNOWN)
    assert revise(stub, two, revised).revised_count == 20
    listed = list_poses(stub, two)
    assert listed[3].local.x_meters == 4.5
    assert listed[0].recording_start == DATUM
    assert listed[10].recording_start == AFTER
    assert not listed[12].HasField("recording_start")
    assert ranges(stub, two) == [(1, 10), (11, 20)]
    assert list_poses(stub, two, view=api.POSE_VIEW_AS_SENT) == sent


def test_revision_into_one_frame_leaves_one_recording(stub, two):
    sent = list_poses(stub, two)
    revision = get(stub, two).revision
    poses = [pose(n, x=float(n)) for n in range(1, 21)]
    answer = revise(stub, two, poses, size=7, common_frame=True,
                    expected_revision=revision)
    assert (answer.revised_count, answer.revision) == (20, revision + 1)
    listed = list_poses(stub, two)
    assert listed[0].recording_start == DATUM
    assert [p.sequence for p in listed if p.HasField("recording_start")] == [1]
    assert ranges(stub, two) == [(1, 20)]
    nodes, edges = export(stub, two)
    assert len(edges) == len(nodes) - 1
    # What was sent is kept, and what comes again is compared with that.
    assert list_poses(stub, two, view=api.POSE_VIEW_AS_SENT) == sent
    assert append(stub, two, sent).durable_sequence == 20
    # An answer that got lost is given again.
    again = revise(stub, two, poses, common_frame=True, expected_revision=revision)
    assert again.revision == answer.revision
    append(stub, two, beginning(straight(2, first=21), UNKNOWN))
    assert ranges(stub, two) == [(1, 20), (21, 22)]


def test_filters_that_began_anew_may_be_joined(stub, new_vehicle):
    """The first pose of a recording has no transition to tell."""
    vehicle = new_vehicle(**FILTER)

    def filtered(first, start):
        poses = straight(10, first=first)
        for p in poses[1:]:
            p.error_transition.extend(IDENTITY_9)
        return beginning(poses, start)

    append(stub, vehicle, filtered(1, DATUM))
    append(stub, vehicle, filtered(11, UNKNOWN))
    revise(stub, vehicle, straight(20), common_frame=True)
    assert ranges(stub, vehicle) == [(1, 20)]
    assert list(list_poses(stub, vehicle)[10].error_transition) == [0.0] * 9
    append(stub, vehicle, filtered(21, AFTER))
    assert ranges(stub, vehicle) == [(1, 20), (21, 30)]


@pytest.mark.parametrize("missing", [1, 11, 20])
def test_revision_into_one_frame_names_all_poses(missing, stub, two, unchanged):
    unchanged(two)
    poses = [pose(n, x=float(n)) for n in range(1, 21) if n != missing]
    failure = failure_of(lambda: revise(stub, two, poses, common_frame=True))
    assert (failure.code, failure.reason) == (INVALID, "INVALID_FIELD")
    assert failure.fields == ["poses"]
    assert "got 19 of the 20 poses" in failure.message
    # Whoever has not seen the last poses is told that first.
    failure = failure_of(lambda: revise(
        stub, two, poses, common_frame=True,
        expected_revision=get(stub, two).revision - 1))
    assert failure.reason == "REVISION_MISMATCH"


def test_common_frame_is_said_first(stub, two, unchanged):
    unchanged(two)
    poses = [pose(n, x=float(n)) for n in range(1, 21)]
    failure = failure_of(lambda: stub.RevisePoses(iter([
        api.RevisePosesRequest(vehicle=two, poses=poses[:10]),
        api.RevisePosesRequest(poses=poses[10:], common_frame=True)])))
    assert (failure.code, failure.fields) == (INVALID, ["common_frame"])


def test_poses_that_go_into_another_frame_are_not_said_to_outrun_their_claims(
        stub, new_vehicle):
    vehicle = new_vehicle()
    append(stub, vehicle, straight(50))
    append(stub, vehicle, beginning(straight(50, first=51), UNKNOWN))
    moved = [*straight(50), *(pose(n, x=n + 500.0) for n in range(51, 101))]
    assert not revise(stub, vehicle, moved, common_frame=True).warnings
    # In the frame of their own they would be.
    moved = [pose(n, x=n + 900.0) for n in range(51, 101)]
    assert [w.reason for w in revise(stub, vehicle, moved).warnings] == [
        api.WARNING_REASON_COVARIANCES_KEPT]


@pytest.mark.parametrize("view", [api.POSE_VIEW_CURRENT, api.POSE_VIEW_AS_SENT])
def test_export_joins_recordings_by_loop_closures_alone(view, stub, new_vehicle):
    vehicle = new_vehicle()
    append(stub, vehicle, straight(100))
    append(stub, vehicle, beginning(straight(100, first=101), AFTER))
    LOOP_CLOSURES.add(stub, vehicle, 150, 50)
    nodes, edges = export(stub, vehicle, view=view)
    (first,) = [node.index for node in nodes if node.sequence == 101]
    consecutive = {(e.from_index, e.to_index) for e in edges
                   if e.kind == api.EDGE_KIND_CONSECUTIVE}
    loops = [e for e in edges if e.kind == api.EDGE_KIND_LOOP_CLOSURE]
    assert (first - 1, first) not in consecutive
    assert len(consecutive) == len(nodes) - 2
    assert len(loops) == 1
    assert loops[0].from_index < first <= loops[0].to_index


FIX = (0.25, 0.0, 0.0, 0.25, 0.0, 0.0004)


def rounds(first, count):
    """A pose each 2 m around a circle of 300 poses, known by fixes."""
    radius = 600.0 / math.tau
    return [pose(n, radius * math.cos(math.tau * n / 300),
                 radius * math.sin(math.tau * n / 300),
                 math.remainder(math.tau * n / 300 + math.pi / 2, math.tau), FIX)
            for n in range(first, first + count)]


@pytest.mark.parametrize("told_first", [False, True], ids=["untold", "told"])
def test_retention_keeps_where_recordings_begin_and_end(told_first, tmp_path):
    starts = [1, 1501, 3001] if told_first else [1501, 3001]
    with Server(tmp_path / "store", *ADMIN) as server:
        stub = server.stub()
        vehicle = create(
            stub, "bounded", correlation_model=api.CORRELATION_MODEL_INDEPENDENT,
            sequence_length_meters=100.0, retention=api.Retention(max_passes=2))
        for first in (1, 1501, 3001):
            poses = rounds(first, 1500)
            if first in starts:
                beginning(poses, DATUM)
            send(stub, vehicle, poses)
            settled(server, vehicle)
        summary = settled(server, vehicle)
        assert summary.dropped_pose_count > 1000
        kept = list_poses(stub, vehicle)
        assert [p.sequence for p in kept if p.HasField("recording_start")] == starts
        assert ranges(stub, vehicle) == [(1, 1500), (1501, 3000), (3001, 4500)]
        whole = as_bytes(recordings(stub, vehicle))
    with Server(tmp_path / "store", "--snapshot-poses", "0") as server:
        stub = server.stub()
        assert as_bytes(list_poses(stub, vehicle)) == as_bytes(kept)
        assert as_bytes(recordings(stub, vehicle)) == whole
        # Those that are dropped need not be named.
        answer = revise(stub, vehicle, [
            pose(p.sequence, p.local.x_meters, p.local.y_meters,
                 p.heading_radians, FIX) for p in kept], common_frame=True)
        assert answer.revised_count == len(kept)
        assert ranges(stub, vehicle) == [(1, 4500)]
