"""What deploy/cluster/demo does once everything is built: see its --help."""

import contextlib
import csv
import os
import pathlib
import signal
import sys
import tempfile
import threading
import time

import numpy as np

import private_cluster
import revisit

ROOT = pathlib.Path(__file__).resolve().parents[2]
DRIVE = ROOT / "tests/data/boreas/boreas_glen_shields.csv"
SERVERS = 3
GROUP = "fleet"
# How well it is known where each vehicle began: 5 m and 1 degree.
DATUM_VARIANCES = (25.0, 25.0, 3e-4)
# Poses at which vehicles are asked what another one has seen.
ASKED = (500, 1000, 1500, 2000)
# Times a second that every vehicle sends what it has.
TICKS = 10


def read_drive():
    with open(DRIVE, newline="") as file:
        rows = [{name: float(value) for name, value in row.items()}
                for row in csv.DictReader(file)]

    def column(name):
        return np.array([row[name] for row in rows])

    covariance = np.column_stack([
        column(name) for name in ("pxx", "pxy", "pxt", "pyy", "pyt", "ptt")])
    return revisit.Poses.local(
        column("est_x"), column("est_y"), column("est_yaw"), covariance,
        stamps=column("t_s"), sequence=np.arange(1, len(rows) + 1))


def answer_of(candidates):
    """What a check answered, without how long it took, without the revision, which
    counts batches, and without the vehicle's name."""
    kept = revisit.v1.CandidateSet()
    kept.CopyFrom(candidates)
    kept.ClearField("search_duration")
    kept.ClearField("revision")
    for candidate in kept.candidates:
        candidate.recording_of_match = candidate.recording_of_match.partition(
            "/recordings/")[2]
    return kept.SerializeToString(deterministic=True)


class Vehicle:
    """One vehicle that streams the drive, and what it has seen of it."""

    def __init__(self, vehicle_id, address, **security):
        self.id = vehicle_id
        self.client = revisit.Client(address, **security)
        self._lock = threading.Lock()
        self._last_ack = None
        self.longest_gap = 0.0
        self.acked = 0
        self.answers = {}
        self.errors = []
        self.client.create_vehicle(vehicle_id)
        self.stream = self.client.stream_poses(
            vehicle_id, revisit.StreamOptions(send_candidates=True),
            revisit.StreamCallbacks(
                ack=self._on_ack, candidates=self._on_candidates,
                disconnected=lambda error, _: self.errors.append(error)))

    def _on_ack(self, ack):
        now = time.monotonic()
        with self._lock:
            if self._last_ack is not None:
                self.longest_gap = max(self.longest_gap, now - self._last_ack)
            self._last_ack = now
            self.acked = ack.durable_sequence

    def _on_candidates(self, candidates):
        self.answers[candidates.query.sequence] = answer_of(candidates)

    def close(self):
        self.client.close()


def say(text):
    print(f"\n== {text}", flush=True)


