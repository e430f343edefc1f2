"""A cell: servers, one PostgreSQL, Envoys and vehicles; and an oracle that holds what
happens against what is promised, after every event."""

import collections
import dataclasses
import math
import typing

import client
import database
import edge
import kernel as kernels
import parameters as figures
import server as servers


@dataclasses.dataclass
class Setup:
    seed: int = 1
    servers: int = 10
    # The vehicles of one server at the peak; `part` of it is simulated, on as small a
    # part of the server's threads, of PostgreSQL's cores and of its network.
    streams_per_server: int = 2500
    part: float = 1.0
    envoys: int = 1
    # Seconds between two messages of a stream.
    message_s: float = 10.0
    history_days: float = 7.0
    # Share of the history's nodes that is kept in memory and in the store.
    kept: float = 1.0
    # Graphs are stored as they are in memory and loaded as such, instead of being
    # built from the rows.
    snapshots: bool = False
    max_stream_age: float = math.inf
    # Seconds that the standby is behind; None: it is synchronous.
    standby_lag: typing.Optional[float] = None
    # Share of PostgreSQL's CPU that others take.
    busy: float = 0.0
    # Only vehicles of this server have streams.
    only_of: int = None
    policy: figures.Policy = dataclasses.field(default_factory=figures.Policy)
    parameters: figures.Parameters = dataclasses.field(
        default_factory=figures.Parameters)

    @property
    def nodes(self):
        """Nodes of one vehicle's history."""
        p = self.parameters
        return (p.hours_a_day * 3600 * p.speed_mps / p.node_m
                * self.history_days * self.kept)

    @property
    def stored_bytes(self):
        p = self.parameters
        if self.snapshots:
            return self.nodes * p.snapshot_node_B
        return (p.hours_a_day * 3600 * p.pose_hz * p.disk_pose_80
                * self.history_days * self.kept)


class Violation(AssertionError):
    """A promise that was broken."""


