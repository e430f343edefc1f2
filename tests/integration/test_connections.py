"""Floods of connections, connections that come to nothing, and those that ask
too much of one: only they are cut, and the server takes the next at once."""

import contextlib
import signal
import socket
import statistics
import struct
import subprocess
import sys
import time

import grpc
import pytest

from raw_http2 import PATIENCE_SECONDS, RawConnection
from revisit_server import (BIN, RUN_SECONDS, Server, clean_environment,
                            wait_until)
from stubs import api

PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"


def frame_head(length, kind, flags, stream):
    return struct.pack(">IBBI", length, kind, flags, stream)[1:]


SETTINGS = frame_head(0, 4, 0, 0)


def info(stub, timeout=PATIENCE_SECONDS, **more):
    return stub.GetServerInfo(api.GetServerInfoRequest(), timeout=timeout,
                              **more)


def connect(server):
    return socket.create_connection(("127.0.0.1", server.port),
                                    timeout=PATIENCE_SECONDS)


def ended(connection, seconds=PATIENCE_SECONDS):
    """Whether the server ends the connection within this time."""
    deadline = time.monotonic() + seconds
    while True:
        connection.settimeout(max(deadline - time.monotonic(), 0.001))
        try:
            if connection.recv(4096) == b"":
                return True
        except TimeoutError:
            return False
        except ConnectionResetError:
            return True


@contextlib.contextmanager
def flood(server, count):
    """As many connections as a client can hold that asks for nothing."""
    with contextlib.ExitStack() as stack:
        sockets = []
        for _ in range(count):
            with contextlib.suppress(OSError):
                sockets.append(stack.enter_context(connect(server)))
        yield sockets


def test_flood_beyond_the_descriptors_is_shed_and_service_goes_on_at_once(
        tmp_path):
    with Server(tmp_path / "store", descriptors=96) as server:
        stub = server.stub()
        info(stub)
        times = []
        for _ in range(3):
            with flood(server, 300) as sockets:
                # The last ones are shed for certain, and the one that was
                # there before is served throughout.
                assert ended(sockets[-1])
                info(stub)
            start = time.monotonic()
            channel = server.channel(("grpc.use_local_subchannel_pool", 1))
            grpc.channel_ready_future(channel).result(
                timeout=PATIENCE_SECONDS)
            times.append(time.monotonic() - start)
            info(server.stub())
        # On a busy machine one of them may be late.
        assert statistics.median(times) < 2
        shed = server.logged(" connections_shed ")
        assert "limit=descriptors" in shed[0]
        # The store still has its files.
        stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id="after"))


def test_caps_of_connections_hold_and_count_only_the_living(tmp_path):
    with Server(tmp_path / "store", "--max-connections=8",
                "--max-connections-per-address=5") as server:
        for _ in range(3):
            with contextlib.ExitStack() as stack:
                kept = []
                # The server hears in its own time of those that went before.
                while len(kept) < 5:
                    with contextlib.suppress(ConnectionError):
                        one = stack.enter_context(RawConnection(server.port))
                        if one.is_alive():
                            kept.append(one)
                with contextlib.suppress(ConnectionResetError):
                    assert ended(stack.enter_context(connect(server)))
                assert all(one.is_alive() for one in kept)
                # Room for one comes as one goes.
                kept[2].close()
                wait_until(lambda: takes_one_more(server), "room")
        info(server.stub(), wait_for_ready=True)
        assert any("limit=max-connections-per-address" in line
                   for line in server.logged(" connections_shed "))


def takes_one_more(server):
    try:
        with connect(server) as connection:
            connection.sendall(PREFACE + SETTINGS)
            return connection.recv(9) != b""
    except ConnectionError:
        return False


# A program that has nothing else to do; it says when it is at it.
FLOODER = """
import socket, sys
count = 0
while True:
    try:
        with socket.socket() as one:
            one.setblocking(False)
            one.connect_ex(("127.0.0.1", int(sys.argv[1])))
    except OSError:
        pass
    count += 1
    if count == 1000:
        print(flush=True)
"""


@contextlib.contextmanager
def connect_flood(server, programs=3):
    """More connections than can be taken."""
    flooders = [subprocess.Popen(
        [sys.executable, "-S", "-c", FLOODER, str(server.port)],
        stdout=subprocess.PIPE) for _ in range(programs)]
    try:
        for one in flooders:
            one.stdout.read(1)
        yield
    finally:
        for one in flooders:
            one.kill()
            one.wait()
            one.stdout.close()


@pytest.mark.parametrize("flags", [[], ["--max-connections-per-address=10"]],
                         ids=["taken", "shed"])
def test_connect_flood_does_not_hold_up_the_end(flags, tmp_path):
    with Server(tmp_path / "store", "--drain-timeout-seconds=2",
                *flags) as server:
        with connect_flood(server):
            time.sleep(2)
            server.process.send_signal(signal.SIGTERM)
            assert server.process.wait(20) == 0


