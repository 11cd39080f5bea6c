"""Records of frames, uploads, batches and imports."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from statistics import fmean, median
from typing import Annotated, Literal, get_args

from pydantic import Discriminator, Field, StringConstraints, Tag, computed_field, model_validator

from sceneprint_client.api.base import (
    FOLDER_NAME,
    MOST_TAGS,
    ApiRecord,
    CameraIntrinsics,
    Direction,
    FrameState,
    Given,
    GivenBase,
    GivenVector,
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

#: Maximum absolute value of a frame's priority.
MOST_PRIORITY = 10

#: Kind of a frame: a depth image or a point cloud.
Kind = Literal["depth", "cloud"]


#: Usual depths of depth cameras, metres: range of the median, range of the 5th percentile, and
#: maximum of the 95th. In recordings of two Kinects, an Xtion and a RealSense, they are 1.05 to
#: 2.8, .65 to 1.6 and 2.8 to 6.4; pooled over nine consecutive frames, .83 to 3.6, .39 to 2.24 and
#: at most 6.9. Depth in quarters of a millimetre, read as millimetres, is four times too large.
_MEDIAN_M, _NEAR_M, _FAR_M = (0.2, 5.0), (0.3, 2.3), 10.0
#: Usual medians of scanners, metres; in 453 scans of three LiDARs, they are 3.3 to 26.
_SCANNED_M = (0.2, 500.0)


class SampleRange(ApiRecord):
    """Range of a frame's depths, or of the distances of its points from the sensor, metres."""

    near: float = Field(description="5th percentile, metres.")
    median: float
    far: float = Field(description="95th percentile, metres.")
    count: int = Field(description="Number of pixels with depth, or number of points.")
    valid: float | None = Field(
        default=None, description="Share of the pixels with depth; null for a cloud."
    )

    @property
    def is_doubtful(self) -> bool:
        """Return whether the range is unusual for a sensor of its kind, a camera or a scanner."""
        if self.valid is None:
            return not _SCANNED_M[0] < self.median < _SCANNED_M[1]
        return not (
            _MEDIAN_M[0] < self.median < _MEDIAN_M[1]
            and _NEAR_M[0] < self.near < _NEAR_M[1]
            and self.far < _FAR_M
        )

    def __str__(self) -> str:
        what = "range" if self.valid is None else "depth"
        amount = (
            f"{self.count} points"
            if self.valid is None
            else f"{_percent(self.valid)} of pixels valid"
        )
        text = f"{what} {self.near:.2g} to {self.far:.2g} m (5th to 95th percentile), {amount}"
        if not self.is_doubtful:
            return text
        if self.valid is None:
            return (
                f"{text}; a median of {self.median:.2g} m is unusual for a scanner: check that the "
                "coordinates are metres"
            )
        return (
            f"{text}; a median of {self.median:.2g} m and a 5th percentile of {self.near:.2g} m "
            "are unusual for a depth camera: check that the images are depth, not infrared or "
            "disparity, and specify the depth scale if the unit is not the millimetre; "
            "floating-point samples must be metres"
        )


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share > 0.01 else f"{100 * share:.2g} %"


def pooled_range(ranges: Iterable[SampleRange]) -> SampleRange | None:
    """Return the range of several frames of one kind, with the medians of their percentiles and
    their total count; None if there are no frames.
    """
    all_ranges = list(ranges)
    if not all_ranges:
        return None
    shares = [part.valid for part in all_ranges if part.valid is not None]
    return SampleRange(
        near=median(part.near for part in all_ranges),
        median=median(part.median for part in all_ranges),
        far=median(part.far for part in all_ranges),
        count=sum(part.count for part in all_ranges),
        valid=fmean(shares) if shares else None,
    )


class UploadSummary(ApiRecord):
    """Summary of an upload of several frames: poses, omitted data and ranges."""

    frames: int = Field(description="Number of frames that were sent or found in an archive.")
    poses: int = Field(description="Number of frames with a pose in the map.")
    without_pose: dict[str, int] = Field(description="Number of frames without a pose, by reason.")
    left_out: list[str] = Field(default=[], description="Omitted data, with the reasons.")
    lost: int = Field(
        default=0,
        description="Number of frames with depth or points that were omitted although no option "
        "excluded them.",
    )
    depth: SampleRange | None = Field(
        default=None, description="Pooled range of all depth images: medians over the images."
    )
    points: SampleRange | None = Field(default=None, description="Pooled range of all clouds.")

    @computed_field(description="The summary in one line.")  # type: ignore[prop-decorator]
    @property
    def text(self) -> str:
        """The summary in one line."""
        parts = [f"poses of {self.poses} of {self.frames} frames"]
        parts += [f"{count} without: {why}" for why, count in self.without_pose.items() if why]
        parts += [*self.left_out, *(str(pooled) for pooled in (self.depth, self.points) if pooled)]
        return "; ".join(parts)


