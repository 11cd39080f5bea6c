"""Frames as JSON."""

from __future__ import annotations

import re
from datetime import datetime, timezone
from typing import Annotated, Literal

from pydantic import AwareDatetime, Field, StringConstraints, field_validator, model_validator

from sceneprint_client.api.base import (
    ApiRecord,
    Direction,
    FileName,
    FrameState,
    Given,
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

#: Tags of a frame.
MOST_TAGS = 32
#: A frame's priority is a whole number from minus this to this.
MOST_PRIORITY = 10

#: A frame's place in its session is at most this, which every reader of JSON reads exactly.
MOST_SEQUENCE = 2**53 - 1
#: Place of a frame within its session.
Place = Annotated[int, Field(ge=0, le=MOST_SEQUENCE)]

#: What a frame is: a depth image or a point cloud.
Kind = Literal["depth", "cloud"]
#: How files of clouds are packed; all but KITTI's say so themselves.
CloudFormat = Literal["ply", "pcd", "kitti", "npy", "las", "pointcloud2"]

Row4 = Annotated[list[float], Field(min_length=4, max_length=4)]


class CameraIntrinsics(Given):
    """The camera: pixel = (fx x/z + cx, fy y/z + cy), pixel centres at integers."""

    width: int = Field(ge=1, le=65535)
    height: int = Field(ge=1, le=65535)
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: list[float] = Field(
        default=[], max_length=5, description="k1, k2, p1, p2[, k3] of OpenCV; none by default."
    )


class GivenVector(Given):
    """Metres."""

    x: float
    y: float
    z: float


class GivenQuaternion(GivenVector):
    """Unit quaternion."""

    w: float


#: What ROS calls the parts of a pose, and what we do.
ROS_NAMES = {"position": "translation", "orientation": "rotation"}


class GivenTransform(Given):
    """A rigid transform, as `translation` and `rotation` or as `matrix`."""

    translation: GivenVector | None = Field(
        default=None, description="`position`, as ROS calls it, is taken too."
    )
    rotation: GivenQuaternion | None = Field(
        default=None, description="`orientation`, as ROS calls it, is taken too."
    )
    matrix: Annotated[list[Row4], Field(min_length=4, max_length=4)] | None = None

    @model_validator(mode="before")
    @classmethod
    def _as_ros_calls_it(cls, given: object) -> object:
        if not isinstance(given, dict):
            return given
        ours = {name: own for name, own in ROS_NAMES.items() if name in given and own not in given}
        return {ours.get(name, name): value for name, value in given.items()}

    @model_validator(mode="after")
    def _one_way(self) -> GivenTransform:
        parts = (self.translation is not None, self.rotation is not None)
        if parts not in ((True, True), (False, False)) or parts[0] == (self.matrix is not None):
            raise ValueError("give translation and rotation, or matrix")
        return self


class GivenPose(GivenTransform):
    """T_parent_sensor, as `translation` and `rotation` or as `matrix`."""

    parent_frame: Label | None = Field(
        default=None,
        description="Poses are combined within one parent frame; default: ROBOT/SESSION.",
    )
    of: Literal["sensor", "base"] = Field(
        default="sensor",
        description="`base`, of an upload with `T_base_sensor`: the pose is T_parent_base, and is "
        "stored as that of the sensor.",
    )


class GivenBase(GivenTransform):
    """T_base_sensor: where the sensor sits on the robot; x_base = T_base_sensor @ x_sensor."""

    base_frame: Label = Field(
        default="base_link", description="What the robot calls the frame of its base."
    )


class FrameMeta(Given):
    """What is known of a frame beside its samples."""

    intrinsics: CameraIntrinsics | None = Field(
        default=None, description="Of a depth image, which needs them; a point cloud has none."
    )
    depth_scale: float = Field(
        default=1000.0,
        gt=0,
        description="Stored units per metre; floating NPY files are metres whatever it is.",
    )
    depth_along_ray: bool = Field(
        default=False, description="Samples are ranges along the pixel's ray."
    )
    viewpoint: GivenVector | Literal["file"] | None = Field(
        default="file",
        description="Of a point cloud: where it was seen from, along its own axes, metres; null "
        "where there is no such place, as of a cloud that is fused of many views. `file`: as the "
        "file says (a PCD's VIEWPOINT), else the origin of its coordinates.",
    )
    units_per_metre: float = Field(
        default=1.0, gt=0, description="Of a point cloud: 1000 where it is in millimetres."
    )
    format: CloudFormat | None = Field(
        default=None,
        description="Of a point cloud: how it is packed. KITTI's files alone do not say so "
        "themselves; `kitti` has to be given.",
    )
    robot: Label | None = Field(default=None, description="Who took the frame.")
    session: Label | None = Field(default=None, description="In which run.")
    captured_at: AwareDatetime | None = Field(
        default=None,
        description="When, with its time zone.",
    )
    name: FileName | None = Field(
        default=None,
        description="Of the original file or message, such as `frame-000123.depth.png`: to find "
        "the frame again by. A label: nothing opens it as a path.",
    )
    sequence: Place | None = Field(
        default=None,
        description="Place within the session, such as the number of the file or message: orders "
        "the frames that have no `captured_at`, whatever the order of upload.",
    )
    pose: GivenPose | None = None
    T_base_sensor: GivenBase | None = Field(
        default=None,
        description="Where the sensor sits on the robot: answers then also say where its base is. "
        "A cloud with a `viewpoint` that is not its origin has the base frame `cloud` without it: "
        "the coordinates as they were sent.",
    )
    up: Up | None = Field(
        default=None,
        description="Up as an IMU has it: a unit vector in the sensor's axes, of a camera x right, "
        "y down, z forward. A camera held level has (0, -1, 0). Transforms that tilt a query "
        "against a frame are impossible then.",
    )
    tags: list[Label] = Field(default=[], max_length=MOST_TAGS)

    @field_validator("captured_at")
    @classmethod
    def _in_utc(cls, captured_at: datetime | None) -> datetime | None:
        if captured_at is not None:
            try:  # as it will be told
                datetime.fromtimestamp(captured_at.timestamp(), timezone.utc)
            except (ValueError, OverflowError) as error:
                raise ValueError("not within the years 1 to 9999 of UTC") from error
        return captured_at

    @model_validator(mode="after")
    def _named_parent(self) -> FrameMeta:
        if self.pose is not None and self.pose.parent_frame is None and self.session is None:
            raise ValueError("pose: name its parent_frame, or the session it belongs to")
        if self.pose is not None and self.pose.of == "base" and self.T_base_sensor is None:
            raise ValueError("pose: of the base; give T_base_sensor, where the sensor sits on it")
        return self


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


# What `if_novel` of an upload means, however it is given.

#: Where `if_novel` is just true: consecutive frames of a slow Kinect lie nearer than this, mostly
#: by the noise of their depth, and what is left of a recording answers as well (docs/).
NOVEL = 0.25


def novelty_of(given: bool | float | str | None) -> float | None:
    """The distance beyond which a frame is kept, as a share of that of unrelated frames.

    Parameters
    ----------
    given : the share, as number or text; true for the default; false or None for every frame

    Raises
    ------
    InvalidRequest : none of these.
    """
    if given is None or given is False or given == "false":
        return None
    if given is True or given == "true":
        return NOVEL
    try:
        share = float(given)
    except (TypeError, ValueError):
        share = -1.0
    if not 0 < share <= 1:  # nor for NaN
        raise InvalidRequest(
            f"`if_novel` is {given!r:.40}. Give true, or a share of the distance of unrelated "
            "frames: above 0, up to 1.",
            (("if_novel", "neither true nor false nor a number above 0, up to 1"),),
        )
    return share


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
