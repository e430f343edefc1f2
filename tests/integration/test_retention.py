"""Vehicles that keep a part of their history: what is dropped, what stays, and
what callers hear of it."""

import math
import sqlite3
import time

import grpc
import pytest
from google.protobuf import duration_pb2, field_mask_pb2, timestamp_pb2

import scraped
from grouping import add_link, add_member, add_vehicle, create_group, delete_link
from own_postgres import own_postgres
from revisit_server import Server, run, wait_until
from stubs import api
from wire import PoseStream, append, batches, failure_of, get, list_poses, pose

ADMIN = ("--admin-listen", "127.0.0.1:0")
LAP_METERS = 600.0
LAP = 300
SETTINGS = dict(correlation_model=api.CORRELATION_MODEL_INDEPENDENT,
                sequence_length_meters=100.0)
# Standard deviations of 0.5 m and 0.02 rad.
FIX = (0.25, 0.0, 0.0, 0.25, 0.0, 0.0004)


def course(count, first=1):
    """Poses of a course with corners, a pose every 2 m and every second."""
    radius = LAP_METERS / math.tau
    poses = []
    for n in range(first, first + count):
        angle = math.tau * (n % LAP) / LAP
        bulge = radius * (1.0 + 0.25 * math.cos(3 * angle))
        slope = -0.75 * radius * math.sin(3 * angle)
        heading = math.atan2(slope * math.sin(angle) + bulge * math.cos(angle),
                             slope * math.cos(angle) - bulge * math.sin(angle))
        poses.append(pose(n, bulge * math.cos(angle), bulge * math.sin(angle),
                          heading, FIX, stamp=timestamp_pb2.Timestamp(seconds=n)))
    return poses


def create(stub, name, **retention):
    settings = api.VehicleSettings(**SETTINGS)
    if retention:
        settings.retention.CopyFrom(api.Retention(**retention))
    return stub.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id=name, vehicle=api.Vehicle(settings=settings))).vehicle.name


def drive(stub, vehicle, laps, first_lap=0):
    for batch in batches(course(laps * LAP, first_lap * LAP + 1), 50):
        append(stub, vehicle, batch)


def settled(server, vehicle):
    """The vehicle once what fell due is dropped. What comes first is behind what
    led to it; the change comes behind the drop."""
    stub = server.stub()
    get(stub, vehicle)
    wait_until(lambda: scraped.scrape(server).value(
        "revisit_trimmed_vehicles") == 0, "end of the look at the history")
    return stub.UpdateVehicle(api.UpdateVehicleRequest(
        vehicle=api.Vehicle(name=vehicle, display_name="settled"),
        update_mask=field_mask_pb2.FieldMask(paths=["display_name"]))).vehicle


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with Server(tmp_path_factory.mktemp("server") / "store", *ADMIN) as running:
        yield running


def best(stub, vehicle, sequence=0):
    found = stub.FindCandidates(api.FindCandidatesRequest(
        vehicle=vehicle, sequence=sequence)).candidates
    return found.candidates[0] if found.candidates else None


def assert_finds_its_place(stub, vehicle, sequence=0):
    """The best candidate is whole laps before the query."""
    candidate = best(stub, vehicle, sequence)
    assert candidate is not None
    assert candidate.verdict == api.VERDICT_ACCEPTED
    behind = (candidate.query.sequence - candidate.matched.sequence) % LAP
    assert min(behind, LAP - behind) <= 3


@pytest.fixture
def database():
    with own_postgres() as postgres:
        if postgres is None:
            pytest.skip("there is no PostgreSQL: tests/run installs it")
        yield postgres


