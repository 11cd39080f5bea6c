"""`sceneprint fsck`: what of a data folder is lost, damaged or left over, and its repair."""

from __future__ import annotations

import argparse
import json
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tqdm import tqdm

from sceneprint.cli.connection import one_line
from sceneprint.cli.numbers import whole
from sceneprint.cli.serve import add_data_option, settings_of
from sceneprint.cli.signals import ended_by_signals

if TYPE_CHECKING:
    from sceneprint.maintenance.fsck import Outcome

#: What was looked at, in the order in which it is told.
_COUNTED = (
    "models", "frames", "signatures", "blobs", "files", "generations", "tables",
)  # fmt: skip


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "fsck",
        help="check database, blobs and caches, and repair what can be repaired",
        description="Check rows, signatures, uploads, artifacts and caches of a data folder, and "
        "say what is wrong and what --repair would do. Without --repair nothing is changed. The "
        "service may run. Exit code 1 where something is left to be done, 2 where the folder "
        "cannot be checked.",
    )
    add_data_option(command)
    command.add_argument("--map", metavar="MAP", help="check this map alone")
    how = command.add_mutually_exclusive_group()
    how.add_argument(
        "--repair",
        action="store_true",
        help="repair what can be; damaged bytes are moved to `quarantine` in the data folder",
    )
    how.add_argument(
        "--quick", action="store_true", help="see what is there, and do not read its bytes"
    )
    command.add_argument(
        "--grace",
        type=whole,
        metavar="SECONDS",
        help="leave files that nothing refers to if they changed since (default: 3600)",
    )
    command.add_argument("--json", type=Path, metavar="FILE", help="write the findings there too")
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Check, tell, and repair if asked to; returns 1 where something is left."""
    from sceneprint.engine import Engine
    from sceneprint.maintenance.fsck import GRACE_S, fsck
    from sceneprint.writing import check_writable, write_whole

    if options.json is not None:
        check_writable(options.json)
    counts, outcomes = Counter[str](), []
    with ended_by_signals(), _shown() as progress:
        for outcome in fsck(
            settings_of(options), map_name=options.map, repair=options.repair,
            quick=options.quick, progress=progress, counts=counts,
            grace_s=GRACE_S if options.grace is None else min(options.grace, 10**10),
        ):  # fmt: skip
            outcomes.append(outcome)
            tqdm.write(_line(outcome))
    repaired = sum(each.done is not None for each in outcomes)
    if repaired:
        with Engine(settings_of(options)) as engine:
            engine.audit.command("fsck --repair", map_name=options.map, repaired=repaired)
    if options.json is not None:
        record = {"checked": dict(counts), "findings": [_record(each) for each in outcomes]}
        write_whole(options.json, (json.dumps(record, indent=1) + "\n").encode())
    print("checked " + ", ".join(f"{counts[name]} {name}" for name in _COUNTED))
    print(_summary(outcomes, repair=options.repair))
    return 1 if any(each.left for each in outcomes) else 0


def _line(outcome: Outcome) -> str:
    finding = outcome.finding
    if outcome.done is not None:
        then = f"done: {outcome.done}"
    elif outcome.error is not None:
        then = f"NOT REPAIRED: {outcome.error}"
    else:
        then = "" if finding.would is None else f"would: {finding.would}"
    text = f"{finding.severity:8}  {finding.kind}  {finding.what}: {finding.means}"
    return one_line(f"{text}; {then}" if then else text)


def _summary(outcomes: list[Outcome], *, repair: bool) -> str:
    kinds = Counter(each.finding.severity for each in outcomes)
    damaged, unneeded, left = kinds["damage"], kinds["leftover"], sum(o.left for o in outcomes)
    if not damaged and not unneeded:
        return "all is well"
    found = f"{damaged} damaged, {unneeded} left over"
    if repair:
        done = f"{damaged + unneeded - left} repaired, {left} not"
        return f"{found}: {done}. Look again once workers have signed what is to be signed again."
    possible = sum(o.finding.repair is not None for o in outcomes)
    return f"{found}; nothing was changed: `sceneprint fsck --repair` can mend {possible}"


def _record(outcome: Outcome) -> dict[str, object]:
    finding = outcome.finding
    return {
        "kind": finding.kind,
        "severity": finding.severity,
        "what": finding.what,
        "means": finding.means,
        "would": finding.would,
        "map": finding.map,
        "frame_id": finding.frame_id,
        "path": None if finding.path is None else str(finding.path),
        "done": outcome.done,
        "error": outcome.error,
    }


@contextmanager
def _shown() -> Iterator[Callable[[str, int, int], None]]:
    """A bar on a terminal, of one subject after the other."""
    with tqdm(disable=None, leave=False) as bar:

        def progress(subject: str, done: int, total: int) -> None:
            if bar.disable:
                return
            if bar.desc != f"{subject}: ":
                bar.reset(total)
                bar.set_description(subject)
            bar.total, bar.n = total, done
            bar.refresh()

        yield progress
