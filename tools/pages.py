"""Generator of docs/settings.md and of tables in other pages, from tables in the code.

python -m tools.pages        # writes the pages
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

from annotated_types import Ge, Gt, Le
from pydantic import SecretStr
from pydantic.fields import FieldInfo

from sceneprint import errors
from sceneprint.settings import Settings
from sceneprint_client.api import FrameState, JobState
from sceneprint_client.api.admin import KINDS
from service.metrics import METRICS
from service.problem_types import PROBLEM_TYPES, problem_type
from service.problems import type_of
from tools.site.markup import cell, code, page, table

DOCS = Path(__file__).resolve().parents[1] / "docs"
#: Titles of the sections, by the first setting in each.
SECTIONS = {
    "data_dir": "Places",
    "host": "Service",
    "queued_requests": "Limits of requests",
    "workers": "Workers and decoders",
    "unindexed_frames": "Upkeep",
    "undo_window_s": "Retention",
}
_BOUNDS = {Ge: ("ge", "at least {:,}"), Gt: ("gt", "above {:,}"), Le: ("le", "at most {:,}")}


def settings_page() -> str:
    """Return the page as Markdown."""
    fields = Settings.model_fields
    names, starts = list(fields), [*(list(fields).index(name) for name in SECTIONS), len(fields)]
    parts = [
        "# Settings",
        f"Service and workers read these {len(fields)} environment variables when they start. "
        "All have defaults. An invalid value prevents the start, and a one-line "
        "message is printed. The names in the tables follow `SCENEPRINT_`: `SCENEPRINT_PORT`.",
        "A secret can come from a file of one line: set `SCENEPRINT_DATABASE_URL_FILE`, "
        "`PGPASSWORD_FILE`, `AWS_ACCESS_KEY_ID_FILE`, `AWS_SECRET_ACCESS_KEY_FILE` or "
        "`AZURE_STORAGE_ACCOUNT_KEY_FILE` to its path.",
        "Clients take the defaults of `--url` and `--key` from `SCENEPRINT_URL` and "
        "`SCENEPRINT_KEY`. If `SSL_CERT_FILE` names a PEM file, clients trust its authorities "
        "instead of the public ones.",
    ]
    for title, first, after in zip(SECTIONS.values(), starts, starts[1:], strict=False):
        rows = [_row(name, fields[name]) for name in names[first:after]]
        head = ("name", "type", "default", "what it sets", "when to change it")
        parts += [f"## {title}", table(head, rows)]
    return page(*parts)


def _row(name: str, field: FieldInfo) -> tuple[str, ...]:
    assert field.description is not None
    extra: dict[str, Any] = dict(field.json_schema_extra)  # type: ignore[arg-type]
    bounds = ", ".join(
        text.format(getattr(limit, key))
        for limit in field.metadata
        if type(limit) in _BOUNDS
        for key, text in [_BOUNDS[type(limit)]]
    )
    bounds = re.sub(r"^at least (.*), at most ", r"\1 to ", bounds)
    return (
        f"`{name.upper()}`",
        ", ".join(filter(None, (_type_of(field), bounds))),
        extra["shown"] or _default_text(name, field.default),
        cell(field.description),
        cell(extra["change"]),
    )


def _type_of(field: FieldInfo) -> str:
    """Return the type of a setting's value in words."""
    kinds = {Path: "path", SecretStr: "text", str: "text", int: "whole number", float: "number"}
    result = [
        one for one in (get_args(field.annotation) or [field.annotation]) if one is not type(None)
    ]
    if all(isinstance(item, str) for item in result):
        return " or ".join(map(code, result))
    if result[0] is bool:
        return "`true` or `false`"
    return "list" if Ellipsis in result else kinds[result[0]]


def _default_text(name: str, default: object) -> str:
    if default in (None, ()):
        return "none"
    if name.endswith("_bytes") and isinstance(default, int):
        return f"{code(str(default))} ({default >> 20:,} MiB)"
    return code(str(default).lower() if isinstance(default, bool) else str(default))


def problem_rows() -> Iterator[tuple[str, str, str, str]]:
    """Yield a row for each type of problem, with the classes that share it."""
    kinds = [getattr(errors, name) for name in errors.__all__ if name[:1].isupper()]
    for name, row in sorted(PROBLEM_TYPES.items(), key=lambda one: one[1].status):
        if name == "SceneprintError":  # the base of errors that a service does not send
            continue
        named = {name, *(kind.__name__ for kind in kinds if problem_type(kind) is row)}
        types = sorted(type_of(one).removeprefix("/problems/") for one in named)
        docstring = inspect.getdoc(getattr(errors, name, None)) or ""
        meaning = row.meaning or docstring.partition("\n\n")[0]
        yield str(row.status), ", ".join(map(code, types)), cell(meaning), cell(row.remedy)


def sections() -> dict[str, dict[str, str]]:
    """Return the tables between the marks of each page, by the names of the marks."""
    metrics = (
        (f"`sceneprint_{name}`", m.kind, ", ".join(map(code, m.labels)), cell(m.meaning))
        for name, m in METRICS.items()
    )
    states = [
        table((title, "meaning"), ((f"`{one}`", cell(one.sentence)) for one in kind))
        for title, kind in (("frame", FrameState), ("job", JobState))
    ]
    kinds = ((f"`{kind}`", cell(text)) for kind, text in KINDS.items())
    problems = ("status", "`type` ends in", "meaning", "what to do")
    return {
        "operations.md": {
            "states": page(*states, table(("event", "meaning"), kinds)),
            "metrics": table(("metric", "type", "labels", "meaning"), metrics),
        },
        "reference.md": {"problems": table(problems, problem_rows())},
    }


def written_pages() -> dict[Path, str]:
    """Return the text of each page with its present tables."""
    pages = {DOCS / "settings.md": settings_page()}
    for name, tables in sections().items():
        text = (DOCS / name).read_text()
        for mark, content in tables.items():
            begin, end = f"<!-- {mark}:begin -->", f"<!-- {mark}:end -->"
            head, _, rest = text.partition(begin)
            text = f"{head}{begin}\n\n{content}\n{end}{rest.partition(end)[2]}"
        pages[DOCS / name] = text
    return pages


if __name__ == "__main__":
    for path, text in written_pages().items():
        path.write_text(text)
