"""`sceneprint coverage`: where in a map a robot would be found, and where it would get lost."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from sceneprint.atomic_files import check_writable, write_whole
from sceneprint.cli.numbers import positive, whole_number
from sceneprint.cli.options import add_service_options, one_line, open_client
from sceneprint.errors import InvalidRequest
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
        "many are found, found in a wrong place, ambiguous and not found. Can write the plan as a "
        "picture, and compare with an earlier result.",
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
    command.add_argument("--out", type=Path, metavar="FILE", help="write the plan as a PNG")
    command.add_argument(
        "--parent-frame", metavar="NAME", help="of the plan to write (default: of most frames)"
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
    if options.out is not None:  # it may take an hour
        check_writable(options.out)
    changes = None
    with open_client(options) as client:
        told = _measured(client, options, given)
        if told.state is JobState.SUCCEEDED:
            if options.since is not None:
                changes = client.coverage_changes(options.map, told.coverage_id, options.since)
            if options.out is not None:
                plan = client.coverage_plan(options.map, told.coverage_id, options.parent_frame)
                write_whole(options.out, plan)
    if options.json:
        print((changes or told).model_dump_json())
    else:
        print("\n".join(coverage_lines(told)))
        if changes is not None:
            print("\n".join(change_lines(changes)))
        if told.state is JobState.SUCCEEDED and options.out is not None:
            print(f"wrote {one_line(str(options.out))}")
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
