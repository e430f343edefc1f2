"""The client for asyncio does what the blocking one does: it has the same calls, its
streams bring every pose exactly once whatever happens to the server, and nothing of it
keeps the event loop waiting."""

import asyncio
import contextlib
import functools
import inspect
import random
import time

import grpc
import numpy as np
import pytest

import revisit
from conftest import LONG, as_bytes, stopped, straight
from drive_client import Drive
from fake_service import Fault, FakeService, serving
from revisit import BackoffOptions, StreamCallbacks, StreamOptions, aio, v1

SEED = 20101018
QUICK = {"backoff": BackoffOptions(initial=0.01, max=0.2), "answer_timeout": 5.0}
ASKED = StreamOptions(send_candidates=True)
Code = grpc.StatusCode


def in_event_loop(test):
    """Runs a test that is a coroutine function; one that hangs fails."""
    @functools.wraps(test)
    def run(**fixtures):
        async def body():
            await asyncio.wait_for(test(**fixtures), 5 * LONG)
        asyncio.run(body())
    return run


async def until(condition, what):
    deadline = time.monotonic() + LONG
    while not condition():
        assert time.monotonic() < deadline, f"no {what}"
        await asyncio.sleep(0.001)


def batches(poses, size=64):
    return (poses[row:row + size] for row in range(0, len(poses), size))


def surface(kind):
    return {name: member for name, member in inspect.getmembers(kind)
            if not name.startswith("_")}


@pytest.mark.parametrize("blocking, awaited", [
    (revisit.Client, aio.Client), (revisit.PoseStream, aio.PoseStream)])
def test_both_clients_have_the_same_members_and_arguments(blocking, awaited):
    assert surface(blocking).keys() == surface(awaited).keys()
    for name, member in surface(blocking).items():
        other = surface(awaited)[name]
        assert other.__doc__, name
        if callable(member) and name != "run":
            assert (inspect.signature(member).parameters
                    == inspect.signature(other).parameters), name


@in_event_loop
async def test_every_call_answers(server, boreas, tmp_path):
    async with aio.Client(server.address) as client:
        assert (await client.server_info()).max_batch_poses > 0
        made = await client.create_vehicle("calls", labels={"a": "b"}, max_candidates=2)
        assert made.settings.max_candidates == 2
        async with client.stream_poses("calls") as stream:
            await stream.append(boreas[0])
        answer = await client.find_candidates("calls", exhaustive=True)
        best, other = answer.candidates
        added = await client.add_loop_closure("calls", best)
        await client.reject_candidate("calls", other, note="a bridge")
        assert [one.name async for one in client.list_loop_closures("calls")] == [
            added.loop_closure.name]
        [rejected] = [one async for one in client.list_rejected_candidates("calls")]
        graph = await client.export_pose_graph("calls")
        assert graph.edges["kind"].tolist().count("LOOP_CLOSURE") == 1
        await client.export("calls", tmp_path / "a.g2o")
        assert (tmp_path / "a.g2o").stat().st_size > 0
        drawn = await client.map("calls", format="svg", check_interval=1000)
        assert drawn.text.startswith("<svg")
        await client.delete_loop_closure(added.loop_closure.name)
        await client.delete_rejected_candidate(rejected.name)
        assert [one.WhichOneof("pair") async for one in
                client.list_deleted_pose_pairs("calls")] == [
            "rejected_candidate", "loop_closure"]
        poses = await client.poses("calls")
        poses.position[:, 1] += 1.0
        revision = (await client.get_vehicle("calls")).revision
        assert (await client.revise_poses("calls", poses, revision)
                ).revised_count == len(poses)
        assert (await client.update_vehicle("calls", display_name="C")
                ).display_name == "C"
        with pytest.raises(revisit.FailedPrecondition):
            await client.accept_data_loss("calls", 0)
        assert "vehicles/calls" in [one.name async for one in client.list_vehicles()]
        await client.delete_vehicle("calls")
        with pytest.raises(revisit.NotFound) as caught:
            await client.call("GetVehicle", v1.GetVehicleRequest(name="vehicles/calls"),
                              request_id="my-own 7")
        assert (caught.value.reason, caught.value.request_id) == (
            "VEHICLE_NOT_FOUND", "my-own 7")


@in_event_loop
async def test_pages_are_walked_to_the_end(server):
    async with aio.Client(server.address) as client:
        await client.create_vehicle("pages")
        async with client.stream_poses("pages") as stream:
            await stream.append(straight(25_000))
        poses = await client.poses("pages")
        assert poses.sequence.tolist() == list(range(1, 25_001))


