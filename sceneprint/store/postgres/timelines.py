"""Timelines of a PostgreSQL server: no process goes back to an earlier one.

A standby that is promoted begins a timeline of its own. Its old primary, where it returns, still
writes the one before, and what it acknowledges is lost when it is made a standby. A process that
knows the later timeline refuses it, and connects to the next host of its URL.

    hosts  --Timelines.connect-->  connection to a primary  --Timelines.follow-->  timeline.json

The note lets processes that begin later, on whatever host, refuse the old primary too.
"""

from __future__ import annotations

import json
import logging
import math
import threading
import time
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from sqlalchemy import Dialect, Engine, event
from sqlalchemy.exc import InvalidatePoolError

from sceneprint.errors import StoreAway, UnusableStore
from sceneprint.store.blobs.folder import TIMELINE, Blobs
from sceneprint.store.database_errors import database_label

if TYPE_CHECKING:
    import psycopg

log = logging.getLogger(__name__)

#: Seconds for which what was noted beside the blobs is believed to be the newest.
COMPARED_S = 5.0
_NUMBER = (
    "CASE WHEN pg_is_in_recovery() THEN NULL"
    " ELSE left(pg_walfile_name(pg_current_wal_lsn()), 8) END"
)
_ASKED = f"SELECT (pg_control_system()).system_identifier::text, {_NUMBER}"
#: Where an administrator lets nobody ask for the system.
_ASKED_LESS = f"SELECT '', {_NUMBER}"
#: In the notes of a pooled connection: the timeline that its server writes.
_OF_CONNECTION = "sceneprint_timeline"


@dataclass(frozen=True)
class Timeline:
    """What a primary writes.

    Parameters
    ----------
    system : identifier that it has in common with its standbys, and with what was restored from
        its files
    number : greater than that of the timeline which it branched off from
    """

    system: str
    number: int

    def __str__(self) -> str:
        return f"{self.system}/{self.number:08X}"


