"""`sceneprint audit`: who changed what."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from sceneprint.cli.connection import one_line
from sceneprint.cli.existing import require_database
from sceneprint.cli.numbers import whole
from sceneprint.cli.serve import add_data_option, settings_of

if TYPE_CHECKING:
    from sceneprint.schemas.keys import Audited


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "audit",
        help="print who changed what",
        description="Print changes, the newest first: who made them, from where, and what was "
        "changed. Uploads of frames are not among them; the frames themselves tell.",
    )
    command.add_argument("--actor", metavar="NAME", help="those made with this key, or `command`")
    command.add_argument("--map", metavar="MAP", help="those of this map")
    command.add_argument(
        "--limit", type=whole, default=100, metavar="N", help="at most so many (default: 100)"
    )
    command.add_argument("--json", action="store_true", help="a JSON object a line")
    add_data_option(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Print the changes."""
    from sceneprint.engine import Engine

    settings = settings_of(options)
    require_database(settings)
    with Engine(settings) as engine:
        cursor, left = None, options.limit
        while left > 0:
            page = engine.audit.page(cursor, min(left, 1000), options.actor, options.map)
            for one in page.items:
                print(one.model_dump_json() if options.json else _line(one))
            cursor, left = page.next_cursor, left - len(page.items)
            if cursor is None:
                break
    return 0


def _line(one: Audited) -> str:
    who = "nobody's key" if one.actor is None else one.actor
    whence = "" if one.address is None else f" from {one.address}"
    what = " ".join(part for part in (one.action, one.map, one.target) if part)
    return one_line(f"{one.at:%Y-%m-%dT%H:%M:%SZ}  {who}{whence}  {what}")
