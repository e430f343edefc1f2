"""The real Envoy with the configuration of deploy/cluster in front of three real
servers: every call about a vehicle reaches the same server, whoever sends it.

The servers have a store each, so that a call at another server than its vehicle's
does not find the vehicle."""

import base64
import collections
import importlib
import json
import os
import pathlib
import random
import re
import shutil
import signal
import subprocess
import sys
import time
import uuid

import grpc
import pytest

from envoy_proxy import ENVOY, replaced, skip_without_envoy
from identities import Authority, TokenKey, bearer, key_set, replace
from killed_server import check_is_reset
from revisit_server import RUN_SECONDS, Server, wait_until
from stubs import PROTO, ROOT, PoseGraphServiceStub, api
from wire import PoseStream, append, decode_failure, straight

CLUSTER = ROOT / "deploy/cluster"
EDGE = ROOT / "deploy/edge/envoy.yaml"
GRPCURL = pathlib.Path(os.environ.get("REVISIT_TEST_GRPCURL",
                                      ROOT / "build/tools/grpcurl"))
SERVICE = "revisit.v1.PoseGraphService"

sys.path.insert(0, str(CLUSTER))
private_cluster = importlib.import_module("private_cluster")
update_routing = importlib.import_module("update_routing")


@pytest.fixture(scope="module", autouse=True)
def envoy():
    skip_without_envoy()


class Cluster:
    """Envoy, and servers that only Envoy may call."""

    def __init__(self, directory, listed=3, before="", notice_seconds=0):
        """Of three servers, the first `listed` are known to Envoy. `before` is a
        filter of Envoy that comes before all others."""
        self.directory = directory
        self.authority = Authority()
        for name, certificate in (
                ("edge", self.authority.issue_for_server()),
                ("server", self.authority.issue("revisitd")),
                ("envoy", self.authority.issue("envoy"))):
            replace(directory / f"{name}.pem", certificate.pem)
            replace(directory / f"{name}.key", certificate.key_pem)
        self.authorities = replace(directory / "servers-ca.pem",
                                   self.authority.pem)
        self.key = TokenKey("ES256", "cluster")
        verbs = ["read", "write", "admin"]
        flags = [
            "--tls-cert", directory / "server.pem",
            "--tls-key", directory / "server.key",
            "--tls-client-ca", self.authorities,
            "--token-keys", replace(directory / "keys.json", key_set(self.key)),
            "--token-issuer", "https://login.example",
            "--token-audience", "revisit",
            "--policy", replace(directory / "policy.json", json.dumps({
                "version": 1,
                "tenants": [{"name": "acme", "vehicle_prefix": "acme-"}],
                "grants": [
                    {"certificate_dns": "envoy", "tenant": "*",
                     "vehicles": ["*"], "verbs": verbs},
                    {"token_subject": "acme", "tenant": "acme",
                     "vehicles": ["*"], "verbs": verbs}]})),
            "--drain-notice-seconds", notice_seconds]
        self.servers = []
        self._processes = private_cluster.Processes(directory)
        try:
            for number in range(3):
                self.servers.append(
                    Server(directory / f"store{number}", *flags))
            self.envoy = private_cluster.Envoy(
                self._processes, ENVOY, self.addresses()[:listed], before)
        except BaseException:
            self.close()
            raise

    def addresses(self):
        return [server.address for server in self.servers]

    def close(self):
        self._processes.stop()
        for server in self.servers:
            if server.is_running():
                server.kill()

    def channel(self, envoy=None):
        return grpc.secure_channel(
            (envoy or self.envoy).address,
            grpc.ssl_channel_credentials(self.authority.pem),
            options=[("grpc.use_local_subchannel_pool", 1)])

    def direct_channel(self, server):
        def read(name):
            return (self.directory / name).read_bytes()

        return grpc.secure_channel(server.address, grpc.ssl_channel_credentials(
            self.authority.pem, read("envoy.key"), read("envoy.pem")), options=[
                ("grpc.ssl_target_name_override", "revisitd")])

    def wait_until_healthy(self, servers):
        wait_until(lambda: self.envoy.healthy() == servers,
                   f"{servers} healthy servers")

    def number_of(self, request_ids):
        """By request id, the number of the server that had the call."""

        def found():
            numbers = {}
            for number, server in enumerate(self.servers):
                numbers |= dict.fromkeys(re.findall(
                    r" call request_id=(\S+)", server.log()), number)
            return all(request_id in numbers
                       for request_id in request_ids) and numbers

        numbers = wait_until(found, "lines of all calls in the logs")
        return {request_id: numbers[request_id] for request_id in request_ids}

    def where(self, vehicles, channel, *metadata):
        """By vehicle, the number of the server that a call about it reaches."""
        stub = PoseGraphServiceStub(channel)
        asked = {}
        for vehicle in vehicles:
            asked[vehicle] = uuid.uuid4().hex
            with pytest.raises(grpc.RpcError) as raised:
                stub.GetVehicle(
                    api.GetVehicleRequest(name=f"vehicles/{vehicle}"),
                    metadata=(("x-request-id", asked[vehicle]), *metadata),
                    timeout=20)
            assert raised.value.code() == grpc.StatusCode.NOT_FOUND, (
                raised.value)
        numbers = self.number_of(asked.values())
        return {vehicle: numbers[asked[vehicle]] for vehicle in vehicles}


