#!/usr/bin/env python3
"""Whether two builds answer the same, to the last bit.

    same_answers.py BEFORE AFTER [DRIVE.csv ...]

BEFORE and AFTER are folders with a revisitd, such as build/release/bin of two
checkouts of one API. Each drive, or the shipped one, is streamed to both under each of
the settings below (noise models, state spaces, alignments, with and without belief,
satellite fixes); a drive without covariances gets those of the protocol of RESULTS.md.
Then some accepted candidates are confirmed, with and without a measurement, others
rejected, the path is searched again with options of all kinds, half of the poses are
revised, and the server is started again over its store. Compared are

- the candidates of each check that fell due on the stream, and of each search,
- the vehicle with its consistency, findings and counts,
- the exported graph: nodes, edges, covariances,
- what is stored of poses as they were sent, of pairs and of snapshots, byte for byte,

without times, ids that the server draws, and how long a search took. Prints a line for
each drive and setting, and for the first difference of each what it was; ends with 1
if there is any.

Needs Python 3.8 or newer, and what tests/integration/requirements.txt names.
"""

import argparse
import contextlib
import csv
import hashlib
import math
import pathlib
import re
import sqlite3
import sys
import tempfile

import grpc
import numpy as np

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests/integration"))

import revisit_server  # noqa: E402
from stubs import api  # noqa: E402
from wire import batches, get  # noqa: E402

SHIPPED = ROOT / "tests/data/boreas/boreas_glen_shields.csv"
VEHICLE = "vehicles/compared"
# As RESULTS.md claims: per square root of a metre, and at the start.
ALONG, ACROSS, HEADING = 0.1, 0.05, math.radians(0.1)
START = np.diag([0.01, 0.01, 1e-4])
SEARCH_EVERY_POSES = 200
#: The uid of a vehicle, which the server draws and with which marks begin.
UID = re.compile(rb"[0-9a-f]{8}(-[0-9a-f]{4}){3}-[0-9a-f]{12}")
CONFIRMED, REJECTED = 6, 3

DEAD_RECKONING = {"correlation_model": api.CORRELATION_MODEL_DEAD_RECKONING}
SETTINGS = {
    "defaults": {},
    "no belief": {"use_belief": False},
    "no belief, inflated": {"use_belief": False, "apply_inflation": True},
    "composite": {"alignment": api.ALIGNMENT_COMPOSITE},
    "as printed": {"alignment": api.ALIGNMENT_COMPOSITE,
                   "likelihood_form": api.LIKELIHOOD_FORM_AS_PRINTED},
    "independent": {"correlation_model": api.CORRELATION_MODEL_INDEPENDENT},
    "correlated fixes": {
        "correlation_model": api.CORRELATION_MODEL_CORRELATED_FIXES},
    "filter": {"correlation_model": api.CORRELATION_MODEL_FILTER},
    "spatial": {"state_space": api.STATE_SPACE_SPATIAL},
    "spatial, filter": {"state_space": api.STATE_SPACE_SPATIAL,
                        "correlation_model": api.CORRELATION_MODEL_FILTER},
    "nodes every 5 m": {"node_spacing_meters": 5.0,
                        "sequence_length_meters": 300.0},
}
OPTIONS = {
    "own": {},
    "either direction, paths": {"direction": api.DIRECTION_EITHER,
                                "include_aligned_path": True,
                                "max_candidates": 20},
    "exhaustive": {"exhaustive": True, "max_candidates": 20},
    "composite": {"alignment": api.ALIGNMENT_COMPOSITE},
    "independent": {"correlation_model": api.CORRELATION_MODEL_INDEPENDENT},
    "dead reckoning": DEAD_RECKONING,
    "longer, sparser": {"sequence_length_meters": 250.0,
                        "road_spacing_meters": 100.0, "use_belief": False},
}