class Timelines:
    """The newest timeline of each system that a process knows of; safe to share between threads.

    Parameters
    ----------
    engine : whose new connections are those of `connect`
    """

    def __init__(self, engine: Engine) -> None:
        self._url = engine.url
        self._lock = threading.Lock()
        self._newest: dict[str, int] = {}
        self._blobs: Blobs | None = None
        self._compared = -math.inf
        self._refused: tuple[str, str] | None = None
        #: What is wrong with the old primary that was refused last, and what to do; None: none was.
        self.refused: str | None = None
        #: That of the last connection to a primary.
        self.current: Timeline | None = None
        event.listen(engine, "do_connect", self._connect)
        event.listen(engine, "checkout", self._require_newest)

    def connect(self, *args: Any, **options: Any) -> tuple[psycopg.Connection[Any], Any]:
        """Connect to the first host that is no old primary, as `psycopg.connect` does otherwise.

        Returns
        -------
        connection, timeline : None of a standby

        Raises
        ------
        StoreAway : only old primaries can be reached.
        psycopg.Error : no host can be.
        """
        import psycopg

        hosts = _hosts(options)
        while True:
            connection = psycopg.connect(*args, **options)
            try:
                found = _timeline_of(connection)
                place = connection.info.host, str(connection.info.port)
                is_usable = found is None or self._admit(found)
            except BaseException:
                connection.close()
                raise
            if found is None or is_usable:
                return connection, found
            connection.close()
            message = self._message(place, found)
            if self._refused != place:  # it is told once
                self._refused, self.refused = place, message
                log.error("old primary refused", extra={"reason": message})
            left = [one for one in hosts if one != place]
            if len(left) in (0, len(hosts)):
                raise StoreAway(message)
            hosts = left
            options["host"] = ",".join(host for host, _ in hosts)
            options["port"] = ",".join(port for _, port in hosts)

    def follow(self, blobs: Blobs) -> None:
        """Note the newest timeline beside the blobs from now on, and learn what is noted there.

        Where the blobs are away, nothing is learnt. Connections that are open to an old primary are
        given up when they are used next.
        """
        self._blobs = blobs
        self._compare_note()

    def learn(self, note: bytes | None) -> Timeline | None:
        """Learn what is noted beside the blobs, and return it; None where nothing that can be read
        is.
        """
        noted = None if note is None else _parsed(note)
        if noted is not None:
            with self._lock:
                before = self._newest.get(noted.system, 0)
                self._newest[noted.system] = max(before, noted.number)
        return noted

    def _compare_note(self) -> None:
        """Learn what is noted beside the blobs, and note what is newer; neither where they are
        away.
        """
        if self._blobs is None:
            return
        self._compared = time.monotonic()
        try:
            noted = self.learn(self._blobs.get_note(TIMELINE))
            current = self.current
            if current is None or not self._is_newest(current) or current == noted:
                return
            self._blobs.put_note(TIMELINE, json.dumps(vars(current)).encode())
        except UnusableStore as error:
            log.warning("timeline note unavailable", extra={"error": str(error)})

    def _admit(self, found: Timeline) -> bool:
        """Whether a primary may be used: none writes a later timeline."""
        if time.monotonic() - self._compared > COMPARED_S:  # others may have used a later one
            self._compare_note()
        with self._lock:
            before = self._newest.get(found.system, 0)
            if found.number < before:
                return False
            self._newest[found.system] = found.number
            is_new = self.current is None or found != self.current
            self.current = found
        if is_new:
            self._compare_note()
        return True

    def _is_newest(self, found: Timeline) -> bool:
        with self._lock:
            return found.number >= self._newest.get(found.system, 0)

    def _connect(
        self, _dialect: Dialect, record: Any, args: Any, options: dict[str, Any]
    ) -> psycopg.Connection[Any]:
        connection, found = self.connect(*args, **options)
        record.info[_OF_CONNECTION] = found
        return connection

    def _require_newest(self, _connection: Any, record: Any, _proxy: object) -> None:
        """Give all connections up where one leads to an old primary."""
        found = record.info.get(_OF_CONNECTION)
        if found is not None and not self._is_newest(found):
            raise InvalidatePoolError

    def _message(self, place: tuple[str, str], found: Timeline) -> str:
        with self._lock:
            newest = self._newest[found.system]
        return (
            f"{database_label(self._url)}: the server {place[0]}:{place[1]} is an old primary: it "
            f"writes timeline {found.number}, and a standby that was promoted since writes "
            f"{newest}. Stop it, or make it a standby. If you restored the earlier one "
            f"on purpose, remove {TIMELINE} beside the blobs, and start all processes again."
        )


def _hosts(options: dict[str, Any]) -> list[tuple[str, str]]:
    """Hosts and ports that are tried in turn."""
    hosts = str(options.get("host", "")).split(",")
    ports = str(options.get("port", "")).split(",")
    if len(ports) == 1:
        ports *= len(hosts)
    return [(host, port or "5432") for host, port in zip(hosts, ports, strict=False)]


def _timeline_of(connection: psycopg.Connection[Any]) -> Timeline | None:
    import psycopg

    before, connection.autocommit = connection.autocommit, True
    try:
        row = connection.execute(_ASKED).fetchone()
    except psycopg.errors.InsufficientPrivilege:
        row = connection.execute(_ASKED_LESS).fetchone()
    connection.autocommit = before
    return None if row is None or row[1] is None else Timeline(row[0], int(row[1], 16))


def _parsed(data: bytes) -> Timeline | None:
    """What a note says; None where it cannot be read."""
    try:
        found = json.loads(data)
        return Timeline(str(found["system"]), int(found["number"]))
    except (ValueError, TypeError, KeyError, RecursionError):
        log.warning("timeline note unreadable", extra={"bytes": len(data)})
        return None
