"""What is made of a ranking's candidates: matches in the order to believe them.

candidates of R  --associate-->  matches, C_vld first
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from sceneprint.geometry.registration.alignment import are_scans
from sceneprint.geometry.registration.gravity import Ups
from sceneprint.geometry.registration.sequence_alignment import Matching
from sceneprint.geometry.retrieval.distance import Ranking
from sceneprint.geometry.rigid import average_poses, inverse
from sceneprint.geometry.validation.acceptance import Mode
from sceneprint.geometry.validation.map_verification import (
    MapParameters,
    at_place,
    different_views,
)
from sceneprint.geometry.validation.match_ranking import preferred
from sceneprint.geometry.validation.validation import PairValidation, ValidationParameters
from sceneprint.pipeline import validate, validate_guided, validate_without_up
from sceneprint.types import Floats, Geometry

#: Gives the parent frame and T_parent_sensor (4, 4) of a row of the database, if it has a pose.
PoseOf = Callable[[int], tuple[str, Floats] | None]


@dataclass(frozen=True, eq=False)
class PairMatch:
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
    validation: PairValidation


def associate(
    query: Geometry,
    ranking: Ranking,
    among: Sequence[int],
    open_geometry: Callable[[int], Geometry | None],
    k: int = 5,
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
        T = _predicted(tried, index, pose_of) if mode == "full" and validation is None else None
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
    first = preferred([match.validation for match in tried])
    rest = [i for i in range(len(tried)) if i not in first]
    rest.sort(key=lambda i: not tried[i].validation.contradicts_up)
    return [tried[i] for i in [*first, *rest]]


def searched(matches: Sequence[PairMatch]) -> dict[int, PairValidation] | None:
    """Validations that were searched for, by row, for `associate` to search for the rest as well;
    None where nothing was guided.
    """
    if not any(match.validation.guided for match in matches):
        return None
    return {m.index: m.validation for m in matches if not m.validation.guided}


#: Strong matches from different viewpoints that must agree on a pose before others follow from it.
_GUIDES = 2


def _predicted(tried: Sequence[PairMatch], index: int, pose_of: PoseOf) -> Floats | None:
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
    p = MapParameters()
    different = different_views(np.stack(viewpoints), p)
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
