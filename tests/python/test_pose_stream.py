"""A stream brings every pose to the server exactly once, whatever happens to the
server meanwhile, and says why where it cannot."""

import math
import random
import shutil
import threading
import time

import pytest

import revisit
from conftest import LONG, as_bytes, straight
from drive_client import Drive
from revisit import StreamCallbacks, StreamOptions
from revisit._stream_state import log_warnings
from revisit_server import wait_until

SEED = 20101018
#: Waits and stall limits for servers that come to harm.
QUICK = {"backoff": revisit.BackoffOptions(initial=0.01, max=0.2),
         "answer_timeout": 5.0}

def test_poses_that_were_taken_are_stored_to_the_bit(client, new_vehicle):
    vehicle = new_vehicle()
    poses = Drive(SEED)[0:500]
    with client.stream_poses(vehicle) as stream:
        assert stream.wait_until_opened(LONG) == 0
        for start in range(0, 500, 37):
            stream.append(poses[start:start + 37])
        stream.finish()
        assert stream.acked_sequence == 500
        assert stream.pending_poses == stream.pending_bytes == 0
        assert stream.vehicle_uid == client.get_vehicle(vehicle).uid
    assert as_bytes(client.list_poses(vehicle)) == as_bytes(poses)


def test_nothing_is_lost_or_doubled_when_the_server_is_killed(restarted, in_thread):
    """Poses go in while the server is killed again and again."""
    rng = random.Random(SEED)
    poses = Drive(SEED)[0:6000]
    acked = []
    options = StreamOptions(send_candidates=True, max_pending_poses=256,
                            batch_poses=16, **QUICK)
    callbacks = StreamCallbacks(
        ack=lambda ack: acked.append(ack.durable_sequence),
        candidates=lambda answer: None)
    with revisit.Client(restarted.address) as client:
        client.create_vehicle("survivor")
        with client.stream_poses("survivor", options, callbacks) as stream:
            stream.wait_until_opened(LONG)

            def append_all():
                for start in range(0, len(poses), 25):
                    stream.append(poses[start:start + 25])
                stream.finish()

            done = in_thread(append_all)
            for round_ in range(1, 6):
                wait_until(lambda: stream.acked_sequence >= round_ * 900,
                           "progress", LONG)
                time.sleep(rng.random() * 0.02)
                restarted.kill()
                restarted.start()
            done()
            assert stream.reconnects >= 5
            assert stream.acked_sequence == len(poses)
        assert as_bytes(client.list_poses("survivor")) == as_bytes(poses)
    assert acked == sorted(acked)


def test_a_stream_goes_on_after_a_graceful_restart(restarted, in_thread):
    resumed = []
    with revisit.Client(restarted.address) as client:
        client.create_vehicle("a")
        with client.stream_poses(
                "a", StreamOptions(**QUICK),
                StreamCallbacks(resumed=resumed.append)) as stream:
            stream.append(straight(50))
            wait_until(lambda: stream.acked_sequence == 50, "acknowledgement")
            restarted.stop()
            restarted.start()
            stream.append(straight(50, first=51))
            in_thread(stream.finish)()
        assert resumed == [50]
        assert len(client.poses("a")) == 100


def test_calls_find_a_server_that_is_back_at_once(restarted):
    """gRPC itself would wait for seconds."""
    with revisit.Client(restarted.address, max_attempts=1) as client:
        client.create_vehicle("a")
        restarted.kill()
        for _ in range(5):
            with pytest.raises(revisit.Unavailable):
                client.get_vehicle("a")
        restarted.start()
        begun = time.monotonic()
        client.get_vehicle("a")
        assert time.monotonic() - begun < 3.0


def test_a_server_that_stays_away_is_given_up_in_time(tmp_path):
    begun = time.monotonic()
    with revisit.Client("127.0.0.1:1") as client:
        stream = client.stream_poses("a", StreamOptions(give_up_after=1.0, **QUICK))
        with pytest.raises(revisit.Unavailable):
            stream.wait_until_opened()
        with pytest.raises(revisit.Unavailable):
            stream.append(straight(1))
        with pytest.raises(revisit.Unavailable):
            stream.finish()
        assert stream.reconnects > 0
    assert time.monotonic() - begun < 20


