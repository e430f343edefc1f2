"""What one caller may take of the server, and what the others still get."""

import contextlib
import statistics
import time

import grpc
import pytest

import scraped
from revisit_server import Server, wait_until, wait_until_still
from stubs import api
from wire import (PoseStream, append, batches, decode_failure, failure_of, get,
                  laps, straight)

EXHAUSTED = grpc.StatusCode.RESOURCE_EXHAUSTED
UNAVAILABLE = grpc.StatusCode.UNAVAILABLE
ADMIN = "--admin-listen=127.0.0.1:0"


def create(stub, name="car", **settings):
    return stub.CreateVehicle(api.CreateVehicleRequest(
        vehicle_id=name, vehicle=api.Vehicle(
            settings=api.VehicleSettings(**settings)))).vehicle.name


def fill(stub, vehicle, poses):
    for batch in batches(poses, 1000):
        append(stub, vehicle, batch)


def search(vehicle, **options):
    return api.FindCandidatesRequest(
        vehicle=vehicle, options=api.CandidateOptions(**options))


def outcomes(futures):
    """The answers, and the failures by reason."""
    answers, failures = [], {}
    for future in futures:
        try:
            answers.append(future.result())
        except grpc.RpcError as error:
            failure = decode_failure(error)
            failures.setdefault(failure.reason, []).append(failure)
    return answers, failures


# ---- Streams


def opens(stub, vehicle):
    """What a new stream of the vehicle is answered first; None if it is refused."""
    with PoseStream(stub, vehicle) as stream:
        try:
            return stream.receive_kind("opened")
        except grpc.RpcError:
            return None


@pytest.mark.parametrize("flag, code, reason", [
    ("--max-streams=2", UNAVAILABLE, "OVERLOADED"),
    ("--max-streams-per-vehicle=2", EXHAUSTED, "STREAM_QUOTA"),
    ("--max-streams-per-caller=2", EXHAUSTED, "STREAM_QUOTA"),
])
def test_stream_too_many_is_refused_until_one_ends(
        flag, code, reason, tmp_path):
    with Server(tmp_path / "store", flag) as server:
        stub = server.stub()
        vehicle = create(stub)
        with contextlib.ExitStack() as stack:
            streams = [stack.enter_context(PoseStream(stub, vehicle))
                       for _ in range(2)]
            for stream in streams:
                stream.receive_kind("opened")
            delays = set()
            for _ in range(5):
                with PoseStream(stub, vehicle) as stream:
                    failure = failure_of(stream.receive)
                assert (failure.code, failure.reason) == (code, reason)
                assert failure.metadata["limit"] == "2"
                assert 1 <= failure.retry_seconds <= 3
                delays.add(failure.retry_seconds)
            # Not all come back at once.
            assert len(delays) > 1
            # Those that are there go on.
            streams[0].send(straight(3))
            assert streams[0].receive_kind("ack").durable_sequence == 3
            streams[1].half_close()
            assert streams[1].receive() is None

            wait_until(lambda: opens(stub, vehicle), "room for a stream")


def test_revisions_and_exports_count_as_streams(tmp_path):
    with Server(tmp_path / "store", "--max-streams-per-vehicle=1") as server:
        stub = server.stub()
        vehicle = create(stub)
        append(stub, vehicle, straight(3))
        with PoseStream(stub, vehicle) as stream:
            stream.receive_kind("opened")
            for call in (
                    lambda: list(stub.ExportPoseGraph(
                        api.ExportPoseGraphRequest(vehicle=vehicle))),
                    lambda: stub.RevisePoses(iter([api.RevisePosesRequest(
                        vehicle=vehicle, poses=straight(1))]))):
                failure = failure_of(call)
                assert (failure.code, failure.reason) == (
                    EXHAUSTED, "STREAM_QUOTA")


