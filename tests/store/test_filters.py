"""Tests of filters in the database; tests/engine/test_filters.py compares them with Python."""

import pytest
from sqlalchemy import update

from sceneprint.store.frame_queries import QueryOrigin, passing_frames
from sceneprint.store.frames import delete_frame, set_state
from sceneprint.store.maps import add_map
from sceneprint.store.tables import frames
from sceneprint_client.api import Filter, FrameState

NOBODY = QueryOrigin(None, None, None)


def passing(store, row, taken=NOBODY, **wanted):
    with store.database.read() as connection:
        return sorted(passing_frames(connection, row.number, Filter(**wanted), taken).tolist())


@pytest.fixture
def indexed(store, received):
    """Insert a frame as queries find it."""

    def add(content, **fields):
        frame = received(content, **fields)
        with store.database.write() as connection:
            connection.execute(
                update(frames).where(frames.c.number == frame.number).values(state="indexed")
            )
        return frame

    return add


def test_only_indexed_frames_of_the_map_pass(store, hall, indexed, received):
    kept = [indexed(f"kept {i}", tags=["a"], robot="r1") for i in range(12)]
    with store.database.write() as connection:
        attic = add_map(connection, "attic", None, hall.model_id)
    other = indexed("other", row=attic, tags=["a"], robot="r1")
    for state in FrameState:
        if state != FrameState.INDEXED:
            frame = received(state, tags=["a"], robot="r1")
            with store.database.write() as connection:
                set_state(connection, frame.number, state)
    with store.database.write() as connection:
        delete_frame(connection, hall, kept[0])
    numbers = [frame.number for frame in kept[1:]]
    for wanted in ({}, {"tags": ["a"]}, {"robot": "r1"}, {"exclude_frames": [kept[0].id]}):
        assert passing(store, hall, **wanted) == numbers  # two digits and more, too
    assert passing(store, attic) == [other.number]
    assert passing(store, hall, robot="r2") == []
    with store.database.read() as connection:
        nobody = passing_frames(connection, 99, Filter(), NOBODY)
    assert (nobody.dtype, nobody.shape) == ("int64", (0,))


def test_own_session_is_that_of_the_robot(store, hall, indexed):
    """Named: by robot, session and time of a frame; the query is r1 in s at 100, 10 s away."""
    frames = {
        text: indexed(str(text), robot=text[0], session=text[1], captured_at=text[2]).number
        for text in [
            ("r1", "s", 89.9), ("r1", "s", 90.0), ("r1", "s", 110.0), ("r1", "s", 110.1),
            ("r1", "s", None), ("r1", "t", 100.0), ("r1", None, 100.0), ("r2", "s", 100.0),
            (None, "s", 100.0), (None, "s", 200.0), ("r2", "s", None),
        ]
    }  # fmt: skip
    away = [("r1", "s", 89.9), ("r1", "s", 110.1), ("r1", "t", 100.0), ("r1", None, 100.0),
            (None, "s", 200.0)]  # fmt: skip
    of_r2 = [("r2", "s", 100.0), ("r2", "s", None)]
    origin = QueryOrigin("r1", "s", 100.0)
    assert passing(store, hall, origin, not_within_s=10) == sorted(frames[o] for o in away + of_r2)
    # a query that names no robot may be any robot's
    origin = QueryOrigin(None, "s", 100.0)
    assert passing(store, hall, origin, not_within_s=10) == sorted(frames[o] for o in away)
    with pytest.raises(ValueError, match="no session"):
        passing(store, hall, NOBODY, not_within_s=10)


BOX = {"min": {"x": 0, "y": 0, "z": 0}, "max": {"x": 1, "y": 1, "z": 1}}


@pytest.mark.parametrize(
    "wanted",
    [
        {"robot": "r1"},
        {"session": "s"},
        {"captured_after": "2026-11-16T09:30:00Z"},
        {"tags": ["a", "b"]},
        {"not_within_s": 5},
        {"region": {"parent_frame": "p", **BOX}},
        {"exclude_frames": ["a"]},
    ],
)
def test_no_filter_reads_other_maps(store, hall, plans, wanted):
    with store.database.read() as connection, plans(connection) as steps:
        passing_frames(
            connection, hall.number, Filter.model_validate(wanted), QueryOrigin("r1", "s", 1.0)
        )
    assert steps
    assert all("SEARCH" in step or "LIST SUBQUERY" in step for step in steps), steps
    assert not any("TEMP B-TREE" in step for step in steps), steps
    if "session" in wanted:
        assert any("session=?" in step for step in steps), steps
    if "tags" in wanted:
        assert sum("tag=?" in step for step in steps) == 2
