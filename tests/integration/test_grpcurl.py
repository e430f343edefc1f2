"""The real grpcurl against the real server, with the lines of docs/try.md.

Fields have the names of the protos in its JSON: the descriptors that are served
hold no others.
"""

import json
import os
import pathlib
import re
import subprocess

import pytest

from documents import commands, is_shown
from revisit_server import RUN_SECONDS
from stubs import ROOT

GRPCURL = pathlib.Path(os.environ.get("REVISIT_TEST_GRPCURL",
                                      ROOT / "build/tools/grpcurl"))
TRIED_ADDRESS = "127.0.0.1:50051"
SERVICE = "revisit.v1.PoseGraphService"
# The number that grpcurl adds to the code of a status to make its exit code.
STATUS_EXIT = 64
INVALID_ARGUMENT = 3


@pytest.fixture(scope="module", autouse=True)
def grpcurl():
    if not GRPCURL.exists():
        pytest.exit(f"there is no grpcurl at {GRPCURL}: tests/run builds it "
                    "where there is Go", returncode=77)


TRIED = [command for command in commands(ROOT / "docs/try.md")
         if command.marker == "grpcurl"]


@pytest.fixture(scope="module")
def run_line(server):
    """Runs one line of a shell against the server of this test."""
    def run(line):
        assert TRIED_ADDRESS in line
        return subprocess.run(
            ["bash", "-c", line.replace(TRIED_ADDRESS, server.address)],
            env={**os.environ,
                 "PATH": f"{GRPCURL.parent}:{os.environ['PATH']}"},
            capture_output=True, text=True, timeout=RUN_SECONDS,
            check=False)
    return run


@pytest.fixture(scope="module")
def results(run_line):
    """Results of its lines, in their order."""
    return [(command.text, run_line(command.text)) for command in TRIED]


def results_of(results, word):
    found = [result for command, result in results if word in command]
    assert found, f"docs/try.md has no line with {word}"
    return found


def test_list_shows_the_service_health_and_reflection(results):
    listed = results_of(results, " list")[0]
    assert listed.returncode == 0, listed.stderr
    assert set(listed.stdout.split()) == {
        SERVICE, "grpc.health.v1.Health", "grpc.reflection.v1.ServerReflection",
        "grpc.reflection.v1alpha.ServerReflection"}


def test_describe_shows_what_a_method_takes(results):
    method, message = results_of(results, " describe ")
    assert method.returncode == 0, method.stderr
    assert "rpc AppendPoses ( .revisit.v1.AppendPosesRequest )" in (
        method.stdout)
    assert message.returncode == 0, message.stderr
    assert "repeated .revisit.v1.Pose poses = 2" in message.stdout
    # With what the protos say about it.
    assert "// Appends one batch" in method.stdout


def test_create_answers_with_every_setting(results):
    created = results_of(results, "/CreateVehicle")[0]
    assert created.returncode == 0, created.stderr
    vehicle = json.loads(created.stdout)["vehicle"]
    assert vehicle["settings"]["sequence_length_meters"] == 150
    assert vehicle["state"] == "VEHICLE_STATE_ACTIVE"


def test_append_answers_what_is_durable(results):
    appended, as_columns = results_of(results, "/AppendPoses")[:2]
    assert appended.returncode == 0, appended.stderr
    assert json.loads(appended.stdout)["ack"]["durable_sequence"] == "2"
    assert as_columns.stdout == appended.stdout


def test_poses_are_read_back_as_the_columns_that_were_sent(results):
    [listed] = results_of(results, "/ListPoses")
    assert listed.returncode == 0, listed.stderr
    sent = next(command for command, _ in results if '"columns"' in command)
    columns = json.loads(sent.split("'")[1])["columns"]
    [answer] = json.loads(listed.stdout)["columns"]
    assert answer == {**columns, "first_sequence": "1"}


def test_find_says_why_there_is_no_candidate(results):
    found = results_of(results, "/FindCandidates")[0]
    assert found.returncode == 0, found.stderr
    answer = json.loads(found.stdout)["candidates"]
    assert answer["empty_reason"] == "EMPTY_REASON_PATH_TOO_SHORT"
    assert answer["query"]["sequence"] == "1"


def test_error_comes_with_details_that_resolve(results):
    failed = results_of(results, "/AppendPoses")[-1]
    assert failed.returncode == STATUS_EXIT + INVALID_ARGUMENT
    for words in ("Code: InvalidArgument", "google.rpc.ErrorInfo",
                  "COVARIANCE_NOT_POSITIVE_DEFINITE", '"domain": "revisit"',
                  "request_id", "google.rpc.BadRequest",
                  "poses[0].covariance.values"):
        assert words in failed.stderr, failed.stderr


def test_every_line_to_try_was_looked_at(results):
    assert len(results) == 9
    assert [result.returncode for _, result in results] == [
        0, 0, 0, 0, 0, 0, 0, 0, STATUS_EXIT + INVALID_ARGUMENT]


def test_lines_print_what_the_document_shows(results):
    shown = [command.shown for command in TRIED]
    assert sum(text is not None for text in shown) >= 4
    for (command, result), text in zip(results, shown):
        assert text is None or is_shown(text, result.stdout + result.stderr), (
            command, result)


