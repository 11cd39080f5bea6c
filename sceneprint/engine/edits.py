"""Metadata of frames and maps, edited by a JSON merge patch (RFC 7396).

frame, patch  --edited-->  its columns as they shall be  --edit_frame-->  frame
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from pydantic import ValidationError

from sceneprint.engine.frames import base_of, columns, viewpoint_of
from sceneprint.engine.tags import frame_tag, map_tag
from sceneprint.engine.transforms import pose_matrix, transform
from sceneprint.engine.wire import tell_frames, tell_map, when
from sceneprint.errors import InvalidRequest, PreconditionFailed, UnknownFrame
from sceneprint.schemas import Frame, FrameMeta, FrameState, Map
from sceneprint.schemas.edits import FrameEdit, MapEdit
from sceneprint.store import Store
from sceneprint.store.editing import write_frame, write_map
from sceneprint.store.frames import find_frame
from sceneprint.store.maps import find_map
from sceneprint.store.records import FrameRow

#: Columns of each field that can be edited.
_COLUMNS = {
    "robot": ("robot",),
    "session": ("session",),
    "captured_at": ("captured_at",),
    "tags": ("tags",),
    "pose": ("pose_parent", "pose"),
    "T_base_sensor": ("base_frame", "base"),
}
_CONTENT = (
    "intrinsics", "depth_scale", "depth_along_ray", "viewpoint", "units_per_metre", "format",
)  # fmt: skip
#: Ways to give a transform.
_WAYS = ("translation", "rotation", "matrix")


def edit_frame(
    store: Store, map_name: str, frame_id: str, patch: Mapping[str, Any],
    if_match: Collection[str] | None = None,
) -> Frame:  # fmt: skip
    """Change the metadata of a frame; filters see it at once.

    Parameters
    ----------
    store : see Store
    map_name, frame_id : of the frame, in whatever state
    patch : fields of FrameEdit: what is left out stays, None removes
    if_match : tags of `frame_tag`; None to change it however it is by now

    Raises
    ------
    UnknownMap, UnknownFrame : there is none, or it was deleted.
    InvalidRequest : a field is unknown, cannot be edited, or is not as it should be.
    InvalidPose : no rigid transform.
    PreconditionFailed : it has been edited meanwhile.
    """
    _check_fields(patch)
    with store.database.write() as connection:
        row = find_map(connection, map_name)
        frame = find_frame(connection, row, frame_id)
        if frame.state == FrameState.DELETED:
            raise UnknownFrame(f"Frame {frame.id} of map {row.name!r} was deleted before.")
        _check_tag(f"Frame {frame.id}", frame_tag(frame), if_match)
        now = write_frame(connection, row, frame, edited(frame, patch))
        return tell_frames(connection, row, [now])[0]


def edit_map(
    store: Store, map_name: str, patch: Mapping[str, Any],
    if_match: Collection[str] | None = None, *, dry_run: bool = False,
) -> Map:  # fmt: skip
    """Change title, quotas and retention of a map; parameters and errors as of `edit_frame`.

    Who may set a quota, the caller has seen to. With `dry_run` nothing is changed, and the map told
    as it would be.
    """
    try:
        change = MapEdit.model_validate(dict(patch))
    except ValidationError as error:
        raise _invalid(error, "The change of the map") from error
    values = change.model_dump(include=change.model_fields_set)
    with store.database.read() if dry_run else store.database.write() as connection:
        row = find_map(connection, map_name)
        _check_tag(f"Map {row.name!r}", map_tag(row), if_match)
        if dry_run:
            return tell_map(connection, replace(row, **values))
        return tell_map(connection, write_map(connection, row, values))


def edited(frame: FrameRow, patch: Mapping[str, Any]) -> dict[str, Any]:
    """Columns of a frame as a patch wants them; those that it does not touch are left out.

    Raises
    ------
    InvalidRequest, InvalidPose : see `edit_frame`.
    """
    meta = _merged(frame, patch)
    pose = None if meta.pose is None else pose_matrix(meta.pose)
    known = columns(meta, pose, base_of(meta.T_base_sensor, viewpoint_of(frame)))
    found = {name: known[name] for field in patch for name in _COLUMNS[field]}
    for field, column in (("pose", "pose"), ("T_base_sensor", "base")):
        given = patch.get(field)
        if given is not None and not any(way in given for way in _WAYS):
            del found[column]  # only its frame is renamed: not a digit changes
    return found


def _merged(frame: FrameRow, patch: Mapping[str, Any]) -> FrameMeta:
    """What would be uploaded to have the frame as it is wanted."""
    now = {
        "robot": frame.robot,
        "session": frame.session,
        "captured_at": when(frame.captured_at),
        "tags": frame.tags,
        "pose": _told(frame.pose, "parent_frame", frame.pose_parent),
        "T_base_sensor": _told(frame.base, "base_frame", frame.base_frame),
    }
    for field, given in patch.items():
        is_transform = field in ("pose", "T_base_sensor") and isinstance(given, Mapping)
        now[field] = _with(now[field], given) if is_transform else given
    wanted = {name: value for name, value in now.items() if value is not None}
    try:
        return FrameMeta.model_validate({"intrinsics": frame.intrinsics, **wanted})
    except ValidationError as error:
        raise _invalid(error, "The change of the frame") from error


def _told(matrix: list[list[float]] | None, name: str, frame: str | None) -> dict[str, Any] | None:
    return None if matrix is None else {name: frame, "matrix": matrix}


def _with(now: Mapping[str, Any] | None, given: Mapping[str, Any]) -> dict[str, Any]:
    """A transform after a patch; it is given in one way, so the other one goes."""
    kept = dict(now or {})
    if "matrix" in kept and ("translation" in given or "rotation" in given):
        T = transform(np.array(kept.pop("matrix")), "", "")
        kept |= {"translation": T.translation.model_dump(), "rotation": T.rotation.model_dump()}
    merged = {**kept, **given}
    return {name: value for name, value in merged.items() if value is not None}


def _check_fields(patch: Mapping[str, Any]) -> None:
    for name in patch:
        if name in _CONTENT:
            raise InvalidRequest(
                f"`{name}` is part of what the frame is, and cannot be edited. Delete the frame, "
                "and upload it as it should be.",
                ((name, "cannot be edited"),),
            )
        if name not in FrameEdit.model_fields:
            raise InvalidRequest(
                f"The change of the frame has a field {name!r:.80} that is not known. Its fields "
                f"are {', '.join(FrameEdit.model_fields)}.",
                ((name[:80], "not known"),),
            )


def _check_tag(what: str, tag: str, if_match: Collection[str] | None) -> None:
    if if_match is not None and tag not in if_match:
        raise PreconditionFailed(
            f'{what} has been edited since it was read: its ETag is "{tag}" by now. Read it '
            "again, and send the change with that in If-Match."
        )


def _invalid(error: ValidationError, what: str) -> InvalidRequest:
    found = tuple(
        (".".join(str(part) for part in one["loc"])[:80], one["msg"].removeprefix("Value error, "))
        for one in error.errors(include_url=False, include_input=False)[:20]
    )
    told = "; ".join(f"{place or 'it'}: {reason}" for place, reason in found[:3])
    return InvalidRequest(f"{what} is not as it should be: {told}. See /docs.", found)
