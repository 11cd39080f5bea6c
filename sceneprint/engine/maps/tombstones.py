"""Deleted frames: restored while their deletion can be undone, and purged afterwards."""

from __future__ import annotations

import re
import time
from collections.abc import Callable

from sqlalchemy import Connection

from sceneprint.engine.serializers import when
from sceneprint.engine.upkeep.garbage_collection import collect_deleted_blobs
from sceneprint.errors import Conflict, QuotaExceeded, UnknownDeletion, UnknownFrame
from sceneprint.store import Store
from sceneprint.store.deletion import oldest_tombstones, purge_frames
from sceneprint.store.frames import delete_frame
from sceneprint.store.maps import find_frame, find_map, list_maps
from sceneprint.store.queue import read_clock
from sceneprint.store.tables import MapRow
from sceneprint.store.tombstones import (
    Deletion,
    find_deletion,
    find_tombstone,
    list_deletions,
    restore_frame,
    successor_of,
    tombstones_of,
)
from sceneprint_client.api import Page
from sceneprint_client.api.listing import MOST_REFUSED, FrameDeletion, FramesRestored, RefusedFrame

#: Frames deleted, edited or restored in one transaction: other writers wait for some 20 ms.
AT_ONCE = 100
#: Seconds after which a call ends with what is left.
CALL_S = 10.0
#: Ids of deletions, which fit into 64 bits.
_NUMBER = re.compile("[0-9]{1,18}")


