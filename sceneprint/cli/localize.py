"""`sceneprint localize`: where in a map was this frame taken? One pose, or why there is none."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sceneprint.cli.asking import add_asking_options, options_of
from sceneprint.cli.connection import add_service_options, one_line, open_client
from sceneprint.cli.query import chosen, metres

if TYPE_CHECKING:
    from sceneprint.schemas import Localization


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "localize",
        help="ask a service where a frame was taken, for its pose",
        description="Find where in a map a depth frame or a cloud was taken. The frame is not "
        "added to the map. Exit code 0: found; 1: ambiguous or not found.",
    )
    command.add_argument("map", metavar="MAP")
    command.add_argument(
        "path", type=Path, metavar="FRAME", help="a depth image, a cloud or a folder"
    )
    command.add_argument(
        "--frame", metavar="N|FILE", help="of a folder: its place from 0, or name (default: 0)"
    )
    command.add_argument("--json", action="store_true", help="print the record")
    add_asking_options(command)
    add_service_options(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Ask; returns 1 where the frame is not found."""
    reference = chosen(options.path, options.frame)[0]
    how: dict[str, Any] = options_of(options)
    with open_client(options) as client:
        there = client.localize(options.map, reference, **how)
    if options.json:
        print(there.model_dump_json())
    else:
        print("\n".join(lines_of(reference.name, there)))
    return 0 if there.status == "found" else 1


def lines_of(name: str, there: Localization) -> list[str]:
    """A localization for people."""
    sure = f" ({there.strength})" if there.strength else ""
    lines = [
        f"{one_line(name)}: {there.status.replace('_', ' ')}{sure}; {one_line(there.reason)} "
        f"({there.milliseconds.get('total', 0.0):.0f} ms)"
    ]
    if there.pose is not None:
        r = there.pose.rotation
        lines.append(
            f"  at {metres(there.pose)} m in {one_line(there.pose.parent_frame)}, rotation "
            f"{r.x:.4f} {r.y:.4f} {r.z:.4f} {r.w:.4f} (x y z w)"
        )
    elif there.best is not None:
        lines.append(f"  at {metres(there.best.transform)} m from frame {there.best.frame_id}")
    return lines
