"""same_answers.py sees a difference of one bit, and none where only times differ."""

import math
import sys

import pytest

import same_answers
from stubs import api


def answer(score, nanos=0):
    found = api.CandidateSet(candidates=[api.Candidate(score=score)])
    found.search_duration.nanos = nanos
    return [("search", same_answers.without_times(found))]


def test_times_are_no_difference():
    alike, difference = same_answers.compare(answer(1.5, nanos=1),
                                             answer(1.5, nanos=2))
    assert (alike, difference) == (1, None)


def test_the_last_bit_is_a_difference():
    alike, difference = same_answers.compare(
        answer(1.5), answer(math.nextafter(1.5, 2.0)))
    assert alike == 0
    assert difference[0] == "search"


def test_an_answer_that_is_missing_is_a_difference():
    alike, difference = same_answers.compare(answer(1.5), [])
    assert (alike, difference) == (0, ("count", 1, "count", 0))


def test_two_runs_of_one_build_answer_the_same(tmp_path, monkeypatch, capsys):
    drive = tmp_path / "short.csv"
    lines = same_answers.SHIPPED.read_text().splitlines()
    # The first loops of the drive are closed by then.
    drive.write_text("\n".join(lines[:900]) + "\n")
    programs = str(same_answers.revisit_server.BIN)
    monkeypatch.setattr(same_answers, "SETTINGS",
                        {"defaults": {}, "filter": same_answers.SETTINGS["filter"]})
    monkeypatch.setattr(sys, "argv", ["same_answers.py", programs, programs,
                                      str(drive)])
    with pytest.raises(SystemExit) as end:
        same_answers.main()
    printed = capsys.readouterr().out.splitlines()
    assert end.value.code == 0
    assert len(printed) == 2
    assert all(line.endswith("are the same") and " 0 candidates" not in line
               for line in printed)
