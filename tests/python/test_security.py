"""The client shows who it is by certificate or token, sends no token in plaintext to
other machines, and names faults of its files at once."""

import asyncio
import json

import pytest
from cryptography.hazmat.primitives import serialization

import revisit
from conftest import LONG, straight
from identities import (
    AUDIENCE, ISSUER, Authority, TokenKey, key_set, replace)
from revisit import StreamCallbacks, StreamOptions, v1
from revisit_server import Server, wait_until


class Files:
    """Keys and certificates of a server, in a folder."""

    def __init__(self, directory):
        self.directory = directory
        self.authority = Authority()
        self.token_key = TokenKey("EdDSA", "one")
        self.ca = replace(directory / "ca.pem", self.authority.pem)
        shown = self.authority.issue_for_server()
        self.certificate = replace(directory / "server.pem", shown.pem)
        self.key = replace(directory / "server.key", shown.key_pem)
        self.token_keys = replace(directory / "keys.json", key_set(self.token_key))
        self.policy = replace(
            directory / "policy.json",
            json.dumps({"version": 1, "tenants": [], "grants": [
                {caller: name, "tenant": "*", "vehicles": ["*"],
                 "verbs": ["read", "write", "admin"]}
                for caller, name in (
                    ("token_subject", "backend"),
                    ("certificate_uri", "spiffe://fleet.example/*"))]}))

    def token_file(self, name="token", **claims):
        return replace(self.directory / name,
                       self.token_key.token("backend", **claims) + "\n")

    @property
    def token_flags(self):
        return ["--token-keys", self.token_keys, "--token-issuer", ISSUER,
                "--token-audience", AUDIENCE, "--token-leeway-seconds", 0,
                "--policy", self.policy, "--security-check-seconds", 0.1]

    @property
    def tls_flags(self):
        return ["--tls-cert", self.certificate, "--tls-key", self.key]


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    return Files(tmp_path_factory.mktemp("files"))


@pytest.fixture(scope="module")
def plaintext(files, tmp_path_factory):
    with Server(tmp_path_factory.mktemp("plaintext") / "store",
                *files.token_flags) as running:
        yield running


@pytest.fixture(scope="module")
def encrypted(files, tmp_path_factory):
    with Server(tmp_path_factory.mktemp("tls") / "store", *files.tls_flags,
                *files.token_flags) as running:
        yield running


def test_a_token_says_who_calls(plaintext, files):
    with revisit.Client(plaintext.address) as nobody:
        with pytest.raises(revisit.Unauthenticated) as caught:
            nobody.create_vehicle("a")
    assert caught.value.reason == "CREDENTIALS_MISSING"
    with revisit.Client(plaintext.address, token_file=files.token_file()) as client:
        client.create_vehicle("a")
        with client.stream_poses("a") as stream:
            stream.append(straight(10))


def test_decisions_say_who_made_them(plaintext, files):
    with revisit.Client(plaintext.address, token_file=files.token_file()) as client:
        client.create_vehicle("decided")
        client.append_poses("decided", straight(50))
        client.add_loop_closure("decided", 40, 4)
        client.reject_candidate("decided", v1.RejectedCandidate(
            query_sequence=41, matched_sequence=4, decided_by="token:somebody-else"))
        for pairs in (client.list_loop_closures("decided"),
                      client.list_rejected_candidates("decided")):
            assert [pair.decided_by for pair in pairs] == ["token:backend"]
        client.delete_loop_closure("vehicles/decided/loopClosures/40-4")
        [undone] = client.list_deleted_pose_pairs("decided")
        assert (undone.loop_closure.decided_by, undone.deleted_by) == (
            "token:backend", "token:backend")


def test_tls_with_a_token(encrypted, files):
    with revisit.Client(encrypted.address, tls_authorities=files.ca,
                        token_file=files.token_file()) as client:
        client.create_vehicle("a")
        with client.stream_poses("a") as stream:
            stream.append(straight(10))


def test_another_authority_is_not_trusted(encrypted, files, tmp_path):
    other = replace(tmp_path / "other.pem", Authority().pem)
    with revisit.Client(encrypted.address, tls_authorities=other,
                        max_attempts=1) as client:
        with pytest.raises(revisit.Unavailable):
            client.server_info()


