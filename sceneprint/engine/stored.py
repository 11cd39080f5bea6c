"""Maps searched in the database, by a node that does not hold their signatures.

query  --codes of pgvector-->  candidates, and frames without a code  --signatures-->  Hits

All maps of a query are asked in one statement, as of one state of the database: a frame that is
deleted there is found by none of it.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection

from sceneprint.engine.remembered import Remembered
from sceneprint.engine.shortlists import WHOLE, count_nearer
from sceneprint.errors import UnknownFrame
from sceneprint.geometry.retrieval import distances
from sceneprint.index import SHORTLIST, Code, Hits
from sceneprint.index.keys import Keys
from sceneprint.store import Database, codes, fits, graphs, vectors
from sceneprint.store.fits import Fit
from sceneprint.store.vectors import Vector
from sceneprint.types import Bytes

#: Bytes of signatures that are read and compared at once.
BLOCK_BYTES = 16 << 20
#: Hits whose signatures are kept, to be compared among each other: a ranking has fewer.
_HELD = 1000

Codes = Callable[[Connection, Fit], Code]


@dataclass(eq=False)
class Stored:
    """A map in the database: the Shortlist of pgvector, for one query.

    Parameters
    ----------
    database : to read from
    code_of : the code of a fit
    remembered : signatures that this node read lately
    map_number, model_id, revision, size : of the map
    length : bytes of a signature
    """

    database: Database
    code_of: Codes
    remembered: Remembered
    map_number: int
    model_id: str
    revision: int
    size: int
    length: int
    _damaged: set[int] = field(default_factory=set)
    _compared: Keys | None = None  # of the last search; None: all
    _held: dict[int, Bytes] = field(default_factory=dict)

    @property
    def kind(self) -> Literal["local", "database"]:
        """See Shortlist."""
        return "database"

    @property
    def dead(self) -> frozenset[int]:
        """None: what is deleted is not in the database."""
        return frozenset()

    @property
    def damaged(self) -> frozenset[int]:
        """See Shortlist; of those that were looked at."""
        return frozenset(self._damaged)

    @property
    def number(self) -> int:
        """See Shortlist."""
        return 0

    def search(
        self, query: Bytes, size: int, *, dead: frozenset[int], among: Keys | None = None,
        exact: bool = False,
    ) -> Hits:  # fmt: skip
        """See `search_stored`."""
        wanted = None if among is None else [among]
        return search_stored([self], query, size, dead=dead, among=wanted, exact=exact)[0]

    def nearer(
        self, query: Bytes, key: int, distance: int, *, dead: frozenset[int],
        among: Keys | None = None,
    ) -> int:  # fmt: skip
        """See Shortlist: a scan of the whole map in the database."""
        count = 0
        with self.database.read() as connection:
            for numbers, rows in _all(self, connection, among):
                count += count_nearer(numbers, distances(query, rows), key, distance, dead)
        return count

    def is_compared(
        self, query: Bytes, size: int, key: int, *, dead: frozenset[int],
        among: Keys | None = None, exact: bool = False,
    ) -> bool:  # fmt: skip
        """Whether the last search compared a frame: in a graph that grows another may not."""
        del query, size
        if key in dead or (among is not None and key not in among):
            return False
        return exact or self._compared is None or key in self._compared

    def signatures(self, keys: Keys) -> Bytes:
        """See Shortlist; UnknownFrame where one was deleted since the search."""
        lacking = [key for key in keys.tolist() if key not in self._held]
        read: dict[int, Bytes] = {}
        if lacking:
            with self.database.read() as connection:
                for _, numbers, rows in _some(connection, [self], lacking):
                    read.update(zip(numbers.tolist(), rows, strict=True))
        found = np.empty((len(keys), self.length), np.uint8)
        for i, key in enumerate(keys.tolist()):
            row = self._held.get(key, read.get(key))
            if row is None:
                raise UnknownFrame("A frame was deleted while it was compared. Ask again.")
            found[i] = row
        return found

    def has(self, keys: Keys) -> NDArray[np.bool_]:
        """See Shortlist; as the database is now."""
        with self.database.read() as connection:
            there = vectors.heads(connection, keys.tolist(), [self.map_number], self.model_id)
        return np.isin(keys, [one.number for one in there])


def search_stored(
    views: Sequence[Stored], query: Bytes, size: int, *, dead: frozenset[int],
    among: Sequence[Keys] | None = None, exact: bool = False,
) -> list[Hits]:  # fmt: skip
    """The nearest frames of each of some maps of one model, of one state of the database.

    Parameters
    ----------
    views : of the maps, one or more
    query : (D,) a signature of their model
    size : most of each answer
    dead : frames that may not be found
    among : of each map the frames that may, where not all may
    exact : compare all
    """
    first = views[0]
    wanted = None if among is None else np.concatenate(among)
    asked = sum(view.size for view in views) if wanted is None else len(wanted)
    count = max(SHORTLIST, size)
    with first.database.read() as connection:
        chosen = None
        if not exact and asked > count:
            chosen = _proposed(connection, views, query, count, asked, wanted, dead)
        found = {view.map_number: _Nearest(query, size, dead) for view in views}
        for i, view in enumerate(views):
            view._compared = chosen
            own = None if among is None else among[i]
            for keys, rows in () if chosen is not None else _all(view, connection, own):
                found[view.map_number].add(keys, rows)
        if chosen is not None:
            for number, keys, rows in _some(connection, views, chosen.tolist()):
                found[number].add(keys, rows)
        hits = [found[view.map_number].hits(exact=chosen is None) for view in views]
        _hold(connection, views, hits, min(size, _HELD))
    return hits


def _hold(connection: Connection, views: Sequence[Stored], hits: Sequence[Hits], size: int) -> None:
    """Keep the signatures of the nearest of all: a later look might not find them any more."""
    keys = np.concatenate([one.keys for one in hits])
    order = np.lexsort((keys, np.concatenate([one.distances for one in hits])))
    held: dict[int, dict[int, Bytes]] = {view.map_number: {} for view in views}
    for number, some, rows in _some(connection, views, keys[order[:size]].tolist()):
        held[number].update(zip(some.tolist(), rows, strict=True))
    for view in views:
        view._held = held[view.map_number]


def _proposed(
    connection: Connection, views: Sequence[Stored], query: Bytes, count: int, asked: int,
    wanted: Keys | None, dead: frozenset[int],
) -> Keys | None:  # fmt: skip
    """Frames that are compared; None for all, where nothing proposes any."""
    first = views[0]
    fit = fits.live_fit(connection, first.model_id)
    if fit is None:  # dropped since the map was looked at
        return None
    maps = [view.map_number for view in views]
    code = first.code_of(connection, fit).encode(query[None])[0]
    near = graphs.nearest(connection, fit, code, maps, count, asked, wanted, dead)
    others = np.array(sorted(codes.uncoded(connection, fit, maps, 2 * WHOLE)), np.int64)
    if wanted is not None:
        others = others[np.isin(others, wanted)]
    return np.concatenate([near, others])


def _all(view: Stored, connection: Connection, among: Keys | None) -> Iterator[tuple[Keys, Bytes]]:
    """All frames of a map and their signatures, block by block."""
    rows = max(BLOCK_BYTES // view.length, 1)
    for block in vectors.blocks(connection, view.map_number, view.model_id, rows, among):
        yield _sound(view, block)


def _some(
    connection: Connection, views: Sequence[Stored], numbers: Sequence[int]
) -> Iterator[tuple[int, Keys, Bytes]]:
    """Signatures of those of some frames that are found, in blocks of one map each."""
    first, by_map = views[0], {view.map_number: view for view in views}
    heads = vectors.heads(connection, numbers, by_map, first.model_id)
    step = max(BLOCK_BYTES // first.length, 1)
    for start in range(0, len(heads), step):
        some = heads[start : start + step]
        known = first.remembered.get(some, first.model_id)
        lacking = {head.number: head for head in some if head.number not in known}
        if lacking:
            read = vectors.vectors(connection, lacking, first.model_id)
            first.remembered.put({lacking[n]: vector for n, vector, _ in read}, first.model_id)
            known |= {number: vector for number, vector, _ in read}
        for number in sorted({head.map_number for head in some}):
            own = [
                (head.number, known[head.number], head.checksum)
                for head in some
                if head.map_number == number
            ]
            yield number, *_sound(by_map[number], own)


def _sound(view: Stored, read: Sequence[Vector]) -> tuple[Keys, Bytes]:
    """Those whose bytes are what was stored; the others are noted."""
    kept = []
    for number, vector, checksum in read:
        if len(vector) == view.length and zlib.crc32(vector) == checksum:
            kept.append((number, np.frombuffer(vector, np.uint8)))
        else:
            view._damaged.add(number)
    rows = np.stack([row for _, row in kept]) if kept else np.empty((0, view.length), np.uint8)
    return np.array([number for number, _ in kept], np.int64), rows


class _Nearest:
    """The nearest frames of one map among those that come by."""

    def __init__(self, query: Bytes, size: int, dead: frozenset[int]) -> None:
        self._query, self._size = query, size
        self._dead = np.fromiter(dead, np.int64, len(dead))
        self._keys, self._found, self._count = np.empty(0, np.int64), np.empty(0, np.int64), 0

    def add(self, keys: Keys, rows: Bytes) -> None:
        alive = np.flatnonzero(~np.isin(keys, self._dead))
        self._count += len(alive)
        keys = np.concatenate([self._keys, keys[alive]])
        found = np.concatenate([self._found, distances(self._query, rows, rows=alive)])
        first = np.lexsort((keys, found))[: self._size]
        self._keys, self._found = keys[first], found[first]

    def hits(self, *, exact: bool) -> Hits:
        return Hits(self._keys, self._found, exact, self._count)