def upload_summary(
    frames: int, without_pose: Mapping[str, int], ranges: Iterable[SampleRange],
    left_out: Sequence[str] = (), lost: int = 0,
) -> UploadSummary:  # fmt: skip
    """Return the summary of an upload.

    Parameters
    ----------
    frames, left_out, lost : see UploadSummary
    without_pose : number of frames without a pose, by the reason
    ranges : ranges of the frames in the map
    """
    all_ranges = list(ranges)
    return UploadSummary(
        frames=frames,
        poses=frames - sum(without_pose.values()),
        without_pose=dict(without_pose),
        left_out=list(left_out),
        lost=lost,
        depth=pooled_range(part for part in all_ranges if part.valid is not None),
        points=pooled_range(part for part in all_ranges if part.valid is None),
    )


class Added(ApiRecord):
    """The result of an upload."""

    frame_id: str
    job_id: str = Field(
        description="Id of the job that signs the frame; see GET /v1/jobs/{job_id}."
    )
    state: FrameState
    reason: str | None = Field(
        default=None, description="Reason why the frame was rejected, failed or is redundant."
    )
    samples: SampleRange | None = Field(
        default=None, description="Range of the frame's samples; see Frame."
    )
    has_pose: bool = Field(default=False, description="Whether the frame has a pose.")


class Frame(ApiRecord):
    """A frame of a map."""

    frame_id: str
    map: str
    state: FrameState
    reason: str | None = Field(
        description="Reason why the frame was rejected, failed or is redundant."
    )
    job_id: str
    content_id: str | None = Field(
        description="Hash of the samples and the camera, or of the points and the viewpoint; null "
        "after the frame was deleted."
    )
    kind: Kind = "depth"
    bytes: int = Field(description="Size of the upload.")
    intrinsics: CameraIntrinsics | None = Field(description="Camera intrinsics; null for a cloud.")
    depth_scale: float | None = Field(description="Stored units per metre; null for a cloud.")
    depth_along_ray: bool | None = Field(
        description="Whether samples are distances along the ray of the pixel instead of the "
        "optical axis; null for a cloud."
    )
    trust_depth: bool | None = Field(
        default=None, description="Whether the sanity check of depth images was skipped."
    )
    samples: SampleRange | None = Field(
        default=None, description="Range of the samples; null after the frame was purged."
    )
    points: int | None = Field(default=None, description="Number of points of a cloud.")
    viewpoint: Vector | None = Field(
        default=None, description="Viewpoint of a cloud in its own coordinates; null if unknown."
    )
    units_per_metre: float | None = Field(
        default=None, description="Units per metre of a cloud; null for a depth image."
    )
    note: str | None = Field(
        default=None,
        description="Changes to the points of a cloud when it was read; null if there were none.",
    )
    robot: str | None
    session: str | None
    name: str | None = Field(default=None, description="Name of the original file or message.")
    sequence: int | None = Field(default=None, description="Index in the session.")
    captured_at: datetime | None
    received_at: datetime
    indexed_at: datetime | None
    pose: Transform | None
    sent_pose: Transform | None = Field(
        default=None,
        description="Pose as uploaded, if its parent frame was joined to that of `pose`; otherwise "
        "null.",
    )
    base_frame: str | None = Field(default=None, description="Name of the robot's base frame.")
    T_base_sensor: Transform | None = Field(
        default=None, description="Pose of the sensor on the robot, as uploaded."
    )
    up: Direction | None = Field(
        default=None, description="Up direction in the sensor's axes, as uploaded."
    )
    tags: list[str]
    etag: str | None = Field(
        default=None,
        description="Entity tag of the editable fields. Send it in If-Match, in quotes, so that "
        "your edit does not overwrite another edit.",
    )


# Batches and imports of archives.

#: Pattern of frame ids that clients choose.
FRAME_ID = r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}"
#: Maximum number of frames in one batch.
MOST_OF_BATCH = 64
#: Status codes of refused frames; 422 for all other errors.
_STATUSES: dict[type[SceneprintError], int] = {Conflict: 409, QuotaExceeded: 403}


