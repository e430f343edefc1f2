"""A client in Python, from stubs made in this session: streams drives, takes
acknowledgements and candidates, resumes, and misbehaves."""

import math
import threading
import time

import grpc
import pytest

import scraped
from revisit_server import Server, wait_until, wait_until_still
from stubs import api
from wire import (PoseStream, append, as_bytes, batches, boreas, failure_of,
                  get, laps, list_poses, pose, straight)

RADIUS = 60.0
LAP = 2 * math.pi * RADIUS
# Short sequences, so that short drives have checks.
SHORT = {"sequence_length_meters": 40.0, "check_interval_meters": 20.0}


def stream_all(stub, vehicle, poses, size=64, **fields):
    """Streams poses to the end; answers all responses after `opened`."""
    with PoseStream(stub, vehicle, **fields) as stream:
        opened = stream.receive_kind("opened")
        for batch in batches(poses[opened.durable_sequence:], size):
            stream.send(batch)
        stream.half_close()
        return stream.receive_all()


def of_kind(responses, kind):
    return [message for name, message in responses if name == kind]


def test_first_response_says_what_is_durable(stub, new_vehicle):
    vehicle = new_vehicle()
    limits = stub.GetServerInfo(api.GetServerInfoRequest())
    with PoseStream(stub, vehicle) as stream:
        opened = stream.receive_kind("opened")
    assert opened.durable_sequence == 0
    assert opened.max_batch_poses == limits.max_batch_poses
    append(stub, vehicle, straight(5))
    with PoseStream(stub, vehicle) as stream:
        opened = stream.receive_kind("opened")
    assert opened.durable_sequence == 5
    assert opened.revision == get(stub, vehicle).revision


def test_every_batch_is_acknowledged_in_order(stub, new_vehicle):
    vehicle = new_vehicle()
    responses = stream_all(stub, vehicle, straight(1000), size=64)
    acks = of_kind(responses, "ack")
    assert len(acks) == len(responses)
    assert [ack.durable_sequence for ack in acks] == [
        *range(64, 1000, 64), 1000]
    revisions = [ack.revision for ack in acks]
    assert revisions == sorted(set(revisions))
    assert get(stub, vehicle).revision == revisions[-1]
    assert as_bytes(list_poses(stub, vehicle)) == as_bytes(straight(1000))


def test_an_acknowledged_pose_is_seen_by_the_next_read(stub, new_vehicle):
    vehicle = new_vehicle()
    with PoseStream(stub, vehicle) as stream:
        stream.receive_kind("opened")
        for batch in batches(straight(50), 5):
            stream.send(batch)
            ack = stream.receive_kind("ack")
            seen = get(stub, vehicle)
            assert seen.durable_sequence == ack.durable_sequence
            assert seen.revision == ack.revision


