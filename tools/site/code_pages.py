"""Pages of settings, metrics and commands, from the code that reads, counts and runs them."""

from __future__ import annotations

import argparse
import ast
import inspect
import os
from collections.abc import Iterator
from dataclasses import dataclass

from prometheus_client.metrics import MetricWrapperBase

from sceneprint import settings
from sceneprint.cli import COMMANDS, parser
from service.metrics import Metrics
from tools.site.markup import cell, code, fenced, page, plain, table

#: Bounds of pydantic's fields, as they are written after a type.
_BOUNDS = {"ge": "at least {}", "gt": "above {}", "le": "at most {}", "lt": "below {}"}
#: Defaults that are computed, in words.
_COMPUTED = {
    "default_cache_dir": "`sceneprint` in the user's cache folder",
    "default_data_dir": "`sceneprint` in the user's data folder",
    "os.cpu_count() or 1": "number of processors",
    "max(os.cpu_count() or 1, 2)": "number of processors, at least 2",
    "min(max(os.cpu_count() or 1, 2), 8)": "number of processors, from 2 to 8",
}


@dataclass(frozen=True)
class Setting:
    """An environment variable that is read at the start.

    Parameters
    ----------
    name : of the variable
    kind : of its value, as Python writes it
    bounds : of a number
    default : Markdown
    meaning : for operators
    """

    name: str
    kind: str
    bounds: str
    default: str
    meaning: str


def read_settings() -> list[Setting]:
    """All settings, in the order of the source: the comments above fields say what they mean."""
    source = inspect.getsource(settings.Settings)
    lines = source.splitlines()
    (tree,) = ast.parse(source).body
    assert isinstance(tree, ast.ClassDef)
    fields = [one for one in tree.body if isinstance(one, ast.AnnAssign)]
    return [_setting(field, lines) for field in fields]


def _setting(field: ast.AnnAssign, lines: list[str]) -> Setting:
    assert isinstance(field.target, ast.Name)
    name = field.target.id
    comment: list[str] = []
    for line in reversed(lines[: field.lineno - 1]):
        if not line.strip().startswith("#:"):
            break
        comment.insert(0, line.strip().removeprefix("#:").strip())
    limits = settings.Settings.model_fields[name].metadata
    bounds = [
        text.format(f"{getattr(limit, key):,}")
        for key, text in _BOUNDS.items()
        for limit in limits
        if getattr(limit, key, None) is not None
    ]
    return Setting(
        f"SCENEPRINT_{name.upper()}", _kind(field.annotation), ", ".join(bounds),
        _default(name, field.value), " ".join(comment),
    )  # fmt: skip


def _kind(annotation: ast.expr) -> str:
    """A type without what only pydantic needs."""
    if isinstance(annotation, ast.Subscript) and ast.unparse(annotation.value) == "Annotated":
        assert isinstance(annotation.slice, ast.Tuple)
        annotation = annotation.slice.elts[0]
    return ast.unparse(annotation).replace("SecretStr", "str")


def _default(name: str, value: ast.expr | None) -> str:
    """The default of a setting; one that is computed, in words.

    Raises
    ------
    KeyError : there are no words for how it is computed.
    """
    default = settings.Settings.model_fields[name].default
    for given in value.keywords if isinstance(value, ast.Call) else ():
        if given.arg == "default_factory":
            how = given.value.body if isinstance(given.value, ast.Lambda) else given.value
            return _COMPUTED[ast.unparse(how)]
    if default in (None, ()):
        return "none"
    mebibytes = f" ({default >> 20:,} MiB)" if name.endswith("_bytes") else ""
    return code(str(default)) + mebibytes


