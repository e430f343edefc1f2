"""Groups of vehicles from the command line, against a real server: what is created,
added, linked, listed and undone, and what is refused."""

import json
import re

import pytest

from revisit_server import clean_environment, run
from wire import append, straight

USAGE = 64
MEASURED = ["--relative", "1.25,-0.5,0.03", "--covariance",
            "0.04,0,0,0.04,0,0.0004", "--note", "icp", "--score", "0.75"]


@pytest.fixture(scope="module")
def revisit(server):
    """Runs `revisit` against the server; answers the finished process."""
    def call(*arguments):
        return run("revisit", *arguments, "--server", server.address,
                   env=clean_environment())
    return call


@pytest.fixture(scope="module", autouse=True)
def vehicles(revisit, stub):
    """Two planar vehicles with 200 poses each, a spatial one, and one that has
    fixes."""
    for name in ("shuttle-7", "shuttle-8"):
        assert revisit("vehicle", "create", name).returncode == 0
        append(stub, f"vehicles/{name}", straight(200))
    for name, kind in (("drone", ("--state-space", "spatial")),
                       ("rover", ("--frame", "geodetic"))):
        assert revisit("vehicle", "create", name, *kind).returncode == 0


@pytest.fixture
def depot(revisit):
    """The id of a group with the two planar vehicles, which is deleted afterwards."""
    assert revisit("group", "create", "depot").returncode == 0
    for vehicle in ("shuttle-7", "shuttle-8"):
        done = revisit("group", "add", "depot", vehicle)
        assert done.returncode == 0, done.stderr
    yield "depot"
    revisit("group", "delete", "depot", "--yes")


def read(result):
    assert result.returncode == 0, result
    return json.loads(result.stdout)


def names(result):
    assert result.returncode == 0, result
    return result.stdout.splitlines()


def test_a_group_is_created_shown_changed_and_deleted(revisit):
    create = ["group", "create", "site", "--display-name", "North",
              "--geodetic-origin", "48.25,11.5,480", "--fix-bias", "3"]
    made = read(revisit(*create, "--json"))
    assert made["name"] == "groups/site" and made["settings"]["fixBiasMeters"] == 3
    assert read(revisit(*create, "--json")) == made
    other = revisit("group", "create", "site", "--fix-bias", "4")
    assert other.returncode == 64 + 6 and "GROUP_EXISTS" in other.stderr
    changed = read(revisit("group", "update", "site", "--no-geodetic-origin",
                           "--display-name", "", "--json"))
    assert "geodeticOrigin" not in changed["settings"]
    assert changed["settings"]["fixBiasMeters"] == 3
    assert changed["revision"] > made["revision"]
    late = revisit("group", "update", "site", "--fix-bias", "5",
                   "--expected-revision", made["revision"])
    assert late.returncode == 64 + 10 and "REVISION_MISMATCH" in late.stderr
    shown = revisit("group", "get", "site").stdout
    for line in ("name +groups/site", f"revision +{changed['revision']}",
                 "geodetic origin +none", "fix bias +3 m"):
        assert re.search(f"^{line}$", shown, re.MULTILINE), shown
    assert "groups/site" in names(revisit("group", "list", "-o", "name"))
    unsure = revisit("group", "delete", "site")
    assert unsure.returncode == USAGE and "--yes is required" in unsure.stderr
    assert read(revisit("group", "delete", "site", "--yes", "--json")) == {
        "deleted": ["groups/site"]}
    assert revisit("group", "get", "site").returncode == 64 + 5


def test_members_have_their_datums_and_lose_them(depot, revisit):
    datum = ["--datum", "12.5,-3,1.5", "--datum-sigma", "5m,2deg", "--datum-id", "gate"]
    placed = revisit("group", "set-datum", depot, "shuttle-8", *datum)
    assert re.fullmatch(r"updated groups/depot/members/shuttle-8, revision \d+\n",
                        placed.stdout), placed
    table = revisit("group", "members", depot).stdout
    assert re.search(r"vehicles/shuttle-7 +- +- +- +- +-\n", table), table
    assert re.search(r"vehicles/shuttle-8 +datum within 5 m and 2.0 degrees, gate +"
                     r"12.50 +-3.00 +0.00 +1.5000\n", table), table
    assert revisit("group", "add", depot, "shuttle-8", *datum).returncode == 0
    other = revisit("group", "add", depot, "shuttle-8")
    assert other.returncode == 64 + 6 and "MEMBER_EXISTS" in other.stderr
    assert revisit("group", "set-datum", depot, "shuttle-8", "--none").returncode == 0
    assert "datum within" not in revisit("group", "members", depot).stdout
    assert revisit("group", "remove", depot, "shuttle-8").returncode == 0
    assert names(revisit("group", "members", depot, "-o", "name")) == [
        "groups/depot/members/shuttle-7"]


