"""Client methods for queries: localization, similarity of two frames, and details of answers."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterable, Sequence
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
    MOST_DRAWN,
    MatchDetails,
    OverlayColour,
    OverlayTransform,
    QueryRecord,
    RecordStatus,
    Similarities,
    StoredQuery,
)
from sceneprint_client.calls import Call, Series
from sceneprint_client.errors import InvalidRequest
from sceneprint_client.http import (
    QueryFrame,
    QueryOptions,
    ServiceConnection,
    check_options,
    compared_frame,
    form_text,
    frames_form,
    map_path,
    match_path,
    meta_json,
    query_form,
    query_json,
    query_of,
    query_path,
    query_target,
    without_none,
)

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from sceneprint_client.http import FrameInput, MetaInput
    from sceneprint_client.surface_encoding import SurfacePoints


class QueryMethods(ServiceConnection):
    """Client methods for queries and their answers."""

    @Call
    async def query(
        self, map_name: str | None = None, frame: FrameInput | None = None,
        meta: MetaInput | None = None, *, frame_id: str | None = None,
        maps: str | Iterable[str] | None = None, up: Sequence[float] | None = None,
        robot: str | None = None, **how: Unpack[QueryOptions],
    ) -> Answer:  # fmt: skip
        """Return the frames of a map that show the place of a frame, without storing the frame.

        Parameters
        ----------
        frame, meta : the frame to search for, as for `upload`
        frame_id : id of a frame of the map, instead of `frame`; the frame itself is excluded
        maps : names of maps with the same model to search together, or `*` for all, instead of
            `map_name`; with `frame_id`, `map_name` is the map of that frame
        up : unit vector in the sensor's axes, from an IMU; default: from `meta` or a sidecar file
        robot : name of the robot for the query log; default: from `meta`
        how : fields of Query, such as k, stages, exact, filter and seed; nested options are
            dictionaries or records

        Raises
        ------
        UnknownMap, UnknownFrame : If the map or frame does not exist.
        FrameError, DatasetError : If the frame cannot be read or has no surface to sign.
        InvalidRequest : If an option is out of range, the frame of the map is not indexed, or
            the maps have different models.
        TypeError : If not exactly one of `frame` and `frame_id` is passed, no map is passed, or
            an option is unknown.
        """
        check_options(how)
        if maps is None:
            name, query_frame = await self._run(query_target, map_name, frame, meta, frame_id, up)
            request = _query_request(query_frame, query_of(Query, how), robot)
            return await self._call(Answer, "POST", f"{map_path(name)}/queries", **request)
        if (frame_id is None) != (map_name is None):
            raise TypeError("with `maps`, pass `map_name` only with `frame_id`")
        _, query_frame = await self._run(query_target, map_name or "", frame, meta, frame_id, up)
        named = query_frame if isinstance(query_frame, NamedFrame) else None
        names = maps if isinstance(maps, str) else list(maps)
        several = query_of(SeveralQuery, how, maps=names, frame=named)
        if isinstance(query_frame, NamedFrame):
            request = {"json": {**query_json(several), **without_none(robot=robot)}}
        else:
            request = query_form(*_with_robot(robot, *query_frame), several)
        return await self._call(Answer, "POST", "/v1/queries", **request)

    @Call
    async def localize(
        self, map_name: str, frame: FrameInput | None = None,
        meta: MetaInput | None = None, *, frame_id: str | None = None,
        up: Sequence[float] | None = None, robot: str | None = None,
        **how: Unpack[QueryOptions],
    ) -> Localization:  # fmt: skip
        """Return the status and pose of a frame in a map; see `query` for the parameters."""
        check_options(how)
        name, query_frame = await self._run(query_target, map_name, frame, meta, frame_id, up)
        request = _query_request(query_frame, query_of(Query, how), robot)
        return await self._call(Localization, "POST", f"{map_path(name)}/localize", **request)

    @Call
    async def localize_sequence(
        self, map_name: str, frames: Sequence[FrameInput],
        metas: Sequence[MetaInput] | None = None, **how: Unpack[QueryOptions],
    ) -> Localization:  # fmt: skip
        """Return the pose of the last of several frames; the earlier ones contribute evidence.

        Parameters
        ----------
        frames : 2 to 10 frames in the order of capture, as for `upload`
        metas : metadata of each frame; the poses in the metadata, in any common parent frame, are
            the odometry. Default: metadata from sidecar files
        how : see `query`

        Raises
        ------
        InvalidRequest : If there are too few or too many frames, or metadata or odometry is
            missing.
        """
        check_options(how)
        if metas is not None and len(metas) != len(frames):
            raise InvalidRequest(
                f"The number of `metas`, {len(metas)}, is not the number of frames, {len(frames)}. "
                "Pass one per frame.",
                (("metas", "pass one for each frame"),),
            )
        request = await self._run(
            frames_form, frames, [None] * len(frames) if metas is None else metas
        )
        fields = query_json(query_of(Query, how))
        request["data"] |= {name: form_text(value) for name, value in fields.items()}
        path = f"{map_path(map_name)}/localize/sequence"
        return await self._call(Localization, "POST", path, **request)

    @Call
    async def similarity(
        self, a: FrameInput | NamedFrame | tuple[str, str],
        b: FrameInput | NamedFrame | tuple[str, str],
        meta_a: MetaInput | None = None, meta_b: MetaInput | None = None, *, validate: bool = True,
        validation: ValidationOptions | dict[str, Any] | None = None, seed: int = 0,
        model: str | None = None,
    ) -> Similarity:  # fmt: skip
        """Return the similarity of two frames, and whether they show the same place.

        Parameters
        ----------
        a, b : a frame as for `upload`, or a stored frame as (map, frame id)
        meta_a, meta_b : metadata of frames that are not stored
        validate, validation, seed, model : see Comparison

        Raises
        ------
        UnknownMap, UnknownFrame : If the map or frame does not exist.
        FrameError, DatasetError : If a frame cannot be read or has no surface to sign.
        InvalidRequest : If an option is out of range, or the frames have different models.
        """
        how = checked(
            Comparison, "The comparison", validate=validate, validation=validation, seed=seed,
            model=model,
        )  # fmt: skip
        body = how.model_dump(mode="json", exclude_defaults=True, by_alias=True)
        files = {}
        for name, frame, meta in (("a", a, meta_a), ("b", b, meta_b)):
            target = await self._run(compared_frame, frame, meta)
            if isinstance(target, NamedFrame):
                body[f"frame_{name}"] = target.model_dump()
            else:
                files[name] = (name, target[0], "application/octet-stream")
                body[f"meta_{name}"] = meta_json(target[1])
        if not files:
            return await self._call(Similarity, "POST", "/v1/similarity", json=body)
        fields = {name: form_text(value) for name, value in body.items()}
        return await self._call(Similarity, "POST", "/v1/similarity", files=files, data=fields)

    @Series
    def queries(
        self, map_name: str | None = None, *,
        status: RecordStatus | Iterable[RecordStatus] = (), robot: str | None = None,
        since: datetime | str | None = None, until: datetime | str | None = None,
        kept: bool = False,
    ) -> AsyncIterator[QueryRecord]:  # fmt: skip
        """Yield past queries, newest first; the service stores them for 30 days by default.

        Parameters
        ----------
        map_name : name of a map; default: all maps that the key may read
        status : one or several statuses
        robot : name of a robot; default: all robots
        since, until : start (inclusive) and end (exclusive) of the period, with a time zone
        kept : whether to return only queries with a kept answer, see `keep_answer`

        Raises
        ------
        UnknownMap : If the map does not exist.
        InvalidRequest : If the status or a time is invalid.
        """
        statuses = [status] if isinstance(status, str) else list(status)
        return self._pages(
            Page[QueryRecord], "/v1/queries", map=map_name, status=statuses or None, robot=robot,
            since=_as_text(since), until=_as_text(until), kept=kept or None,
        )  # fmt: skip

    @Call
    async def delete_queries(self, map_name: str) -> None:
        """Delete all past queries of a map with their answers, permanently.

        Raise UnknownMap if the map does not exist. Raise Forbidden if the key does not have `admin`
        for the map.
        """
        await self._send("DELETE", "/v1/queries", params={"map": map_name})

    @Call
    async def answer(self, query_id: str) -> Answer:
        """Return the answer to an earlier query while it is stored.

        Raise UnknownQuery if the query is not stored.
        """
        return await self._call(Answer, "GET", query_path(query_id))

    @Call
    async def stored_query(self, query_id: str) -> StoredQuery:
        """Return the parameters of an earlier query and the expiry of its answer."""
        return await self._call(StoredQuery, "GET", f"{query_path(query_id)}/question")

    @Call
    async def keep_answer(self, query_id: str, title: str | None = None) -> QueryRecord:
        """Keep an answer until it is released, or retitle a kept answer; return its record.

        Parameters
        ----------
        query_id : id of the query
        title : label for people

        Raises
        ------
        UnknownQuery : If the query is no longer stored.
        QuotaExceeded : If too many answers are kept.
        InvalidRequest : If the title is too long.
        """
        body = without_none(title=title)
        return await self._call(QueryRecord, "PUT", f"{query_path(query_id)}/keep", json=body)

    @Call
    async def release_answer(self, query_id: str) -> None:
        """Release a kept answer; raise UnknownQuery if it is not kept."""
        await self._send("DELETE", f"{query_path(query_id)}/keep")

    @Call
    async def query_cloud(self, query_id: str) -> bytes:
        """Return points and normals of a query's surface as PLY, in the frame of its sensor.

        Raise UnknownQuery if the answer is not stored. Raise NotIndexed if the query ran without
        validation.
        """
        return await self._bytes(f"{query_path(query_id)}/cloud.ply")

    @Call
    async def query_points(self, query_id: str, limit: int = MOST_DRAWN) -> SurfacePoints:
        """Return at most `limit` points of `query_cloud` as arrays."""
        from sceneprint_client.surface_encoding import decode_points  # this import loads numpy

        path = f"{query_path(query_id)}/points"
        return decode_points(await self._bytes(path, params={"limit": limit}))

    @Call
    async def similarities(self, query_id: str, limit: int = 50) -> Similarities:
        """Return pairwise similarities of a query and its nearest frames.

        Parameters
        ----------
        query_id : id of the query
        limit : number of frames of the ranking, 1 to 200

        Raises
        ------
        UnknownQuery : If the answer is not stored.
        InvalidRequest : If `limit` is out of range.
        """
        return await self._call(
            Similarities, "GET", f"{query_path(query_id)}/similarities", params={"limit": limit}
        )

    @Call
    async def match_details(
        self, query_id: str, frame_id: str, map_name: str | None = None
    ) -> MatchDetails:
        """Validate one match of a query again, and return its details.

        Parameters
        ----------
        query_id, frame_id : id of the query, and id of one of its matches
        map_name : map of the match if several maps have this frame id; default: the first

        Raises
        ------
        UnknownQuery : If the answer is not stored.
        UnknownMap, UnknownFrame : If no match has this id, or its frame was deleted.
        NotIndexed : If the query ran without validation, or the map now has another model.
        """
        return await self._call(
            MatchDetails, "GET", match_path(query_id, frame_id), params=without_none(map=map_name)
        )

    @Call
    async def overlay(
        self, query_id: str, frame_id: str, map_name: str | None = None,
        color: OverlayColour = "source", transform: OverlayTransform = "aligned",
    ) -> bytes:  # fmt: skip
        """Return coloured points of a query and a match as PLY, in the frame of the match's sensor.

        Parameters
        ----------
        query_id, frame_id, map_name : see `match_details`
        color : source of the colour: "source", "normal" or "residual"
        transform : "aligned" (the accepted one), "rival" (the second best), or "none"

        Raises
        ------
        UnknownQuery, UnknownMap, UnknownFrame, NotIndexed : See `match_details`.
        InvalidRequest : If the transform or color is not supported.
        """
        return await self._bytes(
            f"{match_path(query_id, frame_id)}/overlay.ply",
            params=without_none(map=map_name, color=color, transform=transform),
        )


def _as_text(at: datetime | str | None) -> str | None:
    return at.isoformat() if isinstance(at, datetime) else at


def _query_request(frame: QueryFrame, query: Query, robot: str | None) -> dict[str, Any]:
    """Return the keyword arguments of an httpx request for a query with a stored or a new frame."""
    if isinstance(frame, NamedFrame):
        named = {"frame_id": frame.frame_id, **without_none(robot=robot)}
        return {"json": {**named, **query_json(query)}}
    return query_form(*_with_robot(robot, *frame), query)


def _with_robot(robot: str | None, data: bytes, meta: FrameMeta) -> tuple[bytes, FrameMeta]:
    """Return a frame with the robot's name in its metadata, unless these already name a robot."""
    if robot is None or meta.robot is not None:
        return data, meta
    return data, meta.model_copy(update={"robot": robot})
