"""The real Envoy with the configuration of deploy/edge in front of the real
server: callers are served through it, and what strangers can do costs neither
of both more than is promised."""

import json
import signal
import ssl

import grpc
import pytest

import attacks
import killed_server
from envoy_proxy import Envoy, replaced, skip_without_envoy
from identities import Authority, TokenKey, bearer, key_set, replace
from raw_http2 import RawConnection
from revisit_server import Server, free_port
from stubs import ROOT, PoseGraphServiceStub, api
from wire import PoseStream, straight

CONFIGURATION = ROOT / "deploy/edge/envoy.yaml"
# Bytes as promised: of one connection, and of all.
MB_OF_ONE, MB_OF_ALL = 64, 256
CONNECTIONS = 40


@pytest.fixture(scope="module", autouse=True)
def envoy():
    skip_without_envoy()


class Edge:
    """Envoy, and revisitd behind it."""

    def __init__(self, directory):
        self.key = TokenKey("ES256", "edge")
        self.authority = Authority()
        keys = replace(directory / "keys.json", key_set(self.key))
        certificate = self.authority.issue_for_server()
        replace(directory / "edge.pem", certificate.pem)
        replace(directory / "edge.key", certificate.key_pem)
        policy = replace(directory / "policy.json", json.dumps({
            "version": 1,
            "tenants": [{"name": "acme", "vehicle_prefix": "acme-"}],
            "grants": [{"token_subject": "acme", "tenant": "acme",
                        "vehicles": ["*"],
                        "verbs": ["read", "write", "admin"]}]}))
        self.flags = [
            "--token-keys", keys, "--token-issuer", "https://login.example",
            "--token-audience", "revisit", "--policy", policy,
            "--log-level=warning"]
        self.directory = directory
        self.server_port = free_port()
        self.start_server()
        port = free_port()
        self.envoy = Envoy(directory, replaced(CONFIGURATION.read_text(), {
            "/etc/revisit": directory,
            "address: 0.0.0.0, port_value: 50051":
                f"address: 127.0.0.1, port_value: {port}",
            "port_value: 50052": f"port_value: {self.server_port}"}), port)
        self.tls = ssl.create_default_context(
            cadata=self.authority.pem.decode())
        self.tls.set_alpn_protocols(["h2"])

    def start_server(self):
        self.server = Server(self.directory / "store", *self.flags,
                             listen=f"127.0.0.1:{self.server_port}")

    def channel(self):
        return grpc.secure_channel(
            self.envoy.address,
            grpc.ssl_channel_credentials(self.authority.pem),
            options=[("grpc.use_local_subchannel_pool", 1)])

    def connect(self, **more):
        return RawConnection(self.envoy.port, tls=self.tls, **more)

    @property
    def pids(self):
        return self.envoy.pid, self.server.pid

    def close(self):
        self.envoy.close()
        self.server.close()


@pytest.fixture
def edge(tmp_path):
    running = Edge(tmp_path)
    yield running
    try:
        assert running.envoy.is_running(), running.envoy.log()
        assert running.server.is_running()
    finally:
        running.close()


def call_as_acme(edge, channel, sequence):
    stub = PoseGraphServiceStub(channel)
    metadata = bearer(edge.key.token("acme"))
    if sequence == 1:
        stub.CreateVehicle(
            api.CreateVehicleRequest(vehicle_id="acme-1"), metadata=metadata,
            timeout=20)
    ack = stub.AppendPoses(api.AppendPosesRequest(
        vehicle="vehicles/acme-1", poses=straight(sequence)[sequence - 1:]),
        metadata=metadata, timeout=20).ack
    assert ack.durable_sequence == sequence


def test_callers_are_served_through_it_and_strangers_answered_by_it(edge):
    # From here on each call has a line in the log.
    edge.server.process.send_signal(signal.SIGUSR2)
    edge.server.logged("log_level name=info")
    with edge.channel() as channel:
        call_as_acme(edge, channel, 1)
        stub = PoseGraphServiceStub(channel)
        for metadata in ((), bearer(TokenKey("ES256", "edge").token("acme"))):
            with pytest.raises(grpc.RpcError) as raised:
                stub.GetServerInfo(api.GetServerInfoRequest(),
                                   metadata=metadata, timeout=20)
            assert raised.value.code() == grpc.StatusCode.UNAUTHENTICATED
        call_as_acme(edge, channel, 2)
    # What came before a call is in the log before it.
    edge.server.logged("method=AppendPoses", 2)
    assert "UNAUTHENTICATED" not in edge.server.log()


def test_streams_go_on_when_the_server_dies_behind_it(edge, tmp_path):
    token = edge.key.token("acme")
    metadata = bearer(token)
    flags = ["--create", "--server", edge.envoy.address,
             "--tls-ca", replace(tmp_path / "ca.pem", edge.authority.pem),
             "--token-file", replace(tmp_path / "token", token)]
    drive = killed_server.write_drive(tmp_path / "drive.csv")
    with edge.channel() as channel:
        stub = PoseGraphServiceStub(channel)
        stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id="acme-idle"),
                           metadata=metadata, timeout=20)
        with PoseStream(stub, "vehicles/acme-idle", metadata=metadata) as idle:
            idle.receive_kind("opened")
            summary = killed_server.stream_through_a_kill(
                drive, "acme-1", flags,
                lambda: stub.GetVehicle(
                    api.GetVehicleRequest(name="vehicles/acme-1"),
                    metadata=metadata, timeout=20).vehicle.durable_sequence,
                edge.server.kill, edge.start_server)
            # How Envoy tells of it.
            with pytest.raises(grpc.RpcError) as raised:
                idle.receive()
            killed_server.check_is_reset(raised.value)
    edge.server.close()
    # Nobody asks the next one's callers who they are.
    with Server(tmp_path / "store") as server:
        killed_server.check_all_is_stored_once(
            summary, server.stub(), "vehicles/acme-1")
    edge.start_server()


@pytest.mark.release_build
@pytest.mark.parametrize("attack, connections, promised", [
    *((attack, 1, MB_OF_ONE) for attack in attacks.ATTACKS),
    *((attack, CONNECTIONS, MB_OF_ALL) for attack in attacks.ATTACKS)])
def test_attack_costs_no_more_than_is_promised(
        attack, connections, promised, edge):
    with edge.channel() as channel:
        call_as_acme(edge, channel, 1)
        with attacks.Watcher(*edge.pids) as watcher:
            attacks.run(attacks.ATTACKS[attack], edge.connect, connections)
        print(f"{attack}, {connections}: Envoy "
              f"{watcher.most[0] / 1e6:.0f} MB, revisitd "
              f"{watcher.most[1] / 1e6:.0f} MB")
        assert sum(watcher.most) < promised * 1e6
        # The caller who was there before.
        call_as_acme(edge, channel, 2)


@pytest.mark.release_build
def test_half_open_connections_cost_no_more_than_is_promised(edge):
    with attacks.Watcher(*edge.pids) as watcher:
        with attacks.half_open(edge.envoy.port, 500), \
                attacks.half_open(edge.envoy.port, 500, b"\x16\x03\x01\x02\x00\x01"):
            with edge.channel() as channel:
                call_as_acme(edge, channel, 1)
    print(f"{watcher.most[0] / 1e6:.0f} MB")
    assert sum(watcher.most) < MB_OF_ALL * 1e6