def test_a_datum_of_another_kind_of_vehicle_is_refused(depot, revisit):
    size = ["--datum-sigma", "5m,2deg"]
    planar = revisit("group", "add", depot, "drone", "--datum", "1,2,0.5", *size)
    assert planar.returncode == 64 + 3, planar
    assert revisit("group", "add", depot, "drone", "--datum", "1,2,30,0.5",
                   *size).returncode == 0
    assert re.search(r"vehicles/drone +datum within 5 m and 2.0 degrees +1.00 +2.00 +"
                     r"30.00 +0.5000\n", revisit("group", "members", depot).stdout)
    geodetic = revisit("group", "add", depot, "rover", "--datum", "1,2,0.5", *size)
    assert geodetic.returncode in (64 + 3, 64 + 9), geodetic
    assert revisit("group", "add", depot, "rover").returncode == 0


def test_a_link_is_added_once_listed_and_undone(depot, revisit):
    ends = ["shuttle-8@150", "shuttle-7@20"]
    added = read(revisit("link", "add", depot, *ends, *MEASURED, "--json"))
    name = added["loopClosure"]["name"]
    assert name.startswith("groups/depot/loopClosures/")
    again = read(revisit("link", "add", depot, *ends, *MEASURED, "--json"))
    assert again == added
    other = revisit("link", "add", depot, *ends)
    assert other.returncode == 64 + 6 and "LOOP_CLOSURE_EXISTS" in other.stderr
    table = revisit("link", "list", depot).stdout
    assert re.search(r"shuttle-8@150 +shuttle-7@20 +1.25 m, -0.50 m, 0.030 rad +0.75 ",
                     table), table
    assert names(revisit("link", "list", depot, "-o", "name")) == [name]
    backwards = revisit("link", "delete", depot, *reversed(ends))
    assert backwards.returncode == 64 + 5
    assert "revisit link list depot shows" in backwards.stderr
    gone = read(revisit("link", "delete", depot, *ends, "--json"))
    assert gone == {"name": name, "revision": added["revision"] + 1}
    assert read(revisit("link", "list", depot, "--json"))["loopClosures"] == []


def test_links_are_deleted_by_their_ids(depot, revisit):
    for words in (["shuttle-8@150", "shuttle-7@20", "--id", "first"],
                  ["shuttle-8@150", "shuttle-7@20", "--id", "second"]):
        assert revisit("link", "add", depot, *words).returncode == 0
    both = revisit("link", "delete", depot, "shuttle-8@150", "shuttle-7@20")
    assert both.returncode == 64 + 9
    assert "groups/depot/loopClosures/second" in both.stderr
    assert revisit("link", "delete", depot, "first").returncode == 0
    assert revisit("link", "delete", depot,
                   "groups/depot/loopClosures/second").returncode == 0
    assert names(revisit("link", "list", depot, "-o", "name")) == []


@pytest.mark.parametrize("ends", [
    ["shuttle-8@150", "shuttle-8@20"], ["shuttle-8@150", "rover@1"],
    ["shuttle-8@150", "nobody@1"], ["shuttle-8@99999", "shuttle-7@20"]], ids=str)
def test_what_is_no_pair_of_stored_poses_of_two_members_is_refused(ends, depot,
                                                                   revisit):
    refused = revisit("link", "add", depot, *ends)
    assert refused.returncode in (64 + 3, 64 + 5, 64 + 9, 64 + 11), refused
    assert names(revisit("link", "list", depot, "-o", "name")) == []


def test_a_member_that_is_removed_takes_its_links_along(depot, revisit):
    assert revisit("link", "add", depot, "shuttle-8@150",
                   "shuttle-7@20").returncode == 0
    assert revisit("group", "remove", depot, "shuttle-7").returncode == 0
    assert names(revisit("link", "list", depot, "-o", "name")) == []


def test_what_there_is_not_is_told(revisit):
    for words in (["group", "get", "nothing"], ["group", "members", "nothing"],
                  ["group", "add", "nothing", "shuttle-7"], ["link", "list", "nothing"],
                  ["group", "delete", "nothing", "--yes"]):
        result = revisit(*words)
        assert result.returncode == 64 + 5, result
        assert "GROUP_NOT_FOUND" in result.stderr
