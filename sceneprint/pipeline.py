"""The stages of the paper's Fig. 1, as functions.

frame --prepare--> signature, geometry
signature, database --retrieve--> R --diversify--> C --associate--> C_vld --localize--> pose
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sceneprint.errors import ModelMismatch
from sceneprint.geometry.kernel import run_both
from sceneprint.geometry.registration.alignment import are_scans
from sceneprint.geometry.registration.overlap import thin_points
from sceneprint.geometry.registration.patch_descriptors import compress, patch_descriptors
from sceneprint.geometry.registration.sequence_alignment import Matching
from sceneprint.geometry.retrieval.ranking import (
    DiversityParameters,
    Metric,
    Ranking,
    Selection,
    distances,
    pairwise_distances,
    rank,
    ranking_size,
)
from sceneprint.geometry.retrieval.ranking import diversify as select
from sceneprint.geometry.rigid import NO_UPS, Ups, average_poses, inverse
from sceneprint.geometry.surface.cloud import CloudParameters
from sceneprint.geometry.surface.range_image import SPREAD_POINTS, range_image, spread_points
from sceneprint.geometry.surface.voxels import Voxels
from sceneprint.geometry.validation.acceptance import Mode
from sceneprint.geometry.validation.map_verification import (
    MapParameters,
    at_place,
    distinct_viewpoints,
)
from sceneprint.geometry.validation.validation import (
    PairValidation,
    ValidationParameters,
    rank_accepted,
)
from sceneprint.geometry.validation.validation import validate as validate_geometry
from sceneprint.geometry.validation.validation import validate_guided as check_predicted
from sceneprint.geometry.validation.validation import validate_without_up as check_up
from sceneprint.models import PRESETS, Model, read_model
from sceneprint.models.model import AnswerParameters
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
    """Compute the signature of a frame: Sec. III-A, III-B, III-F.

    Raises
    ------
    UselessFrame : If no sample lies within the sensor's range, or no two patches form a pair
    """
    p = signer.model.parameters
    return encode(hierarchy_of(see(frame, p), p, frame.name), signer, frame.name)


def prepare(frame: AnyFrame, signer: Signer) -> tuple[Signature, Geometry]:
    """Compute the signature and the geometry artifact of a frame, from one surface.

    Raises
    ------
    UselessFrame : See `sign`
    """
    p = signer.model.parameters
    seen = see(frame, p)
    return run_both(
        lambda: encode(hierarchy_of(seen, p, frame.name), signer, frame.name),
        lambda: geometry_of(seen, signer.model),
    )


def geometry_of(seen: Surface, model: Model) -> Geometry:
    """Compute a surface's geometry artifact, which validation requires: Sec. III-E.

    Parameters
    ----------
    seen : result of `sceneprint.signing.see`
    model : model with parameters and compression
    """
    p = model.parameters
    _PARAMETERS[model.id] = p.validation, model.answer
    shown = seen
    if isinstance(seen, Voxels):
        shown = _scan_image(seen.cloud, p.cloud) if seen.cloud.has_viewpoint else seen.plain
    patches = patches_for_validation(seen, p)
    histograms = patch_descriptors(patches, p.surroundings)
    return Geometry(shown, patches, compress(histograms, model.compression), model.id)


def _scan_image(cloud: Cloud, p: CloudParameters) -> Surface:
    """Return the range image of a cloud, with spread points if the sensor sees all around."""
    shown = range_image(cloud, p)
    if not (isinstance(shown.camera, Sphere) and shown.camera.sees_around):
        return shown
    points = spread_points(cloud, shown, p)
    # distant surfaces have few points, so the cubes must be smaller than for evenly spread points
    even = math.sqrt(float(points.areas.sum(dtype=float)) / SPREAD_POINTS)
    return replace(shown, spread=thin_points(points, SPREAD_POINTS, even / 12))


def distance(a: Signature, b: Signature) -> int:
    """Return the distance between two signatures: -s(X, Y) of Sec. III-C.

    Raises
    ------
    ModelMismatch : If the signatures are of different models
    """
    _require_same_model(a, b)
    return int(distances(a.vector, b.vector[None], a.metric)[0])


def retrieve(
    query: Signature, database: Sequence[Signature], model: Model, size: int | None = None
) -> Ranking:
    """Return R, the database frames that are most similar to the query: Sec. III-C.

    Parameters
    ----------
    database : N signatures
    model : model of all signatures
    size : number of members of R; None derives it from N, see `ranking_size`

    Raises
    ------
    ModelMismatch : If a signature is not of `model`
    """
    _require_same_model(query, model)
    for signature in database:
        _require_same_model(query, signature)
    size = ranking_size(len(database)) if size is None else size
    stored = (
        _stack_vectors(database) if len(database) else np.empty((0, len(query.vector)), np.uint8)
    )
    return rank(distances(query.vector, stored, model.metric), size, model.unrelated_distance)


def diversify(
    ranking: Ranking,
    database: Sequence[Signature],
    k: int = 10,
    p: DiversityParameters | None = None,
) -> Selection:
    """Select C, `k` members of R that are near the query and differ from each other: Sec. III-D.

    Parameters
    ----------
    ranking : R
    database : signatures to which R refers
    k : size of C
    p : parameters; None selects the defaults

    Returns
    -------
    selection : positions in R, in the order of R
    """
    ranked = [database[i] for i in ranking.indices]
    metric: Metric = ranked[0].metric if ranked else "l2"
    among = pairwise_distances(_stack_vectors(ranked), metric)
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
    """Decide whether two frames show the same place, and estimate their transform: Sec. III-E.

    Parameters
    ----------
    query, match : geometry artifacts of one model
    seed : seed of the random choices; the result contains it
    p : parameters; None selects the parameters of the artifacts' model
    mode : "full", or "paper" to apply only the paper's test
    matching : "histograms", or "sequence" for the paper's slower matching
    ups : (3,) unit vectors, up in the query's and in the match's coordinates; None if unknown
    other_axes : whether to try hypotheses for scanners that were not upright

    Raises
    ------
    ModelMismatch : If the artifacts are of different models, or if `p` is None and this process has
        not used their model
    """
    _require_same_model(query, match)
    p = p or _validation_parameters(query)
    return validate_geometry(query, match, seed, p, mode, matching, ups=ups, other_axes=other_axes)


def validate_guided(
    query: Geometry, match: Geometry, T_match_query: Floats, seed: int,
    p: ValidationParameters | None, ups: Ups,
) -> PairValidation | None:  # fmt: skip
    """Check a predicted transform T_match_query (4, 4): Sec. III-E.

    The transform is predicted by other matches and the map's poses; for the result, see
    `sceneprint.geometry.validation.validation.validate_guided`.

    Raises
    ------
    ModelMismatch : See `validate`
    """
    _require_same_model(query, match)
    return check_predicted(
        query, match, T_match_query, seed, p or _validation_parameters(query), ups
    )


def validate_without_up(
    query: Geometry, match: Geometry, seed: int, p: ValidationParameters | None, ups: Ups
) -> PairValidation | None:
    """Validate by the surfaces only, if no match of a query fits `up`: Sec. III-E.

    For the result, see `sceneprint.geometry.validation.validation.validate_without_up`.

    Raises
    ------
    ModelMismatch : See `validate`
    """
    _require_same_model(query, match)
    return check_up(query, match, seed, p or _validation_parameters(query), ups)


#: Parameters of the models that this process has used, by id. An artifact stores only the id.
_PARAMETERS: dict[str, tuple[ValidationParameters, AnswerParameters]] = {}


def _validation_parameters(geometry: Geometry) -> ValidationParameters:
    """Return the validation parameters of an artifact's model."""
    _learn_presets(geometry.model_id)
    if geometry.model_id not in _PARAMETERS:
        raise ModelMismatch(
            f"The artifacts are of model {geometry.model_id[:12]}, which is not a preset and has "
            "not been used by this process. Pass `p`, its `model.parameters.validation`."
        )
    return _PARAMETERS[geometry.model_id][0]


