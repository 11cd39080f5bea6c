"""Kept answers: they outlive their hour with all that can be looked at, and go when they must."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from sqlalchemy import update

from sceneprint.engine import Engine
from sceneprint.errors import Conflict, InvalidRequest, QuotaExceeded, UnknownMap, UnknownQuery
from sceneprint.store.query_records import WantedRecords
from sceneprint.store.tables import kept_answers
from sceneprint_client.api import NamedFrame, NewMap, Query, SeveralQuery
from sceneprint_client.api.results import KeepOptions

ALL = WantedRecords()


@pytest.fixture
def asked(full: Engine, uploads: Any) -> str:
    """Id of an answer to an upload."""
    return full.queries.upload(["hall"], uploads[0].data, uploads[0].meta, Query(seed=3)).query_id


def expire(engine: Engine) -> None:
    """Let the hour of all answers be over."""
    then = time.time() - 2 * engine.settings.query_s
    for one in engine.settings.query_dir.iterdir():
        os.utime(one, (then, then))


def keep(engine: Engine, query_id: str, **options: Any) -> Any:
    return engine.kept_answers.keep(engine.kept, query_id, KeepOptions(**options))


def kept_ids(engine: Engine, **more: Any) -> list[str]:
    given: dict[str, Any] = {"names": None, "map_name": None, "cursor": None, "limit": 100} | more
    return [one.query_id for one in engine.kept_answers.page(ALL, **given).items]


def test_a_kept_answer_outlives_its_hour_and_the_process(
    full: Engine, asked: str, make_engine: Callable[..., Engine]
) -> None:
    frame_id = full.inspection.answer(asked).matches[0].frame_id
    before = (
        full.inspection.answer(asked), full.again.question(asked), full.again.preview(asked),
        full.inspection.overlay(asked, frame_id, None, "residual", "aligned"),
    )  # fmt: skip
    told = keep(full, asked, title="by the door")
    assert (told.kept, told.title, told.until) == (True, "by the door", None)
    expire(full)
    second = make_engine()
    assert before == (
        second.inspection.answer(asked), second.again.question(asked), second.again.preview(asked),
        second.inspection.overlay(asked, frame_id, None, "residual", "aligned"),
    )  # fmt: skip
    assert second.kept_answers.retention(second.kept, asked) == told
    second.kept_answers.release(asked)
    for missing in (
        lambda: full.inspection.answer(asked), lambda: second.kept_answers.release(asked),
        lambda: keep(full, asked), lambda: full.kept_answers.retention(full.kept, asked),
    ):  # fmt: skip
        with pytest.raises(UnknownQuery):
            missing()


def test_release_removes_the_blob(full: Engine, asked: str) -> None:
    before = set(full.store.blobs.digests())
    keep(full, asked)
    keep(full, asked)  # once more: the same blob, the same row
    (new,) = set(full.store.blobs.digests()) - before
    assert kept_ids(full) == [asked]
    full.kept_answers.release(asked)
    assert not full.store.blobs.holds(new)
    assert kept_ids(full) == []
    # within its hour it is an answer like any other
    told = full.kept_answers.retention(full.kept, asked)
    assert (told.kept, told.kept_at) == (False, None)
    assert told.until is not None
    assert told.until.timestamp() == pytest.approx(time.time() + full.settings.query_s, abs=60)


def test_the_list_has_what_the_query_came_to(full: Engine, asked: str, uploads: Any) -> None:
    answer = full.inspection.answer(asked)
    robot = uploads[1].meta.model_copy(update={"robot": "r7"})
    other = full.queries.upload(
        ["hall"], uploads[1].data, robot, Query(stages=("retrieve",))
    ).query_id
    keep(full, asked, title="one")
    keep(full, other)
    page = full.kept_answers.page(ALL, None, "hall", None, 1)
    assert [one.query_id for one in page.items] == [other]
    assert (page.items[0].robot, page.items[0].status) == ("r7", "unvalidated")
    (last,) = full.kept_answers.page(ALL, None, "hall", page.next_cursor, 1).items
    assert (last.query_id, last.status, last.reason) == (asked, answer.status, answer.reason)
    assert (last.map, last.maps, last.support) == ("hall", ["hall"], answer.location.support)
    assert last.pose is not None
    assert last.pose.translation == answer.location.pose.translation
    assert last.keep is not None
    assert (last.keep.title, last.keep.until) == ("one", None)
    for wanted, found in (
        (WantedRecords(robot="r7"), [other]), (WantedRecords(statuses=("found",)), [asked]),
        (WantedRecords(until=last.at.timestamp()), []),
        (WantedRecords(since=page.items[0].at.timestamp() + 1), []),
    ):  # fmt: skip
        got = full.kept_answers.page(wanted, None, None, None, 9).items
        assert [one.query_id for one in got] == found
    with pytest.raises(UnknownMap):
        kept_ids(full, map_name="attic")
    with pytest.raises(InvalidRequest):
        kept_ids(full, cursor="x")


def test_who_may_not_read_all_maps_of_an_answer_does_not_see_it(full: Engine) -> None:
    full.create_map(NewMap(name="attic", model="depth"))
    frame = full.list_frames("hall").items[0].frame_id
    both = full.queries.stored(
        ["hall", "attic"], NamedFrame(map="hall", frame_id=frame),
        SeveralQuery(maps=["hall", "attic"]),
    ).query_id  # fmt: skip
    keep(full, both)
    assert kept_ids(full, names=("hall", "attic")) == [both]
    assert kept_ids(full, map_name="attic") == [both]
    assert kept_ids(full, names=("hall",)) == []
    blobs = set(full.store.blobs.digests())
    full.delete_map("attic")
    assert kept_ids(full) == []
    assert len(blobs - set(full.store.blobs.digests())) == 1


def test_an_answer_goes_with_a_frame_that_it_shows(
    full: Engine, asked: str, make_engine: Callable[..., Engine]
) -> None:
    shown = full.inspection.answer(asked).matches[0].frame_id
    keep(full, asked)
    full.delete_frame("hall", shown)
    assert full.kept_answers.remove_spent() == 0  # its deletion can be undone
    full.tombstones.restore_one("hall", shown)
    assert full.kept_answers.remove_spent() == 0
    make_engine(undo_s=0).delete_frame("hall", shown)
    full.kept_answers.release(asked)
    with pytest.raises(Conflict, match=f"{shown} of map 'hall' was deleted"):
        keep(full, asked)


def test_an_answer_that_shows_a_purged_frame_is_removed(full: Engine, asked: str) -> None:
    shown = full.inspection.answer(asked).matches[0].frame_id
    keep(full, asked)
    full.delete_frame("hall", shown)
    full.tombstones.purge(everything=True)
    assert full.kept_answers.remove_spent() == 1
    expire(full)
    with pytest.raises(UnknownQuery):
        full.inspection.answer(asked)


def test_an_answer_is_released_at_its_end(full: Engine, asked: str) -> None:
    with pytest.raises(InvalidRequest, match="`until` has passed"):
        keep(full, asked, until=datetime.now(UTC) - timedelta(seconds=1))
    until = datetime.now(UTC) + timedelta(hours=2)
    assert keep(full, asked, until=until).until == until
    assert full.kept_answers.remove_spent() == 0
    with full.store.database.write() as connection:
        connection.execute(update(kept_answers).values(until=time.time() - 1))
    assert not full.kept_answers.retention(full.kept, asked).kept
    assert keep(full, asked).until is None  # within its hour it may be kept once more
    with full.store.database.write() as connection:
        connection.execute(update(kept_answers).values(until=time.time() - 1))
    expire(full)
    with pytest.raises(UnknownQuery):
        full.inspection.answer(asked)
    assert kept_ids(full) == []
    assert full.kept_answers.remove_spent() == 1


@pytest.mark.parametrize("bound", [{"kept_answers": 1}, {"kept_bytes": 100_000}])
def test_a_map_has_so_many_kept_answers(
    full: Engine, uploads: Any, make_engine: Callable[..., Engine], bound: dict[str, int]
) -> None:
    engine = make_engine(**bound)
    ids = [
        engine.queries.upload(["hall"], one.data, one.meta, Query(seed=3)).query_id
        for one in uploads[:2]
    ]
    if "kept_bytes" in bound:
        sizes = [(engine.settings.query_dir / one).stat().st_size for one in ids]
        engine = make_engine(kept_bytes=sum(sizes) - 1)
    keep(engine, ids[0])
    with pytest.raises(QuotaExceeded, match="SCENEPRINT_KEPT_ANSWERS"):
        keep(engine, ids[1])
    assert keep(engine, ids[0], title="again").title == "again"  # it is kept already
    engine.kept_answers.release(ids[0])
    assert keep(engine, ids[1]).kept
