"""`sceneprint thin`: which frames a map can lose, and losing them."""

from __future__ import annotations

import argparse
import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from sceneprint.cli.connection import one_line
from sceneprint.cli.existing import require_database
from sceneprint.cli.numbers import positive, whole
from sceneprint.cli.serve import add_data_option, settings_of
from sceneprint.writing import check_writable, write_whole

if TYPE_CHECKING:
    from sceneprint.maintenance.thinning import Proposal

#: Frames that are listed on the screen.
SHOWN = 5


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "thin",
        help="say which frames a map can lose, and delete them with --yes",
        description="Find frames that repeat others of the same map, by the distance of their "
        "signatures. Nothing is deleted without --yes. Works on the data folder, also while a "
        "service runs on it.",
    )
    command.add_argument("map", metavar="MAP")
    how = command.add_mutually_exclusive_group(required=True)
    how.add_argument(
        "--keep",
        type=positive,
        metavar="N",
        help="keep the N frames that together say most (a determinantal point process)",
    )
    how.add_argument(
        "--novelty",
        type=_share,
        metavar="D",
        help="in the order they came, keep a frame if none that is kept is as near as D, a share "
        "of the distance of unrelated frames; 0.2 is cautious",
    )
    command.add_argument(
        "--session", metavar="NAME", help="look at the frames of this session alone"
    )
    command.add_argument(
        "--seed", type=whole, default=0, metavar="S", help="of the sample for --keep (default: 0)"
    )
    command.add_argument("--json", type=Path, metavar="FILE", help="write all that can go")
    command.add_argument("--yes", action="store_true", help="do delete them")
    add_data_option(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Propose, and carry it out where told to."""
    from sceneprint.engine import Engine
    from sceneprint.maintenance.thinning import carry_out, propose

    if options.json is not None:
        check_writable(options.json)
    settings = settings_of(options)
    require_database(settings)
    with Engine(settings) as engine:
        with _Bar("compare") as bar:
            proposal = propose(
                engine, options.map, keep=options.keep, novelty=options.novelty,
                session=options.session, seed=options.seed, progress=bar.tell,
            )  # fmt: skip
        _say(proposal, options)
        if options.json is not None:
            write_whole(options.json, json.dumps(_document(proposal, options), indent=1).encode())
        if not options.yes:
            if proposal.losses:
                print("nothing was deleted; add --yes to delete them")
            return 0
        with _Bar("delete") as bar:
            deleted = carry_out(engine, proposal, bar.tell)
        if deleted:
            engine.audit.command("thin", map_name=options.map, deleted=deleted)
    left = len(proposal.losses) - deleted
    why = f", {left} not: they are gone already, or what stood for them is" if left else ""
    print(f"{deleted} frames are deleted{why}")
    return 0


def _say(proposal: Proposal, options: argparse.Namespace) -> None:
    n, lost = proposal.n_frames, len(proposal.losses)
    where = f"map {proposal.map}, model {proposal.model}"
    if options.session is not None:
        where += f", session {one_line(options.session)}"
    if options.keep is not None:
        where += f", seed {options.seed}"
    print(where)
    if not lost:
        print(f"none of {n} frames can go")
        return
    median, largest = proposal.shares
    print(f"{lost} of {n} frames can go, {n - lost} stay; about {_size(proposal.freed_bytes)} less")
    print(
        f"from a frame that can go to the nearest that stays: {median:.3f} of the distance of "
        f"unrelated frames (median), {largest:.3f} (most)"
    )
    for one in sorted(proposal.losses, key=lambda loss: -loss.share)[:SHOWN]:
        print(f"  {one.frame_id}  {one.share:.3f} from {one.like}")
    if lost > SHOWN:
        print(f"  and {lost - SHOWN} nearer ones (--json FILE names all)")


def _document(proposal: Proposal, options: argparse.Namespace) -> dict[str, Any]:
    median, largest = proposal.shares
    return {
        "map": proposal.map,
        "model": proposal.model,
        "session": options.session,
        "keep": options.keep,
        "novelty": options.novelty,
        "seed": None if options.keep is None else options.seed,
        "frames": proposal.n_frames,
        "freed_bytes": proposal.freed_bytes,
        "median_share": median,
        "largest_share": largest,
        "losses": [asdict(one) for one in proposal.losses],
    }


class _Bar:
    """A bar that is told of steps done and their total."""

    def __init__(self, what: str) -> None:
        self._bar = tqdm(desc=what, unit="frame", disable=None, delay=0.5)

    def __enter__(self) -> _Bar:
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.close()

    def tell(self, done: int, total: int) -> None:
        self._bar.total = total
        self._bar.update(done - self._bar.n)


def _share(text: str) -> float:
    try:
        share = float(text)
    except ValueError:
        share = math.nan
    if not 0 <= share <= 2:  # false for NaN as well
        raise argparse.ArgumentTypeError(f"{text!r} is not a share from 0 to 2")
    return share


def _size(n_bytes: int) -> str:
    return f"{n_bytes / 1e9:.1f} GB" if n_bytes >= 1e9 else f"{n_bytes / 1e6:.1f} MB"
