"""What happened, in order: written in the transaction in which it happens."""

from __future__ import annotations

import time
from typing import Any

from sqlalchemy import Connection, insert

from sceneprint.store.tables import events


def tell(
    connection: Connection,
    kind: str,
    map_name: str | None = None,
    frame_id: str | None = None,
    job_id: str | None = None,
    **data: Any,
) -> None:
    """Note an event; `kind` is such as frame.indexed."""
    connection.execute(
        insert(events).values(
            at=time.time(), kind=kind, map=map_name, frame_id=frame_id, job_id=job_id, data=data
        )
    )
