#!/usr/bin/env python3
"""What other tenants notice while one asks for all it can: how long their searches,
acknowledgements and checks take beside that, against how long they take alone.

    build/python/bin/python tests/integration/crowding.py

REVISIT_BIN names the directory of another revisitd to measure. Prints a row a
pattern and kind of work. The tenant that crowds calls from a process of its own,
at nice 19, so that it takes no processor from who is measured; who is refused
there waits as the server says (RetryInfo), or, with --at-once, not at all."""

import argparse
import collections
import contextlib
import multiprocessing
import os
import pathlib
import sys
import tempfile
import threading
import time

import grpc

from stubs import PoseGraphServiceStub, api
from test_tenants import Tenants, make_vehicle
from wire import PoseStream, decode_failure, laps

CROWD_VEHICLES = 20
OTHERS = 4
# The poses of each vehicle's history, which are a meter apart.
POSES = 6000
# Seconds between two calls of one caller of the others, and two batches.
PACE_SECONDS = 0.1
BATCH_SECONDS = 0.5
# One check falls due with each.
BATCH_POSES = 50

PATTERNS = {
    "searches": {},
    "exhaustive": {"exhaustive": True, "use_belief": False,
                   "direction": api.DIRECTION_EITHER},
    "composite": {"alignment": api.ALIGNMENT_COMPOSITE,
                  "direction": api.DIRECTION_EITHER},
}


def retry_seconds(error):
    return decode_failure(error).retry_seconds or 0.0


def crowd(port, metadata, callers, options, at_once, counts, stop):
    """Callers, each of which asks again when it is answered. Runs in a process of
    its own."""
    os.nice(19)
    answers = collections.Counter()

    def ask(number):
        channel = grpc.insecure_channel(
            f"127.0.0.1:{port}", options=[("grpc.use_local_subchannel_pool", 1)])
        stub = PoseGraphServiceStub(channel)
        request = api.FindCandidatesRequest(
            vehicle=f"vehicles/umbra-{number % CROWD_VEHICLES}",
            options=api.CandidateOptions(**options))
        while not stop.is_set():
            try:
                stub.FindCandidates(request, metadata=metadata, timeout=60)
                answers["OK"] += 1
            except grpc.RpcError as error:
                if "grpc-status-details-bin" not in dict(
                        error.trailing_metadata() or ()):
                    answers[error.code().name] += 1
                    continue
                answers[decode_failure(error).reason] += 1
                if not at_once:
                    stop.wait(retry_seconds(error))

    threads = [threading.Thread(target=ask, args=(number,), daemon=True)
               for number in range(callers)]
    for thread in threads:
        thread.start()
    stop.wait()
    counts.put(dict(answers))


class Others:
    """Callers and vehicles of another tenant, who keep their pace until they are
    stopped. Milliseconds of each kind of work, and what was refused."""

    def __init__(self, tenants):
        self.taken = collections.defaultdict(list)
        self.refused = collections.Counter()
        self._stop = threading.Event()
        self._tenants = tenants
        self._threads = []
        self._streams = []
        for number in range(OTHERS):
            self._start(self._search, tenants.calls("acme"),
                        f"vehicles/acme-{number}")
            self._begin_stream(number)

    def _start(self, target, *args):
        thread = threading.Thread(target=target, args=args, daemon=True)
        thread.start()
        self._threads.append(thread)

    def _search(self, call, vehicle):
        while not self._stop.wait(PACE_SECONDS):
            start = time.monotonic()
            try:
                call("FindCandidates",
                     api.FindCandidatesRequest(vehicle=vehicle), timeout=60)
                self._note("search", start)
            except grpc.RpcError as error:
                self.refused[decode_failure(error).reason] += 1

    def _begin_stream(self, number):
        stub, metadata = self._tenants.stub("acme")
        stream = PoseStream(stub, f"vehicles/acme-stream-{number}",
                            timeout=3600, metadata=metadata,
                            send_candidates=True)
        opened = stream.receive_kind("opened")
        self._streams.append(stream)
        sent = {}
        self._start(self._send, stream, opened.durable_sequence, sent)
        self._start(self._receive, stream, sent)

    def _send(self, stream, durable, sent):
        while not self._stop.wait(BATCH_SECONDS):
            batch = laps(BATCH_POSES, radius=100.0, first=durable + 1)
            durable += BATCH_POSES
            sent[durable] = time.monotonic()
            stream.send(batch)
        stream.half_close()

    def _receive(self, stream, sent):
        try:
            while (received := stream.receive()) is not None:
                kind, message = received
                if kind == "ack":
                    self._note("ack", sent[message.durable_sequence])
                elif kind == "candidates":
                    last = -(-message.query.sequence // BATCH_POSES
                             ) * BATCH_POSES
                    self._note("check", sent.get(last))
        except grpc.RpcError as error:
            self.refused[decode_failure(error).reason] += 1

    def _note(self, kind, start):
        if start is not None:
            self.taken[kind].append((time.monotonic() - start) * 1e3)

    def take(self):
        """What was since the last time."""
        taken, self.taken = self.taken, collections.defaultdict(list)
        refused, self.refused = self.refused, collections.Counter()
        return taken, refused

    def close(self):
        self._stop.set()
        for thread in self._threads:
            thread.join(30)


