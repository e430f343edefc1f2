"""Metrics say what a client did, to the call and to the pose."""

import collections
import re
import threading
import time

import pytest

import scraped
from identities import Authority
from revisit_server import Server, run, wait_until
from stubs import ROOT, api
from wire import LOOP_CLOSURES, REJECTED_CANDIDATES, PoseStream, append, \
    failure_of, get, laps, straight

ADMIN = ("--admin-listen", "127.0.0.1:0")


@pytest.fixture
def server(tmp_path):
    with Server(tmp_path / "store", *ADMIN) as running:
        yield running


def create(stub, name):
    stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id=name))
    return f"vehicles/{name}"


def once_calls_are_over(server):
    """The page when no call is open any more: each is so until its answer is on its
    way, though it is counted before."""

    def over():
        page = scraped.scrape(server)
        return page.total("revisit_calls_open") == 0 and page

    return wait_until(over, "end of the calls")


def test_counts_calls_by_method_and_code(server):
    stub = server.stub()
    vehicle = create(stub, "counted")
    for _ in range(5):
        get(stub, vehicle)
    for _ in range(3):
        failure_of(lambda: get(stub, "vehicles/unknown"))
    failure_of(lambda: get(stub, "no name"))
    page = scraped.scrape(server)
    for method, code, count in [
            ("CreateVehicle", "OK", 1), ("GetVehicle", "OK", 5),
            ("GetVehicle", "NOT_FOUND", 3),
            ("GetVehicle", "INVALID_ARGUMENT", 1), ("ListPoses", "OK", 0)]:
        assert page.value("revisit_calls_total", method=method,
                          code=code) == count, (method, code)
    assert page.total("revisit_calls_total") == 10
    assert page.value("revisit_call_errors_total",
                      reason="VEHICLE_NOT_FOUND") == 3
    assert page.value("revisit_call_errors_total",
                      reason="INVALID_RESOURCE_NAME") == 1
    assert page.total("revisit_call_errors_total") == 4
    assert page.value("revisit_call_seconds_count", method="GetVehicle") == 9
    assert page.value("revisit_call_seconds_bucket", method="GetVehicle",
                      le="+Inf") == 9
    once_calls_are_over(server)


def test_counts_poses_that_are_new_repeated_and_refused(server):
    stub = server.stub()
    vehicle = create(stub, "poses")
    with PoseStream(stub, vehicle) as stream:
        stream.receive_kind("opened")
        for first in range(1, 101, 10):
            stream.send(straight(10, first=first))
        for _ in range(10):
            stream.receive_kind("ack")
        page = scraped.scrape(server)
        assert page.value("revisit_calls_open", method="StreamPoses") == 1
        # 95 of them again, and 10 new ones.
        stream.send(straight(105, first=6))
        stream.receive_kind("ack")
        # A gap.
        stream.send(straight(7, first=200))
        assert failure_of(stream.receive).reason == "SEQUENCE_GAP"
    append(stub, vehicle, straight(110))
    failure_of(lambda: append(stub, vehicle, straight(3, first=300)))
    failure_of(lambda: append(stub, "vehicles/unknown", straight(4)))
    failure_of(lambda: append(stub, "no name", straight(2)))
    page = scraped.scrape(server)
    assert page.value("revisit_poses_accepted_total") == 110
    assert page.value("revisit_poses_repeated_total") == 95 + 110
    assert page.value("revisit_poses_refused_total",
                      reason="SEQUENCE_GAP") == 7 + 3
    assert page.value("revisit_poses_refused_total",
                      reason="VEHICLE_NOT_FOUND") == 4
    assert page.value("revisit_poses_refused_total",
                      reason="INVALID_RESOURCE_NAME") == 2
    assert page.total("revisit_poses_refused_total") == 16
    assert page.value("revisit_ack_seconds_count") == 10 + 1 + 1
    assert 0 < page.value("revisit_ack_seconds_sum") < 60
    assert page.value("revisit_resident_vehicles") == 1
    info = stub.GetServerInfo(api.GetServerInfoRequest())
    assert page.value("revisit_resident_nodes") == info.resident_node_count > 0
    assert page.value("revisit_resident_bytes") == info.resident_bytes > 0
    assert page.value("revisit_queued_bytes") == 0
    # The vehicle, and what eleven batches brought.
    assert page.value("revisit_store_writes_total") == 12
    commits = page.value("revisit_store_commits_total")
    assert 1 <= commits <= 12
    assert page.value("revisit_store_flush_seconds_count") >= commits
    assert page.value("revisit_store_commit_seconds_count") >= commits
    store = server.store
    assert page.value("revisit_store_bytes") == sum(
        (store / name).stat().st_size
        for name in ["revisit.sqlite", "revisit.sqlite-wal"])
    assert page.value("revisit_store_free_bytes") > 0
    assert page.value("revisit_store_min_free_bytes") == 128 << 20


