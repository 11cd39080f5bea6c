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

#: What a limit is called that takes one away.
NONE = "none"


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "maps",
        help="list, make, limit or delete the maps of a service",
        description="List the maps of a service, or make, change or delete one. Quotas are the "
        "operator's: they ask for a key with `admin` for `*`.",
    )
    choice = command.add_mutually_exclusive_group()
    choice.add_argument("--create", metavar="NAME", help="make a map: a-z, 0-9, - and _")
    choice.add_argument("--edit", metavar="NAME", help="change its title or limits")
    choice.add_argument("--delete", metavar="NAME", help="remove a map with all its frames")
    command.add_argument("--title", help="of the map, for people")
    command.add_argument(
        "--model", choices=PRESETS, help=f"of the map to make (default: {PRESETS[0]})"
    )
    for name, metavar, kind, told in (
        ("--quota-frames", "N", int, "most frames that it may hold"),
        ("--quota-bytes", "N", int, "most bytes of uploads that it may hold"),
        ("--retention-days", "DAYS", float, "delete frames that many days after they came"),
    ):
        command.add_argument(
            name, metavar=metavar, type=_limit(kind), help=f"{told}; `{NONE}` for no limit"
        )
    command.add_argument("--yes", action="store_true", help="do delete")
    command.add_argument("--json", action="store_true", help="print JSON")
    add_service_options(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """List, make, change or delete."""
    names = ("title", "quota_frames", "quota_bytes", "retention_days")
    given = {n: getattr(options, n) for n in names if getattr(options, n) is not None}
    limits = {n: None if value == NONE else value for n, value in given.items() if n != "title"}
    if options.create is None and options.model is not None:
        raise InvalidRequest("--model is of a map to make. Add --create NAME.")
    if given and options.create is None and options.edit is None:
        raise InvalidRequest(
            f"--{next(iter(given)).replace('_', '-')} is of a map to make or change. Add "
            "--create NAME or --edit NAME."
        )
    with open_client(options) as client:
        if options.delete is not None:
            _delete(client, options.delete, sure=options.yes)
        elif options.edit is not None:
            title = {"title": options.title or None} if "title" in given else {}
            edited = _edit(client, options.edit, title | limits, sure=options.yes)
            print(edited.model_dump_json() if options.json else _line(edited))
        elif options.create is not None:
            model = options.model or PRESETS[0]
            made = client.create_map(options.create, options.title, model, **limits)
            print(made.model_dump_json() if options.json else _line(made))
        else:
            _list(client.maps(), as_json=options.json)
    return 0


def _limit(kind: type[int] | type[float]) -> Any:
    def read(given: str) -> float | str:
        return NONE if given == NONE else kind(given)

    read.__name__ = "number"  # argparse tells it
    return read


def _edit(client: Client, name: str, changes: dict[str, Any], *, sure: bool) -> Map:
    if not changes:
        raise InvalidRequest("Nothing to change was given. Add --title or a limit.")
    if changes.get("retention_days") is not None and not sure:
        told = client.edit_map(name, changes, dry_run=True)
        if told.overdue:
            raise InvalidRequest(
                f"This would delete {told.overdue} frames of map {name} for good, which are older "
                f"than {told.retention_days:g} days, and nothing was changed. Add --yes to do it."
            )
    return client.edit_map(name, changes)


def _delete(client: Client, name: str, *, sure: bool) -> None:
    n_frames = sum(client.map(name).frames.values())
    if not sure:
        raise InvalidRequest(
            f"This would remove map {name} and its {n_frames} frames for good. Add --yes to do it."
        )
    client.delete_map(name)
    print(f"map {name} and its {n_frames} frames are deleted")


def _line(one: Map) -> str:
    limits = _limits(one)
    return f"map {one.name}, {one.model}{limits and ', '}{limits}"


def _limits(one: Map) -> str:
    """What a map has of what it may have, and for how long."""
    parts = []
    if one.quota_frames is not None:
        parts.append(f"{one.used_frames} of {one.quota_frames} frames")
    if one.quota_bytes is not None:
        parts.append(f"{one.used_bytes / 1e6:.1f} of {one.quota_bytes / 1e6:.1f} MB")
    if one.retention_days is not None:
        parts.append(f"kept {one.retention_days:g} days")
    return ", ".join(parts)


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
        title, limits = one_line(one.title or ""), _limits(one)
        told = f"{title}  ({limits})".strip() if limits else title
        print(
            f"{one.name:{width}}  {n.get('indexed', 0):7}  {waiting:7}  {n.get('rejected', 0):8}  "
            f"{n.get('failed', 0):6}  {one.model:20}  {told}".rstrip()
        )
