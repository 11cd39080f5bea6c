"""Associations of sessions.

A topic of the client: what it needs of a backend, both backends, and the calls of `Client`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, Protocol

from sceneprint.client.edges import Edges, EdgesBackend, EmbeddedEdges, RemoteEdges
from sceneprint.client.frames import checked
from sceneprint.client.messages import association_path, map_path
from sceneprint.client.sending import PAGE, given
from sceneprint.schemas import Filter, Page, ValidationOptions
from sceneprint.schemas.associations import Association, NewAssociation

#: Pauses between two looks at an association, seconds: the first, and the longest.
_PAUSES_S = (0.02, 0.5)


class AssociationsBackend(EdgesBackend, Protocol):
    """What this topic needs of whoever does the work."""

    def begin_association(self, map_name: str, asked: NewAssociation) -> Association:
        """Queue an association."""

    def list_associations(self, map_name: str, cursor: str | None) -> Page[Association]:
        """A page of the associations of a map, the newest first."""

    def get_association(self, map_name: str, association_id: str) -> Association:
        """An association."""

    def delete_association(self, map_name: str, association_id: str) -> None:
        """Forget an association."""

    def meanwhile(self, pause_s: float) -> None:
        """Let jobs come nearer to their end."""


class RemoteAssociations(RemoteEdges):
    """Over HTTP."""

    def begin_association(self, map_name: str, asked: NewAssociation) -> Association:
        """Queue an association."""
        path = f"{map_path(map_name)}/associations"
        body = asked.model_dump(mode="json", exclude_unset=True)
        return self._ask(Association, "POST", path, json=body)

    def list_associations(self, map_name: str, cursor: str | None) -> Page[Association]:
        """A page of the associations of a map, the newest first."""
        path, asked = f"{map_path(map_name)}/associations", given(cursor=cursor, limit=PAGE)
        return self._ask(Page[Association], "GET", path, params=asked)

    def get_association(self, map_name: str, association_id: str) -> Association:
        """An association."""
        return self._ask(Association, "GET", association_path(map_name, association_id))

    def delete_association(self, map_name: str, association_id: str) -> None:
        """Forget an association."""
        self._delete(association_path(map_name, association_id))


class EmbeddedAssociations(EmbeddedEdges):
    """In this process."""

    def begin_association(self, map_name: str, asked: NewAssociation) -> Association:
        """Queue an association."""
        return self._engine.associations.begin(map_name, asked)

    def list_associations(self, map_name: str, cursor: str | None) -> Page[Association]:
        """A page of the associations of a map, the newest first."""
        return self._engine.associations.list_all(map_name, cursor, PAGE)

    def get_association(self, map_name: str, association_id: str) -> Association:
        """An association."""
        return self._engine.associations.get(map_name, association_id)

    def delete_association(self, map_name: str, association_id: str) -> None:
        """Forget an association."""
        self._engine.associations.remove(map_name, association_id)


class Associations(Edges):
    """The calls."""

    _backend: AssociationsBackend

    def associate(
        self, map_name: str, session: str, other: str | None = None, *,
        robots: Sequence[str] | None = None, filter: Filter | Mapping[str, Any] | None = None,  # noqa: A002
        apart: int | None = None, not_within_s: float | None = None, k: int = 3,
        candidates: int = 10, seed: int = 0, min_overlap: float = 0.0,
        validation: ValidationOptions | Mapping[str, Any] | None = None, timeout_s: float = 3600.0,
        progress: Callable[[int, int], None] | None = None,
    ) -> Association:  # fmt: skip
        """Find where two sessions see the same places, or one session comes back to some.

        Parameters
        ----------
        map_name : of the map
        session : each of its frames is looked up
        other : among the frames of this one; default: among the session's own, taken before it
        robots : who took each of them, needed where several robots call their sessions alike
        filter : only frames that pass it are taken
        apart, not_within_s : of one session, frames or seconds that come between
        k, candidates, seed : accepted edges wanted of each frame, among so many candidates
        min_overlap : least overlap of an edge that is kept
        validation : what an edge must stand
        timeout_s : for its end; 0 to return at once. It goes on, whoever waits
        progress : called with the number of frames that are done, and of all

        Returns
        -------
        association : `association.state.over` is False where the time ran out

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : a session without frames, of several robots, or with too many frames; or
            an option out of its range.
        """
        sessions = [session] if other is None else [session, other]
        fields = given(
            robots=robots, filter=filter, apart=apart, not_within_s=not_within_s,
            validation=validation,
        )  # fmt: skip
        asked = checked(
            NewAssociation, "The association", sessions=sessions, k=k, candidates=candidates,
            seed=seed, min_overlap=min_overlap, **fields,
        )  # fmt: skip
        begun = self._backend.begin_association(map_name, asked)
        return self.wait_for_association(begun, timeout_s=timeout_s, progress=progress)

    def wait_for_association(
        self, association: Association, *, timeout_s: float = 3600.0,
        progress: Callable[[int, int], None] | None = None,
    ) -> Association:  # fmt: skip
        """An association once it is over, or as it is when the time has come; see `associate`."""
        until, (pause, longest) = time.monotonic() + timeout_s, _PAUSES_S
        while True:
            told = association.progress
            if progress is not None and told is not None and told.total is not None:
                progress(told.done, told.total)
            left = until - time.monotonic()
            if association.state.over or left <= 0:
                return association
            self._backend.meanwhile(min(pause, left))
            pause = min(1.4 * pause, longest)
            association = self.association(association.map, association.association_id)

    def association(self, map_name: str, association_id: str) -> Association:
        """An association; UnknownMap or UnknownJob where there is none."""
        return self._backend.get_association(map_name, association_id)

    def associations(self, map_name: str) -> Iterator[Association]:
        """Associations of a map, the newest first; UnknownMap."""
        page = self._backend.list_associations(map_name, None)
        yield from page.items
        while page.next_cursor is not None:
            page = self._backend.list_associations(map_name, page.next_cursor)
            yield from page.items

    def delete_association(self, map_name: str, association_id: str) -> None:
        """Forget an association with its edges; UnknownMap or UnknownJob where there is none."""
        self._backend.delete_association(map_name, association_id)
