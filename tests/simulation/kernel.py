"""Events in time, and lines that wait for a resource."""

import collections
import heapq
import itertools
import random


class Kernel:
    """Runs events in the order of their times; equal times in the order in which
    they were scheduled. Everything random is drawn from `random`, so a seed
    determines a run."""

    def __init__(self, seed):
        self.now = 0.0
        self.random = random.Random(seed)
        # Called after every event.
        self.after_event = None
        self._heap = []
        self._order = itertools.count()

    def after(self, delay, act, *arguments):
        heapq.heappush(self._heap,
                       (self.now + delay, next(self._order), act, arguments))

    def run(self, until):
        """Runs all events up to and including `until`."""
        heap = self._heap
        while heap and heap[0][0] <= until:
            self.now, _, act, arguments = heapq.heappop(heap)
            act(*arguments)
            if self.after_event is not None:
                self.after_event()
        self.now = until


class Line:
    """First come, first served, by `places` servers at a time."""

    def __init__(self, kernel, places):
        self._kernel = kernel
        self._waiting = collections.deque()
        self._free = places
        self.busy_seconds = 0.0

    def request(self, seconds, done):
        """Calls `done` once the request has had its turn of `seconds`."""
        if self._free > 0:
            self._free -= 1
            self._serve(seconds, done)
        else:
            self._waiting.append((seconds, done))

    def _serve(self, seconds, done):
        self.busy_seconds += seconds
        self._kernel.after(seconds, self._served, done)

    def _served(self, done):
        if self._waiting:
            self._serve(*self._waiting.popleft())
        else:
            self._free += 1
        done()


class Flushes:
    """A log that one writer flushes: whatever came while a flush was under way is
    covered by the next one, as PostgreSQL and SQLite commit in groups."""

    def __init__(self, kernel, seconds):
        self._kernel = kernel
        self._seconds = seconds
        self._waiting = []
        self._flushing = False

    def request(self, done):
        self._waiting.append(done)
        if not self._flushing:
            self._flush()

    def _flush(self):
        self._flushing = True
        covered, self._waiting = self._waiting, []
        self._kernel.after(self._seconds, self._flushed, covered)

    def _flushed(self, covered):
        if self._waiting:
            self._flush()
        else:
            self._flushing = False
        for done in covered:
            done()
