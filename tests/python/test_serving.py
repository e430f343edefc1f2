"""Servers that a program starts for itself: while it goes on, however it ends, and
where they cannot be."""

import asyncio
import contextlib
import os
import re
import shutil
import signal
import stat
import subprocess
import sys
import textwrap
import threading

import grpc
import pytest

import revisit
from conftest import LONG, straight
from revisit import _server_process, aio
from revisit_server import BIN, Server, open_files, wait_until
from served import is_gone, pid_of
from test_asyncio import in_event_loop, until

pytestmark = pytest.mark.usefixtures("scratch")


@contextlib.contextmanager
def script(text, **popen):
    """A Python of its own that runs the text. Its standard output says what there is to
    wait for."""
    running = subprocess.Popen(
        [sys.executable, "-u", "-c", textwrap.dedent(text)], text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, **popen)
    try:
        yield running
    finally:
        if running.poll() is None:
            running.kill()
        running.communicate(timeout=LONG)


# ---- What a server of one's own does


def test_a_server_serves_until_its_client_is_closed(scratch):
    with revisit.serve() as client:
        assert re.fullmatch(r"127\.0\.0\.1:\d+", client.address)
        client.create_vehicle("a")
        assert client.append_poses("a", straight(5)).durable_sequence == 5
        with revisit.Client(client.address) as other:
            assert other.get_vehicle("a").durable_sequence == 5
        assert [client.store] == list(scratch.iterdir())
        pid = pid_of(client)
    assert is_gone(pid)
    assert not client.store.exists()
    with pytest.raises(revisit.Cancelled, match="closed"):
        client.get_vehicle("a")


def test_a_store_is_kept_and_served_again_after_a_change_of_directory(tmp_path,
                                                                      monkeypatch):
    monkeypatch.chdir(tmp_path)
    with revisit.serve("below/drives") as client:
        assert client.store == tmp_path / "below/drives"
        client.create_vehicle("a")
        monkeypatch.chdir("/")
        client.append_poses("a", straight(5))
    with revisit.serve(tmp_path / "below/drives") as client:
        assert client.get_vehicle("a").durable_sequence == 5


def test_settings_are_keywords(tmp_path):
    with revisit.serve(max_batch_poses=7, serve_health=False, serve_reflection=True,
                       audit_log=tmp_path / "audit", slow_call_seconds=0.5) as client:
        assert client.server_info().max_batch_poses == 7
        client.create_vehicle("a")
        with grpc.insecure_channel(client.address) as channel:
            with pytest.raises(grpc.RpcError) as raised:
                channel.unary_unary("/grpc.health.v1.Health/Check")(b"", timeout=LONG)
        assert raised.value.code() == grpc.StatusCode.UNIMPLEMENTED
    assert (tmp_path / "audit").read_text()


def test_settings_of_the_environment_are_kept_from_it(monkeypatch, tmp_path):
    monkeypatch.setenv("REVISIT_STORE", str(tmp_path / "other"))
    monkeypatch.setenv("REVISIT_NO_SUCH", "1")
    with revisit.serve() as client:
        client.server_info()
    assert not (tmp_path / "other").exists()


def test_the_log_can_be_read_before_and_after_the_end():
    with revisit.serve(log_format="json") as client:
        wait_until(lambda: '"serving"' in client.log, "log")
        before = client.log
    assert client.log.startswith(before)
    assert '"stopped"' in client.log
    client.close()
    assert '"stopped"' in client.log


def test_no_file_stays_open():
    with revisit.serve() as client:
        client.server_info()
    before = sorted(open_files(os.getpid()).splitlines())
    for _ in range(3):
        with revisit.serve() as client:
            client.server_info()

    def left():
        now = sorted(open_files(os.getpid()).splitlines())
        return [name for name in now if re.match("pipe|.*revisit|.*deleted", name)
                and name not in before]

    wait_until(lambda: not left(), "end of open files")


def test_many_servers_run_at_once(in_thread):
    started = threading.Barrier(4)

    def run(number):
        with revisit.serve() as client:
            client.create_vehicle(f"vehicle-{number}")
            started.wait(LONG)
            return (client.address,
                    [vehicle.name for vehicle in client.list_vehicles()])

    ends = [in_thread(run, number) for number in range(4)]
    found = [end() for end in ends]
    assert len({address for address, _ in found}) == 4
    assert [names for _, names in found] == [
        [f"vehicles/vehicle-{number}"] for number in range(4)]


# ---- How it ends


def test_an_exception_ends_the_server_and_goes_on():
    with pytest.raises(ZeroDivisionError):
        with revisit.serve() as client:
            client.create_vehicle("a")
            raise ZeroDivisionError
    assert is_gone(pid_of(client))


def test_closing_twice_and_from_several_threads_is_closing_once(in_thread):
    client = revisit.serve()
    for end in [in_thread(client.close) for _ in range(3)]:
        end()
        assert is_gone(pid_of(client))
    client.close()


def test_a_client_that_nobody_refers_to_ends_its_server():
    client = revisit.serve()
    pid = pid_of(client)
    del client
    wait_until(lambda: is_gone(pid), "end of the server")


