"""Deleted frames restored, while their deletion can still be undone; afterwards they are purged.

deletion id | frame ids  --restore-->  FramesRestored
"""

from __future__ import annotations

import time
from collections.abc import Callable

from sqlalchemy import Connection

from sceneprint.engine.serializers import when
from sceneprint.engine.upkeep.garbage_collection import collect_deleted_blobs
from sceneprint.errors import Conflict, QuotaExceeded, UnknownDeletion, UnknownFrame
from sceneprint.store import Store
from sceneprint.store.deletion import doom
from sceneprint.store.maps import find_map, use_of
from sceneprint.store.tables import MapRow
from sceneprint.store.undo_rows import (
    DeletedFrame,
    Deletion,
    deletion_of_frame,
    find_deletion,
    forget_frames,
    frames_of_deletion,
    has_empty_deletions,
    list_deletions,
    remove_empty_deletions,
    restore_frame,
    restored_size,
    rival_of,
    spent_frames,
)
from sceneprint_client.api import Page
from sceneprint_client.api.listing import FrameDeletion
from sceneprint_client.api.selections import (
    MOST_REFUSED,
    FramesRestored,
    RefusedFrame,
    RestoreOptions,
)

#: Frames restored or purged in one transaction: other writers wait for some 20 ms.
AT_ONCE = 100
#: Seconds after which a call ends with what is left.
CALL_S = 10.0


def deletion_record(deletion: Deletion, frames: int) -> FrameDeletion:
    """A deletion as JSON tells it."""
    return FrameDeletion(
        deletion_id=deletion.id, at=when(deletion.at), until=when(deletion.until), frames=frames
    )


class FrameUndo:
    """Undoes deletions of frames.

    Parameters
    ----------
    store : see Store
    wake : called when frames wait to be signed
    """

    def __init__(self, store: Store, wake: Callable[[], None]) -> None:
        self._store, self._wake = store, wake

    def list_all(self, map_name: str, cursor: str | None, limit: int) -> Page[FrameDeletion]:
        """Deletions of a map that can be undone, the newest first.

        Raises
        ------
        UnknownMap : there is none.
        InvalidRequest : a cursor that was not given out.
        """
        before = self._store.seals.row("deletion", cursor)
        with self._store.database.read() as connection:
            row = find_map(connection, map_name)
            found = list_deletions(connection, row.number, before, limit + 1)
        more = self._store.seals.next_cursor("deletion", [d.number for d, _ in found], limit)
        told = [deletion_record(*one) for one in found[:limit]]
        return Page[FrameDeletion](items=told, next_cursor=more)

    def restore(
        self, map_name: str, wanted: RestoreOptions, seconds: float = CALL_S
    ) -> FramesRestored:
        """Put deleted frames back with all that was known of them.

        Parameters
        ----------
        map_name : of the map
        wanted : which frames
        seconds : after which no further block of a deletion is begun

        Raises
        ------
        UnknownMap, UnknownDeletion : there is none, or it cannot be undone any more.
        QuotaExceeded : the map has no room for them; of a deletion none was restored.
        """
        try:
            if wanted.deletion_id is not None:
                return self._restore_all(map_name, wanted.deletion_id, seconds)
            return self._restore_named(map_name, wanted.frame_ids or [])
        finally:
            self._wake()

    def restore_one(self, map_name: str, frame_id: str) -> None:
        """Put one deleted frame back.

        Raises
        ------
        UnknownMap, UnknownFrame : there is none, or it cannot be restored any more.
        Conflict : another frame has its id or its content.
        QuotaExceeded : the map has no room for it.
        """
        found = self._restore_named(map_name, [frame_id])
        self._wake()
        if not found.frames:
            refused = found.refused[0]
            if refused.reason == _GONE:
                raise UnknownFrame(
                    f"Frame {frame_id!r:.80} of map {map_name!r} {_GONE}. Upload it again."
                )
            raise Conflict(f"Frame {frame_id!r:.80} was not restored: {refused.reason}.")

    def _restore_all(self, map_name: str, deletion_id: str, seconds: float) -> FramesRestored:
        until, done, last = time.monotonic() + seconds, 0, 0
        refused: list[RefusedFrame] = []
        while True:
            with self._store.database.write() as connection:
                row = find_map(connection, map_name)
                deletion = find_deletion(connection, row.number, deletion_id)
                if deletion is None:
                    if not last:
                        raise _unknown_deletion(row, deletion_id)
                    left = []  # its time was over meanwhile
                else:
                    if not last:
                        _require_room(connection, row, deletion)
                    some = frames_of_deletion(connection, deletion, last, AT_ONCE)
                    for one in some:
                        done += _restored(connection, row, deletion, one, refused)
                        last = one.frame_number
                    left = frames_of_deletion(connection, deletion, last, _COUNTED)
                remove_empty_deletions(connection)
            if not left or time.monotonic() >= until:
                break
        return FramesRestored(
            map=row.name, frames=done, refused=refused[:MOST_REFUSED], remaining=len(left)
        )

    def _restore_named(self, map_name: str, frame_ids: list[str]) -> FramesRestored:
        names, done = list(dict.fromkeys(frame_ids)), 0
        refused: list[RefusedFrame] = []
        for at in range(0, len(names), AT_ONCE):
            with self._store.database.write() as connection:
                row = find_map(connection, map_name)
                for name in names[at : at + AT_ONCE]:
                    found = deletion_of_frame(connection, row.number, name)
                    if found is None:
                        refused.append(RefusedFrame(frame_id=name, reason=_GONE))
                    else:
                        done += _restored(connection, row, *found, refused)
                remove_empty_deletions(connection)
        return FramesRestored(
            map=row.name, frames=done, refused=refused[:MOST_REFUSED], remaining=0
        )

    def purge(self, *, everything: bool = False) -> int:
        """Delete for good what can no longer be restored; with `everything`, all that could be.

        Returns
        -------
        how many frames
        """
        purged = 0
        while True:
            with self._store.database.read() as connection:  # most often there is none: no lock
                if not spent_frames(connection, 1, all_of_them=everything):
                    break
            with self._store.database.write() as connection:
                numbers = spent_frames(connection, AT_ONCE, all_of_them=everything)
                blobs = forget_frames(connection, numbers)
                doom(connection, blobs)
                remove_empty_deletions(connection)
            collect_deleted_blobs(self._store, blobs)
            purged += len(numbers)
        with self._store.database.read() as connection:
            has_empty = has_empty_deletions(connection)
        if has_empty:  # all that it had was too large to be kept, or its map had no room for more
            with self._store.database.write() as connection:
                remove_empty_deletions(connection)
        return purged


