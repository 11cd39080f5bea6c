"""Records that the whole API shares: names, cameras, poses, states and metadata of frames."""

from __future__ import annotations

import ipaddress
import math
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from datetime import datetime, timezone
from typing import Annotated, Any, Generic, Literal, TypeVar

from pydantic import (
    AfterValidator,
    AwareDatetime,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    StringConstraints,
    ValidationError,
    field_validator,
    model_validator,
)

from sceneprint_client.errors import InvalidIntrinsics, InvalidRequest
from sceneprint_client.formats import CloudFormat

if sys.version_info >= (3, 11):
    from enum import StrEnum
else:
    from enum import Enum

    class StrEnum(str, Enum):
        """Equivalent of `enum.StrEnum` in Python 3.11."""

        __str__ = str.__str__


T = TypeVar("T")
Record = TypeVar("Record", bound=BaseModel)

#: Description of each name pattern. Error messages show the description instead of the pattern.
NAME_RULES = {
    (ONE_LINE := r"^[^\x00-\x1f\x7f]+$"): "characters of one line, without control characters",
    (_FILE_NAME := r"^[^\x00-\x1f\x7f\\]+$"): "characters of one line, without backslashes",
    (_TEXT := r"^[^\x00]*$"): "text without the character NUL",
    (FOLDER_NAME := r"^[^/\\\x00-\x1f\x7f.][^/\\\x00-\x1f\x7f]*$"): (
        "characters of one line, without slashes and without a leading dot"
    ),
    (MAP_NAME := r"^[a-z0-9][a-z0-9_-]{0,62}$"): (
        "1 to 63 lower-case letters, digits, hyphens and underscores, the first a letter or digit"
    ),
    (MAP_OR_EVERY := r"^(\*|[a-z0-9][a-z0-9_-]{0,62})$"): "the name of a map, or * for all",
    (DIGEST := r"^[0-9a-f]{64}$"): "64 digits of 0-9 and a-f",
}


def fault_reason(fault: Mapping[str, Any]) -> str:
    """Return the reason of a pydantic error; a pattern of NAME_RULES is replaced by its rule."""
    rule = NAME_RULES.get(fault.get("ctx", {}).get("pattern"))
    return f"must be {rule}" if rule else str(fault["msg"]).removeprefix("Value error, ")


#: Printable one-line name.
Label = Annotated[str, StringConstraints(min_length=1, max_length=128, pattern=ONE_LINE)]


#: Maximum length of the name of a frame.
MOST_OF_NAME = 255


def _require_relative(name: str) -> str:
    if "\\" in name or any(part in ("", ".", "..") for part in name.split("/")):
        raise ValueError("must be relative, with `/` as separator, without `.`, `..` and `\\`")
    return name


#: Name of an original file or message. It is only a label; it is never opened as a path.
FileName = Annotated[
    str,
    StringConstraints(min_length=1, max_length=MOST_OF_NAME, pattern=_FILE_NAME),
    AfterValidator(_require_relative),
]


#: Free text without NUL, which databases cannot store.
Note = Annotated[str, StringConstraints(max_length=200, pattern=_TEXT)]