def test_candidates_come_at_every_check_after_the_ack_of_their_batch(
        stub, new_vehicle):
    vehicle = new_vehicle(**SHORT)
    poses = laps(int(2.5 * LAP))
    responses = stream_all(stub, vehicle, poses, size=16, send_candidates=True)
    acked, last_check = 0, 0.0
    for kind, message in responses:
        if kind == "ack":
            acked = message.durable_sequence
            continue
        query = message.query
        assert query.sequence <= acked
        # No ack stands between a batch's own and its candidates.
        assert query.sequence > acked - 2 * 16
        assert query.travelled_meters >= last_check + 18.0
        last_check = query.travelled_meters
    checks = of_kind(responses, "candidates")
    travelled = get(stub, vehicle).travelled_meters
    # From two sequence lengths on, one each interval.
    assert len(checks) == 1 + int((travelled - 80.0) // 20.0)


def test_second_lap_of_a_circle_finds_the_first(stub, new_vehicle):
    vehicle = new_vehicle(**SHORT)
    poses = laps(int(2.5 * LAP))
    responses = stream_all(stub, vehicle, poses, send_candidates=True)
    late = [answer for answer in of_kind(responses, "candidates")
            if answer.query.travelled_meters > LAP + 80.0]
    assert len(late) >= 10
    for answer in late:
        best = answer.candidates[0]
        assert best.rank == 1
        assert best.gate.verdict == api.GATE_VERDICT_ACCEPTED
        assert best.gate.degrees_of_freedom == 3
        # Chi-square quantile 0.95 of 3 degrees of freedom, from tables.
        assert best.gate.threshold == pytest.approx(7.8147, abs=1e-4)
        assert math.hypot(
            best.query.pose.x_meters - best.matched.pose.x_meters,
            best.query.pose.y_meters - best.matched.pose.y_meters) < 10.0
        gap = best.query.travelled_meters - best.matched.travelled_meters
        assert gap == pytest.approx(round(gap / LAP) * LAP, abs=10.0)


def test_candidates_of_the_stream_are_those_of_find_candidates(
        stub, new_vehicle):
    vehicle = new_vehicle(**SHORT)
    options = api.CandidateOptions(include_aligned_path=True, max_candidates=3)
    responses = stream_all(
        stub, vehicle, laps(int(2 * LAP)), send_candidates=True,
        candidate_options=options)
    streamed = of_kind(responses, "candidates")[-1]
    assert streamed.candidates
    # The node lies beyond the pose whose sequence it shows, before the next.
    assert streamed.query.fraction > 0.0
    found = stub.FindCandidates(api.FindCandidatesRequest(
        vehicle=vehicle, sequence=streamed.query.sequence + 1,
        options=options)).candidates
    assert found.query == streamed.query
    assert list(found.candidates) == list(streamed.candidates)
    for candidate in found.candidates:
        path = [(pair.query_index, pair.matched_index)
                for pair in candidate.aligned_path]
        assert path[-1] == (candidate.query.index, candidate.matched.index)
        assert [query for query, _ in path] == list(
            range(path[0][0], path[-1][0] + 1))


def test_a_path_that_is_too_short_says_so(stub, new_vehicle):
    vehicle = new_vehicle()
    append(stub, vehicle, straight(10))
    answer = stub.FindCandidates(
        api.FindCandidatesRequest(vehicle=vehicle)).candidates
    assert answer.empty_reason == api.EMPTY_REASON_PATH_TOO_SHORT
    assert not answer.candidates


def test_a_vehicle_without_poses_has_no_query(stub, new_vehicle):
    answer = stub.FindCandidates(
        api.FindCandidatesRequest(vehicle=new_vehicle())).candidates
    assert not answer.HasField("query")
    assert answer.empty_reason == api.EMPTY_REASON_PATH_TOO_SHORT


def test_client_resumes_in_the_middle_with_the_same_result(stub, new_vehicle):
    poses = laps(int(2 * LAP))
    whole, resumed = new_vehicle(**SHORT), new_vehicle(**SHORT)
    at_once = stream_all(stub, whole, poses, send_candidates=True)

    half = len(poses) // 2
    first = stream_all(stub, resumed, poses[:half], send_candidates=True)
    acked = of_kind(first, "ack")[-1].durable_sequence
    assert acked == half
    second = stream_all(stub, resumed, poses, send_candidates=True,
                        acked_sequence=acked)
    assert as_bytes(list_poses(stub, resumed)) == as_bytes(poses)

    def places(vehicle, *parts):
        answers = [answer for part in parts for answer in of_kind(part, "candidates")]
        for answer in answers:
            for candidate in answer.candidates:
                # All but the vehicle's name is the same.
                assert candidate.recording_of_match == f"{vehicle}/recordings/1"
                candidate.ClearField("recording_of_match")
        return [(answer.query, list(answer.candidates)) for answer in answers]
    assert places(resumed, first, second) == places(whole, at_once)


def test_duplicates_are_acknowledged_again_and_change_nothing(
        stub, new_vehicle):
    vehicle = new_vehicle(**SHORT)
    poses = laps(200)
    stream_all(stub, vehicle, poses)
    before = get(stub, vehicle)
    with PoseStream(stub, vehicle, send_candidates=True) as stream:
        assert stream.receive_kind("opened").durable_sequence == 200
        for batch in (poses[:50], poses[150:], poses, poses[:1]):
            stream.send(batch)
            ack = stream.receive_kind("ack")
            assert ack.durable_sequence == 200
            assert ack.revision == before.revision
        stream.half_close()
        assert stream.receive() is None
    assert get(stub, vehicle) == before
    for ack in (append(stub, vehicle, poses[:10]),
                append(stub, vehicle, poses[190:])):
        assert ack.durable_sequence == 200
        assert ack.revision == before.revision


def test_a_batch_may_begin_with_stored_poses(stub, new_vehicle):
    vehicle = new_vehicle()
    poses = straight(30)
    append(stub, vehicle, poses[:20])
    ack = append(stub, vehicle, poses[10:])
    assert ack.durable_sequence == 30
    assert as_bytes(list_poses(stub, vehicle)) == as_bytes(poses)
    # The seam lies within a batch of the client and within one of the store.
    assert append(stub, vehicle, poses[15:25]).durable_sequence == 30


def test_jump_is_reported_with_the_ack_and_not_bridged(stub, new_vehicle):
    vehicle = new_vehicle()
    before, after = straight(20), straight(20, first=21)
    for moved in after:
        moved.local.y_meters = 500.0
    ack = append(stub, vehicle, [*before, *after])
    assert [jump.sequence for jump in ack.jumps] == [21]
    assert ack.jumps[0].distance_meters == pytest.approx(math.hypot(500, 1))
    # The same answer to a batch that was sent again, as for a lost one.
    assert append(stub, vehicle, [*before, *after]) == ack
    # 19 m on each side of it.
    assert get(stub, vehicle).travelled_meters == pytest.approx(38.0)


def test_two_vehicles_stream_side_by_side(stub, new_vehicle):
    vehicles = [new_vehicle() for _ in range(4)]
    streams = [PoseStream(stub, vehicle) for vehicle in vehicles]
    for stream in streams:
        stream.receive_kind("opened")
    for batch in batches(straight(400), 20):
        for stream in streams:
            stream.send(batch)
    for stream in streams:
        stream.half_close()
        assert of_kind(stream.receive_all(), "ack")[-1].durable_sequence == 400


@pytest.mark.release_build
@pytest.mark.parametrize("alignment", [api.ALIGNMENT_RELATIVE,
                                       api.ALIGNMENT_COMPOSITE],
                         ids=api.Alignment.Name)
def test_shipped_drive_is_streamed_and_its_places_are_found_again(
        alignment, stub, new_vehicle):
    vehicle = new_vehicle(alignment=alignment)
    poses, truth = boreas()
    responses = stream_all(stub, vehicle, poses, send_candidates=True)
    assert of_kind(responses, "ack")[-1].durable_sequence == len(poses)
    checks = of_kind(responses, "candidates")
    travelled = get(stub, vehicle).travelled_meters
    assert travelled == pytest.approx(15.9e3, rel=0.01)
    assert len(checks) == 1 + int((travelled - 300.0) // 50.0)

    accepted = correct = 0
    for answer in checks:
        if not answer.candidates:
            continue
        best = answer.candidates[0]
        if best.verdict != api.VERDICT_ACCEPTED:
            continue
        accepted += 1
        query, matched = (at(truth, node)
                          for node in (best.query, best.matched))
        correct += (math.hypot(query[0] - matched[0],
                               query[1] - matched[1]) < 10.0
                    and abs(math.remainder(query[2] - matched[2],
                                           2 * math.pi)) < math.pi / 4)
    print(f"{len(checks)} checks, {accepted} accepted, {correct} correct")
    # The second day drives 8 km of the first again: some 150 checks. These are
    # bounds that a broken search would miss by far, not figures of merit.
    assert correct >= 75
    assert correct >= 0.75 * accepted


def at(truth, node):
    """True place of a node, between its two poses."""
    a = truth[node.sequence - 1]
    b = truth[min(node.sequence, len(truth) - 1)]
    turn = math.remainder(b[2] - a[2], 2 * math.pi)
    return (a[0] + node.fraction * (b[0] - a[0]),
            a[1] + node.fraction * (b[1] - a[1]),
            a[2] + node.fraction * turn)


# ---- Clients that do not keep up, or go away


class Flood:
    """Requests of a client that sends as fast as the server takes them. Each
    pose is a jump, so that the answers are large."""

    SETTINGS = {"max_step_meters": 0.5}

    def __init__(self, vehicle, size, most):
        self.sent_batches = 0
        self._vehicle, self._size, self._most = vehicle, size, most
        self._stopped = threading.Event()

    def __iter__(self):
        yield api.StreamPosesRequest(
            open=api.StreamPosesOpen(vehicle=self._vehicle))
        for number in range(self._most):
            if self._stopped.is_set():
                return
            yield api.StreamPosesRequest(batch=api.PoseBatch(poses=straight(
                self._size, first=number * self._size + 1)))
            # Counted when the transport asks for the next: it took this one.
            self.sent_batches = number + 1

    def stop(self):
        self._stopped.set()


def test_client_that_does_not_read_is_slowed_down_in_bounded_memory(
        server, new_vehicle):
    most, size = 20000, 256
    vehicle = new_vehicle(**Flood.SETTINGS)
    # A small window, so that the answers fill it soon.
    stub = type(server.stub())(server.channel(
        ("grpc.http2.lookahead_bytes", 65535), ("grpc.http2.bdp_probe", 0)))
    before = server.resident_bytes()
    flood = Flood(vehicle, size, most)
    call = stub.StreamPoses(iter(flood), timeout=120)
    try:
        sent = wait_until_still(lambda: flood.sent_batches)
        grown = server.resident_bytes() - before
        print(f"{sent} batches sent, {grown / 2**20:.1f} MiB more resident")
        assert 0 < sent < most, "the server took all of it"
        assert grown < 96 * 2**20
        # The others do not wait for it.
        other = new_vehicle()
        assert append(server.stub(), other, straight(10)).durable_sequence == 10
        # Once it reads, all is answered.
        flood.stop()
        acks = [response.ack for response in call
                if response.WhichOneof("message") == "ack"]
        assert call.code() == grpc.StatusCode.OK
        assert len(acks) >= sent
        assert acks[-1].durable_sequence == len(acks) * size
    finally:
        flood.stop()
        call.cancel()


def test_cancelled_stream_leaves_the_server_healthy(server, stub, new_vehicle):
    vehicle = new_vehicle(**SHORT)
    whole = laps(4100)
    poses = whole[:4000]
    for _ in range(20):
        with PoseStream(stub, vehicle, send_candidates=True) as stream:
            opened = stream.receive_kind("opened")
            # The last batch again, if the server has taken all by now.
            first = min(opened.durable_sequence, len(poses) - 32)
            for batch in batches(poses[first:], 32):
                stream.send(batch)
            stream.receive()
            stream.call.cancel()
            with pytest.raises(grpc.RpcError) as raised:
                stream.receive_all()
            assert raised.value.code() == grpc.StatusCode.CANCELLED
    # What was taken is a prefix, and the drive goes on from there.
    responses = stream_all(stub, vehicle, whole)
    durable = get(stub, vehicle).durable_sequence
    assert durable == len(whole)
    assert {kind for kind, _ in responses} == {"ack"}
    assert as_bytes(list_poses(stub, vehicle)) == as_bytes(whole)


def test_connection_that_breaks_off_leaves_the_server_healthy(
        server, stub, new_vehicle):
    vehicle = new_vehicle()
    channel = grpc.insecure_channel(
        server.address, options=[("grpc.use_local_subchannel_pool", 1)])
    stream = PoseStream(type(stub)(channel), vehicle)
    stream.receive_kind("opened")
    for batch in batches(straight(1000), 10):
        stream.send(batch)
    stream.receive_kind("ack")
    channel.close()
    stream.half_close()
    durable = get(stub, vehicle).durable_sequence
    assert durable >= 10
    stream_all(stub, vehicle, straight(1000))
    assert as_bytes(list_poses(stub, vehicle)) == as_bytes(straight(1000))


def test_stream_ends_at_its_deadline(stub, new_vehicle):
    vehicle = new_vehicle()

    def opened_and_ended(timeout):
        with PoseStream(stub, vehicle, timeout=timeout) as stream:
            opened = False
            with pytest.raises(grpc.RpcError) as raised:
                opened = stream.receive_kind("opened") is not None
                stream.receive()
            assert raised.value.code() == grpc.StatusCode.DEADLINE_EXCEEDED
            return opened

    # A busy machine may take longer to open it than the shorter ones.
    assert any(opened_and_ended(timeout) for timeout in (0.3, 3, 30))


def test_deleted_vehicle_ends_its_stream(stub, new_vehicle):
    vehicle = new_vehicle()
    with PoseStream(stub, vehicle) as stream:
        stream.receive_kind("opened")
        stub.DeleteVehicle(api.DeleteVehicleRequest(name=vehicle))
        stream.send(straight(3))
        failure = failure_of(stream.receive)
    assert failure.code == grpc.StatusCode.NOT_FOUND
    assert failure.reason == "VEHICLE_NOT_FOUND"


def test_health_of_the_service_is_serving(server):
    from grpc_health.v1 import health_pb2, health_pb2_grpc
    health = health_pb2_grpc.HealthStub(server.channel())
    for service in ("", "revisit.v1.PoseGraphService"):
        answer = health.Check(health_pb2.HealthCheckRequest(service=service))
        assert answer.status == health_pb2.HealthCheckResponse.SERVING


def test_server_says_what_it_is(stub):
    info = stub.GetServerInfo(api.GetServerInfoRequest())
    assert info.durability == api.DURABILITY_LOCAL
    assert info.version.count(".") == 2
    assert info.max_batch_poses > 0
    assert info.max_message_bytes > 0
    assert info.max_batches_in_flight > 0
    assert info.store_format > 0


@pytest.mark.release_build
def test_memory_does_not_grow_with_streams_that_come_and_go(
        server, stub, new_vehicle):
    vehicle = new_vehicle()
    append(stub, vehicle, straight(10))

    def come_and_go(times):
        for _ in range(times):
            with PoseStream(stub, vehicle) as stream:
                stream.receive_kind("opened")
                stream.send(straight(10))
                stream.receive_kind("ack")
                stream.half_close()
                assert stream.receive() is None

    come_and_go(100)
    before = server.resident_bytes()
    come_and_go(500)
    wait_until(lambda: server.resident_bytes() - before < 8 * 2**20,
               "memory given back")


def test_pose_without_stamp_leads_to_nodes_without_stamp(stub, new_vehicle):
    vehicle = new_vehicle(node_spacing_meters=1.0, sequence_length_meters=10.0,
                          check_interval_meters=10.0)
    stamped = straight(10)
    for n, one in enumerate(stamped):
        one.stamp.seconds = 1000 + n
    append(stub, vehicle, [*stamped, pose(11, x=11.0)])
    nodes = [node for part in stub.ExportPoseGraph(
        api.ExportPoseGraphRequest(vehicle=vehicle)) for node in part.nodes]
    assert [node.HasField("stamp") for node in nodes[:9]] == [True] * 9
    assert nodes[4].stamp.seconds == 1004


# ---- Slow searches, and everybody else

FINE = api.VehicleSettings(node_spacing_meters=0.5,
                               sequence_length_meters=20.0)
# A thousand nodes, which is the most.
LONGEST_METERS = 500.0
# Beyond 7,500 the server refuses the search: twenty nodes a pose, two directions,
# and 300 million comparisons are allowed.
MOST_POSES = 7000
# Longer than a few acknowledgements on a machine that is busy, and the least
# that will do on one that is fast.
SLOW_SECONDS = 1.0
LEAST_SLOW_SECONDS = 0.3


@pytest.fixture
def small_server(tmp_path):
    with Server(tmp_path / "store", "--worker-threads", 1, "--search-threads", 2,
                "--admin-listen", "127.0.0.1:0") as running:
        yield running
        assert running.is_running(), running.log()


def create_fine(stub, name):
    return stub.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id=name, vehicle=api.Vehicle(settings=FINE))).vehicle.name


