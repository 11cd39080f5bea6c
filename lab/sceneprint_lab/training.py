"""Training of a model on synthetic scenes and, optionally, the user's frames.

    rooms or sites, frames  --train-->  Model

The functions that fit projection, mixture and whitening are in `geometry`, in the modules of these
stages. This module calls them, and derives the quantiser step and d0 from the resulting signatures.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from multiprocessing import get_context
from typing import Any, Literal

import numpy as np

from sceneprint.errors import FrameError, TrainingError
from sceneprint.formats.dataset import FrameReference
from sceneprint.geometry.registration.patch_descriptors import fit_compression, patch_descriptors
from sceneprint.geometry.retrieval.ranking import Metric, pairwise_distances
from sceneprint.geometry.signature.fisher_vector import (
    UNITS,
    Ints16,
    WhiteningParameters,
    fit_whitening,
    psi_units,
    quantise,
    whiten,
)
from sceneprint.geometry.signature.mixture import MixtureParameters, fit_mixture
from sceneprint.geometry.signature.pair_features import (
    fit_projection,
    neighbour_pairs,
    pair_properties,
    project,
)
from sceneprint.geometry.signature.segmentation import HierarchyParameters, patch_weights
from sceneprint.geometry.validation.acceptance import AcceptanceParameters
from sceneprint.geometry.validation.map_verification import MapParameters
from sceneprint.models import Model, ModelParameters, read_model
from sceneprint.models.model import AnswerParameters, scale_lengths
from sceneprint.signing import (
    Signer,
    float_signature,
    hierarchy_of,
    open_signer,
    patches_for_validation,
    see,
    table_statistics,
)
from sceneprint.types import AnyFrame, Bytes, Floats, Floats32, Patches
from sceneprint_lab.synth import synthesise_room, synthesise_survey

# The presets: sizes, lengths and training scenes.
#
# name  --preset_parameters-->  ModelParameters, MixtureParameters

#: Kinds of synthetic scenes: rooms for a depth camera, or sites for a laser scanner.
Scenes = Literal["rooms", "sites"]

#: Sizes of the presets: G components and H levels.
PRESET_SIZES = {"depth": (256, 2), "lidar": (256, 4), "paper": (1250, 4)}
#: Levels of psi in stored signatures, parameters of the whitening, and number of scenes to which it
#: is fitted. `paper` stores psi.
PRESET_WHITENINGS = {
    "depth": ((1,), WhiteningParameters(448, exponent=0.75), 500),
    "lidar": ((1, 2, 3), WhiteningParameters(448, exponent=0.75), 400),
}


def preset_parameters(preset: str) -> tuple[ModelParameters, MixtureParameters]:
    """Return the parameters of a preset.

    `depth`, the default, is for depth cameras indoors. `lidar` has greater lengths, for scanners
    with a range of tens of metres. `paper` has the sizes of Sec. III-F.

    Raise TrainingError if the preset does not exist.
    """
    if preset not in PRESET_SIZES:
        raise TrainingError(
            f"There is no preset {preset!r}. Select one of {', '.join(PRESET_SIZES)}."
        )
    g, h = PRESET_SIZES[preset]
    model = _lidar() if preset == "lidar" else ModelParameters()
    return replace(model, hierarchy=HierarchyParameters(h)), MixtureParameters(g)


def preset_whitening(preset: str) -> tuple[tuple[int, ...], WhiteningParameters, int]:
    """Return the levels of psi in signatures, and the whitening's parameters and number of scenes.

    The number of scenes is 0 if psi is stored without whitening.
    """
    if preset not in PRESET_WHITENINGS:
        return (0,), WhiteningParameters(), 0
    return PRESET_WHITENINGS[preset]


def preset_scenes(preset: str) -> tuple[Scenes, int]:
    """Return the kind of training scenes of a preset, and the number of frames per scene."""
    return ("sites", 3) if preset == "lidar" else ("rooms", 6)


#: Maximum plane violations of an accepted transform between scans, and of a rival that counts.
_MOST_VIOLATIONS = 0.08
#: Acceptance for scans. Planes and free space decide, because two scans may have little surface in
#: common. Corridors look similar, so six distinct planes must agree, with few violations of free
#: space. In streets, many small planes agree although two scans have little surface in common.
_SCAN_ACCEPTANCE = AcceptanceParameters(
    residual_m=0.2, residual_rad=math.radians(3.0), violation_weight=0.0, evidence=0.0,
    plane_overlap=0.0, strong=0.0, net_strong=0.15, planes=6.0, many_planes=10.0,
    plane_violations=_MOST_VIOLATIONS,
)  # fmt: skip
#: Ratio of the lengths for a scanner to those for a depth camera.
_FACTOR = 5.0
#: Parameters that adapt refinements to the noise of a laser.
_SCAN_NOISE: dict[str, Any] = {"reference_depth": 10.0, "growth": 1, "weight_depth": 1e6}


def _lidar() -> ModelParameters:
    """Return the default parameters with lengths multiplied by five, adapted to scanners.

    The neighbourhood radius and the equal weights of large and small patches were tuned on
    synthetic halls that are not in the training data (docs/evaluation.md). The noise of a laser
    does not grow with range, so distant points have full weights; only the distance between samples
    grows, linearly with range.
    """
    p = scale_lengths(ModelParameters(), _FACTOR)
    noise = _SCAN_NOISE
    cloud = replace(
        p.cloud,
        minimum_range=0.6,
        maximum_range=60.0,
        voxel_angle=1 / 40,  # large enough to connect rings 1.4 degrees apart
        seed_px=4.4,
        maximum_patches=1000,
        validation_seed_px=6.9,
        maximum_validation_patches=500,
        image_angle=1 / 64,  # a window contains three rings two degrees apart
        noise_gate=0.0015,
    )
    depth = replace(p.depth, minimum_depth=0.6, maximum_depth=60.0)
    v = p.validation
    validation = replace(
        v, acceptance=_SCAN_ACCEPTANCE,
        alignment=replace(
            v.alignment, matching=replace(v.alignment.matching, n_sources=200),
            consensus=replace(v.alignment.consensus, n_seeds=80),
            coarse=replace(v.alignment.coarse, first_gate=0.6, last_gate=0.2, **noise),
            fine=replace(v.alignment.fine, first_gate=0.3, last_gate=0.1, **noise),
        ),
        rivals=replace(
            v.rivals, refuted=_MOST_VIOLATIONS, first=replace(v.rivals.first, **noise),
            then=replace(v.rivals.then, **noise),
        ),
        agreement=replace(
            v.agreement, surface_tolerance=0.12, point_tolerance=0.5, free_space_margin=0.4,
            reference_depth=10.0, growth=1,
        ),
    )  # fmt: skip
    return replace(
        p, depth=depth, weights=replace(p.weights, size_exponent=0.0),
        properties=replace(p.properties, radius=30.0), cloud=cloud, validation=validation,
    )  # fmt: skip


def preset_answer(preset: str) -> AnswerParameters:
    """Return the answer parameters of a preset, one of PRESETS.

    The confidence is that of the shipped preset, because its fit requires answers of a model.
    """
    confidence = read_model(preset).answer.confidence
    if preset != "lidar":
        return AnswerParameters(confidence=confidence)
    lengths = scale_lengths(MapParameters(), _FACTOR)
    refinement = replace(lengths.refinement, **_SCAN_NOISE)
    return AnswerParameters(replace(lengths, refinement=refinement), confidence)


#: Callback that takes the name of the stage, the number of finished steps and the total.
Report = Callable[[str, int, int], None]


@dataclass(frozen=True)
class TrainingParameters:
    """Parameters of the training, all of which affect the model."""

    rooms: int = 100  #: number of synthetic rooms or sites
    views: int = 6  #: number of frames per room or site
    seed: int = 0  #: seed of rooms, sampled pairs and fits
    pairs: int = 240_000  #: number of pairs to which projection and mixture are fitted
    projection: Literal["pca", "ica"] = "pca"
    descriptors: int = 128  #: number of bytes per descriptor
    histograms: int = 40_000  #: number of histograms to which the compression is fitted
    clipped_share: float = 0.0005  #: share of signature components outside the quantiser's range
    scenes: Scenes = "rooms"  #: kind of synthetic scenes
    whitening_rooms: int = 0  #: number of rooms for the whitening; 0 stores psi
    levels: tuple[int, ...] = (0,)  #: levels in whitened signatures
    whitening: WhiteningParameters = field(default_factory=WhiteningParameters)


@dataclass(frozen=True, eq=False)
class Lesson:
    """The training data of a frame."""

    place: str  #: name of the place; frames of different places are unrelated
    properties: Floats  #: (n, 13) properties of sampled pairs of all levels
    histograms: Floats32  #: (m, D) histograms of the surroundings of sampled patches
    levels: tuple[Patches, ...]  #: patches of each level


@dataclass(frozen=True)
class Draw:
    """The number of samples to draw from each frame."""

    pairs: int  #: number of pairs per level
    histograms: int


def train(
    name: str, model_p: ModelParameters, mixture_p: MixtureParameters, p: TrainingParameters,
    references: Sequence[tuple[str, FrameReference]] = (), jobs: int = 1,
    report: Report | None = None,
) -> Model:  # fmt: skip
    """Return a trained model, which does not depend on the number of processes.

    Parameters
    ----------
    model_p, mixture_p : parameters of the model, such as the results of `preset_parameters`
    references : the user's frames, in addition to the rooms, each with the name of its place
    jobs : number of processes that create and segment frames; 1 uses this process
    report : callback for progress

    Raises
    ------
    TrainingError : If there is too little data, the frames show fewer than two places, or a level
        does not exist
    """
    from threadpoolctl import threadpool_limits

    if p.whitening_rooms and max(p.levels) >= (n_levels := model_p.hierarchy.n_levels):
        raise TrainingError(
            f"There is no level {max(p.levels)}: the hierarchy has {n_levels} levels. Select from "
            f"0 to {n_levels - 1}."
        )
    notify = report or _silent
    n_frames = p.rooms * p.views + len(references)
    drawn = Draw(
        math.ceil(p.pairs / max(n_frames * model_p.hierarchy.n_levels, 1)),
        math.ceil(p.histograms / max(n_frames, 1)),
    )
    lessons = list(_lessons(model_p, p, drawn, references, jobs, notify))
    if len({lesson.place for lesson in lessons}) < 2:
        raise TrainingError(
            f"The {len(lessons)} usable frames show fewer than two places, but d0, the distance "
            "between unrelated frames, requires two. Add --rooms or frames of another place."
        )
    properties = np.concatenate([lesson.properties for lesson in lessons])
    histograms = np.concatenate([lesson.histograms for lesson in lessons])
    if len(histograms) <= model_p.surroundings.dimension:
        raise TrainingError(
            f"{len(histograms)} patches are too few to fit the compression of "
            f"{model_p.surroundings.dimension} bins. Add --rooms or your own frames."
        )
    with threadpool_limits(1):  # the order of summation must not depend on the processors
        compression = fit_compression(histograms, p.descriptors)
        projection = fit_projection(properties, p.projection, p.seed)
        features = project(properties, projection)
        fit = fit_mixture(features, mixture_p, p.seed)
        mixture = next(fit)
        for step, mixture in enumerate(fit, 1):  # noqa: B007 -- the last mixture is the result
            notify("mixture", step, mixture_p.iterations)
    provenance = {
        "training": _provenance(p),
        "mixture": asdict(mixture_p),
        "own_frames": len(references),
        "frames_used": len(lessons),
        "pairs_used": len(features),
    }
    fitted = Model(name, model_p, projection, mixture, compression, 1.0, 1.0, provenance)
    model = calibrated(fitted, lessons, p)
    return whitened(model, p, references, jobs, notify) if p.whitening_rooms else model


def _provenance(p: TrainingParameters) -> dict[str, Any]:
    """Return the parameters for the provenance, without unused ones of scenes and whitening."""
    written = asdict(p)
    if p.scenes == "rooms":
        del written["scenes"]
    if not p.whitening_rooms:
        for name in ("whitening_rooms", "levels", "whitening"):
            del written[name]
    return written


def _silent(stage: str, done: int, total: int) -> None:
    del stage, done, total


def calibrated(model: Model, lessons: Sequence[Lesson], p: TrainingParameters) -> Model:
    """Return the model with a quantiser step and d0, computed from one frame per place.

    `lessons`: training data of at least two places.
    """
    signer = open_signer(model, cached=False)
    first = {lesson.place: lesson for lesson in reversed(lessons)}
    psi = [
        float_signature([table_statistics(level, signer) for level in lesson.levels], model)
        for lesson in sorted(first.values(), key=lambda lesson: lesson.place)
    ]
    step = float(np.quantile(np.abs(np.stack(psi)), 1.0 - p.clipped_share)) / 127
    stored = np.stack([quantise(vector, step) for vector in psi])
    d0 = _median_distance(stored, "l1")
    return replace(model, quantiser_step=step, psi_unrelated_distance=d0)


def whitened(
    model: Model, p: TrainingParameters, references: Sequence[tuple[str, FrameReference]],
    jobs: int, report: Report,
) -> Model:  # fmt: skip
    """Return the model with a whitening, fitted to `p.whitening_rooms` and the user's frames.

    Parameters
    ----------
    model : result of `calibrated`
    p, references, jobs, report : arguments of `train`

    Raises
    ------
    TrainingError : If there are too few frames for the dimension of the whitening
    """
    from threadpoolctl import threadpool_limits

    psi, places = list[Ints16](), list[str]()
    with _open_pool(jobs, _open_signer, model, p.levels) as pool:
        rooms = pool.map(partial(_room_psi, p), range(p.whitening_rooms))
        for done, (place, vectors) in enumerate(rooms, 1):
            report("whitening", done, p.whitening_rooms)
            psi += vectors
            places += [place] * len(vectors)
        for place, vectors in pool.map(_own_psi, references, chunksize=4):
            psi += vectors
            places += [place] * len(vectors)
    if len(psi) <= p.whitening.dimension:
        raise TrainingError(
            f"{len(psi)} usable frames are too few for signatures of {p.whitening.dimension} "
            "bytes. Add --rooms or your own frames."
        )
    with threadpool_limits(1):
        fit = fit_whitening(np.stack(psi), p.levels, p.whitening)
    first = {place: i for i, place in reversed(list(enumerate(places)))}
    stored = np.stack([whiten(psi[i] / UNITS, fit) for _, i in sorted(first.items())])
    own = replace(fit, unrelated_distance=_median_distance(stored, "l2"))
    # Coarser levels were needed for the mixture only.
    h = replace(model.parameters.hierarchy, n_levels=max(p.levels) + 1)
    return replace(model, parameters=replace(model.parameters, hierarchy=h), whitening=own)


#: Signer with which this process fits the whitening, and levels of psi.
_signing: list[tuple[Signer, tuple[int, ...]]] = []


def _open_signer(model: Model, levels: tuple[int, ...]) -> None:
    _signing[:] = [(open_signer(model, cached=False), levels)]


def _room_psi(p: TrainingParameters, index: int) -> tuple[str, list[Ints16]]:
    """Return the name of a synthetic scene, and psi of each usable frame."""
    name, frames = _scene(p, index)
    return name, [vector for frame in frames for vector in _psi(frame)]


def _own_psi(reference: tuple[str, FrameReference]) -> tuple[str, list[Ints16]]:
    place, frame = reference
    try:
        return place, _psi(frame.read())
    except FrameError:  # unusable frames of a recording are skipped
        return place, []


def _psi(frame: AnyFrame) -> list[Ints16]:
    """Return [psi] of a frame, with all levels, or [] if the frame cannot be signed."""
    (signer, levels), p = _signing[0], _signing[0][0].model.parameters
    try:
        patches = hierarchy_of(see(frame, p), p).levels
        statistics = [table_statistics(patches[level], signer) for level in levels]
        return [psi_units(float_signature(statistics, signer.model))]
    except FrameError:
        return []


def _median_distance(stored: Bytes, metric: Metric) -> float:
    among = pairwise_distances(stored, metric)
    return float(np.median(among[np.triu_indices(len(stored), 1)]))


def _open_pool(jobs: int, begin: Callable[..., None] | None = None, *arguments: Any) -> Executor:
    """Return a pool of `jobs` processes that first call `begin`; a thread if `jobs` is 1."""
    if jobs == 1:
        return ThreadPoolExecutor(1, "training", begin, arguments)
    return ProcessPoolExecutor(jobs, get_context("spawn"), begin, arguments)


def _lessons(
    model_p: ModelParameters, p: TrainingParameters, draw: Draw,
    references: Sequence[tuple[str, FrameReference]], jobs: int, report: Report,
) -> Iterator[Lesson]:  # fmt: skip
    """Yield the training data of all synthetic scenes, then of the user's frames."""
    room = partial(_room_lessons, model_p, p, draw)
    frame = partial(_own_lesson, model_p, p, draw)
    with _open_pool(jobs) as pool:
        for done, lessons in enumerate(pool.map(room, range(p.rooms)), 1):
            report("rooms", done, p.rooms)
            yield from lessons
        own = pool.map(frame, range(len(references)), references, chunksize=4)
        for done, lessons in enumerate(own, 1):
            report("frames", done, len(references))
            yield from lessons


