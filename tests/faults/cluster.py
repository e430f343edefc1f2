"""A cluster that a row of the fault matrix harms: several real revisitd over one
PostgreSQL, the clients of some vehicles, and the judgement in the end."""

import contextlib
import math
import signal
import time

import grpc

from cluster_clients import Fleet
from cluster_history import Claim, Stored, hasty_moves, moves, violations
from database_proxy import DatabaseProxy
from envoy_front import EnvoyFront
from postgres import Postgres, url_of
from revisit_server import (Server, clean_environment, free_port, is_crowded,
                            wait_until)
from revisit_server import run as run_program
from stubs import PoseGraphServiceStub
from wire import as_bytes, list_poses

# The lease of the servers: how long they may be silent, and how long they keep a
# vehicle that others ask for. Shorter than by default, since the rows wait for it,
# and longer than what a busy machine holds a server up.
LEASE_SECONDS = 3.0
# Beyond the lease: until others have looked twice, have claimed, and have loaded,
# on a machine that is busy.
TAKEOVER_SECONDS = LEASE_SECONDS + 10.0


def back_seconds():
    """Within which everybody is served once nothing is in the way any more. That is a
    promise of a machine that has time for it; one with long queues at its processors,
    of others' work, is held to the order of events alone."""
    return TAKEOVER_SECONDS if is_crowded() else 5.0


def short_of_lease_seconds():
    """The longest time that anybody may wait where no lease has to run out. A promise
    as that of back_seconds()."""
    return TAKEOVER_SECONDS if is_crowded() else LEASE_SECONDS


# Who had which vehicle when, noted by the database itself in the transaction that
# changes it.
_NOTE_CLAIMS = """
CREATE SCHEMA faults;
CREATE TABLE faults.claims (at timestamptz, key bigint, owner uuid, previous uuid,
                            previous_lived boolean);
CREATE FUNCTION faults.note_claim() RETURNS trigger LANGUAGE plpgsql AS $$
BEGIN
  INSERT INTO faults.claims VALUES (
    clock_timestamp(), NEW.key, NEW.owner, OLD.owner,
    EXISTS (SELECT 1 FROM public.servers s
            WHERE s.incarnation = OLD.owner AND s.state = 'live'));
  RETURN NULL;
END $$;
CREATE TRIGGER note_claim AFTER UPDATE OF owner ON public.heads
  FOR EACH ROW EXECUTE FUNCTION faults.note_claim();
"""


