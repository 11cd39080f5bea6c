"""Records for lists and selections of frames, edits, deletions, sessions and trajectories."""

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


def _as_list(value: object) -> object:
    return [value] if isinstance(value, str) else value


#: One name or several, as a repeated parameter of the query string.
_Names = Annotated[list[Label], BeforeValidator(_as_list), Field(max_length=100)]


#: Prefix of a name.
_Prefix = Annotated[str, Field(min_length=1, max_length=MOST_OF_NAME, pattern=ONE_LINE)]


class FrameListing(Given):
    """Conditions on the listed frames, all of which must hold.

    A frame does not match a condition on a property that it lacks, such as a time.
    """

    state: FrameState | None = Field(
        default=None, description="State; default: any state except `deleted`."
    )
    robot: _Names = Field(
        default=[], description="Robot; repeat the parameter to match any of several robots."
    )
    session: _Names = Field(
        default=[], description="Session; repeat the parameter to match any of several sessions."
    )
    tag: _Names = Field(
        default=[],
        description="Tag; repeat the parameter to match frames that have all of several tags.",
    )
    captured_after: AwareDatetime | None = Field(
        default=None, description="Earliest capture time, with time zone."
    )
    captured_before: AwareDatetime | None = Field(
        default=None, description="Latest capture time, with time zone."
    )
    received_after: AwareDatetime | None = Field(
        default=None, description="Earliest upload time, with time zone."
    )
    received_before: AwareDatetime | None = Field(
        default=None, description="Latest upload time, with time zone."
    )
    parent_frame: Label | None = Field(default=None, description="Parent frame of the pose.")
    has_pose: bool | None = Field(default=None, description="Whether the frame has a pose.")
    content_id: Annotated[str, Field(pattern=DIGEST)] | None = Field(
        default=None, description="Hash of the samples and the camera; see Frame."
    )
    name: _Prefix | None = Field(default=None, description="Prefix of the name; case-sensitive.")
    find: _Prefix | None = Field(
        default=None, description="Prefix of the id, name or session; case-sensitive."
    )
    order: Literal["asc", "desc", "taken"] = Field(
        default="asc",
        description="`asc`: by upload time. `desc`: newest upload first. `taken`, only for a "
        "single session: by `captured_at`; frames without it, by `sequence`; frames with neither, "
        "by upload time.",
    )

    @field_validator("order")
    @classmethod
    def _require_one_session(cls, order: str, info: ValidationInfo) -> str:
        if order == "taken" and len(info.data.get("session", [None])) != 1:
            raise ValueError("`taken` requires exactly one `session`")
        return order


class FramePage(FrameListing):
    """A page of a list of frames."""

    cursor: str | None = Field(default=None, description="`next_cursor` of the previous page.")
    limit: Annotated[int, Field(ge=1, le=200)] = 100


class Session(ApiRecord):
    """The frames of one robot in one session."""

    robot: str | None
    session: str | None
    frames: dict[str, int] = Field(description="Number of frames in each state.")
    with_pose: int = Field(description="Number of frames with a pose.")
    first_captured_at: datetime | None
    last_captured_at: datetime | None
    parent_frames: list[str] = Field(
        description="At most 20 parent frames of the poses, sorted by number of frames."
    )
    tags: list[str] = Field(
        default=[], description="At most 20 tags of the frames, sorted by number of frames."
    )


#: Source of the timestamps in a trajectory.
Stamp = Literal["captured", "sequence", "received"]
#: Requested source of timestamps; see Run.
Clock = Literal["taken", "captured", "sequence", "received"]


