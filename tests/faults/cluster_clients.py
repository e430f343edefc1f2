"""Clients of a cluster: vehicles that stream and append, and others that read them.

They go where a proxy would lead them: to a server that follows from the vehicle's
name and from which servers seem well, once to the owner that NOT_OWNER names, and now
and then to any other, as if two proxies were of different opinions. Or they have a real
proxy, which they tell that owner as the client library does.
"""

import base64
import collections
import contextlib
import queue
import random
import threading
import time
import zlib

import grpc

from cluster_history import Ack, History, Read
from drive_client import Drive
from stubs import PoseGraphServiceStub, api
from wire import decode_failure

# How long a client waits for an answer before it tries elsewhere.
ANSWER_SECONDS = 3.0
# How long answers that were sent may still come.
ON_ITS_WAY_SECONDS = 0.3
# How long a server that does not answer is left out.
LEFT_OUT_SECONDS = 2.0
# How often a call goes to a server chosen by chance.
STRAY = 0.03
_OPTIONS = [("grpc.initial_reconnect_backoff_ms", 50),
            ("grpc.min_reconnect_backoff_ms", 500),
            ("grpc.max_reconnect_backoff_ms", 500),
            ("grpc.use_local_subchannel_pool", 1)]

# Answers that a client of a cluster may get at any time, and tries again after.
PASSING = {
    (grpc.StatusCode.UNAVAILABLE, None), (grpc.StatusCode.CANCELLED, ""),
    (grpc.StatusCode.DEADLINE_EXCEEDED, None),
    (grpc.StatusCode.ABORTED, "EPOCH_FENCED"),
}
# And behind a proxy: how it tells of a server that died.
PASSING_BEHIND_PROXY = {(grpc.StatusCode.INTERNAL, "")}


class Unexpected(Exception):
    """An answer that no fault of the row excuses."""


class _Lost(Exception):
    """A writer was told that what it was acknowledged is gone."""


def failure_of(error):
    """(reason, metadata) of a status; empty without ErrorInfo."""
    if error.code() == grpc.StatusCode.CANCELLED:
        # By this side, whatever the other one said at that moment.
        return "", {}
    if "grpc-status-details-bin" not in dict(error.trailing_metadata() or ()):
        return "", {}
    failure = decode_failure(error)
    return failure.reason, failure.metadata


