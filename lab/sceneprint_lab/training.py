"""Learning a model: synthetic scenes and, if wished, frames of one's own, to a `Model`.

    rooms or sites, frames  --train-->  Model

What is learnt (projection, mixture, whitening) lives with its stage in `geometry`; here the
stages are put in order, and the quantiser and d0 are fixed from the signatures that come out.
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

# What the presets are made of: sizes, lengths, and the scenes they learn from.
#
# name  --preset_parameters-->  ModelParameters, MixtureParameters

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
    """Return parameters of a preset.

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
    """Return levels of psi that stored signatures are made of, how, and the scenes that teach it.

    No scenes where psi itself is stored.
    """
    if preset not in PRESET_WHITENINGS:
        return (0,), WhiteningParameters(), 0
    return PRESET_WHITENINGS[preset]


def preset_scenes(preset: str) -> tuple[Scenes, int]:
    """Return what a preset learns from, and how many frames are taken in each."""
    return ("sites", 3) if preset == "lidar" else ("rooms", 6)


#: Most violations by planes of a scan's transform, and of a rival to it: what is not believed to
#: be refuted refutes nothing.
_MOST_VIOLATIONS = 0.08
#: Of scans planes and free space decide, as what two of them share may be small. A corridor looks
#: like others: six distinct planes have to agree, and hardly any lie in another's free space.
_SCAN_ACCEPTANCE = AcceptanceParameters(
    residual_m=0.2, residual_rad=math.radians(3.0), violation_weight=0.0, evidence=0.0,
    plane_overlap=0.0, strong=0.0, net_strong=0.15, planes=6.0, plane_violations=_MOST_VIOLATIONS,
)  # fmt: skip
#: The world of a scanner beside that of a depth camera.
_FACTOR = 5.0
#: How the noise of a laser changes what its refinements weigh.
_SCAN_NOISE: dict[str, Any] = {"reference_depth": 10.0, "growth": 1, "weight_depth": 1e6}


def _lidar() -> ModelParameters:
    """Return `paper` in a world five times as large, but with a scanner's reach and noise.

    How far patches reach, and that large ones count no more than small ones, was found best on
    synthetic halls that training does not know (docs/evaluation.md). The noise of a laser does
    not grow with range, so nothing is weighted down for being far; what grows, linearly, is the
    distance from sample to sample.
    """
    p = scale_lengths(ModelParameters(), _FACTOR)
    noise = _SCAN_NOISE
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
    """Return the numbers of a preset by which poses are judged.

    Penalties of the confidence are those that the preset was shipped with: they are learnt from
    answers, which need a model.

    Parameters
    ----------
    preset : one of PRESETS
    """
    confidence = read_model(preset).answer.confidence
    if preset != "lidar":
        return AnswerParameters(confidence=confidence)
    lengths = scale_lengths(MapParameters(), _FACTOR)
    refinement = replace(lengths.refinement, **_SCAN_NOISE)
    return AnswerParameters(replace(lengths, refinement=refinement), confidence)


#: Called with the stage's name, steps done and their total.
Report = Callable[[str, int, int], None]


@dataclass(frozen=True)
class TrainingParameters:
    """What a model is trained on and how; all of it decides the outcome."""

    rooms: int = 100  #: synthetic rooms, or sites
    views: int = 6  #: frames taken in each
    seed: int = 0  #: of rooms, of the pairs drawn and of the fits
    pairs: int = 240_000  #: properties that projection and mixture are fitted to
    projection: Literal["pca", "ica"] = "pca"
    descriptors: int = 128  #: bytes of a descriptor
    histograms: int = 40_000  #: of surroundings, that their compression is fitted to
    clipped_share: float = 0.0005  #: of signature components, beyond the quantiser's range
    scenes: Scenes = "rooms"  #: seen by a depth camera, or by a laser
    whitening_rooms: int = 0  #: that the whitening is fitted to; 0: signatures are psi itself
    levels: tuple[int, ...] = (0,)  #: that whitened signatures are made of
    whitening: WhiteningParameters = field(default_factory=WhiteningParameters)


@dataclass(frozen=True, eq=False)
class Lesson:
    """What training keeps of one frame."""

    place: str  #: frames of different places are unrelated
    properties: Floats  #: (n, 13) of pairs drawn from all levels
    histograms: Floats32  #: (m, D) of the surroundings of patches drawn
    levels: tuple[Patches, ...]


