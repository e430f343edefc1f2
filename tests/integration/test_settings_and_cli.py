"""Settings of revisitd and the command line `revisit`, as a shell sees them."""

import contextlib
import json
import os
import re
import socket
import subprocess

import grpc
import pytest

from documents import commands, is_shown
from drive_client import create
from revisit_server import (BIN, RUN_SECONDS, Server, clean_environment, run,
                            wait_until)
from stubs import PROTO, ROOT, api
from wire import BOREAS, append, get, straight

USAGE = 64


def settings_of(text):
    """Keys and values as --print-config prints them."""
    pairs = (line.split("=", 1) for line in text.splitlines()
             if line.strip() and not line.lstrip().startswith("#"))
    return {key.strip(): value.strip().strip('"') for key, value in pairs}


def print_config(*flags, **environment):
    result = run("revisitd", *flags, "--print-config",
                 env=clean_environment(**environment))
    assert (result.returncode, result.stderr) == (0, ""), result
    return settings_of(result.stdout)


# ---- Settings of the server


def test_defaults_keep_to_the_loopback():
    settings = print_config()
    assert settings["listen"] == "127.0.0.1:50051"


def test_flags_win_over_environment_over_file_over_defaults(tmp_path):
    file = tmp_path / "revisitd.conf"
    file.write_text("# A comment.\n"
                    "max-batch-poses = 11\n"
                    "worker-threads = 1\n"
                    'listen = "127.0.0.1:1111"\n')
    environment = {"REVISIT_WORKER_THREADS": "2",
                   "REVISIT_LISTEN": "127.0.0.1:2222"}
    flags = ["--config", file, "--listen", "127.0.0.1:3333"]
    defaults = print_config()
    settings = print_config(*flags, **environment)
    assert settings["listen"] == "127.0.0.1:3333"
    assert settings["worker-threads"] == "2"
    assert settings["max-batch-poses"] == "11"
    assert settings["log-level"] == defaults["log-level"]
    # The environment may name the file too.
    assert print_config(REVISIT_CONFIG=str(file))["max-batch-poses"] == "11"


def test_what_is_printed_may_be_read_again(tmp_path):
    printed = run("revisitd", "--store", 'a "b" \\ c', "--keepalive-seconds",
                  "12.5", "--print-config").stdout
    file = tmp_path / "revisitd.conf"
    file.write_text(printed)
    again = run("revisitd", "--config", file, "--print-config")
    assert again.stdout == printed


@pytest.mark.parametrize("flags, environment, file, words", [
    (["--no-such-thing", "1"], {}, None, ["no-such-thing"]),
    ([], {"REVISIT_NO_SUCH_THING": "1"}, None, ["REVISIT_NO_SUCH_THING"]),
    ([], {}, "worker-threads = 1\nno-such-thing = 1\n",
     ["no-such-thing", "revisitd.conf:2"]),
    ([], {}, "worker-threads = 1\nworker-threads = 2\n",
     ["worker-threads", "revisitd.conf:2"]),
    ([], {}, "worker-threads\n", ["revisitd.conf:1"]),
    (["--worker-threads", "many"], {}, None, ["worker-threads", "many"]),
    (["--worker-threads", "-1"], {}, None, ["worker-threads", "-1"]),
    ([], {"REVISIT_WORKER_THREADS": "1e9"}, None,
     ["REVISIT_WORKER_THREADS", "1e9"]),
    (["--drain-timeout-seconds", "nan"], {}, None,
     ["drain-timeout-seconds", "nan"]),
    (["--log-level", "loud"], {}, None, ["log-level", "loud"]),
], ids=str)
def test_wrong_settings_are_refused_by_name(
        flags, environment, file, words, tmp_path):
    if file is not None:
        path = tmp_path / "revisitd.conf"
        path.write_text(file)
        flags = [*flags, "--config", path]
    result = run("revisitd", *flags, "--store", tmp_path / "store",
                 env=clean_environment(**environment))
    assert result.returncode == USAGE
    for word in words:
        assert word in result.stderr
    assert not (tmp_path / "store").exists()


@pytest.mark.parametrize("words, told", [
    (["--store=", "--listen=127.0.0.1:1"], 'store: got ""; allowed is'),
    (["--print-config=yes"], '--print-config: got "yes"; allowed is no value'),
    (["--lisen=127.0.0.1:1"], "did you mean --listen?"),
    (["bakup"], "did you mean backup?"),
], ids=str)
def test_words_that_cannot_be_meant_start_nothing(words, told, tmp_path):
    result = run("revisitd", *words, cwd=tmp_path)
    assert result.returncode == USAGE
    assert told in result.stderr
    assert list(tmp_path.iterdir()) == []


def test_file_of_settings_that_is_not_there_is_told(tmp_path):
    result = run("revisitd", "--config", tmp_path / "none.conf")
    assert result.returncode == USAGE
    assert "none.conf" in result.stderr


