"""Poses that a stream holds until they are acknowledged."""

from __future__ import annotations

import collections

from revisit import v1


class PendingPoses:
    """Poses in the order of their sequences: first those that were sent on the
    connection of the moment, then the others. Not thread-safe."""

    def __init__(self, max_poses: int, max_bytes: int) -> None:
        self._max_poses = max_poses
        self._max_bytes = max_bytes
        self._sent: collections.deque[tuple[v1.Pose, int]] = collections.deque()
        self._unsent: collections.deque[tuple[v1.Pose, int]] = collections.deque()
        #: Serialised bytes of all poses.
        self.bytes = 0
        #: Highest sequence that was ever sent on any connection.
        self.last_sent_sequence = 0

    def __len__(self) -> int:
        return len(self._sent) + len(self._unsent)

    @property
    def sent(self) -> int:
        """Number of poses that were sent on this connection."""
        return len(self._sent)

    @property
    def unsent(self) -> int:
        return len(self._unsent)

    def has_room(self, poses: int, size: int) -> bool:
        return (len(self) + poses <= self._max_poses
                and self.bytes + size <= self._max_bytes)

    def take(self, pose: v1.Pose, size: int) -> None:
        self._unsent.append((pose, size))
        self.bytes += size

    def next_batch(self, max_poses: int) -> v1.PoseBatch:
        """The next unsent poses, which count as sent from now on."""
        taken = [self._unsent.popleft()
                 for _ in range(min(max_poses, len(self._unsent)))]
        self._sent.extend(taken)
        self.last_sent_sequence = max(self.last_sent_sequence,
                                      taken[-1][0].sequence)
        return v1.PoseBatch(poses=[pose for pose, _ in taken])

    def drop_acknowledged(self, durable_sequence: int) -> int:
        """Forgets the sent poses up to this sequence; how many those are."""
        return self._drop(self._sent, durable_sequence)

    def _drop(self, poses: collections.deque[tuple[v1.Pose, int]],
              last_sequence: int) -> int:
        before = len(poses)
        while poses and poses[0][0].sequence <= last_sequence:
            self.bytes -= poses.popleft()[1]
        return before - len(poses)

    def start_over(self) -> None:
        """Counts all poses as unsent, for a new connection."""
        self._unsent.extendleft(reversed(self._sent))
        self._sent.clear()

    def resume(self, durable_sequence: int) -> int:
        """Forgets what a new connection says is durable; how many poses that are.
        What lies above the last sent sequence and is durable already came from
        elsewhere: it stays, so that the server compares it."""
        return self._drop(self._unsent,
                          min(durable_sequence, self.last_sent_sequence))
