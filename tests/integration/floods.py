#!/usr/bin/env python3
"""Floods of strangers on revisitd itself, run after run: what they take of its
memory, and what honest callers notice meanwhile and afterwards.

    build/python/bin/python tests/integration/floods.py --runs 200

Prints a line a run, and then a table: of each pattern the most memory of its runs,
and what the calls of all of them took. Honest callers bring a token: one on a
connection that has been let in, and one that connects anew for each call. The
flood comes from a process of its own, at nice 19, so that it takes no processor
from who is measured."""

import argparse
import contextlib
import json
import multiprocessing
import os
import pathlib
import ssl
import statistics
import sys
import tempfile
import threading
import time

import grpc

import attacks
from identities import (AUDIENCE, ISSUER, Authority, TokenKey, bearer, key_set,
                        replace)
from raw_http2 import RawConnection
from revisit_server import Server
from stubs import PoseGraphServiceStub, api

# Seconds of quiet before a flood, and after it until all has to be given back.
QUIET_SECONDS = 1.0
AFTER_SECONDS = 5.0
CALL_SECONDS = 30.0
CONNECTIONS = (64, 1, 8, 32, 2, 16, 3, 40, 5, 4)
# What is left that nobody waits for.
GIVEN_BACK_BYTES = 8e6


class Target:
    """A server that asks for tokens, by TLS or not, and its honest callers."""

    def __init__(self, directory, tls, *flags):
        self.key = TokenKey("ES256", "key")
        self.certificate = None
        files = []
        if tls:
            self.authority = Authority()
            issued = self.authority.issue_for_server()
            files = ["--tls-cert", replace(directory / "tls.pem", issued.pem),
                     "--tls-key", replace(directory / "tls.key",
                                          issued.key_pem)]
            self.certificate = self.authority.pem
        policy = replace(directory / "policy.json", json.dumps({
            "version": 1,
            "tenants": [{"name": "acme", "vehicle_prefix": "acme-"}],
            "grants": [{"token_subject": "acme", "tenant": "acme",
                        "vehicles": ["*"], "verbs": ["read"]}]}))
        self.server = Server(
            directory / "store", "--log-level=warning", "--policy", policy,
            "--token-keys", replace(directory / "keys", key_set(self.key)),
            "--token-issuer", ISSUER, "--token-audience", AUDIENCE, *files,
            *flags)
        self.metadata = bearer(self.key.token("acme"))

    def channel(self):
        address = f"127.0.0.1:{self.server.port}"
        options = [("grpc.use_local_subchannel_pool", 1)]
        if self.certificate is None:
            return grpc.insecure_channel(address, options=options)
        return grpc.secure_channel(
            address, grpc.ssl_channel_credentials(self.certificate),
            options=options)

    def ask(self, channel):
        """Seconds that a call takes."""
        start = time.monotonic()
        PoseGraphServiceStub(channel).GetServerInfo(
            api.GetServerInfoRequest(), timeout=CALL_SECONDS,
            metadata=self.metadata)
        return time.monotonic() - start


class Callers:
    """Two honest callers until they are stopped: seconds of each call, None for
    one that failed."""

    def __init__(self, target):
        self.target = target
        self.known, self.new = [], []
        self._stop = threading.Event()
        self._channel = target.channel()
        target.ask(self._channel)
        self._threads = [threading.Thread(target=self._call_known),
                         threading.Thread(target=self._call_new)]
        for thread in self._threads:
            thread.start()

    def _call_known(self):
        while not self._stop.wait(0.005):
            self.known.append(self._seconds(self._channel))

    def _call_new(self):
        while not self._stop.wait(0.02):
            start = time.monotonic()
            with self.target.channel() as channel:
                answer = self._seconds(channel)
            self.new.append(answer and time.monotonic() - start)

    def _seconds(self, channel):
        try:
            return self.target.ask(channel)
        except grpc.RpcError as error:
            print(f"failed: {error.code().name} {error.details()}", flush=True)
            return None

    def take(self):
        """The calls since the last time: known, new."""
        known, self.known = self.known, []
        new, self.new = self.new, []
        return known, new

    def close(self):
        self._stop.set()
        for thread in self._threads:
            thread.join()
        self._channel.close()


def flood(attack, port, tls, connections, seconds):
    """Runs in a process of its own."""
    os.nice(19)
    attacks.SECONDS = seconds
    context = None
    if tls:
        context = ssl.create_default_context()
        context.check_hostname = False
        context.verify_mode = ssl.CERT_NONE
        context.set_alpn_protocols(["h2"])
    attacks.run(attacks.ATTACKS[attack],
                lambda **more: RawConnection(port, tls=context, **more),
                connections)