def test_counts_while_many_clients_send(server):
    clients, batches, size = 8, 25, 20
    pages, over = [], threading.Event()

    def drive(number):
        stub = server.stub()
        vehicle = create(stub, f"many-{number}")
        with PoseStream(stub, vehicle) as stream:
            stream.receive_kind("opened")
            for batch in range(batches):
                stream.send(straight(size, first=1 + batch * size))
            stream.half_close()
            assert len(stream.receive_all()) <= batches

    def watch():
        while not over.is_set():
            pages.append(scraped.scrape(server))

    watcher = threading.Thread(target=watch)
    drivers = [threading.Thread(target=drive, args=(number,))
               for number in range(clients)]
    for thread in [watcher, *drivers]:
        thread.start()
    for thread in drivers:
        thread.join()
    over.set()
    watcher.join()

    page = once_calls_are_over(server)
    assert page.value("revisit_poses_accepted_total") == (
        clients * batches * size)
    assert page.value("revisit_ack_seconds_count") == clients * batches
    assert page.value("revisit_calls_total", method="StreamPoses",
                      code="OK") == clients
    # No counter ever falls.
    for before, after in zip(pages, [*pages[1:], page]):
        for key, value in before.samples.items():
            name = re.sub(r"_(bucket|count|sum)$", "", key[0])
            kind = before.kinds.get(key[0], before.kinds.get(name))
            if kind in ("counter", "histogram"):
                assert after.samples[key] >= value, key


def test_counts_searches_by_outcome_and_candidates_by_verdict(server):
    stub = server.stub()
    vehicle = create(stub, "searched")
    poses = laps(377 * 2)
    sets = []
    with PoseStream(stub, vehicle, send_candidates=True) as stream:
        stream.receive_kind("opened")
        for first in range(0, len(poses), 100):
            stream.send(poses[first:first + 100])
        stream.half_close()
        sets += [message for kind, message in stream.receive_all()
                 if kind == "candidates"]
    sets.append(stub.FindCandidates(
        api.FindCandidatesRequest(vehicle=vehicle)).candidates)
    # No search is begun.
    failure_of(lambda: stub.FindCandidates(api.FindCandidatesRequest(
        vehicle=vehicle, sequence=len(poses) + 1)))
    verdicts = collections.Counter(
        api.Verdict.Name(candidate.verdict).removeprefix("VERDICT_").lower()
        for found in sets for candidate in found.candidates)
    page = scraped.scrape(server)
    assert {dict(labels)["verdict"]: count for labels, count
            in page.series("revisit_candidates_total").items()
            if count} == verdicts
    assert verdicts["accepted"] > 0
    outcomes = {dict(labels)["outcome"]: count for labels, count
                in page.series("revisit_searches_total").items()}
    assert sum(outcomes.values()) == len(sets)
    assert outcomes["accepted"] == sum(
        any(candidate.verdict == api.VERDICT_ACCEPTED
            for candidate in found.candidates) for found in sets)
    assert page.value("revisit_search_seconds_count") == len(sets)
    assert page.value("revisit_search_nodes_sum") == sum(
        found.nodes_considered for found in sets)


def test_counts_decisions_that_are_stored(server):
    stub = server.stub()
    vehicle = create(stub, "decided")
    append(stub, vehicle, straight(40))
    for _ in range(2):
        # The second is there already.
        LOOP_CLOSURES.add(stub, vehicle, 20, 1, "loop")
        REJECTED_CANDIDATES.add(stub, vehicle, 30, 1, "rejection")
    LOOP_CLOSURES.add(stub, vehicle, 25, 2, "other")
    revision = [api.RevisePosesRequest(
        vehicle=vehicle, poses=straight(5, first=12, spacing=1.01),
        expected_revision=get(stub, vehicle).revision)]
    for _ in range(2):
        stub.RevisePoses(iter(revision))
    loop = f"{vehicle}/loopClosures/loop"
    LOOP_CLOSURES.delete(stub, loop)
    failure_of(lambda: LOOP_CLOSURES.delete(stub, loop))
    REJECTED_CANDIDATES.delete(stub, f"{vehicle}/rejectedCandidates/rejection")
    with PoseStream(stub, vehicle, acked_sequence=99,
                    vehicle_uid=get(stub, vehicle).uid) as stream:
        assert failure_of(stream.receive).reason == "DURABLE_SEQUENCE_REGRESSED"
    page = scraped.scrape(server)
    assert page.value("revisit_vehicles", state="data_loss") == 1
    stub.AcceptDataLoss(api.AcceptDataLossRequest(
        name=vehicle, durable_sequence=40))
    page = scraped.scrape(server)
    assert page.value("revisit_vehicles", state="active") == 1
    assert {dict(labels)["decision"]: count for labels, count
            in page.series("revisit_decisions_total").items()} == {
        "loop_closure_added": 2, "loop_closure_deleted": 1,
        "candidate_rejected": 1, "rejection_deleted": 1, "poses_revised": 1,
        "data_loss_accepted": 1}


