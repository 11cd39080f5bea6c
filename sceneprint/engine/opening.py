"""Opening a store whose server may be away: what is started beside it may be there before it."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from sceneprint.engine.engine import Engine
from sceneprint.errors import StoreAway, UnusableStore
from sceneprint.settings import Settings

log = logging.getLogger(__name__)

#: Seconds that who is started waits for a server before it gives up, and says why.
PATIENCE_S = 60.0
#: Seconds between two tries.
AGAIN_S = 1.0


def open_engine(
    settings: Settings, patience_s: float = PATIENCE_S,
    may_go_on: Callable[[float], bool] | None = None,
) -> Engine:  # fmt: skip
    """An engine, as soon as its database answers; a fault that waiting cannot mend is told at once.

    Parameters
    ----------
    settings : see Settings
    patience_s : seconds to wait at most
    may_go_on : waits so many seconds, and says whether to try again; default: it always is

    Raises
    ------
    UnusableStore, NewerSchema : see Engine. Of a server that is away, once it was waited for.
    """
    if str(settings.blobs).startswith("memory:"):
        raise UnusableStore(
            "SCENEPRINT_BLOB_URL=memory:/// keeps blobs in one process, and a service has workers "
            "of its own: they would find none. Use file:///folder, or `Client.embedded`."
        )
    until, said = time.monotonic() + patience_s, False
    while True:
        try:
            return Engine(settings)
        except StoreAway as error:
            if time.monotonic() + AGAIN_S > until:
                raise
            if not said:
                log.warning("the database is waited for", extra={"error": str(error)})
                said = True
            if may_go_on is None:
                time.sleep(AGAIN_S)
            elif not may_go_on(AGAIN_S):
                raise
