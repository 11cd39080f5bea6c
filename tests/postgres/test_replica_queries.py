"""Queries of an engine that has a read replica."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from benchmarks.fleet.postgres import Server
from sceneprint.engine import Engine
from sceneprint.errors import InvalidRequest
from sceneprint.settings import Settings
from sceneprint.store import Replica
from sceneprint_client.api import Answer, JobState, NewMap, Query
from sceneprint_client.api.admin import ReplicaSeen
from service.metrics import Metrics

Until = Callable[[Callable[[], Any]], Any]


@pytest.fixture(scope="module")
def follower(postgres: Server, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    made = postgres.standby(tmp_path_factory.mktemp("follower") / "s", synchronous=False)
    yield made
    made.kill()


@pytest.fixture
def engine(postgres_url: str, follower: Server, tmp_path: Path) -> Iterator[Engine]:
    name = postgres_url.rpartition("/")[2]
    given = {"database_url": postgres_url, "replica_url": follower.url(name), "replica_lag_s": 60.0,
             "data_dir": tmp_path}  # fmt: skip
    (tmp_path / "blobs").mkdir()  # of a database that has its schema already it is not made
    with Engine(Settings.model_validate(given)) as opened:
        yield opened


def work_off(engine: Engine) -> None:
    while (work := engine.claim("w")) is not None:
        assert engine.run(work) == JobState.SUCCEEDED


def catch_up(engine: Engine, until: Until) -> None:
    replica, since = engine.store.replica, time.monotonic()
    assert replica is not None

    def near(found: Replica = replica) -> bool:
        now = found.near()
        return now is not None and now.behind_s < time.monotonic() - since

    until(near)


def of_replica(answer: Answer) -> bool:
    return answer.replica_behind_s is not None


def ids(answer: Answer) -> list[str]:
    return sorted(match.frame_id for match in answer.matches)


def test_queries_are_answered_from_the_replica_as_from_the_database(
    engine: Engine, follower: Server, small: list[Any], until: Until
) -> None:
    engine.create_map(NewMap(name="hall", model="depth"))
    kept = [engine.add_frame("hall", *one)[0].frame_id for one in small[:3]]
    work_off(engine)
    catch_up(engine, until)
    asked = Query(k=5, candidates=5, keep=False)

    def ask(number: int) -> Answer:
        return engine.queries.upload(["hall"], *small[number], asked)

    first = ask(0)
    assert of_replica(first)
    assert first.matches[0].frame_id == kept[0]
    with Engine(engine.settings.model_copy(update={"replica_url": None})) as other:
        same = other.queries.upload(["hall"], *small[0], asked)
    apart = {"query_id", "milliseconds", "replica_behind_s"}
    assert not of_replica(same)
    assert first.model_dump(exclude=apart) == same.model_dump(exclude=apart)
    assert of_replica(engine.query_frame("hall", kept[1], asked))

    follower.execute("SELECT pg_wal_replay_pause()")
    try:
        new = engine.add_frame("hall", *small[3])[0].frame_id
        work_off(engine)
        engine.delete_frame("hall", kept[0])
        stale = ask(0)
        assert of_replica(stale)  # it is allowed to be so old, and says so
        assert stale.replica_behind_s is not None
        assert stale.replica_behind_s <= 60.0
        assert ids(stale) == sorted(kept)
        found = engine.query_frame("hall", new, asked)  # which the replica does not know
        assert not of_replica(found)
        assert ids(found) == sorted(kept[1:])
        newest = ask(3)  # what is held of the map is newer than the replica by now
        assert not of_replica(newest)
        assert ids(newest) == sorted([*kept[1:], new])
    finally:
        follower.execute("SELECT pg_wal_replay_resume()")
    catch_up(engine, until)
    caught_up = ask(3)
    assert of_replica(caught_up)
    assert ids(caught_up) == sorted([*kept[1:], new])
    with pytest.raises(InvalidRequest, match="is deleted"):
        engine.query_frame("hall", kept[0], asked)
    seen = engine.operations.statistics.tell().replica
    assert seen is not None
    assert seen.used
    assert seen.behind_s is not None
    figures = engine.operations.statistics.figures()
    told, counted = Metrics().text(figures, 0, 0, {}, {}).decode(), Metrics()
    without = replace(figures, stats=figures.stats.model_copy(update={"replica": None}))
    assert "sceneprint_replica_used 1.0" in told
    assert "sceneprint_replica" not in counted.text(without, 0, 0, {}, {}).decode()
    unused = ReplicaSeen(used=False, behind_s=None)
    away = replace(figures, stats=figures.stats.model_copy(update={"replica": unused}))
    for _ in range(2):
        told = counted.text(away, 0, 0, {}, {}).decode()
        assert "sceneprint_replica_used 0.0" in told
        assert "sceneprint_replica_behind_seconds +Inf" in told
