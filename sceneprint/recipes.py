"""What the presets are made of: sizes, lengths, and the scenes they learn from.

name  --preset_parameters-->  ModelParameters, MixtureParameters
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, Literal

from sceneprint.errors import TrainingError
from sceneprint.geometry.hierarchy import HierarchyParameters
from sceneprint.geometry.mixture import MixtureParameters
from sceneprint.geometry.scaling import scaled
from sceneprint.geometry.whitening import WhiteningParameters
from sceneprint.models import ModelParameters

#: Synthetic scenes: rooms seen by a depth camera, or sites scanned by a laser.
Scenes = Literal["rooms", "sites"]

#: Sizes of the presets: G components, H levels.
PRESET_SIZES = {"depth": (256, 2), "lidar": (256, 4), "paper": (1250, 4)}
#: Levels of psi that stored signatures are made of, how, and the number of scenes that the
#: whitening is fitted to; `paper` stores psi itself.
PRESET_WHITENINGS = {
    "depth": ((1,), WhiteningParameters(448, exponent=0.75), 500),
    "lidar": ((1, 2, 3), WhiteningParameters(448, exponent=0.75), 400),
}


def preset_parameters(preset: str) -> tuple[ModelParameters, MixtureParameters]:
    """Parameters of a preset.

    `depth` suits depth cameras indoors, and is what to take by default. `lidar` has longer
    lengths, for scanners that see tens of metres. `paper` has the sizes of Sec. III-F.

    Raises
    ------
    TrainingError : no such preset.
    """
    if preset not in PRESET_SIZES:
        raise TrainingError(
            f"There is no preset {preset!r}. Choose one of {', '.join(PRESET_SIZES)}."
        )
    g, h = PRESET_SIZES[preset]
    model = _lidar() if preset == "lidar" else ModelParameters()
    return replace(model, hierarchy=HierarchyParameters(h)), MixtureParameters(g)


def preset_whitening(preset: str) -> tuple[tuple[int, ...], WhiteningParameters, int]:
    """Levels of psi that stored signatures are made of, how, and the scenes that teach it.

    No scenes where psi itself is stored.
    """
    if preset not in PRESET_WHITENINGS:
        return (0,), WhiteningParameters(), 0
    return PRESET_WHITENINGS[preset]


def preset_scenes(preset: str) -> tuple[Scenes, int]:
    """What a preset learns from, and how many frames are taken in each."""
    return ("sites", 3) if preset == "lidar" else ("rooms", 6)


#: The world of a scanner beside that of a depth camera.
_FACTOR = 5.0


def _lidar() -> ModelParameters:
    """`paper` in a world five times as large, but with a scanner's reach and noise.

    How far patches reach, and that large ones count no more than small ones, was found best on
    synthetic halls that training does not know (docs/evaluation.md). The noise of a laser does
    not grow with range, so nothing is weighted down for being far; what grows, linearly, is the
    distance from sample to sample.
    """
    p = scaled(ModelParameters(), _FACTOR)
    cloud = replace(
        p.cloud,
        minimum_range=0.6,
        maximum_range=60.0,
        voxel_angle=1 / 40,  # so that rings 1.4 degrees apart touch
        seed_px=4.4,
        maximum_patches=1000,
        validation_seed_px=6.9,
        maximum_validation_patches=500,
        image_angle=1 / 64,  # so that a window holds three rings two degrees apart
        noise_gate=0.0015,
    )
    depth = replace(p.depth, minimum_depth=0.6, maximum_depth=60.0)
    v = p.validation
    noise: dict[str, Any] = {"reference_depth": 10.0, "growth": 1, "weight_depth": 1e6}
    validation = replace(
        v,
        acceptance=replace(v.acceptance, residual_m=0.2, residual_rad=math.radians(3.0)),
        alignment=replace(
            v.alignment,
            matching=replace(v.alignment.matching, n_sources=200),
            consensus=replace(v.alignment.consensus, n_seeds=80),
            n_refined=12,
            coarse=replace(v.alignment.coarse, first_gate=1.2, last_gate=0.3, **noise),
            fine=replace(v.alignment.fine, first_gate=0.3, last_gate=0.1, **noise),
        ),
        rivals=replace(
            v.rivals,
            first=replace(v.rivals.first, **noise),
            then=replace(v.rivals.then, **noise),
        ),
        agreement=replace(
            v.agreement,
            surface_tolerance=0.12,
            point_tolerance=0.5,
            free_space_margin=0.4,
            reference_depth=10.0,
            growth=1,
        ),
    )
    return replace(
        p,
        depth=depth,
        weights=replace(p.weights, size_exponent=0.0),
        properties=replace(p.properties, radius=30.0),
        cloud=cloud,
        validation=validation,
    )
