"""How PostgreSQL is set up: what a connection is told, and how a turn is taken.

Writers take turns as they do in SQLite: each begins with one advisory lock of the database, held
until its commit. So what a transaction reads stays true until it writes, and numbers that it is
given are in the order of the commits.

Writers of one map alone share that lock, and have their map's to themselves: those of other maps
write at the same time. What they read of their map stays true, and its revisions are in the order
of the commits. Their events get no number before they are committed (see `events`).
"""

from __future__ import annotations

import select
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass
from functools import cache, partial
from typing import TYPE_CHECKING, Any

from sqlalchemy import URL, Connection, Dialect, Engine, create_engine, event, text
from sqlalchemy.engine import ExceptionContext
from sqlalchemy.exc import InvalidatePoolError

from sceneprint.errors import StoreAway, UnusableStore
from sceneprint.store.database_errors import database_label, is_of_old_plan
from sceneprint.store.sqlite import BUSY_S

if TYPE_CHECKING:
    pass


#: Advisory locks are two numbers: this one, which is ours alone, and what is locked.
LOCKS = 0x5CE7E
#: Whose turn it is to write.
TURN = 1
#: Who numbers events (see `events`).
EVENTS = 8
#: The first number of locks of single maps; the second is that of the map.
MAP_LOCKS = 0x5CE7F
#: Of maps whose numbers have the same last bits, writers take turns.
LOCK_BITS = 0x7FFFFFFF
#: Seconds for one statement, and for a transaction in which nothing is asked: a client that fell
#: silent must not keep the turn from all others.
STATEMENT_S, IDLE_S = 60.0, 30.0
#: Seconds that a new schema may wait for its turn: another process may be making it.
MIGRATION_S = 600.0
#: Seconds a writer waits after somebody has waited in vain: the queue is of the whole fleet, and
#: who leaves it after a moment, and begins at its end again, would never get through.
HELD_S = 2.0
#: Connections that a process keeps, and has at most.
KEPT, MOST = 8, 32
#: Seconds without use after which a connection is tried before it is used: that costs a round trip.
#: One that the server ended is found out at once.
UNTRIED_S = 1.0
#: Seconds after which a connection is made anew, so that servers added since get their share.
_OLD_S = 1800
#: What of libpq is set where the URL does not: a server that is gone, and sent no word, is found
#: out within ten seconds.
_CONNECT = {
    "connect_timeout": "3",
    "application_name": "sceneprint",
    "client_encoding": "utf8",
    "keepalives_idle": "3",
    "keepalives_interval": "2",
    "keepalives_count": "3",
    "tcp_user_timeout": "9000",
}
#: Oldest version that is known to do.
_OLDEST = 14
_WARNED, _USED = "sceneprint_warned", "sceneprint_used"
#: Option of a connection: its only statement is a transaction of its own.
SINGLE = "sceneprint_single"
#: Option of a statement: it is several, of which the last one has the answer.
_MESSAGE = "sceneprint_message"


