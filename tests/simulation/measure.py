#!/usr/bin/env python3
"""What a message of poses costs each part of a cluster: the CPU time of a real
revisitd, of the real Envoy with the configuration of deploy/cluster before it and of
the real PostgreSQL behind it, at given rates.

    build/python/bin/python tests/simulation/measure.py

Each vehicle has a connection and a stream of its own and sends at even times, no two
at the same. Nobody asks for candidates. Prints a row a load: microseconds of CPU a
message, and a pose. The figures of parameters.py that name this command are from it.
Needs what tests/run installs."""

import argparse
import asyncio
import contextlib
import os
import pathlib
import sys

import grpc

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "integration"))
sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[2] / "deploy/cluster"))

import private_cluster
import tables
from envoy_proxy import directory_of_cluster
from revisit_server import BIN, processor_seconds
from stubs import PoseGraphServiceStub, api
from wire import straight

# Poses a message, vehicles, messages a second of all of them together.
LOADS = ((1, 120, 120), (1, 120, 600), (1, 120, 1200), (64, 120, 120), (64, 120, 600))
WARM_SECONDS = 4.0


def seconds_with_children(pid):
    """Processor time of a process, and of its children that live and that have
    ended."""
    process = pathlib.Path(f"/proc/{pid}")
    ended = map(int, (process / "stat").read_text().rpartition(")")[2].split()[13:15])
    total = processor_seconds(pid) + sum(ended) / os.sysconf("SC_CLK_TCK")
    for child in (process / f"task/{pid}/children").read_text().split():
        # One that is gone counts among those that have ended from the next look on.
        with contextlib.suppress(FileNotFoundError):
            total += processor_seconds(child)
    return total


class Vehicle:
    """One vehicle, which streams over a connection of its own."""

    def __init__(self, address, credentials, name):
        self.name = name
        self._channel = grpc.aio.secure_channel(
            address, credentials, options=[("grpc.use_local_subchannel_pool", 1)])
        self._stub = PoseGraphServiceStub(self._channel)
        self.acknowledged = 0

    async def create(self):
        await self._stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id=self.name))

    async def drive(self, poses, first_after, every, end):
        """Sends so many poses a message until the time of the loop is `end`, and waits
        until all are acknowledged."""
        loop = asyncio.get_running_loop()
        call = self._stub.StreamPoses()
        await call.write(api.StreamPosesRequest(
            open=api.StreamPosesOpen(vehicle=f"vehicles/{self.name}")))
        reader = asyncio.create_task(self._read(call))
        sequence, at = self.acknowledged + 1, loop.time() + first_after
        while at < end:
            await asyncio.sleep(at - loop.time())
            await call.write(api.StreamPosesRequest(batch=api.PoseBatch(
                poses=straight(poses, first=sequence))))
            sequence, at = sequence + poses, at + every
        await call.done_writing()
        await reader
        assert self.acknowledged == sequence - 1, (self.acknowledged, sequence)

    async def _read(self, call):
        async for response in call:
            if response.WhichOneof("message") == "ack":
                self.acknowledged = response.ack.durable_sequence

    async def close(self):
        await self._channel.close()


async def measure(cluster, poses, count, rate, seconds):
    """CPU seconds a message: revisitd, Envoy, PostgreSQL; and messages a second."""
    parts = (
        lambda: processor_seconds(cluster.servers[0].process.pid),
        lambda: processor_seconds(cluster.envoy.process.pid),
        lambda: seconds_with_children(cluster.postgres.process.pid))
    credentials = grpc.ssl_channel_credentials(cluster.authorities.read_bytes())
    vehicles = [Vehicle(cluster.envoy.address, credentials,
                        f"poses-{poses}-rate-{rate}-{i}") for i in range(count)]
    for vehicle in vehicles:
        await vehicle.create()
    loop = asyncio.get_running_loop()
    every = count / rate
    end = loop.time() + WARM_SECONDS + seconds + 0.5
    drives = [asyncio.create_task(vehicle.drive(poses, every * i / count, every, end))
              for i, vehicle in enumerate(vehicles)]
    await asyncio.sleep(WARM_SECONDS)

    def look():
        return (loop.time(), sum(vehicle.acknowledged for vehicle in vehicles),
                [part() for part in parts])

    begun, acknowledged, before = look()
    await asyncio.sleep(seconds)
    ended, acknowledged_then, after = look()
    await asyncio.gather(*drives)
    for vehicle in vehicles:
        await vehicle.close()
    messages = (acknowledged_then - acknowledged) / poses
    return ([(b - a) / messages for a, b in zip(before, after)],
            messages / (ended - begun))


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=10.0)
    chosen = parser.parse_args()
    envoy = private_cluster.find_envoy()
    if envoy is None or private_cluster.find_postgres() is None:
        print("there is no Envoy or no PostgreSQL: tests/run installs them",
              file=sys.stderr)
        return 77
    table = tables.Table(
        "CPU time of each part, microseconds a message (a pose)",
        ("poses a message", "messages a second", "revisitd", "Envoy", "PostgreSQL"))
    for poses, count, rate in LOADS:
        with directory_of_cluster() as directory, \
                private_cluster.Processes(directory) as processes:
            cluster = private_cluster.PrivateCluster(processes, BIN, 1, envoy)
            costs, came = asyncio.run(measure(
                cluster, poses, count, rate, chosen.seconds))
        table.add(**{"poses a message": poses, "messages a second": round(came),
                     **{part: f"{1e6 * cost:.0f} ({1e6 * cost / poses:.1f})"
                        for part, cost in zip(("revisitd", "Envoy", "PostgreSQL"),
                                              costs)}})
    print(table.text())
    return 0


if __name__ == "__main__":
    sys.exit(main())
