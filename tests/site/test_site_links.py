"""Tests of the paths and the links of the site's pages."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.site.hooks import navigation_of
from tools.site.links import (
    linked_files,
    rewritten,
)
from tools.site.reference import GeneratedPage

GENERATED = [
    GeneratedPage("reference/http/index.md", "HTTP API", "", "operations", "HTTP API"),
    GeneratedPage("reference/http/maps.md", "Maps", "", "", "HTTP API"),
    GeneratedPage("reference/errors.md", "Errors", "", "problems"),
]
INDEX = """# Documentation

## Tutorials

| | |
|---|---|
| [Start](start.md) | first |
| [Examples](../examples/README.md) | more |

## Reference

| | |
|---|---|
| [Fields](fields.md) | all of them |

## Explanation

| | |
|---|---|
| [Trust](trust.md) | why |
"""


def test_links_are_rewritten_for_where_the_page_lies() -> None:
    text = (
        "[a](api.md#maps) [b](../examples/robot_loop.py) [c](https://x.org/a.md) [d](#here)\n"
        "```\n[e](../examples/README.md)\n```\n[f](../examples/README.md)\n"
    )
    assert rewritten(text, "docs/tracker.md") == (
        "[a](api.md#maps) [b](examples/robot_loop.py.md) [c](https://x.org/a.md) [d](#here)\n"
        "```\n[e](../examples/README.md)\n```\n[f](examples/README.md)\n"
    )
    assert rewritten("[a](../../docs/tracker.md#x)", "ros2/node/README.md") == (
        "[a](../../tracker.md#x)"
    )
    assert rewritten("[a](docs/README.md)", "CHANGELOG.md") == "[a](README.md)"


def test_what_pages_link_to_is_found_through_other_pages(tmp_path: Path) -> None:
    for path, text in {
        "docs/a.md": "[b](../b/README.md) [c](c.md) [w](https://w.org)",
        "docs/c.md": "```\n[none](../none.md)\n```\n",
        "b/README.md": "[code](run.py) [a](../docs/a.md)",
        "b/run.py": "print()",
        "b/other.py": "print()",
    }.items():
        (tmp_path / path).parent.mkdir(exist_ok=True)
        (tmp_path / path).write_text(text)
    pages = ["docs/a.md", "docs/c.md"]
    assert linked_files(tmp_path, pages) == ["b/README.md", "b/run.py"]
    (tmp_path / "docs/c.md").write_text("[none](../none.md#x)")
    with pytest.raises(FileNotFoundError, match=r"docs/c\.md links to \.\./none\.md"):
        linked_files(tmp_path, pages)


def test_navigation_follows_the_index_and_lists_generated_pages_in_reference() -> None:
    assert navigation_of(INDEX, GENERATED) == [
        {"Home": "README.md"},
        {"Tutorials": [{"Start": "start.md"}, {"Examples": "examples/README.md"}]},
        {
            "Reference": [
                {"Fields": "fields.md"},
                {"HTTP API": ["reference/http/index.md", {"Maps": "reference/http/maps.md"}]},
                {"Errors": "reference/errors.md"},
            ]
        },
        {"Explanation": [{"Trust": "trust.md"}]},
        {"Project": [{"Contribute": "CONTRIBUTING.md"}, {"Changelog": "CHANGELOG.md"}]},
    ]
    with pytest.raises(ValueError, match="no section 'Reference'"):
        navigation_of("# Documentation\n", GENERATED)