def test_lines_may_be_run_again(results, run_line):
    for command, first in results:
        again = run_line(command)
        assert again.returncode == first.returncode, again.stderr
        if "/AppendPoses" in command and first.returncode == 0:
            assert again.stdout == first.stdout


@pytest.mark.parametrize("symbol", [
    "grpc.health.v1.Health", "google.rpc.ErrorInfo", "google.rpc.BadRequest",
    "google.rpc.RetryInfo", "google.rpc.Status", f"{SERVICE}.StreamPoses",
    "revisit.v1.Pose", "revisit.v1.CandidateSet", "revisit.v1.ErrorReason",
    "google.protobuf.FieldMask", "google.protobuf.Timestamp",
    "grpc.reflection.v1.ServerReflection", "grpc.health.v1.Health.Watch",
])
def test_descriptor_resolves(symbol, run_line):
    result = run_line(f"grpcurl -plaintext {TRIED_ADDRESS} describe {symbol}")
    assert result.returncode == 0, result.stderr
    assert symbol in result.stdout


@pytest.mark.parametrize("symbol, comment", [
    (SERVICE, "// Keeps one pose graph per vehicle"),
    (SERVICE, "  // Finds loop-closure candidates at one pose of the vehicle."),
    ("revisit.v1.PoseBatch", "// Poses with consecutive sequences."),
    ("revisit.v1.PoseBatch", "  // One to GetServerInfoResponse.max_batch_"),
    ("revisit.v1.Pose", "  // Position of the vehicle. Required, and of"),
    ("revisit.v1.Verdict", "  // The candidate is within the gates, and its"),
    ("google.rpc.RetryInfo", "// Describes when the clients can retry"),
    ("grpc.health.v1.Health.Watch", "// Says how a service is, at once and"),
])
def test_describe_shows_the_comments_of_the_protos(symbol, comment, run_line):
    result = run_line(f"grpcurl -plaintext {TRIED_ADDRESS} describe {symbol}")
    assert comment in result.stdout, result


def test_both_versions_of_reflection_answer_the_same(server):
    # ServerReflectionRequest{file_containing_symbol}
    request = b"\x22" + bytes([len(SERVICE)]) + SERVICE.encode()
    answers = {version: list(server.channel().stream_stream(
        f"/grpc.reflection.{version}.ServerReflection/ServerReflectionInfo",
        request_serializer=bytes, response_deserializer=bytes)(iter([request])))
        for version in ("v1", "v1alpha")}
    assert len(answers["v1"]) == 1
    assert b"Keeps one pose graph per vehicle" in answers["v1"][0]
    assert answers["v1"] == answers["v1alpha"]


def test_symbol_that_is_not_there_is_not_found(run_line):
    result = run_line(
        f"grpcurl -plaintext {TRIED_ADDRESS} describe revisit.v1.Nothing")
    assert result.returncode != 0
    assert "not found" in result.stderr.lower()


def test_all_methods_are_listed(run_line):
    result = run_line(f"grpcurl -plaintext {TRIED_ADDRESS} list {SERVICE}")
    declared = re.findall(r"^  rpc (\w+)\(", (
        ROOT / "proto/revisit/v1/pose_graph_service.proto").read_text(),
        re.MULTILINE)
    assert set(result.stdout.split()) == {
        f"{SERVICE}.{name}" for name in declared}


def test_health_is_asked_by_hand(run_line):
    result = run_line(f"grpcurl -plaintext -d '{{\"service\": \"{SERVICE}\"}}' "
                      f"{TRIED_ADDRESS} grpc.health.v1.Health/Check")
    assert json.loads(result.stdout) == {"status": "SERVING"}


def test_stream_is_fed_by_hand(run_line):
    result = run_line(
        "grpcurl -plaintext -d '"
        '{"open": {"vehicle": "vehicles/shuttle-1"}}'
        '{"batch": {"poses": [{"sequence": 1, "local": {"x_meters": 0},'
        ' "heading_radians": 0, "covariance": {"form":'
        ' "COVARIANCE_FORM_PLANAR_6", "values":'
        " [0.01, 0, 0, 0.01, 0, 0.0001]}}]}}'"
        f" {TRIED_ADDRESS} {SERVICE}/StreamPoses")
    assert result.returncode == 0, result.stderr
    assert '"opened"' in result.stdout
    assert '"ack"' in result.stdout


def test_json_nan_is_refused_by_the_server(run_line):
    result = run_line(
        "grpcurl -plaintext -d '"
        '{"vehicle": "vehicles/shuttle-1", "poses": [{"sequence": 3,'
        ' "local": {"x_meters": "NaN"}, "heading_radians": 0,'
        ' "covariance": {"form": "COVARIANCE_FORM_PLANAR_6", "values":'
        " [0.01, 0, 0, 0.01, 0, 0.0001]}}]}'"
        f" {TRIED_ADDRESS} {SERVICE}/AppendPoses")
    assert result.returncode == STATUS_EXIT + INVALID_ARGUMENT
    assert "NOT_FINITE" in result.stderr
