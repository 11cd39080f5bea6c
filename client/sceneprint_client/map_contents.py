"""Client methods for maps and their contents: frames, sessions, trajectories and surfaces."""

from __future__ import annotations

from collections.abc import AsyncIterator, Iterable, Mapping, Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Any, Literal

from pydantic_core import to_json

from sceneprint_client.api import Frame, FrameState, Map, NewMap, Page
from sceneprint_client.api.base import checked
from sceneprint_client.api.copies import CopyRequest, MapCopy
from sceneprint_client.api.listing import (
    Clock,
    FrameDeletion,
    FrameListing,
    FramesDeleted,
    FramesEdited,
    FramesRestored,
    RefusedFrame,
    Run,
    Session,
    SessionChange,
    Trajectory,
)
from sceneprint_client.api.results import (
    MOST_DRAWN,
    WIDTH,
    CloudFrame,
    FramePatches,
    FrameSignature,
    View,
)
from sceneprint_client.api.surface import PLAN_WIDTH, MapSurface, SurfaceSighting, SurfaceTile
from sceneprint_client.calls import Call, Series
from sceneprint_client.http import (
    ServiceConnection,
    deletion_path,
    frame_path,
    map_path,
    surface_path,
    surface_tile_path,
    without_none,
)

if TYPE_CHECKING:
    from sceneprint_client.surface_encoding import SurfacePoints


