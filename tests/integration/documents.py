"""The project's documents, the shell commands in them, and what these print."""

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
    block, if there is one; `shown` what the document says that it prints, a block
    `text` behind the one that the command ends."""
    text: str
    marker: str
    shown: typing.Optional[str] = None


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
    for marker, block, shown in re.findall(
            r"^(?:<!-- ([\w-]+) -->\n)?```sh\n(.*?)^```$"
            r"(?:\n\n```text\n(.*?)^```$)?", path.read_text(),
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
        if shown:
            found[-1] = found[-1]._replace(shown=shown)
    return found


# What differs from run to run: uids, today's times, how long something took, whose
# request it was.
OF_ONE_RUN = re.compile(
    r"[0-9a-f]{8}(?:-[0-9a-f]{4}){3}-[0-9a-f]{12}|20\d\d-\d\d-\d\dT[\d:.]+Z"
    r"|in [\d.]+ s, \d+/s|(?<=duration\": )\"[\d.]+s\""
    r"|(?<=\"request_id\": )\"\w+\"|127\.0\.0\.1:\d+")
NUMBER = re.compile(r"-?\d+(?:\.\d+)?(?:e[-+]\d+)?")


def _is_like(shown, printed):
    """Whether two lines are the same, but for what is of one run, and for numbers
    with a point, which may differ by one in their last place: processors round
    otherwise."""
    shown, printed = (OF_ONE_RUN.sub("*", " ".join(line.split()))
                      for line in (shown, printed))
    if NUMBER.sub("#", shown) != NUMBER.sub("#", printed):
        return False
    return all(
        one == other or "." in one and abs(float(one) - float(other))
        <= 1.01 * 10.0 ** -len(one.partition(".")[2].partition("e")[0])
        for one, other in zip(NUMBER.findall(shown), NUMBER.findall(printed)))


#: How far a command has come, which it says only where it takes seconds.
PROGRESS = re.compile(r": (\d+ %  )?\d+(/\d+)? \w+  \d+/s(  [\d:]+ left)?$")


def is_shown(shown, printed):
    """Whether a document shows what a command printed, but for how far it had come. A
    line `...` of the document stands for any number of lines."""
    def match(rows, lines):
        if not rows:
            return not lines
        if rows[0] == "...":
            return any(match(rows[1:], lines[i:]) for i in range(len(lines) + 1))
        return bool(lines) and _is_like(rows[0], lines[0]) and match(
            rows[1:], lines[1:])

    return match([row for row in shown.splitlines() if row.strip()],
                 [line for line in printed.splitlines()
                  if line.strip() and not PROGRESS.search(line)])
