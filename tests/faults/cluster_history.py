"""What the clients of a cluster saw of one vehicle, held against what is stored in
the end and against what a cluster promises:

* every acknowledged pose is stored, once, as it was sent, and none before it is
  missing;
* a read that began after an acknowledgement, or after another read, shows at least
  as many poses, and none shows a pose that is not stored in the end;
* a vehicle does not go back and forth between servers that live.

Times are seconds of one monotonic clock, that of the clients, but for claims,
which have the database's.
"""

import bisect
import dataclasses


@dataclasses.dataclass(frozen=True)
class Ack:
    returned: float
    sequence: int


@dataclasses.dataclass(frozen=True)
class Read:
    """`sequence` is the highest one that it showed; `what` was called."""

    called: float
    returned: float
    sequence: int
    what: str


@dataclasses.dataclass(frozen=True)
class Claim:
    """The vehicle went to `owner`, or to nobody. `previous_stayed`: whether the
    owner before was alive in the database at that moment, and had not been asked to
    end: a server that is about to end gives its vehicles to whoever asks."""

    at: float
    owner: str
    previous: str
    previous_stayed: bool


@dataclasses.dataclass
class History:
    """For one writer and any number of readers, on threads of their own."""

    acks: list = dataclasses.field(default_factory=list)
    reads: list = dataclasses.field(default_factory=list)
    # Highest sequence that was ever sent.
    sent: int = 0

    @property
    def acked(self):
        return max((ack.sequence for ack in self.acks), default=0)

    def longest_silence(self, since, until):
        """The longest time without an acknowledgement."""
        times = sorted([since, until] + [
            ack.returned for ack in self.acks if since < ack.returned < until])
        return max(b - a for a, b in zip(times, times[1:]))


@dataclasses.dataclass
class Stored:
    """`rows` are (first sequence, count), `head` is the sequence that the store
    claims to have, `poses` are what is read back, from sequence 1 on."""

    rows: list
    head: int
    poses: list


def violations(history, stored, sent_pose, lost_at=None):
    """The broken promises, as sentences that begin with a word for their kind:
    LOST, GAP, DOUBLE, WRONG, STALE, UNSTORED. `sent_pose(n)` is what was sent as
    sequence n. `lost_at` is when the store lost the end of what it had, if it did,
    which is then no violation, and reads that began later are not judged."""
    broken = [*_of_rows(stored), *_of_poses(history, stored, sent_pose)]
    if lost_at is not None:
        before = [read for read in history.reads if read.called < lost_at]
        return [*broken, *_of_reads(history.acks, before, None)]
    return [*broken, *_of_losses(history, stored),
            *_of_reads(history.acks, history.reads, stored.head)]


def _of_rows(stored):
    expected = 1
    for first, count in sorted(stored.rows):
        if first > expected:
            yield f"GAP before the row of sequence {first}: {expected} is missing"
        if first < expected:
            yield f"DOUBLE poses in the row of sequence {first}, {count} poses"
        expected = max(expected, first + count)
    if expected - 1 != stored.head:
        yield (f"GAP at the end: rows up to {expected - 1}, "
               f"the head says {stored.head}")


def _of_poses(history, stored, sent_pose):
    if len(stored.poses) != stored.head:
        yield f"GAP: {len(stored.poses)} poses are read of {stored.head}"
    if stored.head > history.sent:
        yield f"WRONG: {stored.head} poses are stored, {history.sent} were sent"
    wrong = [n for n, pose in enumerate(stored.poses[:history.sent], 1)
             if pose != sent_pose(n)]
    if wrong:
        yield f"WRONG content of {len(wrong)} poses, the first is {wrong[0]}"


def _of_losses(history, stored):
    if history.acked > stored.head:
        yield (f"LOST {history.acked - stored.head} poses: {history.acked} were "
               f"acknowledged, {stored.head} are stored")


def _of_reads(acks, reads, head):
    known = sorted([(ack.returned, ack.sequence) for ack in acks] +
                   [(read.returned, read.sequence) for read in reads])
    times = [time for time, _ in known]
    floors = []
    for _, sequence in known:
        floors.append(max(sequence, floors[-1] if floors else 0))
    for read in reads:
        before = bisect.bisect_left(times, read.called)
        floor = floors[before - 1] if before else 0
        if read.sequence < floor:
            yield (f"STALE {read.what} at {read.called:.3f}: shows "
                   f"{read.sequence}, {floor} was known before")
        if head is not None and read.sequence > head:
            yield (f"UNSTORED {read.what} at {read.called:.3f}: shows "
                   f"{read.sequence}, {head} are stored")


def moves(claims):
    """(at, the new owner, whether the one before stayed), for each claim of another
    server than the one before."""
    owner, left_by_one_that_stays = None, False
    for claim in sorted(claims, key=lambda each: each.at):
        if not claim.owner:
            left_by_one_that_stays = claim.previous_stayed
            continue
        if claim.owner != owner:
            if owner is not None:
                yield (claim.at, claim.owner, claim.previous_stayed
                       if claim.previous else left_by_one_that_stays)
            owner = claim.owner


def hasty_moves(claims, apart_seconds):
    """Violations of the promise that a vehicle does not go back and forth: from a
    server that stays it moves no sooner than so long after it came there from
    another."""
    came = None
    for at, _, stayed in moves(claims):
        if stayed and came is not None and at - came < apart_seconds - 0.5:
            yield (f"MOVED at {at:.3f} from a server that stays, {at - came:.1f} s "
                   "after it came there")
        came = at