class MapMethods(ServiceConnection):
    """Client methods for maps, frames, and data derived from frames."""

    @Call
    async def create_map(
        self, /, name: str, title: str | None = None, model: str = "depth",
        up: Sequence[float] | None = None, **limits: float | None,
    ) -> Map:  # fmt: skip
        """Create and return a map, or return the existing map with the same properties.

        Parameters
        ----------
        name, title, model : properties of the map
        up : unit vector in the parent frames of its poses; default: estimated from its frames
        limits : `quota_frames` and `quota_bytes`, which require an operator's key, and
            `retention_days`; see NewMap

        Raises
        ------
        InvalidRequest : If the name, the model or a limit is invalid.
        MapExists : If a map of that name has another title, model or limits.
        Forbidden : If a quota is set and the key does not have `admin` for `*`.
        """
        fields: dict[str, Any] = limits if up is None else {**limits, "up": list(up)}
        new = checked(NewMap, "The map", name=name, title=title, model=model, **fields)
        return await self._call(Map, "POST", "/v1/maps", json=new.model_dump(exclude_unset=True))

    @Call
    async def maps(self) -> list[Map]:
        """Return all maps, sorted by name."""
        return (await self._call(Page[Map], "GET", "/v1/maps")).items

    @Call
    async def map(self, name: str) -> Map:
        """Return a map; raise UnknownMap if it does not exist."""
        return await self._call(Map, "GET", map_path(name))

    @Call
    async def edit_map(
        self, map_name: str, changes: Mapping[str, Any], if_match: str | None = None, *,
        dry_run: bool = False,
    ) -> Map:  # fmt: skip
        """Edit title, limits and up of a map; parameters and errors as for `edit_frame`.

        Changes to quotas raise Forbidden unless the key has `admin` for `*`. `dry_run` returns
        the edited map without storing it; its `overdue` is the number of frames that the new
        retention would delete immediately.
        """
        parameters = {"dry_run": "true"} if dry_run else {}
        return await self._call(
            Map, "PATCH", map_path(map_name), params=parameters, **_edit_request(changes, if_match)
        )

    @Call
    async def delete_map(self, name: str) -> None:
        """Delete a map and its contents permanently; raise UnknownMap if it does not exist."""
        await self._delete(map_path(name))

    @Call
    async def reencode(self, map_name: str, model: str) -> Map:
        """Start to sign a map with another model; return the map, which switches at the end.

        Parameters
        ----------
        model : `depth`, `lidar`, `paper`, or the id or label of one of `models`

        Raises
        ------
        UnknownMap : If the map does not exist.
        InvalidRequest : If the model does not exist.
        Conflict : If the map already uses this model, or is already switching to a different one.
        """
        return await self._call(
            Map, "POST", f"{map_path(map_name)}/reencoding", json={"model": model}
        )

    @Call
    async def cancel_reencoding(self, map_name: str) -> Map:
        """Cancel the re-encoding of a map, which keeps its model; return the map.

        Raise UnknownMap if the map does not exist. Raise Conflict if no re-encoding is in progress.
        """
        return await self._call(Map, "DELETE", f"{map_path(map_name)}/reencoding")

    @Call
    async def frame(self, map_name: str, frame_id: str) -> Frame:
        """Return a frame; raise UnknownMap or UnknownFrame if it does not exist."""
        return await self._call(Frame, "GET", frame_path(map_name, frame_id))

    @Series
    def frames(
        self, map_name: str, state: FrameState | None = None, *,
        robot: str | Iterable[str] = (), session: str | Iterable[str] = (),
        tags: str | Iterable[str] = (), captured_after: datetime | None = None,
        captured_before: datetime | None = None, received_after: datetime | None = None,
        received_before: datetime | None = None, parent_frame: str | None = None,
        has_pose: bool | None = None, content_id: str | None = None, name: str | None = None,
        find: str | None = None, order: Literal["asc", "desc", "taken"] = "asc",
    ) -> AsyncIterator[Frame]:  # fmt: skip
        """Yield the frames of a map that meet all conditions; deleted frames only with `state`.

        A frame does not meet a condition on a property that it lacks, such as a time.

        Parameters
        ----------
        state : state of the frames
        robot, session : one or several names
        tags : tags, all of which a frame must have
        captured_after, captured_before : start (inclusive) and end of the capture time, with a
            time zone
        received_after, received_before : start (inclusive) and end of the upload time
        parent_frame : parent frame of the pose
        has_pose : whether the frames have a pose
        content_id : hash of samples and camera, or of points and viewpoint
        name : prefix of the name, such as "frame-000123"
        find : prefix of the id, name or session
        order : "asc": order of upload; "desc": newest upload first; "taken", with one session:
            order of capture

        Raises
        ------
        UnknownMap : If the map does not exist.
        InvalidRequest : If a name is invalid, or a time has no time zone.
        """
        listing = checked(
            FrameListing, "The list", state=state, robot=_names(robot), session=_names(session),
            tag=_names(tags), captured_after=captured_after, captured_before=captured_before,
            received_after=received_after, received_before=received_before,
            parent_frame=parent_frame, has_pose=has_pose, content_id=content_id, name=name,
            find=find, order=order,
        )  # fmt: skip
        parameters = listing.model_dump(mode="json", exclude_defaults=True)
        return self._pages(Page[Frame], f"{map_path(map_name)}/frames", **parameters)

    @Call
    async def edit_frame(
        self, map_name: str, frame_id: str, changes: Mapping[str, Any],
        if_match: str | None = None,
    ) -> Frame:  # fmt: skip
        """Edit the metadata of a frame, which filters use immediately; return the edited frame.

        Parameters
        ----------
        changes : fields of FrameEdit; omitted fields are unchanged, None removes a value
        if_match : `etag` of the frame when you read it; None overwrites later edits

        Raises
        ------
        UnknownMap, UnknownFrame : If the map or frame does not exist or was deleted.
        InvalidRequest, InvalidPose : If a field is unknown, cannot be edited, or is invalid.
        PreconditionFailed : If the frame was edited after you read it.
        """
        return await self._call(
            Frame, "PATCH", frame_path(map_name, frame_id), **_edit_request(changes, if_match)
        )

    @Call
    async def delete_frame(self, map_name: str, frame_id: str) -> None:
        """Delete a frame; raise UnknownMap or UnknownFrame if it does not exist."""
        await self._delete(frame_path(map_name, frame_id))

    @Call
    async def restore_frame(self, map_name: str, frame_id: str) -> Frame:
        """Restore and return a deleted frame, within ten minutes by default.

        Raises
        ------
        UnknownMap, UnknownFrame : If the frame does not exist or can no longer be restored.
        Conflict : If the same content was uploaded again.
        QuotaExceeded : If the quota of the map has no room for the frame.
        """
        return await self._call(Frame, "POST", f"{frame_path(map_name, frame_id)}/restore")

    @Call
    async def delete_frames(
        self, map_name: str, frame_ids: Sequence[str] | None = None,
        filter: Mapping[str, Any] | None = None,  # noqa: A002  (as in JSON)
    ) -> tuple[int, list[FrameDeletion]]:  # fmt: skip
        """Delete frames by their ids, or all frames that pass a filter.

        Parameters
        ----------
        frame_ids : at most 1000 ids; unknown ids are skipped
        filter : conditions as for `frames`, at least one

        Returns
        -------
        count : number of deleted frames
        deletions : arguments for `restore_deletion`

        Raises
        ------
        UnknownMap : If the map does not exist.
        InvalidRequest : If you pass neither ids nor a filter, or both.
        """
        body = without_none(frame_ids=frame_ids and list(frame_ids), filter=filter)
        count, deletions = 0, list[FrameDeletion]()
        while True:
            done = await self._call(
                FramesDeleted, "POST", f"{map_path(map_name)}/frames/delete", json=body
            )
            count += done.frames
            deletions += [] if done.deletion is None else [done.deletion]
            if not done.remaining:
                return count, deletions

    @Call
    async def edit_frames(
        self, /, map_name: str, frame_ids: Sequence[str] | None = None,
        filter: Mapping[str, Any] | None = None,  # noqa: A002  (as in JSON)
        **changes: Any,
    ) -> tuple[int, list[dict[str, Any]]]:  # fmt: skip
        """Edit frames by their ids, or all frames that pass a filter.

        Parameters
        ----------
        map_name, frame_ids, filter : see `delete_frames`
        changes : `session`, `robot`, `add_tags`, `remove_tags`; see FramesEdit

        Returns
        -------
        count : number of edited frames
        inverse : arguments of the calls that undo the edit

        Raises
        ------
        UnknownMap : If the map does not exist.
        InvalidRequest : If there is nothing to change, or a frame would have too many tags.
        """
        body = without_none(frame_ids=frame_ids and list(frame_ids), filter=filter) | changes
        count, inverse = 0, list[dict[str, Any]]()
        while True:
            done = await self._call(
                FramesEdited, "POST", f"{map_path(map_name)}/frames/edit", json=body
            )
            count += done.frames
            inverse += done.inverse
            if not done.remaining:
                return count, inverse
            body["after"] = done.last_frame_id

    @Call
    async def restore_deletion(self, map_name: str, deletion_id: str) -> FramesRestored:
        """Restore the frames of a deletion, within ten minutes by default; return the total counts.

        Parameters
        ----------
        deletion_id : id from `deletions` or `delete_frames`

        Raises
        ------
        UnknownMap, UnknownDeletion : If the deletion does not exist or can no longer be undone.
        QuotaExceeded : If the quota of the map has no room for the frames.
        """
        path = f"{deletion_path(map_name, deletion_id)}/restore"
        count, refused = 0, dict[str, RefusedFrame]()
        while True:
            done = await self._call(FramesRestored, "POST", path)
            count += done.frames
            refused |= {frame.frame_id: frame for frame in done.refused}
            if not done.remaining or not done.frames:
                update = {"frames": count, "refused": list(refused.values())}
                return done.model_copy(update=update)

    @Series
    def deletions(self, map_name: str) -> AsyncIterator[FrameDeletion]:
        """Yield the deletions that can still be undone, newest first."""
        return self._pages(Page[FrameDeletion], f"{map_path(map_name)}/deletions")

    @Series
    def sessions(self, map_name: str) -> AsyncIterator[Session]:
        """Yield the sessions of a map, sorted by robot, with frame counts, times and parent frames.

        Raise UnknownMap if the map does not exist.
        """
        return self._pages(Page[Session], f"{map_path(map_name)}/sessions")

    @Call
    async def delete_session(self, map_name: str, session: str, robot: str | None = None) -> int:
        """Delete all frames of a session and return their number; `restore_deletion` undoes it.

        Parameters
        ----------
        map_name, session : names of the map and the session
        robot : robot whose frames to delete; default: all robots

        Raises
        ------
        UnknownMap, UnknownSession : If the map or session does not exist.
        """
        path, deleted = f"{map_path(map_name)}/sessions", 0
        while True:
            parameters = without_none(session=session, robot=robot)
            change = await self._call(SessionChange, "DELETE", path, params=parameters)
            deleted += change.frames
            if not change.remaining:
                return deleted

    @Call
    async def edit_session(
        self, map_name: str, session: str, *, rename: str | None = None,
        rename_robot: str | None = None, add_tags: Sequence[str] = (),
        remove_tags: Sequence[str] = (), robot: str | None = None,
    ) -> int:  # fmt: skip
        """Rename a session or its robot, and add or remove tags; return the number of its frames.

        Parameters
        ----------
        map_name, session : names of the map and the session
        rename : new name; the name of another session merges the two
        rename_robot : new robot of the frames
        add_tags, remove_tags : tags to add to and remove from all frames
        robot : robot whose frames to edit; default: all robots

        Raises
        ------
        UnknownMap, UnknownSession : If the map or session does not exist.
        InvalidRequest : If there is nothing to change, or a frame would have too many tags.
        """
        path, edited, after = f"{map_path(map_name)}/sessions", 0, None
        changes = {
            "session": rename, "robot": rename_robot, "add_tags": list(add_tags),
            "remove_tags": list(remove_tags),
        }  # fmt: skip
        body = {name: value for name, value in changes.items() if value}
        while True:
            parameters = without_none(session=session, robot=robot, after=after)
            change = await self._call(SessionChange, "PATCH", path, json=body, params=parameters)
            edited, after = edited + change.frames, change.last_frame_id
            if not change.remaining:
                return edited

    @Call
    async def trajectory(
        self, map_name: str, session: str, *, robot: str | None = None,
        parent_frame: str | None = None, captured_after: datetime | None = None,
        captured_before: datetime | None = None, most: int | None = None,
        clock: Clock = "taken",
    ) -> Trajectory:  # fmt: skip
        """Return the poses of a session in order of capture.

        Parameters
        ----------
        map_name, session : names of the map and the session
        robot : name of the robot; required if several robots have a session of that name
        parent_frame : parent frame; required if the poses have several parent frames
        captured_after, captured_before : start and end of the capture time, with a time zone
        clock : source of the timestamps: "captured" (`captured_at`), "sequence", or "received"
            (which every frame has); "taken": `captured_at`, or `sequence` if no frame with a pose
            has a capture time
        most : maximum number of poses, evenly spaced; `posed` is the number of all poses

        Raises
        ------
        UnknownMap : If the map does not exist.
        InvalidRequest : If the session is ambiguous, or too long for one answer.
        """
        run = _run(session, robot, parent_frame, captured_after, captured_before, most, clock)
        return await self._call(
            Trajectory, "GET", **_run_request(map_name, run, "application/json")
        )

    @Call
    async def trajectory_text(
        self, map_name: str, session: str, *, robot: str | None = None,
        parent_frame: str | None = None, captured_after: datetime | None = None,
        captured_before: datetime | None = None, most: int | None = None,
        clock: Clock = "taken",
    ) -> str:  # fmt: skip
        """Return the text of a TUM file; parameters and errors as for `trajectory`."""
        run = _run(session, robot, parent_frame, captured_after, captured_before, most, clock)
        return (await self._bytes(**_run_request(map_name, run, "text/plain"))).decode()

    @Call
    async def cloud(self, map_name: str, frame_id: str, within: CloudFrame = "optical") -> bytes:
        """Return points and normals of a frame's surface as PLY.

        Parameters
        ----------
        map_name, frame_id : names of the map and of an indexed frame
        within : coordinate frame: "optical" (sensor), "parent" (of the pose) or "base" (robot)

        Raises
        ------
        UnknownMap, UnknownFrame : If the map or frame does not exist or was deleted.
        NotIndexed : If the frame is not indexed.
        InvalidRequest : If the frame lacks the pose or the base that `within` requires.
        """
        return await self._bytes(
            f"{frame_path(map_name, frame_id)}/cloud.ply", params={"frame": within}
        )

    @Call
    async def frame_points(
        self, map_name: str, frame_id: str, within: CloudFrame = "optical",
        limit: int = MOST_DRAWN,
    ) -> SurfacePoints:  # fmt: skip
        """Return the points of `cloud` as arrays; the response is a third as large.

        Parameters
        ----------
        map_name, frame_id, within : see `cloud`
        limit : maximum number of points; a larger cloud always yields the same subset
        """
        from sceneprint_client.surface_encoding import decode_points  # this import loads numpy

        path = f"{frame_path(map_name, frame_id)}/points"
        return decode_points(await self._bytes(path, params={"frame": within, "limit": limit}))

    @Call
    async def preview(
        self, map_name: str, frame_id: str, view: View = "depth", width: int = WIDTH
    ) -> bytes:
        """Return a PNG picture of an indexed frame: "depth", "normals" or "patches". Errors are
        those of `cloud`.
        """
        return await self._bytes(
            f"{frame_path(map_name, frame_id)}/preview.png", params={"view": view, "width": width}
        )

    @Call
    async def patches(self, map_name: str, frame_id: str) -> FramePatches:
        """Return the surface patches of an indexed frame. Errors are those of `cloud`."""
        return await self._call(FramePatches, "GET", f"{frame_path(map_name, frame_id)}/patches")

    @Call
    async def signature(self, map_name: str, frame_id: str) -> FrameSignature:
        """Return the signature of an indexed frame. Errors are those of `cloud`."""
        return await self._call(
            FrameSignature, "GET", f"{frame_path(map_name, frame_id)}/signature"
        )

    @Call
    async def upload_of(self, map_name: str, frame_id: str) -> bytes:
        """Return the original bytes of a frame's upload.

        Raise UnknownMap or UnknownFrame if the map or frame does not exist or was deleted. Raise
        NotIndexed if the service did not store the upload.
        """
        return await self._bytes(f"{frame_path(map_name, frame_id)}/upload")

    @Call
    async def map_copy(
        self, map_name: str, have: Sequence[str] = ()
    ) -> tuple[MapCopy, dict[str, bytes]]:
        """Return a map's state at a single moment, and the parts not in `have` that fit a response.

        Raise UnknownMap if the map does not exist. Raise ValueError if the answer is not a copy of
        a map.
        """
        body = CopyRequest(have=list(have)).model_dump()
        data = (await self._send("POST", f"{map_path(map_name)}/copy", json=body)).content
        line, _, rest = data.partition(b"\n")
        head, parts, start = MapCopy.model_validate_json(line), dict[str, bytes](), 0
        for part in head.parts:
            if part.sent:
                parts[part.digest] = rest[start : start + part.bytes]
                start += part.bytes
        return head, parts

    @Call
    async def copied_artifact(self, map_name: str, digest: str) -> bytes:
        """Return the validation geometry of a frame; raise NotFound for an unknown digest."""
        return await self._bytes(f"{map_path(map_name)}/copy/artifacts/{digest}")

    @Call
    async def copied_model(self, map_name: str) -> bytes:
        """Return the file of a map's model; raise UnknownMap if the map does not exist."""
        return await self._bytes(f"{map_path(map_name)}/copy/model")