@dataclass(frozen=True)
class Draw:
    """How much is taken from each frame."""

    pairs: int  #: of each level
    histograms: int


def train(
    name: str, model_p: ModelParameters, mixture_p: MixtureParameters, p: TrainingParameters,
    references: Sequence[tuple[str, FrameReference]] = (), jobs: int = 1,
    report: Report | None = None,
) -> Model:  # fmt: skip
    """Learn a model; the same arguments give the same model, however many processes help.

    Parameters
    ----------
    name : what to call the model
    model_p, mixture_p : its parameters, such as those of a preset: see `preset_parameters`
    references : frames of one's own beside the rooms, each with the name of its place
    jobs : processes that make and segment frames; with one, this process does
    report : called as the stages advance

    Raises
    ------
    TrainingError : too little data, frames of fewer than two places, or no such level.
    """
    from threadpoolctl import threadpool_limits

    if p.whitening_rooms and max(p.levels) >= (n_levels := model_p.hierarchy.n_levels):
        raise TrainingError(f"There is no level {max(p.levels)}: the hierarchy has {n_levels}.")
    tell = report or _silent
    n_frames = p.rooms * p.views + len(references)
    drawn = Draw(
        math.ceil(p.pairs / max(n_frames * model_p.hierarchy.n_levels, 1)),
        math.ceil(p.histograms / max(n_frames, 1)),
    )
    lessons = list(_lessons(model_p, p, drawn, references, jobs, tell))
    if len({lesson.place for lesson in lessons}) < 2:
        raise TrainingError(
            f"{len(lessons)} usable frames of fewer than two places: d0, the distance of "
            "unrelated frames, needs two. Add --rooms, or frames of another place."
        )
    properties = np.concatenate([lesson.properties for lesson in lessons])
    histograms = np.concatenate([lesson.histograms for lesson in lessons])
    if len(histograms) <= model_p.surroundings.dimension:
        raise TrainingError(
            f"{len(histograms)} patches are too few to learn what {model_p.surroundings.dimension} "
            "bins of their surroundings have in common. Add --rooms, or frames of your own."
        )
    with threadpool_limits(1):  # sums in one order, whatever the number of processors
        compression = fit_compression(histograms, p.descriptors)
        projection = fit_projection(properties, p.projection, p.seed)
        features = project(properties, projection)
        fit = fit_mixture(features, mixture_p, p.seed)
        mixture = next(fit)
        for step, mixture in enumerate(fit, 1):  # noqa: B007 -- the last one is kept
            tell("mixture", step, mixture_p.iterations)
    seen = {
        "training": _written(p),
        "mixture": asdict(mixture_p),
        "own_frames": len(references),
        "frames_used": len(lessons),
        "pairs_used": len(features),
    }
    fitted = Model(name, model_p, projection, mixture, compression, 1.0, 1.0, seen)
    model = calibrated(fitted, lessons, p)
    return whitened(model, p, references, jobs, tell) if p.whitening_rooms else model


def _written(p: TrainingParameters) -> dict[str, Any]:
    """Return the parameters for provenance, without defaults that came later."""
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
    """Return the model with its quantiser step and d0 fixed, from one frame of each place.

    Parameters
    ----------
    model : with projection and mixture
    lessons : of at least two places
    """
    signer = open_signer(model, cached=False)
    first = {lesson.place: lesson for lesson in reversed(lessons)}
    psi = [
        float_signature([table_statistics(level, signer) for level in lesson.levels], model)
        for lesson in sorted(first.values(), key=lambda lesson: lesson.place)
    ]
    step = float(np.quantile(np.abs(np.stack(psi)), 1.0 - p.clipped_share)) / 127
    stored = np.stack([quantise(one, step) for one in psi])
    d0 = _median_distance(stored, "l1")
    return replace(model, quantiser_step=step, psi_unrelated_distance=d0)


