"""Paths of pages on the site, and changes of their links and nested lists.

A page of the site is a file of the repository. Pages of docs/ are at the top of the site; linked
files elsewhere keep their paths, so that no link leads out of the site.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Callable, Iterator
from pathlib import Path

DOCS = "docs/"
#: Path of the repository's README on the site, which has its own index.
README = "introduction.md"
_LINK = re.compile(r"(?<=\]\()([^)\s]+)(?=\))")
_FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
_SHALLOW = re.compile(r"^ {2,3}(?=\S)", re.MULTILINE)
#: Suffixes of files that a browser shows or saves; all other files are shown as text.
_BINARY = (".png", ".svg", ".json")


def site_path(path: str) -> str:
    """Return the path of a file on the site; both paths are relative, with slashes."""
    if path.startswith(DOCS):
        return path.removeprefix(DOCS)
    if path == "README.md":
        return README
    return path if path.endswith((".md", *_BINARY)) else f"{path}.md"


def targets(text: str) -> Iterator[str]:
    """Yield the targets of a page's relative links, without anchors and without blocks of code."""
    for target in _LINK.findall(_FENCE.sub("", text)):
        if "://" not in target and not target.startswith(("#", "mailto:")):
            yield target.partition("#")[0]


def linked_files(root: Path, pages: list[str]) -> list[str]:
    """Return the files outside docs/ that pages link to, in the order of their paths.

    Parameters
    ----------
    root : folder of the repository
    pages : paths of pages in the repository; links of linked pages are followed too

    Raises
    ------
    FileNotFoundError : If the target of a link is not a file of the repository.
    """
    results: set[str] = set()
    waiting = list(pages)
    while waiting:
        page = waiting.pop()
        for target in targets((root / page).read_text(encoding="utf-8")):
            path = posixpath.normpath(posixpath.join(posixpath.dirname(page), target))
            if not (root / path).is_file():
                raise FileNotFoundError(f"{page} links to {target}, which is not a file. Fix it.")
            if not path.startswith(DOCS) and path not in results:
                results.add(path)
                if path.endswith(".md"):
                    waiting.append(path)
    return sorted(results)


def rewrite_links(text: str, page: str) -> str:
    """Return a page's text with the relative links of the site.

    Parameters
    ----------
    text : Markdown
    page : path of the page in the repository
    """
    here = posixpath.dirname(site_path(page))

    def moved(match: re.Match[str]) -> str:
        target, mark, anchor = match[0].partition("#")
        if not target or "://" in match[0] or target.startswith("mailto:"):
            return match[0]
        path = posixpath.normpath(posixpath.join(posixpath.dirname(page), target))
        return posixpath.relpath(site_path(path), here or ".") + mark + anchor

    return outside_fences(text, lambda part: _LINK.sub(moved, part))


def outside_fences(text: str, change: Callable[[str], str]) -> str:
    """Return a text with changes outside blocks of code."""
    parts, end = [], 0
    for fence in _FENCE.finditer(text):
        parts += [change(text[end : fence.start()]), fence[0]]
        end = fence.end()
    return "".join(parts) + change(text[end:])


def deepen_lists(text: str) -> str:
    """Return a page's text with list contents indented by four, as Python-Markdown requires.

    Git hosts accept two or three, which align with the text of the item.
    """
    return outside_fences(text, lambda part: _SHALLOW.sub("    ", part))


def heading_anchor(title: str, separator: str = "-") -> str:
    """Return the anchor that git hosts generate from the text of a heading."""
    return re.sub(r"[^\w -]", "", title).strip().lower().replace(" ", separator)
