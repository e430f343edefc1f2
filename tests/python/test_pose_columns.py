"""Poses go to the server and come back as columns, and are the same poses, bit for bit,
as those that go as messages."""

import asyncio
import contextlib
import random
import time

import grpc
import numpy as np
import pytest

import revisit
from column_rows import random_poses
from conftest import LONG, as_bytes, straight
from drive_client import Drive
from fake_service import serving
from revisit import Poses, StreamOptions, v1
from revisit._pending import PendingPoses, held_arrays, held_messages
from revisit._pose_columns import arrays_of, columns_of, sequence_at
from revisit.v1 import pose_graph_service_pb2_grpc as service
from revisit_server import wait_until
from test_arrays import identical
from wire import expanded

SEED = 20101018
#: Waits and stall limits for servers that come to harm.
QUICK = {"backoff": revisit.BackoffOptions(initial=0.01, max=0.2),
         "answer_timeout": 5.0}


def noncontiguous(poses):
    """The same poses in arrays whose rows do not lie side by side."""
    doubled = np.repeat(np.arange(len(poses)), 2)
    return poses[doubled][::2]


# Columns say what poses say.


def test_columns_say_what_the_poses_say_to_the_bit():
    rng = np.random.default_rng(SEED)
    for _ in range(500):
        poses = random_poses(rng, int(rng.integers(1, 6)), int(rng.integers(1, 2**40)))
        messages = list(poses.to_messages())
        columns = columns_of(noncontiguous(poses))
        assert as_bytes(expanded(columns)) == as_bytes(messages)
        back = arrays_of(columns)
        assert as_bytes(back.to_messages()) == as_bytes(messages)
        assert identical(back, Poses.from_messages(messages))


def test_a_step_may_have_64_bits():
    poses = straight(5)
    poses.stamp[:] = np.array([-2**62, 2**62 - 1, -2**62, -2**62 - 1, 63 - 2**62],
                              "datetime64[ns]")
    columns = columns_of(poses)
    assert list(columns.stamp_step_nanos) == [2**63 - 1, -2**63 + 1, -1, 64]
    assert identical(arrays_of(columns), poses)


def test_numbers_that_all_poses_have_are_sent_once():
    columns = columns_of(straight(5))
    assert list(columns.covariance_diagonals) == [0.01, 0.01, 1e-4]
    assert not columns.covariances and not columns.z_meters


@pytest.mark.parametrize("name, value", [
    ("stamp", np.datetime64("NaT")), ("stamp", np.datetime64(-2**63 + 1, "ns")),
    ("is_geodetic", True), ("quaternion", 0.5), ("covariance_form", 2),
    ("covariance_form", 0), ("error_transition", np.nan),
    ("recording_start", v1.RecordingStart()), ("sequence", 7)])
def test_rows_that_are_not_alike_have_no_columns(name, value):
    poses = Poses.local(np.arange(4.0), np.zeros(4), np.zeros(4), np.ones((4, 6)),
                        stamps=np.full(4, 2**62).astype("datetime64[ns]"),
                        sequence=np.arange(1, 5), error_transition=np.ones((4, 9)))
    assert columns_of(poses) is not None
    getattr(poses, name)[2] = value
    assert columns_of(poses) is None