def test_a_stream_keeps_the_server_of_a_client_that_is_forgotten():
    client = revisit.serve()
    client.create_vehicle("a")
    pid = pid_of(client)
    stream = client.stream_poses("a")
    del client
    stream.append(straight(5))
    stream.finish()
    assert stream.acked_sequence == 5 and not is_gone(pid)
    stream.close()


def test_the_end_of_the_program_ends_the_server(scratch):
    with script("""
            import revisit
            client = revisit.serve()
            print(client._server._process.pid, flush=True)
            """) as program:
        pid = int(program.stdout.readline())
        assert program.wait(LONG) == 0
        assert is_gone(pid)


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGINT],
                         ids=lambda number: number.name)
def test_a_signal_that_ends_the_program_ends_the_server(number, tmp_path, scratch):
    """Also if it was started by a thread that is over, and while a fork lives on."""
    with script("""
            import os, sys, threading, time
            import revisit
            made = []
            starter = threading.Thread(
                target=lambda: made.extend([revisit.serve("store"), revisit.serve()]))
            starter.start()
            starter.join()
            made[0].create_vehicle("a")
            fork = os.fork()
            if fork == 0:
                sys.stdin.read()
                os._exit(0)
            made[1].create_vehicle("b")
            print(*(one._server._process.pid for one in made), fork, flush=True)
            while True:
                time.sleep(0.1)
            """, cwd=tmp_path) as program:
        *servers, fork = map(int, program.stdout.readline().split())
        assert list(scratch.iterdir())
        program.send_signal(number)
        program.wait(LONG)
        wait_until(lambda: all(map(is_gone, servers)), "end of the servers")
        assert not is_gone(fork)
        assert list(scratch.iterdir()) == []
        # It ended in good order, and left the store to the next.
        with revisit.serve(tmp_path / "store") as client:
            assert [one.name for one in client.list_vehicles()] == ["vehicles/a"]


def test_ctrl_c_reaches_the_program_before_the_server(tmp_path):
    """The terminal sends it to all processes of the group."""
    with script("""
            import sys, time
            import revisit
            try:
                with revisit.serve("store") as client:
                    try:
                        print("serving", flush=True)
                        while True:
                            time.sleep(0.1)
                    except KeyboardInterrupt:
                        client.create_vehicle("a")
                        print("created", flush=True)
                        raise
            except KeyboardInterrupt:
                print("closed", flush=True)
            """, cwd=tmp_path, start_new_session=True) as program:
        assert program.stdout.readline() == "serving\n"
        os.killpg(program.pid, signal.SIGINT)
        assert program.stdout.read() == "created\nclosed\n"
        assert program.wait(LONG) == 0


def test_a_fork_neither_uses_nor_ends_the_server():
    with script("""
            import os, sys, threading
            import revisit
            client = revisit.serve()
            client.create_vehicle("a")
            stream = client.stream_poses("a")
            locked, forked = threading.Event(), threading.Event()

            def use():
                with stream._changed:
                    locked.set()
                    forked.wait()

            threading.Thread(target=use).start()
            locked.wait()
            fork = os.fork()
            if fork == 0:
                try:
                    client.server_info()
                except RuntimeError as error:
                    print(error, flush=True)
                client.close()
                sys.exit(3)
            assert os.waitpid(fork, 0)[1] == 3 << 8
            forked.set()
            print(client.get_vehicle("a").name, flush=True)
            client.close()
            """) as program:
        said, errors = program.communicate(timeout=LONG)
    assert program.returncode == 0, errors
    refused, served = said.splitlines()
    assert "a fork makes one of its own: revisit.Client(" in refused
    assert served == "vehicles/a"


# ---- What is refused


@pytest.mark.parametrize("settings, kind, message", [
    ({"max_batch_pose": 7}, TypeError,
     "no setting max_batch_pose; did you mean max_batch_poses?"),
    ({"config": "revisitd.conf"}, TypeError, "no setting config"),
    ({"listen": "127.0.0.1:1"}, TypeError, "listen is not for a server of"),
    ({"end_with_input": False}, TypeError, "end_with_input is not for"),
    ({"temporary_store": True}, TypeError, "temporary_store is not for"),
    ({"tls_cert": "cert.pem"}, TypeError, "tls_cert is not for"),
    ({"policy": "policy.json"}, TypeError, "policy is not for"),
    ({"max_batch_poses": [7]}, TypeError, r"max_batch_poses is \[7\]"),
    ({"max_batch_poses": None}, TypeError, "max_batch_poses is None"),
    ({"max_batch_poses": 0}, ValueError, r'max-batch-poses: got "0"; allowed is'),
    ({"log_level": "loud"}, ValueError, 'log-level: got "loud"'),
    ({"store": 7}, TypeError, "store is 7: it is the path of a directory"),
    ({"store": b"drives"}, TypeError, "store is b'drives'"),
    ({"store": ""}, ValueError, "store is ''"),
    ({"store": "postgresql:///fleet"}, ValueError, "keeps its store in a directory"),
    ({"store": __file__}, NotADirectoryError, "is no directory"),
    ({"start_deadline": 0}, ValueError, "start_deadline is 0 s: it is positive"),
    ({"max_attempts": 0}, ValueError, "max_attempts is 0: it is at least 1"),
], ids=str)
def test_wrong_arguments_are_refused_by_name(settings, kind, message, scratch):
    with pytest.raises(kind, match=message):
        revisit.serve(**settings)
    assert list(scratch.iterdir()) == []


