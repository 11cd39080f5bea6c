"""Where each page of the site comes from, and what changes on the way there: links, inner lists.

A page of the site is a file of the repository. Pages below docs/ lie at the top of the site; what
they link to elsewhere in the repository keeps its path, so that no link leads out of the site.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Callable, Iterator
from pathlib import Path

DOCS = "docs/"
#: Where the README of the repository is read, if a page links to it: the site has its own index.
README = "introduction.md"
_LINK = re.compile(r"(?<=\]\()([^)\s]+)(?=\))")
_FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
_SHALLOW = re.compile(r"^ {2,3}(?=\S)", re.MULTILINE)
#: Ends of names of files that a browser shows or saves; all other files are shown as text.
_BINARY = (".png", ".svg", ".json")


def site_path(path: str) -> str:
    """Where a file of the repository is on the site; both relative, with slashes."""
    if path.startswith(DOCS):
        return path.removeprefix(DOCS)
    if path == "README.md":
        return README
    return path if path.endswith((".md", *_BINARY)) else f"{path}.md"


def targets(text: str) -> Iterator[str]:
    """Targets of the relative links of a page, without anchors, outside blocks of code."""
    for target in _LINK.findall(_FENCE.sub("", text)):
        if "://" not in target and not target.startswith(("#", "mailto:")):
            yield target.partition("#")[0]


def linked_files(root: Path, pages: list[str]) -> list[str]:
    """Files outside docs/ that pages lead to, in the order of their paths.

    Parameters
    ----------
    root : folder of the repository
    pages : their paths in it; what a linked page links to is found as well

    Raises
    ------
    FileNotFoundError : a link leads to no file of the repository.
    """
    found: set[str] = set()
    waiting = list(pages)
    while waiting:
        page = waiting.pop()
        for target in targets((root / page).read_text(encoding="utf-8")):
            path = posixpath.normpath(posixpath.join(posixpath.dirname(page), target))
            if not (root / path).is_file():
                raise FileNotFoundError(f"{page} links to {target}, which is no file. Mend it.")
            if not path.startswith(DOCS) and path not in found:
                found.add(path)
                if path.endswith(".md"):
                    waiting.append(path)
    return sorted(found)


def rewritten(text: str, page: str) -> str:
    """A page's text with its relative links as they are on the site.

    Parameters
    ----------
    text : Markdown
    page : its path in the repository
    """
    here = posixpath.dirname(site_path(page))

    def moved(found: re.Match[str]) -> str:
        target, mark, anchor = found[0].partition("#")
        if not target or "://" in found[0] or target.startswith("mailto:"):
            return found[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(page), target))
        return posixpath.relpath(site_path(path), here or ".") + mark + anchor

    return outside_fences(text, lambda part: _LINK.sub(moved, part))


def outside_fences(text: str, change: Callable[[str], str]) -> str:
    """A text of which everything but blocks of code is changed."""
    parts, end = [], 0
    for fence in _FENCE.finditer(text):
        parts += [change(text[end : fence.start()]), fence[0]]
        end = fence.end()
    return "".join(parts) + change(text[end:])


def with_deep_lists(text: str) -> str:
    """A page's text with what lies within list items indented by four, as Python-Markdown needs it.

    Git hosts are content with two or three, which put it below the text of the item.
    """
    return outside_fences(text, lambda part: _SHALLOW.sub("    ", part))


def heading_anchor(title: str, separator: str = "-") -> str:
    """The anchor of a heading, as git hosts make it of the heading's text."""
    return re.sub(r"[^\w -]", "", title).strip().lower().replace(" ", separator)