class Oracle:
    """Hears of everything, keeps count, and raises Violation where a promise is
    broken: two servers that would answer for a vehicle, an answer from memory that
    lacks an acknowledged pose, a write that is no prefix, an acknowledged pose that
    is not in the store."""

    def __init__(self, kernel, setup):
        self._kernel = kernel
        self._setup = setup
        self._touched = set()
        self._holders = collections.defaultdict(set)
        self.acked = collections.defaultdict(int)
        # Vehicles that an asynchronous failover has set back, not told yet.
        self.set_back = {}
        self.told = {}
        self.heads = None
        self._failed_over = -math.inf
        self.refusals = collections.Counter()
        self.owned_at = collections.defaultdict(list)
        self.loads = []
        self.burials = []
        self.handovers = 0
        self.checks = 0
        kernel.after_event = self._check

    def stored_bytes(self, _):
        return self._setup.stored_bytes

    def touched(self, vehicle):
        self._touched.add(vehicle)

    def owned(self, vehicle, server):
        self._holders[vehicle].add(server)
        self._touched.add(vehicle)
        self.owned_at[vehicle].append((self._kernel.now, server.address))

    def loaded(self, vehicle):
        self.loads.append((self._kernel.now, vehicle))

    def claimed(self, taken, refused):
        del taken, refused

    def buried(self, result):
        if result is True:
            self.burials.append(self._kernel.now)

    def handed_over(self):
        self.handovers += 1

    def acknowledged(self, vehicle, sequence):
        self.acked[vehicle] = max(self.acked[vehicle], sequence)
        self._touched.add(vehicle)
        # It was on its way when the primary died.
        if self._kernel.now - self._failed_over < 0.1:
            self._note_set_back(vehicle)

    def regressed(self, vehicle):
        """A client was told that acknowledged poses are gone."""
        if vehicle not in self.set_back:
            raise Violation(f"vehicle {vehicle} lost poses without a failover that "
                            f"loses any, at {self._kernel.now:.3f} s")
        self.told[vehicle] = self.set_back.pop(vehicle)
        self.acked[vehicle] = 0

    def refused(self, reason):
        self.refusals[reason] += 1

    def moving(self, vehicle):
        """An acknowledgement came, or nothing waits for one."""

    def head_changed(self, key, old, new):
        if old is not None and new.durable < old.durable and self.heads.up:
            raise Violation(f"vehicle {key}: durable {old.durable} -> {new.durable} "
                            f"at {self._kernel.now:.3f} s")
        self._touched.add(key)

    def failed_over(self):
        """Notes which vehicles an asynchronous standby has set back."""
        self._failed_over = self._kernel.now
        for vehicle in self.acked:
            self._note_set_back(vehicle)

    def _note_set_back(self, vehicle):
        lost = self.acked[vehicle] - self.heads.heads[vehicle].durable
        if lost > 0 and self._setup.standby_lag is not None:
            self.set_back[vehicle] = lost

    def _check(self):
        while self._touched:
            self._check_vehicle(self._touched.pop())

    def _check_vehicle(self, vehicle):
        self.checks += 1
        holders = self._holders[vehicle]
        for server in [each for each in holders if not each.owns(vehicle)]:
            holders.discard(server)
        readers = [server for server in holders if server.may_read(vehicle)]
        if len(readers) > 1:
            raise Violation(
                f"vehicle {vehicle} is answered for by "
                f"{sorted(server.address for server in readers)} "
                f"at {self._kernel.now:.3f} s")
        if vehicle in self.set_back:
            return
        acked = self.acked[vehicle]
        for server in readers:
            if server.seats[vehicle].durable < acked:
                raise Violation(
                    f"vehicle {vehicle}: {server.address} would answer with "
                    f"{server.seats[vehicle].durable} poses of {acked} acknowledged "
                    f"at {self._kernel.now:.3f} s")
        if self.heads.up and self.heads.heads[vehicle].durable < acked:
            raise Violation(f"vehicle {vehicle}: {acked} acknowledged, "
                            f"{self.heads.heads[vehicle].durable} stored at "
                            f"{self._kernel.now:.3f} s")

    def check_all(self):
        """The same for every vehicle there is."""
        for vehicle in list(self.acked):
            self._check_vehicle(vehicle)