def run_cluster(directory, **arguments):
    running = Cluster(directory, **arguments)
    try:
        yield running
        assert running.envoy.process.is_running(), running.envoy.process.log()
    finally:
        running.close()


@pytest.fixture(scope="module")
def cluster(tmp_path_factory):
    """For tests that leave all servers as they are."""
    yield from run_cluster(tmp_path_factory.mktemp("cluster"))


@pytest.fixture(scope="module")
def channel(cluster):
    with cluster.channel() as opened:
        yield opened


# What Envoy is told of the API.


def test_routing_is_that_of_the_protos():
    text = (CLUSTER / "envoy.yaml").read_text()
    routing = update_routing.Routing(update_routing.compile_protos())
    assert text == update_routing.updated(text, routing), (
        "run deploy/cluster/update_routing.py")


@pytest.mark.parametrize("request_fields, outcome", [
    ("string name = 1;", "name"),
    ("Vehicle vehicle = 1;", "vehicle.name"),
    ("string car = 1;", None),
    ("", None),
    ("string name = 1; string parent = 2;", None)])
def test_new_method_has_to_name_its_vehicle(tmp_path, request_fields, outcome):
    changed = shutil.copytree(PROTO, tmp_path / "proto")
    path = changed / update_routing.SERVICE_PROTO
    method = "  rpc GetServerInfo("
    path.write_text(replaced(path.read_text(), {
        method: "  rpc Fresh(FreshRequest) returns (GetVehicleResponse);\n"
        + method}) + f"message FreshRequest {{ {request_fields} }}\n")
    descriptors = update_routing.compile_protos(changed)
    if outcome is None:
        with pytest.raises(ValueError, match="Fresh names a vehicle in"):
            update_routing.Routing(descriptors)
        return
    routing = update_routing.Routing(descriptors)
    assert routing.fields[f"{SERVICE}.Fresh"] == outcome
    text = (CLUSTER / "envoy.yaml").read_text()
    assert text != update_routing.updated(text, routing)


def test_policy_of_the_documentation_is_that_of_the_demo():
    policy = re.search(r"^```json\n(.*?)^```",
                       (ROOT / "docs/scale.md").read_text(),
                       re.DOTALL | re.MULTILINE).group(1)
    assert json.loads(policy) == private_cluster.POLICY


# Where calls go.

PLACE = ('"sequence": %d, "local": {"x_meters": %d}, "heading_radians": 0,'
         ' "covariance": {"form": "COVARIANCE_FORM_PLANAR_6", "values":'
         ' [0.01, 0, 0, 0.01, 0, 0.0001]}')
