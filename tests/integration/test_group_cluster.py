"""Searches in a group whose vehicles are on several servers that are killed, stopped
and ended while vehicles drive on, are revised and are linked: answers name nothing but
what is stored, and say how old it is."""

import contextlib
import dataclasses
import random
import signal
import threading
import time

import grpc
import pytest

from group_site import FRAMES, make_site, moved, name_of, search
from grouping import add_link, delete_link, links_of
from own_postgres import exit_without_postgres, own_shared_store
from revisit_server import START_SECONDS, wait_until
from stubs import PoseGraphServiceStub, api
from three_servers import LEASE_SECONDS, SERVERS, Cluster, served, vehicle_of
from wire import boreas, list_poses

GROUP = "groups/site"
FRAMES_BY_NAME = {name_of(vehicle): frame for vehicle, frame in FRAMES.items()}
# Vehicles have as many poses before anything happens.
FIRST = 600
# How often a server is harmed in one run of the tests, at least.
LEAST_HARMED = 6
# Where the vehicle that asks is asked about at rest.
ASKED = (400, 500, 590)
# How far, in metres, the poses of two attempts to send them lie from each other.
ATTEMPT_METERS = 1e-3
# For how many poses the vehicles stand at most.
MOST_STANDING = 100
# Linear interpolation between two poses is exact to this, in metres.
EXACT_METERS = 1e-6


@dataclasses.dataclass
class Named:
    """A pose that an answer has named, of a vehicle other than the one that asked."""

    vehicle: str
    sequence: int
    fraction: float
    x: float


class Caller(threading.Thread):
    """Calls again and again, at any server, until it is stopped or fails."""

    def __init__(self, cluster, seed):
        super().__init__(daemon=True)
        self._cluster = cluster
        self._rng = random.Random(seed)
        self._stopped = threading.Event()
        self.failure = None

    def call_once(self):
        raise NotImplementedError

    def run(self):
        try:
            while not self._stopped.wait(self._rng.uniform(0.0, 0.05)):
                self.call_once()
        except BaseException as error:  # pylint: disable=broad-except
            self.failure = error

    def stop(self):
        self._stopped.set()
        self.join()
        if self.failure is not None:
            raise self.failure


class Writer(Caller):
    """Appends poses to the vehicles by turns, at any server. Each attempt sends poses a
    little elsewhere, so that those that were never stored can be told apart."""

    def __init__(self, cluster, poses, batch, seed):
        super().__init__(cluster, seed)
        self._poses, self._batch = poses, batch
        self._attempts = 0
        # By vehicle: when which pose was known to be stored.
        self.acked = {name: [(0.0, 0)] for name in poses}

    def call_once(self):
        name = self._rng.choice(sorted(self._poses))
        durable = vehicle_of(self._cluster, self._rng, name).durable_sequence
        self.note(name, durable)
        batch = self._poses[name][durable:durable + self._batch]
        if not batch:
            return
        self._attempts += 1
        sent = []
        for pose in batch:
            sent.append(api.Pose())
            sent[-1].CopyFrom(pose)
            sent[-1].local.x_meters += ATTEMPT_METERS * (self._attempts % 97)
        with grpc.insecure_channel(
                self._rng.choice(self._cluster.addresses())) as channel:
            try:
                ack = PoseGraphServiceStub(channel).AppendPoses(
                    api.AppendPosesRequest(vehicle=name, poses=sent), timeout=10).ack
                self.note(name, ack.durable_sequence)
            except grpc.RpcError as error:
                # Whether they are stored is seen when it asks again.
                assert error.code() in (
                    grpc.StatusCode.UNAVAILABLE, grpc.StatusCode.ABORTED,
                    grpc.StatusCode.DEADLINE_EXCEEDED), error

    def note(self, name, sequence):
        if sequence > self.acked[name][-1][1]:
            self.acked[name].append((time.monotonic(), sequence))

    def acked_before(self, name, moment):
        return max(sequence for at, sequence in list(self.acked[name])
                   if at <= moment)


