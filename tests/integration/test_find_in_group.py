"""`revisit find --group` against a real server: candidates name their vehicle, the
words that it prints link the two, and what was not searched is told."""

import json
import re

import pytest

from revisit_server import clean_environment, run, wait_until
from wire import BOREAS, append, batches, boreas

# The drive comes back to its first road where the second day begins.
FIRST_DAY = 1079
USAGE = 64


@pytest.fixture(scope="module")
def revisit(server):
    """Runs `revisit` against the server; answers the finished process."""
    def call(*arguments):
        return run("revisit", *arguments, "--server", server.address,
                   env=clean_environment())
    return call


def succeeded(result):
    assert result.returncode == 0, result
    return result.stdout


@pytest.fixture(scope="module", autouse=True)
def fleet(revisit, stub):
    """The two days of the shipped drive as two vehicles of a group, and a third one
    that is no planar vehicle."""
    poses, _ = boreas()
    second = poses[FIRST_DAY:]
    for sequence, pose in enumerate(second, 1):
        pose.sequence = sequence
    for vehicle, drive in (("shuttle-7", poses[:FIRST_DAY]), ("shuttle-8", second)):
        succeeded(revisit("vehicle", "create", vehicle))
        for batch in batches(drive, 1000):
            append(stub, f"vehicles/{vehicle}", batch)
    succeeded(revisit("vehicle", "create", "drone", "--state-space", "spatial"))
    succeeded(revisit("group", "create", "depot"))
    for vehicle in ("shuttle-7", "shuttle-8", "drone"):
        succeeded(revisit("group", "add", "depot", vehicle))


def test_candidates_of_another_vehicle_are_named(revisit):
    text = succeeded(revisit("find", "shuttle-8", "--group", "depot"))
    assert re.search(r"^RANK +VEHICLE +SEQUENCE ", text, re.MULTILINE), text
    assert re.search(r"^ +1 +vehicles/shuttle-7 +\d+ ", text, re.MULTILINE), text
    assert re.search(r"^ +\d +itself +\d+ ", text, re.MULTILINE), text
    assert re.search(r"^searched 1 other vehicle with \d+ nodes, as they were up to "
                     r"\d+\.\d s ago; revision 4 of the group$", text, re.MULTILINE)
    assert re.search(r"^not searched, since its state space is another one: "
                     r"vehicles/drone$", text, re.MULTILINE), text
    wide = succeeded(revisit("find", "shuttle-8", "--group", "depot", "-o", "wide"))
    assert re.search(r"^SEARCHED +NODES +LAST SEQUENCE +LAG s\n"
                     rf"vehicles/shuttle-7 +\d+ +{FIRST_DAY} +", wide, re.MULTILINE)


def test_only_the_histories_that_are_asked_for_are_searched(revisit):
    def vehicles(*flags):
        found = json.loads(succeeded(revisit(
            "find", "shuttle-8", "--group", "depot", "--json", *flags)))
        return {candidate["matchedVehicle"] for candidate in found["candidates"]}

    assert vehicles() == {"vehicles/shuttle-7", ""}
    assert vehicles("--exclude-own") == {"vehicles/shuttle-7"}
    assert vehicles("--in", "drone") == {""}
    assert vehicles("--in", "shuttle-7,drone", "--exclude-own",
                    "--partial") == {"vehicles/shuttle-7"}
    nobody = revisit("find", "shuttle-8", "--group", "depot", "--in", "nobody")
    assert nobody.returncode == 64 + 5 and "MEMBER_NOT_FOUND" in nobody.stderr
    nothing = revisit("find", "shuttle-8", "--group", "nothing")
    assert nothing.returncode == 64 + 5 and "GROUP_NOT_FOUND" in nothing.stderr
    assert revisit("find", "shuttle-8", "--partial").returncode == USAGE


def test_a_stream_names_the_vehicles_that_its_checks_find(revisit):
    stream = ["stream", str(BOREAS), "--vehicle", "shuttle-9", "--create",
              "--candidates", "--group", "depot", "--in", "shuttle-7,drone",
              "--exclude-own"]
    text = succeeded(revisit(*stream))
    assert text.count("check at ") > 200
    assert re.search(r"^check at sequence 20\d\d, .* of vehicles/shuttle-7, ", text,
                     re.MULTILINE), text
    # Told once, since it stays so.
    assert text.count("not searched, since its state space is another one: "
                      "vehicles/drone\n") == 1
    stream[3] = "shuttle-10"
    found = [json.loads(line) for line in
             succeeded(revisit(*stream, "--partial", "--json")).splitlines()]
    checks = [line for line in found if "groupRevision" in line]
    assert len(checks) == found[-1]["checks"] > 200
    assert {candidate["matchedVehicle"] for check in checks
            for candidate in check["candidates"]} == {"vehicles/shuttle-7"}
    nothing = revisit(*stream[:4], "--candidates", "--group", "nothing")
    assert nothing.returncode == 64 + 5 and "GROUP_NOT_FOUND" in nothing.stderr
    assert revisit(*stream[:4], "--group", "depot").returncode == USAGE
    assert revisit(*stream[:4], "--candidates", "--partial").returncode == USAGE


def test_a_map_shows_the_group_in_the_frame_of_one_vehicle(revisit, tmp_path):
    drawing = ["map", "shuttle-8", "--group", "depot", "--exclude-own",
               "--check-interval", "400"]
    drawn = succeeded(revisit(*drawing, "--svg"))
    assert "among 1 other vehicle of groups/depot" in drawn
    assert "shuttle-7: tied by nothing, drawn beside the others" in drawn
    assert "shuttle-8: the frame of the map" in drawn
    assert int(re.search(r"accepted: (\d+)", drawn).group(1)) > 5
    page = tmp_path / "depot.html"
    succeeded(revisit(*drawing, "--output", str(page)))
    assert "shuttle-7: tied by nothing" in page.read_text()
    assert revisit(*drawing, "--geojson").returncode == USAGE
    nothing = revisit("map", "shuttle-8", "--group", "nothing")
    assert nothing.returncode == 64 + 5 and "GROUP_NOT_FOUND" in nothing.stderr


def test_the_words_that_are_printed_link_the_two_vehicles(revisit):
    find = ["find", "shuttle-8", "--group", "depot", "--exclude-own"]
    words = succeeded(revisit(*find, "-o", "name")).splitlines()[0].split()
    assert re.fullmatch(r"shuttle-8@\d+ shuttle-7@\d+", " ".join(words))
    revision = json.loads(succeeded(revisit(
        "link", "add", "depot", *words, "--json")))["revision"]

    def answer():
        found = json.loads(succeeded(revisit(*find, "--json")))
        return found if found["groupRevision"] >= revision else None

    wait_until(answer, "search that knows the link")
    assert answer()["candidates"][0]["frameState"] == "FRAME_STATE_PROVISIONAL"
    succeeded(revisit("link", "delete", "depot", *words))
