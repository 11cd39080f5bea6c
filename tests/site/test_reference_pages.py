"""Tests that the generated pages describe all of the code, once."""

import json
import re
from pathlib import Path

import pytest

import sceneprint_client
from sceneprint_client import Client
from tools.site import http_pages
from tools.site.reference import api_document, generated_pages

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def document():
    return api_document()


@pytest.fixture(scope="module")
def pages():
    return {page.path: page for page in generated_pages()}


def test_every_operation_is_described_once_on_the_page_of_its_resource(document, pages):
    frozen = json.loads((ROOT / "tests/golden/openapi.json").read_text())["paths"]
    wanted = {
        (f"{method.upper()} {path}", body["tags"][0])
        for path, methods in frozen.items()
        for method, body in methods.items()
    }
    described = [
        (line, name)
        for name in http_pages.resources(document)
        for line in re.findall(
            r"^```http\n(.*)\n```$", pages[f"reference/http/{name}.md"].text, re.M
        )
    ]
    assert len(described) == len(wanted) > 90
    assert set(described) == wanted
    listed = re.findall(
        r"^\| \[`([^`]+)`\]\((\w+)\.md#", pages["reference/http/index.md"].text, re.M
    )
    assert set(listed) == wanted
    assert pages["reference/http/index.md"].text.splitlines()[2].startswith(f"{len(wanted)} opera")


def sections(text, level=2):
    """Return the text below each heading of a level, by the heading without its anchor."""
    parts = re.split(rf"^{'#' * level} (.*)$", text, flags=re.MULTILINE)
    titles = [title.partition(" {")[0] for title in parts[1::2]]
    return dict(zip(titles, parts[2::2], strict=True))


def test_everything_that_the_client_offers_is_described(pages):
    result = sections(pages["reference/client.md"].text)
    assert list(result) == [name for name in sceneprint_client.__all__ if name[0] != "_"]
    methods = {name for name in dir(Client) if name[0] != "_" and callable(getattr(Client, name))}
    assert set(sections(result["Client"], 3)) == methods
    assert len(methods) > 90
