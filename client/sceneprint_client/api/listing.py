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
    """Conditions on the frames of a list; all of them must hold.

    A frame without the property of a condition, such as a time, is omitted.
    """

    state: FrameState | None = Field(
        default=None, description="In this state; by default in any state but `deleted`."
    )
    robot: _Names = Field(default=[], description="Taken by this robot; repeated: by one of them.")
    session: _Names = Field(
        default=[], description="Taken in this session; repeated: in one of them."
    )
    tag: _Names = Field(default=[], description="With this tag; repeated: with all of them.")
    captured_after: AwareDatetime | None = Field(
        default=None, description="Taken at this time or later; with a time zone."
    )
    captured_before: AwareDatetime | None = Field(
        default=None, description="Taken at this time or earlier."
    )
    received_after: AwareDatetime | None = Field(
        default=None, description="Uploaded at this time or later."
    )
    received_before: AwareDatetime | None = Field(
        default=None, description="Uploaded at this time or earlier."
    )
    parent_frame: Label | None = Field(
        default=None, description="With a pose in this parent frame."
    )
    has_pose: bool | None = Field(default=None, description="Whether it has a pose.")
    content_id: Annotated[str, Field(pattern=DIGEST)] | None = Field(
        default=None, description="Hash of its samples and camera."
    )
    name: _Prefix | None = Field(
        default=None, description="Its name starts with this text; case matters."
    )
    find: _Prefix | None = Field(
        default=None, description="Its id, name or session starts with this text; case matters."
    )
    order: Literal["asc", "desc", "taken"] = Field(
        default="asc",
        description="Default: in order of arrival; `desc`: the newest first; `taken`, of one "
        "session: by `captured_at`, frames without it by `sequence`, others in order of "
        "arrival.",
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
    """The frames of one robot in one run."""

    robot: str | None
    session: str | None
    frames: dict[str, int] = Field(description="Number of frames in each state.")
    with_pose: int = Field(description="Number of frames with a pose.")
    first_captured_at: datetime | None
    last_captured_at: datetime | None
    parent_frames: list[str] = Field(
        description="Parent frames of their poses, those with most frames first; at most 20."
    )
    tags: list[str] = Field(
        default=[], description="Tags of their frames, those with most frames first; at most 20."
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
    captured_before: AwareDatetime | None = Field(
        default=None, description="Taken at this time or earlier."
    )
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
        description="Parent frame of the poses; null if no frame of the run has one."
    )
    child_frame: str = Field(
        default="optical",
        description="Frame of each sensor: of a camera x right, y down, z forward; of a cloud, "
        "its sensor's.",
    )
    frame_ids: list[str]
    poses: list[list[float]] = Field(
        description="A row for each frame, as in a TUM file: t tx ty tz qx qy qz qw, with t "
        "according to `stamps`, metres, unit quaternion."
    )
    stamps: Stamp | None = Field(
        default=None,
        description="Meaning of t: `captured` and `received` in seconds since 1970, or "
        "`sequence`, positions in the session. Null if no pose has a stamp.",
    )
    posed: int = Field(description="Number of poses, including those beyond `most`.")
    left_out: int = Field(
        description="Number of frames of the run that are omitted: without pose or stamp, in "
        "another parent frame, with a duplicate stamp, or beyond `most`."
    )
    reason: str | None = Field(default=None, description="Why there is no pose; otherwise null.")


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
    """A box along the axes of a parent frame; it includes its faces."""

    parent_frame: Label = Field(
        description="Parent frame of the box. Frames with poses in another one, or without "
        "poses, are outside."
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
    """Conditions on the frames that a query may find; all of them must hold.

    A frame without the property of a condition, such as a time, does not pass.
    """

    robot: Names | None = Field(default=None, description="Taken by this robot, or one of these.")
    session: Names | None = Field(
        default=None, description="Taken in this session, or one of these."
    )
    captured_after: AwareDatetime | None = Field(
        default=None, description="Taken at this time or later."
    )
    captured_before: AwareDatetime | None = Field(
        default=None, description="Taken at this time or earlier."
    )
    tags: list[Label] = Field(
        default=[], max_length=MOST_TAGS, description="With all of these tags."
    )
    not_within_s: float | None = Field(
        default=None,
        gt=0,
        description="Excludes frames of the query's own session that were taken within this "
        "many seconds of it, for loop closure. Frames of the session without a time are "
        "excluded as well. A session of another robot, if both are named, is another session.",
    )
    region: Region | None = Field(default=None, description="With a pose in this region.")
    exclude_frames: list[Label] = Field(
        default=[], max_length=1000, description="Not one of these ids."
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
    """Changes to a frame: omitted fields stay, null removes a value.

    Samples, camera, and how they are read cannot be edited: delete the frame and upload it again.
    """

    robot: Label | None = Field(default=None, description="Robot that took the frame.")
    session: Label | None = Field(
        default=None,
        description="Name of the run. The parent frame of a pose that was named after the "
        "former session stays.",
    )
    captured_at: AwareDatetime | None = Field(
        default=None, description="Time of capture, with its time zone."
    )
    name: FileName | None = Field(default=None, description="Name of the original file or message.")
    sequence: Place | None = Field(default=None, description="Position in the session.")
    tags: Annotated[list[Label], Field(max_length=MOST_TAGS)] | None = Field(
        default=None, description="The complete list of tags, which replaces the former one."
    )
    pose: GivenPose | None = Field(
        default=None,
        description="T_parent_sensor. `parent_frame` alone renames it; `translation` or "
        "`rotation` alone leaves the other unchanged; each is replaced as a whole.",
    )
    T_base_sensor: GivenBase | None = Field(
        default=None,
        description="Pose of the sensor on the robot; its parts are edited like those of `pose`.",
    )
    up: Up | None = Field(default=None, description="Up direction in the sensor's axes.")


class SessionEdit(Given):
    """Changes to all frames of a session: omitted fields stay."""

    session: Label | None = Field(
        default=None,
        description="New name; the name of another session joins the two. The parent frame of "
        "poses that was named after the session stays.",
    )
    robot: Label | None = Field(default=None, description="Robot that took the frames.")
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
    until: datetime = Field(description="Time until which its frames can be restored.")
    frames: int = Field(description="Number of frames that can be restored.")


class SessionChange(ApiRecord):
    """The result of changing a session."""

    map: str
    session: str = Field(description="Present name of the session.")
    robot: str | None = Field(description="Robot, if the request named one.")
    frames: int = Field(description="Number of frames that this call deleted or edited.")
    remaining: int = Field(
        default=0,
        description="Number of frames that are left after the time limit: repeat the call.",
    )
    last_frame_id: str | None = Field(
        default=None, description="If frames remain after an edit: send it as `after`."
    )
    deletion: FrameDeletion | None = Field(
        default=None, description="The deletion, to undo this call, if it can be undone."
    )


class MapEdit(Given):
    """Changes to a map: omitted fields stay, null removes a value."""

    title: Note | None = Field(default=None, description="A label for people.")
    quota_frames: Quota | None = Field(
        default=None,
        description="Maximum number of frames; frames beyond it stay. Only the operator sets "
        "it: `admin` for `*`.",
    )
    quota_bytes: Quota | None = Field(
        default=None, description="Maximum size of its uploads, bytes; see `quota_frames`."
    )
    retention_days: Days | None = Field(
        default=None,
        description="Days after which a frame is deleted permanently, counted from when it was "
        "received. Workers delete older frames within minutes.",
    )
    up: Up | None = Field(
        default=None, description="Up direction in the parent frames of its poses; see NewMap."
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
    """A selection of a map's frames, by their ids or by a filter."""

    frame_ids: _Ids | None = Field(
        default=None, description="Ids of frames; unknown and deleted ones are ignored."
    )
    filter: FrameListing | None = Field(
        default=None,
        description="Conditions as for GET /frames, at least one; `order` is ignored.",
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
    """Changes to the selected frames: omitted fields stay, null removes a value."""

    session: Label | None = Field(
        default=None,
        description="Session to which the frames are moved. The parent frame of their poses stays.",
    )
    robot: Label | None = Field(default=None, description="Robot that took the frames.")
    add_tags: list[Label] = Field(default=[], max_length=MOST_TAGS)
    remove_tags: list[Label] = Field(default=[], max_length=MOST_TAGS)
    after: Label | None = Field(
        default=None, description="`last_frame_id` of the previous call, to continue from there."
    )

    @model_validator(mode="after")
    def _edits_something(self) -> FramesEdit:
        if not ({"session", "robot"} & self.model_fields_set or self.add_tags or self.remove_tags):
            raise ValueError("name session, robot, add_tags or remove_tags")
        return self


class FramesEdited(ApiRecord):
    """The result of an edit."""

    map: str
    frames: int = Field(
        description="Number of frames that this call changed; the others had these values already."
    )
    remaining: int = Field(
        description="Number of frames that are left, as a call edits at most 1000: repeat it "
        "with `after`."
    )
    last_frame_id: str | None = Field(
        default=None, description="If frames remain: send it as `after`."
    )
    inverse: list[dict[str, Any]] = Field(
        description="Bodies of requests that undo the edit: send each to the same path. They "
        "name the frames by id."
    )


class FramesDeleted(ApiRecord):
    """The result of a deletion."""

    map: str
    frames: int = Field(description="Number of frames that this call deleted.")
    remaining: int = Field(
        description="Number of frames that are left after the time limit: repeat the call."
    )
    deletion: FrameDeletion | None = Field(
        description="The deletion, to undo this call; null if it cannot be undone."
    )


class RefusedFrame(ApiRecord):
    """A frame that was not restored."""

    frame_id: str
    reason: str


class FramesRestored(ApiRecord):
    """The result of restoring deleted frames."""

    map: str
    frames: int = Field(
        description="Number of frames that this call restored. Indexed frames are found by "
        "queries at once, unless the map has changed its model: then workers sign them again."
    )
    refused: list[RefusedFrame] = Field(
        description=f"Frames that were not restored, at most {MOST_REFUSED} of them: the same "
        "content was uploaded since."
    )
    remaining: int = Field(
        description="Number of frames that are left after the time limit: repeat the call."
    )
