"""What a server keeps and does for searches in a group whose other vehicles it has only
in its store: time until their histories are there, memory, searches, and looks at what
has changed. Prints one table; ends by itself; leaves nothing behind.

All vehicles have driven the same streets, each placed by a datum at a site of its own,
ten to a site."""

import argparse
import os
import pathlib
import shutil
import statistics
import tempfile
import time

import grpc

import fleet
from fleet import api, in_parallel, mebibytes, milliseconds, row, seconds_of

PARENT = "groups/all"
VEHICLES_A_SITE = 10
SITE_METERS = 3000.0
ROUNDS = 50


class Group:
    def __init__(self, server):
        self.server = server
        self.client = fleet.Client(server)

    def make(self, names):
        self.client.stub.CreateGroup(api.CreateGroupRequest(group_id="all"))
        for k, name in enumerate(names):
            member = api.GroupMember(vehicle=f"vehicles/{name}")
            member.datum.pose.x_meters = SITE_METERS * (k // VEHICLES_A_SITE)
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


def measure(stores, vehicles, nodes):
    names = [f"v{i:05}" for i in range(vehicles)]
    parts = list(fleet.batches(nodes))
    with stores.server("group") as server:
        group = Group(server)

        def fill(name):
            group.client.create(name)
            for poses in parts:
                group.client.append(name, poses)

        in_parallel(fill, names)
        group.make(names)
    print(f"\n{vehicles} vehicles of {nodes} nodes, {VEHICLES_A_SITE} to a site")
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
    shutil.rmtree(stores.directory / "group")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--vehicles", type=int, default=1000)
    parser.add_argument("--nodes", type=int, default=10000)
    parser.add_argument("--directory", help="where to put the store; it takes some "
                        "3 GiB at the default sizes")
    arguments = parser.parse_args()
    directory = tempfile.mkdtemp(prefix="revisit-group-", dir=arguments.directory)
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, "
          f"{time.strftime('%Y-%m-%d')}")
    try:
        measure(fleet.Stores(directory), arguments.vehicles, arguments.nodes)
    finally:
        shutil.rmtree(directory, ignore_errors=True)


if __name__ == "__main__":
    main()