class Tombstones:
    """Deletes frames, restores them, and purges them when their time is over.

    Parameters
    ----------
    seconds : for which deleted frames can be restored; 0: no deletion can be undone
    wake : called when frames wait to be signed
    """

    def __init__(self, store: Store, seconds: float, wake: Callable[[], None]) -> None:
        self._store, self._seconds, self._wake = store, seconds, wake

    def begin(self, row: MapRow) -> int | None:
        """Return the number of a deletion that begins now; None if it cannot be undone. `row` is
        the map as the writing transaction reads it.
        """
        return row.revision + 1 if self._seconds > 0 else None

    def delete_frame(self, map_name: str, frame_id: str) -> None:
        """Delete a frame at once; raise UnknownMap or UnknownFrame if it does not exist."""
        with self._store.database.write() as connection:
            row = find_map(connection, map_name)
            frame = find_frame(connection, row, frame_id)
            blobs = delete_frame(connection, row, frame, self.begin(row))
        collect_deleted_blobs(self._store, blobs)

    def find(self, connection: Connection, row: MapRow, number: int | None) -> FrameDeletion | None:
        """Return the deletion of a number, if it can be undone."""
        if number is None:
            return None
        found = find_deletion(connection, row.number, self._seconds, number)
        return None if found is None else self._record(found)

    def list_all(self, map_name: str, cursor: str | None, limit: int) -> Page[FrameDeletion]:
        """Return a page of the deletions that can be undone, newest first. Raise UnknownMap, and
        InvalidRequest for a cursor that was not issued.
        """
        before = self._store.seals.row("deletion", cursor)
        with self._store.database.read() as connection:
            row = find_map(connection, map_name)
            found = list_deletions(connection, row.number, self._seconds, limit + 1, before)
        more = self._store.seals.next_cursor("deletion", [one.number for one in found], limit)
        items = [self._record(one) for one in found[:limit]]
        return Page[FrameDeletion](items=items, next_cursor=more)

    def restore_one(self, map_name: str, frame_id: str) -> None:
        """Restore a deleted frame, so that queries find it again at once. Raise UnknownMap or
        UnknownFrame if it cannot be restored, Conflict if its content was uploaded again, and
        QuotaExceeded if the map has no room for it.
        """
        with self._store.database.write() as connection:
            row = find_map(connection, map_name)
            frame = find_tombstone(connection, row.number, self._seconds, frame_id)
            if frame is None:
                raise UnknownFrame(
                    f"Frame {frame_id!r:.80} of map {map_name!r} was not deleted, or cannot be "
                    "restored any more. Upload it again."
                )
            successor = successor_of(connection, frame)
            if successor is not None:
                raise Conflict(
                    f"Frame {frame.id} was not restored: it was uploaded again, as frame "
                    f"{successor}."
                )
            restore_frame(connection, row, frame)
        self._wake()

    def restore(self, map_name: str, deletion_id: str, seconds: float = CALL_S) -> FramesRestored:
        """Restore the frames of a deletion, until none is left or the time is over.

        Parameters
        ----------
        deletion_id : of a deletion of `list_all`
        seconds : after which no further block is begun

        Raises
        ------
        UnknownMap, UnknownDeletion : there is none, or it can no longer be undone.
        QuotaExceeded : the map has no room for all of its frames; none was restored.
        """
        until, done, last, left = time.monotonic() + seconds, 0, 0, 1
        refused: list[RefusedFrame] = []
        while left and (not last or time.monotonic() < until):
            with self._store.database.write() as connection:
                row = find_map(connection, map_name)
                number = int(deletion_id) if _NUMBER.fullmatch(deletion_id) else 0
                found = find_deletion(connection, row.number, self._seconds, number)
                if found is None:
                    if not last:
                        raise _unknown_deletion(row, deletion_id)
                    left = 0  # its time was over meanwhile
                    break
                if not last:
                    _require_room(row, found)
                before, own = done, (row.number, self._seconds, found.number)
                for frame in tombstones_of(connection, *own, last, AT_ONCE):
                    last = frame.number
                    successor = successor_of(connection, frame)
                    if successor is None:
                        restore_frame(connection, row, frame)
                        done += 1
                    else:
                        reason = f"it was uploaded again, as frame {successor}"
                        refused.append(RefusedFrame(frame_id=frame.id, reason=reason))
                left = found.frames - (done - before) - len(refused)
        self._wake()
        return FramesRestored(
            map=row.name, frames=done, refused=refused[:MOST_REFUSED], remaining=left
        )

    def purge(self, *, everything: bool = False) -> int:
        """Delete for good what can no longer be restored; with `everything`, all tombstones.

        Returns
        -------
        how many frames
        """
        with self._store.database.read() as connection:
            rows, purged = list_maps(connection), 0
        for row in rows:
            while numbers := self._spent(row, everything=everything):
                with self._store.database.write(map_number=row.number) as connection:
                    # restored or purged meanwhile: what is left of them
                    there = {one[0] for one in oldest_tombstones(connection, row.number)}
                    numbers = [one for one in numbers if one in there]
                    blobs = purge_frames(connection, row.number, numbers)
                collect_deleted_blobs(self._store, blobs)
                purged += len(numbers)
        return purged

    def _spent(self, row: MapRow, *, everything: bool) -> list[int]:
        """Return numbers of the oldest tombstones of a map whose time is over."""
        with self._store.database.read() as connection:
            over = read_clock(connection) - self._seconds
            oldest = oldest_tombstones(connection, row.number)
        return [number for number, _, at in oldest if everything or at <= over]

    def _record(self, one: Deletion) -> FrameDeletion:
        return FrameDeletion(
            deletion_id=str(one.number), at=when(one.at), until=when(one.at + self._seconds),
            frames=one.frames,
        )  # fmt: skip


def _unknown_deletion(row: MapRow, deletion_id: str) -> UnknownDeletion:
    return UnknownDeletion(
        f"Map {row.name!r} has no deletion {deletion_id!r:.80} that can be undone: it never "
        "existed, or its time is over, or all its frames were restored. "
        f"GET /v1/maps/{row.name}/deletions lists those that can be."
    )


def _require_room(row: MapRow, deletion: Deletion) -> None:
    """Check that a map may hold all frames of a deletion; their bytes it holds already."""
    if row.quota_frames is not None and row.used_frames + deletion.frames > row.quota_frames:
        raise QuotaExceeded(
            f"The deletion has {deletion.frames} frames, for which the quota of map {row.name!r} "
            "leaves no room, so none was restored. Restore some of them one by one, or ask the "
            "operator for a larger quota."
        )
