"""The package is what its users get: built from a checkout or a source distribution,
with types, without leaving anything in the tree."""

import ast
import importlib.metadata
import os
import pathlib
import re
import subprocess
import sys
import tarfile
import zipfile

import pytest

import revisit
from conftest import ROOT

PACKAGE = ROOT / "client/python"
WELL_TYPED = '''
import numpy as np
from numpy.typing import NDArray
import revisit
from revisit import v1

def drive(client: revisit.Client, x: NDArray[np.float64]) -> float:
    poses = revisit.Poses.local(x, x, x, np.ones((len(x), 6)), stamps=x)
    with client.stream_poses("a", revisit.StreamOptions(send_candidates=True)) as s:
        for answer in s.run([poses]):
            best: v1.Candidate = answer.candidates[0]
            return best.probability
    try:
        return float(client.poses("a").position[0, 0])
    except revisit.InvalidArgument as error:
        return float(len(error.field_violations[0].field))

def settle(client: revisit.Client, bar: revisit.ProgressBar) -> list[str]:
    made = client.create_vehicle("a", correlation_model="independent",
                                 node_spacing_meters=1, labels={"depot": "north"},
                                 place_tolerance={"position_meters": 3.0})
    client.add_loop_closure("a", 40, 4, relative=(1.0, 2.0, 0.1),
                            covariance=np.eye(3))
    client.find_candidates("a", direction=v1.DIRECTION_EITHER)
    poses = revisit.read_recording("drive.csv", axes="camera", progress=bar)
    ack = client.append_poses("a", poses)
    name: str = made.name
    return [name, *(one.message for one in ack.warnings)]

def join(client: revisit.Client) -> int:
    made = client.create_group("g", fix_bias_meters=3, geodetic_origin={
        "latitude_degrees": 48.0, "longitude_degrees": 11.0})
    placed: v1.Datum = revisit.datum((1.0, 2.0, 0.1), np.eye(3), datum_id="gate")
    added = client.add_group_member("g", "a", placed)
    found = client.find_candidates("a", group="g", vehicles=["b"], exclude_own=True)
    linked = client.add_inter_vehicle_loop_closure("g", "a", found.candidates[0])
    frames: list[v1.FrameTransform] = list(
        client.list_frame_transforms("g", "a", vehicles="b", allow_partial=True))
    members: list[str] = [member.vehicle for member in client.list_group_members("g")]
    return added.revision + linked.revision + made.revision + len(members) + len(frames)

def own() -> str:
    with revisit.serve(store=revisit.shipped_drive().parent, log_level="off") as client:
        served: revisit.ServedClient = client
        return f"{served.address} {served.store.name} {served.log}"

async def own_awaited() -> str:
    async with revisit.aio.serve() as client:
        vehicle: v1.Vehicle = await client.create_vehicle("a")
        return vehicle.name + client.address + str(client.store)

async def join_awaited(client: revisit.aio.Client) -> str:
    await client.update_group_member("g", "a", None, expected_revision=3)
    linked = await client.add_inter_vehicle_loop_closure("g", ("a", 1), ("b", 2))
    async for link in client.list_inter_vehicle_loop_closures("g"):
        return link.name
    return linked.loop_closure.name

def verify(client: revisit.Client) -> str:
    checks = client.list_checks("a", states=["open", v1.CANDIDATE_STATE_CONFIRMED])
    first: v1.Check = next(checks)
    for event in client.watch(["a"], cursor=checks.watch_cursor(), states="open"):
        if event.candidate is not None:
            added = event.confirm((1.0, 2.0, 0.1), np.eye(3), note=first.name)
            return added.loop_closure.name + event.candidate.name + event.cursor
    return client.get_check("vehicles/a/checks/7").name

async def verify_awaited(client: revisit.aio.Client) -> str:
    watch = client.watch(cursor_file=revisit.CursorFile("x"), from_start=True)
    async for event in watch:
        await event.reject(note="icp")
        return event.vehicle_uid
    return await client.list_checks().watch_cursor()

async def follow(client: revisit.aio.Client) -> float:
    async with client.stream_poses("a") as stream:
        await stream.append(revisit.read_recording("drive.csv"))
        async for answer in stream.run([]):
            best: v1.Candidate = answer.candidates[0]
            return best.probability
    vehicle: v1.Vehicle = await client.get_vehicle("a")
    return vehicle.travelled_meters
'''
BADLY_TYPED = '''
import revisit

def drive(client: revisit.Client) -> None:
    client.get_vehicle(7)
    client.get_vehicle("a").nothing
    revisit.StreamOptions(batch_poses="many")
    revisit.Poses.local()
    client.create_vehicle("a", max_candidate=3)
    client.create_vehicle("a", max_candidates="three")
    client.create_group("g", fix_bias="three")
    client.add_group_member("g", "a", (1, 2, 3))
    revisit.aio.Client("").get_vehicle("a").name
    for event in client.watch(states=None):
        event.candidate.name
'''


