"""`sceneprint query`: where in a map were these frames taken?"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sceneprint.cli.asking import add_asking_options, explained_lines, options_of
from sceneprint.cli.connection import add_service_options, one_line, open_client
from sceneprint.cli.overlaying import add_overlay_options, check_overlay, save_overlay
from sceneprint.datasets import FrameReference, find_sequences
from sceneprint.errors import DatasetError, FrameError, MissingDependency, TooLarge

if TYPE_CHECKING:
    from sceneprint.schemas import Answer, Match, Transform


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "query",
        help="ask a service where frames were taken",
        description="Look depth frames or point clouds up in a map: one file, or the frames of a "
        "folder (7-Scenes, TUM RGB-D or plain depth images, with an intrinsics.json beside them or "
        "above; or clouds). They are not kept.",
    )
    command.add_argument("map", metavar="MAP")
    command.add_argument("path", type=Path, metavar="PATH")
    command.add_argument(
        "--frame", metavar="N|FILE", help="of a folder, only this one: its place from 0, or name"
    )
    command.add_argument(
        "--map",
        action="append",
        default=[],
        metavar="NAME",
        dest="also",
        help="ask this map too, as one with MAP; several: all of them (MAP may be '*' for every "
        "map that you may read)",
    )
    command.add_argument(
        "--stages",
        default="retrieve,diversify,validate",
        help="comma separated, from `retrieve` (default: retrieve,diversify,validate)",
    )
    command.add_argument("--json", action="store_true", help="print each answer as a line of JSON")
    add_asking_options(command)
    add_overlay_options(command)
    add_service_options(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Ask; returns 2 where a frame could not be looked up."""
    references = chosen(options.path, options.frame)
    how: dict[str, Any] = {**options_of(options), "stages": options.stages}
    several = options.map == "*" or options.also
    if several:
        how["maps"] = "*" if options.map == "*" else [options.map, *options.also]
    check_overlay(options, len(references))
    failed = 0
    with open_client(options) as client:
        for reference in references:
            try:
                answer = client.query(None if several else options.map, reference, **how)
            except (FrameError, MissingDependency, TooLarge) as error:  # of this file alone
                failed += 1
                print(f"{one_line(reference.name)}: {one_line(str(error))}", file=sys.stderr)
                continue
            if options.json:
                told = {"name": reference.name, **answer.model_dump(mode="json")}
                print(json.dumps(told), flush=True)
            else:
                lines = [*lines_of(reference.name, answer), *explained_lines(answer)]
                print("\n".join(lines), flush=True)
            if options.overlay is not None:
                print(save_overlay(client, answer, options), file=sys.stderr)
    return 2 if failed else 0


def chosen(path: Path, wanted: str | None) -> list[FrameReference]:
    """The frames to look up.

    Raises
    ------
    DatasetError : nothing is found at the path, or no such frame.
    """
    references = [frame for sequence in find_sequences(path) for frame in sequence.frames]
    if wanted is None:
        return references
    if wanted.isascii() and wanted.isdigit():
        if int(wanted) < len(references):
            return [references[int(wanted)]]
        raise DatasetError(
            f"{path}: has {len(references)} frames. Give --frame a place from 0 to "
            f"{len(references) - 1}."
        )
    named = [
        frame
        for frame in references
        if wanted in (frame.name, frame.name.rpartition("/")[2], frame.path.name)
        or Path(wanted).absolute() == frame.path
    ]
    if len(named) == 1:
        return named
    found = f"{len(named)} frames are called" if named else "no frame is called"
    raise DatasetError(
        f"{path}: {found} {wanted}. Give --frame a place from 0, or a name such as "
        f"{references[0].name}."
    )


def lines_of(name: str, answer: Answer) -> list[str]:
    """An answer for people: a line of what came out, a line each match, and the pose."""
    counts = answer.counts
    tried = f"{counts.accepted} of {counts.validated} validated, " if counts.validated else ""
    of = f"{counts.map}"
    if counts.passed != counts.map:
        of = f"{counts.passed} that pass, of {counts.map}"
    lines = [
        f"{one_line(name)}: {answer.status.replace('_', ' ')} ({tried}{counts.ranked} ranked of "
        f"{of} frames, {answer.milliseconds.get('total', 0.0):.0f} ms)"
    ]
    if answer.matches:
        several = len(answer.maps) > 1
        width = max(len(_label(match, several)) for match in answer.matches)
        lines.append(
            f"  {'match':{width}}  rank  similarity  {'validation':15}  overlap  "
            f"{'to the match, m':>20}  {'deg':>5}  {'in the map, m':>20}  reason"
        )
    for match in answer.matches:
        v = match.validation
        status = f"{v.status} {v.strength}" if v.strength else v.status
        overlap = "" if v.overlap is None else f"{v.overlap:.2f}"
        lines.append(
            f"  {_label(match, several):{width}}  {match.rank:4}  {match.similarity:10.2f}  "
            f"{status:15}  {overlap:>7}  {metres(match.transform):>20}  "
            f"{_degrees(match.transform):>5}  {metres(match.pose_in_map):>20}  "
            f"{one_line(v.reason)}".rstrip()
        )
    if answer.location is not None:
        there, r = answer.location, answer.location.pose.rotation
        lines.append(
            f"  at {metres(there.pose)} m in {one_line(there.pose.parent_frame)}, rotation "
            f"{r.x:.4f} {r.y:.4f} {r.z:.4f} {r.w:.4f} (x y z w); {there.support} of {there.votes} "
            f"matches agree, spread {100 * there.spread_m:.1f} cm, {there.spread_deg:.1f} deg"
        )
    return lines


def _label(match: Match, several: bool) -> str:
    """Who saw it, in which of several maps, and the frame's id to ask for the rest."""
    seen = "/".join(one_line(who) for who in (match.robot, match.session) if who)
    return "  ".join(part for part in (match.map if several else "", seen, match.frame_id) if part)


def metres(transform: Transform | None) -> str:
    """Its translation; nothing where there is none."""
    if transform is None:
        return ""
    t = transform.translation
    return " ".join(f"{round(value, 3) + 0.0:.3f}" for value in (t.x, t.y, t.z))


def _degrees(transform: Transform | None) -> str:
    """Angle of the turn."""
    if transform is None:
        return ""
    r = transform.rotation
    return f"{math.degrees(2 * math.atan2(math.hypot(r.x, r.y, r.z), abs(r.w))):.1f}"