def test_a_vehicle_that_goes_round_stays_bounded_and_finds_its_loops(tmp_path):
    with Server(tmp_path / "store", *ADMIN) as server:
        stub = server.stub()
        vehicle = create(stub, "bounded", max_passes=3)
        whole = create(stub, "whole")
        sizes = []
        for first_lap in range(0, 40, 4):
            drive(stub, vehicle, 4, first_lap)
            drive(stub, whole, 4, first_lap)
            sizes.append(settled(server, vehicle).node_count)
            assert_finds_its_place(stub, vehicle)
        assert max(sizes[3:]) < 2400, sizes
        assert get(stub, whole).node_count > 11_900
        summary = get(stub, vehicle)
        assert scraped.scrape(server).value("revisit_poses_dropped_total") == (
            summary.dropped_pose_count)
        last = server.logged("poses_dropped")[-1]
        assert 'vehicle=bounded' in last
        assert f"first_kept_sequence={summary.first_kept_sequence}" in last
        assert summary.durable_sequence == 40 * LAP
        assert summary.dropped_pose_count > 30 * LAP
        assert summary.travelled_meters == pytest.approx(
            get(stub, whole).travelled_meters, rel=1e-3)
        for sequence in range(summary.first_kept_sequence + LAP + 100, 40 * LAP, 97):
            assert_finds_its_place(stub, vehicle, sequence)
        kept = list_poses(stub, vehicle)
        before = best(stub, vehicle)
    with Server(tmp_path / "store") as server:
        stub = server.stub()
        loaded = get(stub, vehicle)
        assert (loaded.node_count, loaded.first_kept_sequence,
                loaded.dropped_pose_count, loaded.travelled_meters) == (
                    summary.node_count, summary.first_kept_sequence,
                    summary.dropped_pose_count, summary.travelled_meters)
        assert list_poses(stub, vehicle) == kept
        assert best(stub, vehicle) == before
        drive(stub, vehicle, 1, 40)
        assert_finds_its_place(stub, vehicle)
    verified = run("revisitd", "verify", "--store", tmp_path / "store")
    assert verified.stdout.endswith("sound\n"), verified.stdout


@pytest.fixture(scope="module")
def bounded(server, stub):
    vehicle = create(stub, "asked", max_passes=2)
    drive(stub, vehicle, 10)
    summary = settled(server, vehicle)
    assert summary.dropped_pose_count > 4 * LAP
    assert summary.first_kept_sequence > 1
    return vehicle


def test_lists_begin_at_the_first_pose_that_is_kept(stub, bounded):
    summary = get(stub, bounded)
    kept = list_poses(stub, bounded)
    assert kept[0].sequence == summary.first_kept_sequence
    assert len(kept) == 10 * LAP - summary.dropped_pose_count
    assert [p.sequence for p in kept] == sorted(p.sequence for p in kept)
    # Pages pass over what is missing.
    pages = []
    request = api.ListPosesRequest(parent=bounded, page_size=37)
    while True:
        page = stub.ListPoses(request)
        pages.extend(page.poses)
        if not page.next_page_token:
            break
        assert len(page.poses) == 37
        request.page_token = page.next_page_token
    assert pages == kept


@pytest.mark.parametrize("name", ["ListPoses", "FindCandidates", "AddLoopClosure",
                                  "RejectCandidate"])
def test_calls_that_name_a_dropped_pose_hear_where_to_go_on(name, stub, bounded):
    first = get(stub, bounded).first_kept_sequence
    request = {
        "ListPoses": api.ListPosesRequest(parent=bounded, first_sequence=2),
        "FindCandidates": api.FindCandidatesRequest(vehicle=bounded, sequence=2),
        "AddLoopClosure": api.AddLoopClosureRequest(
            parent=bounded, loop_closure=api.LoopClosure(
                query_sequence=10 * LAP, matched_sequence=2)),
        "RejectCandidate": api.RejectCandidateRequest(
            parent=bounded, rejected_candidate=api.RejectedCandidate(
                query_sequence=10 * LAP, matched_sequence=2)),
    }[name]
    failure = failure_of(lambda: getattr(stub, name)(request))
    assert failure.code == grpc.StatusCode.OUT_OF_RANGE
    assert failure.reason == "POSES_DROPPED"
    assert failure.metadata["sequence"] == "2"
    assert failure.metadata["first_kept_sequence"] == str(first)
    assert failure.metadata["next_kept_sequence"] == str(first)
    listed = stub.ListPoses(api.ListPosesRequest(parent=bounded,
                                                 first_sequence=first))
    assert listed.poses[0].sequence == first


def test_dropped_poses_that_come_again_are_acknowledged(stub, bounded):
    revision = get(stub, bounded).revision
    assert append(stub, bounded, course(200, 2)).durable_sequence == 10 * LAP
    last = get(stub, bounded).first_kept_sequence
    assert append(stub, bounded, course(300, last - 150)).durable_sequence == 10 * LAP
    assert get(stub, bounded).revision == revision


