"""What is made of a ranking's candidates: matches in the order to believe them, and a place.

candidates of R  --associate-->  matches, C_vld first  --locate-->  pose of the query
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sceneprint.geometry.acceptance import Mode
from sceneprint.geometry.association import preferred, voters
from sceneprint.geometry.averaging import PoseAverage, average_poses
from sceneprint.geometry.retrieval import Ranking
from sceneprint.geometry.validation import Validation, ValidationParameters
from sceneprint.pipeline import validate
from sceneprint.types import Floats, Geometry


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
    poses: Sequence[Floats] | Mapping[int, Floats],
    parents: Sequence[str] | Mapping[int, str] | None = None,
    views: int = 5,
) -> Location | None:
    """Pose of the query: robust average over up to five validated views.

    Parameters
    ----------
    matches : of `associate`
    poses : T_parent_sensor (4, 4) of every row of the database, or by the rows of the matches
    parents : parent frame of every row; default: one for all. Poses are combined within one
        parent frame only, that of most of the matches
    views : most that are averaged, at least 1

    Returns
    -------
    location : or None where nothing was accepted

    Raises
    ------
    ValueError : views below 1.
    """
    if views < 1:
        raise ValueError(f"views = {views}: average 1 view or more")
    accepted = [m for m in matches if m.validation.status == "accepted"]
    names = [parents[m.index] if parents is not None else "" for m in accepted]
    chosen = voters(names, [m.validation.strength == "strong" for m in accepted], views)
    transforms = [(accepted[i].index, accepted[i].validation.T_match_query) for i in chosen]
    votes = [poses[index] @ T for index, T in transforms if T is not None]
    if not votes:
        return None
    return Location(names[chosen[0]], average_poses(np.stack(votes)))
