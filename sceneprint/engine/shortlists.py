"""What proposes the frames that a query is compared with: FAISS on this node, or pgvector.

    a map as of now  --Readers.views-->  Shortlist  --search-->  Hits

Both propose by the same kind of code, and the distances that count are of the signatures
themselves: where both propose the same frames, they answer with the same bytes.
"""

from __future__ import annotations

from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from sceneprint.index import Hits
from sceneprint.index.keys import Keys
from sceneprint.types import Bytes

#: Frames up to which a map is compared whole on this node: a shortlist saves next to nothing
#: there. And frames newer than its index that a node reads before it would ask the database.
WHOLE = 4000


class Shortlist(Protocol):
    """A map that can be searched, as of one revision or later."""

    @property
    def kind(self) -> Literal["local", "database"]:
        """What proposes: an index of this node, or the database."""

    @property
    def model_id(self) -> str:
        """Of the model that made all signatures."""

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
    def damaged(self) -> frozenset[int]:
        """Frames that were passed over, as their signature is damaged."""

    @property
    def number(self) -> int:
        """Of the generation of the index; 0 where none is used."""

    def search(
        self, query: Bytes, size: int, *, dead: frozenset[int], among: Keys | None = None,
        exact: bool = False,
    ) -> Hits:  # fmt: skip
        """The nearest frames by exact distance; see `index.search`."""

    def nearer(
        self, query: Bytes, key: int, distance: int, *, dead: frozenset[int],
        among: Keys | None = None,
    ) -> int:  # fmt: skip
        """How many frames come before one in the order of exact distance, equal ones by key."""

    def is_compared(
        self, query: Bytes, size: int, key: int, *, dead: frozenset[int],
        among: Keys | None = None, exact: bool = False,
    ) -> bool:  # fmt: skip
        """Whether `search` computes the exact distance of a frame; see `index.is_compared`."""

    def signatures(self, keys: Keys) -> Bytes:
        """Signatures (r, D) of frames that it has."""

    def has(self, keys: Keys) -> NDArray[np.bool_]:
        """Which frames (n,) can be found."""


def count_nearer(
    keys: Keys, found: NDArray[np.int64], key: int, distance: int, dead: frozenset[int]
) -> int:
    """How many of some frames come before one; see `Shortlist.nearer`."""
    before = (found < distance) | ((found == distance) & (keys < key))
    return int((before & ~np.isin(keys, list(dead))).sum())
