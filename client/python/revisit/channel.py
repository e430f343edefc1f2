"""Connections to a server: TLS, tokens, request ids."""

from __future__ import annotations

import dataclasses
import os
import pathlib
import re
import ssl
import uuid
from typing import Optional, Union

import grpc

from revisit.errors import Unauthenticated

PathLike = Union[str, "os.PathLike[str]"]
Metadata = tuple[tuple[str, str], ...]

_ARGUMENTS = (
    # A connection that failed is tried again soon, so that the back-off of this
    # package decides.
    ("grpc.initial_reconnect_backoff_ms", 100),
    ("grpc.min_reconnect_backoff_ms", 5_000),
    ("grpc.max_reconnect_backoff_ms", 2_000),
    ("grpc.max_receive_message_length", 64 << 20),
    # One process may speak to several servers that follow each other at one
    # address; channels that share a connection would share its back-off too.
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


def _read_token(path: PathLike) -> str:
    token = pathlib.Path(path).read_text(encoding="latin-1").strip()
    if not re.fullmatch(r"[!-~]+", token):
        raise ValueError(f"{os.fspath(path)} holds no token")
    return token


def _check_tls(options: ChannelOptions) -> None:
    """Finds faults of the files that gRPC would only report as "unreachable"."""
    assert options.tls_authorities is not None
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
            f"{os.fspath(options.tls_certificate)} and {os.fspath(options.tls_key)} are "
            "no certificate and its own, unencrypted private key: "
            f"{error}") from error


def _read(path: Optional[PathLike]) -> Optional[bytes]:
    return None if path is None else pathlib.Path(path).read_bytes()


def make_channel(options: ChannelOptions) -> grpc.Channel:
    """Makes a channel, which connects on first use.

    OSError if a file cannot be read; ValueError if one holds something else, or
    if certificate and key do not belong together or do not come together and
    with authorities."""
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
        credentials = grpc.ssl_channel_credentials(
            _read(options.tls_authorities), _read(options.tls_key),
            _read(options.tls_certificate))
    elif options.token_file is not None:
        # Such a channel connects within this machine only.
        credentials = grpc.local_channel_credentials(
            grpc.LocalConnectionType.UDS if options.address.startswith("unix")
            else grpc.LocalConnectionType.LOCAL_TCP)
    else:
        return grpc.insecure_channel(options.address, options=_ARGUMENTS)
    return grpc.secure_channel(options.address, credentials, options=_ARGUMENTS)


class Caller:
    """What every call says of itself. Thread-safe."""

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
