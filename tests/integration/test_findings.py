"""What about a vehicle's poses contradicts its settings: in the vehicle, with the
acknowledgement that is the first to show it, and on the command line."""

import math

import numpy
import pytest

from revisit_server import Server, run
from stubs import api
from wire import PoseStream, append, batches, boreas, get, pose

SIGMA = 5.0
HEADING = 0.05


def road(meters, spacing):
    """Points every `spacing` metres of a winding road: x, y, heading."""
    x, y, heading = 0.0, 0.0, 0.3
    for n in range(round(meters / spacing)):
        yield x, y, heading
        heading += 0.02 * spacing * math.sin(n * spacing / 70)
        x += spacing * math.cos(heading)
        y += spacing * math.sin(heading)


def fixes(seed, kept, meters=2000.0, spacing=8.0):
    """Fixes whose errors keep so much of themselves from one to the next."""
    rng = numpy.random.default_rng(seed)
    error = rng.normal(0.0, SIGMA, 2)
    poses = []
    for n, (x, y, heading) in enumerate(road(meters, spacing), 1):
        fresh = SIGMA * math.sqrt(1.0 - kept * kept)
        error = kept * error + rng.normal(0.0, fresh, 2)
        poses.append(pose(n, x + error[0], y + error[1],
                          heading + rng.normal(0.0, HEADING),
                          [SIGMA ** 2, 0, 0, SIGMA ** 2, 0, HEADING ** 2]))
    return poses


def reckoning(meters=2000.0, spacing=2.0, begun_anew=0):
    """Dead reckoning without errors, whose covariances grow as they should; at this
    sequence, they begin anew."""
    start = covariance = numpy.diag([0.01, 0.01, 1e-5])
    poses = []
    before = None
    for n, (x, y, heading) in enumerate(road(meters, spacing), 1):
        if before is not None:
            lever = numpy.array([[1, 0, before[1] - y], [0, 1, x - before[0]],
                                 [0, 0, 1.0]])
            covariance = lever @ covariance @ lever.T + spacing * numpy.diag(
                [0.01, 0.0025, 3e-6])
        if n == begun_anew:
            covariance = start
        before = (x, y)
        poses.append(pose(n, x, y, heading,
                          list(covariance[numpy.triu_indices(3)])))
    return poses


def codes_of(vehicle):
    return [api.FindingCode.Name(f.code).removeprefix("FINDING_CODE_")
            for f in vehicle.findings]


MODELS = {name: getattr(api, f"CORRELATION_MODEL_{name}")
          for name in ("DEAD_RECKONING", "INDEPENDENT", "CORRELATED_FIXES")}
# What poses show under each of the models, and the setting that is named.
SHOWN = {
    "independent fixes": (
        lambda seed: fixes(seed, 0.0),
        {"DEAD_RECKONING": ("COVARIANCES_DO_NOT_GROW", "INDEPENDENT")}),
    "correlated fixes": (
        lambda seed: fixes(seed, 0.97),
        {"DEAD_RECKONING": ("COVARIANCES_DO_NOT_GROW", "CORRELATED_FIXES"),
         "INDEPENDENT": ("ERRORS_CORRELATED", "CORRELATED_FIXES")}),
    "reckoning": (
        lambda seed: reckoning(),
        {"INDEPENDENT": ("COVARIANCES_GROW", "DEAD_RECKONING"),
         "CORRELATED_FIXES": ("COVARIANCES_GROW", "DEAD_RECKONING")}),
}


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("poses", SHOWN)
def test_poses_that_contradict_the_model_are_told_once(
        poses, model, stub, new_vehicle, seed):
    make, shown = SHOWN[poses]
    vehicle = new_vehicle(correlation_model=MODELS[model])
    with PoseStream(stub, vehicle) as stream:
        stream.receive_kind("opened")
        for batch in batches(make(seed)):
            stream.send(batch)
        stream.half_close()
        warnings = [w for _, ack in stream.receive_all() for w in ack.warnings
                    if w.reason == api.WARNING_REASON_FINDING]
    found = get(stub, vehicle)
    if model not in shown:
        assert not warnings
        assert not found.findings
        return
    code, setting = shown[model]
    assert codes_of(found) == [code]
    assert f"correlation_model to {setting}" in found.findings[0].message
    assert len(warnings) == 1
    assert warnings[0].metadata["finding"] == f"FINDING_CODE_{code}"
    assert 0 < int(warnings[0].metadata["sequence"]) <= found.durable_sequence
    assert setting in warnings[0].message
    # Mended by the setting that it names.
    mended = stub.UpdateVehicle(api.UpdateVehicleRequest(
        vehicle=api.Vehicle(name=vehicle, settings=api.VehicleSettings(
            correlation_model=MODELS[setting])),
        update_mask={"paths": ["settings.correlation_model"]})).vehicle
    assert not mended.findings


