"""Which frames of a map a list has, the sessions of a map, and the trajectory of one."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import AwareDatetime, BeforeValidator, Field

from sceneprint.schemas.base import Given, Label, Told
from sceneprint.schemas.states import FrameState


def _one_or_many(given: object) -> object:
    return [given] if isinstance(given, str) else given


#: One name or several, as a query string repeats them.
_Names = Annotated[list[Label], BeforeValidator(_one_or_many), Field(max_length=100)]


class FrameListing(Given):
    """Which frames a list has; all that is given must hold.

    A frame that lacks what a condition asks about, such as a time, is left out.
    """

    state: FrameState | None = Field(
        default=None, description="In this state; by default in any but `deleted`."
    )
    robot: _Names = Field(default=[], description="Taken by this one; repeated: by one of them.")
    session: _Names = Field(default=[], description="Taken in this one; repeated: in one of them.")
    tag: _Names = Field(default=[], description="It has this tag; repeated: all of them.")
    captured_after: AwareDatetime | None = Field(
        default=None, description="Taken then, or later; with a time zone."
    )
    captured_before: AwareDatetime | None = Field(default=None, description="Then, or earlier.")
    received_after: AwareDatetime | None = Field(
        default=None, description="Uploaded then, or later."
    )
    received_before: AwareDatetime | None = Field(default=None, description="Then, or earlier.")
    parent_frame: Label | None = Field(default=None, description="Its pose leads there.")
    has_pose: bool | None = Field(default=None, description="Whether it has a pose.")
    content_id: Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")] | None = Field(
        default=None, description="Of its samples and camera."
    )
    order: Literal["asc", "desc"] = Field(
        default="asc", description="As they came; `desc`: the newest first."
    )


class FramePage(FrameListing):
    """A part of a list of frames."""

    cursor: str | None = Field(default=None, description="`next_cursor` of the page before.")
    limit: Annotated[int, Field(ge=1, le=1000)] = 100


class Session(Told):
    """What one robot took in one run."""

    robot: str | None
    session: str | None
    frames: dict[str, int] = Field(description="How many are in each state that has any.")
    with_pose: int = Field(description="How many of them have a pose.")
    first_captured_at: datetime | None
    last_captured_at: datetime | None
    parent_frames: list[str] = Field(
        description="Where their poses lead, at most 20: those of most frames first."
    )


class Run(Given):
    """Whose poses a trajectory has."""

    session: Label = Field(description="Of the frames.")
    robot: Label | None = Field(
        default=None, description="Needed where several robots called a run so."
    )
    parent_frame: Label | None = Field(
        default=None, description="Needed where the poses lead to several."
    )
    captured_after: AwareDatetime | None = Field(
        default=None, description="A part of it: taken then, or later; with a time zone."
    )
    captured_before: AwareDatetime | None = Field(default=None, description="Then, or earlier.")
    most: Annotated[int, Field(ge=2, le=10_000)] | None = Field(
        default=None,
        description="At most so many poses, evenly taken along the run, the first and the last "
        "among them. A run may then be of any length.",
    )
    clock: Literal["captured", "received"] = Field(
        default="captured",
        description="By which time: `received`, in the order in which frames came, has those too "
        "that do not say when they were taken.",
    )


class Trajectory(Told):
    """The poses of one run, in the order of time."""

    map: str
    session: str
    robot: str | None
    parent_frame: str | None = Field(
        description="Where the poses lead; null where no frame of the run has one."
    )
    child_frame: str = Field(
        default="optical",
        description="Of each camera: x right, y down, z forward; of a cloud, its sensor's.",
    )
    frame_ids: list[str]
    poses: list[list[float]] = Field(
        description="A row for each frame, as in a TUM file: t tx ty tz qx qy qz qw, seconds "
        "since 1970 by the clock that was asked for, metres, unit quaternion."
    )
    posed: int = Field(
        description="Poses that there are: as many as are told, or more where `most` was given."
    )
    left_out: int = Field(
        description="Frames of the run that are not in it: without pose or time, with a pose that "
        "leads elsewhere, of a time that is there already, or one too many for `most`."
    )
