"""Who calls in tests of security, and servers that ask for it: a plugin of pytest, for
its fixtures."""

import contextlib
import json

import grpc
import pytest

from identities import AUDIENCE, ISSUER, Authority, TokenKey, bearer, key_set, replace
from revisit_server import Server
from stubs import PoseGraphServiceStub, api

Code = grpc.StatusCode
USAGE = 64
SERVICE = api.GetServerInfoRequest.DESCRIPTOR.file.services_by_name[
    "PoseGraphService"]
METHODS = sorted(SERVICE.methods_by_name)

POLICY = {
    "version": 1,
    "tenants": [{"name": "acme", "vehicle_prefix": "acme-"},
                {"name": "umbra", "vehicle_prefix": "umbra-"}],
    "grants": [
        {"token_subject": "acme", "tenant": "acme", "vehicles": ["*"],
         "verbs": ["read", "write", "admin"]},
        {"token_subject": "umbra", "tenant": "umbra", "vehicles": ["*"],
         "verbs": ["read", "write", "admin"]},
        {"token_subject": "acme-reader", "tenant": "acme",
         "vehicles": ["*"], "verbs": ["read"]},
        {"token_subject": "acme-writer", "tenant": "acme",
         "vehicles": ["*"], "verbs": ["write"]},
        {"token_subject": "vehicle:*", "tenant": "acme",
         "vehicles": ["acme-{match}"], "verbs": ["read", "write"]},
        {"token_subject": "acme-few", "tenant": "acme",
         "vehicles": ["acme-1*", "acme-7"], "verbs": ["read"]},
        {"token_claim": {"name": "groups", "value": "operators"},
         "tenant": "*", "vehicles": ["*"],
         "verbs": ["read", "write", "admin"]},
        {"certificate_uri": "spiffe://fleet.example/acme/*", "tenant": "acme",
         "vehicles": ["acme-{match}"], "verbs": ["read", "write"]},
    ],
}


class Identities:
    """Files of keys, policy and certificates, and who is behind them."""

    def __init__(self, directory):
        self.directory = directory
        self.keys = [TokenKey("RS256", "rsa"), TokenKey("ES256", "ec"),
                     TokenKey("EdDSA", "ed")]
        self.key = self.keys[2]
        self.key_file = replace(directory / "keys.json", key_set(*self.keys))
        self.policy_file = replace(directory / "policy.json",
                                   json.dumps(POLICY))
        self.authority = Authority()
        self.authority_file = replace(directory / "ca.pem", self.authority.pem)
        self.certificate = self.authority.issue_for_server()
        self.certificate_file = directory / "server.pem"
        self.server_key_file = directory / "server.key"
        self.show(self.certificate)

    def show(self, certificate):
        replace(self.server_key_file, certificate.key_pem)
        replace(self.certificate_file, certificate.pem)

    @property
    def token_flags(self):
        return ["--token-keys", self.key_file, "--token-issuer", ISSUER,
                "--token-audience", AUDIENCE, "--token-leeway-seconds", 0,
                "--policy", self.policy_file, "--security-check-seconds", 0.1]

    @property
    def tls_flags(self):
        return ["--tls-cert", self.certificate_file,
                "--tls-key", self.server_key_file]

    @property
    def client_flags(self):
        return [*self.tls_flags, "--tls-client-ca", self.authority_file,
                "--policy", self.policy_file, "--security-check-seconds", 0.1]


class As:
    """The service as one caller sees it: each call brings the token."""

    def __init__(self, stub, token):
        self._stub = stub
        self.metadata = bearer(token) if token else ()

    def __getattr__(self, method):
        call = getattr(self._stub, method)

        def with_token(request, **fields):
            fields.setdefault("metadata", self.metadata)
            return call(request, **fields)

        return with_token


@pytest.fixture(scope="module")
def identities(tmp_path_factory):
    return Identities(tmp_path_factory.mktemp("identities"))


@pytest.fixture(scope="module")
def token_server(identities, tmp_path_factory):
    """Takes tokens, in plaintext."""
    with Server(tmp_path_factory.mktemp("tokens") / "store",
                *identities.token_flags) as running:
        yield running
        assert running.is_running(), running.log()


@pytest.fixture(scope="module")
def called_by(token_server, identities):
    """Makes the service as somebody sees it."""
    stub = token_server.stub()

    def make(subject, **claims):
        return As(stub, identities.key.token(subject, **claims))

    return make


@pytest.fixture(scope="module")
def tls_server(identities, tmp_path_factory):
    """Wants certificates of clients."""
    with Server(tmp_path_factory.mktemp("tls") / "store",
                *identities.client_flags) as running:
        yield running
        assert running.is_running(), running.log()


@contextlib.contextmanager
def secure_stub(server, authority_pem, certificate=None):
    credentials = grpc.ssl_channel_credentials(
        authority_pem, certificate and certificate.key_pem,
        certificate and certificate.pem)
    # Else channels of equal credentials would share a connection.
    with grpc.secure_channel(
            server.address, credentials,
            options=[("grpc.use_local_subchannel_pool", 1)]) as channel:
        yield PoseGraphServiceStub(channel)


def create(stub, vehicle_id):
    return stub.CreateVehicle(
        api.CreateVehicleRequest(vehicle_id=vehicle_id)).vehicle.name


def ask(stub):
    return stub.GetServerInfo(api.GetServerInfoRequest(), timeout=10)


def list_vehicles(stub, page_size):
    """(ids, page by page; the tokens between them)"""
    request = api.ListVehiclesRequest(page_size=page_size)
    pages, tokens = [], []
    while True:
        page = stub.ListVehicles(request)
        pages.append([vehicle.name.split("/")[1] for vehicle in page.vehicles])
        if not page.next_page_token:
            return pages, tokens
        request.page_token = page.next_page_token
        tokens.append(page.next_page_token)
