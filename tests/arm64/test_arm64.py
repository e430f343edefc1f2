"""What is compiled for arm64 does there what it does on x86-64."""

import os
import pathlib
import re
import shutil
import subprocess

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[2]
BIN = pathlib.Path(os.environ["REVISIT_BIN"])
BARE = pathlib.Path(os.environ["REVISIT_ARM64_BARE"])
LIBRARIES = ROOT / "build/arm64/root"
MADE = ROOT / "build/arm64/release"
PACKAGES = MADE / "packages"
#: Seconds that nothing here takes, on however busy a machine.
LONG = 1800
everything = pytest.mark.skipif(not os.environ["REVISIT_ARM64_ALL"],
                                reason="tests/arm64/run --all has it")
#: Cores with 128 bits of NEON, without and with vectors of SVE of several lengths.
PROCESSORS = [
    "cortex-a72", "max,sve256=on,sve512=off",
    *(pytest.param(processor, marks=everything) for processor in (
        "cortex-a53", "max,sve128=on,sve256=off,sve512=off", "max,sve512=on"))]


def do(*command, **options):
    """Runs a command that has to succeed; answers its output."""
    result = subprocess.run(list(map(str, command)), capture_output=True, text=True,
                            timeout=LONG, check=False, **options)
    assert result.returncode == 0, (result.stdout + result.stderr)[-4000:]
    return result.stdout


def core_test(processor, *flags):
    return do("qemu-aarch64-static", "-cpu", processor, "-L", LIBRARIES,
              MADE / "bin/core_test", "--gtest_brief=1", *flags)


def on_bare_arm64(script, *shown):
    """Runs a script on a Debian of arm64 with nothing on it, which has these folders
    below /media; answers its output."""
    disk = BARE / "user"
    binds = [word for place in shown
             for word in ("--bind", place, f"/media/{place.name}")]
    try:
        return do(ROOT / "tests/bare-root", "run", BARE, "user", *binds, script)
    finally:
        shutil.rmtree(disk)


def table_of(shown):
    """The lines of a demo that are the same on every machine: without how long it took,
    and without paths and ports."""
    table = shown[shown.index("\nchecks "):shown.index("The map of the drive")]
    return [line for line in table.splitlines()
            if not re.match(r"poses |query time ", line)]


@pytest.fixture(scope="module")
def table(tmp_path_factory):
    """What the demo prints on x86-64."""
    shown = table_of(do(BIN / "revisit", "demo", cwd=tmp_path_factory.mktemp("demo")))
    assert any(line.startswith("recall ") for line in shown), shown
    return shown


@pytest.mark.parametrize("program", ["revisit", "revisitd"])
def test_programs_are_of_arm64(program):
    assert "ARM aarch64" in do("file", "--brief", MADE / "bin" / program)


@pytest.mark.parametrize("processor", PROCESSORS)
def test_kernels_agree_with_their_oracles(processor):
    shown = core_test(processor, "--gtest_filter=*Kernel*:WalkOn*:AlignTest*:"
                      "LogSimilarity*:HeadingMatchTest.NoPath*")
    assert re.search(r"^\[  PASSED  \] [1-9]\d* tests", shown, re.MULTILINE), shown


@everything
def test_all_of_the_core_agrees_with_its_oracles():
    shown = core_test("cortex-a72")
    assert re.search(r"^\[  PASSED  \] [1-9]\d{2,} tests", shown, re.MULTILINE), shown


def test_packages_depend_on_the_libraries_of_arm64s_debian():
    for name in ("revisit", "revisit-server"):
        [package] = PACKAGES.glob(f"{name}_*_arm64.deb")
        fields = do("dpkg-deb", "--field", package)
        assert re.search("^Architecture: arm64$", fields, re.MULTILINE), fields
        assert "libgrpc++1.51" in fields


def test_the_demo_of_the_packages_prints_the_table_of_x86(table):
    shown = on_bare_arm64("""
        apt-get update -q=2
        apt-get install -q=2 -y --no-install-recommends \
          /media/packages/revisit_*.deb /media/packages/revisit-server_*.deb >/dev/null
        dpkg --print-architecture
        revisit demo""", PACKAGES)
    assert shown.splitlines()[0] == "arm64"
    assert table_of(shown) == table


@everything
def test_the_demo_of_the_archive_prints_the_table_of_x86(table):
    shown = on_bare_arm64("""
        tar xzf /media/portable/revisit-*-linux-aarch64.tar.gz
        revisit-*/bin/revisit demo""", ROOT / "build/portable")
    assert table_of(shown) == table


@everything
def test_the_packages_for_pip_print_what_their_document_shows():
    document = (ROOT / "client/python/README.md").read_text()
    lines, printed = re.search(r"^```python\n(.*?)^```\n\n```\n(.*?)^```", document,
                               re.DOTALL | re.MULTILINE).groups()
    shown = on_bare_arm64(f"""
        python3 -m venv environment
        environment/bin/pip install --quiet --disable-pip-version-check \
          /media/wheels/revisit_server-*_aarch64.whl /media/wheels/revisit-*.whl
        cat >first.py <<'TEXT'
{lines}TEXT
        environment/bin/python first.py""", ROOT / "build/wheels")
    assert shown == printed