class Cluster:
    """Servers 0, 1, ... over one database, and one fleet of clients. As a context
    it ends with all of them."""

    def __init__(self, run, servers=3, database=None, url=None, proxied=False,
                 host_of=None, flags=(), front=None, fleet=None, **more):
        """`url`: what the servers are given as their store, if not the database
        itself. With `proxied`, they reach it through `proxy`. `host_of`:
        (address, launch) of a server by number. `front`: an EnvoyFront before the
        servers; without, there is one if all rows are to be behind Envoy. `fleet`:
        further arguments of Fleet; `more`: of Postgres, where `database` is none
        that is there already."""
        directory = run.new(f"cluster{run.rng.randrange(10**9)}")
        self.servers = {}
        # When, by incarnation.
        self._asked_to_end = {}
        self._directory = directory
        self._rng = run.rng
        self.front = front
        if front is None and run.behind_envoy:
            self.front = EnvoyFront(run)
        self._flags = ["--lease-seconds", LEASE_SECONDS, *flags,
                       *(self.front.flags if self.front else ())]
        self._host_of = host_of or (lambda number: ("127.0.0.1", ()))
        self._listens = {}
        with contextlib.ExitStack() as stack:
            self.database = database or stack.enter_context(
                Postgres(directory / "database", **more))
            migrated = run_program("revisitd", "migrate", "--store",
                                   self.database.url())
            assert migrated.returncode == 0, migrated
            self.database.sql(_NOTE_CLAIMS)
            self.proxy = None
            if proxied:
                self.proxy = stack.enter_context(DatabaseProxy(
                    (self.database.host, self.database.port)))
                url = url_of(self.proxy.address)
            self._url = url or self.database.url()
            stack.callback(self._close_servers)
            for number in range(servers):
                self.start(number)
            if self.front is not None:
                stack.callback(self.front.close)
                self.front.start(self.addresses())
            self.fleet = Fleet(run.seed, self.addresses(), **(
                {"proxy": self.front.address,
                 "open_channel": self.front.open_channel} if self.front else {}),
                **(fleet or {}))
            self.fleet.create()
            stack.callback(self._stop_fleet)
            self._stack = stack.pop_all()

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._stack.close()

    def _stop_fleet(self):
        self.fleet.stopped.set()
        for vehicle in self.fleet.vehicles:
            vehicle.cancel()

    def _close_servers(self):
        for server in self.servers.values():
            if server.is_running():
                server.process.send_signal(signal.SIGCONT)
                server.kill()

    # Servers.

    def addresses(self):
        return [server.address for server in self.servers.values()]

    def tell_of_servers(self):
        """Has calls go to those that there are now."""
        if self.front is None:
            self.fleet.addresses = self.addresses()
        else:
            self.front.list_servers(self.addresses())

    def stub(self, number):
        """Of one server, whatever stands before it."""
        server = self.servers[number]
        if self.front is None:
            return server.stub()
        return PoseGraphServiceStub(
            server.keep(self.front.open_channel_behind(server.address)))

    def start(self, number, **environment):
        """A server, at the address that it had before if it had one."""
        host, launch = self._host_of(number)
        if number not in self._listens:
            self._listens[number] = f"{host}:{free_port()}"
        address = self._listens[number]
        self.servers[number] = Server(
            self._url, "--advertise-address", address, *self._flags,
            listen=address, launch=launch,
            env=clean_environment(**environment),
            log_path=self._directory / f"server{number}.log")
        return self.servers[number]

    def kill(self, number):
        self.servers[number].kill()

    def terminate(self, number, seconds=30):
        """Its end as an operator asks for it; answers how long that took."""
        server = self.servers[number]
        for (incarnation,) in self.database.sql(
                "SELECT incarnation FROM servers WHERE state = 'live' AND address = "
                f"'{server.address}'"):
            self._asked_to_end[incarnation] = time.time()
        begun = time.monotonic()
        server.process.send_signal(signal.SIGTERM)
        assert server.process.wait(seconds) == 0, server.log()[-3000:]
        server.close()
        return time.monotonic() - begun

    def pause(self, number):
        self.servers[number].process.send_signal(signal.SIGSTOP)

    def resume(self, number):
        self.servers[number].process.send_signal(signal.SIGCONT)

    def is_paused(self, number):
        with open(f"/proc/{self.servers[number].pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] == "T"

    # Asked of the database.

    def wait_until_dead(self, number):
        """Until the others have declared a server dead."""
        address = self.servers[number].address
        wait_until(lambda: not self.database.sql(
            f"SELECT 1 FROM servers WHERE address = '{address}' AND "
            "state = 'live'"), f"dead server at {address}", TAKEOVER_SECONDS)

    def lives(self, number):
        """Whether a server is one of those that live in the database."""
        return bool(self.database.sql(
            "SELECT 1 FROM servers WHERE state = 'live' AND address = "
            f"'{self.servers[number].address}'"))

    def owners(self):
        """The address of the server of each vehicle that has one that lives, by
        name."""
        return {f"vehicles/{name}": address for name, address in self.database.sql(
            "SELECT v.id, s.address FROM vehicles v JOIN heads h USING (key) "
            "JOIN servers s ON s.incarnation = h.owner WHERE s.state = 'live'")}

    def count_of(self, number):
        """How many vehicles a server has."""
        return list(self.owners().values()).count(self.servers[number].address)

    def vehicles_of(self, number):
        """Those of the fleet that a server has."""
        owners = self.owners()
        return [vehicle for vehicle in self.fleet.vehicles
                if owners.get(vehicle.name) == self.servers[number].address]

    def any_owner(self):
        """The number of one of the servers that have vehicles: it is of no use to
        harm others."""
        with_vehicles = set(self.owners().values())
        return self._rng.choice([
            number for number, server in sorted(self.servers.items())
            if server.is_running() and server.address in with_vehicles])

    def moves(self):
        """How often a vehicle has gone from one server to another."""
        return sum(len(list(moves(claims))) for claims in self.claims().values())

    def claims(self):
        found = {vehicle.name: [] for vehicle in self.fleet.vehicles}
        for name, at, owner, previous, lived in self.database.sql(
                "SELECT v.id, extract(epoch FROM c.at), c.owner, c.previous, "
                "c.previous_lived FROM faults.claims c JOIN vehicles v USING (key) "
                "ORDER BY c.at"):
            stayed = lived == "t" and float(at) < self._asked_to_end.get(
                previous, math.inf)
            found[f"vehicles/{name}"].append(
                Claim(float(at), owner, previous, stayed))
        return found

    # The judgement.

    def judge(self, lost_at=None):
        """Stops the clients and holds what they saw against what is stored;
        answers in words what was seen. `lost_at`: when the database lost the end
        of what it had."""
        self.fleet.stop()
        self._settle()
        broken = []
        claims = self.claims()
        owners = self.owners()
        tables = self._tables()
        for vehicle in self.fleet.vehicles:
            head, rows = tables[vehicle.name]
            try:
                poses = self._read_back(vehicle, owners.get(vehicle.name))
            except grpc.RpcError as error:
                broken.append(f"{vehicle.name}: DAMAGED {error.details()}")
                continue
            stored = Stored(rows, head, poses)
            broken += [f"{vehicle.name}: {text}" for text in [
                *violations(vehicle.history, stored, vehicle.sent_pose, lost_at),
                *hasty_moves(claims[vehicle.name], LEASE_SECONDS)]]
        broken += self.verify()
        if broken:
            raise Broken(broken)
        histories = [vehicle.history for vehicle in self.fleet.vehicles]
        lost = "" if lost_at else "lost 0, "
        return (f"{self.fleet.acked()} poses acked: {lost}gaps 0; "
                f"{sum(len(history.reads) for history in histories)} reads, stale "
                f"0; {self.moves()} moves, hasty 0")

    def verify(self):
        """What is wrong with the database as it is stored."""
        verified = run_program("revisitd", "verify", "--store",
                               self.database.url())
        return [] if verified.returncode == 0 else [
            f"verify: REFUSES {verified.stdout} {verified.stderr}"]

    def _settle(self):
        """Waits until what was sent and not acknowledged is stored, or is not going
        to be."""
        before = None
        while (now := self.database.sql(
                "SELECT sum(durable_sequence) FROM heads")) != before:
            before = now
            time.sleep(0.4)

    def _tables(self):
        """(head, rows) of each vehicle by name, without a server's help."""
        found = {}
        for name, head, first, count in self.database.sql(
                "SELECT v.id, h.durable_sequence, b.first_sequence, b.count "
                "FROM vehicles v JOIN heads h USING (key) "
                "LEFT JOIN batches b ON b.vehicle_key = v.key"):
            _, rows = found.setdefault(f"vehicles/{name}", (int(head), []))
            if first:
                rows.append((int(first), int(count)))
        return found

    def _read_back(self, vehicle, owner):
        address = self.front.address if self.front else owner or next(
            server.address for server in self.servers.values()
            if server.is_running())
        with self.fleet.open_channel(address, options=None) as channel:
            stub = PoseGraphServiceStub(channel)
            # A server that has just ended may still be listed as the owner.
            deadline = time.monotonic() + TAKEOVER_SECONDS
            while True:
                try:
                    return as_bytes(list_poses(stub, vehicle.name))
                except grpc.RpcError as error:
                    if time.monotonic() > deadline or \
                            error.code() == grpc.StatusCode.DATA_LOSS:
                        raise
                    time.sleep(0.5)


class Broken(Exception):
    """Promises that were broken."""

    def __init__(self, texts):
        self.texts = texts
        super().__init__(f"{len(texts)} broken promises: " + "; ".join(texts[:8]))
