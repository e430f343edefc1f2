"""Poses, drives, streams and errors as they go over the wire."""

import csv
import dataclasses
import math
import queue
import time

import grpc
import pytest
from google.rpc import error_details_pb2, status_pb2

from stubs import ROOT, api

BOREAS = ROOT / "tests/data/boreas/boreas_glen_shields.csv"

# Variances of 0.1 m and 0.01 rad: xx, xy, xh, yy, yh, hh.
SMALL_COVARIANCE = (0.01, 0.0, 0.0, 0.01, 0.0, 1e-4)


def pose(sequence, x=0.0, y=0.0, heading=0.0, covariance=SMALL_COVARIANCE,
         **fields):
    """A planar pose in the local frame."""
    return api.Pose(
        sequence=sequence,
        local=api.LocalPosition(x_meters=x, y_meters=y),
        heading_radians=heading,
        covariance=api.Covariance(form=api.COVARIANCE_FORM_PLANAR_6,
                                  values=covariance),
        **fields)


def straight(count, first=1, spacing=1.0):
    """Poses along +x, the pose of sequence n at x = n * spacing."""
    return [pose(n, x=n * spacing) for n in range(first, first + count)]


def laps(count, radius=60.0, spacing=1.0, first=1):
    """Poses along a circle, counter-clockwise, exactly over each other at each
    lap if the circumference is a multiple of the spacing."""
    poses = []
    for n in range(first, first + count):
        angle = n * spacing / radius
        poses.append(pose(n, x=radius * math.cos(angle),
                          y=radius * math.sin(angle),
                          heading=math.remainder(angle + math.pi / 2,
                                                 2 * math.pi)))
    return poses


def boreas():
    """The shipped drive: (poses as estimated, true (x, y, heading) of each)."""
    poses, truth = [], []
    with open(BOREAS, newline="") as file:
        for row in csv.DictReader(file):
            number = {name: float(value) for name, value in row.items()}
            poses.append(pose(
                int(row["frame"]) + 1, number["est_x"], number["est_y"],
                number["est_yaw"],
                [number[name] for name in
                 ("pxx", "pxy", "pxt", "pyy", "pyt", "ptt")]))
            truth.append((number["gt_x"], number["gt_y"], number["gt_yaw"]))
    return poses, truth


def batches(poses, size=64):
    return [poses[i:i + size] for i in range(0, len(poses), size)]


def columns_of(poses):
    """The poses as PoseColumns, which are alike in what they have."""
    first = poses[0]
    columns = api.PoseColumns(
        first_sequence=first.sequence, pose_count=len(poses),
        covariance_form=first.covariance.form,
        covariances=[value for each in poses for value in each.covariance.values],
        error_transitions=[value for each in poses
                           for value in each.error_transition])
    if first.HasField("stamp"):
        columns.first_stamp.CopyFrom(first.stamp)
        stamps = [each.stamp.ToNanoseconds() for each in poses]
        columns.stamp_step_nanos.extend(
            after - before for before, after in zip(stamps, stamps[1:]))
    if first.HasField("recording_start"):
        columns.recording_start.CopyFrom(first.recording_start)
    for each in poses:
        if each.HasField("geodetic"):
            columns.latitude_degrees.append(each.geodetic.latitude_degrees)
            columns.longitude_degrees.append(each.geodetic.longitude_degrees)
            columns.height_meters.append(each.geodetic.height_meters)
        else:
            columns.x_meters.append(each.local.x_meters)
            columns.y_meters.append(each.local.y_meters)
            columns.z_meters.append(each.local.z_meters)
        if each.HasField("quaternion"):
            turn = each.quaternion
            columns.quaternions.extend([turn.x, turn.y, turn.z, turn.w])
        else:
            columns.heading_radians.append(each.heading_radians)
    return columns


#: How many numbers the forms of a covariance have, and which are the variances.
COVARIANCE_PLACES = {
    api.COVARIANCE_FORM_PLANAR_6: (6, [0, 3, 5]),
    api.COVARIANCE_FORM_SPATIAL_10: (10, [0, 4, 7, 9]),
    api.COVARIANCE_FORM_ROS_36: (36, list(range(0, 36, 7)))}


