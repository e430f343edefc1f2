"""What an acknowledgement promises, against kill -9, SIGTERM, a second server
and damaged files."""

import itertools
import random
import signal
import sqlite3
import subprocess
import time

import grpc
import pytest

from drive_client import VEHICLE, Client, Drive, create
from raw_http2 import RawConnection
from revisit_server import (BIN, STOP_SECONDS, Server, clean_environment, run,
                            wait_until)
from stubs import PoseGraphServiceStub, api
from wire import (LOOP_CLOSURES, PAIR_KINDS, REJECTED_CANDIDATES, PoseStream,
                  append, as_bytes, batches, decode_failure, failure_of, get,
                  laps, list_poses, pose, straight)

# Short, so that kills also fall into searches.
SETTINGS = {"sequence_length_meters": 20.0, "check_interval_meters": 10.0,
            "node_spacing_meters": 1.0}


def test_acknowledged_poses_survive_kill_9_in_mid_stream(
        tmp_path, request, seed):
    kills = request.config.getoption("--kills")
    rng = random.Random(seed)
    client = Client(Drive(seed), random.Random(seed + 1))
    store = tmp_path / "store"
    with Server(store) as server:
        create(server.stub(), **SETTINGS)
    killed_in_stream = 0
    unacknowledged = 0
    for number in range(kills):
        with Server(store, wait=False) as server:
            if rng.random() < 0.1:
                # While it starts and looks at what the last kill left.
                time.sleep(rng.uniform(0.0, 0.03))
                server.kill()
                continue
            server.wait_until_listening()
            stub = server.stub()
            durable = client.verify(stub, whole=number % 10 == 9)
            unacknowledged += durable - client.acked
            assert not client.stream(server, kill_after=rng.uniform(0.0, 0.25))
            assert server.process.wait() == -signal.SIGKILL
            killed_in_stream += 1
    # The client finishes its drive.
    with Server(store) as server:
        stub = server.stub()
        client.verify(stub)
        end = client.sent + 300
        assert client.stream(server, until=end)
        assert client.acked == end
        assert client.verify(stub, whole=True) == end
        # The graph that was rebuilt is the one that was never interrupted.
        whole = create(stub, "vehicles/uninterrupted", **SETTINGS).name
        for batch in batches(client.drive[0:end], 1000):
            append(stub, whole, batch)
        assert nodes_of(stub, VEHICLE) == nodes_of(stub, whole)
    print(f"{kills} kills, {killed_in_stream} in mid-stream; {end} poses; "
          f"{unacknowledged} were stored before their ack got out")
    assert killed_in_stream >= kills // 2
    assert client.acked > kills


def nodes_of(stub, vehicle):
    return as_bytes(
        node for part in stub.ExportPoseGraph(
            api.ExportPoseGraphRequest(vehicle=vehicle)) for node in part.nodes)


def test_everything_else_survives_kill_9_too(tmp_path):
    store = tmp_path / "store"
    with Server(store) as server:
        stub = server.stub()
        create(stub, correlation_model=api.CORRELATION_MODEL_INDEPENDENT,
               **SETTINGS)
        append(stub, VEHICLE, straight(100))
        # Out of the order of their names, the kinds in turns.
        for name, query in (("z", 90), ("removed", 80), ("kept", 95)):
            for n, kind in enumerate(PAIR_KINDS):
                kind.add(stub, VEHICLE, query, 10 + n, name)
        for kind in PAIR_KINDS:
            kind.delete(stub, f"{VEHICLE}/{kind.collection}/removed")
        stub.RevisePoses(iter([api.RevisePosesRequest(
            vehicle=VEHICLE, poses=[pose(7, x=7.0, y=0.25)])]))
        request = api.UpdateVehicleRequest(vehicle=api.Vehicle(
            name=VEHICLE, settings=api.VehicleSettings(max_candidates=9)))
        request.update_mask.paths.append("settings.max_candidates")
        stub.UpdateVehicle(request)
        create(stub, "vehicles/short-lived")
        append(stub, "vehicles/short-lived", straight(5))
        stub.DeleteVehicle(api.DeleteVehicleRequest(
            name="vehicles/short-lived"))
        before = state_of(stub)
        assert get(stub, VEHICLE).consistency.confirmed_count == 2
        assert get(stub, VEHICLE).consistency.rejected_count == 2
        server.kill()
    with Server(store) as server:
        stub = server.stub()
        assert state_of(stub) == before
        # A name that is free again begins with nothing.
        assert create(stub, "vehicles/short-lived").durable_sequence == 0
        assert list_poses(stub, "vehicles/short-lived") == []


