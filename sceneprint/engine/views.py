"""A map as this node holds it: an index of FAISS, and the frames that are newer."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sceneprint.engine.shortlists import count_nearer
from sceneprint.index import Generation, Hits, Tail, is_compared, search, signatures_of
from sceneprint.index.keys import Keys
from sceneprint.types import Bytes


@dataclass(frozen=True, eq=False)
class View:
    """A map as of one revision: the Shortlist of this node.

    Parameters
    ----------
    model_id : of the model that made all signatures
    revision : of the map
    generation : of its index, or None
    tail : frames newer than it
    dead : frames of both that are deleted
    size : frames that can be found
    damaged : frames that were passed over, as their signature is damaged
    """

    model_id: str
    revision: int
    generation: Generation | None
    tail: Tail
    dead: frozenset[int]
    size: int
    damaged: frozenset[int] = frozenset()

    @property
    def kind(self) -> Literal["local", "database"]:
        """See Shortlist."""
        return "local"

    @property
    def number(self) -> int:
        """See Shortlist."""
        return 0 if self.generation is None else self.generation.number

    def search(
        self, query: Bytes, size: int, *, dead: frozenset[int], among: Keys | None = None,
        exact: bool = False,
    ) -> Hits:  # fmt: skip
        """See `index.search`."""
        return search(query, self.generation, self.tail, size, dead=dead, among=among, exact=exact)

    def nearer(
        self, query: Bytes, key: int, distance: int, *, dead: frozenset[int],
        among: Keys | None = None,
    ) -> int:  # fmt: skip
        """See Shortlist."""
        hits = self.search(query, max(self.size, 1), dead=dead, among=among, exact=True)
        return count_nearer(hits.keys, hits.distances, key, distance, dead)

    def is_compared(
        self, query: Bytes, size: int, key: int, *, dead: frozenset[int],
        among: Keys | None = None, exact: bool = False,
    ) -> bool:  # fmt: skip
        """See `index.is_compared`."""
        return is_compared(
            query, self.generation, self.tail, size, key, dead=dead, among=among, exact=exact
        )

    def signatures(self, keys: Keys) -> Bytes:
        """See `index.signatures_of`."""
        return signatures_of(keys, self.generation, self.tail)

    def has(self, keys: Keys) -> NDArray[np.bool_]:
        """See Shortlist."""
        known = self.tail.places.of(keys) >= 0
        if self.generation is not None:
            known |= self.generation.places.of(keys) >= 0
        alive: NDArray[np.bool_] = known & ~np.isin(keys, list(self.dead))
        return alive