class Run(Given):
    """Selection of a run, and of its poses, for a trajectory."""

    session: Label = Field(description="Session of the frames.")
    robot: Label | None = Field(
        default=None, description="Robot; required if several robots have a session with this name."
    )
    parent_frame: Label | None = Field(
        default=None, description="Parent frame; required if the poses have several parent frames."
    )
    captured_after: AwareDatetime | None = Field(
        default=None, description="Earliest capture time, with time zone."
    )
    captured_before: AwareDatetime | None = Field(
        default=None, description="Latest capture time, with time zone."
    )
    most: Annotated[int, Field(ge=2, le=10_000)] | None = Field(
        default=None,
        description="Maximum number of poses, which are evenly spaced along the run and include "
        "the first and the last. With `most`, the run may have any length.",
    )
    clock: Clock = Field(
        default="taken",
        description="Source of the timestamps. `captured`: `captured_at`. `sequence`: the index in "
        "the session. `received`: the upload time, which every frame has. `taken`: `captured_at`, "
        "or the index in the session if no frame with a pose has a capture time.",
    )


class Trajectory(ApiRecord):
    """The poses of one run in the order of their timestamps."""

    map: str
    session: str
    robot: str | None
    parent_frame: str | None = Field(
        description="Parent frame of the poses; null if no frame of the run has a pose."
    )
    child_frame: str = Field(
        default="optical",
        description="Coordinate frame of each sensor. A camera has x right, y down, z forward. A "
        "cloud has the axes of its sensor.",
    )
    frame_ids: list[str]
    poses: list[list[float]] = Field(
        description="One row for each frame, as in a TUM file (t tx ty tz qx qy qz qw), with the "
        "timestamp t, metres and a unit quaternion."
    )
    stamps: Stamp | None = Field(
        default=None,
        description="Meaning of t. `captured` and `received`: seconds since 1970. `sequence`: "
        "index in the session. Null if no pose has a timestamp.",
    )
    posed: int = Field(description="Number of poses, including those omitted because of `most`.")
    left_out: int = Field(
        description="Number of frames of the run that were omitted because they have no pose or "
        "timestamp, have a duplicate timestamp, are in another parent frame, or exceed `most`."
    )
    reason: str | None = Field(
        default=None, description="Reason why there are no poses; null if there are poses."
    )


# Filters of queries.


def parsed(value: object) -> object:
    """Parse JSON text from a form; return other values unchanged.

    Raise ValueError if the text is not JSON.
    """
    if not isinstance(value, str):
        return value
    try:
        return from_json(value)
    except ValueError as error:
        raise ValueError(f"not JSON ({error}); send an object as JSON text in a form") from error


_Several = Annotated[list[Label], Field(min_length=1, max_length=100)]
#: A name, or a list of names, any of which may match.
Names = Annotated[_Several, BeforeValidator(_as_list, json_schema_input_type=Label | _Several)]


class Region(Given):
    """An axis-aligned box in a parent frame, including its faces."""

    parent_frame: Label = Field(
        description="Parent frame of the box. Frames without a pose in this parent frame are "
        "outside the box."
    )
    min: GivenVector
    max: GivenVector

    @field_validator("max")
    @classmethod
    def _require_above_min(cls, corner: GivenVector, info: ValidationInfo) -> GivenVector:
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
    """Conditions on the frames that a query may find, all of which must hold.

    A frame does not match a condition on a property that it lacks, such as a time.
    """

    robot: Names | None = Field(
        default=None, description="Robot, or a list of robots, any of which may match."
    )
    session: Names | None = Field(
        default=None, description="Session, or a list of sessions, any of which may match."
    )
    captured_after: AwareDatetime | None = Field(
        default=None, description="Earliest capture time, with time zone."
    )
    captured_before: AwareDatetime | None = Field(
        default=None, description="Latest capture time, with time zone."
    )
    tags: list[Label] = Field(
        default=[], max_length=MOST_TAGS, description="Tags; a frame must have all of them."
    )
    not_within_s: float | None = Field(
        default=None,
        gt=0,
        description="For loop closures: exclude frames of the query's own session that were taken "
        "within this number of seconds of the query or have no capture time. Sessions with the "
        "same name are different sessions if both robots are known and differ.",
    )
    region: Region | None = Field(default=None, description="Region that contains the pose.")
    exclude_frames: list[Label] = Field(
        default=[], max_length=1000, description="Ids of frames to exclude."
    )

    @field_validator("captured_before")
    @classmethod
    def _require_later(cls, before: datetime | None, info: ValidationInfo) -> datetime | None:
        after: Any = info.data.get("captured_after")
        if before is not None and after is not None and before < after:
            raise ValueError("must not be earlier than `captured_after`")
        return before


