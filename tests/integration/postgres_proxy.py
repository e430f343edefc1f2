"""A proxy before PostgreSQL that ends sessions as a test says."""

import contextlib
import pathlib
import shutil
import socket
import struct
import tempfile
import threading

ADMIN_SHUTDOWN = ("57P01", "terminating connection due to administrator command")
STARTING_UP = ("57P03", "the database system is starting up")
# Messages of a client that ask for a statement: Query, Parse, Execute.
_ASKING = b"QPE"


def _read(connection, size):
    data = b""
    while len(data) < size:
        part = connection.recv(size - len(data))
        if not part:
            raise ConnectionError
        data += part
    return data


def _fatal(code, message):
    """An ErrorResponse that ends a session."""
    fields = b"".join(kind + text.encode() + b"\0" for kind, text in (
        (b"S", "FATAL"), (b"V", "FATAL"), (b"C", code), (b"M", message))) + b"\0"
    return b"E" + struct.pack("!I", len(fields) + 4) + fields


class PostgresProxy:
    """Passes sessions on to the sockets in the directory `server`. Refuses the first
    `refusals` sessions as a database that starts does; ends the session in which the
    statement number `end_at` comes, counted over all sessions from 1, before
    PostgreSQL sees it, or, with `too_late`, without an answer after it has. A context
    manager; `sockets` is the directory to connect to."""

    def __init__(self, server, refusals=0, end_at=None, too_late=False):
        self._server = pathlib.Path(server) / ".s.PGSQL.5432"
        self._refusals, self._end_at, self._too_late = refusals, end_at, too_late
        self._lock = threading.Lock()
        #: Statements that were asked for, and sessions that were refused or ended.
        self.statements, self.refused, self.ended = 0, 0, 0
        self.sockets = tempfile.mkdtemp(prefix="revisit-proxy-")
        self._listener = socket.socket(socket.AF_UNIX)
        self._listener.bind(f"{self.sockets}/.s.PGSQL.5432")
        self._listener.listen(64)

    def __enter__(self):
        threading.Thread(target=self._accept, daemon=True).start()
        return self

    def __exit__(self, *_):
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        shutil.rmtree(self.sockets, ignore_errors=True)

    def _accept(self):
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                threading.Thread(target=self._serve, args=(client,),
                                 daemon=True).start()

    def _serve(self, client):
        with client, contextlib.suppress(OSError), \
                socket.socket(socket.AF_UNIX) as server:
            head = _read(client, 4)
            startup = head + _read(client, struct.unpack("!I", head)[0] - 4)
            with self._lock:
                is_refused = self.refused < self._refusals
                self.refused += is_refused
            if is_refused:
                client.sendall(_fatal(*STARTING_UP))
                return
            server.connect(str(self._server))
            server.sendall(startup)
            ending = threading.Event()
            answers = threading.Thread(target=self._answer,
                                       args=(server, client, ending), daemon=True)
            answers.start()
            try:
                if self._pass_on(client, server, ending):
                    answers.join()
            finally:
                # A socket in which a thread still waits is not closed otherwise, and
                # PostgreSQL would keep the session with its locks.
                with contextlib.suppress(OSError):
                    server.shutdown(socket.SHUT_RDWR)

    def _pass_on(self, client, server, ending):
        """Whether an answer has to come before the session ends."""
        while True:
            head = _read(client, 5)
            message = head + _read(client, struct.unpack("!I", head[1:])[0] - 4)
            if head[:1] in _ASKING and self._is_last():
                if self._too_late:
                    ending.set()
                    # With what asks for the answer to it.
                    server.sendall(message + (b"" if head[:1] == b"Q"
                                              else b"S\0\0\0\4"))
                    return True
                client.sendall(_fatal(*ADMIN_SHUTDOWN))
                return False
            server.sendall(message)

    def _is_last(self):
        with self._lock:
            self.statements += 1
            self.ended += self.statements == self._end_at
            return self.statements == self._end_at

    @staticmethod
    def _answer(server, client, ending):
        with contextlib.suppress(OSError):
            while data := server.recv(65536):
                if ending.is_set():
                    break
                client.sendall(data)
        with contextlib.suppress(OSError):
            client.shutdown(socket.SHUT_RDWR)