def test_a_revision_passes_over_what_is_dropped(stub, bounded):
    first = get(stub, bounded).first_kept_sequence
    before = get(stub, bounded).revision
    answer = stub.RevisePoses(iter([api.RevisePosesRequest(
        vehicle=bounded, poses=course(20, first - 8))]))
    assert (answer.revised_count, answer.dropped_count) == (12, 8)
    assert answer.revision > before
    nothing = stub.RevisePoses(iter([api.RevisePosesRequest(
        vehicle=bounded, poses=course(5, 2))]))
    assert (nothing.revised_count, nothing.dropped_count) == (0, 5)
    assert nothing.revision == answer.revision


def test_an_export_has_no_edge_over_what_is_dropped(server, stub):
    vehicle = create(stub, "islands", max_passes=2)
    drive(stub, vehicle, 2)
    # What it refers to stays, and what lies around is dropped later.
    stub.AddLoopClosure(api.AddLoopClosureRequest(
        parent=vehicle, loop_closure=api.LoopClosure(
            query_sequence=LAP + 100, matched_sequence=100)))
    drive(stub, vehicle, 8, 2)
    assert settled(server, vehicle).dropped_pose_count > 4 * LAP
    nodes, edges = [], []
    for part in stub.ExportPoseGraph(api.ExportPoseGraphRequest(vehicle=vehicle)):
        nodes.extend(part.nodes)
        edges.extend((edge.from_index, edge.to_index) for edge in part.edges)
    cuts = [later.index for earlier, later in zip(nodes, nodes[1:])
            if later.sequence > earlier.sequence + 2]
    assert cuts
    present = set(edges)
    assert all((cut - 1, cut) not in present for cut in cuts)
    assert len(edges) >= len(nodes) - 1 - len(cuts)


def link_to(stub, vehicle, sequence):
    """The name of a loop closure of this pose and one of another vehicle."""
    group = create_group(stub, f"group-of-{vehicle.split('/')[1]}").name
    other = add_vehicle(stub, f"other-of-{vehicle.split('/')[1]}")
    for member in (vehicle, other):
        add_member(stub, group, member)
    return add_link(stub, group, (other, 1), (vehicle, sequence)).loop_closure.name


@pytest.mark.parametrize("retention", [
    dict(max_passes=2), dict(max_age=duration_pb2.Duration(seconds=8 * LAP))],
    ids=["max_passes", "max_age"])
def test_poses_of_links_stay_until_these_are_deleted(retention, server, stub):
    name, = retention
    vehicle = create(stub, f"linked-{name.replace('_', '-')}", **retention)
    drive(stub, vehicle, 2)
    linked = link_to(stub, vehicle, 400)
    drive(stub, vehicle, 18, 2)
    assert settled(server, vehicle).dropped_pose_count > 4 * LAP
    kept = [p.sequence for p in list_poses(stub, vehicle)]
    # With two sequence lengths before it, as those of the vehicle's own.
    assert set(range(302, 401)) <= set(kept)
    assert not set(range(500, 600)) & set(kept)
    delete_link(stub, linked)
    drive(stub, vehicle, 4, 20)
    settled(server, vehicle)
    kept = [p.sequence for p in list_poses(stub, vehicle)]
    assert not set(range(302, 401)) & set(kept)


def test_a_damaged_link_keeps_everything_until_it_is_deleted(tmp_path):
    with Server(tmp_path / "store", *ADMIN) as server:
        stub = server.stub()
        vehicle = create(stub, "doubted", max_passes=0)
        drive(stub, vehicle, 6)
        linked = link_to(stub, vehicle, 400)
    database = sqlite3.connect(tmp_path / "store" / "revisit.sqlite")
    with database:
        assert database.execute(
            "UPDATE group_links SET checksum = checksum + 1").rowcount == 1
    database.close()
    with Server(tmp_path / "store", *ADMIN) as server:
        stub = server.stub()
        stub.UpdateVehicle(api.UpdateVehicleRequest(
            vehicle=api.Vehicle(name=vehicle, settings=api.VehicleSettings(
                retention=api.Retention(max_passes=2))),
            update_mask=field_mask_pb2.FieldMask(paths=["settings.retention"])))
        assert settled(server, vehicle).dropped_pose_count == 0
        line = server.logged("poses_kept")[-1]
        assert "vehicle=doubted" in line
        assert linked.split("/")[-1] in line
        delete_link(stub, linked)
        drive(stub, vehicle, 4, 6)
        assert settled(server, vehicle).dropped_pose_count > LAP