def percentile(values, share):
    values = sorted(values)
    if not values:
        return float("nan")
    return values[min(len(values) - 1, int(len(values) * share))]


def measure(tenants, others, pattern, chosen):
    alone, beside = (collections.defaultdict(list) for _ in range(2))
    refused, crowd_answers = collections.Counter(), collections.Counter()
    # Not a fork: gRPC would close the callers' connections in it.
    spawn = multiprocessing.get_context("spawn")
    for _ in range(chosen.rounds):
        others.take()
        time.sleep(chosen.seconds)
        for kind, values in others.take()[0].items():
            alone[kind] += values
        stop, counts = spawn.Event(), spawn.Queue()
        process = spawn.Process(target=crowd, args=(
            tenants.server.port, tenants.metadata("umbra"), chosen.callers,
            PATTERNS[pattern], chosen.at_once, counts, stop))
        process.start()
        # The process has to start, and the queues to fill.
        time.sleep(4)
        others.take()
        time.sleep(chosen.seconds)
        taken, failed = others.take()
        for kind, values in taken.items():
            beside[kind] += values
        refused += failed
        stop.set()
        crowd_answers.update(counts.get(timeout=60))
        process.join(10)
        process.kill()
        # The searches under way come to their end.
        time.sleep(1)
    return alone, beside, refused, crowd_answers


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--pattern", action="append", choices=sorted(PATTERNS))
    parser.add_argument("--callers", type=int, default=80)
    parser.add_argument("--seconds", type=float, default=10.0)
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--at-once", action="store_true",
                        help="who is refused comes again at once")
    parser.add_argument("--flag", action="append", default=[],
                        help="for revisitd, such as --flag=--search-threads=4")
    chosen = parser.parse_args()
    print(f"{chosen.callers} callers of one tenant; of the other, {OTHERS} "
          "callers who search and as many streams; milliseconds", flush=True)
    print(f"{'pattern':11} {'work':7} {'alone':>6} {'p50':>7} {'p99':>7}  "
          f"{'beside':>6} {'p50':>7} {'p99':>7}  {'ratio':>5}  refused",
          flush=True)
    most = 0.0
    with contextlib.ExitStack() as stack:
        directory = pathlib.Path(stack.enter_context(
            tempfile.TemporaryDirectory()))
        tenants = stack.enter_context(Tenants(directory, *chosen.flag))
        calls = {name: tenants.calls(name) for name in ("acme", "umbra")}
        drive = laps(POSES, radius=100.0)
        for number in range(CROWD_VEHICLES):
            make_vehicle(calls["umbra"], f"umbra-{number}", drive)
        for number in range(OTHERS):
            vehicle = make_vehicle(calls["acme"], f"acme-{number}", drive)
            make_vehicle(calls["acme"], f"acme-stream-{number}", drive)
            calls["acme"]("FindCandidates",
                          api.FindCandidatesRequest(vehicle=vehicle))
        others = Others(tenants)
        stack.callback(others.close)
        # The first check has more to do than the others.
        time.sleep(2)
        for pattern in chosen.pattern or PATTERNS:
            alone, beside, refused, answers = measure(
                tenants, others, pattern, chosen)
            for kind in ("search", "ack", "check"):
                before, after = alone[kind], beside[kind]
                ratio = percentile(after, 0.99) / percentile(before, 0.99)
                most = max(most, ratio)
                print(f"{pattern:11} {kind:7} {len(before):6} "
                      f"{percentile(before, 0.5):7.1f} "
                      f"{percentile(before, 0.99):7.1f}  {len(after):6} "
                      f"{percentile(after, 0.5):7.1f} "
                      f"{percentile(after, 0.99):7.1f}  {ratio:5.1f}  "
                      f"{dict(refused) if kind == 'search' else ''}",
                      flush=True)
            print(f"{'':11} the tenant that crowds: {answers}", flush=True)
    print(f"p99 beside the crowd at most {most:.1f} times as long as alone")


if __name__ == "__main__":
    sys.exit(main())