class Searcher(Caller):
    """Searches in the group, at any server, all the time, and judges the answers."""

    def __init__(self, cluster, writer, seed):
        super().__init__(cluster, seed)
        self._writer = writer
        self.answers = 0
        self.named = []

    def call_once(self):
        asked_at = None

        def ask(stub):
            nonlocal asked_at
            asked_at = time.monotonic()
            return search(stub, sequence=self._rng.randint(300, FIRST),
                          exclude_own=self._rng.random() < 0.5, timeout=3)

        found = served(self._cluster, self._rng, ask)
        self.answers += 1
        assert not found.unsearched
        last = {}
        for searched in found.searched:
            as_of = asked_at - searched.lag.ToTimedelta().total_seconds()
            stored = self._writer.acked_before(searched.vehicle, as_of)
            assert searched.last_sequence >= stored, (searched, stored)
            last[searched.vehicle] = searched.last_sequence
        assert sorted(last) == [name_of("three"), name_of("two")]
        for candidate in found.candidates:
            vehicle, node = candidate.matched_vehicle, candidate.matched
            if not vehicle:
                continue
            assert node.sequence + (node.fraction > 0.0) <= last[vehicle]
            self.named.append(Named(vehicle, node.sequence, node.fraction,
                                    node.pose.x_meters))


class Site:
    """Three vehicles on as many servers, and what happens to them."""

    def __init__(self, cluster, poses, rng):
        self.cluster, self.rng = cluster, rng
        self.links = {}
        self._made = 0
        self._poses = poses
        for name in poses:
            self.call(lambda stub, name=name: stub.CreateVehicle(
                api.CreateVehicleRequest(vehicle_id=name.split("/")[1]), timeout=10))
            while (durable := self.durable(name)) < FIRST:
                self.call(lambda stub, name=name, durable=durable: stub.AppendPoses(
                    api.AppendPosesRequest(vehicle=name,
                                           poses=poses[name][durable:FIRST]),
                    timeout=10))
        self.call(make_site)

    def call(self, call):
        return served(self.cluster, self.rng, call)

    def durable(self, name):
        return vehicle_of(self.cluster, self.rng, name).durable_sequence

    def change_links(self):
        """Adds one, or deletes one that is there. Both may be sent again."""
        if self.links and self.rng.random() < 0.4:
            name = self.rng.choice(sorted(self.links))

            def delete(stub):
                try:
                    delete_link(stub, name)
                except grpc.RpcError as error:
                    if error.code() != grpc.StatusCode.NOT_FOUND:
                        raise

            self.call(delete)
            del self.links[name]
            return
        self._made += 1
        sequence = self.rng.randint(1, FIRST)
        ends = (name_of("one"), sequence), (name_of("two"), sequence)
        link = self.call(lambda stub: add_link(
            stub, GROUP, *ends, link_id=f"link-{self._made}")).loop_closure
        self.links[link.name] = link

    def revise(self, name):
        """Moves all poses that there are a little, across the axis by which they are
        recognised."""
        poses = self.call(lambda stub: list_poses(stub, name))
        shift = self.rng.uniform(-0.1, 0.1)
        for pose in poses:
            pose.local.y_meters += shift
        self.call(lambda stub: stub.RevisePoses(
            iter([api.RevisePosesRequest(vehicle=name, poses=poses)]), timeout=30))

    def harm(self):
        """Answers what was done to some server, which is back when this returns."""
        number = self.rng.randrange(SERVERS)
        kind = self.rng.choice(["killed", "killed", "ended", "stopped"])
        if kind == "stopped":
            process = self.cluster.servers[number].process
            process.send_signal(signal.SIGSTOP)
            # Others have its vehicles, now and then, before it wakes.
            time.sleep(self.rng.choice([0.3, 2.5]) * LEASE_SECONDS)
            process.send_signal(signal.SIGCONT)
            return kind
        getattr(self.cluster, {"killed": "kill", "ended": "end"}[kind])(number)
        time.sleep(self.rng.choice([0.0, self.rng.uniform(0.0, 1.0)]))
        self.cluster.start(number)
        return kind

    def await_fresh(self):
        """Until an answer has what was stored before it was asked for, and is no older
        than it may be; answers the seconds."""
        begun = time.monotonic()
        stored = {name: self.durable(name) for name in FRAMES_BY_NAME}

        def is_fresh():
            found = self.call(lambda stub: search(stub, sequence=FIRST, timeout=3))
            return all(searched.last_sequence >= stored[searched.vehicle] and
                       searched.lag.ToTimedelta().total_seconds() < 3
                       for searched in found.searched)

        wait_until(is_fresh, "an answer that is up to date", seconds=2 * START_SECONDS)
        return time.monotonic() - begun

    def answers(self):
        """At rest: all that is a function of what is stored, as bytes."""
        texts = []
        for sequence in ASKED:
            found = self.call(lambda stub, sequence=sequence: search(
                stub, sequence=sequence))
            found.ClearField("search_duration")
            for searched in found.searched:
                searched.ClearField("lag")
            texts.append(found.SerializeToString(deterministic=True))
        return texts


