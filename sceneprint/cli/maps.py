"""`sceneprint maps`: the maps of a service."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from sceneprint.cli.connection import add_service_options, one_line, open_client
from sceneprint.errors import InvalidRequest
from sceneprint.models import PRESETS

if TYPE_CHECKING:
    from sceneprint.client import Client
    from sceneprint.schemas import Map


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "maps",
        help="list, make or delete the maps of a service",
        description="List the maps of a service, or make or delete one.",
    )
    choice = command.add_mutually_exclusive_group()
    choice.add_argument("--create", metavar="NAME", help="make a map: a-z, 0-9, - and _")
    choice.add_argument("--delete", metavar="NAME", help="remove a map with all its frames")
    command.add_argument("--title", help="of the map to make, for people")
    command.add_argument(
        "--model", choices=PRESETS, help=f"of the map to make (default: {PRESETS[0]})"
    )
    command.add_argument("--yes", action="store_true", help="do delete")
    command.add_argument("--json", action="store_true", help="print JSON")
    add_service_options(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """List, make or delete."""
    if options.create is None and (options.title is not None or options.model is not None):
        raise InvalidRequest("--title and --model are of a map to make. Add --create NAME.")
    with open_client(options) as client:
        if options.delete is not None:
            _delete(client, options.delete, sure=options.yes)
        elif options.create is not None:
            made = client.create_map(options.create, options.title, options.model or PRESETS[0])
            print(made.model_dump_json() if options.json else f"map {made.name}, {made.model}")
        else:
            _list(client.maps(), as_json=options.json)
    return 0


def _delete(client: Client, name: str, *, sure: bool) -> None:
    n_frames = sum(client.map(name).frames.values())
    if not sure:
        raise InvalidRequest(
            f"This would remove map {name} and its {n_frames} frames for good. Add --yes to do it."
        )
    client.delete_map(name)
    print(f"map {name} and its {n_frames} frames are deleted")


def _list(maps: list[Map], *, as_json: bool) -> None:
    if as_json:
        for one in maps:
            print(one.model_dump_json())
        return
    if not maps:
        print("no maps yet; `sceneprint maps --create NAME` or `sceneprint upload` makes one")
        return
    width = max(3, *(len(one.name) for one in maps))
    print(f"{'map':{width}}  indexed  waiting  rejected  failed  model                 title")
    for one in maps:
        n = one.frames
        waiting = n.get("received", 0) + n.get("signing", 0)
        print(
            f"{one.name:{width}}  {n.get('indexed', 0):7}  {waiting:7}  {n.get('rejected', 0):8}  "
            f"{n.get('failed', 0):6}  {one.model:20}  {one_line(one.title or '')}".rstrip()
        )
