"""Completion of command lines, asked of the shells themselves."""

import os
import pty
import shutil
import subprocess
import time

import pytest

from revisit_server import BIN, RUN_SECONDS, clean_environment, run

# Lines that are typed, and the words that have to be offered: these and no
# others, or among others.
CASES = [
    ("revisit v", {"vehicle"}, True),
    ("revisit vehicle cr", {"create"}, True),
    ("revisit vehicle ", {"create", "get", "list", "update", "accept-loss",
                          "delete"}, True),
    ("revisit find --dir", {"--direction"}, True),
    ("revisit find x --direction ", {"either", "opposite", "same"}, True),
    ("revisit --server a find x --direction o", {"opposite"}, True),
    ("revisit completion ", {"bash", "fish", "zsh"}, True),
    ("revisit help cl", {"closures"}, True),
    ("revisit find x --serv", {"--server"}, True),
    ("revisit ", {"vehicle", "stream", "info", "help"}, False),
    ("revisit stream driv", {"drive.csv"}, True),
    ("revisit find x --vehicle ", set(), True),
    ("revisit find x -o ", {"json", "name", "text", "wide"}, True),
    ("revisit info -o ", {"json", "text"}, True),
    ("revisit context u", {"use"}, True),
    ("revisit context use ", {"plant", "yard"}, True),
    ("revisit info --context y", {"yard"}, True),
]


@pytest.fixture
def folder(tmp_path):
    """A home with one file and two contexts, where `revisit` is this build's."""
    (tmp_path / "drive.csv").touch()
    kept = tmp_path / ".config/revisit/contexts.json"
    kept.parent.mkdir(parents=True)
    kept.write_text('{"contexts": {"plant": {"server": "a:1"}, '
                    '"yard": {"server": "b:1"}}}')
    return tmp_path


def environment_in(folder, **extra):
    variables = clean_environment(PATH=f"{BIN}:{os.environ['PATH']}",
                                  HOME=str(folder), **extra)
    variables.pop("XDG_CONFIG_HOME", None)
    return variables


def in_shell(shell, script, folder):
    if shutil.which(shell) is None:
        pytest.skip(f"there is no {shell} here")
    result = subprocess.run(
        [shell, *(["--norc"] if shell == "bash" else ["--no-config"]), "-c",
         script], cwd=folder, capture_output=True, text=True, timeout=RUN_SECONDS,
        env=environment_in(folder), check=False)
    assert (result.returncode, result.stderr) == (0, ""), result
    return result.stdout


def check(offered, expected, whole):
    offered = set(offered)
    assert offered == expected if whole else expected <= offered


@pytest.mark.parametrize("line, expected, whole", CASES)
def test_bash_completes(line, expected, whole, folder):
    # As bash cuts a line into words, the last one at the cursor.
    words = line.split(" ")
    quoted = " ".join(f"'{word}'" for word in words)
    shown = in_shell("bash", f"""
        source <(revisit completion bash)
        COMP_WORDS=({quoted}) COMP_CWORD={len(words) - 1}
        _revisit
        printf '%s\\n' "${{COMPREPLY[@]}}" """, folder)
    check(shown.split(), expected, whole)


def test_bash_completes_behind_an_equals_sign(folder):
    shown = in_shell("bash", """
        source <(revisit completion bash)
        COMP_WORDS=(revisit find --direction = o) COMP_CWORD=4
        _revisit
        echo "${COMPREPLY[@]}" """, folder)
    assert shown == "opposite\n"


@pytest.mark.parametrize("line, expected, whole", CASES)
def test_fish_completes(line, expected, whole, folder):
    shown = in_shell("fish", f"""
        revisit completion fish | source
        complete -C '{line}' | cut -f1""", folder)
    check(shown.split(), expected, whole)


# How a shell that nobody has set up begins, and what makes it complete.
INTERACTIVE = {
    "bash": (["--norc", "-i"], ""),
    "zsh": (["-f", "-i"], "autoload -Uz compinit; compinit -u -D; "),
}


@pytest.mark.parametrize("shell", INTERACTIVE)
def test_line_is_completed_at_the_prompt(shell, folder):
    if shutil.which(shell) is None:
        pytest.skip(f"there is no {shell} here")
    flags, setup = INTERACTIVE[shell]
    child, terminal = pty.fork()
    if child == 0:
        os.chdir(folder)
        os.execvpe(shell, [shell, *flags], environment_in(folder, TERM="dumb"))

    def shown_until(words, seconds=RUN_SECONDS):
        shown = ""
        deadline = time.monotonic() + seconds
        while not all(word in shown for word in words):
            assert time.monotonic() < deadline, shown
            shown += os.read(terminal, 4096).decode(errors="replace")
        return shown

    try:
        os.write(terminal, f"{setup}source <(revisit completion {shell}); "
                 "echo rea''dy\n".encode())
        shown_until(["ready"])
        for line, words in [
                (b"revisit vehicle \t\t", ["accept-loss", "update"]),
                (b"revisit find x --direction \t\t", ["either", "opposite"]),
                (b"revisit find --direction=o\t", ["direction=opposite"]),
                (b"revisit find x -o \t\t", ["name", "wide"]),
                (b"revisit context use \t\t", ["plant", "yard"]),
                (b"revisit stream driv\t", ["drive.csv"])]:
            os.write(terminal, line)
            shown_until(words)
            # Away with the line.
            os.write(terminal, b"\x15\n")
        os.write(terminal, b"exit\n")
    finally:
        os.close(terminal)
        os.waitpid(child, 0)


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_shell_takes_its_script(shell, tmp_path):
    if shutil.which(shell) is None:
        pytest.skip(f"there is no {shell} here")
    script = tmp_path / "script"
    script.write_text(run("revisit", "completion", shell).stdout)
    checked = subprocess.run([shell, "-n", script], capture_output=True,
                             text=True, check=False)
    assert (checked.returncode, checked.stderr) == (0, "")
