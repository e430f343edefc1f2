"""A proxy of TCP between a client and a server that is killed and comes back."""

import contextlib
import socket
import threading


class CutProxy:
    """Passes bytes on, until `limit` bytes have gone to the server: the rest waits.
    Then the server may be replaced. A client sees what it would see behind a load
    balancer: its connections are reset, and new ones reach the new server."""

    def __init__(self, port, limit):
        self._port = port
        self._left = limit
        self._lock = threading.Lock()
        self._sockets = []
        self.held = threading.Event()
        self._released = threading.Event()
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.address = f"127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def lose_server(self):
        """Resets all connections; new ones are closed at once."""
        with self._lock:
            self._port = None
            self._released.set()
            self._close_sockets()

    def find_server(self, port):
        with self._lock:
            self._port = port

    def close(self):
        self._listener.close()
        self.lose_server()

    def _close_sockets(self):
        for one in self._sockets:
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()
        self._sockets.clear()

    def _accept(self):
        with contextlib.suppress(OSError):
            while True:
                client, _ = self._listener.accept()
                self._connect(client)

    def _connect(self, client):
        with self._lock:
            if self._port is None:
                client.close()
                return
            server = socket.create_connection(("127.0.0.1", self._port))
            self._sockets += [client, server]
        threading.Thread(target=self._pass_on, daemon=True,
                         args=(client, server, self._count)).start()
        threading.Thread(target=self._pass_on, daemon=True,
                         args=(server, client, lambda data: None)).start()

    def _count(self, data):
        if self._released.is_set():
            return
        with self._lock:
            self._left -= len(data)
            if self._left >= 0:
                return
        self.held.set()
        self._released.wait()

    @staticmethod
    def _pass_on(source, sink, before):
        with contextlib.suppress(OSError):
            while data := source.recv(16384):
                before(data)
                sink.sendall(data)
            sink.shutdown(socket.SHUT_WR)
