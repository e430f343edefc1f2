"""A server for this process alone:

    with revisit.serve() as client:
        client.create_vehicle("shuttle-7")
"""

from __future__ import annotations

import pathlib
from typing import Any, Optional

from revisit._retries import CallOptions
from revisit._server_process import ServerEnded, ServerProcess
from revisit.backoff import BackoffOptions
from revisit.channel import PathLike
from revisit.client import Client

__all__ = ["ServedClient", "ServerEnded", "serve"]


class ServedClient(Client):
    """Made by `serve()`: a client that has its server with it. Calls, streams and
    watches of a server that has ended by itself raise ServerEnded."""

    def __init__(self, server: ServerProcess, options: CallOptions) -> None:
        super().__init__(server.address, deadline=options.deadline,
                         bulk_deadline=options.bulk_deadline,
                         max_attempts=options.max_attempts, backoff=options.backoff)
        self._server = self._channels.server = server

    @property
    def address(self) -> str:
        """HOST:PORT, for other clients of this server."""
        return self._server.address

    @property
    def store(self) -> pathlib.Path:
        """The directory of the store, which is gone after `close()` if it was made for
        this server."""
        return self._server.store

    @property
    def log(self) -> str:
        """What the server has logged, its last megabyte; also after `close()`."""
        return self._server.log

    def close(self) -> None:
        """Does what `Client.close()` does, then ends the server and waits for that.
        Nothing in a fork of the process that has started it."""
        if not self._server.is_ours:
            return
        try:
            super().close()
        finally:
            self._server.close()

    def __enter__(self) -> ServedClient:
        return self


def serve(store: Optional[PathLike] = None, *, start_deadline: float = 60.0,
          deadline: float = 30.0, bulk_deadline: float = 600.0, max_attempts: int = 6,
          backoff: BackoffOptions = BackoffOptions(), **settings: Any) -> ServedClient:
    """Starts a revisitd on a free port of 127.0.0.1, waits until it takes calls, and
    returns its client.

        with revisit.serve("drives", max_batch_poses=1000) as client:
            client.create_vehicle("shuttle-7")

    `store` is the directory in which the server keeps what it has: made where it is
    missing, and kept. Without one it has a temporary directory that goes with it. The
    server ends with the client: by leaving `with`, by `close()`, at the end of the
    program, and also if this process is killed. REVISIT_ variables of the environment
    are kept from it.

    `settings` are those of revisitd, which `revisitd --help` lists, with underscores;
    True and False are "on" and "off". `start_deadline` is how long the start may take
    in seconds; `deadline` and those after it are as for `Client`.

    The program is the one that REVISIT_SERVER_PROGRAM names, else the one installed
    with this package or with Python, else the one on PATH. FileNotFoundError if there
    is none; TypeError for a name that is no setting, ValueError for a wrong value;
    ServerEnded if the server ends at once, as it does where another one has the store;
    TimeoutError after `start_deadline`."""
    options = CallOptions(deadline, bulk_deadline, max_attempts, backoff)
    return ServedClient(ServerProcess(store, settings, start_deadline), options)