@in_event_loop
async def test_a_list_that_does_not_go_on_ends_with_an_error():
    fake = FakeService()
    fake.pages = lambda token: (["vehicles/a"], token + "x")
    with serving(fake) as address:
        async with aio.Client(address) as client:
            with pytest.raises(revisit.Internal, match="does not go on"):
                [one async for one in client.list_vehicles()]


@in_event_loop
async def test_nothing_is_lost_or_doubled_when_the_server_is_killed(restarted):
    """Poses go in while the server is killed again and again."""
    rng = random.Random(SEED)
    poses = Drive(SEED)[0:6000]
    acked, lost, resumed = [], [], []

    async def heard(ack):
        # The stream awaits a callback that can be awaited.
        await asyncio.sleep(0)
        acked.append(ack.durable_sequence)

    options = StreamOptions(send_candidates=True, max_pending_poses=256,
                            batch_poses=16, **QUICK)
    callbacks = StreamCallbacks(
        ack=heard, candidates=lambda answer: None, resumed=resumed.append,
        disconnected=lambda error, wait: lost.append(error))
    loop = asyncio.get_running_loop()
    async with aio.Client(restarted.address) as client:
        await client.create_vehicle("survivor")
        async with client.stream_poses("survivor", options, callbacks) as stream:
            await stream.wait_until_opened(LONG)

            async def append_all():
                for start in range(0, len(poses), 25):
                    await stream.append(poses[start:start + 25])
                await stream.finish()

            done = asyncio.create_task(append_all())
            for round_ in range(1, 6):
                await until(lambda: stream.acked_sequence >= round_ * 900, "progress")
                await asyncio.sleep(rng.random() * 0.02)
                await loop.run_in_executor(None, restarted.kill)
                await loop.run_in_executor(None, restarted.start)
                # Two kills within one reconnection would count as one.
                await until(lambda: len(resumed) >= round_ or done.done(),
                            "resumption")
            await done
            assert stream.reconnects >= 5 and len(resumed) >= 5 and len(lost) >= 5
            assert stream.acked_sequence == len(poses)
        stored = [pose async for pose in client.list_poses("survivor")]
        assert as_bytes(stored) == as_bytes(poses)
    assert acked and acked == sorted(acked)


@in_event_loop
async def test_a_stream_goes_on_after_a_graceful_restart(restarted):
    loop = asyncio.get_running_loop()
    async with aio.Client(restarted.address) as client:
        await client.create_vehicle("a")
        async with client.stream_poses("a", StreamOptions(**QUICK)) as stream:
            await stream.append(straight(50))
            await until(lambda: stream.acked_sequence == 50, "acknowledgement")
            await loop.run_in_executor(None, restarted.stop)
            await loop.run_in_executor(None, restarted.start)
            await stream.append(straight(50, first=51))
            await stream.finish()
        assert len(await client.poses("a")) == 100


@in_event_loop
async def test_a_server_that_stays_away_is_given_up_in_time():
    begun = time.monotonic()
    async with aio.Client("127.0.0.1:1") as client:
        stream = client.stream_poses("a", StreamOptions(give_up_after=1.0, **QUICK))
        with pytest.raises(revisit.Unavailable):
            await stream.wait_until_opened()
        with pytest.raises(revisit.Unavailable):
            await stream.append(straight(1))
        with pytest.raises(revisit.Unavailable):
            await stream.finish()
    assert time.monotonic() - begun < 20


@in_event_loop
async def test_candidates_are_those_of_the_blocking_client(server, client, boreas):
    def essence(answers):
        return [[(one.matched.sequence, one.verdict, one.probability)
                 for one in answer.candidates] for answer in answers]

    poses, _ = boreas
    client.create_vehicle("blocking")
    with client.stream_poses("blocking", ASKED) as stream:
        expected = essence(stream.run(batches(poses)))
    assert len(expected) == 312

    async def arriving():
        for batch in batches(poses):
            await asyncio.sleep(0)
            yield batch

    narrow = StreamOptions(send_candidates=True, max_waiting_candidates=1)
    async with aio.Client(server.address) as awaited:
        for number, source in enumerate((batches(poses), arriving())):
            vehicle = f"awaited-{number}"
            await awaited.create_vehicle(vehicle)
            async with awaited.stream_poses(vehicle, narrow) as stream:
                assert essence([one async for one in stream.run(source)]) == expected
        await awaited.create_vehicle("afterwards")
        async with awaited.stream_poses("afterwards", ASKED) as stream:
            await stream.append(poses)
            await stream.finish()
            assert essence(stream.take_candidates()) == expected