def test_a_store_that_another_server_has_is_told(tmp_path):
    with Server(tmp_path / "store"):
        with pytest.raises(revisit.ServerEnded) as raised:
            revisit.serve(tmp_path / "store")
    assert raised.value.exit_code > 0
    assert str(tmp_path / "store") in raised.value.log


def program_that(text, path):
    """A revisitd that has the settings of the real one, and else does this."""
    path.write_text(f"""#!/bin/sh
if [ "$1" = --print-config ]; then exec {BIN}/revisitd --print-config; fi
{text}
""")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)
    return str(path)


def test_a_start_that_takes_too_long_is_given_up(tmp_path, monkeypatch):
    monkeypatch.setenv("REVISIT_SERVER_PROGRAM", program_that(
        f"echo $$ > {tmp_path}/pid; echo still looking >&2; exec sleep 600",
        tmp_path / "slow"))
    with pytest.raises(TimeoutError, match="; its log ends:\nstill look") as raised:
        revisit.serve(start_deadline=2.0)
    # Whatever holds on to the error, and with it to what was begun.
    assert raised
    assert is_gone((tmp_path / "pid").read_text().strip())


def test_a_start_that_is_interrupted_leaves_nothing(tmp_path, monkeypatch, scratch):
    monkeypatch.setenv("REVISIT_SERVER_PROGRAM", program_that(
        f"echo $$ > {tmp_path}/new; mv {tmp_path}/new {tmp_path}/pid; exec sleep 600",
        tmp_path / "slow"))

    def interrupt():
        wait_until(lambda: (tmp_path / "pid").exists() and _server_process._running,
                   "start")
        signal.pthread_kill(threading.main_thread().ident, signal.SIGINT)

    threading.Thread(target=interrupt, daemon=True).start()
    with pytest.raises(KeyboardInterrupt) as raised:
        revisit.serve()
    assert raised
    assert is_gone((tmp_path / "pid").read_text().strip())
    assert list(scratch.iterdir()) == []


def test_a_server_that_is_no_server_is_told(tmp_path, monkeypatch):
    monkeypatch.setenv("REVISIT_SERVER_PROGRAM", program_that(
        "printf 'out of \\033[31mluck\\n' >&2; exit 7", tmp_path / "other"))
    with pytest.raises(revisit.ServerEnded) as raised:
        revisit.serve()
    assert raised.value.exit_code == 7
    assert str(raised.value) == ("revisitd ended with exit code 7; its log ends:\n"
                                 "out of <U+001B>[31mluck")
    monkeypatch.setenv("REVISIT_SERVER_PROGRAM", shutil.which("true"))
    with pytest.raises(RuntimeError, match="too old for this package"):
        revisit.serve()


# ---- asyncio


@in_event_loop
async def test_a_server_for_asyncio_serves_until_its_block_is_left(tmp_path):
    async with aio.serve(tmp_path / "store", max_batch_poses=7) as client:
        assert (await client.server_info()).max_batch_poses == 7
        await client.create_vehicle("a")
        async with client.stream_poses("a") as stream:
            await stream.append(straight(5))
        assert client.store == tmp_path / "store" and client.log
        async with aio.Client(client.address) as other:
            assert (await other.get_vehicle("a")).durable_sequence == 5
    assert is_gone(pid_of(client))
    await client.close()
    with pytest.raises(ZeroDivisionError):
        async with aio.serve() as client:
            raise ZeroDivisionError
    assert is_gone(pid_of(client))


@in_event_loop
async def test_for_asyncio_wrong_arguments_are_refused_by_name():
    for settings, kind in (({"max_batch_pose": 7}, TypeError),
                           ({"max_batch_poses": 0}, ValueError),
                           ({"max_attempts": 0}, ValueError)):
        with pytest.raises(kind, match=next(iter(settings)).split("_")[0]):
            async with aio.serve(**settings):
                pass


@in_event_loop
async def test_for_asyncio_a_start_that_is_cancelled_leaves_nothing(tmp_path):
    entered = asyncio.Event()

    async def start():
        async with aio.serve(tmp_path / "store"):
            entered.set()

    starting = asyncio.create_task(start())
    await until((tmp_path / "store").exists, "start")
    starting.cancel()
    with pytest.raises(asyncio.CancelledError):
        await starting
    assert not entered.is_set()

    def is_free():
        with contextlib.suppress(revisit.ServerEnded):
            with revisit.serve(tmp_path / "store"):
                return True

    await asyncio.to_thread(wait_until, is_free, "end of the server")
