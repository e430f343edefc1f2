"""A release: the places of its version, its section of the changelog, and the files
that are gathered."""

import hashlib
import io
import json
import re
import shutil
import subprocess
import sys
import tarfile
import zipfile

import pytest

from stubs import ROOT

PLACES = ["CMakeLists.txt", "client/python/revisit/_version.py",
          "client/python/pyproject.toml", "client/console/package.json",
          "client/console/package-lock.json", "deploy/chart/Chart.yaml"]
[VERSION] = re.findall(r"^project\(revisit VERSION (\S+)",
                       (ROOT / "CMakeLists.txt").read_text(), re.MULTILINE)
OTHER = "7.8.9"
CHANGES = f"# Changelog\n\nIntroduction.\n\n## {VERSION} - 2026-12-24\n\nAll.\n"


class Tree:
    """The files of a tree that has to do with a release."""

    def __init__(self, place):
        self.place = place
        for name in [*PLACES, "deploy/release", "deploy/release.py"]:
            (place / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, place / name)
        (place / "CHANGELOG.md").write_text(CHANGES)

    def check(self):
        return subprocess.run(
            [self.place / "deploy/release", "--check"], capture_output=True, text=True,
            timeout=60, check=False)

    def gather(self, *architectures):
        """With this Python, which has what deploy/release installs."""
        return subprocess.run(
            [sys.executable, "-B", self.place / "deploy/release.py", "gather",
             *architectures], capture_output=True, text=True, timeout=60, check=False)

    def refused(self, result):
        """The lines with which a command that has to fail says why."""
        assert (result.returncode, result.stdout) == (1, "")
        assert "Traceback" not in result.stderr, result.stderr
        return result.stderr


@pytest.fixture
def tree(tmp_path):
    return Tree(tmp_path)


def test_all_places_of_the_version_agree(tree):
    checked = tree.check()
    assert (checked.returncode, checked.stderr) == (0, "")
    assert checked.stdout == f"release: {VERSION} of 2026-12-24: all places agree\n"


@pytest.mark.parametrize("name", PLACES[1:])
def test_each_place_of_another_version_is_named(name, tree):
    path = tree.place / name
    text = path.read_text()
    for found in re.finditer(re.escape(VERSION), text):
        path.write_text(text[:found.start()] + OTHER + text[found.end():])
        said = (f"release: {name}: the version is {OTHER}, and {VERSION} in "
                "CMakeLists.txt")
        # Others' packages may have our version too.
        if "package-lock" in name and found.start() > text.index('"dependencies"'):
            break
        assert tree.refused(tree.check()) == said + "\n"
    path.write_text(text.replace(VERSION, ""))
    assert f"release: {name}: " in tree.refused(tree.check())


@pytest.mark.parametrize("old, new, said", [
    (f"{VERSION} - 2026-12-24", "Unreleased", "Unreleased has text"),
    (f"{VERSION} - ", f"{OTHER} - ", f"and is '{OTHER} - 2026-12-24'"),
    (" - 2026-12-24", "", f"and is '{VERSION}'"),
    ("2026-12-24", "2026-13-24", "has no date"),
    ("## ", "", "and is 'no section'"),
])
def test_changelog_needs_a_dated_section_of_the_version(old, new, said, tree):
    (tree.place / "CHANGELOG.md").write_text(CHANGES.replace(old, new))
    refused = tree.refused(tree.check())
    assert refused.startswith("release: CHANGELOG.md: ") and said in refused


def test_an_empty_section_for_what_comes_next_may_be_above(tree):
    (tree.place / "CHANGELOG.md").write_text(
        CHANGES.replace("## ", "## Unreleased\n\n## "))
    assert tree.check().returncode == 0


# ---- Gathering


def program(commit="82b9556ac0", version=VERSION):
    return f"\x7fELF...\0{version} (commit {commit}, built 2026-12-24)\0...".encode()


def write_wheel(path, files):
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)


def write_archive(path, files):
    with tarfile.open(path, "w:gz") as archive:
        for name, content in files.items():
            entry = tarfile.TarInfo(f"{path.name[:-len('.tar.gz')]}/{name}")
            entry.size = len(content)
            archive.addfile(entry, io.BytesIO(content))


def build(tree, usual=program(), made=program(), arch="x86_64"):
    """Writes what the commands of docs/release.md make, as small as can be: `made` is
    one of the programs, `usual` each other one."""
    folders = [tree.place / "build" / name
               for name in ("wheels", "portable", "release/packages")]
    for folder in folders:
        folder.mkdir(parents=True, exist_ok=True)
    wheels, portable, packages = folders
    write_archive(wheels / f"revisit-{VERSION}.tar.gz", {"README.md": b"sources"})
    write_wheel(wheels / f"revisit-{VERSION}-py3-none-any.whl", {
        f"revisit-{VERSION}.dist-info/METADATA":
            "Name: revisit\nRequires-Dist: numpy>=1.23\n"
            "Requires-Dist: pandas>=1.5; extra == 'pandas'\n"})
    licences = f"revisit_server-{VERSION}.dist-info/licenses"
    scripts = f"revisit_server-{VERSION}.data/scripts"
    write_wheel(
        wheels / f"revisit_server-{VERSION}-py3-none-manylinux_2_31_{arch}.whl",
        {f"{scripts}/revisit": usual, f"{scripts}/revisitd": made,
         f"{licences}/third-party/abseil-cpp-20250814.1/LICENSE": "A",
         f"{licences}/third-party/zlib": "B"})
    write_archive(portable / f"revisit-{VERSION}-linux-{arch}.tar.gz",
                  {"bin/revisit": usual, "bin/revisitd": usual})
    for name in ("revisit", "revisit-server", "librevisit-dev"):
        (packages / f"{name}_{VERSION}-1~deb12_amd64.deb").write_bytes(name.encode())


