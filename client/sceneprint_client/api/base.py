"""What records of the API share: names, cameras, poses, and what is said of a frame beside its
samples."""

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
        """As the one of Python 3.11."""

        __str__ = str.__str__


T = TypeVar("T")
Record = TypeVar("Record", bound=BaseModel)

#: Rules of names by their patterns, which errors put in the place of the pattern.
NAME_RULES = {
    (ONE_LINE := r"^[^\x00-\x1f\x7f]+$"): "characters of one line, without control characters",
    (_FILE_NAME := r"^[^\x00-\x1f\x7f\\]+$"): "characters of one line, without backslashes",
    (_TEXT := r"^[^\x00]*$"): "text without the character NUL",
    (FOLDER_NAME := r"^[^/\\\x00-\x1f\x7f.][^/\\\x00-\x1f\x7f]*$"): (
        "characters of one line, without slashes and without a dot in front"
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


#: Names that people give: printable, one line.
Label = Annotated[str, StringConstraints(min_length=1, max_length=128, pattern=ONE_LINE)]


#: Characters of the name of a frame.
MOST_OF_NAME = 255


def _without_a_way_out(name: str) -> str:
    if "\\" in name or any(part in ("", ".", "..") for part in name.split("/")):
        raise ValueError("relative, with `/` between its parts, and without `.`, `..` and `\\`")
    return name


#: What an original file or message was called: a label, never a path that anybody opens.
FileName = Annotated[
    str,
    StringConstraints(min_length=1, max_length=MOST_OF_NAME, pattern=_FILE_NAME),
    AfterValidator(_without_a_way_out),
]


#: What people write about something: no database has a text with NUL.
Note = Annotated[str, StringConstraints(max_length=200, pattern=_TEXT)]


class Given(BaseModel):
    """A record that a caller sends: unknown fields are errors, as they would have no effect."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class ApiRecord(BaseModel):
    """A record that the service answers with; a client may meet fields it does not know yet."""

    # the many records that answers are made of, built when one is first made: a start is quicker
    model_config = ConfigDict(frozen=True, defer_build=True)


class Page(ApiRecord, Generic[T]):
    """A part of a list."""

    items: list[T]
    next_cursor: str | None = Field(
        default=None, description="Send it as `cursor` for the next page; null at the end."
    )


class Problem(ApiRecord):
    """The reason why a request was refused (RFC 9457)."""

    model_config = ConfigDict(frozen=True, extra="allow")

    type: str = Field(description="URI of the kind of problem.")
    title: str = Field(description="The kind of problem in words.")
    status: int
    detail: str = Field(description="What happened, why, and what to do.")
    instance: str = Field(default="", description="Id of the request, as in the service's log.")


# Rigid transforms as JSON.


class Vector(ApiRecord):
    """Metres."""

    x: float
    y: float
    z: float


class Direction(ApiRecord):
    """A unit vector."""

    x: float
    y: float
    z: float


class Quaternion(ApiRecord):
    """Unit quaternion, w >= 0."""

    x: float
    y: float
    z: float
    w: float


class Transform(ApiRecord):
    """x_parent = matrix @ x_child, in metres. Camera frames (`ID.optical`): x right, y down, z
    ahead; a cloud (`ID.sensor`) keeps the axes of its sensor.
    """

    parent_frame: str
    child_frame: str
    translation: Vector
    rotation: Quaternion
    matrix: list[list[float]] = Field(description="4 x 4, row by row.")


# Which way is up, as a caller gives it.

#: How far from 1 the length of a given direction may be.
_UNIT = 1e-2


class GivenDirection(Given):
    """A unit vector."""

    x: float
    y: float
    z: float

    @model_validator(mode="after")
    def _of_unit_length(self) -> GivenDirection:
        length = math.hypot(self.x, self.y, self.z)
        if not abs(length - 1.0) <= _UNIT:
            raise ValueError(
                f"its length is {length:.3g}, not 1; divide it by its length, as an "
                "accelerometer at rest measures 9.81 upwards"
            )
        return self

    @property
    def unit(self) -> list[float]:
        """Its three numbers, of length 1 as exactly as can be."""
        length = math.hypot(self.x, self.y, self.z)
        return [self.x / length, self.y / length, self.z / length]


def _from_list(given: object) -> object:
    if isinstance(given, list | tuple) and len(given) == len("xyz"):
        return dict(zip("xyz", given, strict=True))
    if not isinstance(given, GivenDirection | dict):
        raise ValueError(  # noqa: TRY004  (pydantic wants it)
            "neither {x, y, z} nor a list of three numbers"
        )
    return given


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
    """State of an uploaded frame; `sentence` describes it for people."""

    RECEIVED = "received"
    SIGNING = "signing"
    INDEXED = "indexed"
    REJECTED = "rejected"
    FAILED = "failed"
    REDUNDANT = "redundant"
    DELETED = "deleted"

    @property
    def sentence(self) -> str:
        """The state in a sentence."""
        return _OF_FRAMES[self]


class JobState(StrEnum):
    """State of a job; `sentence` describes it for people."""

    QUEUED = "queued"
    RUNNING = "running"
    SUCCEEDED = "succeeded"
    FAILED = "failed"
    CANCELLED = "cancelled"
    DEAD = "dead"

    @property
    def sentence(self) -> str:
        """The state in a sentence."""
        return _OF_JOBS[self]

    @property
    def over(self) -> bool:
        """Whether nothing more will happen to the job."""
        return self not in (JobState.QUEUED, JobState.RUNNING)


_OF_FRAMES = {
    FrameState.RECEIVED: "Stored durably, and waiting for a worker.",
    FrameState.SIGNING: "A worker is signing it.",
    FrameState.INDEXED: "Signed, and found by queries from now on.",
    FrameState.REJECTED: "Nothing in it can be signed; `reason` says why. Trying again is no use.",
    FrameState.FAILED: "Signing broke down again and again; the job has the traceback.",
    FrameState.REDUNDANT: (
        "Not kept, as asked: the map already covers this place; `reason` names the frame."
    ),
    FrameState.DELETED: (
        "Removed on request, or as older than its map keeps frames; found by no query."
    ),
}

_OF_JOBS = {
    JobState.QUEUED: "Waiting for a worker, for the first time or for another try.",
    JobState.RUNNING: "A worker holds its lease.",
    JobState.SUCCEEDED: "Done, and what it made is stored.",
    JobState.FAILED: "Its input cannot be used; `error` says why.",
    JobState.CANCELLED: "Given up on request, such as by deleting its frame.",
    JobState.DEAD: "Given up after too many tries; `traceback` has the last one.",
}


def checked(kind: type[Record], what: str, **fields: Any) -> Record:
    """Return a record of the API; the error lists its invalid fields.

    Raises
    ------
    InvalidRequest : a field is missing, unknown or out of its range.
    """
    return record_of(kind, fields, what)


def record_of(kind: type[Record], fields: object, what: str) -> Record:
    """Return the record of an untrusted mapping, which may have any keys; raises as `checked`."""
    try:
        return kind.model_validate(fields)
    except ValidationError as error:
        raise invalid_record(error, what) from error


def invalid_record(error: ValidationError, what: str) -> InvalidRequest:
    """Return the error of a record that pydantic refused."""
    found = error.errors(include_url=False, include_input=False)
    return invalid_request(found, what)


#: Fields that are listed at most, and characters of the name of one: a caller may invent more.
MOST_FIELDS, MOST_OF_FIELD = 20, 80


def invalid_request(found: Sequence[Mapping[str, Any]], what: str) -> InvalidRequest:
    """Return an error that names the first of the fields at fault."""
    fields = tuple(
        (
            ".".join(str(part) for part in one["loc"] if part != "query")[:MOST_OF_FIELD],
            fault_reason(one),
        )
        for one in found[:MOST_FIELDS]
    )
    first = "; ".join(f"{place or 'it'}: {reason}" for place, reason in fields[:3])
    more = f" (and {len(found) - 3} more)" if len(found) > 3 else ""
    if len(found) > MOST_FIELDS:
        more = f" (and {len(found) - 3} more; {MOST_FIELDS} of {len(found)} are listed)"
    return InvalidRequest(f"{what} is not valid: {first}{more}. See /docs for its fields.", fields)


#: Most samples a depth image may have (an 8-megapixel sensor); more is refused unread.
MAXIMUM_SAMPLES = 8_388_608


# The camera.


#: Longest focal length and farthest principal point that are believed, pixels.
MAXIMUM_PIXELS = 1e7


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera: pixel = (fx x/z + cx, fy y/z + cy), pixel centres at integers.

    Parameters
    ----------
    width, height : size of the image, pixels
    fx, fy : focal lengths, pixels
    cx, cy : principal point, pixels
    distortion : Brown-Conrady coefficients k1, k2, p1, p2[, k3] in OpenCV's order and
        meaning; empty for an image without distortion

    Raises
    ------
    InvalidIntrinsics : a size below 1, a focal length that is not positive and finite, a
        principal point that is not finite, or a number of coefficients other than 0, 4, 5.
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
                f"The image size {self.width} x {self.height} is empty. "
                "Give the width and height of the depth image in pixels."
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
                    "have no direction. Give it in pixels, as the sensor's calibration states."
                )
            if not 1e-3 <= value <= MAXIMUM_PIXELS:
                raise InvalidIntrinsics(
                    f"The focal length {name} = {value:g} is that of no camera. "
                    "Give it in pixels, as the sensor's calibration states."
                )
        if not (math.isfinite(self.cx) and math.isfinite(self.cy)):
            raise InvalidIntrinsics(
                f"The principal point ({self.cx}, {self.cy}) is not finite. "
                "Give cx and cy in pixels, as the sensor's calibration states."
            )
        if max(abs(self.cx), abs(self.cy)) > MAXIMUM_PIXELS:
            raise InvalidIntrinsics(
                f"The principal point ({self.cx:g}, {self.cy:g}) is that of no camera. "
                "Give cx and cy in pixels, as the sensor's calibration states."
            )
        if len(self.distortion) not in (0, 4, 5):
            raise InvalidIntrinsics(
                f"{len(self.distortion)} distortion coefficients were given. "
                "Give k1, k2, p1, p2 and optionally k3, or none."
            )
        if not all(math.isfinite(k) for k in self.distortion):
            raise InvalidIntrinsics(
                f"The distortion coefficients {self.distortion} are not all finite. "
                "Give k1, k2, p1, p2 and optionally k3 as the calibration states."
            )

    def without_distortion(self) -> Intrinsics:
        """Return the same camera after its images have been undistorted."""
        return replace(self, distortion=())


#: Tags of a frame.
MOST_TAGS = 32

#: A frame's place in its session is at most this, which every reader of JSON reads exactly.
MOST_SEQUENCE = 2**53 - 1
#: Place of a frame within its session.
Place = Annotated[int, Field(ge=0, le=MOST_SEQUENCE)]

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
        default=[],
        max_length=5,
        description="k1, k2, p1, p2[, k3] of OpenCV; no distortion by default.",
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
        default=None, description="ROS's name `position` is accepted as well."
    )
    rotation: GivenQuaternion | None = Field(
        default=None, description="ROS's name `orientation` is accepted as well."
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
        description="Poses are only combined within one parent frame; default: ROBOT/SESSION.",
    )
    of: Literal["sensor", "base"] = Field(
        default="sensor",
        description="`base`, for an upload with `T_base_sensor`: the pose is T_parent_base, and "
        "is stored as that of the sensor.",
    )


class GivenBase(GivenTransform):
    """T_base_sensor: the pose of the sensor on the robot; x_base = T_base_sensor @ x_sensor."""

    base_frame: Label = Field(default="base_link", description="Name of the robot's base frame.")


class FrameMeta(Given):
    """Metadata of a frame."""

    intrinsics: CameraIntrinsics | None = Field(
        default=None,
        description="Camera of a depth image, which requires it; a point cloud has none.",
    )
    depth_scale: float = Field(
        default=1000.0,
        gt=0,
        description="Stored units per metre; ignored for floating NPY files, which are in metres.",
    )
    depth_along_ray: bool = Field(
        default=False, description="Whether samples are ranges along the pixel's ray."
    )
    trust_depth: bool = Field(
        default=False,
        description="Whether to accept a depth image that does not look like one, such as with "
        "more noise than any known sensor has.",
    )
    viewpoint: GivenVector | Literal["file"] | None = Field(
        default="file",
        description="Viewpoint of a point cloud in its own axes, metres; null without one, as "
        "for clouds fused from many views. `file`: the viewpoint in the file (a PCD's "
        "VIEWPOINT), else the origin of its coordinates.",
    )
    units_per_metre: float = Field(
        default=1.0, gt=0, description="Units of a point cloud: 1000 for millimetres."
    )
    format: CloudFormat | None = Field(
        default=None,
        description="Format of a point cloud. KITTI's files cannot be recognised: set `kitti`.",
    )
    robot: Label | None = Field(default=None, description="Robot that took the frame.")
    session: Label | None = Field(default=None, description="Name of the run.")
    captured_at: AwareDatetime | None = Field(
        default=None,
        description="Time of capture, with its time zone.",
    )
    name: FileName | None = Field(
        default=None,
        description="Name of the original file or message, such as `frame-000123.depth.png`, by "
        "which you find the frame again. It is a label, and never used as a path.",
    )
    sequence: Place | None = Field(
        default=None,
        description="Position in the session, such as the number of the file or message. It "
        "orders frames without `captured_at`, whatever the order of upload.",
    )
    pose: GivenPose | None = None
    T_base_sensor: GivenBase | None = Field(
        default=None,
        description="Pose of the sensor on the robot; answers then state the pose of its base "
        "as well. A cloud with a `viewpoint` other than its origin gets the base frame `cloud` "
        "by default: the coordinates as they were sent.",
    )
    up: Up | None = Field(
        default=None,
        description="Up direction as an IMU measures it: a unit vector in the sensor's axes, of "
        "a camera x right, y down, z forward. A level camera has (0, -1, 0). It excludes "
        "transforms that tilt a query against a frame.",
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


# What `if_novel` of an upload means, however it is given.

#: Where `if_novel` is just true: consecutive frames of a slow Kinect lie nearer than this, mostly
#: by the noise of their depth, and what is left of a recording answers as well (docs/).
NOVEL = 0.25


def novelty_of(given: bool | float | str | None) -> float | None:
    """Return the minimum distance of a new place, as a share of that of unrelated frames.

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


def is_loopback(host: str) -> bool:
    """Return whether a name or address, without port or brackets, is only ever this machine."""
    if host.lower() == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
