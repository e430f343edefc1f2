"""The whole API from the command line, as a shell sees it: what is listed, what
is undone, what is asked before it is lost."""

import json
import os
import pty
import re
import subprocess

import pytest

from revisit_server import BIN, clean_environment, run, wait_until
from stubs import api
from watching import wait_until_paid
from wire import append, laps, straight

USAGE = 64


@pytest.fixture(scope="module")
def revisit(server):
    """Runs `revisit` against the server; answers the finished process."""
    def call(*arguments, **environment):
        return run("revisit", *arguments, "--server", server.address,
                   env=clean_environment(**environment))
    call.address = server.address
    return call


@pytest.fixture
def vehicle(revisit, stub):
    """The id of a vehicle with 200 poses, which is deleted afterwards."""
    assert revisit("vehicle", "create", "api-1", "--correlation-model",
                   "independent").returncode == 0
    append(stub, "vehicles/api-1", straight(200))
    yield "api-1"
    revisit("vehicle", "delete", "api-1", "--yes")


def listed(result):
    assert result.returncode == 0, result
    return json.loads(result.stdout)


def test_names_and_labels_are_given_changed_and_removed(revisit):
    create = ["vehicle", "create", "named", "--display-name", "Golf 3",
              "--label", "site=north", "--label", "note=a=b"]
    assert revisit(*create).returncode == 0
    shown = revisit("vehicle", "get", "named").stdout
    for line in (r"display name +Golf 3", r"label note +a=b",
                 r"label site +north"):
        assert re.search(f"^{line}$", shown, re.MULTILINE), shown
    changed = listed(revisit(
        "vehicle", "update", "named", "--display-name", "", "--label",
        "site=south", "--remove-label", "note", "--json"))
    assert changed.get("displayName", "") == ""
    assert changed["labels"] == {"site": "south"}
    wrong = revisit("vehicle", "update", "named", "--label", "site")
    assert wrong.returncode == USAGE
    assert 'got "site"; expected KEY=VALUE' in wrong.stderr
    refused = revisit("vehicle", "update", "named", "--label", "Site=x")
    assert refused.returncode == 64 + 3
    assert revisit("vehicle", "delete", "named", "--yes").returncode == 0


def test_mistaken_confirm_is_undone(vehicle, revisit):
    before = listed(revisit("vehicle", "get", vehicle, "--json"))
    assert revisit("confirm", vehicle, 150, 20).returncode == 0
    assert revisit("confirm", vehicle, 160, 30).returncode == 0
    closures = listed(revisit("closures", "list", vehicle, "--json"))
    assert [(closure["querySequence"], closure["matchedSequence"])
            for closure in closures["loopClosures"]] == [(150, 20), (160, 30)]
    by_poses = revisit("closures", "delete", vehicle, 150, 20)
    assert by_poses.stdout == (
        "deleted vehicles/api-1/loopClosures/150-20, revision 5\n")
    by_id = listed(revisit("closures", "delete", vehicle, "160-30", "--json"))
    assert by_id == {"name": "vehicles/api-1/loopClosures/160-30",
                     "revision": 6}
    after = listed(revisit("vehicle", "get", vehicle, "--json"))
    assert after["loopClosureCount"] == before["loopClosureCount"] == 0
    again = revisit("closures", "delete", vehicle, 150, 20)
    assert again.returncode == 64 + 5
    assert "has no loop closure of the poses 150 and 20" in again.stderr


def test_mistaken_reject_is_undone(vehicle, revisit):
    assert revisit("reject", vehicle, 150, 20, "--note",
                   "a bridge\nabove").returncode == 0
    table = revisit("rejections", "list", vehicle).stdout.splitlines()
    assert table[0].split() == ["ID", "QUERY_SEQ", "MATCHED_SEQ", "CREATED",
                                "DECIDED_BY", "NOTE"]
    assert table[1].split()[:3] == ["150-20", "150", "20"]
    assert table[1].endswith("  a bridge above")
    [rejected] = listed(revisit("rejections", "list", vehicle, "--json"))[
        "rejectedCandidates"]
    assert rejected["note"] == "a bridge\nabove"
    assert revisit("rejections", "delete", vehicle, 150, 20).returncode == 0
    assert listed(revisit("rejections", "list", vehicle, "--json"))[
        "rejectedCandidates"] == []
    [undone] = listed(revisit("deletions", "list", vehicle, "--json"))[
        "deletedPosePairs"]
    assert undone["rejectedCandidate"] == rejected
    assert undone["deletedBy"] == ""
    _, row = revisit("deletions", "list", vehicle).stdout.splitlines()
    assert row.split()[1:5] == ["-", "rejected", "150", "20"]


