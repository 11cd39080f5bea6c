"""Edges of an association, and the graph of them.

Half of the topic `associations` of the client; see there.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Protocol, get_args

from sceneprint.client.messages import association_path
from sceneprint.client.sending import PAGE, Sender, given
from sceneprint.errors import InvalidRequest
from sceneprint.schemas import Page
from sceneprint.schemas.associations import Edge, GraphFormat

if TYPE_CHECKING:
    from sceneprint.engine import Engine


class EdgesBackend(Protocol):
    """What edges need of whoever does the work."""

    def list_edges(
        self, map_name: str, association_id: str, cursor: str | None, min_overlap: float,
        consistent: bool | None,
    ) -> Page[Edge]:  # fmt: skip
        """A page of the edges of an association."""

    def graph(
        self, map_name: str, association_id: str, kind: GraphFormat, min_overlap: float,
        odometry: bool, consistent: bool,
    ) -> str:  # fmt: skip
        """The graph of an association as a file."""


class RemoteEdges(Sender):
    """Over HTTP."""

    def list_edges(
        self, map_name: str, association_id: str, cursor: str | None, min_overlap: float,
        consistent: bool | None,
    ) -> Page[Edge]:  # fmt: skip
        """A page of the edges of an association."""
        path = f"{association_path(map_name, association_id)}/edges"
        asked = given(cursor=cursor, limit=PAGE, min_overlap=min_overlap, consistent=consistent)
        return self._ask(Page[Edge], "GET", path, params=asked)

    def graph(
        self, map_name: str, association_id: str, kind: GraphFormat, min_overlap: float,
        odometry: bool, consistent: bool,
    ) -> str:  # fmt: skip
        """The graph of an association as a file."""
        path = f"{association_path(map_name, association_id)}/graph"
        asked = {
            "format": kind, "min_overlap": min_overlap, "odometry": odometry,
            "consistent": consistent,
        }  # fmt: skip
        return self._bytes("GET", path, params=asked).decode()


class EmbeddedEdges:
    """In this process."""

    _engine: Engine

    def list_edges(
        self, map_name: str, association_id: str, cursor: str | None, min_overlap: float,
        consistent: bool | None,
    ) -> Page[Edge]:  # fmt: skip
        """A page of the edges of an association."""
        return self._engine.associations.edges(
            map_name, association_id, cursor, PAGE, min_overlap, consistent=consistent
        )

    def graph(
        self, map_name: str, association_id: str, kind: GraphFormat, min_overlap: float,
        odometry: bool, consistent: bool,
    ) -> str:  # fmt: skip
        """The graph of an association as a file."""
        return self._engine.associations.graph(
            map_name, association_id, kind, min_overlap, odometry=odometry, consistent=consistent
        )


class Edges:
    """The calls."""

    _backend: EdgesBackend

    def edges(
        self, map_name: str, association_id: str, *, min_overlap: float = 0.0,
        consistent: bool | None = None,
    ) -> Iterator[Edge]:  # fmt: skip
        """Edges of an association in the order in which they were found.

        Parameters
        ----------
        map_name, association_id : of the association
        min_overlap : least overlap
        consistent : those that loops confirm, or those that were outvoted; default: all

        Raises
        ------
        UnknownMap, UnknownJob : there is none.
        InvalidRequest : an overlap out of its range.
        """
        _check_overlap(min_overlap)
        asked = (min_overlap, consistent)
        page = self._backend.list_edges(map_name, association_id, None, *asked)
        yield from page.items
        while page.next_cursor is not None:
            page = self._backend.list_edges(map_name, association_id, page.next_cursor, *asked)
            yield from page.items

    def graph(
        self, map_name: str, association_id: str, kind: GraphFormat = "g2o", *,
        min_overlap: float = 0.0, odometry: bool = False, consistent: bool = False,
    ) -> str:  # fmt: skip
        """The pose graph of an association that has succeeded, as a file.

        Parameters
        ----------
        map_name, association_id : of the association
        kind : g2o, tum or json
        min_overlap : least overlap of an edge
        odometry : with an edge between each two consecutive frames, from their poses
        consistent : only edges that loops confirm; else all that were not outvoted

        Raises
        ------
        UnknownMap, UnknownJob : there is none.
        NotIndexed : it is not over, or did not succeed.
        InvalidRequest : there is no such file, or an overlap out of its range.
        """
        known = get_args(GraphFormat)
        if kind not in known:
            raise InvalidRequest(
                f"A graph does not come as {kind!r:.80}. Give one of {', '.join(known)}.",
                (("format", f"give one of {', '.join(known)}"),),
            )
        _check_overlap(min_overlap)
        return self._backend.graph(
            map_name, association_id, kind, min_overlap, odometry, consistent
        )


def _check_overlap(least: float) -> None:
    if not 0.0 <= least <= 1.0:
        raise InvalidRequest(
            f"The least overlap is {least}. Give one from 0 to 1.",
            (("min_overlap", "out of its range"),),
        )
