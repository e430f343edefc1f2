"""PostgreSQL as the servers see it: the tables of ownership, statements that take CPU,
locks and a flushed log, and a standby."""

import collections
import dataclasses
import typing

import kernel as kernels


@dataclasses.dataclass
class Head:
    owner: typing.Optional[int] = None
    epoch: int = 0
    durable: int = 0


@dataclasses.dataclass
class Incarnation:
    """A row of `servers`."""

    address: str
    beat: int = 0
    live: bool = True


class Failed:
    """A statement without an answer. `unknown`: it may have been committed."""

    def __init__(self, unknown):
        self.unknown = unknown


class Statement(typing.NamedTuple):
    """One autocommit statement.

    `evaluate(database)` is called once the locks are held and answers with
    (result, writes); a write is (table, key, new row) with None for no row.
    """

    cpu: float
    locks: tuple
    evaluate: typing.Callable
    done: typing.Callable
    # Waits for the synchronous standby.
    replicated: bool = True


class Database:
    """One primary and one standby.

    Tables change when a statement commits; row locks are held from its evaluation
    until then, so a second writer of a row evaluates on top of the first. Of
    statements under way at a crash those that had not reached the log are lost,
    of the others chance decides.
    """

    def __init__(self, kernel, parameters, standby_lag=None, busy=0.0):
        """`standby_lag`: seconds that an asynchronous standby is behind; None: it is
        synchronous. `busy`: share of the CPU that statements outside of the
        simulation take; what is simulated gets what they leave."""
        self._kernel = kernel
        self._p = parameters
        self._cpu = kernels.Line(kernel, int(parameters.database_cores))
        self._slow = 1.0 / (1.0 - busy)
        self._log = kernels.Flushes(kernel, parameters.flush_s)
        self._pipe = kernels.Line(kernel, 1)
        self._synchronous = standby_lag is None
        self._standby_lag = standby_lag or 0.0
        self._stalled_until = 0.0
        self._not_on_standby = collections.deque()
        self._locks = {}
        self._under_way = {}
        self._generation = 0
        self.up = True
        self.servers = {}
        self.heads = {}
        # Vehicle -> incarnation that asks for it.
        self.handovers = {}
        # Called with (key, old, new) for every change of a head.
        self.on_head = lambda key, old, new: None
        # Rows of appends that the fence refused.
        self.fenced = 0
        self.bytes_read = 0.0

    # -- What servers call

    def execute(self, statement):
        """`statement.done` gets the result or Failed."""
        hop = self._p.hop_s
        if not self.up:
            self._kernel.after(2 * hop, statement.done, Failed(unknown=False))
            return
        ticket = [statement, "sent", ()]
        self._under_way[id(ticket)] = ticket
        self._kernel.after(
            hop, self._cpu.request, statement.cpu * self._slow,
            lambda: self._alive(ticket) and self._lock(ticket))

    def read(self, size, done):
        """Reads a vehicle's rows, one reader after the other; `done(ok)`."""
        self.bytes_read += size
        generation = self._generation
        self._pipe.request(
            size / self._p.database_send_Bps,
            lambda: done(self.up and generation == self._generation))

    # -- What scenarios call

    def stall_standby(self, seconds):
        """No answer of the standby for so long."""
        self._stalled_until = self._kernel.now + seconds

    def crash(self, outage):
        """The primary is gone; the standby serves after `outage`, with what has
        reached it."""
        self.up = False
        self._generation += 1
        under_way, self._under_way = self._under_way, {}
        for ticket in under_way.values():
            statement, stage, writes = ticket
            in_log = stage == "committing"
            if in_log and self._kernel.random.random() < 0.5:
                self._apply(writes, lost_with=self._arrival())
            self._kernel.after(self._p.hop_s, statement.done, Failed(in_log))
        self._locks.clear()
        while self._not_on_standby:
            arrival, table, key, old = self._not_on_standby.pop()
            if arrival > self._kernel.now:
                self._set(table, key, old)
        self._stalled_until = 0.0
        self._cpu = kernels.Line(self._kernel, int(self._p.database_cores))
        self._log = kernels.Flushes(self._kernel, self._p.flush_s)
        self._kernel.after(outage, self._promoted)

    def _promoted(self):
        self.up = True

    # -- A statement's way

    def _alive(self, ticket):
        return id(ticket) in self._under_way

    def _lock(self, ticket):
        statement = ticket[0]
        for lock in statement.locks:
            if lock in self._locks:
                self._locks[lock].append(ticket)
                return
        result, writes = statement.evaluate(self)
        for lock in statement.locks:
            self._locks[lock] = []
        for table, key, _ in writes:
            self._locks.setdefault((table, key), [])
        ticket[1] = "committing"
        ticket[2] = writes
        if not writes:
            self._finish(ticket, result)
            return
        self._log.request(
            lambda: self._alive(ticket) and self._replicate(ticket, result))

    def _replicate(self, ticket, result):
        if not self._synchronous or not ticket[0].replicated:
            self._finish(ticket, result)
            return
        stall = max(0.0, self._stalled_until - self._kernel.now)
        self._kernel.after(
            stall + 2 * self._p.hop_s + self._p.flush_s,
            lambda: self._alive(ticket) and self._finish(ticket, result))

    def _arrival(self):
        """When a commit of now is on the standby."""
        now = self._kernel.now
        return max(now, self._stalled_until) + self._standby_lag

    def _finish(self, ticket, result):
        statement, _, writes = ticket
        del self._under_way[id(ticket)]
        here_only = not self._synchronous or not statement.replicated
        self._apply(writes, self._arrival() if here_only else self._kernel.now)
        woken = []
        for lock in {*statement.locks, *((t, k) for t, k, _ in writes)}:
            woken += self._locks.pop(lock, [])
        for waiter in woken:
            if self._alive(waiter):
                self._lock(waiter)
        self._kernel.after(self._p.hop_s, statement.done, result)

    def _apply(self, writes, lost_with):
        for table, key, new in writes:
            old = getattr(self, table).get(key)
            if lost_with > self._kernel.now:
                self._not_on_standby.append((lost_with, table, key, old))
            self._set(table, key, new)
        while (self._not_on_standby
               and self._not_on_standby[0][0] <= self._kernel.now):
            self._not_on_standby.popleft()

    def _set(self, table, key, new):
        rows = getattr(self, table)
        if table == "heads":
            self.on_head(key, rows.get(key), new)
        if new is None:
            rows.pop(key, None)
        else:
            rows[key] = new

    def locked(self, key):
        """Whether another transaction holds the head of a vehicle: SKIP LOCKED."""
        return ("heads", key) in self._locks

    def is_dead(self, incarnation):
        row = self.servers.get(incarnation)
        return row is None or not row.live