def run(*arguments, **fields):
    return subprocess.run(arguments, capture_output=True, text=True, check=False,
                          **fields)


def mypy(*arguments, **fields):
    return run(sys.executable, "-m", "mypy", "--config-file",
               PACKAGE / "pyproject.toml", "--cache-dir",
               ROOT / "build/python-client/mypy", *arguments, **fields)


@pytest.fixture(scope="module")
def distributions(tmp_path_factory):
    """A source distribution of the checkout, and a wheel that was built from its
    contents alone."""
    directory = tmp_path_factory.mktemp("dist")
    build = [sys.executable, "-c", "import sys; from hatchling.build import *; "
             "print(globals()['build_' + sys.argv[1]](sys.argv[2]))"]
    made = run(*build, "sdist", directory, cwd=PACKAGE)
    assert made.returncode == 0, made.stderr
    source = directory / made.stdout.split()[-1]
    with tarfile.open(source) as archive:
        archive.extractall(directory, filter="data")
    unpacked = directory / source.name[:-len(".tar.gz")]
    made = run(*build, "wheel", directory, cwd=unpacked)
    assert made.returncode == 0, made.stderr
    return source, directory / made.stdout.split()[-1]


def test_a_wheel_is_built_from_a_source_distribution(distributions, tmp_path):
    source, wheel = distributions
    with tarfile.open(source) as archive:
        names = {name.split("/", 1)[1] for name in archive.getnames()}
    assert {"proto/revisit/v1/geometry.proto", "LICENSE", "README.md",
            "revisit/py.typed", "hatch_build.py",
            "tests/data/boreas/boreas_glen_shields.csv",
            "tests/data/boreas/NOTICE"} <= names
    assert not [name for name in names if name.endswith("_pb2.py")]
    with zipfile.ZipFile(wheel) as archive:
        names = set(archive.namelist())
        archive.extractall(tmp_path)
    assert {"revisit/py.typed", "revisit/LICENSE", "revisit/v1/__init__.py",
            "revisit/v1/geometry_pb2.py", "revisit/v1/geometry_pb2.pyi",
            "revisit/v1/pose_graph_service_pb2_grpc.py",
            "revisit/drives/boreas_glen_shields.csv", "revisit/drives/NOTICE"} <= names
    used = run(sys.executable, "-c", "import revisit; print(revisit.__file__, "
               "revisit.v1.Pose(sequence=7).sequence)",
               env={**os.environ, "PYTHONPATH": str(tmp_path)}, cwd=tmp_path)
    assert used.stdout.split() == [str(tmp_path / "revisit/__init__.py"), "7"]


def test_nothing_is_left_in_the_tree(distributions):
    """Neither by the builds here nor by the install that the tests run on."""
    ignored = run("git", "status", "--short", "--ignored", "--untracked-files=all",
                  "--", "client/python", "tests/python", cwd=ROOT)
    if ignored.returncode != 0:
        pytest.skip("not a checkout of git")
    # Whatever is untracked was not made by git add yet; generated code never is.
    assert [line for line in ignored.stdout.splitlines()
            if re.search(r"_pb2|egg-info|/dist/|/build/|\.whl|\.tar\.gz", line)] == []