class Cluster:
    """Everything of one run. Streams are open and vehicles owned from `begin` on."""

    # Servers have joined and beaten by then.
    begin = 5.0
    # Poses that each vehicle has at the beginning.
    poses = 1000

    def __init__(self, setup):
        self.setup = setup
        self.kernel = kernel = kernels.Kernel(setup.seed)
        p = self.parameters = dataclasses.replace(
            setup.parameters,
            database_cores=max(1, round(setup.parameters.database_cores * setup.part)),
            database_send_Bps=setup.parameters.database_send_Bps * setup.part,
            fewest_asked=max(1, round(setup.parameters.fewest_asked * setup.part)),
            load_node_s=(setup.parameters.snapshot_node_s if setup.snapshots
                         else setup.parameters.load_node_s))
        self.oracle = oracle = Oracle(kernel, setup)
        self.database = database.Database(kernel, p, setup.standby_lag, setup.busy)
        self.database.on_head = oracle.head_changed
        oracle.heads = self.database
        threads = max(1, round(p.server_cores * setup.part))
        self.servers = [
            servers.Server(kernel, p, setup.policy, self.database, f"server-{i}",
                           lambda _: setup.nodes, threads, oracle)
            for i in range(setup.servers)]
        for server in self.servers:
            server.start()
        self.envoys = [edge.Envoy(kernel, p, self.servers)
                       for _ in range(setup.envoys)]
        self.vehicles = {}
        self.callers = []
        # Largest number of vehicles that one server held.
        self.most_held = 0
        # Server-seconds in which a server that ran would not answer from memory.
        self.stale_lease_s = 0.0
        kernel.run(self.begin)
        self._open_streams()
        self._sample()

    def _open_streams(self):
        setup = self.setup
        wanted = round(setup.streams_per_server * setup.part)
        if setup.only_of is None:
            keys = range(wanted * setup.servers)
        else:
            keys = []
            key = 0
            while len(keys) < wanted:
                if self.home(key) is self.servers[setup.only_of]:
                    keys.append(key)
                key += 1
        for key in keys:
            server = self.home(key)
            envoy = self.envoys[key % len(self.envoys)]
            vehicle = client.Vehicle(
                self.kernel, self.parameters, setup.policy, envoy, key,
                self.parameters.pose_hz, setup.message_s, setup.max_stream_age,
                self.oracle)
            vehicle.adopt(server, self.poses)
            seat = servers.Seat()
            seat.state = servers.State.OWNED
            seat.epoch = 1
            seat.durable = seat.sent = self.poses
            seat.since = self.kernel.now
            seat.stream = vehicle
            server.seats[key] = seat
            self.database.heads[key] = database.Head(
                server.incarnation, 1, self.poses)
            self.vehicles[key] = vehicle
            self.oracle.acked[key] = self.poses
            self.oracle.owned(key, server)

    def _sample(self, every=0.25):
        now = self.kernel.now
        for server in self.servers:
            self.most_held = max(self.most_held, len(server.seats))
            if server.running and server.seats and now >= server.lease_until:
                self.stale_lease_s += every
        self.kernel.after(every, self._sample)

    def home(self, key):
        """The server that the first Envoy's table names."""
        return self.envoys[0].route(key)

    def call_beside_streams(self, envoy, keys, every, retries):
        """A verifier of each of these vehicles that calls through another Envoy."""
        self.callers = [
            client.UnaryCaller(self.kernel, self.parameters, self.setup.policy, envoy,
                               key, every, retries, self.oracle)
            for key in keys]

    # -- Harm

    def kill(self, server):
        """kill -9; Envoy resets its streams at once."""
        server.kill()

    def restart(self, server, away, done):
        """SIGTERM, and a new process `away` seconds after the old one ended."""

        def ended():
            self.kernel.after(away, started)

        def started():
            server.start()
            done()

        server.drain(ended)

    def freeze(self, server, seconds):
        """SIGSTOP. Envoy pings each connection now and then, and cuts it when no
        answer comes; each vehicle has a connection of its own."""
        server.freeze(seconds)
        p, random = self.parameters, self.kernel.random
        for vehicle in self.vehicles.values():
            until_ping = random.random() * p.ping_interval_s * (
                1.0 + p.ping_jitter * random.random())
            if seconds > until_ping + p.ping_timeout_s:
                self.kernel.after(until_ping + p.ping_timeout_s, vehicle.cut, server)

    def freeze_at_commit(self, server, seconds):
        """The same between its next decision to append and the statement."""
        server.before_commit = lambda: self.freeze(server, seconds)

    def fail_over(self, outage):
        """The primary dies; the standby is primary after `outage`."""
        self.database.crash(outage)
        self.oracle.failed_over()

    # -- What became of it

    def run(self, seconds):
        self.kernel.run(self.kernel.now + seconds)
        self.oracle.check_all()

    def gaps(self):
        """The longest time of each vehicle without an acknowledgement, sorted."""
        now = self.kernel.now
        # A message comes only so often; what is more is the harm's.
        return sorted(
            max(vehicle.longest_gap, now - vehicle.last_ack) - self.setup.message_s
            for vehicle in self.vehicles.values())

    def waiting(self):
        """Vehicles whose poses have waited for more than two messages' time."""
        limit = 2 * self.setup.message_s + 1.0
        return sum(self.kernel.now - vehicle.last_ack > limit
                   for vehicle in self.vehicles.values())


def quantile(ordered, share):
    return ordered[min(len(ordered) - 1, int(share * len(ordered)))]