#: Name that is valid for a folder.
FolderName = Annotated[
    str,
    StringConstraints(min_length=1, max_length=64, pattern=FOLDER_NAME),
]


class BatchItem(ApiRecord):
    """The result of one frame of a batch."""

    status: int = Field(
        description="Status code as for a single upload: 202 received, 200 already in the map, 403 "
        "quota exceeded, 409 or 422 refused."
    )
    frame: Added | None = Field(description="Added frame; null if the frame was refused.")
    problem: Problem | None = Field(
        description="Details of the error if the frame was refused; otherwise null."
    )


class Batch(ApiRecord):
    """The result of a batch. Received frames are stored durably."""

    items: list[BatchItem] = Field(
        description="One item for each frame, in the order of the request."
    )


#: Coordinate axis of a file, or the opposite direction.
Axis = Literal["x", "-x", "y", "-y", "z", "-z"]
#: Up direction as an axis of a file, or as a vector in the axes of a sensor.
AxisOrUp = Annotated[
    Annotated[Axis, Tag("axis")] | Annotated[Up, Tag("direction")],
    Discriminator(lambda up: "axis" if isinstance(up, str) else "direction"),
]
#: Tag of frames that were rendered from an imported map.
VIRTUAL = "virtual"
#: Options for imports of frames and recordings, and options for imports of whole maps only.
_OF_FRAMES = ("with_poses", "every", "T_base_sensor", "trust_depth")
_OF_MAP = ("heights", "units_per_metre", "offset", "camera")
#: Options for imports of recordings only, with the same names as those of `sceneprint upload`.
RECORDING_OPTIONS = (
    "topic", "camera_info", "pose_frame", "sensor_frame", "depth_scale", "keyframe_m",
    "keyframe_deg", "keyframe_s",
)  # fmt: skip
_TopicName = Annotated[str, Field(min_length=1, max_length=255)]