def test_poses_grow_too_old_by_their_own_stamps(server, stub):
    # The newest poses take less than a tenth of the age, so they do not count as a
    # leap.
    vehicle = create(stub, "aged", max_age=duration_pb2.Duration(seconds=24 * LAP))
    drive(stub, vehicle, 40)
    summary = settled(server, vehicle)
    kept = 40 * LAP - summary.dropped_pose_count
    assert 24 * LAP <= kept < 1.25 * 24 * LAP + 100
    assert summary.first_kept_sequence == 40 * LAP - kept + 1
    assert_finds_its_place(stub, vehicle)


DAY = 24 * 3600
YEAR = 365 * DAY
HOUR = 3600
START = int(time.time()) - 4 * YEAR


def hourly(sequence):
    """A pose each hour: 4000 poses take less than half a year."""
    return START + sequence * HOUR


def stamped(poses, stamp=hourly):
    for p in poses:
        p.stamp.FromSeconds(stamp(p.sequence))
    return poses


def warnings_of(acks):
    """Those of stamps: poses hours apart, without errors, also look like degrees, and
    smoother than their covariances."""
    return [(api.WarningReason.Name(w.reason).removeprefix("WARNING_REASON_"), w)
            for ack in acks for w in ack.warnings
            if w.reason == api.WARNING_REASON_STAMPS_AHEAD
            or w.metadata.get("finding") == "FINDING_CODE_STAMPS_LEAP"]


def send(stub, vehicle, poses):
    """The warnings of a stream of these."""
    acks = []
    with PoseStream(stub, vehicle) as stream:
        stream.receive_kind("opened")
        for batch in batches(poses, 50):
            stream.send(batch)
        stream.half_close()
        acks = [message for _, message in stream.receive_all()]
    return warnings_of(acks)


def findings_of(stub, vehicle):
    return [api.FindingCode.Name(f.code).removeprefix("FINDING_CODE_")
            for f in get(stub, vehicle).findings
            if f.code == api.FINDING_CODE_STAMPS_LEAP]


def in_2100(sequence):
    return 4_102_444_800 + sequence


