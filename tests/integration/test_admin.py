"""The port of probes and metrics: what it says of the server, and that nothing
that comes to it harms anybody."""

import contextlib
import random
import signal
import socket

import pytest

import scraped
from drive_client import VEHICLE, create
from held_threads import held, threads
from revisit_server import BIN, Server, clean_environment, free_port, run, \
    wait_until
from stubs import api
from wire import PoseStream, append, failure_of, straight

ADMIN = ("--admin-listen", "127.0.0.1:0")
USAGE, CANNOT_LISTEN = 64, 69


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    with Server(tmp_path_factory.mktemp("admin") / "store", *ADMIN) as running:
        yield running
        assert running.is_running(), running.log()


def connect(server):
    host, _, port = server.admin.rpartition(":")
    return socket.create_connection((host, int(port)), timeout=30)


def test_there_is_no_such_port_unless_it_is_asked_for(tmp_path):
    with Server(tmp_path / "store") as server:
        create(server.stub())
        assert server.admin is None
    assert "serving" in server.log()
    assert "admin" not in server.log()


def test_answers_probes_and_names_them_to_whoever_asks_for_something_else(
        server):
    assert scraped.get(server.admin, "/livez")[:2] == (200, "alive\n")
    assert scraped.get(server.admin, "/readyz?verbose")[:2] == (200, "ready\n")
    status, text, _ = scraped.get(server.admin, "/")
    assert status == 404
    assert "/readyz" in text


@pytest.mark.release_build
def test_is_alive_and_not_ready_while_it_opens_its_store(tmp_path):
    shim = BIN / "fault_shim.so"
    if not shim.exists():
        pytest.skip("fault_shim.so is not built")
    address = f"127.0.0.1:{free_port()}"
    environment = clean_environment(
        LD_PRELOAD=str(shim), REVISIT_TEST_SLOW_SYNC="300000")
    with Server(tmp_path / "store", "--admin-listen", address, wait=False,
                env=environment) as server:

        def answer():
            with contextlib.suppress(OSError):
                return scraped.get(address, "/readyz")[:2]

        assert wait_until(answer, "admin port") == (503, "starting\n")
        assert scraped.get(address, "/livez")[0] == 200
        assert scraped.get(address, "/metrics")[:2] == (503, "starting\n")
        server.wait_until_listening()
        assert scraped.get(address, "/readyz")[0] == 200


def test_is_not_alive_while_the_threads_of_the_vehicles_hang(tmp_path):
    with Server(tmp_path / "store", *ADMIN, "--worker-threads", 2) as server:
        for _ in range(3):
            assert scraped.get(server.admin, "/livez")[:2] == (200, "alive\n")
        workers = threads(server.pid, "vehicles")
        assert len(workers) == 2

        def livez(status):
            answer = scraped.get(server.admin, "/livez")
            return answer[0] == status and answer

        with held(workers):
            # It is patient for ten seconds.
            assert livez(200)
            answer = wait_until(lambda: livez(503), "503")
            assert "have not answered for 10 s" in answer[1]
            assert scraped.get(server.admin, "/metrics")[0] == 200
        wait_until(lambda: livez(200), "200")
        assert server.logged("liveness_not_answered")
        create(server.stub())


def test_grpc_port_answers_no_probe(server):
    with socket.create_connection(("127.0.0.1", server.port), timeout=30) as bare:
        bare.sendall(b"GET /livez HTTP/1.1\r\nHost: x\r\n\r\n")
        answer = b""
        with contextlib.suppress(ConnectionResetError):
            while chunk := bare.recv(4096):
                answer += chunk
        assert b"alive" not in answer


def test_address_in_use_ends_the_start(server, tmp_path):
    result = run("revisitd", "--store", tmp_path / "store", "--listen",
                 "127.0.0.1:0", "--admin-listen", server.admin)
    assert result.returncode == CANNOT_LISTEN
    assert "admin-listen: cannot listen at " + server.admin in result.stderr


@pytest.mark.parametrize("address", ["9464", "127.0.0.1:70000", "localhost"])
def test_malformed_address_is_a_wrong_setting(address, tmp_path):
    result = run("revisitd", "--store", tmp_path / "store", "--listen",
                 "127.0.0.1:0", "--admin-listen", address)
    assert result.returncode == USAGE
    assert address in result.stderr
    assert "HOST:PORT" in result.stderr