def _names(names: str | Iterable[str]) -> list[str]:
    return [names] if isinstance(names, str) else list(names)


def _run(
    session: str, robot: str | None, parent_frame: str | None, after: datetime | None,
    before: datetime | None, most: int | None, clock: Clock,
) -> Run:  # fmt: skip
    return checked(
        Run, "The run", session=session, robot=robot, parent_frame=parent_frame,
        captured_after=after, captured_before=before, most=most, clock=clock,
    )  # fmt: skip


def _run_request(map_name: str, run: Run, accept: str) -> dict[str, Any]:
    """Return the keyword arguments of an httpx request for a trajectory of type `accept`."""
    parameters = run.model_dump(mode="json", exclude_none=True)
    path = f"{map_path(map_name)}/trajectory"
    return {"path": path, "params": parameters, "headers": {"Accept": accept}}


def _edit_request(changes: Mapping[str, Any], if_match: str | None) -> dict[str, Any]:
    headers = {"Content-Type": "application/merge-patch+json"}
    if if_match is not None:
        headers["If-Match"] = f'"{if_match}"'
    return {"content": to_json(dict(changes)), "headers": headers}


class SurfaceMethods(ServiceConnection):
    """Client methods for the fused surfaces of maps."""

    @Call
    async def surface(self, map_name: str) -> MapSurface:
        """Return the fused surface of a map's posed frames."""
        return await self._call(MapSurface, "GET", surface_path(map_name))

    @Call
    async def begin_surface(self, map_name: str) -> MapSurface:
        """Start to build the surface of a map, or to add new frames to it; return its state.

        Workers do this automatically unless `SCENEPRINT_BUILD_SURFACES` is `on_request`.

        Raise UnknownMap if the map does not exist. Raise InvalidRequest if the map has no indexed
        frame with a pose.
        """
        return await self._call(MapSurface, "POST", surface_path(map_name))

    @Call
    async def delete_surface(self, map_name: str) -> None:
        """Delete the surface of a map; the service does not rebuild it until `begin_surface`."""
        await self._delete(surface_path(map_name))

    @Series
    def surface_tiles(
        self, map_name: str, parent: str | None = None, level: int = 0
    ) -> AsyncIterator[SurfaceTile]:
        """Yield the tiles of a level by column, row and floor; `surface` lists the levels.

        Parameters
        ----------
        parent : parent frame; default: the most common parent frame
        level : number of the level; 0 has the finest cells

        Raises
        ------
        UnknownMap : If the map does not exist.
        """
        path = f"{surface_path(map_name)}/tiles"
        return self._pages(Page[SurfaceTile], path, parent=parent, level=level)

    @Call
    async def surface_tile(self, map_name: str, digest: str) -> bytes:
        """Return the cells of a tile; `sceneprint_client.surface_encoding.decode_tile` reads them.

        Raise UnknownMap if the map does not exist. Raise NotFound if the tile was changed or
        removed; list the tiles again.
        """
        return await self._bytes(surface_tile_path(map_name, digest))

    @Series
    def surface_frames(
        self, map_name: str, at: Sequence[float] | None = None, *, radius: float | None = None,
        box: Sequence[float] | None = None, parent: str | None = None,
    ) -> AsyncIterator[SurfaceSighting]:  # fmt: skip
        """Yield frames that saw a spot, nearest viewpoint first, or frames taken within a box.

        Parameters
        ----------
        at : x, y, z of the spot, metres
        radius : radius around the spot, metres; default: two cells
        box : x, y, z of two opposite corners, metres; instead of `at`
        parent : parent frame; default: the most common parent frame

        Raises
        ------
        UnknownMap : If the map does not exist.
        InvalidRequest : If you pass neither `at` nor `box`, or both, or a number is out of range.
        """
        parameters: dict[str, Any] = without_none(
            at=None if at is None else ",".join(map(repr, map(float, at))),
            box=None if box is None else ",".join(map(repr, map(float, box))),
            radius=radius, parent=parent,
        )  # fmt: skip
        return self._pages(Page[SurfaceSighting], f"{surface_path(map_name)}/frames", **parameters)

    @Call
    async def surface_plan(
        self, map_name: str, parent: str | None = None, *, width: int = PLAN_WIDTH,
        low: float | None = None, high: float | None = None,
    ) -> bytes:  # fmt: skip
        """Return a top view of a surface as a PNG file, transparent where it is empty.

        Parameters
        ----------
        parent : parent frame; default: the most common parent frame
        width : length of the longer side, pixels
        low, high : minimum and maximum height of the drawn surface, along up, metres

        Raises
        ------
        UnknownMap : If the map does not exist.
        NotFound : If no surface has this parent frame.
        """
        parameters = without_none(parent=parent, width=width, low=low, high=high)
        return await self._bytes(f"{surface_path(map_name)}/plan.png", params=parameters)
