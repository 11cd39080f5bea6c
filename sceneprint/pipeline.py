"""The paper's Fig. 1 as functions, one line a stage.

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
    return run_both(
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
    _NUMBERS[model.id] = p.validation, model.answer
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
    return replace(shown, spread=thin_points(points, SPREAD_POINTS, even / 12))


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
_NUMBERS: dict[str, tuple[ValidationParameters, AnswerParameters]] = {}


def _numbers_of(geometry: Geometry) -> ValidationParameters:
    """Return what the model of an artifact validates with: rooms and halls differ."""
    _learn_presets(geometry.model_id)
    if geometry.model_id not in _NUMBERS:
        raise ModelMismatch(
            f"The artifacts are of model {geometry.model_id[:12]}, which ships with no preset and "
            "has not been used by this process. Give `p`, its `model.parameters.validation`."
        )
    return _NUMBERS[geometry.model_id][0]


def answer_numbers(geometry: Geometry) -> AnswerParameters:
    """Return what the model of an artifact judges poses with.

    Those of the default preset, where this process has not used the model.
    """
    _learn_presets(geometry.model_id)
    known = _NUMBERS.get(geometry.model_id)
    return AnswerParameters() if known is None else known[1]


def _learn_presets(model_id: str) -> None:
    """Note the numbers of the presets, unless those of a model are known."""
    if model_id not in _NUMBERS:
        for model in map(read_model, PRESETS):
            _NUMBERS[model.id] = model.parameters.validation, model.answer


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


# What is made of a ranking's candidates: matches in the order to believe them.

#: Accepted matches that the pose of a query rests on: confidences are learnt with as many.
VERDICT_MATCHES = 5

#: Gives the parent frame and T_parent_sensor (4, 4) of a row of the database, if it has a pose.
PoseOf = Callable[[int], tuple[str, Floats] | None]


@dataclass(frozen=True, eq=False)
class PairMatch:
    """A database frame validated against a query.

    Parameters
    ----------
    index : row of the database
    distance, similarity : of the signatures
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
    known: Mapping[int, PairValidation] | None = None,
    retry: bool = True,
) -> list[PairMatch]:
    """Candidates validated in the order of R until `k` are accepted: Sec. III-E.

    Where two strong matches from different viewpoints agree on the query's pose, the transforms of
    later candidates follow from the map's poses: these are refined and checked, and searched for
    only where the check fails.

    Parameters
    ----------
    query : geometry artifact
    ranking : R
    among : positions in R to try, rising: C, or the first of R
    open_geometry : artifact of a row of the database; a row without one is passed over
    k : accepted ones after which to stop, at least 1
    seed, p, mode, matching : see `validate`, by default with the numbers of the model
    go_on : asked before each; where it says no, the rest is left
    up : (3,) unit vector in the query's sensor, where it is known
    up_of : the same of a row of the database
    pose_of : parent frame and T_parent_sensor (4, 4) of a row, None where it has no pose; default:
        none has, and every transform is searched for
    known : validations by row that are taken as they are
    retry : whether the first few are tried in other ways where nothing is accepted

    Returns
    -------
    matches : all that were tried, of scans the first few once more for other axes where nothing
        was accepted, and once more without `up` where that was known: C_vld first, strong before
        weak, then by expected error (of scans all around, the nearest first); then those that were
        not accepted, first those that fit but tilt against `up`

    Raises
    ------
    ModelMismatch : artifacts of two models.
    ValueError : k below 1.
    """
    if k < 1:
        raise ValueError(f"k = {k}: ask for 1 match or more")
    tried: list[PairMatch] = []
    accepted = 0
    for position in among:
        index = int(ranking.indices[position])
        validation = known.get(index) if known else None
        if validation is None and not go_on():
            break
        geometry = open_geometry(index)
        if geometry is None:
            continue
        ups = up, up_of(index)
        T = None
        if mode == "full" and validation is None:
            T = _predicted(tried, index, pose_of, answer_numbers(query).map)
        if T is not None:
            validation = validate_guided(query, geometry, T, seed, p, ups)
        if validation is None:
            validation = validate(query, geometry, seed, p, mode, matching, ups=ups)
        tried.append(
            PairMatch(
                index,
                int(ranking.distances[position]),
                float(ranking.similarities[position]),
                validation,
            )
        )
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


def searched(matches: Sequence[PairMatch]) -> dict[int, PairValidation] | None:
    """Validations that were searched for, by row; None where nothing was guided."""
    if not any(match.validation.guided for match in matches):
        return None
    return {m.index: m.validation for m in matches if not m.validation.guided}


#: Strong matches from different viewpoints that must agree on a pose before others follow from it.
_GUIDES = 2


def _predicted(
    tried: Sequence[PairMatch], index: int, pose_of: PoseOf, p: MapParameters
) -> Floats | None:
    """T_match_query of a candidate by its pose and the matches before; None where these leave it
    open: too few are strong, or one of them, accepted or ambiguous, is for another pose.
    """
    own = pose_of(index)
    if own is None:
        return None
    voting, strong, viewpoints = [], [], []
    for match in tried:
        v, known = match.validation, pose_of(match.index)
        if v.guided or v.T_match_query is None or known is None or known[0] != own[0]:
            continue
        T = known[1] @ v.T_match_query
        if v.status != "rejected":
            voting.append(T)
        if v.strength == "strong":
            strong.append(T)
            viewpoints.append(known[1])
    if len(strong) < _GUIDES:
        return None
    different = distinct_viewpoints(np.stack(viewpoints), p)
    if len(different) < _GUIDES:
        return None
    T_parent_query = average_poses(np.stack(strong)[different]).T
    if not at_place(np.stack(voting), T_parent_query, p).all():
        return None
    return inverse(own[1]) @ T_parent_query


#: Candidates that are tried again for a scanner that did not stand upright, or for a wrong `up`.
_TILTED_TRIES = 3


def _retry_tilted(
    query: Geometry, tried: list[PairMatch], open_geometry: Callable[[int], Geometry | None],
    seed: int, p: ValidationParameters | None, go_on: Callable[[], bool],
) -> None:  # fmt: skip
    """Validate the first candidates as scans of a scanner on its side or upside down.

    What is accepted now replaces what was tried before, in place.
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
    """Ask the surfaces of the first candidates alone whether `up` may be wrong, in place."""
    for place, before in enumerate(tried[:_TILTED_TRIES]):
        geometry, ups = open_geometry(before.index), before.validation.ups
        if geometry is None or not go_on():
            return
        if not _both_known(ups) and not are_scans(query, geometry):  # it took no part
            continue
        validation = validate_without_up(query, geometry, seed, p, ups)
        if validation is not None:
            tried[place] = replace(before, validation=validation)
