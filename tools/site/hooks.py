"""Hooks that mkdocs calls during the build of the site; mkdocs.yml names this file.

docs/*.md, and the pages that they link to elsewhere  --rewrite_links-->  pages of the site
the code                           --generated_pages-->  pages below reference/
the index of docs/README.md        --navigation_of-->    tabs and their pages
blocks of mermaid                  --svg_of-->           figures
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, ClassVar

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page

from tools.site import markup
from tools.site.diagrams import Diagram, read_diagram, svg_of
from tools.site.links import (
    deepen_lists,
    heading_anchor,
    linked_files,
    outside_fences,
    rewrite_links,
    site_path,
)
from tools.site.reference import GeneratedPage, generated_pages

ROOT = Path(__file__).resolve().parents[2]
INDEX = "docs/README.md"
#: Section of the index that lists the generated pages after its own.
REFERENCE = "Reference"
#: The last tab, with pages about the project.
PROJECT = {"Contribute": "CONTRIBUTING.md", "Changelog": "CHANGELOG.md"}
#: Pages of measurements and internals, which a search ranks last.
RANKED_LAST = {
    f"docs/{name}.md"
    for name in (
        "architecture", "dependencies", "evaluation", "fault_injection", "model", "paper",
        "performance",
    )
}  # fmt: skip
#: Factor of their scores: a match in a title has a thousand times the score of one in the text.
_LAST = 1e-4
#: Factor of HTTP operations and records, so that they rank after the text of guides.
_LISTED = 1e-2
_ROW = re.compile(r"^\| \[([^\]]+)\]\(([^)#]+\.md)\) \|", re.MULTILINE)
_MERMAID = re.compile(r"^```mermaid\n(.*?)^```$", re.MULTILINE | re.DOTALL)
#: Assets of the pages, by their names on the site.
_ASSETS = {"site.css": "tools/site/site.css", "icon.svg": "service/dashboard/pages/icon.svg"}


class _Build:
    """Shared state of the hooks of one build."""

    pages: ClassVar[dict[str, GeneratedPage]] = {}
    #: Paths of pages in the repository, by their paths on the site.
    sources: ClassVar[dict[str, str]] = {}


def navigation_of(index: str, generated: list[GeneratedPage]) -> list[dict[str, Any]]:
    """Return tabs with their pages, from the tables of the index.

    Parameters
    ----------
    index : text of docs/README.md with a heading for each tab and a row for each page
    generated : pages to list in the section Reference

    Raises
    ------
    ValueError : If the section Reference does not exist.
    """
    tabs: list[dict[str, Any]] = [{"Home": site_path(INDEX)}]
    for part in index.split("\n## ")[1:]:
        title = part.partition("\n")[0].strip()
        pages: list[Any] = [
            {name: rewrite_links(f"]({path})", INDEX)[2:-1]} for name, path in _ROW.findall(part)
        ]
        if title == REFERENCE:
            pages += _navigation_entries(generated)
        tabs.append({title: pages})
    if not any(REFERENCE in tab for tab in tabs):
        raise ValueError(f"{INDEX} has no section {REFERENCE!r} for the generated pages.")
    tabs.append({"Project": [{name: site_path(path)} for name, path in PROJECT.items()]})
    return tabs


def _navigation_entries(generated: list[GeneratedPage]) -> list[Any]:
    """Return the entries of generated pages; those of a group are below the group's name."""
    entries: list[Any] = []
    groups: dict[str, list[Any]] = {}
    for page in generated:
        if not page.group:
            entries.append({page.title: page.path})
            continue
        if page.group not in groups:
            groups[page.group] = []
            entries.append({page.group: groups[page.group]})
        first = page.path.endswith("/index.md")  # the group's own page
        groups[page.group].append(page.path if first else {page.title: page.path})
    return entries


def with_generated(index: str, generated: list[GeneratedPage]) -> str:
    """Return the index with rows for the generated pages at the end of its section Reference."""
    rows = "\n".join(
        f"| [{page.title}]({page.path}) | {page.about} |" for page in generated if page.about
    )
    head, mark, rest = index.partition(f"\n## {REFERENCE}\n")
    section, other, tail = rest.partition("\n## ")
    return f"{head}{mark}{section.rstrip()}\n{rows}\n{other}{tail}"


def with_figures(text: str, page: str) -> str:
    """Return a page's text with its mermaid blocks drawn."""
    count = 0

    def drawn(match: re.Match[str]) -> str:
        nonlocal count
        count += 1
        diagram: Diagram = read_diagram(match[1])
        svg = svg_of(diagram, f"{heading_anchor(page)}-{count}")
        return f'\n<figure class="diagram" tabindex="0">{svg}</figure>\n'

    return _MERMAID.sub(drawn, text)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Set the navigation, and anchors in the style of git hosts."""
    generated = generated_pages()
    _Build.pages = {page.path: page for page in generated}
    config.nav = navigation_of((ROOT / INDEX).read_text(encoding="utf-8"), generated)
    config.mdx_configs.setdefault("toc", {})["slugify"] = heading_anchor
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add generated pages, linked files outside docs/, and assets."""
    documents = [f"docs/{page.src_uri}" for page in files.documentation_pages()]
    _Build.sources = {site_path(path): path for path in documents}
    for path, page in _Build.pages.items():
        files.append(File.generated(config, path, content=page.text))
    for path in sorted({*linked_files(ROOT, documents), *PROJECT.values()}):
        files.append(_linked_file(path, config))
        _Build.sources[site_path(path)] = path
    for name, path in _ASSETS.items():
        files.append(File.generated(config, f"site/{name}", abs_src_path=str(ROOT / path)))
    return files


def _linked_file(path: str, config: MkDocsConfig) -> File:
    """Return a file outside docs/ as a page, or as a page that shows its text."""
    text = (ROOT / path).read_text(encoding="utf-8")
    if not path.endswith(".md"):
        language = {".py": "python", ".yaml": "yaml"}.get(Path(path).suffix, "text")
        text = markup.page(f"# {Path(path).name}", markup.fenced(text, language))
    file = File.generated(config, site_path(path), content=text)
    if path not in PROJECT.values():
        file.inclusion = InclusionLevel.NOT_IN_NAV
    return file


def on_page_markdown(text: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Return a page as the site shows it: links, lists and diagrams."""
    del config, files
    path = _Build.sources.get(page.file.src_uri)
    if path is None:
        if page.file.src_uri.startswith("reference/http/"):
            page.meta["search"] = {"boost": _LISTED}
        return text
    text = deepen_lists(rewrite_links(text, path))
    if path == INDEX:
        text = with_generated(text, list(_Build.pages.values()))
        page.meta["hide"] = ["navigation"]  # the index itself is the navigation
    if path == PROJECT["Changelog"] or not path.endswith(".md"):
        page.meta["search"] = {"exclude": True}  # its entries would rank before current pages
    if path in RANKED_LAST:
        page.meta["search"] = {"boost": _LAST}
    # Git hosts need a backslash before a bar in a table; Python-Markdown would show it.
    text = outside_fences(text, lambda part: re.sub(r"`[^`\n]*`", _without_escapes, part))
    return with_figures(text, path)


def on_post_page(output: str, page: Page, config: MkDocsConfig) -> str:
    """Name the search dialog for screen readers, since the theme does not."""
    del page, config
    return output.replace('role="dialog"', 'role="dialog" aria-label="Search"', 1)


def _without_escapes(match: re.Match[str]) -> str:
    return match[0].replace("\\|", "|")
