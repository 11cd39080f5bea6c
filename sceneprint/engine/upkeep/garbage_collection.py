"""Garbage collection of blobs: those that nothing refers to any more are removed.

blobs  --collect_blobs-->  removed, or doomed while a snapshot is being taken
doomed blobs  --collect_doomed_blobs-->  removed
"""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Sequence

from sceneprint.errors import UnusableStore
from sceneprint.store import Store
from sceneprint.store.deletion import doom, doomed_blobs, settle
from sceneprint.store.frames import referred_blobs

log = logging.getLogger(__name__)

#: Blobs that are removed in one transaction, and of a store of objects by one request: writers wait
#: meanwhile, and it may be far away.
SWEPT_AT_ONCE = 200
#: Blobs of deleted frames that are asked for at once.
_LEFT_AT_ONCE = 1_000


def collect_blobs(store: Store, blobs: Sequence[str]) -> None:
    """Remove blobs that nothing refers to any more.

    In writing transactions, so that no upload comes to refer to one in between, and short ones.
    While a snapshot is being taken they stay, as it may refer to them: `collect_doomed_blobs`
    removes them later.
    """
    done = 0
    store.geometries.forget(blobs)
    while done < len(blobs):
        with store.database.write() as connection, store.blobs.removing() as allowed:
            if not allowed:
                doom(connection, blobs[done : done + SWEPT_AT_ONCE])
                done += SWEPT_AT_ONCE
                log.info("blob removal deferred", extra={"blobs": len(blobs)})
                continue
            block = blobs[done : done + SWEPT_AT_ONCE]
            kept = referred_blobs(connection, block)
            store.blobs.remove(*(blob for blob in block if blob not in kept))
            settle(connection, block)
            done += len(block)


def collect_deleted_blobs(store: Store, blobs: Sequence[str]) -> None:
    """As `collect_blobs`, after a deletion that took effect already: failures are only logged."""
    try:
        collect_blobs(store, blobs)
    except UnusableStore as error:
        log.warning("blob removal failed", extra={"blobs": len(blobs), "error": str(error)})


def collect_doomed_blobs(
    store: Store, before: float | None = None, seconds: float = math.inf
) -> int:
    """Remove what was doomed and is still there: its process died, or a snapshot was being taken.

    Parameters
    ----------
    store : see Store
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
