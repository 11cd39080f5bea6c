"""`sceneprint similarity`: how alike are two frames, and do they see one place?"""

from __future__ import annotations

import argparse
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sceneprint.cli.asking import setting, settings_of
from sceneprint.cli.connection import add_service_options, one_line, open_client
from sceneprint.cli.numbers import whole
from sceneprint.cli.query import metres

if TYPE_CHECKING:
    from sceneprint.schemas import Similarity


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "similarity",
        help="ask a service how alike two frames are",
        description="Compare two frames, each a depth image or a stored frame, MAP:FRAME_ID. "
        "Neither is kept. Exit code 0: they see one place; 1: they do not, or it is ambiguous.",
    )
    command.add_argument("a", metavar="A")
    command.add_argument("b", metavar="B")
    command.add_argument(
        "--no-validate", action="store_true", help="compare the signatures alone (exit code 0)"
    )
    command.add_argument(
        "--validation", type=setting, action="append", metavar="NAME=VALUE",
        help="what a match must stand, such as mode=paper; several: each",
    )  # fmt: skip
    command.add_argument(
        "--seed", type=whole, default=0, metavar="S", help="of the random choices (default: 0)"
    )
    command.add_argument("--model", help="that signs two images (default: depth)")
    command.add_argument("--json", action="store_true", help="print the record")
    add_service_options(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Compare; returns 1 where the frames do not see one place."""
    with open_client(options) as client:
        found = client.similarity(
            side_of(options.a), side_of(options.b), validate=not options.no_validate,
            validation=settings_of(options.validation), seed=options.seed, model=options.model,
        )  # fmt: skip
    print(found.model_dump_json() if options.json else line_of(found))
    return 0 if found.validation is None or found.validation.status == "accepted" else 1


def side_of(text: str) -> Path | tuple[str, str]:
    """A file, or the map and the id of a stored frame."""
    path = Path(text)
    stored = re.fullmatch(r"([a-z0-9][a-z0-9_-]*):([A-Za-z0-9._:-]+)", text)
    if stored is not None and not path.exists():
        return stored[1], stored[2]
    return path


def line_of(found: Similarity) -> str:
    """A comparison for people."""
    told = f"similarity {found.similarity:.3f} (distance {found.distance}, {found.model})"
    made = found.validation
    if made is not None:
        status = f"{made.status} {made.strength}" if made.strength else made.status
        told += f"; {status}: {one_line(made.reason)}"
    if found.transform is not None:
        told += f"; b lies at {metres(found.transform)} m of a"
    return told
