"""Maps as queries see them: as of one revision, held by this node or in the database.

    a map as of now  --Readers.views-->  MapView  --search-->  Hits

`IndexView` is a map that this node holds, `Stored` one that PostgreSQL searches. Exact
distances of signatures decide in both, so that where both compare the same frames their answers
are the same.
"""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from sceneprint.geometry.retrieval.distance import Metric
from sceneprint.index import Generation, SearchHits, Tail, search, signatures_of
from sceneprint.index.mapped_files import Keys
from sceneprint.types import Bytes

#: Where a map is searched: by this node, or by the database.
Kind = Literal["local", "database"]


class MapView(Protocol):
    """A map that can be searched, as of one revision or later."""

    @property
    def kind(self) -> Kind:
        """Who searches it."""

    @property
    def model_id(self) -> str:
        """Of the model that made all signatures."""

    @property
    def metric(self) -> Metric:
        """How they are compared."""

    @property
    def revision(self) -> int:
        """Of the map."""

    @property
    def size(self) -> int:
        """Frames that can be found."""

    @property
    def dead(self) -> frozenset[int]:
        """Frames that it holds and that are deleted."""

    @property
    def damaged(self) -> Set[int]:
        """Frames that were passed over, as their signature is damaged."""

    @property
    def number(self) -> int:
        """Of the generation of the index; 0 where none is used."""

    def search(
        self, query: Bytes, size: int, *, dead: frozenset[int], among: Keys | None = None,
        exact: bool = False,
    ) -> SearchHits:  # fmt: skip
        """The nearest frames by exact distance; see `index.search`."""

    def nearer(
        self, query: Bytes, key: int, distance: int, *, dead: frozenset[int],
        among: Keys | None = None,
    ) -> int:  # fmt: skip
        """How many frames come before one in the order of exact distance, equal ones by key."""

    def signatures(self, keys: Keys) -> Bytes:
        """Signatures (r, D) of frames that it has."""

    def has(self, keys: Keys) -> NDArray[np.bool_]:
        """Which frames (n,) can be found."""


@dataclass(frozen=True, eq=False)
class IndexView:
    """A map as of one revision, held by this node: an index, and the frames that are newer.

    Parameters
    ----------
    model_id : of the model that made all signatures
    metric : how they are compared
    revision : of the map
    generation : of its index, or None
    tail : frames newer than it
    dead : frames of both that are deleted
    size : frames that can be found
    damaged : frames that were passed over, as their signature is damaged
    """

    model_id: str
    metric: Metric
    revision: int
    generation: Generation | None
    tail: Tail
    dead: frozenset[int]
    size: int
    damaged: frozenset[int] = frozenset()
    kind: Kind = "local"

    @property
    def number(self) -> int:
        """See MapView."""
        return 0 if self.generation is None else self.generation.number

    def search(
        self, query: Bytes, size: int, *, dead: frozenset[int], among: Keys | None = None,
        exact: bool = False,
    ) -> SearchHits:  # fmt: skip
        """See `index.search`."""
        return search(
            query, self.generation, self.tail, size, metric=self.metric, dead=dead, among=among,
            exact=exact,
        )  # fmt: skip

    def nearer(
        self, query: Bytes, key: int, distance: int, *, dead: frozenset[int],
        among: Keys | None = None,
    ) -> int:  # fmt: skip
        """See MapView."""
        hits = self.search(query, max(self.size, 1), dead=dead, among=among, exact=True)
        same = (hits.distances == distance) & (hits.keys < key)
        return int(((hits.distances < distance) | same).sum())

    def signatures(self, keys: Keys) -> Bytes:
        """See `index.signatures_of`."""
        return signatures_of(keys, self.generation, self.tail)

    def has(self, keys: Keys) -> NDArray[np.bool_]:
        """See MapView."""
        known = self.tail.places.of(keys) >= 0
        if self.generation is not None:
            known |= self.generation.places.of(keys) >= 0
        alive: NDArray[np.bool_] = known & ~np.isin(keys, list(self.dead))
        return alive
