"""Tests of the audit log: entries in the transaction of their event, retention and filters."""

import pytest
from sqlalchemy import insert, select

from sceneprint.engine.admin import operations
from sceneprint.engine.admin.operations import Audit
from sceneprint.errors import InvalidRequest, UnknownMap
from sceneprint.process import Actor, acting_as, name_request, set_actor, work_of
from sceneprint.store.audit_log import (
    AuditFilter,
    list_lines,
    record_change,
    record_refusal,
    remove_lines,
    surplus_lines,
)
from sceneprint.store.events import record_event
from sceneprint.store.maps import find_map
from sceneprint.store.tables import audit, events, pending_events, tenants

DAY_S = 86_400.0


def lines_of(store, **wanted):
    with store.database.read() as connection:
        return list_lines(connection, AuditFilter(**wanted), 1000, after=0)


def add_lines(store, *lines):
    usual = {
        "at": 1.0, "actor": "robot", "tenant": "robot", "action": "map.edited", "map": None,
        "data": {},
    }  # fmt: skip
    with store.database.write() as connection:
        connection.execute(insert(audit), [usual | line for line in lines])


def fail_after_event(connection):
    record_event(connection, "map.deleted", "hall")
    find_map(connection, "none")


def test_an_event_of_an_actor_has_a_line_in_its_transaction(store):
    set_actor(Actor("robot-7", "192.0.2.7"))
    name_request("r1")
    try:
        with work_of("fleet"), store.database.write() as connection:
            record_event(
                connection, "map.edited", "hall", details={"quota_frames": 9}, fields=["title"]
            )
        with pytest.raises(UnknownMap), store.database.write() as connection:
            fail_after_event(connection)
    finally:
        set_actor(None)
        name_request(None)
    [line] = lines_of(store)
    assert vars(line) | {"number": 0, "at": 0.0} == {
        "number": 0, "at": 0.0, "actor": "robot-7", "address": "192.0.2.7", "tenant": "fleet",
        "action": "map.edited", "map": "hall", "target": None, "request_id": "r1",
        "data": {"fields": ["title"], "quota_frames": 9},
    }  # fmt: skip
    with store.database.read() as connection:
        assert connection.execute(select(events.c.data)).scalars().all() == [{"fields": ["title"]}]


def test_a_line_names_what_was_changed(store):
    with acting_as("boss"), store.database.write(map_number=1) as connection:
        record_event(connection, "frame.edited", "hall", "f1", "j1", fields=["tags"])
        record_event(connection, "key.created", name="screen")
        record_event(connection, "frame.damaged", "hall", "f2")  # was found, and not changed
        record_change(connection, "job.cancelled", "hall", "j2", kind="sign")
    result = [(line.action, line.map, line.target, line.data) for line in lines_of(store)]
    assert result == [
        ("frame.edited", "hall", "f1", {"fields": ["tags"]}),
        ("key.created", None, "screen", {"name": "screen"}),
        ("job.cancelled", "hall", "j2", {"kind": "sign"}),
    ]


def test_what_a_worker_carries_out_has_no_line(store):
    with store.database.write() as connection:
        record_event(connection, "frame.indexed", "hall", "f1")
        record_change(connection, "job.removed", "hall", "j1")
    assert lines_of(store) == []
    with store.database.read() as connection:
        both = [connection.execute(select(one.c.kind)).all() for one in (events, pending_events)]
    assert both == [[("frame.indexed",)], []]


def test_texts_of_a_refused_request_are_cut(store):
    robot = Actor("robot", "2001:db8::1")
    with store.database.write() as connection:
        record_refusal(
            connection, robot, "robot", "m" * 99, "hall\0\ud800" + "x" * 200, "r1", status=403
        )
    [line] = lines_of(store)
    assert (line.map, line.target) == ("m" * 63, "hall\ufffd?" + "x" * 122)
    assert (line.action, line.address, line.data) == ("refused", "2001:db8::1", {"status": 403})


def test_lines_are_found_by_actor_map_action_and_time(store):
    add_lines(
        store, {"actor": "boss", "action": "key.created"}, {"map": "hall"},
        {"at": 5.0, "action": "keys"},
    )  # fmt: skip
    for wanted, numbers in (
        ({"actor": "boss"}, [1]), ({"map": "hall"}, [2]), ({"action": "key."}, [1]),
        ({"since": 5.0}, [3]), ({"actor": "robot", "action": "map.edited"}, [2]), ({}, [1, 2, 3]),
    ):  # fmt: skip
        assert [line.number for line in lines_of(store, **wanted)] == numbers


def test_pages_go_from_the_newest_to_the_oldest(store, monkeypatch):
    add_lines(store, *[{"at": float(i), "actor": ""} for i in range(5)])
    log = Audit(store, days=2.0)
    first = log.page(AuditFilter(), limit=3)
    rest = log.page(AuditFilter(), first.next_cursor, limit=3)
    assert [one.number for one in (*first.items, *rest.items)] == [5, 4, 3, 2, 1]
    assert (rest.next_cursor, rest.items[0].actor) == (None, None)
    with pytest.raises(InvalidRequest):
        log.page(AuditFilter(), "none")
    monkeypatch.setattr(operations, "_BLOCK", 2)
    assert [line.number for line in log.lines(AuditFilter())] == [1, 2, 3, 4, 5]


def test_old_lines_are_removed(store):
    add_lines(store, *[{"at": DAY_S * day} for day in (1, 2, 9, 3)])
    log = Audit(store, days=2.0)
    assert log.tidy(now=DAY_S * 4.5) == 2  # the last stays behind a younger one
    assert log.tidy(now=DAY_S * 99) == 0  # not before an hour is over
    assert [line.at for line in lines_of(store)] == [DAY_S * 9, DAY_S * 3]
    assert Audit(store, days=2.0).tidy(now=DAY_S * 99) == 2
    add_lines(store, {})
    assert [line.number for line in lines_of(store)] == [5]  # a number is never given again


def test_the_newest_lines_of_each_tenant_are_kept(store):
    """However much one changes, the lines of the others stay."""
    with store.database.write() as connection:
        connection.execute(
            insert(tenants), [{"name": name, "created_at": 0.0} for name in ("quiet", "noisy")]
        )
    add_lines(store, {"tenant": "quiet"}, {"tenant": ""}, *[{"tenant": "noisy"}] * 9)
    with store.database.write() as connection:
        assert surplus_lines(connection, 0.0, 99, most_lines=99) == []
        assert surplus_lines(connection, 0.0, 2, most_lines=4) == [3, 4]  # the oldest first
        spent = surplus_lines(connection, 0.0, 99, most_lines=4)
        remove_lines(connection, spent)
    assert [line.number for line in lines_of(store)] == [1, 2, 8, 9, 10, 11]
