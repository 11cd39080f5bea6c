"""Maps that PostgreSQL searches, where this node would have to read much of them first.

Exact distances of signatures decide there and on this node (`local_index.py`), so that where both
compare the same frames their answers are the same.
"""

from __future__ import annotations

import time
import zlib
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection

from sceneprint.engine.search.local_index import Kind, MapView
from sceneprint.errors import UnknownFrame
from sceneprint.geometry.retrieval.ranking import distances
from sceneprint.index import SearchHits
from sceneprint.index.generation_files import Keys
from sceneprint.models import Model
from sceneprint.store import Database
from sceneprint.store.postgres import vectors
from sceneprint.store.tables import MapRow
from sceneprint.types import Bytes

# Maps searched in PostgreSQL, by a node that does not hold their signatures.
#
# query  --vectors.nearest-->  candidates  --signatures-->  Hits
#
# All maps of a query are asked in one statement, as of one state of the database: a frame that is
# deleted there is found by none of it.

#: Least number of candidates that pgvector is asked for, where it goes through its graph.
LEAST_CANDIDATES = 200
#: How many times as long as it took to count the frames of a map the count is used again.
_COUNTED = 20


@dataclass(frozen=True, eq=False)
class Stored(MapView):
    """A map in the database, as one query sees it; `damaged` are of those that were looked at.

    Parameters
    ----------
    database : to read from
    map_number : of the map
    length : bytes of a signature
    """

    kind: ClassVar[Kind] = "database"

    damaged: set[int]
    database: Database
    map_number: int
    length: int
    _held: dict[int, Bytes] = field(default_factory=dict)  # signatures that were read

    def search(
        self, query: Bytes, size: int, *, dead: frozenset[int], among: Keys | None = None,
        exact: bool = False,
    ) -> SearchHits:  # fmt: skip
        """See `search_stored`."""
        wanted = None if among is None else [among]
        return search_stored([self], query, size, dead=dead, among=wanted, exact=exact)[0]

    def nearer(
        self, query: Bytes, key: int, distance: int, *, dead: frozenset[int],
        among: Keys | None = None,
    ) -> int:  # fmt: skip
        """See MapView."""
        with self.database.read() as connection:
            return vectors.count_nearer(
                connection, query, self.model_id, self.map_number, key, distance, among, dead
            )

    def signatures(self, keys: Keys) -> Bytes:
        """See MapView; UnknownFrame where one was deleted since the search."""
        lacking = [key for key in keys.tolist() if key not in self._held]
        if lacking:
            with self.database.read() as connection:
                _read(connection, [self], lacking)
        if any(key not in self._held for key in lacking):
            raise UnknownFrame("A frame was deleted during the comparison. Send the query again.")
        found = np.empty((len(keys), self.length), np.uint8)
        for i, key in enumerate(keys.tolist()):
            found[i] = self._held[key]
        return found

    def has(self, keys: Keys) -> NDArray[np.bool_]:
        """See MapView; as the database is now."""
        with self.database.read() as connection:
            there = vectors.homes(connection, keys.tolist(), [self.map_number])
        return np.isin(keys, list(there))


class StoredMaps:
    """Makes views of maps in the database, and counts the frames of each now and then."""

    def __init__(self) -> None:
        self._sizes: dict[int, tuple[int, float, int]] = {}  # revision, until when, frames

    def views(
        self, connection: Connection, database: Database, rows: Sequence[MapRow], model: Model
    ) -> dict[int, Stored]:
        """Maps of one model as the database has them, by number.

        Parameters
        ----------
        connection : a reading transaction of `database`
        database : to search in
        rows : of the maps
        model : of all of them, whose vectors are complete
        """
        now = time.monotonic()
        changed = [row for row in rows if not self._is_counted(row, now)]
        if changed:
            counted = vectors.sizes(connection, [row.number for row in changed])
            until = time.monotonic() + _COUNTED * (time.monotonic() - now)
            self._sizes |= {r.number: (r.revision, until, counted[r.number]) for r in changed}
        return {
            row.number: Stored(  # what is deleted is not in the database
                row.model_id, "l2", row.revision, self._sizes[row.number][2], frozenset(), set(),
                database, row.number, model.signature_bytes,
            )
            for row in rows
        }  # fmt: skip

    def _is_counted(self, row: MapRow, now: float) -> bool:
        revision, until, _ = self._sizes.get(row.number, (-1, 0.0, 0))
        return revision == row.revision or now < until


def search_stored(
    views: Sequence[Stored], query: Bytes, size: int, *, dead: frozenset[int],
    among: Sequence[Keys] | None = None, exact: bool = False,
) -> list[SearchHits]:  # fmt: skip
    """Of each of some maps of one model those frames that are among the nearest of all.

    Parameters
    ----------
    views : of the maps, one or more
    query : (D,) a signature of their model
    size : frames of all maps together that are surely found, where there are so many
    dead : frames that may not be found
    among : of each map the frames that may, where not all may
    exact : compare all
    """
    first, maps = views[0], [view.map_number for view in views]
    wanted = None if among is None else np.concatenate(among)
    passed = [view.size for view in views] if among is None else [len(one) for one in among]
    count = max(2 * size, LEAST_CANDIDATES)
    with first.database.read() as connection:
        while True:
            near, whole = vectors.nearest(
                connection, query, first.model_id, maps, count, sum(passed), wanted, dead,
                exact=exact,
            )  # fmt: skip
            found = _read(connection, views, near)
            if len(near) < count or sum(map(len, found)) >= size:
                break
            count *= 4  # so many are damaged, or were rejected by another model
    hits = []
    for keys, n, view in zip(found, passed, views, strict=True):
        apart = distances(query, view.signatures(keys), view.metric)
        order = np.lexsort((keys, apart))[:size]
        hits.append(SearchHits(keys[order], apart[order], whole, n if whole else len(keys)))
    return hits


def _read(connection: Connection, views: Sequence[Stored], numbers: Sequence[int]) -> list[Keys]:
    """Hold the signatures of those of some frames that are found; their numbers, map by map.

    Those whose bytes are not what was stored are noted.
    """
    by_map = {view.map_number: view for view in views}
    found: dict[int, list[int]] = {number: [] for number in by_map}
    for row in vectors.read(connection, numbers, by_map, views[0].model_id):
        number, map_number, vector, checksum = row
        view = by_map[map_number]
        if len(vector) == view.length and zlib.crc32(vector) == checksum:
            view._held[number] = np.frombuffer(vector, np.uint8)
            found[map_number].append(number)
        else:
            view.damaged.add(number)
    return [np.array(found[view.map_number], np.int64) for view in views]
