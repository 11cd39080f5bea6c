"""The audit log: bounded, in order, and found by who and where."""

from __future__ import annotations

from sceneprint.store import Store
from sceneprint.store.keys import KeyChange, list_changes, note


def test_the_newest_lines_are_kept(store: Store) -> None:
    with store.database.write() as connection:
        for number in range(9):
            note(connection, KeyChange(f"a{number}", "boss", at=float(number)), kept=4)
    with store.database.read() as connection:
        found = list_changes(connection, None, 99, None, None)
    assert [(one.action, one.at) for one in found] == [
        ("a8", 8.0), ("a7", 7.0), ("a6", 6.0), ("a5", 5.0),
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