def test_wrong_poses_end_the_stream_with_their_fields(client, new_vehicle):
    vehicle = new_vehicle()
    poses = straight(10)
    poses.covariance[3, 0] = -1.0
    poses.heading[4] = float("nan")
    with pytest.raises(revisit.InvalidArgument) as caught:
        with client.stream_poses(vehicle) as stream:
            stream.append(poses)
    error = caught.value
    assert [(one.field, one.sequence) for one in error.field_violations] == [
        ("batch.columns.covariance_diagonals[9]", 4),
        ("batch.columns.heading_radians[4]", 5)]
    assert "above 0" in error.field_violations[0].description
    assert error.domain == "revisit" and error.reason
    assert error.request_id == error.metadata["request_id"]
    # None of the batch is stored.
    assert client.get_vehicle(vehicle).durable_sequence == 0


def test_sequences_that_do_not_follow_are_refused_before_anything_is_taken(
        client, new_vehicle):
    vehicle = new_vehicle()
    with client.stream_poses(vehicle) as stream:
        stream.append(straight(10))
        with pytest.raises(revisit.InvalidArgument, match="sequence 12 where 11"):
            stream.append(straight(10, first=12))
        broken = [*straight(3, first=11).to_messages(),
                  *straight(1, first=15).to_messages()]
        with pytest.raises(revisit.InvalidArgument, match="sequence 15 where 14"):
            stream.append(broken)
        with pytest.raises(revisit.InvalidArgument, match="sequence 0 where 11"):
            stream.append([revisit.v1.Pose()])
        stream.append(straight(10, first=11))
    assert len(client.poses(vehicle)) == 20


def test_a_gap_before_the_first_pose_is_the_servers_to_refuse(client, new_vehicle):
    with pytest.raises(revisit.FailedPrecondition) as caught:
        with client.stream_poses(new_vehicle()) as stream:
            stream.append(straight(10, first=5))
    assert caught.value.reason == "SEQUENCE_GAP"
    assert caught.value.metadata["expected_sequence"] == "1"


def test_poses_sent_again_are_compared(client, new_vehicle):
    vehicle = new_vehicle()
    for _ in range(2):
        with client.stream_poses(vehicle) as stream:
            stream.append(straight(100))
    with pytest.raises(revisit.AlreadyExists) as caught:
        with client.stream_poses(vehicle) as stream:
            stream.append(straight(100, spacing=1.5))
    assert caught.value.reason == "SEQUENCE_CONTENT_MISMATCH"
    assert len(client.poses(vehicle)) == 100


def test_arrays_without_sequences_are_numbered_behind_what_is_there(
        client, new_vehicle):
    vehicle = new_vehicle()
    client.append_poses(vehicle, straight(7))
    unnumbered = straight(10, first=8)
    unnumbered.sequence[:] = 0
    with client.stream_poses(vehicle) as stream:
        stream.append(unnumbered[:4])
        stream.append(unnumbered[4:])
    assert client.poses(vehicle).sequence.tolist() == list(range(1, 18))


def test_the_callers_poses_may_change_after_append(server, client, new_vehicle):
    vehicle = new_vehicle()
    pose = next(iter(straight(1).to_messages()))
    with client.stream_poses(vehicle) as stream:
        for sequence in range(1, 101):
            pose.sequence, pose.local.x_meters = sequence, float(sequence)
            stream.append([pose])
    assert client.poses(vehicle).position[:, 0].tolist() == list(range(1, 101))


def test_lost_data_are_no_vehicle_made_anew(restarted, tmp_path):
    """An old copy of the store is put back under a stream."""
    lost = threading.Event()
    restored = threading.Event()

    def wait_for_the_old_store(error, wait):
        lost.set()
        restored.wait(LONG)

    with revisit.Client(restarted.address) as client:
        client.create_vehicle("a")
        client.append_poses("a", straight(10))
    restarted.stop()
    shutil.copytree(restarted.store, tmp_path / "copy")
    restarted.start()
    with revisit.Client(restarted.address) as client:
        stream = client.stream_poses(
            "a", StreamOptions(**QUICK),
            StreamCallbacks(disconnected=wait_for_the_old_store))
        stream.append(straight(10, first=11))
        wait_until(lambda: stream.acked_sequence == 20, "acknowledgement")
        restarted.kill()
        stream.append(straight(10, first=21))
        shutil.rmtree(restarted.store)
        shutil.copytree(tmp_path / "copy", restarted.store)
        assert lost.wait(LONG)
        restarted.start()
        restored.set()
        with pytest.raises(revisit.DataLoss) as caught:
            stream.finish()
        assert caught.value.reason == "DURABLE_SEQUENCE_REGRESSED"
        assert caught.value.metadata["durable_sequence"] == "10"
        assert caught.value.metadata["acked_sequence"] == "20"
        assert stream.acked_sequence == 20
        # It proves that poses are lost: the vehicle takes none until somebody
        # accepts it.
        with pytest.raises(revisit.DataLoss):
            client.append_poses("a", straight(1, first=11))
        client.accept_data_loss("a", 10)
        with client.stream_poses("a") as stream:
            assert stream.wait_until_opened(LONG) == 10
            stream.append(straight(10, first=11))


