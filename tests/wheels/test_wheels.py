"""The packages for pip: what is in them, and what is refused to become one."""

import ast
import email
import hashlib
import os
import shutil
import stat
import tarfile
import zipfile

import pytest

from made import ARCH, CLIENT, MADE, PROGRAMS, ROOT, SERVER, SOURCES, VERSION, do, run

INFO = f"revisit_server-{VERSION}.dist-info"
DATA = f"revisit_server-{VERSION}.data"


def metadata(wheel):
    with zipfile.ZipFile(wheel) as archive:
        [name] = [name for name in archive.namelist()
                  if name.endswith(".dist-info/METADATA")]
        return email.message_from_bytes(archive.read(name))


def build(*arguments, tree=ROOT, umask=-1, **environment):
    return run(tree / "deploy/wheels/build", *arguments, cwd=tree, umask=umask,
               env={**os.environ, **environment})


def digests(folder):
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest()
            for path in folder.iterdir()}


def test_there_are_two_wheels_and_a_source_distribution():
    assert {path.name for path in (CLIENT, SOURCES, SERVER)} <= set(digests(MADE))


def test_programs_drive_licences_and_module_are_all_that_the_servers_wheel_has():
    third_party = PROGRAMS / "share/doc/revisit/third-party"
    licences = {f"{INFO}/licenses/third-party/{path.relative_to(third_party)}"
                for path in third_party.rglob("*") if path.is_file()}
    assert licences, "the programs have no licences of the libraries in them"
    with zipfile.ZipFile(SERVER) as archive:
        assert set(archive.namelist()) == {
            "revisit_server/__init__.py", "revisit_server/py.typed",
            f"{DATA}/scripts/revisit", f"{DATA}/scripts/revisitd",
            f"{DATA}/data/share/revisit/demo/boreas_glen_shields.csv",
            f"{DATA}/data/share/revisit/demo/NOTICE",
            f"{INFO}/METADATA", f"{INFO}/WHEEL", f"{INFO}/RECORD",
            f"{INFO}/licenses/LICENSE", *licences}
        for name in ("revisit", "revisitd"):
            entry = archive.getinfo(f"{DATA}/scripts/{name}")
            assert archive.read(entry) == (PROGRAMS / "bin" / name).read_bytes()
            assert stat.S_IMODE(entry.external_attr >> 16) == 0o755
        drive = ROOT / "tests/data/boreas"
        for name in ("boreas_glen_shields.csv", "NOTICE"):
            assert archive.read(f"{DATA}/data/share/revisit/demo/{name}") == (
                drive / name).read_bytes()
        assert archive.read(f"{INFO}/licenses/LICENSE") == (
            ROOT / "LICENSE").read_bytes()


def test_the_servers_wheel_is_for_every_python_on_its_platform():
    with zipfile.ZipFile(SERVER) as archive:
        tags = email.message_from_bytes(archive.read(f"{INFO}/WHEEL"))
    assert tags.get_all("Tag") == [f"py3-none-manylinux_2_31_{ARCH}"]
    assert tags["Root-Is-Purelib"] == "false"


def test_the_servers_wheel_asks_for_no_other_package():
    of = metadata(SERVER)
    assert (of["Name"], of["Version"]) == ("revisit-server", VERSION)
    assert of["Requires-Python"] == ">=3.8"
    assert of.get_all("Requires-Dist") is None
    assert of["License-Expression"] == "Apache-2.0 AND CC-BY-4.0"


def test_the_module_of_the_server_is_of_the_oldest_python_that_is_promised():
    with zipfile.ZipFile(SERVER) as archive:
        ast.parse(archive.read("revisit_server/__init__.py"), feature_version=(3, 8))


def test_an_extra_of_the_client_is_the_programs_of_its_version():
    of = metadata(CLIENT)
    assert of["Version"] == VERSION
    assert "server" in of.get_all("Provides-Extra")
    assert f"revisit-server=={VERSION}; extra == 'server'" in (
        of.get_all("Requires-Dist"))


def test_the_source_distribution_has_all_that_a_wheel_is_built_from():
    with tarfile.open(SOURCES) as archive:
        names = {name.partition("/")[2] for name in archive.getnames()}
    assert {"pyproject.toml", "hatch_build.py", "LICENSE", "README.md",
            "revisit/__init__.py", "proto/revisit/v1/vehicle.proto"} <= names


def test_two_builds_give_the_same_bytes(tmp_path):
    """The second one in another place, of another time, and without history."""
    before = digests(MADE)
    tree = tmp_path / "tree"
    for name in (".gitignore", "LICENSE", "client/python", "deploy/wheels",
                 "deploy/dependencies.txt", "deploy/install-dependencies",
                 "proto/revisit", "tests/data/boreas"):
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        copy = shutil.copytree if (ROOT / name).is_dir() else shutil.copy
        copy(ROOT / name, tree / name)
    (tree / "build").mkdir()
    (tree / "build/wheels-venv").symlink_to(ROOT / "build/wheels-venv")
    with tarfile.open(SOURCES) as archive:
        time = archive.next().mtime
    again = build("--programs", PROGRAMS, tree=tree, umask=0o077,
                  SOURCE_DATE_EPOCH=str(time),
                  TZ="Pacific/Auckland", LC_ALL="C", PYTHONHASHSEED="7")
    assert again.returncode == 0, again.stderr
    for name, digest in digests(tree / "build/wheels").items():
        assert before[name] == digest, name


def test_programs_that_need_more_than_their_tag_says_are_refused_by_symbol(tmp_path):
    before = digests(MADE)
    source = tmp_path / "strange.c"
    source.write_text("int strange(void);\nint main(void) { return strange(); }\n")
    library = tmp_path / "libstrange.so"
    do("cc", "-shared", "-x", "c", "-o", library, "-",
       input="int strange(void) { return 0; }")
    (tmp_path / "bin").mkdir()
    for name in ("revisit", "revisitd"):
        do("cc", "-o", tmp_path / "bin" / name, source, library)
    refused = build("--programs", tmp_path)
    assert refused.returncode == 1
    # Version 2.34 of glibc gave that a version of its own.
    assert "revisitd needs __libc_start_main of libc.so.6 GLIBC_2.34" in refused.stderr
    assert "libstrange.so is needed, and is no library of" in refused.stderr
    assert digests(MADE) == before


def test_programs_of_another_architecture_are_refused():
    before = digests(MADE)
    other = "aarch64" if ARCH == "x86_64" else "x86_64"
    refused = build("--programs", PROGRAMS, "--arch", other, "--platform", "linux")
    assert refused.returncode == 1
    assert f"revisitd is for {ARCH}, not for {other}" in refused.stderr
    assert digests(MADE) == before


@pytest.mark.parametrize("arguments, said", [
    (["--arch", "mips"], "no wheels for 'mips': x86_64 or aarch64"),
    (["--platform", "win32"], "no platform 'win32': manylinux_2_31 or linux"),
    (["--arch"], "--arch takes a value"),
])
def test_what_is_built_for_nobody_is_wrong_usage(arguments, said):
    refused = build(*arguments)
    assert refused.returncode == 64
    assert said in refused.stderr


def test_programs_that_are_missing_are_asked_for_by_the_command_that_makes_them(
        tmp_path):
    refused = build("--programs", tmp_path)
    assert refused.returncode == 1
    assert f"no program {tmp_path}/bin/revisit" in refused.stderr
