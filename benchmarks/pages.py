"""Figures in a page of the documentation, between two marks."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path


def put_between(page: Path, begin: str, end: str, lines: Sequence[str]) -> None:
    """Replace what stands between the marks of a page; the marks stay."""
    head, rest = page.read_text().split(begin)
    page.write_text("\n".join([head + begin, *lines, end]) + rest.split(end)[1])