def read(path, spatial, transitions):
    """The drive's estimate as poses."""
    poses, covariance, before = [], START, None
    with open(path, newline="") as file:
        for number, row in enumerate(csv.DictReader(file), start=1):
            x, y, heading = (float(row[name])
                             for name in ("est_x", "est_y", "est_yaw"))
            step = (0.0, 0.0) if before is None else (x - before[0], y - before[1])
            carried = np.eye(3)
            carried[0, 2], carried[1, 2] = -step[1], step[0]
            length = math.hypot(*step)
            cos, sin = math.cos(heading), math.sin(heading)
            turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
            noise = np.diag([ALONG ** 2, ACROSS ** 2, HEADING ** 2]) * length
            covariance = carried @ covariance @ carried.T + turn @ noise @ turn.T
            upper = covariance[np.triu_indices(3)]
            made = api.Pose(
                sequence=number, heading_radians=heading,
                local=api.LocalPosition(x_meters=x, y_meters=y,
                                        z_meters=0.01 * number if spatial else 0.0))
            made.stamp.FromMilliseconds(round(1000.0 * float(row["t_s"])))
            xx, xy, xh, yy, yh, hh = map(float, upper)
            if spatial:
                made.covariance.form = api.COVARIANCE_FORM_SPATIAL_10
                made.covariance.values[:] = [xx, xy, 0.0, xh, yy, 0.0, yh,
                                             0.01 + 1e-4 * number, 0.0, hh]
            else:
                made.covariance.form = api.COVARIANCE_FORM_PLANAR_6
                made.covariance.values[:] = [xx, xy, xh, yy, yh, hh]
            if transitions:
                full = carried
                if spatial:
                    full = np.eye(4)
                    full[0, 3], full[1, 3] = -step[1], step[0]
                made.error_transition[:] = list(map(float, full.ravel()))
            poses.append(made)
            before = (x, y)
    return poses


def without_times(message):
    """A copy without what differs between two runs of one build."""
    copy = type(message)()
    copy.CopyFrom(message)

    def clear(part):
        for field, value in part.ListFields():
            if field.name in ("search_duration", "create_time", "update_time",
                              "uid", "etag", "vehicle_uid", "nodes_id"):
                part.ClearField(field.name)
            elif field.message_type is not None:
                for one in [value] if hasattr(value, "ListFields") else value:
                    clear(one)

    clear(copy)
    return copy


def stored(path):
    """What the store holds of poses and snapshots, by table: how many rows, and what
    they are, joined. Batches that come together share rows, so that their number is
    no matter of the build."""
    digests = {}
    with contextlib.closing(sqlite3.connect(f"file:{path}?mode=ro", uri=True)) as store:
        tables = [name for (name,) in store.execute(
            "SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name")]
        for table in tables:
            columns = [row[1] for row in store.execute(f"PRAGMA table_info({table})")]
            if "payload" not in columns:
                continue
            digest = hashlib.sha256()
            rows = 0
            for payload, *_ in store.execute(
                    f"SELECT payload, * FROM {table} ORDER BY 2, 3"):
                digest.update(UID.sub(b"", payload) if isinstance(payload, bytes)
                              else str(payload).encode())
                rows += 1
            digests[table] = (None if table == "batches" else rows,
                              digest.hexdigest())
    return digests


