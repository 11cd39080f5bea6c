"""Connections to PostgreSQL, and turns of writers.

Writers take turns as in SQLite: each transaction holds an advisory lock of the database from its
beginning to the commit. Its reads are therefore valid until it writes, and numbers are in commit
order.

Writers of a single map share that lock and lock their map exclusively, so writers of other maps run
concurrently. Their reads of the map remain valid, and its revisions are in commit order. Their
events get numbers after the commit (see `events`).
"""

from __future__ import annotations

import select
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

from sqlalchemy import URL, Connection, Dialect, Engine, create_engine, event, text
from sqlalchemy.engine import ExceptionContext
from sqlalchemy.exc import InvalidatePoolError

from sceneprint.errors import StoreAway, UnusableStore
from sceneprint.store.database_errors import database_label, is_of_old_plan
from sceneprint.store.sqlite import BUSY_S

#: First key of the advisory locks; the second is TURN or EVENTS.
LOCKS = 0x5CE7E
#: Second key of the lock for the turns of writers.
TURN = 1
#: Second key of the lock for the process that numbers events (see `events`).
EVENTS = 8
_EVENT = "at, kind, map, frame_id, job_id, data"
#: Functions and a trigger of the schema. `number_pending_events` holds its lock until the commit,
#: so that numbers are in commit order. It also runs before other events are inserted, which
#: preserves the order of the events of a map.
NUMBERING = (
    f"""
    CREATE FUNCTION number_pending_events() RETURNS void LANGUAGE plpgsql AS $$
    BEGIN
        PERFORM pg_advisory_xact_lock({LOCKS}, {EVENTS});
        PERFORM set_config('sceneprint.numbering', 'on', true);
        WITH pending AS (DELETE FROM pending_events RETURNING *)
        INSERT INTO events ({_EVENT}) SELECT {_EVENT} FROM pending ORDER BY number;
        PERFORM set_config('sceneprint.numbering', '', true);
    END $$
    """,
    """
    CREATE FUNCTION number_pending_events_first() RETURNS trigger LANGUAGE plpgsql AS $$
    BEGIN
        PERFORM number_pending_events();
        RETURN NULL;
    END $$
    """,
    """
    CREATE TRIGGER number_pending_events_first BEFORE INSERT ON events FOR EACH STATEMENT
    WHEN (current_setting('sceneprint.numbering', true) IS DISTINCT FROM 'on')
    EXECUTE FUNCTION number_pending_events_first()
    """,
)
#: First key of the locks of single maps; the second is derived from the map number.
MAP_LOCKS = 0x5CE7F
#: Mask of the bits of a map number in its lock. Maps with equal bits share a lock.
LOCK_BITS = 0x7FFFFFFF
#: Time limits, in seconds, for statements and for idle transactions, so that a hanging client loses
#: its turn.
STATEMENT_S, IDLE_S = 60.0, 30.0
#: Maximum seconds that a migration waits for its turn.
MIGRATION_S = 600.0
#: Maximum seconds that a writer waits after another writer has timed out. With a shorter limit,
#: writers would leave the queue early, join it again at the end, and might never succeed.
HELD_S = 2.0
#: Maximum number of idle connections of a process, and of all its connections.
IDLE_CONNECTIONS, MOST = 8, 32
#: Idle seconds after which a connection is tested by a round trip. Connections closed by the server
#: are detected without a test.
UNTRIED_S = 1.0
#: Age in seconds at which a connection is replaced, to spread connections over new servers.
_OLD_S = 1800
#: Default libpq options, which detect an unreachable server within ten seconds.
_CONNECT = {
    "connect_timeout": "3",
    "application_name": "sceneprint",
    "client_encoding": "utf8",
    "keepalives_idle": "3",
    "keepalives_interval": "2",
    "keepalives_count": "3",
    "tcp_user_timeout": "9000",
}
#: Oldest supported version of PostgreSQL.
_OLDEST = 14
_WARNED, _USED = "sceneprint_warned", "sceneprint_used"
#: Connection option: the transaction is a single statement.
SINGLE = "sceneprint_single"
#: Connection option: the message has several statements, and the last returns rows.
_MESSAGE = "sceneprint_message"


