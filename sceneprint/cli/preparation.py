"""Opening a signer for a command: which model, and a word before the machine goes quiet."""

from __future__ import annotations

import argparse
import sys
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
from tqdm import tqdm

from sceneprint.engine.compilation import ALL, DEPTH, compile_kernels
from sceneprint.errors import FrameError
from sceneprint.models import PRESETS, Model, read_model
from sceneprint.pipeline import Signer, open_signer, sign
from sceneprint.settings import Settings
from sceneprint.types import DepthFrame, Intrinsics


def add_model_options(command: argparse.ArgumentParser) -> None:
    """`--preset` or `--model`."""
    choice = command.add_mutually_exclusive_group()
    choice.add_argument(
        "--preset", choices=PRESETS,
        help=f"preset that ships with sceneprint (default: {PRESETS[0]})",
    )  # fmt: skip
    choice.add_argument("--model", type=Path, metavar="FILE", help="path of your own model")


def open_for(options: argparse.Namespace, settings: Settings, *, psi: bool = False) -> Signer:
    """The signer the options ask for, its code loaded and its table open.

    Says so before the machine goes quiet to compile, and shows the table being built.

    Parameters
    ----------
    options : of `add_model_options`
    psi : sign with psi itself; of the preset `paper` where no model is named

    Raises
    ------
    UnreadableModel : no such model.
    """
    compile_kernels(settings.cache_dir, ("signing",), _print)
    chosen = options.model or options.preset or ("paper" if psi else PRESETS[0])
    model = read_model(chosen)
    signer = _open_signer(model.without_whitening if psi else model, str(chosen), settings)
    with suppress(FrameError):  # a model of another range may see nothing there
        sign(_wall(), signer)  # so that the first frame's time is that of signing, not of loading
    return signer


def prepare_presets(
    settings: Settings, say: Callable[[str], None] | None = None, *, clouds: bool = False,
    stop: threading.Event | None = None,
) -> None:  # fmt: skip
    """See that code is compiled and the presets' tables are built, once an installation.

    So that a service's first frame does not wait for what a person can watch now.

    Parameters
    ----------
    say : what tells of each step, as it takes a while (default: lines on standard error)
    clouds : compile what clouds need as well; else the first cloud waits for that
    stop : once it is set, nothing more is compiled or built
    """
    parts = ALL if clouds else DEPTH
    compile_kernels(settings.cache_dir, parts, say or _print, stop)
    for preset in PRESETS:
        if stop is None or not stop.is_set():
            _open_signer(read_model(preset), preset, settings)


def _print(text: str) -> None:
    print(f"sceneprint: {text}", file=sys.stderr)


def _open_signer(model: Model, name: str, settings: Settings) -> Signer:
    name = f"pair table of {name}"
    # no bar among the lines of a log
    with tqdm(desc=name, unit="bin", unit_scale=True, delay=0.5, disable=None) as bar:

        def progress(done: int, total: int) -> None:
            bar.total = total
            bar.update(done - bar.n)

        return open_signer(model, settings.cache_dir, progress)


def _wall() -> DepthFrame:
    """A flat wall 2 m ahead."""
    camera = Intrinsics(256, 192, 300, 300, 127.5, 95.5)  # halved once, as most are
    return DepthFrame(np.full((192, 256), 2.0, np.float32), camera)
