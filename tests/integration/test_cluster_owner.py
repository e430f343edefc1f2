"""Envoy in front of servers that share a PostgreSQL: a vehicle that another server owns
than the one that Envoy thinks of is found all the same."""

import base64
import re

import grpc
import pytest

from envoy_proxy import ENVOY, directory_of_cluster, skip_without_envoy
from own_postgres import exit_without_postgres, private_cluster
from revisit_server import BIN, run, wait_until
from stubs import PoseGraphServiceStub, api
from wire import PoseStream, append, decode_failure, straight

VEHICLES = [f"vehicle-{i}" for i in range(12)]


@pytest.fixture(scope="module", autouse=True)
def needed_programs():
    skip_without_envoy()
    exit_without_postgres()


@pytest.fixture(scope="module")
def cluster():
    with directory_of_cluster() as directory, \
            private_cluster.Processes(directory) as processes:
        yield private_cluster.PrivateCluster(processes, BIN, 3, ENVOY)


@pytest.fixture(scope="module")
def owner(cluster):
    """The server that was asked first for all vehicles, and so has them, for as long as
    its lease at least."""
    server = cluster.servers[0]

    def read(name):
        return (cluster.authorities.parent / name).read_bytes()

    with grpc.secure_channel(server.address, grpc.ssl_channel_credentials(
            read("servers-ca.pem"), read("envoy.key"), read("envoy.pem")), options=[
                ("grpc.ssl_target_name_override", "revisitd")]) as channel:
        stub = PoseGraphServiceStub(channel)
        for vehicle in VEHICLES:
            stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id=vehicle),
                               timeout=20)
            append(stub, f"vehicles/{vehicle}", straight(3), timeout=20)
    return server


@pytest.fixture(scope="module")
def stub(cluster):
    with grpc.secure_channel(cluster.envoy.address, grpc.ssl_channel_credentials(
            cluster.authorities.read_bytes())) as channel:
        yield PoseGraphServiceStub(channel)


@pytest.fixture(scope="module")
def elsewhere(owner, stub):
    """Vehicles whose calls Envoy sends to another server than the owner."""
    failures = {}
    for vehicle in VEHICLES:
        try:
            stub.GetVehicle(api.GetVehicleRequest(name=f"vehicles/{vehicle}"),
                            timeout=20)
        except grpc.RpcError as error:
            failures[vehicle] = decode_failure(error)
    assert {(failure.reason, failure.metadata["owner"])
            for failure in failures.values()} == {("NOT_OWNER", owner.address)}
    return list(failures)


def test_header_leads_to_the_owner(owner, stub, elsewhere):
    header = ("x-revisit-owner",
              base64.b64encode(owner.address.encode()).decode())
    for vehicle in elsewhere:
        assert append(stub, f"vehicles/{vehicle}", straight(3), timeout=20,
                      metadata=(header,)).durable_sequence == 3


def test_command_line_finds_the_owner(cluster, owner, elsewhere):
    vehicle = elsewhere[0]
    result = run("revisit", "--server", cluster.envoy.address,
                 "--tls-ca", cluster.authorities, "show", "--vehicle", vehicle)
    assert result.returncode == 0, result.stderr
    wait_until(lambda: re.search(
        rf"method=ExportPoseGraph vehicle={vehicle} .*code=OK",
        owner.process.log()), "call at the owner")


def test_vehicle_comes_to_where_it_is_asked_for(stub, elsewhere):
    """Whoever knows nothing of owners waits for some seconds at most."""

    def streams(vehicle):
        with PoseStream(stub, f"vehicles/{vehicle}") as stream:
            try:
                return stream.receive_kind("opened").durable_sequence == 3
            except grpc.RpcError as error:
                assert decode_failure(error).reason == "NOT_OWNER"
                return False

    for vehicle in elsewhere:
        wait_until(lambda: streams(vehicle), f"owner of {vehicle} at hand")
