"""Generator of docs/settings.md, a table of all settings, from the fields of `Settings`.

python -m tools.settings_page        # writes the page
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, get_args

from annotated_types import Ge, Gt, Le
from pydantic import SecretStr
from pydantic.fields import FieldInfo

from sceneprint.settings import Settings
from tools.site.markup import cell, code, page, table

PAGE = Path(__file__).resolve().parents[1] / "docs/settings.md"
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
        f"For operators: the {len(fields)} environment variables that service and workers read "
        "when they start. All have defaults. An invalid value stops the start with a message of "
        "one line. The names in the tables follow `SCENEPRINT_`, as in `SCENEPRINT_PORT`.",
        "Secrets can come from files of one line. Append `_FILE` to the variable and set it to the "
        "path: `SCENEPRINT_DATABASE_URL_FILE`, `PGPASSWORD_FILE`, `AWS_ACCESS_KEY_ID_FILE`, "
        "`AWS_SECRET_ACCESS_KEY_FILE` and `AZURE_STORAGE_ACCOUNT_KEY_FILE`.",
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
    bounds = [
        text.format(getattr(limit, key))
        for limit in field.metadata
        if type(limit) in _BOUNDS
        for key, text in [_BOUNDS[type(limit)]]
    ]
    return (
        f"`{name.upper()}`",
        ", ".join([_type_of(field), *bounds]),
        extra["shown"] or _shown(name, field.default),
        cell(field.description),
        cell(extra["change"]),
    )


def _type_of(field: FieldInfo) -> str:
    """Return the type of a setting's value in words."""
    kinds = {Path: "path", SecretStr: "text", str: "text", int: "whole number", float: "number"}
    found = [
        one for one in (get_args(field.annotation) or [field.annotation]) if one is not type(None)
    ]
    if all(isinstance(one, str) for one in found):
        return " or ".join(map(code, found))
    if found[0] is bool:
        return "`true` or `false`"
    return "list" if Ellipsis in found else kinds[found[0]]


def _shown(name: str, default: object) -> str:
    if default in (None, ()):
        return "none"
    if name.endswith("_bytes") and isinstance(default, int):
        return f"{code(str(default))} ({default >> 20:,} MiB)"
    return code(str(default).lower() if isinstance(default, bool) else str(default))


if __name__ == "__main__":
    PAGE.write_text(settings_page())