def contents(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_release_has_all_files_with_their_digests(tree):
    build(tree)
    gathered = tree.gather("x86_64")
    assert (gathered.returncode, gathered.stderr) == (0, "")
    files = contents(tree.place / f"build/release-{VERSION}")
    assert [line.rpartition("/")[2] for line in gathered.stdout.splitlines()] == sorted(
        files)
    # As docs/install.md has users do it, who have some of the files.
    (tree.place / f"build/release-{VERSION}/revisit-{VERSION}.tar.gz").unlink()
    subprocess.run(["sha256sum", "--check", "--ignore-missing", "SHA256SUMS"],
                   cwd=tree.place / f"build/release-{VERSION}", check=True, timeout=60)
    digests = files.pop("SHA256SUMS").decode().splitlines()
    assert digests == [f"{hashlib.sha256(files[name]).hexdigest()}  {name}"
                       for name in sorted(files)]
    assert sorted(files) == sorted([
        f"revisit-{VERSION}.tar.gz", f"revisit-{VERSION}-py3-none-any.whl",
        f"revisit_server-{VERSION}-py3-none-manylinux_2_31_x86_64.whl",
        f"revisit-{VERSION}-linux-x86_64.tar.gz", f"revisit-{VERSION}.cdx.json",
        *(f"{name}_{VERSION}-1~deb12_amd64.deb"
          for name in ("revisit", "revisit-server", "librevisit-dev"))])


def test_the_bill_of_materials_has_files_and_libraries_and_is_the_same_each_time(tree):
    build(tree)
    assert tree.gather("x86_64").returncode == 0
    place = tree.place / f"build/release-{VERSION}"
    text = (place / f"revisit-{VERSION}.cdx.json").read_text()
    bill = json.loads(text)
    assert bill["metadata"]["component"]["version"] == VERSION
    assert bill["metadata"]["timestamp"] == "2026-12-24T00:00:00+00:00"
    components = {one["name"]: one for one in bill["components"]}
    for name, content in contents(place).items():
        if name not in ("SHA256SUMS", f"revisit-{VERSION}.cdx.json"):
            [known] = components.pop(name)["hashes"]
            assert known == {"alg": "SHA-256",
                             "content": hashlib.sha256(content).hexdigest()}
    assert {name: one.get("version") for name, one in components.items()} == {
        "abseil-cpp": "20250814.1", "zlib": None, "numpy": None}
    uses = {one["ref"]: one.get("dependsOn") for one in bill["dependencies"]}
    server = f"revisit_server-{VERSION}-py3-none-manylinux_2_31_x86_64.whl"
    assert uses[f"file:{server}"] == ["library:abseil-cpp", "library:zlib"]
    assert uses[f"file:revisit-{VERSION}-py3-none-any.whl"] == ["library:numpy"]
    assert tree.gather("x86_64").returncode == 0
    assert (place / f"revisit-{VERSION}.cdx.json").read_text() == text


def test_what_is_missing_is_named_with_its_command_and_nothing_is_written(tree):
    build(tree)
    assert tree.gather("x86_64").returncode == 0
    place = tree.place / f"build/release-{VERSION}"
    before = contents(place)
    (tree.place / f"build/release/packages/librevisit-dev_{VERSION}-1~deb12_amd64.deb"
     ).unlink()
    refused = tree.refused(tree.gather("x86_64", "aarch64"))
    assert refused.splitlines() == [
        f"release: build/wheels/revisit_server-{VERSION}-*-manylinux_*_aarch64.whl is "
        "missing: deploy/wheels/build --arch aarch64 makes it",
        f"release: build/portable/revisit-{VERSION}-linux-aarch64.tar.gz is missing: "
        "deploy/portable/build --arch aarch64 makes it",
        f"release: build/release/packages/librevisit-dev_{VERSION}-*.deb is missing: "
        "cpack makes it"]
    assert contents(place) == before


@pytest.mark.parametrize("made, said", [
    (program("0123456789"), f"programs of {VERSION} of commit 0123456789"),
    (program(version="0.1.0"), "programs of 0.1.0 of commit 82b9556ac0"),
    (b"\x7fELF", "programs of an unknown version"),
])
def test_programs_of_several_builds_are_no_release(made, said, tree):
    build(tree, made=made)
    refused = tree.refused(tree.gather("x86_64"))
    assert "the programs are not of one build" in refused and said in refused
    assert not (tree.place / f"build/release-{VERSION}").exists()


def test_programs_of_a_tree_with_changes_are_no_release(tree):
    changed = program("82b9556ac0-dirty")
    build(tree, usual=changed, made=changed)
    assert "a commit without changes" in tree.refused(tree.gather("x86_64"))


def test_the_tests_and_the_release_use_one_library():
    """They are installed from two lists."""
    [pinned] = re.findall(r"^cyclonedx-python-lib.*", (
        ROOT / "deploy/release-requirements.txt").read_text(), re.MULTILINE)
    assert pinned in (
        ROOT / "tests/integration/requirements.txt").read_text().splitlines()