def stream_through_a_kill(vehicles, drive, seconds, cluster):
    """Streams the drive as all vehicles, evenly over so many seconds, and kills the
    server that most of them are at in the middle."""
    began = time.monotonic()
    ticks = int(seconds * TICKS)
    killed = False
    for tick in range(ticks):
        time.sleep(max(0.0, began + tick / TICKS - time.monotonic()))
        rows = slice(len(drive) * tick // ticks, len(drive) * (tick + 1) // ticks)
        for vehicle in vehicles:
            vehicle.stream.append(drive[rows])
        if not killed and tick >= ticks // 2:
            print_owners(vehicles[0].client)
            calls = cluster.envoy.calls()
            victim = max(cluster.servers, key=lambda server: calls[server.address])
            victim.process.kill()
            killed = True
            print(f"after {time.monotonic() - began:.1f} s: kill -9 of "
                  f"{victim.process.name} (process {victim.process.pid}), which has "
                  f"{calls[victim.address]} of the {len(vehicles)} streams", flush=True)
    for vehicle in vehicles:
        vehicle.stream.finish()
    print(f"after {time.monotonic() - began:.1f} s: every vehicle has heard that its "
          "last pose is durable")


def check_poses(vehicles, drive):
    """How many acknowledged poses are not there, or not as they were sent."""
    sent = [pose.SerializeToString(deterministic=True) for pose in drive.to_messages()]
    lost = 0
    for vehicle in vehicles:
        stored = [pose.SerializeToString(deterministic=True)
                  for pose in vehicle.client.list_poses(vehicle.id)]
        if len(stored) != vehicle.acked:
            print(f"{vehicle.id}: {vehicle.acked} acknowledged, {len(stored)} stored")
        lost += sum(one != other for one, other in zip(sent, stored))
        lost += abs(len(sent) - len(stored))
    return lost


def check_candidates(vehicles, alone):
    """How many checks were answered otherwise than by the server that is alone, and for
    how many the answer was lost with a connection, so that both servers were asked for
    candidates at the check's pose instead."""
    def find(vehicle, sequence):
        return answer_of(vehicle.client.find_candidates(vehicle.id, sequence))

    differing = asked = 0
    for vehicle in vehicles:
        lost = alone.answers.keys() - vehicle.answers.keys()
        asked += len(lost)
        differing += sum(find(vehicle, sequence) != find(alone, sequence)
                         for sequence in lost)
        differing += sum(answer != alone.answers.get(sequence)
                         for sequence, answer in vehicle.answers.items())
    return differing, asked


def found_by(vehicle, other, sequence):
    """What a vehicle finds in the history of another one, as for any two that have
    driven the same: (answer, candidates that are accepted)."""
    found = vehicle.client.find_candidates(
        vehicle.id, sequence, group=GROUP, vehicles=[other.id], exclude_own=True)
    accepted = sum(candidate.verdict == revisit.v1.VERDICT_ACCEPTED
                   for candidate in found.candidates)
    for field in ("searched", "group_revision"):
        found.ClearField(field)
    for candidate in found.candidates:
        candidate.ClearField("matched_vehicle")
        candidate.ClearField("matched_vehicle_uid")
    return answer_of(found), accepted


def search_as_one_fleet(vehicles):
    """Makes the vehicles one group, each with a datum of its own, and has each asked
    for its places in the first one; answers how many answers there were, how many
    differ from that to the second one, and how many candidates are accepted."""
    client = vehicles[0].client
    client.create_group(GROUP)
    for vehicle in vehicles:
        client.add_group_member(GROUP, vehicle.id, revisit.datum(
            (0.0, 0.0, 0.0), np.diag(DATUM_VARIANCES)))
    answers = accepted = differing = 0
    for sequence in ASKED:
        expected = None
        for vehicle in vehicles[1:]:
            answer, count = found_by(vehicle, vehicles[0], sequence)
            expected = expected or answer
            differing += answer != expected
            accepted += count
            answers += 1
    return answers, differing, accepted


def print_vehicles(vehicles):
    cut = [vehicle for vehicle in vehicles if vehicle.errors]
    rest = [vehicle for vehicle in vehicles if not vehicle.errors]
    print(f"{'':28}vehicles  reconnects  longest time without an ack")
    for name, group in (("cut off by the kill", cut), ("others", rest)):
        if group:
            gaps = sorted(vehicle.longest_gap for vehicle in group)
            print(f"{name:28}{len(group):8}"
                  f"{sum(vehicle.stream.reconnects for vehicle in group):12}"
                  f"  {gaps[-1]:.2f} s (median of them {gaps[len(gaps) // 2]:.2f} s)")
    reasons = {}
    for vehicle in vehicles:
        for error in vehicle.errors:
            reason = f"{type(error).__name__} {error.reason}".strip()
            reasons[reason] = reasons.get(reason, 0) + 1
    for reason, count in sorted(reasons.items(), key=lambda item: -item[1]):
        print(f"  {count:4} times a stream ended with {reason}")


def print_owners(client):
    for server in sorted(client.server_info().servers,
                         key=lambda server: server.address):
        print(f"{server.address} owns {server.owned_vehicle_count} vehicles")


def start(processes):
    """A cluster, and the address of a server that is alone."""
    binaries = pathlib.Path(os.environ.get("REVISIT_BIN", ROOT / "build/release/bin"))
    cluster = private_cluster.PrivateCluster(processes, binaries, SERVERS,
                                             private_cluster.find_envoy())
    print(f"PostgreSQL: {cluster.postgres.url('revisit')} "
          f"(process {cluster.postgres.process.pid})")
    for server in cluster.servers:
        print(f"{server.process.name}: {server.address} (process {server.process.pid})")
    print(f"Envoy: {cluster.envoy.address}, TLS (process {cluster.envoy.process.pid})")
    alone = cluster.start_alone()
    print(f"For comparison, over SQLite: {alone.address} "
          f"(process {alone.process.pid})")
    return cluster, alone.address


def run(processes, vehicle_count, seconds):
    drive = read_drive()
    say("Cluster")
    cluster, address_alone = start(processes)
    with contextlib.ExitStack() as stack:
        def vehicle_of(*arguments, **security):
            return stack.enter_context(
                contextlib.closing(Vehicle(*arguments, **security)))

        say("The drive at the server that is alone")
        alone = vehicle_of("alone", address_alone)
        alone.stream.append(drive)
        alone.stream.finish()
        accepted = sum(
            candidate.verdict == revisit.v1.VERDICT_ACCEPTED
            for answer in alone.answers.values()
            for candidate in revisit.v1.CandidateSet.FromString(answer).candidates)
        print(f"{len(drive)} poses, {len(alone.answers)} checks, {accepted} candidates "
              "accepted")

        say(f"{vehicle_count} vehicles through Envoy, "
            f"{vehicle_count * len(drive) / seconds:.0f} poses a second")
        vehicles = [vehicle_of(f"vehicle-{number}", cluster.envoy.address,
                               tls_authorities=cluster.authorities)
                    for number in range(1, vehicle_count + 1)]
        stream_through_a_kill(vehicles, drive, seconds, cluster)
        print_owners(vehicles[0].client)

        say("What the vehicles noticed")
        print_vehicles(vehicles)

        say("What is there")
        sent = vehicle_count * len(drive)
        acked = sum(vehicle.acked for vehicle in vehicles)
        lost = check_poses(vehicles, drive)
        print(f"{acked} of {sent} poses acknowledged; all read back, and compared with "
              f"what was sent: {lost} lost or changed")
        differing, asked = check_candidates(vehicles, alone)
        print(f"{vehicle_count * len(alone.answers)} checks: {differing} answered "
              f"otherwise than by the server that is alone ({asked} asked for again, "
              "their answers lost with the connection)")

        say("The vehicles as one fleet")
        answers, strange, found = search_as_one_fleet(vehicles)
        print(f"each of the others asked for its places in the history of "
              f"{vehicles[0].id}, at its own server: {answers} answers, {found} "
              f"candidates accepted, {strange} answered otherwise than to the first")
        verdict = cluster.run_task("verify", "revisit").splitlines()[-1]
        print(f"revisitd verify finds the database {verdict}")
        return acked == sent and lost == differing == strange == 0 and found > 0


def main():
    vehicle_count, seconds = map(int, sys.argv[1:])
    # The end by any of these signals stops everything too.
    for number in (signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, lambda number, _: sys.exit(128 + number))
    with tempfile.TemporaryDirectory(prefix="revisit-cluster.") as directory:
        # For PostgreSQL, which is somebody else if this is root.
        os.chmod(directory, 0o711)
        with private_cluster.Processes(pathlib.Path(directory)) as processes:
            return 0 if run(processes, vehicle_count, seconds) else 1


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        sys.exit(130)