class Given(BaseModel):
    """A record of a request. Unknown fields are errors, because they would have no effect."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ApiRecord(BaseModel):
    """A record of a response. Clients must accept unknown fields."""

    # Validators are built on first use, which makes the start faster.
    model_config = ConfigDict(frozen=True, defer_build=True)

    def _repr_html_(self) -> str:
        from sceneprint_client.notebook import html_of  # only notebooks call this

        return html_of(self)


class Page(ApiRecord, Generic[T]):
    """A page of a list."""

    items: list[T]
    next_cursor: str | None = Field(
        default=None,
        description="Cursor of the next page, to send as `cursor`; null on the last page.",
    )


class Problem(ApiRecord):
    """Details of an error, as a problem document (RFC 9457)."""

    model_config = ConfigDict(frozen=True, extra="allow")

    type: str = Field(description="URI that identifies the kind of problem.")
    title: str = Field(description="Short name of the kind of problem.")
    status: int
    detail: str = Field(description="What happened, why, and what to do.")
    instance: str = Field(default="", description="Id of the request, as in the service's log.")


# Rigid transforms.


class Vector(ApiRecord):
    """A vector in metres."""

    x: float
    y: float
    z: float


class Direction(ApiRecord):
    """A unit vector."""

    x: float
    y: float
    z: float


class Quaternion(ApiRecord):
    """A unit quaternion with w >= 0."""

    x: float
    y: float
    z: float
    w: float


class Transform(ApiRecord):
    """A rigid transform in metres, with x_parent = matrix @ x_child. In camera frames
    (`ID.optical`), x points right, y down and z forward; in the frames of clouds (`ID.sensor`), the
    axes are those of the sensor.
    """

    parent_frame: str
    child_frame: str
    translation: Vector
    rotation: Quaternion
    matrix: list[list[float]] = Field(description="4 x 4 matrix, row by row.")


# Directions in requests.

#: Tolerance for the length of a unit vector.
_UNIT = 1e-2


class GivenDirection(Given):
    """A unit vector."""

    x: float
    y: float
    z: float

    @model_validator(mode="after")
    def _require_unit_length(self) -> GivenDirection:
        length = math.hypot(self.x, self.y, self.z)
        if not abs(length - 1.0) <= _UNIT:
            raise ValueError(
                f"the length is {length:.3g}, not 1; divide the vector by its length (an "
                "accelerometer at rest measures 9.81 m/s2 upwards)"
            )
        return self

    @property
    def unit(self) -> list[float]:
        """The components, normalised exactly."""
        length = math.hypot(self.x, self.y, self.z)
        return [self.x / length, self.y / length, self.z / length]


def _from_list(value: object) -> object:
    if isinstance(value, list | tuple) and len(value) == len("xyz"):
        return dict(zip("xyz", value, strict=True))
    if not isinstance(value, GivenDirection | dict):
        raise ValueError(  # noqa: TRY004  (pydantic requires it)
            "must be {x, y, z} or a list of three numbers"
        )
    return value


#: A direction as `{x, y, z}`, or as a list of three numbers.
Up = Annotated[
    GivenDirection,
    BeforeValidator(
        _from_list,
        json_schema_input_type=GivenDirection
        | Annotated[list[float], Field(min_length=3, max_length=3)],
    ),
]


# The states of frames and jobs.


class FrameState(StrEnum):
    """State of an uploaded frame."""

    RECEIVED = "received"
    SIGNING = "signing"
    INDEXED = "indexed"
    REJECTED = "rejected"
    FAILED = "failed"
    REDUNDANT = "redundant"
    DELETED = "deleted"

    @property
    def sentence(self) -> str:
        """Description of the state."""
        return _FRAME_STATES[self]


class JobState(StrEnum):
    """State of a job."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"
    DEAD = "dead"

    @property
    def sentence(self) -> str:
        """Description of the state."""
        return _JOB_STATES[self]

    @property
    def over(self) -> bool:
        """Return whether the job has ended."""
        return self not in (JobState.QUEUED, JobState.RUNNING)


_FRAME_STATES = {
    FrameState.RECEIVED: "The frame is stored durably and waits for a worker.",
    FrameState.SIGNING: "A worker is signing the frame.",
    FrameState.INDEXED: "The frame is signed, and queries find it.",
    FrameState.REJECTED: "The frame cannot be signed; `reason` says why. A retry does not help.",
    FrameState.FAILED: "Signing the frame failed in every attempt; the job has the traceback.",
    FrameState.REDUNDANT: (
        "The frame was dropped because of `if_novel`: the map already covers this place; `reason` "
        "names a similar frame."
    ),
    FrameState.DELETED: (
        "The frame was deleted on request or after its map's retention time; no query finds it."
    ),
}

_JOB_STATES = {
    JobState.QUEUED: "The job waits for a worker, for the first attempt or a retry.",
    JobState.RUNNING: "A worker runs the job.",
    JobState.SUCCEEDED: "The job is done, and its result is stored.",
    JobState.FAILED: "The input of the job cannot be used; `error` says why.",
    JobState.CANCELLED: "The job was cancelled, for example because its frame was deleted.",
    JobState.DEAD: "The job failed in every attempt; `traceback` shows the last failure.",
}