def test_connect_flood_does_not_hide_connections_that_do_harm(tmp_path):
    with Server(tmp_path / "store", "--max-idle-bytes=1000000") as server:
        with connect(server) as harmful:
            # Headers that do not end.
            harmful.sendall(PREFACE + SETTINGS + frame_head(1, 1, 0, 1) +
                            b"\x82")
            with connect_flood(server):
                time.sleep(1)
                piece = frame_head(16000, 9, 0, 1) + b"\x00\x01a\x00" * 4000
                with contextlib.suppress(ConnectionError, TimeoutError):
                    for _ in range(70):
                        harmful.sendall(piece)
                server.logged("limit=max-unadmitted-calls")


def test_socket_of_a_living_server_is_not_taken_from_it(tmp_path):
    path = tmp_path / "socket"
    port_file = tmp_path / "port"
    with Server(tmp_path / "store", "--port-file", port_file, wait=False,
                listen=f"unix:{path}"):
        wait_until(port_file.exists, "port file")
        second = subprocess.run(
            [BIN / "revisitd", "--listen", f"unix:{path}", "--store",
             tmp_path / "other"], capture_output=True, text=True,
            timeout=RUN_SECONDS,
            env=clean_environment(), check=False)
        assert second.returncode == 69, second
        assert "another program listens" in second.stderr
        with grpc.insecure_channel(f"unix:{path}") as channel:
            grpc.channel_ready_future(channel).result(
                timeout=PATIENCE_SECONDS)


def test_socket_of_a_server_that_was_killed_is_taken_over(tmp_path):
    path = tmp_path / "socket"
    for _ in range(2):
        port_file = tmp_path / "port"
        port_file.unlink(missing_ok=True)
        with Server(tmp_path / "store", "--port-file", port_file, wait=False,
                    listen=f"unix:{path}") as server:
            wait_until(port_file.exists, "port file")
            with grpc.insecure_channel(f"unix:{path}") as channel:
                grpc.channel_ready_future(channel).result(
                    timeout=PATIENCE_SECONDS)
            server.kill()
        assert path.exists()


@pytest.mark.parametrize("opening", [
    b"", PREFACE[:10], PREFACE, b"\x16\x03\x01", b"GET / HTTP/1.1\r\n"],
    ids=["nothing", "half a preface", "no settings", "TLS", "HTTP/1.1"])
def test_connection_that_does_not_open_as_grpc_does_is_closed(
        opening, tmp_path):
    with Server(tmp_path / "store", "--handshake-timeout-seconds=0.5") as server:
        stub = server.stub()
        # On a busy machine it may itself be too late at first.
        info(stub, wait_for_ready=True)
        with connect(server) as idle:
            idle.sendall(opening)
            assert ended(idle)
        info(stub)


def test_slow_opening_does_not_hold_a_place(tmp_path):
    """A byte now and then, from many at once."""
    with Server(tmp_path / "store", "--handshake-timeout-seconds=0.5") as server:
        stub = server.stub()
        info(stub, wait_for_ready=True)
        with flood(server, 100) as sockets:
            assert len(sockets) == 100
            for byte in PREFACE:
                for connection in sockets:
                    with contextlib.suppress(OSError):
                        connection.send(bytes([byte]))
                info(stub)
                # The pace of these senders.
                time.sleep(0.03)
            assert all(ended(connection) for connection in sockets)


def test_connection_without_a_call_is_closed_after_a_while(tmp_path):
    with Server(tmp_path / "store", "--connection-idle-seconds=1") as server:
        stub = server.stub()
        info(stub)
        with connect(server) as half:
            # A call's headers that never end.
            half.sendall(PREFACE + SETTINGS + frame_head(100, 1, 0, 1) +
                         b"\x82\x86\x84")
            assert ended(half)
        # A client that comes back does not notice.
        info(stub)


@pytest.mark.parametrize("address", ["unix:{}/socket", "localhost:0", "[::1]:0",
                                     "unix-abstract:revisit-{}"])
def test_all_kinds_of_addresses_are_listened_at(address, tmp_path):
    text = address.format(tmp_path)
    if "[::1]" in text and not has_ipv6():
        pytest.skip("this machine has no IPv6")
    port_file = tmp_path / "port"
    server = Server(tmp_path / "store", "--port-file", port_file, wait=False,
                    listen=text)
    with server:
        wait_until(port_file.exists, "port file")
        at = port_file.read_text().strip()
        with grpc.insecure_channel(at) as channel:
            grpc.channel_ready_future(channel).result(
                timeout=PATIENCE_SECONDS)
    if text.startswith("unix:"):
        assert not (tmp_path / "socket").exists()


def has_ipv6():
    try:
        with socket.create_server(("::1", 0), family=socket.AF_INET6):
            return True
    except OSError:
        return False
