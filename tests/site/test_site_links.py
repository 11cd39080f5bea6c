"""Where pages of the site come from, and what becomes of their links."""

from __future__ import annotations

from pathlib import Path

import pytest

from tools.site.hooks import navigation_of, with_generated
from tools.site.links import (
    heading_anchor,
    linked_files,
    rewritten,
    site_path,
    with_deep_lists,
)
from tools.site.markup import cell, first_sentence, table
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


@pytest.mark.parametrize(
    ("path", "place"),
    [
        ("docs/api.md", "api.md"),
        ("docs/deployment/haproxy.cfg", "deployment/haproxy.cfg"),
        ("examples/README.md", "examples/README.md"),
        ("examples/robot_loop.py", "examples/robot_loop.py.md"),
        ("README.md", "introduction.md"),
        ("CHANGELOG.md", "CHANGELOG.md"),
    ],
)
def test_pages_of_docs_lie_at_the_top_and_others_keep_their_paths(path: str, place: str) -> None:
    assert site_path(path) == place


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


def test_anchors_are_those_of_git_hosts() -> None:
    assert heading_anchor("How it's decided: R1, `found` & DR") == "how-its-decided-r1-found--dr"


def test_what_lies_within_list_items_is_indented_as_the_site_needs_it() -> None:
    text = "1. a\n   * c\n     d\n\n   | e |\n2. f\n\n- g\n  - h\n```\n  - i\n```\n"
    deep = "1. a\n    * c\n     d\n\n    | e |\n2. f\n\n- g\n    - h\n```\n  - i\n```\n"
    assert with_deep_lists(text) == deep


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


def test_the_index_gets_a_row_for_each_generated_page_that_says_what_it_holds() -> None:
    added = (
        "| [Fields](fields.md) | all of them |\n"
        "| [HTTP API](reference/http/index.md) | operations |\n"
        "| [Errors](reference/errors.md) | problems |\n"
    )
    text = with_generated(INDEX, GENERATED)
    assert text == INDEX.replace("| [Fields](fields.md) | all of them |\n", added)


def test_signs_of_markdown_in_texts_of_the_code_stand_for_themselves() -> None:
    assert cell("a *b* <c>\n | `x|*` [y]_z") == r"a \*b\* \<c\> \| `x|*` \[y\]\_z"
    assert table(("a", "b"), [("1", "2")]) == "| a | b |\n|---|---|\n| 1 | 2 |\n"
    assert table(("a",), []) == ""
    assert first_sentence("Send v1.2\nof it. And more.\n\nLast.") == "Send v1.2 of it."
    assert first_sentence("no full stop\n\nLast.") == "no full stop"
