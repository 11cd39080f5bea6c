"""The history of queries: written beside the answers, read by page, and removed in blocks."""

from __future__ import annotations

import logging
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import UTC, datetime

import pytest
from sqlalchemy import event, func, select, update

from sceneprint.engine.results import query_history
from sceneprint.engine.results.query_history import AskedQuery, QueryHistory, record_of
from sceneprint.errors import FrameError, InvalidRequest, StoreLocked, UnknownMap
from sceneprint.settings import Settings
from sceneprint.store import deletion
from sceneprint.store.deletion import DAY_S
from sceneprint.store.events import Wanted, list_events
from sceneprint.store.maps import find_map
from sceneprint.store.query_records import NewRecord, WantedRecords, record_of_answer
from sceneprint.store.tables import maps, query_records
from sceneprint_client.api import NewMap, Query
from sceneprint_client.api.results import NewQueryRecord, NewQueryRecords
from sceneprint_client.queries import record_json

EVERY = WantedRecords()


@pytest.fixture
def engine(make_engine):
    """An engine with two maps and no frames."""
    made = make_engine()
    for name in ("hall", "attic"):
        made.create_map(NewMap(name=name, model="depth"))
    return made


def record(number: int, **more: object) -> NewRecord:
    """A record of the query of a number; each came a second after the one before."""
    at = time.time() + number
    one = NewRecord(
        id=f"{number:032x}", at=at, map="hall", maps=None, robot=None, session=None, key_id=None,
        status="not_found", cause="nothing_alike", reason="why", pose_parent=None, pose=None,
        support=None, rival_ratio=None, alternatives=0, milliseconds=12.5, kind="depth",
        frame_map=None, frame_id=None, kept=False,
    )  # fmt: skip
    return replace(one, **more)


def told(engine, names=None, **wanted):
    """Numbers of the records that are listed, page by page of two."""
    found, cursor = [], None
    while True:
        page = engine.history.page(WantedRecords(**wanted), names, cursor, 2)
        found += [int(one.query_id, 16) for one in page.items]
        cursor = page.next_cursor
        if cursor is None:
            return found


def count(engine) -> int:
    with engine.store.database.read() as connection:
        return connection.execute(select(func.count()).select_from(query_records)).scalar_one()


def test_an_answer_and_a_failure_are_recorded_as_they_were(full, uploads):
    one, query = uploads[3], Query(k=3)
    answer = full.queries.upload(["hall"], one.data, one.meta, query)
    assert answer.status == "found"
    found = record_of(AskedQuery(["hall"], query, "spot", "monday", at=7.0), answer, 0.25)
    t, r = answer.location.pose.translation, answer.location.pose.rotation
    assert found == NewRecord(
        id=answer.query_id, at=7.0, map="hall", maps=None, robot="spot", session="monday",
        key_id=None, status="found", cause=None, reason=answer.reason, pose_parent=one.room,
        pose=(t.x, t.y, t.z, r.x, r.y, r.z, r.w), support=answer.location.support,
        rival_ratio=answer.location.rival_ratio, alternatives=0, milliseconds=250.0, kind="depth",
        frame_map=None, frame_id=None, kept=True,
    )  # fmt: skip
    # the pose is where the frame was taken, and not just what the answer says
    assert found.pose[:3] == pytest.approx(one.pose[:3, 3], abs=0.03)
    failed = record_of(
        AskedQuery(["hall"], Query(keep=True), at=8.0), FrameError("no samples"), 0.002
    )
    assert (failed.status, failed.cause, failed.reason) == ("failed", "frame-error", "no samples")
    assert (failed.kept, failed.pose, failed.milliseconds) == (False, None, 2.0)
    broken = record_of(AskedQuery(["hall"], query), ZeroDivisionError("secret"), 0.0)
    assert (broken.status, broken.cause) == ("failed", "internal-error")
    assert "secret" not in broken.reason
    # of several maps it belongs to the one where it was found
    several = record_of(AskedQuery(["attic", "hall"], query), answer, 0.0)
    assert (several.map, several.maps) == (answer.matches[0].map, ("attic", "hall"))


