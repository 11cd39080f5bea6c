"""The command `sceneprint train`: a model from synthetic rooms and your own frames."""

from __future__ import annotations

import argparse
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from sceneprint.cli import metres, positive, whole_number
from sceneprint.errors import TrainingError
from sceneprint.formats.dataset import FrameReference, find_sequences
from sceneprint.models import PRESETS, ModelParameters, save_model


def add_train(command: argparse.ArgumentParser) -> None:
    """Add the options of `sceneprint train`."""
    command.add_argument(
        "--out", type=Path, required=True, metavar="FILE", help="model file to write"
    )
    command.add_argument(
        "--preset", choices=PRESETS, default=PRESETS[0],
        help=f"preset that defines signature size, lengths and scenes (default: {PRESETS[0]})",
    )  # fmt: skip
    command.add_argument(
        "--rooms", type=whole_number, default=100, metavar="N",
        help="number of synthetic rooms or sites (default: 100)",
    )  # fmt: skip
    command.add_argument(
        "--whitening-rooms", type=whole_number, metavar="N",
        help="number of synthetic rooms or sites to fit the whitening of signatures; 0 stores psi "
        "without whitening (default: 500; lidar 400, paper 0)",
    )  # fmt: skip
    command.add_argument("--seed", type=whole_number, default=0, metavar="S")
    command.add_argument(
        "--frames", type=Path, nargs="+", default=[], metavar="DIR",
        help="also train on your own frames, in any layout that `sceneprint sign` reads",
    )  # fmt: skip
    command.add_argument("--projection", choices=("pca", "ica"), default="pca", help="default: pca")
    command.add_argument(
        "--range", type=metres, nargs=2, metavar=("MIN", "MAX"),
        help="range of the sensor in metres (default: 0.3 9; lidar 0.6 60)",
    )  # fmt: skip
    command.add_argument(
        "--radius", type=metres, metavar="R",
        help="radius of the neighbourhood of a patch, metres (default: 3; lidar 30)",
    )  # fmt: skip
    command.add_argument(
        "--jobs", type=positive, default=os.cpu_count() or 1, metavar="N", help="processes"
    )
    command.set_defaults(run=run_train)


def run_train(options: argparse.Namespace) -> int:
    """Train a model on synthetic rooms or, for the preset lidar, on synthetic halls, storeys and
    blocks. The presets cover indoor depth cameras and spinning LiDAR; docs/model.md explains
    when to train your own.
    """
    from sceneprint_lab.training import (
        TrainingParameters,
        preset_answer,
        preset_parameters,
        preset_scenes,
        preset_whitening,
        train,
    )

    references: list[tuple[str, FrameReference]] = [
        (f"{path.resolve()}: {sequence.parent_frame}", reference)
        for path in options.frames
        for sequence in find_sequences(path)
        for reference in sequence.frames
    ]
    options.out.parent.mkdir(parents=True, exist_ok=True)
    if options.out.is_dir():
        raise TrainingError(f"{options.out}: This is a folder. Specify a file for the model.")
    scenes, views = preset_scenes(options.preset)
    levels, whitening, whitening_rooms = preset_whitening(options.preset)
    if options.whitening_rooms is not None:
        whitening_rooms = options.whitening_rooms
    p = TrainingParameters(
        rooms=options.rooms, views=views, seed=options.seed, projection=options.projection,
        scenes=scenes, whitening_rooms=whitening_rooms, levels=levels, whitening=whitening,
    )  # fmt: skip
    model_p, mixture_p = preset_parameters(options.preset)
    if options.range is not None:
        model_p = _with_range(model_p, *options.range)
    if options.radius is not None:
        properties = replace(model_p.properties, radius=options.radius)
        model_p = replace(model_p, properties=properties)
    name = re.sub(r"[^A-Za-z0-9_.-]", "-", options.out.stem)[:64] or options.preset
    with _Bars() as bars:
        model = train(name, model_p, mixture_p, p, references, options.jobs, bars.report)
    save_model(replace(model, answer=preset_answer(options.preset)), options.out)
    print(
        f"{options.out}: model {model.label}, {model.signature_bytes} bytes a signature, "
        f"trained on {model.provenance['frames_used']} frames and "
        f"{model.provenance['pairs_used']} pairs"
    )
    return 0


def _with_range(p: ModelParameters, least: float, most: float) -> ModelParameters:
    """Return the parameters with the range `least` to `most`, for both depth images and clouds."""
    if least >= most:
        raise TrainingError(f"--range {least:g} {most:g}: Put the smaller distance first.")
    return replace(
        p,
        depth=replace(p.depth, minimum_depth=least, maximum_depth=most),
        cloud=replace(p.cloud, minimum_range=least, maximum_range=most),
    )


class _Bars:
    """Progress bars for successive stages."""

    def __init__(self) -> None:
        self.stage = ""
        self.bar: Any = None

    def __enter__(self) -> _Bars:
        return self

    def __exit__(self, *reason: object) -> None:
        if self.bar is not None:
            self.bar.close()

    def report(self, stage: str, done: int, total: int) -> None:
        """Advance the bar of a stage; close the bar of the previous stage."""
        if stage != self.stage:
            self.__exit__()
            self.stage, self.bar = stage, tqdm(desc=stage, total=total, disable=None)
        self.bar.update(done - self.bar.n)