class Fleet:
    """Vehicles with a writer and a reader each, which go on until `stop()`."""

    def __init__(self, seed, addresses, vehicles=8, readers=None, max_batch=16,
                 window=8, passing=(), pause_seconds=0.04, stream_share=0.7,
                 list_share=0.2, stray=STRAY,
                 proxy=None, open_channel=None, may_lose=False,
                 answer_seconds=ANSWER_SECONDS):
        """`addresses`: of the servers; `proxy`: of what stands before them, if
        anything does. `open_channel(address, options)` is insecure by default.
        `readers`: how many vehicles are read as well, if not all.
        `stream_share`: of the writers' calls, how many are streams;
        `list_share`: of the readers', how many are ListPoses, which ask the
        store; `stray`: of all, how many go to any server. With `may_lose`, a
        writer ends when it is told of a loss."""
        self.addresses = [proxy] if proxy else list(addresses)
        self.is_proxied = proxy is not None
        self.open_channel = open_channel or grpc.insecure_channel
        self.may_lose = may_lose
        self.stream_share, self.list_share = stream_share, list_share
        self.stray = stray
        self.answer_seconds = answer_seconds
        # Whether clients go on whatever they are answered with.
        self.accepts_all = False
        self._readers = vehicles if readers is None else readers
        self.passing = PASSING | set(passing) | (
            PASSING_BEHIND_PROXY if proxy else set())
        self.max_batch, self.window = max_batch, window
        self.pause_seconds = pause_seconds
        # How often each status came.
        self.outcomes = collections.Counter()
        self.problems = []
        # The address of a server that writers do not go to.
        self.not_for_writers = None
        self._writes_held = threading.Event()
        # Until when each address is left out.
        self.left_out = {}
        self.stopped = threading.Event()
        self.vehicles = [Vehicle(self, number, seed)
                         for number in range(vehicles)]
        self._threads = []

    def create(self):
        for vehicle in self.vehicles:
            caller = _Caller(self, vehicle, random.Random(0), writes=True)
            vehicle.uid = caller.stub(caller.home()).CreateVehicle(
                api.CreateVehicleRequest(vehicle_id=vehicle.name.split("/")[1])
            ).vehicle.uid
            caller.close()

    def start(self):
        self.stopped.clear()
        for number, vehicle in enumerate(self.vehicles):
            for work in (vehicle.write, vehicle.read)[:1 + (
                    number < self._readers)]:
                thread = threading.Thread(target=self._live, daemon=True,
                                          args=(work,))
                thread.start()
                self._threads.append(thread)

    def _live(self, work):
        try:
            work()
        except _Lost:
            pass
        except Exception as problem:
            self.problems.append(problem)

    def stop(self):
        self.stopped.set()
        for vehicle in self.vehicles:
            vehicle.cancel()
        for thread in self._threads:
            thread.join(30)
            assert not thread.is_alive(), "a client does not end"
        self._threads.clear()
        self.check()

    def check(self):
        if self.problems:
            raise self.problems[0]

    @contextlib.contextmanager
    def without_writes(self):
        """No write is under way meanwhile."""
        self._writes_held.set()
        self.sleep(2 * ON_ITS_WAY_SECONDS)
        yield
        self._writes_held.clear()

    def may_write(self):
        return not self.stopped.is_set() and not self._writes_held.is_set()

    def sleep(self, seconds):
        """Of the row, which ends early if a client met with the unexpected."""
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            self.check()
            time.sleep(min(0.05, max(0.0, until - time.monotonic())))

    def acked(self):
        return sum(vehicle.history.acked for vehicle in self.vehicles)

    def wait_for_acks(self, seconds, vehicles=None):
        """Until every vehicle, or each of these, was acknowledged something sent
        from now on; answers how long that took."""
        begun = time.monotonic()
        todo = list(self.vehicles if vehicles is None else vehicles)
        while todo:
            self.check()
            waited = time.monotonic() - begun
            todo = [vehicle for vehicle in todo if not any(
                ack.returned > begun + ON_ITS_WAY_SECONDS
                for ack in vehicle.history.acks[-3:])]
            assert not todo or waited < seconds, (
                f"no acknowledgement in {waited:.1f} s of "
                f"{[vehicle.name for vehicle in todo]}; {self.summary()}")
            time.sleep(0.01)
        return time.monotonic() - begun

    def longest_silence(self, since):
        """Of any vehicle, until now."""
        return max(vehicle.history.longest_silence(since, time.monotonic())
                   for vehicle in self.vehicles)

    def summary(self):
        return ", ".join(f"{count} {name}"
                         for name, count in self.outcomes.most_common(8))


