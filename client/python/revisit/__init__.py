"""Client of revisit, which tells a vehicle where it has probably been before.

    with revisit.serve() as client:         # or revisit.Client("127.0.0.1:50051")
        client.create_vehicle("shuttle-7")
        options = revisit.StreamOptions(send_candidates=True)
        with client.stream_poses("shuttle-7", options) as stream:
            stream.append(revisit.Poses.local(x, y, heading, covariance))
            stream.finish()
            found = revisit.candidate_table(stream.take_candidates())

`revisit.aio` has the same for asyncio, `revisit.v1` the messages of the API.
"""

from revisit import aio, v1
from revisit._calls import evidence_of
from revisit._group_calls import datum
from revisit._server_process import ServerEnded
from revisit._version import __version__
from revisit.arrays import Poses
from revisit.backoff import BackoffOptions
from revisit.client import Client
from revisit.cursor_file import CursorFile
from revisit.errors import (
    Aborted,
    AlreadyExists,
    Cancelled,
    DataLoss,
    DeadlineExceeded,
    Error,
    FailedPrecondition,
    FieldViolation,
    Internal,
    InvalidArgument,
    NotFound,
    OutOfRange,
    PermissionDenied,
    QuotaViolation,
    ResourceExhausted,
    Unauthenticated,
    Unavailable,
    Unimplemented,
    VehicleReplaced,
)
from revisit.maps import Map
from revisit.pose_stream import PoseStream
from revisit.recording_starts import recording_start
from revisit.recordings import (
    RecordingError,
    iter_recording,
    read_recording,
    shipped_drive,
)
from revisit.serving import ServedClient, serve
from revisit.stream_options import ProgressBar, StreamCallbacks, StreamOptions
from revisit.tables import (
    PoseGraph,
    Table,
    candidate_table,
    check_table,
    edge_table,
    node_table,
    recording_table,
)
from revisit.watch import CheckList, Watch, WatchEvent

__all__ = [
    "Aborted", "AlreadyExists", "BackoffOptions", "Cancelled", "CheckList",
    "Client", "CursorFile", "DataLoss", "DeadlineExceeded", "Error",
    "FailedPrecondition", "FieldViolation", "Internal", "InvalidArgument",
    "Map", "NotFound", "OutOfRange", "PermissionDenied", "PoseGraph",
    "PoseStream", "Poses", "ProgressBar", "QuotaViolation", "RecordingError",
    "ResourceExhausted", "ServedClient", "ServerEnded", "StreamCallbacks",
    "StreamOptions", "Table", "Unauthenticated", "Unavailable", "Unimplemented",
    "VehicleReplaced", "Watch", "WatchEvent", "__version__", "aio",
    "candidate_table", "check_table", "datum", "edge_table", "evidence_of",
    "iter_recording", "node_table", "read_recording", "recording_start",
    "recording_table", "serve", "shipped_drive", "v1",
]
