"""Which frames of a map a list or a selection has, its sessions, and the trajectory of one."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import (
    AwareDatetime,
    BeforeValidator,
    Field,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import from_json

from sceneprint_client.api.base import (
    DIGEST,
    MOST_OF_NAME,
    MOST_TAGS,
    ONE_LINE,
    ApiRecord,
    FileName,
    FrameState,
    Given,
    GivenBase,
    GivenPose,
    GivenVector,
    Label,
    Note,
    Place,
    Up,
)
from sceneprint_client.api.maps import Days, Quota


def _one_or_many(given: object) -> object:
    return [given] if isinstance(given, str) else given


#: One name or several, as a query string repeats them.
_Names = Annotated[list[Label], BeforeValidator(_one_or_many), Field(max_length=100)]


#: The beginning of a name.
_Prefix = Annotated[str, Field(min_length=1, max_length=MOST_OF_NAME, pattern=ONE_LINE)]


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
    content_id: Annotated[str, Field(pattern=DIGEST)] | None = Field(
        default=None, description="Of its samples and camera."
    )
    name: _Prefix | None = Field(default=None, description="Its name begins so; case matters.")
    find: _Prefix | None = Field(
        default=None, description="Its id, its name or its session begins so; case matters."
    )
    order: Literal["asc", "desc", "taken"] = Field(
        default="asc",
        description="As they came; `desc`: the newest first; `taken`, of one session: by "
        "`captured_at`, those without by `sequence`, the rest as they came.",
    )

    @field_validator("order")
    @classmethod
    def _of_one_session(cls, order: str, info: ValidationInfo) -> str:
        if order == "taken" and len(info.data.get("session", [None])) != 1:
            raise ValueError("`taken` is the order of one session; name it with `session`")
        return order


class FramePage(FrameListing):
    """A part of a list of frames."""

    cursor: str | None = Field(default=None, description="`next_cursor` of the page before.")
    limit: Annotated[int, Field(ge=1, le=1000)] = 100


class Session(ApiRecord):
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
    tags: list[str] = Field(
        default=[], description="Of their frames, at most 20: those of most frames first."
    )


#: By what poses are stamped.
Stamp = Literal["captured", "sequence", "received"]
#: How to choose it.
Clock = Literal["taken", "captured", "sequence", "received"]


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
    clock: Clock = Field(
        default="taken",
        description="By what poses are stamped: `captured_at`; `sequence`; `received`, in the "
        "order in which frames came, which every frame has. `taken`: by `captured_at`, and where "
        "no frame with a pose has one, by `sequence`.",
    )


class Trajectory(ApiRecord):
    """The poses of one run, in the order of their stamps."""

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
        description="A row for each frame, as in a TUM file: t tx ty tz qx qy qz qw, stamp as "
        "`stamps` says, metres, unit quaternion."
    )
    stamps: Stamp | None = Field(
        default=None,
        description="What t is: `captured` and `received` in seconds since 1970, or `sequence`, "
        "places in the session. Null where no pose has a stamp.",
    )
    posed: int = Field(
        description="Poses that there are: as many as are told, or more where `most` was given."
    )
    left_out: int = Field(
        description="Frames of the run that are not in it: without pose or stamp, with a pose that "
        "leads elsewhere, of a stamp that is there already, or one too many for `most`."
    )
    reason: str | None = Field(default=None, description="Why there is no pose; else null.")


# Which frames of a map a query may find, as JSON.


def parsed(given: object) -> object:
    """What a form gives as text, as JSON has it.

    Raises
    ------
    ValueError : a text that is no JSON.
    """
    if not isinstance(given, str):
        return given
    try:
        return from_json(given)
    except ValueError as error:
        raise ValueError(f"not JSON ({error}); a form has an object as JSON text") from error


_Several = Annotated[list[Label], Field(min_length=1, max_length=100)]
#: One name, or several of which any will do.
Names = Annotated[_Several, BeforeValidator(_one_or_many, json_schema_input_type=Label | _Several)]


class Region(Given):
    """A box along the axes of the frame that poses lead to; its faces belong to it."""

    parent_frame: Label = Field(
        description="Frames whose pose leads to another frame, or that have none, are outside."
    )
    min: GivenVector
    max: GivenVector

    @field_validator("max")
    @classmethod
    def _above_min(cls, corner: GivenVector, info: ValidationInfo) -> GivenVector:
        least = info.data.get("min")
        wrong = [
            axis
            for axis in "xyz"
            if least is not None and getattr(corner, axis) < getattr(least, axis)
        ]
        if wrong:
            raise ValueError(f"{', '.join(wrong)}: less than in `min`")
        return corner


class Filter(Given):
    """What a frame must be for a query to find it; all that is given must hold.

    A frame that lacks what a condition asks about, such as a time, does not pass it.
    """

    robot: Names | None = Field(default=None, description="Taken by this one, or one of these.")
    session: Names | None = Field(default=None, description="Taken in this one, or one of these.")
    captured_after: AwareDatetime | None = Field(default=None, description="Then, or later.")
    captured_before: AwareDatetime | None = Field(default=None, description="Then, or earlier.")
    tags: list[Label] = Field(default=[], max_length=MOST_TAGS, description="It has all of them.")
    not_within_s: float | None = Field(
        default=None,
        gt=0,
        description="Leaves out frames of the query's own session taken at most so many seconds "
        "before or after it: for loop closure. Those of the session without a time are left out "
        "too; a session is another's where both name robots and the robots differ.",
    )
    region: Region | None = Field(default=None, description="Its pose lies in there.")
    exclude_frames: list[Label] = Field(
        default=[], max_length=1000, description="It is none of these ids."
    )

    @field_validator("captured_before")
    @classmethod
    def _not_earlier(cls, before: datetime | None, info: ValidationInfo) -> datetime | None:
        after: Any = info.data.get("captured_after")
        if before is not None and after is not None and before < after:
            raise ValueError("earlier than `captured_after`")
        return before


# What of a frame and of a map can be edited: JSON merge patches (RFC 7396).


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
    name: FileName | None = Field(default=None, description="Of the original file or message.")
    sequence: Place | None = Field(default=None, description="Place within the session.")
    tags: Annotated[list[Label], Field(max_length=MOST_TAGS)] | None = Field(
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
    up: Up | None = Field(default=None, description="Up in the sensor's axes.")


class SessionEdit(Given):
    """What to change on all frames of a session: what is left out stays."""

    session: Label | None = Field(
        default=None,
        description="Its new name; one that another session has joins the two. The parent frame "
        "of poses that was named after it stays.",
    )
    robot: Label | None = Field(default=None, description="Who took the frames.")
    add_tags: list[Label] = Field(default=[], max_length=MOST_TAGS)
    remove_tags: list[Label] = Field(default=[], max_length=MOST_TAGS)

    @model_validator(mode="after")
    def _changes_something(self) -> SessionEdit:
        if not (self.session or self.robot or self.add_tags or self.remove_tags):
            raise ValueError("name session, robot, add_tags or remove_tags")
        return self


class FrameDeletion(ApiRecord):
    """A deletion that can be undone."""

    deletion_id: str
    at: datetime
    until: datetime = Field(description="Until when its frames can be restored.")
    frames: int = Field(description="How many can be restored.")


class SessionChange(ApiRecord):
    """What became of a session."""

    map: str
    session: str = Field(description="Its name now.")
    robot: str | None = Field(description="Where the frames of one robot were asked for.")
    frames: int = Field(description="How many this call deleted or edited.")
    remaining: int = Field(
        default=0, description="How many are left as time was over: repeat the call for these."
    )
    last_frame_id: str | None = Field(
        default=None, description="Of an edit with frames remaining: send it as `after`."
    )
    deletion: FrameDeletion | None = Field(
        default=None, description="Of a deletion: how to undo this call, where that can be done."
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
    up: Up | None = Field(
        default=None, description="Up in the parent frames of its poses; see NewMap."
    )


#: Fields of a map that are not its own administrators' to set, but the operator's.
OPERATORS = frozenset(("quota_frames", "quota_bytes"))

# Frames chosen by their ids or by a filter, what to do with them, and deletions undone.

#: Frames that one request names, and that one request edits.
MOST_SELECTED = 1000
#: Frames that were not restored and are named with their reasons.
MOST_REFUSED = 100

_Ids = Annotated[list[Label], Field(min_length=1, max_length=MOST_SELECTED)]


class FrameSelection(Given):
    """Which frames of a map: by their ids, or all that pass a filter."""

    frame_ids: _Ids | None = Field(
        default=None, description="Ids that no frame has, or a deleted one, are passed over."
    )
    filter: FrameListing | None = Field(
        default=None,
        description="As for GET /frames, with at least one condition; `order` does not matter.",
    )

    @model_validator(mode="after")
    def _is_one(self) -> FrameSelection:
        if (self.frame_ids is None) == (self.filter is None):
            raise ValueError("give either `frame_ids` or `filter`")
        if self.filter is not None:
            if not self.filter.model_dump(exclude_defaults=True, exclude={"order"}):
                raise ValueError("`filter` has no condition, so it would select every frame")
            if self.filter.state == FrameState.DELETED:
                raise ValueError("deleted frames cannot be selected; restore them first")
        return self


class FramesEdit(FrameSelection):
    """What to change on the selected frames: what is left out stays, null removes."""

    session: Label | None = Field(
        default=None, description="Moves them to it. The parent frame of their poses stays."
    )
    robot: Label | None = Field(default=None, description="Who took them.")
    add_tags: list[Label] = Field(default=[], max_length=MOST_TAGS)
    remove_tags: list[Label] = Field(default=[], max_length=MOST_TAGS)
    after: Label | None = Field(
        default=None, description="`last_frame_id` of the call before, to go on from there."
    )

    @model_validator(mode="after")
    def _edits_something(self) -> FramesEdit:
        if not ({"session", "robot"} & self.model_fields_set or self.add_tags or self.remove_tags):
            raise ValueError("name session, robot, add_tags or remove_tags")
        return self


class FramesEdited(ApiRecord):
    """What an edit changed."""

    map: str
    frames: int = Field(description="How many this call changed; others were so already.")
    remaining: int = Field(
        description="How many are left, as a call edits at most 1000: repeat it with `after`."
    )
    last_frame_id: str | None = Field(
        default=None, description="Where frames remain: send it as `after`."
    )
    inverse: list[dict[str, Any]] = Field(
        description="Undo: send each as a body to the same path. They name the frames by their ids."
    )


class FramesDeleted(ApiRecord):
    """What a deletion did."""

    map: str
    frames: int = Field(description="How many this call deleted.")
    remaining: int = Field(description="How many are left as time was over: repeat the call.")
    deletion: FrameDeletion | None = Field(
        description="How to undo this call; null where it cannot be undone."
    )


class RefusedFrame(ApiRecord):
    """A frame that was not restored."""

    frame_id: str
    reason: str


class FramesRestored(ApiRecord):
    """What became of deleted frames."""

    map: str
    frames: int = Field(
        description="How many this call restored. Queries find those that were indexed at once, "
        "unless the map has another model since: then workers sign them again."
    )
    refused: list[RefusedFrame] = Field(
        description=f"Frames that were not restored, at most {MOST_REFUSED} of them: the same "
        "content was uploaded since."
    )
    remaining: int = Field(description="How many are left as time was over: repeat the call.")
