"""Why one frame is, or is not, among the matches of a query.

frame id, Searched, Validated  --why-->  ExplainedFrame
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from sceneprint.artifacts import read_geometry
from sceneprint.engine.asking import Asked
from sceneprint.engine.deadlines import Deadline
from sceneprint.engine.explaining import figures
from sceneprint.engine.searching import Part, Searched, rank_among_all
from sceneprint.engine.telling import Found, tell_validation
from sceneprint.engine.transforms import transform
from sceneprint.engine.validating import Validated, thresholds
from sceneprint.engine.wire import sensor_of
from sceneprint.errors import DamagedBlob, UnknownFrame, UnreadableGeometry
from sceneprint.geometry.retrieval import distances, similarity
from sceneprint.geometry.validation import Validation
from sceneprint.models import Model
from sceneprint.pipeline import validate
from sceneprint.schemas import ExplainedFrame, FrameState, Query
from sceneprint.schemas import Validation as ToldValidation
from sceneprint.schemas.explanations import Lost
from sceneprint.store import Store
from sceneprint.store.frames import find_frame
from sceneprint.store.records import FrameRow
from sceneprint.store.signatures import geometry_blobs


@dataclass(frozen=True, eq=False)
class Asking:
    """A query that was answered, as far as one frame is asked about.

    Parameters
    ----------
    store : see Store
    searched, asked, query, found, tried : of the query
    model : of the maps
    deadline : no frame is validated for this after it
    """

    store: Store
    searched: Searched
    asked: Asked
    query: Query
    found: Found
    tried: Validated
    model: Model
    deadline: Deadline


def why(asking: Asking, frame_id: str) -> ExplainedFrame:
    """Where a frame was lost, and what would have come of it.

    Raises
    ------
    UnknownFrame : no map that is asked has one of that id.
    """
    part, row = _found(asking, frame_id)
    absent = _absent(asking, part, row)
    name = part.place.row.name
    if absent is not None:
        return ExplainedFrame(
            frame_id=row.id, map=name, state=row.state, passes_filter=None, distance=None,
            similarity=None, rank=None, of=None, shortlisted=None, ranked=None, selected=None,
            validation=None, transform=None, lost_at=absent[0], reason=absent[1],
        )  # fmt: skip
    view, number = part.place.view, np.array([row.number], np.int64)
    stored = view.signatures(number)
    distance = distances(asking.asked.vector, stored, view.metric)
    rank = rank_among_all(asking.searched, asking.asked, row.number, int(distance[0]))
    at = np.flatnonzero(asking.searched.ranking.indices == row.number).tolist()
    passes = part.among is None or row.number in part.among
    # an approximate index cannot be asked what it compared: what it should have ranked, it did not
    missed = not at and passes and not asking.searched.exact and rank <= asking.searched.size
    selected = bool(at) and at[0] in asking.tried.chosen
    validation, T = _aligned(asking, part, row)
    if missed:
        index = "the index" if view.kind == "local" else "pgvector in the database"
        lost: Lost | None = "shortlist"
        reason = f"{index} missed it, though it has rank {rank}: ask with `exact`"
    else:
        lost, reason = _lost(asking, row, rank, passes, bool(at), selected)
    early = lost not in (None, "validation")
    if early and validation is not None and validation.status != "skipped":
        reason += f"; aligned for this all the same, it is {figures(validation)}"
    return ExplainedFrame(
        frame_id=row.id,
        map=name,
        state=row.state,
        passes_filter=passes,
        distance=int(distance[0]),
        similarity=float(similarity(distance, asking.model.unrelated_distance)[0]),
        rank=rank,
        of=sum(one.passed for one in asking.searched.parts),
        shortlisted=not missed,
        ranked=bool(at),
        selected=selected,
        validation=validation,
        transform=(
            None if T is None
            else transform(T, sensor_of(row), asking.found.query_frame)
        ),
        lost_at=lost,
        reason=reason,
    )  # fmt: skip


def _found(asking: Asking, frame_id: str) -> tuple[Part, FrameRow]:
    """The frame, and what is searched of its map: the first that has one which can be found."""
    parts, own = asking.searched.parts, asking.asked.frame
    held, missing = [], None
    with asking.store.queried.read() as connection:
        for part in parts:
            try:
                held.append((part, find_frame(connection, part.place.row, frame_id)))
            except UnknownFrame as error:
                missing = error
    if missing is not None and not held:
        raise missing
    # another map may have had one of that id, or have the query itself under it
    return min(
        held,
        key=lambda one: (
            one[1].state != FrameState.INDEXED,
            own is not None and one[1].number == own[0],
        ),
    )


def _absent(asking: Asking, part: Part, row: FrameRow) -> tuple[Lost, str] | None:
    """Why a frame is not searched at all."""
    view, asked = part.place.view, asking.asked
    if asked.frame is not None and asked.frame[0] == row.number:
        return "query", "it is the query itself, which does not find itself"
    if row.state != FrameState.INDEXED:
        return "state", f"it is {row.state}: {row.state.sentence}"
    if row.number in view.damaged:
        return "state", "its signature is damaged, and is made again from its upload"
    number = np.array([row.number], np.int64)
    if not view.has(number)[0]:
        return "state", "it was indexed while the query ran. Ask again"
    return None


def _lost(
    asking: Asking, row: FrameRow, rank: int, passes: bool, ranked: bool, selected: bool
) -> tuple[Lost | None, str]:
    """Where, and why in words."""
    size, tried = len(asking.searched.ranking), asking.tried
    if not passes:
        return "filter", "it does not pass the filter"
    if not ranked:
        return "ranking", f"it has rank {rank}, and {size} frames are ranked"
    if not selected:
        return "selection", (
            f"it has rank {rank}, and is none of the {len(tried.chosen)} candidates: ask with "
            "more `candidates`, or with `explain` for whom it is like"
        )
    status = {match.index: match.validation for match in tried.matches}.get(row.number)
    if status is not None and status.status == "accepted":
        return None, f"it is a match, {figures(tell_validation(status))}"
    if status is not None:
        return "validation", figures(tell_validation(status))
    if "validate" not in asking.query.stages:
        return None, f"it is a match, of rank {rank}; validation was not asked for"
    if row.number in tried.unreadable:
        return "validation", tried.unreadable[row.number]
    return "deadline" if tried.late else "turn", tried.untried


def _aligned(
    asking: Asking, part: Part, row: FrameRow
) -> tuple[ToldValidation | None, np.ndarray | None]:
    """What aligning the query with a frame comes to, whether or not the query did."""
    geometry = asking.asked.geometry
    if geometry is None:
        return None, None
    known: dict[int, Validation] = {one.index: one.validation for one in asking.tried.matches}
    made = known.get(row.number)
    if made is None:
        if not asking.deadline.allows():
            return ToldValidation(status="skipped", reason="the deadline came before it"), None
        model_id = part.place.row.model_id
        with asking.store.queried.read() as connection:
            blob = geometry_blobs(connection, [row.number], model_id).get(row.number)
        if blob is None:
            return ToldValidation(status="skipped", reason="it was deleted meanwhile"), None
        try:
            own = read_geometry(asking.store.blobs.get(blob))
        except (DamagedBlob, UnreadableGeometry) as error:
            return ToldValidation(status="skipped", reason=str(error)), None
        query = asking.query
        p = asking.model.parameters.validation
        made = validate(geometry, own, query.seed, *thresholds(query.validation, p))
    return tell_validation(made), made.T_match_query
