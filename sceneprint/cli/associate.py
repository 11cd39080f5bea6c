"""`sceneprint associate`: join two sessions of a map, or close the loops of one."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from sceneprint.cli.connection import add_service_options, one_line, open_client
from sceneprint.cli.numbers import positive, whole
from sceneprint.errors import InvalidRequest
from sceneprint.schemas import JobState
from sceneprint.writing import check_writable, write_whole

if TYPE_CHECKING:
    from sceneprint.schemas.associations import Association, GraphFormat, Join

#: What a file is by its name's end.
_FORMATS: dict[str, GraphFormat] = {".g2o": "g2o", ".txt": "tum", ".tum": "tum", ".json": "json"}


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "associate",
        help="join two sessions of a map, or close the loops of one",
        description="Find where the frames of a session see the same places as those of another, "
        "or, of one session alone, as those taken long before; and how the sessions lie to each "
        "other. The graph can be written for an optimiser.",
    )
    command.add_argument("map", metavar="MAP")
    command.add_argument(
        "--session",
        action="append",
        required=True,
        metavar="NAME",
        help="once for loop closures; twice to join them, the first is moved onto the second",
    )
    command.add_argument(
        "--robot",
        action="append",
        metavar="NAME",
        help="who took each session, in their order; where several robots call them alike",
    )
    command.add_argument("--after", metavar="TIME", help="only frames taken then or later")
    command.add_argument("--before", metavar="TIME", help="only frames taken then or earlier")
    command.add_argument(
        "--apart", type=positive, metavar="N", help="of one session, frames between (default: 100)"
    )
    command.add_argument(
        "--not-within", type=float, metavar="SECONDS", help="of one session, time between"
    )
    command.add_argument(
        "--k", type=positive, default=3, metavar="K", help="edges wanted a frame (default: 3)"
    )
    command.add_argument(
        "--candidates",
        type=positive,
        default=10,
        metavar="N",
        help="of a frame, tried until it has K edges (default: 10)",
    )
    command.add_argument(
        "--seed", type=whole, default=0, metavar="S", help="of the random choices (default: 0)"
    )
    command.add_argument(
        "--min-overlap", type=float, default=0.0, metavar="SHARE", help="of an edge, 0 to 1"
    )
    command.add_argument(
        "--out",
        type=Path,
        metavar="FILE",
        help="write the graph: .g2o, .txt (the vertices as a TUM trajectory) or .json",
    )
    command.add_argument(
        "--odometry", action="store_true", help="with edges between consecutive frames"
    )
    command.add_argument("--json", action="store_true", help="print the outcome as JSON")
    add_service_options(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Associate, and wait; returns 2 where it did not succeed."""
    if len(options.session) > 2:
        raise InvalidRequest("An association is of one session or two. Give --session so often.")
    kind = None if options.out is None else _FORMATS.get(options.out.suffix.lower())
    if options.out is not None and kind is None:
        raise InvalidRequest(
            f"{options.out.name!a:.80} does not say what it is. Let --out end in "
            f"{', '.join(_FORMATS)}."
        )
    if options.out is not None:  # it may take an hour
        check_writable(options.out)
    times = {"captured_after": options.after, "captured_before": options.before}
    wanted = {name: value for name, value in times.items() if value is not None}
    with (
        open_client(options) as client,
        tqdm(desc="associate", unit="frame", disable=None) as bar,
    ):

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        told = client.associate(
            options.map, *options.session, robots=options.robot, filter=wanted or None,
            apart=options.apart, not_within_s=options.not_within, k=options.k,
            candidates=options.candidates, seed=options.seed, min_overlap=options.min_overlap,
            progress=progress,
        )  # fmt: skip
        if kind is not None and told.state is JobState.SUCCEEDED:
            graph = client.graph(options.map, told.association_id, kind, odometry=options.odometry)
            write_whole(options.out, graph.encode())
    print(told.model_dump_json() if options.json else "\n".join(lines_of(told)))
    if told.state is JobState.SUCCEEDED and options.out is not None and not options.json:
        print(f"written: {options.out}")
    return 0 if told.state is JobState.SUCCEEDED else 2


def lines_of(told: Association) -> list[str]:
    """An association for people: what was found, and whether the sessions are joined."""
    name = f"association {told.association_id}"
    if told.result is None:
        why = "" if told.error is None else f": {one_line(told.error)}"
        return [f"{name} is {told.state}{why}"]
    r = told.result
    lines = [
        f"{name}: {r.edges} edges from {r.frames} frames ({r.validated} pairs validated)",
        f"loops confirm {r.consistent}, outvoted {r.inconsistent}, nothing to check "
        f"{r.unchecked} by",
    ]
    lines += [line for one in r.joins for line in _join(one)]
    if len(told.asked.sessions) == 2 and not r.joins:
        lines.append("not joined: no edge leads between frames with poses")
    return lines


def _join(one: Join) -> list[str]:
    names = f"{one_line(one.from_parent)} onto {one_line(one.to_parent)}"
    if one.transform is None:
        return [f"not joined, {names}: {one_line(one.reason)}"]
    sure = "surely" if one.strength == "strong" else "weakly: look at it before you trust it"
    t, r = one.transform.translation, one.transform.rotation
    return [
        f"joined {sure}, {names}: {one_line(one.reason)}, spread "
        f"{100 * (one.spread_m or 0.0):.1f} cm, {one.spread_deg or 0.0:.1f} deg",
        f"  translation {t.x:.4f} {t.y:.4f} {t.z:.4f} m, rotation {r.x:.6f} {r.y:.6f} {r.z:.6f} "
        f"{r.w:.6f} (x y z w)",
    ]
