"""A proxy that tells its callers of a dead server as Envoy does: it resets their
calls with INTERNAL_ERROR, which gRPC clients see as INTERNAL without details."""

import contextlib
import socket
import struct
import threading

from raw_http2 import GOAWAY, HEADERS, RST_STREAM, frame

INTERNAL_ERROR = 2


def read_exactly(connection, count):
    """So many bytes, or none if the connection ends first."""
    data = b""
    while len(data) < count:
        try:
            part = connection.recv(count - len(data))
        except OSError:
            return b""
        if not part:
            return b""
        data += part
    return data


class ResettingProxy:
    """Each connection to it has one of its own to the server at `port`."""

    def __init__(self, port):
        self.server_port = port
        # Calls that it has reset.
        self.resets = 0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = "127.0.0.1:%d" % self._listener.getsockname()[1]
        self._run(self._accept)

    @staticmethod
    def _run(work, *arguments):
        threading.Thread(target=work, args=arguments, daemon=True).start()

    def _accept(self):
        with contextlib.suppress(OSError):
            while True:
                caller = self._listener.accept()[0]
                try:
                    server = socket.create_connection(
                        ("127.0.0.1", self.server_port))
                except OSError:
                    caller.close()
                    continue
                self._run(self._forward, caller, server)
                self._run(self._answer, caller, server)

    @staticmethod
    def _forward(caller, server):
        with contextlib.suppress(OSError):
            while data := caller.recv(65536):
                server.sendall(data)
        with contextlib.suppress(OSError):
            server.shutdown(socket.SHUT_WR)

    def _answer(self, caller, server):
        """Passes whole frames on, since a reset must not come within one."""
        answered, last = set(), 0
        with contextlib.suppress(OSError):
            while head := read_exactly(server, 9):
                length, kind, flags, stream = struct.unpack(
                    ">IBBI", b"\0" + head)
                payload = read_exactly(server, length)
                if len(payload) < length:
                    break
                caller.sendall(head + payload)
                if kind == HEADERS:
                    # The second ones are the trailers, which end the call.
                    (answered.discard if flags & 1 else answered.add)(stream)
                    last = max(last, stream)
            for stream in answered:
                self.resets += 1
                caller.sendall(frame(
                    RST_STREAM, struct.pack(">I", INTERNAL_ERROR),
                    stream=stream))
            caller.sendall(frame(GOAWAY, struct.pack(">II", last, 0)))
        for connection in (caller, server):
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            connection.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._listener.close()