@pytest.mark.parametrize("kind", PAIR_KINDS, ids=str)
def test_every_acknowledged_pair_survives_kill_9(kind, tmp_path):
    store = tmp_path / "store"
    with Server(store) as server:
        create(server.stub(), **SETTINGS)
        append(server.stub(), VEHICLE, straight(100))
    acknowledged = []
    for round_number in range(3):
        with Server(store) as server:
            stub = server.stub()
            assert kind.page(stub, VEHICLE)[0] == acknowledged
            for n in range(5):
                added, revision = kind.add(
                    stub, VEHICLE, 50 + 5 * round_number + n, 1 + n)
                acknowledged.append(added)
            assert get(stub, VEHICLE).revision == revision
            server.kill()
    with Server(store) as server:
        stub = server.stub()
        assert kind.page(stub, VEHICLE)[0] == acknowledged
        assert get(stub, VEHICLE).revision == revision
        # Again is once: the retry of a call whose answer was lost.
        assert kind.add(stub, VEHICLE, 50, 1)[0] == acknowledged[0]
        assert get(stub, VEHICLE).revision == revision
        assert kind.count(get(stub, VEHICLE)) == 15


def test_rejected_candidate_stays_away_over_a_crash(tmp_path):
    store = tmp_path / "store"
    with Server(store) as server:
        stub = server.stub()
        create(stub, sequence_length_meters=40.0, check_interval_meters=20.0)
        append(stub, VEHICLE, laps(760))
        request = api.FindCandidatesRequest(
        vehicle=VEHICLE, options=api.CandidateOptions(exhaustive=True))
        best = stub.FindCandidates(request).candidates.candidates[0]
        REJECTED_CANDIDATES.add(stub, VEHICLE, best.query.sequence,
                                best.matched.sequence)
        before = stub.FindCandidates(request).candidates
        server.kill()
    with Server(store) as server:
        after = server.stub().FindCandidates(request).candidates
    for answer in (before, after):
        answer.ClearField("search_duration")
    assert after == before
    assert after.candidates
    # Candidates are 10 m apart; a pose stands for a node within 2 m of it.
    assert all(abs(candidate.matched.travelled_meters
                   - best.matched.travelled_meters) > 7.0
               for candidate in after.candidates)


def test_inflation_is_seen_in_every_gate_and_the_same_after_a_crash(tmp_path):
    # Two laps that lie up to 7 m apart, and claim to be known to 0.1 m.
    poses = laps(760)
    for n, one in enumerate(poses):
        one.local.x_meters += 7.0 * n / 760
    store = tmp_path / "store"
    request = api.FindCandidatesRequest(
        vehicle=VEHICLE, options=api.CandidateOptions(exhaustive=True))
    with Server(store) as server:
        stub = server.stub()
        create(stub, correlation_model=api.CORRELATION_MODEL_INDEPENDENT,
               sequence_length_meters=40.0, check_interval_meters=20.0,
               place_tolerance=api.PlaceTolerance(position_meters=0.1,
                                                  heading_radians=0.1),
               apply_inflation=True)
        append(stub, VEHICLE, poses)
        # Before the first confirmed loop, the prior's.
        prior = get(stub, VEHICLE).consistency.inflation
        assert 1.5 < prior < 2.0
        claimed = stub.FindCandidates(request).candidates.candidates[0].gate
        assert claimed.inflation == prior
        # Out of the order of their names, for the order counts.
        for n, query in enumerate(range(740, 540, -25)):
            LOOP_CLOSURES.add(stub, VEHICLE, query, query - 377, f"z{9 - n}")
        # The same two poses again, and then no longer: what is taken back is the
        # later one, and the order of the others stays.
        LOOP_CLOSURES.add(stub, VEHICLE, 740, 363, "again")
        LOOP_CLOSURES.delete(stub, f"{VEHICLE}/loopClosures/again")
        consistency = get(stub, VEHICLE).consistency
        assert consistency.confirmed_count == 8
        assert consistency.mean_normalized_innovation_squared > 30.0
        assert consistency.applied
        assert prior < consistency.inflation <= 10.0
        before = stub.FindCandidates(request).candidates
        assert {candidate.gate.inflation for candidate in before.candidates} \
            == {consistency.inflation}
        server.kill()
    with Server(store) as server:
        stub = server.stub()
        assert get(stub, VEHICLE).consistency == consistency
        after = stub.FindCandidates(request).candidates
    for answer in (before, after):
        answer.ClearField("search_duration")
    assert after == before


