"""Markdown from what the code says of itself."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence

_CODE = re.compile(r"(``.+?``|`[^`]+`)")


def plain(text: str) -> str:
    """Text whose signs mean nothing in Markdown, but for code between backticks."""
    return _between_code(text, lambda part: re.sub(r"([<>*_|\\\[\]])", r"\\\1", part))


def _between_code(text: str, change: Callable[[str], str]) -> str:
    parts = _CODE.split(text)
    return "".join(part if at % 2 else change(part) for at, part in enumerate(parts))


def cell(text: str) -> str:
    """Text of one line, for a cell of a table."""
    return plain(" ".join(text.split()))


def code(text: str) -> str:
    """Code within a line."""
    return f"`` {text} ``" if "`" in text else f"`{text}`"


def table(titles: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """A table; its cells are Markdown of one line. Without rows: nothing."""
    lines = [f"| {' | '.join(row)} |" for row in rows]
    if not lines:
        return ""
    head = f"| {' | '.join(titles)} |\n|{'---|' * len(titles)}\n"
    return head + "\n".join(lines) + "\n"


def fenced(text: str, language: str = "text") -> str:
    """A block of code."""
    return f"```{language}\n{text.rstrip()}\n```\n"


def page(*parts: str) -> str:
    """Parts with an empty line between them; empty ones are left out."""
    return "\n\n".join(part.strip("\n") for part in parts if part.strip()) + "\n"


def first_sentence(text: str) -> str:
    """The first sentence of a text, or its first paragraph if that ends without a full stop."""
    paragraph = " ".join(text.split("\n\n")[0].split())
    found = re.match(r".+?[.?!](?=\s|$)", paragraph)
    return found[0] if found else paragraph
