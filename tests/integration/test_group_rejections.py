"""Candidates between vehicles that a verifier has rejected: they are not offered again
to either of the two, and their poses are no loop closure."""

import json
import sqlite3

import grpc
import pytest

from grouping import (add_link, add_member, add_vehicle, create_group, delete_link,
                      delete_rejected, get_group, links_of, reject, rejected_of,
                      rejected_pages, remove_member)
from revisit_server import Server, clean_environment, run, wait_until
from scraped import scrape
from stubs import api
from wire import append, batches, boreas, decode_failure, failure_of

Code = grpc.StatusCode
# The drive comes back to its first road where the second day begins.
FIRST_DAY = 1079
# Along the path, in metres.
RADIUS = 10.0


@pytest.fixture(name="depot", scope="module")
def fixture_depot(stub):
    """The two days of the shipped drive as two vehicles of a group."""
    poses, _ = boreas()
    second = poses[FIRST_DAY:]
    for sequence, pose in enumerate(second, 1):
        pose.sequence = sequence
    group = create_group(stub, "depot").name
    for vehicle, drive in (("seven", poses[:FIRST_DAY]), ("eight", second)):
        name = add_vehicle(stub, vehicle, poses=0)
        for batch in batches(drive, 1000):
            append(stub, name, batch)
        add_member(stub, group, name)
    return group


def search(stub, group, vehicle, sequence=0):
    """What a search answers that knows the group as it is."""
    revision = get_group(stub, group).revision
    request = api.FindCandidatesRequest(vehicle=vehicle, sequence=sequence)
    request.options.scope.CopyFrom(api.SearchScope(group=group, exclude_own=True))
    found = []

    def is_new():
        try:
            found.append(stub.FindCandidates(request).candidates)
        except grpc.RpcError as error:
            if decode_failure(error).reason != "GROUP_NOT_READY":
                raise
            return False
        return found[-1].group_revision >= revision

    wait_until(is_new, "search that knows the group as it is")
    return found[-1]


def near(candidates, place):
    """Those within the radius of a place in the other vehicle."""
    return [one for one in candidates if abs(
        one.matched.travelled_meters - place.travelled_meters) <= RADIUS]


def test_rejected_place_is_not_offered_again_until_that_is_undone(stub, depot):
    query, other = "vehicles/eight", "vehicles/seven"
    found = search(stub, depot, query)
    best = found.candidates[0]
    assert best.matched_vehicle == other
    state = best.frame_state
    told = reject(stub, depot, (query, best.query.sequence),
                  (other, best.matched.sequence), note="other hall")
    assert told.revision == get_group(stub, depot).revision
    after = search(stub, depot, query)
    assert near(found.candidates, best.matched)
    assert not near(after.candidates, best.matched)
    # It ties no frames.
    assert all(one.frame_state == state for one in after.candidates)
    # Farther along its road the place may be offered.
    before = search(stub, depot, query, best.query.sequence - 60)
    assert before.candidates
    delete_rejected(stub, told.rejected_candidate.name)
    again = search(stub, depot, query)
    assert [one.matched.sequence for one in again.candidates] == [
        one.matched.sequence for one in found.candidates]
    # Whichever of the two asked.
    name = reject(stub, depot, (other, best.matched.sequence),
                  (query, best.query.sequence)).rejected_candidate.name
    assert not near(search(stub, depot, query).candidates, best.matched)
    delete_rejected(stub, name)


def test_rejection_has_the_words_of_its_neighbours(stub, depot):
    one, two = ("vehicles/eight", 5), ("vehicles/seven", 6)
    told = reject(stub, depot, one, two, "gate", "other hall")
    made = told.rejected_candidate
    assert made.name == f"{depot}/rejectedCandidates/gate"
    assert (made.query.vehicle, made.query.sequence) == one
    assert (made.matched.vehicle, made.matched.sequence) == two
    assert made.note == "other hall" and made.create_time.ToNanoseconds() > 0
    assert reject(stub, depot, one, two, "gate", "other hall") == told
    failure = failure_of(lambda: reject(stub, depot, one, two, "gate"))
    assert (failure.code, failure.reason) == (
        Code.ALREADY_EXISTS, "REJECTED_CANDIDATE_EXISTS")
    # Both kinds have ids of their own, but not both the same poses.
    for query, matched in ((one, two), (two, one)):
        failure = failure_of(lambda q=query, m=matched: add_link(stub, depot, q, m))
        assert (failure.code, failure.reason, failure.metadata["name"]) == (
            Code.FAILED_PRECONDITION, "POSE_PAIR_CONFLICT", made.name)
    closure = add_link(stub, depot, one, ("vehicles/seven", 7), "gate").loop_closure
    assert rejected_of(stub, depot) == [made]
    assert links_of(stub, depot) == [closure]
    failure = failure_of(lambda: reject(stub, depot, ("vehicles/seven", 7), one))
    assert failure.metadata["name"] == closure.name
    # A damaged id or a wrong one says which kind is not there.
    failure = failure_of(lambda: delete_rejected(
        stub, f"{depot}/rejectedCandidates/nothing"))
    assert (failure.code, failure.reason) == (
        Code.NOT_FOUND, "REJECTED_CANDIDATE_NOT_FOUND")
    assert "'nothing'" in failure.message
    failure = failure_of(lambda: delete_link(stub, f"{depot}/loopClosures/nothing"))
    assert failure.reason == "LOOP_CLOSURE_NOT_FOUND"
    delete_link(stub, closure.name)
    assert rejected_of(stub, depot) == [made]
    delete_rejected(stub, made.name)
    assert rejected_of(stub, depot) == []