def test_columns_that_do_not_fit_are_no_poses():
    good = columns_of(Poses.local(
        np.arange(4.0), np.zeros(4), np.zeros(4), np.ones((4, 6)),
        stamps=np.arange(4.0), sequence=np.arange(1, 5),
        error_transition=np.ones((4, 9))))
    changes = [
        lambda made: setattr(made, "pose_count", 0),
        lambda made: setattr(made, "pose_count", 2**31 - 1),
        lambda made: setattr(made, "first_sequence", 2**64 - 1),
        lambda made: setattr(made.first_stamp, "seconds", 2**62),
        lambda made: setattr(made, "covariance_form", 77),
        lambda made: made.quaternions.extend([1.0] * 16),
        *(lambda made, name=name: getattr(made, name).append(1) for name in (
            "x_meters", "y_meters", "z_meters", "heading_radians", "stamp_step_nanos",
            "covariances", "error_transitions")),
        *(lambda made, name=name: made.ClearField(name) for name in (
            "x_meters", "y_meters", "heading_radians", "covariances",
            "stamp_step_nanos"))]
    arrays_of(good)
    for number, change in enumerate(changes):
        wrong = v1.PoseColumns()
        wrong.CopyFrom(good)
        change(wrong)
        with pytest.raises(revisit.Internal, match="do not fit"):
            arrays_of(wrong)
            pytest.fail(f"change {number}")


# Poses that a stream holds.


