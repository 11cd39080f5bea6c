"""Frames as JSON."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Annotated, Literal

from pydantic import AwareDatetime, Field, field_validator, model_validator

from sceneprint.schemas.base import Given, Label, Told
from sceneprint.schemas.states import FrameState
from sceneprint.schemas.transforms import Transform, Vector

#: A frame's priority is a whole number from minus this to this.
MOST_PRIORITY = 10

#: What a frame is: a depth image or a point cloud.
Kind = Literal["depth", "cloud"]
#: How files of clouds are packed; all but KITTI's say so themselves.
CloudFormat = Literal["ply", "pcd", "kitti", "npy", "las"]

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


class GivenTransform(Given):
    """A rigid transform, as `translation` and `rotation` or as `matrix`."""

    translation: GivenVector | None = None
    rotation: GivenQuaternion | None = None
    matrix: Annotated[list[Row4], Field(min_length=4, max_length=4)] | None = None

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
        description="Stored units per metre; NPY files are metres whatever it is.",
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
    pose: GivenPose | None = None
    T_base_sensor: GivenBase | None = Field(
        default=None,
        description="Where the sensor sits on the robot: answers then also say where its base is. "
        "A cloud with a `viewpoint` that is not its origin has the base frame `cloud` without it: "
        "the coordinates as they were sent.",
    )
    tags: list[Label] = Field(default=[], max_length=32)

    @field_validator("captured_at")
    @classmethod
    def _in_utc(cls, captured_at: datetime | None) -> datetime | None:
        if captured_at is not None:
            try:  # as it will be told
                datetime.fromtimestamp(captured_at.timestamp(), UTC)
            except (ValueError, OverflowError) as error:
                raise ValueError("not within the years 1 to 9999 of UTC") from error
        return captured_at

    @model_validator(mode="after")
    def _named_parent(self) -> FrameMeta:
        if self.pose is not None and self.pose.parent_frame is None and self.session is None:
            raise ValueError("pose: name its parent_frame, or the session it belongs to")
        return self


class Added(Told):
    """What has become of an upload."""

    frame_id: str
    job_id: str = Field(description="The job that signs it: GET /v1/jobs/{job_id}.")
    state: FrameState
    reason: str | None = Field(
        default=None, description="Why it was rejected, or failed, or was not kept."
    )


class Frame(Told):
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
    captured_at: datetime | None
    received_at: datetime
    indexed_at: datetime | None
    pose: Transform | None
    base_frame: str | None = Field(default=None, description="Frame of the robot's base.")
    T_base_sensor: Transform | None = Field(
        default=None, description="Where the sensor sits on the robot, as it was sent."
    )
    tags: list[str]
    etag: str | None = Field(
        default=None,
        description="Stands for what PATCH can change: sent in If-Match, with quotes around it, "
        "it keeps an edit from overwriting another.",
    )
