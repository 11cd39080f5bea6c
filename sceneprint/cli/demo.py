"""`sceneprint demo`: the main job, start to end, through a service of its own."""

from __future__ import annotations

import argparse
import os
from contextlib import closing
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from tqdm import tqdm

from sceneprint.cli.choosing import choose_frames
from sceneprint.cli.numbers import positive
from sceneprint.cli.signals import ended_by_signals
from sceneprint.models import PRESETS
from sceneprint.settings import Settings


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "demo",
        help="serve, upload a map, look other frames up over HTTP, and print how well that went",
        description="Start a service with an empty folder, upload the frames of a small synthetic "
        "building (or of --dataset) to a map, look other frames up, print the paper's rows with "
        "true pose errors, and draw a match. The service is stopped and removed at the end.",
    )
    command.add_argument("--out", type=Path, default=Path("demo"), metavar="DIR")
    command.add_argument(
        "--dataset", type=Path, metavar="PATH", help="frames of your own, as for `sign`"
    )
    command.add_argument(
        "--model", choices=PRESETS, default=PRESETS[0], help=f"default: {PRESETS[0]}"
    )
    command.add_argument(
        "--workers", type=positive, default=os.cpu_count() or 1, metavar="N", help="that sign"
    )
    command.add_argument("--rooms", type=positive, default=4, help=argparse.SUPPRESS)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Show the whole way of a frame, over HTTP."""
    from sceneprint.cli.demo_map import ask, fill
    from sceneprint.cli.demo_report import draw, report
    from sceneprint.cli.served import serving
    from sceneprint.cli.signer import prepare_presets
    from sceneprint.client import Client

    options.out.mkdir(parents=True, exist_ok=True)
    with ended_by_signals(), TemporaryDirectory(prefix="sceneprint-demo-") as temporary:
        folder = Path(temporary)
        choice = choose_frames(options.dataset or _building(folder / "building", options.rooms))
        prepare_presets(Settings())
        (folder / "data").mkdir()
        with serving(folder / "data", options.workers) as url, Client(url) as client:
            print(f"service: {url}, an empty folder, {options.workers} worker processes")
            known = fill(client, options.model, choice)
            asked = ask(client, choice)
        report(known, asked)
        draw(known, asked, options.model, options.out)
    print(
        "next: `sceneprint serve`; then, in another terminal, `sceneprint upload MAP PATH` and "
        "`sceneprint query MAP PATH` with frames of your own, and http://127.0.0.1:8008/dashboard "
        "to look at them"
    )
    return 0


def _building(folder: Path, rooms: int) -> Path:
    from sceneprint.cli.demo_building import write_building

    # closed before the folder is removed, however this ends: its processes write there
    with closing(write_building(folder, rooms)) as made:
        for _ in tqdm(made, total=rooms, desc="synthetic building", unit="room", disable=None):
            pass
    return folder
