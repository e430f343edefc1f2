"""Fuzzes sequences of calls on every method against a real revisitd.

Several connections at a time run scenarios: calls of all methods side by side,
on the same few vehicles, from several tenants, made from the descriptors:
messages that go on where the vehicle is, and others; empty ones, repeated
ones, in another order than allowed, some with values at the edges, some that
are no protobuf; half-closed, reset, given up, cut off. Rounds of some seconds
alternate between a server that asks nobody and one with tenants and small
limits; each goes on from the store of its last round.

The server must live, end with 0 when asked to (a sanitizer would not), and be
SERVING. Each call ends, with what its method answers or a status that carries
an ErrorInfo, but for what comes from the transport; never INTERNAL or UNKNOWN;
and the log holds no error but data loss that a client has made up.
"""

import argparse
import base64
import collections
import json
import pathlib
import random
import re
import selectors
import signal
import sys
import tempfile
import time

from google.protobuf.message import DecodeError
from google.rpc import error_details_pb2, status_pb2

import messages
import scenarios
from connection import Connection
from identities import AUDIENCE, ISSUER, TokenKey, key_set
from raw_http2 import call_headers
from revisit_server import BIN, Server
from stubs import ROOT, api

CONNECTIONS = 8
ROUND_SECONDS = 12
# A call that was half-closed ends, also under sanitizers on a busy machine.
END_SECONDS = 60
AWAIT_SECONDS = 2
# Bound of the search for the sequence that did it.
SHRINK_SECONDS = 120
KEPT = 4000

OK, CANCELLED, UNKNOWN, INVALID, DEADLINE = 0, 1, 2, 3, 4
EXHAUSTED, UNIMPLEMENTED, INTERNAL = 8, 12, 13
# Errors in the log that clients can bring about: a claim to know more than
# there is, and a connection that is cut before gRPC has looked at it.
HARMLESS = ['"reason":"DURABLE_SEQUENCE_REGRESSED"', "Failed getpeername"]
REASONS = {name.removeprefix("ERROR_REASON_") for name in
           api.ErrorReason.keys()}

POLICY = {
    "version": 1,
    "tenants": [{"name": "acme", "vehicle_prefix": "acme-"},
                {"name": "umbra", "vehicle_prefix": "umbra-"}],
    "grants": [
        *({"token_subject": tenant, "tenant": tenant, "vehicles": ["*"],
           "verbs": ["read", "write", "admin"]}
          for tenant in ("acme", "umbra")),
        {"token_subject": "operator", "tenant": "*", "vehicles": ["*"],
         "verbs": ["read", "write", "admin"]}]}

SMALL_LIMITS = [
    "--max-batch-poses", 24, "--max-message-bytes", 16384,
    "--max-revision-bytes", 16384, "--max-streams", 24,
    "--max-streams-per-vehicle", 4, "--max-streams-per-caller", 12,
    "--max-batches-in-flight", 2, "--max-bytes-in-flight", 4096,
    "--max-unread-bytes", 8192, "--max-pending-appends", 4,
    "--max-queued-bytes-per-vehicle", 16384, "--max-queued-bytes", 32768,
    "--max-calls", 12, "--max-searches", 3, "--max-searches-per-vehicle", 2,
    "--max-search-steps", 5000, "--slow-consumer-seconds", 0.5]


class Finding(Exception):
    """Something that must not be. `scenario` is the one in which it showed, if
    there is such a one; `dead` is whether the server died of it."""

    def __init__(self, what, scenario=None, dead=False):
        super().__init__(what)
        self.scenario, self.dead = scenario, dead


