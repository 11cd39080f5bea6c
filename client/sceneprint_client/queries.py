"""Queries: where was this frame taken, where am I, are these two frames of one place; and what
their answers rest on.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Any

from sceneprint_client.api import (
    Answer,
    Comparison,
    FrameMeta,
    Localization,
    NamedFrame,
    Page,
    Query,
    SeveralQuery,
    Similarity,
    ValidationOptions,
)
from sceneprint_client.api.base import checked
from sceneprint_client.api.results import (
    COLOURS,
    MOST_DRAWN,
    TRANSFORMS,
    MatchDetails,
    OverlayColour,
    OverlayTransform,
    QueryRecord,
    RecordStatus,
    Similarities,
    StoredQuery,
)
from sceneprint_client.errors import InvalidRequest
from sceneprint_client.http import (
    QueryFrame,
    QueryOptions,
    ServiceConnection,
    check_options,
    compared_frame,
    form_text,
    frames_form,
    given,
    map_path,
    match_path,
    meta_json,
    named_or_sent,
    query_form,
    query_json,
    query_of,
    query_path,
)

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from sceneprint_client.http import FrameInput, MetaInput
    from sceneprint_client.surface_encoding import SurfacePoints

#: Most frames of a ranking that are compared with each other.
_MOST_ALIKE = 200


class QueryMethods(ServiceConnection):
    """Queries, and what can be looked at after one."""

    def query(
        self, map_name: str | None = None, frame: FrameInput | None = None,
        meta: MetaInput | None = None, *, frame_id: str | None = None,
        maps: str | Iterable[str] | None = None, up: Sequence[float] | None = None,
        robot: str | None = None, **how: Unpack[QueryOptions],
    ) -> Answer:  # fmt: skip
        """Where was this frame taken? The frame is not added to the map.

        Parameters
        ----------
        map_name : of the map
        frame, meta : as for `upload`
        frame_id : a frame of the map, instead of `frame`; it does not find itself
        maps : names of maps of one model to search together, or `*` for all, instead of
            `map_name`; with `frame_id`, `map_name` is the map of that frame
        up : unit vector in the sensor's axes, from an IMU; default: from `meta` or a sidecar
        robot : who asks, for the record of the query; default: from `meta`
        how : k, stages, exact, filter, seed and the other fields of Query; a filter, and
            other options with fields, as a dictionary or a record

        Raises
        ------
        UnknownMap, UnknownFrame : it does not exist.
        FrameError, DatasetError : the frame cannot be read, or nothing in it can be signed.
        InvalidRequest : an option is out of range, the frame of the map is not indexed, or
            the maps have different models.
        TypeError : not exactly one of `frame` and `frame_id`, no map, or an unknown option.
        """
        check_options(how)
        if maps is None:
            name, wanted = named_or_sent(map_name, frame, meta, frame_id, up)
            request = _query_request(wanted, query_of(Query, how), robot)
            return self._ask(Answer, "POST", f"{map_path(name)}/queries", **request)
        if (frame_id is None) != (map_name is None):
            raise TypeError("with `maps`, give `map_name` where `frame_id` names a frame of it")
        _, wanted = named_or_sent(map_name or "", frame, meta, frame_id, up)
        named = wanted if isinstance(wanted, NamedFrame) else None
        asked = maps if isinstance(maps, str) else list(maps)
        several = query_of(SeveralQuery, how, maps=asked, frame=named)
        if isinstance(wanted, NamedFrame):
            request = {"json": {**query_json(several), **given(robot=robot)}}
        else:
            request = query_form(*_with_robot(robot, *wanted), several)
        return self._ask(Answer, "POST", "/v1/queries", **request)

    def localize(
        self, map_name: str, frame: FrameInput | None = None,
        meta: MetaInput | None = None, *, frame_id: str | None = None,
        up: Sequence[float] | None = None, robot: str | None = None,
        **how: Unpack[QueryOptions],
    ) -> Localization:  # fmt: skip
        """Where in a map was this frame taken? One status and one pose; see `query`."""
        check_options(how)
        name, wanted = named_or_sent(map_name, frame, meta, frame_id, up)
        request = _query_request(wanted, query_of(Query, how), robot)
        return self._ask(Localization, "POST", f"{map_path(name)}/localize", **request)

    def localize_sequence(
        self, map_name: str, frames: Sequence[FrameInput],
        metas: Sequence[MetaInput] | None = None, **how: Unpack[QueryOptions],
    ) -> Localization:  # fmt: skip
        """Where in a map was the last of these frames taken? The earlier ones vote for it too.

        Parameters
        ----------
        map_name : of the map
        frames : 2 to 10 in the order they were taken, as for `upload`
        metas : of each; their poses, in one parent frame of any name, are the odometry. Default:
            what lies beside the files
        how : see `query`

        Raises
        ------
        InvalidRequest : too few or too many frames, another number of metadata, or no odometry.
        """
        check_options(how)
        if metas is not None and len(metas) != len(frames):
            raise InvalidRequest(
                f"There are {len(frames)} frames and {len(metas)} `metas`. Give one for each.",
                (("metas", "not one for each"),),
            )
        request = frames_form(frames, [None] * len(frames) if metas is None else metas)
        query = query_json(query_of(Query, how))
        request["data"] |= {name: form_text(value) for name, value in query.items()}
        return self._ask(Localization, "POST", f"{map_path(map_name)}/localize/sequence", **request)

    def similarity(
        self, a: FrameInput | NamedFrame | tuple[str, str],
        b: FrameInput | NamedFrame | tuple[str, str],
        meta_a: MetaInput | None = None, meta_b: MetaInput | None = None, *, validate: bool = True,
        validation: ValidationOptions | dict[str, Any] | None = None, seed: int = 0,
        model: str | None = None,
    ) -> Similarity:  # fmt: skip
        """How similar are two frames, and do they see the same place?

        Parameters
        ----------
        a, b : each a frame as for `upload`, or a stored one: (map, frame id)
        meta_a, meta_b : metadata of those that are not stored
        validate, validation, seed, model : see Comparison

        Raises
        ------
        UnknownMap, UnknownFrame : it does not exist.
        FrameError, DatasetError : a frame cannot be read, or nothing in it can be signed.
        InvalidRequest : an option is out of range, or the frames have different models.
        """
        how = checked(
            Comparison, "The comparison", validate=validate, validation=validation, seed=seed,
            model=model,
        )  # fmt: skip
        body = how.model_dump(mode="json", exclude_defaults=True, by_alias=True)
        files = {}
        for name, frame, meta in (("a", a, meta_a), ("b", b, meta_b)):
            found = compared_frame(frame, meta)
            if isinstance(found, NamedFrame):
                body[f"frame_{name}"] = found.model_dump()
            else:
                files[name] = (name, found[0], "application/octet-stream")
                body[f"meta_{name}"] = meta_json(found[1])
        if not files:
            return self._ask(Similarity, "POST", "/v1/similarity", json=body)
        fields = {name: form_text(value) for name, value in body.items()}
        return self._ask(Similarity, "POST", "/v1/similarity", files=files, data=fields)

    # the queries that came

    def queries(
        self, map_name: str | None = None, *,
        status: RecordStatus | Iterable[RecordStatus] = (), robot: str | None = None,
        since: datetime | str | None = None, until: datetime | str | None = None,
        kept: bool = False,
    ) -> Iterator[QueryRecord]:  # fmt: skip
        """Return past queries, newest first; they are stored for 30 days by default.

        Parameters
        ----------
        map_name : only of this map; default: all that the key may read
        status : this one, or one of these
        robot : only of this robot
        since, until : from that time on, and before that time; with a zone
        kept : only queries with a kept answer, see `keep_answer`

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : an invalid status or time.
        """
        statuses = [status] if isinstance(status, str) else list(status)
        return self._items(
            Page[QueryRecord], "/v1/queries", map=map_name, status=statuses or None, robot=robot,
            since=_as_text(since), until=_as_text(until), kept=True if kept else None,
        )  # fmt: skip

    def delete_queries(self, map_name: str) -> None:
        """Delete all past queries of a map with their answers, permanently.

        Raises
        ------
        UnknownMap : no such map.
        Forbidden : the key does not have `admin` for it.
        """
        self._send("DELETE", "/v1/queries", params={"map": map_name})

    # what can be looked at after a query

    def answer(self, query_id: str) -> Answer:
        """Return the answer to an earlier query while it is stored.

        Raises
        ------
        UnknownQuery : it is not stored, or no longer.
        """
        return self._ask(Answer, "GET", query_path(query_id))

    def stored_query(self, query_id: str) -> StoredQuery:
        """Return how an earlier query was sent, and when its answer expires; UnknownQuery."""
        return self._ask(StoredQuery, "GET", f"{query_path(query_id)}/question")

    def keep_answer(self, query_id: str, title: str | None = None) -> QueryRecord:
        """Keep an answer until it is released, or change the title of a kept one.

        Parameters
        ----------
        query_id : of the answer
        title : a label for people

        Raises
        ------
        UnknownQuery : it is no longer stored.
        QuotaExceeded : too many answers are kept.
        InvalidRequest : the title is too long.
        """
        body = given(title=title)
        return self._ask(QueryRecord, "PUT", f"{query_path(query_id)}/keep", json=body)

    def release_answer(self, query_id: str) -> None:
        """Release a kept answer; UnknownQuery if it is not kept."""
        self._send("DELETE", f"{query_path(query_id)}/keep")

    def query_cloud(self, query_id: str) -> bytes:
        """Return the surface that a query saw: points and normals as PLY, in its sensor's frame.

        Raises
        ------
        UnknownQuery : its answer is not stored, or no longer.
        NotIndexed : it ran without validation.
        """
        return self._bytes(f"{query_path(query_id)}/cloud.ply")

    def query_points(self, query_id: str, limit: int = MOST_DRAWN) -> SurfacePoints:
        """The points of `query_cloud` as arrays, at most `limit`. Errors as for `query_cloud`."""
        from sceneprint_client.surface_encoding import decode_points  # it takes numpy

        path = f"{query_path(query_id)}/points"
        return decode_points(self._bytes(path, params={"limit": limit}))

    def similarities(self, query_id: str, limit: int = 50) -> Similarities:
        """Pairwise similarities of a query and its nearest frames.

        Parameters
        ----------
        query_id : of an answer
        limit : how many frames of the ranking, 1 to 200

        Raises
        ------
        UnknownQuery : its answer is not stored, or no longer.
        InvalidRequest : a limit out of range.
        """
        if not 1 <= limit <= _MOST_ALIKE:
            raise InvalidRequest(
                f"{limit} frames cannot be compared with each other. Ask for 1 to {_MOST_ALIKE}.",
                (("limit", f"give 1 to {_MOST_ALIKE}"),),
            )
        return self._ask(
            Similarities, "GET", f"{query_path(query_id)}/similarities", params={"limit": limit}
        )

    def match_details(
        self, query_id: str, frame_id: str, map_name: str | None = None
    ) -> MatchDetails:
        """One match of a query, validated again, with the data behind its figures.

        Parameters
        ----------
        query_id, frame_id : of an answer, and of one of its matches
        map_name : if matches from several maps have that id; default: the first of them

        Raises
        ------
        UnknownQuery : its answer is not stored, or no longer.
        UnknownMap, UnknownFrame : no match has that id, or it was deleted since.
        NotIndexed : the query ran without validation, or the map has another model now.
        """
        return self._ask(
            MatchDetails, "GET", match_path(query_id, frame_id), params=given(map=map_name)
        )

    def overlay(
        self, query_id: str, frame_id: str, map_name: str | None = None,
        color: OverlayColour = "source", transform: OverlayTransform = "aligned",
    ) -> bytes:  # fmt: skip
        """Return points of a query and a match, coloured, as PLY in the match's sensor frame.

        Parameters
        ----------
        query_id, frame_id, map_name : see `match_details`
        color : by "source", "normal" or "residual"
        transform : "aligned" (the accepted one), "rival" (the next best), or "none"

        Raises
        ------
        UnknownQuery, UnknownMap, UnknownFrame, NotIndexed : see `match_details`.
        InvalidRequest : no such transform or color.
        """
        for name, value, known in (("color", color, COLOURS), ("transform", transform, TRANSFORMS)):
            if value not in known:
                raise InvalidRequest(
                    f"{value!r:.80} is no {name} of an overlay. Give one of {', '.join(known)}.",
                    ((name, f"give one of {', '.join(known)}"),),
                )
        return self._bytes(
            f"{match_path(query_id, frame_id)}/overlay.ply",
            params=given(map=map_name, color=color, transform=transform),
        )


def _as_text(at: datetime | str | None) -> str | None:
    return at.isoformat() if isinstance(at, datetime) else at


def _query_request(frame: QueryFrame, query: Query, robot: str | None) -> dict[str, Any]:
    """Arguments of a request that asks for a stored frame of the map, or for one at hand."""
    if isinstance(frame, NamedFrame):
        named = {"frame_id": frame.frame_id, **given(robot=robot)}
        return {"json": {**named, **query_json(query)}}
    return query_form(*_with_robot(robot, *frame), query)


def _with_robot(robot: str | None, data: bytes, meta: FrameMeta) -> tuple[bytes, FrameMeta]:
    """Return a frame with the robot that sends the query, unless its metadata names one."""
    if robot is None or meta.robot is not None:
        return data, meta
    return data, meta.model_copy(update={"robot": robot})
