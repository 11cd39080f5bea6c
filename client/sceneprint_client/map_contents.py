"""Maps and what they hold: frames and what was made of them, sessions, trajectories, and the fused
surface.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
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
    CLOUD_FRAMES,
    MOST_DRAWN,
    VIEWS,
    WIDTH,
    WIDTHS,
    CloudFrame,
    FramePatches,
    FrameSignature,
    View,
)
from sceneprint_client.api.surface import (
    PLAN_WIDTH,
    PLAN_WIDTHS,
    MapSurface,
    SurfaceSighting,
    SurfaceTile,
)
from sceneprint_client.errors import InvalidRequest
from sceneprint_client.http import (
    ServiceConnection,
    deletion_path,
    frame_path,
    given,
    map_path,
    surface_path,
    surface_tile_path,
)

if TYPE_CHECKING:
    from sceneprint_client.surface_encoding import SurfacePoints


class MapMethods(ServiceConnection):
    """Maps, their frames, and what is made of these."""

    def create_map(
        self, name: str, title: str | None = None, model: str = "depth",
        up: Sequence[float] | None = None, **limits: float | None,
    ) -> Map:  # fmt: skip
        """Create a map, or confirm that it exists as requested.

        Parameters
        ----------
        name, title, model : of the map
        up : unit vector in the parent frames of its poses; default: learnt from its frames
        limits : `quota_frames` and `quota_bytes`, which only an operator may set, and
            `retention_days`; see NewMap

        Raises
        ------
        InvalidRequest : the name is not a slug, or there is no such model or limit.
        MapExists : a map of that name has another title, model or limits.
        Forbidden : a quota is given, and the key does not have `admin` for `*`.
        """
        known: dict[str, Any] = limits if up is None else {**limits, "up": list(up)}
        new = checked(NewMap, "The map", name=name, title=title, model=model, **known)
        return self._ask(Map, "POST", "/v1/maps", json=new.model_dump(exclude_unset=True))

    def maps(self) -> list[Map]:
        """Return all maps by name."""
        return self._ask(Page[Map], "GET", "/v1/maps").items

    def map(self, name: str) -> Map:
        """Return a map; UnknownMap if it does not exist."""
        return self._ask(Map, "GET", map_path(name))

    def edit_map(
        self, map_name: str, changes: Mapping[str, Any], if_match: str | None = None, *,
        dry_run: bool = False,
    ) -> Map:  # fmt: skip
        """Edit title, limits and up of a map; parameters and errors as for `edit_frame`.

        Quotas require a key with `admin` for `*`, else Forbidden. With
        `dry_run` nothing changes, and the map is returned as it would be: `overdue` is how many
        frames its retention would delete at once.
        """
        parameters = {"dry_run": "true"} if dry_run else {}
        return self._ask(
            Map, "PATCH", map_path(map_name), params=parameters, **_edit_request(changes, if_match)
        )

    def delete_map(self, name: str) -> None:
        """Delete a map with everything in it, permanently; UnknownMap if it does not exist."""
        self._delete(map_path(name))

    def reencode(self, map_name: str, model: str) -> Map:
        """Sign a map again with another model; the map switches when all frames are signed.

        Parameters
        ----------
        map_name : of the map
        model : `depth`, `lidar`, `paper`, or the id or label of one of `models`

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : no such model.
        Conflict : the map has this model, or is being signed with a third one.
        """
        return self._ask(Map, "POST", f"{map_path(map_name)}/reencoding", json={"model": model})

    def cancel_reencoding(self, map_name: str) -> Map:
        """Cancel a re-encoding: the map keeps its model.

        Raises
        ------
        UnknownMap : no such map.
        Conflict : the map is not being re-encoded.
        """
        return self._ask(Map, "DELETE", f"{map_path(map_name)}/reencoding")

    def frame(self, map_name: str, frame_id: str) -> Frame:
        """Return a frame; UnknownMap or UnknownFrame if it does not exist."""
        return self._ask(Frame, "GET", frame_path(map_name, frame_id))

    def frames(
        self, map_name: str, state: FrameState | None = None, *,
        robot: str | Iterable[str] = (), session: str | Iterable[str] = (),
        tags: str | Iterable[str] = (), captured_after: datetime | None = None,
        captured_before: datetime | None = None, received_after: datetime | None = None,
        received_before: datetime | None = None, parent_frame: str | None = None,
        has_pose: bool | None = None, content_id: str | None = None, name: str | None = None,
        find: str | None = None, order: Literal["asc", "desc", "taken"] = "asc",
    ) -> Iterator[Frame]:  # fmt: skip
        """Frames of a map in order of arrival; deleted ones only on request.

        A frame must meet all conditions. Frames without the field are left out.

        Parameters
        ----------
        map_name : of the map
        state : in this state
        robot, session : this one, or one of these
        tags : the frame has all of them
        captured_after, captured_before : taken at that time or later, or earlier; with a zone
        received_after, received_before : uploaded at that time or later, or earlier
        parent_frame : of its pose
        has_pose : whether it has one
        content_id : hash of its samples and camera, or points and viewpoint
        name : prefix of its name, such as "frame-000123"
        find : prefix of its id, name or session
        order : "desc": newest first; "taken", with one session: in the order in which its
            frames were taken

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : an invalid name, or a time without a zone.
        """
        wanted = checked(
            FrameListing, "The list", state=state, robot=_names(robot), session=_names(session),
            tag=_names(tags), captured_after=captured_after, captured_before=captured_before,
            received_after=received_after, received_before=received_before,
            parent_frame=parent_frame, has_pose=has_pose, content_id=content_id, name=name,
            find=find, order=order,
        )  # fmt: skip
        parameters = wanted.model_dump(mode="json", exclude_defaults=True)
        return self._items(Page[Frame], f"{map_path(map_name)}/frames", **parameters)

    def edit_frame(
        self, map_name: str, frame_id: str, changes: Mapping[str, Any],
        if_match: str | None = None,
    ) -> Frame:  # fmt: skip
        """Edit the metadata of a frame; filters see the change at once.

        Parameters
        ----------
        map_name, frame_id : of the frame
        changes : fields of FrameEdit: omitted ones stay, None removes
        if_match : `etag` of the frame when you read it; None overwrites later edits

        Raises
        ------
        UnknownMap, UnknownFrame : it does not exist, or was deleted.
        InvalidRequest, InvalidPose : a field is unknown, cannot be edited, or is invalid.
        PreconditionFailed : it was edited since.
        """
        return self._ask(
            Frame, "PATCH", frame_path(map_name, frame_id), **_edit_request(changes, if_match)
        )

    def delete_frame(self, map_name: str, frame_id: str) -> None:
        """Delete a frame from its map; UnknownMap or UnknownFrame if it does not exist."""
        self._delete(frame_path(map_name, frame_id))

    def restore_frame(self, map_name: str, frame_id: str) -> Frame:
        """Restore a deleted frame, within ten minutes by default.

        Raises
        ------
        UnknownMap, UnknownFrame : it does not exist, or can no longer be restored.
        Conflict : its content was uploaded again.
        QuotaExceeded : the map has no room for it.
        """
        return self._ask(Frame, "POST", f"{frame_path(map_name, frame_id)}/restore")

    # selected frames

    def delete_frames(
        self, map_name: str, frame_ids: Sequence[str] | None = None,
        filter: Mapping[str, Any] | None = None,  # noqa: A002  (as in JSON)
    ) -> tuple[int, list[FrameDeletion]]:  # fmt: skip
        """Delete frames by their ids, or all that pass a filter.

        Parameters
        ----------
        map_name : of the map
        frame_ids : at most 1000; unknown ones are skipped
        filter : conditions as for `frames`, at least one

        Returns
        -------
        count : number of deleted frames
        deletions : for `restore_deletion`

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : neither ids nor a filter, or both.
        """
        body = given(frame_ids=_listed(frame_ids), filter=filter)
        count, deletions = 0, list[FrameDeletion]()
        while True:
            done = self._ask(
                FramesDeleted, "POST", f"{map_path(map_name)}/frames/delete", json=body
            )
            count += done.frames
            deletions += [] if done.deletion is None else [done.deletion]
            if not done.remaining:
                return count, deletions

    def edit_frames(
        self, map_name: str, frame_ids: Sequence[str] | None = None,
        filter: Mapping[str, Any] | None = None,  # noqa: A002  (as in JSON)
        **changes: Any,
    ) -> tuple[int, list[dict[str, Any]]]:  # fmt: skip
        """Edit frames by their ids, or all that pass a filter.

        Parameters
        ----------
        map_name, frame_ids, filter : see `delete_frames`
        changes : `session`, `robot`, `add_tags`, `remove_tags`; see FramesEdit

        Returns
        -------
        count : number of edited frames
        inverse : arguments for the calls that undo it

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : there is nothing to change, or a frame would have too many tags.
        """
        body = given(frame_ids=_listed(frame_ids), filter=filter) | changes
        count, inverse = 0, list[dict[str, Any]]()
        while True:
            done = self._ask(FramesEdited, "POST", f"{map_path(map_name)}/frames/edit", json=body)
            count += done.frames
            inverse += done.inverse
            if not done.remaining:
                return count, inverse
            body["after"] = done.last_frame_id

    def restore_deletion(self, map_name: str, deletion_id: str) -> FramesRestored:
        """Restore the frames of a deletion, within ten minutes by default.

        Parameters
        ----------
        map_name : of the map
        deletion_id : from `deletions` or `delete_frames`

        Raises
        ------
        UnknownMap, UnknownDeletion : it does not exist, or can no longer be undone.
        QuotaExceeded : the map has no room for the frames.
        """
        path = f"{deletion_path(map_name, deletion_id)}/restore"
        count, refused = 0, dict[str, RefusedFrame]()
        while True:
            done = self._ask(FramesRestored, "POST", path)
            count += done.frames
            refused |= {one.frame_id: one for one in done.refused}
            if not done.remaining or not done.frames:
                told = {"frames": count, "refused": list(refused.values())}
                return done.model_copy(update=told)

    def deletions(self, map_name: str) -> Iterator[FrameDeletion]:
        """Deletions that can still be undone, newest first; UnknownMap if there is no map."""
        return self._items(Page[FrameDeletion], f"{map_path(map_name)}/deletions")

    # sessions

    def sessions(self, map_name: str) -> Iterator[Session]:
        """Sessions of a map by robot: number of frames, times, parent frames of poses.

        Raises
        ------
        UnknownMap : no such map.
        """
        return self._items(Page[Session], f"{map_path(map_name)}/sessions")

    def delete_session(self, map_name: str, session: str, robot: str | None = None) -> int:
        """Delete all frames of a session and return their number; `restore_deletion` undoes it.

        Parameters
        ----------
        map_name, session : of the frames
        robot : only frames of this robot; default: of all

        Raises
        ------
        UnknownMap, UnknownSession : it does not exist.
        """
        path, deleted = f"{map_path(map_name)}/sessions", 0
        while True:
            parameters = given(session=session, robot=robot)
            change = self._ask(SessionChange, "DELETE", path, params=parameters)
            deleted += change.frames
            if not change.remaining:
                return deleted

    def edit_session(
        self, map_name: str, session: str, *, rename: str | None = None,
        rename_robot: str | None = None, add_tags: Sequence[str] = (),
        remove_tags: Sequence[str] = (), robot: str | None = None,
    ) -> int:  # fmt: skip
        """Rename a session or its robot, and add or remove tags; return the number of its frames.

        Parameters
        ----------
        map_name, session : of the frames
        rename : new name; the name of another session joins the two
        rename_robot : new robot of the frames
        add_tags, remove_tags : for all frames
        robot : only frames of this robot; default: of all

        Raises
        ------
        UnknownMap, UnknownSession : it does not exist.
        InvalidRequest : there is nothing to change, or a frame would have too many tags.
        """
        path, edited, after = f"{map_path(map_name)}/sessions", 0, None
        changes = {
            "session": rename, "robot": rename_robot, "add_tags": list(add_tags),
            "remove_tags": list(remove_tags),
        }  # fmt: skip
        body = {name: value for name, value in changes.items() if value}
        while True:
            parameters = given(session=session, robot=robot, after=after)
            change = self._ask(SessionChange, "PATCH", path, json=body, params=parameters)
            edited, after = edited + change.frames, change.last_frame_id
            if not change.remaining:
                return edited

    def trajectory(
        self, map_name: str, session: str, *, robot: str | None = None,
        parent_frame: str | None = None, captured_after: datetime | None = None,
        captured_before: datetime | None = None, most: int | None = None,
        clock: Clock = "taken",
    ) -> Trajectory:  # fmt: skip
        """Return the poses of a session in the order they were taken.

        Parameters
        ----------
        map_name : of the map
        session : of the run
        robot : required if several robots have a session of that name
        parent_frame : required if its poses have several
        captured_after, captured_before : only this part; with a time zone
        clock : time stamps: "captured" (`captured_at`), "sequence", or "received",
            which every frame has; "taken": `captured_at`, or `sequence` if none has one
        most : at most this many poses, evenly spaced; `posed` is the number of all

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : the session is not unique, or too long for one answer.
        """
        run = _run(session, robot, parent_frame, captured_after, captured_before, most, clock)
        return self._ask(Trajectory, "GET", **_run_request(map_name, run, "application/json"))

    def trajectory_text(
        self, map_name: str, session: str, *, robot: str | None = None,
        parent_frame: str | None = None, captured_after: datetime | None = None,
        captured_before: datetime | None = None, most: int | None = None,
        clock: Clock = "taken",
    ) -> str:  # fmt: skip
        """Like `trajectory`, as the text of a TUM file."""
        run = _run(session, robot, parent_frame, captured_after, captured_before, most, clock)
        return self._bytes(**_run_request(map_name, run, "text/plain")).decode()

    # what is made of a frame

    def cloud(self, map_name: str, frame_id: str, within: CloudFrame = "optical") -> bytes:
        """Return the surface that a frame saw: points and normals as PLY.

        Parameters
        ----------
        map_name, frame_id : of an indexed frame
        within : coordinates: "optical" of the sensor, "parent" of its pose, "base" of the
            robot

        Raises
        ------
        UnknownMap, UnknownFrame : it does not exist, or was deleted.
        NotIndexed : it is not indexed, or not yet.
        InvalidRequest : it has no pose, or no base.
        """
        if within not in CLOUD_FRAMES:
            raise _unknown("frame", within, CLOUD_FRAMES)
        return self._bytes(f"{frame_path(map_name, frame_id)}/cloud.ply", params={"frame": within})

    def frame_points(
        self, map_name: str, frame_id: str, within: CloudFrame = "optical",
        limit: int = MOST_DRAWN,
    ) -> SurfacePoints:  # fmt: skip
        """Return the points of `cloud` as arrays, in a third of the bytes. Errors as for `cloud`.

        Parameters
        ----------
        map_name, frame_id, within : see `cloud`
        limit : most points; if there are more, always the same subset
        """
        from sceneprint_client.surface_encoding import decode_points  # it takes numpy

        if within not in CLOUD_FRAMES:
            raise _unknown("frame", within, CLOUD_FRAMES)
        path = f"{frame_path(map_name, frame_id)}/points"
        return decode_points(self._bytes(path, params={"frame": within, "limit": limit}))

    def preview(
        self, map_name: str, frame_id: str, view: View = "depth", width: int = WIDTH
    ) -> bytes:
        """A picture of an indexed frame as PNG: "depth", "normals" or "patches". Errors as for
        `cloud`.
        """
        if view not in VIEWS:
            raise _unknown("view", view, VIEWS)
        if not WIDTHS[0] <= width <= WIDTHS[1]:
            raise InvalidRequest(
                f"The width is {width}. Give one from {WIDTHS[0]} to {WIDTHS[1]}.",
                (("width", "out of its range"),),
            )
        return self._bytes(
            f"{frame_path(map_name, frame_id)}/preview.png", params={"view": view, "width": width}
        )

    def patches(self, map_name: str, frame_id: str) -> FramePatches:
        """Return the surface patches of an indexed frame. Errors as for `cloud`."""
        return self._ask(FramePatches, "GET", f"{frame_path(map_name, frame_id)}/patches")

    def signature(self, map_name: str, frame_id: str) -> FrameSignature:
        """Return the signature of an indexed frame. Errors as for `cloud`."""
        return self._ask(FrameSignature, "GET", f"{frame_path(map_name, frame_id)}/signature")

    def upload_of(self, map_name: str, frame_id: str) -> bytes:
        """Return a frame's upload, byte for byte.

        Raises
        ------
        UnknownMap, UnknownFrame : it does not exist, or was deleted.
        NotIndexed : it was not kept.
        """
        return self._bytes(f"{frame_path(map_name, frame_id)}/upload")

    # a copy of a map, part by part

    def map_copy(self, map_name: str, have: Sequence[str] = ()) -> tuple[MapCopy, dict[str, bytes]]:
        """Return a map at one moment, and those parts of its rows that you lack, as many as fit.

        Raises
        ------
        UnknownMap : there is no such map.
        ValueError : the service sent something else.
        """
        body = CopyRequest(have=list(have)).model_dump()
        data = self._send("POST", f"{map_path(map_name)}/copy", json=body).content
        line, _, rest = data.partition(b"\n")
        head, parts, start = MapCopy.model_validate_json(line), dict[str, bytes](), 0
        for one in head.parts:
            if one.sent:
                parts[one.digest] = rest[start : start + one.bytes]
                start += one.bytes
        return head, parts

    def copied_artifact(self, map_name: str, digest: str) -> bytes:
        """What validation compares of a frame; NotFound if no indexed frame has it."""
        return self._bytes(f"{map_path(map_name)}/copy/artifacts/{digest}")

    def copied_model(self, map_name: str) -> bytes:
        """Return the file of a map's model; UnknownMap if there is no such map."""
        return self._bytes(f"{map_path(map_name)}/copy/model")


