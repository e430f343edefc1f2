"""Makes the site of the documents as they lie in the tree, where links lead to files
of the tree, and of the protos."""

import os
import pathlib
import re
import sys

from mkdocs.structure.files import File

HERE = pathlib.Path(__file__).resolve().parent
TREE = HERE.parents[1]
sys.path.insert(0, str(HERE))

import api_page  # noqa: E402

# Pages whose documents are not in docs/, by their place in the tree.
PAGES = {
    "README.md": "index.md",
    "SECURITY.md": "security.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
    "client/python/README.md": "python.md",
    "proto/README.md": "languages.md",
    "tests/bench/RESULTS.md": "speed.md",
    "tests/evaluation/RESULTS.md": "evaluation.md",
}
# What a page of the site has instead, beside the folders of these documents.
OTHERS = {"proto/revisit/v1": "api.md"}

# A picture is a link with ! before it.
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")
EMPTY_HEAD = re.compile(r"<thead>\s*<tr>(\s*<th[^>]*></th>)+\s*</tr>\s*</thead>")
FENCE = re.compile(r"^(?:```.*?^```|<!--.*?-->)", re.DOTALL | re.MULTILINE)


def _page_of(path):
    """The page for a file or folder of the tree; None without one."""
    for place, page in OTHERS.items():
        if path == place or path.startswith(place + "/"):
            return page
    if path.startswith("docs/") and path.endswith(".md"):
        return path.removeprefix("docs/")
    return PAGES.get(path) or PAGES.get(f"{path}/README.md")


def _document_of(page):
    for document, name in PAGES.items():
        if name == page:
            return document
    return f"docs/{page}"


def _linked(document):
    """Replaces a link of the document by one to a page, or, where it leads to what is
    not in the site, by the name of that."""

    def replace(match):
        is_picture, text, target = match.groups()
        if re.match(r"[a-z]+:|#", target):
            return match[0]
        path, hash_sign, anchor = target.partition("#")
        place = os.path.normpath(os.path.join(os.path.dirname(document), path))
        if not (TREE / place).exists():
            raise ValueError(f"{document} links to {place}, which is not there")
        if is_picture:
            if not place.startswith("docs/"):
                raise ValueError(f"{document} has {place}, which is not in docs/")
            return f"![{text}]({place.removeprefix('docs/')})"
        page = _page_of(place)
        if page is None:
            plain = text.strip("`")
            return f"`{place}`" if plain.endswith(place) or place.endswith(
                plain) else f"{text} (`{place}`)"
        # A place in a proto is no heading of its page.
        place = "" if page in OTHERS.values() else hash_sign + anchor
        return f"[{text}]({page}{place})"

    return replace


def _outside_of_code(markdown, edit):
    kept, parts, end = FENCE.finditer(markdown), [], 0
    for fence in kept:
        parts += [edit(markdown[end:fence.start()]), fence[0]]
        end = fence.end()
    return "".join(parts) + edit(markdown[end:])


def on_files(files, config):
    for document, page in PAGES.items():
        files.append(File.generated(
            config, page, content=(TREE / document).read_text()))
    files.append(File.generated(config, "api.md",
                                content=api_page.write(TREE / "proto")))
    return files


def on_page_markdown(markdown, page, **_):
    if page.file.src_uri in OTHERS.values():
        return markdown
    replace = _linked(_document_of(page.file.src_uri))
    return _outside_of_code(markdown, lambda text: LINK.sub(replace, text))


def on_page_content(html, **_):
    # Markdown has no table without a head; an empty one would be drawn as a row.
    return EMPTY_HEAD.sub("", html)