def _room_lessons(
    model_p: ModelParameters, p: TrainingParameters, draw: Draw, index: int
) -> list[Lesson]:
    name, frames = _scene(p, index)
    return [
        lesson
        for view, frame in enumerate(frames)
        for lesson in _lesson(frame, name, (p.seed, 0, index, view), model_p, draw)
    ]


def _scene(p: TrainingParameters, index: int) -> tuple[str, Sequence[AnyFrame]]:
    """Return the name and the frames of a synthetic scene."""
    if p.scenes == "sites":
        survey = synthesise_survey(p.seed, index, p.views)
        return survey.name, survey.clouds
    room = synthesise_room(p.seed, index, p.views)
    return room.name, room.frames


def _own_lesson(
    model_p: ModelParameters, p: TrainingParameters, draw: Draw,
    index: int, reference: tuple[str, FrameReference],
) -> list[Lesson]:  # fmt: skip
    place, frame = reference
    try:
        return _lesson(frame.read(), place, (p.seed, 1, index), model_p, draw)
    except FrameError:  # unusable frames of a recording are skipped
        return []


def _lesson(
    frame: AnyFrame, place: str, seed: tuple[int, ...], model_p: ModelParameters, draw: Draw
) -> list[Lesson]:
    """Return a list of the training data of a frame; it is empty if the frame is unusable."""
    rng = np.random.default_rng(seed)
    try:
        surface = see(frame, model_p)
        patches = hierarchy_of(surface, model_p)
    except FrameError:
        return []
    drawn = []
    for level in patches.levels:
        pairs = neighbour_pairs(level, model_p.properties)
        if len(pairs):
            # Sample with replacement, in proportion to the weights that the statistics use.
            share = patch_weights(level, model_p.weights)[pairs].prod(axis=1).cumsum()
            some = np.searchsorted(share, np.sort(rng.random(draw.pairs)) * share[-1], "right")
            drawn.append(pair_properties(level, pairs[some], model_p.properties))
    if not drawn:
        return []
    own = patches_for_validation(surface, model_p)
    some = rng.permutation(len(own))[: draw.histograms]
    histograms = patch_descriptors(own, model_p.surroundings)[some]
    return [Lesson(place, np.concatenate(drawn), histograms, patches.levels)]
