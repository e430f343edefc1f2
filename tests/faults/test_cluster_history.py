"""The judge of clusters, on histories that are known to be right or wrong."""

import random

import pytest

from cluster_history import (Ack, Claim, History, Read, Stored, hasty_moves,
                             moves, violations)


def pose(sequence):
    return b"pose %d" % sequence


def stored(*counts):
    """Rows of so many poses each, one after the other."""
    rows, head = [], 0
    for count in counts:
        rows.append((head + 1, count))
        head += count
    return Stored(rows, head, [pose(n) for n in range(1, head + 1)])


def history(acks=(), reads=(), sent=100):
    return History([Ack(*ack) for ack in acks],
                   [Read(*read, "GetVehicle") for read in reads], sent)


def kinds(*arguments, **more):
    return [text.split()[0].rstrip(":")
            for text in violations(*arguments, pose, **more)]


def test_acknowledged_poses_that_are_stored_are_right():
    assert not kinds(history([(1.0, 3), (2.0, 8)], [(1.5, 1.6, 3), (3, 3.1, 8)]),
                     stored(3, 5))


def test_poses_stored_without_an_acknowledgement_are_right():
    assert not kinds(history([(1.0, 3)], [(2.0, 2.1, 8)]), stored(3, 5))


def test_acknowledged_pose_that_is_not_stored_is_lost():
    assert kinds(history([(1.0, 3), (2.0, 9)]), stored(3, 5)) == ["LOST"]


def test_only_reads_after_a_loss_may_show_less():
    def seen(called):
        return history([(1.0, 3), (2.0, 9)], [(called, called + 0.1, 5)])

    assert not kinds(seen(2.6), stored(3, 5), lost_at=2.5)
    assert kinds(seen(2.4), stored(3, 5), lost_at=2.5) == ["STALE"]


def test_missing_row_is_a_gap():
    there = stored(3, 2, 4)
    del there.rows[1]
    assert kinds(history([(1.0, 9)]), there) == ["GAP"]


def test_head_that_does_not_say_what_the_rows_hold_is_a_gap():
    for head in (8, 10):
        there = stored(3, 2, 4)
        there.head = head
        assert "GAP" in kinds(history([(1.0, 5)]), there)


def test_rows_that_overlap_are_doubles():
    there = stored(3, 2, 4)
    there.rows.append((4, 5))
    assert set(kinds(history([(1.0, 9)]), there)) == {"DOUBLE"}


def test_pose_that_is_another_one_is_wrong():
    there = stored(3, 5)
    there.poses[6] = pose(99)
    assert kinds(history([(1.0, 8)]), there) == ["WRONG"]


def test_more_poses_than_were_sent_are_wrong():
    assert kinds(history([(1.0, 8)], sent=8), stored(3, 7)) == ["WRONG"]


def test_read_that_began_after_an_acknowledgement_shows_it():
    assert kinds(history([(1.0, 3), (2.0, 8)], [(2.1, 2.2, 7)]),
                 stored(8)) == ["STALE"]


def test_read_beside_an_acknowledgement_need_not_show_it():
    assert not kinds(history([(1.0, 3), (2.0, 8)], [(1.9, 2.2, 3)]), stored(8))


def test_read_shows_what_an_earlier_one_showed():
    assert kinds(history([(1.0, 3)], [(1.1, 1.2, 8), (1.3, 1.4, 7)]),
                 stored(8)) == ["STALE"]


def test_read_of_what_is_never_stored_is_told():
    assert kinds(history([(1.0, 3)], [(1.1, 1.2, 9)]), stored(8)) == ["UNSTORED"]


def test_claims_without_another_owner_are_no_moves():
    claims = [Claim(1.0, "a", "", False), Claim(2.0, "a", "a", True),
              Claim(3.0, "", "a", True), Claim(4.0, "a", "", False)]
    assert not list(moves(claims))


def test_vehicle_does_not_go_back_and_forth():
    def claims(back, released=True):
        return [Claim(1.0, "a", "", False), Claim(2.0, "b", "a", True), *(
            [Claim(back, "", "b", True), Claim(back + 0.1, "a", "", False)]
            if released else [Claim(back, "a", "b", True)])]

    for released in (True, False):
        assert not list(hasty_moves(claims(12.0, released), 10.0))
        assert list(hasty_moves(claims(5.0, released), 10.0))


def test_vehicle_may_leave_a_dead_server_at_any_time():
    assert not list(hasty_moves([
        Claim(1.0, "a", "", False), Claim(2.0, "b", "a", True),
        Claim(3.0, "c", "b", False)], 10.0))


def test_longest_silence_counts_both_ends():
    seen = history([(2.0, 1), (2.5, 2), (4.0, 3)])
    assert seen.longest_silence(0.0, 5.0) == pytest.approx(2.0)
    assert seen.longest_silence(2.2, 2.4) == pytest.approx(0.2)
    assert seen.longest_silence(2.2, 9.0) == pytest.approx(5.0)


@pytest.mark.parametrize("seed", range(20))
def test_each_single_mistake_in_a_long_history_is_found(seed):
    """A history of one correct store, and the same with one thing wrong."""
    rng = random.Random(seed)
    counts = [rng.randint(1, 9) for _ in range(60)]
    there = stored(*counts)
    acks, reads, now, durable = [], [], 0.0, 0
    for count in counts:
        now += rng.random()
        durable += count
        acks.append((now, durable))
        begun = now + rng.random()
        now = begun + rng.random()
        reads.append((begun, now, durable))
    right = history(acks, reads, sent=durable)
    assert not kinds(right, there)

    at = rng.randrange(1, len(reads))
    begun, ended, sequence = reads[at]
    late = [*reads[:at], (begun, ended, sequence - 1), *reads[at + 1:]]
    assert kinds(history(acks, late, durable), there) == ["STALE"]

    less = stored(*counts[:-1])
    assert "LOST" in kinds(right, less)

    gone = stored(*counts)
    del gone.rows[rng.randrange(len(gone.rows))]
    assert kinds(right, gone) == ["GAP"]

    other = stored(*counts)
    victim = rng.randrange(len(other.poses))
    other.poses[victim] = pose(0)
    assert kinds(right, other) == ["WRONG"]
