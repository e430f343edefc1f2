"""Candidates, jumps and errors come out of a stream as the caller wants them."""

import threading
import time

import numpy as np
import pytest

import revisit
from conftest import LONG, straight
from revisit import StreamCallbacks, StreamOptions
from revisit_server import wait_until

ASKED = StreamOptions(send_candidates=True)


def batches(poses, size=64):
    return [poses[start:start + size] for start in range(0, len(poses), size)]


def right_and_accepted(found, columns):
    """How many of the best candidates are accepted, and of these within 10 m."""
    table = revisit.candidate_table(found)
    best = table.where((table["rank"] == 1) & (table["verdict"] == "ACCEPTED"))
    truth = np.column_stack([columns["gt_x"], columns["gt_y"]])
    # Sequences begin at 1.
    query = truth[best["query_sequence"].astype(int) - 1]
    matched = truth[best["matched_sequence"].astype(int) - 1]
    # At 1 Hz a node lies up to 15 m behind the pose that its sequence names.
    near = np.hypot(*(query - matched).T) < 10 + 15
    return len(best), int(near.sum())


def test_candidates_of_the_shipped_drive_are_found_by_all_ways(
        client, new_vehicle, boreas):
    poses, columns = boreas
    # Afterwards.
    with client.stream_poses(new_vehicle(), ASKED) as stream:
        stream.append(poses)
        stream.finish()
        first = stream.take_candidates()
        assert stream.take_candidates() == []
    assert len(first) == 312
    accepted, right = right_and_accepted(first, columns)
    assert accepted > 140 and right > 0.95 * accepted

    def essence(answers):
        return [[(one.matched.sequence, one.verdict, one.probability)
                 for one in answer.candidates] for answer in answers]

    # By a callback, in order.
    heard = []
    with client.stream_poses(new_vehicle(), ASKED,
                             StreamCallbacks(candidates=heard.append)) as stream:
        for batch in batches(poses):
            stream.append(batch)
    assert essence(heard) == essence(first)
    # In a loop of their own, through a narrow door.
    with client.stream_poses(new_vehicle(), StreamOptions(
            send_candidates=True, max_waiting_candidates=1)) as stream:
        assert essence(stream.run(batches(poses))) == essence(first)
    # In another thread.
    with client.stream_poses(new_vehicle(), StreamOptions(
            send_candidates=True, max_waiting_candidates=2)) as stream:
        taken = []
        thread = threading.Thread(target=lambda: taken.extend(stream.candidates()))
        thread.start()
        stream.append(poses[:500])
        stream.append(poses[500:])
        stream.finish()
        thread.join(LONG)
    assert essence(taken) == essence(first)


def test_candidates_that_only_the_appending_thread_could_take_are_no_deadlock(
        client, new_vehicle, boreas):
    poses, _ = boreas
    with client.stream_poses(new_vehicle(), StreamOptions(
            send_candidates=True, max_waiting_candidates=3)) as stream:
        stream.append(poses)
        with pytest.raises(revisit.FailedPrecondition, match="3 answers of checks"):
            stream.finish()
        # Nothing is lost by that: taken between, all come.
        taken = stream.take_candidates()
        while True:
            try:
                stream.finish()
                break
            except revisit.FailedPrecondition:
                taken += stream.take_candidates()
        taken += stream.take_candidates()
    assert len(taken) == 312


def test_candidate_options_are_the_callers(client, new_vehicle, boreas):
    poses, _ = boreas
    options = StreamOptions(
        send_candidates=True, candidate_options=revisit.v1.CandidateOptions(
            max_candidates=1, direction=revisit.v1.DIRECTION_EITHER))
    with client.stream_poses(new_vehicle(), options) as stream:
        stream.append(poses)
        stream.finish()
        table = revisit.candidate_table(stream.take_candidates())
    assert set(table["rank"]) == {1}
    assert set(table["direction"]) == {"SAME", "OPPOSITE"}


def test_a_stream_that_keeps_no_candidates_says_so(client, new_vehicle):
    with client.stream_poses(new_vehicle()) as stream:
        with pytest.raises(revisit.FailedPrecondition, match="send_candidates"):
            stream.take_candidates()
        with pytest.raises(revisit.FailedPrecondition, match="send_candidates"):
            next(stream.candidates())


def test_an_error_reaches_whoever_takes_candidates(client, new_vehicle):
    poses = straight(1000)
    poses.covariance[900, 0] = -1.0
    with pytest.raises(revisit.InvalidArgument):
        list(client.stream_poses(new_vehicle(), ASKED).run(batches(poses)))


def test_an_error_of_the_source_is_raised_and_ends_the_stream(client, new_vehicle):
    def source():
        yield straight(10)
        raise OSError("the disk is gone")

    stream = client.stream_poses(new_vehicle(), ASKED)
    with pytest.raises(OSError, match="the disk is gone"):
        list(stream.run(source()))
    with pytest.raises(revisit.Cancelled):
        stream.append(straight(10, first=11))


def test_a_loop_that_is_left_early_cancels(client, new_vehicle, boreas):
    poses, _ = boreas
    stream = client.stream_poses(new_vehicle(), ASKED)
    for _ in stream.run(batches(poses)):
        break
    with pytest.raises(revisit.Cancelled):
        stream.finish()


