"""Holding a lease while the work goes on."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

from sceneprint.errors import LostLease, SceneprintError
from sceneprint.store import Store, queue

log = logging.getLogger(__name__)


@contextmanager
def renewed(store: Store, claim: queue.Claim, lease_s: float, longest_s: float) -> Iterator[None]:
    """Renew a lease from a thread of its own while the work goes on."""
    done = threading.Event()

    def renew() -> None:
        until = time.monotonic() + longest_s
        while not done.wait(lease_s / 3) and time.monotonic() < until:
            try:
                with store.database.write(turn=False) as connection:
                    queue.renew(connection, claim, lease_s)
            except LostLease:
                return  # the end of the work will learn of it
            except SceneprintError as error:  # the database may be back before the lease is over
                log.warning("lease not renewed", extra={"error": str(error)})

    thread = threading.Thread(target=renew, name="lease", daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