def mixed_parts(rng, count):
    """Poses of all kinds in arrays and in lists, and all of them as messages."""
    everything = Drive(SEED)[0:count]
    for row in rng.sample(range(1, count), count // 20):
        everything[row].recording_start.unknown = True
    parts, first = [], 0
    while first < count:
        end = min(count, first + rng.choice([1, 2, 7, 40]))
        messages = everything[first:end]
        parts.append(Poses.from_messages(messages) if rng.random() < 0.7 else messages)
        first = end
    for row, message in enumerate(everything):
        # Neighbours that are alike.
        if row % 60 > 20:
            message.ClearField("stamp")
    return parts, everything


def messages_of(batch):
    assert bool(batch.poses) != batch.HasField("columns")
    return list(batch.poses) if batch.poses else list(expanded(batch.columns))


def test_a_stream_holds_each_pose_until_it_is_durable_and_sends_it_as_it_came():
    """Batches of any size, acknowledgements and connections that end anywhere, against
    a list."""
    for seed in range(20):
        rng = random.Random(seed)
        parts, _ = mixed_parts(rng, 400)
        everything = [message for part in parts for message in (
            part.to_messages() if isinstance(part, Poses) else part)]
        expected = as_bytes(everything)
        pending = PendingPoses(10**6, 10**9)
        taken = sent = durable = 0
        columns = 0
        while durable < len(everything):
            what = rng.random()
            if what < 0.4 and parts:
                part = parts.pop(0)
                held = held_arrays(part) if isinstance(part, Poses) else held_messages(
                    part)
                for one in held:
                    pending.take(one)
                    taken += len(one)
            elif what < 0.7 and pending.unsent > 0:
                batch = pending.next_batch(rng.choice([1, 3, 64]), rng.random() < 0.8)
                messages = messages_of(batch)
                assert as_bytes(messages) == expected[sent:sent + len(messages)]
                sent += len(messages)
                columns += batch.HasField("columns")
            elif what < 0.9:
                acknowledged = rng.randint(durable, sent)
                assert pending.drop_acknowledged(acknowledged) == acknowledged - durable
                durable = acknowledged
            else:
                pending.start_over()
                acknowledged = rng.randint(durable, pending.last_sent_sequence)
                assert pending.resume(acknowledged) == acknowledged - durable
                durable = sent = acknowledged
            assert (pending.sent, pending.unsent) == (sent - durable, taken - sent)
            assert (pending.bytes == 0) == (taken == durable)
        assert columns > 10


def test_arrays_are_held_as_they_were_when_they_were_taken():
    poses = straight(10)
    pending = PendingPoses(100, 10**6)
    [held] = held_arrays(poses)
    pending.take(held)
    poses.position[:] = 0.0
    assert list(pending.next_batch(64, True).columns.x_meters) == list(range(1, 11))


# On their way.


def graph_of(stub, name):
    """All of a vehicle's graph, to the bit."""
    parts = list(stub.ExportPoseGraph(v1.ExportPoseGraphRequest(vehicle=name)))
    return (as_bytes(node for part in parts for node in part.nodes),
            as_bytes(edge for part in parts for edge in part.edges))


def split(rng, poses, sizes=(1, 3, 64, 100, 500)):
    first = 0
    while first < len(poses):
        end = min(len(poses), first + rng.choice(sizes))
        yield poses[first:end]
        first = end


def test_the_graph_is_the_same_however_the_poses_come(server, client, new_vehicle,
                                                      boreas):
    poses, _ = boreas
    messages = list(poses.to_messages())
    rng = random.Random(SEED)
    ways = {
        "messages": lambda: [messages],
        "arrays": lambda: [poses],
        "arrays that are split": lambda: split(rng, noncontiguous(poses)),
        "messages that are split": lambda: split(rng, messages),
        "some of each": lambda: (
            part if rng.random() < 0.5 else list(part.to_messages())
            for part in split(rng, poses))}
    graphs, stored = {}, {}
    for way, parts in ways.items():
        vehicle = new_vehicle()
        options = StreamOptions(batch_poses=rng.choice([1, 64, 512]))
        with client.stream_poses(vehicle, options) as stream:
            for part in parts():
                stream.append(part)
        graphs[way] = graph_of(server.stub(), f"vehicles/{vehicle}")
        stored[way] = as_bytes(client.list_poses(vehicle))
    assert len(graphs["messages"][0]) > 100
    for way in ways:
        assert graphs[way] == graphs["messages"], way
        assert stored[way] == as_bytes(messages), way


def test_a_stream_of_arrays_makes_no_message_of_a_pose(client, new_vehicle,
                                                       monkeypatch):
    vehicle = new_vehicle()
    made = []
    kept = Poses.to_messages
    monkeypatch.setattr(Poses, "to_messages",
                        lambda self: made.append(len(self)) or kept(self))
    with client.stream_poses(vehicle) as stream:
        stream.append(straight(1000))
    client.append_poses(vehicle, straight(100, first=1001))
    assert made == []
    assert client.get_vehicle(vehicle).durable_sequence == 1100


def test_arrays_arrive_once_when_the_server_is_killed(restarted, in_thread):
    rng = random.Random(SEED)
    count = 60_000
    numbers = np.random.default_rng(SEED)
    poses = Poses.local(
        numbers.normal(size=count), numbers.normal(size=count),
        numbers.normal(size=count), np.tile([1.0, 0, 0, 1, 0, 1], (count, 1)),
        stamps=numbers.integers(0, 2**62, count).astype("datetime64[ns]"),
        sequence=np.arange(1, count + 1))
    with revisit.Client(restarted.address) as client:
        client.create_vehicle("survivor")
        options = StreamOptions(batch_poses=512, max_pending_poses=5000, **QUICK)
        with client.stream_poses("survivor", options) as stream:
            stream.wait_until_opened(LONG)

            def append_all():
                for part in split(rng, poses, (100, 777, 3000)):
                    stream.append(part)
                stream.finish()

            done = in_thread(append_all)
            for round_ in range(1, 6):
                wait_until(lambda: stream.acked_sequence >= round_ * 9000,
                           "progress", LONG)
                time.sleep(rng.random() * 0.02)
                restarted.kill()
                restarted.start()
            done()
            assert stream.reconnects >= 5
            assert stream.pending_poses == stream.pending_bytes == 0
        assert identical(client.poses("survivor"), poses)


def test_arrays_come_as_columns(server, new_vehicle, monkeypatch):
    """Also those of poses that are not alike, and both clients read the same."""
    vehicle = new_vehicle()
    poses = Poses.from_messages(Drive(SEED)[0:500])

    def never(messages):
        pytest.fail("it makes arrays of messages")

    async def read():
        async with revisit.aio.Client(server.address) as client:
            return await client.poses(vehicle)

    with revisit.Client(server.address) as client:
        with client.stream_poses(vehicle) as stream:
            stream.append(poses)
        monkeypatch.setattr(Poses, "from_messages", never)
        assert identical(client.poses(vehicle), poses)
        assert identical(client.poses(vehicle, 123), poses[122:])
        assert identical(asyncio.run(read()), poses)


def test_the_graph_is_the_same_after_the_server_was_killed(restarted, boreas,
                                                          in_thread):
    poses, _ = boreas
    rng = random.Random(SEED)
    with revisit.Client(restarted.address) as client:
        for name in ("undisturbed", "survivor"):
            client.create_vehicle(name)
        with client.stream_poses("undisturbed") as stream:
            stream.append(poses.to_messages())
        options = StreamOptions(batch_poses=32, max_pending_poses=200, **QUICK)
        with client.stream_poses("survivor", options) as stream:
            def append_all():
                for part in split(rng, poses, (1, 50, 150)):
                    stream.append(part if rng.random() < 0.7
                                  else list(part.to_messages()))
                stream.finish()

            done = in_thread(append_all)
            for acked in (300, 900, 1500):
                wait_until(lambda: stream.acked_sequence >= acked, "progress", LONG)
                restarted.kill()
                restarted.start()
            done()
            assert stream.reconnects > 0
        stub = restarted.server.stub()
        assert graph_of(stub, "vehicles/survivor") == graph_of(
            stub, "vehicles/undisturbed")
        assert as_bytes(client.list_poses("survivor")) == as_bytes(poses.to_messages())


# Servers that do not know columns.


class Older(service.PoseGraphServiceServicer):
    """Stands before a server as if that knew no columns."""

    def __init__(self, stub):
        self._stub = stub
        self.poses = 0

    def _without(self, message):
        message.ClearField("columns")
        self.poses += len(message.poses)
        return message

    def _ended(self, context, error):
        context.set_trailing_metadata(error.trailing_metadata())
        context.abort(error.code(), error.details())

    def StreamPoses(self, requests, context):
        def seen():
            for request in requests:
                if request.HasField("batch"):
                    self._without(request.batch)
                yield request

        try:
            for answer in self._stub.StreamPoses(seen()):
                if answer.HasField("opened"):
                    answer.opened.ClearField("takes_pose_columns")
                yield answer
        except grpc.RpcError as error:
            self._ended(context, error)

    def AppendPoses(self, request, context):
        try:
            return self._stub.AppendPoses(self._without(request))
        except grpc.RpcError as error:
            self._ended(context, error)

    def ListPoses(self, request, context):
        request.ClearField("as_columns")
        return self._stub.ListPoses(request)


@contextlib.contextmanager
def client_of_older(server):
    older = Older(server.stub())
    with serving(older) as address, revisit.Client(address) as client:
        yield client, older


def test_a_server_that_knows_no_columns_gets_messages_and_answers_them(
        server, new_vehicle):
    vehicle = new_vehicle()
    poses = straight(500)
    with client_of_older(server) as (client, older):
        with client.stream_poses(vehicle) as stream:
            stream.append(poses[:200])
            stream.append(list(poses[200:400].to_messages()))
        client.append_poses(vehicle, poses[400:])
        assert older.poses == 500
        assert identical(client.poses(vehicle), poses)
        broken = straight(3, first=501)
        broken.heading[1] = np.nan
        with pytest.raises(revisit.InvalidArgument) as caught:
            client.append_poses(vehicle, broken)
    [violation] = caught.value.field_violations
    assert violation.field == "poses[1].heading_radians"
    assert violation.sequence == 502


def test_a_batch_with_a_gap_is_refused_whole(client, new_vehicle):
    vehicle = new_vehicle()
    with pytest.raises(revisit.InvalidArgument) as caught:
        client.append_poses(vehicle, straight(6)[::2])
    assert [one.field for one in caught.value.field_violations] == [
        "poses[1].sequence", "poses[2].sequence"]
    assert client.get_vehicle(vehicle).durable_sequence == 0


def test_no_poses_are_refused_once(client, new_vehicle):
    """What a server says that sees no poses decides whether it knows columns."""
    with pytest.raises(revisit.InvalidArgument) as caught:
        client.append_poses(new_vehicle(), straight(0))
    assert caught.value.reason == "BATCH_SIZE"
    assert [one.field for one in caught.value.field_violations] == ["poses"]


# Errors.


WRONG = {
    "heading_radians": lambda poses, row: poses.heading.__setitem__(row, np.nan),
    "x_meters": lambda poses, row: poses.position.__setitem__((row, 0), np.inf),
    "z_meters": lambda poses, row: poses.position.__setitem__((row, 2), np.nan),
    "covariances": lambda poses, row: poses.covariance.__setitem__((row, 1), np.nan),
    "covariance_diagonals":
        lambda poses, row: poses.covariance.__setitem__((row, 3), -1.0),
    "error_transitions":
        lambda poses, row: poses.error_transition.__setitem__((row, 4), np.nan)}


@pytest.mark.parametrize("column", WRONG)
def test_a_wrong_number_is_named_by_the_sequence_of_its_pose(client, new_vehicle,
                                                             column):
    rng = random.Random(column)
    row = rng.randrange(1, 200)
    poses = straight(200)
    if column == "error_transitions":
        poses = Poses.local(
            *np.ones((3, 200)), np.tile([1.0, 0, 0, 1, 0, 1], (200, 1)),
            sequence=np.arange(1, 201),
            error_transition=np.tile(np.eye(3).ravel(), (200, 1)))
        poses.error_transition[0] = np.nan
    WRONG[column](poses, row)
    model = ({"correlation_model": v1.CORRELATION_MODEL_FILTER}
             if column == "error_transitions" else {})
    vehicle = new_vehicle(**model)
    options = StreamOptions(batch_poses=rng.choice([7, 64, 200]))
    with pytest.raises(revisit.InvalidArgument) as caught:
        with client.stream_poses(vehicle, options) as stream:
            for part in split(rng, poses):
                stream.append(part)
    [violation] = caught.value.field_violations
    assert violation.field.startswith(f"batch.columns.{column}[")
    assert violation.sequence == row + 1
    assert (f"{violation.field}: {violation.description} (pose of sequence {row + 1})"
            in str(caught.value))
    with pytest.raises(revisit.InvalidArgument) as caught:
        client.append_poses(new_vehicle(**model), poses)
    [violation] = caught.value.field_violations
    assert violation.field.startswith(f"columns.{column}[")
    assert violation.sequence == row + 1


def test_tasks_hear_of_the_sequence_too(server, new_vehicle):
    async def run():
        async with revisit.aio.Client(server.address) as client:
            poses = straight(100)
            poses.heading[70] = np.nan
            caught = []
            try:
                async with client.stream_poses(new_vehicle()) as stream:
                    await stream.append(poses)
            except revisit.InvalidArgument as error:
                caught.append(error)
            try:
                await client.append_poses(new_vehicle(), poses)
            except revisit.InvalidArgument as error:
                caught.append(error)
            return [(one.field, one.sequence) for error in caught
                    for one in error.field_violations]

    assert asyncio.run(run()) == [("batch.columns.heading_radians[6]", 71),
                                  ("columns.heading_radians[70]", 71)]


def test_other_fields_have_no_sequence():
    batch = v1.PoseBatch(columns=columns_of(straight(5, first=31)))
    assert sequence_at("batch.columns.covariance_diagonals[2]", batch) == 31
    assert sequence_at("batch.columns.first_stamp.nanos", batch) == 31
    assert sequence_at("batch.columns.stamp_step_nanos[0]", batch) == 32
    for field in ("batch.columns.covariance_form", "batch.columns.future[3]", "open",
                  "batch.poses[0]", "batch.columns"):
        assert sequence_at(field, batch) is None