def settings_page() -> str:
    """Markdown that lists every setting."""
    found = read_settings()
    return page(
        "# Settings",
        f"{len(found)} environment variables, all of which may be left out. They are read once, "
        "at the start; an invalid value stops it with a message. "
        "[Operations](../operations.md#settings) says which of them matter when.",
        table(
            ("variable", "type", "default", "meaning"),
            (
                (
                    f"`{one.name}`",
                    code(one.kind) + (f", {one.bounds}" if one.bounds else ""),
                    one.default,
                    cell(one.meaning),
                )
                for one in found
            ),
        ),
    )


@dataclass(frozen=True)
class MetricFamily:
    """A family of time series.

    Parameters
    ----------
    name : as Prometheus is told
    kind : counter, gauge or histogram
    labels : of its series
    meaning : its help text
    """

    name: str
    kind: str
    labels: tuple[str, ...]
    meaning: str


def metric_families() -> list[MetricFamily]:
    """All families that a service serves, also those without data, by name."""
    metrics = Metrics()
    found = set()
    for collector in metrics.registry._collector_to_names:  # `collect` leaves out empty ones
        assert isinstance(collector, MetricWrapperBase)
        for family in collector.describe():
            name = family.name + ("_total" if family.type == "counter" else "")
            labels = tuple(collector._labelnames)
            found.add(MetricFamily(name, family.type, labels, family.documentation))
    return sorted(found, key=lambda one: one.name)


def metrics_page() -> str:
    """Markdown that lists every metric."""
    found = metric_families()
    rows = (
        (f"`{one.name}`", one.kind, ", ".join(map(code, one.labels)), cell(one.meaning))
        for one in found
    )
    return page(
        "# Metrics",
        f"`GET /metrics` serves {len(found)} families of metrics to Prometheus. "
        "[Operations](../operations.md#what-to-watch) says what to watch, and has a dashboard.",
        table(("metric", "kind", "labels", "meaning"), rows),
    )


def commands() -> dict[str, argparse.ArgumentParser]:
    """The parser of each command of `sceneprint`, in the order of its help."""
    (found,) = (one for one in parser()._actions if isinstance(one, argparse._SubParsersAction))
    return dict(found.choices)


def commands_page() -> str:
    """Markdown that describes every command with its options."""
    found = commands()
    (listed,) = (one for one in parser()._actions if isinstance(one, argparse._SubParsersAction))
    added = ", ".join(f"`{name}`" for name in found if name not in COMMANDS)
    shorts = {one.dest: one.help or "" for one in listed._choices_actions}
    return page(
        "# Command line",
        f"The {len(found)} commands of `sceneprint`. `sceneprint COMMAND --help` prints the same. "
        f"`sceneprint-lab` adds {added}.",
        table(
            ("command", "what it does"),
            ((f"[`{name}`](#{name})", cell(shorts[name])) for name in found),
        ),
        *(_command(name, one) for name, one in found.items()),
    )


def _command(name: str, one: argparse.ArgumentParser) -> str:
    # argparse wraps usage at the width of the terminal
    columns, os.environ["COLUMNS"] = os.environ.get("COLUMNS"), "88"
    try:
        usage = one.format_usage().removeprefix("usage: ")
    finally:
        os.environ.pop("COLUMNS")
        if columns is not None:
            os.environ["COLUMNS"] = columns
    return page(
        f"## {name}",
        plain(one.description or ""),
        fenced(usage.replace("\n       ", "\n")),
        *_groups(one),
        plain(one.epilog or ""),
    )


def _groups(one: argparse.ArgumentParser) -> Iterator[str]:
    """The options of each group, as the help has them."""
    formatter = one._get_formatter()
    for group in one._action_groups:
        rows = [
            (
                code(formatter._format_action_invocation(action)),
                cell(formatter._expand_help(action)) if action.help else "",
            )
            for action in group._group_actions
            if action.help != argparse.SUPPRESS and not isinstance(action, argparse._HelpAction)
        ]
        title = (group.title or "").capitalize()
        about = f"**{title}**: {plain(group.description)}" if group.description else f"**{title}**"
        if rows:
            yield f"{about}\n\n{table(('option', 'meaning'), rows)}"