class Run:
    """One build with one drive under one setting; `answers` is what is compared, as
    pairs of a name and a value."""

    def __init__(self, programs, folder, poses, settings):
        self.answers = []
        self.programs, self.folder = programs, folder
        with self.server() as server:
            stub = server.stub()
            stub.CreateVehicle(api.CreateVehicleRequest(
                vehicle_id=VEHICLE.split("/")[1], vehicle=api.Vehicle(
                    settings=api.VehicleSettings(**settings))))
            accepted = self.stream(stub, poses)
            self.judge(stub, accepted)
            self.search(stub, len(poses))
            self.revise(stub, poses)
            self.look(stub)
        with self.server() as server:
            self.search(server.stub(), len(poses), "loaded: ")
            self.look(server.stub(), "loaded: ")
        for table, digest in stored(folder / "store" / "revisit.sqlite").items():
            # The first two hold when and as whom vehicles and pairs were created, the
            # last all poses of each row of which one was revised.
            if table not in ("vehicles", "snapshots", "revised_batches"):
                self.answers.append((f"store: {table}", repr(digest)))

    @contextlib.contextmanager
    def server(self):
        revisit_server.BIN = self.programs
        with revisit_server.Server(self.folder / "store", "--snapshot-poses",
                                   "2000") as server:
            yield server

    def note(self, name, message):
        self.answers.append((name, without_times(message)))

    def stream(self, stub, poses):
        """Streams all poses; answers the pairs that were accepted."""
        def requests():
            yield api.StreamPosesRequest(open=api.StreamPosesOpen(
                vehicle=VEHICLE, send_candidates=True))
            for batch in batches(poses):
                yield api.StreamPosesRequest(batch=api.PoseBatch(poses=batch))

        accepted = []
        for response in stub.StreamPoses(requests()):
            if response.WhichOneof("message") != "candidates":
                continue
            found = response.candidates
            self.note(f"check at {found.query.sequence}", found)
            for candidate in found.candidates[:1]:
                if candidate.verdict == api.VERDICT_ACCEPTED:
                    accepted.append((found.query.sequence, candidate))
        return accepted

    def judge(self, stub, accepted):
        """Confirms some candidates, every other one as measured, and rejects some."""
        chosen = accepted[::max(1, len(accepted) // (CONFIRMED + REJECTED))]
        for number, (query, candidate) in enumerate(chosen):
            pair = dict(query_sequence=query,
                        matched_sequence=candidate.matched.sequence)
            if pair["matched_sequence"] >= query:
                continue
            if number % 3 == 2:
                stub.RejectCandidate(api.RejectCandidateRequest(
                    parent=VEHICLE, rejected_candidate_id=f"r{number}",
                    rejected_candidate=api.RejectedCandidate(**pair)))
                continue
            closure = api.LoopClosure(**pair)
            if number % 2:
                closure.measurement.x_meters = 0.25
                closure.measurement.heading_radians = 0.01
                closure.measurement.covariance.form = api.COVARIANCE_FORM_ROS_36
                closure.measurement.covariance.values[:] = list(
                    np.diag([0.04, 0.04, 0.04, 1e-4, 1e-4, 1e-4]).ravel())
            stub.AddLoopClosure(api.AddLoopClosureRequest(
                parent=VEHICLE, loop_closure_id=f"c{number}", loop_closure=closure))

    def search(self, stub, last, when=""):
        for name, options in OPTIONS.items():
            for sequence in range(SEARCH_EVERY_POSES, last + 1, SEARCH_EVERY_POSES):
                where = f"{when}{name}, search at {sequence}"
                try:
                    answer = stub.FindCandidates(api.FindCandidatesRequest(
                        vehicle=VEHICLE, sequence=sequence,
                        options=api.CandidateOptions(**options)))
                except grpc.RpcError as error:
                    self.answers.append((where, f"{error.code()} {error.details()}"))
                else:
                    self.note(where, answer.candidates)

    def revise(self, stub, poses):
        """Moves the first half of the poses by a millimetre."""
        half = poses[:len(poses) // 2]

        def requests():
            yield api.RevisePosesRequest(vehicle=VEHICLE)
            for batch in batches(half):
                moved = []
                for one in batch:
                    copy = api.Pose()
                    copy.CopyFrom(one)
                    copy.local.x_meters += 0.001
                    moved.append(copy)
                yield api.RevisePosesRequest(poses=moved)

        self.note("revision", stub.RevisePoses(requests()))

    def look(self, stub, when=""):
        self.note(when + "vehicle", get(stub, VEHICLE))
        for part in stub.ExportPoseGraph(api.ExportPoseGraphRequest(vehicle=VEHICLE)):
            self.note(when + "graph", part)


def compare(before, after):
    """The number of answers that are alike, and the first that are not."""
    alike = 0
    for (name, one), (other_name, other) in zip(before, after):
        if name != other_name or one != other:
            return alike, (name, one, other_name, other)
        alike += 1
    if len(before) != len(after):
        return alike, ("count", len(before), "count", len(after))
    return alike, None


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=pathlib.Path)
    parser.add_argument("after", type=pathlib.Path)
    parser.add_argument("drives", type=pathlib.Path, nargs="*", default=[SHIPPED])
    options = parser.parse_args()
    differences = 0
    for drive in options.drives:
        for name, settings in SETTINGS.items():
            poses = read(
                drive,
                settings.get("state_space") == api.STATE_SPACE_SPATIAL,
                settings.get("correlation_model") == api.CORRELATION_MODEL_FILTER)
            runs = []
            for programs in (options.before, options.after):
                with tempfile.TemporaryDirectory() as folder:
                    runs.append(Run(programs.resolve(), pathlib.Path(folder), poses,
                                    settings).answers)
            alike, difference = compare(*runs)
            candidates = sum(len(answer.candidates) for _, answer in runs[0][:alike]
                             if hasattr(answer, "candidates"))
            print(f"{drive.stem}, {name}: {alike} answers with {candidates} candidates "
                  "are the same"
                  + (", then there is a difference" if difference else ""), flush=True)
            if difference:
                differences += 1
                print("  before, {}:\n{}\n  after, {}:\n{}".format(*difference))
    sys.exit(1 if differences else 0)


if __name__ == "__main__":
    main()
