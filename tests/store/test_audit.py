"""The audit log: chained by hash, bounded for each tenant, and found by who and where."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from contextlib import closing
from typing import Any

import pytest
from sqlalchemy import delete, insert, select, text, update

from sceneprint.engine.admin.operations import Audit
from sceneprint.store import Store
from sceneprint.store.audit_chain import (
    BEGINNING,
    KeyChange,
    differs_from_copy,
    has_old_lines,
    line_hash,
    lines_in_order,
    list_changes,
    note,
    prune_old_lines,
    verify_chains,
)
from sceneprint.store.database import reach_database
from sceneprint.store.tables import audit, audit_chains


def _write(store: Store, *lines: KeyChange, kept: int = 99) -> None:
    with store.database.write() as connection:
        for one in lines:
            note(connection, one, kept)


def _lines(store: Store) -> list[KeyChange]:
    with store.database.read() as connection:
        return lines_in_order(connection, 0)


def _broken(store: Store) -> list[tuple[str, bool, int | None, str]]:
    with store.database.read() as connection:
        found = verify_chains(connection).broken
    return [(one.tenant, one.refused, one.sequence, one.why) for one in found]


def test_the_newest_lines_of_each_tenant_are_kept(store: Store) -> None:
    """However much one does, the lines of the others stay."""
    _write(store, KeyChange("quiet", "robot", at=0.5), kept=4)
    for number in range(9):
        _write(store, KeyChange(f"a{number}", "boss", at=float(number)), kept=4)
    with store.database.read() as connection:
        found = list_changes(connection, None, 99, None, None)
        assert verify_chains(connection).broken == []
    assert [(one.action, one.at) for one in found] == [
        ("a8", 8.0), ("a7", 7.0), ("a6", 6.0), ("a5", 5.0), ("quiet", 0.5),
    ]  # fmt: skip
    assert [one.sequence for one in found] == [9, 8, 7, 6, 1]


def test_refusals_do_not_push_out_changes(store: Store) -> None:
    _write(store, KeyChange("make", "robot"), kept=3)
    for _ in range(9):
        _write(store, KeyChange("delete_map", "robot", refused=True), kept=3)
    assert [(one.action, one.refused, one.sequence) for one in _lines(store)] == [
        ("make", False, 1), ("delete_map", True, 7), ("delete_map", True, 8),
        ("delete_map", True, 9),
    ]  # fmt: skip


def test_lines_are_found_by_actor_and_map(store: Store) -> None:
    with store.database.write() as connection:
        note(connection, KeyChange("make", "boss", map="hall", data={"n": 1}))
        note(connection, KeyChange("make", "robot", map="yard", target="t" * 200))
        note(connection, KeyChange("edit", "robot", map="hall"))

    def found(*asked: object) -> list[tuple[str, str, str | None]]:
        with store.database.read() as connection:
            lines = list_changes(connection, *asked)  # type: ignore[arg-type]
        return [(one.action, one.actor, one.map) for one in lines]

    made, moved, edited = ("make", "boss", "hall"), ("make", "robot", "yard"), (
        "edit", "robot", "hall",
    )  # fmt: skip
    assert found(None, 9, None, None) == [edited, moved, made]
    assert found(3, 1, None, None) == [moved]
    assert found(None, 9, "robot", None) == [edited, moved]
    assert found(None, 9, None, "hall") == [edited, made]
    assert found(None, 9, "robot", "hall") == [edited]
    with store.database.read() as connection:
        _, second, first = list_changes(connection, None, 9, None, None)
    assert (first.data, second.target) == ({"n": 1}, "t" * 128)


def test_a_hash_is_of_the_one_before_and_of_the_line(store: Store) -> None:
    _write(
        store,
        KeyChange("make", "boss", "::1", "hall", at=1.5, data={"b": 0.1, "a": "\u00e9"}),
        KeyChange("edit", "boss", at=2.0, tenant="boss"),
    )
    first, second = _lines(store)
    of_first = (
        BEGINNING + '["boss",false,1,1.5,"boss","::1","make","hall",null,null,'
        '{"a":"\\u00e9","b":0.1}]'
    )
    assert first.hash == hashlib.sha256(of_first.encode()).hexdigest()
    of_second = first.hash + '["boss",false,2,2.0,"boss",null,"edit",null,null,null,{}]'
    assert second.hash == hashlib.sha256(of_second.encode()).hexdigest()
    assert second.hash == line_hash(first.hash, second)


#: What somebody does to the third of five lines, and what is said of it.
_THIRD = audit.c.sequence == 3
CHANGES: list[tuple[Any, int, str]] = [
    (update(audit).where(_THIRD).values(actor="other"), 3, "its content or its hash was changed"),
    (update(audit).where(_THIRD).values(data={"n": 1}), 3, "its content or its hash was changed"),
    (update(audit).where(_THIRD).values(at=2.5), 3, "its content or its hash was changed"),
    (update(audit).where(_THIRD).values(hash="0" * 64), 3, "its content or its hash was changed"),
    (delete(audit).where(_THIRD), 3, "it was removed"),
    (delete(audit).where(audit.c.sequence == 5), 5, "it was removed"),
    (delete(audit).where(audit.c.sequence == 1), 1, "it was removed"),
    (update(audit_chains).values(last=4), 5, "it was added behind the newest line"),
    (update(audit_chains).values(head="0" * 64), 6, "the chain ends with another line"),
    (update(audit_chains).values(pruned=1), 2, "its content or its hash was changed"),
]


@pytest.mark.parametrize(("change", "place", "why"), CHANGES)
def test_the_first_line_that_does_not_fit_is_named(
    store: Store, change: Any, place: int, why: str
) -> None:
    _write(store, *[KeyChange("edit", "robot", at=float(i)) for i in range(5)])
    assert _broken(store) == []
    with store.database.write() as connection:
        connection.execute(change)
    assert _broken(store) == [("robot", False, place, why)]


def test_a_line_of_no_chain_is_named(store: Store) -> None:
    """One that somebody adds, not those of before there were chains."""
    old = {"actor": "robot", "action": "make", "data": {}}
    with store.database.write() as connection:
        connection.execute(insert(audit).values(at=1.0, **old))
    _write(store, KeyChange("edit", "robot"))
    with store.database.read() as connection:
        found = verify_chains(connection)
    assert (found.broken, found.lines, found.chains, found.unchained) == ([], 1, 1, 1)
    with store.database.write() as connection:
        connection.execute(insert(audit).values(at=1.0, **old))
        connection.execute(
            insert(audit).values(
                at=1.0, tenant="ghost", refused=False, sequence=1, hash="1" * 64, **old
            )
        )
    assert _broken(store) == [("", False, None, "it is in no chain")]
    with store.database.write() as connection:
        connection.execute(delete(audit).where(audit.c.number == 3))
    assert _broken(store) == [("ghost", False, 1, "it is in no chain")]


def test_lines_are_kept_for_their_time_and_the_chain_goes_on(store: Store) -> None:
    day = 86_400.0
    _write(
        store, *[KeyChange("edit", "robot", at=day * i) for i in (1, 2, 3, 4)],
        KeyChange("make", "boss", at=day * 2),
        KeyChange("edit", "robot", at=day * 2.5),  # the clock had been set back
    )  # fmt: skip
    with store.database.read() as connection:
        assert has_old_lines(connection, day * 2.2)
        assert not has_old_lines(connection, day)
    with store.database.write() as connection:
        assert prune_old_lines(connection, day * 2.2, most=1) == 2
        assert prune_old_lines(connection, day * 2.2) == 1
        assert prune_old_lines(connection, day * 2.2) == 0
    assert [(one.actor, one.at, one.sequence) for one in _lines(store)] == [
        ("robot", day * 3, 3), ("robot", day * 4, 4), ("robot", day * 2.5, 5),
    ]  # fmt: skip
    assert _broken(store) == []
    with store.database.write() as connection:
        assert prune_old_lines(connection, day * 9) == 3
    _write(store, KeyChange("edit", "robot"))
    assert [one.sequence for one in _lines(store)] == [6]
    assert _broken(store) == []


def test_old_lines_are_removed_between_jobs(store: Store) -> None:
    day, log = 86_400.0, Audit(store, kept_days=2.0)
    for at in (1.0, 2.0, 3.0):
        log.note(KeyChange("edit", "robot", at=day * at))
    assert log.tidy(now=day * 4.5) == 2
    assert log.tidy(now=day * 4.5) == 0
    assert log.tidy(now=day * 9) == 0  # not before an hour is over
    assert [one.at for one in _lines(store)] == [day * 3]


def test_a_copy_tells_of_a_log_that_was_made_anew(store: Store) -> None:
    """Whoever can write to the database can make all hashes fit."""
    _write(store, *[KeyChange("edit", "robot", at=float(i)) for i in range(3)])
    copy = _lines(store)
    with store.database.write() as connection:
        assert [differs_from_copy(connection, one) for one in copy] == [None] * 3
        connection.execute(delete(audit))
        connection.execute(delete(audit_chains))
        assert differs_from_copy(connection, copy[0]) == "its chain is gone"
        note(connection, KeyChange("edit", "robot", at=0.0))
        note(connection, KeyChange("edit", "other", at=1.0, tenant="robot"))
        assert verify_chains(connection).broken == []
        assert [differs_from_copy(connection, one) for one in copy] == [
            None, "it has another hash", "it is gone",
        ]  # fmt: skip


def test_processes_that_write_at_once_make_one_chain(
    url: str, store: Store, race: Callable[..., list[Any]]
) -> None:
    work = """
from sceneprint.store import open_database
from sceneprint.store.audit_chain import KeyChange, note
def work(i):
    database = open_database(ARGS[0])
    for number in range(20):
        with database.write() as connection:
            note(connection, KeyChange(f"{i}", "robot", data={"n": number}), kept=50)
    database.close()
"""
    assert race(work, 4, url) == [None] * 4
    with store.database.read() as connection:
        found = verify_chains(connection)
        places = list(
            connection.execute(select(audit.c.sequence).order_by(audit.c.number)).scalars()
        )
    assert (found.broken, found.lines, found.chains) == ([], 50, 1)
    assert places == list(range(31, 81))


def test_lines_of_before_there_were_chains_stay(url: str, store: Store) -> None:
    with closing(reach_database(url)) as other, other.write() as connection:
        connection.execute(
            text("INSERT INTO audit (at, actor, action, data) VALUES (1, 'boss', 'make', '{}')")
        )
    (line,) = _lines(store)
    assert (line.actor, line.tenant, line.refused, line.sequence, line.hash) == (
        "boss", None, None, None, None,
    )  # fmt: skip
