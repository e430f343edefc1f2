"""Memory, start-up and loading of a real revisitd with many vehicles and with one
that is very long. Prints one table; ends by itself; leaves nothing behind.

Bytes a node are growth of the process's resident memory over the nodes that came
to be in memory, everything the server keeps for them included."""

import argparse
import math
import os
import pathlib
import random
import shutil
import sqlite3
import statistics
import sys
import tempfile
import threading
import time

ROOT = pathlib.Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "tests/integration"))

import grpc  # noqa: E402
from google.protobuf import timestamp_pb2  # noqa: E402

import revisit_server  # noqa: E402
from revisit_server import processor_seconds  # noqa: E402
from stubs import api  # noqa: E402

revisit_server.START_SECONDS = 300
SPACING = 2.0
# Most poses of a batch.
BATCH = 4096
SECONDS = 1600000000
# The default of --snapshot-poses.
SNAPSHOT_POSES = 20000
MODELS = (("INDEPENDENT", api.CORRELATION_MODEL_INDEPENDENT),
          ("DEAD_RECKONING", api.CORRELATION_MODEL_DEAD_RECKONING),
          ("FILTER", api.CORRELATION_MODEL_FILTER))
SPACES = (("PLANAR", api.STATE_SPACE_PLANAR),
          ("SPATIAL", api.STATE_SPACE_SPATIAL))


def town(count, seed):
    """Positions along streets of 100 m blocks, a node spacing and a bit apart."""
    draw = random.Random(seed)
    side = max(3, int(math.sqrt(count * SPACING / 400.0)))
    # A hair over the spacing, so that every pose brings a node.
    step = SPACING * 1.0001
    at_x, at_y, way = 0, 0, 0
    x, y = 0.0, 0.0
    made = 0
    while made < count:
        turns = [way, way, (way + 1) % 4, (way + 3) % 4]
        while True:
            way = draw.choice(turns)
            to_x = at_x + (1, 0, -1, 0)[way]
            to_y = at_y + (0, 1, 0, -1)[way]
            if 0 <= to_x < side and 0 <= to_y < side:
                break
            turns = [0, 1, 2, 3]
        at_x, at_y = to_x, to_y
        target_x = 100.0 * at_x + draw.uniform(-25.0, 25.0)
        target_y = 100.0 * at_y + draw.uniform(-25.0, 25.0)
        length = math.hypot(target_x - x, target_y - y)
        heading = math.atan2(target_y - y, target_x - x)
        for _ in range(int(length / step)):
            x += step * math.cos(heading)
            y += step * math.sin(heading)
            yield x, y, heading
            made += 1
            if made == count:
                return


def batches(count, space=api.STATE_SPACE_PLANAR,
            model=api.CORRELATION_MODEL_DEAD_RECKONING, seed=1):
    """The field `poses` of AppendPosesRequest, as bytes, batch by batch: nothing
    in it depends on the vehicle."""
    draw = random.Random(seed + 1)
    planar = space == api.STATE_SPACE_PLANAR
    form = (api.COVARIANCE_FORM_PLANAR_6 if planar
            else api.COVARIANCE_FORM_SPATIAL_10)
    request = api.AppendPosesRequest()
    origin = None
    before = None
    for sequence, (x, y, heading) in enumerate(town(count, seed), 1):
        origin = origin or (x, y)
        variance = 0.01 + 1e-4 * sequence
        far_x, far_y = x - origin[0], y - origin[1]
        hh = 1e-4 + 1e-8 * sequence
        # Heading errors swing the position about the start.
        xx, xy, xh = variance + far_y ** 2 * hh, -far_x * far_y * hh, -far_y * hh
        yy, yh = variance + far_x ** 2 * hh, far_x * hh
        zz = 0.5 * variance
        pose = request.poses.add(
            sequence=sequence,
            stamp=timestamp_pb2.Timestamp(
                seconds=SECONDS + sequence // 5,
                nanos=sequence % 5 * 200000000 + draw.randrange(1000000)),
            heading_radians=heading)
        pose.local.x_meters = x
        pose.local.y_meters = y
        pose.covariance.form = form
        pose.covariance.values.extend(
            (xx, xy, xh, yy, yh, hh) if planar
            else (xx, xy, 0.01 * zz, xh, yy, 0.01 * zz, yh, zz, 1e-6, hh))
        if not planar:
            pose.local.z_meters = 5.0 * math.sin(x / 300.0) + draw.gauss(0, 0.01)
        if model == api.CORRELATION_MODEL_FILTER and before is not None:
            # Carried along, then corrected a little in all coordinates.
            size = 3 if planar else 4
            entries = [draw.gauss(0.0, 1e-3) for _ in range(size * size)]
            for i in range(size):
                entries[i * size + i] += 0.998
            entries[size - 1] -= y - before[1]
            entries[2 * size - 1] += x - before[0]
            pose.error_transition.extend(entries)
        before = x, y
        if len(request.poses) == BATCH:
            yield request.SerializeToString()
            request.Clear()
    if request.poses:
        yield request.SerializeToString()