POSES = ", ".join(f"{{{PLACE % (i, 5 * i)}}}" for i in range(1, 5))
PAIR = '{"query_sequence": 4, "matched_sequence": 1}'
# By method, its requests in the form of grpcurl, in an order in which all of them
# are answered with OK but for those below.
REQUESTS = {
    "CreateVehicle": '{"vehicle_id": "ID"}',
    "GetVehicle": '{"name": "vehicles/ID"}',
    "GetCheck": '{"name": "vehicles/ID/checks/4"}',
    "ListChecks": '{"parent": "vehicles/ID"}',
    "UpdateVehicle": '{"vehicle": {"name": "vehicles/ID", "display_name": "x"},'
                     ' "update_mask": {"paths": ["display_name"]}}',
    "AppendPoses": f'{{"vehicle": "vehicles/ID", "poses": [{POSES}]}}',
    "StreamPoses": '{"open": {"vehicle": "vehicles/ID"}}'
                   f'{{"batch": {{"poses": [{POSES}]}}}}',
    "RevisePoses": '{"vehicle": "vehicles/ID", "poses": [{%s}]} {"poses": [{%s}]}'
                   % (PLACE % (1, 6), PLACE % (2, 11)),
    "FindCandidates": '{"vehicle": "vehicles/ID"}',
    "AddLoopClosure": '{"parent": "vehicles/ID", "loop_closure_id": "one",'
                      f' "loop_closure": {PAIR}}}',
    "ListLoopClosures": '{"parent": "vehicles/ID"}',
    "FindContradictions": '{"vehicle": "vehicles/ID"}',
    "DeleteLoopClosure": '{"name": "vehicles/ID/loopClosures/one"}',
    "RejectCandidate": '{"parent": "vehicles/ID", "rejected_candidate_id": "one",'
                       f' "rejected_candidate": {PAIR}}}',
    "ListRejectedCandidates": '{"parent": "vehicles/ID"}',
    "DeleteRejectedCandidate": '{"name": "vehicles/ID/rejectedCandidates/one"}',
    "ListDeletedPosePairs": '{"parent": "vehicles/ID"}',
    "ListPoses": '{"parent": "vehicles/ID"}',
    "ListRecordings": '{"parent": "vehicles/ID"}',
    "ExportPoseGraph": '{"vehicle": "vehicles/ID"}',
    "AcceptDataLoss": '{"name": "vehicles/ID", "durable_sequence": 4}',
    "DeleteVehicle": '{"name": "vehicles/ID"}',
}
# Codes with which the server that has the vehicle answers.
REASONS = {"AcceptDataLoss": "NO_DATA_LOSS", "GetCheck": "CHECK_NOT_FOUND"}


@pytest.fixture
def grpcurl(cluster):
    """Calls a method as anybody would; answers the request id and the exit code."""
    if not GRPCURL.exists():
        pytest.skip(f"there is no grpcurl at {GRPCURL}: tests/run builds it")

    def call(method, request):
        result = subprocess.run(
            [GRPCURL, "-cacert", cluster.authorities, "-v", "-d", request,
             cluster.envoy.address, f"{SERVICE}/{method}"],
            capture_output=True, text=True, timeout=RUN_SECONDS,
            check=False)
        output = result.stdout + result.stderr
        found = re.search(r"^x-request-id: (\S+)$", output, re.MULTILINE)
        assert found, output
        return found.group(1), result.returncode, output

    return call


def test_every_method_is_in_the_table_of_requests():
    file, = [file for file in update_routing.compile_protos().file
             if file.name == update_routing.SERVICE_PROTO]
    methods = {method.name for method in file.service[0].method}
    assert set(REQUESTS) == methods - update_routing.ABOUT_NO_VEHICLE


@pytest.mark.parametrize("vehicle", ["one", "two-2", "3"])
def test_every_method_reaches_the_same_server(cluster, grpcurl, vehicle):
    request_ids = {}
    for method, request in REQUESTS.items():
        request_ids[method], code, output = grpcurl(
            method, request.replace("ID", vehicle))
        if method in REASONS:
            assert f'"reason": "{REASONS[method]}"' in output
        else:
            assert code == 0, output
    numbers = cluster.number_of(request_ids.values())
    assert len(set(numbers.values())) == 1, {
        method: numbers[request_ids[method]] for method in REQUESTS}


def test_vehicles_are_divided_among_all_servers(cluster, channel):
    where = cluster.where([f"vehicle-{i}" for i in range(90)], channel)
    counts = collections.Counter(where.values())
    assert set(counts) == {0, 1, 2}
    assert min(counts.values()) > 10


