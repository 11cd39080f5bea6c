"""From recordings to pairs of frames that were registered, and how far off each is.

PATH...  --evaluate_pairs-->  PairEvaluation
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np

from sceneprint.errors import DatasetError
from sceneprint.evaluation.frames import Prepared, Store, prepare_all
from sceneprint.evaluation.overlap import Overlaps, view_of
from sceneprint.evaluation.pair_drawing import Drawing, Place, draw
from sceneprint.evaluation.pair_trying import Tried, attempt, open_bench, scale_of
from sceneprint.evaluation.planarity import OFF_PLANE, PLANAR, plane_share
from sceneprint.evaluation.protocol import Chosen, every_frame
from sceneprint.evaluation.records import RIGHT, Member
from sceneprint.evaluation.run import overlaps_of
from sceneprint.evaluation.workers import Watch, map_over, unwatched
from sceneprint.geometry.acceptance import AcceptanceParameters, Mode
from sceneprint.geometry.sequences import Matching
from sceneprint.libraries import open3d
from sceneprint.pipeline import Signer
from sceneprint.types import Floats


@dataclass(frozen=True)
class Settings:
    """How to evaluate pairs.

    Parameters
    ----------
    drawing : see Drawing
    frames : of each scene, evenly spread over its recordings, at most
    mode, matching : of validation
    seed : of every pair that is validated
    limits : metres and degrees to which a transform is to be right
    baselines : whether overlapping pairs are registered by Open3D as well
    jobs : processes; no figure but times depends on it
    cache_dir : of derived files of the model; None for the user's
    """

    drawing: Drawing = field(default_factory=Drawing)
    frames: int = 300
    mode: Mode = "full"
    matching: Matching = "histograms"
    seed: int = 0
    limits: tuple[float, float] = RIGHT
    baselines: bool = False
    jobs: int = 1
    cache_dir: Path | None = None


@dataclass(frozen=True, eq=False)
class PairEvaluation:
    """What came of every pair.

    Parameters
    ----------
    members : N frames that can be used, without their signatures
    limits : metres and degrees to which a transform was to be right
    acceptance : the numbers of the model's
    planes : (N,) share of each one's samples in its largest plane
    tried : in the order drawn
    left_out : (name, reason) of other frames
    prepare_ms : median time to sign a frame and work out its geometry
    """

    members: list[Member]
    limits: tuple[float, float]
    acceptance: AcceptanceParameters
    planes: Floats
    tried: list[Tried]
    left_out: list[tuple[str, str]]
    prepare_ms: float | None


def evaluate_pairs(
    paths: Sequence[Path],
    signer: Signer,
    store: Store,
    settings: Settings,
    watch: Watch = unwatched,
) -> PairEvaluation:
    """Draw pairs by true overlap, validate each, and judge it by the true poses.

    Parameters
    ----------
    paths : of sequences with poses; frames of two scenes are negatives of each other
    signer : see `open_signer`
    store : an empty one; its frames serve the pictures afterwards
    settings : see Settings
    watch : told of every step of every stage

    Raises
    ------
    DatasetError : no two frames could be used, or no pair is to be had of them.
    MissingDependency : baselines were asked for, and Open3D cannot be imported.
    """
    if settings.baselines:
        # before all the reading: where it is missing, that is what is to be told
        open3d("A baseline of registration")
    placed = spread(every_frame(paths), settings.frames)
    chosen = tuple(one for one, _ in placed)
    prepared = prepare_all(
        chosen,
        signer,
        store,
        jobs=settings.jobs,
        cache_dir=settings.cache_dir,
        watch=watch,
    )
    members = [replace(m, signature=np.empty(0, np.uint8)) for m in prepared.queries]
    if len(members) < 2:
        raise DatasetError(_too_few(prepared))
    parameters = signer.model.parameters
    opening_views = partial(_views, store, OFF_PLANE * scale_of(parameters))
    shares = map_over(members, _plane_share, opening_views, settings.jobs)
    planes = np.array(list(watch(shares, "planes", len(members))))
    places = [placed[member.number][1] for member in members]
    truth = _overlaps(members, store, watch)
    drawn = draw(places, truth, planes >= PLANAR, settings.drawing)
    if not drawn:
        raise DatasetError(
            f"Of {len(members)} frames no two overlap by a tenth or see nothing of each other, "
            f"{settings.drawing.apart} places apart. Give more recordings, or a smaller --apart."
        )
    tasks = [(one, members[one.query], members[one.match]) for one in drawn]
    opening = partial(
        open_bench,
        store,
        signer.model,
        settings.mode,
        settings.seed,
        settings.limits,
        baselines=settings.baselines,
        matching=settings.matching,
    )
    tried = map_over(tasks, attempt, opening, settings.jobs)
    return PairEvaluation(
        members,
        settings.limits,
        parameters.validation.acceptance,
        planes,
        list(watch(tried, "validate", len(tasks))),
        prepared.left_out,
        prepared.milliseconds,
    )


def spread(chosen: Sequence[Chosen], most: int) -> list[tuple[Chosen, Place]]:
    """At most so many frames of each scene, evenly over its recordings, and where each is."""
    counts: Counter[tuple[str, str]] = Counter()
    of: dict[str, list[tuple[Chosen, Place]]] = {}
    for one in chosen:
        run = str(one.reference.path.parent)
        place = Place(one.scene, run, counts[one.scene, run])
        counts[one.scene, run] += 1
        of.setdefault(one.scene, []).append((one, place))
    return [
        own[i]
        for own in of.values()
        for i in np.linspace(0, len(own) - 1, min(most, len(own))).round().astype(int).tolist()
    ]


def _too_few(prepared: Prepared) -> str:
    usable = len(prepared.queries)
    if not prepared.left_out:
        return f"There is {usable} frame, and a pair has two. Give more recordings."
    name, reason = prepared.left_out[0]
    return (
        f"{usable or 'No'} frame can be used, and a pair has two. The first that was left out is "
        f"{name}: {reason.rstrip('.')}. Choose other recordings."
    )


def _views(store: Store, off: float) -> tuple[Store, float]:
    return store, off


def _plane_share(opened: tuple[Store, float], member: Member) -> float:
    store, off = opened
    return plane_share(view_of(store.frame(member)).samples, off)


def _overlaps(members: Sequence[Member], store: Store, watch: Watch) -> Overlaps:
    """Overlap of all with all; 0 between scenes."""
    shape = len(members), len(members)
    mean, least = np.zeros(shape), np.zeros(shape)
    for scene in dict.fromkeys(member.scene for member in members):
        own = [i for i, member in enumerate(members) if member.scene == scene]
        of_scene = [members[i] for i in own]
        found = overlaps_of(Prepared(of_scene, of_scene, [], None), store, watch)
        at = np.ix_(own, own)
        mean[at], least[at] = found.mean, found.least
    return Overlaps(mean, least)
