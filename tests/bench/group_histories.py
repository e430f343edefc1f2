"""What a server keeps and does for searches in a group whose other vehicles it has only
in its store: time until their histories are there, memory, searches, and looks at what
has changed. Prints one table; ends by itself; leaves nothing behind.

All vehicles have driven the same streets at a site, ten to a site: each placed there by
a datum, or all by fixes. Then what acknowledgements of members wait for while another
vehicle searches, in its own history and in the group."""

import argparse
import math
import os
import pathlib
import shutil
import statistics
import tempfile
import threading
import time

import grpc

import fleet
from fleet import api, in_parallel, mebibytes, milliseconds, row, seconds_of

PARENT = "groups/all"
VEHICLES_A_SITE = 10
SITE_METERS = 3000.0
ROUNDS = 50
# Where the first site is, and metres a degree of latitude.
LATITUDE, LONGITUDE = 48.0, 11.0
METERS_A_DEGREE = 111320.0
# Vehicles that send beside searches, how often a second, and how long.
SENDERS = 4
SENDS_A_SECOND = 10
POSES_A_SEND = 64
SEARCHES_A_SECOND = 10
BESIDE_SECONDS = 15
BESIDE_ROUNDS = 3


def site_of(number):
    """Where vehicles are, east of the first site: the earth is wide enough."""
    return SITE_METERS * (number // VEHICLES_A_SITE)


def with_fixes(poses, meters, east):
    """A batch of fleet.batches() whose positions are fixes with such errors."""
    request = api.AppendPosesRequest.FromString(poses)
    for pose in request.poses:
        x, y = pose.local.x_meters + east, pose.local.y_meters
        pose.geodetic.latitude_degrees = LATITUDE + y / METERS_A_DEGREE
        pose.geodetic.longitude_degrees = LONGITUDE + x / (
            METERS_A_DEGREE * math.cos(math.radians(LATITUDE)))
        pose.covariance.values[:] = (meters ** 2, 0, 0, meters ** 2, 0, 3e-4)
    return request.SerializeToString()


class Group:
    def __init__(self, server):
        self.server = server
        self.client = fleet.Client(server)

    def create(self, name, fixes):
        settings = api.VehicleSettings(
            correlation_model=api.CORRELATION_MODEL_INDEPENDENT,
            coordinate_frame=api.COORDINATE_FRAME_GEODETIC
        ) if fixes else api.VehicleSettings()
        self.client.stub.CreateVehicle(api.CreateVehicleRequest(
            vehicle_id=name, vehicle=api.Vehicle(settings=settings)))

    def make(self, names, fixes):
        self.client.stub.CreateGroup(api.CreateGroupRequest(group_id="all"))
        for k, name in enumerate(names):
            member = api.GroupMember(vehicle=f"vehicles/{name}")
            if not fixes:
                member.datum.pose.x_meters = site_of(k)
                member.datum.covariance.form = api.COVARIANCE_FORM_PLANAR_6
                member.datum.covariance.values.extend((100, 0, 0, 100, 0, 3e-4))
            self.client.stub.AddGroupMember(
                api.AddGroupMemberRequest(parent=PARENT, member=member))

    def find(self, vehicle, group=True):
        options = api.CandidateOptions()
        if group:
            options.scope.group = PARENT
            options.scope.exclude_own = True
        return self.client.stub.FindCandidates(api.FindCandidatesRequest(
            vehicle=f"vehicles/{vehicle}", options=options)).candidates

    def await_histories(self, vehicle):
        """Seconds until a search has them all."""
        start = time.perf_counter()
        while True:
            try:
                self.find(vehicle)
                return time.perf_counter() - start
            except grpc.RpcError as error:
                if error.code() != grpc.StatusCode.UNAVAILABLE:
                    raise
            time.sleep(0.05)

    def processor_seconds(self):
        fields = pathlib.Path(
            f"/proc/{self.server.process.pid}/stat").read_text().split(") ")[1].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def quantiles(seconds):
    cuts = statistics.quantiles(seconds, n=100)
    return milliseconds(statistics.median(seconds)), milliseconds(cuts[98])


class Senders:
    """Members that append poses, each at an even rate; seconds that each call takes."""

    def __init__(self, group, names, nodes, fixes):
        self.group = group
        self.names = names
        self.fixes = fixes
        # They drive on along a line, which is nowhere near the sites.
        self.next = {name: nodes + 1 for name in names}

    def batch(self, name):
        request = api.AppendPosesRequest()
        for sequence in range(self.next[name], self.next[name] + POSES_A_SEND):
            pose = request.poses.add(sequence=sequence, heading_radians=0.0)
            north = -1e4 * (1 + self.names.index(name))
            if self.fixes:
                pose.geodetic.latitude_degrees = LATITUDE + north / METERS_A_DEGREE
                pose.geodetic.longitude_degrees = LONGITUDE + 2e-5 * sequence
                values = (self.fixes ** 2, 0, 0, self.fixes ** 2, 0, 3e-4)
            else:
                pose.local.x_meters, pose.local.y_meters = 2.0 * sequence, north
                values = (1e4, 0, 0, 1e4, 0, 1.0)
            pose.covariance.form = api.COVARIANCE_FORM_PLANAR_6
            pose.covariance.values.extend(values)
        self.next[name] += POSES_A_SEND
        return request.SerializeToString()

    def send(self, seconds):
        taken = []

        def run(name):
            start = time.perf_counter()
            for k in range(int(seconds * SENDS_A_SECOND)):
                poses = self.batch(name)
                due = start + k / SENDS_A_SECOND
                time.sleep(max(0.0, due - time.perf_counter()))
                taken.append(seconds_of(self.group.client.append, name, poses))

        in_parallel(run, self.names)
        return taken


def acknowledged_beside(group, senders, asking, in_group):
    """Seconds of the senders' calls while another vehicle searches."""
    over = threading.Event()

    def search():
        due = time.perf_counter()
        while not over.is_set():
            group.find(asking, in_group)
            due += 1.0 / SEARCHES_A_SECOND
            time.sleep(max(0.0, due - time.perf_counter()))

    searcher = threading.Thread(target=search)
    searcher.start()
    try:
        return senders.send(BESIDE_SECONDS)
    finally:
        over.set()
        searcher.join()


def measure_acks(group, names, asking, nodes, fixes):
    members = [name for name in names if name != asking][-SENDERS:]
    senders = Senders(group, members, nodes, fixes)
    senders.send(1)
    taken = {False: [], True: []}
    for number in range(2 * BESIDE_ROUNDS):
        # In turn, and the other one first in every second round.
        in_group = (number + number // 2) % 2 == 1
        taken[in_group] += acknowledged_beside(group, senders, asking, in_group)
    for in_group, where in ((False, "its own history"), (True, "the group")):
        row(f"acks of {SENDERS} members beside {SEARCHES_A_SECOND} searches a second "
            f"in {where}: p50, p99", *quantiles(taken[in_group]))


def measure(stores, vehicles, nodes, fixes):
    names = [f"v{i:05}" for i in range(vehicles)]
    parts = list(fleet.batches(nodes))
    with stores.server("group") as server:
        group = Group(server)

        for first in range(0, vehicles, VEHICLES_A_SITE):
            here = parts if not fixes else [
                with_fixes(poses, fixes, site_of(first)) for poses in parts]

            def fill(name, here=here):
                group.create(name, fixes)
                for poses in here:
                    group.client.append(name, poses)

            in_parallel(fill, names[first:first + VEHICLES_A_SITE])
        group.make(names, fixes)
    print(f"\n{vehicles} vehicles of {nodes} nodes, {VEHICLES_A_SITE} to a site, by "
          + (f"fixes of {fixes} m" if fixes else "datums of 10 m and 1 degree"))
    asking = names[vehicles // 2]
    with stores.server("group", "--group-memory-mebibytes", 1 << 16) as server:
        group = Group(server)
        group.client.touch(asking)
        empty = fleet.settled_memory(group.client)
        used = group.processor_seconds()
        row("histories are there after, processor",
            f"{group.await_histories(asking):.1f} s",
            f"{group.processor_seconds() - used:.1f} s")
        grown = fleet.settled_memory(group.client) - empty
        row("resident memory for them: all, a node", mebibytes(grown),
            f"{grown / ((vehicles - 1) * nodes):.1f} B")
        own = [seconds_of(group.find, asking, False) for _ in range(ROUNDS)]
        row("a search of the own history: p50, p99", *quantiles(own))
        found = [seconds_of(group.find, asking) for _ in range(ROUNDS)]
        row("a search of all others: p50, p99", *quantiles(found))
        answer = group.find(asking)
        row("  nodes considered, pruned", f"{answer.nodes_considered}",
            f"{answer.nodes_pruned}")
        # Longer apart than a look at the store lasts.
        paused = []
        used = group.processor_seconds()
        for _ in range(10):
            time.sleep(1.5)
            paused.append(seconds_of(group.find, asking))
        row("  that also looks at the store: p50, most",
            milliseconds(statistics.median(paused)), milliseconds(max(paused)))
        row("  processor of each",
            milliseconds((group.processor_seconds() - used) / 10))
        measure_acks(group, names, asking, nodes, fixes)
    shutil.rmtree(stores.directory / "group")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vehicles", type=int, default=1000)
    parser.add_argument("--nodes", type=int, default=10000)
    parser.add_argument("--fixes", type=float, default=0.0, metavar="METERS",
                        help="standard deviation of fixes that place the vehicles, "
                        "instead of datums")
    parser.add_argument("--directory", help="where to put the store; it takes some "
                        "3 GiB at the default sizes")
    arguments = parser.parse_args()
    directory = tempfile.mkdtemp(prefix="revisit-group-", dir=arguments.directory)
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, "
          f"{time.strftime('%Y-%m-%d')}")
    try:
        measure(fleet.Stores(directory), arguments.vehicles, arguments.nodes,
                arguments.fixes)
    finally:
        shutil.rmtree(directory, ignore_errors=True)


if __name__ == "__main__":
    main()
