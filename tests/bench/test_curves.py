"""How figures become the curves and tables of docs/performance.md."""

import json
import pathlib
import re
import subprocess
import sys
import xml.etree.ElementTree

import pytest

HERE = pathlib.Path(__file__).resolve().parent
ROOT = HERE.parents[1]
for folder in (HERE, ROOT / "tests/integration", ROOT / "docs/pictures"):
    sys.path.insert(0, str(folder))

import chart  # noqa: E402
import curves  # noqa: E402
import performance  # noqa: E402
from picture import Picture  # noqa: E402


@pytest.fixture(name="kept", scope="module")
def fixture_kept():
    """The figures of the documents."""
    return performance.read()


def drawn(series, **more):
    """What the chart of these series has between 100 and 300 pixels: its dots and the
    words in it, with their places."""
    picture = Picture(400, chart.height_of(len(series)), "A chart")
    chart.draw(picture, 100, 300, "Title", "x", series, **more)
    root = xml.etree.ElementTree.fromstring(picture.svg())
    space = "{http://www.w3.org/2000/svg}"
    return ([(float(dot.get("cx")), float(dot.get("cy")))
             for dot in root.iter(f"{space}circle")],
            {text.text: (float(text.get("x")), float(text.get("y")))
             for text in root.iter(f"{space}text")})


def test_a_point_lies_at_its_values_on_both_axes():
    dots, words = drawn([chart.Series("one", "blue", [(1, 1), (10, 100), (100, 10)])])
    assert [x for x, _ in dots] == pytest.approx([100, 200, 300])
    # The picture's y grows downwards.
    top, bottom = dots[1][1], dots[0][1]
    assert bottom - top == pytest.approx(chart.BOTTOM - chart.TOP)
    assert dots[2][1] == pytest.approx((top + bottom) / 2)
    # The words of a tick stand beside it.
    assert words["100"][0] == pytest.approx(300)
    assert words["10"][0] == pytest.approx(200)


def test_a_logarithmic_axis_spans_whole_decades_around_its_values():
    axis = chart.Logarithmic([0.3, 0, 42])
    assert axis.ticks() == pytest.approx([0.1, 1, 10, 100])
    assert axis.share(0.1) == 0 and axis.share(100) == 1
    assert chart.Logarithmic([10, 1000]).ticks() == pytest.approx([10, 100, 1000])
    assert len(chart.Logarithmic([10, 10]).ticks()) == 2


@pytest.mark.parametrize("most", [0.7, 1, 96, 154.9, 241, 999])
def test_a_linear_axis_goes_from_nothing_to_beyond_its_greatest_value(most):
    axis = chart.Linear([most / 3, most])
    assert axis.ticks()[0] == 0
    assert most <= axis.ticks()[-1] < 1.5 * most
    assert 3 <= len(axis.ticks()) <= 7


def test_what_was_not_measured_has_no_point_and_no_name():
    dots, words = drawn([chart.Series("some", "blue", [(1, None), (10, 5), (100, 0)]),
                         chart.Series("none", "orange", [(1, None)])])
    assert len(dots) == 1
    assert "some" in words and "none" not in words


@pytest.mark.parametrize("value, words", [
    (0, "0"), (0.00123, "0.001"), (0.4567, "0.457"), (1, "1"), (12.34, "12.3"),
    (99.96, "100"), (1234.5, "1,230"), (999_600, "1 M"), (3_456_789, "3.46 M")])
def test_numbers_are_shown_with_three_digits_that_count(value, words):
    assert chart.words_of(value) == words


def test_the_page_has_the_tables_of_the_figures_beside_it(kept):
    text = performance.PAGE.read_text(encoding="utf-8")
    assert performance.page(text, kept) == text, (
        "tests/bench/run --curves --from docs/pictures/performance.json --into docs")


def test_the_pictures_beside_the_figures_show_them(kept):
    for name, picture in performance.pictures(kept).items():
        assert (performance.HERE / name).read_text(encoding="utf-8") == picture, name


def test_figures_of_the_documents_are_of_a_whole_run(kept):
    assert not kept["small"]
    assert [row["nodes"] for row in kept["memory"]] == list(curves.FULL["sizes"])
    assert [row["vehicles"] for row in kept["vehicles"]] == list(
        curves.FULL["vehicles"])


def test_drawing_again_from_saved_figures_measures_nothing_and_writes_the_same(
        tmp_path):
    subprocess.run(
        [ROOT / "tests/bench/run", "--curves", "--from", performance.FIGURES, "--into",
         tmp_path], check=True, timeout=60)
    written = {path.relative_to(tmp_path): path.read_text(encoding="utf-8")
               for path in tmp_path.rglob("*.*")}
    assert len(written) == 6
    for path, text in written.items():
        assert (ROOT / "docs" / path).read_text(encoding="utf-8") == text, path


def test_a_page_that_lacks_a_place_for_a_table_is_refused(kept):
    text = performance.PAGE.read_text(encoding="utf-8")
    with pytest.raises(ValueError, match="pace"):
        performance.page(text.replace("figures: pace", "pace"), kept)


def test_figures_of_a_small_run_never_become_those_of_the_documents(kept, tmp_path):
    small = {**kept, "small": True}
    with pytest.raises(SystemExit, match="small"):
        performance.write(small, ROOT / "docs")
    performance.write(small, tmp_path)
    assert (tmp_path / "performance.md").exists()


def test_figures_of_another_format_are_refused(tmp_path):
    file = tmp_path / "old.json"
    file.write_text(json.dumps({"format": 0}))
    with pytest.raises(SystemExit, match="format 0"):
        performance.read(file)


def test_the_fleet_that_is_sized_takes_what_its_parts_take():
    # 1,000 vehicles at 10 m/s have 200 checks a second.
    points = [[1000, 0.1], [10_000, 2.0], [100_000, 50.0]]
    need = performance.needs({
        "core": {"check_reckoned": points, "check_fixes": [[10_000, 0.5]]},
        "pace": [{"vehicles": 100, "server_cores": 0.1, "idle_bytes_per_vehicle": 60e3},
                 {"vehicles": 500, "server_cores": 0.25,
                  "idle_bytes_per_vehicle": 50e3}],
        "memory": [{"nodes": 1000, "streamed_bytes": 200},
                   {"nodes": 10_000, "streamed_bytes": 100}]})
    assert need == pytest.approx({
        "poses": 0.5, "reckoned": 0.4, "fixes": 0.1, "nodes_bytes": 1e9,
        "streams_bytes": 50e6})


def test_rounds_become_one_by_the_median_of_each_number():
    rounds = [{"a": 1, "b": {"c": 30.0}}, {"a": 9, "b": {"c": 10.0}},
              {"a": 2, "b": {"c": 20.0}}]
    assert curves.median_of(rounds) == {"a": 2, "b": {"c": 20.0}}


def test_saved_figures_have_four_digits_and_whole_numbers_all_of_theirs():
    assert performance.rounded({"a": [1.23456, 1234567], "b": "x", "c": 1234.56,
                                "d": None, "e": True}) == {
        "a": [1.235, 1234567], "b": "x", "c": 1235, "d": None, "e": True}


def test_every_picture_and_table_of_the_page_is_made_of_figures(kept):
    text = performance.PAGE.read_text(encoding="utf-8")
    shown = set(re.findall(r"pictures/(performance-\w+\.svg)", text))
    assert shown == set(performance.pictures(kept))
    # A row of a table that stands between no marks would stay as it is.
    assert not re.search(r"^\|", performance.BLOCK.sub("", text), re.MULTILINE)
