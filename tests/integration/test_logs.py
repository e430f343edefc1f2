"""Lines of the log that people follow up: changes, traces, what was slow, and how
much of it there is."""

import json
import re
import signal

import grpc
import pytest

from grouping import (add_link, add_member, add_vehicle, create_group, delete_group,
                      delete_link, get_group, remove_member, update_group,
                      update_member)
from identities import AUDIENCE, ISSUER, TokenKey, bearer, key_set
from revisit_server import Server, run, wait_until
from stubs import api
from wire import LOOP_CLOSURES, PoseStream, REJECTED_CANDIDATES, append, \
    failure_of, get, laps, straight

TRACE = "4bf92f3577b34da6a3ce929d0e0e4736"
PARENT = "00f067aa0ba902b7"
TRACEPARENT = ("traceparent", f"00-{TRACE}-{PARENT}-01")
USAGE = 64


def create(stub, name, **call):
    stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id=name), **call)
    return f"vehicles/{name}"


def lines(path, event=None):
    """The lines of a log in JSON that are whole, of one event."""
    if not path.exists():
        return []
    parsed = [json.loads(line)
              for line in path.read_text().splitlines(keepends=True)
              if line.endswith("\n")]
    return [line for line in parsed if event in (None, line["event"])]


def wait_for_lines(path, count, event=None):
    return wait_until(
        lambda: len(lines(path, event)) >= count and lines(path, event),
        f"{count} lines in {path}")


def test_audit_log_says_who_made_changed_and_removed_what(tmp_path):
    audit = tmp_path / "audit"
    with Server(tmp_path / "store", "--audit-log", audit, "--log-format",
                "json", "--log-level", "off") as server:
        stub = server.stub()
        vehicle = create(stub, "audited", metadata=[
            TRACEPARENT, ("x-request-id", "the-first")])
        append(stub, vehicle, straight(50))
        LOOP_CLOSURES.add(stub, vehicle, 40, 1, "closed")
        REJECTED_CANDIDATES.add(stub, vehicle, 50, 1, "rejected")
        failure_of(lambda: LOOP_CLOSURES.add(stub, vehicle, 41, 1, "closed"))
        LOOP_CLOSURES.delete(stub, f"{vehicle}/loopClosures/closed")
        get(stub, vehicle)
        stub.DeleteVehicle(api.DeleteVehicleRequest(name=vehicle))
        failure_of(lambda: stub.DeleteVehicle(
            api.DeleteVehicleRequest(name=vehicle)))
        found = wait_for_lines(audit, 7)
    assert [(line["method"], line.get("id"), line["code"]) for line in found
            ] == [
        ("CreateVehicle", None, "OK"), ("AddLoopClosure", "closed", "OK"),
        ("RejectCandidate", "rejected", "OK"),
        ("AddLoopClosure", "closed", "ALREADY_EXISTS"),
        ("DeleteLoopClosure", "closed", "OK"), ("DeleteVehicle", None, "OK"),
        ("DeleteVehicle", None, "NOT_FOUND")]
    assert {line["event"] for line in found} == {"audit"}
    assert {line["vehicle"] for line in found} == {"audited"}
    assert all(re.match(r"ipv[46]:", line["peer"]) for line in found)
    assert found[3]["reason"] == "LOOP_CLOSURE_EXISTS"
    assert (found[0]["request_id"], found[0]["trace_id"],
            found[0]["parent_id"]) == ("the-first", TRACE, PARENT)
    # They are in no other log.
    assert server.log() == ""


