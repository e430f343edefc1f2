"""Warnings of wrong axes and units, with the acknowledgements. Those of poses
that contradict settings: test_findings.py."""

import math

import pytest

from stubs import api
from wire import PoseStream, append, batches, boreas, pose, straight
from wire import laps as laps_of_one_covariance

SECOND = 1_000_000_000


def stamped(poses, seconds=0.1):
    for n, p in enumerate(poses):
        p.stamp.FromNanoseconds(1_700_000_000 * SECOND
                                + round(n * seconds * SECOND))
    return poses


def laps(count, **shape):
    """Laps whose covariances grow, as those of dead reckoning do."""
    poses = laps_of_one_covariance(count, **shape)
    for n, p in enumerate(poses):
        variance = 0.01 + 0.005 * n
        p.covariance.values[:] = [variance, 0, 0, variance, 0, 1e-6]
    return poses


def warnings_of(ack):
    return {api.WarningReason.Name(w.reason).removeprefix("WARNING_REASON_"): w
            for w in ack.warnings}


def streamed(stub, vehicle, poses):
    """The warnings with each acknowledgement of a stream, but for findings: of the
    poses here, the covariances are none of dead reckoning."""
    with PoseStream(stub, vehicle) as stream:
        stream.receive_kind("opened")
        for batch in batches(poses):
            stream.send(batch)
        stream.half_close()
        told = [warnings_of(message) for _, message in stream.receive_all()]
    for warnings in told:
        warnings.pop("FINDING", None)
    return told


def changed(poses, change):
    for p in poses:
        change(p)
    return poses


def heading(change):
    def apply(p):
        p.heading_radians = change(p.heading_radians)
    return apply


def geodetic_as_local(p):
    p.local.x_meters = 11.5 + p.local.x_meters / 74_000
    p.local.y_meters = 48.1 + p.local.y_meters / 111_000


def camera_axes(p):
    # x right, y down, z forward, as the drive begins: along +y.
    p.local.z_meters, p.local.y_meters = p.local.y_meters, 0.0


def millimetres(p):
    p.local.x_meters *= 1000.0
    p.local.y_meters *= 1000.0


WRONG = {
    "degrees": (heading(lambda h: math.degrees(h)),
                {"HEADING_BEYOND_TURN", "HEADING_OFF_COURSE"}),
    "from north": (heading(lambda h: math.pi / 2 - h), {"HEADING_OFF_COURSE"}),
    "turned": (heading(lambda h: h + math.pi / 2), {"HEADING_OFF_COURSE"}),
    "longitude and latitude": (geodetic_as_local, {"POSITIONS_LIKE_DEGREES"}),
    "millimetres": (millimetres, {"IMPLAUSIBLE_SPEED"}),
    "camera axes": (camera_axes, {"STEEP_PATH"}),
}


@pytest.mark.parametrize("name", WRONG)
def test_wrong_axes_and_units_are_told_once(name, stub, new_vehicle):
    change, reasons = WRONG[name]
    poses = changed(stamped(laps(400, radius=120.0)), change)
    acks = streamed(stub, new_vehicle(), poses)
    told = [reason for ack in acks for reason in ack]
    assert sorted(told) == sorted(reasons)
    for ack in acks:
        for warning in ack.values():
            assert warning.message.isascii()
            assert 1 <= int(warning.metadata["sequence"]) <= 400


def test_warnings_have_numbers(stub, new_vehicle):
    poses = changed(stamped(laps(200)), heading(lambda h: h - math.pi / 2))
    warning = next(ack["HEADING_OFF_COURSE"] for ack in streamed(
        stub, new_vehicle(), poses) if ack)
    assert float(warning.metadata["median_degrees"]) == pytest.approx(90)
    assert float(warning.metadata["turned_degrees"]) == pytest.approx(-90)
    assert "turned by -90 degrees" in warning.message


def test_stamps_that_run_backwards_are_told(stub, new_vehicle):
    poses = stamped(straight(100))
    poses[70].stamp.FromNanoseconds(1_600_000_000 * SECOND)
    acks = streamed(stub, new_vehicle(), poses)
    assert list(acks[0]) == []
    warning = acks[1]["STAMPS_BACKWARDS"]
    assert warning.metadata["sequence"] == "71"
    assert float(warning.metadata["seconds"]) < -9e7


def test_right_poses_are_not_warned_of(stub, new_vehicle):
    poses, _ = boreas()
    assert not any(streamed(stub, new_vehicle(), poses))
    assert not any(streamed(stub, new_vehicle(), stamped(laps(3000))))
    # A vehicle at rest whose fixes scatter, and one without stamps.
    scattered = stamped([
        pose(n, x=50 + 3 * math.sin(7 * n), y=30 + 3 * math.cos(11 * n),
             covariance=[4, 0, 0, 4, 0, 0.1]) for n in range(1, 500)])
    fixes = new_vehicle(correlation_model=api.CORRELATION_MODEL_INDEPENDENT)
    assert not any(streamed(stub, fixes, scattered))


def test_batch_with_the_first_pose_is_looked_at(stub, new_vehicle):
    vehicle = new_vehicle()
    poses = changed(straight(200), heading(lambda h: h + 90.0))
    assert set(warnings_of(append(stub, vehicle, poses[:100]))) == {
        "HEADING_BEYOND_TURN", "HEADING_OFF_COURSE"}
    assert not append(stub, vehicle, poses[100:]).warnings
    # Sent again: the same answer.
    assert append(stub, vehicle, poses[:100]).warnings


def test_warned_poses_are_stored_as_they_came(stub, new_vehicle):
    vehicle = new_vehicle()
    ack = append(stub, vehicle, changed(straight(100), millimetres))
    assert ack.durable_sequence == 100
    assert ack.jumps