class Setup:
    """How servers are started, and who calls them."""

    def __init__(self, directory):
        self.directory = directory
        key = TokenKey("EdDSA", "ed")
        (directory / "keys.json").write_text(key_set(key))
        (directory / "policy.json").write_text(json.dumps(POLICY))
        self.tokens = {name: key.token(name, lasts=86400.0)
                       for name in ("acme", "umbra", "operator")}
        self.tokens["stranger"] = "e30.e30.e30"
        self.starts = 0

    def identities(self, tenants):
        if not tenants:
            return [""]
        return ["acme"] * 5 + ["umbra"] * 3 + ["operator", "stranger", ""]

    def start(self, tenants, store=None):
        """On a store of its own, if none is given."""
        if store is None:
            self.starts += 1
            path = self.directory / f"again-{self.starts}"
            path.mkdir()
            store = path / "store"
        flags = ["--log-level", "warning", "--log-format", "json"]
        if tenants:
            flags += [*SMALL_LIMITS,
                      "--token-keys", self.directory / "keys.json",
                      "--token-issuer", ISSUER, "--token-audience", AUDIENCE,
                      "--policy", self.directory / "policy.json"]
        return Server(store, *flags)


class Worker:
    """Runs scenarios, one after the other, on a connection of its own."""

    def __init__(self, server, setup, world, source, statistics):
        self.server, self.setup, self.world = server, setup, world
        self.source, self.statistics = source, statistics
        self.connection = None
        self.scenario = None
        self.idle = False

    def advance(self, now):
        """As far as it goes without waiting; whether it did anything."""
        moved = False
        while not self.idle:
            if self.scenario is None:
                scenario = self.source()
                if scenario is None:
                    self.idle = True
                    break
                self._begin(scenario, now)
            if not self._steps(now) or not self._over(now):
                break
            self._judge()
            self.scenario = None
            moved = True
        if self.connection is not None:
            self.connection.flush()
        return moved

    def _begin(self, scenario, now):
        self.scenario = scenario
        self.place = 0
        self.numbers = {}
        self.closed_by_us = False
        self.last_step = now
        window = scenario.receive_window
        if (self.connection is None or self.connection.closed or
                self.connection.goaway is not None or scenario.fresh or
                self.connection.receive_window != window):
            if self.connection is not None:
                self.connection.close()
            self.connection = Connection(self.server.port, window)
        self.connection.streams.clear()

    def _steps(self, now):
        """Takes steps until one has to wait; answers whether all are done."""
        connection, scenario = self.connection, self.scenario
        while self.place < len(scenario.steps):
            what, number, argument = scenario.steps[self.place]
            stream = self.numbers.get(number)
            if what == "await":
                if stream is not None and not self._has(
                        stream, argument) and not connection.closed \
                        and now < self.last_step + (
                            AWAIT_SECONDS if scenario.receive_window > 2**20
                            else 0.1):
                    return False
            elif what == "open":
                call = scenario.calls[number]
                token = self.setup.tokens.get(call.identity)
                self.numbers[number] = connection.open(call.headers(token))
                self.statistics["calls"] += 1
            elif what == "close":
                connection.flush()
                connection.close(argument)
                self.closed_by_us = True
            elif what == "raw":
                connection.put(argument)
            elif stream is not None:
                if what == "send":
                    connection.send(stream, argument)
                    self.statistics["messages"] += 1
                elif what == "half-close":
                    connection.half_close(stream)
                elif what == "reset":
                    connection.reset(stream, argument)
            self.place += 1
            self.last_step = now
        return True

    def _has(self, number, count):
        """So many answers, or the end."""
        stream = self.connection.streams[number]
        if stream.outcome is not None:
            return True
        return count is not None and len(stream.messages) >= count

    def _over(self, now):
        """Whether all calls that will end have ended."""
        scenario = self.scenario
        patience = END_SECONDS
        if scenario.receive_window < 2**31 - 1 or self._harmful():
            # What cannot be read, or said, need not end.
            patience = 0.2
        if not self.connection.closed:
            for number in self.numbers.values():
                stream = self.connection.streams[number]
                if stream.outcome is not None or not stream.ends:
                    continue
                if now < self.last_step + patience:
                    return False
                if patience == END_SECONDS:
                    raise Finding(f"a call that was half-closed has not ended "
                                  f"within {END_SECONDS} s: "
                                  f"{self._path(number)}", scenario)
        for number in self.numbers.values():
            self.connection.reset(number, 8)
        return True

    def _harmful(self):
        """Whether the transport may cut what it is sent."""
        return self.scenario.hostile or any(
            call.bad_framing for call in self.scenario.calls)

    def _path(self, number):
        by_number = {value: key for key, value in self.numbers.items()}
        return self.scenario.calls[by_number[number]].path

    def _judge(self):
        lost = []
        for number, stream_number in self.numbers.items():
            stream = self.connection.streams[stream_number]
            call = self.scenario.calls[number]
            try:
                if self._judge_call(call, stream):
                    lost.append(f"{call.path}: {stream.outcome}")
            except Finding as finding:
                raise Finding(f"{call.path}: {finding}", self.scenario) from None
        if self._harmful():
            self.connection.close()
        elif lost and not self.closed_by_us:
            raise Finding(f"calls were lost, though the connection was used as "
                          f"it should be: {lost}, GOAWAY "
                          f"{self.connection.goaway}", self.scenario)

    def _judge_call(self, call, stream):
        """Answers whether the call was lost without a status."""
        self._learn(call, stream)
        if stream.outcome == "reset by us":
            return False
        if stream.outcome != "status":
            return not call.bad_framing
        code = int(stream.headers.get(b"grpc-status", b"2"))
        self.statistics[f"status {code}"] += 1
        if code == OK:
            return False
        text = stream.headers.get(b"grpc-message", b"").decode()
        found = f"status {code} ({text})"
        details = stream.headers.get(b"grpc-status-details-bin")
        if details is None:
            if call.bad_framing or self.scenario.hostile:
                return False
            if code == EXHAUSTED and "larger than max" in text:
                return False
            # gRPC's own.
            if call.bad_message and call.path.startswith("/grpc.health."):
                return False
            if code in (DEADLINE, CANCELLED) and any(
                    name == "grpc-timeout" for name, _ in call.extra):
                return False
            if code == CANCELLED and self._was_cut_as_slow(call):
                return False
            raise Finding(f"{found} without details")
        if code in (UNKNOWN, INTERNAL):
            raise Finding(found)
        status = status_pb2.Status.FromString(_binary(details))
        if status.code != code:
            raise Finding(f"{found}, whose details say {status.code}")
        for detail in status.details:
            info = error_details_pb2.ErrorInfo()
            if detail.Unpack(info):
                if info.domain != "revisit" or info.reason not in REASONS:
                    raise Finding(f"{found} with {info}")
                self.statistics[info.reason] += 1
                self.world.learn_failure(call.vehicle_id, info)
                return False
        raise Finding(f"{found} without ErrorInfo")

    def _was_cut_as_slow(self, call):
        """An export that took nothing for twice the limit is cut where it
        stands, since no trailer would reach it; the log says why, a moment
        later."""
        until = time.monotonic() + END_SECONDS
        while call.method.server_streaming and time.monotonic() < until:
            if any("SLOW_CONSUMER" in line and call.vehicle_id in line
                   for line in self.server.log().splitlines()):
                return True
            time.sleep(0.05)
        return False

    def _learn(self, call, stream):
        answer = messages.message_class(call.method.output_type)
        for data in [*stream.messages[:2], *stream.messages[-2:]]:
            try:
                self.world.learn(call.vehicle_id, answer.FromString(data))
            except DecodeError as error:
                raise Finding(f"an answer that is none: {error}") from error
        self.statistics["answers"] += len(stream.messages)


