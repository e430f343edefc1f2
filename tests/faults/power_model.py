"""What each vehicle must hold, whenever the power was lost: the operations of
its one client with the times at which they began and were acknowledged, and
what the vehicle held after each."""

import dataclasses
import hashlib
import threading
import time

import grpc

from drive_client import Drive, create
from stubs import api
from wire import (PAIR_KINDS, PoseStream, append, decode_failure, get,
                  list_poses)

# A vehicle that has so many is deleted and made again, lest states get large.
MANY_POSES = 6000

# gRPC for Python may hear nothing of the end of a server; see drive_client.py.
HEARS_SECONDS = 30

# How a server that is killed ends the calls on it.
GONE = (grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.CANCELLED)


class Gone(Exception):
    """The server is no more; what became of the last operations is unknown."""


def as_payload(pose):
    """As the store has it: payloads of batches are these, one behind the
    other."""
    return api.PoseBatch(poses=[pose]).SerializeToString(deterministic=True)


def digest_of(payloads):
    return hashlib.sha256(b"".join(payloads))


@dataclasses.dataclass(frozen=True)
class Content:
    """Of a vehicle that is there. None is what is not known."""

    poses: tuple = ()
    # Digests of the payloads, as they were sent and as they are now.
    sent: object = dataclasses.field(default_factory=hashlib.sha256)
    current: object = dataclasses.field(default_factory=hashlib.sha256)
    # {id: (query, matched, time)} of each kind.
    pairs: tuple = ({}, {})
    revision: int = None

    def with_poses(self, poses):
        payloads = [as_payload(pose) for pose in poses]

        def longer(digest):
            if digest is None:
                return None
            digest = digest.copy()
            digest.update(b"".join(payloads))
            return digest
        return dataclasses.replace(
            self, poses=self.poses + tuple(payloads), revision=None,
            sent=longer(self.sent), current=longer(self.current))

    def with_revised(self, poses):
        payloads = list(self.poses)
        for pose in poses:
            payloads[pose.sequence - 1] = as_payload(pose)
        return dataclasses.replace(
            self, poses=tuple(payloads), current=digest_of(payloads),
            revision=None)

    def with_pairs(self, number, pairs):
        both = list(self.pairs)
        both[number] = pairs
        return dataclasses.replace(self, pairs=tuple(both), revision=None)

    def facts(self):
        """As power_states prints them."""
        facts = {"durable": len(self.poses), "revision": self.revision,
                 "sent": self.sent and self.sent.hexdigest(),
                 "current": self.current.hexdigest()}
        for kind, pairs in zip(PAIR_KINDS, self.pairs):
            facts[kind.field] = [[pair_id, *pair]
                                 for pair_id, pair in sorted(pairs.items())]
        return facts


def agree(one, other):
    """Whether two descriptions can be of the same, given what is unknown."""
    if one is None or other is None:
        return one is other
    if isinstance(one, dict):
        return all(one[key] is None or other[key] is None
                   or agree(one[key], other[key]) for key in one)
    if isinstance(one, list):
        return len(one) == len(other) and all(
            a is None or b is None or agree(a, b) for a, b in zip(one, other))
    return one == other


def nanoseconds(stamp):
    return stamp.seconds * 10**9 + stamp.nanos


def observe(stub, name):
    """What a server says of a vehicle; None if there is none."""
    try:
        vehicle = get(stub, name)
    except grpc.RpcError as error:
        assert decode_failure(error).reason == "VEHICLE_NOT_FOUND", error
        return None
    payloads = [as_payload(pose) for pose in list_poses(stub, name)]
    assert len(payloads) == vehicle.durable_sequence
    pairs = []
    for kind in PAIR_KINDS:
        found, rest = kind.page(stub, name, page_size=1000)
        assert not rest
        pairs.append({pair.name.split("/")[-1]: (
            pair.query_sequence, pair.matched_sequence,
            nanoseconds(pair.create_time)) for pair in found})
    return Content(poses=tuple(payloads), sent=None,
                   current=digest_of(payloads), pairs=tuple(pairs),
                   revision=vehicle.revision)


class Operation:
    """With times of CLOCK_MONOTONIC in nanoseconds, which a recording has too.
    `facts` is what the vehicle holds after it, None if it is not there."""

    def __init__(self, content, invoked, acked=None):
        self.invoked, self.acked = invoked, acked
        self.content = content
        self.facts = content and content.facts()

    def learned(self, content):
        """What only the acknowledgement told."""
        self.content = content
        self.facts = content and content.facts()


