"""Opening a store whose server may be away: what is started beside it may be there before it."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import TypeVar

from sceneprint.errors import StoreAway

log = logging.getLogger(__name__)

T = TypeVar("T")

#: Seconds that who is started waits for a server before it gives up, and says why.
PATIENCE_S = 60.0
#: Seconds between two tries.
AGAIN_S = 1.0


def open_patiently(
    attempt: Callable[[], T], patience_s: float = PATIENCE_S,
    may_go_on: Callable[[float], bool] | None = None,
) -> T:  # fmt: skip
    """What an attempt opens, as soon as its server answers; other faults are raised at once.

    Parameters
    ----------
    attempt : opens it
    patience_s : seconds to wait at most
    may_go_on : waits so many seconds, and says whether to try again; default: it always is

    Raises
    ------
    StoreAway : the server is away, and was waited for.
    """
    until, said = time.monotonic() + patience_s, False
    while True:
        try:
            return attempt()
        except StoreAway as error:
            if time.monotonic() + AGAIN_S > until:
                raise
            if not said:
                log.warning("waiting for the database", extra={"error": str(error)})
                said = True
            if may_go_on is None:
                time.sleep(AGAIN_S)
            elif not may_go_on(AGAIN_S):
                raise