def _binary(value):
    # What comes as it is, is told by a zero in front.
    if value[:1] == b"\0":
        return value[1:]
    return base64.b64decode(value + b"=" * (-len(value) % 4))


def drive(server, setup, world, source, statistics, until):
    """Runs scenarios from `source` until it has none, or the time is over."""
    workers = [Worker(server, setup, world, source, statistics)
               for _ in range(CONNECTIONS)]
    stopped = False
    last_word = time.monotonic()
    while not all(worker.idle for worker in workers):
        now = time.monotonic()
        if now >= until and not stopped:
            stopped = True
            for worker in workers:
                worker.source = lambda: None
        if not server.is_running():
            raise Finding("the server died", dead=True)
        moved = False
        try:
            for worker in workers:
                moved |= worker.advance(now)
        except (ConnectionError, TimeoutError) as error:
            time.sleep(0.5)
            if server.is_running():
                raise Finding(f"no connection: {error!r}") from error
            raise Finding("the server died", dead=True) from error
        except Finding:
            time.sleep(0.5)
            if not server.is_running():
                raise Finding("the server died", dead=True) from None
            raise
        if now > last_word + 1:
            last_word = now
            if sanitizer_report(server):
                raise Finding("a sanitizer reports", dead=True)
        _wait(workers, 0.0 if moved else 0.02)
    for worker in workers:
        if worker.connection is not None:
            worker.connection.close()


