"""Signatures in PostgreSQL: as vectors of pgvector that are searched there, and as bytes.

signatures.vector  --put | fill-->  vectors_<dimension>  --nearest-->  frames  --read-->  bytes

A vector holds the numbers of a signature exactly, and 32 bits the squared distance of any two that
are worth telling apart (below 2^24), so that what compares all vectors finds the nearest.

The tables are a cache. Workers make them, because a server may lack the extension, and no migration
does. From then on a signature and its vector are stored in one transaction, and a foreign key
deletes both together; `fill` adds what was stored before, and `vector_tables` says when it is done.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from contextlib import closing
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, func, select, text
from sqlalchemy.exc import DBAPIError

from sceneprint.store.database import Database
from sceneprint.store.postgres.connection import LOCKS, VECTORS
from sceneprint.store.tables import frames
from sceneprint.types import Bytes
from sceneprint_client.api import FrameState

#: The first pgvector that continues an index scan where a filter leaves too few rows.
LEAST_VERSION = (0, 8)
#: Longest vector of 16-bit numbers that pgvector indexes.
MOST_DIMENSION = 4000
#: Frames whose vectors one transaction adds: other writers wait for tens of milliseconds.
BLOCK = 200
#: Rows from which a table gets a graph (HNSW). Comparing all of fewer is as fast and misses none.
GRAPH_FROM = 10_000
#: Neighbours of each vector in the graph, and the candidates looked at to find them.
LINKS, LOOKED_AT = 16, 64
#: Largest search list of the graph that pgvector allows.
_MOST_SIGHT = 1000
#: Cost of a vector looked at in the graph, as a multiple of one compared in a plain scan: measured,
#: 9 to 25.
_STEP_COST = 12.0

#: Number of a frame, number of its map, its signature, and the CRC-32 it had when it was stored.
Row = tuple[int, int, bytes, int]


# the tables


def table_of(dimension: int) -> str:
    """Name of the table of vectors of so many numbers."""
    return f"vectors_{dimension}"


def make_table(connection: Connection, dimension: int) -> str | None:
    """Make the table of a dimension, where it is missing, in a writing transaction in its turn.

    Returns
    -------
    why it cannot be made; None where it is there
    """
    reason = _require_extension(connection)
    if reason is not None or _has_table(connection, dimension):
        return reason
    table = table_of(dimension)
    for statement in (
        "CREATE TABLE IF NOT EXISTS vector_tables (dimension integer PRIMARY KEY, "
        "filled_to bigint NOT NULL, complete boolean NOT NULL)",
        f"CREATE TABLE {table} (frame_number bigint NOT NULL, "
        'model_id varchar(64) COLLATE "C" NOT NULL, map_number bigint NOT NULL, '
        f"vector halfvec({dimension}) NOT NULL, PRIMARY KEY (frame_number, model_id), "
        "FOREIGN KEY (frame_number, model_id) REFERENCES signatures (frame_number, model_id) "
        "ON DELETE CASCADE)",
        f"CREATE INDEX ix_{table}_map_number ON {table} (map_number)",
        f"INSERT INTO vector_tables VALUES ({int(dimension)}, -1, false) "
        "ON CONFLICT (dimension) DO UPDATE SET filled_to = -1, complete = false",
    ):
        connection.execute(text(statement))
    return None


def drop_tables(connection: Connection) -> None:
    """Drop the tables of vectors before signatures are written past `put`; workers make others."""
    if _exists(connection, "vector_tables"):
        for dimension in connection.execute(text("SELECT dimension FROM vector_tables")).scalars():
            connection.execute(text(f"DROP TABLE IF EXISTS {table_of(dimension)}"))
        connection.execute(text("DELETE FROM vector_tables"))


def complete_dimensions(connection: Connection) -> frozenset[int]:
    """Dimensions whose tables hold the vector of every signature; none on SQLite."""
    if not _exists(connection, "vector_tables"):
        return frozenset()
    found = connection.execute(
        text(
            "SELECT dimension FROM vector_tables "
            "WHERE complete AND to_regclass('vectors_' || dimension) IS NOT NULL"
        )
    )
    return frozenset(found.scalars())


def _require_extension(connection: Connection) -> str | None:
    known = text("SELECT extversion FROM pg_extension WHERE extname = 'vector'")
    version: str | None = connection.execute(known).scalar()
    if version is None:
        wanted = text("SELECT 1 FROM pg_available_extensions WHERE name = 'vector'")
        if connection.execute(wanted).first() is None:
            return "the server has no pgvector"
        try:
            with connection.begin_nested():
                connection.execute(text("CREATE EXTENSION IF NOT EXISTS vector"))
        except DBAPIError as error:
            return (
                f"the extension `vector` cannot be made ({str(error.orig).splitlines()[0]}): let "
                "an administrator of the database run CREATE EXTENSION vector"
            )
        version = str(connection.execute(known).scalar())
    if tuple(int(part) for part in version.split(".")[:2] if part.isdigit()) < LEAST_VERSION:
        return f"pgvector {version} is older than {'.'.join(map(str, LEAST_VERSION))}"
    return None


def _has_table(connection: Connection, dimension: int) -> bool:
    return dimension <= MOST_DIMENSION and _exists(connection, table_of(dimension))


def _exists(connection: Connection, table: str) -> bool:
    if connection.dialect.name != "postgresql":
        return False
    found = connection.execute(text("SELECT to_regclass(:name) IS NOT NULL"), {"name": table})
    return bool(found.scalar_one())


# what is in them


def put(connection: Connection, number: int, model_id: str, dimension: int) -> None:
    """Store the vector of a signature, where there is a table for it.

    Parameters
    ----------
    connection : of the transaction that has just stored the signature, in its turn
    number, model_id : of the frame and the model
    dimension : bytes of the signature
    """
    if _has_table(connection, dimension):
        connection.execute(
            text(
                f"{_insert(dimension)} WHERE s.frame_number = :number AND s.model_id = :model "
                "ON CONFLICT (frame_number, model_id) DO UPDATE SET vector = EXCLUDED.vector"
            ),
            {"number": number, "model": model_id},
        )


def fill(connection: Connection, dimension: int) -> bool:
    """Add the vectors of the next BLOCK signatures that were stored before the table was made.

    Parameters
    ----------
    connection : of a writing transaction, in its turn
    dimension : of the table

    Returns
    -------
    complete : none is left
    """
    known = {"dimension": dimension}
    after = connection.execute(
        text("SELECT filled_to FROM vector_tables WHERE dimension = :dimension AND NOT complete"),
        known,
    ).scalar()
    if after is None:
        return True
    last = connection.execute(
        text(
            "SELECT max(frame_number) FROM (SELECT frame_number FROM signatures "
            "WHERE frame_number > :after ORDER BY frame_number LIMIT :most) AS block"
        ),
        {"after": after, "most": BLOCK},
    ).scalar()
    if last is None:
        changed = "complete = true"
    else:
        changed = f"filled_to = {int(last)}"
        connection.execute(
            text(
                f"{_insert(dimension)} WHERE s.frame_number > :after AND s.frame_number <= :last "
                f"AND octet_length(s.vector) = {int(dimension)} ON CONFLICT DO NOTHING"
            ),
            {"after": after, "last": last},
        )
    connection.execute(
        text(f"UPDATE vector_tables SET {changed} WHERE dimension = :dimension"), known
    )
    return last is None


def _insert(dimension: int) -> str:
    """The server itself makes vectors of bytes; a condition on `s`, the signatures, follows."""
    return (
        f"INSERT INTO {table_of(dimension)} (frame_number, model_id, map_number, vector) "
        "SELECT s.frame_number, s.model_id, f.map_number, CAST(ARRAY(SELECT get_byte(s.vector, i) "
        f"- 128 FROM generate_series(0, {int(dimension) - 1}) AS i ORDER BY i) AS halfvec) "
        "FROM signatures s JOIN frames f ON f.number = s.frame_number"
    )


# the nearest of them


def add_graph(database: Database, dimension: int) -> bool:
    """Link the vectors of a table (HNSW) once there are many, beside everything else.

    It is one for all maps, and a query skips what is of others. Of 30,000 vectors in 50 maps, all
    are searched by it in 25 ms (by comparing all in 85), five maps in 127 ms and one in 470; but
    comparing all of one takes 12 ms. A graph for each map would gain nothing: see `_by_graph`.

    Returns
    -------
    added : whether there was none yet, nor another worker at it
    """
    table = table_of(dimension)
    graph = f"ix_{table}_vector"
    lacks = (
        f"SELECT (SELECT count(*) FROM (SELECT 1 FROM {table} LIMIT {GRAPH_FROM}) AS block) = "
        f"{GRAPH_FROM} AND NOT EXISTS (SELECT FROM pg_index "
        f"WHERE indexrelid = to_regclass('{graph}') AND indisvalid)"
    )
    with database.read() as connection:
        if not connection.execute(text(lacks)).scalar_one():
            return False
    with database.explained(), closing(database.driver_connection()) as own:
        own.execute("SET statement_timeout = 0")
        own.execute("SET lock_timeout = 0")
        for wanted in (f"SELECT pg_try_advisory_lock({LOCKS}, {VECTORS})", lacks):
            row = own.execute(wanted).fetchone()
            if row is None or not row[0]:
                return False
        own.execute(f"DROP INDEX CONCURRENTLY IF EXISTS {graph}")  # of a worker that died
        own.execute(
            f"CREATE INDEX CONCURRENTLY {graph} ON {table} USING hnsw "
            f"(vector halfvec_l2_ops) WITH (m = {LINKS}, ef_construction = {LOOKED_AT})"
        )
        own.execute(f"ANALYZE {table}")
    return True


def nearest(
    connection: Connection, query: Bytes, model_id: str, maps: Sequence[int], count: int,
    asked: int, among: NDArray[np.int64] | None = None, barred: Iterable[int] = (), *,
    exact: bool = False,
) -> tuple[list[int], bool]:  # fmt: skip
    """Numbers of the frames whose vectors are nearest, and whether all vectors were compared.

    Parameters
    ----------
    connection : of a reading transaction
    query : (d,) uint8, a signature
    model_id : of the model that made it, and those that are compared
    maps : numbers of the maps that are searched
    count : of frames
    asked : about how many may be found, which decides between the graph and a comparison of all
    among : numbers of those that may be found, where not all may
    barred : numbers of those that may not
    exact : compare all
    """
    wanted, values = _conditions(query, model_id, maps, among, barred)
    graph = not exact and _by_graph(connection, len(query), count, asked)
    # an order that no index has makes PostgreSQL compare all that the conditions leave
    order = f"(vector <-> CAST(:query AS halfvec)){'' if graph else ' + 0'}"
    if graph:
        _steer(connection, count)
    table = table_of(len(query))
    found = connection.execute(
        text(f"SELECT frame_number FROM {table} WHERE {wanted} ORDER BY {order} LIMIT :count"),
        values | {"count": count},
    )
    near = list(found.scalars())
    if graph:
        connection.execute(text("SET LOCAL enable_sort = on"))
    return near, not graph


def count_nearer(
    connection: Connection, query: Bytes, model_id: str, map_number: int, number: int,
    distance: int, among: NDArray[np.int64] | None = None, barred: Iterable[int] = (),
) -> int:  # fmt: skip
    """How many frames of a map come before one in the order of distance, equal ones by number.

    Parameters
    ----------
    connection, query, model_id, among, barred : see `nearest`
    map_number : of the map
    number, distance : of the frame, and squared of its signature
    """
    wanted, values = _conditions(query, model_id, [map_number], among, barred)
    root = "sqrt(CAST(:distance AS double precision))"
    found = connection.execute(
        text(
            f"SELECT count(*) FROM (SELECT frame_number, vector <-> CAST(:query AS halfvec) AS d "
            f"FROM {table_of(len(query))} WHERE {wanted}) AS apart "
            f"WHERE d < {root} OR (d = {root} AND frame_number < :number)"
        ),
        values | {"number": number, "distance": distance},
    )
    return int(found.scalar_one())


def _conditions(
    query: Bytes, model_id: str, maps: Sequence[int], among: NDArray[np.int64] | None,
    barred: Iterable[int],
) -> tuple[str, dict[str, Any]]:  # fmt: skip
    """What holds of all vectors that may be found, and the values that it names."""
    numbers = ",".join(map(str, (query.astype(int) - 128).tolist()))
    values: dict[str, Any] = {"maps": list(maps), "model": model_id, "query": f"[{numbers}]"}
    wanted = "map_number = ANY(CAST(:maps AS bigint[])) AND model_id = :model"
    if gone := list(barred):
        wanted += " AND frame_number <> ALL(CAST(:barred AS bigint[]))"
        values["barred"] = gone
    if among is not None:
        wanted += " AND frame_number = ANY(CAST(:among AS bigint[]))"
        values["among"] = among.tolist()
    return wanted, values


def _by_graph(connection: Connection, dimension: int, count: int, asked: int) -> bool:
    """Whether going through the graph is cheaper than comparing the vectors that are asked for."""
    if asked < GRAPH_FROM:
        return False
    found = connection.execute(
        text(
            "SELECT c.reltuples FROM pg_index i JOIN pg_class c ON c.oid = i.indrelid "
            "WHERE i.indexrelid = to_regclass(:graph) AND i.indisvalid"
        ),
        {"graph": f"ix_{table_of(dimension)}_vector"},
    ).scalar()
    if found is None:
        return False
    there = max(float(found), asked)
    return _STEP_COST * count * there / asked < asked


def _steer(connection: Connection, count: int) -> None:
    """Have the graph searched, and searched on until there are enough, as a filter leaves few.

    In any order, as exact distances decide: pgvector's `strict_order` drops what comes late, of
    the ten nearest up to two (one map of fifty asked).
    """
    sight = min(max(count, 40), _MOST_SIGHT)
    connection.exec_driver_sql(
        f"SET LOCAL hnsw.iterative_scan = relaxed_order; SET LOCAL hnsw.ef_search = {sight}; "
        "SET LOCAL hnsw.max_scan_tuples = 2000000; SET LOCAL hnsw.scan_mem_multiplier = 8; "
        "SET LOCAL enable_sort = off"
    )


# signatures as bytes, by the driver itself: as text, which SQLAlchemy asks for, they take three
# times as long


def homes(
    connection: Connection, numbers: Collection[int], map_numbers: Collection[int]
) -> dict[int, int]:
    """Numbers of the maps of those of some frames that can be found in these maps."""
    wanted = set(map_numbers)
    found = _driven(
        connection,
        "SELECT number, map_number, state FROM frames WHERE number = ANY(%s::bigint[])",
        (list(numbers),),
    )
    return {n: of for n, of, state in found if of in wanted and state == FrameState.INDEXED}


def read(
    connection: Connection, numbers: Collection[int], map_numbers: Collection[int], model_id: str
) -> list[Row]:
    """Signatures of those of some frames that can be found in the maps, sound or not, by number."""
    # one table after the other, by nothing but its key: of a join, or a state, of tables that it
    # has no statistics of yet, the planner makes a hundred times the work
    of = homes(connection, numbers, map_numbers)
    found = _driven(
        connection,
        "SELECT frame_number, vector, checksum FROM signatures "
        "WHERE frame_number = ANY(%s::bigint[]) AND model_id = %s ORDER BY frame_number",
        (list(of), model_id),
    )
    return [(number, of[number], vector, checksum) for number, vector, checksum in found]


def sizes(connection: Connection, map_numbers: Collection[int]) -> dict[int, int]:
    """How many frames of each map can be found."""
    found = connection.execute(
        select(frames.c.map_number, func.count())
        .where(frames.c.map_number.in_(list(map_numbers)), frames.c.state == FrameState.INDEXED)
        .group_by(frames.c.map_number)
    )
    return dict.fromkeys(map_numbers, 0) | {row[0]: row[1] for row in found}


def _driven(connection: Connection, statement: str, values: Sequence[object]) -> list[Any]:
    driver: Any = connection.connection.driver_connection
    with driver.cursor(binary=True) as cursor:
        found: list[Any] = cursor.execute(statement, values).fetchall()
        return found