# What the vehicle's clock says, and whether the stamp is so far ahead.
WRONG = {
    "the last of 2100": (lambda n: in_2100(n) if n == 4000 else hourly(n), True),
    "the first of a batch": (
        lambda n: in_2100(n) if n == 3951 else hourly(n), True),
    "the first of all": (lambda n: in_2100(n) if n == 1 else hourly(n), True),
    "the last twenty of 2100": (
        lambda n: in_2100(n) if n > 3980 else hourly(n), True),
    "each tenth of 2100": (
        lambda n: in_2100(n) if n % 10 == 0 else hourly(n), True),
    "all from half of the way on of 2100": (
        lambda n: in_2100(n) if n > 2000 else hourly(n), True),
    "the last of two years later": (
        lambda n: hourly(n) + (2 * YEAR if n == 4000 else 0), False),
    "some, again and again, of two years later": (
        lambda n: hourly(n) + (2 * YEAR if n % 200 > 180 else 0), False),
    "months ahead for a while, again and again": (
        lambda n: hourly(n) + (300 * DAY if n % 60 > 40 else 0), False),
    "the last of 1970": (lambda n: 0 if n == 4000 else hourly(n), False),
    "a day of 1970": (lambda n: n if 3000 <= n < 3024 else hourly(n), False),
    "the last stretch of 1970": (lambda n: n if n > 3000 else hourly(n), False),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_wrong_stamps_drop_nothing(wrong, server, stub):
    stamp, is_ahead = WRONG[wrong]
    name = "wrong-" + wrong.replace(" ", "-").replace(",", "")
    vehicle = create(stub, name, max_age=duration_pb2.Duration(seconds=YEAR))
    told = send(stub, vehicle, stamped(course(4000), stamp))
    # A look falls due.
    request = api.UpdateVehicleRequest(
        vehicle=api.Vehicle(name=vehicle, settings=api.VehicleSettings(
            retention=api.Retention(
                max_age=duration_pb2.Duration(seconds=YEAR + 1)))),
        update_mask=field_mask_pb2.FieldMask(paths=["settings.retention"]))
    stub.UpdateVehicle(request)
    assert settled(server, vehicle).dropped_pose_count == 0
    ahead = [w for reason, w in told if reason == "STAMPS_AHEAD"]
    assert bool(ahead) == is_ahead
    if is_ahead:
        first = next(n for n in range(1, 4001) if stamp(n) > time.time() + 300)
        assert ahead[0].metadata["sequence"] == str(first)
        assert int(ahead[0].metadata["seconds"]) > 50 * YEAR


def test_a_wrong_stamp_is_told_and_drops_nothing_after_a_restart(tmp_path):
    """The newest of 4,000 poses is stamped in 2100."""
    with Server(tmp_path / "store", *ADMIN) as server:
        stub = server.stub()
        vehicle = create(stub, "leapt", max_age=duration_pb2.Duration(seconds=YEAR))
        assert not send(stub, vehicle, stamped(course(3999)))
        acks = [append(stub, vehicle, stamped(course(1, 4000), in_2100))]
        told = {reason: w for reason, w in warnings_of(acks)}
        assert set(told) == {"STAMPS_AHEAD", "FINDING"}
        assert told["STAMPS_AHEAD"].metadata["sequence"] == "4000"
        assert "ahead of the server's clock" in told["STAMPS_AHEAD"].message
        finding = told["FINDING"]
        assert finding.metadata["finding"] == "FINDING_CODE_STAMPS_LEAP"
        assert finding.metadata["sequence"] == "4000"
        # The stamp of a node on the way to that pose.
        assert YEAR < int(finding.metadata["seconds"]) < 80 * YEAR
        assert "retention.max_age" in finding.message
        assert findings_of(stub, vehicle) == ["STAMPS_LEAP"]
        assert settled(server, vehicle).dropped_pose_count == 0
        # Its optimiser cannot put another stamp in its place either.
        stub.RevisePoses(iter([api.RevisePosesRequest(
            vehicle=vehicle, poses=stamped(course(100, 3000), in_2100))]))
        assert settled(server, vehicle).dropped_pose_count == 0
    with Server(tmp_path / "store", *ADMIN) as server:
        stub = server.stub()
        assert settled(server, vehicle).dropped_pose_count == 0
        assert findings_of(stub, vehicle) == ["STAMPS_LEAP"]
        # The vehicle drives on by the right clock; the finding goes.
        assert not warnings_of(
            append(stub, vehicle, stamped(batch))
            for batch in batches(course(800, 4001), 50))
        assert settled(server, vehicle).dropped_pose_count == 0
        assert findings_of(stub, vehicle) == []
    # And into another store, as it is.
    copy = tmp_path / "copy"
    copied = run("revisitd", "import", "--store", copy, "--from", tmp_path / "store")
    assert copied.returncode == 0, copied.stderr
    with Server(copy, *ADMIN) as server:
        assert settled(server, vehicle).dropped_pose_count == 0


def test_a_clock_that_is_set_right_for_good_ages_what_was_before(server, stub):
    vehicle = create(stub, "set-right",
                     max_age=duration_pb2.Duration(seconds=YEAR))

    def stamp(sequence):
        return hourly(sequence) - (0 if sequence > 3000 else 30 * YEAR)

    send(stub, vehicle, stamped(course(3000), stamp))
    told = send(stub, vehicle, stamped(course(400, 3001), stamp))
    assert [w.metadata["finding"] for _, w in told] == ["FINDING_CODE_STAMPS_LEAP"]
    assert settled(server, vehicle).dropped_pose_count == 0
    # It has lasted for 14 sequence lengths, and more.
    send(stub, vehicle, stamped(course(800, 3401), stamp))
    assert settled(server, vehicle).dropped_pose_count == pytest.approx(3000, abs=60)
    last = server.logged("poses_dropped")[-1]
    assert "vehicle=set-right" in last
    assert "nodes_covered=0" in last and "nodes_too_old=0" not in last
    assert findings_of(stub, vehicle) == []


def test_what_is_kept_can_be_changed_at_any_time(server, stub):
    vehicle = create(stub, "changed")
    drive(stub, vehicle, 12)
    assert get(stub, vehicle).settings.HasField("retention") is False
    request = api.UpdateVehicleRequest(
        vehicle=api.Vehicle(name=vehicle, settings=api.VehicleSettings(
            retention=api.Retention(max_passes=2))),
        update_mask=field_mask_pb2.FieldMask(paths=["settings.retention"]))
    assert stub.UpdateVehicle(request).vehicle.settings.retention.max_passes == 2
    dropped = settled(server, vehicle).dropped_pose_count
    assert dropped > 5 * LAP
    # Named but not given: everything is kept from now on.
    request.vehicle.settings.ClearField("retention")
    assert not stub.UpdateVehicle(request).vehicle.settings.HasField("retention")
    drive(stub, vehicle, 4, 12)
    assert settled(server, vehicle).dropped_pose_count == dropped


@pytest.mark.parametrize("retention,field", [
    (dict(max_passes=-1), "max_passes"), (dict(max_passes=21), "max_passes"),
    (dict(max_age=duration_pb2.Duration()), "max_age"),
    (dict(max_age=duration_pb2.Duration(seconds=-5)), "max_age"),
    (dict(max_age=duration_pb2.Duration(seconds=1, nanos=-5)), "max_age"),
    (dict(max_age=duration_pb2.Duration(seconds=3_153_600_001)), "max_age"),
    (dict(max_age=duration_pb2.Duration(seconds=2**62)), "max_age")])
def test_settings_out_of_range_are_refused(retention, field, stub):
    failure = failure_of(lambda: create(stub, "refused", **retention))
    assert failure.code == grpc.StatusCode.INVALID_ARGUMENT
    assert failure.fields == [f"vehicle.settings.retention.{field}"]


def test_the_command_line_sets_and_shows_what_is_kept(server):
    def revisit(*arguments):
        result = run("revisit", "--server", f"127.0.0.1:{server.port}", *arguments)
        assert result.returncode == 0, result.stderr
        return result.stdout

    shown = revisit("vehicle", "create", "by-hand", "--max-passes", "4",
                    "--max-age", "86400")
    assert "4 passes of each place, at most 86400 s old" in shown
    stub = server.stub()
    vehicle = create(stub, "exported", max_passes=2)
    drive(stub, vehicle, 8)
    summary = settled(server, vehicle)
    shown = revisit("vehicle", "get", "exported")
    assert (f"{summary.dropped_pose_count}, the first that is kept is "
            f"{summary.first_kept_sequence}") in shown
    lines = revisit("export", "exported", "--format", "csv").splitlines()
    assert len(lines) > 300


def test_a_shared_store_drops_as_a_file_does(database, tmp_path):
    owner = database.url("revisit_owner")
    assert run("revisitd", "migrate", "--store", owner).returncode == 0
    with Server(database.url("revisit"), *ADMIN, "--advertise-address", "host-a:1",
                log_path=tmp_path / "shared.log") as server:
        stub = server.stub()
        vehicle = create(stub, "shared", max_passes=3)
        drive(stub, vehicle, 12)
        summary = settled(server, vehicle)
        assert summary.dropped_pose_count > 5 * LAP
        kept = list_poses(stub, vehicle)
        assert_finds_its_place(stub, vehicle)
    verified = run("revisitd", "verify", "--store", owner)
    assert verified.stdout.endswith("sound\n"), verified.stdout
    # And into a file, as it is.
    file = tmp_path / "file"
    copied = run("revisitd", "import", "--store", file, "--from", owner)
    assert copied.returncode == 0, copied.stderr
    with Server(file) as server:
        stub = server.stub()
        loaded = get(stub, vehicle)
        assert loaded.dropped_pose_count == summary.dropped_pose_count
        assert loaded.node_count == summary.node_count
        assert list_poses(stub, vehicle) == kept
        assert_finds_its_place(stub, vehicle)