def test_all_envoys_divide_them_alike(cluster, channel, tmp_path):
    for suffix in ("pem", "key"):
        for file in cluster.directory.glob(f"*.{suffix}"):
            shutil.copy(file, tmp_path)
    vehicles = [f"vehicle-{i}" for i in range(60)]
    with private_cluster.Processes(tmp_path) as processes:
        # Whatever the order in which the servers are listed.
        other = private_cluster.Envoy(processes, ENVOY, cluster.addresses()[::-1])
        with cluster.channel(other) as through_other:
            assert cluster.where(vehicles, through_other) == cluster.where(
                vehicles, channel)


def test_calls_about_no_vehicle_are_divided_too(cluster, channel):
    stub = PoseGraphServiceStub(channel)
    for call, request in ((stub.ListVehicles, api.ListVehiclesRequest()),
                          (stub.GetServerInfo, api.GetServerInfoRequest())):
        request_ids = [uuid.uuid4().hex for _ in range(30)]
        for request_id in request_ids:
            call(request, metadata=(("x-request-id", request_id),), timeout=20)
        assert set(cluster.number_of(request_ids).values()) == {0, 1, 2}


def test_client_does_not_say_where_a_vehicle_belongs(cluster, channel):
    vehicles = [f"vehicle-{i}" for i in range(20)]
    assert cluster.where(vehicles, channel) == cluster.where(
        vehicles, channel, ("x-revisit-route", '{"name":["vehicles/other"]}'))


def address_of(server):
    return base64.b64encode(server.address.encode()).decode()


def test_client_says_who_owns_a_vehicle(cluster, channel):
    vehicles = [f"vehicle-{i}" for i in range(10)]
    for number, server in enumerate(cluster.servers):
        where = cluster.where(vehicles, channel,
                              ("x-revisit-owner", address_of(server)))
        assert set(where.values()) == {number}


@pytest.mark.parametrize("owner", [
    base64.b64encode(b"127.0.0.1:1").decode(),
    base64.b64encode(b"nonsense").decode(), "%", ""])
def test_owner_that_is_no_server_is_not_believed(cluster, channel, owner):
    vehicles = [f"vehicle-{i}" for i in range(10)]
    assert cluster.where(vehicles, channel) == cluster.where(
        vehicles, channel, ("x-revisit-owner", owner))


def test_answers_do_not_tell_addresses_of_servers(cluster, channel):
    stub = PoseGraphServiceStub(channel)
    call = stub.GetServerInfo.with_call(api.GetServerInfoRequest(), timeout=20)[1]
    told = [*call.initial_metadata(), *call.trailing_metadata()]
    assert "x-request-id" in dict(told)
    assert "x-revisit-owner" not in dict(told)
    for server in cluster.servers:
        assert str(server.port) not in str(told)


# Codes with which calls are answered.


def answer_of(channel, method, request):
    """Code, message and whether there are details."""
    call = channel.unary_unary(f"/{SERVICE}/{method}", request_serializer=bytes,
                               response_deserializer=bytes)
    try:
        call(request, timeout=20)
        return grpc.StatusCode.OK
    except grpc.RpcError as error:
        return (error.code(), error.details(), "grpc-status-details-bin"
                in dict(error.trailing_metadata() or ()))


def test_malformed_messages_get_the_answers_of_the_server(
        cluster, channel, seed):
    chance = random.Random(seed)
    sound = [(method, request.SerializeToString()) for method, request in [
        ("GetVehicle", api.GetVehicleRequest(name="vehicles/none")),
        ("UpdateVehicle", api.UpdateVehicleRequest(vehicle=api.Vehicle(
            name="vehicles/none", labels={"a": "b"}))),
        ("AppendPoses", api.AppendPosesRequest(
            vehicle="vehicles/none", poses=straight(2))),
        ("RevisePoses", api.RevisePosesRequest(
            vehicle="vehicles/none", poses=straight(2)))]]
    with cluster.direct_channel(cluster.servers[0]) as direct:
        for _ in range(300):
            method, request = chance.choice(sound)
            request = bytearray(request)
            for _ in range(chance.randrange(4)):
                place = chance.randrange(len(request) + 1)
                chance.choice([
                    lambda: request.insert(place, chance.randrange(256)),
                    lambda: request.__delitem__(slice(max(place, 1), None)),
                    lambda: request.__setitem__(
                        slice(place, place + 1), [chance.randrange(256)])])()
            assert answer_of(channel, method, request) == answer_of(
                direct, method, request), (method, bytes(request))


