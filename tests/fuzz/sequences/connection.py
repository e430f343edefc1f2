"""One HTTP/2 connection that never waits: what is put on it goes out as the
server's windows allow, and what comes in is told at once."""

import errno
import socket
import struct

import hpack

from raw_http2 import (
    ACK, CONTINUATION, DATA, END_HEADERS, END_STREAM, GOAWAY, HEADERS, PADDED,
    PING, PREFACE, RST_STREAM, SETTINGS, WINDOW_UPDATE, encode, frame)

INITIAL_WINDOW, TRUE_BINARY = 4, 0xfe03
MOST_WINDOW = 2**31 - 1


class Stream:
    """One call, as the transport sees it."""

    def __init__(self, window):
        self.window = window
        self.waiting = bytearray()
        self.ends = False
        self.sent_end = False
        self.received = bytearray()
        self.messages = []
        self.headers = {}
        # "status", "reset N", "closed".
        self.outcome = None


class Connection:
    def __init__(self, port, receive_window):
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=10)
        self.socket.setblocking(False)
        self.socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.decoder = hpack.Decoder(max_header_list_size=1 << 20)
        self.streams = {}
        self.closed = False
        self.goaway = None
        self.inbox = b""
        self.outbox = bytearray()
        self.window = 65535
        self.stream_window = 65535
        self.frame_size = 16384
        self.receive_window = receive_window
        self.consumed = 0
        self._next_stream = 1
        self._headers_of = None
        settings = struct.pack(">HIHI", INITIAL_WINDOW, receive_window,
                               TRUE_BINARY, 1)
        self.put(PREFACE + frame(SETTINGS, settings))
        self.put(frame(WINDOW_UPDATE,
                       struct.pack(">I", MOST_WINDOW - 65535)))

    # ---- Out

    def put(self, data):
        if not self.closed:
            self.outbox += data

    def open(self, headers):
        number = self._next_stream
        self._next_stream += 2
        self.streams[number] = Stream(self.stream_window)
        self.put(frame(HEADERS, encode(headers), END_HEADERS, number))
        return number

    def send(self, number, data):
        stream = self.streams[number]
        if stream.outcome is None and not stream.ends:
            stream.waiting += data
            self._pump(number, stream)

    def half_close(self, number):
        stream = self.streams[number]
        if stream.outcome is None and not stream.ends:
            stream.ends = True
            self._pump(number, stream)

    def reset(self, number, code):
        stream = self.streams[number]
        if stream.outcome is None:
            stream.outcome = "reset by us"
            self.put(frame(RST_STREAM, struct.pack(">I", code), 0, number))

    def _pump(self, number, stream):
        while stream.waiting and stream.window > 0 and self.window > 0:
            size = min(len(stream.waiting), stream.window, self.window,
                       self.frame_size)
            piece = bytes(stream.waiting[:size])
            del stream.waiting[:size]
            stream.window -= size
            self.window -= size
            last = stream.ends and not stream.waiting
            stream.sent_end |= last
            self.put(frame(DATA, piece, END_STREAM if last else 0, number))
        if stream.ends and not stream.waiting and not stream.sent_end:
            stream.sent_end = True
            self.put(frame(DATA, b"", END_STREAM, number))

    def flush(self):
        """Writes what the socket takes."""
        while self.outbox and not self.closed:
            try:
                sent = self.socket.send(self.outbox[:1 << 18])
            except BlockingIOError:
                return
            except OSError:
                self._end()
                return
            del self.outbox[:sent]

    # ---- In

    def read(self):
        """Takes in all that has come."""
        while not self.closed:
            try:
                received = self.socket.recv(1 << 18)
            except BlockingIOError:
                break
            except OSError as error:
                assert error.errno in (errno.ECONNRESET, errno.EPIPE), error
                received = b""
            if not received:
                self._parse()
                self._end()
                return
            self.inbox += received
        self._parse()

    def _parse(self):
        at = 0
        inbox = self.inbox
        while len(inbox) - at >= 9:
            length = int.from_bytes(inbox[at:at + 3], "big")
            if len(inbox) - at < 9 + length:
                break
            kind, flags = inbox[at + 3], inbox[at + 4]
            number = int.from_bytes(inbox[at + 5:at + 9], "big") & 0x7fffffff
            self._take(kind, flags, number, inbox[at + 9:at + 9 + length])
            at += 9 + length
        self.inbox = inbox[at:]

    def _take(self, kind, flags, number, payload):
        stream = self.streams.get(number)
        if kind == DATA:
            if flags & PADDED:
                payload = payload[1:len(payload) - payload[0]]
            self.consumed += len(payload)
            if self.consumed > 1 << 24:
                self.put(frame(WINDOW_UPDATE,
                               struct.pack(">I", self.consumed)))
                self.consumed = 0
            if stream is not None:
                self._take_data(stream, payload)
                if flags & END_STREAM:
                    stream.outcome = stream.outcome or "no trailers"
        elif kind == HEADERS:
            self._headers_of = (number, flags, payload)
            if flags & END_HEADERS:
                self._take_headers()
        elif kind == CONTINUATION:
            first, first_flags, so_far = self._headers_of
            self._headers_of = (first, first_flags, so_far + payload)
            if flags & END_HEADERS:
                self._take_headers()
        elif kind == RST_STREAM and stream is not None:
            code = int.from_bytes(payload, "big")
            stream.outcome = stream.outcome or f"reset {code}"
        elif kind == SETTINGS and not flags & ACK:
            for at in range(0, len(payload), 6):
                key, value = struct.unpack_from(">HI", payload, at)
                if key == INITIAL_WINDOW:
                    for each in self.streams.values():
                        each.window += value - self.stream_window
                    self.stream_window = value
            self.put(frame(SETTINGS, flags=ACK))
            self._pump_all()
        elif kind == PING and not flags & ACK:
            self.put(frame(PING, payload, ACK))
        elif kind == GOAWAY:
            self.goaway = payload[4:].decode(errors="replace")
        elif kind == WINDOW_UPDATE:
            more = int.from_bytes(payload, "big")
            if number == 0:
                self.window += more
                self._pump_all()
            elif stream is not None:
                stream.window += more
                self._pump(number, stream)

    def _pump_all(self):
        for number, stream in self.streams.items():
            if stream.outcome is None:
                self._pump(number, stream)

    def _take_headers(self):
        number, flags, block = self._headers_of
        headers = self.decoder.decode(block, raw=True)
        stream = self.streams.get(number)
        if stream is None:
            return
        stream.headers.update(headers)
        if flags & END_STREAM and stream.outcome is None:
            stream.outcome = "status"

    @staticmethod
    def _take_data(stream, payload):
        stream.received += payload
        received = stream.received
        while len(received) >= 5:
            length = int.from_bytes(received[1:5], "big")
            if len(received) < 5 + length:
                break
            stream.messages.append(bytes(received[5:5 + length]))
            del received[:5 + length]

    # ---- End

    def _end(self):
        self.closed = True
        self.socket.close()
        for stream in self.streams.values():
            stream.outcome = stream.outcome or "closed"

    def close(self, abruptly=False):
        if not self.closed:
            if abruptly:
                self.socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER,
                                       struct.pack("ii", 1, 0))
            self._end()
