"""Opening a signer for a command: which model, and a word before the machine goes quiet."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tqdm import tqdm

from sceneprint.geometry.counting import compiled_at
from sceneprint.pipeline import Signer, open_signer
from sceneprint.settings import Settings


def add_model_options(command: argparse.ArgumentParser) -> None:
    """`--preset` or `--model`."""
    choice = command.add_mutually_exclusive_group()
    choice.add_argument(
        "--preset",
        choices=("paper", "compact"),
        default="paper",
        help="model that ships with sceneprint (default: paper)",
    )
    choice.add_argument("--model", type=Path, metavar="FILE", help="a model of your own")


def open_for(options: argparse.Namespace, settings: Settings) -> Signer:
    """The signer the options ask for, with a progress bar while its table is being built.

    Raises
    ------
    UnreadableModel : no such model.
    """
    folder, pattern = compiled_at()
    if not any(Path(folder).glob(pattern)):
        print(
            "sceneprint: first use of this installation; compiling (once, about 20 seconds)",
            file=sys.stderr,
        )
    model = options.model or options.preset
    with tqdm(desc=f"pair table of {model}", unit="bin", unit_scale=True, delay=0.5) as bar:

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        return open_signer(model, settings.cache_dir, progress)