def expect_stored(named, poses_of):
    """Every pose that was named lies between two that are stored: the one behind it,
    and the one before it or, where the vehicle stood, an earlier one."""
    for each in named:
        xs = [pose.local.x_meters for pose in poses_of[each.vehicle]]
        end = xs[each.sequence] if each.fraction > 0.0 else 0.0
        before = xs[max(0, each.sequence - MOST_STANDING):each.sequence]
        assert min(abs(x + each.fraction * (end - x) - each.x)
                   for x in before) < EXACT_METERS, each


def test_answers_name_only_what_is_stored_whatever_happens_to_servers(
        tmp_path, request, seed):
    exit_without_postgres()
    harmed = max(LEAST_HARMED, request.config.getoption("--kills") // 8)
    rng = random.Random(seed)
    drive, _ = boreas()
    poses = {name: moved(drive, frame) for name, frame in FRAMES_BY_NAME.items()}
    with own_shared_store() as database, contextlib.ExitStack() as stack:
        cluster = Cluster(database.url("revisit"), tmp_path)
        stack.callback(cluster.close)
        site = Site(cluster, poses, rng)
        writer = Writer(cluster, poses, max(2, len(drive) // (8 * harmed)), seed + 1)
        writer.start()
        searcher = Searcher(cluster, writer, seed + 2)
        searcher.start()
        kinds, slowest = [], 0.0
        for _ in range(harmed):
            site.change_links()
            if rng.random() < 0.5:
                site.revise(name_of(rng.choice(["two", "three"])))
            before = searcher.answers
            kinds.append(site.harm())
            slowest = max(slowest, site.await_fresh())
            wait_until(lambda: searcher.failure or searcher.answers > before,
                       "answers again", seconds=2 * START_SECONDS)
            assert searcher.failure is None, searcher.failure
        writer.stop()
        searcher.stop()
        site.await_fresh()
        expect_stored(searcher.named, {
            name: site.call(lambda stub, name=name: list_poses(stub, name))
            for name in poses})
        assert {each.vehicle for each in searcher.named} == {
            name_of("two"), name_of("three")}
        assert {link.name: link for link in site.call(
            lambda stub: links_of(stub, GROUP))} == site.links
        in_the_end = site.answers()
        for number in range(SERVERS):
            cluster.kill(number)
        for number in range(SERVERS):
            cluster.start(number)
        # Nothing is left of what servers had in memory.
        assert site.answers() == in_the_end
        print(f"{len(kinds)} times: " + ", ".join(
            f"{kinds.count(kind)} {kind}" for kind in sorted(set(kinds))),
            f"{searcher.answers} answers named {len(searcher.named)} poses; up to "
            f"date again after {slowest:.1f} s at most; {len(site.links)} links",
            sep="; ")


def test_what_was_never_stored_is_told_apart():
    """Such a pose would fail the test above."""
    poses = {"a": moved(boreas()[0][:3], FRAMES["two"])}
    middle = (poses["a"][0].local.x_meters + poses["a"][1].local.x_meters) / 2
    expect_stored([Named("a", 1, 0.5, middle)], poses)
    with pytest.raises(AssertionError):
        expect_stored([Named("a", 1, 0.5, middle + ATTEMPT_METERS)], poses)