#: Frames that are counted of those that are left; of more, as many are told.
_COUNTED = 10_000
_GONE = "was not deleted, or cannot be restored any more"


def _restored(
    connection: Connection, row: MapRow, deletion: Deletion, one: DeletedFrame,
    refused: list[RefusedFrame],
) -> int:  # fmt: skip
    """Restore a frame, or note why not; how many were."""
    reason = rival_of(connection, deletion, one)
    if reason is not None:
        refused.append(RefusedFrame(frame_id=one.data["id"], reason=reason))
        return 0
    restore_frame(connection, row, one)
    return 1


def _require_room(connection: Connection, row: MapRow, deletion: Deletion) -> None:
    """See that a map's quota leaves room for all frames of a deletion."""
    count, size = restored_size(connection, deletion)
    use = use_of(connection, row.number)
    over_frames = row.quota_frames is not None and use.frames + count > row.quota_frames
    over_bytes = row.quota_bytes is not None and use.bytes + size > row.quota_bytes
    if over_frames or over_bytes:
        raise QuotaExceeded(
            f"The deletion has {count} frames of {size} bytes, for which the quota of map "
            f"{row.name!r} leaves no room, so none was restored. Restore some of them with "
            "`frame_ids`, or ask the operator for a larger quota."
        )


def _unknown_deletion(row: MapRow, deletion_id: str) -> UnknownDeletion:
    return UnknownDeletion(
        f"Map {row.name!r} has no deletion {deletion_id!r:.80} that can be undone: it never "
        "existed, or its time is over, or all its frames were restored. "
        f"GET /v1/maps/{row.name}/deletions lists those that can be."
    )
