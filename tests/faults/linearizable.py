"""A row in which many clients use all methods at random on a few vehicles,
while the server is killed and comes back, and every answer is held against
what one vehicle would have answered to one call at a time."""

import collections
import random
import threading
import time

import grpc

import linearization
import vehicle_model
from kills import preloaded
from linearization import Operation
from revisit_server import Server, clean_environment
from stubs import PoseGraphServiceStub, api
from vehicle_model import ABSENT, Summary
from wire import LOOP_CLOSURES, REJECTED_CANDIDATES, PoseStream, decode_failure

# The last one is long: its graph takes a while to be rebuilt.
VEHICLES = ["one", "two", "long"]
LONG = 6000
PAGE = 100
CLIENTS = 10
CALL_SECONDS = 30
# Outcomes that clients make unknown by giving up, for each vehicle and life of
# the server: each doubles what has to be thought of.
MOST_GIVEN_UP = 3

# Share of the operations for which it has to be decided whether they have an order.
LEAST_DECIDED = 0.8

KINDS = {"closure": LOOP_CLOSURES, "rejection": REJECTED_CANDIDATES}
FLAGS = [
    # Vehicles are unloaded while they are used.
    "--idle-unload-minutes", 0.01, "--memory-budget-mebibytes", 0,
    "--log-level", "error"]

# Settings that change: one of searches, one that places all nodes anew.
SETTINGS = ["max_candidates", "node_spacing_meters"]
VALUES = [[3, 5, 8], [0.5, 1.0, 2.0]]


def pose_of(sequence, code):
    return api.Pose(
        sequence=sequence, heading_radians=0.0,
        local=api.LocalPosition(x_meters=sequence * 0.7, y_meters=code * 1e-6),
        covariance=api.Covariance(form=api.COVARIANCE_FORM_PLANAR_6,
                                  values=[.01, 0, 0, .01, 0, 1e-4]))


def code_of(pose):
    return round(pose.local.y_meters * 1e6)


def settings_message(settings):
    return api.VehicleSettings(
        sequence_length_meters=20.0, check_interval_meters=10.0,
        **dict(zip(SETTINGS, settings)))


def summary_of(vehicle):
    return Summary(
        vehicle.uid, vehicle.durable_sequence, vehicle.revision,
        tuple(getattr(vehicle.settings, name) for name in SETTINGS),
        vehicle.state == api.VEHICLE_STATE_DATA_LOSS,
        vehicle.loop_closure_count)


class Unknown(Exception):
    """Whether the call did anything is not known."""


def failure_result(error):
    """What a status tells of the vehicle."""
    if error.code() in (grpc.StatusCode.UNAVAILABLE,
                        grpc.StatusCode.CANCELLED,
                        grpc.StatusCode.DEADLINE_EXCEEDED):
        raise Unknown() from error
    failure = decode_failure(error)
    metadata = failure.metadata
    results = {
        "VEHICLE_NOT_FOUND": lambda: ABSENT,
        "VEHICLE_EXISTS": lambda: ("exists",),
        "POSE_NOT_FOUND": lambda: ("no pose",),
        "LOOP_CLOSURE_NOT_FOUND": lambda: ("no pair",),
        "REJECTED_CANDIDATE_NOT_FOUND": lambda: ("no pair",),
        "LOOP_CLOSURE_EXISTS": lambda: ("exists",),
        "REJECTED_CANDIDATE_EXISTS": lambda: ("exists",),
        "POSE_PAIR_CONFLICT": lambda: ("conflict",),
        "SEQUENCE_GAP": lambda: ("gap", int(metadata["expected_sequence"])),
        "SEQUENCE_CONTENT_MISMATCH": lambda: ("mismatch",),
        "DURABLE_SEQUENCE_REGRESSED":
            lambda: ("loss", int(metadata["durable_sequence"])),
        "REVISION_MISMATCH":
            lambda: ("other revision", int(metadata["revision"])),
        "VEHICLE_REPLACED": lambda: ("replaced", metadata["vehicle_uid"]),
        "NO_DATA_LOSS": lambda: ("no loss",),
        "DURABLE_SEQUENCE_MISMATCH":
            lambda: ("other sequence", int(metadata["durable_sequence"])),
    }
    if failure.reason not in results:
        raise AssertionError(f"{failure} is no answer to this") from error
    return results[failure.reason]()