def test_audit_log_says_who_changed_groups(tmp_path):
    audit = tmp_path / "audit"
    with Server(tmp_path / "store", "--audit-log", audit, "--log-format",
                "json") as server:
        stub = server.stub()
        car, truck = (add_vehicle(stub, name) for name in ("car", "truck"))
        group = create_group(stub, "g").name
        update_group(stub, group, "display_name")
        for vehicle in (car, truck):
            add_member(stub, group, vehicle)
        update_member(stub, f"{group}/members/car")
        add_link(stub, group, (car, 1), (truck, 1), "gate")
        delete_link(stub, f"{group}/loopClosures/gate")
        remove_member(stub, f"{group}/members/car")
        get_group(stub, group)
        delete_group(stub, group)
        failure_of(lambda: delete_group(stub, group))
        found = wait_for_lines(audit, 12)[2:]
        called = server.logged('"GetGroup"')
    assert [(line["method"], line["group"], line.get("vehicle"), line.get("id"),
             line["code"]) for line in found] == [
        ("CreateGroup", "g", None, None, "OK"),
        ("UpdateGroup", "g", None, None, "OK"),
        ("AddGroupMember", "g", "car", None, "OK"),
        ("AddGroupMember", "g", "truck", None, "OK"),
        ("UpdateGroupMember", "g", "car", None, "OK"),
        ("AddInterVehicleLoopClosure", "g", None, "gate", "OK"),
        ("DeleteInterVehicleLoopClosure", "g", None, "gate", "OK"),
        ("RemoveGroupMember", "g", "car", None, "OK"),
        ("DeleteGroup", "g", None, None, "OK"),
        ("DeleteGroup", "g", None, None, "NOT_FOUND")]
    assert json.loads(called[0])["group"] == "g"


def test_audit_log_names_callers_and_what_they_were_refused(tmp_path):
    audit, key = tmp_path / "audit", TokenKey("EdDSA", "ed")
    (tmp_path / "keys.json").write_text(key_set(key))
    (tmp_path / "policy.json").write_text(json.dumps({
        "version": 1,
        "tenants": [{"name": "acme", "vehicle_prefix": "acme-"}],
        "grants": [{"token_subject": "writer", "tenant": "acme",
                    "vehicles": ["*"], "verbs": ["read", "write"]}]}))
    with Server(tmp_path / "store", "--audit-log", audit, "--log-format",
                "json", "--token-keys", tmp_path / "keys.json",
                "--token-issuer", ISSUER, "--token-audience", AUDIENCE,
                "--policy", tmp_path / "policy.json") as server:
        stub = server.stub()
        writer = bearer(key.token("writer"))
        vehicle = create(stub, "acme-1", metadata=writer)
        for metadata, code in [(writer, "PERMISSION_DENIED"),
                               ((), "UNAUTHENTICATED")]:
            with pytest.raises(grpc.RpcError) as refused:
                stub.DeleteVehicle(api.DeleteVehicleRequest(name=vehicle),
                                   metadata=metadata)
            assert refused.value.code().name == code
        made, denied, unknown = wait_for_lines(audit, 3)
    assert (made["tenant"], made["caller"], made["code"]) == (
        "acme", "token:writer", "OK")
    assert (denied["method"], denied["vehicle"], denied["caller"],
            denied["code"], denied["reason"]) == (
        "DeleteVehicle", "acme-1", "token:writer", "PERMISSION_DENIED",
        "NOT_GRANTED")
    assert "caller" not in unknown and "tenant" not in unknown
    assert unknown["code"] == "UNAUTHENTICATED"


def test_audit_log_goes_on_in_a_new_file_once_its_old_one_was_renamed(tmp_path):
    audit, old = tmp_path / "audit", tmp_path / "audit.1"
    with Server(tmp_path / "store", "--audit-log", audit, "--log-format",
                "json") as server:
        stub = server.stub()
        create(stub, "before")
        wait_for_lines(audit, 1)
        audit.rename(old)
        create(stub, "between")
        wait_for_lines(old, 2)
        assert not audit.exists()
        server.process.send_signal(signal.SIGUSR1)
        server.logged("audit_log_opened_again")
        create(stub, "after")
        assert wait_for_lines(audit, 1)[0]["vehicle"] == "after"
        assert [line["vehicle"] for line in lines(old)] == ["before", "between"]


def test_audit_log_that_cannot_be_opened_ends_the_start(tmp_path):
    result = run("revisitd", "--store", tmp_path / "store", "--listen",
                 "127.0.0.1:0", "--audit-log", tmp_path / "none/audit")
    assert result.returncode == USAGE
    assert str(tmp_path / "none/audit") in result.stderr


