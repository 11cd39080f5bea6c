"""Who an upload is: the frame that is there, a frame of its own, or a contradiction."""

from __future__ import annotations

from typing import Any

from sqlalchemy import Connection

from sceneprint.errors import FrameConflict
from sceneprint.schemas import FrameState
from sceneprint.store.frames import frames_of_content, living_frame
from sceneprint.store.records import FrameRow, MapRow

#: What to call a column when it differs.
_FIELDS = {
    "pose_parent": "pose.parent_frame", "base": "T_base_sensor", "content_id": "content",
    "cloud": "units_per_metre",
}  # fmt: skip


def standing(
    connection: Connection, row: MapRow, content: str, known: dict[str, Any],
    frame_id: str | None = None,
) -> FrameRow | None:  # fmt: skip
    """The frame that an upload is of; None where the map has none yet.

    Parameters
    ----------
    connection : of the database
    row : of the map
    content : of the upload
    known : its metadata, by column
    frame_id : that the caller wants for it; None: any frame of that content is it

    Raises
    ------
    FrameConflict : there is one, with other content or metadata.
    """
    if frame_id is not None:
        frame = living_frame(connection, row.number, frame_id)
        if frame is None:
            return None
        differing = _differing(frame, {"content_id": content, **known})
        if differing:
            raise FrameConflict(
                f"Frame {frame.id} of map {row.name} has other {', '.join(differing)}. Delete it "
                "first, send it as it was, or under another id."
            )
        return frame
    found = frames_of_content(connection, row.number, content)
    for frame in found:
        if not _differing(frame, known):
            return frame
    if found:
        raise FrameConflict(
            f"Frame {found[0].id} has the same content, but other "
            f"{', '.join(_differing(found[0], known))}. A frame is in a map once: delete that one "
            "first, send it as it was, or PUT it under an id of its own."
        )
    return None


def _differing(frame: FrameRow, known: dict[str, Any]) -> list[str]:
    return [
        _FIELDS.get(name, name)
        for name, value in known.items()
        if _said(name, getattr(frame, name)) != _said(name, value)
    ]


def _said(name: str, value: Any) -> Any:
    """What of a column the caller has said: not how a cloud was packed, nor what was found in it.

    Its viewpoint is part of its content.
    """
    return value["units_per_metre"] if name == "cloud" and value is not None else value


def being_signed(state: FrameState) -> bool:
    """Whether a frame waits for a worker, or has one."""
    return state in (FrameState.RECEIVED, FrameState.SIGNING)


def is_tried_again(state: FrameState) -> bool:
    """Whether an upload of the same gives a frame another try.

    It broke down every time, or was near to a frame that may be gone since.
    """
    return state in (FrameState.FAILED, FrameState.REDUNDANT)
