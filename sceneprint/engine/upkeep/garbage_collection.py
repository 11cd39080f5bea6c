"""Garbage collection of unreferenced blobs.

blobs  --collect_blobs-->  removed, or doomed during a snapshot
doomed blobs  --collect_doomed_blobs-->  removed

One transaction marks the unreferenced blobs as doomed, the blobs are removed, and another
transaction clears the marks. Writers do not wait for removals, except for a new reference to a
doomed blob, which waits for the end of its removal (`Blobs.holds`).
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
from sceneprint.store.deletion import clear_doomed, doom, doomed_blobs
from sceneprint.store.frames import referred_blobs, refers_to

log = logging.getLogger(__name__)

#: Number of blobs to check and remove at once. Writers wait during the check.
SWEPT_AT_ONCE = 200
#: Maximum seconds to wait for a removal by another process.
_PATIENCE_S = 5.0
#: Name of a quarantined blob.
_BLOB = re.compile("blob-([0-9a-f]{64})")
#: Number of doomed blobs to read at once.
_LEFT_AT_ONCE = 1_000


def collect_blobs(store: Store, blobs: Sequence[str]) -> None:
    """Remove the unreferenced blobs among `blobs`.

    The check runs in a write transaction, so no upload can add a reference meanwhile. During a
    snapshot or a removal by another process, blobs are only marked as doomed;
    `collect_doomed_blobs` removes them later.

    Raises
    ------
    UnusableStore : If some blobs could not be removed. They are doomed.
    """
    store.geometries.forget(blobs)
    if not blobs:
        return
    for first in range(0, len(blobs), SWEPT_AT_ONCE):
        if not _remove(store, blobs[first : first + SWEPT_AT_ONCE]):
            log.info("blob removal deferred", extra={"blobs": len(blobs)})


def _remove(store: Store, block: Sequence[str]) -> bool:
    """Doom unreferenced blobs in a write transaction, remove them after it, and clear the marks.

    If another process still holds the removal lock after _PATIENCE_S seconds, doom the whole block
    instead, and return False.
    """
    with suppress(StoreLocked):
        store.blobs.locks.await_removal(seconds=_PATIENCE_S)
    with ExitStack() as removal:
        with store.database.write() as connection:
            if not removal.enter_context(store.blobs.locks.removing()):
                doom(connection, block)
                return False
            referred = referred_blobs(connection, block)
            # leave younger marks: the removal of their blobs may still be running without its lock
            clear_doomed(connection, [*referred], before=time.time() - store.blobs.locks.late_s)
            unreferenced = [blob for blob in block if blob not in referred]
            at = doom(connection, unreferenced)
        store.blobs.remove(*unreferenced)
    if not unreferenced:
        return True
    with store.database.write() as connection:
        clear_doomed(connection, unreferenced, at)
    return True


def collect_deleted_blobs(store: Store, blobs: Sequence[str]) -> None:
    """Call `collect_blobs` after a committed deletion; log errors instead of raising them."""
    try:
        collect_blobs(store, blobs)
    except UnusableStore as error:
        log.warning("blob removal failed", extra={"blobs": len(blobs), "error": str(error)})


def collect_quarantined(store: Store, folder: Path) -> int:
    """Remove the unreferenced blobs in quarantine; return their number.

    Parameters
    ----------
    folder : folder with files `blob-DIGEST`; other files are ignored
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
    """Remove doomed blobs, which remain after a snapshot or after a process was killed.

    Parameters
    ----------
    before : remove only blobs doomed before this time (seconds since 1970), since another process
        may be removing the others; None selects all
    seconds : duration after which no further block is started

    Returns
    -------
    count : number of checked blobs
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
