"""`sceneprint coverage` and `surface`: what the frames of a map cover, as a job finds it."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from tqdm import tqdm

from sceneprint.atomic_files import check_writable, write_whole
from sceneprint.cli import positive, whole_number
from sceneprint.cli.options import add_service_options, one_line, open_client
from sceneprint.errors import InvalidRequest, NotFound
from sceneprint_client.api import JobState
from sceneprint_client.api.base import checked
from sceneprint_client.api.coverage import COVERAGE_OUTCOMES, NewMapCoverage

if TYPE_CHECKING:
    from sceneprint_client import Client
    from sceneprint_client.api.coverage import (
        CoverageCell,
        CoverageChanges,
        CoverageResult,
        MapCoverage,
    )
    from sceneprint_client.api.surface import MapSurface, SurfaceParent

#: Options that say how to measure: with --since they are those of the earlier result.
_MEASURE = (
    "session", "robot", "every", "most", "not_within_s", "other_sessions", "tolerance_m",
    "tolerance_deg", "cell_m", "seed",
)  # fmt: skip
#: Cells that the summary names.
_WORST = 5


def add_coverage(commands: Any) -> None:
    """Describe the command to the parser.

    Length: a statement for each option, in the order of `--help`.
    """
    command = commands.add_parser(
        "coverage",
        help="measure where in a map a robot would be found",
        description="Query frames of a map against the rest of it, and count by cell of a plan how "
        "many are found, found in a wrong place, ambiguous and not found. Can compare with an "
        "earlier result.",
    )
    command.add_argument("map", metavar="MAP")
    command.add_argument("--session", metavar="NAME", help="query only frames of this session")
    command.add_argument("--robot", metavar="NAME", help="query only frames of this robot")
    command.add_argument(
        "--every", type=positive, metavar="N", help="query every n-th frame (default: 1)"
    )
    command.add_argument(
        "--most",
        type=positive,
        metavar="N",
        help="query at most N frames, evenly spaced (default: 1000)",
    )
    command.add_argument(
        "--not-within",
        dest="not_within_s",
        type=float,
        metavar="SECONDS",
        help="leave out frames of the same session captured within this time of the queried one "
        "(default: 10); 0 leaves out only the frame itself",
    )
    command.add_argument(
        "--other-sessions",
        action="store_true",
        default=None,
        help="leave out the whole session of the queried frame",
    )
    command.add_argument(
        "--tolerance",
        dest="tolerance_m",
        type=float,
        metavar="METRES",
        help="maximum error of a right pose (default: 0.5)",
    )
    command.add_argument(
        "--tolerance-deg",
        type=float,
        metavar="DEGREES",
        help="and its maximum rotation (default: 15)",
    )
    command.add_argument(
        "--cell",
        dest="cell_m",
        type=float,
        metavar="METRES",
        help="width of a cell (default: about 20 cells along the map)",
    )
    command.add_argument("--seed", type=whole_number, metavar="S", help="random seed (default: 0)")
    command.add_argument(
        "--since",
        metavar="ID",
        help="measure as an earlier result did, and print which cells became better or worse",
    )
    command.add_argument("--json", action="store_true", help="print JSON")
    add_service_options(command)
    command.set_defaults(run=run_coverage)


def run_coverage(options: argparse.Namespace) -> int:
    """Measure, and wait; returns 2 where it did not succeed."""
    given = {name: getattr(options, name) for name in _MEASURE}
    given = {name: value for name, value in given.items() if value is not None}
    if options.since is not None and given:
        raise InvalidRequest(
            "--since measures with the options of the earlier result. Leave the other options out."
        )
    checked(NewMapCoverage, "The coverage", **given)  # before a service is asked for
    changes = None
    with open_client(options) as client:
        told = _measured(client, options, given)
        if told.state is JobState.SUCCEEDED and options.since is not None:
            changes = client.coverage_changes(options.map, told.coverage_id, options.since)
    if options.json:
        print((changes or told).model_dump_json())
    else:
        print("\n".join(coverage_lines(told)))
        if changes is not None:
            print("\n".join(change_lines(changes)))
    return 0 if told.state is JobState.SUCCEEDED else 2


def _measured(client: Client, options: argparse.Namespace, given: dict[str, Any]) -> MapCoverage:
    """The coverage job when it is over, or patience is; a bar shows that it goes on."""
    like = None
    if options.since is not None:
        like = client.coverage_result(options.map, options.since)
    with tqdm(desc="coverage", unit="frame", disable=None) as bar:

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        return client.coverage(options.map, like=like, progress=progress, **given)


def coverage_lines(told: MapCoverage) -> list[str]:
    """A coverage job for people: the share of each outcome, and the worst cells."""
    name = f"coverage {told.coverage_id}"
    result = told.result
    if result is None:
        why = "" if told.error is None else f": {one_line(told.error)}"
        return [f"{name} is {told.state}{why}"]
    skipped = f", {result.skipped} skipped" if result.skipped else ""
    lines = [
        f"{name}: {result.frames} frames queried against the rest of {result.map_frames}{skipped}",
        *_share_lines(result),
    ]
    if result.unchecked:
        lines.append(f"  {result.unchecked} of those found have no pose to check them with")
    cells = [(plan.parent_frame, cell) for plan in told.plans or () for cell in plan.cells]
    bad = [one for one in cells if _failures(one[1])]
    if bad:
        lines.append(f"worst cells, {result.cell_m:g} m wide:")
        # as many failures as possible, and of equally many the larger share
        bad.sort(key=lambda one: (-_failures(one[1]), one[1].found, one[1].row, one[1].column))
        lines += [_cell_line(parent, cell, result.cell_m) for parent, cell in bad[:_WORST]]
    return lines


def change_lines(changes: CoverageChanges) -> list[str]:
    """Two results compared, for people."""
    was, now = changes.result_before, changes.result_after
    counted = ", ".join(f"{count} {trend}" for trend, count in changes.trends.items() if count)
    lines = [
        f"since {changes.before}: found {_share(was.found, was)} before, {_share(now.found, now)} "
        f"now; cells: {counted or 'none'}"
    ]
    for plan in changes.plans:
        for cell in plan.cells:
            if cell.trend == "worse" and cell.after is not None:
                line = _cell_line(plan.parent_frame, cell.after, changes.cell_m)
                lines.append(f"  worse: {line.strip()}")
    return lines


def _share_lines(result: CoverageResult) -> list[str]:
    counts = {name.replace("_", " "): getattr(result, name) for name in COVERAGE_OUTCOMES}
    return [f"  {name:9} {n:6} {_share(n, result):>6}" for name, n in counts.items()]


def _share(count: int, result: CoverageResult) -> str:
    return f"{count / max(result.frames, 1):.1%}"


def _failures(cell: CoverageCell) -> int:
    return cell.wrong + cell.ambiguous + cell.not_found


def _cell_line(parent: str, cell: CoverageCell, cell_m: float) -> str:
    """Where a cell is along the axes of its plan, and what became of its queried frames."""
    x, y = ((place + 0.5) * cell_m for place in (cell.column, cell.row))
    counts = ", ".join(
        f"{getattr(cell, name)} {name.replace('_', ' ')}"
        for name in COVERAGE_OUTCOMES
        if getattr(cell, name)
    )
    frames = f"{cell.frames} frame{'' if cell.frames == 1 else 's'} there"
    return f"  {one_line(parent)} at {x:.2f} {y:.2f} m: {counts}; {frames}"


# `sceneprint surface`: what the posed frames of a map saw, fused.

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
    from sceneprint.formats.export import write_ply
    from sceneprint_client.surface_encoding import decode_tile

    own = parent.levels[level]
    tiles = client.surface_tiles(map_name, parent.parent_frame, level)
    points = [
        decode_tile(client.surface_tile(map_name, one.digest), one, own.tile_m).points
        for one in tiles
    ]
    comments = [f"surface of map {map_name}", f"points of {parent.parent_frame}, metres"]
    return write_ply(np.concatenate([np.empty((0, 3)), *points]), comments=comments)
