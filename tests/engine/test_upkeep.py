"""Indexes are caches: of this history of the database, of the maps there are, and expendable."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import update

from sceneprint.engine import Engine, administration, readers, searching, views
from sceneprint.errors import UnreadableModel
from sceneprint.index import search
from sceneprint.schemas import JobState, NewMap, Query
from sceneprint.store.tables import models

Make = Callable[..., Engine]
ALL = Query(stages=("retrieve",), k=50)


def fill(engine: Engine, uploads: Any, work_off: Any, which: range) -> list[str]:
    added = [engine.add_frame("hall", uploads[i].data, uploads[i].meta)[0] for i in which]
    assert work_off(engine) == [JobState.SUCCEEDED] * len(which)
    return [one.frame_id for one in added]


def test_an_index_of_a_history_that_was_undone_is_not_believed(
    make_engine: Make, uploads: Any, work_off: Any, tmp_path: Path, put_back: Any
) -> None:
    """Put back to two frames, the database gives the numbers of the next three out again."""
    data, kept = tmp_path / "data", tmp_path / "kept"
    engine = make_engine(data, tail_frames=2)
    engine.create_map(NewMap(name="hall", model="compact"))
    fill(engine, uploads, work_off, range(2))
    engine.close()
    shutil.copytree(data, kept)
    make_engine(kept).close()
    engine = make_engine(data, tail_frames=2)
    fill(engine, uploads, work_off, range(2, 5))
    assert engine.publish_due() == 1
    engine.close()
    put_back(kept, data)
    engine = make_engine(data, tail_frames=2)
    names = fill(engine, uploads, work_off, range(5, 8))
    for name, i in zip(names, range(5, 8), strict=True):
        answer = engine.query_upload("hall", uploads[i].data, uploads[i].meta, ALL)
        assert (answer.index_generation, answer.counts.map) == (0, 5)
        assert (answer.matches[0].frame_id, answer.matches[0].distance) == (name, 0)
    assert engine.publish_due() == 1  # anew, from nothing
    for fresh in (engine, make_engine(data, tail_frames=2)):
        answer = fresh.query_upload("hall", uploads[5].data, uploads[5].meta, ALL)
        assert (answer.matches[0].frame_id, answer.matches[0].distance) == (names[0], 0)
        assert answer.counts.map == 5
    assert answer.index_generation == 2


def test_an_index_that_cannot_be_written_costs_no_frame(
    make_engine: Make, uploads: Any, work_off: Any, tmp_path: Path, caplog: Any
) -> None:
    (tmp_path / "file").write_text("in the way")
    engine = make_engine(index_dir=tmp_path / "file" / "index", tail_frames=1)
    engine.create_map(NewMap(name="hall", model="compact"))
    names = fill(engine, uploads, work_off, range(3))
    assert engine.publish_due() == 0
    assert [r.message for r in caplog.records if r.levelname == "ERROR"] == ["no index published"]
    answer = engine.query_upload("hall", uploads[1].data, uploads[1].meta, ALL)
    assert (answer.matches[0].frame_id, answer.index_generation) == (names[1], 0)


def test_indexes_of_deleted_maps_are_removed_and_nothing_else(
    make_engine: Make, uploads: Any, work_off: Any, tmp_path: Path
) -> None:
    engine = make_engine(tail_frames=1)
    engine.create_map(NewMap(name="hall", model="compact"))
    fill(engine, uploads, work_off, range(3))
    assert engine.publish_due() == 1
    (folder,) = engine.settings.indexes.glob("[!.]*")
    (engine.settings.indexes / "notes").mkdir()
    shutil.copytree(folder, engine.settings.indexes / "hall-9-abc")  # of a map that is no more
    assert engine.publish_due() == 0
    left = [one.name for one in engine.settings.indexes.glob("[!.]*")]
    assert set(left) == {folder.name, "notes"}
    engine.delete_map("hall")
    assert engine.publish_due() == 0
    assert [one.name for one in engine.settings.indexes.glob("[!.]*")] == ["notes"]


def test_what_was_not_asked_for_long_is_not_held(
    make_engine: Make, uploads: Any, work_off: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine = make_engine()
    for name in ("hall", "other"):
        engine.create_map(NewMap(name=name, model="compact"))
        engine.add_frame(name, uploads[0].data, uploads[0].meta)
    work_off(engine)

    def held() -> list[str]:
        for name in ("hall", "other", "hall"):
            answer = engine.query_upload(name, uploads[0].data, uploads[0].meta, ALL)
            assert answer.matches[0].distance == 0
        return list(engine._readers._open)

    assert held() == ["other", "hall"]
    monkeypatch.setattr(readers, "HELD_BYTES", 2 * 64 * 12_800 - 1)  # 64 rows are set aside at once
    assert held() == ["hall"]


def test_a_model_that_cannot_be_read_costs_its_maps_alone(
    make_engine: Make, uploads: Any, work_off: Any, caplog: Any
) -> None:
    engine = make_engine()
    for name, model in (("hall", "compact"), ("old", "paper")):
        engine.create_map(NewMap(name=name, model=model))
    old = engine.get_map("old").model_id
    with engine.store.database.write() as connection:
        connection.execute(update(models).where(models.c.id == old).values(content=b"of old"))
    fresh = make_engine()
    fresh.warm()
    (error,) = [r for r in caplog.records if r.levelname == "ERROR"]
    assert (error.name, error.__dict__["model"]) == (administration.__name__, old)
    fill(fresh, uploads, work_off, range(1))
    assert fresh.query_upload("hall", uploads[0].data, uploads[0].meta, ALL).counts.map == 1
    with pytest.raises(UnreadableModel):
        fresh.query_upload("old", uploads[0].data, uploads[0].meta, ALL)


@pytest.mark.parametrize(
    ("whole", "exact", "compared"), [(12, False, 12), (11, True, 12), (11, False, 3)]
)
def test_a_shortlist_is_taken_in_large_maps_alone_and_where_exactness_is_not_asked_for(
    signed_folder: Path, tmp_path: Path, make_engine: Make, uploads: Any,
    monkeypatch: pytest.MonkeyPatch, whole: int, exact: bool, compared: int,
) -> None:  # fmt: skip
    shutil.copytree(signed_folder, tmp_path / "data")
    engine = make_engine(tmp_path / "data", tail_frames=1)
    assert engine.publish_due() == 1
    monkeypatch.setattr(views, "search", partial(search, shortlist=3))
    monkeypatch.setattr(searching, "ranking_size", lambda n: min(n, 3))
    monkeypatch.setattr(searching, "WHOLE", whole)
    query = Query(stages=("retrieve",), k=3, exact=exact)
    answer = engine.query_upload("hall", uploads[4].data, uploads[4].meta, query)
    assert (answer.counts.map, answer.counts.compared) == (12, compared)
    assert (answer.exact, answer.index_generation) == (compared == 12, 1)
    assert answer.matches[0].distance == 0