def test_is_not_ready_once_it_has_been_asked_to_end(tmp_path):
    with Server(tmp_path / "store", *ADMIN, "--drain-notice-seconds",
                600) as server:
        stub = server.stub()
        create(stub)
        with PoseStream(stub, VEHICLE) as stream:
            stream.receive_kind("opened")
            server.process.send_signal(signal.SIGTERM)
            wait_until(lambda: scraped.get(server.admin, "/readyz")[:2]
                       == (503, "draining\n"), "end of readiness")
            # It lives, works and counts on.
            assert scraped.get(server.admin, "/livez")[0] == 200
            assert append(stub, VEHICLE, straight(1)).durable_sequence == 1
            page = scraped.scrape(server)
            assert page.value("revisit_draining") == 1
            assert page.value("revisit_poses_accepted_total") == 1
            server.process.send_signal(signal.SIGTERM)
            failure_of(stream.receive)
        server.close_channels()
        assert server.process.wait(30) == 0, server.log()


@pytest.mark.release_build
def test_is_not_ready_on_a_full_disk(tmp_path):
    shim = BIN / "fault_shim.so"
    if not shim.exists():
        pytest.skip("fault_shim.so is not built")
    # The disk is full from some write on, and stays so.
    environment = clean_environment(
        LD_PRELOAD=str(shim), REVISIT_TEST_FAIL_WRITE="500",
        REVISIT_TEST_STICKY="1")
    with Server(tmp_path / "store", *ADMIN, env=environment) as server:
        stub = server.stub()
        create(stub)
        assert scraped.get(server.admin, "/readyz")[0] == 200

        def refused():
            nonlocal first
            try:
                append(stub, VEHICLE, straight(16, first=first), timeout=30)
            except Exception as error:  # Whatever it is is compared below.
                return error
            first += 16
            return None

        first = 1
        error = wait_until(refused, "full disk")
        assert error.code().name == "RESOURCE_EXHAUSTED", error
        status, text, _ = scraped.get(server.admin, "/readyz")
        assert (status, text.count("\n")) == (503, 1)
        assert text.startswith("not writable: ")
        assert scraped.get(server.admin, "/livez")[0] == 200
        page = scraped.scrape(server)
        assert page.value("revisit_store_writable") == 0
        assert page.value("revisit_poses_refused_total",
                          reason="STORAGE_FULL") == 16
        assert page.value("revisit_poses_accepted_total") == first - 1


def test_garbage_is_refused_and_harms_nobody(server, seed):
    rng = random.Random(seed)
    requests = [b"", b"\r\n\r\n", b"GET /metrics HTTP/1.1\r\n" * 2000,
                b"GET /" + b"a" * 100_000 + b" HTTP/1.1\r\n\r\n",
                b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n",
                b"GET /metrics HTTP/1.1\r\nContent-Length: 9999999999999999999"
                b"\r\n\r\n",
                b"GET /metrics HTTP/1.1\r\nTransfer-Encoding: chunked\r\n\r\n"
                b"ffffffffffffffff\r\nx"]
    valid = b"GET /metrics HTTP/1.1\r\nHost: x\r\nConnection: close\r\n\r\n"
    for _ in range(200):
        mutated = bytearray(valid)
        for _ in range(rng.randint(1, 8)):
            mutated[rng.randrange(len(mutated))] = rng.randrange(256)
        requests.append(bytes(mutated))
    requests += [rng.randbytes(rng.randint(1, 2000)) for _ in range(100)]
    for request in requests:
        with connect(server) as bare:
            with contextlib.suppress(OSError):
                bare.sendall(request)
                bare.shutdown(socket.SHUT_WR)
                while bare.recv(1 << 16):
                    pass
    assert scraped.get(server.admin, "/livez")[0] == 200
    assert server.is_running()


def test_many_slow_connections_hold_up_neither_probes_nor_calls(server):
    stub = server.stub()
    with contextlib.ExitStack() as stack:
        for i in range(300):
            bare = stack.enter_context(connect(server))
            bare.sendall(b"GET /metrics HTTP/1.1\r\nHost: "[:i % 30])
        for _ in range(20):
            assert scraped.get(server.admin, "/livez", timeout=5)[0] == 200
            assert scraped.get(server.admin, "/readyz", timeout=5)[0] == 200
        stub.GetServerInfo(api.GetServerInfoRequest(), timeout=5)
        # They do not take the descriptors of callers.
        assert scraped.scrape(server).value("process_open_fds") < 150


def test_a_reader_of_metrics_that_reads_nothing_holds_up_nobody(server):
    with contextlib.ExitStack() as stack:
        for _ in range(10):
            bare = stack.enter_context(connect(server))
            bare.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 1024)
            with contextlib.suppress(BlockingIOError):
                bare.setblocking(False)
                for _ in range(200):
                    bare.send(b"GET /metrics HTTP/1.1\r\nHost: x\r\n\r\n")
        assert scraped.get(server.admin, "/livez", timeout=5)[0] == 200


def test_port_is_that_of_the_setting(tmp_path):
    port = free_port()
    with Server(tmp_path / "store", "--admin-listen",
                f"127.0.0.1:{port}") as server:
        assert server.admin == f"127.0.0.1:{port}"
        server.logged(f"admin_address=127.0.0.1:{port}")