def open_postgres(url: URL) -> Engine:
    """Create an engine with configured connections; do not connect yet."""
    engine = create_engine(
        url,
        connect_args=connect_options(url),
        isolation_level="READ COMMITTED",  # each statement of a writer sees all earlier commits
        pool_recycle=_OLD_S,
        pool_size=IDLE_CONNECTIONS,
        max_overflow=MOST - IDLE_CONNECTIONS,
        pool_timeout=BUSY_S,
    )
    event.listen(engine, "connect", configure)
    event.listen(engine, "connect", _watch_commits)
    event.listen(engine, "checkin", _note_use)
    event.listen(engine, "checkout", partial(_require_alive, engine.dialect))
    event.listen(engine, "do_execute", _execute)
    event.listen(engine, "do_execute_no_params", _refuse_single)
    event.listen(engine, "do_executemany", _refuse_single)
    event.listen(engine, "commit", forget_warnings)
    event.listen(engine, "handle_error", _drop_connections)
    return engine


def connect_options(url: URL) -> dict[str, str]:
    """Return the default libpq options that a URL does not override."""
    return {name: value for name, value in _CONNECT.items() if name not in url.query}


def configure(connection: Any, _record: object = None) -> None:
    """Configure a psycopg connection.

    Raises
    ------
    UnusableStore : If the server is too old, or the encoding of the database is not UTF-8.
    """
    version = connection.info.server_version // 10_000
    encoding = connection.info.parameter_status("server_encoding")
    if version < _OLDEST or encoding != "UTF8":
        connection.close()
        raise UnusableStore(
            f"The server is PostgreSQL {version}, and the database has the encoding {encoding}. "
            f"Use version {_OLDEST} or later, and a database created with ENCODING 'UTF8'."
        )
    connection.adapters.register_dumper(str, _texts())
    options = {**_CONNECT, **connection.info.get_parameters()}
    before, connection.autocommit = connection.autocommit, True
    connection.execute(
        "SELECT set_config('default_transaction_isolation', 'read committed', false),"
        " set_config('lock_timeout', %s, false), set_config('statement_timeout', %s, false),"
        " set_config('idle_in_transaction_session_timeout', %s, false),"
        # the server must detect unreachable clients quickly; otherwise the locks of their sessions
        # would remain for hours
        " set_config('tcp_keepalives_idle', %s, false),"
        " set_config('tcp_keepalives_interval', %s, false),"
        " set_config('tcp_keepalives_count', %s, false),"
        # an acknowledged commit survives a power failure and, with a synchronous standby, the loss
        # of the server; values stronger than `on` are not changed
        " set_config('synchronous_commit', CASE current_setting('synchronous_commit')"
        " WHEN 'off' THEN 'on' ELSE current_setting('synchronous_commit') END, false)",
        [
            *(_milliseconds(seconds) for seconds in (BUSY_S, STATEMENT_S, IDLE_S)),
            *(options[f"keepalives_{name}"] for name in ("idle", "interval", "count")),
        ],
    )
    connection.autocommit = before


def timeline_of(connection: Any) -> str | None:
    """Return the WAL timeline of the server of a psycopg connection; None for a standby."""
    before, connection.autocommit = connection.autocommit, True
    row = connection.execute(
        "SELECT CASE WHEN pg_is_in_recovery() THEN NULL"
        " ELSE left(pg_walfile_name(pg_current_wal_lsn()), 8) END"
    ).fetchone()
    connection.autocommit = before
    return None if row is None else row[0]


@cache
def _texts() -> type[Any]:
    """Return a psycopg dumper that replaces NUL characters, which PostgreSQL cannot store.

    The API refuses NUL in most texts, but not in unvalidated texts such as audit data.
    """
    from psycopg.types.string import StrDumperUnknown

    class Texts(StrDumperUnknown):
        """Dumper that replaces NUL characters in strings."""

        def dump(self, obj: str) -> Any:
            """Encode a text as bytes."""
            return super().dump(obj.replace("\0", "\ufffd") if "\0" in obj else obj)

    return Texts


def allow(connection: Connection, seconds: float) -> None:
    """Set the time limit for statements and idle times of a PostgreSQL transaction; 0: none."""
    if connection.dialect.name == "postgresql":
        for name in ("statement_timeout", "idle_in_transaction_session_timeout"):
            connection.execute(
                text("SELECT set_config(:name, :value, true)"),
                {"name": name, "value": _milliseconds(seconds)},
            )


def begin(connection: Connection, *statements: str) -> Any:
    """Begin a transaction and execute its first statements in a single message.

    Parameters
    ----------
    connection : connection in autocommit mode, so that BEGIN needs no separate round trip
    statements : statements without parameters

    Returns
    -------
    row : first row of the last statement; None without rows
    """
    message = "; ".join(("BEGIN", *statements))
    answer = connection.exec_driver_sql(message, execution_options={_MESSAGE: True})
    return answer.first() if answer.returns_rows else None


