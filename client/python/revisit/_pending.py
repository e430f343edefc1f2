"""Poses that a stream holds until they are acknowledged."""

from __future__ import annotations

import collections
from collections.abc import Iterator
from typing import Union

from revisit import v1
from revisit._pose_columns import columns_of
from revisit.arrays import COLUMNS, Poses, joined, recording_rows


class Held:
    """Poses that follow each other, of which none but the first begins a recording:
    rows of arrays, which all take the same, or messages."""

    __slots__ = ("first_sequence", "poses", "sizes")

    def __init__(self, first_sequence: int, poses: Union[Poses, list[v1.Pose]],
                 sizes: list[int]) -> None:
        """`sizes` are the bytes of each."""
        self.first_sequence = first_sequence
        self.poses = poses
        self.sizes = sizes

    def __len__(self) -> int:
        return len(self.sizes)

    @property
    def bytes(self) -> int:
        return sum(self.sizes)

    def part(self, first: int, end: int) -> Held:
        """Those from one row up to before another."""
        if first == 0 and end == len(self):
            return self
        return Held(self.first_sequence + first, self.poses[first:end],
                    self.sizes[first:end])

    def owned(self) -> Held:
        """The same poses, in arrays that nobody else has. Messages are copied before
        they are held."""
        if not isinstance(self.poses, Poses):
            return self
        copies = [getattr(self.poses, name).copy() for name in COLUMNS]
        return Held(self.first_sequence, Poses(*copies), self.sizes)

    def goes_on(self, before: Held) -> bool:
        """Whether a batch may have these poses behind others."""
        if isinstance(self.poses, Poses):
            return (isinstance(before.poses, Poses)
                    and self.poses.recording_start[0] is None)
        return (not isinstance(before.poses, Poses)
                and not self.poses[0].HasField("recording_start"))

    def batch(self, as_columns: bool) -> v1.PoseBatch:
        """A batch of these poses: columns of arrays, if they are wanted and there are
        any. Messages go as they are: to take them apart in Python costs more than
        columns save."""
        if not isinstance(self.poses, Poses):
            return v1.PoseBatch(poses=self.poses)
        columns = columns_of(self.poses) if as_columns else None
        if columns is not None:
            return v1.PoseBatch(columns=columns)
        return v1.PoseBatch(poses=self.poses.to_messages())


def _recordings(starts: list[int], whole: Held) -> Iterator[Held]:
    """The poses, divided before those rows that begin a recording."""
    first = 0
    for end in [*(row for row in starts if row > 0), len(whole)]:
        yield whole.part(first, end)
        first = end


def held_arrays(poses: Poses) -> Iterator[Held]:
    """The poses as a stream holds them, still in the caller's arrays. There is at least
    one, with its sequence."""
    size = sum(getattr(poses, name).nbytes for name in COLUMNS) // len(poses)
    return _recordings(recording_rows(poses),
                       Held(int(poses.sequence[0]), poses, [size] * len(poses)))


def held_messages(poses: list[v1.Pose]) -> Iterator[Held]:
    """The poses as a stream holds them. There is at least one."""
    starts = [row for row, pose in enumerate(poses) if pose.HasField("recording_start")]
    return _recordings(starts, Held(poses[0].sequence, poses,
                                    [pose.ByteSize() for pose in poses]))


def _joined(parts: list[Held]) -> Held:
    if len(parts) == 1:
        return parts[0]
    arrays = [part.poses for part in parts if isinstance(part.poses, Poses)]
    messages = [pose for part in parts if not isinstance(part.poses, Poses)
                for pose in part.poses]
    return Held(parts[0].first_sequence, joined(arrays) if arrays else messages,
                [size for part in parts for size in part.sizes])


class PendingPoses:
    """Poses in the order of their sequences: first those that were sent on the
    connection of the moment, by batches, then the others. Not thread-safe."""

    def __init__(self, max_poses: int, max_bytes: int) -> None:
        self._max_poses = max_poses
        self._max_bytes = max_bytes
        self._sent: collections.deque[Held] = collections.deque()
        self._unsent: collections.deque[Held] = collections.deque()
        #: Number of poses that were sent on this connection, and of the others.
        self.sent = 0
        self.unsent = 0
        #: Bytes that all poses take.
        self.bytes = 0
        #: Highest sequence that was ever sent on any connection.
        self.last_sent_sequence = 0

    def __len__(self) -> int:
        return self.sent + self.unsent

    def room_for(self, held: Held) -> int:
        """For how many of these poses there is room."""
        most = min(len(held), self._max_poses - len(self))
        left = self._max_bytes - self.bytes
        if isinstance(held.poses, Poses):
            return max(min(most, left // held.sizes[0]), 0)
        for count, size in enumerate(held.sizes[:max(most, 0)]):
            left -= size
            if left < 0:
                return count
        return max(most, 0)

    def has_room(self, parts: list[Held]) -> bool:
        """Whether there is room for all."""
        return (len(self) + sum(map(len, parts)) <= self._max_poses
                and self.bytes + sum(part.bytes for part in parts) <= self._max_bytes)

    def take(self, held: Held) -> None:
        self._unsent.append(held.owned())
        self.unsent += len(held)
        self.bytes += held.bytes

    def next_batch(self, max_poses: int, as_columns: bool) -> v1.PoseBatch:
        """The next unsent poses, which count as sent from now on. There are some."""
        parts: list[Held] = []
        room = max_poses
        while room > 0 and self._unsent and (
                not parts or self._unsent[0].goes_on(parts[-1])):
            part = self._unsent.popleft()
            if len(part) > room:
                self._unsent.appendleft(part.part(room, len(part)))
                part = part.part(0, room)
            parts.append(part)
            room -= len(part)
        batch = _joined(parts)
        self._sent.append(batch)
        self.sent += len(batch)
        self.unsent -= len(batch)
        self.last_sent_sequence = max(self.last_sent_sequence,
                                      batch.first_sequence + len(batch) - 1)
        return batch.batch(as_columns)

    def first_sent(self, as_columns: bool) -> v1.PoseBatch:
        """The first batch of this connection that is not acknowledged, as it was sent;
        empty if there is none."""
        return self._sent[0].batch(as_columns) if self._sent else v1.PoseBatch()

    def drop_acknowledged(self, durable_sequence: int) -> int:
        """Forgets the sent poses up to this sequence; how many those are."""
        dropped = self._drop(self._sent, durable_sequence)
        self.sent -= dropped
        return dropped

    def _drop(self, poses: collections.deque[Held], last_sequence: int) -> int:
        dropped = 0
        while poses and poses[0].first_sequence <= last_sequence:
            held = poses.popleft()
            count = min(last_sequence - held.first_sequence + 1, len(held))
            self.bytes -= sum(held.sizes[:count])
            dropped += count
            if count < len(held):
                poses.appendleft(held.part(count, len(held)))
        return dropped

    def start_over(self) -> None:
        """Counts all poses as unsent, for a new connection."""
        self._unsent.extendleft(reversed(self._sent))
        self._sent.clear()
        self.unsent += self.sent
        self.sent = 0

    def resume(self, durable_sequence: int) -> int:
        """Forgets what a new connection says is durable; how many poses that are.
        What lies above the last sent sequence and is durable already came from
        elsewhere: it stays, so that the server compares it."""
        dropped = self._drop(self._unsent,
                             min(durable_sequence, self.last_sent_sequence))
        self.unsent -= dropped
        return dropped