def as_diagonals(poses):
    """The same poses with the variances of their covariances alone."""
    for each in poses:
        for entry in (1, 2, 4):
            each.covariance.values[entry] = 0.0
    return poses


def headings_claimed(stub, vehicle):
    """The variance of the heading at each node."""
    parts = stub.ExportPoseGraph(api.ExportPoseGraphRequest(vehicle=vehicle))
    return [node.covariance.values[5] for part in parts for node in part.nodes]


@pytest.mark.parametrize("sent, code", [
    (as_diagonals(reckoning()), "COVARIANCES_WITHOUT_LEVER"),
    (reckoning(begun_anew=501), "COVARIANCES_RESET"),
])
def test_claims_that_are_none_of_reckoning_are_carried_on(
        sent, code, stub, new_vehicle):
    told = []
    names = []
    for poses in (reckoning(), sent):
        names.append(new_vehicle())
        told.append([w for batch in batches(poses)
                     for w in append(stub, names[-1], list(batch)).warnings])
    assert not told[0]
    assert not get(stub, names[0]).findings
    assert [w.metadata["finding"] for w in told[1]] == [f"FINDING_CODE_{code}"]
    assert codes_of(get(stub, names[1])) == [code]
    if code == "COVARIANCES_RESET":
        assert told[1][0].metadata["sequence"] == "501"
        assert (float(told[1][0].metadata["before_meters"])
                > 10.0 * float(told[1][0].metadata["after_meters"]))
    assert headings_claimed(stub, names[1]) == pytest.approx(
        headings_claimed(stub, names[0]), rel=1e-2)


def test_findings_are_the_same_after_a_restart_and_shown(tmp_path, seed):
    with Server(tmp_path / "store") as server:
        stub = server.stub()
        stub.CreateVehicle(api.CreateVehicleRequest(
            vehicle_id="gnss", vehicle=api.Vehicle()))
        told = [w for batch in batches(fixes(seed, 0.97))
                for w in append(stub, "vehicles/gnss", list(batch)).warnings]
        assert [w.reason for w in told] == [api.WARNING_REASON_FINDING]
        before = get(stub, "vehicles/gnss")
        assert codes_of(before) == ["COVARIANCES_DO_NOT_GROW"]
    with Server(tmp_path / "store") as server:
        assert get(server.stub(), "vehicles/gnss") == before
        shown = run("revisit", "--server", server.address, "show", "gnss")
        assert shown.returncode == 0, shown.stderr
        assert before.findings[0].message in shown.stdout


def behind(poses, others):
    """These poses with sequences behind the others', as a client sends them whose
    odometry began anew."""
    moved = []
    for n, p in enumerate(poses, len(others) + 1):
        again = api.Pose()
        again.CopyFrom(p)
        again.sequence = n
        moved.append(again)
    return moved


def new_frames(warnings):
    return [w for w in warnings
            if w.metadata.get("finding") == "FINDING_CODE_NEW_FRAME"]


def appended(stub, vehicle, poses):
    return [w for batch in batches(poses)
            for w in append(stub, vehicle, batch).warnings]