class MapsInUse(Exception):
    """Error if another transaction locks a map for too long; nothing was written."""


@dataclass(eq=False)
class SingleStatement:
    """A transaction of one statement: wait for a turn, execution and commit in one round trip.

    Other writers therefore do not wait for the latency of this client. The statement sees all
    commits before its turn.

    Parameters
    ----------
    wait_s : maximum seconds to wait for the turn
    maps_wait_s : maximum seconds to wait for each map; default: `wait_s`
    schema : last known schema, to be checked; None skips the check
    executed : whether the statement has been sent
    """

    map_numbers: Collection[int]
    wait_s: float
    maps_wait_s: float | None
    schema: KnownSchema | None
    executed: bool = False

    def execute(self, cursor: Any, statement: str, parameters: Any) -> None:
        """Execute the statement on a psycopg cursor in autocommit mode.

        Raises
        ------
        NewerSchema : If another version migrated the store, and this version cannot write to it.
        MapsInUse : If a map is in use for longer than `maps_wait_s`.
        ValueError : If a statement has already been executed.
        """
        import psycopg

        if self.executed:
            raise ValueError("a single-statement transaction has a second statement")
        self.executed = True
        if self.schema is not None and self.schema.current is None:
            self.schema.read(cursor.connection)
        sent = None if self.schema is None else self.schema.current
        try:
            self._send(cursor, statement, parameters)
        except psycopg.errors.DivisionByZero:  # the schema has changed, see _MAPS_AND_SCHEMA
            if self.schema is None:
                raise
            self.schema.read(cursor.connection)
            if self.schema.current == sent:  # not yet read by another thread
                raise
            self._send(cursor, statement, parameters)

    def _send(self, cursor: Any, statement: str, parameters: Any) -> None:
        """Send, in one message, the locks of turn and maps, the schema check and the statement."""
        import psycopg

        connection = cursor.connection
        # sort, to prevent deadlocks
        locks = sorted({number & LOCK_BITS for number in self.map_numbers})
        maps_wait_s = self.wait_s if self.maps_wait_s is None else self.maps_wait_s
        turn = connection.cursor()
        try:
            # a pipeline without BEGIN is a single transaction
            with connection.pipeline():
                # no statement limit: it would interrupt the wait of a commit for its standby, and
                # the commit would be acknowledged although the standby may not have it
                turn.execute(
                    "SELECT set_config('statement_timeout', '0', true),"
                    " set_config('lock_timeout', %s, true), pg_advisory_xact_lock_shared(%s, %s),"
                    " set_config('lock_timeout', %s, true)",
                    (_milliseconds(self.wait_s), LOCKS, TURN, _milliseconds(maps_wait_s)),
                )
                if self.schema is None:
                    connection.execute(f"{_MAPS} {_NUMBERS}", (MAP_LOCKS, locks))
                else:
                    schema = self.schema.current or ()
                    connection.execute(_MAPS_AND_SCHEMA, (MAP_LOCKS, *schema, locks))
                cursor.execute(statement, parameters)
        except psycopg.errors.LockNotAvailable as error:
            if turn.pgresult is None or self.maps_wait_s is None:
                raise
            raise MapsInUse from error


#: Query of the schema revision of a store, and of the oldest revision that may write to it.
SCHEMA = "SELECT version_num, least_revision FROM alembic_version, schema_range"
#: Query that locks maps in the order of their numbers.
_MAPS, _NUMBERS = "SELECT pg_advisory_xact_lock(%s, number)", "FROM unnest(%s::integer[]) AS number"
#: Query that aborts the transaction by a division by zero if the schema has changed. During
#: the turn of this process, the schema cannot change.
_MAPS_AND_SCHEMA = (
    f"{_MAPS}, (SELECT 1 / count(*) FROM alembic_version, schema_range"
    f" WHERE version_num = %s AND least_revision = %s) {_NUMBERS}"
)


class KnownSchema:
    """The schema of a store, as last read by this process.

    Parameters
    ----------
    check : function that raises an error if this process cannot write to a schema
    """

    def __init__(self, check: Callable[[Any], None]) -> None:
        self._check = check
        self.current: tuple[str, str] | None = None

    def read(self, connection: Any) -> None:
        """Read the schema again on a psycopg connection, and call `check`."""
        row = connection.execute(SCHEMA).fetchone()
        self._check(row)
        self.current = row


