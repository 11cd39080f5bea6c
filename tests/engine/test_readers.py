"""Tests of queries while maps grow, are indexed, shrink and are recreated."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from sceneprint.engine.search import local_index
from sceneprint_client.api import Answer, JobState, NewMap, Query
from tests.whole_engine import Engine

Make = Callable[..., Engine]
Ids = Callable[[Engine], list[str]]
WorkOff = Callable[[Engine], list[JobState | None]]
ALL = Query(stages=("retrieve",), k=50)
pytestmark = pytest.mark.usefixtures("_always_look")


@pytest.fixture
def more(uploads: Any, work_off: WorkOff) -> Callable[[Engine, int], list[str]]:
    """Index that many frames more, by cameras that differ by half a pixel."""
    shifts: Iterator[int] = iter(range(1, 100))

    def add(engine: Engine, count: int) -> list[str]:
        added = []
        for _ in range(count):
            shift = next(shifts)
            meta = uploads[shift % 12].meta
            camera = meta.intrinsics.model_copy(update={"cx": meta.intrinsics.cx + shift / 2})
            given = meta.model_copy(update={"intrinsics": camera})
            added.append(engine.add_frame("hall", uploads[shift % 12].data, given)[0].frame_id)
        assert work_off(engine) == [JobState.SUCCEEDED] * count
        return added

    return add


def found(answer: Answer) -> list[tuple[str, int]]:
    assert answer.counts.map == answer.counts.ranked == len(answer.matches)
    return [(match.frame_id, match.distance) for match in answer.matches]


def ask(engine: Engine, uploads: Any, which: int = 2, query: Query = ALL) -> Answer:
    return engine.queries.upload(["hall"], uploads[which].data, uploads[which].meta, query)


def truth(make: Make, uploads: Any, folder: Path, tmp_path: Path) -> list[tuple[str, int]]:
    """What an engine says that has no index and has held nothing before."""
    fresh = make(folder, index_dir=tmp_path / "none", unindexed_frames=100_000)
    answer = ask(fresh, uploads)
    assert answer.index_version == 0
    return found(answer)


def test_publishing_changes_no_answer(
    data: Path, make_engine: Make, uploads: Any, more: Any, ids: Ids
) -> None:
    reader, builder = make_engine(data, unindexed_frames=5), make_engine(data, unindexed_frames=5)
    for query in (ALL, Query()):
        ask(reader, uploads, query=query)
    before = [ask(reader, uploads, query=query) for query in (ALL, Query())]
    assert builder.publish_due() == 1
    assert builder.publish_due() == 0
    fresh = make_engine(data, unindexed_frames=5)
    for engine in (reader, fresh):
        for query, old in zip((ALL, Query()), before, strict=True):
            new = ask(engine, uploads, query=query)
            assert new.index_version == 1  # the reader has looked
            free = {"query_id": "", "milliseconds": {}, "index_version": 0}
            assert new.model_copy(update=free) == old.model_copy(update=free)
    gone = ids(reader)[3]
    builder.delete_frame("hall", gone)
    left = [pair for pair in found(before[0]) if pair[0] != gone]
    for engine in (reader, fresh, make_engine(data, unindexed_frames=5)):
        assert found(ask(engine, uploads)) == left  # at once, and whoever deleted it
    shutil.rmtree(data / "index")
    for engine in (reader, fresh, make_engine(data, unindexed_frames=5)):
        assert found(ask(engine, uploads)) == left
    assert builder.publish_due() == 1  # it sees that what it published is gone
    assert make_engine(data, unindexed_frames=5).publish_due() == 0


@pytest.mark.parametrize(("tail_frames", "published"), [(13, 0), (12, 0), (11, 1)])
def test_an_index_is_due_beyond_so_many_frames(
    data: Path, make_engine: Make, tail_frames: int, published: int
) -> None:
    assert make_engine(data, unindexed_frames=tail_frames).publish_due() == published


@pytest.mark.parametrize(("pause_s", "version"), [(1e9, 0), (0.0, 1)])
def test_a_newer_index_is_looked_for_from_time_to_time(
    data: Path, make_engine: Make, uploads: Any, monkeypatch: pytest.MonkeyPatch, pause_s: float,
    version: int,
) -> None:  # fmt: skip
    monkeypatch.setattr(local_index, "_LOOK_S", pause_s)
    reader = make_engine(data)
    assert len(found(ask(reader, uploads))) == 12
    assert make_engine(data, unindexed_frames=1).publish_due() == 1
    answer = ask(reader, uploads)
    assert len(found(answer)) == 12
    assert answer.index_version == version


def test_readers_follow_a_map_through_versions(
    data: Path, make_engine: Make, uploads: Any, more: Any, ids: Ids, tmp_path: Path
) -> None:
    first, builder = make_engine(data, unindexed_frames=3), make_engine(data, unindexed_frames=3)
    ask(first, uploads)
    assert builder.publish_due() == 1
    late = make_engine(data, unindexed_frames=3)
    ask(late, uploads)
    for step in range(3):
        new = more(builder, 2)
        builder.delete_frame("hall", ids(builder)[2 * step])
        builder.delete_frame("hall", new[0])  # before any index has it
        wanted = truth(make_engine, uploads, data, tmp_path)
        assert len(wanted) == 12  # two came, two went
        for engine in (first, late, make_engine(data, unindexed_frames=3)):
            assert found(ask(engine, uploads)) == wanted
    assert builder.publish_due() == 1  # six deletions; of frames alone three were left to index
    new = more(builder, 3)
    assert builder.publish_due() == 0
    new += more(builder, 1)
    assert builder.publish_due() == 1
    more(builder, 1)  # newer than the version: it stays in the tail
    builder.delete_frame("hall", new[0])  # in the version
    wanted = truth(make_engine, uploads, data, tmp_path)
    for engine in (first, late, make_engine(data, unindexed_frames=3)):
        answer = ask(engine, uploads)
        assert (found(answer), answer.index_version) == (wanted, 3)
    more(builder, 3)
    wanted = truth(make_engine, uploads, data, tmp_path)
    for engine in (first, late):
        assert found(ask(engine, uploads)) == wanted


def test_a_map_made_anew_has_none_of_the_old_frames(
    data: Path, make_engine: Make, uploads: Any, work_off: WorkOff
) -> None:
    reader, other = make_engine(data, unindexed_frames=5), make_engine(data, unindexed_frames=5)
    assert len(found(ask(reader, uploads))) == len(found(ask(other, uploads))) == 12
    assert other.publish_due() == 1
    other.delete_map("hall")
    other.create_map(NewMap(name="hall", model="depth"))
    for engine in (reader, other, make_engine(data, unindexed_frames=5)):
        assert found(ask(engine, uploads)) == []
    added, _ = other.add_frame("hall", uploads[7].data, uploads[7].meta)
    assert work_off(other) == [JobState.SUCCEEDED]
    for engine in (reader, other, make_engine(data, unindexed_frames=5)):
        answer = ask(engine, uploads, 7)
        assert found(answer) == [(added.frame_id, 0)]
        assert answer.index_version == 0


def test_a_crowd_at_a_cold_engine_is_served(data: Path, make_engine: Make, ids: Ids) -> None:
    """More threads than the pool has connections, all in need of the model at once."""
    engine = make_engine(data)
    name, start, answers, raised = ids(engine)[0], threading.Barrier(40), [], []

    def work() -> None:
        try:
            start.wait()
            answers.append(found(engine.query_frame("hall", name, ALL)))
        except BaseException as error:
            raised.append(error)

    threads = [threading.Thread(target=work) for _ in range(40)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert raised == []
    assert len(answers) == 40
    assert all(answer == answers[0] for answer in answers)
    assert len(answers[0]) == 11