def answer_parameters(geometry: Geometry) -> AnswerParameters:
    """Return the answer parameters of an artifact's model, or the defaults if it is unknown."""
    _learn_presets(geometry.model_id)
    parameters = _PARAMETERS.get(geometry.model_id)
    return AnswerParameters() if parameters is None else parameters[1]


def _learn_presets(model_id: str) -> None:
    """Register the parameters of the presets if the model is unknown."""
    if model_id not in _PARAMETERS:
        for model in map(read_model, PRESETS):
            _PARAMETERS[model.id] = model.parameters.validation, model.answer


def _stack_vectors(signatures: Sequence[Signature]) -> Bytes:
    if not len(signatures):
        return np.empty((0, 0), np.uint8)
    return np.stack([signature.vector for signature in signatures])


def _require_same_model(a: Signature | Geometry, b: Signature | Geometry | Model) -> None:
    other = b.id if isinstance(b, Model) else b.model_id
    if a.model_id != other:
        raise ModelMismatch(
            f"Frames of different models cannot be compared: {a.model_id[:12]} and {other[:12]}. "
            "Sign both frames with one model."
        )


#: Default number of accepted matches per query; confidences are fitted for this number.
VERDICT_MATCHES = 5

#: Function that returns the parent frame and T_parent_sensor (4, 4) of a database row; None if the
#: row has no pose.
PoseOf = Callable[[int], tuple[str, Floats] | None]