def test_records_are_paged_and_filtered(engine):
    start = time.time()
    for i in range(7):
        status = "found" if i % 2 else "failed"
        home, who = ("attic" if i == 3 else "hall"), ("spot" if i in (1, 3) else None)
        # two at one moment: a page may end between them
        engine.history.note(
            record(i, at=start + i // 2, map=home, robot=who, status=status)
        )  # fmt: skip
    assert told(engine) == [6, 5, 4, 3, 2, 1, 0]
    assert told(engine, ["hall"]) == [6, 5, 4, 2, 1, 0]
    assert told(engine, ["attic", "cellar"]) == [3]
    assert told(engine, []) == []
    assert told(engine, robot="spot") == [3, 1]
    assert told(engine, ["hall"], statuses=("found",)) == [5, 1]
    assert told(engine, statuses=("found", "failed"), robot="spot") == [3, 1]
    assert told(engine, since=start + 1, until=start + 3) == [5, 4, 3, 2]
    for forged in ("0", "a" * 64, engine.store.seals.seal("query", 3)):
        with pytest.raises(InvalidRequest, match="cursor"):
            engine.history.page(EVERY, None, forged, 2)
    with engine.store.database.read() as connection:
        found = list_events(connection, Wanted(kinds=("query.",)))
    assert [int(one.data["query_id"], 16) for one in found] == list(range(7))
    assert [one.map for one in found] == ["hall"] * 3 + ["attic"] + ["hall"] * 3


def test_pages_are_read_by_index(engine):
    engine.history.note(record(1))
    assert engine.history.flush(60)
    plans = []

    def explain(connection, cursor, statement, parameters, context, many):
        if "FROM query_records" in statement and not statement.startswith("EXPLAIN"):
            raw = connection.connection.driver_connection
            found = raw.execute(f"EXPLAIN QUERY PLAN {statement}", parameters).fetchall()
            plans.append("; ".join(row[-1] for row in found))

    if not engine.store.database.is_sqlite:
        pytest.skip("what SQLite says of its plans")
    event.listen(engine.store.database._engine, "before_cursor_execute", explain)
    for names, wanted in (
        (None, {}), (["hall"], {}), (["hall"], {"statuses": ("failed",)}), (None, {"robot": "r"}),
        (["hall"], {"since": 1.0, "until": 2.0}),
        (["hall"], {"robot": "r", "statuses": ("found",)}),
    ):  # fmt: skip
        plans.clear()
        told(engine, names, **wanted)
        assert plans
        assert "robot" not in wanted or "robot_at" in plans[0]
        assert all("USING INDEX" in one and "TEMP B-TREE" not in one for one in plans), plans


def test_a_burst_is_few_commits_and_waits_for_nobody(engine, monkeypatch):
    monkeypatch.setattr(query_history, "GATHER_S", 60.0)  # only who asks for it has it written
    commits = []
    event.listen(engine.store.database._engine, "commit", commits.append)
    with engine.store.database.write():  # another writer is at it meanwhile
        for i in range(300):
            engine.history.note(record(i))
        assert not commits
    commits.clear()
    assert engine.history.flush(60)
    written = [one for one in commits if one is not None]
    assert count(engine) == 300
    assert 1 <= len(written) <= 3  # and not a commit for each


def test_what_cannot_be_written_now_is_written_later(engine, monkeypatch, caplog):
    monkeypatch.setattr(query_history, "AGAIN_S", 0.01)
    write, tried = query_history.add_records, []

    def locked_twice(connection, records):
        tried.append(len(records))
        if len(tried) < 3:
            raise StoreLocked("another process writes")
        return write(connection, records)

    monkeypatch.setattr(query_history, "add_records", locked_twice)
    with caplog.at_level(logging.WARNING):
        engine.history.note(record(1))
        assert engine.history.flush(60)
    assert (count(engine), engine.history.lost, len(tried)) == (1, 0, 3)
    assert [one.message for one in caplog.records] == ["query records wait to be written"]


def test_what_is_lost_is_logged_and_counted(engine, monkeypatch, caplog):
    monkeypatch.setattr(query_history, "MOST_WAITING", 2)
    monkeypatch.setattr(query_history, "GATHER_S", 60.0)
    with caplog.at_level(logging.WARNING):
        for i in range(14):
            engine.history.note(record(i))
    assert engine.history.lost == 12
    assert [(one.message, one.lost) for one in caplog.records] == [
        ("query records lost", 1), ("query records lost", 10)
    ]  # fmt: skip
    engine.history.close()  # which writes what waits
    assert count(engine) == 2
    engine.history.note(record(99))
    assert (engine.history.lost, count(engine)) == (13, 2)


def test_an_unexpected_error_costs_its_records_alone(engine, monkeypatch, caplog):
    write = query_history.add_records

    def breaks(connection, records):
        if records[0].id.endswith("1"):
            raise ZeroDivisionError
        return write(connection, records)

    monkeypatch.setattr(query_history, "add_records", breaks)
    for i in (1, 2):
        engine.history.note(record(i))
        assert engine.history.flush(60)
    assert (told(engine), engine.history.lost) == ([2], 1)
    assert "query records cannot be written" in [one.message for one in caplog.records]


def test_none_is_written_where_none_is_kept(engine):
    silent = QueryHistory(engine.store, Settings(history_days=0))
    silent.note(record(1))
    assert silent.flush(0)
    assert (count(engine), silent.lost) == (0, 0)


def test_a_map_made_anew_has_no_records_of_the_one_before(engine):
    engine.history.note(record(1, at=time.time() - 60))  # of before the map was made
    engine.history.note(record(2, map="cellar"))
    engine.history.note(record(3))
    assert told(engine) == [3]
    engine.delete_map("hall")
    assert (count(engine), engine.history.lost) == (0, 0)


def test_old_and_surplus_records_go_in_blocks(engine, monkeypatch):
    monkeypatch.setattr(deletion, "BLOCK", 3)
    for i in range(10):
        engine.history.note(record(i))
    for i in range(10, 14):
        engine.history.note(record(i, map="attic"))
    assert engine.history.flush(60)
    with engine.store.database.write() as connection:
        aged = update(query_records).where(query_records.c.id.in_(f"{i:032x}" for i in range(4)))
        connection.execute(aged.values(at=time.time() - 31 * DAY_S))
    assert engine.history.remove_spent() == 4
    assert told(engine) == list(range(13, 3, -1))
    few = QueryHistory(engine.store, Settings(history_queries=2))
    assert few.remove_spent() == 6
    assert told(engine) == [13, 12, 9, 8]
    assert few.remove_spent() == 0
    monkeypatch.setattr(query_history, "TIDY_S", 0.0)
    with engine.store.database.write() as connection:
        connection.execute(update(query_records).values(at=1.0))
    engine.publish_due()  # workers look after it
    assert count(engine) == 0


def test_a_revoked_key_takes_its_records_along(engine):
    ids = {}
    for name in ("arm", "cart"):
        secret = engine.create_key(name).secret
        ids[name] = engine.find_key(secret).id
    for i, name in enumerate(("arm", "cart", "arm")):
        engine.history.note(record(i, key_id=ids[name]))
    engine.history.note(record(3))
    page = engine.history.page(EVERY, None, None, 9)
    assert [one.key for one in page.items] == [None, "arm", "cart", "arm"]
    engine.revoke_key("arm")
    assert told(engine) == [3, 1]
    engine.history.note(record(4, key_id=ids["arm"]))  # that was on its way
    assert engine.history.flush(60)
    assert engine.history.remove_spent() == 1
    assert told(engine) == [3, 1]


# Records that robots send of queries that they answered themselves.


def sent(number: int, **more: object) -> dict[str, object]:
    """A record as a robot sends it, a minute for each number ago."""
    at = datetime.fromtimestamp(round(time.time() - 60 * number, 3), UTC)
    one = {
        "query_id": f"{number:032x}", "at": at.isoformat(), "robot": "spot", "session": "monday",
        "status": "found", "reason": "why", "support": 2, "rival_ratio": 0.125,
        "milliseconds": 31.75, "kind": "depth", "frame": {"map": "attic", "frame_id": "f"},
        "pose": {
            "parent_frame": "room", "translation": {"x": 1.1, "y": -2.2, "z": 0.3},
            "rotation": {"x": 0.0, "y": 0.0, "z": 0.6, "w": 0.8},
        },
    }  # fmt: skip
    return one | more


def add(history, *records, key_id=None, name="hall"):
    done = history.add_offline(name, NewQueryRecords(records=list(records)), key_id)
    refused = {int(one.query_id, 16): one.reason for one in done.refused}
    return done.received, done.there, done.expired, refused


@pytest.fixture
def aged(engine):
    """The engine, whose maps are a day old."""
    with engine.store.database.write() as connection:
        connection.execute(update(maps).values(created_at=time.time() - DAY_S))
    return engine


def test_a_robots_records_are_stored_once_with_all_that_they_say(aged):
    one, two = sent(1), sent(2, status="ambiguous", pose=None, alternatives=3, maps=["attic"])
    assert add(aged.history, one, two) == (2, 0, 0, {})
    page = aged.history.page(EVERY, None, None, 9)
    assert [item.model_dump(mode="json") | {"at": None} for item in page.items] == [
        {
            **{name: value for name, value in given.items() if name != "maps"}, "at": None,
            "map": "hall", "maps": asked, "key": None, "cause": None, "kept_until": None,
            "keep": None, "offline": True, "alternatives": given.get("alternatives", 0),
        }
        for given, asked in ((one, ["hall"]), (two, ["attic"]))
    ]  # fmt: skip
    assert [item.at.isoformat() for item in page.items] == [one["at"], two["at"]]
    assert add(aged.history, one, two, sent(3)) == (1, 2, 0, {})
    for changed in (
        {"status": "not_found", "pose": None}, {"reason": "other"}, {"support": 3},
        {"rival_ratio": None}, {"robot": None}, {"maps": ["hall", "attic"]}, {"frame": None},
        {"milliseconds": 31.5}, {"at": sent(4)["at"]}, {"cause": "deadline"}, {"kind": "cloud"},
    ):  # fmt: skip
        done = add(aged.history, one | changed, sent(3) | {"at": told_at(aged, 3)})
        assert done == (0, 1, 0, {1: "the map has another record with this id"}), changed
    assert told(aged) == [1, 2, 3]
    # another map knows nothing of it
    assert add(aged.history, one, name="attic") == (1, 0, 0, {})
    with aged.store.database.read() as connection:
        found = list_events(connection, Wanted(kinds=("query.",)))
    assert [int(event.data["query_id"], 16) for event in found] == [1, 2, 3, 1]
    assert found[0].data == {
        "query_id": one["query_id"], "status": "found", "robot": "spot", "session": "monday",
        "support": 2, "milliseconds": 31.75, "pose": one["pose"], "offline": True,
    }  # fmt: skip


def told_at(engine, number):
    items = engine.history.page(EVERY, None, None, 9).items
    return next(one.at.isoformat() for one in items if int(one.query_id, 16) == number)


def test_records_sent_at_once_by_two_are_there_once(aged):
    records = [sent(i) for i in range(1, 21)]
    with ThreadPoolExecutor(4) as pool:
        done = list(pool.map(lambda _: add(aged.history, *records), range(4)))
    assert sorted(one[:2] for one in done) == [(0, 20), (0, 20), (0, 20), (20, 0)]
    assert told(aged) == list(range(1, 21))


def test_times_that_cannot_be_are_refused_or_put_right(aged):
    before = datetime.fromtimestamp(time.time() - 2 * DAY_S, UTC).isoformat()
    done = add(aged.history, sent(1, at=before), sent(2))
    assert done[:3] == (1, 0, 0)
    assert done[3][1].startswith("the query is older than the map")
    start = time.time()
    ahead = datetime.fromtimestamp(start + DAY_S, UTC).isoformat()
    for expected in ((1, 0, 0, {}), (0, 1, 0, {})):  # and it is recognised later
        assert add(aged.history, sent(3, at=ahead)) == expected
    newest = aged.history.page(EVERY, None, None, 9).items[0]
    assert int(newest.query_id, 16) == 3
    assert start - 1 <= newest.at.timestamp() <= time.time() + 1
    short = QueryHistory(aged.store, Settings(history_days=0.001))  # 86 s
    assert add(short, sent(5), sent(1)) == (1, 0, 1, {})
    none = QueryHistory(aged.store, Settings(history_days=0))
    assert add(none, sent(6)) == (0, 0, 1, {})
    with pytest.raises(UnknownMap):
        add(aged.history, sent(7), name="cellar")


def test_a_map_keeps_no_more_than_it_may_however_many_are_sent(aged):
    few = QueryHistory(aged.store, Settings(history_queries=5))
    for start in (100, 80, 60):
        add(few, *(sent(i) for i in range(start, start - 20, -1)))
        assert count(aged) == 5
    assert told(aged) == list(range(41, 46))
    add(few, *(sent(i) for i in range(70, 50, -1)))  # older than all that are kept
    assert told(aged) == list(range(41, 46))
    # what came in another order than that of its times is counted all the same
    aged.history.note(record(0, at=time.time()))
    assert aged.history.flush(60)
    assert few.remove_spent() == 1
    assert told(aged) == [0, 41, 42, 43, 44]


def test_a_robots_records_go_with_its_key(aged):
    key = aged.find_key(aged.create_key("cart").secret).id
    add(aged.history, sent(1), key_id=key)
    assert aged.history.page(EVERY, None, None, 9).items[0].key == "cart"
    aged.revoke_key("cart")
    assert told(aged) == []


def test_what_the_service_answered_itself_is_known_when_it_comes_back(aged):
    """As from a copy of before copies left the service's records out."""
    aged.history.note(record(1, at=round(time.time() - 5, 6)))
    [online] = aged.history.page(EVERY, None, None, 9).items
    back = NewQueryRecord.model_validate(record_json(online))
    assert add(aged.history, back) == (0, 1, 0, {})
    assert [one.offline for one in aged.history.page(EVERY, None, None, 9).items] == [False]
    # what a robot sends under the id of another's query is never taken for that query's record
    forged = sent(1, at=datetime.fromtimestamp(online.at.timestamp() - 1, UTC).isoformat())
    add(aged.history, forged)
    with aged.store.database.read() as connection:
        number = find_map(connection, "hall").number
        found = record_of_answer(connection, [number], f"{1:032x}", online.at.timestamp())
    assert found is not None
    assert (found.offline, found.status) == (False, "not_found")
