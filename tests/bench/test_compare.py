"""What a comparison of two commits says of their benchmarks."""

import json
import os
import pathlib
import subprocess
import sys

import pytest

COMPARE = pathlib.Path(__file__).parent / "compare.py"

# A program that lists its rows, and takes so long for each in turn.
PROGRAM = """#!{python}
import json, pathlib, re, sys
rows = json.loads({rows!r})
arguments = dict(a.lstrip("-").split("=", 1) for a in sys.argv[1:] if "=" in a)
if "--benchmark_list_tests" in sys.argv:
    print("\\n".join(rows))
elif "--only" in sys.argv:
    part = sys.argv[sys.argv.index("--only") + 1]
    print(json.dumps({{"rounds": [{{part: rows[part]}}]}}))
else:
    (row,) = (r for r in rows if re.search(arguments["benchmark_filter"], r))
    state = pathlib.Path(sys.argv[0] + ".runs")
    runs = json.loads(state.read_text()) if state.exists() else []
    state.write_text(json.dumps(runs + [row]))
    times = rows[row]
    print(json.dumps({{"benchmarks": [{{
        "cpu_time": times[runs.count(row) % len(times)], "time_unit": "ms"}}]}}))
"""


@pytest.fixture(name="program")
def fixture_program(tmp_path):
    def make(name, rows):
        path = tmp_path / name
        path.write_text(PROGRAM.format(python=sys.executable,
                                       rows=json.dumps(rows)))
        os.chmod(path, 0o755)
        return path
    return make


def compare(before, now, *flags, kind="core"):
    return subprocess.run(
        [sys.executable, "-B", COMPARE, "--revision", "abc", f"--{kind}", before,
         now, *flags], capture_output=True, text=True, check=False)


def runs_of(program):
    return json.loads(pathlib.Path(str(program) + ".runs").read_text())


def test_a_row_beyond_the_bound_fails_and_is_measured_twice_as_often(program):
    before = program("before", {"BM_Align/a/10": [2], "BM_Align/b/10": [2]})
    now = program("now", {"BM_Align/a/10": [2.1], "BM_Align/b/10": [2.3]})
    answer = compare(before, now)
    assert answer.returncode == 1
    lines = {line.split()[0]: line for line in answer.stdout.splitlines()
             if line.startswith("Align")}
    assert "1.05x" in lines["Align/a/10"] and "BEYOND" not in lines["Align/a/10"]
    assert "1.15x" in lines["Align/b/10"] and "BEYOND" in lines["Align/b/10"]
    assert "1 of 2 rows" in answer.stderr
    assert runs_of(now).count("BM_Align/a/10") == 3
    assert runs_of(now).count("BM_Align/b/10") == 6
    assert runs_of(before) == runs_of(now)


def test_one_bad_round_is_noise(program):
    before = program("before", {"BM_Align/a/10": [2]})
    now = program("now", {"BM_Align/a/10": [2, 9, 2]})
    answer = compare(before, now)
    assert answer.returncode == 0, answer.stderr
    assert "(1.00 to 4.50, 3)" in answer.stdout


def test_the_bound_is_the_callers(program):
    before = program("before", {"BM_Align/a/10": [2]})
    now = program("now", {"BM_Align/a/10": [3]})
    assert compare(before, now, "--bound", "1.6").returncode == 0
    assert compare(before, now, "--bound", "1.4").returncode == 1


def test_rows_that_one_side_has_are_named_and_iterations_are_no_name(program):
    before = program("before", {"BM_Align/a/10": [2], "BM_Align/gone/10": [2],
                                "BM_Align/s/10/iterations:20": [2]})
    now = program("now", {"BM_Align/a/10": [2], "BM_Align/new/10": [2],
                          "BM_Align/s/10/iterations:200": [2]})
    answer = compare(before, now)
    assert answer.returncode == 0, answer.stderr
    (alone,) = (line for line in answer.stdout.splitlines()
                if line.startswith("Not compared"))
    assert "Align/gone/10" in alone and "Align/new/10" in alone
    assert "Align/s/10 " in answer.stdout


def test_arithmetic_of_the_bench_itself_is_left_out(program):
    rows = {"BM_Limit/Divide": [2], "BM_AlignLiteral/10": [2],
            "BM_LogSimilarityEigen/10": [2], "BM_LogSimilarity/10": [2]}
    answer = compare(program("before", rows), program("now", rows))
    assert answer.returncode == 0, answer.stderr
    assert runs_of(answer.args[-1]) == ["BM_LogSimilarity/10"] * 3


def test_a_filter_without_rows_fails(program):
    rows = {"BM_Align/a/10": [2]}
    answer = compare(program("before", rows), program("now", rows),
                     "--filter", "Nothing")
    assert answer.returncode == 1
    assert "matches Nothing" in answer.stderr


def test_the_server_is_compared_by_cpu_of_a_pose_and_latencies(program):
    def rows(cpu, search):
        return {"ingest": [{"vehicles": 1, "batch_poses": 64, "revisit": {
                    "server_cpu_us_per_pose": cpu}}],
                "query": {"find": {"p50_ms": 1.0, "search_p50_ms": search},
                          "info": {"p50_ms": 0.25}}}
    answer = compare(program("before", rows(2.0, 0.5)),
                     program("now", rows(3.0, 0.5)), kind="server")
    assert answer.returncode == 1
    (slow,) = (line for line in answer.stdout.splitlines() if "BEYOND" in line)
    assert slow.startswith("ingest/1/64/cpu_a_pose") and "1.50x" in slow
    assert "query/find/search_p50" in answer.stdout
    assert "1 of 4 rows" in answer.stderr
