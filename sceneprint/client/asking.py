"""Queries: where was this frame taken, where am I, and are these two frames of one place.

A topic of the client: what it needs of a backend, both backends, and the calls of `Client`.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from sceneprint.client.frames import checked
from sceneprint.client.questions import (
    Options,
    Side,
    body_of,
    frame_of,
    path_of,
    query_of,
    sent_of,
    side_of,
    text_of,
)
from sceneprint.client.sending import Sender
from sceneprint.datasets import FrameReference
from sceneprint.schemas import (
    Answer,
    Comparison,
    FrameMeta,
    Localization,
    NamedFrame,
    Query,
    SeveralQuery,
    Similarity,
    ValidationOptions,
)

if TYPE_CHECKING:
    from typing import Unpack

    from sceneprint.engine import Engine


class AskingBackend(Protocol):
    """What this topic needs of whoever does the work."""

    def query_upload(self, map_name: str, data: bytes, meta: FrameMeta, query: Query) -> Answer:
        """Look a frame up that is not kept."""

    def query_frame(self, map_name: str, frame_id: str, query: Query) -> Answer:
        """Look a frame of the map up among the others."""

    def query_several(self, sent: tuple[bytes, FrameMeta] | None, query: SeveralQuery) -> Answer:
        """Look a frame up in several maps: the one that is sent, or the one the query names."""

    def localize(self, map_name: str, frame: Side, query: Query) -> Localization:
        """Where a frame was taken; a stored one is of that map."""

    def compare(self, a: Side, b: Side, how: Comparison) -> Similarity:
        """How alike two frames are."""


class RemoteAsking(Sender):
    """Over HTTP."""

    def query_upload(self, map_name: str, data: bytes, meta: FrameMeta, query: Query) -> Answer:
        """Look a frame up that is not kept."""
        return self._ask(Answer, "POST", path_of(map_name, "queries"), **sent_of(data, meta, query))

    def query_frame(self, map_name: str, frame_id: str, query: Query) -> Answer:
        """Look a frame of the map up among the others."""
        body = {"frame_id": frame_id, **body_of(query)}
        return self._ask(Answer, "POST", path_of(map_name, "queries"), json=body)

    def query_several(self, sent: tuple[bytes, FrameMeta] | None, query: SeveralQuery) -> Answer:
        """Look a frame up in several maps: the one that is sent, or the one the query names."""
        request = {"json": body_of(query)} if sent is None else sent_of(*sent, query)
        return self._ask(Answer, "POST", "/v1/queries", **request)

    def localize(self, map_name: str, frame: Side, query: Query) -> Localization:
        """Where a frame was taken; a stored one is of that map."""
        if isinstance(frame, NamedFrame):
            request = {"json": {"frame_id": frame.frame_id, **body_of(query)}}
        else:
            request = sent_of(*frame, query)
        return self._ask(Localization, "POST", path_of(map_name, "localize"), **request)

    def compare(self, a: Side, b: Side, how: Comparison) -> Similarity:
        """How alike two frames are."""
        from sceneprint.client.messages import said_of

        body = how.model_dump(mode="json", exclude_defaults=True, by_alias=True)
        files = {}
        for name, side in (("a", a), ("b", b)):
            if isinstance(side, NamedFrame):
                body[f"frame_{name}"] = side.model_dump()
            else:
                files[name] = (name, side[0], "application/octet-stream")
                body[f"meta_{name}"] = said_of(side[1])
        if not files:
            return self._ask(Similarity, "POST", "/v1/similarity", json=body)
        fields = {name: text_of(value) for name, value in body.items()}
        return self._ask(Similarity, "POST", "/v1/similarity", files=files, data=fields)


class EmbeddedAsking:
    """In this process."""

    _engine: Engine

    def query_upload(self, map_name: str, data: bytes, meta: FrameMeta, query: Query) -> Answer:
        """Look a frame up that is not kept."""
        return self._engine.query_upload(map_name, data, meta, query)

    def query_frame(self, map_name: str, frame_id: str, query: Query) -> Answer:
        """Look a frame of the map up among the others."""
        return self._engine.query_frame(map_name, frame_id, query)

    def query_several(self, sent: tuple[bytes, FrameMeta] | None, query: SeveralQuery) -> Answer:
        """Look a frame up in several maps: the one that is sent, or the one the query names."""
        queries = self._engine.queries
        maps = queries.maps_of(query)
        if sent is not None:
            return queries.upload(maps, *sent, query)
        if query.frame is None:
            raise TypeError("a query of several maps names a frame, or one is sent")
        return queries.stored(maps, query.frame, query)

    def localize(self, map_name: str, frame: Side, query: Query) -> Localization:
        """Where a frame was taken; a stored one is of that map."""
        from sceneprint.engine.localizing import check_localizes, localization_of

        check_localizes(query)
        if isinstance(frame, NamedFrame):
            return localization_of(self.query_frame(map_name, frame.frame_id, query))
        return localization_of(self.query_upload(map_name, *frame, query))

    def compare(self, a: Side, b: Side, how: Comparison) -> Similarity:
        """How alike two frames are."""
        return self._engine.queries.compare(a, b, how)


class Asking:
    """The calls."""

    _backend: AskingBackend

    def query(
        self, map_name: str | None = None, frame: bytes | Path | FrameReference | None = None,
        meta: FrameMeta | None = None, *, frame_id: str | None = None,
        maps: str | Iterable[str] | None = None, **how: Unpack[Options],
    ) -> Answer:  # fmt: skip
        """Where was this frame taken? The frame is not added to the map.

        Parameters
        ----------
        map_name : of the map
        frame, meta : as for `upload`
        frame_id : of a frame of the map, in place of `frame`; it does not find itself
        maps : names of maps of one model that are asked as one, or `*` for all, in place of
            `map_name`; with `frame_id`, `map_name` says which map that frame is of
        how : k, stages, exact, filter, seed and the rest of the fields of Query; a filter, and
            what else has fields, as a dictionary or a record

        Raises
        ------
        UnknownMap, UnknownFrame : there is none.
        FrameError, DatasetError : the frame cannot be read, or nothing in it can be signed.
        InvalidRequest : an option is out of its range, the frame of the map is not indexed, or
            the maps are of several models.
        TypeError : not one of `frame` and `frame_id`, no map, or an option that there is not.
        """
        if maps is None:
            name, side = side_of(map_name, frame, meta, frame_id)
            query = query_of(Query, how)
            if isinstance(side, NamedFrame):
                return self._backend.query_frame(name, side.frame_id, query)
            return self._backend.query_upload(name, *side, query)
        if (frame_id is None) != (map_name is None):
            raise TypeError("with `maps`, give `map_name` where `frame_id` names a frame of it")
        _, side = side_of(map_name or "", frame, meta, frame_id)
        named = side if isinstance(side, NamedFrame) else None
        asked = maps if isinstance(maps, str) else list(maps)
        several = query_of(SeveralQuery, how, maps=asked, frame=named)
        return self._backend.query_several(None if isinstance(side, NamedFrame) else side, several)

    def localize(
        self, map_name: str, frame: bytes | Path | FrameReference | None = None,
        meta: FrameMeta | None = None, *, frame_id: str | None = None, **how: Unpack[Options],
    ) -> Localization:  # fmt: skip
        """Where in a map was this frame taken? One status and one pose; see `query`."""
        name, side = side_of(map_name, frame, meta, frame_id)
        return self._backend.localize(name, side, query_of(Query, how))

    def similarity(
        self, a: bytes | Path | FrameReference | NamedFrame | tuple[str, str],
        b: bytes | Path | FrameReference | NamedFrame | tuple[str, str],
        meta_a: FrameMeta | None = None, meta_b: FrameMeta | None = None, *, validate: bool = True,
        validation: ValidationOptions | dict[str, Any] | None = None, seed: int = 0,
        model: str | None = None,
    ) -> Similarity:  # fmt: skip
        """How alike are two frames, and do they see one place?

        Parameters
        ----------
        a, b : each a frame as for `upload`, or a stored one: (map, frame id)
        meta_a, meta_b : what is known of those that are not stored
        validate, validation, seed, model : see Comparison

        Raises
        ------
        UnknownMap, UnknownFrame : there is none.
        FrameError, DatasetError : a frame cannot be read, or nothing in it can be signed.
        InvalidRequest : an option is out of its range, or the frames are of two models.
        """
        given = {"validate": validate, "validation": validation, "seed": seed, "model": model}
        how = checked(Comparison, "The comparison", **given)
        return self._backend.compare(frame_of(a, meta_a), frame_of(b, meta_b), how)
