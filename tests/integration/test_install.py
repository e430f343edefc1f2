"""What `cmake --install` leaves behind: programs that run, pages that are read,
and a library against which a program outside of the tree is built."""

import os
import re
import shutil
import subprocess

import pytest

from revisit_server import BIN, clean_environment
from stubs import ROOT

BUILD = BIN.parent

pytestmark = pytest.mark.release_build


def do(*command, **environment):
    """Runs a command that has to succeed; answers its output."""
    result = subprocess.run(
        list(map(str, command)), capture_output=True, text=True, timeout=240,
        env=clean_environment(**environment), check=False)
    assert result.returncode == 0, result.stdout + result.stderr
    return result.stdout


@pytest.fixture(scope="module")
def prefix(tmp_path_factory):
    """Where it is installed."""
    if not (BUILD / "client/package").exists():
        pytest.skip("only part of the tree has been built")
    path = tmp_path_factory.mktemp("install")
    do("cmake", "--install", BUILD, "--prefix", path)
    return path


@pytest.mark.parametrize("program", ["revisit", "revisitd"])
def test_installed_programs_say_which_build_they_are(program, prefix):
    version = do(prefix / "bin" / program, "--version")
    assert re.fullmatch(program + r" \d+\.\d+\.\d+ \((commit [0-9a-f]+"
                        r"(-dirty)?, )?built \d{4}-\d\d-\d\d\)\n", version)


def test_protos_compile_where_they_are_installed(prefix, tmp_path):
    protos = prefix / "share/revisit/proto"
    do("protoc", "-I", protos, f"--descriptor_set_out={tmp_path / 'all'}",
       "revisit/v1/pose_graph_service.proto")
    installed = {path.relative_to(protos) for path in protos.rglob("*.proto")}
    assert installed == {path.relative_to(ROOT / "proto") for path
                         in (ROOT / "proto/revisit").rglob("*.proto")}


def test_every_command_has_a_manual_page(prefix):
    pages = {path.name for path in (prefix / "share/man/man1").iterdir()}
    assert {"revisit.1", "revisitd.1", "revisit-stream.1",
            "revisit-vehicle-create.1", "revisit-closures-delete.1"} <= pages
    assert "revisit-man-pages.1" not in pages


def test_formatter_has_nothing_to_say_about_the_manual_pages(prefix):
    if shutil.which("man") is None:
        pytest.skip("there is no man here")
    for page in sorted((prefix / "share/man/man1").iterdir()):
        shown = subprocess.run(
            ["man", "--warnings=w", "-l", page], capture_output=True, text=True,
            check=False, env={**os.environ, "LC_ALL": "C.UTF-8",
                              "MANROFFSEQ": "", "MANWIDTH": "80",
                              "PAGER": "cat", "MANPAGER": "cat"})
        assert (shown.returncode, shown.stderr) == (0, ""), page
        assert "\nNAME\n" in shown.stdout, page


def test_completions_lie_where_the_shells_look(prefix):
    for path in ["bash-completion/completions/revisit",
                 "zsh/site-functions/_revisit",
                 "fish/vendor_completions.d/revisit.fish"]:
        assert "vehicle create" in (prefix / "share" / path).read_text()


def test_program_outside_of_the_tree_is_built_against_the_library(
        prefix, server, tmp_path):
    version = re.search(r"^project\(revisit VERSION (\d+\.\d+)",
                        (ROOT / "CMakeLists.txt").read_text(), re.MULTILINE)[1]
    do("cmake", "-S", ROOT / "tests/install", "-B", tmp_path,
       f"-DVERSION={version}", f"-DCMAKE_PREFIX_PATH={prefix}",
       "-DCMAKE_BUILD_TYPE=Debug")
    do("cmake", "--build", tmp_path)
    assert do(tmp_path / "example", server.address, "outsider") == "10\n"


def build_info(source, tmp_path, **environment):
    output = tmp_path / "build_info.cc"
    do("cmake", "-D", "VERSION=1.2.3", "-D", f"SOURCE={source}", "-D",
       f"OUTPUT={output}", "-P", ROOT / "core/base/write_build_info.cmake",
       **environment)
    return output


def test_build_without_history_has_no_commit_and_the_date_it_is_told(tmp_path):
    # A tree in one of somebody else's is none of theirs.
    do("git", "init", "-q", tmp_path)
    source = tmp_path / "tree"
    source.mkdir()
    text = build_info(source, tmp_path, SOURCE_DATE_EPOCH="86400").read_text()
    assert '"1.2.3 (built 1970-01-02)"' in text


def test_build_of_a_checkout_has_its_commit_and_is_written_once(tmp_path):
    if not (ROOT / ".git").exists():
        pytest.skip("this tree has no history")
    output = build_info(ROOT, tmp_path, SOURCE_DATE_EPOCH="86400")
    assert re.search(r'"1\.2\.3 \(commit [0-9a-f]{10,}(-dirty)?, built '
                     r'1970-01-02\)"', output.read_text())
    before = output.stat().st_mtime_ns
    build_info(ROOT, tmp_path, SOURCE_DATE_EPOCH="86400")
    assert output.stat().st_mtime_ns == before
