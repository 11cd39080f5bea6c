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
    """Conditions on the frames of a list; all of them must hold.

    Frames without the property of a condition, such as a time, do not match.
    """

    state: FrameState | None = Field(
        default=None, description="State; default: any state but `deleted`."
    )
    robot: _Names = Field(default=[], description="Robot; repeat it for any of several.")
    session: _Names = Field(default=[], description="Session; repeat it for any of several.")
    tag: _Names = Field(default=[], description="Tag; repeat it for frames with all of several.")
    captured_after: AwareDatetime | None = Field(
        default=None, description="Earliest time of capture, with a time zone."
    )
    captured_before: AwareDatetime | None = Field(
        default=None, description="Latest time of capture, with a time zone."
    )
    received_after: AwareDatetime | None = Field(
        default=None, description="Earliest time of upload, with a time zone."
    )
    received_before: AwareDatetime | None = Field(
        default=None, description="Latest time of upload, with a time zone."
    )
    parent_frame: Label | None = Field(default=None, description="Parent frame of the pose.")
    has_pose: bool | None = Field(default=None, description="Whether the frame has a pose.")
    content_id: Annotated[str, Field(pattern=DIGEST)] | None = Field(
        default=None, description="Hash of samples and camera."
    )
    name: _Prefix | None = Field(default=None, description="Prefix of the name; case-sensitive.")
    find: _Prefix | None = Field(
        default=None, description="Prefix of the id, name or session; case-sensitive."
    )
    order: Literal["asc", "desc", "taken"] = Field(
        default="asc",
        description="`asc`: by time of upload; `desc`: newest upload first; `taken`, for one "
        "session: by `captured_at`, frames without it by `sequence`, others by time of upload.",
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
    limit: Annotated[int, Field(ge=1, le=1000)] = 100


class Session(ApiRecord):
    """The frames of one robot in one session."""

    robot: str | None
    session: str | None
    frames: dict[str, int] = Field(description="Number of frames in each state.")
    with_pose: int = Field(description="Number of frames with a pose.")
    first_captured_at: datetime | None
    last_captured_at: datetime | None
    parent_frames: list[str] = Field(
        description="Parent frames of the poses, by number of frames; at most 20."
    )
    tags: list[str] = Field(
        default=[], description="Tags of the frames, by number of frames; at most 20."
    )


#: Meaning of the stamps of poses.
Stamp = Literal["captured", "sequence", "received"]
#: Choice of the stamps of poses.
Clock = Literal["taken", "captured", "sequence", "received"]


class Run(Given):
    """The run whose poses a trajectory has."""

    session: Label = Field(description="Session of the frames.")
    robot: Label | None = Field(
        default=None, description="Robot; required if several robots have a session of this name."
    )
    parent_frame: Label | None = Field(
        default=None, description="Parent frame; required if the poses have several."
    )
    captured_after: AwareDatetime | None = Field(
        default=None, description="Earliest time of capture, with a time zone."
    )
    captured_before: AwareDatetime | None = Field(
        default=None, description="Latest time of capture, with a time zone."
    )
    most: Annotated[int, Field(ge=2, le=10_000)] | None = Field(
        default=None,
        description="Maximum number of poses, evenly spaced along the run, including the first and "
        "the last. The run may then have any length.",
    )
    clock: Clock = Field(
        default="taken",
        description="Source of the stamps: `captured_at`; `sequence`; `received`, the order of "
        "upload, which every frame has. `taken`: `captured_at`, or `sequence` if no frame with a "
        "pose has a time.",
    )


class Trajectory(ApiRecord):
    """The poses of one run in the order of their stamps."""

    map: str
    session: str
    robot: str | None
    parent_frame: str | None = Field(
        description="Parent frame of the poses; null if no frame of the run has a pose."
    )
    child_frame: str = Field(
        default="optical",
        description="Frame of each sensor: for a camera x right, y down, z forward; for a cloud "
        "the axes of its sensor.",
    )
    frame_ids: list[str]
    poses: list[list[float]] = Field(
        description="One row for each frame, as in a TUM file: t tx ty tz qx qy qz qw, with the "
        "stamp t, metres and a unit quaternion."
    )
    stamps: Stamp | None = Field(
        default=None,
        description="Meaning of t: `captured` and `received` are seconds since 1970, `sequence` is "
        "the index in the session. Null if no pose has a stamp.",
    )
    posed: int = Field(description="Number of poses, including those beyond `most`.")
    left_out: int = Field(
        description="Number of omitted frames of the run: without pose or stamp, in another parent "
        "frame, with a duplicate stamp, or beyond `most`."
    )
    reason: str | None = Field(default=None, description="Why there is no pose; null if there is.")


# Filters of queries.


def parsed(value: object) -> object:
    """Return the value of a JSON text in a form; other values are returned unchanged.

    Raises
    ------
    ValueError : If the text is not JSON.
    """
    if not isinstance(value, str):
        return value
    try:
        return from_json(value)
    except ValueError as error:
        raise ValueError(f"not JSON ({error}); send an object as JSON text in a form") from error


_Several = Annotated[list[Label], Field(min_length=1, max_length=100)]
#: One name, or several names of which one must match.
Names = Annotated[_Several, BeforeValidator(_as_list, json_schema_input_type=Label | _Several)]


class Region(Given):
    """A box along the axes of a parent frame, including its faces."""

    parent_frame: Label = Field(
        description="Parent frame of the box. Frames without a pose in it are outside."
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
    """Conditions on the frames that a query may find; all of them must hold.

    Frames without the property of a condition, such as a time, do not match.
    """

    robot: Names | None = Field(default=None, description="Robot, or any of a list.")
    session: Names | None = Field(default=None, description="Session, or any of a list.")
    captured_after: AwareDatetime | None = Field(
        default=None, description="Earliest time of capture, with a time zone."
    )
    captured_before: AwareDatetime | None = Field(
        default=None, description="Latest time of capture, with a time zone."
    )
    tags: list[Label] = Field(
        default=[], max_length=MOST_TAGS, description="Tags; a frame must have all of them."
    )
    not_within_s: float | None = Field(
        default=None,
        gt=0,
        description="Exclude frames of the query's own session within this number of seconds, and "
        "frames of that session without a time, for loop closure. Sessions of different robots "
        "are different sessions, if both robots are known.",
    )
    region: Region | None = Field(default=None, description="Region that contains the pose.")
    exclude_frames: list[Label] = Field(
        default=[], max_length=1000, description="Ids of excluded frames."
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
    """Changes to a frame. Omitted fields stay; null removes a value.

    Samples, camera and their interpretation cannot be edited; delete and upload the frame again.
    """

    robot: Label | None = Field(default=None, description="Robot that took the frame.")
    session: Label | None = Field(
        default=None,
        description="Name of the session. A parent frame that was named after the previous session "
        "stays.",
    )
    captured_at: AwareDatetime | None = Field(
        default=None, description="Time of capture, with its time zone."
    )
    name: FileName | None = Field(default=None, description="Name of the original file or message.")
    sequence: Place | None = Field(default=None, description="Index in the session.")
    tags: Annotated[list[Label], Field(max_length=MOST_TAGS)] | None = Field(
        default=None, description="Complete list of tags, which replaces the previous list."
    )
    pose: GivenPose | None = Field(
        default=None,
        description="T_parent_sensor. `parent_frame` alone renames it; `translation` or `rotation` "
        "alone leaves the other unchanged; each is replaced as a whole.",
    )
    T_base_sensor: GivenBase | None = Field(
        default=None,
        description="Pose of the sensor on the robot; its parts are edited like those of `pose`.",
    )
    up: Up | None = Field(default=None, description="Up direction in the sensor's axes.")


class SessionEdit(Given):
    """Changes to all frames of a session. Omitted fields stay."""

    session: Label | None = Field(
        default=None,
        description="New name. The name of another session merges the two. A parent frame that was "
        "named after the session stays.",
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
    until: datetime = Field(description="Time until which its frames can be restored.")
    frames: int = Field(description="Number of frames that can be restored.")


class SessionChange(ApiRecord):
    """The result of changing a session."""

    map: str
    session: str = Field(description="Present name of the session.")
    robot: str | None = Field(description="Robot in the request, or null.")
    frames: int = Field(description="Number of frames that this call deleted or edited.")
    remaining: int = Field(
        default=0,
        description="Number of frames left after the time limit. If not 0, repeat the call.",
    )
    last_frame_id: str | None = Field(
        default=None, description="Value for `after` in the next call, if frames remain."
    )
    deletion: FrameDeletion | None = Field(
        default=None, description="Deletion that undoes this call; null if it cannot be undone."
    )


class MapEdit(Given):
    """Changes to a map. Omitted fields stay; null removes a value."""

    title: Note | None = Field(default=None, description="A label for people.")
    quota_frames: Quota | None = Field(
        default=None,
        description="Maximum number of frames. Existing frames beyond it stay. It requires `admin` "
        "for `*`.",
    )
    quota_bytes: Quota | None = Field(
        default=None, description="Maximum size of the uploads, bytes; see `quota_frames`."
    )
    retention_days: Days | None = Field(
        default=None,
        description="Number of days after the upload at which a frame is permanently deleted. "
        "Workers delete expired frames within minutes.",
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
        description="Conditions as for GET /frames, at least one; `order` is ignored.",
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
    """Changes to the selected frames. Omitted fields stay; null removes a value."""

    session: Label | None = Field(
        default=None,
        description="New session of the frames. The parent frame of their poses stays.",
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
        description="Number of frames that this call changed; others already had the values."
    )
    remaining: int = Field(
        description="Number of frames left; a call edits at most 1000. If not 0, repeat the call "
        "with `after`."
    )
    last_frame_id: str | None = Field(
        default=None, description="Value for `after` in the next call, if frames remain."
    )
    inverse: list[dict[str, Any]] = Field(
        description="Bodies of requests that undo the edit. Send each to the same path. They name "
        "the frames by id."
    )


class FramesDeleted(ApiRecord):
    """The result of a deletion of several frames."""

    map: str
    frames: int = Field(description="Number of frames that this call deleted.")
    remaining: int = Field(
        description="Number of frames left after the time limit. If not 0, repeat the call."
    )
    deletion: FrameDeletion | None = Field(
        description="Deletion that undoes this call; null if it cannot be undone."
    )


class RefusedFrame(ApiRecord):
    """A frame that was not restored."""

    frame_id: str
    reason: str


class FramesRestored(ApiRecord):
    """The result of restoring deleted frames."""

    map: str
    frames: int = Field(
        description="Number of frames that this call restored. Queries find the indexed ones at "
        "once, unless the map has switched to another model; workers then sign them again."
    )
    refused: list[RefusedFrame] = Field(
        description=f"Frames that were not restored, at most {MOST_REFUSED}, because the same "
        "content was uploaded again."
    )
    remaining: int = Field(
        description="Number of frames left after the time limit. If not 0, repeat the call."
    )