def expanded(columns):
    """The poses of columns, one number after the other."""
    count = columns.pose_count
    size, places = COVARIANCE_PLACES[columns.covariance_form]
    given = len(columns.error_transitions)
    width = next((width for width in (9, 16)
                  if given > 0 and given in (width * count, width * (count - 1))), 0)
    without = count - given // width if width else 0
    stamp = columns.first_stamp.ToNanoseconds()
    for row in range(count):
        pose = api.Pose(sequence=columns.first_sequence + row)
        if columns.HasField("first_stamp"):
            stamp += columns.stamp_step_nanos[row - 1] if row > 0 else 0
            pose.stamp.seconds, pose.stamp.nanos = divmod(stamp, 10**9)
        if columns.x_meters:
            pose.local.x_meters = columns.x_meters[row]
            pose.local.y_meters = columns.y_meters[row]
            pose.local.z_meters = columns.z_meters[row] if columns.z_meters else 0.0
        else:
            pose.geodetic.latitude_degrees = columns.latitude_degrees[row]
            pose.geodetic.longitude_degrees = columns.longitude_degrees[row]
            pose.geodetic.height_meters = (
                columns.height_meters[row] if columns.height_meters else 0.0)
        if columns.quaternions:
            turn = pose.quaternion
            turn.x, turn.y, turn.z, turn.w = columns.quaternions[4 * row:4 * row + 4]
        else:
            pose.heading_radians = columns.heading_radians[row]
        pose.covariance.form = columns.covariance_form
        values = [0.0] * size
        if columns.covariances:
            begin = 0 if len(columns.covariances) == size else row * size
            values = columns.covariances[begin:begin + size]
        else:
            begin = (0 if len(columns.covariance_diagonals) == len(places)
                     else row * len(places))
            for place, one in zip(places, columns.covariance_diagonals[begin:]):
                values[place] = one
        pose.covariance.values.extend(values)
        if width and row >= without:
            begin = (row - without) * width
            pose.error_transition.extend(columns.error_transitions[begin:begin + width])
        if row == 0 and columns.HasField("recording_start"):
            pose.recording_start.CopyFrom(columns.recording_start)
        yield pose


def append(stub, vehicle, poses, **call):
    return stub.AppendPoses(
        api.AppendPosesRequest(vehicle=vehicle, poses=poses), **call).ack


def get(stub, vehicle):
    return stub.GetVehicle(api.GetVehicleRequest(name=vehicle)).vehicle


def list_poses(stub, vehicle, **fields):
    """All stored poses, page by page."""
    request = api.ListPosesRequest(parent=vehicle, page_size=10000, **fields)
    poses = []
    while True:
        page = stub.ListPoses(request)
        poses.extend(page.poses)
        if not page.next_page_token:
            return poses
        request.page_token = page.next_page_token


def as_bytes(messages):
    """Exact content: equal if and only if every number is, to the bit."""
    return [message.SerializeToString(deterministic=True)
            for message in messages]


@dataclasses.dataclass(frozen=True)
class PairKind:
    """Pairs of poses that a verifier has looked at; the kinds have the same
    calls under other names."""

    field: str
    message: str
    collection: str
    add_method: str
    list_method: str
    delete_method: str
    reason: str

    def __str__(self):
        return self.field

    def request(self, parent, query=0, matched=0, pair_id="", **content):
        return getattr(api, f"{self.add_method}Request")(**{
            "parent": parent, f"{self.field}_id": pair_id,
            self.field: getattr(api, self.message)(
                query_sequence=query, matched_sequence=matched, **content)})

    def call_add(self, stub, request):
        return getattr(stub, self.add_method)(request)

    def add(self, stub, parent, *pair, **content):
        """(the stored pair, revision)"""
        answer = self.call_add(stub, self.request(parent, *pair, **content))
        return getattr(answer, self.field), answer.revision

    def page(self, stub, parent, **fields):
        """(the pairs, token of the next page)"""
        answer = getattr(stub, self.list_method)(getattr(
            api, f"{self.list_method}Request")(parent=parent, **fields))
        return list(getattr(answer, f"{self.field}s")), answer.next_page_token

    def delete(self, stub, name):
        return getattr(stub, self.delete_method)(getattr(
            api, f"{self.delete_method}Request")(name=name)).revision

    def count(self, vehicle):
        """How many a vehicle says it has."""
        return (vehicle.loop_closure_count if self is LOOP_CLOSURES
                else vehicle.consistency.rejected_count)


LOOP_CLOSURES = PairKind(
    "loop_closure", "LoopClosure", "loopClosures", "AddLoopClosure",
    "ListLoopClosures", "DeleteLoopClosure", "LOOP_CLOSURE")
REJECTED_CANDIDATES = PairKind(
    "rejected_candidate", "RejectedCandidate", "rejectedCandidates",
    "RejectCandidate", "ListRejectedCandidates", "DeleteRejectedCandidate",
    "REJECTED_CANDIDATE")