class Vehicle:
    """One vehicle, and what its clients saw of it."""

    def __init__(self, fleet, number, seed):
        self.fleet = fleet
        self.name = f"vehicles/fleet-{number}"
        self.uid = ""
        self.drive = Drive(seed * 1000 + number)
        self.history = History()
        self.told_of_loss = False
        # Whether a stream of its writer is open.
        self.streams = False
        self._rng = random.Random(f"{seed} {number}")
        self._calls = set()
        self._lock = threading.Lock()

    def sent_pose(self, sequence):
        return self.drive[sequence - 1:sequence][0].SerializeToString(
            deterministic=True)

    def cancel(self):
        with self._lock:
            for call in self._calls:
                call.cancel()

    def _caller(self, writes):
        return _Caller(self.fleet, self, random.Random(self._rng.random()), writes)

    # Writing.

    def write(self):
        caller = self._caller(writes=True)
        while not self.fleet.stopped.is_set():
            if not self.fleet.may_write():
                caller.wait()
                continue
            try:
                if caller.rng.random() < self.fleet.stream_share:
                    self._stream(caller)
                else:
                    self._append(caller)
            except grpc.RpcError as error:
                caller.note(error)
        caller.close()

    def _poses(self, first, rng):
        last = first + rng.randint(1, self.fleet.max_batch) - 1
        poses = self.drive[first - 1:last]
        self.history.sent = max(self.history.sent, last)
        return last, poses

    def _acked(self, sequence):
        self.history.acks.append(Ack(time.monotonic(), sequence))

    def _append(self, caller):
        for _ in range(caller.rng.randint(1, 20)):
            if not self.fleet.may_write():
                return
            _, poses = self._poses(self.history.acked + 1, caller.rng)
            ack = caller.stub().AppendPoses(api.AppendPosesRequest(
                vehicle=self.name, vehicle_uid=self.uid, poses=poses),
                timeout=self.fleet.answer_seconds,
                metadata=caller.metadata()).ack
            self._acked(ack.durable_sequence)
            self.fleet.outcomes["append"] += 1
            time.sleep(caller.rng.random() * self.fleet.pause_seconds)

    def _stream(self, caller):
        """One stream of some batches, a window of which is under way. It is given
        up when an answer is late."""
        rng = caller.rng
        requests = queue.SimpleQueue()
        call = caller.stub().StreamPoses(iter(requests.get, None),
                                         metadata=caller.metadata())
        late = _Watch(call, self.fleet.answer_seconds)
        with self._lock:
            self._calls.add(call)
        try:
            called = time.monotonic()
            requests.put(api.StreamPosesRequest(open=api.StreamPosesOpen(
                vehicle=self.name, acked_sequence=self.history.acked,
                vehicle_uid=self.uid)))
            opened = next(call).opened
            late.put_off()
            self.history.reads.append(Read(
                called, time.monotonic(), opened.durable_sequence, "opened"))
            self.fleet.outcomes["stream"] += 1
            self.streams = True
            under_way = collections.deque()
            sequence = opened.durable_sequence
            for _ in range(rng.randint(5, 300)):
                if not self.fleet.may_write():
                    break
                sequence, poses = self._poses(sequence + 1, rng)
                requests.put(api.StreamPosesRequest(
                    batch=api.PoseBatch(poses=poses)))
                under_way.append(sequence)
                while len(under_way) >= self.fleet.window:
                    self._read_ack(call, under_way, late)
                time.sleep(rng.random() * self.fleet.pause_seconds)
            requests.put(None)
            while under_way:
                self._read_ack(call, under_way, late)
            for _ in call:
                pass
        except StopIteration:
            # Ended with OK although nobody has closed it.
            raise Unexpected(f"{self.name}: a stream ended early") from None
        finally:
            self.streams = False
            late.stop()
            requests.put(None)
            call.cancel()
            with self._lock:
                self._calls.discard(call)

    def _read_ack(self, call, under_way, late):
        response = next(call)
        late.put_off()
        if response.WhichOneof("message") == "ack":
            self._acked(response.ack.durable_sequence)
            under_way.popleft()

    # Reading.

    def read(self):
        caller = self._caller(writes=False)
        while not self.fleet.stopped.is_set():
            called = time.monotonic()
            floor = self.history.acked
            try:
                if floor == 0 or caller.rng.random() >= self.fleet.list_share:
                    what = "GetVehicle"
                    sequence = caller.stub().GetVehicle(
                        api.GetVehicleRequest(name=self.name),
                        timeout=self.fleet.answer_seconds,
                        metadata=caller.metadata()).vehicle.durable_sequence
                else:
                    what = "ListPoses"
                    sequence = self._read_poses(caller, max(1, floor - 5))
            except grpc.RpcError as error:
                caller.note(error)
            else:
                self.history.reads.append(
                    Read(called, time.monotonic(), sequence, what))
                self.fleet.outcomes["read"] += 1
                caller.wait()
        caller.close()

    def _read_poses(self, caller, first):
        """The highest sequence among poses that are what was sent."""
        poses = []
        request = api.ListPosesRequest(parent=self.name, first_sequence=first,
                                       page_size=10000)
        while True:
            page = caller.stub().ListPoses(
                request, timeout=self.fleet.answer_seconds,
                metadata=caller.metadata())
            poses += page.poses
            request.page_token = page.next_page_token
            if not page.next_page_token:
                break
        for sequence, pose in enumerate(poses, first):
            if pose.SerializeToString(
                    deterministic=True) != self.sent_pose(sequence):
                raise Unexpected(f"{self.name}: pose {sequence} is not what was "
                                 "sent")
        return first + len(poses) - 1


