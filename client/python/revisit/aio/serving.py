"""A server for this process alone, for asyncio."""

from __future__ import annotations

import asyncio
import contextlib
import pathlib
from collections.abc import AsyncIterator
from typing import Any, Optional

from revisit import serving
from revisit._retries import CallOptions
from revisit._server_process import ServerProcess
from revisit.aio.client import Client
from revisit.aio.pose_stream import document
from revisit.backoff import BackoffOptions
from revisit.channel import PathLike


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
        return self._server.address

    @property
    def store(self) -> pathlib.Path:
        return self._server.store

    @property
    def log(self) -> str:
        return self._server.log

    async def close(self) -> None:
        if not self._server.is_ours:
            return
        try:
            await super().close()
        finally:
            await asyncio.to_thread(self._server.close)

    async def __aenter__(self) -> ServedClient:
        return self


@contextlib.asynccontextmanager
async def serve(store: Optional[PathLike] = None, *, start_deadline: float = 60.0,
                deadline: float = 30.0, bulk_deadline: float = 600.0,
                max_attempts: int = 6, backoff: BackoffOptions = BackoffOptions(),
                **settings: Any) -> AsyncIterator[ServedClient]:
    """Does what `revisit.serve()` does, as an asynchronous context manager:

        async with revisit.aio.serve() as client:
            await client.create_vehicle("shuttle-7")
    """
    options = CallOptions(deadline, bulk_deadline, max_attempts, backoff)
    server = await asyncio.to_thread(ServerProcess, store, settings, start_deadline)
    async with ServedClient(server, options) as client:
        yield client


document(ServedClient, serving.ServedClient)