# Edits of frames, sessions and maps: JSON merge patches (RFC 7396).


class FrameEdit(Given):
    """Changes to a frame. Omitted fields are unchanged; null removes a value.

    The samples, the camera and their interpretation cannot be edited. To change them, delete the
    frame and upload it again.
    """

    robot: Label | None = Field(default=None, description="Robot that took the frame.")
    session: Label | None = Field(
        default=None,
        description="Name of the session. A parent frame that was named after the previous session "
        "keeps its name.",
    )
    captured_at: AwareDatetime | None = Field(
        default=None, description="Capture time, with time zone."
    )
    name: FileName | None = Field(default=None, description="Name of the original file or message.")
    sequence: Place | None = Field(default=None, description="Index in the session.")
    tags: Annotated[list[Label], Field(max_length=MOST_TAGS)] | None = Field(
        default=None, description="Complete list of tags, which replaces the previous list."
    )
    pose: GivenPose | None = Field(
        default=None,
        description="T_parent_sensor. `parent_frame`, `translation` and `rotation` can be edited "
        "separately, and each is replaced as a whole.",
    )
    T_base_sensor: GivenBase | None = Field(
        default=None,
        description="Pose of the sensor on the robot; its parts can be edited separately, as for "
        "`pose`.",
    )
    up: Up | None = Field(default=None, description="Up direction in the sensor's axes.")


class SessionEdit(Given):
    """Changes to all frames of a session. Omitted fields are unchanged."""

    session: Label | None = Field(
        default=None,
        description="New name of the session. If another session has this name, the two are "
        "merged. A parent frame that was named after the session keeps its name.",
    )
    robot: Label | None = Field(default=None, description="Robot that took the frames.")
    add_tags: list[Label] = Field(default=[], max_length=MOST_TAGS)
    remove_tags: list[Label] = Field(default=[], max_length=MOST_TAGS)

    @model_validator(mode="after")
    def _require_change(self) -> SessionEdit:
        if not (self.session or self.robot or self.add_tags or self.remove_tags):
            raise ValueError("specify session, robot, add_tags or remove_tags")
        return self


class FrameDeletion(ApiRecord):
    """A deletion that can be undone."""

    deletion_id: str
    at: datetime
    until: datetime = Field(description="Time until which the frames can be restored.")
    frames: int = Field(description="Number of frames that can be restored.")


class SessionChange(ApiRecord):
    """The result of changing a session."""

    map: str
    session: str = Field(description="Current name of the session.")
    robot: str | None = Field(description="Robot in the request; null if there is none.")
    frames: int = Field(description="Number of frames that this call deleted or edited.")
    remaining: int = Field(
        default=0,
        description="Number of frames that the call did not process within the time limit. If it "
        "is not 0, repeat the call.",
    )
    last_frame_id: str | None = Field(
        default=None, description="Value for `after` in the next call, if frames remain."
    )
    deletion: FrameDeletion | None = Field(
        default=None,
        description="Deletion with which this call can be undone; null if it cannot be undone.",
    )


class MapEdit(Given):
    """Changes to a map. Omitted fields are unchanged; null removes a value."""

    title: Note | None = Field(default=None, description="Human-readable title.")
    quota_frames: Quota | None = Field(
        default=None,
        description="Maximum number of frames. Existing frames are not deleted. Changing the quota "
        "requires `admin` for `*`.",
    )
    quota_bytes: Quota | None = Field(
        default=None, description="Maximum size of the uploads, bytes; see `quota_frames`."
    )
    retention_days: Days | None = Field(
        default=None,
        description="Time after the upload at which a frame is permanently deleted, days. Workers "
        "delete expired frames within minutes.",
    )
    up: Up | None = Field(
        default=None, description="Up direction in the parent frames of the poses; see NewMap."
    )