@dataclass(frozen=True, eq=False)
class PairMatch:
    """A database frame, with its validation against a query.

    Parameters
    ----------
    index : row of the database
    distance, similarity : distance and similarity of the signatures
    """

    index: int
    distance: int
    similarity: float
    validation: PairValidation


def associate(
    query: Geometry,
    ranking: Ranking,
    among: Sequence[int],
    open_geometry: Callable[[int], Geometry | None],
    k: int = VERDICT_MATCHES,
    seed: int = 0,
    p: ValidationParameters | None = None,
    mode: Mode = "full",
    go_on: Callable[[], bool] = lambda: True,
    matching: Matching = "histograms",
    *,
    up: Floats | None = None,
    up_of: Callable[[int], Floats | None] = lambda _: None,
    pose_of: PoseOf = lambda _: None,
    validations: Mapping[int, PairValidation] | None = None,
    retry: bool = True,
) -> list[PairMatch]:
    """Validate candidates in the order of R until `k` matches are accepted: Sec. III-E.

    If two strong matches from different viewpoints agree on the query's pose, the map's poses
    predict the transforms of later candidates. A predicted transform is refined and checked; only
    if the check fails is the transform searched for. If no match is accepted, the first candidates
    are validated again without `up` (if it is known), and scans then with other axes.

    Parameters
    ----------
    query : geometry artifact
    ranking : R
    among : ascending positions in R to validate: C, or the first members of R
    open_geometry : function that returns the artifact of a row, or None to skip the row
    k : number of accepted matches at which to stop; at least 1
    seed, p, mode, matching : arguments of `validate`
    go_on : function that is called before each candidate; False ends the search
    up : (3,) unit vector that points up in the query's sensor frame; None if unknown
    up_of : function that returns `up` of a database row
    pose_of : see PoseOf; by default, no row has a pose, and every transform is searched for
    validations : existing validations, by row, which are reused
    retry : whether to validate the first candidates again if no match is accepted

    Returns
    -------
    matches : all validated candidates: C_vld first (`rank_accepted`), then candidates whose
        transforms fit but tilt against `up`, then the others

    Raises
    ------
    ModelMismatch : See `validate`
    ValueError : If k is below 1
    """
    if k < 1:
        raise ValueError(f"k is {k}. Request at least 1 match.")
    tried: list[PairMatch] = []
    accepted = 0
    for position in among:
        index = int(ranking.indices[position])
        validation = validations.get(index) if validations else None
        if validation is None and not go_on():
            break
        geometry = open_geometry(index)
        if geometry is None:
            continue
        ups = up, up_of(index)
        T = None
        if mode == "full" and validation is None:
            T = _predict_transform(tried, index, pose_of, answer_parameters(query).map)
        if T is not None:
            validation = validate_guided(query, geometry, T, seed, p, ups)
        if validation is None:
            validation = validate(query, geometry, seed, p, mode, matching, ups=ups)
        tried.append(
            PairMatch(
                index, int(ranking.distances[position]), float(ranking.similarities[position]),
                validation,
            )
        )  # fmt: skip
        accepted += validation.status == "accepted"
        if accepted == k:
            break
    if retry and not accepted and mode == "full":
        if up is not None:
            _retry_without_up(query, tried, open_geometry, seed, p, go_on)
        if all(match.validation.status != "accepted" for match in tried):
            _retry_tilted(query, tried, open_geometry, seed, p, go_on)
    first = rank_accepted([match.validation for match in tried])
    rest = [i for i in range(len(tried)) if i not in first]
    rest.sort(key=lambda i: not tried[i].validation.contradicts_up)
    return [tried[i] for i in [*first, *rest]]