def test_an_editable_install_is_refused_with_the_reason():
    made = run(sys.executable, "-c", "from hatchling.build import build_editable; "
               "import tempfile; build_editable(tempfile.mkdtemp())", cwd=PACKAGE)
    assert made.returncode != 0
    assert "install without --editable" in made.stderr


def test_the_version_is_the_projects():
    [version] = re.findall(r"project\(revisit VERSION (\S+)",
                           (ROOT / "CMakeLists.txt").read_text())
    assert revisit.__version__ == version


def test_v1_has_every_message_and_enum_of_the_protos():
    for proto in (ROOT / "proto/revisit/v1").glob("*.proto"):
        for name in re.findall(r"^(?:message|enum) (\w+)", proto.read_text(),
                               re.MULTILINE):
            assert hasattr(revisit.v1, name), name


def test_types_of_what_it_answers_come_along():
    """Without an extra, and at the versions that pip takes by itself."""
    needed = [one for one in importlib.metadata.requires("revisit")
              if "extra ==" not in one]
    for name in ("types-grpcio", "types-protobuf"):
        assert any(re.match(rf"{name}\b", one) for one in needed), name


def test_comments_of_the_protos_are_descriptions():
    place = pathlib.Path(revisit.v1.__file__).parent
    for proto in (ROOT / "proto/revisit/v1").glob("*.proto"):
        stub = (place / f"{proto.stem}_pb2.pyi").read_text()
        for name in re.findall(r"^(?:message|enum) (\w+)", proto.read_text(),
                               re.MULTILINE):
            described = getattr(revisit.v1, name).__doc__
            assert described and described[0].isupper(), name
            first = described.splitlines()[0].replace('"', '\\"')
            assert re.search(rf'^class {name}\(.*\n    """{re.escape(first)}', stub,
                             re.MULTILINE), name
        # All fields and values, once in their class and, of a value, in the module.
        members = re.findall(
            r"^ +(?:repeated |optional )?(?:[\w.<>, ]+ )?(\w+) = \d+[;\[ ]",
            proto.read_text(), re.MULTILINE)
        assert members or proto.stem == "error_reason"
        for name in set(members):
            assert re.search(rf'^    {name}: .*\n    """', stub, re.MULTILINE), name
    settings = (place / "keywords.py").read_text()
    assert '    node_spacing_meters: Optional[float]\n    """Travelled' in settings


def test_the_package_is_typed_strictly():
    checked = mypy("-p", "revisit")
    assert checked.returncode == 0, checked.stdout


def test_the_package_of_the_programs_is_typed_strictly_too():
    checked = mypy(ROOT / "deploy/wheels/server/revisit_server")
    assert checked.returncode == 0, checked.stdout


def test_its_users_are_checked_by_its_types(tmp_path):
    (tmp_path / "good.py").write_text(WELL_TYPED)
    (tmp_path / "bad.py").write_text(BADLY_TYPED)
    checked = mypy("good.py", cwd=tmp_path)
    assert checked.returncode == 0, checked.stdout
    checked = mypy("bad.py", cwd=tmp_path)
    assert re.findall(r"bad.py:\d+: error: .*\[([\w-]+)\]", checked.stdout) == [
        "arg-type", "attr-defined", "arg-type", "call-arg", "call-arg", "arg-type",
        "call-arg", "arg-type", "attr-defined", "union-attr"]


@pytest.mark.parametrize("path", sorted(PACKAGE.rglob("*.py")),
                         ids=lambda path: path.name)
def test_sources_are_of_the_oldest_python_that_is_promised(path):
    [oldest] = re.findall(r'requires-python = ">=3\.(\d+)"',
                          (PACKAGE / "pyproject.toml").read_text())
    ast.parse(path.read_text(), feature_version=(3, int(oldest)))
