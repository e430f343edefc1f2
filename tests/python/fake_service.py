"""A service that answers as a test says: for what a real one does rarely."""

import concurrent.futures
import contextlib

import grpc
from google.protobuf import any_pb2, duration_pb2
from google.rpc import error_details_pb2, status_pb2

from revisit import v1
from revisit.v1 import pose_graph_service_pb2_grpc as service


class Fault(Exception):
    """A status that the service ends a call with."""

    def __init__(self, code, message="as the test says", reason="", retry=None,
                 metadata=(("limit", "7"),)):
        super().__init__(message)
        self.code, self.message, self.reason, self.retry = (code, message, reason,
                                                            retry)
        self.metadata = dict(metadata)

    def end(self, context):
        details = []
        if self.reason:
            details.append(error_details_pb2.ErrorInfo(
                reason=self.reason, domain="revisit", metadata=self.metadata))
        if isinstance(self.retry, duration_pb2.Duration):
            details.append(error_details_pb2.RetryInfo(retry_delay=self.retry))
        elif self.retry is not None:
            details.append(error_details_pb2.RetryInfo(
                retry_delay=duration_pb2.Duration(
                    seconds=int(self.retry), nanos=int(self.retry % 1 * 1e9))))
        if details:
            status = status_pb2.Status(code=self.code.value[0], message=self.message)
            for detail in details:
                packed = any_pb2.Any()
                packed.Pack(detail)
                status.details.append(packed)
            context.set_trailing_metadata(
                (("grpc-status-details-bin", status.SerializeToString()),))
        context.abort(self.code, self.message)


class FakeService(service.PoseGraphServiceServicer):
    """Ends as many calls with faults as it is given, then answers well. A stream
    opens first, then meets its fault at the first batch."""

    def __init__(self, *faults):
        self.faults = list(faults)
        #: What is on the page of a token, and the token of the next one.
        self.pages = lambda token: ([], "")
        self.metadata = []
        self.opens = []
        self.stored = []
        self.calls = 0

    def _meet(self, context):
        if self.faults:
            self.faults.pop(0).end(context)

    def _note(self, context):
        self.calls += 1
        self.metadata.append(dict(context.invocation_metadata()))

    def GetVehicle(self, request, context):
        self._note(context)
        self._meet(context)
        return v1.GetVehicleResponse(vehicle=v1.Vehicle(name=request.name))

    def ListVehicles(self, request, context):
        self._note(context)
        vehicles, token = self.pages(request.page_token)
        return v1.ListVehiclesResponse(
            vehicles=[v1.Vehicle(name=name) for name in vehicles],
            next_page_token=token)

    def ListPoses(self, request, context):
        self._note(context)
        sequences, token = self.pages(request.page_token)
        return v1.ListPosesResponse(
            poses=[v1.Pose(sequence=sequence) for sequence in sequences],
            next_page_token=token)

    def DeleteVehicle(self, request, context):
        self._note(context)
        self._meet(context)
        return v1.DeleteVehicleResponse()

    def RevisePoses(self, requests, context):
        self._note(context)
        revised = [pose.sequence for request in requests for pose in request.poses]
        self._meet(context)
        return v1.RevisePosesResponse(revised_count=len(revised))

    def StreamPoses(self, requests, context):
        self._note(context)
        self.opens.append(next(requests).open)
        yield v1.StreamPosesResponse(opened=v1.StreamPosesOpened(
            durable_sequence=len(self.stored), max_batch_poses=4, vehicle_uid="one"))
        for request in requests:
            self._meet(context)
            assert len(request.batch.poses) <= 4
            self.stored += [pose.sequence for pose in request.batch.poses]
            yield v1.StreamPosesResponse(ack=v1.Ack(
                durable_sequence=len(self.stored)))


@contextlib.contextmanager
def serving(fake):
    """Yields the address."""
    server = grpc.server(concurrent.futures.ThreadPoolExecutor(8))
    service.add_PoseGraphServiceServicer_to_server(fake, server)
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    try:
        yield f"127.0.0.1:{port}"
    finally:
        server.stop(0).wait()