def test_client_that_does_not_read_its_candidates_is_cut_and_can_resume(
        tmp_path):
    with Server(tmp_path / "store", "--max-unread-bytes=100000",
                "--slow-consumer-seconds=600", ADMIN,
                "--max-streams-per-vehicle=2") as server:
        stub = server.stub()
        vehicle = create(stub, check_interval_meters=2.0,
                         sequence_length_meters=20.0)
        poses = laps(4000)
        # Searches with so many paths take minutes in an instrumented server.
        with PoseStream(stub, vehicle, timeout=400, send_candidates=True,
                        candidate_options=api.CandidateOptions(
                            max_candidates=100, candidate_separation_meters=0,
                            include_aligned_path=True)) as stream:
            stream.receive_kind("opened")
            sent = 0
            # The server reads on, since acknowledgements are all written.
            for batch in batches(poses, 64):
                stream.send(batch)
                sent += len(batch)
            # Comes to read only when the server has given up, and takes no more.
            wait_until(lambda: get(stub, vehicle).durable_sequence,
                       "durable pose")
            wait_until_still(lambda: (
                get(stub, vehicle).durable_sequence,
                scraped.scrape(server).total("revisit_searches_total")))
            with pytest.raises(grpc.RpcError) as raised:
                while stream.receive():
                    pass
        failure = decode_failure(raised.value)
        assert (failure.code, failure.reason) == (EXHAUSTED, "SLOW_CONSUMER")
        durable = get(stub, vehicle).durable_sequence
        assert int(failure.metadata["durable_sequence"]) <= durable <= sent
        with PoseStream(stub, vehicle) as stream:
            assert stream.receive_kind("opened").durable_sequence == durable
            if durable < len(poses):
                stream.send(poses[durable:durable + 10])
                assert (stream.receive_kind("ack").durable_sequence
                        == durable + 10)


def test_client_that_never_reads_again_is_let_go(tmp_path):
    with Server(tmp_path / "store", "--max-unread-bytes=50000",
                "--slow-consumer-seconds=0.2",
                "--max-streams-per-vehicle=1") as server:
        stub = server.stub()
        vehicle = create(stub, check_interval_meters=2.0,
                         sequence_length_meters=20.0)
        # Windows that hold next to nothing of what is not read.
        channel = server.channel(("grpc.use_local_subchannel_pool", 1),
                                 ("grpc.http2.lookahead_bytes", 1024),
                                 ("grpc.http2.bdp_probe", 0))
        stalled = channel.stream_stream(
            "/revisit.v1.PoseGraphService/StreamPoses",
            request_serializer=lambda m: m.SerializeToString(),
            response_deserializer=bytes)
        requests = [api.StreamPosesRequest(open=api.StreamPosesOpen(
            vehicle=vehicle, send_candidates=True,
            candidate_options=api.CandidateOptions(
                max_candidates=100, candidate_separation_meters=0,
                include_aligned_path=True)))]
        requests += [api.StreamPosesRequest(batch=api.PoseBatch(poses=batch))
                     for batch in batches(laps(4000), 64)]
        call = stalled(iter(requests))
        next(call)
        server.logged("SLOW_CONSUMER")

        wait_until(lambda: opens(stub, vehicle),
                   "the place of the stream that was cut")
        call.cancel()


# ---- Searches and batches

SLOW = {"alignment": api.ALIGNMENT_COMPOSITE,
        "direction": api.DIRECTION_EITHER}


@pytest.fixture(scope="module")
def slow_server(tmp_path_factory):
    """One thread for all work, and searches that take a while."""
    with Server(tmp_path_factory.mktemp("slow") / "store",
                ADMIN, "--search-threads=1", "--max-searches-per-vehicle=4",
                "--max-searches=6") as server:
        stub = server.stub()
        for name in ("a", "b"):
            fill(stub, create(stub, name, sequence_length_meters=300,
                              node_spacing_meters=0.5),
                 laps(4000, spacing=2.0))
        yield server


@pytest.fixture(scope="module")
def search_seconds(slow_server):
    stub = slow_server.stub()
    times = []
    for _ in range(5):
        start = time.monotonic()
        stub.FindCandidates(search("vehicles/a", **SLOW))
        times.append(time.monotonic() - start)
    return statistics.median(times)


def test_searches_too_many_of_a_vehicle_are_refused_and_others_served(
        slow_server):
    stub = slow_server.stub()
    futures = [stub.FindCandidates.future(search("vehicles/a", **SLOW))
               for _ in range(40)]
    other = stub.FindCandidates.future(search("vehicles/b", **SLOW))
    answers, failures = outcomes(futures)
    assert set(failures) == {"SEARCH_QUOTA"}
    assert 4 <= len(answers) < 40
    assert len(other.result().candidates.candidates) > 0
    for failure in failures["SEARCH_QUOTA"]:
        assert failure.code == EXHAUSTED
        assert 0.1 <= failure.retry_seconds <= 0.3
        assert "vehicles/a" in failure.message