class _Caller:
    """One client's channels, and where it goes next. A channel whose connection may
    have died is made anew, for gRPC keeps it from a server that is back for a
    while."""

    def __init__(self, fleet, vehicle, rng, writes):
        self.rng = rng
        self._writes = writes
        self._fleet, self._vehicle = fleet, vehicle
        self._channels = {}
        # Where the last call went, and the owner that the last answer named.
        self._address = None
        self._owner = None

    def home(self):
        """Of the servers that seem well, the one that the name stands for: if one
        comes or goes, few vehicles have another one."""
        now = time.monotonic()
        addresses = self._addresses()
        return max([address for address in addresses
                    if self._fleet.left_out.get(address, 0.0) < now] or addresses,
                   key=lambda address: zlib.crc32(
                       f"{self._vehicle.name} {address}".encode()))

    def _addresses(self):
        return [address for address in self._fleet.addresses
                if not self._writes or address != self._fleet.not_for_writers]

    def stub(self, address=None):
        """For the next call."""
        if address is None and not self._fleet.is_proxied:
            address, self._owner = self._owner, None
        if address not in self._addresses():
            address = (self.rng.choice(self._addresses())
                       if self.rng.random() < self._fleet.stray else self.home())
        self._address = address
        if address not in self._channels:
            self._channels[address] = self._fleet.open_channel(
                address, options=_OPTIONS)
        return PoseGraphServiceStub(self._channels[address])

    def metadata(self):
        """For the next call: what tells a proxy of the owner."""
        owner, self._owner = self._owner, None
        return owner and [("x-revisit-owner",
                           base64.b64encode(owner.encode()).decode())]

    def note(self, error):
        """Learns from a failure, and waits; Unexpected if it is none that
        passes."""
        fleet = self._fleet
        code = error.code()
        reason, metadata = failure_of(error)
        fleet.outcomes[f"{code.name} {reason}".strip()] += 1
        if reason == "DURABLE_SEQUENCE_REGRESSED" and fleet.may_lose:
            self._vehicle.told_of_loss = True
            raise _Lost
        if not fleet.accepts_all and (code, reason) not in fleet.passing and (
                code, None) not in fleet.passing:
            raise Unexpected(
                f"{self._vehicle.name} at {self._address}: {code.name} {reason}: "
                f"{error.details()}")
        if reason == "NOT_OWNER":
            self._owner = metadata["owner"]
        elif reason in ("", "SERVER_DRAINING"):
            fleet.left_out[self._address] = time.monotonic() + LEFT_OUT_SECONDS
        if not reason:
            self._channels.pop(self._address).close()
        self.wait()

    def wait(self):
        self._fleet.stopped.wait(self.rng.uniform(0.02, 0.15))

    def close(self):
        for channel in self._channels.values():
            channel.close()


class _Watch:
    """Cancels a call whose answer is late: gRPC would wait for ever for a server
    that is stopped."""

    def __init__(self, call, seconds):
        self._call, self._seconds = call, seconds
        self._due = time.monotonic() + seconds
        self._stopped = threading.Event()
        threading.Thread(target=self._run, daemon=True).start()

    def _run(self):
        while (left := self._due - time.monotonic()) > 0:
            if self._stopped.wait(left):
                return
        self._call.cancel()

    def put_off(self):
        self._due = time.monotonic() + self._seconds

    def stop(self):
        self._stopped.set()
