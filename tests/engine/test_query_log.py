"""Tests of the query log: records, pages, kept answers, and deletion in blocks."""

import logging
import os
import time
import uuid
from dataclasses import replace

import numpy as np
import pytest
from sqlalchemy import func, select, update

from sceneprint.engine.maps.map_lifecycle import get_maps
from sceneprint.engine.results import query_log
from sceneprint.engine.results.query_entry import (
    SentQuery,
    StoredAnswer,
    decode_answer,
    encode_answer,
    query_row,
)
from sceneprint.engine.results.query_log import QueryLog
from sceneprint.errors import FrameError, InvalidRequest, QuotaExceeded, UnknownQuery
from sceneprint.settings import Settings
from sceneprint.store.answer_files import open_answers
from sceneprint.store.deletion import DAY_S
from sceneprint.store.events import EventFilter, list_events
from sceneprint.store.frame_queries import QueryOrigin
from sceneprint.store.query_rows import NewQuery, WantedQueries
from sceneprint.store.tables import queries
from sceneprint_client.api import (
    Alternative,
    Answer,
    Counts,
    NamedFrame,
    NewMap,
    Query,
    SeveralQuery,
)

COUNTS = Counts(map=0, passed=0, compared=0, ranked=0, selected=0, validated=0, accepted=0)
EVERY = WantedQueries()


@pytest.fixture
def engine(make_engine):
    result = make_engine()
    for name in ("hall", "attic"):
        result.create_map(NewMap(name=name, model="depth"))
    return result


def row(number, **more):
    one = NewQuery(
        id=f"{number:032x}", at=time.time() + number, map="hall", maps=None, robot=None,
        session=None, status="not_found", cause="nothing_alike", reason="why", pose_parent=None,
        pose=None, confidence=None, support=None, alternatives=0,
        milliseconds=12.5, kind="depth", frame_map=None, frame_id=None, key_id=None, listed=True,
    )  # fmt: skip
    return replace(one, **more)


def stored(size=1000, query=None):
    """An answer that takes a little more than `size` bytes."""
    answer = Answer(
        query_id=uuid.uuid4().hex, status="not_found", matches=[], location=None, seed=3,
        model="m", index_version=0, exact=True, counts=COUNTS,
        milliseconds={"total": 0.1 + 0.2}, maps=["hall"],
    )  # fmt: skip
    vector = np.arange(64, dtype=np.uint8)
    return StoredAnswer(answer, query or Query(), "ab" * 32, vector, bytes(size), (7, 3))


def log_of(engine, **settings):
    files = open_answers(engine.store.blobs, engine.settings.query_dir)
    return QueryLog(engine.store, files, Settings(**settings))


def files_of(engine):
    files = open_answers(engine.store.blobs, engine.settings.query_dir)
    return {name for name, _ in files.list()}


def log_answer(engine, size=1000, log=None, **more):
    """Have an answer logged; returns its id."""
    one = stored(size)
    where = engine.query_log if log is None else log
    where.note(row(0, **{"id": one.answer.query_id, "at": time.time(), **more}), one)
    assert where.flush(60)
    return one.answer.query_id


def numbers(engine, names=None, **wanted):
    """Numbers of the queries that are listed, page by page of two."""
    results, cursor = [], None
    while True:
        page = engine.query_log.page(WantedQueries(**wanted), names, cursor, 2)
        results += [int(item.query_id, 16) for item in page.items]
        cursor = page.next_cursor
        if cursor is None:
            return results


def count(engine, *conditions):
    statement = select(func.count()).select_from(queries).where(*conditions)
    return engine.fetch(statement).scalar_one()


