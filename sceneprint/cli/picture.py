"""`sceneprint picture`: what the geometry sees of a frame."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from sceneprint.cli.signer import add_model_options
from sceneprint.datasets import find_sequences
from sceneprint.errors import DatasetError
from sceneprint.models import PRESETS, read_model


def add_to(commands: Any) -> None:
    """Describe the command to the parser."""
    command = commands.add_parser(
        "picture",
        help="draw depth, normals and patches of a frame",
        description="Draw a frame as the geometry sees it: depth, normals as colour, and the "
        "boundaries of the surface patches at each level.",
    )
    command.add_argument("path", type=Path, metavar="PATH", help="a depth image, or a folder")
    command.add_argument("--out", type=Path, required=True, metavar="FILE.png")
    command.add_argument(
        "--frame", type=int, default=0, metavar="N", help="which frame of a folder (default: 0)"
    )
    add_model_options(command)
    command.set_defaults(run=run)


def run(options: argparse.Namespace) -> int:
    """Draw one frame."""
    from sceneprint.pictures import save_picture

    if options.out.suffix.lower() != ".png":
        raise DatasetError(f"{options.out}: pictures are PNG. Name a file that ends in .png.")
    frames = [frame for sequence in find_sequences(options.path) for frame in sequence.frames]
    if not 0 <= options.frame < len(frames):
        raise DatasetError(
            f"{options.path}: there is no frame {options.frame}. "
            f"Choose --frame from 0 to {len(frames) - 1}."
        )
    options.out.parent.mkdir(parents=True, exist_ok=True)
    model = read_model(options.model or options.preset or PRESETS[0])
    save_picture(frames[options.frame].read(), model, options.out)
    print(f"{frames[options.frame].path} drawn to {options.out}")
    return 0
