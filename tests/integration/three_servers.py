"""Three servers that share a database, and calls that any of them may answer."""

import time

import grpc

from revisit_server import START_SECONDS, Server, free_port
from stubs import PoseGraphServiceStub, api

SERVERS = 3
LEASE_SECONDS = 1


class Cluster:
    """Servers over one database, each of which is started again when it is killed."""

    def __init__(self, url, directory):
        self._url = url
        self._directory = directory
        self._ports = [free_port() for _ in range(SERVERS)]
        self.servers = [None] * SERVERS
        for number in range(SERVERS):
            self.start(number)

    def start(self, number):
        address = f"127.0.0.1:{self._ports[number]}"
        self.servers[number] = Server(
            self._url, "--advertise-address", address,
            "--lease-seconds", LEASE_SECONDS, listen=address,
            log_path=self._directory / f"server-{number}.log")

    def kill(self, number):
        self.servers[number].kill()

    def end(self, number):
        """As an operator asks for it: its vehicles go to the others."""
        server = self.servers[number]
        server.process.terminate()
        assert server.process.wait(2 * START_SECONDS) == 0, server.log()[-3000:]
        server.close()

    def addresses(self):
        return [server.address for server in self.servers if server.is_running()]

    def close(self):
        for server in self.servers:
            server.close()


def served(cluster, rng, call):
    """What any server answers that has the vehicle, or gets it: others say who has it,
    and one that was just killed says nothing."""
    deadline = time.monotonic() + 2 * START_SECONDS
    while True:
        address = rng.choice(cluster.addresses())
        with grpc.insecure_channel(address) as channel:
            try:
                return call(PoseGraphServiceStub(channel))
            except grpc.RpcError as error:
                assert error.code() in (
                    grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.ABORTED,
                    grpc.StatusCode.DEADLINE_EXCEEDED), error
                assert time.monotonic() < deadline, error
        time.sleep(0.02)


def vehicle_of(cluster, rng, name):
    return served(cluster, rng, lambda stub: stub.GetVehicle(
        api.GetVehicleRequest(name=name), timeout=10)).vehicle


def append_up_to(cluster, rng, name, poses):
    """Appends what is missing of these poses, at any server, so that vehicles move."""
    while (durable := vehicle_of(cluster, rng, name).durable_sequence) < len(poses):
        served(cluster, rng, lambda stub: stub.AppendPoses(
            api.AppendPosesRequest(vehicle=name,
                                   poses=poses[durable:durable + 1000]),
            timeout=10))