def test_a_vehicle_made_anew_under_the_stream_gets_none_of_its_poses(restarted):
    lost = threading.Event()
    replaced = threading.Event()

    def wait_for_the_other(error, wait):
        lost.set()
        replaced.wait(LONG)

    with revisit.Client(restarted.address) as client:
        client.create_vehicle("a")
        stream = client.stream_poses(
            "a", StreamOptions(**QUICK),
            StreamCallbacks(disconnected=wait_for_the_other))
        stream.append(straight(10))
        wait_until(lambda: stream.acked_sequence == 10, "acknowledgement")
        uid = stream.vehicle_uid
        restarted.kill()
        stream.append(straight(10, first=11))
        assert lost.wait(LONG)
        restarted.start()
        client.delete_vehicle("a")
        other = client.create_vehicle("a").uid
        client.append_poses("a", straight(15, spacing=2.0))
        replaced.set()
        with pytest.raises(revisit.VehicleReplaced) as caught:
            stream.finish()
        assert other in str(caught.value) and uid in str(caught.value)
        assert stream.acked_sequence == 10
        assert stream.vehicle_uid == uid
        assert len(client.poses("a")) == 15


def test_what_an_earlier_life_knew_is_checked(client, new_vehicle):
    vehicle = new_vehicle()
    with client.stream_poses(vehicle) as stream:
        stream.append(straight(10))
    kept = {"acked_sequence": stream.acked_sequence, "vehicle_uid": stream.vehicle_uid}
    with client.stream_poses(vehicle, StreamOptions(**kept)) as stream:
        assert stream.wait_until_opened(LONG) == 10
    client.delete_vehicle(vehicle)
    client.create_vehicle(vehicle)
    stream = client.stream_poses(vehicle, StreamOptions(**kept))
    with pytest.raises(revisit.VehicleReplaced) as caught:
        stream.wait_until_opened(LONG)
    assert isinstance(caught.value, revisit.FailedPrecondition)
    assert caught.value.metadata["expected_vehicle_uid"] == kept["vehicle_uid"]
    with pytest.raises(revisit.VehicleReplaced):
        stream.append(straight(10, first=11))
    assert client.get_vehicle(vehicle).durable_sequence == 0


def test_warnings_are_returned_and_each_kind_is_logged_once(
        client, new_vehicle, caplog):
    poses = straight(200)
    poses.heading[:] = 90.0
    with client.stream_poses(new_vehicle()) as stream:
        stream.append(poses)
        stream.finish()
        reasons = [one.reason for one in stream.warnings]
    assert reasons == [revisit.v1.WARNING_REASON_HEADING_BEYOND_TURN,
                       revisit.v1.WARNING_REASON_HEADING_OFF_COURSE]
    logged = [one.getMessage() for one in caplog.records if one.levelname == "WARNING"]
    assert [text.split("What to do: ")[1] for text in logged] == [
        "np.radians() makes radians of degrees",
        f"poses.with_body(yaw={-math.remainder(90.0, 2 * math.pi):.4f}) turns them, if "
        "the vehicle drives forwards"]


def test_a_warning_that_comes_again_is_not_logged_again(caplog):
    warning = revisit.v1.Warning(
        reason=revisit.v1.WARNING_REASON_STAMPS_BACKWARDS, message="back\x1b[2J")
    ack = revisit.v1.Ack(warnings=[warning, warning])
    known = set()
    for _ in range(3):
        log_warnings("vehicles/a", ack, known)
    [record] = caplog.records
    assert record.getMessage().startswith("vehicles/a: back<U+001B>[2J. What to do: ")


class Bar:
    """The part of tqdm that is used."""

    def __init__(self):
        self.done = 0

    def update(self, n):
        assert n > 0
        self.done += n


def test_progress_counts_the_poses_that_became_durable(restarted, in_thread):
    bar = Bar()
    with revisit.Client(restarted.address) as client:
        client.create_vehicle("a")
        client.append_poses("a", straight(100))
        with client.stream_poses("a", StreamOptions(batch_poses=16, **QUICK),
                                 StreamCallbacks(progress=bar)) as stream:
            stream.append(straight(2000, first=101))
            wait_until(lambda: stream.acked_sequence > 500, "progress", LONG)
            restarted.kill()
            restarted.start()
            in_thread(stream.finish)()
        assert bar.done == 2000
        read = Bar()
        assert len(client.poses("a", progress=read)) == read.done == 2100
