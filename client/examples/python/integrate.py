"""Streams a drive to revisit, prints where the vehicle has been before, and confirms
one of these places.

usage: integrate.py ADDRESS FILE VEHICLE_ID
"""

import asyncio
import contextlib
import csv
import math
import random
import sys

import grpc
from google.rpc import error_details_pb2
from grpc_status import rpc_status
from revisit.v1 import (
    candidate_pb2, geometry_pb2, loop_closure_pb2, pose_columns_pb2)
from revisit.v1 import pose_graph_service_pb2 as api
from revisit.v1.pose_graph_service_pb2_grpc import PoseGraphServiceStub

BATCH = 64
ATTEMPTS = 10
COVARIANCE = ("pxx", "pxy", "pxt", "pyy", "pyt", "ptt")
# A connection whose other end has vanished is noticed after half a minute.
CHANNEL = (("grpc.keepalive_time_ms", 20_000),
           ("grpc.keepalive_timeout_ms", 10_000),
           ("grpc.min_reconnect_backoff_ms", 100),
           ("grpc.max_reconnect_backoff_ms", 2_000))


def read_drive(path):
    """The poses of a drive, which number from 1 in the order of the file."""
    with open(path, newline="") as file:
        return [make_pose(sequence, row)
                for sequence, row in enumerate(csv.DictReader(file), start=1)]


def make_pose(sequence, row):
    seconds = float(row["t_s"])
    pose = geometry_pb2.Pose(
        sequence=sequence, heading_radians=float(row["est_yaw"]),
        local=geometry_pb2.LocalPosition(x_meters=float(row["est_x"]),
                                         y_meters=float(row["est_y"])),
        covariance=geometry_pb2.Covariance(
            form=geometry_pb2.COVARIANCE_FORM_PLANAR_6,
            values=[float(row[name]) for name in COVARIANCE]))
    pose.stamp.seconds = math.floor(seconds)
    pose.stamp.nanos = round((seconds - math.floor(seconds)) * 1e9)
    return pose


def columns_of(poses):
    """The poses as columns, which take less to send and to read. All poses of this
    drive have the same fields, or they would be messages."""
    stamps = [pose.stamp.ToNanoseconds() for pose in poses]
    return pose_columns_pb2.PoseColumns(
        first_sequence=poses[0].sequence, pose_count=len(poses),
        first_stamp=poses[0].stamp,
        stamp_step_nanos=[after - before for before, after in zip(stamps, stamps[1:])],
        x_meters=[pose.local.x_meters for pose in poses],
        y_meters=[pose.local.y_meters for pose in poses],
        heading_radians=[pose.heading_radians for pose in poses],
        covariance_form=geometry_pb2.COVARIANCE_FORM_PLANAR_6,
        covariances=[value for pose in poses for value in pose.covariance.values])


def batch_of(poses, takes_columns):
    # Servers that know no columns take the same poses as messages.
    return (api.PoseBatch(columns=columns_of(poses)) if takes_columns
            else api.PoseBatch(poses=poses))


def details_of(error):
    """Details of an error: the first of each type by its bare name."""
    status = rpc_status.from_call(error)
    found = {}
    for detail in status.details if status else ():
        name = detail.type_url.rpartition(".")[2]
        message = getattr(error_details_pb2, name, lambda: None)()
        if message is not None and detail.Unpack(message):
            found.setdefault(name, message)
    return found


def seconds_before_retry(error, attempt):
    """Seconds to wait before the stream is opened again, or None if that is of
    no use."""
    details = details_of(error)
    if attempt > ATTEMPTS:
        return None
    if "RetryInfo" in details:
        return details["RetryInfo"].retry_delay.ToTimedelta().total_seconds()
    lost = (error.code() == grpc.StatusCode.UNAVAILABLE
            or (error.code() == grpc.StatusCode.INTERNAL
                and "ErrorInfo" not in details))
    return min(2.0, 0.1 * 2**attempt) * random.uniform(0.5, 1) if lost else None


async def send(call, poses, takes_columns):
    """Sends the poses, no faster than the server reads them."""
    # The error of the call is that of its answers.
    with contextlib.suppress(grpc.RpcError, asyncio.InvalidStateError):
        for first in range(0, len(poses), BATCH):
            await call.write(api.StreamPosesRequest(
                batch=batch_of(poses[first:first + BATCH], takes_columns)))
        await call.done_writing()