def search(vehicle, length_meters):
    return api.FindCandidatesRequest(
        vehicle=vehicle, options=api.CandidateOptions(
            alignment=api.ALIGNMENT_COMPOSITE,
            sequence_length_meters=length_meters))


def make_slow(stub, vehicles):
    """Drives the vehicles on until a search of theirs is slow, however fast
    the machine; answers how long it takes."""
    count = 0
    seconds = 0.0
    while count < MOST_POSES and seconds <= SLOW_SECONDS:
        more = laps(1000, radius=600.0, spacing=10.0, first=count + 1)
        count += len(more)
        for vehicle in vehicles:
            append(stub, vehicle, more)
        begin = time.monotonic()
        stub.FindCandidates(search(vehicles[0], LONGEST_METERS))
        seconds = time.monotonic() - begin
    if seconds < LEAST_SLOW_SECONDS:
        pytest.skip("no search is slow on this machine")
    return seconds


@pytest.mark.release_build
def test_poses_of_others_are_acknowledged_while_vehicles_search(
        small_server):
    stub = small_server.stub()
    slow = [create_fine(stub, f"slow-{i}") for i in range(2)]
    other = create_fine(stub, "other")
    append(stub, other, laps(10))
    make_slow(stub, slow)
    with PoseStream(stub, other) as stream:
        stream.receive_kind("opened")
        # Without a deadline, so that they are admitted though they will have to
        # wait.
        searches = [stub.FindCandidates.future(search(vehicle, LONGEST_METERS))
                    for vehicle in slow for _ in range(6)]
        for sequence in range(11, 21):
            stream.send(laps(1, first=sequence))
            assert stream.receive_kind("ack").durable_sequence == sequence
        # And what is read without a search is answered.
        assert get(stub, other).durable_sequence == 20
        # If each waited for a thread that searches, all of these had ended.
        assert sum(one.done() for one in searches) <= 4
        for one in searches:
            one.cancel()


@pytest.mark.release_build
def test_search_that_is_given_up_frees_its_thread(small_server):
    stub = small_server.stub()
    vehicle = create_fine(stub, "slow")
    seconds = make_slow(stub, [vehicle])

    def searches(**outcome):
        page = scraped.scrape(small_server)
        return page.value("revisit_searches_total", **outcome) if outcome else \
            page.total("revisit_searches_total")

    before, stopped = searches(), searches(outcome="stopped")
    # Without a deadline, so that they are admitted though they will have to wait.
    calls = [stub.FindCandidates.future(search(vehicle, LONGEST_METERS))
             for _ in range(12)]
    # For some to begin.
    time.sleep(seconds / 2)
    for call in calls:
        call.cancel()
    stub.FindCandidates(search(vehicle, 10.0))
    # Those that had begun stop, and of the others none begins.
    wait_until(lambda: searches(outcome="stopped") > stopped, "stop")
    assert searches() - before < 10
