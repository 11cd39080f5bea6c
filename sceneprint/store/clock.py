"""The clock by which leases end and jobs are due: of the database, as those of its hosts differ.

A SQLite file has one host, and so one clock.
"""

from __future__ import annotations

import time

from sqlalchemy import ColumnElement, Connection, Float, cast, extract, func, literal, select


def now(connection: Connection) -> ColumnElement[float]:
    """The time of the statement it is part of, seconds since 1970."""
    if connection.dialect.name == "sqlite":
        return literal(time.time())
    # of the statement: the transaction may have waited for its turn since it began. Not
    # clock_timestamp(), which is another time for each row, so that no index would be used
    return cast(extract("epoch", func.statement_timestamp()), Float(53))


def read_clock(connection: Connection) -> float:
    """The time now, seconds since 1970."""
    if connection.dialect.name == "sqlite":
        return time.time()
    return float(connection.execute(select(now(connection))).scalar_one())
