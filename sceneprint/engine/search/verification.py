"""Candidates of R to matches, C_vld first, until enough are accepted or time is up: Sec. III-E.

query Geometry, candidates  --validated-->  Validated
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from sceneprint.engine.search.gravity import known_ups
from sceneprint.engine.search.retrieval import Deadline, Searched
from sceneprint.engine.upkeep.repair import resign_frames
from sceneprint.errors import DamagedBlob, UnreadableGeometry
from sceneprint.formats.artifact import read_geometry
from sceneprint.geometry.validation.acceptance import Mode
from sceneprint.geometry.validation.validation import ValidationParameters
from sceneprint.matches import PairMatch, associate
from sceneprint.store import Store
from sceneprint.store.signatures import geometry_blobs
from sceneprint.types import Floats, Geometry
from sceneprint_client.api import Query, ValidationOptions

#: Candidates that are selected and validated, unless more matches are wanted: more cost time.
CANDIDATES = 10
#: What stands in the place of a limit where nothing is known of free space: what a caller says of
#: the one is meant of the other too.
_BLIND = {
    "evidence": "blind_evidence", "plane_overlap": "blind_plane_overlap",
    "ambiguous_share": "blind_ambiguous_share",
}  # fmt: skip
#: Why no candidate was tried where validation was not asked for.
NOT_ASKED = "not requested"


@dataclass(frozen=True, eq=False)
class Validated:
    """What came of the candidates.

    Parameters
    ----------
    chosen : positions in R of the candidates
    matches : those that were tried, of `associate`
    unreadable : numbers of frames whose artifact cannot be read, and why
    untried : why the others were not tried
    late : whether the deadline came before the last of them; None without a deadline
    """

    chosen: Sequence[int]
    matches: list[PairMatch]
    unreadable: dict[int, str]
    untried: str
    late: bool | None


def wanted_of(query: Query) -> int:
    """How many candidates a query asks for."""
    if "validate" not in query.stages:
        return query.k
    return query.candidates or max(CANDIDATES, query.k)


def thresholds(
    given: ValidationOptions | None, p: ValidationParameters
) -> tuple[ValidationParameters, Mode]:
    """What a validation is done with, as `validate` takes it: the model's `p`, but for what was
    given.
    """
    if given is None:
        return p, "full"
    own = given.model_dump(exclude={"mode", "residual_deg"}, exclude_unset=True)
    if "residual_deg" in given.model_fields_set:
        own["residual_rad"] = math.radians(given.residual_deg)
    own |= {blind: own[name] for name, blind in _BLIND.items() if name in own}
    return replace(p, acceptance=replace(p.acceptance, **own)), given.mode


def validated(
    store: Store, searched: Searched, chosen: Sequence[int], geometry: Geometry | None,
    query: Query, deadline: Deadline, p: ValidationParameters, up: Floats | None = None,
) -> Validated:  # fmt: skip
    """Try candidates in the order of R.

    Parameters
    ----------
    store : see Store
    searched : see Searched
    chosen : positions in R of the candidates
    geometry : of the query; None where validation was not asked for
    query, deadline : see there
    p : of the model
    up : (3,) in the query's sensor, where it is known
    """
    if geometry is None:
        return Validated(chosen, [], {}, NOT_ASKED, deadline.reached)
    ranking, model_id = searched.ranking, searched.parts[0].place.row.model_id
    with store.queried.read() as connection:
        blobs = geometry_blobs(connection, ranking.indices[list(chosen)].tolist(), model_id)
        ups = {} if up is None else known_ups(connection, ranking.indices.tolist())
    unreadable: dict[int, str] = {}

    def open_geometry(number: int) -> Geometry | None:
        if number not in blobs:  # deleted in the meantime
            return None
        try:  # when its turn comes: 200 at once would be 125 MB
            return read_geometry(store.blobs.get(blobs[number]))
        except (DamagedBlob, UnreadableGeometry) as error:  # one frame must not cost the answer
            unreadable[number] = str(error)
            return None

    matches = associate(
        geometry, ranking, chosen, open_geometry, query.k, query.seed,
        *thresholds(query.validation, p), deadline.allows, up=up, up_of=ups.get,
    )  # fmt: skip
    owner = dict(zip(ranking.indices.tolist(), searched.owners.tolist(), strict=True))
    for i, part in enumerate(searched.parts):
        bad = sorted(number for number in unreadable if owner[number] == i)
        resign_frames(store, part.place.row, bad, model_id)
    late = deadline.reached
    untried = (
        "the deadline passed before it was validated"
        if late
        else "enough matches were accepted before it"
    )
    return Validated(chosen, matches, unreadable, untried, late)
