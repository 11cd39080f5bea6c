"""Opening a signer for a command: which model, and a word before the machine goes quiet."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sceneprint.errors import FrameError
from sceneprint.geometry.counting import compiled_at
from sceneprint.models import PRESETS
from sceneprint.pipeline import Signer, open_signer, sign
from sceneprint.settings import Settings
from sceneprint.types import Frame, Intrinsics


def add_model_options(command: argparse.ArgumentParser) -> None:
    """`--preset` or `--model`."""
    choice = command.add_mutually_exclusive_group()
    choice.add_argument(
        "--preset",
        choices=PRESETS,
        default=PRESETS[0],
        help=f"model that ships with sceneprint (default: {PRESETS[0]})",
    )
    choice.add_argument("--model", type=Path, metavar="FILE", help="a model of your own")


def open_for(options: argparse.Namespace, settings: Settings) -> Signer:
    """The signer the options ask for, its code loaded and its table open.

    Says so before the machine goes quiet to compile, and shows the table being built.

    Raises
    ------
    UnreadableModel : no such model.
    """
    _announce()
    signer = _opened(options.model or options.preset, settings)
    with suppress(FrameError):  # a model of another range may see nothing there
        sign(_wall(), signer)  # so that the first frame's time is that of signing, not of loading
    return signer


def prepare_presets(settings: Settings, say: Callable[[str], None] | None = None) -> None:
    """See that code is compiled and the presets' tables are built, once an installation.

    So that a service's first frame does not wait for what a person can watch now.

    Parameters
    ----------
    settings : see Settings
    say : what tells that it takes a while (default: a line on standard error)
    """
    from sceneprint.engine.warming import warm

    if _announce(say):
        warm(_opened(PRESETS[0], settings), clouds=True)
    for preset in PRESETS:
        _opened(preset, settings)


def _announce(say: Callable[[str], None] | None = None) -> bool:
    """Whether the code is yet to be compiled; says so."""
    folder, pattern = compiled_at()
    new = not any(Path(folder).glob(pattern))
    if new:
        (say or _print)("first use of this installation; compiling (once, about 10 seconds)")
    return new


def _print(text: str) -> None:
    print(f"sceneprint: {text}", file=sys.stderr)


def _opened(model: str | Path, settings: Settings) -> Signer:
    name = f"pair table of {model}"
    # no bar among the lines of a log
    with tqdm(desc=name, unit="bin", unit_scale=True, delay=0.5, disable=None) as bar:

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        return open_signer(model, settings.cache_dir, progress)


def _wall() -> Frame:
    """A flat wall 2 m ahead."""
    camera = Intrinsics(256, 192, 300, 300, 127.5, 95.5)  # halved once, as most are
    return Frame(np.full((192, 256), 2.0, np.float32), camera)
