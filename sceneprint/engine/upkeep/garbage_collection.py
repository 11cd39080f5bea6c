"""Garbage collection of blobs: those that nothing refers to any more are removed.

blobs  --collect_blobs-->  removed, or doomed while a snapshot is being taken
doomed blobs  --collect_doomed_blobs-->  removed

Where a fleet keeps its blobs in an object store, no writer waits for that store: one turn dooms
blobs, they are removed after it, and another turn settles them. Who comes to refer to one of them
meanwhile waits for the end of the removal (`ObjectBlobs.holds`).
"""

from __future__ import annotations

import logging
import math
import re
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

from sceneprint.errors import StoreLocked, UnusableStore
from sceneprint.store import Store
from sceneprint.store.blobs.folder import LONGEST_S
from sceneprint.store.deletion import clear_doomed, doom, doomed_blobs
from sceneprint.store.frames import referred_blobs, refers_to

log = logging.getLogger(__name__)

#: Blobs that are found and removed at once, of a store of objects by one request: writers wait
#: while they are found, and in a folder while they are removed.
SWEPT_AT_ONCE = 200
#: Seconds to wait for another removal.
_PATIENCE_S = 5.0
#: Name of a file in quarantine.
_BLOB = re.compile("blob-([0-9a-f]{64})")
#: Blobs of deleted frames that are asked for at once.
_LEFT_AT_ONCE = 1_000


def collect_blobs(store: Store, blobs: Sequence[str]) -> None:
    """Remove blobs that nothing refers to any more. Short write transactions find them, so that no
    upload can refer to one meanwhile. During a snapshot, which may refer to them, and while another
    process removes blobs, they stay, and `collect_doomed_blobs` removes them later. Raise
    UnusableStore if some could not be removed; those are doomed.
    """
    store.geometries.forget(blobs)
    if not blobs:
        return
    remove = _remove_after_turn if store.blobs.outlast_turns else _remove_in_turn
    for first in range(0, len(blobs), SWEPT_AT_ONCE):
        if not remove(store, blobs[first : first + SWEPT_AT_ONCE]):
            log.info("blob removal deferred", extra={"blobs": len(blobs)})


def _remove_in_turn(store: Store, block: Sequence[str]) -> bool:
    """Remove those of some blobs that nothing refers to; False where they have to stay for now."""
    with store.database.write() as connection, store.blobs.removing() as allowed:
        if not allowed:
            doom(connection, block)
            return False
        kept = referred_blobs(connection, block)
        store.blobs.remove(*(blob for blob in block if blob not in kept))
        clear_doomed(connection, block)
        return True


def _remove_after_turn(store: Store, block: Sequence[str]) -> bool:
    """As `_remove_in_turn`; they are doomed until they are known to be gone, whoever dies."""
    with suppress(StoreLocked):
        store.blobs.wait_for_removal(seconds=_PATIENCE_S)  # else these would be left for later
    with ExitStack() as removal:
        with store.database.write() as connection:
            if not removal.enter_context(store.blobs.removing()):
                doom(connection, block)  # and settle nothing: it may be on its way out elsewhere
                return False
            kept = referred_blobs(connection, block)
            # a removal that lost its lock may still be at the others, and `holds` must know
            clear_doomed(connection, [*kept], before=time.time() - LONGEST_S)
            gone = [blob for blob in block if blob not in kept]
            at = doom(connection, gone)
        store.blobs.remove(*gone)
    if not gone:
        return True
    with store.database.write() as connection:
        clear_doomed(connection, gone, at)
    return True


def collect_deleted_blobs(store: Store, blobs: Sequence[str]) -> None:
    """As `collect_blobs`, after a deletion that took effect already: failures are only logged."""
    try:
        collect_blobs(store, blobs)
    except UnusableStore as error:
        log.warning("blob removal failed", extra={"blobs": len(blobs), "error": str(error)})


def collect_quarantined(store: Store, folder: Path) -> int:
    """Remove damaged bytes that were set aside, once what they belonged to is gone.

    Parameters
    ----------
    folder : with `blob-DIGEST`; what else lies there is none of ours

    Returns
    -------
    removed : number of files
    """
    removed = 0
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        blob = _BLOB.fullmatch(path.name)
        if blob is None:
            continue
        with store.database.read() as connection:
            needed = refers_to(connection, blob[1])
        if not needed:
            path.unlink(missing_ok=True)
            removed += 1
    return removed


def collect_doomed_blobs(
    store: Store, before: float | None = None, seconds: float = math.inf
) -> int:
    """Remove what was doomed and is still there: its process died, or a snapshot was being taken.

    Parameters
    ----------
    before : only what was doomed before this time, seconds since 1970: of what is younger,
        somebody may be at it
    seconds : after which the rest is left for another time

    Returns
    -------
    swept : number of blobs that were looked at
    """
    until, last, count = time.monotonic() + seconds, "", 0
    while time.monotonic() < until:
        with store.database.read() as connection:
            blobs = doomed_blobs(connection, _LEFT_AT_ONCE, before, last)
        if not blobs:
            break
        collect_blobs(store, blobs)
        count, last = count + len(blobs), blobs[-1]
    return count
