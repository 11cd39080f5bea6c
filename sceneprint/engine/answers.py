"""A query to its answer: R, C, C_vld, and the pose of the query.

signature, Geometry, View  --answer-->  Answer
"""

from __future__ import annotations

import time
import uuid
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from sceneprint.artifacts import read_geometry
from sceneprint.engine.asking import Asked
from sceneprint.engine.healing import sign_again
from sceneprint.engine.readers import View
from sceneprint.engine.telling import Found, tell_location, tell_matches
from sceneprint.errors import DamagedBlob, UnreadableGeometry
from sceneprint.geometry.diversity import Selection, diversify
from sceneprint.geometry.retrieval import Ranking, pairwise_distances, ranking_size, similarity
from sceneprint.index import search, signatures_of
from sceneprint.index.keys import Keys
from sceneprint.matches import Match, associate
from sceneprint.models import Model
from sceneprint.schemas import Answer, AnswerStatus, Counts, Filter, Query
from sceneprint.store import Store
from sceneprint.store.filters import passing
from sceneprint.store.frames import frames_of
from sceneprint.store.records import MapRow
from sceneprint.store.signatures import geometry_blobs
from sceneprint.types import Geometry

#: Candidates that are selected and validated, unless more matches are wanted: more cost time.
CANDIDATES = 10
#: Frames up to which a map is compared whole: a shortlist saves next to nothing there.
WHOLE = 4000


@dataclass
class _Clock:
    """Milliseconds of each stage, one after the other."""

    spent: dict[str, float]
    _since: float = field(default_factory=time.perf_counter)

    def stage(self, name: str) -> None:
        now = time.perf_counter()
        self.spent[name] = round(1e3 * (now - self._since), 2)
        self._since = now


def answer(
    store: Store, row: MapRow, model: Model, view: View, asked: Asked, query: Query
) -> Answer:
    """Ask a map.

    Parameters
    ----------
    store : see Store
    row, model : of the map
    view : of the map
    asked, query : what is sought, and how
    """
    sign_again(store, row, sorted(view.damaged), row.model_id)
    clock = _Clock({"prepare": round(asked.prepare_ms, 2)})
    dead = view.dead if asked.frame is None else view.dead | {asked.frame[0]}
    size = max(view.size - (asked.frame is not None), 0)  # it may just have been deleted
    among = None if query.filter is None else _among(store, row, view, dead, asked, query.filter)
    passed = size if among is None else len(among)
    hits = search(
        asked.vector, view.generation, view.tail, ranking_size(passed), dead=dead, among=among,
        exact=query.exact or passed <= WHOLE,
    )  # fmt: skip
    shares = similarity(hits.distances, model.unrelated_distance)
    ranking = Ranking(hits.keys.astype(np.intp), hits.distances, shares)
    clock.stage("retrieve")
    wanted = max(CANDIDATES, query.k) if "validate" in query.stages else query.k
    selection = _selection(view, ranking, wanted) if "diversify" in query.stages else None
    clock.stage("diversify")
    chosen = range(min(wanted, len(ranking))) if selection is None else selection.indices.tolist()
    matches, unreadable = _validated(store, row, ranking, chosen, asked.geometry, query)
    clock.stage("validate")
    clock.spent["total"] = round(sum(clock.spent.values()), 2)
    with store.database.read() as connection:
        rows = frames_of(connection, ranking.indices[list(chosen)].tolist())
    matches = [match for match in matches if match.index in rows]  # the rest was deleted meanwhile
    found = Found(row.name, ranking, selection, rows, unreadable, asked.frame)
    statuses = [match.validation.status for match in matches]
    return Answer(
        query_id=uuid.uuid4().hex,
        status=_status(statuses) if "validate" in query.stages else "unvalidated",
        matches=tell_matches(found, chosen, matches, validated="validate" in query.stages),
        location=tell_location(found, matches),
        seed=query.seed,
        model=model.label,
        index_generation=0 if view.generation is None else view.generation.number,
        exact=hits.exact,
        counts=Counts(
            map=size,
            passed=passed,
            compared=hits.compared,
            ranked=len(ranking),
            selected=0 if selection is None else len(selection.indices),
            validated=len(matches),
            accepted=statuses.count("accepted"),
        ),
        milliseconds=clock.spent,
    )


def _among(
    store: Store, row: MapRow, view: View, dead: frozenset[int], asked: Asked, wanted: Filter
) -> Keys:
    """Frames of a view that pass a filter; the database may be newer or older than the view."""
    with store.database.read() as connection:
        numbers = passing(connection, row.number, wanted, asked.taken)
    known = view.tail.places.of(numbers) >= 0
    if view.generation is not None:
        known |= view.generation.places.of(numbers) >= 0
    return numbers[known & ~np.isin(numbers, list(dead))]


def _selection(view: View, ranking: Ranking, wanted: int) -> Selection:
    """C, from the stored signatures of R."""
    rows = signatures_of(ranking.indices.astype(np.int64), view.generation, view.tail)
    return diversify(ranking.distances, pairwise_distances(rows), wanted)


def _validated(
    store: Store, row: MapRow, ranking: Ranking, chosen: Sequence[int],
    query_geometry: Geometry | None, query: Query,
) -> tuple[list[Match], dict[int, str]]:  # fmt: skip
    """Candidates tried in the order of R, and those whose artifact cannot be read."""
    if query_geometry is None:
        return [], {}
    with store.database.read() as connection:
        numbers = ranking.indices[list(chosen)].tolist()
        blobs = geometry_blobs(connection, numbers, row.model_id)
    opened: dict[int, Geometry] = {}
    unreadable: dict[int, str] = {}
    for number, blob in blobs.items():  # those deleted in the meantime are not among them
        try:
            opened[number] = read_geometry(store.blobs.get(blob))
        except (DamagedBlob, UnreadableGeometry) as error:  # one frame must not cost the answer
            unreadable[number] = str(error)
    sign_again(store, row, sorted(unreadable), row.model_id)
    among = [i for i in chosen if int(ranking.indices[i]) in opened]
    matches = associate(query_geometry, ranking, among, opened.__getitem__, query.k, query.seed)
    return matches, unreadable


def _status(statuses: Sequence[str]) -> AnswerStatus:
    if "accepted" in statuses:
        return "found"
    return "ambiguous" if "ambiguous" in statuses else "not_found"