def test_rejections_are_listed_page_by_page_and_leave_with_a_member(stub):
    group = create_group(stub, "paged").name
    names = [add_vehicle(stub, f"paged-{n}") for n in range(3)]
    for name in names:
        add_member(stub, group, name)
    made = [reject(stub, group, (names[n % 2], 1), (names[2], 1 + n),
                   f"r{n}").rejected_candidate for n in range(4)]
    add_link(stub, group, (names[0], 1), (names[1], 1), "r2")
    for size in (1, 3, 4):
        pages = rejected_pages(stub, group, size)
        assert [one for page in pages for one in page] == made
        assert all(len(page) <= size for page in pages)
    failure = failure_of(lambda: reject(stub, group, (names[0], 1), (names[1], 99)))
    assert failure.reason == "POSE_NOT_FOUND"
    failure = failure_of(lambda: reject(stub, group, (names[0], 0), (names[0], 1)))
    assert failure.fields == ["rejected_candidate.query.sequence",
                              "rejected_candidate.matched.vehicle"]
    remove_member(stub, f"{group}/members/paged-0")
    assert rejected_of(stub, group) == made[1::2]


def test_rejections_outlive_their_server_and_damage_is_told(tmp_path):
    with Server(tmp_path / "store") as server:
        stub = server.stub()
        group = create_group(stub, "g").name
        car, truck = (add_vehicle(stub, name) for name in ("car", "truck"))
        for name in (car, truck):
            add_member(stub, group, name)
        add_link(stub, group, (car, 3), (truck, 3), "a")
        for name in ("a", "b"):
            reject(stub, group, (car, 1 + (name == "b")), (truck, 1), name)
        before = rejected_of(stub, group)
        server.kill()
    with Server(tmp_path / "store") as server:
        assert rejected_of(server.stub(), group) == before
    database = sqlite3.connect(tmp_path / "store" / "revisit.sqlite")
    with database:
        assert database.execute("UPDATE group_links SET checksum = checksum + 1 "
                                "WHERE state = 4 AND id LIKE '%a'").rowcount == 1
    database.close()
    with Server(tmp_path / "store") as server:
        stub = server.stub()
        assert len(links_of(stub, group)) == 1
        failure = failure_of(lambda: rejected_pages(stub, group, 1))
        assert (failure.code, failure.reason) == (Code.DATA_LOSS, "STORE_CORRUPT")
        delete_rejected(stub, f"{group}/rejectedCandidates/a")
        assert rejected_of(stub, group) == before[1:]


def test_decisions_between_vehicles_are_counted_once(tmp_path):
    with Server(tmp_path / "store", "--admin-listen", "127.0.0.1:0") as server:
        stub = server.stub()
        group = create_group(stub, "g").name
        car, truck = (add_vehicle(stub, name) for name in ("car", "truck"))
        for name in (car, truck):
            add_member(stub, group, name)
        for _ in range(2):
            closure = add_link(stub, group, (car, 1), (truck, 1), "a").loop_closure
            rejected = reject(stub, group, (car, 2), (truck, 1), "a").rejected_candidate
        delete_link(stub, closure.name)
        delete_rejected(stub, rejected.name)
        failure_of(lambda: delete_link(stub, closure.name))
        page = scrape(server)
        assert {decision: page.value("revisit_decisions_total", decision=decision)
                for decision in ("loop_closure_added", "loop_closure_deleted",
                                 "candidate_rejected", "rejection_deleted")} == {
            "loop_closure_added": 1, "loop_closure_deleted": 1,
            "candidate_rejected": 1, "rejection_deleted": 1}


def test_command_line_rejects_lists_and_undoes(server, stub, depot):
    def revisit(*words):
        done = run("revisit", *words, "--server", server.address,
                   env=clean_environment())
        assert done.returncode == 0, done
        return done.stdout

    words = ("eight@50", "seven@60")
    made = json.loads(revisit("link", "reject", "depot", *words, "--note",
                              "other hall", "--json"))["rejectedCandidate"]
    assert json.loads(revisit("link", "list", "depot", "--rejected", "--json"))[
        "rejectedCandidates"] == [made]
    assert "other hall" in revisit("link", "list", "depot", "--rejected")
    assert revisit("link", "list", "depot", "-o", "name") == ""
    revisit("link", "delete", "depot", *words, "--rejected")
    assert rejected_of(stub, depot) == []
