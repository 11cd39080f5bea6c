"""Parent frames joined into one: their rows, and the poses of frames that follow them.

A join leads from a parent frame to another. Frames that were sent with poses in a parent frame have
them in its root, which is where its joins lead to, and keep what was sent beside that.

    join_parent, undo_joins  -->  rows of joins  --find_joins-->  roots  -->  poses of frames
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import Connection, bindparam, delete, func, insert, select, update

from sceneprint.store.maps import position
from sceneprint.store.surface_rows import note_moved
from sceneprint.store.tables import FrameRow, frames, parent_joins
from sceneprint.types import Floats
from sceneprint_client.api import FrameState


@dataclass(frozen=True, eq=False)
class ParentJoin:
    """A parent frame that is joined, the root, and T_root_parent (4, 4)."""

    parent: str
    root: str
    T: Floats


@dataclass(frozen=True)
class ParentRun:
    """Indexed frames of a map in one parent frame and session: how many, and the first number."""

    parent: str
    session: str | None
    robot: str | None
    frames: int
    first: int


def find_joins(connection: Connection, map_number: int) -> dict[str, ParentJoin]:
    """Return how each joined parent frame of a map lies in its root, by its name."""
    c = parent_joins.c
    stands = c.map_number == map_number, c.undone_at.is_(None)
    rows = connection.execute(select(c.parent, c.towards, c.transform).where(*stands))
    steps = {row.parent: (row.towards, np.array(row.transform)) for row in rows}
    found = {}
    for parent, (root, T) in steps.items():
        while root in steps:  # it ends: a join leads from one root to another
            root, onwards = steps[root]
            T = onwards @ T
        found[parent] = ParentJoin(parent, root, T)
    return found


def is_joined_by(connection: Connection, map_number: int, job_id: str) -> bool:
    """Return whether a join that an association found stands."""
    c = parent_joins.c
    stands = c.map_number == map_number, c.job_id == job_id, c.undone_at.is_(None)
    return connection.execute(select(c.parent).where(*stands)).first() is not None


def undone_pairs(connection: Connection, map_number: int) -> list[set[str]]:
    """Return the roots that the two ends of each undone join lead to now."""
    c, joins = parent_joins.c, find_joins(connection, map_number)
    undone = select(c.parent, c.towards).where(c.map_number == map_number, c.undone_at.is_not(None))
    return [{_root(joins, name) for name in row} for row in connection.execute(undone)]


def _root(joins: Mapping[str, ParentJoin], name: str) -> str:
    return joins[name].root if name in joins else name


def posed_runs(connection: Connection, map_number: int) -> list[ParentRun]:
    """Return the sessions of a map's indexed frames with poses, the one that came first first."""
    c, first = frames.c, func.min(frames.c.number)
    run = (c.pose_parent, c.session, c.robot)
    asked = select(*run, func.count(), first).where(
        c.map_number == map_number, c.state == FrameState.INDEXED, c.pose_x.is_not(None)
    )
    found = connection.execute(asked.group_by(*run).order_by(first))
    return [ParentRun(*row) for row in found]


def count_poses(connection: Connection, map_number: int) -> tuple[int, int]:
    """Return how many indexed frames of a map have a pose, and in how many parent frames."""
    c = frames.c
    asked = select(func.count(c.pose_x), func.count(c.pose_parent.distinct())).where(
        c.map_number == map_number, c.state == FrameState.INDEXED, c.pose_x.is_not(None)
    )
    posed, parents = connection.execute(asked).one()
    return posed, parents


def root_columns(connection: Connection, frame: FrameRow) -> dict[str, Any]:
    """Return the pose in the root of a frame whose pose is as it was sent, in a joined frame; else
    nothing.
    """
    if frame.pose is None or frame.pose_parent is None or frame.sent_parent is not None:
        return {}  # what was moved follows its joins by itself
    one = find_joins(connection, frame.map_number).get(frame.pose_parent)
    return {} if one is None else _columns(frame.pose_parent, frame.pose, one)


def _columns(parent: str, sent: Any, one: ParentJoin | None) -> dict[str, Any]:
    """Return the columns of a frame that was sent in a parent frame, by the join of that."""
    if one is None:
        return {"pose_parent": parent, "pose": sent, "sent_parent": None, "sent_pose": None}
    moved = (one.T @ np.array(sent)).tolist()
    return {"pose_parent": one.root, "pose": moved, "sent_parent": parent, "sent_pose": sent}


def join_parent(connection: Connection, map_number: int, one: ParentJoin, job_id: str) -> bool:
    """Let all poses in a parent frame, and those that were joined to it, lead to a root.

    Parameters
    ----------
    connection : of a writing transaction of the map
    map_number : of the map
    one : a join of two roots
    job_id : of the association that found it

    Returns
    -------
    joined : False, and nothing was written, where one of them is joined by now
    """
    before = find_joins(connection, map_number)
    if one.parent in before or one.root in before:
        return False
    c = parent_joins.c
    ends = c.map_number == map_number, c.parent == one.parent, c.towards == one.root
    connection.execute(delete(parent_joins).where(*ends))  # it may have been undone before
    connection.execute(
        insert(parent_joins).values(
            map_number=map_number, parent=one.parent, towards=one.root, transform=one.T.tolist(),
            job_id=job_id, joined_at=time.time(),
        )
    )  # fmt: skip
    _move_frames(connection, map_number, before)
    return True


def undo_joins(connection: Connection, map_number: int, job_id: str) -> bool:
    """Take back the joins that an association found, in a writing transaction of the map.

    Returns
    -------
    undone : False, and nothing was written, where none of them stands
    """
    before = find_joins(connection, map_number)
    if not is_joined_by(connection, map_number, job_id):
        return False
    c = parent_joins.c
    own = c.map_number == map_number, c.job_id == job_id, c.undone_at.is_(None)
    connection.execute(update(parent_joins).where(*own).values(undone_at=time.time()))
    _move_frames(connection, map_number, before)
    return True


def _move_frames(connection: Connection, map_number: int, before: Mapping[str, ParentJoin]) -> None:
    """Give frames whose root is another one than before their poses in it, by what was sent."""
    now = find_joins(connection, map_number)
    changed = [name for name in {*before, *now} if _root(before, name) != _root(now, name)]
    f = frames.c
    affected = select(f.number, f.pose_parent, f.pose, f.sent_parent, f.sent_pose).where(
        f.map_number == map_number,
        f.pose_x.is_not(None),
        f.pose_parent.in_(changed) | f.sent_parent.in_(changed),
    )  # deleted ones too: they may be restored
    moved = []
    for number, parent, pose, sent_parent, sent_pose in connection.execute(affected).all():
        sent = (parent, pose)
        if sent_parent in changed:  # else a copy of a frame that another map had moved
            sent = (sent_parent, sent_pose)
        values = _columns(*sent, now.get(sent[0]))
        moved.append({"own": number, **values, **position(values["pose"])})
    if not moved:
        return
    own = update(frames).where(f.number == bindparam("own"))
    columns = [name for name in moved[0] if name != "own"]
    named = own.values({name: bindparam(name, type_=f[name].type) for name in columns})
    connection.execute(named, moved)
    note_moved(connection, [one["own"] for one in moved], map_number)