class Client:
    def __init__(self, server):
        self.server = server
        self.stub = server.stub()
        self._append = server.channel(
            ("grpc.max_send_message_length", -1)).unary_unary(
                "/revisit.v1.PoseGraphService/AppendPoses")

    def create(self, vehicle, space=api.STATE_SPACE_PLANAR,
               model=api.CORRELATION_MODEL_DEAD_RECKONING):
        self.stub.CreateVehicle(api.CreateVehicleRequest(
            vehicle_id=vehicle, vehicle=api.Vehicle(settings=api.VehicleSettings(
                state_space=space, correlation_model=model))))

    def append(self, vehicle, poses):
        head = api.AppendPosesRequest(
            vehicle=f"vehicles/{vehicle}").SerializeToString()
        self._append(head + poses)

    def touch(self, vehicle):
        """Loads it if need be."""
        return self.stub.GetVehicle(
            api.GetVehicleRequest(name=f"vehicles/{vehicle}")).vehicle

    def find(self, vehicle):
        return self.stub.FindCandidates(api.FindCandidatesRequest(
            vehicle=f"vehicles/{vehicle}"))

    def info(self):
        return self.stub.GetServerInfo(api.GetServerInfoRequest())

    def memory(self):
        return self.server.resident_bytes()


def seconds_of(call, *arguments):
    start = time.perf_counter()
    call(*arguments)
    return time.perf_counter() - start


def in_parallel(work, items, threads=8):
    """Calls work(item); the first error ends it."""
    items = iter(items)
    lock = threading.Lock()
    errors = []

    def run():
        while not errors:
            with lock:
                item = next(items, None)
            if item is None:
                return
            try:
                work(item)
            except grpc.RpcError as error:
                errors.append(error)

    runners = [threading.Thread(target=run) for _ in range(threads)]
    for runner in runners:
        runner.start()
    for runner in runners:
        runner.join()
    if errors:
        raise errors[0]


def milliseconds(seconds):
    return f"{seconds * 1e3:.1f} ms"


def mebibytes(count):
    return f"{count / 2 ** 20:.1f} MiB"


def row(what, *cells):
    print(f"{what:58}" + "".join(f"{cell:>16}" for cell in cells), flush=True)


class Stores:
    def __init__(self, directory):
        self.directory = pathlib.Path(directory)

    def server(self, name, *flags):
        return revisit_server.Server(self.directory / name, "--log-level",
                                     "warning", *flags)


def settled_memory(client):
    """Once it has stopped changing: the server works on after an answer."""
    before = client.memory()
    for _ in range(50):
        time.sleep(0.1)
        now = client.memory()
        if abs(now - before) < 2 ** 16:
            return now
        before = now
    return before


