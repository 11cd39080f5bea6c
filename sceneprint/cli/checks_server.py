"""What `sceneprint doctor` says of a database server and its replica; they are only read."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

from sceneprint.cli.findings import Finding, Verdict

if TYPE_CHECKING:
    from sceneprint.settings import Settings
    from sceneprint.store import Database

#: Clocks that differ by more are told, and by more than a lease are wrong, seconds.
APART_S = 2.0
#: What a commit that was acknowledged needs to survive the loss of power.
_DURABLE = ("fsync", "full_page_writes")
_ASKED = """
SELECT current_setting('server_version') AS version,
  current_setting('server_encoding') AS encoding,
  current_setting('fsync') AS fsync,
  current_setting('full_page_writes') AS full_page_writes,
  current_setting('synchronous_commit') AS synchronous_commit,
  current_setting('synchronous_standby_names') AS standbys,
  current_setting('data_checksums') AS checksums,
  current_setting('max_connections')::int
    - current_setting('superuser_reserved_connections')::int AS connections,
  (SELECT count(*) FROM pg_stat_activity WHERE backend_type = 'client backend') AS taken,
  pg_is_in_recovery() AS standby,
  (SELECT extversion FROM pg_extension WHERE extname = 'vector') AS vector,
  (SELECT default_version FROM pg_available_extensions WHERE name = 'vector') AS installable,
  has_database_privilege(current_database(), 'CREATE') AS creates
"""
_BEHIND = """
SELECT pg_is_in_recovery(), CASE WHEN pg_last_wal_receive_lsn() = pg_last_wal_replay_lsn() THEN 0
  ELSE extract(epoch FROM clock_timestamp() - pg_last_xact_replay_timestamp()) END,
  (SELECT count(*) FROM pg_stat_wal_receiver)
"""


def server(settings: Settings) -> Iterator[Finding]:
    """Findings about the database server, and the replica where one is named.

    Parameters
    ----------
    settings : whose database is looked at; of SQLite there is nothing to say
    """
    from sceneprint.errors import SceneprintError
    from sceneprint.store.database import reach_database

    database = reach_database(settings.database)
    try:
        if database.is_sqlite:
            return
        yield from _server(database, settings)
    except SceneprintError as error:
        yield Finding("WRONG", "database server", str(error))
        return
    finally:
        database.close()
    if settings.replica_url is not None:
        yield _replica(settings.replica_url.get_secret_value(), settings)


def _server(database: Database, settings: Settings) -> Iterator[Finding]:
    with database.read() as connection:
        told = dict(connection.exec_driver_sql(_ASKED).mappings().one())
        before = time.time()
        there = float(
            connection.exec_driver_sql("SELECT extract(epoch FROM clock_timestamp())").scalar_one()
        )
        after = time.time()
    text = f"PostgreSQL {told['version']}, {told['encoding']}"
    if told["standby"]:
        text += "; it is a standby, to which nothing can be written. Name the primary."
        yield Finding("WRONG", "database server", text)
        return
    yield Finding("ok", "database server", text)
    yield _durability(told)
    yield _connections(told, settings)
    yield _vector(told, settings)
    yield _clock(before, there, after, settings)


def _durability(told: Mapping[str, object]) -> Finding:
    off = [name for name in _DURABLE if told[name] == "off"]
    if off:
        text = (
            f"{', '.join(off)} off: what was acknowledged may be lost when the server's host "
            "fails. Set it on."
        )
        return Finding("WRONG", "durability", text)
    text = "commits survive the loss of power"
    if told["standbys"] and told["synchronous_commit"] == "local":
        text += "; synchronous_commit is local, so that no standby is waited for. Set it on."
        return Finding("note", "durability", text)
    if told["standbys"]:
        text += f", and of the host: a standby is waited for ({told['standbys']})"
    else:
        text += "; no standby is waited for, so that what came last may go with the host's disk"
    if told["checksums"] == "off":
        text += "; data_checksums are off, so that a damaged page may be found late"
        return Finding("note", "durability", text)
    return Finding("ok", "durability", text)


def _connections(told: Mapping[str, object], settings: Settings) -> Finding:
    from sceneprint.store.postgres import MOST

    most, taken = int(str(told["connections"])), int(str(told["taken"]))
    # a worker takes one for its work, one for its lease and one to be woken; a service as many as
    # it answers at once, and one
    wanted = 3 * settings.workers + min(settings.concurrency + settings.waiting, MOST) + 3
    text = (
        f"{most} at most (max_connections), {taken} taken now; a service and {settings.workers} "
        f"workers may take {wanted}"
    )
    if taken + wanted > most:
        return Finding("note", "connections", f"{text}. Raise max_connections, or run fewer.")
    return Finding("ok", "connections", text)


def _vector(told: Mapping[str, object], settings: Settings) -> Finding:
    wanted = settings.search == "database"
    if told["vector"] is not None:
        return Finding("ok", "pgvector", f"{told['vector']}")
    if told["installable"] is not None and told["creates"]:
        text = f"{told['installable']} is installed; the first use makes it (CREATE EXTENSION)"
        return Finding("ok", "pgvector", text)
    why = "not installed" if told["installable"] is None else "this user may not make it"
    text = (
        f"{why}: each node needs the index of the maps that it is asked about, and waits for it "
        "when it starts; all else works. Have CREATE EXTENSION vector run in this database"
    )
    verdict: Verdict = "WRONG" if wanted else "note"
    return Finding(verdict, "pgvector", f"{text}." if not wanted else f"{text}, or set "
                   "SCENEPRINT_SEARCH=auto.")  # fmt: skip


def _clock(before: float, there: float, after: float, settings: Settings) -> Finding:
    """The clocks of this host and of the server, as far as the answer's way can tell."""
    apart = max(before - there, there - after, 0.0)
    text = f"the server's differs from this host's by {apart:.1f} s"
    if apart > APART_S:
        verdict: Verdict = "WRONG" if apart > settings.lease_s else "note"
        return Finding(verdict, "clock", f"{text}. Let both follow a time server.")
    return Finding("ok", "clock", text)


def _replica(url: str, settings: Settings) -> Finding:
    from sceneprint.errors import SceneprintError
    from sceneprint.store.database import reach_database
    from sceneprint.store.revisions import known_revisions, revision_of

    try:
        database = reach_database(url)
    except SceneprintError as error:
        return Finding("WRONG", "replica", f"SCENEPRINT_REPLICA_URL: {error}")
    try:
        if database.is_sqlite:
            text = "SCENEPRINT_REPLICA_URL is no URL of PostgreSQL. Correct it, or unset it."
            return Finding("WRONG", "replica", text)
        with database.read() as connection:
            standby, behind, receives = connection.exec_driver_sql(_BEHIND).one()
            schema = revision_of(connection)
    except SceneprintError as error:
        text = f"{error} Until then the primary is asked."
        return Finding("WRONG", "replica", text)
    finally:
        database.close()
    if not standby:
        return Finding("note", "replica", f"{database.shown} is no standby, but a primary")
    if schema != known_revisions()[0]:
        return Finding("note", "replica", f"{database.shown} has schema {schema}: not used yet")
    text = f"{database.shown} is {'some time' if behind is None else f'{behind:.1f} s'} behind"
    if not receives:
        text += ", and receives nothing from its primary. See its log."
        return Finding("note", "replica", text)
    if behind is None or behind > settings.replica_lag_s:
        text += f"; SCENEPRINT_REPLICA_LAG_S is {settings.replica_lag_s:g} s: it is not used"
        return Finding("note", "replica", text)
    return Finding("ok", "replica", text)
