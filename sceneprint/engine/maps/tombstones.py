"""Tombstones: deleted frames can be restored for a limited time, and are then purged."""

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

#: Maximum number of frames to change in one transaction (about 20 ms).
AT_ONCE = 100
#: Maximum duration of a call, seconds; the result contains the number of remaining frames.
CALL_S = 10.0
#: Format of deletion ids, which fit into 64 bits.
_NUMBER = re.compile("[0-9]{1,18}")


class Tombstones:
    """Deletion, restoration and purge of frames.

    Parameters
    ----------
    seconds : time for which deleted frames can be restored; 0 disables restoration
    wake : function that wakes workers, since restored frames may need a signature
    """

    def __init__(self, store: Store, seconds: float, wake: Callable[[], None]) -> None:
        self._store, self._seconds, self._wake = store, seconds, wake

    def begin(self, row: MapRow) -> int | None:
        """Return the number of a new deletion; None if restoration is disabled.

        Parameters
        ----------
        row : row of the map, read in the same write transaction
        """
        return row.revision + 1 if self._seconds > 0 else None

    def delete_frame(self, map_name: str, frame_id: str) -> None:
        """Delete a frame; raise UnknownMap or UnknownFrame if it does not exist."""
        with self._store.database.write() as connection:
            row = find_map(connection, map_name)
            frame = find_frame(connection, row, frame_id)
            blobs = delete_frame(connection, row, frame, self.begin(row))
        collect_deleted_blobs(self._store, blobs)

    def find(self, connection: Connection, row: MapRow, number: int | None) -> FrameDeletion | None:
        """Return a deletion that can be undone; None if there is none with this number."""
        if number is None:
            return None
        deletion = find_deletion(connection, row.number, self._seconds, number)
        return None if deletion is None else self._record(deletion)

    def list_all(self, map_name: str, cursor: str | None, limit: int) -> Page[FrameDeletion]:
        """Return a page of the deletions that can be undone, newest first.

        Raises
        ------
        UnknownMap : If the map does not exist.
        InvalidRequest : If the service did not issue the cursor.
        """
        before = self._store.seals.row("deletion", cursor)
        with self._store.database.read() as connection:
            row = find_map(connection, map_name)
            deletions = list_deletions(connection, row.number, self._seconds, limit + 1, before)
        more = self._store.seals.next_cursor("deletion", [row.number for row in deletions], limit)
        items = [self._record(deletion) for deletion in deletions[:limit]]
        return Page[FrameDeletion](items=items, next_cursor=more)

    def restore_one(self, map_name: str, frame_id: str) -> None:
        """Restore a deleted frame; queries find it again immediately.

        Raises
        ------
        UnknownMap, UnknownFrame : If the map does not exist, or the frame cannot be restored.
        Conflict : If the same content was uploaded again.
        QuotaExceeded : If the map has no room for the frame.
        """
        with self._store.database.write() as connection:
            row = find_map(connection, map_name)
            frame = find_tombstone(connection, row.number, self._seconds, frame_id)
            if frame is None:
                raise UnknownFrame(
                    f"Frame {frame_id!r:.80} of map {map_name!r} was not deleted, or can no "
                    "longer be restored. Upload it again."
                )
            successor = successor_of(connection, frame)
            if successor is not None:
                raise Conflict(
                    f"Frame {frame.id} was not restored, because it was uploaded again as frame "
                    f"{successor}. Use that frame."
                )
            restore_frame(connection, row, frame)
        self._wake()

    def restore(self, map_name: str, deletion_id: str, seconds: float = CALL_S) -> FramesRestored:
        """Restore the frames of a deletion in blocks; return counts and the refused frames.

        Parameters
        ----------
        deletion_id : id of a deletion from `list_all`
        seconds : duration after which no further block is started

        Raises
        ------
        UnknownMap, UnknownDeletion : If the map or the deletion does not exist, or the deletion
            cannot be undone.
        QuotaExceeded : If the map has no room for all frames; none was restored.
        """
        until, done, last, remaining = time.monotonic() + seconds, 0, 0, 1
        refused: list[RefusedFrame] = []
        while remaining and (not last or time.monotonic() < until):
            with self._store.database.write() as connection:
                row = find_map(connection, map_name)
                number = int(deletion_id) if _NUMBER.fullmatch(deletion_id) else 0
                deletion = find_deletion(connection, row.number, self._seconds, number)
                if deletion is None:
                    if not last:
                        raise _unknown_deletion(row, deletion_id)
                    remaining = 0  # the deletion has expired
                    break
                if not last:
                    _require_room(row, deletion)
                before, own = done, (row.number, self._seconds, deletion.number)
                for frame in tombstones_of(connection, *own, last, AT_ONCE):
                    last = frame.number
                    successor = successor_of(connection, frame)
                    if successor is None:
                        restore_frame(connection, row, frame)
                        done += 1
                    else:
                        reason = f"it was uploaded again as frame {successor}"
                        refused.append(RefusedFrame(frame_id=frame.id, reason=reason))
                remaining = deletion.frames - (done - before) - len(refused)
        self._wake()
        return FramesRestored(
            map=row.name, frames=done, refused=refused[:MOST_REFUSED], remaining=remaining
        )

    def purge(self, *, everything: bool = False) -> int:
        """Purge tombstones that have expired; with `everything`, purge all tombstones.

        Returns
        -------
        purged : number of purged frames
        """
        with self._store.database.read() as connection:
            rows, purged = list_maps(connection), 0
        for row in rows:
            while numbers := self._expired(row, everything=everything):
                with self._store.database.write(map_number=row.number) as connection:
                    # skip frames that were restored or purged meanwhile
                    existing = {frame[0] for frame in oldest_tombstones(connection, row.number)}
                    numbers = [number for number in numbers if number in existing]
                    blobs = purge_frames(connection, row.number, numbers)
                collect_deleted_blobs(self._store, blobs)
                purged += len(numbers)
        return purged

    def _expired(self, row: MapRow, *, everything: bool) -> list[int]:
        """Return the frame numbers of the oldest expired tombstones of a map; see `purge`."""
        with self._store.database.read() as connection:
            over = read_clock(connection) - self._seconds
            oldest = oldest_tombstones(connection, row.number)
        return [number for number, _, at in oldest if everything or at <= over]

    def _record(self, deletion: Deletion) -> FrameDeletion:
        return FrameDeletion(
            deletion_id=str(deletion.number), at=when(deletion.at),
            until=when(deletion.at + self._seconds), frames=deletion.frames,
        )  # fmt: skip


def _unknown_deletion(row: MapRow, deletion_id: str) -> UnknownDeletion:
    return UnknownDeletion(
        f"Map {row.name!r} has no deletion {deletion_id!r:.80} that can be undone. It never "
        "existed, has expired, or all its frames were restored. List the deletions that can be "
        f"undone with GET /v1/maps/{row.name}/deletions."
    )


def _require_room(row: MapRow, deletion: Deletion) -> None:
    """Raise QuotaExceeded if the frames of a deletion exceed the quota; their bytes still count."""
    if row.quota_frames is not None and row.used_frames + deletion.frames > row.quota_frames:
        raise QuotaExceeded(
            f"The quota of map {row.name!r} has no room for the {deletion.frames} frames of the "
            "deletion, so no frame was restored. Restore single frames, or ask the operator for a "
            "larger quota."
        )