def test_messages_may_be_as_large_as_the_server_takes(cluster, channel):
    for size in (1 << 16, 1 << 20, 4_000_000, 4_210_000):
        request = api.AppendPosesRequest(
            vehicle="vehicles/none", vehicle_uid="x" * size).SerializeToString()
        with cluster.direct_channel(cluster.servers[0]) as direct:
            assert answer_of(channel, "AppendPoses", request) == answer_of(
                direct, "AppendPoses", request)


def test_vehicle_of_any_length_ends_no_call_of_others(cluster, channel):
    stub = PoseGraphServiceStub(channel)
    stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id="beside"), timeout=20)
    with PoseStream(stub, "vehicles/beside") as stream:
        stream.receive_kind("opened")
        for name in ("vehicles/" + "a" * 1_000_000, "\n\x00\u20ac" * 1000):
            code, _, has_details = answer_of(
                channel, "GetVehicle",
                api.GetVehicleRequest(name=name).SerializeToString())
            assert (code, has_details) == (
                grpc.StatusCode.INVALID_ARGUMENT, True)
        stream.send(straight(3))
        assert stream.receive_kind("ack").durable_sequence == 3


def test_quiet_stream_stays(cluster, channel):
    stub = PoseGraphServiceStub(channel)
    stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id="quiet"), timeout=20)
    with PoseStream(stub, "vehicles/quiet", timeout=120) as stream:
        stream.receive_kind("opened")
        # Envoy has pinged the server more often than gRPC forgives at once.
        time.sleep(40)
        stream.send(straight(3))
        assert stream.receive_kind("ack").durable_sequence == 3


# Servers that come and go.


@pytest.fixture
def own_cluster(tmp_path):
    yield from run_cluster(tmp_path)


def of_server(where, number):
    return [vehicle for vehicle, at in where.items() if at == number]


def test_calls_go_to_the_next_server_when_one_is_killed(own_cluster):
    with own_cluster.channel() as channel:
        vehicles = [f"vehicle-{i}" for i in range(60)]
        before = own_cluster.where(vehicles, channel)
        victim = before[vehicles[0]]
        stub = PoseGraphServiceStub(channel)
        stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id=vehicles[0]),
                           timeout=20)
        with PoseStream(stub, f"vehicles/{vehicles[0]}") as stream:
            stream.receive_kind("opened")
            own_cluster.servers[victim].kill()
            after = own_cluster.where(of_server(before, victim), channel)
            assert victim not in after.values()
            # They were sent to it first, unless this took so long that Envoy had
            # asked for its health before.
            [said] = [host for host in own_cluster.envoy.hosts()
                      if host["address"]["socket_address"]["port_value"]
                      == own_cluster.servers[victim].port]
            errors = sum(int(stat.get("value", 0)) for stat in said["stats"]
                         if stat["name"] == "rq_error")
            assert errors > 0 or said["health_status"].get(
                "failed_active_health_check")
            with pytest.raises(grpc.RpcError) as raised:
                stream.receive()
            check_is_reset(raised.value)
        own_cluster.wait_until_healthy(2)
        owner = ("x-revisit-owner", address_of(own_cluster.servers[victim]))
        for metadata in ((), (owner,)):
            at_last = own_cluster.where(vehicles, channel, *metadata)
            assert victim not in at_last.values()
            # Vehicles of others stay where they are.
            assert sum(at_last[vehicle] != before[vehicle] != victim
                       for vehicle in vehicles) <= 1