def _execute(cursor: Any, statement: str, parameters: Any, context: Any) -> bool:
    """Execute a statement with the option `_MESSAGE` or SINGLE; return False for others."""
    if _MESSAGE in context.execution_options:
        cursor.execute(statement)
        while cursor.nextset():
            pass
        return True
    single = context.execution_options.get(SINGLE)
    if single is None:
        return False
    single.execute(cursor, statement, parameters)
    return True


def _refuse_single(_cursor: Any, _statement: str, *others: Any) -> None:
    """Raise ValueError for SINGLE, which requires a statement with one set of parameters."""
    if others[-1].execution_options.get(SINGLE) is not None:
        raise ValueError("a single-statement transaction requires one set of parameters")


def take_turn(
    connection: Connection, wait_s: float, query: str | None = None, map_number: int | None = None
) -> Any:
    """Begin a transaction, and wait for a turn to write, in one message.

    Parameters
    ----------
    wait_s : maximum seconds to wait
    query : query of one row, executed in the turn
    map_number : number of the only map that the transaction writes to; None for all maps

    Returns
    -------
    row : row of `query`; None without a query
    """
    message = ["SET LOCAL statement_timeout = 0"]  # see SingleStatement
    turn = f"SELECT pg_advisory_xact_lock({LOCKS}, {TURN})"
    if map_number is not None:
        turn = (
            f"SELECT pg_advisory_xact_lock_shared({LOCKS}, {TURN}); "
            f"SELECT pg_advisory_xact_lock({MAP_LOCKS}, {map_number & LOCK_BITS})"
        )
    if wait_s == BUSY_S:
        message.append(turn)
    else:
        # a migration waits longer than BUSY_S, and then has no time limit for locks
        after = "0" if wait_s > BUSY_S else _milliseconds(BUSY_S)
        message += [f"SET LOCAL lock_timeout = {_milliseconds(wait_s)}", turn]
        message.append(f"SET LOCAL lock_timeout = {after}")
    row = begin(connection, *message, *(() if query is None else (query,)))
    if wait_s > BUSY_S:
        allow(connection, 0)
    return None if query is None else row


def require_synchronous(connection: Connection) -> None:
    """Check that the commit waited for a synchronous standby.

    Raises
    ------
    StoreAway : If the wait was interrupted, which the server reports only as a warning.
    """
    if _WARNED in connection.info:
        raise StoreAway(
            f"{database_label(connection.engine.url)}: An operator ended the wait for a standby. "
            "The commit is stored, but is lost if the server fails before a standby receives it. "
            "Restart the standby, or remove it from synchronous_standby_names."
        )


def _note_use(_connection: Any, record: Any) -> None:
    record.info[_USED] = time.monotonic()


def _require_alive(dialect: Dialect, connection: Any, record: Any, _proxy: object) -> None:
    """Test a connection after idle time, or if it has input, such as a shutdown message.

    If it is broken, drop all pooled connections.
    """
    used = record.info.get(_USED)
    if used is None:
        return
    if time.monotonic() - used < UNTRIED_S and not _has_input(connection):
        return
    try:
        dialect.do_ping(connection)
    except dialect.loaded_dbapi.Error as error:
        if dialect.is_disconnect(error, connection, None):
            raise InvalidatePoolError from error
        raise


def _has_input(connection: Any) -> bool:
    """Return whether the server has sent unrequested input."""
    poll = select.poll()
    poll.register(connection.fileno(), select.POLLIN)
    return bool(poll.poll(0))


def _watch_commits(connection: Any, record: Any) -> None:
    """Record warnings: a COMMIT causes them only if the wait for its standby was interrupted."""
    if not hasattr(connection, "add_notice_handler"):
        return

    def warned(notice: Any) -> None:
        if notice.severity_nonlocalized == "WARNING":
            record.info[_WARNED] = True

    connection.add_notice_handler(warned)


def forget_warnings(connection: Connection) -> None:
    """Discard the warnings of statements before a COMMIT."""
    connection.info.pop(_WARNED, None)


def _drop_connections(context: ExceptionContext) -> None:
    """Drop all connections after errors of a standby or of outdated prepared statements.

    New connections may reach the primary.
    """
    error = context.original_exception
    if getattr(error, "sqlstate", None) in ("25006", "26000") or is_of_old_plan(error):
        context.is_disconnect = True


def _milliseconds(seconds: float) -> str:
    return str(int(1000 * seconds))
