"""Tests of joined and separated parent frames, which finally have their original poses."""

import math

import numpy as np
import pytest
from sqlalchemy import insert, select, update

from sceneprint.store.maps import add_frame, add_map, position, store_model
from sceneprint.store.parent_joins import (
    ParentJoin,
    join_parent,
    root_columns,
    undo_joins,
    undone_pairs,
)
from sceneprint.store.tables import frame_row, frames, surface_frames
from sceneprint_client.api import FrameState
from tests.store.frame_rows import frame_values

MODEL = "ab" * 32
CB, BA = "c" * 32, "b" * 32  # associations
#: Numbers that no product of poses leaves as they are.
SENT = [
    [0.6, -0.8, 0.0, 0.1],
    [0.8, 0.6, 0.0, 1 / 3],
    [0.0, 0.0, 1.0, math.pi],
    [0.0, 0.0, 0.0, 1.0],
]
#: C lies 10 m along the x of B; B is turned by a right angle about the z of A, 100 m up.
B_C, A_B = np.eye(4), np.eye(4)
B_C[0, 3] = 10.0
A_B[:3] = [[0.0, -1.0, 0.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 100.0]]


@pytest.fixture
def at(store):
    """A writing connection, and the number of a map of four frames: in A, B, C and without pose."""
    with store.database.write() as connection:
        store_model(connection, MODEL, "toy", b"")
        row = add_map(connection, "hall", None, MODEL)
        for name in ("A", "B", "C", None):
            pose = {} if name is None else {"pose_parent": name, "pose": SENT}
            values = frame_values(f"{name}" * 8, session=name, novelty=None, cloud=None, **pose)
            add_frame(connection, row.number, values)
        yield connection, row.number


def stored(connection):
    """What the frame of each session has: parent frame, pose, and what was sent."""
    c = frames.c
    columns = (c.session, c.pose_parent, c.pose, c.pose_x, c.sent_parent, c.sent_pose)
    return {name: (parent, pose, x, *sent)
            for name, parent, pose, x, *sent in connection.execute(select(*columns))}  # fmt: skip


def moved(T, root, parent):
    pose = (T @ np.array(SENT)).tolist()
    return root, pose, pose[0][3], parent, SENT


AS_SENT = {
    **{name: (name, SENT, 0.1, None, None) for name in "ABC"}, None: (None, None, None, None, None)
}  # fmt: skip


def join_chain(connection, number):
    assert join_parent(connection, number, ParentJoin("C", "B", B_C), CB)
    assert stored(connection) == AS_SENT | {"C": moved(B_C, "B", "C")}
    assert join_parent(connection, number, ParentJoin("B", "A", A_B), BA)


def test_a_chain_of_joins_leads_to_its_root(at):
    connection, number = at
    join_chain(connection, number)
    chained = {"B": moved(A_B, "A", "B"), "C": moved(A_B @ B_C, "A", "C")}
    assert stored(connection) == AS_SENT | chained
    # by hand: x of A is minus y of B, y of A is x of B, 10 m of which is C's origin
    assert [one[3] for one in stored(connection)["C"][1][:3]] == [-1 / 3, 10.1, math.pi + 100]
    for one in (ParentJoin("B", "A", A_B), ParentJoin("A", "C", A_B)):
        assert not join_parent(connection, number, one, "d" * 32)
    assert stored(connection) == AS_SENT | chained


@pytest.mark.parametrize("first", [CB, BA])
def test_joins_are_undone_in_either_order(at, first):
    connection, number = at
    join_chain(connection, number)
    deleted = update(frames).where(frames.c.session == "C")  # it may be restored
    connection.execute(deleted.values(state=FrameState.DELETED))
    assert undo_joins(connection, number, first)
    left = {BA: {"C": moved(B_C, "B", "C")}, CB: {"B": moved(A_B, "A", "B")}}[first]
    assert stored(connection) == AS_SENT | left
    assert undone_pairs(connection, number) == [{BA: {"A", "B"}, CB: {"A", "C"}}[first]]
    assert not undo_joins(connection, number, first)
    assert undo_joins(connection, number, {CB: BA, BA: CB}[first])
    assert stored(connection) == AS_SENT  # to the last bit
    assert undone_pairs(connection, number) in ([{"A", "B"}, {"B", "C"}], [{"B", "C"}, {"A", "B"}])
    join_chain(connection, number)  # by somebody who knows better
    assert undone_pairs(connection, number) == []


def test_what_was_moved_is_noted_for_surfaces(at):
    connection, number = at
    join_chain(connection, number)
    numbers = list(connection.execute(select(frames.c.number).order_by(frames.c.number)).scalars())
    rows = [
        {"map_number": number, "frame_number": frame_number, "parent": "A", "changed": False}
        for frame_number in numbers
    ]
    connection.execute(insert(surface_frames), rows)
    undo_joins(connection, number, BA)
    changed = select(surface_frames.c.frame_number).where(surface_frames.c.changed)
    assert set(connection.execute(changed).scalars()) == {*numbers[1:3]}  # of B and C


def test_a_frame_in_flight_is_moved_once(at):
    connection, number = at
    which = select(frames).where(frames.c.session == "C")
    before = frame_row(connection.execute(which).mappings().one())
    assert root_columns(connection, before) == {}
    join_chain(connection, number)
    names = ("pose_parent", "pose", "sent_parent", "sent_pose")
    root, pose, _, *sent = moved(A_B @ B_C, "A", "C")
    assert root_columns(connection, before) == dict(zip(names, (root, pose, *sent), strict=True))
    now = frame_row(connection.execute(which).mappings().one())
    assert join_parent(connection, number, ParentJoin("A", "Z", A_B), "d" * 32)
    assert root_columns(connection, now) == {}  # the join has moved it
    assert undo_joins(connection, number, "d" * 32)
    undo_joins(connection, number, BA)
    undo_joins(connection, number, CB)
    assert root_columns(connection, now) == root_columns(connection, before) == {}


def test_a_copied_frame_follows_the_joins_of_its_own_map(at):
    """Its map has not the join that moved it elsewhere."""
    connection, number = at
    copied = moved(B_C, "B", "C")
    names = ("pose_parent", "pose", "pose_x", "sent_parent", "sent_pose")
    of_c = update(frames).where(frames.c.session == "C")
    connection.execute(of_c.values(**dict(zip(names, copied, strict=True))))
    assert join_parent(connection, number, ParentJoin("B", "A", A_B), BA)
    pose = (A_B @ np.array(copied[1])).tolist()
    assert stored(connection)["C"] == ("A", pose, position(pose)["pose_x"], "B", copied[1])
    assert undo_joins(connection, number, BA)
    assert stored(connection)["C"] == ("B", copied[1], 10.1, None, None)
