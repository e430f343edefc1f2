"""Connections of gRPC's asyncio interface."""

from __future__ import annotations

import asyncio
from typing import Any, Optional

import grpc

from revisit.channel import ARGUMENTS, ChannelOptions, Channels
from revisit.errors import Error


class AioChannels(Channels):
    """The channel to a server, for the event loop in which it is first used."""

    def __init__(self, options: ChannelOptions) -> None:
        super().__init__(options)
        self._closing: set[asyncio.Task[None]] = set()

    def _open(self, credentials: Optional[grpc.ChannelCredentials]) -> Any:
        if credentials is None:
            return grpc.aio.insecure_channel(self.options.address, options=ARGUMENTS)
        return grpc.aio.secure_channel(self.options.address, credentials,
                                       options=ARGUMENTS)

    def _close_channel(self, channel: Any) -> None:
        task = asyncio.get_running_loop().create_task(channel.close())
        self._closing.add(task)
        task.add_done_callback(self._closing.discard)

    async def explain(self, error: Error) -> Error:
        """Does what `explained()` does without holding up the event loop."""
        if self.server is None:
            return error
        return await asyncio.to_thread(self.explained, error)

    async def aclose(self) -> None:
        """Ends all calls."""
        self.close()
        await asyncio.gather(*self._closing)