def open_postgres(url: URL) -> Engine:
    """An engine whose connections are told what all are told; none is opened yet."""
    engine = create_engine(
        url,
        connect_args=connect_options(url),
        isolation_level="READ COMMITTED",  # a writer's statements see all that was committed
        pool_recycle=_OLD_S,
        pool_size=KEPT,
        max_overflow=MOST - KEPT,
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
    event.listen(engine, "handle_error", _leave_behind)
    return engine


def connect_options(url: URL) -> dict[str, str]:
    """What of libpq is set beside what a URL says."""
    return {name: value for name, value in _CONNECT.items() if name not in url.query}


def configure(connection: Any, _record: object = None) -> None:
    """Tell a connection of psycopg what all of them are told.

    Raises
    ------
    UnusableStore : the server is too old, or its database is not of UTF-8.
    """
    version = connection.info.server_version // 10_000
    encoding = connection.info.parameter_status("server_encoding")
    if version < _OLDEST or encoding != "UTF8":
        connection.close()
        raise UnusableStore(
            f"The server is PostgreSQL {version}, and the database of encoding {encoding}. Version "
            f"{_OLDEST} or later is needed, and a database made with ENCODING 'UTF8'."
        )
    connection.adapters.register_dumper(str, _texts())
    given = {**_CONNECT, **connection.info.get_parameters()}
    before, connection.autocommit = connection.autocommit, True
    connection.execute(
        "SELECT set_config('default_transaction_isolation', 'read committed', false),"
        " set_config('lock_timeout', %s, false), set_config('statement_timeout', %s, false),"
        " set_config('idle_in_transaction_session_timeout', %s, false),"
        # the server gives up a client whose host is gone as soon as the client would give it up:
        # locks of its session would else stay for hours
        " set_config('tcp_keepalives_idle', %s, false),"
        " set_config('tcp_keepalives_interval', %s, false),"
        " set_config('tcp_keepalives_count', %s, false),"
        # a commit that was acknowledged survives the power, and the fall of the server where a
        # standby is waited for: more than `on` is left as it is
        " set_config('synchronous_commit', CASE current_setting('synchronous_commit')"
        " WHEN 'off' THEN 'on' ELSE current_setting('synchronous_commit') END, false)",
        [
            *(_milliseconds(seconds) for seconds in (BUSY_S, STATEMENT_S, IDLE_S)),
            *(given[f"keepalives_{name}"] for name in ("idle", "interval", "count")),
        ],
    )
    connection.autocommit = before


def timeline_of(connection: Any) -> str | None:
    """Return the timeline that the server of a psycopg connection writes; None of a standby."""
    before, connection.autocommit = connection.autocommit, True
    row = connection.execute(
        "SELECT CASE WHEN pg_is_in_recovery() THEN NULL"
        " ELSE left(pg_walfile_name(pg_current_wal_lsn()), 8) END"
    ).fetchone()
    connection.autocommit = before
    return None if row is None else row[0]


@cache
def _texts() -> type[Any]:
    """How texts are handed over: PostgreSQL has none with NUL, and nothing is found by such a one.

    What is stored has none: the API refuses it. In what is only noted, such as whom a request was
    about, another character takes its place.
    """
    from psycopg.types.string import StrDumperUnknown

    class Texts(StrDumperUnknown):
        """Texts without NUL."""

        def dump(self, obj: str) -> Any:
            """As bytes."""
            return super().dump(obj.replace("\0", "\ufffd") if "\0" in obj else obj)

    return Texts


def allow(connection: Connection, seconds: float) -> None:
    """Let statements of this transaction, and pauses between them, take so long; 0: any time."""
    if connection.dialect.name == "postgresql":
        for name in ("statement_timeout", "idle_in_transaction_session_timeout"):
            connection.execute(
                text("SELECT set_config(:name, :value, true)"),
                {"name": name, "value": _milliseconds(seconds)},
            )


def begin(connection: Connection, *statements: str) -> Any:
    """Begin a transaction, in one message with its first statements, of which each sees what was
    committed before it.

    Parameters
    ----------
    connection : that commits each statement at once, as its `isolation_level` says: what begins
        transactions by itself takes a round trip for that
    statements : without parameters

    Returns
    -------
    row : of the last statement; None where it has none
    """
    message = "; ".join(("BEGIN", *statements))
    answer = connection.exec_driver_sql(message, execution_options={_MESSAGE: True})
    return answer.first() if answer.returns_rows else None


class MapsInUse(Exception):
    """Another transaction had a map for longer than was waited for it; nothing was written."""


@dataclass(eq=False)
class SingleStatement:
    """A transaction of one statement: it takes its turn, is executed and committed in one round
    trip. Others of its maps wait for that long, wherever the client is.

    It sees what was committed before its turn.

    Parameters
    ----------
    map_numbers : of the only maps that are written to
    wait_s : seconds to wait for the turn
    maps_wait_s : seconds to wait for one of the maps, once it is the turn of writers of maps; None:
        as long as for that
    schema : what this process knows of the schema; None: that is not looked at
    executed : whether it was sent
    """

    map_numbers: Collection[int]
    wait_s: float
    maps_wait_s: float | None
    schema: KnownSchema | None
    executed: bool = False

    def execute(self, cursor: Any, statement: str, parameters: Any) -> None:
        """Execute it on a cursor of psycopg that commits each statement.

        Raises
        ------
        NewerSchema : another version has brought the store beyond what this one may write.
        MapsInUse : a map was not free within `maps_wait_s`.
        ValueError : it is the second.
        """
        import psycopg

        if self.executed:
            raise ValueError("a transaction of a single statement has a second one")
        self.executed = True
        if self.schema is not None and self.schema.found is None:
            self.schema.look(cursor.connection)
        sent = None if self.schema is None else self.schema.found
        try:
            self._send(cursor, statement, parameters)
        except psycopg.errors.DivisionByZero:  # nothing was written
            if self.schema is None:
                raise
            self.schema.look(cursor.connection)
            if self.schema.found == sent:  # another thread may have found the new one before
                raise
            self._send(cursor, statement, parameters)

    def _send(self, cursor: Any, statement: str, parameters: Any) -> None:
        import psycopg

        connection = cursor.connection
        # in one order, so that nobody waits for one who waits for him
        locks = sorted({number & LOCK_BITS for number in self.map_numbers})
        maps_wait_s = self.wait_s if self.maps_wait_s is None else self.maps_wait_s
        turn = connection.cursor()
        try:
            # without a BEGIN, all up to the end of the pipeline is one transaction
            with connection.pipeline():
                # a commit that waits for its standby would be cut off by the limit of statements,
                # and be acknowledged although the standby may lack it
                turn.execute(
                    "SELECT set_config('statement_timeout', '0', true),"
                    " set_config('lock_timeout', %s, true), pg_advisory_xact_lock_shared(%s, %s),"
                    " set_config('lock_timeout', %s, true)",
                    (_milliseconds(self.wait_s), LOCKS, TURN, _milliseconds(maps_wait_s)),
                )
                if self.schema is None:
                    connection.execute(f"{_MAPS} {_NUMBERS}", (MAP_LOCKS, locks))
                else:
                    known = self.schema.found or ()
                    connection.execute(_MAPS_AND_SCHEMA, (MAP_LOCKS, *known, locks))
                cursor.execute(statement, parameters)
        except psycopg.errors.LockNotAvailable as error:
            if turn.pgresult is None or self.maps_wait_s is None:
                raise
            raise MapsInUse from error


#: The schema of a store, and the oldest one whose processes may write to it.
SCHEMA = "SELECT version_num, least_revision FROM alembic_version, schema_range"
#: The locks of maps, one after the other.
_MAPS, _NUMBERS = "SELECT pg_advisory_xact_lock(%s, number)", "FROM unnest(%s::integer[]) AS number"
#: Divides by zero if the schema is another one, so that the rest of the transaction fails. The
#: schema stays the same while this process has its turn.
_MAPS_AND_SCHEMA = (
    f"{_MAPS}, (SELECT 1 / count(*) FROM alembic_version, schema_range"
    f" WHERE version_num = %s AND least_revision = %s) {_NUMBERS}"
)


class KnownSchema:
    """The schema of a store, as a process found it last, and may write to it.

    Parameters
    ----------
    check : raises where it may not write to the one that was found
    """

    def __init__(self, check: Callable[[Any], None]) -> None:
        self._check = check
        self.found: tuple[str, str] | None = None

    def look(self, connection: Any) -> None:
        """Find it again, by a connection of psycopg.

        Raises
        ------
        Exception : of `check`
        """
        found = connection.execute(SCHEMA).fetchone()
        self._check(found)
        self.found = found


def _execute(cursor: Any, statement: str, parameters: Any, context: Any) -> bool:
    """Execute what is several statements, and go to the answer of the last one; or what is a
    transaction of its own. Any other statement is SQLAlchemy's.
    """
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
    """See that what is no single statement with parameters is not sent as one."""
    if others[-1].execution_options.get(SINGLE) is not None:
        raise ValueError("a transaction of a single statement has one with parameters")


def take_turn(
    connection: Connection, wait_s: float, asked: str | None = None, map_number: int | None = None
) -> Any:
    """Begin a transaction, and wait for a writer's turn.

    All of it is one message: once the turn is there, nobody else writes until what is sent next has
    come, and that takes a round trip.

    Parameters
    ----------
    connection : see `begin`
    wait_s : seconds to wait
    asked : a query of one row, answered when it is its turn
    map_number : of the only map that is written to; None: anything may be

    Returns
    -------
    row : of `asked`
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
        # what is waited for so long is done without haste; others find the usual time again
        after = "0" if wait_s > BUSY_S else _milliseconds(BUSY_S)
        message += [f"SET LOCAL lock_timeout = {_milliseconds(wait_s)}", turn]
        message.append(f"SET LOCAL lock_timeout = {after}")
    row = begin(connection, *message, *(() if asked is None else (asked,)))
    if wait_s > BUSY_S:
        allow(connection, 0)
    return None if asked is None else row


def require_synchronous(connection: Connection) -> None:
    """See that what was committed is where a commit has to be.

    Raises
    ------
    StoreAway : somebody ended the wait for a standby; the server says so in passing.
    """
    if _WARNED in connection.info:
        raise StoreAway(
            f"{database_label(connection.engine.url)}: the wait for a standby was ended by "
            "hand. What was written is there, and lost if the server falls before a standby "
            "follows. Bring the standby back, or take it out of synchronous_standby_names."
        )


def _note_use(_connection: Any, record: Any) -> None:
    record.info[_USED] = time.monotonic()


def _require_alive(dialect: Dialect, connection: Any, record: Any, _proxy: object) -> None:
    """Try a connection that was not used for a while, or to which the server has said something
    since: as a rule that it ends. Where it is broken, none is kept.
    """
    used = record.info.get(_USED)
    if used is None:  # it is new
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
    """Whether a server has sent something that was not asked for."""
    found = select.poll()
    found.register(connection.fileno(), select.POLLIN)
    return bool(found.poll(0))


def _watch_commits(connection: Any, record: Any) -> None:
    """Note warnings: a COMMIT has one only where it does not wait for its standby any more."""
    if not hasattr(connection, "add_notice_handler"):
        return

    def warned(said: Any) -> None:
        if said.severity_nonlocalized == "WARNING":
            record.info[_WARNED] = True

    connection.add_notice_handler(warned)


def forget_warnings(connection: Connection) -> None:
    """Before a COMMIT, those of the statements before it."""
    connection.info.pop(_WARNED, None)


def _leave_behind(context: ExceptionContext) -> None:
    """Give all connections up whose server is a standby, as the next may lead to the one that
    writes; and those that prepared statements for tables that another process changed.
    """
    error = context.original_exception
    if getattr(error, "sqlstate", None) in ("25006", "26000") or is_of_old_plan(error):
        context.is_disconnect = True


def _milliseconds(seconds: float) -> str:
    return str(int(1000 * seconds))
