"""What is made of a ranking's candidates: matches in the order to believe them.

candidates of R  --associate-->  matches, C_vld first
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

from sceneprint.geometry.retrieval.distance import Ranking
from sceneprint.geometry.validation.acceptance import Mode
from sceneprint.geometry.validation.alignment import are_scans
from sceneprint.geometry.validation.association import preferred
from sceneprint.geometry.validation.gravity import Ups
from sceneprint.geometry.validation.sequence_alignment import Matching
from sceneprint.geometry.validation.validation import PairValidation, ValidationParameters
from sceneprint.pipeline import validate, validate_without_up
from sceneprint.types import Floats, Geometry


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
) -> list[PairMatch]:
    """Candidates validated in the order of R until `k` are accepted: Sec. III-E.

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
        if not go_on():
            break
        index = int(ranking.indices[position])
        geometry = open_geometry(index)
        if geometry is None:
            continue
        ups = up, up_of(index)
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
    if not accepted and mode == "full":
        if up is not None:
            _retry_without_up(query, tried, open_geometry, seed, p, go_on)
        if all(match.validation.status != "accepted" for match in tried):
            _retry_tilted(query, tried, open_geometry, seed, p, go_on)
    first = preferred([match.validation for match in tried])
    rest = [i for i in range(len(tried)) if i not in first]
    rest.sort(key=lambda i: not tried[i].validation.contradicts_up)
    return [tried[i] for i in [*first, *rest]]


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