def test_one_pair_is_not_both_confirmed_and_rejected(vehicle, revisit):
    assert revisit("confirm", vehicle, 150, 20).returncode == 0
    conflict = revisit("reject", vehicle, 150, 20)
    assert conflict.returncode == 64 + 9
    assert "150 and 20 are the loop closure '150-20'" in conflict.stderr
    undo = conflict.stderr.splitlines()[-1]
    assert undo == ("undo that first: revisit closures delete api-1 150 20")
    assert revisit(*undo.split(" revisit ")[1].split()).returncode == 0
    assert revisit("reject", vehicle, 150, 20).returncode == 0
    conflict = revisit("confirm", vehicle, 150, 20, "--json")
    assert conflict.returncode == 64 + 9
    assert "revisit rejections delete api-1 150 20" in json.loads(
        conflict.stderr)["error"]["hint"]


@pytest.mark.parametrize("words", [["150"], ["2", "1", "3"], ["a", "1"],
                                   ["0", "1"],
                                   ["vehicles/other/loopClosures/1"]],
                         ids=str)
def test_what_names_no_closure_deletes_none(words, vehicle, revisit):
    assert revisit("confirm", vehicle, 150, 20).returncode == 0
    result = revisit("closures", "delete", vehicle, *words)
    assert result.returncode in (USAGE, 64 + 5), result
    closures = listed(revisit("closures", "list", vehicle, "--json"))
    assert len(closures["loopClosures"]) == 1


def test_closures_of_all_pages_are_listed(vehicle, revisit, stub):
    for i in range(30):
        stub.AddLoopClosure(api.AddLoopClosureRequest(
            parent=f"vehicles/{vehicle}", loop_closure=api.LoopClosure(
                query_sequence=150 + i, matched_sequence=20)))
    closures = listed(revisit("closures", "list", vehicle, "--json"))
    assert len(closures["loopClosures"]) == 30


def test_poses_are_listed_from_one_to_another(vehicle, revisit):
    poses = listed(revisit("poses", "list", vehicle, "--json"))["poses"]
    assert [pose["sequence"] for pose in poses] == list(range(1, 201))
    assert len(poses[0]["covariance"]["values"]) == 6
    few = listed(revisit("poses", "list", vehicle, "--from", 7, "--to", 9,
                         "--json"))["poses"]
    assert few == poses[6:9]
    table = revisit("poses", "list", vehicle, "--from", 200).stdout
    assert [line.split()[0] for line in table.splitlines()] == ["SEQUENCE",
                                                               "200"]
    swapped = revisit("poses", "list", vehicle, "--from", 9, "--to", 7)
    assert swapped.returncode == USAGE
    assert "--from: got 9; allowed is at most --to, 7" in swapped.stderr


def test_info_is_what_the_server_says(server, revisit, stub):
    info = stub.GetServerInfo(api.GetServerInfoRequest())
    said = listed(revisit("info", "--json"))
    assert said["version"] == info.version
    assert said["maxMessageBytes"] == info.max_message_bytes
    text = revisit("info").stdout
    assert server.address in text
    assert f"at most {info.max_batch_poses}" in text


def test_deletion_needs_yes_where_nobody_can_be_asked(vehicle, revisit):
    refused = revisit("vehicle", "delete", vehicle)
    assert refused.returncode == USAGE
    assert "--yes is required" in refused.stderr
    assert revisit("vehicle", "get", vehicle).returncode == 0
    deleted = revisit("vehicle", "delete", vehicle, "--yes", "--json")
    assert listed(deleted) == {"deleted": [f"vehicles/{vehicle}"]}
    assert revisit("vehicle", "get", vehicle).returncode == 64 + 5


def at_terminal(arguments, typed, **environment):
    """Exit code of `revisit` at a terminal of its own, and what that shows."""
    mine, its = pty.openpty()
    with subprocess.Popen([BIN / "revisit", *map(str, arguments)], stdin=its,
                          stdout=its, stderr=its,
                          env=clean_environment(**environment)) as process:
        os.close(its)
        os.write(mine, typed.encode())
        shown = b""
        try:
            while chunk := os.read(mine, 4096):
                shown += chunk
        except OSError:
            # The program has closed its end.
            pass
        code = process.wait(30)
    os.close(mine)
    return code, shown.decode()


def test_deletion_at_a_terminal_wants_the_id(vehicle, server, revisit):
    arguments = ["vehicle", "delete", vehicle, "--server", server.address]
    code, shown = at_terminal(arguments, "yes\n")
    assert code == 1
    assert "with its 200 poses and 0 loop closures" in shown
    assert 'is not deleted: got "yes"' in shown
    assert revisit("vehicle", "get", vehicle).returncode == 0
    code, shown = at_terminal(arguments, f"{vehicle}\n")
    assert code == 0, shown
    assert f"deleted vehicles/{vehicle}" in shown
    assert revisit("vehicle", "get", vehicle).returncode == 64 + 5


def test_whole_numbers_have_one_form_in_json(vehicle, revisit):
    """All are numbers, however many bits the field of the message has."""
    got = listed(revisit("vehicle", "get", vehicle, "--json"))
    shown = listed(revisit("show", vehicle, "--json"))
    assert got["durableSequence"] == 200
    assert got["settings"]["maxCandidates"] == 5
    assert shown["vehicle"] == got
    assert shown["nodeCount"] == got["nodeCount"]