def state_of(stub):
    """All that can be read of the vehicle."""
    return {
        "vehicle": as_bytes([get(stub, VEHICLE)]),
        "poses": as_bytes(list_poses(stub, VEHICLE)),
        "graph": as_bytes(
            itertools.chain.from_iterable(
                [*part.nodes, *part.edges] for part in stub.ExportPoseGraph(
                    api.ExportPoseGraphRequest(vehicle=VEHICLE)))),
        "pairs": [as_bytes(kind.page(stub, VEHICLE)[0])
                  for kind in PAIR_KINDS],
        "names": [vehicle.name for vehicle in stub.ListVehicles(
            api.ListVehiclesRequest()).vehicles],
    }


@pytest.mark.parametrize("name", [signal.SIGTERM, signal.SIGINT],
                         ids=lambda number: number.name)
def test_signal_drains(name, tmp_path):
    store = tmp_path / "store"
    with Server(store) as server:
        stub = server.stub()
        create(stub, **SETTINGS)
        acked = 0

        def without_end():
            yield api.StreamPosesRequest(
                open=api.StreamPosesOpen(vehicle=VEHICLE))
            for first in itertools.count(1, 16):
                yield api.StreamPosesRequest(batch=api.PoseBatch(
                    poses=straight(16, first=first)))

        stream = stub.StreamPoses(without_end(), timeout=60)
        assert next(stream).WhichOneof("message") == "opened"
        acked = next(stream).ack.durable_sequence
        server.process.send_signal(name)
        with pytest.raises(grpc.RpcError) as raised:
            while True:
                acked = next(stream).ack.durable_sequence
        failure = decode_failure(raised.value)
        assert failure.code == grpc.StatusCode.UNAVAILABLE
        assert failure.reason == "SERVER_DRAINING"
        assert failure.retry_seconds is not None
        assert server.process.wait(STOP_SECONDS) == 0, server.log()
    assert acked > 0
    with Server(store) as server:
        stub = server.stub()
        # Everything that was taken on was acknowledged before the end.
        assert get(stub, VEHICLE).durable_sequence == acked
        assert (as_bytes(list_poses(stub, VEHICLE))
                == as_bytes(straight(acked)))


def test_idle_stream_is_told_and_does_not_hold_up_the_end(tmp_path):
    # The limit of draining is not used up, unless a client is there that does
    # not hear of the end.
    with Server(tmp_path / "store", "--drain-timeout-seconds", 60) as server:
        channel = server.channel()
        create(server.stub())
        with PoseStream(PoseGraphServiceStub(channel), VEHICLE) as stream:
            stream.receive_kind("opened")
            server.process.send_signal(signal.SIGTERM)
            failure = failure_of(stream.receive)
            assert failure.reason == "SERVER_DRAINING"
        server.close_channels()
        assert server.process.wait(STOP_SECONDS) == 0


def test_client_that_stays_does_not_hold_up_the_end(tmp_path):
    with Server(tmp_path / "store", "--drain-timeout-seconds", 600) as server, \
            RawConnection(server.port) as deaf:
        create(server.stub())
        assert deaf.is_alive()
        server.process.send_signal(signal.SIGTERM)
        # Both clients are idle and hold on to their connections, and one of them
        # hears nothing of the end.
        assert server.process.wait(STOP_SECONDS) == 0


def test_second_server_on_the_same_store_exits_and_says_why(tmp_path):
    store = tmp_path / "store"
    with Server(store) as first:
        stub = first.stub()
        create(stub)
        append(stub, VEHICLE, straight(10))
        second = run("revisitd", "--listen", "127.0.0.1:0", "--store", store)
        assert second.returncode == 73
        assert second.stdout == ""
        assert str(first.pid) in second.stderr
        assert str(store) in second.stderr
        assert len(second.stderr.strip().splitlines()) == 1
        # The first is unharmed.
        assert append(stub, VEHICLE,
                      straight(5, first=11)).durable_sequence == 15
        assert get(stub, VEHICLE).durable_sequence == 15
    # And the store is free once it is gone.
    with Server(store) as third:
        assert get(third.stub(), VEHICLE).durable_sequence == 15


