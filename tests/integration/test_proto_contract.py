"""The API is well-formed, can be generated from, and breaks no older client.

proto/baseline.binpb is the API as last released. After a release, or a change
that is meant to break:

    build/python/bin/buf build proto --exclude-source-info \\
        -o proto/baseline.binpb
"""

import os
import pathlib
import re
import shutil
import subprocess
import sys

import pytest
from google.protobuf import descriptor_pb2

from stubs import PROTO, generate

BUF = pathlib.Path(sys.executable).with_name("buf")
BASELINE = PROTO / "baseline.binpb"
README = PROTO / "README.md"
# Exit code of buf when it has found something, rather than failed.
FINDINGS = 100
# Names that depend on the language, and so are not left to its generator.
NAMES = {
    "csharp_namespace": "Revisit.V1",
    "go_package": "revisit/v1;revisitv1",
    "java_multiple_files": True,
    "java_package": "revisit.v1",
    "objc_class_prefix": "RVS",
    "php_namespace": "Revisit\\V1",
    "ruby_package": "Revisit::V1",
}


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
    protos = sorted((PROTO / "revisit").rglob("*.proto"))
    result = subprocess.run(
        ["protoc", f"-I{PROTO}", f"--{language}_out={tmp_path}", *protos],
        capture_output=True, text=True, timeout=60, check=False)
    assert (result.returncode, result.stderr) == (0, "")
    made = [path for path in tmp_path.rglob("*") if path.name.endswith(suffix)]
    assert len(made) >= len(protos)


def test_python_stubs_are_generated(tmp_path):
    generate(tmp_path)
    assert (tmp_path / "revisit/v1/pose_graph_service_pb2_grpc.py").exists()


def test_every_proto_has_the_names_of_every_language(tmp_path):
    image = tmp_path / "image.binpb"
    assert buf("build", PROTO, "--exclude-imports", "-o",
               image).returncode == 0
    files = descriptor_pb2.FileDescriptorSet.FromString(
        image.read_bytes()).file
    assert len(files) == len(list((PROTO / "revisit").rglob("*.proto")))
    for file in files:
        words = pathlib.Path(file.name).stem.split("_")
        expected = {**NAMES, "java_outer_classname":
                    "".join(map(str.capitalize, words)) + "Proto"}
        assert {field.name: value
                for field, value in file.options.ListFields()} == expected


@pytest.fixture
def beside_proto(tmp_path):
    """Runs a program in a folder that holds nothing but `proto`."""
    (tmp_path / "proto").symlink_to(PROTO)

    def run(*arguments):
        return subprocess.run(
            arguments, cwd=tmp_path, capture_output=True, text=True, timeout=60,
            env={**os.environ, "PATH": f"{BUF.parent}:{os.environ['PATH']}"},
            check=False)
    return run


def test_commands_of_the_readme_generate(beside_proto, tmp_path):
    lines = re.search(r"<!-- protoc -->\n```sh\n(.*?)```", README.read_text(),
                      re.DOTALL).group(1)
    result = beside_proto("bash", "-euc", lines)
    assert (result.returncode, result.stderr) == (0, "")
    for made in ("python/revisit/v1/pose_graph_service_pb2_grpc.py",
                 "python/revisit/v1/error_reason_pb2.pyi",
                 "cpp/revisit/v1/pose_graph_service.grpc.pb.cc",
                 "ruby/revisit/v1/pose_graph_service_services_pb.rb",
                 "csharp/V1/PoseGraphService.cs"):
        assert (tmp_path / "gen" / made).exists()


def test_buf_replaces_names_as_the_readme_says(beside_proto, tmp_path):
    (tmp_path / "buf.gen.yaml").write_text(re.search(
        r"```yaml\n(.*?)```", README.read_text(), re.DOTALL).group(1))
    result = beside_proto("buf", "generate")
    assert (result.returncode, result.stderr) == (0, "")
    pose = tmp_path / "gen/java/your/organisation/revisit/v1/Pose.java"
    assert "package your.organisation.revisit.v1;" in pose.read_text()
