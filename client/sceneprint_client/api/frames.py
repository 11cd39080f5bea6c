"""Frames as JSON."""

from __future__ import annotations

import re
from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field, StringConstraints

from sceneprint_client.api.base import (
    MOST_TAGS,
    ApiRecord,
    CameraIntrinsics,
    Direction,
    FrameState,
    Given,
    GivenBase,
    Label,
    Problem,
    Transform,
    Up,
    Vector,
)
from sceneprint_client.errors import (
    Conflict,
    InvalidRequest,
    QuotaExceeded,
    SceneprintError,
    kebab_case,
)

#: A frame's priority is a whole number from minus this to this.
MOST_PRIORITY = 10

#: What a frame is: a depth image or a point cloud.
Kind = Literal["depth", "cloud"]


class Added(ApiRecord):
    """What has become of an upload."""

    frame_id: str
    job_id: str = Field(description="The job that signs it: GET /v1/jobs/{job_id}.")
    state: FrameState
    reason: str | None = Field(
        default=None, description="Why it was rejected, or failed, or was not kept."
    )


class Frame(ApiRecord):
    """A frame of a map."""

    frame_id: str
    map: str
    state: FrameState
    reason: str | None = Field(description="Why it was rejected, or failed, or was not kept.")
    job_id: str
    content_id: str | None = Field(
        description="Hash of samples and camera, or of points and viewpoint; null when deleted."
    )
    kind: Kind = "depth"
    bytes: int = Field(description="Size of the upload.")
    intrinsics: CameraIntrinsics | None = Field(description="Null of a cloud.")
    depth_scale: float | None = Field(description="Null of a cloud.")
    depth_along_ray: bool | None = Field(description="Null of a cloud.")
    points: int | None = Field(default=None, description="Of a cloud, as it was read.")
    viewpoint: Vector | None = Field(
        default=None, description="Of a cloud, in its own coordinates; null where it has none."
    )
    units_per_metre: float | None = Field(default=None, description="Null of a depth image.")
    note: str | None = Field(
        default=None, description="What was done to the points of a cloud on the way, or null."
    )
    robot: str | None
    session: str | None
    name: str | None = Field(default=None, description="Of the original file or message.")
    sequence: int | None = Field(default=None, description="Place within the session.")
    captured_at: datetime | None
    received_at: datetime
    indexed_at: datetime | None
    pose: Transform | None
    base_frame: str | None = Field(default=None, description="Frame of the robot's base.")
    T_base_sensor: Transform | None = Field(
        default=None, description="Where the sensor sits on the robot, as it was sent."
    )
    up: Direction | None = Field(default=None, description="Up in the sensor's axes, as sent.")
    tags: list[str]
    etag: str | None = Field(
        default=None,
        description="Stands for what PATCH can change: sent in If-Match, with quotes around it, "
        "it keeps an edit from overwriting another.",
    )


# Uploads of many frames as JSON: batches, and imports of archives.

#: What a frame may be called by who sends it.
FRAME_ID = r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}"
#: Frames of one batch.
MOST_OF_BATCH = 64
#: Statuses of frames that are refused; of any other reason, 422.
_STATUSES: dict[type[SceneprintError], int] = {Conflict: 409, QuotaExceeded: 403}


#: As a folder may be called.
FolderName = Annotated[
    str,
    StringConstraints(
        min_length=1, max_length=64, pattern=r"^[^/\\\x00-\x1f\x7f.][^/\\\x00-\x1f\x7f]*$"
    ),
]


class BatchItem(ApiRecord):
    """What came of one frame of a batch."""

    status: int = Field(
        description="As if it had been sent alone: 202 received, 200 the map has it already, 403 "
        "beyond the map's quota, 409 or 422 refused."
    )
    frame: Added | None = Field(description="Null where it was refused.")
    problem: Problem | None = Field(description="Why it was refused, or null.")


class Batch(ApiRecord):
    """What came of a batch; the frames that were taken are safe."""

    items: list[BatchItem] = Field(description="In the order in which the frames were sent.")


class ImportOptions(Given):
    """What is said of all frames of an archive."""

    name: FolderName = Field(
        default="import",
        description="Names what lies at the top of the archive, outside of any folder.",
    )
    robot: Label | None = Field(
        default=None, description="Who took the frames, and whose the poses' frame is."
    )
    session: Label | None = Field(
        default=None, description="In which run; default: the name of each sequence."
    )
    tags: list[Label] = Field(default=[], max_length=MOST_TAGS)
    parent_frame: Label | None = Field(
        default=None,
        description="What all poses lead to; default: the scene's name, after ROBOT/ if given.",
    )
    with_poses: bool = Field(default=True, description="Take the poses that are in the archive.")
    every: int = Field(default=1, ge=1, description="Take every Nth frame of a sequence.")
    T_base_sensor: GivenBase | None = Field(
        default=None, description="Where the sensor sits on the robot."
    )
    up: Up | None = Field(
        default=None,
        description="Up in the sensor's axes, of all frames: where the sensor is carried level.",
    )
    priority: int = Field(
        default=0, ge=-MOST_PRIORITY, le=MOST_PRIORITY, description="Of the frames' jobs."
    )
    if_novel: float | None = Field(
        default=None, gt=0, le=1, description="As of an upload, for each frame."
    )


class ImportItem(ApiRecord):
    """What came of one frame of an archive, or of a member that is none."""

    name: str = Field(description="Of the member, as the archive has it, or of a sequence.")
    status: int = Field(description="As of an item of a batch.")
    frame_id: str | None = Field(description="Null where it was refused.")
    job_id: str | None = Field(description="The job that signs it.")
    problem: Problem | None = Field(description="Why it was refused, or null.")


def problem_of(error: SceneprintError) -> Problem:
    """Why one of many frames was refused, as if it had been sent alone."""
    name = kebab_case(type(error).__name__)
    fields = error.fields if isinstance(error, InvalidRequest) else ()
    listed = [{"field": place, "reason": reason} for place, reason in fields]
    told: dict[str, object] = {
        "type": f"/problems/{name}",
        "title": name.replace("-", " ").capitalize(),
        "status": next((n for kind, n in _STATUSES.items() if isinstance(error, kind)), 422),
        "detail": str(error),
    }
    return Problem.model_validate({**told, "errors": listed} if listed else told)


def check_frame_id(frame_id: str) -> None:
    """See that a frame may be called so.

    Raises
    ------
    InvalidRequest : it would not stay one part of a path.
    """
    if not re.fullmatch(FRAME_ID, frame_id):
        raise InvalidRequest(
            f"The frame id {frame_id!r:.80} is none. Take up to 64 letters, digits, dots, "
            "hyphens and underscores, of which the first is a letter or digit.",
            (("frame_id", "not as it should be"),),
        )
