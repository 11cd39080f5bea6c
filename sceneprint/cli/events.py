"""`sceneprint events`: what happened in the maps of a service, and what happens."""

from __future__ import annotations

import argparse
import sys
from itertools import islice
from typing import TYPE_CHECKING, Any

from sceneprint.cli.connection import add_service_options, one_line, open_client
from sceneprint.cli.numbers import whole

if TYPE_CHECKING:
    from collections.abc import Iterable

    from sceneprint.client import Client
    from sceneprint.schemas.events import Event

#: Events listed unless told otherwise.
LISTED = 20


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "events",
        help="list what happened in the maps of a service, or follow what happens",
        description="List the latest events of a service, the oldest of them first; or follow "
        "them as they happen, until Ctrl-C. A stream that breaks is taken up again where it broke.",
    )
    command.add_argument("--map", metavar="MAP", help="only of this map")
    command.add_argument(
        "--kind", action="append", default=[], metavar="KIND",
        help="only kinds that begin so, such as frame. or frame.indexed; may be given repeatedly",
    )  # fmt: skip
    command.add_argument("--follow", action="store_true", help="go on with what happens")
    command.add_argument(
        "--after", metavar="ID", help="begin behind the event of this id; 0: with the oldest kept"
    )
    command.add_argument(
        "--limit", type=whole, metavar="N",
        help=f"at most so many (default: {LISTED}; with --after or --follow all)",
    )  # fmt: skip
    command.add_argument("--json", action="store_true", help="print JSON, one event a line")
    add_service_options(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """List, or follow."""
    with open_client(options) as client:
        if options.follow:
            found = client.events(options.map, kinds=options.kind, after=options.after)
        elif options.after is not None:
            found = client.events(
                options.map, kinds=options.kind, after=options.after, follow=False
            )
        else:
            found = iter(_latest(client, options))
        _print(islice(found, options.limit), as_json=options.json)
    return 0


def _latest(client: Client, options: argparse.Namespace) -> list[Event]:
    """The newest events, the oldest of them first."""
    found: list[Event] = []
    cursor, most = None, LISTED if options.limit is None else options.limit
    while len(found) < most:
        page = client.event_page(
            options.map, kinds=options.kind, cursor=cursor,
            limit=min(most - len(found), 500),
        )  # fmt: skip
        found += page.items
        cursor = page.next_cursor
        if cursor is None:
            break
    return found[::-1]


def _print(found: Iterable[Event], *, as_json: bool) -> None:
    for event in found:
        if as_json:
            print(event.model_dump_json())
        else:
            about = [event.map, event.frame_id, *(f"{k}={v}" for k, v in event.data.items())]
            told = "  ".join(one_line(one) for one in about if one is not None)
            print(f"{event.id}  {event.at:%Y-%m-%d %H:%M:%S}  {event.kind:22}  {told}".rstrip())
        sys.stdout.flush()  # who follows wants it now, also through a pipe
