"""A read replica: asked while it is near, never wrong for long, and no query fails for it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import text

from benchmarks.fleet.postgres import Server
from sceneprint import store as sceneprint_store
from sceneprint.errors import UnknownMap, UnusableStore, UselessFrame
from sceneprint.store import (
    Behind,
    Database,
    Replica,
    Store,
    behind_s,
    open_store,
    read_through,
    require_primary,
)
from sceneprint.store.database import open_database
from sceneprint.store.events import record_event
from sceneprint.store.maps import add_map, find_map, keep_model

MODEL = "ab" * 32
NAMES = text("SELECT name FROM maps ORDER BY name")


@pytest.fixture(scope="module")
def pair(
    postgres: Server, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Server, Server]]:
    """A server and its asynchronous standby."""
    follower = postgres.standby(tmp_path_factory.mktemp("follower") / "s", synchronous=False)
    yield postgres, follower
    follower.kill()


@pytest.fixture
def store(
    pair: tuple[Server, Server], postgres_url: str, tmp_path: Path, until: Callable[..., Any],
    monkeypatch: pytest.MonkeyPatch,
) -> Iterator[Store]:  # fmt: skip
    """A store whose replica has caught up."""
    monkeypatch.setattr(sceneprint_store, "AGAIN_S", 0.05)
    monkeypatch.setattr(sceneprint_store, "EVERY_S", 0.05)
    name = postgres_url.rpartition("/")[2]
    opened = open_store(postgres_url, tmp_path / "blobs", pair[1].url(name), 30.0)
    assert opened.replica is not None
    with opened.database.write() as connection:
        keep_model(connection, MODEL, "toy", b"the file of a model")
        add_map(connection, "hall", None, MODEL)
    caught_up(opened, until)
    yield opened
    opened.close()


def caught_up(store: Store, until: Callable[..., Any]) -> None:
    """Wait until the replica has all that there is now."""
    since = time.monotonic()

    def near() -> bool:
        found = store.replica and store.replica.near()
        return bool(found) and found.behind_s < time.monotonic() - since

    until(near)


def held(pair: tuple[Server, Server], hold: bool) -> None:
    """Let the standby receive, and apply nothing; or go on."""
    pair[1].execute(f"SELECT pg_wal_replay_{'pause' if hold else 'resume'}()")


def maps_of(database: Database) -> list[str]:
    with database.read() as connection:
        return list(connection.execute(NAMES).scalars())


def test_within_a_query_the_replica_is_read_and_elsewhere_the_primary(store: Store) -> None:
    assert store.queried is store.database
    assert behind_s() is None

    def ask() -> tuple[bool, list[str], float | None]:
        with store.queried.read() as connection:
            recovers = connection.execute(text("SELECT pg_is_in_recovery()")).scalar_one()
        return recovers, maps_of(store.queried), behind_s()

    recovers, names, behind = read_through(store.replica, ask)
    assert (recovers, names) == (True, ["hall"])
    assert behind is not None
    assert 0 <= behind <= 30.0
    assert store.queried is store.database
    assert read_through(None, ask) == (False, ["hall"], None)
    assert read_through(store.replica, lambda: read_through(store.replica, ask))[0] is True


def test_what_the_replica_does_not_know_yet_the_primary_is_asked(
    store: Store, pair: tuple[Server, Server]
) -> None:
    held(pair, True)
    try:
        with store.database.write() as connection:
            add_map(connection, "new", None, MODEL)
        tried: list[bool] = []

        def ask() -> str:
            tried.append(store.queried is store.database)
            with store.queried.read() as connection:
                return find_map(connection, "new").name

        assert read_through(store.replica, ask) == "new"
        assert tried == [False, True]
        with pytest.raises(UnknownMap, match="no map 'none'"):
            read_through(store.replica, lambda: _find(store, "none"))
    finally:
        held(pair, False)


def _find(store: Store, name: str) -> None:
    with store.queried.read() as connection:
        find_map(connection, name)


def test_errors_of_the_frame_itself_are_raised_once(store: Store) -> None:
    tried: list[int] = []

    def ask() -> None:
        tried.append(1)
        raise UselessFrame("a: nothing in it")

    with pytest.raises(UselessFrame):
        read_through(store.replica, ask)
    assert tried == [1]


def test_what_is_held_of_the_primary_is_not_mixed_with_an_older_state(store: Store) -> None:
    tried: list[bool] = []

    def ask() -> str:
        tried.append(store.queried is store.database)
        require_primary("what is held")
        return "answered"

    assert read_through(store.replica, ask) == "answered"
    assert tried == [False, True]
    require_primary("it is")
    assert issubclass(Behind, Exception)


def test_it_is_asked_only_while_it_is_near_by_the_log_and_not_by_a_clock(
    pair: tuple[Server, Server], postgres_url: str, until: Callable[..., Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(sceneprint_store, "AGAIN_S", 0.05)  # its database is not there at first
    name = postgres_url.rpartition("/")[2]
    primary = open_database(postgres_url)
    ours = Replica(primary, pair[1].url(name), 0.2)
    until(lambda: ours.near())  # nothing is written: it has all, however long ago that was
    held(pair, True)
    try:
        with primary.write() as connection:
            record_event(connection, "map.created", "one")
        until(lambda: (ours.standing().behind_s or 0) > 1.5)  # though it is measured all the while
        assert ours.near() is None
        told = ours.standing()
        assert not told.used
        assert told.reason == "it is farther behind than 0.2 s"
    finally:
        held(pair, False)
    until(lambda: ours.near())
    assert ours.standing().reason is None
    ours.close()
    primary.close()


@pytest.mark.parametrize(
    ("url", "reason"),
    [
        ("postgresql://postgres@127.0.0.1:1/none", "Connection refused"),
        ("{primary}", "no replica"),
        ("{other}", "does not exist|schema None|no replica"),
    ],
)
def test_what_is_no_replica_or_is_away_costs_no_query(
    postgres: Server, postgres_url: str, url: str, reason: str, until: Callable[..., Any],
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.setattr(sceneprint_store, "AGAIN_S", 0.05)
    given = url.format(primary=postgres_url, other=postgres.url("postgres"))
    primary = open_database(postgres_url)
    ours = Replica(primary, given, 30.0)
    assert read_through(ours, lambda: behind_s()) is None
    until(lambda: ours.standing().reason not in (None, "it was not asked yet"))
    told = ours.standing()
    assert (told.used, told.behind_s) == (False, None)
    assert told.reason is not None
    assert any(one in told.reason for one in reason.split("|")), told.reason
    ours.close()
    primary.close()


def test_one_of_an_older_schema_is_not_used(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    assert store.replica is not None
    monkeypatch.setattr(sceneprint_store, "known_revisions", lambda: ("9999", frozenset()))
    with pytest.raises(UnusableStore, match=r"has schema 0.*, not yet ours"):
        store.replica.measure()


def test_one_that_falls_is_left_at_once_and_comes_back(
    store: Store, pair: tuple[Server, Server], until: Callable[..., Any]
) -> None:
    pair[1].kill()
    for _ in range(3):
        assert read_through(store.replica, lambda: maps_of(store.queried)) == ["hall"]
    until(lambda: store.replica and not store.replica.standing().used)
    pair[1].start()
    until(lambda: store.replica and store.replica.standing().used)
    assert read_through(store.replica, lambda: store.queried is not store.database)


def test_a_replica_is_of_postgresql(postgres_url: str, tmp_path: Path) -> None:
    with pytest.raises(UnusableStore, match="SCENEPRINT_REPLICA_URL is no URL of PostgreSQL"):
        open_store(postgres_url, tmp_path / "blobs", f"sqlite:///{tmp_path}/a.db", 5.0)


def test_a_conflict_with_recovery_is_asked_of_the_primary(
    store: Store, pair: tuple[Server, Server], postgres_url: str, until: Callable[..., Any]
) -> None:
    """The standby has to apply what removes rows that a query there may still read."""
    primary, follower = pair
    follower.execute("ALTER SYSTEM SET max_standby_streaming_delay = 0")
    follower.execute("SELECT pg_reload_conf()")
    tried: list[bool] = []

    def ask() -> list[str]:
        tried.append(store.queried is not store.database)
        with store.queried.read() as connection:
            names = list(connection.execute(NAMES).scalars())
            if tried == [True]:
                with store.database.write() as writing:
                    writing.execute(text("UPDATE maps SET title = 'other'"))
                primary.execute("VACUUM maps", postgres_url.rpartition("/")[2])
                until(lambda: connection.execute(NAMES).all() == [])  # it is ended there
        return names

    assert read_through(store.replica, ask) == ["hall"]
    assert tried == [True, False]
    follower.execute("ALTER SYSTEM RESET max_standby_streaming_delay")
    follower.execute("SELECT pg_reload_conf()")
    caught_up(store, until)
    assert read_through(store.replica, lambda: maps_of(store.queried)) == ["hall"]
