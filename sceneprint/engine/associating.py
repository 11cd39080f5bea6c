"""A session against another, or against itself, frame by frame: a job in slices.

plan --> frame, frame, ... a slice at a time --> edges --conclude--> verdicts, joins
"""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from typing import Any

import numpy as np

from sceneprint.artifacts import read_geometry
from sceneprint.engine.concluding import conclude
from sceneprint.engine.healing import sign_again
from sceneprint.engine.readers import Readers
from sceneprint.engine.sides import Plan, eligible, runs_of
from sceneprint.engine.signers import Signers
from sceneprint.engine.slices import Outcome, Task
from sceneprint.engine.validating import thresholds
from sceneprint.engine.views import MapView
from sceneprint.errors import DamagedBlob, UnreadableGeometry
from sceneprint.geometry.diversity import diversify
from sceneprint.geometry.retrieval import Ranking, pairwise_distances, ranking_size, similarity
from sceneprint.matches import Match, associate
from sceneprint.models import Model
from sceneprint.schemas.associations import NewAssociation
from sceneprint.store import Store
from sceneprint.store.associations import stops_of
from sceneprint.store.frames import frames_of
from sceneprint.store.maps import find_map, unknown_map
from sceneprint.store.parts import items_of
from sceneprint.store.records import MapRow
from sceneprint.store.signatures import geometry_blobs, stored_signatures
from sceneprint.types import Geometry

#: Artifacts that a slice keeps opened, of some 600 kB each.
_OPENED = 64


class Associating:
    """The handler of the jobs.

    Parameters
    ----------
    store, signers, readers : of the engine
    """

    def __init__(self, store: Store, signers: Signers, readers: Readers) -> None:
        self._store, self._signers, self._readers = store, signers, readers

    def __call__(self, task: Task, until: float) -> Outcome:
        """A slice: at least one frame, or the conclusion."""
        asked = NewAssociation.model_validate(task.data)
        progress = dict(task.progress) or self._begin(task, asked)
        plan = Plan(progress["source"], progress["target"], progress["taken"])
        items: list[dict[str, Any]] = []
        opened = _Opened(self._store)
        while progress["done"] < len(plan.source):
            edges, tried = self._frame(task, asked, plan, progress["done"], opened)
            items += edges
            progress["validated"] += tried or 0
            progress["skipped"] += tried is None
            progress["done"] += 1
            if time.monotonic() >= until:
                return Outcome(False, progress, items)
        with self._store.database.read() as connection:
            found = items_of(connection, task.claim.job.number) + items
            stops = stops_of(connection, {*plan.source, *plan.target})
        end = conclude(found, plan.source, plan.target, stops, asked)
        result = {
            "frames": len(plan.source), "skipped": progress["skipped"],
            "validated": progress["validated"], "edges": len(found), **end.counts,
            "joins": end.joins,
        }  # fmt: skip
        return Outcome(
            True, progress, items + end.verdicts, result=result, event="association.found"
        )

    def _begin(self, task: Task, asked: NewAssociation) -> dict[str, Any]:
        runs = runs_of(self._store, task.of_map, asked)
        source, target = runs[0], runs[-1]
        return {
            "done": 0, "total": len(source), "validated": 0, "skipped": 0,
            "source": [stop.number for stop in source],
            "target": [stop.number for stop in target],
            "taken": [stop.captured_at for stop in source],
        }  # fmt: skip

    def _frame(
        self, task: Task, asked: NewAssociation, plan: Plan, place: int, opened: _Opened
    ) -> tuple[list[dict[str, Any]], int | None]:
        """Edges of one frame, and how many candidates were tried; None where it is gone."""
        number = plan.source[place]
        among = eligible(asked, plan, place)
        if not len(among):
            return [], 0
        row, model, view = self._view(task.of_map)
        with self._store.database.read() as connection:
            vectors = stored_signatures(connection, [number], row.model_id)
            alive = number in frames_of(connection, [number])
        geometry = opened.geometry(row, number)
        if number not in vectors or not alive or geometry is None:
            if alive:  # damaged, and made again behind this
                sign_again(self._store, row, [number], row.model_id)
            return [], None
        among = among[view.has(among)]
        hits = view.search(
            np.frombuffer(vectors[number], np.uint8), ranking_size(len(among)), dead=view.dead,
            among=among, exact=True,
        )  # fmt: skip
        if not len(hits):
            return [], 0
        shares = similarity(hits.distances, model.unrelated_distance)
        ranking = Ranking(hits.keys.astype(np.intp), hits.distances, shares)
        distances = pairwise_distances(view.signatures(hits.keys), view.metric)
        chosen = diversify(ranking.distances, distances, asked.candidates).indices.tolist()
        matches = associate(
            geometry, ranking, chosen, lambda key: opened.geometry(row, key), asked.k,
            asked.seed, *thresholds(asked.validation, model.parameters.validation),
        )  # fmt: skip
        order = {number: i for i, number in enumerate(ranking.indices.tolist())}
        accepted = sorted(
            (one for one in matches if one.validation.status == "accepted"),
            key=lambda one: order[one.index],
        )
        # a frame that is deleted from here on is left out where edges are told
        edges = [
            _item(number, one) for one in accepted if one.validation.overlap >= asked.min_overlap
        ]
        return edges, len(matches)

    def _view(self, of: MapRow) -> tuple[MapRow, Model, MapView]:
        """The map as it is now: frames of it may be deleted, and its model may change.

        Raises
        ------
        UnknownMap : it was deleted, whether or not another has its name.
        """
        row = of
        while True:  # its signer opened while no connection is held
            model = self._signers(row.model_id).model
            with self._store.database.read() as connection:
                row = find_map(connection, of.name)
                if row.number != of.number:
                    raise unknown_map(of.name)
                if row.model_id == model.id:
                    views = self._readers.views(connection, self._store.database, [row])
                    return row, model, views[0]


class _Opened:
    """Artifacts that were opened lately: frames near each other have the same candidates."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._held: OrderedDict[tuple[int, str], Geometry] = OrderedDict()

    def geometry(self, row: MapRow, number: int) -> Geometry | None:
        """The artifact of a frame; None where it is gone or damaged."""
        key = (number, row.model_id)
        if key not in self._held:
            with self._store.database.read() as connection:
                blob = geometry_blobs(connection, [number], row.model_id).get(number)
            if blob is None:
                return None
            try:
                self._held[key] = read_geometry(self._store.blobs.get(blob))
            except (DamagedBlob, UnreadableGeometry):  # one frame must not cost the others
                sign_again(self._store, row, [number], row.model_id)
                return None
        self._held.move_to_end(key)
        while len(self._held) > _OPENED:
            self._held.popitem(last=False)
        return self._held[key]


def _item(number: int, match: Match) -> dict[str, Any]:
    """An edge as it is kept."""
    v = match.validation
    T = np.eye(4) if v.T_match_query is None else v.T_match_query  # an accepted one has one
    return {
        "from": number, "to": match.index, "T": T.ravel().tolist(),
        "covariance": None if v.covariance is None else v.covariance.ravel().tolist(),
        "overlap": v.overlap, "residual_m": v.residual_m,
        "residual_deg": math.degrees(v.residual_rad), "strength": v.strength,
        "inliers": v.inliers, "ambiguity": v.ambiguity, "similarity": match.similarity,
    }  # fmt: skip
