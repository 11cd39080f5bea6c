"""The paper's Fig. 1 as functions, one line a stage.

frame --prepare--> signature, geometry
signature, database --retrieve--> R --diversify--> C --associate--> C_vld --localize--> pose
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from sceneprint.errors import ModelMismatch
from sceneprint.geometry.core_pool import both
from sceneprint.geometry.registration.gravity import NO_UPS, Ups
from sceneprint.geometry.registration.overlap import thinned
from sceneprint.geometry.registration.patch_descriptors import compress, patch_descriptors
from sceneprint.geometry.registration.sequence_alignment import Matching
from sceneprint.geometry.retrieval.distance import (
    Metric,
    Ranking,
    distances,
    pairwise_distances,
    rank,
    ranking_size,
)
from sceneprint.geometry.retrieval.dpp import DiversityParameters, Selection
from sceneprint.geometry.retrieval.dpp import diversify as select
from sceneprint.geometry.surface.cloud import CloudParameters
from sceneprint.geometry.surface.range_image import SPREAD_POINTS, range_image, spread_points
from sceneprint.geometry.surface.voxels import Voxels
from sceneprint.geometry.validation.acceptance import Mode
from sceneprint.geometry.validation.validation import PairValidation, ValidationParameters
from sceneprint.geometry.validation.validation import validate as validate_geometry
from sceneprint.geometry.validation.validation import validate_guided as check_predicted
from sceneprint.geometry.validation.validation import validate_without_up as check_up
from sceneprint.models import PRESETS, Model, read_model
from sceneprint.signing import (
    Signature,
    Signer,
    encode,
    hierarchy_of,
    open_signer,
    patches_for_validation,
    see,
)
from sceneprint.types import AnyFrame, Bytes, Cloud, Floats, Geometry, Sphere, Surface

__all__ = [
    "Signature",
    "Signer",
    "distance",
    "diversify",
    "geometry_of",
    "open_signer",
    "prepare",
    "retrieve",
    "sign",
    "validate",
    "validate_guided",
    "validate_without_up",
]


def sign(frame: AnyFrame, signer: Signer) -> Signature:
    """The stored signature of a frame: Sec. III-A, III-B, III-F; whitened where its model says so.

    Parameters
    ----------
    frame : depth, or a cloud, in metres
    signer : see `open_signer`

    Raises
    ------
    UselessFrame : nothing within the sensor's range, or no two patches to relate.
    """
    p = signer.model.parameters
    return encode(hierarchy_of(see(frame, p), p, frame.name), signer, frame.name)


def prepare(frame: AnyFrame, signer: Signer) -> tuple[Signature, Geometry]:
    """Signature and geometry artifact of a frame, of one look at its surface.

    Raises
    ------
    UselessFrame : see `sign`.
    """
    p = signer.model.parameters
    seen = see(frame, p)
    return both(
        lambda: encode(hierarchy_of(seen, p, frame.name), signer, frame.name),
        lambda: geometry_of(seen, signer.model),
    )


def geometry_of(seen: Surface, model: Model) -> Geometry:
    """The geometry artifact of a surface: what validation needs of it, Sec. III-E.

    Parameters
    ----------
    seen : of `sceneprint.signing.see`
    model : whose parameters and compression are used
    """
    p = model.parameters
    _NUMBERS[model.id] = p.validation
    shown = seen
    if isinstance(seen, Voxels):
        shown = _scan(seen.cloud, p.cloud) if seen.cloud.has_viewpoint else seen.plain
    patches = patches_for_validation(seen, p)
    histograms = patch_descriptors(patches, p.surroundings)
    return Geometry(shown, patches, compress(histograms, model.compression), model.id)


def _scan(cloud: Cloud, p: CloudParameters) -> Surface:
    """The range image of a cloud; where it sees all around, with points spread over it."""
    shown = range_image(cloud, p)
    if not (isinstance(shown.camera, Sphere) and shown.camera.sees_around):
        return shown
    points = spread_points(cloud, shown, p)
    # far surface is seen thinly, so that cubes are far narrower than if points lay evenly
    even = math.sqrt(float(points.areas.sum(dtype=float)) / SPREAD_POINTS)
    return replace(shown, spread=thinned(points, SPREAD_POINTS, even / 12))


def distance(a: Signature, b: Signature) -> int:
    """Distance of two stored signatures in their model's metric: -s(X, Y) of Sec. III-C.

    Raises
    ------
    ModelMismatch : they are of two models.
    """
    _same_model(a, b)
    return int(distances(a.vector, b.vector[None], a.metric)[0])


def retrieve(
    query: Signature, database: Sequence[Signature], model: Model, size: int | None = None
) -> Ranking:
    """R: the database frames most similar to the query, Sec. III-C.

    Parameters
    ----------
    query : see Signature
    database : N signatures
    model : of all of them
    size : how many; default: by the density of the map, see `ranking_size`

    Raises
    ------
    ModelMismatch : signatures of several models, or of another than `model`.
    """
    _same_model(query, model)
    for one in database:
        _same_model(query, one)
    size = ranking_size(len(database)) if size is None else size
    stored = _stacked(database) if len(database) else np.empty((0, len(query.vector)), np.uint8)
    found = distances(query.vector, stored, model.metric)
    return rank(found, size, model.unrelated_distance)


def diversify(
    ranking: Ranking,
    database: Sequence[Signature],
    k: int = 10,
    p: DiversityParameters | None = None,
) -> Selection:
    """C: `k` of R that are near the query and unlike each other, Sec. III-D.

    Parameters
    ----------
    ranking : R
    database : that R is of
    k : how many to select
    p : see DiversityParameters

    Returns
    -------
    selection : positions in R, the top-ranked first, in the order of R
    """
    ranked = [database[i] for i in ranking.indices]
    metric: Metric = ranked[0].metric if ranked else "l2"
    among = pairwise_distances(_stacked(ranked), metric)
    return select(ranking.distances, among, k, p)


def validate(
    query: Geometry,
    match: Geometry,
    seed: int = 0,
    p: ValidationParameters | None = None,
    mode: Mode = "full",
    matching: Matching = "histograms",
    *,
    ups: Ups = NO_UPS,
    other_axes: bool = False,
) -> PairValidation:
    """Whether two frames see one place, and the transform between them: Sec. III-E.

    Parameters
    ----------
    query, match : geometry artifacts of one model
    seed : of the random choices; the answer echoes it
    p : default: those of the model that made them, `model.parameters.validation`
    mode : "full", or "paper" for the paper's test alone
    matching : "histograms", or "sequence" for correspondences as the paper finds them: slower
    ups : (3,) unit vectors, up in the query's and in the match's coordinates where they are known
    other_axes : whether the scanners may have stood otherwise than upright; of scans

    Raises
    ------
    ModelMismatch : the artifacts are of two models; or of one that this process has not used,
        and `p` was not given.
    """
    _same_model(query, match)
    p = p or _numbers_of(query)
    return validate_geometry(query, match, seed, p, mode, matching, ups=ups, other_axes=other_axes)


def validate_guided(
    query: Geometry, match: Geometry, T_match_query: Floats, seed: int,
    p: ValidationParameters | None, ups: Ups,
) -> PairValidation | None:  # fmt: skip
    """Check a transform (4, 4) that other matches and the map's poses predict: Sec. III-E.

    See `sceneprint.geometry.validation.validation.validate_guided`.

    Raises
    ------
    ModelMismatch : see `validate`.
    """
    _same_model(query, match)
    return check_predicted(query, match, T_match_query, seed, p or _numbers_of(query), ups)


def validate_without_up(
    query: Geometry, match: Geometry, seed: int, p: ValidationParameters | None, ups: Ups
) -> PairValidation | None:
    """Ask the surfaces alone, of a query that found nothing with `up`: Sec. III-E.

    See `sceneprint.geometry.validation.validation.validate_without_up`.

    Raises
    ------
    ModelMismatch : see `validate`.
    """
    _same_model(query, match)
    return check_up(query, match, seed, p or _numbers_of(query), ups)


#: Of models that this process has used, by id: an artifact names its model, and holds no more.
_NUMBERS: dict[str, ValidationParameters] = {}


def _numbers_of(made: Geometry) -> ValidationParameters:
    """What its own model validates with: rooms and halls are not judged by one number."""
    if made.model_id not in _NUMBERS:
        for model in map(read_model, PRESETS):
            _NUMBERS[model.id] = model.parameters.validation
    if made.model_id not in _NUMBERS:
        raise ModelMismatch(
            f"The artifacts are of model {made.model_id[:12]}, which ships with no preset and has "
            "not been used by this process. Give `p`, its `model.parameters.validation`."
        )
    return _NUMBERS[made.model_id]


def _stacked(signatures: Sequence[Signature]) -> Bytes:
    if not len(signatures):
        return np.empty((0, 0), np.uint8)
    return np.stack([one.vector for one in signatures])


def _same_model(a: Signature | Geometry, b: Signature | Geometry | Model) -> None:
    other = b.id if isinstance(b, Model) else b.model_id
    if a.model_id != other:
        raise ModelMismatch(
            f"Frames of two models cannot be compared: {a.model_id[:12]} and {other[:12]}. "
            "Sign both frames with one model."
        )
