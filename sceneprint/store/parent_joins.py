"""Joins of parent frames, and the resulting poses of frames.

A join transforms poses from one parent frame to another. Following the joins from a parent frame
leads to its root. The stored pose of a frame is relative to the root; the uploaded pose is stored
too.

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
from sceneprint.store.surface_rows import note_edit
from sceneprint.store.tables import FrameRow, frames, parent_joins
from sceneprint.types import Floats
from sceneprint_client.api import FrameState


@dataclass(frozen=True, eq=False)
class ParentJoin:
    """A joined parent frame, its root, and T_root_parent (4, 4)."""

    parent: str
    root: str
    T: Floats


@dataclass(frozen=True)
class ParentRun:
    """A session in one parent frame: count of indexed frames, and number of the first frame."""

    parent: str
    session: str | None
    robot: str | None
    frames: int
    first: int


def find_joins(connection: Connection, map_number: int) -> dict[str, ParentJoin]:
    """Return the joins of a map from parent frames to their roots, by parent frame."""
    c = parent_joins.c
    stands = c.map_number == map_number, c.undone_at.is_(None)
    rows = connection.execute(select(c.parent, c.towards, c.transform).where(*stands))
    steps = {row.parent: (row.towards, np.array(row.transform)) for row in rows}
    joins = {}
    for parent, (root, T) in steps.items():
        while root in steps:  # terminates, because joins have no cycles
            root, onwards = steps[root]
            T = onwards @ T
        joins[parent] = ParentJoin(parent, root, T)
    return joins


def is_joined_by(connection: Connection, map_number: int, job_id: str) -> bool:
    """Return whether a join by an association is in effect."""
    c = parent_joins.c
    stands = c.map_number == map_number, c.job_id == job_id, c.undone_at.is_(None)
    return connection.execute(select(c.parent).where(*stands)).first() is not None


def undone_pairs(connection: Connection, map_number: int) -> list[set[str]]:
    """Return the current roots of the two parent frames of each undone join."""
    c, joins = parent_joins.c, find_joins(connection, map_number)
    undone = select(c.parent, c.towards).where(c.map_number == map_number, c.undone_at.is_not(None))
    return [{_root(joins, name) for name in row} for row in connection.execute(undone)]


def _root(joins: Mapping[str, ParentJoin], name: str) -> str:
    return joins[name].root if name in joins else name


def posed_runs(connection: Connection, map_number: int) -> list[ParentRun]:
    """Return the sessions of a map with poses, by parent frame, in the order of first frames."""
    c, first = frames.c, func.min(frames.c.number)
    run = (c.pose_parent, c.session, c.robot)
    statement = select(*run, func.count(), first).where(
        c.map_number == map_number, c.state == FrameState.INDEXED, c.pose_x.is_not(None)
    )
    rows = connection.execute(statement.group_by(*run).order_by(first))
    return [ParentRun(*row) for row in rows]


def count_poses(
    connection: Connection, map_number: int | None = None
) -> dict[int, tuple[int, int]]:
    """Count the indexed frames with a pose, and their parent frames, by map number.

    Maps without such frames are omitted; `map_number` selects one map.
    """
    c = frames.c
    statement = select(c.map_number, func.count(c.pose_x), func.count(c.pose_parent.distinct()))
    statement = statement.where(c.state == FrameState.INDEXED, c.pose_x.is_not(None))
    if map_number is not None:
        statement = statement.where(c.map_number == map_number)
    found = connection.execute(statement.group_by(c.map_number))
    return {number: (posed, parents) for number, posed, parents in found}


def root_columns(connection: Connection, frame: FrameRow) -> dict[str, Any]:
    """Return a frame's pose columns after all joins; {} if its stored pose is up to date."""
    if frame.pose is None or frame.pose_parent is None or frame.sent_parent is not None:
        return {}  # the joins have already been applied
    join = find_joins(connection, frame.map_number).get(frame.pose_parent)
    return {} if join is None else _columns(frame.pose_parent, frame.pose, join)


def _columns(parent: str, sent: Any, join: ParentJoin | None) -> dict[str, Any]:
    """Return the pose columns of a frame whose uploaded pose a join transforms."""
    if join is None:
        return {"pose_parent": parent, "pose": sent, "sent_parent": None, "sent_pose": None}
    moved = (join.T @ np.array(sent)).tolist()
    return {"pose_parent": join.root, "pose": moved, "sent_parent": parent, "sent_pose": sent}


def join_parent(connection: Connection, map_number: int, join: ParentJoin, job_id: str) -> bool:
    """Record a join, and move all poses that are relative to a root to another root.

    Parameters
    ----------
    connection : writing transaction of the map
    join : join of two roots
    job_id : id of the association that found the join

    Returns
    -------
    joined : False if one of the roots is already joined, and nothing was written
    """
    before = find_joins(connection, map_number)
    if join.parent in before or join.root in before:
        return False
    c = parent_joins.c
    ends = c.map_number == map_number, c.parent == join.parent, c.towards == join.root
    connection.execute(delete(parent_joins).where(*ends))  # a join that was undone earlier
    connection.execute(
        insert(parent_joins).values(
            map_number=map_number, parent=join.parent, towards=join.root, transform=join.T.tolist(),
            job_id=job_id, joined_at=time.time(),
        )
    )  # fmt: skip
    _move_frames(connection, map_number, before)
    return True


def undo_joins(connection: Connection, map_number: int, job_id: str) -> bool:
    """Undo the joins by an association, in a write transaction of the map.

    Returns
    -------
    undone : False if no such join is in effect, and nothing was written
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
    """Recompute the poses of all frames with a changed root, and record these edits."""
    now = find_joins(connection, map_number)
    changed = [name for name in {*before, *now} if _root(before, name) != _root(now, name)]
    f = frames.c
    affected = select(f.number, f.pose_parent, f.pose, f.sent_parent, f.sent_pose).where(
        f.map_number == map_number,
        f.pose_x.is_not(None),
        f.pose_parent.in_(changed) | f.sent_parent.in_(changed),
    )  # including deleted frames, which may be restored
    moved = []
    for number, parent, pose, sent_parent, sent_pose in connection.execute(affected).all():
        sent = (parent, pose)
        if sent_parent in changed:
            sent = (sent_parent, sent_pose)
        values = _columns(*sent, now.get(sent[0]))
        moved.append({"own": number, **values, **position(values["pose"])})
    if not moved:
        return
    own = update(frames).where(f.number == bindparam("own"))
    columns = [name for name in moved[0] if name != "own"]
    named = own.values({name: bindparam(name, type_=f[name].type) for name in columns})
    connection.execute(named, moved)
    note_edit(connection, [row["own"] for row in moved], map_number)
