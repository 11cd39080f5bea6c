"""Who changed what."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

from sceneprint.engine.cursors import opened
from sceneprint.schemas import Page
from sceneprint.schemas.keys import Audited
from sceneprint.store import Store
from sceneprint.store import audit as stored
from sceneprint.store.audit import Change

#: The actor of what a command does to the data folder; no key may be named so.
COMMAND = "command"


class Audit:
    """The audit log of one store.

    Parameters
    ----------
    store : see Store
    """

    def __init__(self, store: Store) -> None:
        self._store = store

    def note(self, change: Change) -> None:
        """Add a line."""
        with self._store.database.write() as connection:
            stored.note(connection, change)

    def command(
        self, action: str, *, map_name: str | None = None, target: str | None = None, **data: Any
    ) -> None:
        """Add a line for a command on the data folder."""
        self.note(Change(action, COMMAND, map=map_name, target=target, data=data))

    def page(
        self, cursor: str | None = None, limit: int = 100, actor: str | None = None,
        map_name: str | None = None,
    ) -> Page[Audited]:  # fmt: skip
        """Changes, the newest first.

        Parameters
        ----------
        cursor, limit : of the page
        actor : name of the key that made them; default: of all, and of none
        map_name : that was changed; default: any, and none

        Raises
        ------
        InvalidRequest : a cursor that was not given out.
        """
        seals = self._store.seals
        before = opened(seals, "audit", cursor)
        with self._store.database.read() as connection:
            found = stored.list_changes(connection, before, limit + 1, actor, map_name)
        more = seals.seal("audit", found[limit - 1].number) if len(found) > limit else None
        return Page[Audited](items=[_told(one) for one in found[:limit]], next_cursor=more)


def _told(change: Change) -> Audited:
    assert change.at is not None
    return Audited(
        at=datetime.fromtimestamp(change.at, UTC),
        actor=change.actor or None,
        address=change.address,
        action=change.action,
        map=change.map,
        target=change.target,
        request_id=change.request_id,
        data=change.data or {},
    )