def checked(kind: type[Record], what: str, **fields: Any) -> Record:
    """Return a validated record of type `kind`; `what` is the name of the record in errors.

    Raise InvalidRequest if a field is missing, unknown or out of range; the error lists these
    fields.
    """
    return record_of(kind, fields, what)


def record_of(kind: type[Record], fields: object, what: str) -> Record:
    """Return a validated record from an untrusted mapping; see `checked`."""
    try:
        return kind.model_validate(fields)
    except ValidationError as error:
        raise invalid_record(error, what) from error


def invalid_record(error: ValidationError, what: str) -> InvalidRequest:
    """Return the error for a record, named `what`, that pydantic rejected."""
    faults = error.errors(include_url=False, include_input=False)
    return invalid_request(faults, what)


#: Maximum number of invalid fields in an error, and maximum length of their names.
MOST_FIELDS, MOST_OF_FIELD = 20, 80


def invalid_request(faults: Sequence[Mapping[str, Any]], what: str) -> InvalidRequest:
    """Return the error for a record named `what`; it lists the first of pydantic's faults."""
    fields = tuple(
        (
            ".".join(str(part) for part in fault["loc"] if part != "query")[:MOST_OF_FIELD],
            fault_reason(fault),
        )
        for fault in faults[:MOST_FIELDS]
    )
    first = "; ".join(f"{place or 'it'}: {reason}" for place, reason in fields[:3])
    more = f" (and {len(faults) - 3} more)" if len(faults) > 3 else ""
    if len(faults) > MOST_FIELDS:
        more = f" (and {len(faults) - 3} more; {MOST_FIELDS} of {len(faults)} are listed)"
    return InvalidRequest(f"{what} is not valid: {first}{more}. See /docs for its fields.", fields)


#: Maximum number of samples of a depth image, enough for an 8-megapixel sensor. Larger files are
#: not read.
MAXIMUM_SAMPLES = 8_388_608


# The camera.


#: Maximum focal length, and maximum absolute value of cx and cy, pixels.
MAXIMUM_PIXELS = 1e7


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera: pixel = (fx x/z + cx, fy y/z + cy), pixel centres at integers.

    Parameters
    ----------
    width, height : size of the image, pixels
    fx, fy : focal lengths, pixels
    cx, cy : principal point, pixels
    distortion : coefficients k1, k2, p1, p2[, k3[, k4, k5, k6]] in OpenCV's order and meaning;
        empty for an image without distortion

    Raises
    ------
    InvalidIntrinsics : If the image is empty or has more than `MAXIMUM_SAMPLES` samples, a value is
        not finite or impossible for a camera, or the number of coefficients is not 0, 4, 5 or 8.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise InvalidIntrinsics(
                f"The image size {self.width} x {self.height} is invalid: both must be at least 1. "
                "Specify the width and height of the depth image in pixels."
            )
        if self.width * self.height > MAXIMUM_SAMPLES:
            raise InvalidIntrinsics(
                f"The image size {self.width} x {self.height} exceeds the limit of "
                f"{MAXIMUM_SAMPLES} samples. Send the image at a lower resolution."
            )
        for name, value in (("fx", self.fx), ("fy", self.fy)):
            if not (math.isfinite(value) and value > 0):
                raise InvalidIntrinsics(
                    f"The focal length {name} = {value} is not a positive number, so pixels "
                    "have no direction. Specify it in pixels, as in the sensor's calibration."
                )
            if not 1e-3 <= value <= MAXIMUM_PIXELS:
                raise InvalidIntrinsics(
                    f"The focal length {name} = {value:g} is impossible for a camera. "
                    "Specify it in pixels, as in the sensor's calibration."
                )
        if not (math.isfinite(self.cx) and math.isfinite(self.cy)):
            raise InvalidIntrinsics(
                f"The principal point ({self.cx}, {self.cy}) is not finite. "
                "Specify cx and cy in pixels, as in the sensor's calibration."
            )
        if max(abs(self.cx), abs(self.cy)) > MAXIMUM_PIXELS:
            raise InvalidIntrinsics(
                f"The principal point ({self.cx:g}, {self.cy:g}) is impossible for a camera. "
                "Specify cx and cy in pixels, as in the sensor's calibration."
            )
        if len(self.distortion) not in (0, 4, 5, 8):
            raise InvalidIntrinsics(
                f"There are {len(self.distortion)} distortion coefficients. "
                "Specify k1, k2, p1, p2, optionally k3, and optionally k4, k5, k6; or none."
            )
        if not all(math.isfinite(k) for k in self.distortion):
            raise InvalidIntrinsics(
                f"The distortion coefficients {self.distortion} are not all finite. "
                "Specify them as in the sensor's calibration."
            )

    def without_distortion(self) -> Intrinsics:
        """Return the camera of the undistorted image."""
        return replace(self, distortion=())


