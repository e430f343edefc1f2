"""Connections to a server: TLS, tokens, request ids."""

from __future__ import annotations

import base64
import contextlib
import dataclasses
import os
import pathlib
import re
import ssl
import threading
import uuid
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Optional, Union

import grpc

from revisit._arguments import instance, text
from revisit.errors import (
    Cancelled, DeadlineExceeded, Error, Unauthenticated, Unavailable, is_cut)
from revisit.v1 import pose_graph_service_pb2_grpc as service

if TYPE_CHECKING:
    from revisit._server_process import ServerProcess

PathLike = Union[str, "os.PathLike[str]"]
Metadata = tuple[tuple[str, str], ...]

ARGUMENTS = (
    ("grpc.max_receive_message_length", 64 << 20),
    # Channels that share a connection would share its back-off too.
    ("grpc.use_local_subchannel_pool", 1),
)


@dataclasses.dataclass(frozen=True)
class ChannelOptions:
    """Where the server is, and how the client shows who it is."""

    #: A gRPC target such as "127.0.0.1:50051" or "unix:/run/revisit.sock".
    address: str
    #: File (PEM) of the authorities that may have issued the server's
    #: certificate. If None, the channel is in plaintext.
    tls_authorities: Optional[PathLike] = None
    #: Files (PEM) of the client's own certificate, with those that issued it,
    #: and its key, which must not be encrypted. Read once.
    tls_certificate: Optional[PathLike] = None
    tls_key: Optional[PathLike] = None
    #: File with a bearer token; white space around it is ignored. It is read
    #: again for each call and each connection of a stream, so that a renewed
    #: token takes effect once it replaces the file. In plaintext a token is sent
    #: to this machine only: calls to other addresses fail.
    token_file: Optional[PathLike] = None

    def __post_init__(self) -> None:
        if not text("address", self.address, 'a string such as "127.0.0.1:50051"'):
            raise ValueError("address is empty: expected one such as "
                             '"127.0.0.1:50051"')
        for name in ("tls_authorities", "tls_certificate", "tls_key", "token_file"):
            instance(name, getattr(self, name), (str, os.PathLike, type(None)),
                     "the path of a file")


def _read_token(path: PathLike) -> str:
    token = pathlib.Path(path).read_text(encoding="latin-1").strip()
    if not re.fullmatch(r"[!-~]+", token):
        raise ValueError(f"{os.fspath(path)} holds no token")
    return token


def _check_tls(options: ChannelOptions) -> None:
    """Finds faults of the files that gRPC would only report as "unreachable"."""
    assert options.tls_authorities is not None
    for path in (options.tls_authorities, options.tls_certificate, options.tls_key):
        # Unlike ssl, it names the file that cannot be read.
        _read(path)
    try:
        context = ssl.create_default_context(
            cafile=os.fspath(options.tls_authorities))
    except ssl.SSLError as error:
        raise ValueError(f"{os.fspath(options.tls_authorities)} holds no "
                         f"certificate: {error}") from error
    if options.tls_certificate is None or options.tls_key is None:
        return
    try:
        # An encrypted key would be asked for at the terminal.
        context.load_cert_chain(os.fspath(options.tls_certificate),
                                os.fspath(options.tls_key), password="")
    except (ssl.SSLError, ValueError) as error:
        raise ValueError(
            f"{os.fspath(options.tls_certificate)} and "
            f"{os.fspath(options.tls_key)} are no certificate and its own, "
            f"unencrypted private key: {error}") from error


def _read(path: Optional[PathLike]) -> Optional[bytes]:
    return None if path is None else pathlib.Path(path).read_bytes()


def _credentials(options: ChannelOptions) -> Optional[grpc.ChannelCredentials]:
    """None for plaintext."""
    if (options.tls_certificate is None) != (options.tls_key is None):
        raise ValueError("a client certificate and its key are needed together: "
                         "tls_certificate and tls_key")
    if options.tls_authorities is None and options.tls_certificate is not None:
        raise ValueError("a client certificate needs TLS: name the file of who may "
                         "have issued the server's certificate in tls_authorities")
    if options.token_file is not None:
        # Read once here, so that a mistake shows at once.
        _read_token(options.token_file)
    if options.tls_authorities is not None:
        _check_tls(options)
        return grpc.ssl_channel_credentials(
            _read(options.tls_authorities), _read(options.tls_key),
            _read(options.tls_certificate))
    if options.token_file is not None:
        # Such a channel connects within this machine only.
        return grpc.local_channel_credentials(
            grpc.LocalConnectionType.UDS if options.address.startswith("unix")
            else grpc.LocalConnectionType.LOCAL_TCP)
    return None


def stub_of(channel: Any) -> Any:
    """The service, for which the generator of gRPC writes no types."""
    return service.PoseGraphServiceStub(channel)  # type: ignore[no-untyped-call]