def test_an_exception_in_the_block_cancels(client, new_vehicle):
    with pytest.raises(KeyError):
        with client.stream_poses(new_vehicle()) as stream:
            stream.append(straight(10))
            raise KeyError
    with pytest.raises(revisit.Cancelled):
        stream.finish()


def test_an_exception_in_a_callback_ends_the_stream_and_is_raised(
        client, new_vehicle):
    def fail(ack):
        raise ZeroDivisionError("in a callback")

    stream = client.stream_poses(new_vehicle(), StreamOptions(),
                                 StreamCallbacks(ack=fail))
    stream.append(straight(10))
    with pytest.raises(ZeroDivisionError, match="in a callback"):
        stream.finish()
    with pytest.raises(ZeroDivisionError):
        stream.append(straight(10, first=11))


def test_a_callback_may_ask_the_stream_and_cancel_it(client, new_vehicle):
    seen = []

    def cancel(ack):
        seen.append((stream.acked_sequence, stream.pending_poses, stream.reconnects))
        stream.cancel()

    stream = client.stream_poses(new_vehicle(), StreamOptions(),
                                 StreamCallbacks(ack=cancel))
    stream.append(straight(10))
    with pytest.raises(revisit.Cancelled):
        stream.finish()
    stream.close()
    assert seen == [(10, 0, 0)]


def test_no_callback_runs_after_close(client, new_vehicle, boreas):
    poses, _ = boreas
    acked = []

    def slow(ack):
        time.sleep(0.05)
        acked.append(ack.durable_sequence)

    stream = client.stream_poses(new_vehicle(), StreamOptions(batch_poses=1),
                                 StreamCallbacks(ack=slow))
    stream.append(poses[:200])
    wait_until(lambda: acked, "acknowledgement")
    stream.close()
    count = len(acked)
    time.sleep(0.2)
    assert len(acked) == count < 200


def test_jumps_are_reported(client, new_vehicle, caplog):
    poses = straight(20)
    poses.position[10:, 1] += 500.0
    heard = []
    with client.stream_poses(
            new_vehicle(), StreamOptions(), StreamCallbacks(
                ack=lambda ack: heard.extend(ack.jumps))) as stream:
        stream.append(poses)
        stream.finish()
        [jump] = stream.jumps
    assert jump.sequence == 11 and jump.distance_meters == pytest.approx(500.001)
    assert [one.sequence for one in heard] == [11]
    assert "jump of 500.0 m before sequence 11" in caplog.text


def test_a_finished_stream_takes_no_more(client, new_vehicle):
    with client.stream_poses(new_vehicle()) as stream:
        stream.append(straight(10))
        stream.finish()
        stream.finish()
        with pytest.raises(revisit.FailedPrecondition, match="finished"):
            stream.append(straight(10, first=11))
        with pytest.raises(revisit.FailedPrecondition, match="finished"):
            stream.try_append(straight(10, first=11))


def test_a_closed_client_ends_its_streams(server, new_vehicle):
    with revisit.Client(server.address) as client:
        stream = client.stream_poses(new_vehicle())
        stream.wait_until_opened(LONG)
    with pytest.raises(revisit.Cancelled):
        stream.append(straight(10))


def test_many_streams_at_a_time(client, new_vehicle, in_thread):
    vehicles = [new_vehicle() for _ in range(8)]

    def drive(vehicle):
        with client.stream_poses(vehicle) as stream:
            for start in range(1, 1001, 50):
                stream.append(straight(50, first=start))

    for wait in [in_thread(drive, vehicle) for vehicle in vehicles]:
        wait()
    for vehicle in vehicles:
        assert client.get_vehicle(vehicle).durable_sequence == 1000


@pytest.mark.parametrize("wrong", [
    {"batch_poses": 0}, {"max_pending_poses": 0}, {"acked_sequence": -1},
    {"answer_timeout": 0.0}, {"max_waiting_candidates": 0}])
def test_options_out_of_range_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        StreamOptions(**wrong)


def test_table_of_candidates_tells_of_recordings_and_has_nan_for_what_is_absent():
    tied = revisit.v1.Candidate(
        recording_of_match="vehicles/a/recordings/21",
        frame_state=revisit.v1.FRAME_STATE_DATUM,
        difference=revisit.v1.PoseDifference(x_meters=2.5),
        gate=revisit.v1.Gate(threshold=7.5))
    none = revisit.v1.Candidate(frame_state=revisit.v1.FRAME_STATE_NONE)
    table = revisit.candidate_table([revisit.v1.CandidateSet(candidates=[tied, none])])
    assert table["recording_of_match"].tolist() == ["vehicles/a/recordings/21", ""]
    assert table["frame_state"].tolist() == ["DATUM", "NONE"]
    np.testing.assert_array_equal(table["difference_x"], [2.5, np.nan])
    np.testing.assert_array_equal(table["gate_threshold"], [7.5, np.nan])
    assert table["gate_verdict"].tolist() == ["UNSPECIFIED", "UNSPECIFIED"]