def test_a_client_certificate_says_who_calls(files, tmp_path):
    shown = files.authority.issue("spiffe://fleet.example/bus")
    certificate = replace(tmp_path / "client.pem", shown.pem)
    key = replace(tmp_path / "client.key", shown.key_pem)
    with Server(tmp_path / "store", *files.tls_flags, "--tls-client-ca",
                files.ca, "--policy", files.policy) as server:
        with revisit.Client(server.address, tls_authorities=files.ca,
                            tls_certificate=certificate, tls_key=key) as client:
            client.create_vehicle("a")
        server.logged("certificate:spiffe://fleet.example/bus")
        with revisit.Client(server.address, tls_authorities=files.ca,
                            max_attempts=1) as client:
            with pytest.raises(revisit.Unavailable):
                client.server_info()


def test_a_stream_takes_the_token_that_replaced_an_expired_one(plaintext, files):
    lost = []

    def renew(error, wait):
        lost.append(error)
        files.token_file("brief")

    with revisit.Client(plaintext.address,
                        token_file=files.token_file("lasting")) as client:
        client.create_vehicle("renewed")
    token = files.token_file("brief", lasts=2.0)
    with revisit.Client(plaintext.address, token_file=token) as client:
        with client.stream_poses(
                "renewed", StreamOptions(),
                StreamCallbacks(disconnected=renew)) as stream:
            stream.wait_until_opened(LONG)
            stream.append(straight(10))
            wait_until(lambda: lost, "end of the token", LONG)
            stream.append(straight(10, first=11))
        assert client.get_vehicle("renewed").durable_sequence == 20
    assert [error.reason for error in lost] == ["TOKEN_EXPIRED"]


def test_no_token_goes_to_another_machine_in_plaintext(files):
    # An address that no machine has: nothing is sent, whatever listens there.
    with revisit.Client("192.0.2.1:50051", token_file=files.token_file(),
                        max_attempts=1, deadline=5.0) as client:
        with pytest.raises(revisit.Error) as caught:
            client.server_info()
    assert caught.value.code.name in ("UNAVAILABLE", "DEADLINE_EXCEEDED")


def test_faults_of_files_are_named_at_once(files, tmp_path):
    shown = files.authority.issue("spiffe://fleet.example/bus")
    certificate = replace(tmp_path / "client.pem", shown.pem)
    other_key = replace(tmp_path / "other.key", files.authority.issue("a:b").key_pem)
    secret = serialization.load_pem_private_key(shown.key_pem, None).private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8,
        serialization.BestAvailableEncryption(b"secret"))
    secret_key = replace(tmp_path / "secret.key", secret)
    empty = replace(tmp_path / "empty", "")
    for wrong, message in [
            ({"tls_authorities": tmp_path / "none"}, "none"),
            ({"tls_authorities": empty}, "empty holds no certificate"),
            ({"tls_certificate": certificate}, "needed together"),
            ({"tls_certificate": certificate, "tls_key": other_key}, "needs TLS"),
            ({"tls_authorities": files.ca, "tls_certificate": certificate,
              "tls_key": other_key}, "no certificate and its own"),
            ({"tls_authorities": files.ca, "tls_certificate": certificate,
              "tls_key": secret_key}, "no certificate and its own"),
            ({"token_file": tmp_path / "none"}, "none"),
            ({"token_file": empty}, "empty holds no token")]:
        with pytest.raises((OSError, ValueError), match=message):
            revisit.Client("127.0.0.1:1", **wrong)


def test_a_token_that_went_away_is_the_callers_fault(plaintext, files):
    token = files.token_file("gone")
    with revisit.Client(plaintext.address, token_file=token) as client:
        token.unlink()
        with pytest.raises(revisit.Unauthenticated, match="no token to send"):
            client.server_info()
        with pytest.raises(revisit.Unauthenticated, match="no token to send"):
            client.stream_poses("a").finish()


def test_the_client_of_asyncio_and_the_program_show_who_calls_too(
        encrypted, files, tmp_path):
    async def append():
        async with revisit.aio.Client(encrypted.address, tls_authorities=files.ca,
                                      token_file=files.token_file()) as client:
            await client.create_vehicle("both")
            async with client.stream_poses("both") as stream:
                await stream.append(straight(10))
            await client.export("both", tmp_path / "both.g2o")

    asyncio.run(append())
    assert (tmp_path / "both.g2o").read_text().count("VERTEX_SE2") == 10
    with revisit.Client(encrypted.address, tls_authorities=files.ca) as nobody:
        with pytest.raises(revisit.Unauthenticated) as caught:
            nobody.export("both", tmp_path / "none.g2o")
    assert caught.value.reason == "CREDENTIALS_MISSING"