def whitened(
    model: Model, p: TrainingParameters, references: Sequence[tuple[str, FrameReference]],
    jobs: int, report: Report,
) -> Model:  # fmt: skip
    """Return the model with a whitening, fitted to more rooms, and to frames of one's own.

    Parameters
    ----------
    model : calibrated
    p, references, jobs, report : see `train`

    Raises
    ------
    TrainingError : too few frames for the dimension of the whitening.
    """
    from threadpoolctl import threadpool_limits

    psi, places = list[Ints16](), list[str]()
    with _helpers(jobs, _open_signer, model, p.levels) as pool:
        rooms = pool.map(partial(_room_psi, p), range(p.whitening_rooms))
        for done, (place, found) in enumerate(rooms, 1):
            report("whitening", done, p.whitening_rooms)
            psi += found
            places += [place] * len(found)
        for place, found in pool.map(_own_psi, references, chunksize=4):
            psi += found
            places += [place] * len(found)
    if len(psi) <= p.whitening.dimension:
        raise TrainingError(
            f"{len(psi)} usable frames are too few for signatures of {p.whitening.dimension} "
            "bytes. Add --rooms, or frames of your own."
        )
    with threadpool_limits(1):
        fit = fit_whitening(np.stack(psi), p.levels, p.whitening)
    first = {place: i for i, place in reversed(list(enumerate(places)))}
    stored = np.stack([whiten(psi[i] / UNITS, fit) for _, i in sorted(first.items())])
    own = replace(fit, unrelated_distance=_median_distance(stored, "l2"))
    # coarser levels taught the mixture; no frame needs them any more
    h = replace(model.parameters.hierarchy, n_levels=max(p.levels) + 1)
    return replace(model, parameters=replace(model.parameters, hierarchy=h), whitening=own)


#: What a process signs with while the whitening is fitted: its model, and the levels of psi.
_signing: list[tuple[Signer, tuple[int, ...]]] = []


def _open_signer(model: Model, levels: tuple[int, ...]) -> None:
    _signing[:] = [(open_signer(model, cached=False), levels)]


def _room_psi(p: TrainingParameters, index: int) -> tuple[str, list[Ints16]]:
    name, frames = _scene(p, index)
    return name, [one for frame in frames for one in _psi(frame)]


def _own_psi(reference: tuple[str, FrameReference]) -> tuple[str, list[Ints16]]:
    place, frame = reference
    try:
        return place, _psi(frame.read())
    except FrameError:  # one bad frame of a recording teaches nothing; that is all
        return place, []


def _psi(frame: AnyFrame) -> list[Ints16]:
    """Return psi of some levels of a frame; of a frame that cannot be signed, none."""
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


def _helpers(jobs: int, begin: Callable[..., None] | None = None, *arguments: Any) -> Executor:
    """Return a pool of processes that begin with a call; for one job, a thread of this process."""
    if jobs == 1:
        return ThreadPoolExecutor(1, "training", begin, arguments)
    return ProcessPoolExecutor(jobs, get_context("spawn"), begin, arguments)


def _lessons(
    model_p: ModelParameters, p: TrainingParameters, draw: Draw,
    references: Sequence[tuple[str, FrameReference]], jobs: int, report: Report,
) -> Iterator[Lesson]:  # fmt: skip
    room = partial(_room_lessons, model_p, p, draw)
    frame = partial(_own_lesson, model_p, p, draw)
    with _helpers(jobs) as pool:
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
    """Return the frames of one synthetic scene, and what it is called."""
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
    except FrameError:  # one bad frame of a recording teaches nothing; that is all
        return []


def _lesson(
    frame: AnyFrame, place: str, seed: tuple[int, ...], model_p: ModelParameters, draw: Draw
) -> list[Lesson]:
    rng = np.random.default_rng(seed)
    try:
        seen = see(frame, model_p)
        patches = hierarchy_of(seen, model_p)
    except FrameError:
        return []
    drawn = []
    for level in patches.levels:
        pairs = neighbour_pairs(level, model_p.properties)
        if len(pairs):
            # as often as they count in the statistics; one that comes twice does no harm
            share = patch_weights(level, model_p.weights)[pairs].prod(axis=1).cumsum()
            some = np.searchsorted(share, np.sort(rng.random(draw.pairs)) * share[-1], "right")
            drawn.append(pair_properties(level, pairs[some], model_p.properties))
    if not drawn:
        return []
    own = patches_for_validation(seen, model_p)
    some = rng.permutation(len(own))[: draw.histograms]
    histograms = patch_descriptors(own, model_p.surroundings)[some]
    return [Lesson(place, np.concatenate(drawn), histograms, patches.levels)]