#: How much later than its connections a server may end, in seconds.
END_SECONDS = 1.0


class Lease:
    """A channel that is not closed as long as it is used. Counted by the lock of
    the `Channels` that it comes from."""

    def __init__(self, channel: Any) -> None:
        self.channel = channel
        self.users = 0
        self.is_retired = False


class Channels:
    """The channel to a server, which is made anew after it has failed: the back-off of
    gRPC would keep the old one from a server that is back for seconds more.
    Thread-safe."""

    #: The server, where this process runs it: once it has ended, no call is made.
    server: Optional[ServerProcess] = None

    def __init__(self, options: ChannelOptions) -> None:
        """OSError if a file cannot be read; ValueError if one holds something else,
        or if certificate and key do not belong together or do not come together
        and with authorities. Connects on first use."""
        self.options = options
        self._made_of = _credentials(options)
        self._lock = threading.Lock()
        self._closed = False
        self._leases: list[Lease] = []
        self._newest: Optional[Lease] = None

    def _open(self, credentials: Optional[grpc.ChannelCredentials]) -> Any:
        if credentials is None:
            return grpc.insecure_channel(self.options.address, options=ARGUMENTS)
        return grpc.secure_channel(self.options.address, credentials,
                                   options=ARGUMENTS)

    def _close_channel(self, channel: Any) -> None:
        channel.close()

    @property
    def is_closed(self) -> bool:
        return self._closed

    @contextlib.contextmanager
    def lease(self) -> Iterator[Lease]:
        """The newest channel, for one call. Cancelled after `close()`; ServerEnded
        after the end of a server that this process runs."""
        if self.server is not None:
            self.server.check()
        with self._lock:
            if self._closed:
                raise Cancelled("the client is closed")
            if self._newest is None:
                self._newest = Lease(self._open(self._made_of))
                self._leases.append(self._newest)
            lease = self._newest
            lease.users += 1
        try:
            yield lease
        finally:
            with self._lock:
                lease.users -= 1
                self._close_if_done(lease)

    def report(self, lease: Lease, error: Error) -> None:
        """Lets later calls have a new channel if this error, which came on the
        leased one, shows that its connection or its server may have gone."""
        if not (is_cut(error) or (
                isinstance(error, (Unavailable, DeadlineExceeded))
                and error.reason in ("", "SERVER_DRAINING"))):
            return
        with self._lock:
            if lease is self._newest and not self._closed:
                lease.is_retired = True
                self._newest = None

    def explained(self, error: Error) -> Error:
        """The error of a call, or the ServerEnded that is behind it; another attempt
        would hear of that by `lease()`."""
        is_broken = is_cut(error) or (isinstance(error, Unavailable)
                                      and not error.reason)
        if self.server is None or self._closed or not is_broken:
            return error
        return self.server.why_ended(END_SECONDS) or error

    def _close_if_done(self, lease: Lease) -> None:
        if lease.is_retired and lease.users == 0 and lease in self._leases:
            self._leases.remove(lease)
            self._close_channel(lease.channel)

    def close(self) -> None:
        """Ends all calls."""
        with self._lock:
            self._closed = True
            leases, self._leases = self._leases, []
        for lease in leases:
            self._close_channel(lease.channel)


class Caller:
    """The metadata by which every call says who makes it. Thread-safe."""

    def __init__(self, token_file: Optional[PathLike] = None) -> None:
        self._token_file = token_file

    def metadata(self, request_id: Optional[str] = None) -> tuple[str, Metadata]:
        """A request id, new unless one is given, and the metadata of a call.

        Unauthenticated if the token cannot be read; ValueError if the given id
        is not 1 to 128 printable ASCII characters."""
        request_id = request_id or uuid.uuid4().hex
        if not re.fullmatch(r"[ -~]{1,128}", request_id):
            raise ValueError(f"the request id {request_id!r} is not 1 to 128 printable "
                             "ASCII characters")
        metadata: Metadata = (("x-request-id", request_id),)
        if self._token_file is not None:
            try:
                token = _read_token(self._token_file)
            except (OSError, ValueError) as error:
                raise Unauthenticated(f"there is no token to send: {error}",
                                      request_id=request_id) from error
            metadata += (("authorization", "Bearer " + token),)
        return request_id, metadata


def owner_route(last: Optional[BaseException]) -> Metadata:
    """For the attempt after one that ended with this error: where that said which
    server owns the vehicle, the header by which Envoy's stateful sessions
    (envoy.http.stateful_session.header) send the call there. The next attempt only:
    the owner may change at any time, and without the header a proxy chooses by the
    vehicle's id."""
    if not isinstance(last, Error) or last.reason != "NOT_OWNER":
        return ()
    owner = last.metadata.get("owner", "")
    if not owner:
        return ()
    return (("x-revisit-owner", base64.b64encode(owner.encode()).decode()),)
