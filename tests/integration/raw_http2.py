"""A connection on which anything can be sent: frames are put together by hand,
so that they can be wrong."""

import socket
import struct

import hpack
from hyperframe.frame import Frame

PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"

DATA, HEADERS, PRIORITY, RST_STREAM, SETTINGS = 0, 1, 2, 3, 4
PUSH_PROMISE, PING, GOAWAY, WINDOW_UPDATE, CONTINUATION = 5, 6, 7, 8, 9
END_STREAM, ACK, END_HEADERS, PADDED, PRIORITY_FLAG = 1, 1, 4, 8, 32

SERVICE = "/revisit.v1.PoseGraphService"

# Longer than any answer takes.
PATIENCE_SECONDS = 30
# So long nothing is taken by a server that waits until its answers are read.
STALL_SECONDS = 5


def frame(kind, payload=b"", flags=0, stream=0, length=None):
    length = len(payload) if length is None else length
    return struct.pack(">IBBI", length, kind, flags, stream)[1:] + payload


def message(payload, compressed=0, length=None):
    """A message of gRPC, with what stands before it."""
    length = len(payload) if length is None else length
    return struct.pack(">BI", compressed, length) + payload


def call_headers(path=f"{SERVICE}/GetServerInfo", replace=(), without=(),
                 extra=()):
    headers = {":method": "POST", ":scheme": "http", ":path": path,
               ":authority": "localhost", "te": "trailers",
               "content-type": "application/grpc", **dict(replace)}
    return [(name, value) for name, value in headers.items()
            if name not in without] + list(extra)


def encode(headers):
    """Without the compression's memory: each block stands for itself."""
    return hpack.Encoder().encode(
        [hpack.NeverIndexedHeaderTuple(name, value)
         for name, value in headers], huffman=False)


def indexed_headers(headers):
    """The headers as a client that keeps a table sends them: the first time, and
    in all blocks after it on the same connection."""
    encoder = hpack.Encoder()
    return (encoder.encode(headers, huffman=True),
            encoder.encode(headers, huffman=True))


def split(data, size=16384):
    """What fits one frame each."""
    return [data[i:i + size] for i in range(0, max(len(data), 1), size)]


class RawConnection:
    """With acknowledge=False the server's settings, its limits among them, are
    never agreed to. `source` is the address that the server takes the caller
    for; `tls` is an ssl.SSLContext to speak by. The timeout of the socket is that
    of sending."""

    def __init__(self, port, settings=b"", acknowledge=True,
                 source="127.0.0.1", tls=None):
        self.socket = socket.create_connection(
            ("127.0.0.1", port), timeout=PATIENCE_SECONDS,
            source_address=(source, 0))
        if tls is not None:
            self.socket = tls.wrap_socket(self.socket,
                                          server_hostname="localhost")
        self.socket.settimeout(STALL_SECONDS)
        self.decoder = hpack.Decoder()
        self.buffer = b""
        self.send(PREFACE + frame(SETTINGS, settings))
        if acknowledge:
            next(self.frames())
            self.send(frame(SETTINGS, flags=ACK))

    def send(self, data):
        """False if the other side has gone, or takes nothing."""
        try:
            self.socket.sendall(data)
            return True
        except (ConnectionError, TimeoutError):
            return False

    def request(self, headers, body=message(b""), stream=1, end=END_STREAM):
        block = split(encode(headers))
        pieces = split(body)
        self.send(b"".join(
            [frame(CONTINUATION if i else HEADERS, piece,
                   END_HEADERS if i == len(block) - 1 else 0, stream)
             for i, piece in enumerate(block)] +
            [frame(DATA, piece, end if i == len(pieces) - 1 else 0, stream)
             for i, piece in enumerate(pieces)]))

    def frames(self, seconds=PATIENCE_SECONDS):
        """What comes, until the end of the connection or for so long nothing
        does."""
        while True:
            while len(self.buffer) >= 9:
                head, length = Frame.parse_frame_header(
                    memoryview(self.buffer[:9]))
                if len(self.buffer) < 9 + length:
                    break
                head.parse_body(memoryview(self.buffer[9:9 + length]))
                self.buffer = self.buffer[9 + length:]
                yield head
            sending = self.socket.gettimeout()
            self.socket.settimeout(seconds)
            try:
                received = self.socket.recv(65536)
            except TimeoutError:
                return
            except ConnectionError:
                received = b""
            finally:
                self.socket.settimeout(sending)
            if not received:
                yield None
                return
            self.buffer += received

    def outcome(self, stream=1, seconds=PATIENCE_SECONDS):
        """How it ends: "closed" (the connection), "reset N" (the stream, with
        the error's number), "status N" (of gRPC), "http N" (of HTTP)."""
        http = None
        for received in self.frames(seconds):
            if received is None:
                return "closed"
            if received.type == GOAWAY and received.error_code != 0:
                return "closed"
            if received.stream_id != stream:
                continue
            if received.type == RST_STREAM:
                return http or f"reset {received.error_code}"
            if received.type == HEADERS:
                headers = dict(self.decoder.decode(received.data))
                if "grpc-status" in headers:
                    return f"status {headers['grpc-status']}"
                if headers.get(":status", "200") != "200":
                    http = f"http {headers[':status']}"
        return http or "nothing"

    def is_alive(self, seconds=PATIENCE_SECONDS):
        """Whether a ping is answered, and nothing before it says otherwise."""
        self.send(frame(PING, b"answerme"))
        for received in self.frames(seconds):
            if received is None or (received.type == GOAWAY and
                                    received.error_code != 0):
                return False
            if received.type == PING and received.opaque_data == b"answerme":
                return True
        return False

    def close(self):
        self.socket.close()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()
