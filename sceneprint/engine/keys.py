"""Making keys."""

from __future__ import annotations

from sceneprint.errors import InvalidRequest
from sceneprint.store import Store
from sceneprint.store import keys as stored


def create_key(store: Store, name: str) -> str:
    """Make a key and return its secret.

    Raises
    ------
    InvalidRequest : the name is empty, too long or not printable.
    Conflict : there is a key of that name.
    """
    if not (0 < len(name) <= 128 and name.isprintable()):
        raise InvalidRequest(
            f"{name!r:.80} is no name for a key. Take up to 128 printable characters.",
            (("name", "not printable, empty or too long"),),
        )
    with store.database.write() as connection:
        return stored.create_key(connection, name)