def test_help_and_version_are_printed_and_nothing_started(tmp_path):
    shown = run("revisitd", "--help", cwd=tmp_path)
    assert (shown.returncode, shown.stderr) == (0, "")
    for key in print_config():
        assert f"--{key}" in shown.stdout
    version = run("revisitd", "--version", cwd=tmp_path)
    assert re.fullmatch(r"revisitd \d+\.\d+\.\d+ \(.*built [\d-]+\)\n",
                        version.stdout)
    assert list(tmp_path.iterdir()) == []


def test_address_that_is_taken_is_told(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        result = run("revisitd", "--listen", f"127.0.0.1:{port}",
                     "--store", tmp_path / "store")
    assert result.returncode == 69
    assert f"127.0.0.1:{port}" in result.stderr


@pytest.mark.parametrize("address, allowed", [
    ("127.0.0.1", "HOST:PORT, such as 127.0.0.1:50051"),
    (":50051", "0.0.0.0 stands for all addresses of IPv4"),
    ("0.0.0.0", "HOST:PORT, such as"),
    ("127.0.0.1:99999", "from 0 to 65535"),
    ("127.0.0.1:http", "from 0 to 65535"),
])
def test_what_is_no_address_is_wrong_usage(address, allowed, tmp_path):
    result = run("revisitd", "--listen", address, "--store", tmp_path / "store")
    assert result.returncode == 64
    assert f'listen: got "{address}"; allowed is' in result.stderr
    assert allowed in result.stderr


def test_port_file_tells_where_it_listens(tmp_path):
    port_file = tmp_path / "port"
    with Server(tmp_path / "store", "--port-file", port_file) as server:
        wait_until(port_file.exists, "port file")
        assert port_file.read_text().strip() == server.address


def test_temporary_store_goes_with_the_server(tmp_path):
    store = tmp_path / "store"
    with Server(store, "--temporary-store", "on") as server:
        append(server.stub(), create(server.stub()).name, straight(3))
        assert list(store.iterdir())
        server.close_channels()
        server.process.terminate()
        assert server.process.wait(RUN_SECONDS) == 0, server.log()
    assert not store.exists()


def test_what_was_there_before_is_no_temporary_store(tmp_path):
    store = tmp_path / "store"
    store.mkdir()
    (store / "file").write_text("precious")
    for place in (store, store / "file", "postgresql:///fleet"):
        refused = run("revisitd", "--store", place, "--temporary-store", "on")
        assert refused.returncode == 74
        assert f"temporary-store: {place} cannot be made" in refused.stderr
    assert (store / "file").read_text() == "precious"


def test_limits_of_the_flags_are_those_of_the_server(tmp_path):
    with Server(tmp_path / "store", "--max-batch-poses", 10,
                "--max-batches-in-flight", 3,
                "--max-message-bytes", 65536) as server:
        info = server.stub().GetServerInfo(api.GetServerInfoRequest())
    assert info.max_batch_poses == 10
    assert info.max_batches_in_flight == 3
    assert info.max_message_bytes == 65536


def test_unused_vehicles_above_the_memory_budget_leave_and_come_back(tmp_path):
    store = tmp_path / "store"
    info = api.GetServerInfoRequest()
    with Server(store) as server:
        stub = server.stub()
        for name in ("a", "b"):
            stub.CreateVehicle(api.CreateVehicleRequest(vehicle_id=name))
            append(stub, f"vehicles/{name}", straight(4096, spacing=2.0))
            append(stub, f"vehicles/{name}",
                   straight(4096, first=4097, spacing=2.0))
        resident = stub.GetServerInfo(info)
        assert resident.resident_vehicle_count == 2
        assert resident.resident_node_count == 2 * 8192
        # Two vehicles of some 0.7 MiB each.
        assert 1 << 20 < resident.resident_bytes < 2 * 8192 * 128
    with Server(store, "--memory-budget-mebibytes", 1) as server:
        stub = server.stub()
        assert stub.GetServerInfo(info).resident_vehicle_count == 0
        for name in ("a", "b"):
            assert get(stub, f"vehicles/{name}").durable_sequence == 8192
        wait_until(
            lambda: stub.GetServerInfo(info).resident_vehicle_count == 1,
            "vehicle unloaded")
        assert stub.GetServerInfo(info).resident_bytes <= 1 << 20
        assert get(stub, "vehicles/a").durable_sequence == 8192


def test_every_call_has_one_line_in_the_log_that_is_json(tmp_path):
    with Server(tmp_path / "store", "--log-format", "json") as server:
        stub = server.stub()
        calls = [("x-request-id", "first"), ("x-request-id", "second")]
        for metadata in calls:
            stub.GetServerInfo(api.GetServerInfoRequest(), metadata=[metadata])
        # An id that would forge a line, were it written as it came.
        # Its error is another test's concern.
        with contextlib.suppress(grpc.RpcError):
            stub.GetVehicle(api.GetVehicleRequest(
                name='vehicles/x"\n{"forged": true}\x1b[31m'))
    lines = [json.loads(line) for line in server.log().splitlines()]
    for _, request_id in calls:
        own = [line for line in lines if request_id in line.values()]
        assert len(own) == 1
        assert any("GetServerInfo" in str(value) for value in own[0].values())
    assert not any(line.get("forged") for line in lines)
    assert "\x1b" not in server.log()


# ---- The command line


@pytest.fixture(scope="module")
def revisit(server):
    """Runs `revisit` against the server; answers the finished process."""
    def call(*arguments):
        return run("revisit", *arguments, "--server", server.address)
    return call


@pytest.fixture(scope="module")
def driven(stub, revisit):
    """A vehicle that the command line made and streamed the drive to."""
    assert revisit("vehicle", "create", "cli-boreas").returncode == 0
    streamed = revisit("stream", BOREAS, "--vehicle", "cli-boreas")
    assert streamed.returncode == 0, streamed.stderr
    return "cli-boreas"


COMMANDS = [("vehicle", "create"), ("vehicle", "get"), ("vehicle", "list"),
            ("vehicle", "update"), ("vehicle", "accept-loss"),
            ("vehicle", "delete"), ("stream",),
            ("find",), ("checks",), ("watch",), ("review",),
            ("confirm",), ("reject",), ("closures", "list"),
            ("closures", "delete"), ("rejections", "list"),
            ("rejections", "delete"), ("deletions", "list"),
            ("contradictions",), ("poses", "list"), ("show",),
            ("export",), ("map",), ("revise",), ("evaluate",), ("info",),
            ("context", "list"), ("context", "use"), ("context", "set"),
            ("context", "show"), ("context", "delete")]


def test_command_line_asks_where_a_server_listens_by_default():
    assert print_config()["listen"] in run("revisit", "--help").stdout


def test_help_names_every_command():
    shown = run("revisit", "--help")
    assert (shown.returncode, shown.stderr) == (0, "")
    for command in COMMANDS:
        assert command[0] in shown.stdout


@pytest.mark.parametrize("command", COMMANDS, ids=" ".join)
def test_help_of_a_command_has_examples(command):
    shown = run("revisit", *command, "--help")
    assert (shown.returncode, shown.stderr) == (0, "")
    assert f"revisit {' '.join(command)}" in shown.stdout
    assert "xample" in shown.stdout


def test_json_is_printed_by_every_command_that_reads(driven, revisit):
    def parsed(*arguments):
        result = revisit(*arguments, "--json")
        assert result.returncode == 0, result.stderr
        return json.loads(result.stdout)

    vehicle = parsed("vehicle", "get", driven)
    assert json.dumps(vehicle).count("vehicles/cli-boreas") == 1
    assert parsed("vehicle", "list")
    assert parsed("show", "--vehicle", driven)["consecutiveEdgeCount"] > 7000
    found = parsed("find", "--vehicle", driven, "--aligned-path")
    assert found["candidates"][0]["alignedPath"]
    everything = revisit("export", "--vehicle", driven, "--json")
    parts = [json.loads(line) for line in everything.stdout.splitlines()]
    assert set(parts[0]) == {"vehicle"}
    assert {key for part in parts[1:] for key in part} == {"node", "edge"}


def test_json_is_the_same_by_both_of_its_names(driven, revisit):
    for words in (["vehicle", "get"], ["poses", "list"], ["show"],
                  ["closures", "list"], ["export"]):
        short = revisit(*words, driven, "--json")
        assert short.returncode == 0, short.stderr
        assert revisit(*words, driven, "-o", "json").stdout == short.stdout


def test_names_are_for_scripts(driven, revisit):
    def lines(*arguments):
        result = revisit(*arguments, "-o", "name")
        assert result.returncode == 0, result.stderr
        return result.stdout.splitlines()

    assert f"vehicles/{driven}" in lines("vehicle", "list")
    assert lines("vehicle", "get", driven) == [f"vehicles/{driven}"]
    # The node that is asked at is the last one before the pose.
    answer = json.loads(revisit("find", driven, "--sequence", 2068, "--json").stdout)
    query, matched = answer["query"]["sequence"], answer["candidates"][0][
        "matched"]["sequence"]
    best = f"{query}-{matched}"
    assert lines("find", driven, "--sequence", 2068)[0] == best
    assert lines("vehicle", "create", "cli-named") == ["vehicles/cli-named"]
    assert lines("vehicle", "delete", "cli-named", "--yes") == [
        "vehicles/cli-named"]
    # A closure has the name that its candidate had.
    closure = f"vehicles/{driven}/loopClosures/{best}"
    assert lines("confirm", driven, query, matched) == [closure]
    assert lines("closures", "list", driven) == [closure]
    assert lines("closures", "delete", driven, best) == [closure]


def test_wide_tables_have_more_columns(driven, revisit):
    def rows(*arguments):
        result = revisit(*arguments, "-o", "wide")
        assert result.returncode == 0, result.stderr
        return result.stdout.splitlines()

    revisit("vehicle", "create", "cli-wide", "--display-name", "Golf",
            "--label", "site=north", "--label", "kind=car", "--node-spacing",
            "0.5", "--no-use-belief", "--max-passes", 3)
    titles, *vehicles = rows("vehicle", "list")
    assert titles.index("LABELS") < titles.index("OTHER SETTINGS")
    [row] = [row for row in vehicles if row.startswith("vehicles/cli-wide ")]
    assert "Golf          kind=car,site=north  " in row
    assert "  use-belief=false node-spacing=0.5 max-passes=3  " in row
    # A vehicle with the server's defaults has no other settings.
    [row] = [row for row in vehicles if row.startswith(f"vehicles/{driven} ")]
    assert "=" not in row
    assert "PATH P-VALUE" in "".join(rows("find", driven))
    titles, first, *_ = rows("poses", "list", driven, "--to", 2)
    assert titles.split()[-4:] == ["QX", "QY", "QZ", "QW"]
    assert "SD YAW rad" in titles and len(first.split()) == 14


@pytest.mark.parametrize("words", [["show"], ["find"], ["export"],
                                   ["stream", BOREAS]], ids=str)
def test_vehicle_is_named_bare_or_by_a_flag(words, driven, revisit):
    answers = []
    for arguments in ([*words, driven], [*words, "--vehicle", driven],
                      [words[0], "--vehicle", driven, *words[1:]]):
        result = revisit(*arguments)
        assert result.returncode == 0, (arguments, result.stderr)
        # A stream tells how long it took.
        answers.append(re.sub("in .* s,.*", "", result.stdout))
    assert answers[0] and answers == answers[:1] * 3
    assert revisit(*words, driven, "--vehicle", driven).returncode == USAGE


def test_tables_are_for_people(driven, revisit):
    for arguments in (["vehicle", "get", driven], ["vehicle", "list"],
                      ["show", "--vehicle", driven],
                      ["find", "--vehicle", driven]):
        result = revisit(*arguments)
        assert result.returncode == 0, result.stderr
        assert result.stdout.strip()
        assert not result.stdout.lstrip().startswith("{")
        # Not to a terminal: no colours, no bars drawn over themselves.
        assert "\x1b" not in result.stdout
        assert "\r" not in result.stdout


def test_find_takes_alignment_and_direction(driven, revisit):
    def found(*flags):
        result = revisit("find", "--vehicle", driven, "--json", *flags)
        assert result.returncode == 0, result.stderr
        return json.loads(result.stdout)

    composite = found("--alignment", "composite")
    assert "newPlaceProbability" not in composite
    assert "probability" not in composite["candidates"][0]
    assert composite["candidates"][0]["verdict"].startswith("VERDICT_")
    relative = found("--alignment", "relative", "--direction", "either",
                     "--acceptance-probability", "0.9",
                     "--road-spacing", "100", "--shape-correlation", "20",
                     "--shape-tolerance-position", "2",
                     "--shape-tolerance-heading", "0.1")
    assert 0.0 <= relative["newPlaceProbability"] <= 1.0
    for candidate in relative["candidates"]:
        assert 0.0 <= candidate["probability"] <= 1.0
        assert candidate["direction"] in ("DIRECTION_SAME",
                                          "DIRECTION_OPPOSITE")
    table = revisit("find", "--vehicle", driven).stdout
    assert "new place: probability " in table
    for column in ("DIRECTION", "PROBABILITY", "VERDICT"):
        assert column in table


def test_settings_are_created_and_updated(revisit):
    def settings(*arguments):
        result = revisit(*arguments, "--json")
        assert result.returncode == 0, result.stderr
        return json.loads(result.stdout)["settings"]

    made = settings("vehicle", "create", "cli-settings",
                    "--alignment", "composite", "--road-spacing", "80",
                    "--shape-tolerance-position", "2",
                    "--shape-tolerance-heading", "0.1", "--apply-inflation",
                    "--max-inflation", "4", "--no-use-belief")
    assert made["alignment"] == "ALIGNMENT_COMPOSITE"
    assert made["roadSpacingMeters"] == 80
    assert made["shapeTolerance"] == {"positionMeters": 2,
                                      "headingRadians": 0.1}
    assert made["applyInflation"] is True
    assert made["maxInflation"] == 4
    assert made["useBelief"] is False
    changed = settings("vehicle", "update", "cli-settings",
                       "--alignment", "relative", "--no-apply-inflation",
                       "--acceptance-probability", "0.9", "--use-belief")
    assert changed == {**made, "alignment": "ALIGNMENT_RELATIVE",
                       "applyInflation": False, "acceptanceProbability": 0.9,
                       "useBelief": True}
    nothing = revisit("vehicle", "update", "cli-settings")
    assert nothing.returncode == USAGE
    assert nothing.stderr.startswith("A setting to change is required\n")
    half = revisit("vehicle", "update", "cli-settings",
                   "--tolerance-position", "3")
    assert half.returncode == USAGE
    assert "--tolerance-heading" in half.stderr
    assert revisit("vehicle", "delete", "cli-settings", "--yes").returncode == 0


def setting_flags():
    """The flags of settings, each with the default that its help states."""
    text = run("revisit", "vehicle", "create", "--help").stdout
    text = text[text.index("Settings of the vehicle"):text.index("\nOutput:")]
    flags = {}
    for entry in re.split(r"\n(?=  --)", text)[1:]:
        stated = re.search(r"\(([a-z0-9.-]+)\)\s*$", entry)
        flags[re.match(r"  (--[a-z-]+)", entry)[1]] = stated and stated[1]
    return flags


def test_defaults_in_the_help_are_those_of_the_server(revisit):
    flags = setting_flags()
    # A switch states none.
    assert flags.pop("--apply-inflation") is None
    assert flags.pop("--use-belief") is None
    # An age that is given is a limit.
    assert flags.pop("--max-age") == "any"
    # And a word is a group.
    assert flags.pop("--check-group") == "none"
    given = [word for flag in flags.items() for word in flag]
    answers = [revisit("vehicle", "create", name, *words, "--json")
               for name, words in [("cli-unset", ["--no-apply-inflation",
                                                  "--use-belief"]),
                                   ("cli-stated", given)]]
    assert [answer.stderr for answer in answers] == ["", ""]
    unset, stated = [json.loads(answer.stdout)["settings"]
                     for answer in answers]
    assert stated == unset


def documented_defaults():
    """The defaults that the comments of the API state, as its JSON has them."""
    text = (PROTO / "revisit/v1/vehicle.proto").read_text()
    text = text[text.index("\nmessage VehicleSettings {"):]
    text = text[:text.index("\n}")]
    defaults = {}
    for comment, field in re.findall(
            r"((?:  //.*\n)+)  (?:optional )?\S+ (\w+) = \d+;", text):
        words = " ".join(re.sub(r"^ *//", "", line).strip()
                         for line in comment.splitlines())
        stated = re.search(r"[Dd]efault (.+?)(\.( |$)|, or )", words)
        if stated:
            defaults[field] = stated[1]
    return defaults


def is_said(value, words):
    """Whether the words of a comment are this value of a setting."""
    if isinstance(value, str):
        return value.endswith(f"_{words}")
    if isinstance(value, dict):
        return words == (f"{value['positionMeters']:g} m and "
                         f"{value['headingRadians']:g} rad")
    if isinstance(value, bool):
        return words == ("yes" if value else "no")
    return words == f"{value:g}"


def test_defaults_in_the_comments_of_the_api_are_those_of_the_server(revisit):
    answer = revisit("vehicle", "create", "cli-defaults", "--json")
    settings = json.loads(answer.stdout)["settings"]
    stated = documented_defaults()
    fields = api.VehicleSettings.DESCRIPTOR.fields_by_name
    # The default is the first position, that everything is kept, and no group.
    absent = {"geodetic_origin", "retention", "check_group"}
    assert stated.keys() == set(fields.keys()) - absent
    assert "retention" not in settings and "checkGroup" not in settings
    wrong = {field: words for field, words in stated.items()
             if not is_said(settings[fields[field].json_name], words)}
    assert wrong == {}


def test_every_setting_has_a_flag():
    def leaves(message):
        if message.full_name == "google.protobuf.Duration":
            return 1
        return sum(leaves(field.message_type) if field.message_type else 1
                   for field in message.fields)

    settings = api.VehicleSettings.DESCRIPTOR
    # The server takes it from the first pose.
    origin = settings.fields_by_name["geodetic_origin"].message_type
    assert len(setting_flags()) == leaves(settings) - leaves(origin)


def test_candidates_are_confirmed_and_rejected(revisit, stub):
    name = "vehicles/cli-verify"
    assert revisit("vehicle", "create", "cli-verify", "--correlation-model",
                   "independent").returncode == 0
    append(stub, name, straight(200))
    confirmed = revisit("confirm", "cli-verify", 150, 20)
    assert (confirmed.returncode, confirmed.stdout) == (
        0, f"confirmed {name}/loopClosures/150-20, revision 3\n")
    rejected = revisit("reject", "cli-verify", 160, 30, "--json")
    assert rejected.returncode == 0, rejected.stderr
    answer = json.loads(rejected.stdout)
    assert (answer["rejectedCandidate"]["name"]
            == f"{name}/rejectedCandidates/160-30")
    # Again: the existing one.
    assert json.loads(revisit("reject", name, 160, 30,
                              "--json").stdout) == answer
    assert "1 confirmed, 1 rejected" in revisit(
        "show", "--vehicle", "cli-verify").stdout
    shown = json.loads(revisit("show", "--vehicle", "cli-verify",
                               "--json").stdout)["vehicle"]["consistency"]
    assert shown["rejectedCount"] == 1
    missing = revisit("reject", "cli-verify", 300, 20)
    assert missing.returncode == 64 + 5
    assert "POSE_NOT_FOUND" in missing.stderr
    swapped = revisit("confirm", "cli-verify", 20, 150)
    assert swapped.returncode == 64 + 3
    assert "loop_closure.matched_sequence" in swapped.stderr
    assert revisit("vehicle", "delete", "cli-verify", "--yes").returncode == 0


def test_loss_of_data_is_accepted(revisit, tmp_path):
    def state():
        return json.loads(revisit("vehicle", "get", "cli-loss",
                                  "--json").stdout)["state"]

    drive = tmp_path / "drive.csv"
    drive.write_text("t_s,est_x,est_y,est_yaw\n" + "".join(
        f"{i},{i},0,0\n" for i in range(20)))
    stream = ["stream", drive, "--vehicle", "cli-loss", "--create"]
    assert revisit(*stream).returncode == 0
    # Nobody knows which vehicle they belong to.
    lost = revisit(*stream, "--acked-sequence", 30)
    assert lost.returncode == 64 + 15, lost
    assert state() == "VEHICLE_STATE_ACTIVE"
    uid = json.loads(revisit(*stream, "--json").stdout)["vehicleUid"]
    other = revisit(*stream, "--acked-sequence", 30, "--vehicle-uid",
                    uid[::-1][:8] + uid[8:])
    assert other.returncode == 64 + 9, other
    assert "VEHICLE_REPLACED" in other.stderr
    assert state() == "VEHICLE_STATE_ACTIVE"
    lost = revisit(*stream, "--acked-sequence", 30, "--vehicle-uid", uid)
    assert lost.returncode == 64 + 15, lost
    assert state() == "VEHICLE_STATE_DATA_LOSS"
    # Who does not know what there is accepts nothing.
    assert revisit("vehicle", "accept-loss", "cli-loss",
                   30).returncode == 64 + 9
    assert state() == "VEHICLE_STATE_DATA_LOSS"
    accepted = revisit("vehicle", "accept-loss", "cli-loss", 20)
    assert accepted.returncode == 0, accepted
    assert re.search("^state +ACTIVE$", accepted.stdout, re.MULTILINE)
    assert revisit(*stream).returncode == 0
    assert revisit("vehicle", "delete", "cli-loss", "--yes").returncode == 0


TRIED = [command for command in commands(ROOT / "docs/try.md")
         if command.marker == "revisit"]


@pytest.fixture(scope="module")
def run_line(tmp_path_factory):
    """Runs one line of a shell, as it is printed, against a server that has
    nothing but what the lines before it made."""
    # Where build/release/bin/revisit is this build's, and in the path.
    home = tmp_path_factory.mktemp("lines")
    (home / "build/release").mkdir(parents=True)
    (home / "build/release/bin").symlink_to(BIN)
    (home / "tests").symlink_to(ROOT / "tests")
    (home / "tmp").mkdir()
    with Server(home / "store") as server:
        def call(line):
            return subprocess.run(
                ["bash", "-c", line.replace("/tmp/", f"{home}/tmp/")], cwd=home,
                capture_output=True, text=True,
                env=clean_environment(REVISIT_SERVER=server.address, COLUMNS="88",
                                      PATH=f"{BIN}:{os.environ['PATH']}"),
                timeout=RUN_SECONDS, check=False)
        yield call


@pytest.fixture(scope="module")
def tried_results(run_line):
    """Results of its lines, in their order."""
    return [(command.text, run_line(command.text)) for command in TRIED]


def test_lines_to_try_work_in_their_order(tried_results):
    assert len(tried_results) == 8
    for line, result in tried_results:
        assert result.returncode == 0, (line, result.stderr)
        # A map says on standard error what it asked.
        assert result.stdout or "--output" in line, line


def test_lines_to_try_print_what_the_document_shows(tried_results):
    for command, (line, result) in zip(TRIED, tried_results):
        assert command.shown is None or is_shown(
            command.shown, result.stdout + result.stderr), (line, result)
    assert sum(command.shown is not None for command in TRIED) >= 5


def test_lines_to_try_confirm_and_reject_what_they_found(tried_results):
    results = {line.split()[1]: (line.split(), result.stdout)
               for line, result in tried_results}
    found = results["find"][1]
    _, _, _, query, confirmed, *_ = results["confirm"][0]
    _, _, _, same_query, rejected, *_ = results["reject"][0]
    assert query == same_query
    assert f"sequence {query}, " in found
    verdicts = dict(re.findall(r"^  SEQUENCE +(\d+) .*?VERDICT (\w+)$", found,
                               re.DOTALL | re.MULTILINE))
    assert list(verdicts)[0] == confirmed
    assert verdicts[confirmed] == "ACCEPTED"
    assert verdicts[rejected].startswith("REJECTED_")


@pytest.fixture(scope="module")
def grouped(tried_results, run_line):
    """Another vehicle, and the group of both that examples name."""
    for line in ("revisit vehicle create shuttle-8", "revisit group create depot",
                 "revisit group add depot shuttle-7",
                 "revisit group add depot shuttle-8"):
        assert run_line(line).returncode == 0, line


# Those that need no file, and leave the vehicle and the group there.
@pytest.mark.parametrize("command", [
    "vehicle get", "vehicle list", "vehicle update", "find", "confirm",
    "reject", "show", "export", "group get", "group list", "group update",
    "group members", "group set-datum", "link list"])
def test_examples_of_the_help_work_after_them(
        command, tried_results, grouped, run_line):
    shown = run("revisit", *command.split(), "--help").stdout
    # A long line goes on behind a backslash.
    shown = shown.replace("\\\n", "")
    examples = re.findall(r"^  (revisit .*)", shown.split("Examples:\n")[1],
                          re.MULTILINE)
    assert tried_results and examples
    for example in examples:
        result = run_line(example)
        assert result.returncode == 0, (example, result.stderr)


def test_streaming_again_changes_nothing(driven, revisit):
    before = revisit("vehicle", "get", driven, "--json").stdout
    again = revisit("stream", BOREAS, "--vehicle", driven)
    assert again.returncode == 0, again.stderr
    assert revisit("vehicle", "get", driven, "--json").stdout == before


def test_empty_value_takes_no_other_word(revisit):
    revisit("vehicle", "create", "cli-empty", "--display-name", "Old")
    updated = revisit("vehicle", "update", "cli-empty", "--display-name=",
                      "--acceptance-probability=0.75")
    assert updated.returncode == 0, updated
    vehicle = json.loads(revisit("vehicle", "get", "cli-empty", "--json").stdout)
    assert vehicle["displayName"] == ""
    assert vehicle["settings"]["acceptanceProbability"] == 0.75


@pytest.mark.parametrize("output", [["--output", "/dev/full"], []], ids=str)
def test_full_disk_is_told_by_its_code(output):
    with open("/dev/full", "wb") as full:
        result = subprocess.run(
            [BIN / "revisit", "convert", BOREAS, *output, "--json"], stdout=full,
            stderr=subprocess.PIPE, text=True, check=False, timeout=60)
    assert result.returncode == 1
    # Warnings about the recording come first.
    error = json.loads(result.stderr.splitlines()[-1])["error"]
    assert error["code"] == "RESOURCE_EXHAUSTED"
    assert error["message"].endswith(": No space left on device")


@pytest.mark.parametrize("words", [
    ["--json=yes", "info"], ["info", "--json="], ["info", "--json=true"],
    ["vehicle", "update", "x", "--apply-inflation=no"]], ids=str)
def test_value_of_a_flag_that_takes_none_is_wrong_usage(words):
    result = run("revisit", *words)
    assert result.returncode == USAGE, result
    assert "; allowed is no value\n" in result.stderr


def test_vehicles_come_and_go(revisit):
    assert revisit("vehicle", "create", "cli-brief").returncode == 0
    assert "cli-brief" in revisit("vehicle", "list").stdout
    assert revisit("vehicle", "delete", "cli-brief", "--yes").returncode == 0
    assert "cli-brief" not in revisit("vehicle", "list").stdout


# 64 and the code of the status; see `revisit --help`.
@pytest.mark.parametrize("arguments, code, words", [
    (["vehicle", "get", "nobody"], 64 + 5, "nobody"),
    (["vehicle", "create", "Bad_Id"], 64 + 3, "Bad_Id"),
    (["find", "--vehicle", "nobody"], 64 + 5, "nobody"),
    (["stream", "no-such-file.csv", "--vehicle", "x"], 1,
     "revisit: no-such-file.csv: No such file or directory\n"),
], ids=str)
def test_failure_has_its_exit_code_and_words(arguments, code, words, revisit):
    result = revisit(*arguments)
    assert result.returncode == code, result
    assert words in result.stderr
    assert result.stdout == ""


@pytest.mark.parametrize("arguments", [
    [], ["no-such-command"], ["vehicle"], ["find"], ["vehicle", "get"],
    ["find", "--vehicle", "x", "--no-such-flag"], ["stream", BOREAS],
    ["confirm", "x", "2"], ["reject", "x", "two", "1"],
    ["find", "--vehicle", "x", "--direction", "sideways"]],
    ids=str)
def test_wrong_usage_has_its_exit_code(arguments):
    result = run("revisit", *arguments)
    assert result.returncode == USAGE
    assert result.stderr


MAX_SEQUENCE = 2**63 - 1


@pytest.mark.parametrize("arguments, words", [
    (["stream", BOREAS, "--vehicle", "x", "--acked-sequence", "-1"],
     f'--acked-sequence: got "-1"; allowed is a whole number in [0, '
     f"{MAX_SEQUENCE}]"),
    (["find", "--vehicle", "x", "--sequence", "-1"],
     f'--sequence: got "-1"; allowed is a whole number in [1, {MAX_SEQUENCE}]'),
    (["find", "--vehicle", "x", "--sequence", MAX_SEQUENCE + 1],
     f'got "{MAX_SEQUENCE + 1}"'),
    (["confirm", "x", "-1", "3"], 'QUERY_SEQ: got "-1"'),
    (["reject", "x", "3", "0"], 'MATCHED_SEQ: got "0"'),
    (["find", "--vehicle", "x", "--max-candidates", "99999999999"],
     '--max-candidates: got "99999999999"; allowed is a whole number in '
     "[1, 100]"),
    (["vehicle", "update", "x", "--node-spacing", "abc"],
     '--node-spacing: got "abc"; allowed is a finite number'),
    (["stream", BOREAS, "--vehicle", "x", "--give-up-after", "inf"],
     '--give-up-after: got "inf"; allowed is a finite number'),
    (["evaluate", BOREAS, "--sequence-lengths", "100,0"],
     '--sequence-lengths: got "0"; allowed is a finite number above 0'),
], ids=str)
def test_number_that_is_not_allowed_is_told_with_what_is(arguments, words):
    # Without a server: none is asked.
    result = run("revisit", *arguments)
    assert result.returncode == USAGE, result
    assert words in result.stderr


@pytest.mark.parametrize("arguments, words", [
    ([], "a command is missing; allowed is vehicle, stream, "),
    (["bogus"], 'got "bogus"; allowed is vehicle, stream, '),
    (["vehicle"], "a command is missing; allowed is create, get, "),
    (["vehicle", "bogus"], 'got "bogus"; allowed is create, get, '),
    (["--server", "x", "vehicle", "bogus", "more"],
     'got "bogus"; allowed is create'),
], ids=str)
def test_command_that_there_is_not_is_told_with_those_there_are(
        arguments, words):
    result = run("revisit", *arguments)
    assert result.returncode == USAGE, result
    assert result.stderr.startswith(words), result.stderr


def test_leading_zeros_do_not_change_a_number(driven, revisit):
    swapped = revisit("confirm", driven, "0020", "030")
    assert "got 30; allowed is less than query_sequence, 20" in swapped.stderr


def test_server_that_is_not_there_is_told():
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{unused.getsockname()[1]}"
        result = run("revisit", "vehicle", "list", "--server", address)
    assert result.returncode == 64 + 14
    assert address in result.stderr
    assert "TLS" not in result.stderr


def test_server_may_come_from_the_environment(server, driven):
    listed = run("revisit", "vehicle", "list", "--json",
                 env=clean_environment(REVISIT_SERVER=server.address))
    assert driven in listed.stdout


def test_error_is_json_too_where_json_is_asked_for(revisit):
    result = revisit("vehicle", "get", "nobody", "--json")
    assert result.returncode == 64 + 5
    error = json.loads(result.stderr)["error"]
    assert error["reason"] == "VEHICLE_NOT_FOUND"


@pytest.mark.release_build
def test_stream_brings_the_candidates_where_asked(revisit):
    result = revisit("stream", BOREAS, "--vehicle", "cli-candidates",
                     "--create", "--candidates", "--uncertainty", "file",
                     "--json")
    assert result.returncode == 0, result.stderr
    *checks, summary = map(json.loads, result.stdout.splitlines())
    assert summary["checks"] == len(checks) > 300
    assert summary["durableSequence"] == summary["poses"] == 2076


KEYS = {"drive", "checks", "true_loops", "accepted", "accepted_correct",
        "top1_correct", "top5_correct", "precision", "recall", "f1",
        "query_ms_p50", "query_ms_p99"}


@pytest.mark.release_build
def test_evaluate_judges_the_shipped_drive(revisit, tmp_path):
    result = revisit("evaluate", BOREAS, "--uncertainty", "file", "--json",
                     "--map", tmp_path / "map.svg")
    assert result.returncode == 0, result.stderr
    report = json.loads(result.stdout)
    total = report["total"]
    for part in (*report["drives"], total):
        assert KEYS <= part.keys()
    assert total["checks"] > 300
    # Bounds that a broken search would miss by far.
    assert total["true_loops"] > 100
    assert total["precision"] > 0.75
    assert total["recall"] > 0.5
    drawing = (tmp_path / "map.svg").read_text()
    assert drawing.startswith(("<?xml", "<svg"))
    assert drawing.rstrip().endswith("</svg>")


@pytest.mark.release_build
def test_evaluate_starts_a_server_of_its_own(tmp_path):
    result = run("revisit", "evaluate", BOREAS, "--json",
                 cwd=tmp_path, env=clean_environment(TMPDIR=str(tmp_path)))
    assert result.returncode == 0, result.stderr
    assert json.loads(result.stdout)["total"]["checks"] > 300
    # And leaves nothing behind.
    assert list(tmp_path.iterdir()) == []
