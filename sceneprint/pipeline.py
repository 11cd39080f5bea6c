"""The paper's Fig. 1 as functions, one line a stage.

frame --prepare--> signature, geometry
signature, database --retrieve--> R --diversify--> C --associate--> C_vld --locate--> pose
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from sceneprint.errors import ModelMismatch
from sceneprint.geometry.association import preferred, voters
from sceneprint.geometry.averaging import PoseAverage, average_poses
from sceneprint.geometry.diversity import DiversityParameters, Selection
from sceneprint.geometry.diversity import diversify as select
from sceneprint.geometry.retrieval import (
    Ranking,
    distances,
    pairwise_distances,
    rank,
    ranking_size,
)
from sceneprint.geometry.segmentation import patches_of, segment
from sceneprint.geometry.surroundings import compress, surroundings
from sceneprint.geometry.validation import Mode, Validation, ValidationParameters
from sceneprint.geometry.validation import validate as validate_geometry
from sceneprint.models import Model
from sceneprint.signing import Signature, Signer, encode, hierarchy_of, open_signer, see
from sceneprint.types import Bytes, Floats, Frame, Geometry, Surface

__all__ = [
    "Location",
    "Match",
    "Signature",
    "Signer",
    "associate",
    "distance",
    "diversify",
    "geometry_of",
    "locate",
    "open_signer",
    "prepare",
    "retrieve",
    "sign",
    "validate",
]


@dataclass(frozen=True, eq=False)
class Match:
    """A database frame validated against a query.

    Parameters
    ----------
    index : row of the database
    distance, similarity : of the signatures
    validation : see Validation
    """

    index: int
    distance: int
    similarity: float
    validation: Validation


@dataclass(frozen=True, eq=False)
class Location:
    """Where a query was taken.

    Parameters
    ----------
    parent : frame in which the pose is given
    average : T_parent_query with the spread of the votes and how many agree
    """

    parent: str
    average: PoseAverage


def sign(frame: Frame, signer: Signer) -> Signature:
    """The signature psi of a frame: Sec. III-A, III-B, III-F.

    Parameters
    ----------
    frame : depth in metres
    signer : see `open_signer`

    Raises
    ------
    UselessFrame : nothing within the sensor's range, or no two patches to relate.
    """
    p = signer.model.parameters
    return encode(hierarchy_of(see(frame, p), p, frame.name), signer, frame.name)


def prepare(frame: Frame, signer: Signer) -> tuple[Signature, Geometry]:
    """Signature and geometry artifact of a frame, of one look at its surface.

    Raises
    ------
    UselessFrame : see `sign`.
    """
    p = signer.model.parameters
    seen = see(frame, p)
    signature = encode(hierarchy_of(seen, p, frame.name), signer, frame.name)
    return signature, geometry_of(seen, signer.model)


def geometry_of(seen: Surface, model: Model) -> Geometry:
    """The geometry artifact of a surface: what validation needs of it, Sec. III-E.

    Parameters
    ----------
    seen : of `sceneprint.signing.see`
    model : whose parameters and compression are used
    """
    p = model.parameters
    patches = patches_of(seen, segment(seen, p.validation_segmentation))
    histograms = surroundings(patches, p.surroundings)
    return Geometry(seen, patches, compress(histograms, model.compression), model.id)


def distance(a: Signature, b: Signature) -> int:
    """L1 distance of two stored signatures, in units of a byte: -s(X, Y) of Sec. III-C.

    Raises
    ------
    ModelMismatch : they are of two models.
    """
    _same_model(a, b)
    return int(distances(a.vector, b.vector[None])[0])


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
    ModelMismatch : signatures of several models.
    """
    for one in database:
        _same_model(query, one)
    size = ranking_size(len(database)) if size is None else size
    stored = _stacked(database) if database else np.empty((0, len(query.vector)), np.uint8)
    return rank(distances(query.vector, stored), size, model.unrelated_distance)


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
    among = pairwise_distances(_stacked([database[i] for i in ranking.indices]))
    return select(ranking.distances, among, k, p)


def validate(
    query: Geometry,
    match: Geometry,
    seed: int = 0,
    p: ValidationParameters | None = None,
    mode: Mode = "full",
) -> Validation:
    """Whether two frames see one place, and the transform between them: Sec. III-E.

    Parameters
    ----------
    query, match : geometry artifacts of one model
    seed : of the random choices; the answer echoes it
    p : see ValidationParameters
    mode : "full", or "paper" for the paper's test alone

    Raises
    ------
    ModelMismatch : the artifacts are of two models.
    """
    _same_model(query, match)
    return validate_geometry(query, match, seed, p, mode)


def associate(
    query: Geometry,
    ranking: Ranking,
    among: Sequence[int],
    open_geometry: Callable[[int], Geometry],
    k: int = 5,
    seed: int = 0,
    p: ValidationParameters | None = None,
    mode: Mode = "full",
) -> list[Match]:
    """Candidates validated in the order of R until `k` are accepted: Sec. III-E.

    Parameters
    ----------
    query : geometry artifact
    ranking : R
    among : positions in R to try, rising: C, or the first of R
    open_geometry : artifact of a row of the database
    k : accepted ones after which to stop, at least 1
    seed, p, mode : see `validate`

    Returns
    -------
    matches : all that were tried: C_vld first, strong before weak, each in the order of R; then
        those that were not accepted

    Raises
    ------
    ModelMismatch : artifacts of two models.
    ValueError : k below 1.
    """
    if k < 1:
        raise ValueError(f"k = {k}: ask for 1 match or more")
    tried: list[Match] = []
    accepted = 0
    for position in among:
        index = int(ranking.indices[position])
        validation = validate(query, open_geometry(index), seed, p, mode)
        tried.append(
            Match(
                index,
                int(ranking.distances[position]),
                float(ranking.similarities[position]),
                validation,
            )
        )
        accepted += validation.status == "accepted"
        if accepted == k:
            break
    first = preferred([match.validation for match in tried])
    rest = [i for i in range(len(tried)) if i not in first]
    return [tried[i] for i in [*first, *rest]]


def locate(
    matches: Sequence[Match],
    poses: Sequence[Floats],
    parents: Sequence[str] | None = None,
    views: int = 5,
) -> Location | None:
    """Pose of the query: robust average over up to five validated views.

    Parameters
    ----------
    matches : of `associate`
    poses : T_parent_sensor (4, 4) of every row of the database
    parents : parent frame of every row; default: one for all. Poses are combined within one
        parent frame only, that of most of the matches
    views : most that are averaged

    Returns
    -------
    location : or None where nothing was accepted
    """
    accepted = [m for m in matches if m.validation.status == "accepted"]
    names = [parents[m.index] if parents is not None else "" for m in accepted]
    chosen = voters(names, [m.validation.strength == "strong" for m in accepted], views)
    transforms = [(accepted[i].index, accepted[i].validation.T_match_query) for i in chosen]
    votes = [poses[index] @ T for index, T in transforms if T is not None]
    if not votes:
        return None
    return Location(names[chosen[0]], average_poses(np.stack(votes)))


def _stacked(signatures: Sequence[Signature]) -> Bytes:
    if not signatures:
        return np.empty((0, 0), np.uint8)
    return np.stack([one.vector for one in signatures])


def _same_model(a: Signature | Geometry, b: Signature | Geometry) -> None:
    if a.model_id != b.model_id:
        raise ModelMismatch(
            f"Frames of two models cannot be compared: {a.model_id[:12]} and "
            f"{b.model_id[:12]}. Sign both frames with one model."
        )
