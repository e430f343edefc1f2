"""A server that a program has started for itself, and that ends by itself: what waits
for it learns that, and nothing is asked of another."""

import asyncio
import os
import signal

import pytest

import revisit
from conftest import straight
from revisit import aio
from revisit_server import Server, wait_until
from served import check_ended, is_gone, killed, pid_of
from test_asyncio import in_event_loop, until

pytestmark = pytest.mark.usefixtures("scratch")


@pytest.mark.parametrize("call", [
    lambda client: client.server_info(),
    lambda client: client.delete_vehicle("a"),
    lambda client: client.append_poses("a", straight(1))],
    ids=["safe", "unsafe", "data"])
def test_calls_after_the_end_of_the_server_say_so(call):
    with revisit.serve() as client:
        client.create_vehicle("a")
        killed(client)
        for _ in range(2):
            with pytest.raises(revisit.ServerEnded) as raised:
                call(client)
            check_ended(raised)


def test_streams_and_watches_end_with_the_server(in_thread):
    options = revisit.StreamOptions(send_candidates=True)
    with revisit.serve(default_checks="stored") as client:
        client.create_vehicle("a")
        stream = client.stream_poses("a", options)
        stream.append(straight(5))
        wait_until(lambda: stream.acked_sequence == 5, "acknowledgement")
        watching = client.watch()
        waits = {
            "watch": in_thread(lambda: next(iter(watching))),
            "candidates": in_thread(lambda: list(stream.candidates()))}
        wait_until(lambda: watching.cursor, "open watch")
        killed(client)
        for wait in waits.values():
            with pytest.raises(revisit.ServerEnded) as raised:
                wait()
            check_ended(raised)
        for late in (stream.finish, lambda: stream.append(straight(1, first=6)),
                     lambda: next(iter(client.watch()))):
            with pytest.raises(revisit.ServerEnded):
                late()


def test_calls_that_run_end_with_the_server(in_thread):
    with revisit.serve() as client:
        client.server_info()
        os.kill(pid_of(client), signal.SIGSTOP)
        call = in_thread(lambda: client.create_vehicle("a"))
        killed(client)
        with pytest.raises(revisit.ServerEnded) as raised:
            call()
        check_ended(raised)


def test_another_server_at_its_address_is_not_taken_for_it(tmp_path):
    with revisit.serve() as client:
        client.create_vehicle("a")
        killed(client)
        wait_until(lambda: is_gone(pid_of(client)), "end of the server")
        with Server(tmp_path / "store", listen=client.address):
            for call in (client.server_info, lambda: next(iter(client.watch())),
                         client.stream_poses("a").finish):
                with pytest.raises(revisit.ServerEnded) as raised:
                    call()
                check_ended(raised)


@in_event_loop
async def test_for_asyncio_calls_streams_and_watches_end_with_the_server():
    async with aio.serve(default_checks="stored") as client:
        await client.create_vehicle("a")
        stream = client.stream_poses("a", revisit.StreamOptions(send_candidates=True))
        await stream.append(straight(5))
        watching = client.watch()

        async def answers():
            return [answer async for answer in stream.candidates()]

        async def event():
            async for event in watching:
                return event

        waits = [asyncio.create_task(answers()), asyncio.create_task(event())]
        await until(lambda: stream.acked_sequence == 5 and watching.cursor, "answers")
        killed(client)
        # The first is not made again.
        for wait in (client.delete_vehicle("a"), *waits, client.server_info(),
                     stream.finish()):
            with pytest.raises(revisit.ServerEnded) as raised:
                await wait
            check_ended(raised)