def test_answers_and_failures_become_rows(full, uploads):
    one, query = uploads[3], Query(k=3)
    answer = full.ask(one, query)
    assert answer.status == "found"
    actual = query_row(SentQuery(["hall"], query, "spot", "monday", at=7.0), answer, 0.25)
    t, r = answer.location.pose.translation, answer.location.pose.rotation
    assert actual == NewQuery(
        id=answer.query_id, at=7.0, map="hall", maps=None, robot="spot", session="monday",
        key_id=None, status="found", cause=None, reason=answer.reason, pose_parent=one.room,
        pose=(t.x, t.y, t.z, r.x, r.y, r.z, r.w), confidence=answer.location.confidence,
        support=answer.location.support,
        alternatives=0, milliseconds=250.0, kind="depth", frame_map=None, frame_id=None,
        listed=True,
    )  # fmt: skip
    # the pose is where the frame was taken, not only what the answer says
    assert actual.pose[:3] == pytest.approx(one.pose[:3, 3], abs=0.03)
    assert actual.confidence >= 0.99
    pose = answer.location.pose
    alternatives = [Alternative(pose=pose, confidence=p, weight=1, support=1, score=0.5)
                    for p in (0.7, 0.2)]  # fmt: skip
    unsure = answer.model_copy(
        update={"status": "ambiguous", "location": None, "alternatives": alternatives}
    )
    unsure_row = query_row(SentQuery(["hall"], query), unsure, 0.25)
    assert (unsure_row.pose, unsure_row.confidence, unsure_row.alternatives) == (None, 0.7, 2)
    failed = query_row(SentQuery(["hall"], Query(), at=8.0), FrameError("no samples"), 0.002)
    assert (failed.status, failed.cause, failed.reason) == ("failed", "frame-error", "no samples")
    assert (failed.pose, failed.milliseconds) == (None, 2.0)
    broken = query_row(SentQuery(["hall"], query), ZeroDivisionError("secret"), 0.0)
    assert (broken.status, broken.cause) == ("failed", "internal-error")
    assert "secret" not in broken.reason
    # of several maps it belongs to the one where it was found
    several = query_row(SentQuery(["attic", "hall"], query), answer, 0.0)
    assert (several.map, several.maps) == (answer.matches[0].map, ("attic", "hall"))


