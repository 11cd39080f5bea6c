"""A shard of Qdrant's engine over the signatures of a generation, which says which are nearest.

    signatures (N, D)  --write_shard-->  folder  --open_shard-->  Shard
    query (D,)  --Shard.nearest-->  rows, and a distance that no other row is below

The engine runs in this process (the package `qdrant-edge-py`); there is no server. A point is a row
of the generation, its vector the signature as it is stored. What the engine says of distances is
rounded, so it only chooses rows: distances that count are those of `geometry.retrieval`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sceneprint.errors import DamagedIndex, UnusableStore
from sceneprint.geometry.retrieval.ranking import Metric
from sceneprint.types import Bytes

if TYPE_CHECKING:
    from qdrant_edge import EdgeConfig, EdgeShard

#: What the vector of a point is called.
_VECTOR = "signature"
#: Bytes of signatures that are given to the engine at once.
_AT_ONCE = 4 << 20
#: Queries of one segment that the engine works on at once, each on a thread that stays; more wait.
_THREADS = 1
#: The engine adds squares and differences of bytes in 32 bits with a sign.
_LARGEST = (1 << 31) - 1
#: Parts by which a distance of the engine may be wrong: of 24 bits, some are lost in each of a few
#: steps. And what may be lost of it beyond that.
_ROUNDED, _BEYOND = 1e-6, 2.0


def can_hold(dimension: int, metric: Metric) -> bool:
    """Whether the engine's distances of such signatures cannot overflow."""
    return dimension * (255 if metric == "l1" else 255**2) <= _LARGEST


@dataclass(frozen=True, eq=False)
class Shard:
    """An open shard; any number of threads may search it, as long as nobody writes.

    Parameters
    ----------
    path : of its folder, to show
    engine : of Qdrant
    size : N, points that it holds: the rows 0 to N - 1
    metric : of their signatures
    """

    path: Path
    engine: EdgeShard
    size: int
    metric: Metric

    def nearest(
        self, query: Bytes, count: int, free: NDArray[np.bool_] | None
    ) -> tuple[NDArray[np.int64], float]:
        """The rows nearest to a query, by the distances of the engine, each compared.

        Parameters
        ----------
        query : (D,) uint8
        count : of rows, 1 or more; there must be so many
        free : (N,) which rows may be found; all of them if None

        Returns
        -------
        rows : (count,) in no order that is promised
        limit : no other row has an exact distance below this

        Raises
        ------
        DamagedIndex : the engine failed, or found something else than so many rows.
        """
        from qdrant_edge import Query, QueryRequest, SearchParams

        with _explained(self.path):
            found = self.engine.query(
                QueryRequest(
                    limit=count,
                    query=Query.Nearest(query.tolist(), using=_VECTOR),
                    params=SearchParams(exact=True),
                    filter=None if free is None else _filter(free),
                )
            )
            rows = np.array([int(str(one.id)) for one in found], np.int64)
            farthest = max((one.score for one in found), default=0.0)
        if len(np.unique(rows)) != count or rows.min() < 0 or rows.max() >= self.size:
            raise DamagedIndex(f"{self.path}: found {len(rows)} rows, where {count} are nearest.")
        if free is not None and not free[rows].all():
            raise DamagedIndex(f"{self.path}: found rows that it was not to find.")
        distance = farthest if self.metric == "l1" else farthest**2
        return rows, distance * (1 - _ROUNDED) - _BEYOND


def _filter(free: NDArray[np.bool_]) -> Any:
    """Of the rows that may be found, or of those that may not, whichever are fewer."""
    from qdrant_edge import Filter, HasIdCondition

    if 2 * np.count_nonzero(free) <= len(free):
        return Filter(must=[HasIdCondition(set(np.flatnonzero(free).tolist()))])
    return Filter(must_not=[HasIdCondition(set(np.flatnonzero(~free).tolist()))])


def write_shard(path: Path, vectors: Bytes, metric: Metric) -> None:
    """Write the shard of signatures into an empty folder.

    Parameters
    ----------
    path : of the folder
    vectors : (N, D) uint8
    metric : how they are compared; see `can_hold`

    Raises
    ------
    UnusableStore : the engine cannot write it, or is not installed.
    ValueError : it cannot hold such signatures.
    """
    n, dimension = vectors.shape
    if not can_hold(dimension, metric):
        raise ValueError(f"Qdrant cannot compare signatures of {dimension} bytes by {metric}")
    try:
        from qdrant_edge import EdgeShard, Point, UpdateOperation

        with _explained(path):
            engine = EdgeShard.create(str(path), _config(dimension, metric))
            step = max(_AT_ONCE // dimension, 1)
            for start in range(0, n, step):
                rows = range(start, min(start + step, n))
                points = [Point(row, {_VECTOR: vectors[row].tobytes()}) for row in rows]
                engine.update(UpdateOperation.upsert_points(points))
            engine.flush()
            engine.close()
            # it adds files and defaults when it first opens what it wrote, and nothing after that
            open_shard(path, n, dimension, metric).engine.close()
    except (ImportError, DamagedIndex) as error:
        raise UnusableStore(f"Qdrant's engine cannot write a shard: {error}") from error


def open_shard(path: Path, size: int, dimension: int, metric: Metric) -> Shard:
    """Open a shard; processes that do so share the memory of its files.

    Parameters
    ----------
    path : of a folder whose files the caller has checked
    size, dimension, metric : that it must have

    Raises
    ------
    DamagedIndex : missing, of other points, or of an engine that this one cannot read, or there is
        no engine.
    """
    try:
        from qdrant_edge import EdgeShard
    except ImportError as error:
        raise DamagedIndex(f"{path}: Qdrant's engine is not installed ({error}).") from error
    with _explained(path):
        engine = EdgeShard.load(str(path), _config(dimension, metric))
        points = engine.info().points_count
    if points != size:
        raise DamagedIndex(f"{path}: {points} points, where there are {size} signatures.")
    return Shard(path, engine, size, metric)


def _config(dimension: int, metric: Metric) -> EdgeConfig:
    from qdrant_edge import Distance, EdgeConfig, EdgeVectorParams, VectorStorageDatatype

    distance = Distance.Manhattan if metric == "l1" else Distance.Euclid
    vector = EdgeVectorParams(dimension, distance, datatype=VectorStorageDatatype.Uint8)
    # nothing is written twice: a shard that is not whole has no name, and is nobody's
    return EdgeConfig({_VECTOR: vector}, max_search_threads=_THREADS, wal_enabled=False)


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    """What the engine raises, as an error of ours: its panics are no `Exception`."""
    try:
        yield
    except (DamagedIndex, KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:
        raise DamagedIndex(f"{path}: Qdrant's engine failed: {error!s:.300}") from error