PAIR_KINDS = [LOOP_CLOSURES, REJECTED_CANDIDATES]


def deletions_page(stub, parent, **fields):
    """(the pairs that were deleted, token of the next page)"""
    answer = stub.ListDeletedPosePairs(
        api.ListDeletedPosePairsRequest(parent=parent, **fields))
    return list(answer.deleted_pose_pairs), answer.next_page_token


class PoseStream:
    """One StreamPoses call. What is put into it is sent as the server reads."""

    def __init__(self, stub, vehicle=None, timeout=60, metadata=None, **fields):
        self._requests = queue.SimpleQueue()
        self.call = stub.StreamPoses(iter(self._requests.get, None),
                                     timeout=timeout, metadata=metadata)
        if vehicle is not None:
            self.put(api.StreamPosesRequest(
                open=api.StreamPosesOpen(vehicle=vehicle, **fields)))

    def put(self, request):
        self._requests.put(request)

    def send(self, poses):
        self.put(api.StreamPosesRequest(batch=api.PoseBatch(poses=poses)))

    def half_close(self):
        self._requests.put(None)

    def receive(self):
        """The next response as (kind, message); None at the end."""
        response = next(self.call, None)
        if response is None:
            return None
        kind = response.WhichOneof("message")
        return kind, getattr(response, kind)

    def receive_kind(self, kind):
        received = self.receive()
        assert received is not None, f"stream ended before {kind}"
        assert received[0] == kind, received
        return received[1]

    def receive_all(self):
        return list(iter(self.receive, None))

    def cancel(self):
        self.call.cancel()
        self.half_close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.cancel()


@dataclasses.dataclass
class Failure:
    """A status other than OK, with its details taken apart."""

    code: grpc.StatusCode
    message: str
    reason: str
    metadata: dict
    # (field, description) of BadRequest.
    violations: list
    retry_seconds: float
    # Whose quota, by QuotaFailure.
    quota_subjects: list

    @property
    def fields(self):
        return [field for field, _ in self.violations]


def decode_failure(error):
    """Takes an error apart and checks what holds for every one of ours."""
    trailers = dict(error.trailing_metadata())
    assert "grpc-status-details-bin" in trailers, (
        f"no details: {error.code()} {error.details()}")
    status = status_pb2.Status.FromString(trailers["grpc-status-details-bin"])
    assert status.code == error.code().value[0]
    assert status.message == error.details()
    assert status.message, "a status without words"
    kinds = [detail.TypeName() for detail in status.details]
    assert len(kinds) == len(set(kinds)), kinds
    details = {}
    for detail in status.details:
        message = getattr(error_details_pb2, detail.TypeName().split(".")[-1])()
        assert detail.Unpack(message)
        details[detail.TypeName()] = message
    info = details["google.rpc.ErrorInfo"]
    assert info.domain == "revisit"
    assert f"ERROR_REASON_{info.reason}" in api.ErrorReason.keys()
    assert info.metadata["request_id"]
    bad_request = details.get("google.rpc.BadRequest")
    retry = details.get("google.rpc.RetryInfo")
    quota = details.get("google.rpc.QuotaFailure")
    may_retry = error.code() in (grpc.StatusCode.UNAVAILABLE,
                                 grpc.StatusCode.RESOURCE_EXHAUSTED)
    assert (retry is not None) == may_retry, kinds
    return Failure(
        code=error.code(), message=error.details(), reason=info.reason,
        metadata=dict(info.metadata),
        violations=[(violation.field, violation.description)
                    for violation in bad_request.field_violations]
        if bad_request else [],
        retry_seconds=retry.retry_delay.ToTimedelta().total_seconds()
        if retry else None,
        quota_subjects=[violation.subject for violation in quota.violations]
        if quota else [])


def served_again(call, seconds=30):
    """What a call answers whose channel has just lost its connection: gRPC may
    begin it on the one that is dying, and then fails it with UNAVAILABLE, which
    callers are to try again. What the server itself answers is not repeated."""
    deadline = time.monotonic() + seconds
    while True:
        try:
            return call()
        except grpc.RpcError as error:
            if (error.code() != grpc.StatusCode.UNAVAILABLE
                    or "grpc-status-details-bin" in dict(
                        error.trailing_metadata() or ())
                    or time.monotonic() > deadline):
                raise


def failure_of(call):
    """The failure of a call that must fail."""
    with pytest.raises(grpc.RpcError) as raised:
        call()
    return decode_failure(raised.value)
