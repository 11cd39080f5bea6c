"""`sceneprint audit`: print or export who changed what."""

from __future__ import annotations

import argparse
import socket
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from datetime import UTC
from pathlib import Path
from typing import TYPE_CHECKING

from sceneprint.cli import duration, whole_number
from sceneprint.cli.options import one_line, require_database
from sceneprint.cli.serve import add_data_option, settings_of

if TYPE_CHECKING:
    from sceneprint.engine import Engine
    from sceneprint.store.audit_log import AuditFilter
    from sceneprint_client.api.admin import AuditLine

#: Facility `log audit`, severity `notice`, as RFC 5424 numbers them.
_PRIORITY = 13 * 8 + 5


def add_audit(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint audit`."""
    command.add_argument(
        "--actor",
        metavar="NAME",
        help="only entries of this key, or `command` for the command line",
    )
    command.add_argument("--map", metavar="MAP", help="only entries about this map")
    command.add_argument(
        "--action", metavar="TEXT", help="only actions that begin so, such as `key.` or `refused`"
    )
    command.add_argument(
        "--since",
        type=duration,
        metavar="DURATION",
        help="only entries of the last 12h, 30d or 8w",
    )
    command.add_argument(
        "--limit",
        type=whole_number,
        default=100,
        metavar="N",
        help="maximum number of entries to print without --format (default: 100)",
    )
    command.add_argument(
        "--format",
        choices=tuple(_FORMATS),
        help="export as JSON lines, or as syslog messages (RFC 5424), one per line",
    )
    command.add_argument(
        "--output",
        type=Path,
        metavar="FILE",
        help="with --format: append to this file (default: standard output)",
    )
    add_data_option(command)
    command.set_defaults(run=run_audit)


def run_audit(options: argparse.Namespace) -> int:
    """Print the newest entries of the audit log, newest first. Each entry names the key, its
    address, and the change or the refused request. With --format, export all entries, oldest
    first.
    """
    from sceneprint.engine import Engine
    from sceneprint.errors import InvalidRequest
    from sceneprint.store.audit_log import AuditFilter

    if options.output is not None and options.format is None:
        raise InvalidRequest("--output needs --format. Choose jsonl or syslog.")
    settings = settings_of(options)
    require_database(settings)
    since = None if options.since is None else time.time() - options.since.total_seconds()
    wanted = AuditFilter(options.actor, options.map, options.action, since)
    with Engine(settings) as engine:
        if options.format is None:
            for one in _newest(engine, wanted, options.limit):
                print(_line(one))
            return 0
        written = _FORMATS[options.format]
        target = options.output
        with nullcontext(sys.stdout) if target is None else target.open("a") as file:
            for one in engine.audit.lines(wanted):
                print(written(one), file=file)
    return 0


def _newest(engine: Engine, wanted: AuditFilter, left: int) -> Iterator[AuditLine]:
    cursor = None
    while left > 0:
        page = engine.audit.page(wanted, cursor, min(left, 1000))
        yield from page.items
        cursor, left = page.next_cursor, left - len(page.items)
        if cursor is None:
            return


def _line(one: AuditLine) -> str:
    who = "no key" if one.actor is None else one.actor
    whence = "" if one.address is None else f" from {one.address}"
    operation = one.data.get("operation") if one.action == "refused" else None
    what = " ".join(part for part in (one.action, operation, one.map, one.target) if part)
    return one_line(f"{one.at:%Y-%m-%dT%H:%M:%SZ}  {who}{whence}  {what}")


def _json_line(one: AuditLine) -> str:
    return one.model_dump_json()


def _syslog_message(one: AuditLine) -> str:
    """Return a message of RFC 5424 whose text is the JSON line."""
    at = one.at.astimezone(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")
    host = socket.gethostname() or "-"
    return f"<{_PRIORITY}>1 {at} {host} sceneprint - audit - {_json_line(one)}"


_FORMATS: dict[str, Callable[[AuditLine], str]] = {"jsonl": _json_line, "syslog": _syslog_message}
