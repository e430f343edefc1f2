"""Who may call, and for how long; test_authorization.py has what they may see."""

import contextlib
import json
import re
import signal
import socket
import ssl
import threading
import time

import grpc
import pytest
from grpc_health.v1 import health_pb2, health_pb2_grpc

from caller_identities import (
    POLICY, USAGE, As, Code, Identities, ask, create, list_vehicles, secure_stub)
from identities import Authority, TokenKey, bearer, key_set, replace
from revisit_server import Server, clean_environment, open_files, run, wait_until
from stubs import ROOT, PoseGraphServiceStub, api
from wire import (
    PoseStream, append, decode_failure, failure_of, list_poses, straight)

pytest_plugins = ("caller_identities",)


# --- TLS.

def test_client_is_known_by_its_certificate(tls_server, identities):
    bus = identities.authority.issue("spiffe://fleet.example/acme/bus-1",
                                     "x.example")
    with secure_stub(tls_server, identities.authority.pem, bus) as stub:
        vehicle = create(stub, "acme-bus-1")
        assert append(stub, vehicle, straight(3)).durable_sequence == 3
        failure = failure_of(lambda: create(stub, "acme-bus-2"))
        assert (failure.code, failure.reason) == (
            Code.PERMISSION_DENIED, "NOT_GRANTED")
    tls_server.logged("certificate:spiffe://fleet.example/acme/bus-1")


@pytest.mark.parametrize("names, reason, words", [
    ((), "CREDENTIALS_INVALID", "no URI and no DNS name"),
    (("spiffe://fleet.example/umbra/bus-1",), "NOT_GRANTED", "grants"),
])
def test_good_certificate_of_nobody_is_told_so(
        tls_server, identities, names, reason, words):
    certificate = identities.authority.issue(
        *names, common_name="spiffe://fleet.example/acme/bus-1")
    with secure_stub(tls_server, identities.authority.pem,
                     certificate) as stub:
        failure = failure_of(lambda: ask(stub))
        assert failure.reason == reason
        assert words in failure.message


def refused(server, authority_pem, certificate=None):
    """Whether a handshake fails: all a caller gets to see."""
    with secure_stub(server, authority_pem, certificate) as stub:
        with pytest.raises(grpc.RpcError) as raised:
            ask(stub)
        assert "grpc-status-details-bin" not in dict(
            raised.value.trailing_metadata() or ())
        return raised.value.code() == Code.UNAVAILABLE


def test_handshake_fails_without_the_right_certificate(tls_server, identities):
    name = "spiffe://fleet.example/acme/bus-1"
    stranger = Authority()
    good = identities.authority.issue(name)
    assert refused(tls_server, identities.authority.pem)
    assert refused(tls_server, identities.authority.pem, stranger.issue(name))
    # One that calls itself the same.
    assert refused(tls_server, identities.authority.pem,
                   Authority("Test authority").issue(name))
    assert refused(tls_server, identities.authority.pem,
                   identities.authority.issue(name, begins=-7200, ends=-3600))
    assert refused(tls_server, identities.authority.pem,
                   identities.authority.issue(name, begins=3600))
    # The client's side of it.
    assert refused(tls_server, stranger.pem, good)
    with secure_stub(tls_server, identities.authority.pem, good) as stub:
        ask(stub)
    # The callers are told nothing; whoever runs the server is.
    for reason in ("peer did not return a certificate",
                   "certificate verify failed"):
        tls_server.logged(reason)


def test_tls_that_asks_for_no_certificate_takes_tokens(identities, tmp_path):
    with Server(tmp_path / "store", *identities.tls_flags,
                *identities.token_flags) as server:
        with secure_stub(server, identities.authority.pem) as stub:
            acme = As(stub, identities.key.token("acme"))
            assert create(acme, "acme-1") == "vehicles/acme-1"
        with secure_stub(server, identities.authority.pem) as stub:
            failure = failure_of(lambda: ask(stub))
            assert failure.reason == "CREDENTIALS_MISSING"