def _wait(workers, seconds):
    """Until something comes in, or may go out."""
    with selectors.DefaultSelector() as selector:
        for worker in workers:
            connection = worker.connection
            if connection is None or connection.closed:
                continue
            events = selectors.EVENT_READ
            if connection.outbox:
                events |= selectors.EVENT_WRITE
            selector.register(connection.socket, events, connection)
        if not selector.get_map():
            time.sleep(seconds)
            return
        for key, _ in selector.select(seconds):
            key.data.read()


def is_harmless(line):
    return any(harmless in line for harmless in HARMLESS)


def sanitizer_report(server):
    found = re.search(
        r"(ERROR: \w+Sanitizer|runtime error:|DEADLYSIGNAL)[^\n]*",
        server.log()[-200000:])
    return found and found.group(0)


def check_after(server, setup, begin):
    """What must be so at the end of each round, whose log is from `begin` on.
    """
    connection = Connection(server.port, 2**31 - 1)
    number = connection.open(call_headers(path="/grpc.health.v1.Health/Check"))
    connection.send(number, b"\0\0\0\0\0")
    connection.half_close(number)
    deadline = time.monotonic() + END_SECONDS
    stream = connection.streams[number]
    while stream.outcome is None and time.monotonic() < deadline:
        connection.flush()
        connection.read()
        time.sleep(0.01)
    connection.close()
    if stream.messages != [b"\x08\x01"]:
        raise Finding(f"Health answers {stream.messages}, {stream.outcome}, "
                      f"{stream.headers}")
    server.close_channels()
    server.process.send_signal(signal.SIGTERM)
    code = server.process.wait(END_SECONDS)
    report = sanitizer_report(server)
    if code != 0 or report:
        raise Finding(f"asked to end, the server ended with {code}; {report}",
                      dead=True)
    for line in server.log()[begin:].splitlines():
        if '"level":"error"' in line and not is_harmless(line):
            raise Finding(f"the log says {line}")


# ---- What did it


def still_kills(setup, tenants, tried, seconds):
    """Whether these scenarios, on a new store, end the server."""
    left = list(reversed(tried))
    with setup.start(tenants) as server:
        try:
            drive(server, setup, messages.World(),
                  lambda: left.pop() if left else None,
                  collections.Counter(), time.monotonic() + seconds)
            time.sleep(0.1)
        except Finding:
            pass
        dead = not server.is_running() or sanitizer_report(server)
        if not dead:
            server.process.send_signal(signal.SIGTERM)
            dead = server.process.wait(END_SECONDS) != 0
        return dead


