"""The project's documents, and the shell commands in them."""

import re
import shlex
import typing

from stubs import ROOT

DOCUMENTS = sorted([
    *ROOT.glob("*.md"), *(
        path for folder in ("client", "deploy", "docs", "proto", "tests")
        for path in (ROOT / folder).rglob("*.md")
        if "node_modules" not in path.parts)])


def name_of(path):
    """The path of a document as it is named in the tree."""
    return path.relative_to(ROOT).as_posix()


class Command(typing.NamedTuple):
    """One command of a document: with its pipes and lists, as many lines as it
    takes, without comments. `marker` is the name in the HTML comment before its
    block, if there is one."""
    text: str
    marker: str


def _is_whole(text):
    """Whether a shell would not wait for more after this."""
    if text.endswith("\\"):
        return False
    try:
        shlex.split(text)
        return True
    except ValueError:
        return False  # A quote is open.


def commands(path):
    """The commands of the fenced blocks `sh` of a document, in order."""
    found = []
    for marker, block in re.findall(
            r"^(?:<!-- ([\w-]+) -->\n)?```sh\n(.*?)^```", path.read_text(),
            re.DOTALL | re.MULTILINE):
        text = ""
        for line in block.splitlines():
            text += re.sub(r"(^| )#.*$", "", line).rstrip()
            if not text:
                continue
            if _is_whole(text):
                found.append(Command(text.replace("\\\n", ""), marker))
                text = ""
            else:
                text += "\n"
        assert not text, f"{path}: an unfinished command: {text}"
    return found