def test_plaintext_gets_nothing_from_a_tls_listener(tls_server):
    with grpc.insecure_channel(tls_server.address) as channel:
        with pytest.raises(grpc.RpcError) as raised:
            ask(PoseGraphServiceStub(channel))
        assert raised.value.code() == Code.UNAVAILABLE
    with socket.create_connection(("127.0.0.1", tls_server.port)) as raw:
        raw.settimeout(10)
        raw.sendall(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n" + bytes(9))
        answer = b""
        with contextlib.suppress(ConnectionResetError):
            while part := raw.recv(4096):
                answer += part
    # Nothing, or a record of TLS that is an alert: no frame of HTTP/2.
    assert answer[:1] in (b"", b"\x15"), answer


@pytest.mark.parametrize("version, accepted", [
    (ssl.TLSVersion.TLSv1, False), (ssl.TLSVersion.TLSv1_1, False),
    (ssl.TLSVersion.TLSv1_2, True), (ssl.TLSVersion.TLSv1_3, True)])
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_tls_is_1_2_or_later(
        tls_server, identities, tmp_path, version, accepted):
    good = identities.authority.issue("spiffe://fleet.example/acme/bus-1")
    context = ssl.create_default_context(
        cadata=identities.authority.pem.decode())
    # Else this side would not even offer the old ones.
    context.set_ciphers("ALL:@SECLEVEL=0")
    context.minimum_version = context.maximum_version = version
    context.set_alpn_protocols(["h2"])
    context.load_cert_chain(replace(tmp_path / "pem", good.pem),
                            replace(tmp_path / "key", good.key_pem))

    def connect():
        with socket.create_connection(("127.0.0.1", tls_server.port)) as raw:
            with context.wrap_socket(raw, server_hostname="localhost") as tls:
                return tls.version(), tls.selected_alpn_protocol()

    if accepted:
        assert connect() == (version.name.replace("_", "."), "h2")
    else:
        # This gRPC hangs up rather than say why. It is not this side that did.
        with pytest.raises((ssl.SSLError, ConnectionResetError)) as raised:
            connect()
        assert "NO_PROTOCOLS_AVAILABLE" not in str(raised.value)


def served_serial(server, identities, certificate):
    """Of the certificate that new connections get to see."""
    context = ssl.create_default_context(
        cadata=identities.authority.pem.decode())
    context.set_alpn_protocols(["h2"])
    context.load_cert_chain(
        replace(identities.directory / "own.pem", certificate.pem),
        replace(identities.directory / "own.key", certificate.key_pem))
    with socket.create_connection(("127.0.0.1", server.port)) as raw:
        with context.wrap_socket(raw, server_hostname="localhost") as tls:
            return int(tls.getpeercert()["serialNumber"], 16)


def test_rotated_certificates_are_taken_and_bad_ones_are_not(tmp_path):
    own = Identities(tmp_path)
    client = own.authority.issue("spiffe://fleet.example/acme/bus-1")

    def serial():
        return served_serial(server, own, client)

    with Server(tmp_path / "store", *own.client_flags) as server:
        assert serial() == own.certificate.serial
        lines = iter(range(1, 100))

        def await_refusal():
            count = next(lines)
            wait_until(
                lambda: server.log().count("tls_files_refused") == count,
                f"refusal {count} in {server.log()}")
            assert serial() == own.certificate.serial

        with secure_stub(server, own.authority.pem, client) as old_connection:
            ask(old_connection)
            fresh = own.authority.issue_for_server()
            # Half of a rotation: the key is there, its certificate is not.
            replace(own.server_key_file, fresh.key_pem)
            await_refusal()
            # Written half.
            replace(own.certificate_file, fresh.pem[:len(fresh.pem) // 2])
            await_refusal()
            replace(own.certificate_file, b"garbage")
            await_refusal()
            own.certificate_file.unlink()
            await_refusal()
            replace(own.certificate_file, fresh.pem)
            wait_until(lambda: serial() == fresh.serial, "new certificate")
            own.certificate = fresh
            # Two changes, of which the server may see one or two.
            own.show(own.authority.issue_for_server(begins=-7200, ends=-3600))
            wait_until(lambda: "has expired at" in server.log(), "refusal")
            assert serial() == fresh.serial
            # Connections live through all of it.
            ask(old_connection)

        # Who may issue clients' certificates rotates too.
        successor = Authority("Successor")
        new_client = successor.issue("spiffe://fleet.example/acme/bus-2")
        own.show(fresh)
        assert refused(server, own.authority.pem, new_client)
        replace(own.authority_file, successor.pem)
        wait_until(lambda: not refused_now(server, own, new_client),
                   "client of the new authority")
        assert refused(server, own.authority.pem, client)


def test_hangup_has_certificates_keys_and_policy_looked_at_now(tmp_path):
    own = Identities(tmp_path)
    client = own.authority.issue("spiffe://fleet.example/acme/bus-1")
    # It would be a minute until the next look.
    with Server(tmp_path / "certified", *own.client_flags[:-1], 60) as server:
        assert served_serial(server, own, client) == own.certificate.serial
        fresh = own.authority.issue_for_server()
        own.show(fresh)
        server.process.send_signal(signal.SIGHUP)
        wait_until(
            lambda: served_serial(server, own, client) == fresh.serial,
            "new certificate")
    with Server(tmp_path / "policed", *own.token_flags[:-1], 60) as server:
        acme = As(server.stub(), own.key.token("acme"))
        ask(acme)
        policy = json.loads(json.dumps(POLICY))
        policy["grants"] = [grant for grant in policy["grants"]
                            if grant.get("token_subject") != "acme"]
        replace(own.policy_file, json.dumps(policy))
        server.process.send_signal(signal.SIGHUP)
        server.logged("access_rules_loaded")
        assert failure_of(lambda: ask(acme)).reason == "NOT_GRANTED"


def refused_now(server, identities, certificate):
    with secure_stub(server, identities.authority.pem, certificate) as stub:
        try:
            ask(stub)
        except grpc.RpcError as error:
            assert error.code() == Code.UNAVAILABLE, error
            return True
        return False


def test_stream_ends_when_the_client_certificate_expires(
        tls_server, identities):
    name = "spiffe://fleet.example/acme/brief"
    lasting = identities.authority.issue(name)
    with secure_stub(tls_server, identities.authority.pem, lasting) as stub:
        vehicle = create(stub, "acme-brief")

    def opened_and_ended(ends):
        brief = identities.authority.issue(name, ends=ends)
        with secure_stub(tls_server, identities.authority.pem, brief) as stub, \
                PoseStream(stub, vehicle) as stream:
            try:
                stream.receive_kind("opened")
            except grpc.RpcError as error:
                assert error.code() in (Code.UNAUTHENTICATED, Code.UNAVAILABLE)
                return False
            failure = failure_of(stream.receive_all)
            assert (failure.code, failure.reason) == (
                Code.UNAUTHENTICATED, "CERTIFICATE_EXPIRED")
            # Also on the connection that is still there.
            failure = failure_of(lambda: ask(stub))
            assert failure.reason == "CERTIFICATE_EXPIRED"
            return True

    # On a busy machine the handshake may be too late for the shorter ones.
    assert any(opened_and_ended(ends) for ends in (3, 8, 30))


def test_client_whose_authority_is_removed_is_ended_on_its_open_connection(
        tmp_path):
    own = Identities(tmp_path)
    client = own.authority.issue("spiffe://fleet.example/acme/bus-1")
    with Server(tmp_path / "store", *own.client_flags) as server, \
            secure_stub(server, own.authority.pem, client) as stub:
        vehicle = create(stub, "acme-bus-1")
        with PoseStream(stub, vehicle) as stream:
            stream.receive_kind("opened")
            # One more is trusted: nobody is ended.
            other = Authority("Other")
            replace(own.authority_file, own.authority.pem + other.pem)
            second = other.issue("spiffe://fleet.example/acme/bus-2")
            wait_until(lambda: not refused_now(server, own, second),
                       "client of the other authority")
            stream.send(straight(1))
            assert stream.receive_kind("ack").durable_sequence == 1
            replace(own.authority_file, other.pem)
            failure = failure_of(stream.receive_all)
            assert (failure.code, failure.reason) == (
                Code.UNAUTHENTICATED, "CREDENTIALS_INVALID")
        # The connection is the one that was there.
        failure = failure_of(lambda: ask(stub))
        assert (failure.code, failure.reason) == (
            Code.UNAUTHENTICATED, "CREDENTIALS_INVALID")
        assert "no authority that is trusted now" in failure.message


# --- Tokens.

def test_tokens_of_every_algorithm_are_taken(token_server, identities):
    stub = token_server.stub()
    for key in identities.keys:
        ask(As(stub, key.token("acme")))
        # Some write the scheme otherwise.
        stub.GetServerInfo(
            api.GetServerInfoRequest(),
            metadata=(("authorization", "bearer " + key.token("acme")),))


def test_bad_tokens_are_refused_with_the_reason(token_server, identities):
    stub = token_server.stub()
    key = identities.key
    good = key.token("acme")
    cases = [
        ((), "CREDENTIALS_MISSING", "a bearer token"),
        (bearer(""), "CREDENTIALS_INVALID", "form"),
        (bearer("x"), "CREDENTIALS_INVALID", "form"),
        ((("authorization", good),), "CREDENTIALS_INVALID", "Bearer TOKEN"),
        ((("authorization", "Basic " + good),), "CREDENTIALS_INVALID",
         "Bearer TOKEN"),
        (bearer(good) + bearer(good), "CREDENTIALS_INVALID", "given once"),
        (bearer(good[:-8]), "CREDENTIALS_INVALID", "signature"),
        (bearer(key.token("acme", header={"alg": "none"})),
         "CREDENTIALS_INVALID", "algorithm"),
        (bearer(key.token("acme", header={"alg": "HS256"})),
         "CREDENTIALS_INVALID", "algorithm"),
        (bearer(key.token("acme", header={"kid": "rsa"})),
         "CREDENTIALS_INVALID", "another algorithm"),
        (bearer(key.token("acme", header={"kid": "new"})),
         "CREDENTIALS_INVALID", "does not have the key"),
        (bearer(TokenKey("EdDSA", "ed").token("acme")),
         "CREDENTIALS_INVALID", "signature does not hold"),
        (bearer(key.token("acme", aud="other")), "CREDENTIALS_INVALID",
         "audience"),
        (bearer(key.token("acme", iss="other")), "CREDENTIALS_INVALID",
         "issuer"),
        (bearer(key.token("acme", exp=None)), "CREDENTIALS_INVALID",
         "expires"),
        (bearer(key.token("acme", lasts=-1)), "TOKEN_EXPIRED", "expired"),
        (bearer(key.token("acme", nbf=time.time() + 100)),
         "TOKEN_NOT_YET_VALID", "nbf"),
    ]
    for metadata, reason, words in cases:
        failure = failure_of(lambda: stub.GetServerInfo(
            api.GetServerInfoRequest(), metadata=metadata))
        assert (failure.code, failure.reason) == (
            Code.UNAUTHENTICATED, reason), (metadata, failure)
        assert words in failure.message
    failure = failure_of(lambda: ask(As(stub, key.token("nobody"))))
    assert (failure.code, failure.reason) == (
        Code.PERMISSION_DENIED, "NOT_GRANTED")


# --- Streams that outlive what let them in.

def first_that_lasts(begin):
    """What `begin(seconds)` answers the first time that credentials of so many
    seconds did not expire within it: on a busy machine brief ones may."""
    for seconds in (1, 5):
        try:
            return begin(seconds)
        except grpc.RpcError as error:
            assert decode_failure(error).reason == "TOKEN_EXPIRED"
    return begin(25)


def test_stream_ends_after_its_last_ack_when_the_token_expires(
        called_by, token_server):
    create(called_by("acme"), "acme-long-1")
    vehicle = "vehicles/acme-long-1"
    acks = []
    sent = 0
    with contextlib.ExitStack() as stack:

        def open_stream(lasts):
            brief = called_by("vehicle:long-1", lasts=lasts)
            stream = stack.enter_context(
                PoseStream(brief, vehicle, metadata=brief.metadata))
            # Poses of a stream before may have become durable as it ended.
            durable = stream.receive_kind("opened").durable_sequence
            return stream, durable, lasts

        def send_and_receive(stream):
            nonlocal sent
            stream.send(straight(5, first=sent + 1))
            sent += 5
            acks.append(stream.receive_kind("ack").durable_sequence)

        def open_and_send(lasts):
            nonlocal sent
            stream, sent, lasts = open_stream(lasts)
            send_and_receive(stream)
            return stream, lasts

        stream, lasts = first_that_lasts(open_and_send)
        # Ends behind it, and well before the time that calls have here.
        later, *_ = open_stream(lasts + 10)
        with pytest.raises(grpc.RpcError) as raised:
            while True:
                send_and_receive(stream)
        failure = decode_failure(raised.value)
        assert later.call.is_active()
    assert (failure.code, failure.reason) == (
        Code.UNAUTHENTICATED, "TOKEN_EXPIRED")
    assert acks == list(range(acks[0], acks[-1] + 1, 5))
    # Nothing that was acknowledged is missing, and it goes on from there.
    again = called_by("vehicle:long-1")
    with PoseStream(again, vehicle, metadata=again.metadata) as stream:
        durable = stream.receive_kind("opened").durable_sequence
        assert acks[-1] <= durable <= sent
        stream.send(straight(5, first=durable + 1))
        assert (stream.receive_kind("ack").durable_sequence == durable + 5)
    assert len(list_poses(again, vehicle)) == durable + 5


def test_idle_calls_of_all_kinds_end_when_the_token_expires(
        called_by, token_server):
    vehicle = create(called_by("acme"), "acme-idle-1")
    append(called_by("acme"), vehicle, straight(1))
    held = threading.Event()

    def nothing_more():
        yield api.RevisePosesRequest(vehicle=vehicle, poses=straight(1))
        held.wait(60)

    with contextlib.ExitStack() as stack:
        stack.callback(held.set)

        def begin(lasts):
            brief = called_by("vehicle:idle-1", lasts=lasts)
            unopened, opened = (
                stack.enter_context(
                    PoseStream(brief, *name, metadata=brief.metadata))
                for name in ((), (vehicle,)))
            opened.receive_kind("opened")
            revision = token_server.stub().RevisePoses.future(
                nothing_more(), metadata=brief.metadata, timeout=60)
            # The server has its first message.
            wait_until(lambda: revision.done() or "/.revision-" in open_files(
                token_server.pid), "draft")
            if revision.done():
                revision.result()
            return unopened.receive_all, opened.receive_all, revision.result

        for wait in first_that_lasts(begin):
            failure = failure_of(wait)
            assert (failure.code, failure.reason) == (
                Code.UNAUTHENTICATED, "TOKEN_EXPIRED")


def test_stream_ends_when_policy_or_keys_change(tmp_path):
    own = Identities(tmp_path)
    with Server(tmp_path / "store", *own.token_flags) as server:
        stub = server.stub()
        acme = As(stub, own.key.token("acme"))
        writer = As(stub, own.key.token("acme-writer"))
        vehicle = create(acme, "acme-1")
        with PoseStream(acme, vehicle, metadata=acme.metadata) as stays, \
                PoseStream(writer, vehicle, metadata=writer.metadata) as goes:
            stays.receive_kind("opened")
            goes.receive_kind("opened")
            # A file that is no good changes nothing.
            replace(own.policy_file, "{")
            wait_until(lambda: "access_rules_refused" in server.log(),
                       "refusal")
            goes.send(straight(1))
            goes.receive_kind("ack")
            policy = json.loads(json.dumps(POLICY))
            policy["grants"] = [grant for grant in policy["grants"] if
                                grant.get("token_subject") != "acme-writer"]
            replace(own.policy_file, json.dumps(policy))
            failure = failure_of(goes.receive_all)
            assert (failure.code, failure.reason) == (
                Code.PERMISSION_DENIED, "NOT_GRANTED")
            stays.send(straight(1, first=2))
            stays.receive_kind("ack")
            # A key that was stolen is taken out of the set.
            replace(own.key_file, key_set(own.keys[0]))
            failure = failure_of(stays.receive_all)
            assert (failure.code, failure.reason) == (
                Code.UNAUTHENTICATED, "CREDENTIALS_INVALID")
        assert "does not have the key" in failure.message
        ask(As(stub, own.keys[0].token("acme")))


# --- Switches.

def health(server):
    return health_pb2_grpc.HealthStub(server.channel()).Check(
        health_pb2.HealthCheckRequest(), timeout=10)


def reflect(server):
    call_ = server.channel().stream_stream(
        "/grpc.reflection.v1alpha.ServerReflection/ServerReflectionInfo")
    # list_services = 7, of any text.
    return b"".join(call_(iter([b"\x3a\x01*"]), timeout=10))


def test_health_and_reflection_are_open_unless_switched_off(
        token_server, tmp_path):
    assert health(token_server).status == health_pb2.HealthCheckResponse.SERVING
    assert b"revisit.v1.PoseGraphService" in reflect(token_server)
    with Server(tmp_path / "store", "--serve-health", "off",
                "--serve-reflection", "off") as server:
        for ask_it in (health, reflect):
            with pytest.raises(grpc.RpcError) as raised:
                ask_it(server)
            assert raised.value.code() == Code.UNIMPLEMENTED
        ask(server.stub())


def test_remote_listener_without_security_is_refused(tmp_path):
    store = tmp_path / "store"
    result = run("revisitd", "--listen", "0.0.0.0:0", "--store", store)
    assert result.returncode == USAGE
    assert "whoever reaches this address" in result.stderr
    assert not store.exists()


def test_policy_of_the_documentation_is_a_good_one(tmp_path):
    own = Identities(tmp_path)
    text = (ROOT / "SECURITY.md").read_text()
    policy = re.search(r"^```json\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    replace(own.policy_file, policy.group(1))
    with Server(tmp_path / "store", *own.token_flags) as server:
        backend = As(server.stub(), own.key.token("acme-backend"))
        create(backend, "acme-1")
        viewer = As(server.stub(), own.key.token(
            "somebody", groups=["umbra-viewers"]))
        assert list_vehicles(viewer, 10) == ([[]], [])


@pytest.mark.parametrize("name, content, words", [
    ("policy.json", '{"version": 1}', "policy.json: policy: \"tenants\""),
    ("policy.json", None, "cannot read"),
    ("keys.json", "{}", "keys.json: not a key set"),
    ("server.pem", "garbage", "holds no certificate"),
    ("server.key", "garbage", "private key cannot be read"),
])
def test_files_that_are_no_good_keep_the_server_from_starting(
        tmp_path, name, content, words):
    own = Identities(tmp_path)
    if content is None:
        (tmp_path / name).unlink()
    else:
        replace(tmp_path / name, content)
    store = tmp_path / "store"
    result = run("revisitd", "--listen", "127.0.0.1:0", "--store", store,
                 *own.token_flags, *own.tls_flags)
    assert result.returncode == USAGE
    assert words in result.stderr
    assert not store.exists()


# --- The command line.

def test_command_line_speaks_tls_and_shows_its_certificate(
        tls_server, identities, tmp_path):
    certificate = identities.authority.issue(
        "spiffe://fleet.example/acme/shuttle-1")
    files = ["--tls-ca", identities.authority_file,
             "--tls-cert", replace(tmp_path / "cert", certificate.pem),
             "--tls-key", replace(tmp_path / "key", certificate.key_pem)]
    other_key = replace(tmp_path / "other", identities.certificate.key_pem)
    result = run("revisit", "--server", tls_server.address, *files, "vehicle",
                 "create", "acme-shuttle-1")
    assert result.returncode == 0, result
    result = run("revisit", "--server", tls_server.address, *files, "vehicle",
                 "get", "acme-shuttle-2")
    assert result.returncode == 64 + Code.NOT_FOUND.value[0], result
    for wrong, code, words in [
            (files[:4], USAGE, "--tls-cert requires --tls-key"),
            (files[2:], USAGE, "--tls-cert requires --tls-ca"),
            (["--tls-ca", tmp_path / "missing"], 1, "revisit: cannot read"),
            (["--tls-ca", other_key], 1, "holds no certificate"),
            ([*files[:4], "--tls-key", files[3]], 1, "holds no private key"),
            ([*files[:3], other_key, *files[4:]], 1, "holds no certificate"),
            ([*files[:4], "--tls-key", other_key], 1,
             "the private key is not that of the certificate")]:
        result = run("revisit", "--server", tls_server.address, *wrong,
                     "vehicle", "list")
        assert result.returncode == code, result
        assert words in result.stderr
        # Nothing of what gRPC and OpenSSL log by themselves.
        assert len(result.stderr.splitlines()) == (1 if code == 1 else 2)


def test_command_line_asks_whether_tls_is_wanted(
        tls_server, token_server, identities):
    def told(server, *flags):
        result = run("revisit", "--server", server.address, *flags, "vehicle",
                     "list")
        assert result.returncode == 64 + Code.UNAVAILABLE.value[0], result
        # Nothing that gRPC logs by itself.
        assert result.stderr.startswith(("revisit: ", "{")), result
        return result.stderr.splitlines()[-1]

    authority = ["--tls-ca", identities.authority_file]
    assert told(tls_server).startswith("(connected without TLS: ")
    assert told(tls_server, *authority).startswith(
        "(connected without a certificate: ")
    assert told(token_server, *authority).startswith("(connected with TLS: ")
    asked = run("revisit", "--server", token_server.address, *authority, "vehicle",
                "list", env={**clean_environment(), "GRPC_VERBOSITY": "ERROR"})
    assert "Handshake failed" in asked.stderr.partition("revisit: ")[0], asked
    # What reads JSON is not asked.
    assert json.loads(told(tls_server, "--json"))["error"]["code"] == (
        "UNAVAILABLE")
    stranger = replace(identities.directory / "stranger.pem", Authority().pem)
    assert told(tls_server, "--tls-ca", stranger).startswith("revisit: ")


def test_command_line_sends_its_token(token_server, identities, tmp_path):
    token = tmp_path / "token"
    arguments = ["revisit", "--server", token_server.address, "--token-file",
                 token, "vehicle"]
    replace(token, identities.key.token("acme") + "\n")
    result = run(*arguments, "create", "acme-cli-1")
    assert result.returncode == 0, result
    result = run(*arguments, "get", "umbra-cli-1")
    assert result.returncode == 64 + Code.NOT_FOUND.value[0], result
    replace(token, identities.key.token("acme", lasts=-10))
    result = run(*arguments, "list")
    assert result.returncode == 64 + Code.UNAUTHENTICATED.value[0], result
    assert "expired" in result.stderr
    replace(token, "two words")
    result = run(*arguments, "list")
    assert result.returncode == 1, result
    assert "holds no token" in result.stderr


def test_command_line_does_not_call_memory_empty_of_which_it_is_not_told(
        token_server, called_by, identities, tmp_path):
    owner = called_by("acme")
    append(owner, create(owner, "acme-cli-memory"), straight(20))
    token = tmp_path / "token"

    def told(*arguments):
        result = run("revisit", "--server", token_server.address,
                     "--token-file", token, "info", *arguments)
        assert result.returncode == 0, result
        return result.stdout

    replace(token, identities.key.token("acme"))
    assert re.findall("^.*in memory.*$", re.sub(" +", " ", told()),
                      re.MULTILINE) == [
        "in memory not told to a tenant's caller"]
    assert not json.loads(told("--json")).get("overAllTenants")
    replace(token, identities.key.token("op", groups=["operators"]))
    assert re.search("^vehicles in memory +[1-9]", told(), re.MULTILINE)
    assert re.search("^graphs in memory +[1-9][0-9]* B$", told(), re.MULTILINE)


def own_address():
    """An address of this machine that is not the loopback; None if there is
    none."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            # Sends nothing.
            probe.connect(("192.0.2.1", 9))
        except OSError:
            return None
        return probe.getsockname()[0]


def test_command_line_sends_no_token_in_plaintext_to_other_machines(
        identities, tmp_path):
    address = own_address()
    if address is None or address.startswith("127."):
        pytest.skip("this machine has the loopback only")
    token = replace(tmp_path / "token", identities.key.token("acme"))
    with socket.create_server((address, 0)) as listener:
        listener.settimeout(20)
        heard = []

        def hear():
            with contextlib.suppress(OSError):
                connection, _ = listener.accept()
                connection.settimeout(2)
                with connection, contextlib.suppress(OSError):
                    while part := connection.recv(4096):
                        heard.append(part)

        thread = threading.Thread(target=hear)
        thread.start()
        port = listener.getsockname()[1]
        result = run("revisit", "--server", f"{address}:{port}",
                     "--token-file", token, "vehicle", "list")
        assert result.returncode == 64 + Code.UNAVAILABLE.value[0], result
    thread.join()
    assert b"eyJ" not in b"".join(heard)