class ImportOptions(Given):
    """Options of an import: how to read the file, and metadata of the added frames."""

    as_: Literal["frames", "map", "recording"] = Field(
        default="frames",
        alias="as",
        description="`frames`: an archive of sequences; their frames are added. `map`: a cloud or "
        "mesh of a whole place; rendered views of the place are added, with the tag `virtual`. "
        "`recording`: an MCAP file or ROS 1 bag; its keyframes are added.",
    )
    name: FolderName = Field(
        default="import",
        description="Name for a sequence that is not in a folder of the archive. For a map or a "
        "recording, the name of its file.",
    )
    robot: Label | None = Field(
        default=None,
        description="Robot that took the frames; also the prefix of the default parent frame.",
    )
    session: Label | None = Field(
        default=None,
        description="Session of the frames; default: the name of each sequence, or of the map's "
        "file.",
    )
    tags: list[Label] = Field(default=[], max_length=MOST_TAGS, description="Tags of all frames.")
    parent_frame: Label | None = Field(
        default=None,
        description="Parent frame of all poses; default: the name of the scene or of the map's "
        "file, with the prefix ROBOT/ if `robot` is specified.",
    )
    with_poses: bool = Field(default=True, description="Whether to use the poses in the archive.")
    every: int = Field(default=1, ge=1, description="Import every n-th frame of a sequence.")
    trust_depth: bool = Field(default=False, description="See FrameMeta; applies to all frames.")
    T_base_sensor: GivenBase | None = Field(
        default=None, description="Pose of the sensor on the robot."
    )
    up: AxisOrUp | None = Field(
        default=None,
        description="Up direction in the sensor's axes, for all frames; specify it only if the "
        "sensor is carried level. For a map, the axis of its file that points up, such as `z` or "
        "`-y`; default: the up axis that the file specifies, otherwise an estimate.",
    )
    heights: list[Annotated[float, Field(gt=0, le=1000)]] = Field(
        default=[],
        max_length=8,
        description="For a map: heights of the robot's sensor above the floor, metres; default: "
        "typical heights of the model's sensors.",
    )
    units_per_metre: float | None = Field(
        default=None,
        gt=0,
        description="For a map: units per metre, such as 1000 for millimetres; default: the unit "
        "that the file specifies, otherwise an estimate.",
    )
    offset: GivenVector | None = Field(
        default=None,
        description="For a map: offset to subtract from the coordinates of its file, metres. Files "
        "in the same parent frame need the same offset. Default: the centre of the file if it is "
        "more than a kilometre from the origin, otherwise no offset.",
    )
    camera: CameraIntrinsics | None = Field(
        default=None,
        description="For a map of depth images: the robot's camera, for which views are rendered.",
    )
    topic: _TopicName | None = Field(
        default=None,
        description="For a recording: topic of depth images or points; default: the only such "
        "topic.",
    )
    camera_info: _TopicName | None = Field(
        default=None,
        description="For a recording: topic of the camera info; default: `camera_info` beside the "
        "images, otherwise the only topic with the coordinate frame of the images.",
    )
    pose_frame: _TopicName | None = Field(
        default=None,
        description="For a recording: frame of the poses; default: the first of `map`, `odom` and "
        "`world` that exists, otherwise the topmost frame.",
    )
    sensor_frame: _TopicName | None = Field(
        default=None,
        description="For a recording with points in a world frame: frame of the sensor; default: "
        "the only descendant of the world frame without children.",
    )
    depth_scale: float | None = Field(
        default=None,
        gt=0,
        description="For a recording: stored units per metre of 16-bit depth; default: 1000.",
    )
    keyframe_m: float = Field(
        default=0.3,
        ge=0,
        description="For a recording: minimum distance between frames, metres; 0 selects every "
        "frame. A rotation by `keyframe_deg` is also sufficient.",
    )
    keyframe_deg: float = Field(
        default=15, ge=0, description="For a recording: minimum rotation between frames, degrees."
    )
    keyframe_s: float = Field(
        default=0.5,
        ge=0,
        description="For a recording without poses: minimum time between frames, seconds.",
    )
    priority: int = Field(
        default=0, ge=-MOST_PRIORITY, le=MOST_PRIORITY, description="Priority of the frames' jobs."
    )
    if_novel: float | None = Field(
        default=None, gt=0, le=1, description="As for the upload of a frame; applies to each frame."
    )

    @model_validator(mode="after")
    def _require_matching_options(self) -> ImportOptions:
        unused = dict.fromkeys(_OF_FRAMES, "does not apply to a map; omit it")
        if self.as_ != "map":
            unused = dict.fromkeys(_OF_MAP, "applies only if `as` is `map`")
        if self.as_ != "recording":
            unused |= dict.fromkeys(RECORDING_OPTIONS, "applies only if `as` is `recording`")
        for name, hint in unused.items():
            if getattr(self, name) != type(self).model_fields[name].get_default():
                raise ValueError(f"{name}: {hint}")
        if self.up is not None and isinstance(self.up, str) != (self.as_ == "map"):
            axes = f"one of {', '.join(get_args(Axis))}, the axis of the file that points up"
            raise ValueError(
                f"up: {axes if self.as_ == 'map' else 'a unit vector in the axes of the sensor'}"
            )
        if self.as_ == "map" and len(self.tags) >= MOST_TAGS:
            raise ValueError(f"tags: at most {MOST_TAGS - 1}, because {VIRTUAL!r} is added")
        return self


def camera_fields(text: str) -> dict[str, float]:
    """Return the fields of a camera in the format `fx,fy,cx,cy,width,height`.

    Raise InvalidRequest if the text is not six numbers.
    """
    return _number_fields("camera", text, ("fx", "fy", "cx", "cy", "width", "height"), "pixels")


def offset_fields(text: str) -> dict[str, float]:
    """Return the fields x, y and z, metres, of an offset such as `10,0,0`.

    Raise InvalidRequest if the text is not three numbers.
    """
    return _number_fields("offset", text, ("x", "y", "z"), "metres")


def _number_fields(what: str, text: str, names: Sequence[str], unit: str) -> dict[str, float]:
    """Return comma-separated numbers by name; raise InvalidRequest for other text."""
    try:
        return dict(zip(names, map(float, text.split(",")), strict=True))
    except ValueError as error:
        raise InvalidRequest(
            f"The {what} {text!r:.80} is not {len(names)} numbers. Write {','.join(names)} in "
            f"{unit}.",
            ((what, f"not {','.join(names)}"),),
        ) from error


class WeakArea(ApiRecord):
    """A square of the floor in which localisation is unreliable."""

    centre: Vector = Field(description="Centre on the floor, in the parent frame of the map.")
    width_m: float
    views: int = Field(description="Number of test views in the square.")
    found: int = Field(
        description="Number of test views in the square that were found at their poses."
    )