def test_a_recording_in_another_frame_is_told_with_its_first_pose(stub, new_vehicle):
    vehicle = new_vehicle()
    poses = reckoning()
    warnings = appended(stub, vehicle, poses + behind(poses, poses))
    assert len(new_frames(warnings)) == len(warnings) == 1
    told = warnings[0].metadata
    assert told["sequence"] == str(len(poses) + 1)
    assert float(told["before_meters"]) > 3 * float(told["after_meters"])
    assert float(told["before_radians"]) > 3 * float(told["after_radians"])
    end = poses[-1].local
    assert float(told["meters"]) == pytest.approx(
        math.hypot(end.x_meters, end.y_meters), abs=10)
    found = get(stub, vehicle)
    assert codes_of(found) == ["NEW_FRAME"]
    assert found.findings[0].message == warnings[0].message
    assert f"sequence {len(poses) + 1} looks like the start" in warnings[0].message
    assert "with recording_start (revisit: --recording)" in warnings[0].message
    # A third one is told as well, and then stands for all.
    more = appended(stub, vehicle, behind(poses, 2 * poses))
    assert [w.metadata["sequence"] for w in new_frames(more)] == [
        str(2 * len(poses) + 1)]
    assert codes_of(get(stub, vehicle)) == ["NEW_FRAME"]


def test_a_new_frame_is_told_after_a_restart_and_no_second_time(tmp_path):
    poses = reckoning()
    with Server(tmp_path / "store") as server:
        stub = server.stub()
        stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id="v"))
        appended(stub, "vehicles/v", poses + behind(poses, poses))
        before = get(stub, "vehicles/v").findings
        assert len(before) == 1
    with Server(tmp_path / "store") as server:
        stub = server.stub()
        assert list(get(stub, "vehicles/v").findings) == list(before)
        last = poses[-1].local
        on = [pose(2 * len(poses) + n, last.x_meters + n, last.y_meters,
                   poses[-1].heading_radians, poses[-1].covariance.values)
              for n in range(1, 20)]
        assert not new_frames(appended(stub, "vehicles/v", on))


def test_a_new_frame_is_gone_once_poses_are_revised_into_one(stub, new_vehicle):
    vehicle = new_vehicle()
    poses = reckoning()
    appended(stub, vehicle, poses + behind(poses, poses))
    # An optimiser has joined the two, and claims what it knows of the second.
    whole = behind(reckoning(meters=4000.0), [])
    stub.RevisePoses(iter([api.RevisePosesRequest(
        vehicle=vehicle, poses=whole[:2 * len(poses)])]))
    assert codes_of(get(stub, vehicle)) == []


def test_one_recording_is_no_new_frame(stub, new_vehicle):
    poses, _ = boreas()
    assert not new_frames(appended(stub, new_vehicle(), poses))


def test_the_command_line_begins_another_recording_where_one_begins(server, tmp_path):
    """Two files that both begin at the origin, as those of an odometry do."""
    file = tmp_path / "drive.csv"
    file.write_text("t,x,y,yaw\n" + "".join(
        f"{n},{x},{y},{heading}\n"
        for n, (x, y, heading) in enumerate(road(2000.0, 5.0))))

    def stream(name, *flags):
        done = run("revisit", "stream", file, "--vehicle", name, "--create",
                   "--append", *flags, "--server", server.address)
        assert done.returncode == 0, done.stderr
        return done.stderr

    same = ("--recording", "same")
    assert "new recording" not in stream("silent", *same)
    said = stream("silent", *same)
    assert "sequence 401 looks like the start of a new recording" in said
    assert "--recording" in said
    assert "NEW_FRAME" not in stream("stated")
    assert "new recording" not in stream(
        "stated", "--start-sigma-position", "10", "--start-sigma-heading", "0.2")
    assert codes_of(get(server.stub(), "vehicles/stated")) == []
    # By itself, for a file that does not go on where the last one ended.
    both = run("revisit", "stream", file, file, "--vehicle", "both", "--create",
               "--server", server.address)
    assert "so another recording begins" in both.stderr
    assert "looks like the start of a new recording" not in both.stderr
    assert codes_of(get(server.stub(), "vehicles/both")) == []
