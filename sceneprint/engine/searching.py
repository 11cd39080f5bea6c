"""A query to R, one ranking over all maps that are asked: Sec. III-C.

signature, Places  --search_maps-->  Searched
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from sceneprint.engine.asking import Asked
from sceneprint.engine.stored import Stored, search_stored
from sceneprint.engine.views import MapView
from sceneprint.geometry.retrieval import Ranking, ranking_size, similarity
from sceneprint.index import Hits
from sceneprint.index.keys import Keys
from sceneprint.models import Model
from sceneprint.schemas import Filter, Query
from sceneprint.store import Store
from sceneprint.store.filters import passing
from sceneprint.store.records import MapRow
from sceneprint.types import Bytes


@dataclass(frozen=True, eq=False)
class Place:
    """A map that is asked: its row, and its frames as of one revision."""

    row: MapRow
    view: MapView


@dataclass(frozen=True, eq=False)
class Part:
    """What is searched of one map.

    Parameters
    ----------
    place : the map
    dead : frames that may not be found: deleted ones, and the query itself
    among : frames that pass the filter; None without one
    size : frames that can be found
    """

    place: Place
    dead: frozenset[int]
    among: Keys | None
    size: int

    @property
    def passed(self) -> int:
        """How many pass the filter; all without one."""
        return self.size if self.among is None else len(self.among)


@dataclass(frozen=True, eq=False)
class Searched:
    """R, and where it is from.

    Parameters
    ----------
    parts : of each map
    hits : of each map, in the same order
    ranking : R, of frame numbers
    owners : (r,) which part each of R is of
    size : that R was to have
    """

    parts: tuple[Part, ...]
    hits: tuple[Hits, ...]
    ranking: Ranking
    owners: NDArray[np.intp]
    size: int

    @property
    def exact(self) -> bool:
        """Every frame that passes was compared."""
        return all(one.exact for one in self.hits)

    def signatures(self) -> Bytes:
        """Stored signatures (r, D) of R."""
        keys = self.ranking.indices.astype(np.int64)
        first = self.parts[0].place.view
        if len(self.parts) == 1 or not len(keys):
            return first.signatures(keys)
        order = np.argsort(self.owners, kind="stable")
        edges = np.searchsorted(self.owners[order], np.arange(len(self.parts) + 1))
        found: list[Bytes] = [
            self.parts[i].place.view.signatures(keys[order[a:b]])
            for i, (a, b) in enumerate(pairwise(edges.tolist()))
            if a < b
        ]
        rows = np.empty((len(keys), found[0].shape[1]), np.uint8)
        rows[order] = np.concatenate(found)
        return rows


def search_maps(
    store: Store, places: Sequence[Place], asked: Asked, query: Query, model: Model
) -> Searched:
    """The frames of all maps that are nearest to a query.

    Parameters
    ----------
    store : see Store
    places : the maps, one or more of one model
    asked, query : what is sought, and how
    model : of all of them
    """
    parts = tuple(_part(store, place, asked, query) for place in places)
    size = ranking_size(sum(part.passed for part in parts))
    hits = _searched(asked.vector, parts, size, query.exact)
    keys = np.concatenate([one.keys for one in hits])
    found = np.concatenate([one.distances for one in hits])
    owners = np.repeat(np.arange(len(parts)), [len(one) for one in hits])
    first = np.lexsort((keys, found))[:size]  # equal distances in the order in which frames came
    distances = found[first]
    shares = similarity(distances, model.unrelated_distance)
    return Searched(parts, hits, Ranking(keys[first].astype(np.intp), distances, shares),
                    owners[first], size)  # fmt: skip


def rank_among_all(searched: Searched, asked: Asked, number: int, distance: int) -> int:
    """The rank, from 1, of a distance among all frames that pass, each compared exactly."""
    return 1 + sum(
        part.place.view.nearer(asked.vector, number, distance, dead=part.dead, among=part.among)
        for part in searched.parts
    )


def _searched(vector: Bytes, parts: Sequence[Part], size: int, exact: bool) -> tuple[Hits, ...]:
    """Hits of each part: of those in the database by one statement for all."""
    stored = [(part.place.view, part) for part in parts if isinstance(part.place.view, Stored)]
    among = [part.among for _, part in stored if part.among is not None]
    found = iter(
        search_stored(
            [view for view, _ in stored], vector, size,
            dead=frozenset().union(*(part.dead for _, part in stored)),
            among=among if among else None, exact=exact,
        )
        if stored else ()
    )  # fmt: skip
    return tuple(
        _counted(next(found), part)
        if isinstance(part.place.view, Stored)
        else part.place.view.search(vector, size, dead=part.dead, among=part.among, exact=exact)
        for part in parts
    )


def _counted(hits: Hits, part: Part) -> Hits:
    """The database counts the query itself, where it is of the map."""
    return replace(hits, compared=min(hits.compared, part.passed))


def _part(store: Store, place: Place, asked: Asked, query: Query) -> Part:
    view, own = place.view, asked.frame
    dead = view.dead if own is None else view.dead | {own[0]}
    itself = asked.home is not None and asked.home.number == place.row.number
    size = max(view.size - itself, 0)  # it may just have been deleted
    among = None
    if query.filter is not None:
        among = _among(store, place, dead, asked, query.filter)
    return Part(place, dead, among, size)


def _among(store: Store, place: Place, dead: frozenset[int], asked: Asked, wanted: Filter) -> Keys:
    """Frames of a view that pass a filter; the database may be newer or older than the view."""
    view = place.view
    with store.queried.read() as connection:
        numbers = passing(connection, place.row.number, wanted, asked.taken)
    if isinstance(view, Stored):  # what passes is found, or was deleted since
        return numbers[~np.isin(numbers, list(dead))]
    return numbers[view.has(numbers) & ~np.isin(numbers, list(dead))]