class Vehicle:
    """One vehicle and its client."""

    def __init__(self, name, rng, content=None, drive=None):
        self.name, self.rng = name, rng
        self.drive = drive
        self.operations = [Operation(content, 0, 0)]

    @property
    def content(self):
        return self.operations[-1].content

    def live(self, stub, stop):
        """Until told to, or until the server is no more."""
        try:
            while not stop.is_set():
                self.act(stub)
        except Gone:
            pass

    def act(self, stub):
        """One operation, or a stream of some."""
        content = self.content
        if content is None:
            self.create(stub)
        elif len(content.poses) < 20:
            self.append(stub, self.rng.randint(1, 40))
        elif len(content.poses) > MANY_POSES:
            self.delete(stub)
        else:
            self.rng.choices(
                [lambda: self.append(stub, self.rng.randint(1, 40)),
                 lambda: self.append(stub, 600), lambda: self.stream(stub),
                 lambda: self.revise(stub), lambda: self.add_pair(stub),
                 lambda: self.delete_pair(stub), lambda: self.update(stub),
                 lambda: self.delete(stub)],
                weights=[20, 25, 6, 8, 10, 4, 2, 1])[0]()

    def begin(self, content):
        operation = Operation(content, time.monotonic_ns())
        self.operations.append(operation)
        return operation

    def end(self, operation, content):
        operation.acked = time.monotonic_ns()
        operation.learned(content)
        # No more than the facts of what is over is needed.
        place = self.operations.index(operation, -len(self.operations))
        if place > 0:
            self.operations[place - 1].content = None

    def call(self, content, call, learn):
        """An operation after which the vehicle holds this, and what
        `learn(content, response)` makes of the answer."""
        operation = self.begin(content)
        try:
            response = call()
        except grpc.RpcError as error:
            if error.code() not in GONE:
                raise
            raise Gone from error
        self.end(operation, learn(content, response))

    @staticmethod
    def with_revision(content, response):
        return dataclasses.replace(content, revision=response.revision)

    def next_poses(self, count):
        stored = len(self.content.poses)
        return self.drive[stored:stored + count]

    def create(self, stub):
        # Other poses than the last vehicle of this name had.
        self.drive = Drive(self.rng.randrange(10**6))
        self.call(Content(), lambda: create(stub, self.name),
                  self.with_revision)

    def update(self, stub):
        """Seen by the revision only."""
        vehicle = api.Vehicle(name=self.name)
        vehicle.settings.gate_probability = self.rng.uniform(0.9, 0.99)
        self.call(dataclasses.replace(self.content, revision=None),
                  lambda: stub.UpdateVehicle(api.UpdateVehicleRequest(
                      vehicle=vehicle,
                      update_mask={"paths": ["settings.gate_probability"]}
                  )).vehicle, self.with_revision)

    def delete(self, stub):
        self.call(None, lambda: stub.DeleteVehicle(
            api.DeleteVehicleRequest(name=self.name)), lambda *_: None)

    def append(self, stub, count):
        poses = self.next_poses(count)
        self.call(self.content.with_poses(poses),
                  lambda: append(stub, self.name, poses), self.with_revision)

    def revise(self, stub):
        stored = len(self.content.poses)
        count = self.rng.randint(1, min(stored, 30))
        first = self.rng.randint(0, stored - count)
        poses = [api.PoseBatch.FromString(payload).poses[0]
                 for payload in self.content.poses[first:first + count]]
        for pose in poses:
            pose.local.x_meters += self.rng.random()
        self.call(self.content.with_revised(poses),
                  lambda: stub.RevisePoses(iter([
                      api.RevisePosesRequest(vehicle=self.name, poses=poses)])),
                  self.with_revision)

    def add_pair(self, stub):
        number = self.rng.randrange(2)
        pairs = self.content.pairs[number]
        pair_id = f"p{self.rng.randrange(10**6)}"
        if pair_id in pairs:
            return
        query = self.rng.randint(11, len(self.content.poses))
        matched = self.rng.randint(1, query - 10)
        if any(pair[:2] == (query, matched)
               for pair in self.content.pairs[1 - number].values()):
            return  # It would be a conflict.

        def learn(content, response):
            stored, revision = response
            known = (query, matched, nanoseconds(stored.create_time))
            return dataclasses.replace(
                content.with_pairs(number, {**pairs, pair_id: known}),
                revision=revision)
        self.call(
            self.content.with_pairs(
                number, {**pairs, pair_id: (query, matched, None)}),
            lambda: PAIR_KINDS[number].add(stub, self.name, query, matched,
                                           pair_id), learn)

    def delete_pair(self, stub):
        number = self.rng.randrange(2)
        pairs = self.content.pairs[number]
        if not pairs:
            return
        gone = self.rng.choice(sorted(pairs))
        kind = PAIR_KINDS[number]
        self.call(
            self.content.with_pairs(number, {
                key: pair for key, pair in pairs.items() if key != gone}),
            lambda: kind.delete(stub,
                                f"{self.name}/{kind.collection}/{gone}"),
            lambda content, revision: dataclasses.replace(
                content, revision=revision))

    def stream(self, stub):
        """Some batches that do not wait for each other's acknowledgement."""
        waiting = []
        try:
            with PoseStream(stub, self.name) as stream:
                opened = stream.receive_kind("opened")
                assert opened.durable_sequence == len(self.content.poses)
                for _ in range(self.rng.randint(2, 30)):
                    poses = self.next_poses(self.rng.randint(1, 20))
                    waiting.append(self.begin(self.content.with_poses(poses)))
                    stream.send(poses)
                stream.half_close()
                for operation in waiting:
                    ack = stream.receive_kind("ack")
                    assert ack.durable_sequence == len(operation.content.poses)
                    self.end(operation, dataclasses.replace(
                        operation.content, revision=ack.revision))
        except grpc.RpcError as error:
            if error.code() not in GONE:
                raise
            raise Gone from error

    def resolve(self, stub):
        """After a start: what became of the operations that were not
        acknowledged. What a server shows is as good as acknowledged."""
        seen = observe(stub, self.name)
        now = time.monotonic_ns()
        facts = seen and seen.facts()
        first = max(place for place, operation in enumerate(self.operations)
                    if operation.acked is not None)
        for place in range(len(self.operations) - 1, first - 1, -1):
            operation = self.operations[place]
            if not agree(operation.facts, facts):
                continue
            del self.operations[place + 1:]
            if seen is not None:
                operation.learned(dataclasses.replace(
                    operation.content, pairs=seen.pairs,
                    revision=seen.revision))
            for unknown in self.operations[first + 1:]:
                unknown.acked = now
            return
        raise AssertionError(f"{self.name} has neither what was acknowledged "
                             f"nor what came next: {facts}")

    def verdict(self, facts, time_ns, since=None):
        """"held", "lost" or "wrong", if this is found after the power was lost
        at that time; what was acknowledged before `since`, or else that time,
        must be there."""
        since = time_ns if since is None else since
        first = max(place for place, operation in enumerate(self.operations)
                    if operation.acked is not None and operation.acked < since)
        if any(agree(operation.facts, facts)
               for operation in self.operations[first:]
               if operation.invoked < time_ns):
            return "held"
        if any(agree(operation.facts, facts)
               for operation in self.operations[:first]):
            return "lost"
        return "wrong"


