"""What the documents link to is there: files, folders and headings."""

import re

import pytest

from documents import DOCUMENTS, name_of
from stubs import ROOT


def without_code(text):
    return re.sub(r"^```.*?^```", "", text, flags=re.DOTALL | re.MULTILINE)


def anchors(path):
    """Headings of a document in the form in which links name them."""
    headings = re.findall(r"^#+ +(.+)$", without_code(path.read_text()),
                          re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
            for heading in headings}


def links(path):
    """Targets of the links of a document that lead to files of the tree."""
    targets = re.findall(r"\]\(([^)\s]+)\)", without_code(path.read_text()))
    return [target for target in targets
            if not re.match(r"[a-z]+:", target)]


def test_there_are_documents_with_links():
    names = set(map(name_of, DOCUMENTS))
    assert {"README.md", "CHANGELOG.md", "SECURITY.md",
            "docs/operate.md"} <= names
    assert len(links(ROOT / "README.md")) > 5


@pytest.mark.parametrize("document", DOCUMENTS, ids=name_of)
def test_every_link_leads_to_something_in_the_tree(document):
    missing = []
    for link in links(document):
        name, _, anchor = link.partition("#")
        target = (document.parent / name).resolve() if name else document
        if not target.is_relative_to(ROOT) or not target.exists():
            missing.append(link)
        elif anchor and anchor not in anchors(target):
            missing.append(link)
    assert missing == []


@pytest.mark.parametrize("document", ["operate", "scale", "integrate",
                                      "how-it-works", "limits", "performance"])
def test_readme_leads_to(document):
    assert f"docs/{document}.md" in links(ROOT / "README.md")


def quoted_messages():
    """Messages of the first columns of docs/troubleshooting.md."""
    rows = re.findall(r"^\| (`.*?) \|", (ROOT / "docs/troubleshooting.md").read_text(),
                      re.MULTILINE)
    return [message for row in rows for message in re.findall(r"`([^`]+)`", row)]


def words_of_sources():
    """All text in the sources that print messages: adjacent literals are one."""
    text = " ".join(path.read_text() for folder in ("client", "core", "server", "proto")
                    for pattern in ("*.cc", "*.h", "*.proto")
                    for path in (ROOT / folder).rglob(pattern)
                    if "node_modules" not in path.parts)
    return re.sub(r'"\s+"', "", text)


def test_messages_that_are_explained_are_those_of_the_programs():
    sources = words_of_sources()
    parts = {part.strip() for message in quoted_messages()
             for part in message.split("...") if len(part.strip()) > 3}
    assert len(parts) > 50
    # Of gRPC, of the operating system.
    parts -= {"failed to connect to all addresses", ": Address already in use"}
    assert sorted(part for part in parts if part not in sources) == []