#: Maximum number of tags of a frame.
MOST_TAGS = 32

#: Maximum index of a frame in its session. Every JSON parser reads it exactly.
MOST_SEQUENCE = 2**53 - 1
#: Index of a frame in its session.
Place = Annotated[int, Field(ge=0, le=MOST_SEQUENCE)]

Row4 = Annotated[list[float], Field(min_length=4, max_length=4)]


class CameraIntrinsics(Given):
    """A pinhole camera: pixel = (fx x/z + cx, fy y/z + cy), with pixel centres at integers."""

    width: int = Field(ge=1, le=65535)
    height: int = Field(ge=1, le=65535)
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: list[float] = Field(
        default=[],
        max_length=8,
        description="OpenCV distortion coefficients k1, k2, p1, p2[, k3[, k4, k5, k6]]; default: "
        "no distortion.",
    )


class GivenVector(Given):
    """A vector in metres."""

    x: float
    y: float
    z: float


class GivenQuaternion(GivenVector):
    """A unit quaternion."""

    w: float


#: Names of the parts of a pose in ROS and in this API.
ROS_NAMES = {"position": "translation", "orientation": "rotation"}


class GivenTransform(Given):
    """A rigid transform, as `translation` and `rotation` or as `matrix`."""

    translation: GivenVector | None = Field(
        default=None, description="Translation; the ROS name `position` is also accepted."
    )
    rotation: GivenQuaternion | None = Field(
        default=None, description="Rotation; the ROS name `orientation` is also accepted."
    )
    matrix: Annotated[list[Row4], Field(min_length=4, max_length=4)] | None = None

    @model_validator(mode="before")
    @classmethod
    def _rename_from_ros(cls, value: object) -> object:
        if not isinstance(value, dict):
            return value
        ours = {name: own for name, own in ROS_NAMES.items() if name in value and own not in value}
        return {ours.get(name, name): part for name, part in value.items()}

    @model_validator(mode="after")
    def _require_one_form(self) -> GivenTransform:
        parts = (self.translation is not None, self.rotation is not None)
        if parts not in ((True, True), (False, False)) or parts[0] == (self.matrix is not None):
            raise ValueError("specify either translation and rotation, or matrix")
        return self


class GivenPose(GivenTransform):
    """T_parent_sensor, as `translation` and `rotation` or as `matrix`."""

    parent_frame: Label | None = Field(
        default=None,
        description="Parent frame; default: ROBOT/SESSION. Poses are combined only within the same "
        "parent frame.",
    )
    of: Literal["sensor", "base"] = Field(
        default="sensor",
        description="Frame whose pose is specified. `sensor`: the pose is T_parent_sensor. `base`: "
        "the pose is T_parent_base; the service converts it to the pose of the sensor, which "
        "requires `T_base_sensor`.",
    )


class GivenBase(GivenTransform):
    """T_base_sensor, the pose of the sensor on the robot: x_base = T_base_sensor @ x_sensor."""

    base_frame: Label = Field(default="base_link", description="Name of the robot's base frame.")