@pytest.mark.parametrize("width", [40, 60, 80, 200])
def test_tables_keep_to_the_width_of_the_terminal(width, vehicle, revisit):
    assert revisit("confirm", vehicle, 150, 20, "--note", "seen").returncode == 0
    for words in (["vehicle", "list"], ["poses", "list", vehicle],
                  ["closures", "list", vehicle]):
        result = revisit(*words, COLUMNS=str(width))
        assert result.returncode == 0, result
        assert max(map(len, result.stdout.splitlines())) <= width, words


def test_what_goes_into_a_pipe_is_a_whole_table(vehicle, revisit):
    lines = revisit("vehicle", "list").stdout.splitlines()
    assert lines[0].split()[0] == "VEHICLE"
    assert sum(line.startswith(f"vehicles/{vehicle} ") for line in lines) == 1


def test_vin_becomes_an_id_as_the_help_says(revisit):
    shown = " ".join(run("revisit", "vehicle", "create", "--help").stdout.split())
    assert "WVWZZZ1JZXW000001 is wvwzzz1jzxw000001" in shown
    assert revisit("vehicle", "create",
                   "WVWZZZ1JZXW000001").returncode == 64 + 3
    assert revisit("vehicle", "create", "wvwzzz1jzxw000001").returncode == 0
    assert revisit("vehicle", "delete", "wvwzzz1jzxw000001",
                   "--yes").returncode == 0


@pytest.fixture
def lapped(revisit, stub):
    """The id of a vehicle that has driven one lap three times, all checks stored."""
    assert revisit("vehicle", "create", "api-2", "--checks", "stored",
                   "--sequence-length", 20, "--check-interval", 10,
                   "--node-spacing", 1).returncode == 0
    append(stub, "vehicles/api-2", laps(1140))
    wait_until_paid(stub, "vehicles/api-2")
    yield "api-2"
    revisit("vehicle", "delete", "api-2", "--yes")


def test_open_candidates_are_reviewed_at_a_terminal(lapped, server, revisit):
    def opened():
        listed_checks = listed(revisit("checks", lapped, "--state", "open",
                                       "--by", "value", "--json"))["checks"]
        return [state["name"] for check in listed_checks
                for state in check["states"]
                if state["state"] == "CANDIDATE_STATE_OPEN"]

    before = opened()
    code, shown = at_terminal(["review", lapped, "--server", server.address],
                              "c\nr\nu\ns\nq\n")
    assert code == 0, shown
    assert shown.count("told then") == 5
    assert "1 confirmed, 0 rejected, 1 skipped" in shown
    [confirmed] = re.findall(r"confirmed (vehicles/\S+)", shown)
    [rejected] = re.findall(r"rejected (vehicles/\S+)", shown)
    assert {confirmed, rejected} <= set(before) and rejected != confirmed
    assert re.findall(r"undone (vehicles/\S+)", shown) == [rejected]
    after = opened()
    assert confirmed not in after and rejected in after
    [closure] = listed(revisit("closures", "list", lapped, "--json"))[
        "loopClosures"]
    check = listed(revisit("checks", lapped, "--sequence",
                           confirmed.split("/")[3], "--json"))
    assert [state["decision"] for state in check["states"]
            if state["name"] == confirmed] == [closure["name"]]


def test_contradicted_closure_is_listed_and_upheld(lapped, revisit):
    checks = listed(revisit("checks", lapped, "--state", "open", "--json"))["checks"]
    *right, wrong = checks[::4]
    for check in right:
        best = check["candidates"]["candidates"][0]
        assert revisit("confirm", lapped, best["query"]["sequence"],
                       best["matched"]["sequence"]).returncode == 0
    assert listed(revisit("contradictions", lapped, "--json"))[
        "contradictions"] == []
    query = wrong["candidates"]["query"]["sequence"]
    # Half a lap away from all that agree.
    made = revisit("confirm", lapped, query, query - 190, "--candidate",
                   wrong["states"][0]["name"], "-o", "name").stdout
    assert revisit("contradictions", lapped, "-o", "name").stdout == made
    titles, row = revisit("contradictions", lapped).stdout.splitlines()
    assert titles.split()[:4] == ["ID", "P-VALUE", "QUERY_SEQ", "MATCHED_SEQ"]
    assert row.split()[2:4] == [str(query), str(query - 190)]

    def first():
        return listed(revisit("checks", lapped, "--by", "value", "--json"))[
            "checks"][0]["states"]

    wait_until(lambda: any(state["cause"] == "CANDIDATE_CAUSE_CONTRADICTION"
                           for state in first()), "second look")
    reviewed = subprocess.run(
        [BIN / "revisit", "review", lapped, "--server", revisit.address],
        input="c\nq\n", text=True, capture_output=True, timeout=60, check=True,
        env=clean_environment())
    assert "contradicted: the loop closure" in reviewed.stdout
    assert f"upheld {wrong['states'][0]['name']}\n" in reviewed.stdout
    assert made.strip() in [closure["name"] for closure in listed(
        revisit("closures", "list", lapped, "--json"))["loopClosures"]]
    assert not any(state["cause"] == "CANDIDATE_CAUSE_CONTRADICTION"
                   for state in first())