def ask_store(store, sql):
    """Reads the store beside the server."""
    [file] = store.glob("*.sqlite")
    database = sqlite3.connect(f"file:{file}?mode=ro", uri=True)
    try:
        return database.execute(sql).fetchone()[0]
    finally:
        database.close()


def await_snapshots(store, poses, vehicles=1):
    """Until so few poses of each vehicle have come since its last one that no other is
    due."""
    deadline = time.monotonic() + 120
    while ask_store(store, "SELECT count(*) FROM snapshots WHERE last_sequence > "
                    f"{poses - SNAPSHOT_POSES}") < vehicles:
        assert time.monotonic() < deadline, "no snapshot was written"
        time.sleep(0.05)


def stored_bytes(store, poses):
    size = sum(path.stat().st_size for path in store.iterdir())
    snapshot = ask_store(
        store, "SELECT coalesce((SELECT sum(length(payload)) FROM snapshots), "
        "0) + coalesce((SELECT sum(length(payload)) FROM snapshot_parts), 0)")
    return size / poses, snapshot / poses


def load_of(stores, store, names, *flags):
    """Milliseconds by the clock and of the server's processor that a vehicle takes to
    load, bytes by which the server grows for all of them, and what it says then."""
    with stores.server(store, *flags) as server:
        client = Client(server)
        client.info()
        empty = settled_memory(client)
        used = processor_seconds(server.pid)
        took = sum(seconds_of(client.touch, name) for name in names)
        used = processor_seconds(server.pid) - used
        return {"ms": took / len(names) * 1e3, "cpu_ms": used / len(names) * 1e3,
                "grown": settled_memory(client) - empty, "info": client.info()}


def measure_kind(stores, nodes, vehicles=1, space=api.STATE_SPACE_PLANAR,
                 model=api.CORRELATION_MODEL_DEAD_RECKONING):
    """Bytes a node of vehicles of so many nodes each, and what they take to load: from
    the snapshot where there is one, and from the poses."""
    store = "kind"
    names = [f"v{i}" for i in range(vehicles)]
    parts = list(batches(nodes, space, model))
    total = vehicles * nodes
    with stores.server(store) as server:
        client = Client(server)
        for name in names:
            client.create(name, space, model)
        empty = settled_memory(client)
        # The first quarter holds what there is to a process once.
        quarter, sent = None, 0
        for name in names:
            for poses in parts:
                client.append(name, poses)
                sent += total / vehicles / len(parts)
                if quarter is None and sent >= total / 4:
                    quarter = (settled_memory(client),
                               client.info().resident_node_count)
        streamed = settled_memory(client)
        if nodes >= SNAPSHOT_POSES:
            await_snapshots(stores.directory / store, nodes, vehicles)
        info = client.info()
    loaded = load_of(stores, store, names)
    figures = {
        "nodes": nodes, "vehicles": vehicles,
        "graph_bytes": info.resident_bytes / info.resident_node_count,
        "streamed_bytes": (streamed - empty) / info.resident_node_count,
        "marginal_bytes": ((streamed - quarter[0]) /
                           max(1, info.resident_node_count - quarter[1])),
        "loaded_bytes": loaded["grown"] / loaded["info"].resident_node_count,
        "snapshot_bytes": stored_bytes(stores.directory / store, total)[1],
        "snapshot": None}
    if nodes >= SNAPSHOT_POSES:
        figures["snapshot"] = {"ms": loaded["ms"], "cpu_ms": loaded["cpu_ms"]}
    # Without snapshots, the first load removes it.
    replayed = load_of(stores, store, names, "--snapshot-poses", 0)
    figures["poses"] = {"ms": replayed["ms"], "cpu_ms": replayed["cpu_ms"]}
    shutil.rmtree(stores.directory / store)
    return figures