@in_event_loop
async def test_candidates_that_only_the_appending_task_could_take_are_no_deadlock(
        server, boreas):
    async with aio.Client(server.address) as client:
        await client.create_vehicle("deadlock")
        stream = client.stream_poses("deadlock", StreamOptions(
            send_candidates=True, max_waiting_candidates=3))
        await stream.append(boreas[0])
        with pytest.raises(revisit.FailedPrecondition, match="nobody but this task"):
            await stream.finish()
        taken = stream.take_candidates()
        while True:
            try:
                await stream.finish()
                break
            except revisit.FailedPrecondition:
                taken += stream.take_candidates()
        taken += stream.take_candidates()
    assert len(taken) == 312


@in_event_loop
async def test_errors_of_stream_source_and_callback_are_raised(server):
    async with aio.Client(server.address) as client:
        await client.create_vehicle("errors")
        poses = straight(1000)
        poses.covariance[900, 0] = -1.0
        with pytest.raises(revisit.InvalidArgument) as caught:
            async for _ in client.stream_poses("errors", ASKED).run(batches(poses)):
                pass
        assert caught.value.field_violations

        def source():
            yield straight(10)
            raise OSError("the disk is gone")

        await client.create_vehicle("source")
        stream = client.stream_poses("source", ASKED)
        with pytest.raises(OSError, match="the disk is gone"):
            async for _ in stream.run(source()):
                pass
        with pytest.raises(revisit.Cancelled):
            await stream.append(straight(10, first=11))

        def fail(ack):
            raise ZeroDivisionError("in a callback")

        await client.create_vehicle("callback")
        stream = client.stream_poses("callback", StreamOptions(),
                                     StreamCallbacks(ack=fail))
        await stream.append(straight(10))
        with pytest.raises(ZeroDivisionError, match="in a callback"):
            await stream.finish()
        with pytest.raises(KeyError):
            async with client.stream_poses("callback") as stream:
                raise KeyError
        with pytest.raises(revisit.Cancelled):
            await stream.finish()


@in_event_loop
async def test_a_loop_that_is_left_early_cancels(server, boreas):
    async with aio.Client(server.address) as client:
        await client.create_vehicle("left")
        stream = client.stream_poses("left", ASKED)
        async with contextlib.aclosing(stream.run(batches(boreas[0]))) as answers:
            async for _ in answers:
                break
        with pytest.raises(revisit.Cancelled):
            await stream.finish()


@in_event_loop
async def test_a_slow_server_makes_append_wait_and_nothing_else(server):
    options = StreamOptions(max_pending_poses=100, batch_poses=10, answer_timeout=LONG)
    async with aio.Client(server.address) as client:
        await client.create_vehicle("slow")
        async with client.stream_poses("slow", options) as stream:
            await stream.wait_until_opened(LONG)
            with stopped(server):
                appended = asyncio.create_task(stream.append(straight(1000)))
                await until(lambda: stream.pending_poses == 100, "full stream")
                assert not await stream.try_append(straight(1, first=101))
                # The event loop turns meanwhile.
                begun = time.monotonic()
                for _ in range(100):
                    await asyncio.sleep(0.001)
                assert time.monotonic() - begun < 5.0
                assert not appended.done() and stream.pending_poses == 100
            await appended
        assert len(await client.poses("slow")) == 1000


@in_event_loop
async def test_a_server_that_stands_still_is_left_for_a_new_connection(server):
    lost = []
    options = StreamOptions(answer_timeout=0.3,
                            backoff=BackoffOptions(initial=0.01, max=0.2))
    callbacks = StreamCallbacks(disconnected=lambda error, wait: lost.append(error))
    async with aio.Client(server.address) as client:
        await client.create_vehicle("stall")
        async with client.stream_poses("stall", options, callbacks) as stream:
            await stream.wait_until_opened(LONG)
            with stopped(server):
                await stream.append(straight(10))
                await until(lambda: stream.reconnects >= 2, "new connection")
            await stream.finish()
        assert lost[0].message == "no answer for 0.3 s"
        assert len(await client.poses("stall")) == 10


@pytest.mark.parametrize("fault", [
    Fault(Code.UNAVAILABLE, reason="OVERLOADED", retry=0.05), Fault(Code.INTERNAL),
    Fault(Code.CANCELLED), Fault(Code.RESOURCE_EXHAUSTED, reason="FULL", retry=0.05)],
    ids=lambda fault: f"{fault.code.name}")
@in_event_loop
async def test_a_call_and_a_stream_go_on_after(fault):
    fake = FakeService(fault, fault)
    with serving(fake) as address:
        async with aio.Client(address, backoff=QUICK["backoff"]) as client:
            assert (await client.get_vehicle("a")).name == "vehicles/a"
            assert fake.calls == 3
            fake.faults = [fault, fault]
            async with client.stream_poses("a", StreamOptions(**QUICK)) as stream:
                await stream.append(straight(10))
    assert fake.stored == list(range(1, 11)) and stream.reconnects == 2