def test_server_that_stops_gets_no_new_calls_and_ends_its_streams(tmp_path):
    vehicles = [f"vehicle-{i}" for i in range(30)]
    for own in run_cluster(tmp_path, notice_seconds=600):
        with own.channel() as channel:
            before = own.where(vehicles, channel)
            number = before[vehicles[0]]
            stub = PoseGraphServiceStub(channel)
            stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id=vehicles[0]),
                               timeout=20)
            with PoseStream(stub, f"vehicles/{vehicles[0]}") as stream:
                stream.receive_kind("opened")
                own.servers[number].process.send_signal(signal.SIGTERM)
                own.wait_until_healthy(2)
                after = own.where(of_server(before, number)[1:], channel)
                assert number not in after.values()
                # Nothing has cut the stream meanwhile.
                stream.send(straight(3))
                assert stream.receive_kind("ack").durable_sequence == 3
                # The second one ends the notice.
                own.servers[number].process.send_signal(signal.SIGTERM)
                with pytest.raises(grpc.RpcError) as raised:
                    stream.receive()
                assert decode_failure(raised.value).reason == "SERVER_DRAINING"


def test_servers_answer_for_themselves_when_none_is_healthy(tmp_path):
    for own in run_cluster(tmp_path, notice_seconds=600):
        with own.channel() as channel:
            vehicles = [f"vehicle-{i}" for i in range(30)]
            before = own.where(vehicles, channel)
            for server in own.servers:
                server.process.send_signal(signal.SIGTERM)
            own.wait_until_healthy(0)
            # Else Envoy would answer, and say nothing of why nor of when to come again.
            wait_until(lambda: own.where(vehicles, channel) == before,
                       "calls at the servers to which they belong")


def test_server_that_is_added_takes_vehicles_and_moves_no_others(tmp_path):
    vehicles = [f"vehicle-{i}" for i in range(200)]
    for small in run_cluster(tmp_path, listed=2):
        with small.channel() as channel:
            two = small.where(vehicles, channel)
            assert set(two.values()) == {0, 1}
            small.envoy.list_servers(small.addresses())
            wait_until(lambda: 2 in small.where(vehicles, channel).values(),
                       "calls at the new server")
            three = small.where(vehicles, channel)
            moved = {vehicle for vehicle in vehicles
                     if two[vehicle] != three[vehicle]}
            assert 0.2 < len(moved) / len(vehicles) < 0.47
            # Ports, and with them the tables, are others each time.
            assert len(moved - set(of_server(three, 2))) <= 1
            # One that is off the list stays until it stops.
            small.envoy.list_servers(small.addresses()[1:])
            # Envoy has the list, and counts on it no longer.
            small.wait_until_healthy(2)
            assert len(small.envoy.hosts()) == 3
            assert small.where(vehicles, channel) == three
            small.servers[0].kill()
            wait_until(lambda: len(small.envoy.hosts()) == 2,
                       "end of the one that is off the list")
            last = small.where(vehicles, channel)
            assert sum(last[vehicle] != three[vehicle] != 0
                       for vehicle in vehicles) <= 1


# Strangers.


def test_filter_of_the_edge_keeps_strangers_off(tmp_path):
    text = EDGE.read_text()
    tokens = text[text.index("          - name: envoy.filters.http.jwt_authn\n"):
                  text.index("          - name: envoy.filters.http.router\n")]
    tokens = tokens.replace("/etc/revisit", str(tmp_path))
    for guarded in run_cluster(tmp_path, before=tokens):
        with guarded.channel() as channel:
            stub = PoseGraphServiceStub(channel)
            stranger = bearer(TokenKey("ES256", "cluster").token("acme"))
            for metadata in ((), stranger):
                with pytest.raises(grpc.RpcError) as raised:
                    stub.GetServerInfo(api.GetServerInfoRequest(),
                                       metadata=metadata, timeout=20)
                assert raised.value.code() == grpc.StatusCode.UNAUTHENTICATED
            metadata = bearer(guarded.key.token("acme"))
            stub.CreateVehicle(
                api.CreateVehicleRequest(vehicle_id="acme-1"),
                metadata=metadata, timeout=20)
            assert append(stub, "vehicles/acme-1", straight(3),
                          metadata=metadata).durable_sequence == 3
            for server in guarded.servers:
                server.close()
                assert " stopped " in server.log()
                assert "UNAUTHENTICATED" not in server.log()
