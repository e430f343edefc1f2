"""The scripts of tests/evaluation that run `revisit evaluate`: straight roads,
symmetric corners, and the tables of RESULTS.md."""

import re
import sys

import pytest

from made_drives import write_gnss_laps
from revisit_server import BIN, clean_environment, run
from stubs import ROOT

sys.path.insert(0, str(ROOT / "tests/evaluation"))
import situations

# For the time they take; what they run is tested in test_evaluate.py.
pytestmark = pytest.mark.release_build

SEEDS = 12


@pytest.fixture(name="outcomes", scope="module")
def fixture_outcomes(tmp_path_factory):
    """What comes of each situation: {alignment: {situation: Outcome}}."""
    files = situations.write_situations(tmp_path_factory.mktemp("situations"))
    return {alignment: {
        name: situations.outcome(checks) for name, checks
        in situations.evaluate(BIN / "revisit", files, f"1-{SEEDS}",
                               "--alignment", alignment).items()}
        for alignment in ("relative", "composite")}


def test_curve_still_in_the_sequence_tells_the_place(outcomes):
    relative = outcomes["relative"]["curve still in the sequence"]
    assert relative.checks == SEEDS
    assert relative.accepted_right >= SEEDS - 1
    assert relative.sure_wrong == 0
    assert relative.stated > 0.8


def test_straight_road_is_known_to_look_the_same_everywhere(outcomes):
    relative = outcomes["relative"]["straight road"]
    # The road is sure, where along it the vehicle is is less so: the drift that the
    # curve has shown still tells it, to some metres, and the interval says so.
    assert relative.stated > 0.8
    by_curve = outcomes["relative"]["curve still in the sequence"]
    assert relative.interval > 10.0 > 2.0 * by_curve.interval
    # The paper's states nothing, and takes whatever lies within its gate.
    paper = outcomes["composite"]["straight road"]
    assert relative.accepted_right >= SEEDS - 2
    assert paper.accepted_wrong > relative.accepted_wrong
    assert paper.stated is None


def test_next_curve_recovers_the_place(outcomes):
    straight = outcomes["relative"]["straight road"]
    further_on = outcomes["relative"]["recovery further on"]
    assert further_on.first >= SEEDS - 1
    assert further_on.interval < straight.interval
    assert further_on.accepted_wrong == 0
    assert further_on.stated > 0.8


def test_symmetric_corners_are_both_offered(outcomes):
    relative = outcomes["relative"]["symmetric corners"]
    # Their shapes are the same, and 40 m are within the drift: which of the two
    # is first is a matter of luck, and the right one is among those offered.
    assert relative.among_five >= SEEDS - 1
    paper = outcomes["composite"]["symmetric corners"]
    assert relative.accepted_wrong <= paper.accepted_wrong


def tables(*arguments, folder):
    return run(sys.executable, ROOT / "tests/evaluation/tables.py",
               "--revisit", BIN / "revisit", "--nagoya", folder, *arguments,
               env=clean_environment())


def rows_of(text):
    """The rows of a Markdown table, without header and rule."""
    lines = [line for line in text.splitlines() if line.startswith("|")]
    assert re.fullmatch(r"(\|---)+\|", lines[1])
    rows = [[cell.strip() for cell in line.strip("|").split("|")]
            for line in lines]
    assert {len(row) for row in rows} == {lines[1].count("---")}
    return rows[2:]


def figure_in(cell):
    """The figure of a cell that may have an interval behind it."""
    return float(cell.split(" ")[0])


def test_filtered_poses_are_compared_under_every_model(tmp_path):
    write_gnss_laps(tmp_path)
    result = tables("filter", folder=tmp_path)
    assert result.returncode == 0, result.stderr
    rows = rows_of(result.stdout)
    assert [row[2] for row in rows] == \
        ["FILTER", "DEAD_RECKONING", "INDEPENDENT"] * 4
    # The second lap of each of five seeds, with a check each 50 m.
    for row in rows:
        loops, checks = map(int, row[3].split(" / "))
        assert 60 <= loops <= 90 < checks
    recall = {tuple(row[:3]): figure_in(row[7]) for row in rows}
    # Fixes each second leave nothing of the error of the lap before, which
    # dead reckoning would still have.
    assert recall["each second", "relative", "FILTER"] > 0.8


def test_lengths_of_sequences_have_a_row_each(tmp_path):
    write_gnss_laps(tmp_path)
    result = tables("lengths", folder=tmp_path)
    assert result.returncode == 0, result.stderr
    rows = rows_of(result.stdout)
    assert [row[0] for row in rows] == ["100", "150", "200", "300", "400"]
    # Checks begin at two lengths, so that there are fewer.
    checks = [int(row[1].split(" / ")[1]) for row in rows]
    assert checks == sorted(checks, reverse=True)
    assert checks[-1] < checks[0]
    assert figure_in(rows[1][3]) > 0.8


def test_tables_say_what_they_need(tmp_path):
    result = tables("height", folder=tmp_path)
    assert result.returncode == 2
    assert "height: needs --drives DIR" in result.stderr
    result = tables("heights", folder=tmp_path)
    assert result.returncode == 2
    assert "expected tables among height, filter" in result.stderr
    result = tables("lengths", folder=tmp_path)
    assert result.returncode == 1
    assert "spp_2023.pos: not found" in result.stderr