async def answers(stub, opening, poses):
    """One stream: sends what is not durable yet while it yields the answers."""
    call = stub.StreamPoses()
    sender = None
    try:
        await call.write(api.StreamPosesRequest(open=opening))
        while (answer := await call.read()) is not grpc.aio.EOF:
            if answer.HasField("opened"):
                sender = asyncio.create_task(
                    send(call, poses[answer.opened.durable_sequence:],
                         answer.opened.takes_pose_columns))
            yield answer
    finally:
        if sender is not None:
            sender.cancel()
        call.cancel()


async def stream(stub, vehicle, poses):
    """Streams the poses until all are durable, over as many connections as it
    takes; returns the accepted candidates that came."""
    accepted, attempt = [], 0
    # Whoever outlives this program keeps these two, beside the poses.
    opening = api.StreamPosesOpen(vehicle=vehicle.name, vehicle_uid=vehicle.uid,
                                  acked_sequence=0, send_candidates=True)
    while True:
        try:
            async for answer in answers(stub, opening, poses):
                if answer.HasField("opened"):
                    opening.acked_sequence = answer.opened.durable_sequence
                    print(f"stream: open, durable up to {opening.acked_sequence}")
                elif answer.HasField("ack"):
                    opening.acked_sequence = answer.ack.durable_sequence
                    attempt = 0
                else:
                    accepted += report(answer.candidates.candidates)
            return accepted
        except grpc.aio.AioRpcError as error:
            attempt += 1
            seconds = seconds_before_retry(error, attempt)
            if seconds is None:
                raise
            print(f"stream: lost at {opening.acked_sequence} "
                  f"({error.code().name}), again in {seconds:.1f} s")
            await asyncio.sleep(seconds)


def report(candidates):
    """Prints candidates that are worth a verifier's look, and returns them."""
    accepted = [candidate for candidate in candidates
                if candidate.verdict == candidate_pb2.VERDICT_ACCEPTED]
    for candidate in accepted:
        print(f"candidate: {place(candidate.query)} is {place(candidate.matched)}"
              f", probability {candidate.probability:.3f}")
    return accepted


def place(node):
    return f"{node.sequence} at {node.stamp.ToJsonString()}"


async def confirm(stub, vehicle, accepted):
    """Says of the most probable candidate that it is the same place, as a verifier
    would after it compared images or scans."""
    best = max(accepted, key=lambda candidate: candidate.probability)
    response = await stub.AddLoopClosure(api.AddLoopClosureRequest(
        parent=vehicle.name, loop_closure=loop_closure_pb2.LoopClosure(
            query_sequence=best.query.sequence,
            matched_sequence=best.matched.sequence)))
    print(f"confirmed: {response.loop_closure.name}")


async def show_error(stub, vehicle, pose):
    """Sends a pose with a variance below 0, which is refused and changes nothing,
    and prints all that the error says."""
    pose.sequence += 1
    pose.covariance.values[0] = -1
    try:
        await stub.AppendPoses(api.AppendPosesRequest(
            vehicle=vehicle.name, vehicle_uid=vehicle.uid, poses=[pose]))
    except grpc.aio.AioRpcError as error:
        details = details_of(error)
        info = details["ErrorInfo"]
        print(f"refused: {error.code().name}, reason {info.reason} of "
              f"{info.domain}, request {info.metadata['request_id']}: "
              f"{error.details()}")
        for violation in details["BadRequest"].field_violations:
            print(f"  {violation.field}: {violation.description}")


async def main(address, path, vehicle_id):
    poses = read_drive(path)
    async with grpc.aio.insecure_channel(address, options=CHANNEL) as channel:
        stub = PoseGraphServiceStub(channel)
        vehicle = (await stub.CreateVehicle(api.CreateVehicleRequest(
            vehicle_id=vehicle_id))).vehicle
        print(f"vehicle: {vehicle.name}, uid {vehicle.uid}")
        accepted = await stream(stub, vehicle, poses)
        print(f"durable: all {len(poses)} poses")
        if accepted:
            await confirm(stub, vehicle, accepted)
        await show_error(stub, vehicle, poses[-1])


if __name__ == "__main__":
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    asyncio.run(main(*sys.argv[1:]))