def measure_kinds(stores, nodes):
    """One vehicle of each kind, loaded from the store and streamed."""
    print(f"\nBytes a node, one vehicle of {nodes} nodes with stamps")
    row("", "graph", "as streamed", "3/4 of it", "as loaded", "snapshot",
        "ms to load", "from poses")
    for space_name, space in SPACES:
        for model_name, model in MODELS:
            figures = measure_kind(stores, nodes, 1, space, model)
            row(f"{space_name} {model_name}",
                *(f"{figures[name]:.1f}" for name in (
                    "graph_bytes", "streamed_bytes", "marginal_bytes",
                    "loaded_bytes", "snapshot_bytes")),
                *(f"{figures[way]['ms']:.0f}" if figures[way] else "-"
                  for way in ("snapshot", "poses")))


def measure_fleet(stores, vehicles, nodes):
    print(f"\n{vehicles} vehicles of {nodes} nodes")
    names = [f"v{i}" for i in range(vehicles)]
    parts = list(batches(nodes))
    with stores.server("fleet") as server:
        client = Client(server)
        empty = settled_memory(client)

        def fill(name):
            client.create(name)
            for poses in parts:
                client.append(name, poses)

        took = seconds_of(in_parallel, fill, names)
        row("stored, poses a second (8 clients)",
            f"{vehicles * nodes / took:.0f}")
        grown = settled_memory(client) - empty
        info = client.info()
        row("all in memory, as streamed: bytes a node",
            f"{grown / info.resident_node_count:.1f}")
    size = sum(path.stat().st_size
               for path in (stores.directory / "fleet").iterdir())
    row("store", mebibytes(size))
    start = time.perf_counter()
    # Long enough for the queries below.
    idle = 0.25 if vehicles > 100 else 0.05
    with stores.server("fleet", "--idle-unload-minutes", idle) as server:
        client = Client(server)
        client.info()
        row("start of the server to its first answer",
            milliseconds(time.perf_counter() - start))
        empty = settled_memory(client)
        row("resident memory, no vehicle loaded", mebibytes(empty))
        sample = random.Random(3).sample(names, min(100, vehicles))
        cold = [seconds_of(client.find, name) for name in sample]
        warm = [seconds_of(client.find, name) for name in sample]
        row("first query on a cold vehicle: median, most",
            milliseconds(statistics.median(cold)), milliseconds(max(cold)))
        row("the same on a resident one",
            milliseconds(statistics.median(warm)), milliseconds(max(warm)))
        deadline = time.monotonic() + 120
        while client.info().resident_vehicle_count > 0:
            assert time.monotonic() < deadline, "the vehicles were not unloaded"
            time.sleep(0.2)
        row("resident memory after they were unloaded", mebibytes(
            settled_memory(client)))
    with stores.server("fleet") as server:
        client = Client(server)
        client.info()
        empty = settled_memory(client)
        took = seconds_of(in_parallel, client.touch, names)
        row("all loaded (8 clients), vehicles a second",
            f"{vehicles / took:.0f}")
        grown = settled_memory(client) - empty
        info = client.info()
        assert info.resident_vehicle_count == vehicles
        row("all in memory, as loaded: bytes a node, a vehicle",
            f"{grown / info.resident_node_count:.1f}",
            f"{grown / vehicles:.0f}")
        row("  of which nodes and edges: bytes a node",
            f"{info.resident_bytes / info.resident_node_count:.1f}")
    # A tenth of them may stay.
    budget = max(1, info.resident_bytes // 10 >> 20)
    with stores.server("fleet", "--memory-budget-mebibytes", budget) as server:
        client = Client(server)
        client.info()
        empty = settled_memory(client)
        in_parallel(client.touch, names)
        deadline = time.monotonic() + 120
        while client.info().resident_bytes > budget << 20:
            assert time.monotonic() < deadline, "the budget was not kept"
            time.sleep(0.2)
        info = client.info()
        grown = settled_memory(client) - empty
        row(f"all loaded once with a budget of {budget} MiB: resident",
            mebibytes(grown), f"{info.resident_vehicle_count} vehicles")
    shutil.rmtree(stores.directory / "fleet")


def measure_long(stores, nodes):
    print(f"\nOne vehicle of {nodes} nodes, and another beside it")
    with stores.server("long") as server:
        client = Client(server)
        client.create("long")
        client.create("short")
        client.append("short", next(batches(1000)))
        empty = settled_memory(client)
        took = 0.0
        for poses in batches(nodes):
            took += seconds_of(client.append, "long", poses)
        row("stored, poses a second (one call after the other)",
            f"{nodes / took:.0f}")
        grown = settled_memory(client) - empty
        row("in memory, as streamed: bytes a node", f"{grown / nodes:.1f}")
        start = time.perf_counter()
        if nodes >= SNAPSHOT_POSES:
            await_snapshots(stores.directory / "long", nodes)
            row("until its snapshot is written",
                milliseconds(time.perf_counter() - start))
    row("store: bytes a pose, of which the snapshot",
        *(f"{count:.1f}" for count in stored_bytes(stores.directory / "long", nodes)))
    start = time.perf_counter()
    with stores.server("long") as server:
        client = Client(server)
        client.info()
        row("start of the server to its first answer",
            milliseconds(time.perf_counter() - start))
        client.find("short")
        empty = settled_memory(client)
        alone = [seconds_of(client.find, "short") for _ in range(50)]
        loaded = threading.Event()
        took = []

        def load():
            took.append(seconds_of(client.touch, "long"))
            loaded.set()

        loader = threading.Thread(target=load)
        loader.start()
        beside = []
        # At least one, although a short history is loaded before it.
        while not (beside and loaded.is_set()):
            beside.append(seconds_of(client.find, "short"))
        loader.join()
        row("loaded by its first call", milliseconds(took[0]))
        grown = settled_memory(client) - empty
        row("in memory, as loaded: bytes a node", f"{grown / nodes:.1f}")
        row("query on the other vehicle, alone: median, most",
            milliseconds(statistics.median(alone)), milliseconds(max(alone)))
        row("  while the long one is loaded",
            milliseconds(statistics.median(beside)), milliseconds(max(beside)))
        first = seconds_of(client.find, "long")
        then = [seconds_of(client.find, "long") for _ in range(3)]
        row("query on the long one: first, median after",
            milliseconds(first), milliseconds(statistics.median(then)))
    took = []
    for _ in range(3):
        with stores.server("long") as server:
            client = Client(server)
            client.info()
            took.append(seconds_of(client.touch, "long"))
    row("loaded again, three times", *map(milliseconds, took))
    # Without snapshots, the first load removes it.
    took = []
    for _ in range(3):
        with stores.server("long", "--snapshot-poses", 0) as server:
            client = Client(server)
            client.info()
            took.append(seconds_of(client.touch, "long"))
    row("loaded from its poses, three times", *map(milliseconds, took))
    shutil.rmtree(stores.directory / "long")


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--kind-nodes", type=int, default=200000)
    parser.add_argument("--vehicles", type=int, default=10000)
    parser.add_argument("--nodes", type=int, default=1000)
    parser.add_argument("--long-nodes", type=int, default=1000000)
    parser.add_argument("--directory", help="where to put the stores; they "
                        "take some 3 GiB at the default sizes")
    arguments = parser.parse_args()
    directory = tempfile.mkdtemp(prefix="revisit-fleet-",
                                 dir=arguments.directory)
    stores = Stores(directory)
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}, "
          f"{time.strftime('%Y-%m-%d')}")
    try:
        measure_kinds(stores, arguments.kind_nodes)
        measure_fleet(stores, arguments.vehicles, arguments.nodes)
        measure_long(stores, arguments.long_nodes)
    finally:
        shutil.rmtree(directory, ignore_errors=True)


if __name__ == "__main__":
    main()
