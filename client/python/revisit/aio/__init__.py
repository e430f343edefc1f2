"""The client for asyncio: what `revisit.Client` and its streams do, awaited.

    async with revisit.aio.Client("127.0.0.1:50051") as client:
        await client.create_vehicle("shuttle-7")
        options = revisit.StreamOptions(send_candidates=True)
        async with client.stream_poses("shuttle-7", options) as stream:
            durable = await stream.wait_until_opened()
            async for answer in stream.run(batches):
                ...

Arguments, answers, errors, retries and the contract of a stream are those of the
blocking client. One client is for one event loop.
"""

from revisit.aio.client import Client
from revisit.aio.pose_stream import PoseStream
from revisit.aio.serving import ServedClient, serve
from revisit.aio.watch import CheckList, Watch, WatchEvent

__all__ = ["CheckList", "Client", "PoseStream", "ServedClient", "Watch", "WatchEvent",
           "serve"]
