"""A revisitd of the cluster: its lease, the vehicles that it owns, its loads."""

import collections
import dataclasses
import enum
import itertools
import math
import typing

import database as db

_incarnations = itertools.count(1)


class State(enum.Enum):
    CLAIMING = 1
    LOADING = 2
    OWNED = 3
    RELEASING = 4


@dataclasses.dataclass
class Refusal:
    """An error as a client gets it."""

    reason: str
    # RetryInfo.
    retry: typing.Optional[float] = None
    # Address that NOT_OWNER names.
    owner: typing.Optional[str] = None


class Seat:
    """A vehicle on a server. There is none for one that nobody asked for."""

    __slots__ = ("state", "epoch", "durable", "sent", "since", "callers", "stream",
                 "in_flight", "asked_by")

    def __init__(self):
        self.state = State.CLAIMING
        self.epoch = 0
        self.durable = 0
        # Last sequence that is in memory and may be stored.
        self.sent = 0
        self.since = 0.0
        # Called with Refusal or the durable sequence.
        self.callers = []
        # The stream that appends: gets on_ack(durable) and on_end(Refusal).
        self.stream = None
        self.in_flight = False
        self.asked_by = None


class Server:
    """One process after the other at one address."""

    def __init__(self, kernel, parameters, policy, database, address, nodes,
                 load_threads, watch):
        """`nodes(vehicle)`: nodes of its graph. `watch` is told of every vehicle
        whose owner may have changed, and of figures."""
        self._kernel = kernel
        self._p = parameters
        self._policy = policy
        self._database = database
        self.address = address
        self._nodes = nodes
        self._load_threads = load_threads
        self._watch = watch
        self.running = False
        self.draining = False
        self._frozen_until = 0.0
        self._partitioned_until = 0.0
        self.incarnation = None
        self.lease_until = -math.inf
        # Whether it takes calls: it has joined, and its lease held when it looked.
        self._open = False
        # How many processes there were.
        self._life = 0
        self.seats = {}
        # Graphs in memory of vehicles that it no longer owns: vehicle -> (epoch,
        # sequence that is known to be stored, sequence that may be).
        self._kept = {}
        self._seen = {}
        self._last_reading = -math.inf
        self._to_claim = []
        self._claim_under_way = False
        # Vehicles that it asked others for and that have not come -> when.
        self._asked = {}
        # Vehicles that came in this window, and in the one before it.
        self._came = self._came_before = 0
        self._window_start = -math.inf
        self._loads = collections.deque()
        self._loading = 0
        self._groups = [{} for _ in range(int(parameters.writers))]
        self._group_under_way = [False] * len(self._groups)
        self.joins = 0
        self.load_seconds = 0.0
        # A failpoint: called once between the decision to append and the statement.
        self.before_commit = None

    # -- The process

    def start(self):
        self.running = True
        self.draining = False
        self._open = False
        self._life += 1
        self._join()
        self._follow_lease(self._life)

    def kill(self):
        """kill -9: streams end at once, everything in memory is gone."""
        self.running = False
        self._drop_everything(Refusal("CUT"))
        self._kept.clear()

    def freeze(self, seconds):
        """SIGSTOP: nothing is done or heard until then."""
        self._frozen_until = self._kernel.now + seconds

    def partition(self, seconds):
        """Cuts the server from PostgreSQL."""
        self._partitioned_until = self._kernel.now + seconds

    def drain(self, done):
        """SIGTERM: health NOT_SERVING, no new claims; after the notice streams end
        and one row frees every vehicle. `done` when the process has ended."""
        self.draining = True
        self._kernel.after(self._p.drain_notice_s, self._drain_streams, done)

    def _drain_streams(self, done):
        for seat in list(self.seats.values()):
            if seat.in_flight:
                self._kernel.after(0.01, self._drain_streams, done)
                return
        self._drop_everything(
            Refusal("SERVER_DRAINING", self._kernel.random.uniform(0.0, 1.0)))
        self._kept.clear()
        incarnation, self.incarnation = self.incarnation, None

        def ended(_):
            self.running = False
            done()

        self._execute(db.bury(self._p, incarnation, None, ended))

    @property
    def frozen(self):
        return self._kernel.now < self._frozen_until

    @property
    def working(self):
        """Whether its process runs, and is not about to end."""
        return self.running and not self.draining and not self.frozen

    @property
    def serving(self):
        """What a health check is told; a frozen server answers none."""
        return self.working and self._open

    def owns(self, vehicle):
        seat = self.seats.get(vehicle)
        return seat is not None and seat.state in (State.OWNED, State.RELEASING)

    def may_read(self, vehicle):
        """Whether it would answer from memory now."""
        return (self.running and self.owns(vehicle)
                and self._kernel.now < self.lease_until)

    def resident_nodes(self):
        return sum(self._nodes(vehicle) for vehicle, seat in self.seats.items()
                   if seat.state is not State.CLAIMING)

    def loads_waiting(self):
        """Vehicles that are being loaded or wait for it."""
        return len(self._loads) + self._loading

    # -- PostgreSQL

    def _execute(self, statement):
        if self._kernel.now < self._partitioned_until:
            self._kernel.after(1.0, self._answer, self.incarnation, statement.done,
                               db.Failed(unknown=False))
            return
        if self.frozen:
            # It had been about to send this; nothing is re-checked on waking.
            self._kernel.after(self._frozen_until - self._kernel.now,
                               self._execute, statement)
            return
        done, incarnation = statement.done, self.incarnation
        self._database.execute(statement._replace(
            done=lambda result: self._answer(incarnation, done, result)))

    def _answer(self, incarnation, done, result):
        """An answer to a process that has ended or begun a new life goes nowhere."""
        if self.frozen:
            self._kernel.after(self._frozen_until - self._kernel.now,
                               self._answer, incarnation, done, result)
        elif self.running and incarnation == self.incarnation:
            done(result)

    def _join(self):
        self.incarnation = next(_incarnations)
        self.joins += 1
        self.lease_until = -math.inf
        self._seen.clear()
        incarnation, sent = self.incarnation, self._kernel.now

        def joined(result):
            if isinstance(result, db.Failed):
                self._kernel.after(0.5, self._join_again, incarnation)
                return
            self._extend_lease(sent)
            self._open = True
            self._kernel.after(
                self._p.beat_s * self._kernel.random.random(), self._beat, incarnation)

        self._execute(db.join(self._p, incarnation, self.address, joined))

    def _join_again(self, incarnation):
        if self.running and incarnation == self.incarnation:
            self._join()

    def _extend_lease(self, sent):
        lapsed = self._kernel.now >= self.lease_until
        self.lease_until = sent + self._p.ttl_s - self._p.lease_margin_s
        if lapsed:
            for vehicle in self.seats:
                self._watch.touched(vehicle)

    def _beat(self, incarnation):
        if not self.running or incarnation != self.incarnation:
            return
        if self.frozen:
            self._kernel.after(self._frozen_until - self._kernel.now,
                               self._beat, incarnation)
            return
        sent = self._kernel.now

        def answered(result):
            if isinstance(result, db.Failed):
                # A connection is made anew at once, with half a second between.
                self._kernel.after(self._kernel.random.uniform(0.25, 0.75),
                                   self._beat, incarnation)
                return
            if result is None:
                self._drop_everything(Refusal("EPOCH_FENCED"))
                self._join()
                return
            self._extend_lease(sent)
            live, wanted = result
            self._observe(live)
            for vehicle, by in wanted.items():
                seat = self.seats.get(vehicle)
                if seat is not None and seat.state is State.OWNED:
                    row = live.get(by)
                    seat.asked_by = row.address if row else ""
                    self._maybe_release(vehicle, seat)
            elapsed = self._kernel.now - sent
            self._kernel.after(max(0.0, self._p.beat_s - elapsed),
                               self._beat, incarnation)

        self._execute(db.beat(self._p, incarnation, self._policy.replicated_beats,
                              answered))

    def _follow_lease(self, life):
        """Looks now and then whether the lease still holds. One without it gets out
        of the way: it is not healthy, and streams and callers are sent away."""
        if not self.running or life != self._life:
            return
        if self.frozen:
            self._kernel.after(self._frozen_until - self._kernel.now,
                               self._follow_lease, life)
            return
        holds = self._kernel.now < self.lease_until
        if self._open and not holds and self._policy.leave_without_lease:
            self._open = False
            for seat in self.seats.values():
                self._send_away(
                    seat, Refusal("LEASE_STALE", self._p.unavailable_retry_s))
        elif holds:
            self._open = True
        self._kernel.after(self._p.lease_look_s, self._follow_lease, life)

    def _send_away(self, seat, refusal):
        callers, seat.callers = seat.callers, []
        for _, caller in callers:
            caller(refusal)
        stream, seat.stream = seat.stream, None
        if stream is not None:
            stream.on_end(self, refusal)

    def _observe(self, live):
        now = self._kernel.now
        if self._policy.watch_anew and now - self._last_reading > 2 * self._p.beat_s:
            self._seen.clear()
        self._last_reading = now
        for other, row in live.items():
            if other == self.incarnation:
                continue
            beat, since = self._seen.get(other, (None, now))
            if beat != row.beat:
                self._seen[other] = (row.beat, now)
            elif now - since >= self._p.ttl_s:
                self._execute(db.bury(self._p, other, beat, self._watch.buried))

    # -- A vehicle's way from nobody's to owned and back

    def open(self, vehicle, stream, caller):
        """`caller` gets the durable sequence once the vehicle is owned and loaded,
        or a Refusal. `stream` (None for a unary call) then receives acks."""
        if self.frozen:
            self._kernel.after(self._frozen_until - self._kernel.now,
                               self.open, vehicle, stream, caller)
            return
        if not self.running:
            caller(Refusal("CUT"))
            return
        if self.draining:
            caller(Refusal("SERVER_DRAINING", self._kernel.random.uniform(0.0, 1.0)))
            return
        if self.lease_until == -math.inf:
            # It has not joined yet.
            caller(Refusal("STORE_UNAVAILABLE", self._retry()))
            return
        if not self._open and self._policy.leave_without_lease:
            caller(Refusal("LEASE_STALE", self._p.unavailable_retry_s))
            return
        seat = self.seats.get(vehicle)
        if seat is not None and seat.state is State.OWNED:
            if self._policy.lease_to_open and self._kernel.now >= self.lease_until:
                caller(Refusal("LEASE_STALE", self._p.unavailable_retry_s))
                return
            if stream is not None:
                seat.stream = stream
            caller(seat.durable)
            return
        if seat is not None and seat.state is State.RELEASING:
            caller(Refusal("NOT_OWNER", self._retry(), seat.asked_by))
            return
        if seat is None:
            limit = self._policy.load_queue
            waiting = len(self._loads) + len(self._to_claim)
            if limit is not None and waiting >= limit:
                # As long as the queue in front needs, spread over half as much again.
                seconds = waiting / self._load_threads * self._load_cpu(vehicle)
                caller(Refusal("OVERLOADED",
                               seconds * self._kernel.random.uniform(1.0, 1.5)))
                return
            seat = self.seats[vehicle] = Seat()
            self._to_claim.append(vehicle)
            self._claim()
        seat.callers.append((stream, caller))

    def _retry(self):
        return self._kernel.random.uniform(0.0, self._p.not_owner_retry_s)

    def _may_ask(self, vehicle):
        """Whether to ask another server for the vehicle; counts it if so."""
        if not self._policy.paced_handovers:
            return True
        self._move_window()
        if vehicle not in self._asked:
            most = max(self._p.fewest_asked, self._came_before, self._came)
            if len(self._asked) >= most:
                return False
            self._asked[vehicle] = self._kernel.now
        return True

    def _came_from_another(self, vehicle):
        self._move_window()
        self._came += 1
        self._asked.pop(vehicle, None)

    def _move_window(self):
        now, window = self._kernel.now, 2 * self._p.beat_s
        if now - self._window_start < window:
            return
        self._came_before = self._came if now - self._window_start < 2 * window else 0
        self._came = 0
        self._window_start = now
        self._asked = {vehicle: at for vehicle, at in self._asked.items()
                       if now - at < self._p.hold_s + window}

    def _until_burial(self, owner):
        """Seconds until the owner can be buried if its beat is overdue, else 0."""
        if not self._policy.retry_after_burial or owner not in self._seen:
            return 0.0
        silent = self._kernel.now - self._seen[owner][1]
        if silent < 1.5 * self._p.beat_s:
            return 0.0
        return max(0.0, self._p.ttl_s - silent)

    def _claim(self):
        if self._claim_under_way or not self._to_claim:
            return
        keys, self._to_claim = self._to_claim[:1000], self._to_claim[1000:]
        self._claim_under_way = True

        def answered(result):
            self._claim_under_way = False
            if isinstance(result, db.Failed):
                for vehicle in keys:
                    self._leave(vehicle, Refusal("STORE_UNAVAILABLE", self._retry()))
                self._claim()
                return
            taken, others = result
            for vehicle, head in taken.items():
                self._taken(vehicle, head)
            foreign = []
            for vehicle, owner in others.items():
                row = self._database.servers.get(owner)
                self._leave(vehicle, Refusal(
                    "NOT_OWNER", self._until_burial(owner) + self._retry(),
                    row.address if row else None))
                if owner is not None and self._may_ask(vehicle):
                    foreign.append(vehicle)
            if foreign:
                self._execute(db.ask(self._p, self.incarnation, foreign,
                                     lambda _: None))
            self._watch.claimed(len(taken), len(others))
            self._claim()

        self._execute(db.claim(self._p, self.incarnation, keys, answered))

    def _taken(self, vehicle, head):
        seat = self.seats[vehicle]
        seat.state = State.LOADING
        seat.epoch = head.epoch
        seat.durable = seat.sent = head.durable
        kept = self._kept.pop(vehicle, None)
        # Nobody owned it in between, so the store has what this server wrote.
        if (self._policy.keep_graph and kept is not None
                and head.epoch == kept[0] + 1 and head.durable in kept[1:]):
            self._loaded(vehicle, seat)
            return
        self._loads.append((vehicle, seat))
        self._load()

    def _load_cpu(self, vehicle):
        return self._nodes(vehicle) * self._p.load_node_s

    def _load(self):
        while self._loads and self._loading < self._load_threads:
            vehicle, seat = self._loads.popleft()
            if self.seats.get(vehicle) is not seat:
                continue
            self._loading += 1
            incarnation = self.incarnation
            self._database.read(
                self._watch.stored_bytes(vehicle),
                lambda ok, v=vehicle, s=seat, i=incarnation: self._build(v, s, i, ok))

    def _build(self, vehicle, seat, incarnation, ok):
        if not ok:
            self._loading -= 1
            if self.seats.get(vehicle) is seat:
                self._leave(vehicle, Refusal("STORE_UNAVAILABLE", self._retry()))
            self._load()
            return
        seconds = self._load_cpu(vehicle)
        self.load_seconds += seconds
        self._kernel.after(seconds, self._built, vehicle, seat, incarnation)

    def _built(self, vehicle, seat, incarnation):
        self._loading -= 1
        if self.seats.get(vehicle) is seat and incarnation == self.incarnation:
            self._came_from_another(vehicle)
            self._watch.loaded(vehicle)
            self._loaded(vehicle, seat)
        self._load()

    def _loaded(self, vehicle, seat):
        seat.state = State.OWNED
        seat.since = self._kernel.now
        self._watch.owned(vehicle, self)
        callers, seat.callers = seat.callers, []
        for stream, caller in callers:
            if stream is not None:
                seat.stream = stream
            caller(seat.durable)

    def _leave(self, vehicle, refusal):
        """The vehicle goes back to NONE."""
        seat = self.seats.pop(vehicle, None)
        if seat is None:
            return
        if seat.state in (State.OWNED, State.RELEASING):
            self._kept[vehicle] = (seat.epoch, seat.durable, seat.sent)
        self._watch.touched(vehicle)
        self._send_away(seat, refusal)

    def _drop_everything(self, refusal):
        self._to_claim.clear()
        self._claim_under_way = False
        self._loads.clear()
        self._groups = [{} for _ in self._groups]
        self._group_under_way = [False] * len(self._groups)
        for vehicle in list(self.seats):
            self._leave(vehicle, refusal)

    def _maybe_release(self, vehicle, seat):
        if (seat.asked_by is None or seat.in_flight or seat.state is not State.OWNED
                or self._kernel.now - seat.since < self._p.hold_s):
            return
        seat.state = State.RELEASING

        def released(result):
            if self.seats.get(vehicle) is seat:
                self._watch.handed_over()
                self._leave(vehicle, Refusal("NOT_OWNER", self._retry(),
                                             seat.asked_by or None))

        self._execute(db.release(self._p, self.incarnation, vehicle, seat.epoch,
                                 released))

    # -- Appends

    def append(self, vehicle, stream, first, count):
        """The stream gets on_ack or on_end."""
        if self.frozen:
            self._kernel.after(self._frozen_until - self._kernel.now,
                               self.append, vehicle, stream, first, count)
            return
        seat = self.seats.get(vehicle)
        if not self.running or seat is None or seat.stream is not stream:
            stream.on_end(self, Refusal("CUT" if not self.running else "NOT_OWNER"))
            return
        if seat.state is not State.OWNED or seat.in_flight:
            stream.on_end(self, Refusal("NOT_OWNER", self._retry(), seat.asked_by))
            return
        seat.in_flight = True
        seat.sent = first + count - 1
        connection = vehicle % len(self._groups)
        self._groups[connection][vehicle] = (seat, first, count)
        self._commit(connection)

    def _commit(self, connection):
        group = self._groups[connection]
        if self._group_under_way[connection] or not group:
            return
        self._group_under_way[connection] = True
        batch = {}
        for vehicle in list(group)[:int(self._p.rows_per_commit)]:
            batch[vehicle] = group.pop(vehicle)
        rows = [db.Row(vehicle, seat.epoch, first, count)
                for vehicle, (seat, first, count) in sorted(
                    batch.items(), key=lambda item: item[0])]

        if self.before_commit is not None:
            fail, self.before_commit = self.before_commit, None
            fail()

        def answered(result):
            self._group_under_way[connection] = False
            for row in rows:
                self._answer_row(row, batch[row.key][0], result)
            self._commit(connection)

        self._execute(db.append(self._p, self.incarnation, rows, self._policy.fence,
                                answered))

    def _answer_row(self, row, seat, result):
        if self.seats.get(row.key) is not seat:
            return
        seat.in_flight = False
        last = row.first + row.count - 1
        if isinstance(result, db.Failed):
            self._leave(row.key, Refusal("STORE_UNAVAILABLE", self._retry()))
        elif row.key in result:
            seat.durable = last
            if seat.stream is not None:
                seat.stream.on_ack(self, last)
            self._maybe_release(row.key, seat)
        else:
            self._leave(row.key, Refusal("EPOCH_FENCED"))
