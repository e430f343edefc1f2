"""Prints what becomes of stored candidates, and goes on where it was after whatever
broke, this program too.

usage: watch.py ADDRESS CURSOR_FILE
"""

import asyncio
import os
import pathlib
import sys

import grpc
from integrate import CHANNEL, details_of, seconds_before_retry
from revisit.v1 import check_pb2
from revisit.v1 import pose_graph_service_pb2 as api
from revisit.v1.pose_graph_service_pb2_grpc import PoseGraphServiceStub


def keep(path, cursor):
    """Replaces the file, so that it is never without a cursor."""
    partial = path.with_name(path.name + ".partial")
    with open(partial, "w") as file:
        file.write(cursor)
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, path)


async def list_all(stub):
    """Prints what is stored; returns where a watch goes on."""
    request, cursor = api.ListChecksRequest(parent="vehicles/-"), ""
    while True:
        page = await stub.ListChecks(request)
        cursor = cursor or page.watch_cursor
        for check in page.checks:
            for candidate in check.states:
                print(f"listed: {text_of(candidate)}")
        if not page.next_page_token:
            return cursor
        request.page_token = page.next_page_token


def text_of(candidate):
    state = check_pb2.CandidateState.Name(candidate.state)
    return f"{candidate.name} {state.removeprefix('CANDIDATE_STATE_')}"


def report(answer):
    """This is where a verifier works. What it does comes to the same if done twice: an
    event comes again if the program ends before its cursor is kept."""
    if answer.HasField("candidate"):
        event = answer.candidate
        print(f"event: {event.number} {text_of(event.candidate)}", flush=True)
    elif answer.HasField("vehicle_deleted"):
        event = answer.vehicle_deleted
        print(f"event: {event.number} {event.vehicle} DELETED", flush=True)


async def watch(stub, path):
    # By uid of the vehicle: the number of its last event that was worked off.
    told = {}
    attempt = 0
    while True:
        try:
            if not path.exists():
                # The events of a store that was restored from a backup have lower
                # numbers.
                told.clear()
                keep(path, await list_all(stub))
            request = api.WatchCandidatesRequest(cursor=path.read_text())
            async for answer in stub.WatchCandidates(request):
                # Of a beat, an empty one.
                event = (answer.candidate if answer.HasField("candidate")
                         else answer.vehicle_deleted)
                if event.number > told.get(event.vehicle_uid, 0):
                    report(answer)
                    told[event.vehicle_uid] = event.number
                keep(path, answer.cursor)
                attempt = 0
        except grpc.aio.AioRpcError as error:
            info = details_of(error).get("ErrorInfo")
            reason = info.reason if info else ""
            attempt += 1
            seconds = seconds_before_retry(error, attempt)
            if reason in ("CURSOR_TOO_OLD", "CURSOR_UNKNOWN"):
                path.unlink()
                seconds = 0.1
            elif reason == "SLOW_CONSUMER":
                seconds = 0.1
            if seconds is None:
                raise
            print(f"watch: lost ({reason or error.code().name}), again in "
                  f"{seconds:.1f} s", flush=True)
            await asyncio.sleep(seconds)


async def main(address, path):
    async with grpc.aio.insecure_channel(address, options=CHANNEL) as channel:
        await watch(PoseGraphServiceStub(channel), pathlib.Path(path))


if __name__ == "__main__":
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    asyncio.run(main(*sys.argv[1:]))
