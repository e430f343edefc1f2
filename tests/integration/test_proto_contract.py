"""The API is well-formed, can be generated from, and breaks no older client.

proto/baseline.binpb is the API as last released. After a release, or a change
that is meant to break:

    build/python/bin/buf build proto --exclude-source-info \\
        -o proto/baseline.binpb
"""

import pathlib
import shutil
import subprocess
import sys

import pytest

from stubs import PROTO, generate

BUF = pathlib.Path(sys.executable).with_name("buf")
BASELINE = PROTO / "baseline.binpb"
# What buf answers when it has found something, rather than failed.
FINDINGS = 100


def buf(*arguments):
    return subprocess.run([BUF, *map(str, arguments)], capture_output=True,
                          text=True, timeout=60, check=False)


def test_protos_are_lint_clean():
    result = buf("lint", PROTO)
    assert (result.returncode, result.stdout) == (0, ""), result


def test_protos_break_no_client_of_the_baseline():
    result = buf("breaking", PROTO, "--against", BASELINE)
    assert (result.returncode, result.stdout) == (0, ""), result


@pytest.mark.parametrize("file, old, new, complaint", [
    ("geometry.proto", "double y_meters = 2;", "double y_meters = 9;",
     'field "2" with name "y_meters" on message'),
    ("candidate.proto", "GATE_VERDICT_REJECTED = 2;",
     "GATE_VERDICT_REJECTED = 7;", 'enum value "2" on enum "GateVerdict"'),
    ("vehicle.proto", "optional int32 max_candidates",
     "optional int64 max_candidates", 'changed type from "int32" to "int64"'),
    ("pose_graph_service.proto",
     "  rpc GetServerInfo(GetServerInfoRequest)"
     " returns (GetServerInfoResponse);\n", "", 'deleted'),
])
def test_baseline_catches_a_breaking_change(
        tmp_path, file, old, new, complaint):
    changed = shutil.copytree(PROTO, tmp_path / "proto")
    path = changed / "revisit/v1" / file
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))
    result = buf("breaking", changed, "--against", BASELINE)
    assert result.returncode == FINDINGS, result
    assert complaint in result.stdout


def test_buf_builds_one_image_of_all_protos(tmp_path):
    image = tmp_path / "image.binpb"
    result = buf("build", PROTO, "-o", image)
    assert result.returncode == 0, result
    assert image.stat().st_size > 0


@pytest.mark.parametrize("language, suffix", [
    ("cpp", ".pb.cc"), ("csharp", ".cs"), ("java", ".java"), ("kotlin", ".kt"),
    ("objc", ".pbobjc.m"), ("php", ".php"), ("python", "_pb2.py"),
    ("ruby", "_pb.rb"),
])
def test_code_is_generated_for(language, suffix, tmp_path):
    protos = sorted(PROTO.rglob("*.proto"))
    result = subprocess.run(
        ["protoc", f"-I{PROTO}", f"--{language}_out={tmp_path}", *protos],
        capture_output=True, text=True, timeout=60, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    made = [path for path in tmp_path.rglob("*") if path.name.endswith(suffix)]
    assert len(made) >= len(protos)


def test_python_stubs_are_generated(tmp_path):
    generate(tmp_path)
    assert (tmp_path / "revisit/v1/pose_graph_service_pb2_grpc.py").exists()