#: Fields of a map that only the operator may set, not the administrators of the map.
OPERATORS = frozenset(("quota_frames", "quota_bytes"))

# Selections of frames by ids or by a filter.

#: Maximum number of frames in a request, and of edited frames per call.
MOST_SELECTED = 1000
#: Maximum number of frames that are listed with the reason why they were not restored.
MOST_REFUSED = 100

_Ids = Annotated[list[Label], Field(min_length=1, max_length=MOST_SELECTED)]


class FrameSelection(Given):
    """Selection of a map's frames by their ids or by a filter."""

    frame_ids: _Ids | None = Field(
        default=None, description="Ids of frames; unknown and deleted frames are ignored."
    )
    filter: FrameListing | None = Field(
        default=None,
        description="At least one condition, as for GET /frames; `order` is ignored.",
    )

    @model_validator(mode="after")
    def _require_one(self) -> FrameSelection:
        if (self.frame_ids is None) == (self.filter is None):
            raise ValueError("specify either `frame_ids` or `filter`")
        if self.filter is not None:
            if not self.filter.model_dump(exclude_defaults=True, exclude={"order"}):
                raise ValueError("`filter` has no condition, so it would select every frame")
            if self.filter.state == FrameState.DELETED:
                raise ValueError("deleted frames cannot be selected; restore them first")
        return self


class FramesEdit(FrameSelection):
    """Changes to the selected frames. Omitted fields are unchanged; null removes a value."""

    session: Label | None = Field(
        default=None,
        description="New session of the frames. The parent frame of their poses does not change.",
    )
    robot: Label | None = Field(default=None, description="Robot that took the frames.")
    add_tags: list[Label] = Field(default=[], max_length=MOST_TAGS)
    remove_tags: list[Label] = Field(default=[], max_length=MOST_TAGS)
    after: Label | None = Field(
        default=None, description="`last_frame_id` of the previous call, to continue after it."
    )

    @model_validator(mode="after")
    def _require_change(self) -> FramesEdit:
        if not ({"session", "robot"} & self.model_fields_set or self.add_tags or self.remove_tags):
            raise ValueError("specify session, robot, add_tags or remove_tags")
        return self


class FramesEdited(ApiRecord):
    """The result of an edit of several frames."""

    map: str
    frames: int = Field(
        description="Number of frames that this call changed, excluding frames that already had "
        "the new values."
    )
    remaining: int = Field(
        description="Number of frames that still have to be edited. A call edits at most 1000 "
        "frames; if `remaining` is not 0, repeat the call with `after`."
    )
    last_frame_id: str | None = Field(
        default=None, description="Value for `after` in the next call, if frames remain."
    )
    inverse: list[dict[str, Any]] = Field(
        description="Request bodies that undo the edit. Send each to the same path. The bodies "
        "list the ids of the frames."
    )


class FramesDeleted(ApiRecord):
    """The result of a deletion of several frames."""

    map: str
    frames: int = Field(description="Number of frames that this call deleted.")
    remaining: int = Field(
        description="Number of frames that the call did not process within the time limit. If it "
        "is not 0, repeat the call."
    )
    deletion: FrameDeletion | None = Field(
        description="Deletion with which this call can be undone; null if it cannot be undone."
    )


class RefusedFrame(ApiRecord):
    """A frame that was not restored."""

    frame_id: str
    reason: str


class FramesRestored(ApiRecord):
    """The result of restoring deleted frames."""

    map: str
    frames: int = Field(
        description="Number of frames that this call restored. Queries find the indexed frames "
        "immediately, unless the map has switched to another model; in that case, workers first "
        "sign the frames again."
    )
    refused: list[RefusedFrame] = Field(
        description=f"Frames that were not restored because the same content was uploaded again; "
        f"at most {MOST_REFUSED} are listed."
    )
    remaining: int = Field(
        description="Number of frames that the call did not process within the time limit. If it "
        "is not 0, repeat the call."
    )
