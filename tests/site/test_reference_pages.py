"""Pages made from the code: everything is on them, once, as the code has it."""

from __future__ import annotations

import argparse
import json
import re
from pathlib import Path
from typing import Any

import pytest

import sceneprint_client
from sceneprint import errors
from sceneprint.cli import all_commands, parser
from sceneprint.cli.completion import subcommands
from sceneprint_client import Client
from service.problems import type_of as problem_type
from tools.site import http_pages
from tools.site.code_pages import metric_families
from tools.site.error_page import kinds, remedy, status
from tools.site.markup import cell
from tools.site.reference import GeneratedPage, api_document, generated_pages

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def document() -> dict[str, Any]:
    return api_document()


@pytest.fixture(scope="module")
def pages() -> dict[str, GeneratedPage]:
    return {one.path: one for one in generated_pages()}


def sections(text: str, level: int = 2) -> dict[str, str]:
    """Text below each heading of a level, by the heading without its anchor."""
    parts = re.split(rf"^{'#' * level} (.*)$", text, flags=re.MULTILINE)
    return {
        title.partition(" {")[0]: body for title, body in zip(parts[1::2], parts[2::2], strict=True)
    }


def rows(text: str) -> list[list[str]]:
    """Cells of the rows of tables."""
    lines = re.findall(r"^\| (.*) \|$", text, re.MULTILINE)
    return [re.split(r" \| ", line) for line in lines]


def test_every_operation_is_described_once_on_the_page_of_its_resource(
    document: dict[str, Any], pages: dict[str, GeneratedPage]
) -> None:
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


def test_an_operation_says_what_it_takes_and_what_it_answers(
    pages: dict[str, GeneratedPage],
) -> None:
    text = sections(pages["reference/http/jobs.md"].text)["Retry job"]
    assert "POST /v1/jobs/{job_id}/retry" in text
    assert ["`job_id`", "path (required)", "string", ""] in rows(text)
    answers = {cells[0]: cells[1] for cells in rows(text)}
    assert answers["202"] == "[Job](records.md#job)"
    problems = [name for name in answers if answers[name] == "[Problem](records.md#problem)"]
    assert problems == ["404, 409, 400, 401, 403, 408, 421, 429, 500, 503, 507"]
    ask = sections(pages["reference/http/queries.md"].text)["Ask"]
    folded = ask.split('??? note "Parameters if the body is the frame itself"')[1].split("**Body**")
    assert "`fx` | query | number | of the camera, pixels." in folded[0]
    assert "**Body** `multipart/form-data`" in ask
    body = {cells[0]: cells[1:] for cells in rows(ask)}
    assert body["`frame` (required)"][0] == "file"
    assert body["`meta` (required)"][0].startswith("[FrameMeta](records.md#framemeta)")


def test_every_record_has_its_fields(
    document: dict[str, Any], pages: dict[str, GeneratedPage]
) -> None:
    schemas = document["components"]["schemas"]
    text = pages["reference/http/records.md"].text
    found = sections(text)
    assert len(found) == len(schemas) > 140
    fields = sum(len(schema.get("properties", {})) for schema in schemas.values())
    assert sum(len(rows(body)) for body in found.values()) == fields + sum(
        1 for schema in schemas.values() if schema.get("properties")
    )
    answer = {cells[0]: cells[1] for cells in rows(found["Answer"])}
    assert answer["`status` (required)"] == "`found` or `ambiguous` or `not_found` or `unvalidated`"
    assert answer["`alternatives`"] == "list of [Alternative](records.md#alternative)"
    assert "received" in found["FrameState"]
    assert r"Page\[Frame\]" in found


def test_every_metric_is_listed_with_its_labels(pages: dict[str, GeneratedPage]) -> None:
    watched = (ROOT / "docs/operations.md").read_text().split("| metric |")[1].split("\n\n")[0]
    names = {one.name for one in metric_families()}
    assert names == set(re.findall(r"`(sceneprint_\w+)`", watched))
    told = {cells[0].strip("`"): cells[1:] for cells in rows(pages["reference/metrics.md"].text)}
    assert set(told) == names | {"metric"}
    assert told["sceneprint_requests_total"] == [
        "counter", "`method`, `route`, `status`", "Requests answered.",
    ]  # fmt: skip


def test_every_command_is_described_with_all_its_options(pages: dict[str, GeneratedPage]) -> None:
    found = sections(pages["reference/commands.md"].text)
    parsers = {name: one for name, _, one in subcommands(parser())}
    assert list(found) == list(parsers)
    assert [name for name in found if " " not in name] == list(all_commands())
    assert {"make association", "make mesh"} < found.keys()
    for name, command in parsers.items():
        cells = [row[0] for row in rows(found[name])]
        for option in command._actions:
            if option.help == argparse.SUPPRESS or "--help" in option.option_strings:
                continue
            for flag in option.option_strings:
                assert any(flag in re.split(r"[`, ]+", one) for one in cells), (name, flag)
    query = {row[0]: row[1] for row in rows(found["query"])}
    assert query["`--k K`"].startswith("largest number of accepted matches to list")
    assert query["`--k K`"].endswith("(default: 5)")
    assert found["query"].split("```text\n")[1].startswith("sceneprint query [-h]")


def test_every_error_is_listed_with_its_status_and_what_to_do(
    pages: dict[str, GeneratedPage],
) -> None:
    public = set(kinds())
    assert {one.__name__ for one in public} == {
        name for name in errors.__all__ if name[0].isupper()
    } - {"SceneprintError"}
    parts = sections(pages["reference/errors.md"].text)
    problems = {row[1].strip("`"): row for row in rows(parts["Problems by status"])[1:]}
    others = {row[0].strip("`"): row for row in rows(parts["Other errors"])[1:]}
    for kind in public:
        if status(kind) == 500:
            assert others[kind.__name__][2]
        else:
            row = problems[problem_type(kind.__name__)]
            assert row[0].startswith(f"{status(kind)} ")
            assert row[3] == cell(remedy(kind))
    assert problems["/problems/rate-limited"] == [
        "429 Too Many Requests", "`/problems/rate-limited`",
        "The caller sends more requests than it may.", "Wait for the seconds in `Retry-After`.",
    ]  # fmt: skip
    # whatever the reference by hand lists is there, too
    table = (ROOT / "docs/reference.md").read_text().split("## Problems")[1]
    by_hand = re.findall(r"`([a-z]+(?:-[a-z]+)+|forbidden|misdirected|conflict|busy)`", table)
    assert {f"/problems/{name}" for name in by_hand} - set(problems) == {"/problems/damaged-blob"}


def test_everything_that_the_client_offers_is_described(pages: dict[str, GeneratedPage]) -> None:
    found = sections(pages["reference/client.md"].text)
    assert list(found) == [name for name in sceneprint_client.__all__ if name[0] != "_"]
    methods = sections(found["Client"], 3)
    assert set(methods) == {
        name for name in dir(Client) if name[0] != "_" and callable(getattr(Client, name))
    }
    assert len(methods) > 90
    assert "embedded(path: str | Path) -> Self" in methods["embedded"]
    assert ["`UnknownMap`, `UnknownFrame`", "it does not exist."] in rows(methods["query"])
    assert set(sections(found["Tracker"], 3)) >= {"update"}
