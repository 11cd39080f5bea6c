"""Deletions of frames that can still be undone: what the rows were, and the uploads that stay.

Deletion, rows of frames  --remember_frames-->  rows, in the transaction that deletes
rows  --restore_frame-->  a frame as it was, to be signed again
rows  --forget_frames-->  nothing, once the time is over
"""

from __future__ import annotations

import uuid
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import ColumnElement, Connection, delete, func, insert, select, update

from sceneprint.store.events import record_event
from sceneprint.store.maps import ROOMLESS, count_on, require_room
from sceneprint.store.queue import enqueue, read_clock
from sceneprint.store.tables import (
    MapRow,
    count_rows,
    deleted_frames,
    deletions,
    frame_tags,
    frames,
    now,
)
from sceneprint_client.api import FrameState

#: Columns that a restored frame has as they were, beside those that a deletion leaves alone.
_COLUMNS = (
    "id", "state", "reason", "content_id", "robot", "session", "captured_at", "tags",
    "pose_parent", "pose", "pose_x", "pose_y", "pose_z", "base_frame", "base", "novelty", "up",
    "name", "sequence", "indexed_at",
)  # fmt: skip
#: States in which a restored frame is signed.
_SIGNED = (FrameState.INDEXED, FrameState.RECEIVED, FrameState.SIGNING)


@dataclass(frozen=True)
class Deletion:
    """A deletion that can be undone; fields as in the table.

    Parameters
    ----------
    most_bytes : of uploads that its map may keep for undoing; None where it is of no matter
    """

    number: int
    id: str
    map_number: int
    at: float
    until: float
    most_bytes: int | None = None


@dataclass(frozen=True)
class DeletedFrame:
    """A frame that can be restored; fields as in the table."""

    frame_number: int
    deletion_number: int
    blob: str | None
    bytes: int
    data: dict[str, Any]

    @property
    def is_counted(self) -> bool:
        """Whether it takes room in its map when it is restored."""
        return self.data["state"] not in ROOMLESS


@dataclass(frozen=True)
class UndoLimits:
    """What of deletions can be undone.

    Parameters
    ----------
    seconds : for how long; 0: no deletion can be
    most_bytes : of uploads that a map may keep for it
    """

    seconds: float
    most_bytes: int

    def begin(self, connection: Connection, map_number: int) -> Deletion | None:
        """Note a deletion of frames of a map; None where it cannot be undone."""
        if self.seconds <= 0:
            return None
        at = read_clock(connection)
        made = insert(deletions).values(
            id=uuid.uuid4().hex, map_number=map_number, at=at, until=at + self.seconds
        )
        row = connection.execute(made.returning(deletions)).mappings().one()
        return Deletion(**row, most_bytes=self.most_bytes)


#: Deletions for good.
NO_UNDO = UndoLimits(0.0, 0)


def remember_frames(
    connection: Connection, deletion: Deletion, rows: Sequence[Mapping[str, Any]]
) -> int:
    """Note what frames are, before they are deleted; those beyond the bytes that may be kept are
    left out. Returns how many were noted.

    Parameters
    ----------
    connection : of a writing transaction
    deletion : see Deletion
    rows : of the frames
    """
    held = connection.execute(
        select(func.coalesce(func.sum(deleted_frames.c.bytes), 0))
        .join(deletions, deletions.c.number == deleted_frames.c.deletion_number)
        .where(deletions.c.map_number == deletion.map_number)
    ).scalar_one()
    noted = []
    for row in rows:
        has_upload = row["state"] not in ROOMLESS
        size = row["bytes"] if has_upload else 0
        if deletion.most_bytes is not None and held + size > deletion.most_bytes:
            continue
        held += size
        noted.append(
            {
                "frame_number": row["number"], "deletion_number": deletion.number,
                "blob": row["blob"] if has_upload else None, "bytes": size,
                "data": {name: row[name] for name in _COLUMNS},
            }
        )  # fmt: skip
    if noted:
        connection.execute(insert(deleted_frames), noted)
    return len(noted)


def find_deletion(connection: Connection, map_number: int, deletion_id: str) -> Deletion | None:
    """A deletion of a map, unless its time is over."""
    asked = select(deletions).where(
        deletions.c.map_number == map_number, deletions.c.id == deletion_id,
        deletions.c.until > read_clock(connection),
    )  # fmt: skip
    row = connection.execute(asked).mappings().first()
    return None if row is None else Deletion(**row)


def deletion_of_frame(
    connection: Connection, map_number: int, frame_id: str
) -> tuple[Deletion, DeletedFrame] | None:
    """The deletion of a frame that can be restored, and what it was."""
    asked = (
        select(deleted_frames)
        .join(deletions, deletions.c.number == deleted_frames.c.deletion_number)
        .join(frames, frames.c.number == deleted_frames.c.frame_number)
        .where(
            frames.c.map_number == map_number, frames.c.id == frame_id,
            deletions.c.until > read_clock(connection),
        )
    )  # fmt: skip
    row = connection.execute(asked).mappings().first()
    if row is None:
        return None
    found = DeletedFrame(**row)
    own = select(deletions).where(deletions.c.number == found.deletion_number)
    return Deletion(**connection.execute(own).mappings().one()), found


def list_deletions(
    connection: Connection, map_number: int, before: int | None, limit: int
) -> list[tuple[Deletion, int]]:
    """Deletions of a map that can be undone, the newest first, and how many frames each has left.

    Parameters
    ----------
    connection : of the database
    map_number : of the map
    before : number of the deletion that the page before ended with
    limit : at most so many
    """
    asked = (
        select(*deletions.c, func.count(deleted_frames.c.frame_number).label("frames"))
        .join(deleted_frames, deleted_frames.c.deletion_number == deletions.c.number)
        .where(
            deletions.c.map_number == map_number, deletions.c.until > read_clock(connection)
        )
        .group_by(*deletions.c)
        .order_by(deletions.c.number.desc())
        .limit(limit)
    )  # fmt: skip
    if before is not None:
        asked = asked.where(deletions.c.number < before)
    found = []
    for row in connection.execute(asked).mappings():
        values = dict(row)
        count = values.pop("frames")
        found.append((Deletion(**values), count))
    return found