@in_event_loop
async def test_what_must_not_be_done_twice_is_not():
    fake = FakeService(Fault(Code.UNAVAILABLE))
    with serving(fake) as address:
        async with aio.Client(address) as client:
            with pytest.raises(revisit.Unavailable):
                await client.delete_vehicle("a")
    assert fake.calls == 1


class Deaf:
    """A call to a server whose end gRPC misses: it neither answers nor ends, not even
    if it is cancelled."""

    def __init__(self):
        self.calls = 0
        self.cancelled = 0

    def __aiter__(self):
        return self

    async def __anext__(self):
        await asyncio.sleep(LONG)

    def cancel(self):
        self.cancelled += 1


@in_event_loop
async def test_a_call_that_grpc_forgets_is_left_behind(monkeypatch):
    """The watchdog does not wait for the end of a call that never ends."""
    monkeypatch.setattr("revisit.aio._engine.CANCEL_SECONDS", 0.1)
    deaf = Deaf()

    class Stub:
        def StreamPoses(self, requests, metadata):
            deaf.calls += 1
            return deaf

    monkeypatch.setattr("revisit.aio._engine.stub_of", lambda channel: Stub())
    begun = time.monotonic()
    async with aio.Client("127.0.0.1:1") as client:
        stream = client.stream_poses("a", StreamOptions(
            backoff=QUICK["backoff"], answer_timeout=0.1, give_up_after=1.0))
        with pytest.raises(revisit.Unavailable, match="no answer for 0.1 s"):
            await stream.finish()
        assert deaf.calls == deaf.cancelled > 1
    assert time.monotonic() - begun < 20


@in_event_loop
async def test_a_closed_client_ends_calls_and_streams(server):
    client = aio.Client(server.address)
    await client.create_vehicle("closed")
    stream = client.stream_poses("closed")
    await stream.wait_until_opened(LONG)
    with stopped(server):
        call = asyncio.create_task(client.server_info())
        await asyncio.sleep(0.1)
        await client.close()
        with pytest.raises(revisit.Cancelled, match="closed"):
            await call
    with pytest.raises(revisit.Cancelled):
        await stream.append(straight(10))
    with pytest.raises(revisit.Cancelled, match="closed"):
        await client.server_info()


@in_event_loop
async def test_a_task_that_is_cancelled_stops_waiting(server):
    async with aio.Client(server.address) as client:
        await client.create_vehicle("cancelled")
        with stopped(server):
            for waiting in (client.server_info(),
                            client.stream_poses("cancelled").wait_until_opened()):
                task = asyncio.create_task(waiting)
                await asyncio.sleep(0.05)
                task.cancel()
                with pytest.raises(asyncio.CancelledError):
                    await task
        assert (await client.server_info()).version


@in_event_loop
async def test_a_hundred_streams_are_held_at_a_time(server):
    async with aio.Client(server.address) as client:
        async def drive(number):
            vehicle = f"many-{number}"
            await client.create_vehicle(vehicle)
            async with client.stream_poses(vehicle) as stream:
                for start in range(1, 101, 20):
                    await stream.append(straight(20, first=start))
            return (await client.get_vehicle(vehicle)).durable_sequence

        assert await asyncio.gather(*map(drive, range(100))) == [100] * 100


@in_event_loop
async def test_arrays_without_sequences_are_numbered_behind_what_is_there(server):
    unnumbered = straight(10, first=8)
    unnumbered.sequence[:] = 0
    async with aio.Client(server.address) as client:
        await client.create_vehicle("numbered")
        await client.append_poses("numbered", straight(7))
        async with client.stream_poses("numbered") as stream:
            await stream.append(unnumbered[:4])
            await stream.append(unnumbered[4:])
        stored = await client.poses("numbered")
        assert np.array_equal(stored.sequence, np.arange(1, 18))


@in_event_loop
async def test_warnings_are_returned_and_logged(server, caplog):
    poses = straight(200)
    poses.heading[:] = 90.0
    async with aio.Client(server.address) as client:
        await client.create_vehicle("warned")
        async with client.stream_poses("warned") as stream:
            await stream.append(poses)
            await stream.finish()
            assert len(stream.warnings) == 2
    assert caplog.text.count("What to do: ") == 2


def test_recordings_are_listed_by_asyncio_too(server, client, new_vehicle):
    vehicle = new_vehicle()
    client.append_poses(vehicle, straight(20))
    client.append_poses(vehicle, straight(20).numbered(21).as_recording("after"))

    async def listed():
        async with revisit.aio.Client(server.address) as other:
            return [recording.first_sequence
                    async for recording in other.list_recordings(vehicle)]

    assert asyncio.run(listed()) == [1, 21]