def test_lock_of_a_killed_server_is_no_obstacle(tmp_path):
    store = tmp_path / "store"
    with Server(store) as server:
        create(server.stub())
        server.kill()
    with Server(store) as server:
        assert get(server.stub(), VEHICLE).name == VEHICLE


def database_of(store):
    """The file of the tables."""
    return store / "revisit.sqlite"


def test_damaged_record_is_told_and_harms_no_other_vehicle(tmp_path):
    store = tmp_path / "store"
    # Found again in the file by these bytes.
    marked = straight(64)
    for one in marked:
        one.local.z_meters = 1234.56789
    with Server(store) as server:
        stub = server.stub()
        create(stub)
        append(stub, VEHICLE, marked)
        create(stub, "vehicles/neighbour")
        append(stub, "vehicles/neighbour", straight(64))
    path = database_of(store)
    content = bytearray(path.read_bytes())
    z = marked[0].local.SerializeToString()[-8:]
    at = content.index(z)
    content[at] ^= 0x10
    path.write_bytes(content)
    with Server(store) as server:
        stub = server.stub()
        assert get(stub, VEHICLE).state == api.VEHICLE_STATE_DAMAGED
        failure = failure_of(lambda: list_poses(stub, VEHICLE))
        assert failure.code == grpc.StatusCode.DATA_LOSS
        assert failure.reason == "STORE_CORRUPT"
        failure = failure_of(lambda: append(stub, VEHICLE,
                                            straight(1, first=65)))
        assert failure.code == grpc.StatusCode.DATA_LOSS
        neighbour = "vehicles/neighbour"
        assert len(list_poses(stub, neighbour)) == 64
        assert append(stub, neighbour,
                      straight(1, first=65)).durable_sequence == 65


def test_store_that_is_none_is_refused_and_left_alone(tmp_path):
    store = tmp_path / "store"
    with Server(store):
        pass
    path = database_of(store)
    path.write_bytes(b"not a database at all, by any means\n" * 200)
    result = run("revisitd", "--listen", "127.0.0.1:0", "--store", store)
    assert result.returncode in (73, 74)
    assert str(store) in result.stderr
    assert path.read_bytes() == b"not a database at all, by any means\n" * 200


def test_store_of_a_newer_format_is_refused_and_left_alone(tmp_path):
    store = tmp_path / "store"
    with Server(store):
        pass
    path = database_of(store)
    database = sqlite3.connect(path)
    database.execute("PRAGMA user_version = 10")
    database.close()
    content = path.read_bytes()
    result = run("revisitd", "--listen", "127.0.0.1:0", "--store", store)
    assert result.returncode in (73, 74)
    assert "has format 10" in result.stderr
    assert "use a newer server" in result.stderr
    assert path.read_bytes() == content


# The tables that a format lacks.
GROUPS = ["vehicle_groups", "group_members", "group_links"]
CHECKS = ["check_heads", "checks", "events", "dropped_events", *GROUPS]
LACKING = {4: ["snapshots", "snapshot_parts", "deleted_snapshots",
               "deleted_pose_pairs", *CHECKS],
           5: ["deleted_pose_pairs", *CHECKS],
           6: CHECKS,
           7: GROUPS,
           8: []}


@pytest.mark.parametrize("killed", [False, True], ids=["drained", "killed"])
@pytest.mark.parametrize("version", LACKING)
def test_store_of_an_older_format_is_brought_up_to_date(version, killed, tmp_path):
    # Only the tables are those of such a server; its rows are a test of the
    # storage.
    store = tmp_path / "store"
    with Server(store) as server:
        create(server.stub())
        append(server.stub(), VEHICLE, straight(10))
        before = state_of(server.stub())
    database = sqlite3.connect(database_of(store))
    for table in LACKING[version]:
        database.execute(f"DROP TABLE {table}")
    database.execute(f"PRAGMA user_version = {version}")
    database.close()
    with Server(store) as server:
        # Killed before it has written anything else, too.
        if killed:
            server.kill()
    with Server(store) as server:
        stub = server.stub()
        assert state_of(stub) == before
        assert stub.GetServerInfo(api.GetServerInfoRequest()).store_format == 9
        LOOP_CLOSURES.add(stub, VEHICLE, 9, 2)
        server.kill()
    with Server(store) as server:
        pairs, _ = LOOP_CLOSURES.page(server.stub(), VEHICLE)
        assert [pair.query_sequence for pair in pairs] == [9]