class FrameMeta(Given):
    """Metadata of a frame."""

    intrinsics: CameraIntrinsics | None = Field(
        default=None,
        description="Camera intrinsics of a depth image; point clouds have none.",
    )
    depth_scale: float = Field(
        default=1000.0,
        gt=0,
        description="Stored units per metre; ignored for floating-point NPY files, whose values "
        "are in metres.",
    )
    depth_along_ray: bool = Field(
        default=False,
        description="Whether samples are distances along the ray of the pixel instead of the "
        "optical axis.",
    )
    trust_depth: bool = Field(
        default=False,
        description="Whether to accept a depth image that fails the sanity check, for example "
        "because it has more noise than images of any known sensor.",
    )
    viewpoint: GivenVector | Literal["file"] | None = Field(
        default="file",
        description="Viewpoint of a point cloud in its own coordinates, metres; null if the cloud "
        "has no single viewpoint, for example because it was fused from many views. `file`: the "
        "viewpoint in the file (VIEWPOINT in a PCD file), otherwise the origin of the file's "
        "coordinates.",
    )
    units_per_metre: float = Field(
        default=1.0,
        gt=0,
        description="Units per metre of a point cloud, such as 1000 for millimetres.",
    )
    format: CloudFormat | None = Field(
        default=None,
        description="Format of a point cloud; default: detected automatically. KITTI files require "
        "`kitti`.",
    )
    robot: Label | None = Field(default=None, description="Robot that took the frame.")
    session: Label | None = Field(default=None, description="Session in which the frame was taken.")
    captured_at: AwareDatetime | None = Field(
        default=None,
        description="Capture time, with time zone.",
    )
    name: FileName | None = Field(
        default=None,
        description="Name of the original file or message, such as `frame-000123.depth.png`. The "
        "name is a searchable label and is never used as a path.",
    )
    sequence: Place | None = Field(
        default=None,
        description="Index in the session, such as the number of the file or message. It "
        "determines the order of frames without `captured_at`, regardless of the order of upload.",
    )
    pose: GivenPose | None = None
    T_base_sensor: GivenBase | None = Field(
        default=None,
        description="Pose of the sensor on the robot. If specified, answers also contain the pose "
        "of the robot's base. For a cloud whose `viewpoint` is not its origin, the default base "
        "frame is `cloud`, the coordinate frame of the upload.",
    )
    up: Up | None = Field(
        default=None,
        description="Unit vector that points up, in the sensor's axes, for example from an IMU. "
        "For a level camera (x right, y down, z forward), it is (0, -1, 0). Transforms that tilt a "
        "query relative to a frame are excluded.",
    )
    tags: list[Label] = Field(default=[], max_length=MOST_TAGS)

    @field_validator("captured_at")
    @classmethod
    def _in_utc(cls, captured_at: datetime | None) -> datetime | None:
        if captured_at is not None:
            try:  # responses use the same conversion
                datetime.fromtimestamp(captured_at.timestamp(), timezone.utc)
            except (ValueError, OverflowError) as error:
                raise ValueError("must be between the years 1 and 9999 UTC") from error
        return captured_at

    @model_validator(mode="after")
    def _require_parent(self) -> FrameMeta:
        if self.pose is not None and self.pose.parent_frame is None and self.session is None:
            raise ValueError("pose: specify its parent_frame, or the session of the frame")
        if self.pose is not None and self.pose.of == "base" and self.T_base_sensor is None:
            raise ValueError("pose: a pose of the base requires T_base_sensor")
        return self


# The option `if_novel` of an upload.

#: Value of `if_novel` that `true` stands for. Consecutive frames of a slow Kinect differ by less,
#: mostly because of noise; without these frames, a recording answers queries equally well.
NOVEL = 0.25


def novelty_of(value: bool | float | str | None) -> float | None:
    """Return the minimum distance of a novel frame, as a share of the unrelated distance.

    Parameters
    ----------
    value : share as a number or text; true: `NOVEL`; false or None: no minimum, returned as None

    Raises
    ------
    InvalidRequest : If the value is invalid.
    """
    text = str(value).lower()  # generated clients send Python's names, True and False
    if value is None or text == "false":
        return None
    if text == "true":
        return NOVEL
    try:
        share = float(value)
    except (TypeError, ValueError):
        share = -1.0
    if not 0 < share <= 1:  # NaN is rejected too
        raise InvalidRequest(
            f"`if_novel` is {value!r:.40}. Specify true, or a number above 0 and up to 1, the "
            "share of the distance between unrelated frames.",
            (("if_novel", "must be true, false, or a number above 0 and up to 1"),),
        )
    return share


def is_loopback(host: str) -> bool:
    """Return whether a host name or IP address, without port or brackets, is a loopback address."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
