"""revisit demo: the loops of the shipped drive, on a server of its own, and its two
days as two vehicles of one group."""

import contextlib
import json
import re
import signal
import subprocess

import pytest

from revisit_server import (BIN, RUN_SECONDS, STOP_SECONDS, clean_environment,
                            run, wait_until)


def demo(directory, *flags):
    """Runs it with its temporary files below the directory."""
    scratch = directory / "scratch"
    scratch.mkdir()
    result = run("revisit", "demo", *flags, cwd=directory,
                 env=clean_environment(TMPDIR=str(scratch)))
    assert list(scratch.iterdir()) == []
    return result


def test_demo_finds_the_loops_of_the_drive_and_draws_them(tmp_path):
    shown = demo(tmp_path)
    assert shown.returncode == 0, shown.stderr
    figures = dict(re.findall(r"^(checks|precision|recall) +([\d.]+)\b",
                              shown.stdout, re.MULTILINE))
    assert figures["checks"] == "312"
    assert float(figures["precision"]) > 0.95
    assert float(figures["recall"]) > 0.95
    assert shown.stdout.splitlines()[-1].startswith("With --keep the server stays up")
    # No commands for a server that has ended.
    assert "REVISIT_SERVER" not in shown.stdout
    # The report, not a line for each check.
    assert len(shown.stdout.splitlines()) < 80
    assert (tmp_path / "demo.svg").read_text().startswith("<svg")


def test_demo_finds_day_one_from_day_two_as_another_vehicle(tmp_path):
    shown = demo(tmp_path)
    assert shown.returncode == 0, shown.stderr
    # Checks, loops, accepted, right; precision, recall; the state of the frame.
    rows = {name: ([int(count) for count in counts.split()], frame)
            for name, counts, frame in re.findall(
                r"^(before|after) +((?:\d+ +){4})[\d.]+ +[\d.]+ +(\S+)$",
                shown.stdout, re.MULTILINE)}
    (checks, loops, accepted, right), frame = rows["before"]
    assert frame == "NONE"
    assert loops > 140 and right > 0.8 * loops and right > 0.97 * accepted
    (checks_after, loops_after, accepted, right_after), frame = rows["after"]
    assert frame == "PROVISIONAL"
    assert (checks_after, loops_after) == (checks, loops)
    assert right_after > right and right_after > 0.97 * accepted
    drawn = (tmp_path / "demo-group.svg").read_text()
    assert "vehicles/demo-day-2" in drawn
    assert "among 1 other vehicle of groups/demo" in drawn
    assert "demo-day-1: PROVISIONAL, within" in drawn
    assert "confirmed: 1" in drawn
    assert int(re.search(r"accepted: (\d+)", drawn).group(1)) > 140


def test_demo_draws_a_page_where_it_is_asked_to(tmp_path):
    shown = demo(tmp_path, "--map", "page.html")
    assert shown.returncode == 0, shown.stderr
    assert "<html" in (tmp_path / "page.html").read_text()
    assert "<html" in (tmp_path / "page-group.html").read_text()
    assert not (tmp_path / "demo.svg").exists()


def test_demo_as_json_is_the_evaluation_alone(tmp_path):
    shown = demo(tmp_path, "--json")
    assert json.loads(shown.stdout)["total"]["checks"] == 312


@contextlib.contextmanager
def kept_demo(directory):
    """A demo that keeps its server: the process, and the server's address."""
    output = directory / "output"
    scratch = directory / "scratch"
    scratch.mkdir()
    with open(output, "wb") as file:
        process = subprocess.Popen(
            [BIN / "revisit", "demo", "--keep"], cwd=directory, stdout=file,
            stdin=subprocess.DEVNULL,
            env=clean_environment(TMPDIR=str(scratch)))
    try:
        wait_until(lambda: "until Ctrl-C" in output.read_text(), "last line",
                   RUN_SECONDS)
        yield process, re.search(r"REVISIT_SERVER=(\S+)",
                                 output.read_text()).group(1)
    finally:
        if process.poll() is None:
            process.kill()
            process.wait(STOP_SECONDS)


def is_up(address):
    return run("revisit", "--server", address, "info").returncode != 78


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM],
                         ids=lambda number: number.name)
def test_demo_keeps_its_server_until_it_is_interrupted(number, tmp_path):
    with kept_demo(tmp_path) as (process, address):
        found = run("revisit", "--server", address, "find", "boreas")
        assert found.returncode == 0, found.stderr
        assert "ACCEPTED" in found.stdout
        between = run("revisit", "--server", address, "find", "demo-day-2",
                      "--group", "demo", "--exclude-own")
        assert "vehicles/demo-day-1" in between.stdout, between.stderr
        process.send_signal(number)
        assert process.wait(STOP_SECONDS) == 130
    assert list((tmp_path / "scratch").iterdir()) == []
    assert not is_up(address)


def test_server_of_a_demo_that_is_killed_ends(tmp_path):
    with kept_demo(tmp_path) as (process, address):
        assert is_up(address)
        process.kill()
        wait_until(lambda: not is_up(address), "end of the server")
    [directory] = (tmp_path / "scratch").iterdir()
    assert " stopped " in (directory / "log").read_text()
