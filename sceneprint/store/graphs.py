"""The nearest codes in PostgreSQL: all compared, or through a graph of pgvector (HNSW).

code  --nearest-->  numbers of frames
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import closing
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, text

from sceneprint.store.codes import as_text, count_codes
from sceneprint.store.database import Database
from sceneprint.store.fits import Fit
from sceneprint.types import Floats32

#: Codes from which a table gets a graph (HNSW). Comparing all of fewer is as fast, and misses none.
GRAPH_FROM = 10_000
#: Neighbours of each code in the graph, and those looked at to find them.
LINKS, LOOKED_AT = 16, 64
#: Most that a search of the graph keeps in sight: what pgvector allows.
_MOST_SIGHT = 1000
#: Times that a frame looked at in the graph costs of one that is compared in passing: measured,
#: 3.5 to 4.6 us and 0.35 us.
_STEP_COST = 12.0


def add_graph(connection: Connection, fit: Fit) -> bool:
    """Link the codes of a fit, if they are many; until the commit no frame can be deleted."""
    if count_codes(connection, fit) < GRAPH_FROM:
        return False
    connection.execute(text(_graph_of(fit)))
    connection.execute(text(f"ANALYZE {fit.table}"))
    return True


def add_graph_beside(database: Database, fit: Fit) -> bool:
    """As `add_graph`, beside whoever deletes frames; may take minutes, or as long as a backup."""
    with database.read() as connection:
        if count_codes(connection, fit) < GRAPH_FROM:
            return False
    with database.explained(), closing(database.driver_connection()) as own:
        own.execute("SET statement_timeout = 0")
        own.execute("SET lock_timeout = 0")
        own.execute(f"DROP INDEX IF EXISTS {fit.graph}")  # of a worker that died over it
        own.execute(_graph_of(fit, "CONCURRENTLY"))
        own.execute(f"ANALYZE {fit.table}")
    return True


def _graph_of(fit: Fit, how: str = "") -> str:
    return (
        f"CREATE INDEX {how} IF NOT EXISTS {fit.graph} ON {fit.table} USING hnsw "
        f"(code halfvec_l2_ops) WITH (m = {LINKS}, ef_construction = {LOOKED_AT})"
    )


def nearest(
    connection: Connection, fit: Fit, code: Floats32, maps: Sequence[int], count: int, asked: int,
    among: NDArray[np.int64] | None = None, barred: Iterable[int] = (),
) -> NDArray[np.int64]:  # fmt: skip
    """Numbers of the frames whose codes are nearest, in no particular order.

    Parameters
    ----------
    connection : of a reading transaction
    fit : whose codes
    code : (d,) of the query, by the same fit
    maps : numbers of the maps that are searched
    count : of frames
    asked : about how many may be found, from which follows how they are looked for
    among : numbers of those that may be found, where not all may
    barred : numbers of those that may not
    """
    barred = list(barred)
    values: dict[str, Any] = {"maps": list(maps), "code": as_text(code), "count": count}
    conditions = ["map_number = ANY(CAST(:maps AS bigint[]))"]
    if among is not None:
        conditions.append("frame_number = ANY(CAST(:among AS bigint[]))")
        values["among"] = among.tolist()
    if barred:
        conditions.append("frame_number <> ALL(CAST(:barred AS bigint[]))")
        values["barred"] = barred
    graph = _by_graph(connection, fit, count, asked)
    # an order that no index has makes PostgreSQL compare all that the conditions leave
    order = "code <-> CAST(:code AS halfvec)" if graph else "(code <-> CAST(:code AS halfvec)) + 0"
    if graph:
        _steer(connection, count)
    found = connection.execute(
        text(
            f"SELECT frame_number FROM {fit.table} WHERE {' AND '.join(conditions)} "
            f"ORDER BY {order} LIMIT :count"
        ),
        values,
    )
    numbers = np.fromiter(found.scalars(), np.int64)
    if graph:
        connection.execute(text("SET LOCAL enable_sort = on"))
    return numbers


def _by_graph(connection: Connection, fit: Fit, count: int, asked: int) -> bool:
    """Whether going through the graph is cheaper than comparing the codes that are asked for."""
    if asked < GRAPH_FROM:
        return False
    found = connection.execute(
        text(
            "SELECT c.reltuples FROM pg_index i "
            "JOIN pg_class c ON c.oid = i.indrelid "
            "WHERE i.indexrelid = to_regclass(:graph) AND i.indisvalid"
        ),
        {"graph": fit.graph},
    ).scalar()
    if found is None:
        return False
    there = max(float(found), asked)
    return _STEP_COST * count * there / asked < asked


def _steer(connection: Connection, count: int) -> None:
    """Have the graph asked, and asked on until there are enough: a filter leaves few of the first.

    In any order, as exact distances decide: pgvector's `strict_order` drops what comes late, of
    the ten nearest up to two (one map of fifty asked).
    """
    sight = min(max(count, 40), _MOST_SIGHT)
    connection.execute(
        text(
            "SELECT set_config('hnsw.iterative_scan', 'relaxed_order', true), "
            "set_config('hnsw.ef_search', :sight, true), "
            "set_config('hnsw.max_scan_tuples', '2000000', true), "
            "set_config('hnsw.scan_mem_multiplier', '8', true), "
            "set_config('enable_sort', 'off', true)"
        ),
        {"sight": str(sight)},
    )