def test_whoever_has_the_answer_may_ask_again_at_once(tmp_path):
    with Server(tmp_path / "store", "--max-searches=1", "--max-calls=1",
                "--log-level=error") as server:
        stub = server.stub()
        vehicle = create(stub)
        append(stub, vehicle, straight(50))
        for _ in range(1000):
            stub.FindCandidates(search(vehicle))


def test_searches_too_many_in_all_are_refused(slow_server):
    stub = slow_server.stub()
    futures = [stub.FindCandidates.future(search(f"vehicles/{name}", **SLOW))
               for _ in range(20) for name in "ab"]
    _, failures = outcomes(futures)
    assert "OVERLOADED" in failures
    for failure in failures["OVERLOADED"]:
        assert failure.code == UNAVAILABLE
        assert failure.metadata["limit"] == "6"


def searches_run_to_their_end(server):
    """How many have been, once none is left."""

    def over():
        page = scraped.scrape(server)
        return page.value("revisit_limit_used_ratio",
                          limit="max-searches") == 0 and page

    page = wait_until(over, "end of the searches")
    return page.total("revisit_searches_total") - page.value(
        "revisit_searches_total", outcome="stopped")


def test_nobody_works_for_callers_who_gave_up(slow_server):
    stub = slow_server.stub()
    before = searches_run_to_their_end(slow_server)
    rounds, answers = 5, 0
    for _ in range(rounds):
        futures = [stub.FindCandidates.future(
            search(f"vehicles/{name}", **SLOW)) for _ in range(20)
            for name in "ab"]
        # When the first is answered, others are under way and wait.
        wait_until(lambda: any(
            future.done() and future.code() is grpc.StatusCode.OK
            for future in futures), "answer")
        for future in futures:
            future.cancel()
        answers += sum(future.code() is grpc.StatusCode.OK
                       for future in futures)
    # Five were taken beside each that was answered. One or two of a round may be
    # done before the server hears that nobody waits for them.
    given_up = searches_run_to_their_end(slow_server) - before - answers
    assert given_up <= 2 * rounds


def test_search_that_would_be_late_is_refused_before_it_is_begun(
        slow_server, search_seconds):
    stub = slow_server.stub()
    # On a busy machine the refusal may itself be late, or a search be sooner
    # done than the last ones tell: of a few rounds, one has to do.
    for _ in range(10):
        futures = [stub.FindCandidates.future(search("vehicles/a", **SLOW))
                   for _ in range(4)]
        error = stub.FindCandidates.future(
            search("vehicles/b", **SLOW),
            timeout=2 * search_seconds).exception()
        outcomes(futures)
        if error is not None and "grpc-status-details-bin" in dict(
                error.trailing_metadata() or ()):
            break
    # In time, or it would be the client's own deadline that ended it.
    failure = decode_failure(error)
    assert failure.reason == "OVERLOADED"
    assert "deadline" in failure.message


def test_rate_of_searches_is_bounded(tmp_path):
    with Server(tmp_path / "store",
                "--max-search-rate-per-caller=3") as server:
        stub = server.stub()
        vehicle = create(stub)
        futures = [stub.FindCandidates.future(search(vehicle))
                   for _ in range(10)]
        answers, failures = outcomes(futures)
        assert len(answers) >= 3
        assert set(failures) == {"SEARCH_QUOTA"}
        assert all(0 < failure.retry_seconds <= 1
                   for failure in failures["SEARCH_QUOTA"])
        # What it says is when it works again.
        time.sleep(max(failure.retry_seconds
                       for failure in failures["SEARCH_QUOTA"]))
        stub.FindCandidates(search(vehicle))


def test_search_larger_than_allowed_says_what_was_got_and_allowed(tmp_path):
    with Server(tmp_path / "store", "--max-search-steps=20000") as server:
        stub = server.stub()
        vehicle = create(stub, node_spacing_meters=1.0,
                         sequence_length_meters=50.0,
                         check_interval_meters=10.0)
        poses = laps(400)
        with PoseStream(stub, vehicle, send_candidates=True) as stream:
            stream.receive_kind("opened")
            for batch in batches(poses, 50):
                stream.send(batch)
            stream.half_close()
            received = stream.receive_all()
        acks = [message for kind, message in received if kind == "ack"]
        assert acks[-1].durable_sequence == len(poses)
        reasons = [message.empty_reason for kind, message in received
                   if kind == "candidates"]
        # Fine while the history is short; then said, and the stream goes on.
        assert api.EMPTY_REASON_LIMIT_EXCEEDED not in reasons[:5]
        assert reasons[-1] == api.EMPTY_REASON_LIMIT_EXCEEDED
        failure = failure_of(lambda: stub.FindCandidates(search(vehicle)))
        assert failure.code == grpc.StatusCode.OUT_OF_RANGE
        assert failure.reason == "LIMIT_EXCEEDED"
        assert int(failure.metadata["limit"]) == 20000
        assert int(failure.metadata["got"]) > 10000
        # What it proposes helps.
        asked_until_answered(stub, search(vehicle, sequence_length_meters=20.0))
        # So does asking of an earlier time.
        asked_until_answered(stub, api.FindCandidatesRequest(
            vehicle=vehicle, sequence=200))


