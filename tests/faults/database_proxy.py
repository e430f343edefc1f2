"""A proxy before PostgreSQL that delays answers, loses them, and cuts.

It understands so much of the protocol (version 3.0, without encryption) as it
needs to know which statement an answer belongs to.
"""

import contextlib
import socket
import struct
import threading
import time

_READY = b"Z"
_ERROR = b"E"
_BIND = b"B"


def _receive(connection, count):
    data = b""
    while len(data) < count:
        part = connection.recv(count - len(data))
        if not part:
            raise EOFError
        data += part
    return data


def _message(connection, typed=True):
    """(type, the whole message)"""
    head = _receive(connection, 5 if typed else 4)
    length, = struct.unpack(">I", head[-4:])
    return head[:1] if typed else b"", head + _receive(connection, length - 4)


def _reset(*connections):
    """Ends connections as a machine does that is gone: without a goodbye."""
    for connection in connections:
        with contextlib.suppress(OSError):
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER,
                                  struct.pack("ii", 1, 0))
            # A shutdown wakes whoever reads from it.
            connection.shutdown(socket.SHUT_RDWR)
        connection.close()


class DatabaseProxy:
    """Each connection to it has one of its own to `target`, (host, port).
    Thread-safe."""

    def __init__(self, target, host="127.0.0.1"):
        self.target = target
        # Answers that were lost although the statement had succeeded.
        self.eaten = 0
        # Executions of each statement that were passed on.
        self.executed = {}
        # Seconds that every answer takes longer.
        self.delay = 0.0
        self._eat = set()
        self._lock = threading.Lock()
        self._pairs = set()
        self._listener = socket.create_server((host, 0), backlog=64)
        self.address = "%s:%d" % self._listener.getsockname()
        self._run(self._accept)

    def eat_answer(self, statement):
        """The next answer to this prepared statement gets lost: the connection is
        cut instead."""
        with self._lock:
            self._eat.add(statement)

    def cut(self):
        """Ends all connections."""
        with self._lock:
            pairs = list(self._pairs)
        for pair in pairs:
            _reset(*pair)

    def close(self):
        self._listener.close()
        self.cut()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.close()

    @staticmethod
    def _run(work, *arguments):
        threading.Thread(target=work, args=arguments, daemon=True).start()

    def _accept(self):
        with contextlib.suppress(OSError):
            while True:
                caller = self._listener.accept()[0]
                try:
                    database = socket.create_connection(self.target, 5)
                except OSError:
                    _reset(caller)
                    continue
                database.settimeout(None)
                for connection in (caller, database):
                    connection.setsockopt(socket.IPPROTO_TCP,
                                          socket.TCP_NODELAY, 1)
                connection = _Connection(self, caller, database)
                with self._lock:
                    self._pairs.add((caller, database))
                self._run(self._serve, connection.forward, caller, database)
                self._run(self._serve, connection.answer, caller, database)

    def _serve(self, work, caller, database):
        with contextlib.suppress(OSError, EOFError):
            work()
        with self._lock:
            self._pairs.discard((caller, database))
        _reset(caller, database)

    def is_to_be_eaten(self, statement):
        """Whether the answer to it is to get lost, which is asked once for each
        execution."""
        with self._lock:
            self.executed[statement] = self.executed.get(statement, 0) + 1
            if statement not in self._eat:
                return False
            self._eat.remove(statement)
            return True

    def note_eaten(self):
        with self._lock:
            self.eaten += 1


class _Connection:
    def __init__(self, proxy, caller, database):
        self._proxy = proxy
        self._caller, self._database = caller, database
        self._eats = False

    def forward(self):
        _, startup = _message(self._caller, typed=False)
        self._database.sendall(startup)
        while True:
            kind, message = _message(self._caller)
            if kind == _BIND:
                # The name of the portal, then that of the statement.
                name = message[5:].split(b"\0", 2)[1].decode()
                self._eats = self._proxy.is_to_be_eaten(name)
            self._database.sendall(message)

    def answer(self):
        while True:
            data = b""
            failed = False
            while True:
                kind, message = _message(self._database)
                data += message
                failed = failed or kind == _ERROR
                if kind == _READY or not self._eats:
                    break
            if self._proxy.delay > 0.0 and kind == _READY:
                time.sleep(self._proxy.delay)
            if self._eats:
                if not failed:
                    self._proxy.note_eaten()
                return
            self._caller.sendall(data)