def shrink(setup, tenants, recent):
    """The fewest scenarios, and the fewest of their steps, that still do it."""
    until = time.monotonic() + SHRINK_SECONDS

    def kills(tried):
        return time.monotonic() < until and still_kills(
            setup, tenants, tried, 5 + len(tried) / 50)

    recent = list(recent)
    count = CONNECTIONS
    # Some of it is chance: which call is first, and how far it gets.
    while not any(kills(recent[-count:]) for _ in range(4)):
        if count >= len(recent) or time.monotonic() >= until:
            return recent, False
        count *= 4
    kept = recent[-count:]
    size = max(1, len(kept) // 2)
    while True:
        at = 0
        while at < len(kept) and len(kept) > 1:
            fewer = kept[:at] + kept[at + size:]
            if fewer and kills(fewer):
                kept = fewer
            else:
                at += size
        if size == 1:
            break
        size = max(1, size // 2)
    if len(kept) > 4:
        return kept, True
    for place, scenario in enumerate(kept):
        for call in range(len(scenario.calls)):
            smaller = scenario.without(call=call)
            if kills([*kept[:place], smaller, *kept[place + 1:]]):
                kept[place] = scenario = smaller
        step = 0
        while step < len(scenario.steps):
            smaller = scenario.without(step=step)
            if kills([*kept[:place], smaller, *kept[place + 1:]]):
                kept[place] = scenario = smaller
            else:
                step += 1
    return kept, True


def show(found, log=""):
    for number, scenario in enumerate(found):
        if len(found) > 20 and number >= 20:
            print(f"... {len(found) - 20} more")
            break
        print(f"-- connection {number}")
        for line in scenario.lines():
            print("  " + line)
    if log:
        lines = [line for line in log.splitlines() if not is_harmless(line)]
        print("\n".join(lines)[-4000:])
    sys.stdout.flush()


def replay(setup, path, tenants):
    left = scenarios.load(path)
    show(left)
    dead = still_kills(setup, tenants, left, 600)
    print("the server died" if dead else "the server lived")
    return 1 if dead else 0


def run(arguments, setup):
    statistics = collections.Counter()
    stores = {}
    worlds = {}
    number = 0
    start = time.monotonic()
    end = start + arguments.seconds
    rounds = 0
    while time.monotonic() < end:
        tenants = rounds % 2 == 1
        rounds += 1
        recent = collections.deque(maxlen=KEPT)
        world = worlds.setdefault(tenants, messages.World())
        if tenants not in stores:
            stores[tenants] = setup.directory / f"round-{tenants}" / "store"
            stores[tenants].parent.mkdir()

        def source():
            nonlocal number
            number += 1
            made = scenarios.make(messages.seeded(arguments.seed, number),
                                  world, setup.identities(tenants))
            recent.append(made)
            return made

        with setup.start(tenants, stores[tenants]) as server:
            begin = len(server.log())
            try:
                drive(server, setup, world, source, statistics,
                      min(end, time.monotonic() + ROUND_SECONDS))
                check_after(server, setup, begin)
            except Finding as finding:
                seconds = time.monotonic() - start
                print(f"FOUND after {seconds:.0f} s, {statistics['calls']} "
                      f"calls: {finding}", flush=True)
                tell(arguments, setup, tenants, server, finding, recent)
                return 1
        if arguments.verbose:
            print(f"{time.monotonic() - start:.0f} s: {dict(statistics)}",
                  flush=True)
    seconds = time.monotonic() - start
    reasons = sum(1 for name in statistics if name in REASONS)
    print(f"clean: {number} scenarios, {statistics['calls']} calls, "
          f"{statistics['messages']} messages in {seconds:.0f} s "
          f"({statistics['calls'] / seconds:.0f} calls/s), {rounds} servers; "
          f"{statistics['status 0']} calls ended with OK, others for "
          f"{reasons} reasons")
    return 0


def tell(arguments, setup, tenants, server, finding, recent):
    log = server.log()
    if not finding.dead:
        found = [finding.scenario] if finding.scenario else []
        show(found, log)
    else:
        found, sure = shrink(setup, tenants, recent)
        print("the sequence that does it" if sure else
              "not found again; the last of what was sent")
        show(found, log)
    if not found:
        return
    path = ROOT / f"build/fuzz/found/sequence-{arguments.seed}.json"
    scenarios.save(path, found)
    option = " --tenants" if tenants else ""
    print(f"again: tests/fuzz/sequences/run --replay {path}{option}")


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--seed", type=int, default=None,
                        help="of all choices but for what answers tell "
                        "(default: a new one)")
    parser.add_argument("--replay", type=pathlib.Path, metavar="FILE",
                        help="run what was found, on a new store")
    parser.add_argument("--tenants", action="store_true",
                        help="with --replay: against the server with tenants")
    parser.add_argument("--verbose", action="store_true")
    arguments = parser.parse_args()
    if arguments.seed is None:
        arguments.seed = random.SystemRandom().randrange(2**32)
    print(f"seed {arguments.seed}, {BIN}", flush=True)
    with tempfile.TemporaryDirectory(prefix="revisit-sequences-") as directory:
        setup = Setup(pathlib.Path(directory))
        if arguments.replay:
            return replay(setup, arguments.replay, arguments.tenants)
        return run(arguments, setup)


if __name__ == "__main__":
    sys.exit(main())
