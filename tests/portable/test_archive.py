"""The archive runs where there is nothing but a C library, and holds what its document
says."""

import os
import pathlib
import re
import shutil
import subprocess
import tarfile

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[2]
ROOTS = pathlib.Path(os.environ["REVISIT_BARE_ROOTS"])
RELEASES = os.environ["REVISIT_BARE_RELEASES"].split()
ARCH = os.uname().machine
[VERSION] = re.findall(r"^project\(revisit VERSION ([\d.]+)",
                       (ROOT / "CMakeLists.txt").read_text(), re.MULTILINE)
NAME = f"revisit-{VERSION}-linux-{ARCH}"
ARCHIVE = ROOT / f"build/portable/{NAME}.tar.gz"
#: Seconds that nothing here takes, on however busy a machine.
LONG = 600
#: What docs/install.md says of the archive.
DOCUMENT = (ROOT / "docs/install.md").read_text().split("## The archive\n")[1]
#: Its commands that unpack and remove an archive.
COMMANDS = dict(re.findall(r"^(sudo tar|sudo rm)( .*?[^\\])$", DOCUMENT,
                           re.MULTILINE | re.DOTALL))


def service_commands():
    """Its commands that start the service, for one who is root already."""
    lines = re.findall(r"^sudo ((?:useradd|systemctl) .*)", DOCUMENT, re.MULTILINE)
    assert [line.split()[0] for line in lines] == ["useradd", "systemctl", "systemctl"]
    return lines


def do(*command):
    """Runs a command that has to succeed; answers its output."""
    result = subprocess.run(list(map(str, command)), capture_output=True, text=True,
                            timeout=LONG, check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def names():
    with tarfile.open(ARCHIVE) as archive:
        return {member.name.removeprefix(f"{NAME}/") for member in archive}


@pytest.mark.parametrize("release", RELEASES)
def test_programs_run_where_nothing_is_installed(release):
    table = do(ROOT / "tests/bare-root", "run", ROOTS / release, "user",
               "--bind", ARCHIVE.parent, "/media", f"""
        ! command -v gcc
        tar xzf /media/{ARCHIVE.name}
        cd {NAME}
        bin/revisitd --version
        bin/revisit demo""")
    shutil.rmtree(ROOTS / release / "user")
    assert f"revisitd {VERSION} (" in table
    assert re.search(r"^recall +1\.00", table, re.MULTILINE), table


@pytest.mark.parametrize("release", RELEASES[:1])
def test_what_the_document_unpacks_its_next_line_removes(release):
    unpack = "tar" + COMMANDS["sudo tar"].replace("revisit-VERSION-linux-ARCH", NAME)
    remove = "rm" + COMMANDS["sudo rm"]
    do(ROOT / "tests/bare-root", "run", ROOTS / release, "user",
       "--bind", ARCHIVE.parent, "/media", f"""
        find /usr/local ! -type d >before
        cd /media
        {unpack}
        revisit --version
        test -e /usr/local/lib/systemd/system/revisitd.service
        {remove}
        cd
        find /usr/local ! -type d | diff before -""")
    shutil.rmtree(ROOTS / release / "user")


def test_the_archive_has_what_its_document_says(names):
    assert {"bin/revisit", "bin/revisitd", "lib/systemd/system/revisitd.service",
            "etc/revisit/revisitd.conf", "share/man/man1/revisitd.1",
            "share/man/man1/revisit.1", "share/bash-completion/completions/revisit",
            "share/revisit/demo/boreas_glen_shields.csv", "share/revisit/demo/NOTICE",
            "share/revisit/proto/revisit/v1/pose_graph_service.proto",
            "share/doc/revisit/LICENSE", "share/doc/revisit/docs/install.md",
            "share/doc/revisit/docs/pictures/gate.svg"} <= names


def test_every_library_in_the_programs_has_its_licence(names):
    licences = dict(re.fullmatch(r"(.+?)-\d.*", pathlib.Path(name).name).group(1, 0)
                    for name in names if "/third-party/" in name)
    for package in ("libgrpc++-dev", "libprotobuf-dev", "libabsl-dev", "libssl-dev",
                    "libpq-dev", "libsqlite3-dev", "libhwy-dev", "prometheus-cpp-dev",
                    "libcivetweb-dev", "libspdlog-dev", "libfmt-dev", "libre2-dev",
                    "libc-ares-dev", "libzstd-dev", "zlib1g-dev", "libexpat1-dev",
                    "libxxhash-dev", "libgeographiclib-dev", "libeigen3-dev",
                    "libboost-math-dev", "libcli11-dev", "nlohmann-json3-dev",
                    "libstdc++"):
        assert package in licences
    with tarfile.open(ARCHIVE) as archive:
        for name in licences.values():
            text = archive.extractfile(
                f"{NAME}/share/doc/revisit/third-party/{name}").read()
            assert re.search(b"licen[cs]e", text, re.IGNORECASE), name


def test_links_between_the_documents_lead_somewhere(names):
    top = "share/doc/revisit"
    documents = sorted(name for name in names
                       if name.startswith(f"{top}/docs/") and name.endswith(".md"))
    assert documents
    with tarfile.open(ARCHIVE) as archive:
        for name in documents:
            text = archive.extractfile(f"{NAME}/{name}").read().decode()
            for link in re.findall(r"\]\(([^)#:\s]+\.(?:md|svg))", text):
                place = os.path.normpath(os.path.join(os.path.dirname(name), link))
                if place.startswith(f"{top}/docs/"):
                    assert place in names, f"{name}: {link}"


def test_no_path_of_the_machine_that_built_it_is_in_the_programs():
    for program in ("revisit", "revisitd"):
        with tarfile.open(ARCHIVE) as archive:
            content = archive.extractfile(f"{NAME}/bin/{program}").read()
        assert os.fsencode(ROOT) not in content, program


def test_everything_has_the_date_of_the_commit_and_belongs_to_root():
    with tarfile.open(ARCHIVE) as archive:
        members = list(archive)
    assert len({member.mtime for member in members}) == 1
    assert {(member.uid, member.gid) for member in members} == {(0, 0)}
    assert {member.mode & 0o7777 for member in members} <= {0o755, 0o644}