class Memory:
    """What clients believe of a vehicle, which may be wrong: it makes them ask
    for what may be."""

    def __init__(self):
        self.there = False
        self.uid = ""
        self.durable = 0
        self.revision = 0
        self.loss = False
        self.variant = 1


class Client:
    """One thread, and what it did: operations by vehicle."""

    def __init__(self, number, rng, memories, channel, given_up):
        self.name = f"client {number}"
        self.rng, self.memories, self.given_up = rng, memories, given_up
        self.stub = PoseGraphServiceStub(channel)
        self.operations = collections.defaultdict(list)
        self.problem = None

    def live(self, stop):
        try:
            while not stop.is_set():
                self.act(self.rng.choice(VEHICLES))
        except Exception as error:
            self.problem = error
            stop.set()

    # ---- Calls

    def timeout(self, vehicle):
        """Mostly enough; now and then the call is given up half-way."""
        if self.rng.random() < 0.03 and self.given_up[vehicle] < MOST_GIVEN_UP:
            self.given_up[vehicle] += 1
            return self.rng.uniform(0.0005, 0.01)
        return CALL_SECONDS

    def record(self, vehicle, kind, arguments, call):
        """Does it, and notes what came of it."""
        called = time.monotonic()
        try:
            try:
                result = call()
            except grpc.RpcError as error:
                result = failure_result(error)
        except Unknown:
            result = None
        returned = None if result is None else time.monotonic()
        self.operations[vehicle].append(Operation(
            kind, arguments, called, returned, result, self.name))
        self.learn(vehicle, result)
        return result

    def learn(self, vehicle, result):
        memory = self.memories[vehicle]
        if result is None:
            return
        if result == ABSENT or result == ("deleted",):
            memory.there, memory.durable, memory.loss = False, 0, False
            memory.variant = self.rng.randint(1, 9)
            return
        memory.there = True
        told = result[0]
        if told == "vehicle":
            memory.durable, memory.loss = result[1].durable, result[1].loss
            memory.revision, memory.uid = result[1].revision, result[1].uid
        elif told == "replaced":
            memory.uid = result[1]
        elif told in ("ack", "opened"):
            memory.durable, memory.revision = result[1], result[2]
        elif told == "gap":
            memory.durable = result[1] - 1
        elif told == "loss":
            memory.durable, memory.loss = result[1], True
        elif told in ("revised", "pair", "removed"):
            memory.revision = result[1]

    def call(self, vehicle, method, request):
        return getattr(self.stub, method)(request,
                                          timeout=self.timeout(vehicle))

    # ---- What it may do

    def act(self, vehicle):
        memory, rng = self.memories[vehicle], self.rng
        if not memory.there and rng.random() < 0.5:
            self.create(vehicle)
            return
        if memory.loss and rng.random() < 0.3:
            self.accept(vehicle)
            return
        if rng.random() < 0.4:
            # Reads, one right after the other: what was seen stays seen.
            for read in rng.sample([
                    self.get, self.list_poses, self.list_pairs,
                    self.list_vehicles, self.find, self.export], 2):
                read(vehicle)
            return
        rng.choices([
            self.get, self.list_poses, self.list_vehicles, self.list_pairs,
            self.find, self.export, self.append, self.stream, self.revise,
            self.add, self.remove, self.update, self.create, self.accept,
            self.delete, self.claim_loss,
        ], [4, 4, 2, 4, 2, 2, 18, 10, 16, 10, 6, 8, 2, 0.5,
            0.3 if vehicle == "long" else 5 if memory.durable > 400 else 0.7,
            0.6])[0](vehicle)

    def get(self, vehicle):
        self.record(vehicle, "read vehicle", (), lambda: ("vehicle", summary_of(
            self.call(vehicle, "GetVehicle", api.GetVehicleRequest(
                name=f"vehicles/{vehicle}")).vehicle)))

    def list_vehicles(self, _):
        called = time.monotonic()
        try:
            answer = self.stub.ListVehicles(api.ListVehiclesRequest(),
                                            timeout=CALL_SECONDS)
        except grpc.RpcError as error:
            try:
                raise AssertionError(f"{failure_result(error)} of a list")
            except Unknown:
                return
        returned = time.monotonic()
        listed = {each.name.split("/")[1]: each for each in answer.vehicles}
        for vehicle in VEHICLES:
            result = ("vehicle", summary_of(listed[vehicle])) \
                if vehicle in listed else ABSENT
            self.operations[vehicle].append(Operation(
                "read vehicle", (), called, returned, result,
                self.name + " L"))

    def list_poses(self, vehicle):
        last = self.memories[vehicle].durable
        first = self.rng.randint(1, max(1, last - PAGE // 2))
        self.read_poses(vehicle, first, PAGE)

    def read_poses(self, vehicle, first, most):
        def call():
            answer = self.call(vehicle, "ListPoses", api.ListPosesRequest(
                parent=f"vehicles/{vehicle}", first_sequence=first,
                page_size=most))
            assert [pose.sequence for pose in answer.poses] == \
                list(range(first, first + len(answer.poses)))
            return "poses", tuple(map(code_of, answer.poses))
        self.record(vehicle, "read poses", (first, most), call)

    def list_pairs(self, vehicle, name=None):
        name = name or self.rng.choice(list(KINDS))
        kind = KINDS[name]

        def call():
            answer = self.call(vehicle, kind.list_method, getattr(
                api, f"{kind.list_method}Request")(
                    parent=f"vehicles/{vehicle}"))
            return "pairs", frozenset(
                (pair.name.split("/")[-1], pair.query_sequence,
                 pair.matched_sequence)
                for pair in getattr(answer, f"{kind.field}s"))
        self.record(vehicle, "read pairs", (name,), call)

    def find(self, vehicle):
        self.record(vehicle, "read revision", (), lambda: (
            "revision", self.call(
                vehicle, "FindCandidates", api.FindCandidatesRequest(
                    vehicle=f"vehicles/{vehicle}")).candidates.revision))

    def export(self, vehicle):
        def call():
            parts = list(self.call(
                vehicle, "ExportPoseGraph", api.ExportPoseGraphRequest(
                    vehicle=f"vehicles/{vehicle}")))
            summary = parts[0].vehicle
            assert sum(len(part.nodes) for part in parts) == summary.node_count
            return "vehicle", summary_of(summary)
        self.record(vehicle, "read vehicle", (), call)

    def batch(self, vehicle, first=None):
        """(first sequence, codes): mostly what comes next."""
        rng, memory = self.rng, self.memories[vehicle]
        if first is None:
            first = memory.durable + 1
            if rng.random() < 0.25:
                first = max(1, first + rng.choice([-3, -2, -1, 1]))
        variant = memory.variant
        if rng.random() < 0.05:
            variant = rng.randint(1, 9)
        most = 1500 if vehicle == "long" and first < LONG else 16
        return first, (variant,) * rng.randint(1, most)

    def uid(self, vehicle):
        """Of the vehicle that is meant, if it is to be told: the one that was
        there last."""
        return self.memories[vehicle].uid if self.rng.random() < 0.5 else ""

    @staticmethod
    def poses(first, codes):
        return [pose_of(first + place, code)
                for place, code in enumerate(codes)]

    def append(self, vehicle):
        first, codes = self.batch(vehicle)
        uid = self.uid(vehicle)

        def call():
            ack = self.call(vehicle, "AppendPoses", api.AppendPosesRequest(
                vehicle=f"vehicles/{vehicle}", vehicle_uid=uid,
                poses=self.poses(first, codes))).ack
            return "ack", ack.durable_sequence, ack.revision
        self.record(vehicle, "append", (first, codes, uid), call)

    def claim_loss(self, vehicle):
        acked = self.memories[vehicle].durable + self.rng.choice([0, 1, 1000])
        self.open(vehicle, acked, CALL_SECONDS)

    def open(self, vehicle, acked, timeout):
        """(the stream, what opening it answered)."""
        streams = []
        uid = self.uid(vehicle)

        def call():
            streams.append(PoseStream(
                self.stub, f"vehicles/{vehicle}", timeout=timeout,
                acked_sequence=acked, vehicle_uid=uid,
                send_candidates=True))
            opened = streams[0].receive_kind("opened")
            assert opened.vehicle_uid
            return ("opened", opened.durable_sequence, opened.revision,
                    opened.vehicle_uid)
        result = self.record(vehicle, "open", (acked, uid), call)
        if result is None or result[0] != "opened":
            streams[0].cancel()
            return None, result
        return streams[0], result

    def stream(self, vehicle):
        stream, opened = self.open(vehicle, 0, self.timeout(vehicle))
        if stream is None:
            return
        first, sent = opened[1] + 1, []
        for _ in range(self.rng.randint(1, 4)):
            first, codes = self.batch(vehicle, first)
            # The stream is of the vehicle that it was opened for.
            operation = Operation("append", (first, codes, opened[3]),
                                  time.monotonic(), None, None,
                                  self.name + " S")
            sent.append(operation)
            self.operations[vehicle].append(operation)
            stream.send(self.poses(first, codes))
            first += len(codes)
        stream.half_close()
        waiting = iter(sent)
        try:
            for kind, message in iter(stream.receive, None):
                if kind != "ack":
                    continue
                operation = next(waiting)
                operation.result = ("ack", message.durable_sequence,
                                    message.revision)
                operation.returned = time.monotonic()
                self.learn(vehicle, operation.result)
        except grpc.RpcError as error:
            # It does not say which batch it was, nor what became of the rest.
            try:
                self.learn(vehicle, failure_result(error))
                for operation in waiting:
                    operation.returned = time.monotonic()
            except Unknown:
                pass
        finally:
            stream.cancel()

    def revise(self, vehicle):
        rng, memory = self.rng, self.memories[vehicle]
        last = memory.durable + (rng.random() < 0.03)
        if last < 1:
            return
        token = rng.randrange(10, 10**6)
        chosen = sorted(rng.sample(range(1, last + 1),
                                   min(last, rng.randint(1, 40))))
        revised = tuple((sequence, token) for sequence in chosen)
        expected = memory.revision if rng.random() < 0.3 else 0
        messages = [api.RevisePosesRequest(
            vehicle=f"vehicles/{vehicle}", expected_revision=expected)]
        for begin in range(0, len(revised), 16):
            messages.append(api.RevisePosesRequest(poses=[
                pose_of(*each) for each in revised[begin:begin + 16]]))

        def call():
            answer = self.stub.RevisePoses(iter(messages),
                                           timeout=self.timeout(vehicle))
            assert answer.revised_count == len(revised)
            return "revised", answer.revision
        self.record(vehicle, "revise", (revised, expected), call)

    def add(self, vehicle):
        durable = self.memories[vehicle].durable
        if durable < 3:
            return
        name = self.rng.choice(list(KINDS))
        kind = KINDS[name]
        pair_id = self.rng.choice("abcd")
        query = self.rng.randint(2, durable + (self.rng.random() < 0.05))
        matched = self.rng.randint(1, query - 1)

        def call():
            answer = self.call(vehicle, kind.add_method, kind.request(
                f"vehicles/{vehicle}", query, matched, pair_id))
            return "pair", answer.revision
        self.record(vehicle, "add", (name, pair_id, query, matched), call)

    def remove(self, vehicle):
        name = self.rng.choice(list(KINDS))
        kind = KINDS[name]
        pair_id = self.rng.choice("abcd")

        def call():
            answer = self.call(vehicle, kind.delete_method, getattr(
                api, f"{kind.delete_method}Request")(
                    name=f"vehicles/{vehicle}/{kind.collection}/{pair_id}"))
            return "removed", answer.revision
        self.record(vehicle, "remove", (name, pair_id), call)

    def update(self, vehicle):
        place = 0 if self.rng.random() < 0.7 else 1
        value = self.rng.choice(VALUES[place])
        request = api.UpdateVehicleRequest(vehicle=api.Vehicle(
            name=f"vehicles/{vehicle}",
            settings=api.VehicleSettings(**{SETTINGS[place]: value})))
        request.update_mask.paths.append(f"settings.{SETTINGS[place]}")
        self.record(vehicle, "update", (place, value), lambda: (
            "vehicle", summary_of(
                self.call(vehicle, "UpdateVehicle", request).vehicle)))

    def create(self, vehicle):
        settings = (self.rng.choice(VALUES[0]), 1.0)
        request = api.CreateVehicleRequest(
            vehicle_id=vehicle,
            vehicle=api.Vehicle(settings=settings_message(settings)))
        self.record(vehicle, "create", (settings,), lambda: (
            "vehicle", summary_of(
                self.call(vehicle, "CreateVehicle", request).vehicle)))

    def delete(self, vehicle):
        def call():
            self.call(vehicle, "DeleteVehicle",
                      api.DeleteVehicleRequest(name=f"vehicles/{vehicle}"))
            return ("deleted",)
        self.record(vehicle, "delete", (), call)

    def accept(self, vehicle):
        durable = self.memories[vehicle].durable
        if self.rng.random() < 0.1:
            durable += 1
        self.record(vehicle, "accept", (durable,), lambda: (
            "vehicle", summary_of(
                self.call(vehicle, "AcceptDataLoss", api.AcceptDataLossRequest(
                    name=f"vehicles/{vehicle}",
                    durable_sequence=durable)).vehicle)))


def end_of_life(rng):
    """(environment, how it ends, after how many seconds)."""
    way = rng.random()
    if way < 0.2:
        # Right after a flush: stored, and nobody was told.
        return (preloaded(file="-wal", kill_sync=rng.randint(2, 400)), "kill",
                10.0)
    environment = preloaded(slow_sync=rng.randint(1000, 40000)) \
        if way < 0.5 else clean_environment()
    return environment, "stop" if way > 0.9 else "kill", rng.uniform(0.5, 5.0)


def census(channel, memories):
    """What each vehicle is, asked by one client: operations by vehicle. None if
    the server went away."""
    client = Client("census", random.Random(1), memories, channel,
                    collections.Counter({name: MOST_GIVEN_UP
                                         for name in VEHICLES}))
    for vehicle in VEHICLES:
        client.get(vehicle)
        client.read_poses(vehicle, 1, 10000)
        for name in KINDS:
            client.list_pairs(vehicle, name)
    asked = client.operations
    sure = all(operation.result is not None
               for operations in asked.values() for operation in operations)
    return asked if sure else None


class Judge:
    """Keeps in which states each vehicle may be, and what was done since. Where
    that leaves too many possibilities, as when the server was killed amid many
    changes of one vehicle, the vehicle is begun anew."""

    def __init__(self):
        self.states = {vehicle: {None} for vehicle in VEHICLES}
        self.history = {vehicle: [] for vehicle in VEHICLES}
        self.counts = collections.Counter()
        # Vehicles in states that are not known.
        self.undecided = set()

    def add(self, operations):
        for vehicle, more in operations.items():
            self.history[vehicle] += more
            self.counts["operations"] += len(more)
            self.counts["unknown"] += sum(
                operation.result is None for operation in more)

    def decide(self, seen):
        """With the next server's answers, before anybody changes anything."""
        for vehicle in VEHICLES:
            operations = self.history[vehicle]
            try:
                if vehicle not in self.undecided:
                    self.states[vehicle] = linearization.check(
                        vehicle_model, self.states[vehicle], operations,
                        seen[vehicle])
                    self.counts["decided"] += len(operations)
            except linearization.Undecided:
                self.undecided.add(vehicle)
            except linearization.Violation as violation:
                print(f"vehicle {vehicle}, life {self.counts['lives']}:\n"
                      f"{violation.explain()}", flush=True)
                raise
            self.history[vehicle] = []

    def begin_anew(self, stub):
        """Deletes vehicles in states that are not known, while nobody else calls.
        Raises RpcError if the server went away."""
        for vehicle in sorted(self.undecided):
            try:
                stub.DeleteVehicle(api.DeleteVehicleRequest(
                    name=f"vehicles/{vehicle}"), timeout=CALL_SECONDS)
            except grpc.RpcError as error:
                if error.code() != grpc.StatusCode.NOT_FOUND:
                    raise
            self.states[vehicle] = {None}
            self.undecided.discard(vehicle)


def one_life(run, store, memories, judge, seconds):
    """From a start of the server to its end."""
    environment, end, planned = end_of_life(run.rng)
    seconds = min(seconds, planned)
    given_up = collections.Counter()
    stop = threading.Event()
    with Server(store, *FLAGS, env=environment, wait=False) as server:
        try:
            server.wait_until_listening()
        except AssertionError:
            # Killed by a flush of its start.
            return
        seen = census(server.channel(), memories)
        if seen is None:
            return
        judge.decide(seen)
        try:
            judge.begin_anew(PoseGraphServiceStub(server.channel()))
        except grpc.RpcError:
            # Killed by a flush of a deletion.
            return
        judge.counts["lives"] += 1
        clients = [Client(number, random.Random(run.rng.random()), memories,
                          server.channel(("grpc.use_local_subchannel_pool", 1)),
                          given_up)
                   for number in range(CLIENTS)]
        threads = [threading.Thread(target=client.live, args=(stop,))
                   for client in clients]
        for thread in threads:
            thread.start()
        until = time.monotonic() + seconds
        while time.monotonic() < until and server.is_running() \
                and not stop.is_set():
            time.sleep(0.01)
        if server.is_running():
            getattr(server.process, "terminate" if end == "stop" else "kill")()
        stop.set()
        server.process.wait(60)
        for thread in threads:
            thread.join(2 * CALL_SECONDS)
            assert not thread.is_alive(), "a call does not end"
        for client in clients:
            judge.add(client.operations)
            if client.problem is not None:
                raise client.problem


def linearizable(run):
    seconds = run.rounds(short=15, long=1800)
    store = run.new("linear") / "store"
    memories = {vehicle: Memory() for vehicle in VEHICLES}
    judge = Judge()
    until = time.monotonic() + seconds
    while (left := until - time.monotonic()) > 0:
        one_life(run, store, memories, judge, left)
    with Server(store, *FLAGS) as server:
        judge.decide(census(server.channel(), memories))
    counts = judge.counts
    assert counts["lives"] > 0 and counts["operations"] > 0, counts
    assert counts["decided"] >= LEAST_DECIDED * counts["operations"], counts
    return counts["lives"], (
        f"{counts['operations']} operations of {CLIENTS} clients, "
        f"{counts['unknown']} with unknown outcome; each vehicle's have an "
        f"order, but for {counts['operations'] - counts['decided']} of which "
        f"that is not decided")


ROWS = [("linearizable over all methods", "64",
         "every answer is that of one call at a time", linearizable)]
