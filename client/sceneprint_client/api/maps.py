"""Maps as JSON."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated

from pydantic import AfterValidator, Field, StringConstraints, WithJsonSchema

from sceneprint_client.api.base import MAP_NAME, ApiRecord, Direction, Given, Note, Up

#: Names of the models that ship with the service, the default first.
PRESETS = ("depth", "lidar", "paper")
#: A map's name: an immutable slug.
Slug = Annotated[str, StringConstraints(pattern=MAP_NAME)]


def _shipped(name: str) -> str:
    if name not in PRESETS:
        *most, last = map(repr, PRESETS)
        raise ValueError(f"Input should be {', '.join(most)} or {last}")  # as pydantic says it
    return name


#: A model that ships with the package.
Preset = Annotated[
    str, AfterValidator(_shipped), WithJsonSchema({"type": "string", "enum": list(PRESETS)})
]


#: Most that a quota can say: JavaScript knows no larger whole number.
MOST_QUOTA = 2**53 - 1
#: Longest retention, days: a hundred years.
MOST_DAYS = 36_525.0
Quota = Annotated[int, Field(ge=0, le=MOST_QUOTA)]
Days = Annotated[float, Field(gt=0, le=MOST_DAYS)]
_INHERITED = "omitted: the quota of a deleted map of this name."


class NewMap(Given):
    """A map to create."""

    name: Slug = Field(
        description="Lower-case letters, digits, - and _, at most 63; it cannot be changed.",
        examples=["warehouse-2"],
    )
    title: Note | None = Field(default=None, description="A label for people.")
    model: Preset = Field(
        default="depth",
        description="Model that signs its frames, until `sceneprint reencode` changes it: "
        "`depth` for depth cameras indoors, `lidar` for LiDAR scanners, `paper` for research, "
        "which stores the long signatures of the paper and compares all of them.",
    )
    quota_frames: Quota | None = Field(
        default=None,
        description="Maximum number of frames; null: no limit; "
        f"{_INHERITED} Only the operator sets it: `admin` for `*`.",
    )
    quota_bytes: Quota | None = Field(
        default=None,
        description="Maximum size of uploads, bytes: frames as they were sent, and archives "
        "until their imports end; see `quota_frames`.",
    )
    retention_days: Days | None = Field(
        default=None,
        description="Days after which a frame is deleted, counted from when it was received; "
        "null: never.",
    )
    up: Up | None = Field(
        default=None,
        description="Up direction in the parent frames of its poses, (0, 0, 1) if z points up, "
        "for frames with a pose but without `up`. Null: estimated from frames that have both.",
    )


class Reencoding(ApiRecord):
    """The progress of a map's switch to another model."""

    model: str = Field(description="Name and first digits of the next model's id.")
    model_id: str
    done: int = Field(description="Number of frames that it has signed.")
    left: int = Field(description="Number of frames that wait.")
    failed: int = Field(
        description="Number of frames without anything to sign, which are rejected at the switch."
    )
    dead: int = Field(
        description="Number of frames whose jobs failed in every attempt: the switch waits "
        "until they are tried again or deleted."
    )


class Map(ApiRecord):
    """A namespace of frames that share one model."""

    name: str
    title: str | None
    model: str = Field(description="Name and first digits of the id of its model.")
    model_id: str
    reencoding: Reencoding | None = Field(
        default=None, description="Progress of a switch to another model."
    )
    created_at: datetime
    revision: int = Field(description="Increases with every frame that is indexed or deleted.")
    frames: dict[str, int] = Field(description="Number of frames in each state.")
    posed_frames: int = Field(
        default=0,
        description="Number of indexed frames with a pose. Without any, answers have no pose.",
    )
    parent_frames: int = Field(
        default=0,
        description="Parent frames of these poses. If there are several, answers are in that of "
        "their matches, until an association joins them.",
    )
    used_frames: int = Field(
        default=0,
        description="Number of frames that count towards the quota: neither deleted nor redundant.",
    )
    used_bytes: int = Field(
        default=0,
        description="Size of its uploads as they were sent, and of archives that are being "
        "imported; without signatures, artifacts and indexes.",
    )
    quota_frames: int | None = Field(default=None, description="Null without a quota.")
    quota_bytes: int | None = Field(default=None, description="Null without a quota.")
    retention_days: float | None = Field(
        default=None, description="Days after which a frame is deleted; null: never."
    )
    up: Direction | None = Field(
        default=None,
        description="Up direction in the parent frames of its poses; null: estimated from its "
        "frames.",
    )
    overdue: int | None = Field(
        default=None,
        description="Number of frames older than `retention_days`, which are deleted next; null "
        "without that.",
    )
    etag: str | None = Field(
        default=None,
        description="Version of what PATCH can change. Sent in If-Match, in quotes, it prevents "
        "an edit from overwriting another.",
    )
