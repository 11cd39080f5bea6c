"""What of a frame and of a map can be edited: JSON merge patches (RFC 7396)."""

from __future__ import annotations

from typing import Annotated

from pydantic import AwareDatetime, Field

from sceneprint.schemas.base import Given, Label, Note
from sceneprint.schemas.frames import GivenBase, GivenPose
from sceneprint.schemas.maps import Days, Quota


class FrameEdit(Given):
    """What to change of a frame: what is left out stays, null removes.

    Samples, camera and how they are read are what a frame is, and cannot be edited: delete it and
    upload it again.
    """

    robot: Label | None = Field(default=None, description="Who took the frame.")
    session: Label | None = Field(
        default=None,
        description="In which run. The parent frame of a pose that was named after it stays.",
    )
    captured_at: AwareDatetime | None = Field(default=None, description="When, with its zone.")
    tags: Annotated[list[Label], Field(max_length=32)] | None = Field(
        default=None, description="All of them: they are replaced together."
    )
    pose: GivenPose | None = Field(
        default=None,
        description="T_parent_sensor. `parent_frame` alone renames it; `translation` or "
        "`rotation` alone leave the other; each of them is replaced as a whole.",
    )
    T_base_sensor: GivenBase | None = Field(
        default=None, description="Where the sensor sits on the robot; parts of it as of `pose`."
    )


class MapEdit(Given):
    """What to change of a map: what is left out stays, null removes."""

    title: Note | None = Field(default=None, description="For people.")
    quota_frames: Quota | None = Field(
        default=None,
        description="Most frames that it may hold; what is there beyond it stays. Only the "
        "operator sets it: `admin` for `*`.",
    )
    quota_bytes: Quota | None = Field(
        default=None, description="Most bytes of uploads that it may hold; as `quota_frames`."
    )
    retention_days: Days | None = Field(
        default=None,
        description="Days after which a frame is deleted, for good, counted from when it was "
        "received. Workers delete what is older within minutes.",
    )


#: Fields of a map that are not its own administrators' to set, but the operator's.
OPERATORS = frozenset(("quota_frames", "quota_bytes"))
