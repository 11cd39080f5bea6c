"""What can be looked at after a query.

A topic of the client: what it needs of a backend, both backends, and the calls of `Client`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

from sceneprint.client.messages import match_path, query_path
from sceneprint.client.sending import Sender, given
from sceneprint.errors import InvalidRequest
from sceneprint.schemas import Answer
from sceneprint.schemas.kept import (
    COLOURS,
    TRANSFORMS,
    MatchDetails,
    OverlayColour,
    OverlayTransform,
    Similarities,
)

if TYPE_CHECKING:
    from sceneprint.engine import Engine

#: Most frames of a ranking that are compared with each other.
_MOST = 200


class KeptBackend(Protocol):
    """What this topic needs of whoever does the work."""

    def answer(self, query_id: str) -> Answer:
        """An answer again."""

    def query_cloud(self, query_id: str) -> bytes:
        """A query's surface as PLY."""

    def similarities(self, query_id: str, limit: int) -> Similarities:
        """A ranking, each to each."""

    def match_details(self, query_id: str, frame_id: str, map_name: str | None) -> MatchDetails:
        """What a match rests on."""

    def overlay(
        self, query_id: str, frame_id: str, map_name: str | None, color: OverlayColour,
        transform: OverlayTransform,
    ) -> bytes:  # fmt: skip
        """A query laid on a match as PLY."""


class RemoteKept(Sender):
    """Over HTTP."""

    def answer(self, query_id: str) -> Answer:
        """An answer again."""
        return self._ask(Answer, "GET", query_path(query_id))

    def query_cloud(self, query_id: str) -> bytes:
        """A query's surface as PLY."""
        return self._bytes("GET", f"{query_path(query_id)}/cloud.ply")

    def similarities(self, query_id: str, limit: int) -> Similarities:
        """A ranking, each to each."""
        path = f"{query_path(query_id)}/similarities"
        return self._ask(Similarities, "GET", path, params={"limit": limit})

    def match_details(self, query_id: str, frame_id: str, map_name: str | None) -> MatchDetails:
        """What a match rests on."""
        path = match_path(query_id, frame_id)
        return self._ask(MatchDetails, "GET", path, params=given(map=map_name))

    def overlay(
        self, query_id: str, frame_id: str, map_name: str | None, color: OverlayColour,
        transform: OverlayTransform,
    ) -> bytes:  # fmt: skip
        """A query laid on a match as PLY."""
        path = f"{match_path(query_id, frame_id)}/overlay.ply"
        params = given(map=map_name, color=color, transform=transform)
        return self._bytes("GET", path, params=params)


class EmbeddedKept:
    """In this process."""

    _engine: Engine

    def answer(self, query_id: str) -> Answer:
        """An answer again."""
        return self._engine.inspection.answer(query_id)

    def query_cloud(self, query_id: str) -> bytes:
        """A query's surface as PLY."""
        return self._engine.inspection.cloud(query_id)

    def similarities(self, query_id: str, limit: int) -> Similarities:
        """A ranking, each to each."""
        return self._engine.inspection.similarities(query_id, limit)

    def match_details(self, query_id: str, frame_id: str, map_name: str | None) -> MatchDetails:
        """What a match rests on."""
        return self._engine.inspection.match(query_id, frame_id, map_name)

    def overlay(
        self, query_id: str, frame_id: str, map_name: str | None, color: OverlayColour,
        transform: OverlayTransform,
    ) -> bytes:  # fmt: skip
        """A query laid on a match as PLY."""
        return self._engine.inspection.overlay(query_id, frame_id, map_name, color, transform)


class Kept:
    """The calls."""

    _backend: KeptBackend

    def answer(self, query_id: str) -> Answer:
        """The answer to a query once more, for about an hour.

        Raises
        ------
        UnknownQuery : it is not kept, or no longer.
        """
        return self._backend.answer(query_id)

    def query_cloud(self, query_id: str) -> bytes:
        """The surface that a query saw, points and normals as PLY, in its sensor's frame.

        Raises
        ------
        UnknownQuery : it is not kept, or no longer.
        NotIndexed : it was asked without validation.
        """
        return self._backend.query_cloud(query_id)

    def similarities(self, query_id: str, limit: int = 50) -> Similarities:
        """How alike a query and its nearest frames are, each to each.

        Parameters
        ----------
        query_id : of an answer
        limit : how many of the ranking, 1 to 200

        Raises
        ------
        UnknownQuery : it is not kept, or no longer.
        InvalidRequest : a limit out of its range.
        """
        if not 1 <= limit <= _MOST:
            raise InvalidRequest(
                f"{limit} frames cannot be compared with each other. Ask for 1 to {_MOST}.",
                (("limit", f"give 1 to {_MOST}"),),
            )
        return self._backend.similarities(query_id, limit)

    def match_details(
        self, query_id: str, frame_id: str, map_name: str | None = None
    ) -> MatchDetails:
        """One match of a query, validated once more, with what its figures were counted on.

        Parameters
        ----------
        query_id, frame_id : of an answer and of one of its matches
        map_name : where matches of several maps have that id; default: the first of them

        Raises
        ------
        UnknownQuery : it is not kept, or no longer.
        UnknownMap, UnknownFrame : no match has that id, or it was deleted since.
        NotIndexed : the query was asked without validation, or the map has another model now.
        """
        return self._backend.match_details(query_id, frame_id, map_name)

    def overlay(
        self, query_id: str, frame_id: str, map_name: str | None = None,
        color: OverlayColour = "source", transform: OverlayTransform = "aligned",
    ) -> bytes:  # fmt: skip
        """A query's points and a match's in the match's sensor's frame, coloured, as PLY.

        Parameters
        ----------
        query_id, frame_id, map_name : see `match_details`
        color : by "source", "normal" or "residual"
        transform : "aligned" as it was found, "rival" as the next best, or "none"

        Raises
        ------
        UnknownQuery, UnknownMap, UnknownFrame, NotIndexed : see `match_details`.
        InvalidRequest : there is no such transform, or no such way to colour.
        """
        for name, value, known in (("color", color, COLOURS), ("transform", transform, TRANSFORMS)):
            if value not in known:
                raise InvalidRequest(
                    f"{value!r:.80} is no {name} of an overlay. Give one of {', '.join(known)}.",
                    ((name, f"give one of {', '.join(known)}"),),
                )
        return self._backend.overlay(query_id, frame_id, map_name, color, transform)
