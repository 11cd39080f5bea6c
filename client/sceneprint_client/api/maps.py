"""Records of maps."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

from pydantic import AfterValidator, Field, StringConstraints, WithJsonSchema

from sceneprint_client.api.base import MAP_NAME, ApiRecord, Direction, Given, Note, Up

#: Names of the models that the service contains, the default first.
PRESETS = ("depth", "lidar", "paper")
#: Name of a map; it cannot be changed.
Slug = Annotated[str, StringConstraints(pattern=MAP_NAME)]


def _require_preset(name: str) -> str:
    if name not in PRESETS:
        *most, last = map(repr, PRESETS)
        raise ValueError(f"Input should be {', '.join(most)} or {last}")  # pydantic's wording
    return name


#: Name of a model that the service contains.
Preset = Annotated[
    str, AfterValidator(_require_preset), WithJsonSchema({"type": "string", "enum": list(PRESETS)})
]


#: Maximum value of a quota: the largest integer that JavaScript represents exactly.
MOST_QUOTA = 2**53 - 1
#: Maximum retention, days: a hundred years.
MOST_DAYS = 36_525.0
Quota = Annotated[int, Field(ge=0, le=MOST_QUOTA)]
Days = Annotated[float, Field(gt=0, le=MOST_DAYS)]
_INHERITED = "If omitted, a map keeps the quota of a deleted map with the same name."


class NewMap(Given):
    """A map to create."""

    name: Slug = Field(
        description="Name of the map, with at most 63 lower-case letters, digits, hyphens and "
        "underscores. It cannot be changed later.",
        examples=["warehouse-2"],
    )
    title: Note | None = Field(default=None, description="Human-readable title.")
    model: Preset = Field(
        default="depth",
        description="Model that signs the frames; it can be changed later with `sceneprint "
        "reencode`. `depth` is for depth cameras indoors, and `lidar` for LiDAR scanners. `paper` "
        "is for research; it stores the long signatures of the paper and compares all of them.",
    )
    quota_frames: Quota | None = Field(
        default=None,
        description=f"Maximum number of frames; null: no limit. {_INHERITED} Setting it requires "
        "`admin` for `*`.",
    )
    quota_bytes: Quota | None = Field(
        default=None,
        description="Maximum size of the uploads as received, bytes, including archives until "
        "their imports end; see `quota_frames`.",
    )
    retention_days: Days | None = Field(
        default=None,
        description="Time after the upload at which a frame is permanently deleted, days; null if "
        "frames do not expire.",
    )
    up: Up | None = Field(
        default=None,
        description="Up direction in the parent frames of the poses, such as (0, 0, 1) if z points "
        "up. It applies to frames that have a pose but no `up`. If null, the service estimates it "
        "from frames with both.",
    )


class Reencoding(ApiRecord):
    """The progress of a map's switch to another model."""

    model: str = Field(description="Label of the next model (name and first digits of its id).")
    model_id: str
    done: int = Field(description="Number of frames signed with the next model.")
    left: int = Field(description="Number of frames that still have to be signed.")
    failed: int = Field(
        description="Number of frames that the next model cannot sign; the switch rejects them."
    )
    dead: int = Field(
        description="Number of frames whose jobs failed in every attempt. The switch waits until "
        "they are retried or deleted."
    )


class Map(ApiRecord):
    """A namespace of frames that share one model."""

    name: str
    title: str | None
    model: str = Field(description="Label of the model (name and first digits of its id).")
    model_id: str
    reencoding: Reencoding | None = Field(
        default=None,
        description="Progress of the switch to another model; null if there is no switch.",
    )
    created_at: datetime
    revision: int = Field(
        description="Counter that increases with each frame that is indexed or deleted."
    )
    frames: dict[str, int] = Field(description="Number of frames in each state.")
    posed_frames: int = Field(
        default=0,
        description="Number of indexed frames with a pose. If it is 0, answers have no pose.",
    )
    parent_frames: int = Field(
        default=0,
        description="Number of parent frames of the poses. If there are several, answers use the "
        "parent frame of their matches until an association joins the parent frames.",
    )
    recent_queries: dict[str, int] = Field(
        default={},
        description="Number of queries in the last hour by status, including `failed`. Queries "
        "whose `record` is false do not count.",
    )
    used_frames: int = Field(
        default=0,
        description="Number of frames that count towards the quota (all except deleted and "
        "redundant frames).",
    )
    used_bytes: int = Field(
        default=0,
        description="Size of the uploads as received and of archives during their import, "
        "excluding signatures, artifacts and indexes.",
    )
    quota_frames: int | None = Field(
        default=None, description="Maximum number of frames; null if there is no quota."
    )
    quota_bytes: int | None = Field(
        default=None, description="Maximum size of the uploads, bytes; null if there is no quota."
    )
    retention_days: float | None = Field(
        default=None,
        description="Time after the upload at which a frame is permanently deleted, days; null if "
        "frames do not expire.",
    )
    up: Direction | None = Field(
        default=None,
        description="Up direction in the parent frames of the poses; null if it is estimated from "
        "the frames.",
    )
    overdue: int | None = Field(
        default=None,
        description="Number of frames that are older than `retention_days` and will be deleted "
        "next; null if frames do not expire.",
    )
    etag: str | None = Field(
        default=None,
        description="Entity tag of the editable fields. Send it in If-Match, in quotes, so that "
        "your edit does not overwrite another edit.",
    )
