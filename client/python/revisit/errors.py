"""Errors of the service, with what they say to programs.

Every failure of a call or a stream is an `Error`; its subclasses stand for the
codes of gRPC, so that `except revisit.NotFound` does what it looks like. What
the server says beyond the code (google.rpc details) is in the attributes. A
request that failed has changed nothing on the server.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any, Callable, Optional

import grpc
from google.protobuf.message import DecodeError
from google.rpc import error_details_pb2, status_pb2

from revisit._text import printable

#: The longest wait, in seconds, that is taken over from a server. One that asks for
#: more, by mistake or malice, is asked again after so long.
LONGEST_RETRY_DELAY = 300.0

_DETAILS_KEY = "grpc-status-details-bin"


@dataclasses.dataclass(frozen=True)
class FieldViolation:
    """One field of the request that is wrong."""

    #: Path below the request, such as "poses[3].covariance".
    field: str
    #: The value that was got, and the allowed ones.
    description: str
    #: Pose.sequence of the pose that has the field, in a batch of poses; of what all
    #: poses of a batch have in common, that of the first. None of other fields. A
    #: stream makes batches of its own, so their places say little to its caller.
    sequence: Optional[int] = None


@dataclasses.dataclass(frozen=True)
class QuotaViolation:
    """A limit that was reached."""

    #: Whose limit it is.
    subject: str
    description: str


class Error(Exception):
    """A call or a stream that failed."""

    #: The status code of gRPC that the class stands for.
    code: grpc.StatusCode = grpc.StatusCode.UNKNOWN
    #: The server's message.
    message: str
    #: A value of revisit.v1.ErrorReason without its prefix, such as
    #: "SEQUENCE_GAP". Empty if the error comes from the transport or from this
    #: package.
    reason: str
    #: "revisit" if `reason` is the service's.
    domain: str
    #: The numbers that the message names, and "request_id".
    metadata: Mapping[str, str]
    #: Every field that is wrong.
    field_violations: tuple[FieldViolation, ...]
    quota_violations: tuple[QuotaViolation, ...]
    #: How many seconds to wait at least before trying again, between 0 and
    #: LONGEST_RETRY_DELAY; None where the server says nothing of it.
    retry_delay: Optional[float]
    #: Names the call in the server's log. Empty if it is not known.
    request_id: str

    def __init__(self, message: str, *, reason: str = "", domain: str = "",
                 metadata: Optional[Mapping[str, str]] = None,
                 field_violations: tuple[FieldViolation, ...] = (),
                 quota_violations: tuple[QuotaViolation, ...] = (),
                 retry_delay: Optional[float] = None, request_id: str = "",
                 code: Optional[grpc.StatusCode] = None) -> None:
        super().__init__(message)
        self.message = message
        self.reason = reason
        self.domain = domain
        self.metadata = dict(metadata or {})
        self.field_violations = field_violations
        self.quota_violations = quota_violations
        self.retry_delay = retry_delay
        self.request_id = self.metadata.get("request_id", request_id)
        if code is not None:
            self.code = code

    def __str__(self) -> str:
        """Fit for a terminal: a control character or an invisible one in what the
        server said is shown by its number, "<U+001B>"."""
        text = self.code.name
        if self.reason:
            text += f" ({printable(self.reason)})"
        text += f": {printable(self.message)}"
        for violation in self.field_violations:
            line = f"{violation.field}: {violation.description}"
            if violation.sequence is not None:
                line += f" (pose of sequence {violation.sequence})"
            line = printable(line)
            # The server's messages contain the first violation themselves.
            if line not in text:
                text += f"\n  {line}"
        return text


class Cancelled(Error):
    """The caller gave up, or the connection was cut."""

    code = grpc.StatusCode.CANCELLED


class InvalidArgument(Error):
    """The request is malformed; `field_violations` list what is wrong with it."""

    code = grpc.StatusCode.INVALID_ARGUMENT


class DeadlineExceeded(Error):
    """The time for the call was over before its answer came."""

    code = grpc.StatusCode.DEADLINE_EXCEEDED


class NotFound(Error):
    """There is no such thing, or the caller may not know of it."""

    code = grpc.StatusCode.NOT_FOUND


class AlreadyExists(Error):
    """Something of this name, or a pose of this sequence, has other content."""

    code = grpc.StatusCode.ALREADY_EXISTS


class PermissionDenied(Error):
    """The caller is known, but may not do this."""

    code = grpc.StatusCode.PERMISSION_DENIED


class ResourceExhausted(Error):
    """A limit was reached; `quota_violations` may say whose."""

    code = grpc.StatusCode.RESOURCE_EXHAUSTED


class FailedPrecondition(Error):
    """The vehicle or the stream is not in a state in which this can be done."""

    code = grpc.StatusCode.FAILED_PRECONDITION


class VehicleReplaced(FailedPrecondition):
    """The vehicle was deleted and made again: it has another uid by now, and
    what was acknowledged belongs to the one before."""


class Aborted(Error):
    """Something else changed the vehicle meanwhile."""

    code = grpc.StatusCode.ABORTED


class OutOfRange(Error):
    """The call asks for more work than the server allows for one call, or for what is
    not kept any more."""

    code = grpc.StatusCode.OUT_OF_RANGE


class Unimplemented(Error):
    """The server does not know the call."""

    code = grpc.StatusCode.UNIMPLEMENTED


class Internal(Error):
    """A defect of the server or, without a reason, a stream that was reset."""

    code = grpc.StatusCode.INTERNAL


class Unavailable(Error):
    """The server cannot be reached, or does not take calls at the moment."""

    code = grpc.StatusCode.UNAVAILABLE


class DataLoss(Error):
    """The server has less than it acknowledged, or damaged data."""

    code = grpc.StatusCode.DATA_LOSS


class Unauthenticated(Error):
    """The server does not know who calls."""

    code = grpc.StatusCode.UNAUTHENTICATED


_CLASSES: dict[grpc.StatusCode, type[Error]] = {
    made.code: made for made in Error.__subclasses__()}
_CLASSES_BY_REASON: dict[str, type[Error]] = {
    "VEHICLE_REPLACED": VehicleReplaced}


def error_class(code: grpc.StatusCode, reason: str) -> type[Error]:
    """The class that stands for a code and a reason."""
    return _CLASSES_BY_REASON.get(reason, _CLASSES.get(code, Error))


def _details(trailers: Any) -> status_pb2.Status:
    for key, value in trailers or ():
        if key == _DETAILS_KEY:
            try:
                return status_pb2.Status.FromString(value)
            except DecodeError:
                break
    return status_pb2.Status()


def from_rpc_error(error: Any, request_id: str = "") -> Error:
    """The `Error` that a grpc.RpcError of a call stands for."""
    found: dict[str, Any] = {"request_id": request_id}
    info = error_details_pb2.ErrorInfo()
    bad = error_details_pb2.BadRequest()
    quota = error_details_pb2.QuotaFailure()
    retry = error_details_pb2.RetryInfo()
    for detail in _details(error.trailing_metadata()).details:
        if detail.Unpack(info):
            found.update(reason=info.reason, domain=info.domain,
                         metadata=info.metadata)
        elif detail.Unpack(bad):
            found["field_violations"] = tuple(
                FieldViolation(one.field, one.description)
                for one in bad.field_violations)
        elif detail.Unpack(quota):
            found["quota_violations"] = tuple(
                QuotaViolation(one.subject, one.description)
                for one in quota.violations)
        elif detail.Unpack(retry) and retry.HasField("retry_delay"):
            asked = retry.retry_delay.seconds + retry.retry_delay.nanos * 1e-9
            found["retry_delay"] = min(max(asked, 0.0), LONGEST_RETRY_DELAY)
    code = error.code()
    made = error_class(code, found.get("reason", ""))
    return made(error.details() or "", code=code, **found)


def located(error: Error, sequence_of: Callable[[str], Optional[int]]) -> Error:
    """The error, whose field violations have the sequences of their poses."""
    error.field_violations = tuple(
        dataclasses.replace(one, sequence=sequence_of(one.field))
        for one in error.field_violations)
    return error


def is_cut(error: Error) -> bool:
    """Whether a call that nobody here cancelled was cut on its way, so that nobody
    said how it ended; what the server says itself has a reason. gRPC answers
    CANCELLED to calls that come in the moment between the last refusal of a server
    that shuts down and the end of its connection, and INTERNAL to calls that gRPC or
    a proxy reset (RST_STREAM), as Envoy does to a stream when the server behind it
    dies."""
    return isinstance(error, (Cancelled, Internal)) and not error.reason


def was_elsewhere(error: Error) -> bool:
    """Whether the server says that it has changed nothing because the vehicle is, or
    was meanwhile, another server's: then also a call that must not be done twice may
    be made again."""
    return error.reason in ("NOT_OWNER", "EPOCH_FENCED")


def lost_to_others(error: Error) -> bool:
    """Whether a change of a group was not made because others changed it at the same
    time: where no revision was expected, it may be made again."""
    return error.reason == "REVISION_MISMATCH"


def reads_histories(error: Error) -> bool:
    """Whether a search in a group was not made because the server still reads histories
    of its members: it goes on with that meanwhile."""
    return error.reason == "GROUP_NOT_READY"
