"""Opening a signer for a command: which model, and a word before the machine goes quiet."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sceneprint.errors import FrameError
from sceneprint.geometry.counting import compiled_at
from sceneprint.models import PRESETS, Model, read_model
from sceneprint.pipeline import Signer, open_signer, sign
from sceneprint.settings import Settings
from sceneprint.types import Frame, Intrinsics


def add_model_options(command: argparse.ArgumentParser) -> None:
    """`--preset` or `--model`."""
    choice = command.add_mutually_exclusive_group()
    choice.add_argument(
        "--preset",
        choices=PRESETS,
        help=f"model that ships with sceneprint (default: {PRESETS[0]})",
    )
    choice.add_argument("--model", type=Path, metavar="FILE", help="a model of your own")


def open_for(options: argparse.Namespace, settings: Settings, *, psi: bool = False) -> Signer:
    """The signer the options ask for, its code loaded and its table open.

    Says so before the machine goes quiet to compile, and shows the table being built.

    Parameters
    ----------
    options : of `add_model_options`
    settings : see Settings
    psi : sign with psi itself; of the preset `paper` where no model is named

    Raises
    ------
    UnreadableModel : no such model.
    """
    if _is_new():
        _print("first use of this installation: compiling (once, about half a minute)")
    chosen = options.model or options.preset or ("paper" if psi else PRESETS[0])
    model = read_model(chosen)
    signer = _opened(model.of_psi if psi else model, str(chosen), settings)
    with suppress(FrameError):  # a model of another range may see nothing there
        sign(_wall(), signer)  # so that the first frame's time is that of signing, not of loading
    return signer


def prepare_presets(settings: Settings, say: Callable[[str], None] | None = None) -> None:
    """See that code is compiled and the presets' tables are built, once an installation.

    So that a service's first frame does not wait for what a person can watch now.

    Parameters
    ----------
    settings : see Settings
    say : what tells of each step, as it takes a while (default: lines on standard error)
    """
    from sceneprint.engine.warming import warm

    if _is_new():
        tell, begun = say or _print, time.monotonic()
        tell("first use of this installation: compiling for depth images (about 40 seconds)")
        signer = _opened(read_model(PRESETS[0]), PRESETS[0], settings)
        warm(signer)
        spent = time.monotonic() - begun
        tell(f"compiled for depth images in {spent:.0f} s; now for clouds (about 15 seconds)")
        warm(signer, clouds=True)
        tell(f"compiled, once for all, in {time.monotonic() - begun:.0f} s")
    for preset in PRESETS:
        _opened(read_model(preset), preset, settings)


def _is_new() -> bool:
    """Whether the code is yet to be compiled."""
    folder, pattern = compiled_at()
    return not any(Path(folder).glob(pattern))


def _print(text: str) -> None:
    print(f"sceneprint: {text}", file=sys.stderr)


def _opened(model: Model, name: str, settings: Settings) -> Signer:
    name = f"pair table of {name}"
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
