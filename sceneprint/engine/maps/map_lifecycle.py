"""Maps made, and the metadata of maps and frames edited."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from pydantic import ValidationError

from sceneprint import errors
from sceneprint.engine import serializers
from sceneprint.engine.ingest.frame_decoder import base_of, columns, viewpoint_of
from sceneprint.models import read_model, write_model
from sceneprint.store import Store
from sceneprint.store.frames import find_frame, write_frame, write_map
from sceneprint.store.maps import add_map, find_map, keep_model, list_maps
from sceneprint.store.tables import FrameRow
from sceneprint_client.api import Frame, FrameMeta, FrameState, Map, NewMap
from sceneprint_client.api.frames import ROS_NAMES
from sceneprint_client.api.listing import FrameEdit, MapEdit

#: Fields of a new map that say what it may hold, and for how long.
LIMITS = frozenset(("quota_frames", "quota_bytes", "retention_days"))


def create_map(store: Store, new: NewMap) -> tuple[Map, bool]:
    """Make a map, or find that it is there as wanted.

    Returns
    -------
    made : the map
    new : False where it was there

    Raises
    ------
    MapExists : there is one of that name with another title, model, quota, retention or up.
    """
    model = read_model(new.model)
    limits: dict[str, Any] = new.model_dump(include=set(LIMITS & new.model_fields_set))
    if new.up is not None:
        limits["up"] = new.up.unit
    with store.database.write() as connection:
        there = {row.name: row for row in list_maps(connection)}.get(new.name)
        if there is None:
            keep_model(connection, model.id, model.name, write_model(model))
            row = add_map(connection, new.name, new.title, model.id, limits)
            return serializers.map_record(connection, row), True
        other = any(getattr(there, name) != value for name, value in limits.items())
        if other or (there.title, there.model_id) != (new.title, model.id):
            raise errors.MapExists(
                f"Map {new.name!r} already exists with a different title, model, limits or up. Use "
                "it as it is, delete it, or choose another name."
            )
        return serializers.map_record(connection, there), False


# Metadata of frames and maps, edited by a JSON merge patch (RFC 7396).
#
# frame, patch  --edited-->  its columns as they shall be  --edit_frame-->  frame

#: Columns of each field that can be edited.
_COLUMNS = {
    "robot": ("robot",),
    "session": ("session",),
    "captured_at": ("captured_at",),
    "tags": ("tags",),
    "pose": ("pose_parent", "pose"),
    "T_base_sensor": ("base_frame", "base"),
    "up": ("up",),
    "name": ("name",),
    "sequence": ("sequence",),
}
_CONTENT = (
    "intrinsics", "depth_scale", "depth_along_ray", "viewpoint", "units_per_metre", "format",
)  # fmt: skip
#: Ways to give a transform.
_WAYS = ("translation", "rotation", "matrix", *ROS_NAMES)


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
            raise errors.UnknownFrame(f"Frame {frame.id} of map {row.name!r} was deleted before.")
        _check_tag(f"Frame {frame.id}", serializers.frame_tag(frame), if_match)
        now = write_frame(connection, row, frame, edited(frame, patch))
        return serializers.frame_records(connection, row, [now])[0]


def edit_map(
    store: Store, map_name: str, patch: Mapping[str, Any],
    if_match: Collection[str] | None = None, *, dry_run: bool = False,
) -> Map:  # fmt: skip
    """Change title, limits and up of a map; parameters and errors as of `edit_frame`.

    Who may set a quota, the caller has seen to. With `dry_run` nothing is changed, and the map told
    as it would be.
    """
    try:
        change = MapEdit.model_validate(dict(patch))
    except ValidationError as error:
        raise _invalid(error, "The edit of the map") from error
    values = change.model_dump(include=change.model_fields_set)
    if change.up is not None:
        values["up"] = change.up.unit
    with store.database.read() if dry_run else store.database.write() as connection:
        row = find_map(connection, map_name)
        _check_tag(f"Map {row.name!r}", serializers.map_tag(row), if_match)
        if dry_run:
            return serializers.map_record(connection, replace(row, **values))
        return serializers.map_record(connection, write_map(connection, row, values))


def edited(frame: FrameRow, patch: Mapping[str, Any]) -> dict[str, Any]:
    """Columns of a frame as a patch wants them; those that it does not touch are left out.

    Raises
    ------
    InvalidRequest, InvalidPose : see `edit_frame`.
    """
    meta = _merged(frame, patch)
    if meta.pose is not None and meta.pose.of != "sensor":
        raise errors.InvalidRequest(
            "The edited pose is that of the base. Give that of the sensor, and leave `of` out.",
            (("pose.of", "an edited pose is that of the sensor"),),
        )
    pose = None if meta.pose is None else serializers.pose_matrix(meta.pose)
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
        "captured_at": serializers.when(frame.captured_at),
        "tags": frame.tags,
        "pose": _relative_transform(frame.pose, "parent_frame", frame.pose_parent),
        "T_base_sensor": _relative_transform(frame.base, "base_frame", frame.base_frame),
        "up": frame.up,
        "name": frame.name,
        "sequence": frame.sequence,
    }
    for field, given in patch.items():
        is_transform = field in ("pose", "T_base_sensor") and isinstance(given, Mapping)
        now[field] = _with(now[field], given) if is_transform else given
    wanted = {name: value for name, value in now.items() if value is not None}
    try:
        return FrameMeta.model_validate({"intrinsics": frame.intrinsics, **wanted})
    except ValidationError as error:
        raise _invalid(error, "The edit of the frame") from error


def _relative_transform(
    matrix: list[list[float]] | None, name: str, frame: str | None
) -> dict[str, Any] | None:
    return None if matrix is None else {name: frame, "matrix": matrix}


def _with(now: Mapping[str, Any] | None, given: Mapping[str, Any]) -> dict[str, Any]:
    """A transform after a patch; it is given in one way, so the other one goes."""
    given = {ROS_NAMES.get(name, name): value for name, value in given.items()}
    kept = dict(now or {})
    if "matrix" in kept and ("translation" in given or "rotation" in given):
        T = serializers.transform(np.array(kept.pop("matrix")), "", "")
        kept |= {"translation": T.translation.model_dump(), "rotation": T.rotation.model_dump()}
    merged = {**kept, **given}
    return {name: value for name, value in merged.items() if value is not None}


def _check_fields(patch: Mapping[str, Any]) -> None:
    for name in patch:
        if name in _CONTENT:
            raise errors.InvalidRequest(
                f"`{name}` is part of the identity of the frame and cannot be edited. Delete the "
                "frame, and upload it again with the right value.",
                ((name, "cannot be edited"),),
            )
        if name not in FrameEdit.model_fields:
            raise errors.InvalidRequest(
                f"The edit of the frame has an unknown field {name!r:.80}. Its fields are "
                f"{', '.join(FrameEdit.model_fields)}.",
                ((name[:80], "unknown"),),
            )


def _check_tag(what: str, tag: str, if_match: Collection[str] | None) -> None:
    if if_match is not None and tag not in if_match:
        raise errors.PreconditionFailed(
            f'{what} was edited after you read it: its ETag is now "{tag}". Read it again, and '
            "send the edit with the new ETag in If-Match."
        )


def _invalid(error: ValidationError, what: str) -> errors.InvalidRequest:
    found = tuple(
        (".".join(str(part) for part in one["loc"])[:80], one["msg"].removeprefix("Value error, "))
        for one in error.errors(include_url=False, include_input=False)[:20]
    )
    told = "; ".join(f"{place or 'it'}: {reason}" for place, reason in found[:3])
    return errors.InvalidRequest(f"{what} is not valid: {told}. See /docs.", found)
