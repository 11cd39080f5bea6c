"""Pages of metrics and commands, generated from the code."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator
from dataclasses import dataclass

from prometheus_client.metrics import MetricWrapperBase

from sceneprint.cli import COMMANDS, parser
from sceneprint.cli.completion import subcommands
from service.metrics import Metrics
from tools.site.markup import cell, code, fenced, page, plain, table


@dataclass(frozen=True)
class MetricFamily:
    """A family of time series.

    Parameters
    ----------
    name : name in Prometheus
    kind : counter, gauge or histogram
    labels : labels of its series
    meaning : help text
    """

    name: str
    kind: str
    labels: tuple[str, ...]
    meaning: str


def metric_families() -> list[MetricFamily]:
    """Return all families of a service by name, including those without data."""
    metrics = Metrics()
    found = set()
    for collector in metrics.registry._collector_to_names:  # `collect` omits empty families
        assert isinstance(collector, MetricWrapperBase)
        for family in collector.describe():
            name = family.name + ("_total" if family.type == "counter" else "")
            labels = tuple(collector._labelnames)
            found.add(MetricFamily(name, family.type, labels, family.documentation))
    return sorted(found, key=lambda one: one.name)


def metrics_page() -> str:
    """Return Markdown that lists every metric."""
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


def commands_page() -> str:
    """Return Markdown that describes every command with its options."""
    found = {name: (line, one) for name, line, one in subcommands(parser())}
    own = [name for name in found if " " not in name]
    added = ", ".join(f"`{name}`" for name in own if name not in COMMANDS)
    return page(
        "# Command line",
        f"The {len(own)} commands of `sceneprint`. `sceneprint COMMAND --help` prints the same. "
        f"`sceneprint-lab` adds {added}.",
        table(
            ("command", "what it does"),
            ((f"[`{name}`](#{name.replace(' ', '-')})", cell(line))
             for name, (line, _) in found.items()),
        ),
        *(_command(name, one) for name, (_, one) in found.items()),
    )  # fmt: skip


def _command(name: str, one: argparse.ArgumentParser) -> str:
    # argparse wraps the usage at the width of the terminal.
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
    """Yield the options of each group as in the help."""
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
