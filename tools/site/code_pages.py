"""Generator of the page of commands, from their parsers."""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterator

from sceneprint.cli import COMMANDS, parser
from sceneprint.cli.completion import subcommands
from tools.site.markup import cell, code, fenced, page, plain, table


def commands_page() -> str:
    """Return Markdown that describes every command with its options."""
    result = {name: (line, one) for name, line, one in subcommands(parser())}
    own = [name for name in result if " " not in name]
    added = ", ".join(f"`{name}`" for name in own if name not in COMMANDS)
    return page(
        "# Command line",
        f"The {len(own)} commands of `sceneprint`. `sceneprint COMMAND --help` prints the same. "
        f"`sceneprint-lab` adds {added}.",
        table(
            ("command", "what it does"),
            ((f"[`{name}`](#{name.replace(' ', '-')})", cell(line))
             for name, (line, _) in result.items()),
        ),
        *(_command(name, one) for name, (_, one) in result.items()),
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