def _listed(names: Sequence[str] | None) -> list[str] | None:
    return None if names is None else list(names)


def _names(given: str | Iterable[str]) -> list[str]:
    return [given] if isinstance(given, str) else list(given)


def _run(
    session: str, robot: str | None, parent_frame: str | None, after: datetime | None,
    before: datetime | None, most: int | None, clock: Clock,
) -> Run:  # fmt: skip
    return checked(
        Run, "The run", session=session, robot=robot, parent_frame=parent_frame,
        captured_after=after, captured_before=before, most=most,
        clock=clock,
    )  # fmt: skip


def _run_request(map_name: str, run: Run, accept: str) -> dict[str, Any]:
    """Arguments of a request for a trajectory."""
    parameters = run.model_dump(mode="json", exclude_none=True)
    path = f"{map_path(map_name)}/trajectory"
    return {"path": path, "params": parameters, "headers": {"Accept": accept}}


def _edit_request(changes: Mapping[str, Any], if_match: str | None) -> dict[str, Any]:
    """Arguments of a request that edits."""
    headers = {"Content-Type": "application/merge-patch+json"}
    if if_match is not None:
        headers["If-Match"] = f'"{if_match}"'
    return {"content": to_json(dict(changes)), "headers": headers}


def _unknown(what: str, name: str, known: Iterable[str]) -> InvalidRequest:
    return InvalidRequest(
        f"There is no {what} {name!r:.40}. Give one of {', '.join(known)}.", ((what, "unknown"),)
    )


