"""Whose a prefix of an object store is: two databases on one would sweep each other's blobs.

    PREFIX/sceneprint.json   {"store": name of the store, "restoring": while one is restored there}

The name goes with the database's secret, so a restored store has that of the one that the snapshot
was taken of: a restore therefore takes no prefix that is in use, were it by its own name.
"""

from __future__ import annotations

import json
from typing import Any

from sceneprint.errors import UnusableStore
from sceneprint.store.objects import Objects

#: Under the prefix.
MARK = "sceneprint.json"


class Mark:
    """The mark of a prefix.

    Parameters
    ----------
    objects : of the prefix

    Every method raises UnusableStore where the prefix is another's, or cannot be used.
    """

    def __init__(self, objects: Objects) -> None:
        self._objects = objects

    def claim(self, owner: str, *, anew: bool) -> bool:
        """See that the prefix is a store's; whether it is marked so now.

        Parameters
        ----------
        owner : the store
        anew : mark it where it is nobody's yet
        """
        for _ in range(2):  # another process may be the first
            found = self._found()
            if found is None:
                if not anew:
                    return False
                if self._put(owner, create=True):
                    return True
                continue
            if found.get("store") != owner:
                raise self._of_another("another database")
            return True
        return False

    def begin(self, owner: str, before: str) -> None:
        """Take the prefix for a store that is to be restored there.

        Parameters
        ----------
        owner : the store
        before : name of the empty database that it is restored to: what a service has marked so,
            and never used, is free
        """
        found = self._found()
        free = found is not None and before != owner and found.get("store") == before
        if found is None or free:
            if not self._put(owner, create=found is None, restoring=True):
                raise self._of_another("another database")  # at the same time
        elif found.get("store") != owner:
            raise self._of_another("another database")
        elif found.get("restoring") is not True:
            raise self._of_another("the store that the snapshot was taken of, or its copy")

    def end(self, owner: str) -> None:
        """Say that it is restored."""
        self._put(owner)

    def _found(self) -> dict[str, Any] | None:
        """What is there; None where nothing is."""
        try:
            found = json.loads(self._objects.get(MARK))
        except FileNotFoundError:
            return None
        except (ValueError, RecursionError):
            return {}
        return found if isinstance(found, dict) else {}

    def _put(self, owner: str, *, create: bool = False, restoring: bool = False) -> bool:
        record = {"kind": "sceneprint blobs", "store": owner}
        more = {"restoring": True} if restoring else {}
        return self._objects.put(MARK, json.dumps(record | more).encode(), create=create)

    def _of_another(self, whose: str) -> UnusableStore:
        return UnusableStore(
            f"{self._objects.url}: the blobs there are of {whose}, which would lose them to this "
            "one. Give each database a prefix of its own in SCENEPRINT_BLOB_URL. If that database "
            f"is gone for good, remove {MARK} there."
        )
