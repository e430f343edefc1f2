"""One fault of each kind, in the simulation and against real servers over a real
PostgreSQL behind a real Envoy, with the real client: vehicles wait about as long.

That is judged in seconds, for seconds are what the simulation says. Its seeds give the
shortest and the longest time that chance makes of a fault; the real one has to lie
between, with a margin for a machine that is busy."""

import contextlib
import dataclasses
import os
import pathlib
import signal
import subprocess
import sys
import threading
import time

import pytest

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[1] / "integration"))

import cluster
import parameters
from envoy_proxy import ENVOY, directory_of_cluster, skip_without_envoy
from own_postgres import exit_without_postgres, private_cluster
from revisit_server import BIN, clean_environment, is_crowded, wait_until

SERVERS = 3
VEHICLES = 12
# Seconds between two poses of a vehicle, each of which is a message.
EVERY = 0.1
SEEDS = range(1, 21)
# The longest gap of a simulated run may be so many seconds longer on a busy machine,
# and by this share; or shorter, where the dice fell otherwise than for any seed.
LATE_SECONDS, EARLY_SECONDS, SHARE = 2.0, 1.0, 0.15
# The same on a machine with long queues at its processors, which the simulation does
# not have.
CROWDED_SECONDS = 10.0


@pytest.fixture(scope="module", autouse=True)
def needs():
    skip_without_envoy()
    exit_without_postgres()


class Fleet:
    """Vehicles that stream by `revisit stream`, and when each had something new in the
    store."""

    def __init__(self, running, directory):
        self._postgres = running.postgres
        self._stop = threading.Event()
        # Lines that were written, of every vehicle; each is a pose.
        self._lines = 0
        self._stored = {}
        self._last = {}
        self.longest = {}
        self._streams = []
        for i in range(VEHICLES):
            with open(directory / f"vehicle-{i}.log", "wb") as log:
                self._streams.append(subprocess.Popen(
                    [BIN / "revisit", "stream", "-", "--create",
                     "--vehicle", f"vehicle-{i}", "--server", running.envoy.address,
                     "--tls-ca", running.authorities],
                    stdin=subprocess.PIPE, stdout=log, stderr=log, text=True,
                    env=clean_environment()))
        self._threads = [threading.Thread(target=self._drive),
                         threading.Thread(target=self._watch)]
        for thread in self._threads:
            thread.start()

    def _drive(self):
        """The same straight drive for all, each a little later than the one before."""
        header = "t_s,est_x,est_y,est_yaw\n"
        begun = time.monotonic()
        while not self._stop.is_set():
            line = self._lines
            for i, stream in enumerate(self._streams):
                at = begun + EVERY * (line + i / VEHICLES)
                time.sleep(max(0.0, at - time.monotonic()))
                text = f"{EVERY * line:.3f},{line},0,0\n"
                stream.stdin.write(text if line else header + text)
                stream.stdin.flush()
            self._lines += 1

    def _watch(self):
        while not self._stop.wait(0.02):
            try:
                rows = self._postgres.ask(
                    "SELECT v.id, h.durable_sequence FROM vehicles v "
                    "JOIN heads h USING (key)")
            except RuntimeError:
                continue
            now = time.monotonic()
            for vehicle, sequence in (row.split("|") for row in rows.splitlines()):
                if self._stored.get(vehicle) != int(sequence):
                    self.longest[vehicle] = max(
                        self.longest.get(vehicle, 0.0),
                        now - self._last.get(vehicle, now))
                    self._last[vehicle] = now
                    self._stored[vehicle] = int(sequence)

    def wait_until_all_go_on(self, seconds=60.0):
        """Until each vehicle has stored a pose that nobody has sent yet: what a server
        took before it was killed may be stored, or seen, after that."""
        # Sequences count from 1, and the line of this number may be on its way.
        unsent = self._lines + 2
        wait_until(lambda: len(self._stored) == VEHICLES and
                   min(self._stored.values()) >= unsent, "progress of all vehicles",
                   seconds)

    def begin(self):
        """What came before does not count."""
        self.longest.clear()

    def close(self):
        self._stop.set()
        for thread in self._threads:
            thread.join()
        for stream in self._streams:
            with contextlib.suppress(BrokenPipeError):
                stream.stdin.close()
            stream.kill()
            stream.wait()


@dataclasses.dataclass
class Fault:
    # Harms the real cluster, given the server that has most streams.
    really: callable
    # Harms the simulated cell and its first server.
    simulated: callable
    figures: dict = dataclasses.field(default_factory=dict)


def hang(_, server):
    os.kill(server.process.pid, signal.SIGSTOP)
    time.sleep(HANG_SECONDS)
    os.kill(server.process.pid, signal.SIGCONT)


def restart_postgres(running, _):
    running.postgres.process.stop()
    time.sleep(OUTAGE_SECONDS)
    running.postgres.start()


HANG_SECONDS = 25.0
OUTAGE_SECONDS = 3.0
FAULTS = {
    "killed": Fault(lambda _, server: server.process.kill(),
                    lambda cell: cell.kill(cell.servers[0])),
    "terminated": Fault(lambda _, server: server.process.stop(),
                        lambda cell: cell.servers[0].drain(lambda: None),
                        {"drain_notice_s": 0.0}),
    "hangs": Fault(hang, lambda cell: cell.freeze(cell.servers[0], HANG_SECONDS)),
    "database away": Fault(restart_postgres,
                           lambda cell: cell.fail_over(OUTAGE_SECONDS)),
}


def simulated_gap(fault, seed):
    cell = cluster.Cluster(cluster.Setup(
        seed=seed, servers=SERVERS, streams_per_server=VEHICLES // SERVERS,
        message_s=EVERY, history_days=0.001,
        parameters=dataclasses.replace(parameters.Parameters(), **fault.figures)))
    # Other times than those of beats and probes, which all begin together.
    cell.run(12.0 + cell.parameters.beat_s * cell.kernel.random.random())
    fault.simulated(cell)
    cell.run(60.0)
    assert cell.waiting() == 0
    return cell.gaps()[-1]


def real_gap(fault):
    with directory_of_cluster() as directory, \
            private_cluster.Processes(directory) as processes:
        running = private_cluster.PrivateCluster(processes, BIN, SERVERS, ENVOY)
        with contextlib.closing(Fleet(running, directory)) as fleet:
            fleet.wait_until_all_go_on()
            # Servers may ask each other for vehicles at first.
            time.sleep(4.0)
            fleet.begin()
            calls = running.envoy.calls()
            fault.really(running, max(running.servers,
                                      key=lambda server: calls[server.address]))
            fleet.wait_until_all_go_on()
            time.sleep(2.0)
            return max(fleet.longest.values())


@pytest.mark.parametrize("name", FAULTS)
def test_vehicles_wait_as_long_as_simulated_where_a_server_or_the_database_is(name):
    gaps = [simulated_gap(FAULTS[name], seed) for seed in SEEDS]
    gap = real_gap(FAULTS[name])
    print(f"{name}: {gap:.1f} s, simulated {min(gaps):.1f} to {max(gaps):.1f} s")
    assert (1.0 - SHARE) * min(gaps) - EARLY_SECONDS <= gap
    late = CROWDED_SECONDS if is_crowded() else LATE_SECONDS
    assert gap <= (1.0 + SHARE) * max(gaps) + late