# -- The statements of the protocol. Rows are replaced, never changed in place.


def join(p, incarnation, address, done):
    return Statement(
        p.statement_cpu_s, (),
        lambda database: (True, [("servers", incarnation, Incarnation(address))]),
        done)


def beat(p, incarnation, replicated, done):
    """Answers None if this incarnation is dead, else ({incarnation: row} of all that
    live, {vehicle: incarnation that asks} of its own)."""

    def evaluate(database):
        row = database.servers.get(incarnation)
        if row is None or not row.live:
            return None, []
        live = {key: other for key, other in database.servers.items() if other.live}
        wanted = {key: by for key, by in database.handovers.items()
                  if (head := database.heads.get(key)) is not None
                  and head.owner == incarnation}
        return (live, wanted), [
            ("servers", incarnation,
             dataclasses.replace(row, beat=row.beat + 1))]

    return Statement(p.statement_cpu_s, (("servers", incarnation),), evaluate, done,
                     replicated)


def bury(p, incarnation, seen, done):
    def evaluate(database):
        row = database.servers.get(incarnation)
        if row is None or not row.live or (seen is not None and row.beat != seen):
            return False, []
        return True, [("servers", incarnation, dataclasses.replace(row, live=False))]

    return Statement(p.statement_cpu_s, (("servers", incarnation),), evaluate, done)


def claim(p, incarnation, keys, done):
    """Answers ({vehicle: head} of what was taken, {vehicle: owner} of the others)."""

    def evaluate(database):
        taken, others = {}, {}
        alive = not database.is_dead(incarnation)
        for key in keys:
            head = database.heads[key]
            free = (head.owner is None or head.owner == incarnation
                    or database.is_dead(head.owner))
            if alive and free and not database.locked(key):
                taken[key] = dataclasses.replace(
                    head, owner=incarnation, epoch=head.epoch + 1)
            else:
                others[key] = head.owner
        writes = [("heads", key, head) for key, head in taken.items()]
        writes += [("handovers", key, None) for key in taken
                   if key in database.handovers]
        return (taken, others), writes

    return Statement(p.statement_cpu_s + p.row_cpu_s * len(keys), (), evaluate, done)


def ask(p, incarnation, keys, done):
    return Statement(
        p.statement_cpu_s + p.row_cpu_s * len(keys), (),
        lambda database: (True, [("handovers", key, incarnation) for key in keys]),
        done, replicated=False)


def release(p, incarnation, key, epoch, done):
    def evaluate(database):
        head = database.heads[key]
        if (head.owner, head.epoch) != (incarnation, epoch):
            return False, []
        return True, [("heads", key, dataclasses.replace(head, owner=None))]

    return Statement(p.statement_cpu_s + p.row_cpu_s, (("heads", key),), evaluate, done)


class Row(typing.NamedTuple):
    key: int
    epoch: int
    first: int
    count: int


def append(p, incarnation, rows, fence, done):
    """Answers the set of vehicles whose rows were written."""

    def evaluate(database):
        writes = []
        for row in rows:
            head = database.heads[row.key]
            if not fence or (head.owner, head.epoch, head.durable) == (
                    incarnation, row.epoch, row.first - 1):
                writes.append(("heads", row.key, dataclasses.replace(
                    head, durable=row.first + row.count - 1)))
            else:
                database.fenced += 1
        return {key for _, key, _ in writes}, writes

    cpu = (p.statement_cpu_s + p.row_cpu_s * len(rows)
           + p.pose_cpu_s * sum(row.count for row in rows))
    return Statement(cpu, tuple(("heads", row.key) for row in rows), evaluate, done)
