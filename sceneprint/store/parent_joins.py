"""Parent frames joined into one: their rows, and the poses of frames that follow them.

A join leads from a parent frame to a root, which is joined to none itself. Frames that were sent
with poses in the parent frame have them in the root, and keep what was sent beside that.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy import Connection, bindparam, func, insert, select, update

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


def find_join(connection: Connection, map_number: int, parent: str | None) -> ParentJoin | None:
    """Return the join that leads from a parent frame, if there is one."""
    c = parent_joins.c
    asked = select(c.parent, c.root, c.transform)
    row = connection.execute(asked.where(c.map_number == map_number, c.parent == parent)).first()
    return None if row is None else ParentJoin(row.parent, row.root, np.array(row.transform))


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
    """Return the pose in the root of a frame whose parent frame is joined; nothing of others."""
    one = None if frame.pose is None else find_join(connection, frame.map_number, frame.pose_parent)
    if one is None:
        return {}
    moved = (one.T @ np.array(frame.pose)).tolist()
    sent = {"sent_parent": frame.pose_parent, "sent_pose": frame.pose}
    return {"pose_parent": one.root, "pose": moved, **sent}


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
    parent, root, T = one.parent, one.root, one.T
    if any(find_join(connection, map_number, name) for name in (parent, root)):
        return False
    c, to_root = parent_joins.c, {parent: T}
    of_parent = select(c.parent, c.transform).where(c.map_number == map_number, c.root == parent)
    for name, transform in connection.execute(of_parent).all():
        to_root[name] = T @ np.array(transform)
        own = update(parent_joins).where(c.map_number == map_number, c.parent == name)
        connection.execute(own.values(root=root, transform=to_root[name].tolist()))
    connection.execute(
        insert(parent_joins).values(
            map_number=map_number, parent=parent, root=root, transform=T.tolist(), job_id=job_id,
            joined_at=time.time(),
        )
    )  # fmt: skip
    f = frames.c
    asked = select(f.number, f.pose, f.sent_parent, f.sent_pose).where(
        f.map_number == map_number, f.pose_parent == parent, f.pose_x.is_not(None)
    )  # deleted ones too: they may be restored
    moved = []
    for number, pose, sent_parent, sent_pose in connection.execute(asked).all():
        sent = pose if sent_pose is None else sent_pose
        in_root = (to_root[sent_parent or parent] @ np.array(sent)).tolist()
        moved.append(
            {
                "own": number, "pose": in_root, **position(in_root),
                "sent_parent": sent_parent or parent, "sent_pose": sent,
            }
        )  # fmt: skip
    _move(connection, map_number, root, moved)
    return True


def _move(
    connection: Connection, map_number: int, root: str, moved: Sequence[dict[str, Any]]
) -> None:
    """Write poses in a root."""
    if not moved:
        return
    own = update(frames).where(frames.c.number == bindparam("own")).values(pose_parent=root)
    columns = ("pose", "pose_x", "pose_y", "pose_z", "sent_parent", "sent_pose")
    named = own.values({name: bindparam(name, type_=frames.c[name].type) for name in columns})
    connection.execute(named, list(moved))
    note_moved(connection, [one["own"] for one in moved], map_number)
