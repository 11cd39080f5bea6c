"""Entity tags: short texts that change when what they stand for does."""

from __future__ import annotations

import hashlib
import json

from sceneprint.store.records import FrameRow, MapRow

#: Columns of a frame that can be edited.
EDITABLE = (
    "robot", "session", "captured_at", "tags", "pose_parent", "pose", "base_frame", "base",
)  # fmt: skip


def tag_of(*parts: object) -> str:
    """32 digits of what can be told as JSON: the same for the same parts."""
    told = json.dumps(parts, sort_keys=True)
    return hashlib.sha256(told.encode()).hexdigest()[:32]


def frame_tag(frame: FrameRow) -> str:
    """Stands for all of a frame that can be edited."""
    return tag_of("frame", [getattr(frame, name) for name in EDITABLE])


def map_tag(row: MapRow) -> str:
    """Stands for all of a map that can be edited."""
    limits = row.quota_frames, row.quota_bytes, row.retention_days
    # as it was where there are none: a tag that somebody holds outlives the upgrade
    return tag_of("map", row.name, row.title, *(() if limits == (None,) * 3 else limits))