def unguided_validations(matches: Sequence[PairMatch]) -> dict[int, PairValidation] | None:
    """Return the unguided validations, by row; None if no match was guided."""
    if not any(match.validation.guided for match in matches):
        return None
    return {m.index: m.validation for m in matches if not m.validation.guided}


#: Minimum number of strong matches, from different viewpoints, that guide other matches.
_GUIDES = 2


def _predict_transform(
    tried: Sequence[PairMatch], index: int, pose_of: PoseOf, p: MapParameters
) -> Floats | None:
    """Predict T_match_query of a candidate from its pose and the previous matches.

    Return None if the candidate has no pose, if too few of these matches are strong, or if an
    accepted or ambiguous match supports another pose.
    """
    own = pose_of(index)
    if own is None:
        return None
    voting, strong, viewpoints = [], [], []
    for match in tried:
        v, posed = match.validation, pose_of(match.index)
        if v.guided or v.T_match_query is None or posed is None or posed[0] != own[0]:
            continue
        T = posed[1] @ v.T_match_query
        if v.status != "rejected":
            voting.append(T)
        if v.strength == "strong":
            strong.append(T)
            viewpoints.append(posed[1])
    if len(strong) < _GUIDES:
        return None
    different = distinct_viewpoints(np.stack(viewpoints), p)
    if len(different) < _GUIDES:
        return None
    T_parent_query = average_poses(np.stack(strong)[different]).T
    if not at_place(np.stack(voting), T_parent_query, p).all():
        return None
    return inverse(own[1]) @ T_parent_query


#: Number of candidates to validate again if a scanner may not have been upright or `up` may be
#: wrong.
_TILTED_TRIES = 3


def _retry_tilted(
    query: Geometry, tried: list[PairMatch], open_geometry: Callable[[int], Geometry | None],
    seed: int, p: ValidationParameters | None, go_on: Callable[[], bool],
) -> None:  # fmt: skip
    """Validate the first candidates again, as if a scanner was on its side or upside down.

    Accepted results replace earlier ones in `tried`.
    """
    for place, before in enumerate(tried[:_TILTED_TRIES]):
        geometry = open_geometry(before.index)
        if geometry is None or not are_scans(query, geometry) or not go_on():
            return
        if _both_known(before.validation.ups):
            continue
        validation = validate(query, geometry, seed, p, other_axes=True)
        if validation.status == "accepted":
            tried[place] = replace(before, validation=validation)


def _both_known(ups: Ups) -> bool:
    return ups[0] is not None and ups[1] is not None


def _retry_without_up(
    query: Geometry, tried: list[PairMatch], open_geometry: Callable[[int], Geometry | None],
    seed: int, p: ValidationParameters | None, go_on: Callable[[], bool],
) -> None:  # fmt: skip
    """Validate the first candidates again without `up`, which may be wrong; update `tried`."""
    for place, before in enumerate(tried[:_TILTED_TRIES]):
        geometry, ups = open_geometry(before.index), before.validation.ups
        if geometry is None or not go_on():
            return
        if not _both_known(ups) and not are_scans(query, geometry):  # `up` had no effect
            continue
        validation = validate_without_up(query, geometry, seed, p, ups)
        if validation is not None:
            tried[place] = replace(before, validation=validation)