def test_pages_and_filters(engine):
    start = time.time()
    for i in range(7):
        status = "found" if i % 2 else "failed"
        home, robot = ("attic" if i == 3 else "hall"), ("spot" if i in (1, 3) else None)
        # two at one moment: a page may end between them
        engine.query_log.note(row(i, at=start + i // 2, map=home, robot=robot, status=status))
    engine.query_log.note(row(7, listed=False), stored())
    for names, wanted, expected in (
        (None, {}, [6, 5, 4, 3, 2, 1, 0]), (["hall"], {}, [6, 5, 4, 2, 1, 0]),
        (["attic", "cellar"], {}, [3]), ([], {}, []), (None, {"robot": "spot"}, [3, 1]),
        (["hall"], {"statuses": ("found",)}, [5, 1]),
        (None, {"since": start + 1, "until": start + 3}, [5, 4, 3, 2]),
    ):  # fmt: skip
        assert numbers(engine, names, **wanted) == expected
    for forged in ("0", "a" * 64, engine.store.seals.seal("query", 3)):
        with pytest.raises(InvalidRequest, match="cursor"):
            engine.query_log.page(EVERY, None, forged, 2)
    with engine.store.database.read() as connection:
        actual = list_events(connection, EventFilter(kinds=("query.",)))
    assert [int(item.data["query_id"], 16) for item in actual] == list(range(7))
    assert [item.map for item in actual] == ["hall"] * 3 + ["attic"] + ["hall"] * 3


def test_recent_queries_are_counted_by_map_and_status(engine):
    for i, (home, status) in enumerate(
        (("hall", "found"), ("hall", "found"), ("attic", "ambiguous"), ("hall", "failed"))
    ):
        engine.query_log.note(row(i, map=home, status=status))
    engine.query_log.note(row(4, status="found", listed=False), stored())
    assert engine.query_log.flush(60)
    counts = {"attic": {"ambiguous": 1}, "hall": {"found": 2, "failed": 1}}
    assert {map_.name: map_.recent_queries for map_ in get_maps(engine.store)} == counts


def test_a_new_map_has_no_queries_of_the_deleted_one(engine):
    engine.query_log.note(row(1, at=time.time() - 60))  # of before the map was created
    engine.query_log.note(row(2, map="cellar"))
    engine.query_log.note(row(3))
    assert numbers(engine) == [3]
    engine.delete_map("hall")
    assert (count(engine), engine.query_log.lost) == (0, 0)


def test_a_revoked_key_is_no_longer_named(engine):
    key = engine.find_key(engine.create_key("arm").secret)
    engine.query_log.note(row(1, key_id=key.id))
    (before,) = engine.query_log.page(EVERY, None, None, 9).items
    engine.revoke_key("arm")
    (after,) = engine.query_log.page(EVERY, None, None, 9).items
    assert (before.key, after.key) == ("arm", None)


def test_what_is_lost_is_logged_and_counted(engine, monkeypatch, caplog):
    engine.query_log.note(row(1000))
    assert engine.query_log.flush(60)
    monkeypatch.setattr(query_log, "MOST_WAITING", 2)
    monkeypatch.setattr(query_log, "GATHER_S", 60.0)
    with caplog.at_level(logging.WARNING):
        for i in range(14):
            engine.query_log.note(row(i))
    assert engine.query_log.lost == 12
    assert [(record.message, record.lost) for record in caplog.records] == [
        ("queries lost", 1), ("queries lost", 10)
    ]  # fmt: skip
    engine.query_log.close()  # which writes what waits
    assert count(engine) == 3
    engine.query_log.note(row(99))
    assert (engine.query_log.lost, count(engine)) == (13, 3)


def test_an_answer_comes_back_as_it_was():
    request = Query(k=2, seed=9, validation={"evidence": 0.35}, filter={"robot": "r1"})
    base = ("base_link", np.arange(16.0).reshape(4, 4))
    origin = QueryOrigin("r1", "run", 12.5)
    for one in (
        stored(query=request), replace(stored(query=request), geometry=None),
        replace(stored(query=request), origin=origin, base=base, up=np.array([0.0, 0.0, 1.0])),
    ):  # fmt: skip
        again = decode_answer(encode_answer(one))
        assert again.answer.model_dump_json() == one.answer.model_dump_json()
        assert again.query == one.query
        assert (again.model_id, again.geometry, again.at) == (one.model_id, one.geometry, one.at)
        assert (again.ranked, again.vector.tobytes()) == ((7, 3), one.vector.tobytes())
        assert again.origin == one.origin
        assert again.query.validation.model_fields_set == {"evidence"}
    assert again.base[0] == "base_link"
    assert (again.base[1] == base[1]).all()
    assert again.up.tolist() == [0.0, 0.0, 1.0]
    several = stored(query=SeveralQuery(maps=["hall", "attic"], k=4))
    assert decode_answer(encode_answer(several)).query == Query(k=4)


def test_an_answer_is_found_by_every_process(engine, make_engine):
    name = log_answer(engine)
    assert engine.query_log.find(name).answer.query_id == name
    assert make_engine().query_log.find(name).answer.query_id == name
    for other in ("", "..", "a" * 31, name.upper(), name + "\n", "b" * 32):
        with pytest.raises(UnknownQuery, match="expired"):
            engine.query_log.find(other)


def test_damaged_bytes_are_no_answer(engine):
    """Answers are not synced to disk: after a power cut a row may be without its file."""
    name = log_answer(engine)
    path = engine.settings.query_dir / name
    for data in (b"", b"\xff" * 400, path.read_bytes()[:300], None):
        if data is None:
            path.unlink()
        else:
            path.write_bytes(data)
        with pytest.raises(UnknownQuery):
            engine.query_log.find(name)
    with pytest.raises(UnknownQuery):
        engine.query_log.keep(name, None)
    assert numbers(engine, kept=True) == []


def test_nothing_is_stored_where_there_is_no_room_or_time(engine):
    silent = log_of(engine, query_log_days=0)
    silent.note(row(1), stored())
    roomless = log_of(engine, query_log_bytes=0)
    roomless.note(row(2), stored())
    roomless.note(row(3, listed=False), stored())
    small = log_of(engine, query_log_bytes=1000)
    small.note(row(4), stored(1000))  # would push out all, and not fit
    for one in (silent, roomless, small):
        assert one.flush(60)
        one.close()
    assert (numbers(engine), count(engine, queries.c.bytes > 0)) == ([4, 2], 0)


def test_the_oldest_answers_go_where_room_is_needed(engine):
    log = log_of(engine, query_log_bytes=30_000)
    start = time.time()  # a clock may be set back
    names = [log_answer(engine, 1000, log, listed=i % 2 == 0, at=start + i) for i in range(40)]
    query_id = names[39]
    log.keep(query_id, None)
    log.remove_surplus()
    with engine.store.database.read() as connection:
        held = connection.execute(select(func.sum(queries.c.bytes))).scalar_one()
        of_answers = select(queries.c.id).where(queries.c.bytes > 0)
        there = set(connection.execute(of_answers).scalars())
    assert 20_000 < held <= 30_000
    assert there == set(names[-len(there) :])
    assert files_of(engine) == there - {query_id}  # which is in the database
    # a listed query stays without its answer, and of the others nothing
    assert count(engine, queries.c.listed) == 20
    assert count(engine, ~queries.c.listed) == len(there & set(names[1::2]))
    log.close()


def test_files_without_a_row_are_swept(engine):
    name = log_answer(engine)
    folder, long_ago = engine.settings.query_dir, time.time() - 3600
    for path in (folder / ("c" * 32), folder / ".unfinished.part", folder / ("d" * 32)):
        path.write_bytes(b"x")
    for path in (folder / name, folder / ("c" * 32), folder / ".unfinished.part"):
        os.utime(path, (long_ago, long_ago))
    assert engine.query_log.purge() == 0
    assert files_of(engine) == {name, "d" * 32}  # the row of the young one may be on its way


def test_a_folder_that_cannot_be_written_costs_no_query_its_row(engine, caplog):
    engine.settings.query_dir.write_bytes(b"")
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            log_answer(engine)
    assert (count(engine), count(engine, queries.c.bytes > 0)) == (2, 0)
    assert [record.message for record in caplog.records] == ["answers cannot be stored"]


def test_old_and_surplus_queries_are_removed_in_blocks(engine, monkeypatch):
    monkeypatch.setattr(query_log, "BLOCK", 3)
    for i in range(14):
        engine.query_log.note(row(i, map="attic" if i >= 10 else "hall"))
    assert engine.query_log.flush(60)
    aged = update(queries).where(queries.c.id.in_(f"{i:032x}" for i in range(4)))
    engine.write(aged.values(at=time.time() - 31 * DAY_S))
    assert engine.query_log.remove_surplus() == 4
    assert numbers(engine) == list(range(13, 3, -1))
    monkeypatch.setattr(query_log, "MOST_QUERIES", 2)
    assert engine.query_log.remove_surplus() == 6
    assert numbers(engine) == [13, 12, 9, 8]
    monkeypatch.setattr(query_log, "TIDY_S", 0.0)
    engine.write(update(queries).values(at=1.0))
    engine.publish_due()  # workers do so
    assert count(engine) == 0


def test_a_kept_answer_stays_until_it_is_released(engine, make_engine):
    query_id, other = log_answer(engine), log_answer(engine)
    record = engine.query_log.keep(query_id, "by the door")
    assert (record.title, record.expires_at, record.stored) == ("by the door", None, True)
    again = engine.query_log.keep(query_id, "the door")
    assert (again.title, again.kept_at) == ("the door", record.kept_at)
    with engine.store.database.write() as connection:
        connection.execute(update(queries).values(at=time.time() - 40 * DAY_S))
        connection.exec_driver_sql("UPDATE maps SET created_at = 0")
    engine.query_log.remove_surplus()
    second = make_engine()
    assert second.query_log.find(query_id).answer.query_id == query_id
    page = second.query_log.page(WantedQueries(kept=True), None, None, 9)
    assert [item.query_id for item in page.items] == [query_id]
    assert files_of(engine) == set()
    second.query_log.release(query_id)
    assert second.query_log.record(query_id).kept_at is None
    second.query_log.remove_surplus()
    for missing in (query_id, other):
        with pytest.raises(UnknownQuery):
            engine.query_log.find(missing)
    with pytest.raises(UnknownQuery):
        engine.query_log.release(query_id)


def test_so_many_answers_are_kept(engine, monkeypatch):
    ids = [log_answer(engine) for _ in range(2)]
    monkeypatch.setattr(query_log, "MOST_KEPT", 1)
    engine.query_log.keep(ids[0], None)
    with pytest.raises(QuotaExceeded, match="SCENEPRINT_QUERY_LOG_BYTES"):
        engine.query_log.keep(ids[1], None)
    engine.query_log.keep(ids[0], "again")
    engine.query_log.release(ids[0])
    assert engine.query_log.keep(ids[1], None).kept_at is not None
    monkeypatch.setattr(query_log, "MOST_KEPT", 9)
    small = log_of(engine, query_log_bytes=3000)  # of which kept ones take half
    with pytest.raises(QuotaExceeded):
        small.keep(ids[0], None)


def test_an_answer_goes_with_a_map_that_was_searched(full):
    full.create_map(NewMap(name="attic", model="depth"))
    frame = full.list_frames("hall").items[0].frame_id
    both = full.queries.stored(
        ["hall", "attic"], NamedFrame(map="hall", frame_id=frame),
        SeveralQuery(maps=["hall", "attic"]),
    ).query_id  # fmt: skip
    assert full.query_log.find_row(both).searched == ["hall", "attic"]
    full.delete_map("attic")
    with pytest.raises(UnknownQuery):
        full.query_log.find(both)


def test_an_answer_goes_with_a_purged_frame_that_it_shows(full, uploads):
    answer = full.ask(uploads[0], Query(seed=3))
    shown = answer.matches[0].frame_id
    full.query_log.keep(answer.query_id, None)
    full.delete_frame("hall", shown)
    assert full.query_log.purge() == 0  # its deletion can be undone
    full.tombstones.restore_one("hall", shown)
    assert full.query_log.purge() == 0
    own = full.query_frame("hall", shown, Query(k=1)).query_id
    full.delete_frame("hall", shown)
    with pytest.raises(UnknownQuery):  # at once, without the frame that was its query
        full.query_log.find(own)
    full.tombstones.purge(everything=True)
    assert full.query_log.purge() == 2
    with pytest.raises(UnknownQuery):
        full.query_log.find(answer.query_id)
