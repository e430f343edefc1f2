"""A service whose watch breaks in the ways that a client has to get over."""

import concurrent.futures
import contextlib
import importlib
import time

import grpc
from google.protobuf import any_pb2
from google.rpc import error_details_pb2, status_pb2

from stubs import api

check = importlib.import_module("revisit.v1.check_pb2")
service = importlib.import_module("revisit.v1.pose_graph_service_pb2_grpc")

NAME = "vehicles/shuttle-1/checks/{0}0/candidates/1"
#: How what a client prints begins, line by line.
LINES = [
    f"listed: {NAME.format(1)} OPEN", f"listed: {NAME.format(2)} OPEN",
    f"event: 3 {NAME.format(3)} OPEN", f"event: 4 {NAME.format(4)} OPEN",
    "watch: lost (UNAVAILABLE)", "watch: lost (SLOW_CONSUMER)",
    f"event: 5 {NAME.format(5)} OPEN", "watch: lost (UNAVAILABLE)",
    "watch: lost (CURSOR_TOO_OLD)",
    f"listed: {NAME.format(1)} OPEN", f"listed: {NAME.format(2)} OPEN",
    "event: 6 vehicles/shuttle-1 DELETED",
]
#: Where its watches go on.
CURSORS = ["listed", "after-4", "after-4", "after-5", "listed"]


def _end(context, code, reason):
    status = status_pb2.Status(code=code.value[0], message=reason)
    packed = any_pb2.Any()
    packed.Pack(error_details_pb2.ErrorInfo(reason=reason, domain="revisit"))
    status.details.append(packed)
    context.set_trailing_metadata(
        (("grpc-status-details-bin", status.SerializeToString()),))
    context.abort(code, reason)


def _event(number):
    return api.WatchCandidatesResponse(
        cursor=f"after-{number}", candidate=check.CandidateEvent(
            number=number, vehicle_uid="uid", check=NAME.format(number)[:-13],
            candidate=check.CheckCandidate(name=NAME.format(number), state=1)))


class WatchService(service.PoseGraphServiceServicer):
    def __init__(self):
        self.cursors = []

    def ListChecks(self, request, context):
        number = int(request.page_token or 1)
        name = NAME.format(number)
        return api.ListChecksResponse(
            checks=[check.Check(name=name[:-13], states=[
                check.CheckCandidate(name=name, state=1)])],
            next_page_token="2" if number == 1 else "",
            watch_cursor="listed" if number == 1 else "")

    def WatchCandidates(self, request, context):
        self.cursors.append(request.cursor)
        count = len(self.cursors)
        if count == 4:
            _end(context, grpc.StatusCode.OUT_OF_RANGE, "CURSOR_TOO_OLD")
        yield api.WatchCandidatesResponse(cursor=request.cursor,
                                          beat=check.WatchBeat())
        if count == 1:
            yield _event(3)
            yield _event(4)
            context.abort(grpc.StatusCode.UNAVAILABLE, "as the test says")
        elif count == 2:
            _end(context, grpc.StatusCode.RESOURCE_EXHAUSTED, "SLOW_CONSUMER")
        elif count == 3:
            # A client prints once what comes twice.
            yield _event(4)
            yield _event(5)
            context.abort(grpc.StatusCode.UNAVAILABLE, "as the test says")
        yield api.WatchCandidatesResponse(
            cursor="after-6", vehicle_deleted=check.VehicleDeleted(
                vehicle="vehicles/shuttle-1", vehicle_uid="uid", number=6))
        while context.is_active():
            time.sleep(0.01)


@contextlib.contextmanager
def serving(fake):
    """Yields the address."""
    server = grpc.server(concurrent.futures.ThreadPoolExecutor(4))
    service.add_PoseGraphServiceServicer_to_server(fake, server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    try:
        yield f"127.0.0.1:{port}"
    finally:
        server.stop(0).wait()