def frames_of_deletion(
    connection: Connection, deletion: Deletion, after: int, limit: int
) -> list[DeletedFrame]:
    """Frames of a deletion, in the order they came, after the one of a number."""
    own = deleted_frames.c.deletion_number == deletion.number
    asked = select(deleted_frames).where(own, deleted_frames.c.frame_number > after)
    asked = asked.order_by(deleted_frames.c.frame_number).limit(limit)
    return [DeletedFrame(**row) for row in connection.execute(asked).mappings()]


def count_restorable(connection: Connection, deletion: Deletion | None) -> int:
    """How many frames of a deletion can be restored."""
    if deletion is None:
        return 0
    return count_rows(connection, deleted_frames.c.deletion_number == deletion.number)


def restored_size(connection: Connection, deletion: Deletion) -> tuple[int, int]:
    """How many frames with uploads a deletion has, and bytes of those uploads."""
    asked = select(func.count(), func.coalesce(func.sum(deleted_frames.c.bytes), 0)).where(
        deleted_frames.c.deletion_number == deletion.number, deleted_frames.c.blob.is_not(None)
    )
    count, size = connection.execute(asked).one()
    return int(count), int(size)


def rival_of(connection: Connection, deletion: Deletion, one: DeletedFrame) -> str | None:
    """Why a frame cannot be restored: another has its id, or its content came again since."""
    row = frames.c.map_number == deletion.map_number
    living = frames.c.state != FrameState.DELETED
    same_id = select(frames.c.id).where(row, living, frames.c.id == one.data["id"])
    if connection.execute(same_id).first() is not None:
        return f"another frame has the id {one.data['id']}"
    content = one.data["content_id"]
    again = select(frames.c.id).where(
        row, living, frames.c.content_id == content, frames.c.received_at >= deletion.at
    )
    found = None if content is None else connection.execute(again.limit(1)).scalar()
    return None if found is None else f"it was uploaded again, as frame {found}"


def restore_frame(connection: Connection, row: MapRow, one: DeletedFrame) -> None:
    """Put a deleted frame back; what was indexed is signed again.

    Parameters
    ----------
    connection : of a writing transaction
    row : of its map
    one : a frame that nothing takes the place of, see `rival_of`

    Raises
    ------
    QuotaExceeded : the map has no room for it.
    """
    values = dict(one.data)
    was = FrameState(values["state"])
    values["ended_at"] = now(connection) if was == FrameState.REDUNDANT else None
    if one.is_counted:
        require_room(connection, row, one.bytes)
        count_on(connection, row.number, 1, one.bytes)
    if was in _SIGNED:
        values |= {"state": FrameState.RECEIVED, "reason": None, "indexed_at": None}
        # what its map kept once is not judged again
        values["novelty"] = None if was == FrameState.INDEXED else values["novelty"]
    # a frame that had the id meanwhile, and was deleted as well, gives it up
    rival = (frames.c.map_number == row.number) & (frames.c.id == values["id"])
    connection.execute(
        update(frames)
        .where(rival, frames.c.number != one.frame_number, frames.c.state == FrameState.DELETED)
        .values(id=uuid.uuid4().hex)
    )
    connection.execute(update(frames).where(frames.c.number == one.frame_number).values(**values))
    tags = [{"frame_number": one.frame_number, "tag": tag} for tag in sorted(set(values["tags"]))]
    if tags:
        connection.execute(insert(frame_tags), tags)
    job = enqueue(connection, "sign", one.frame_number) if was in _SIGNED else None
    record_event(
        connection, "frame.restored", row.name, values["id"], None if job is None else job.id
    )
    own = deleted_frames.c.frame_number == one.frame_number
    connection.execute(delete(deleted_frames).where(own))


def spent_frames(connection: Connection, limit: int, *, all_of_them: bool) -> list[int]:
    """Numbers of frames whose deletion can no longer be undone; with `all_of_them`, of all."""
    asked = select(deleted_frames.c.frame_number)
    if not all_of_them:
        asked = asked.join(deletions, deletions.c.number == deleted_frames.c.deletion_number).where(
            deletions.c.until <= read_clock(connection)
        )
    return list(connection.execute(asked.limit(limit)).scalars())


def forget_frames(connection: Connection, numbers: Sequence[int]) -> list[str]:
    """Let frames be deleted for good; returns the blobs that they referred to."""
    own = deleted_frames.c.frame_number.in_(numbers)
    blobs = connection.execute(
        select(deleted_frames.c.blob).where(own, deleted_frames.c.blob.is_not(None))
    )
    found = [str(one) for one in blobs.scalars()]
    connection.execute(delete(deleted_frames).where(own))
    return found


def has_empty_deletions(connection: Connection) -> bool:
    """Whether there is a deletion of which no frame is left to restore."""
    return (
        connection.execute(select(deletions.c.number).where(_empty()).limit(1)).first() is not None
    )


def remove_empty_deletions(connection: Connection) -> None:
    """Remove deletions of which no frame is left to restore."""
    connection.execute(delete(deletions).where(_empty()))


def _empty() -> ColumnElement[bool]:
    left = select(deleted_frames.c.frame_number).where(
        deleted_frames.c.deletion_number == deletions.c.number
    )
    return ~left.exists()