def asked_until_answered(stub, request):
    """The answer, and why calls before it were refused."""
    refusals = []
    while True:
        try:
            return stub.FindCandidates(request).candidates, refusals
        except grpc.RpcError as error:
            refusals.append(decode_failure(error))
            assert refusals[-1].reason == "SEARCH_QUOTA"
            assert len(refusals) < 200


def test_marks_count_among_the_steps_of_a_search_and_are_kept(tmp_path):
    poses = laps(4000, radius=100.0)
    answers, refused = [], []
    for number, steps in enumerate((300_000_000, 2_000_000, 400_000)):
        with Server(tmp_path / f"store-{number}", ADMIN,
                    f"--max-search-steps={steps}") as server:
            stub = server.stub()
            vehicle = create(stub)
            fill(stub, vehicle, poses)
            answer, refusals = asked_until_answered(stub, search(vehicle))
            answer.ClearField("search_duration")
            answers.append(answer)
            refused.append(len(refusals))
            for failure in refusals:
                assert failure.code == EXHAUSTED
                assert failure.message.startswith("vehicles/car: ")
                assert failure.metadata["limit"] == str(steps)
                assert 0.1 <= failure.retry_seconds <= 0.3
            assert scraped.scrape(server).value(
                "revisit_limit_refusals_total",
                limit="max-search-steps") == len(refusals)
            # Nothing is left to search first, nor where a setting changes that
            # marks do not depend on.
            stub.FindCandidates(search(vehicle))
            stub.UpdateVehicle(api.UpdateVehicleRequest(
                vehicle=api.Vehicle(name=vehicle, settings=api.VehicleSettings(
                    max_candidates=3)),
                update_mask={"paths": ["settings.max_candidates"]}))
            stub.FindCandidates(search(vehicle))
    assert answers[0].candidates
    assert answers[1:] == answers[:1] * 2
    assert refused[0] == 0
    assert 2 <= refused[1] < refused[2]


@pytest.mark.parametrize("flag, code, reason", [
    ("--max-queued-bytes-per-vehicle=3000", EXHAUSTED, "QUEUE_FULL"),
    ("--max-queued-bytes=3000", UNAVAILABLE, "OVERLOADED"),
])
def test_batches_beyond_the_queue_are_refused_whole_and_can_be_sent_again(
        flag, code, reason, tmp_path):
    with Server(tmp_path / "store", flag, "--worker-threads=1") as server:
        stub = server.stub()
        vehicle = create(stub)
        poses = straight(3000)
        futures = [stub.AppendPoses.future(api.AppendPosesRequest(
            vehicle=vehicle, poses=poses[:20])) for _ in range(200)]
        answers, failures = outcomes(futures)
        assert answers
        assert set(failures) == {reason}
        assert {failure.code for failure in failures[reason]} == {code}
        # One that is larger than the queue comes through alone.
        wait_until(lambda: not outcomes([stub.AppendPoses.future(
            api.AppendPosesRequest(vehicle=vehicle, poses=poses))])[1],
            "room for a large batch")
        assert get(stub, vehicle).durable_sequence == len(poses)


def test_server_that_is_short_of_memory_refuses_work_and_says_so(tmp_path):
    with Server(tmp_path / "store", "--max-memory-bytes=1") as server:
        stub = server.stub()
        for call in (
                lambda: create(stub),
                lambda: append(stub, "vehicles/x", straight(1)),
                lambda: PoseStream(stub, "vehicles/x").receive(),
                lambda: stub.FindCandidates(search("vehicles/x"))):
            failure = failure_of(call)
            assert (failure.code, failure.reason) == (
                EXHAUSTED, "MEMORY_PRESSURE")
            assert failure.retry_seconds >= 2.5
        # An operator can still ask.
        stub.GetServerInfo(api.GetServerInfoRequest())


# ---- Overload