class SurfaceMethods(ServiceConnection):
    """Surfaces of maps."""

    def surface(self, map_name: str) -> MapSurface:
        """Return the fused surface of a map's posed frames; UnknownMap if it does not exist."""
        return self._ask(MapSurface, "GET", surface_path(map_name))

    def begin_surface(self, map_name: str) -> MapSurface:
        """Build the surface of a map now, or add new frames to it.

        Workers do this by themselves, unless `SCENEPRINT_BUILD_SURFACES` is `on_request`.

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : it has no indexed frame with a pose.
        """
        return self._ask(MapSurface, "POST", surface_path(map_name))

    def delete_surface(self, map_name: str) -> None:
        """Delete the surface of a map until it is requested again; UnknownMap if it is missing."""
        self._delete(surface_path(map_name))

    def surface_tiles(
        self, map_name: str, parent: str | None = None, level: int = 0
    ) -> Iterator[SurfaceTile]:
        """Tiles of a level by column, row and floor; `surface` lists the levels.

        Parameters
        ----------
        map_name : of the map
        parent : parent frame; default: the most common one
        level : 0 for the finest

        Raises
        ------
        UnknownMap : no such map.
        """
        path = f"{surface_path(map_name)}/tiles"
        return self._items(Page[SurfaceTile], path, parent=parent, level=level)

    def surface_tile(self, map_name: str, digest: str) -> bytes:
        """Return the cells of a tile; `sceneprint_client.surface_encoding.decode_tile` reads them.

        Raises
        ------
        UnknownMap : no such map.
        NotFound : it changed or was removed: list the tiles again.
        """
        return self._bytes(surface_tile_path(map_name, digest))

    def surface_frames(
        self, map_name: str, at: Sequence[float] | None = None, *, radius: float | None = None,
        box: Sequence[float] | None = None, parent: str | None = None,
    ) -> Iterator[SurfaceSighting]:  # fmt: skip
        """Frames that saw a spot, nearest viewpoint first; or those taken in a box.

        Parameters
        ----------
        map_name : of the map
        at : x, y, z of the spot, metres
        radius : they saw something within this distance of it, metres; default: two cells
        box : x, y, z of two corners, metres; instead of `at`
        parent : parent frame; default: the most common one

        Raises
        ------
        UnknownMap : no such map.
        InvalidRequest : neither or both of `at` and `box`, or numbers out of range.
        """
        asked: dict[str, Any] = given(
            at=None if at is None else ",".join(map(repr, map(float, at))),
            box=None if box is None else ",".join(map(repr, map(float, box))),
            radius=radius, parent=parent,
        )  # fmt: skip
        return self._items(Page[SurfaceSighting], f"{surface_path(map_name)}/frames", **asked)

    def surface_plan(
        self, map_name: str, parent: str | None = None, *, width: int = PLAN_WIDTH,
        low: float | None = None, high: float | None = None,
    ) -> bytes:  # fmt: skip
        """Return a surface seen from above as a PNG file, transparent where it is empty.

        Parameters
        ----------
        map_name : of the map
        parent : parent frame; default: the most common one
        width : of the longer side, pixels
        low, high : only what lies between these heights, metres along up

        Raises
        ------
        UnknownMap : no such map.
        NotFound : no surface has that parent frame.
        """
        if not PLAN_WIDTHS[0] <= width <= PLAN_WIDTHS[1]:
            raise InvalidRequest(
                f"The width is {width}. Give one from {PLAN_WIDTHS[0]} to {PLAN_WIDTHS[1]}.",
                (("width", "out of its range"),),
            )
        asked = given(parent=parent, width=width, low=low, high=high)
        return self._bytes(f"{surface_path(map_name)}/plan.png", params=asked)