def test_lines_of_calls_name_the_trace_that_they_belong_to(tmp_path):
    with Server(tmp_path / "store", "--log-format", "json") as server:
        stub = server.stub()
        vehicle = create(stub, "traced", metadata=[TRACEPARENT])
        with PoseStream(stub, vehicle, metadata=[TRACEPARENT]) as stream:
            stream.receive_kind("opened")
            stream.send(straight(1))
            stream.receive_kind("ack")
        for malformed in ["", "00-zz", TRACEPARENT[1].upper()]:
            create(stub, vehicle.split("/")[1],
                   metadata=[("traceparent", malformed)])
        calls = wait_for_lines(server.log_path, 5, "call")
    traced = [call for call in calls if "trace_id" in call]
    assert sorted(call["method"] for call in traced) == [
        "CreateVehicle", "StreamPoses"]
    assert {(call["trace_id"], call["parent_id"]) for call in traced} == {
        (TRACE, PARENT)}
    assert all("parent_id" not in call for call in calls if call not in traced)


def test_slow_calls_are_logged_with_what_their_search_had_to_do(tmp_path):
    with Server(tmp_path / "store", "--log-format", "json", "--log-level",
                "warning", "--slow-call-seconds", 1e-6) as server:
        stub = server.stub()
        vehicle = create(stub, "slow")
        with PoseStream(stub, vehicle, send_candidates=True) as stream:
            stream.receive_kind("opened")
            stream.send(laps(377 * 2)[:700])
            stream.receive_kind("ack")
            stream.receive_kind("candidates")
        found = stub.FindCandidates(
            api.FindCandidatesRequest(vehicle=vehicle),
            metadata=[TRACEPARENT]).candidates
        calls = wait_for_lines(server.log_path, 2, "slow_call")
        searches = wait_for_lines(server.log_path, 1, "slow_search")
    made, searched = calls
    assert (made["method"], made["vehicle"]) == ("CreateVehicle", "slow")
    assert "search_ms" not in made
    assert searched["method"] == "FindCandidates"
    assert searched["candidates"] == len(found.candidates)
    assert searched["nodes_considered"] == found.nodes_considered
    assert searched["nodes_pruned"] == found.nodes_pruned
    assert searched["comparisons"] > 0
    assert 0 < searched["search_ms"] <= searched["duration_ms"]
    assert searched["trace_id"] == TRACE
    assert {line["method"] for line in searches} == {"StreamPoses"}
    assert all(line["vehicle"] == "slow" and "outcome" in line
               for line in searches)


@pytest.mark.parametrize("flags", [(), ("--slow-call-seconds", 3600)])
def test_calls_that_are_not_slow_are_not_logged_as_such(flags, tmp_path):
    with Server(tmp_path / "store", *flags) as server:
        stub = server.stub()
        vehicle = create(stub, "quick")
        append(stub, vehicle, straight(10))
        stub.FindCandidates(api.FindCandidatesRequest(vehicle=vehicle))
        server.logged("FindCandidates")
        assert not re.search(r" slow_(call|search) ", server.log())


def test_level_of_the_log_changes_while_the_server_runs(tmp_path):
    with Server(tmp_path / "store", "--log-level", "error", "--log-format",
                "json") as server:
        stub = server.stub()
        create(stub, "unseen")
        for level in ["warning", "info", "debug", "error"]:
            server.process.send_signal(signal.SIGUSR2)
            wait_until(lambda level=level: [
                line["name"] for line in lines(server.log_path, "log_level")
            ][-1:] == [level], level)
            create(stub, f"at-{level}")
        server.process.send_signal(signal.SIGUSR2)
        wait_for_lines(server.log_path, 5, "log_level")
        calls = [line["vehicle"] for line in lines(server.log_path, "call")]
        assert calls == ["at-info", "at-debug"]


def test_log_that_is_off_can_be_switched_on(tmp_path):
    with Server(tmp_path / "store", "--log-level", "off") as server:
        stub = server.stub()
        create(stub, "unseen")
        for level in ["error", "warning", "info"]:
            server.process.send_signal(signal.SIGUSR2)
            server.logged(f"log_level name={level}")
        with grpc.insecure_channel(server.address):
            create(stub, "seen")
        server.logged("vehicle=seen")
        assert "unseen" not in server.log()
