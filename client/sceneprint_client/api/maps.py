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
_INHERITED = "left out: as a map of this name had that was deleted."


class NewMap(Given):
    """A map to make."""

    name: Slug = Field(
        description="Lower-case letters, digits, - and _, up to 63; never changes.",
        examples=["warehouse-2"],
    )
    title: Note | None = Field(default=None, description="For people.")
    model: Preset = Field(
        default="depth",
        description="The model that signs its frames, until `sceneprint reencode` changes it: "
        "`depth` for depth cameras indoors, `lidar` for the ranges of a LiDAR, `paper` for "
        "research: it stores the long signatures of the paper and compares them all.",
    )
    quota_frames: Quota | None = Field(
        default=None,
        description="Most frames that it may hold; null: as many as there is room for; "
        f"{_INHERITED} Only the operator sets it: `admin` for `*`.",
    )
    quota_bytes: Quota | None = Field(
        default=None,
        description="Maximum bytes of uploads: frames as they were sent, and archives until their "
        "imports end; as `quota_frames`.",
    )
    retention_days: Days | None = Field(
        default=None,
        description="Days after which a frame is deleted, counted from when it was received; "
        "null: never.",
    )
    up: Up | None = Field(
        default=None,
        description="Up in the parent frames of its poses, (0, 0, 1) where z points up: what a "
        "frame with a pose and no `up` of its own has. Null: learnt from frames that have both.",
    )


class Reencoding(ApiRecord):
    """How far a map has come that is being signed with another model."""

    model: str = Field(description="Name and first digits of the id of the model to come.")
    model_id: str
    done: int = Field(description="Frames that it has signed.")
    left: int = Field(description="Frames that wait for it.")
    failed: int = Field(
        description="Frames in which it finds nothing to sign: rejected at the switch."
    )
    dead: int = Field(
        description="Frames whose jobs broke down in every try: the switch waits until they are "
        "tried again or deleted."
    )


class Map(ApiRecord):
    """A namespace of frames that share one model."""

    name: str
    title: str | None
    model: str = Field(description="Name and first digits of the id of its model.")
    model_id: str
    reencoding: Reencoding | None = Field(
        default=None, description="Where the map is on its way to another model."
    )
    created_at: datetime
    revision: int = Field(description="Grows with every frame that is indexed or deleted.")
    frames: dict[str, int] = Field(description="How many frames are in each state.")
    posed_frames: int = Field(
        default=0, description="Indexed frames with a pose. Without any, answers have no pose."
    )
    parent_frames: int = Field(
        default=0,
        description="Parent frames of these poses. More than one: answers are in that of their "
        "matches, until an association joins them.",
    )
    used_frames: int = Field(
        default=0, description="Frames that count for the quota: neither deleted nor redundant."
    )
    used_bytes: int = Field(
        default=0,
        description="Bytes of their uploads as they were sent, and of archives that are being "
        "imported; not of signatures, artifacts and indexes.",
    )
    quota_frames: int | None = Field(default=None, description="Null: no quota.")
    quota_bytes: int | None = Field(default=None, description="Null: no quota.")
    retention_days: float | None = Field(
        default=None, description="Days after which a frame is deleted; null: never."
    )
    up: Direction | None = Field(
        default=None,
        description="Up in the parent frames of its poses; null: learnt from its frames.",
    )
    overdue: int | None = Field(
        default=None,
        description="Frames that are older, and deleted next; null without `retention_days`.",
    )
    etag: str | None = Field(
        default=None,
        description="Stands for what PATCH can change: sent in If-Match, with quotes around it, "
        "it keeps an edit from overwriting another.",
    )
