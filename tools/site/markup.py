"""Markdown from docstrings and descriptions of the code."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence

_CODE = re.compile(r"(``.+?``|`[^`]+`)")


def plain(text: str) -> str:
    """Escape a text for Markdown, except code between backticks."""
    return _between_code(text, lambda part: re.sub(r"([<>*_|\\\[\]])", r"\\\1", part))


def _between_code(text: str, change: Callable[[str], str]) -> str:
    parts = _CODE.split(text)
    return "".join(part if at % 2 else change(part) for at, part in enumerate(parts))


def cell(text: str) -> str:
    """Return a text as one line for a table cell."""
    return plain(" ".join(text.split()))


def code(text: str) -> str:
    """Return inline code."""
    return f"`` {text} ``" if "`" in text else f"`{text}`"


def table(titles: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table with one-line Markdown cells; an empty text without rows."""
    lines = [f"| {' | '.join(row)} |" for row in rows]
    if not lines:
        return ""
    head = f"| {' | '.join(titles)} |\n|{'---|' * len(titles)}\n"
    return head + "\n".join(lines) + "\n"


def fenced(text: str, language: str = "text") -> str:
    """Return a block of code."""
    return f"```{language}\n{text.rstrip()}\n```\n"


def page(*parts: str) -> str:
    """Return parts with an empty line between them, without empty parts."""
    return "\n\n".join(part.strip("\n") for part in parts if part.strip()) + "\n"


def first_sentence(text: str) -> str:
    """Return the first sentence of a text, or its first paragraph without a full stop."""
    paragraph = " ".join(text.split("\n\n")[0].split())
    match = re.match(r".+?[.?!](?=\s|$)", paragraph)
    return match[0] if match else paragraph