class MapImportResult(ApiRecord):
    """Result of the import of a whole map, in the `result` of its job."""

    points: int
    triangles: int = Field(description="Number of triangles; 0 for a cloud.")
    units_per_metre: float
    units_from: str = Field(description="Source of the unit: `stated`, `file` or `estimated`.")
    up: Direction = Field(description="Up direction in the axes of the file.")
    up_from: str = Field(description="Source of `up`: `stated`, `file` or `estimated`.")
    offset: Vector = Field(
        description="Offset, metres. Coordinates in the file are coordinates of the poses plus "
        "this offset. It is zero unless it was specified or the file is far from its origin."
    )
    notes: list[str] = Field(description="Changes that the import made to the content of the file.")
    session: str
    parent_frame: str = Field(description="Parent frame of the poses of all views.")
    views: int = Field(description="Number of views that were added as frames.")
    refused: int = Field(
        description="Number of views that could not be added; see the import's items."
    )
    seen: float = Field(description="Share of the surface that the views see, 0 to 1.")
    tested: int = Field(description="Number of test views, which were queried but not added.")
    found: int = Field(description="Number of test views that were found at their poses.")
    wrong: int
    ambiguous: int
    not_found: int
    coverage: float | None = Field(
        description="`found` / `tested`, an upper bound for the share of real frames that will be "
        "found; null if there were no test views."
    )
    weak: list[WeakArea] = Field(
        description="Areas in which fewer than half of the test views were found, worst first."
    )


#: Maximum number of topics in an outline, which lists usable topics first.
MOST_RECORDING_TOPICS = 200


class RecordingTopic(ApiRecord):
    """A topic of a recording."""

    name: str
    type: str = Field(description="Type of the messages, such as `sensor_msgs/msg/Image`.")
    count: int = Field(description="Number of messages.")
    use: str = Field(
        description="Content that the import can use, such as `16UC1`, `points` or `camera`, with "
        "`, used` for the topic of the frames; empty if the import cannot use the topic."
    )


class RecordingOutline(ApiRecord):
    """The content of a recording, and the frames that the import selects."""

    kind: str = Field(description="`ROS 1` or `ROS 2`.")
    seconds: float = Field(description="Duration, seconds.")
    span: str = Field(description="Duration and start, as text.")
    topics: list[RecordingTopic] = Field(
        description=f"At most {MOST_RECORDING_TOPICS} topics, usable topics first."
    )
    findings: list[str] = Field(
        description="Findings on the selected frames, as `sceneprint bag` prints them: omissions "
        "with reasons, the camera, poses, mounting, up, and the range of a sample."
    )
    problem: str | None = Field(
        description="Reason why no frame can be used; null if the import adds frames."
    )
    lost: int = Field(
        description="Number of frames and poses that were omitted although no option excludes "
        "them, plus the number of damaged messages."
    )


class ImportItem(ApiRecord):
    """The result of one frame of an archive, or of a skipped file."""

    name: str = Field(description="Name of the file in the archive, or of a sequence.")
    status: int = Field(description="Status code as for an item of a batch.")
    frame_id: str | None = Field(description="Id of the frame; null if the frame was refused.")
    job_id: str | None = Field(description="Id of the job that signs the frame.")
    problem: Problem | None = Field(
        description="Details of the error if the frame was refused; otherwise null."
    )
    samples: SampleRange | None = Field(
        default=None, description="Range of the frame's samples; see Frame."
    )
    has_pose: bool = Field(
        default=False, description="Whether the archive contains a pose of the frame."
    )


def problem_of(error: SceneprintError) -> Problem:
    """Return the problem document for a frame of a batch, the same as for a single upload."""
    name = kebab_case(type(error).__name__)
    fields = error.fields if isinstance(error, InvalidRequest) else ()
    listed = [{"field": place, "reason": reason} for place, reason in fields]
    document: dict[str, object] = {
        "type": f"/problems/{name}",
        "title": name.replace("-", " ").capitalize(),
        "status": next((n for kind, n in _STATUSES.items() if isinstance(error, kind)), 422),
        "detail": str(error),
    }
    return Problem.model_validate({**document, "errors": listed} if listed else document)


def check_frame_id(frame_id: str) -> None:
    """Check the id of a frame; raise InvalidRequest if the id is not safe as one part of a path."""
    if not re.fullmatch(FRAME_ID, frame_id):
        raise InvalidRequest(
            f"The frame id {frame_id!r:.80} is not valid. Use up to 64 letters, digits, dots, "
            "hyphens and underscores, starting with a letter or digit.",
            (("frame_id", "not a valid frame id"),),
        )
