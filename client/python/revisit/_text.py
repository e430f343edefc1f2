"""Texts of others, such as a server, as a terminal may show them."""

from __future__ import annotations

import re

# The control characters, the separators of lines and paragraphs, the interlinear
# annotations, lone surrogates, and what Unicode 15 calls
# Default_Ignorable_Code_Point.
_ESCAPED = re.compile(
    r"[\x00-\x1f\x7f-\x9f\xad\u034f\u061c\u115f\u1160\u17b4\u17b5\u180b-\u180f"
    r"\u200b-\u200f\u2028-\u202e\u2060-\u206f\u3164\ud800-\udfff\ufe00-\ufe0f"
    r"\ufeff\uffa0\ufff0-\ufffb\U0001bca0-\U0001bca3\U0001d173-\U0001d17a"
    r"\U000e0000-\U000e0fff]")


def printable(text: str) -> str:
    """The text with the number of each character that could steer a terminal, begin
    a line of its own, change the direction of what is around it, or show as
    nothing, in place of the character: "<U+001B>"."""
    return _ESCAPED.sub(lambda found: f"<U+{ord(found[0]):04X}>", text)
