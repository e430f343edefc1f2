"""The packages for pip are all that their users need: here, and on a system with Python
and no compiler."""

import os
import re
import shutil
import sys
import textwrap

import pytest

from made import CLIENT, RELEASES, ROOT, ROOTS, SERVER, VERSION, do, run

PACKAGES = ("revisit", "revisit-server")
#: Both together; pip takes neither of them from anywhere else.
BOTH = (SERVER, f"{CLIENT}[server]")


#: The first lines of Python in the README of the client, which need nothing but both
#: packages, and what they print.
LINES, PRINTED = re.search(
    r"^```python\n(.*?)^```\n\n```\n(.*?)^```",
    (ROOT / "client/python/README.md").read_text(), re.DOTALL | re.MULTILINE).groups()


class Environment:
    """An environment of Python of its own, with these packages."""

    def __init__(self, place, *packages):
        self.place = place
        do(sys.executable, "-m", "venv", place)
        if packages:
            self.pip("install", *packages)

    def pip(self, *arguments):
        return do(self.place / "bin/python", "-m", "pip", "--disable-pip-version-check",
                  "--quiet", *arguments)

    def run(self, *command, **options):
        """Runs a command as one who has activated the environment."""
        path = f"{self.place / 'bin'}:/usr/bin:/bin"
        return do(*command, cwd=self.place, env={"PATH": path, "HOME": str(self.place)},
                  **options)

    def files(self):
        """Not its folders: pip leaves empty ones of data, share/revisit here."""
        return {path.relative_to(self.place) for path in self.place.rglob("*")
                if path.is_file() and "__pycache__" not in path.parts}


@pytest.fixture(scope="module")
def environment(tmp_path_factory):
    return Environment(tmp_path_factory.mktemp("wheels") / "environment", *BOTH)


@pytest.mark.parametrize("program", ["revisit", "revisitd"])
def test_programs_are_on_the_path_of_their_environment(program, environment):
    assert environment.run(program, "--version").startswith(f"{program} {VERSION} (")


def test_the_demo_finds_its_server_and_its_drive(environment):
    assert "recall" in environment.run("revisit", "demo")


def test_the_first_lines_of_the_readme_run(environment):
    assert environment.run("python", "-c", LINES) == PRINTED


@pytest.mark.parametrize("program", ["revisit", "revisitd"])
def test_the_module_tells_where_its_programs_are(program, environment):
    told = environment.run(
        "python", "-c", f"import revisit_server; print(revisit_server.{program}())")
    assert told.strip() == str(environment.place / "bin" / program)


def test_the_module_tells_it_of_a_folder_that_is_no_environment_too(tmp_path):
    do(sys.executable, "-m", "pip", "--disable-pip-version-check", "--quiet", "install",
       "--target", tmp_path / "folder", SERVER)
    command = [sys.executable, "-c", "import revisit_server as programs; "
               "print(programs.revisitd())"]
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "folder")}
    assert do(*command, env=environment).strip() == str(
        tmp_path / "folder/bin/revisitd")
    (tmp_path / "folder/bin/revisitd").unlink()
    refused = run(*command, env=environment)
    assert refused.returncode == 1
    assert "install that package anew" in refused.stderr


def test_nothing_of_them_is_left_behind(tmp_path):
    other = Environment(tmp_path / "environment")
    before = other.files()
    other.pip("install", "--no-deps", *BOTH)
    assert other.files() > before
    other.pip("uninstall", "--yes", *PACKAGES)
    assert other.files() == before


# What is done on a system with nothing on it, with the packages in /root/wheels.
BARE = textwrap.dedent("""\
    for compiler in cc gcc c++ g++ clang; do
      if command -v "$compiler"; then exit 70; fi
    done
    python3 -m venv environment
    . environment/bin/activate
    pip install --quiet /root/wheels/{server} '/root/wheels/{client}[server]'
    echo "= programs"
    revisit --version
    revisitd --version
    echo "= demo"
    revisit demo
    echo "= lines"
    python /root/wheels/lines.py
    echo "= left"
    pip uninstall --quiet --yes {packages}
    find / -xdev -type f -path "*revisit*" -not -path "/root/wheels*"
    """)


@pytest.mark.parametrize("release", RELEASES)
def test_they_are_all_that_a_system_with_python_needs(release, tmp_path):
    for wheel in (SERVER, CLIENT):
        shutil.copy(wheel, tmp_path)
    (tmp_path / "lines.py").write_text(LINES)
    shutil.rmtree(ROOTS / release / "user", ignore_errors=True)
    told = do(ROOT / "tests/bare-root", "run", ROOTS / release, "user", "--bind",
              tmp_path, "/root/wheels",
              BARE.format(server=SERVER.name, client=CLIENT.name,
                          packages=" ".join(PACKAGES)))
    shutil.rmtree(ROOTS / release / "user")
    _, programs, demo, lines, left = re.split(r"^= \w+\n", told, flags=re.MULTILINE)
    assert re.fullmatch(rf"revisit {VERSION} \(.*\)\nrevisitd {VERSION} \(.*\)\n",
                        programs)
    assert "recall" in demo
    assert lines == PRINTED
    assert left == ""
