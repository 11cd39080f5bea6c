"""Signers for commands, with messages while kernels are compiled."""

from __future__ import annotations

import argparse
import threading
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np

from sceneprint.cli.output import print_error, progress_bar
from sceneprint.engine.compilation import ALL, DEPTH, compile_kernels
from sceneprint.errors import FrameError
from sceneprint.models import PRESETS, Model, read_model
from sceneprint.pipeline import Signer, open_signer, sign
from sceneprint.settings import Settings
from sceneprint.types import DepthFrame, Intrinsics


def add_model_options(command: argparse.ArgumentParser) -> None:
    """Add `--preset` and `--model`."""
    choice = command.add_mutually_exclusive_group()
    choice.add_argument(
        "--preset", choices=PRESETS,
        help=f"model that sceneprint contains (default: {PRESETS[0]})",
    )  # fmt: skip
    choice.add_argument("--model", type=Path, metavar="FILE", help="file of your own model")


def open_signer_of(options: argparse.Namespace, settings: Settings, *, psi: bool = False) -> Signer:
    """Return the signer of the model in the options, with compiled kernels and an open table. Raise
    UnreadableModel if the model does not exist.

    With `psi`, the signer returns psi instead of signatures, and the default model is `paper`.
    """
    compile_kernels(settings.cache_dir, ("signing",), _print)
    name = options.model or options.preset or ("paper" if psi else PRESETS[0])
    model = read_model(name)
    signer = _open_signer(model.without_whitening if psi else model, str(name), settings)
    camera = Intrinsics(256, 192, 300, 300, 127.5, 95.5)  # halved once, like most images
    wall = DepthFrame(np.full((192, 256), 2.0, np.float32), camera)
    with suppress(FrameError):  # the wall may be outside of the model's range
        sign(wall, signer)  # load everything, so that the first frame takes no extra time
    return signer


def prepare_presets(
    settings: Settings, say: Callable[[str], None] | None = None, *, clouds: bool = False,
    stop: threading.Event | None = None,
) -> None:  # fmt: skip
    """Compile kernels and build the tables of the presets, unless this was done before.

    Parameters
    ----------
    say : function that receives progress messages; None prints them on standard error
    clouds : whether to include kernels of clouds; otherwise the first cloud waits for them
    stop : event that cancels the preparation
    """
    parts = ALL if clouds else DEPTH
    compile_kernels(settings.cache_dir, parts, say or _print, stop)
    for preset in PRESETS:
        if stop is None or not stop.is_set():
            _open_signer(read_model(preset), preset, settings)


def _print(text: str) -> None:
    print_error(f"sceneprint: {text}")


def _open_signer(model: Model, name: str, settings: Settings) -> Signer:
    with progress_bar(f"pair table of {name}", "bin", unit_scale=True, delay=0.5) as progress:
        return open_signer(model, settings.cache_dir, progress)