class Fleet:
    """Some vehicles whose clients work at the same time."""

    def __init__(self, vehicles):
        self.vehicles = {vehicle.name.split("/")[1]: vehicle
                         for vehicle in vehicles}

    @property
    def operations(self):
        return sum(len(vehicle.operations)
                   for vehicle in self.vehicles.values())

    @property
    def acked(self):
        return sum(operation.acked is not None
                   for vehicle in self.vehicles.values()
                   for operation in vehicle.operations)

    def work(self, server, count, meanwhile=lambda: None, end=lambda: None):
        """So many operations, and then `end()`, which may kill the server."""
        stop = threading.Event()
        failures = []

        def live(vehicle):
            try:
                vehicle.live(server.stub(), stop)
            except BaseException as error:
                failures.append(error)
        threads = [threading.Thread(target=live, args=(vehicle,))
                   for vehicle in self.vehicles.values()]
        goal = self.operations + count
        for thread in threads:
            thread.start()
        try:
            meanwhile()
            while self.operations < goal and not failures:
                time.sleep(0.005)
            end()
        finally:
            stop.set()
            for thread in threads:
                thread.join(HEARS_SECONDS)
                if thread.is_alive():
                    server.close_channels()
                    thread.join()
        if failures:
            raise failures[0]

    def resolve(self, server):
        for vehicle in self.vehicles.values():
            vehicle.resolve(server.stub())

    def verdict(self, facts, time_ns, since=None):
        """Of all vehicles, the worst; `facts` is {id: of the vehicle}."""
        if set(facts) - set(self.vehicles):
            return "wrong"
        verdicts = {vehicle.verdict(facts.get(name), time_ns, since)
                    for name, vehicle in self.vehicles.items()}
        return ("wrong" if "wrong" in verdicts
                else "lost" if "lost" in verdicts else "held")
