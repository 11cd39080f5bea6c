"""`sceneprint surface`: what the posed frames of a map saw, fused."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sceneprint.atomic_files import check_writable, write_whole
from sceneprint.cli.options import add_service_options, one_line, open_client
from sceneprint.errors import InvalidRequest, NotFound

if TYPE_CHECKING:
    from sceneprint_client import Client
    from sceneprint_client.api.surface import MapSurface, SurfaceParent

#: What a picture and points are written as.
_KINDS = (".png", ".ply")
#: Seconds between two looks at a surface that is being built; seconds to wait, at most.
_PAUSE_S, _PATIENCE_S = 0.5, 3600.0


def add_surface(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "surface",
        help="build, show or write the fused surface of a map",
        description="Fuse what the posed frames of a map saw, as far as that is not done, and "
        "print what there is. Can write it as a plan or as points.",
    )
    command.add_argument("map", metavar="MAP")
    command.add_argument(
        "--out", type=Path, metavar="FILE", help="write a plan (.png) or all cells (.ply)"
    )
    command.add_argument(
        "--level",
        type=int,
        choices=(0, 1, 2),
        default=0,
        metavar="L",
        help="cells to write as points: 0 for the finest (default), 1 or 2",
    )
    command.add_argument(
        "--parent-frame", metavar="NAME", help="what to write (default: of most frames)"
    )
    command.add_argument("--no-build", action="store_true", help="show it as it is")
    command.add_argument("--delete", action="store_true", help="delete it")
    command.add_argument("--json", action="store_true", help="print JSON")
    add_service_options(command)
    command.set_defaults(run=run_surface)


def run_surface(options: argparse.Namespace) -> int:
    """Build, and wait; returns 2 where that failed."""
    if options.delete and options.out is not None:
        raise InvalidRequest("--delete leaves nothing to write. Leave --out out.")
    if options.out is not None:
        if options.out.suffix.lower() not in _KINDS:
            raise InvalidRequest(
                f"--out {one_line(str(options.out))}: end the name with .png for a plan, or with "
                ".ply for points."
            )
        check_writable(options.out)
    with open_client(options) as client:
        if options.delete:
            client.delete_surface(options.map)
            print(f"deleted the surface of map {one_line(options.map)}")
            return 0
        told = client.surface(options.map) if options.no_build else _built(client, options.map)
        if options.out is not None and told.error is None:
            write_whole(options.out, _content(client, told, options))
    print(told.model_dump_json() if options.json else "\n".join(surface_lines(told)))
    if options.out is not None and told.error is None and not options.json:
        print(f"wrote {one_line(str(options.out))}")
    return 0 if told.error is None else 2


def surface_lines(told: MapSurface) -> list[str]:
    """A surface for people: its state, and each parent frame with its cells."""
    left = f", {told.frames_left} left" if told.frames_left else ""
    lines = [f"surface of map {told.map} is {told.state}: {told.frames} frames{left}"]
    if told.error is not None:
        lines.append(f"  failed: {one_line(told.error)}")
    for parent in told.parents:
        size = [getattr(parent.high, axis) - getattr(parent.low, axis) for axis in "xyz"]
        box = " x ".join(f"{side:.1f}" for side in size)
        lines.append(f"{one_line(parent.parent_frame)}: {parent.frames} frames, {box} m")
        lines += [
            f"  cells of {one.cell_m:g} m: {one.cells} in {one.tiles} tiles, "
            f"{one.bytes / 1000:.0f} kB"
            for one in parent.levels
        ]
    return lines


def _built(client: Client, map_name: str) -> MapSurface:
    """The surface when nothing is left to do, or patience is over."""
    from tqdm import tqdm

    told = client.begin_surface(map_name)
    until = time.monotonic() + _PATIENCE_S
    with tqdm(desc="surface", unit="frame", disable=None) as bar:
        while told.state == "building" and time.monotonic() < until:
            time.sleep(_PAUSE_S)
            told = client.surface(map_name)
            bar.total = told.frames + told.frames_left
            bar.update(told.frames - bar.n)
    return told


def _content(client: Client, told: MapSurface, options: argparse.Namespace) -> bytes:
    """A plan, or points, as a file."""
    if options.out.suffix.lower() == ".png":
        return client.surface_plan(options.map, options.parent_frame)
    parents = [one for one in told.parents if options.parent_frame in (None, one.parent_frame)]
    if not parents:
        raise NotFound(
            f"Map {options.map!r:.80} has no surface in that parent frame. `sceneprint surface "
            f"{options.map}` lists those that there are."
        )
    return _points(client, options.map, parents[0], options.level)


def _points(client: Client, map_name: str, parent: SurfaceParent, level: int) -> bytes:
    from sceneprint.formats.points.ply_export import write_ply
    from sceneprint_client.surface_encoding import decode_tile

    own = parent.levels[level]
    tiles = client.surface_tiles(map_name, parent.parent_frame, level)
    points = [
        decode_tile(client.surface_tile(map_name, one.digest), one, own.tile_m).points
        for one in tiles
    ]
    comments = [f"surface of map {map_name}", f"points of {parent.parent_frame}, metres"]
    return write_ply(np.concatenate([np.empty((0, 3)), *points]), comments=comments)