def test_tells_when_the_last_backup_was_made(server, tmp_path):
    name = "revisit_store_backup_timestamp_seconds"
    assert scraped.scrape(server).series(name) == {}
    for copy in ("first", "second"):
        begin = int(time.time())
        made = run("revisitd", "backup", "--store", server.store, "--to",
                   tmp_path / copy)
        assert (made.returncode, made.stderr) == (0, "")
        assert begin <= scraped.scrape(server).value(name) <= time.time()
    # One that failed is none.
    before = scraped.scrape(server).value(name)
    assert run("revisitd", "backup", "--store", server.store, "--to",
               tmp_path / "second").returncode != 0
    assert scraped.scrape(server).value(name) == before


def test_backup_whose_time_cannot_be_noted_is_a_backup(server, tmp_path):
    # The note's place is taken by something that nobody can write over.
    (server.store / "revisit.sqlite.backup").mkdir()
    made = run("revisitd", "backup", "--store", server.store, "--to",
               tmp_path / "copy")
    assert made.returncode == 0
    assert "revisit.sqlite.backup: no metric will say" in made.stderr
    assert scraped.scrape(server).series(
        "revisit_store_backup_timestamp_seconds") == {}


def test_counts_what_each_limit_refuses(tmp_path):
    with Server(tmp_path / "store", *ADMIN, "--max-streams-per-vehicle", 1,
                "--max-search-rate-per-caller", 1) as server:
        stub = server.stub()
        vehicle = create(stub, "limited")
        with PoseStream(stub, vehicle) as stream:
            stream.receive_kind("opened")
            for _ in range(3):
                with PoseStream(stub, vehicle) as second:
                    assert failure_of(second.receive).reason == "STREAM_QUOTA"
        answers = []
        for _ in range(10):
            try:
                stub.FindCandidates(api.FindCandidatesRequest(vehicle=vehicle))
                answers.append(None)
            except Exception as error:  # Counted below.
                answers.append(error)
        refused = sum(answer is not None for answer in answers)
        assert refused > 0
        page = scraped.scrape(server)
        refusals = page.series("revisit_limit_refusals_total")
        assert {dict(labels)["limit"]: count for labels, count
                in refusals.items() if count} == {
            "max-streams-per-vehicle": 3,
            "max-search-rate-per-caller": refused}
        # A label of a limit is the name of a setting, or one of a few others.
        help_text = (ROOT / "server/settings/option_table.cc").read_text()
        others = {"caller-deadline", "descriptors",
                  "max-search-steps-per-second", "max-searches-share",
                  "max-unadmitted-calls", "max-unadmitted-pings"}
        for labels in refusals:
            limit = dict(labels)["limit"]
            assert limit in others or f'"{limit}"' in help_text, limit


def test_tells_when_certificates_and_keys_expire_and_were_loaded(tmp_path):
    authority = Authority()
    certificate = authority.issue("localhost", ends=3 * 86400)
    (tmp_path / "cert.pem").write_bytes(certificate.pem + authority.pem)
    (tmp_path / "key.pem").write_bytes(certificate.key_pem)
    with Server(tmp_path / "store", *ADMIN, "--tls-cert", tmp_path / "cert.pem",
                "--tls-key", tmp_path / "key.pem", "--security-check-seconds",
                0.1) as server:
        start = scraped.scrape(server)
        loaded = start.value("revisit_security_files_loaded_timestamp_seconds",
                             files="tls")
        now = start.value("process_start_time_seconds")
        assert abs(loaded - now) < 60
        expires = start.value(
            "revisit_tls_certificate_expiry_timestamp_seconds")
        assert abs(expires - now - 3 * 86400) < 120
        assert start.value("revisit_security_files_refused", files="tls") == 0

        (tmp_path / "cert.pem").write_text("garbage")
        wait_until(lambda: scraped.scrape(server).value(
            "revisit_security_files_refused", files="tls") == 1, "refusal")
        after = scraped.scrape(server)
        assert after.value("revisit_tls_certificate_expiry_timestamp_seconds"
                           ) == expires

        renewed = authority.issue("localhost", ends=20 * 86400)
        (tmp_path / "key.pem").write_bytes(renewed.key_pem)
        (tmp_path / "cert.pem").write_bytes(renewed.pem + authority.pem)
        wait_until(lambda: scraped.scrape(server).value(
            "revisit_tls_certificate_expiry_timestamp_seconds")
            > expires + 86400, "new certificate")
        page = scraped.scrape(server)
        assert page.value("revisit_security_files_refused", files="tls") == 0
        assert page.value("revisit_security_files_loaded_timestamp_seconds",
                          files="tls") > loaded


def test_no_label_grows_with_vehicles_or_callers(server):
    stub = server.stub()
    first = create(stub, "one")
    append(stub, first, straight(20))
    before = set(scraped.scrape(server).samples)
    for number in range(30):
        vehicle = create(stub, f"label-{number}")
        append(stub, vehicle, straight(20))
        LOOP_CLOSURES.add(stub, vehicle, 20, 1, f"loop-{number}")
    page = scraped.scrape(server)
    assert set(page.samples) == before
    assert "label-" not in page.text
