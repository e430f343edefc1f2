"""The pictures of the documents are those that docs/pictures/draw.py draws, with
what the server answers today."""

import os
import re
import sys
import xml.etree.ElementTree

import pytest

from documents import DOCUMENTS
from revisit_server import BIN
from stubs import ROOT

PICTURES = ROOT / "docs/pictures"
# Of a coordinate, in pixels; processors round otherwise.
TOLERANCE = 0.3


@pytest.fixture(scope="module")
def drawn():
    os.environ["REVISIT_BIN"] = str(BIN)
    sys.path.insert(0, str(PICTURES))
    import draw
    return draw.pictures()


def test_each_picture_is_the_file_beside_the_script(drawn):
    assert set(drawn) == {path.name for path in PICTURES.glob("*.svg")}
    number = re.compile(r"-?\d+\.\d+")
    for name, text in drawn.items():
        kept = (PICTURES / name).read_text(encoding="utf-8")
        assert number.sub("#", text) == number.sub("#", kept), (
            f"{name}: docs/pictures/draw.py draws another one")
        assert [float(x) for x in number.findall(text)] == pytest.approx(
            [float(x) for x in number.findall(kept)], abs=TOLERANCE), name


def test_each_picture_is_shown_with_words_that_say_what_it_shows():
    shown = {}
    for path in DOCUMENTS:
        shown.update((target.rpartition("/")[2], words) for words, target in re.findall(
            r"!\[([^\]]*)\]\(([^)]+\.svg)\)", path.read_text()))
    assert set(shown) == {path.name for path in PICTURES.glob("*.svg")}
    assert [name for name, words in shown.items() if len(words.split()) < 8] == []


def test_each_picture_has_a_ground_and_colours_for_light_and_dark_pages():
    for path in PICTURES.glob("*.svg"):
        text = path.read_text(encoding="utf-8")
        root = xml.etree.ElementTree.fromstring(text)
        assert root[0].tag.endswith("title") and root[0].text
        assert 'class="ground"' in text
        assert "prefers-color-scheme: dark" in text
        # Nothing is fetched when a page is read.
        assert "http" not in text.replace("http://www.w3.org/2000/svg", "")
