"""A kept query once more: how it was asked, what it saw, and what other options would answer.

query id  --Rerun-->  Question | PNG | Answer

An operator is told the id of a robot's query, and has neither the frame nor the robot. The
signature and the points that are kept with the answer are all that asking again needs.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any

from sceneprint.engine.results.result_views import check_geometry
from sceneprint.engine.results.stored_results import StoredResult, StoredResults
from sceneprint.engine.search.query import Queries, steadily
from sceneprint.engine.search.retrieval import Deadline, PreparedQuery, check_taken
from sceneprint.errors import DamagedSignature, InvalidRequest, NotIndexed, UnknownFrame
from sceneprint.formats.artifact import read_geometry
from sceneprint.pictures import depth_view, normals_view, picture
from sceneprint.store import Store
from sceneprint.store.frames import find_frame
from sceneprint.store.maps import find_map
from sceneprint.store.postgres.replica import read_through
from sceneprint.store.signatures import stored_vector
from sceneprint.store.tables import MapRow
from sceneprint_client.api import Answer, NamedFrame, Query
from sceneprint_client.api.results import Question, View


class Rerun:
    """Kept queries, asked once more."""

    def __init__(self, store: Store, kept: StoredResults, queries: Queries) -> None:
        self._store, self._kept, self._queries = store, kept, queries

    def question(self, query_id: str) -> Question:
        """How it was asked; UnknownQuery where it is not kept, or no longer."""
        kept = self._kept.find(query_id)
        return Question(
            query_id=query_id,
            maps=kept.answer.maps,
            frame=kept.answer.frame,
            kind=kept.answer.kind,
            robot=kept.taken.robot,
            session=kept.taken.session,
            asked_at=datetime.fromtimestamp(kept.at, UTC).isoformat(timespec="seconds"),
            validates=kept.geometry is not None or kept.answer.frame is not None,
            model=kept.answer.model,
            options=_given_options(kept),
        )

    def preview(self, query_id: str, view: View = "depth", width: int = 320) -> bytes:
        """A picture of what the query saw as PNG; see `sceneprint.pictures`.

        Raises
        ------
        UnknownQuery : it is not kept, or no longer.
        NotIndexed : it was asked without validation, for which alone its points are made.
        InvalidRequest : its patches, which are not kept.
        """
        kept = self._kept.find(query_id)
        if view == "patches":
            raise InvalidRequest(
                "The patches of a query are not stored. Use view=depth or view=normals.",
                (("view", "not stored for a query"),),
            )
        surface = read_geometry(check_geometry(kept, "the frame and the stage")).surface
        colours, text = (depth_view if view == "depth" else normals_view)(surface)
        return picture(colours, width, {"view": view, "model": kept.answer.model, **text})

    def options(self, query_id: str, changes: Mapping[str, Any]) -> dict[str, Any]:
        """How to ask again: as it was asked, with what is given put in its place.

        Parameters
        ----------
        query_id : of a kept answer
        changes : options by name; None puts back the default
        """
        merged = {**_given_options(self._kept.find(query_id)), **changes}
        return {name: value for name, value in merged.items() if value is not None}

    def ask(
        self, query_id: str, maps: list[str], query: Query, since: float | None = None
    ) -> Answer:
        """Ask a kept query once more.

        Parameters
        ----------
        query_id : of a kept answer
        maps, query, since : see `Queries.upload`

        Raises
        ------
        UnknownQuery : it is not kept, or no longer.
        UnknownMap, UnknownFrame : a map, or the stored frame that was asked for, is gone, or
            another frame has its id.
        NotIndexed : it was an upload asked without validation, and this asks for it; or a map has
            another model than its signature.
        InvalidRequest : see `prepare_upload` and `prepare_stored`.
        """
        kept = self._kept.find(query_id)
        frame = kept.answer.frame
        if frame is not None:
            named = NamedFrame(map=frame.map, frame_id=frame.frame_id)
            self._check_same(kept, named)
            return self._queries.stored(maps, named, query, since)
        deadline = Deadline(query.deadline_ms, since)

        def ask(rows: list[MapRow]) -> Answer:
            for row in rows:
                if row.model_id != kept.model_id:
                    raise NotIndexed(
                        f"Map {row.name!r} has a different model than the query was signed with, "
                        "and the upload of the query is not stored. Send the frame again."
                    )
            return self._queries.answer(rows, _ready(kept, query), query, deadline)

        return read_through(self._store.replica, lambda: steadily(self._store, maps, ask))

    def _check_same(self, kept: StoredResult, named: NamedFrame) -> None:
        """Frames that are deleted give up their ids; one of the same content signs the same."""
        with self._store.database.read() as connection:
            frame = find_frame(connection, find_map(connection, named.map), named.frame_id)
            try:
                vector = stored_vector(connection, frame.number, kept.model_id)
            except DamagedSignature:  # whoever asks for it has it made again
                return
        if vector is not None and vector != kept.vector.tobytes():
            raise UnknownFrame(
                f"Frame {named.frame_id} of map {named.map!r} was deleted after the query, and a "
                "new frame has its id. Send a new query."
            )


def _given_options(kept: StoredResult) -> dict[str, Any]:
    told: dict[str, Any] = kept.query.model_dump(mode="json", exclude_unset=True)
    return {name: value for name, value in told.items() if name in Query.model_fields}


def _ready(kept: StoredResult, query: Query) -> PreparedQuery:
    """The query as `Queries.upload` prepared it."""
    artifact = kept.geometry
    validates = "validate" in query.stages
    return PreparedQuery(
        kept.model_id,
        kept.vector,
        read_geometry(check_geometry(kept, "the frame and the stage")) if validates else None,
        check_taken(kept.taken, query),
        None,
        0.0,
        base=kept.base,
        artifact=artifact,
        kind=kept.answer.kind,
        up=kept.up,
    )