def test_store_restored_from_an_old_copy_is_noticed(tmp_path):
    store = tmp_path / "store"
    with Server(store) as server:
        create(server.stub())
        append(server.stub(), VEHICLE, straight(10))
    backup = {path: path.read_bytes() for path in store.rglob("*")
              if path.is_file()}
    with Server(store) as server:
        acked = append(server.stub(), VEHICLE,
                       straight(10, first=11)).durable_sequence
        uid = get(server.stub(), VEHICLE).uid
    for path, content in backup.items():
        path.write_bytes(content)
    with Server(store) as server:
        with PoseStream(server.stub(), VEHICLE, acked_sequence=acked,
                        vehicle_uid=uid) as stream:
            failure = failure_of(stream.receive)
        assert failure.code == grpc.StatusCode.DATA_LOSS
        assert failure.metadata["durable_sequence"] == "10"
    # It is not forgotten over a restart.
    with Server(store) as server:
        failure = failure_of(lambda: append(server.stub(), VEHICLE,
                                            straight(1, first=11)))
        assert failure.code == grpc.StatusCode.DATA_LOSS


def test_idle_vehicle_is_unloaded_and_comes_back(tmp_path):
    # The shortest time there is: 0.6 seconds.
    with Server(tmp_path / "store", "--idle-unload-minutes", 0.01) as server:
        stub = server.stub()
        create(stub, **SETTINGS)
        append(stub, VEHICLE, straight(500))
        before = state_of(stub)
        node_count = get(stub, VEHICLE).node_count
        assert node_count > 400

        def listed():
            return stub.ListVehicles(api.ListVehiclesRequest()).vehicles[0]

        # ListVehicles does not load: it shows no nodes for one not in memory.
        wait_until(lambda: listed().node_count == 0, "unloading", seconds=30)
        assert listed().durable_sequence == 500
        assert state_of(stub) == before
        assert listed().node_count == node_count


def test_server_that_may_not_write_its_store_says_so(tmp_path):
    # A file where the directory would be made.
    (tmp_path / "file").write_text("in the way")
    result = run("revisitd", "--listen", "127.0.0.1:0",
                 "--store", tmp_path / "file" / "store")
    assert result.returncode in (73, 74)
    assert str(tmp_path / "file") in result.stderr


def test_full_file_system_is_told_and_loses_nothing(tmp_path):
    # A limit on the size of any one file stands in for a full disk.
    store = tmp_path / "store"
    limit_kib = 1024
    with Server(store) as server:
        create(server.stub())
    process = subprocess.Popen(
        ["bash", "-c",
         f"ulimit -f {limit_kib}; trap '' XFSZ; exec \"$@\"", "limited",
         BIN / "revisitd", "--listen", "127.0.0.1:0", "--store", store,
         "--port-file", tmp_path / "port"],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        env=clean_environment())
    acked = 0
    try:
        address = wait_until(lambda: (tmp_path / "port").exists() and
                             (tmp_path / "port").read_text().strip(), "port")
        with grpc.insecure_channel(address) as channel:
            stub = PoseGraphServiceStub(channel)
            with pytest.raises(grpc.RpcError) as raised:
                for batch in batches(straight(100000), 256):
                    acked = append(stub, VEHICLE, batch).durable_sequence
            failure = decode_failure(raised.value)
            assert failure.code == grpc.StatusCode.UNAVAILABLE
            assert failure.reason == "STORE_UNAVAILABLE"
            # Reads go on.
            assert get(stub, VEHICLE).durable_sequence == acked
    finally:
        process.terminate()
        process.wait(30)
    assert acked > 0
    with Server(store) as server:
        stub = server.stub()
        stored = list_poses(stub, VEHICLE)
        assert len(stored) >= acked
        assert as_bytes(stored) == as_bytes(straight(100000)[:len(stored)])
        assert append(stub, VEHICLE, straight(
            10, first=len(stored) + 1)).durable_sequence == len(stored) + 10