def percentiles(calls):
    """Milliseconds: median, 99th percentile; and failed calls."""
    answered = sorted(one * 1e3 for one in calls if one is not None)
    failed = len(calls) - len(answered)
    if not answered:
        return float("inf"), float("inf"), failed
    return (statistics.median(answered),
            answered[min(len(answered) - 1, int(len(answered) * 0.99))],
            failed)


def one_run(target, flooded, attack, connections, seconds, tls):
    pid = flooded.pid
    callers = Callers(target)
    try:
        time.sleep(QUIET_SECONDS)
        before = callers.take()
        with attacks.Watcher(pid) as watcher:
            # Not a fork: gRPC would close the callers' connections in it.
            attacker = multiprocessing.get_context("spawn").Process(
                target=flood, args=(attack, flooded.port, tls,
                                    connections, seconds))
            attacker.start()
            attacker.join(3 * seconds + 60)
            during = callers.take()
            attacker.kill()
            end = time.monotonic() + AFTER_SECONDS
            left = watcher.most[0]
            # Some calls come after it in any case.
            time.sleep(QUIET_SECONDS)
            while left > GIVEN_BACK_BYTES and time.monotonic() < end:
                time.sleep(0.1)
                left = min(left, attacks.resident_bytes(pid) -
                           watcher.before[0])
            after = callers.take()
        assert flooded.is_running(), flooded.log()
    finally:
        callers.close()
    return {"attack": attack, "connections": connections,
            "most": watcher.most[0] / 1e6, "left": left / 1e6,
            "calls": (before, during, after)}


def line_of(run):
    def both(calls):
        return " ".join(f"{median:8.1f} {p99:8.1f} {failed:3d}"
                        for median, p99, failed in calls)
    return (f"{run['attack']:22} {run['connections']:4d} "
            f"{run['most']:7.0f} {run['left']:6.0f}  " +
            "  ".join(both([percentiles(calls) for calls in when])
                      for when in run["calls"]))


def row_of(attack, runs):
    """The runs of an attack as a row of a table in Markdown."""
    alone = [run["most"] for run in runs if run["connections"] == 1]
    cells = [attack, str(len(runs)),
             f"{max(alone):.0f}" if alone else "",
             f"{max(run['most'] for run in runs):.0f}",
             f"{max(run['left'] for run in runs):.0f}"]
    failed = 0
    for caller in range(2):
        whens = []
        for when in range(3):
            median, p99, failures = percentiles(
                [call for run in runs for call in run["calls"][when][caller]])
            whens.append(f"{median:.1f}, {p99:.1f}")
            failed += failures
        cells += whens
    return "| " + " | ".join(cells + [str(failed)]) + " |"


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--runs", type=int, default=len(attacks.ATTACKS))
    parser.add_argument("--attack", action="append",
                        choices=sorted(attacks.ATTACKS))
    parser.add_argument("--connections", type=int,
                        help="instead of 64, 1, 8 and others in turn")
    parser.add_argument("--seconds", type=float, default=2.0)
    parser.add_argument("--elsewhere", action="store_true",
                        help="flood another server: what honest callers notice of "
                        "the machine that\nthey share with who floods")
    parser.add_argument("--tls", action="store_true")
    chosen = parser.parse_args()
    names = chosen.attack or sorted(attacks.ATTACKS)
    print(f"MB at most and left {AFTER_SECONDS:.0f} s after; "
          "ms median, p99 and failed calls of the caller let in, and of one who "
          "connects for each call: before, during, after", flush=True)
    runs_of = {}
    for i in range(chosen.runs):
        attack = names[i % len(names)]
        connections = (chosen.connections or
                       CONNECTIONS[i // len(names) % len(CONNECTIONS)])
        with contextlib.ExitStack() as stack:
            directory = pathlib.Path(stack.enter_context(
                tempfile.TemporaryDirectory()))
            target = Target(directory, chosen.tls)
            stack.callback(target.server.close)
            flooded = target
            if chosen.elsewhere:
                other = directory / "other"
                other.mkdir()
                flooded = Target(other, chosen.tls)
                stack.callback(flooded.server.close)
            run = one_run(target, flooded.server, attack, connections,
                          chosen.seconds, chosen.tls)
        print(line_of(run), flush=True)
        runs_of.setdefault(attack, []).append(run)
    print("\nMB at most and left after "
          f"{AFTER_SECONDS:.0f} s, the worst of the runs; ms median and p99 of "
          "all calls\n\n"
          "| flood | runs | MB of one connection | MB | MB left | "
          "let in: before | during | after | new: before | during | after | "
          "failed calls |\n" + "|---" * 12 + "|")
    for attack, runs in runs_of.items():
        print(row_of(attack, runs))
    every = [run for runs in runs_of.values() for run in runs]
    print(row_of("all", every))
    return 0


if __name__ == "__main__":
    sys.exit(main())
