"""Frames as JSON."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from datetime import datetime
from statistics import fmean, median
from typing import Annotated, Literal, get_args

from pydantic import (
    Discriminator,
    Field,
    StringConstraints,
    Tag,
    computed_field,
    model_validator,
)

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

#: A frame's priority is a whole number from minus this to this.
MOST_PRIORITY = 10

#: What a frame is: a depth image or a point cloud.
Kind = Literal["depth", "cloud"]


#: What depth cameras measure, metres: between which lie the median and the 5th percentile, and
#: below which the 95th. Of recordings of two Kinects, an Xtion and a RealSense they are 1.05 to
#: 2.8, .65 to 1.6 and 2.8 to 6.4; of nine consecutive frames .83 to 3.6, .39 to 2.24, and 6.9 at
#: most. Depth in quarters of a millimetre that is taken for millimetres is four times as far away.
_MEDIAN_M, _NEAR_M, _FAR_M = (0.2, 5.0), (0.3, 2.3), 10.0


class SampleRange(ApiRecord):
    """Range of a frame's samples: depths, or distances of points from the sensor, metres."""

    near: float = Field(description="Metres; 5 % of the samples are nearer.")
    median: float
    far: float = Field(description="Metres; 5 % of the samples are farther away.")
    count: int = Field(description="Number of pixels with depth, or of points.")
    valid: float | None = Field(
        default=None, description="Share of the pixels that have depth; null for a cloud."
    )

    @property
    def is_doubtful(self) -> bool:
        """Return whether hardly any depth camera measures such a range."""
        return self.valid is not None and not (
            _MEDIAN_M[0] < self.median < _MEDIAN_M[1]
            and _NEAR_M[0] < self.near < _NEAR_M[1]
            and self.far < _FAR_M
        )

    def __str__(self) -> str:
        what = "range" if self.valid is None else "depth"
        text = f"{what} {self.near:.2g} to {self.far:.2g} m (5th to 95th percentile)"
        if self.valid is None:
            return f"{text}, {self.count} points"
        text += f", {_percent(self.valid)} of pixels valid"
        if not self.is_doubtful:
            return text
        return (
            f"{text}; a median of {self.median:.2g} m from {self.near:.2g} m on is unusual for a "
            "depth camera: check its unit, and give the stored units per metre (--depth-scale) if "
            "it is not the millimetre"
        )


def _percent(share: float) -> str:
    return f"{100 * share:.0f} %" if share > 0.01 else f"{100 * share:.2g} %"


def pooled_range(ranges: Iterable[SampleRange]) -> SampleRange | None:
    """Return the range of several frames of one kind: the medians of theirs, and all their samples;
    None of no frames.
    """
    found = list(ranges)
    if not found:
        return None
    shares = [one.valid for one in found if one.valid is not None]
    return SampleRange(
        near=median(one.near for one in found),
        median=median(one.median for one in found),
        far=median(one.far for one in found),
        count=sum(one.count for one in found),
        valid=fmean(shares) if shares else None,
    )


class UploadSummary(ApiRecord):
    """Summary of an upload of several frames: poses, frames that were left out, and ranges."""

    frames: int = Field(description="Frames that were sent, or found in an archive.")
    poses: int = Field(description="Of these, those that the map has with their poses.")
    without_pose: dict[str, int] = Field(description="How many others there are for each reason.")
    left_out: list[str] = Field(default=[], description="What is not among the frames, and why.")
    lost: int = Field(
        default=0,
        description="Frames among these that hold depth or points, which nobody left out.",
    )
    depth: SampleRange | None = Field(
        default=None, description="Of all depth images: the medians of their ranges."
    )
    points: SampleRange | None = Field(default=None, description="Of all clouds, likewise.")

    @computed_field(description="All of it as one line.")  # type: ignore[prop-decorator]
    @property
    def text(self) -> str:
        """Return all of it as one line, for people."""
        parts = [f"poses of {self.poses} of {self.frames} frames"]
        parts += [f"{count} without: {why}" for why, count in self.without_pose.items() if why]
        parts += [*self.left_out, *(str(one) for one in (self.depth, self.points) if one)]
        return "; ".join(parts)


def upload_summary(
    frames: int, without_pose: Mapping[str, int], ranges: Iterable[SampleRange],
    left_out: Sequence[str] = (), lost: int = 0,
) -> UploadSummary:  # fmt: skip
    """Return the summary of an upload.

    Parameters
    ----------
    frames, left_out, lost : as in UploadSummary
    without_pose : number of frames by the reason why they have none
    ranges : of the frames that the map has
    """
    of_frames = list(ranges)
    return UploadSummary(
        frames=frames,
        poses=frames - sum(without_pose.values()),
        without_pose=dict(without_pose),
        left_out=list(left_out),
        lost=lost,
        depth=pooled_range(one for one in of_frames if one.valid is not None),
        points=pooled_range(one for one in of_frames if one.valid is None),
    )


class Added(ApiRecord):
    """The result of an upload."""

    frame_id: str
    job_id: str = Field(description="Id of the job that signs it: GET /v1/jobs/{job_id}.")
    state: FrameState
    reason: str | None = Field(
        default=None, description="Why the frame was rejected, failed, or was not kept."
    )
    samples: SampleRange | None = Field(
        default=None, description="Range of its samples; see Frame."
    )
    has_pose: bool = Field(default=False, description="Whether the frame has a pose.")


class Frame(ApiRecord):
    """A frame of a map."""

    frame_id: str
    map: str
    state: FrameState
    reason: str | None = Field(description="Why the frame was rejected, failed, or was not kept.")
    job_id: str
    content_id: str | None = Field(
        description="Hash of samples and camera, or of points and viewpoint; null if deleted."
    )
    kind: Kind = "depth"
    bytes: int = Field(description="Size of the upload.")
    intrinsics: CameraIntrinsics | None = Field(description="Null for a cloud.")
    depth_scale: float | None = Field(description="Null for a cloud.")
    depth_along_ray: bool | None = Field(description="Null for a cloud.")
    trust_depth: bool | None = Field(
        default=None, description="Whether it was accepted although it may not look like depth."
    )
    samples: SampleRange | None = Field(
        default=None, description="Range of its samples; null if purged."
    )
    points: int | None = Field(default=None, description="Number of points of a cloud.")
    viewpoint: Vector | None = Field(
        default=None, description="Viewpoint of a cloud in its own coordinates; null without one."
    )
    units_per_metre: float | None = Field(default=None, description="Null for a depth image.")
    note: str | None = Field(
        default=None, description="How the points of a cloud were changed on reading, or null."
    )
    robot: str | None
    session: str | None
    name: str | None = Field(default=None, description="Name of the original file or message.")
    sequence: int | None = Field(default=None, description="Position in the session.")
    captured_at: datetime | None
    received_at: datetime
    indexed_at: datetime | None
    pose: Transform | None
    sent_pose: Transform | None = Field(
        default=None,
        description="The pose as it was sent, if the map joined its parent frame to that of "
        "`pose`; else null.",
    )
    base_frame: str | None = Field(default=None, description="Name of the robot's base frame.")
    T_base_sensor: Transform | None = Field(
        default=None, description="Pose of the sensor on the robot, as it was sent."
    )
    up: Direction | None = Field(
        default=None, description="Up direction in the sensor's axes, as it was sent."
    )
    tags: list[str]
    etag: str | None = Field(
        default=None,
        description="Version of what PATCH can change. Sent in If-Match, in quotes, it prevents "
        "an edit from overwriting another.",
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
    StringConstraints(min_length=1, max_length=64, pattern=FOLDER_NAME),
]


class BatchItem(ApiRecord):
    """The result of one frame of a batch."""

    status: int = Field(
        description="Status as for a single upload: 202 received, 200 already in the map, 403 "
        "beyond the map's quota, 409 or 422 refused."
    )
    frame: Added | None = Field(description="Null if the frame was refused.")
    problem: Problem | None = Field(description="Why the frame was refused, or null.")


class Batch(ApiRecord):
    """The result of a batch; received frames are stored durably."""

    items: list[BatchItem] = Field(
        description="One item for each frame, in the order in which they were sent."
    )


#: An axis of a file's coordinates, or its opposite.
Axis = Literal["x", "-x", "y", "-y", "z", "-z"]
#: Up as an axis of a file, or in the axes of a sensor.
AxisOrUp = Annotated[
    Annotated[Axis, Tag("axis")] | Annotated[Up, Tag("direction")],
    Discriminator(lambda up: "axis" if isinstance(up, str) else "direction"),
]
#: Of frames that were rendered from a map that came as one file.
VIRTUAL = "virtual"
#: Options that only an import of frames has, and those that only one of a whole map has.
_OF_FRAMES = ("with_poses", "every", "T_base_sensor", "trust_depth")
_OF_MAP = ("heights", "units_per_metre", "offset", "camera")


class ImportOptions(Given):
    """Options of an import: how its file is read, and metadata of the frames that it adds."""

    as_: Literal["frames", "map"] = Field(
        default="frames",
        alias="as",
        description="`frames`: an archive of sequences, whose frames are added. `map`: a cloud or "
        "mesh of a whole place, of which views are rendered and added, tagged `virtual`.",
    )
    name: FolderName = Field(
        default="import",
        description="Names what lies at the top of the archive, outside of any folder. Of a map, "
        "the name of its file.",
    )
    robot: Label | None = Field(
        default=None, description="Who took the frames, and whose the poses' frame is."
    )
    session: Label | None = Field(
        default=None,
        description="In which run; default: the name of each sequence, or of the map's file.",
    )
    tags: list[Label] = Field(default=[], max_length=MOST_TAGS, description="Of all frames.")
    parent_frame: Label | None = Field(
        default=None,
        description="What all poses lead to; default: the name of the scene, or of the map's "
        "file, after ROBOT/ if given.",
    )
    with_poses: bool = Field(default=True, description="Take the poses that are in the archive.")
    every: int = Field(default=1, ge=1, description="Take every Nth frame of a sequence.")
    trust_depth: bool = Field(default=False, description="As of an upload, of all frames.")
    T_base_sensor: GivenBase | None = Field(
        default=None, description="Where the sensor sits on the robot."
    )
    up: AxisOrUp | None = Field(
        default=None,
        description="Up in the sensor's axes, of all frames: where the sensor is carried level. Of "
        "a map, the axis of its file that points up, such as `z` or `-y`; default: as the file "
        "says, else estimated.",
    )
    heights: list[Annotated[float, Field(gt=0, le=1000)]] = Field(
        default=[],
        max_length=8,
        description="Of a map: heights of the robot's sensor above the floor, metres; default: "
        "those of the model's sensors.",
    )
    units_per_metre: float | None = Field(
        default=None,
        gt=0,
        description="Of a map: 1000 for a file in millimetres; default: as the file says, else "
        "estimated.",
    )
    offset: GivenVector | None = Field(
        default=None,
        description="Of a map: metres that are subtracted from the coordinates of its file. Files "
        "in one parent frame need the same offset. Default: none; of a file that lies more than a "
        "kilometre from its origin, its middle.",
    )
    camera: CameraIntrinsics | None = Field(
        default=None,
        description="Of a map of depth images: the robot's camera, whose views are rendered.",
    )
    priority: int = Field(
        default=0, ge=-MOST_PRIORITY, le=MOST_PRIORITY, description="Of the frames' jobs."
    )
    if_novel: float | None = Field(
        default=None, gt=0, le=1, description="As of an upload, for each frame."
    )

    @model_validator(mode="after")
    def _of_its_kind(self) -> ImportOptions:
        if self.as_ == "map":
            idle: Sequence[str] = _OF_FRAMES
            hint = "does not apply to a map; leave it out"
        else:
            idle, hint = _OF_MAP, "applies only with `as` = `map`"
        for name in idle:
            if getattr(self, name) != type(self).model_fields[name].get_default():
                raise ValueError(f"{name}: {hint}")
        if self.up is not None and isinstance(self.up, str) != (self.as_ == "map"):
            axes = f"one of {', '.join(get_args(Axis))}, the axis of the file that points up"
            raise ValueError(
                f"up: {axes if self.as_ == 'map' else 'a unit vector in the axes of the sensor'}"
            )
        if self.as_ == "map" and len(self.tags) >= MOST_TAGS:
            raise ValueError(f"tags: at most {MOST_TAGS - 1}, as {VIRTUAL!r} is added")
        return self


def camera_fields(text: str) -> dict[str, float]:
    """Return the fields of a camera that is written as `fx,fy,cx,cy,width,height`.

    Raises
    ------
    InvalidRequest : these are not six numbers.
    """
    return _number_fields("camera", text, ("fx", "fy", "cx", "cy", "width", "height"), "pixels")


def offset_fields(text: str) -> dict[str, float]:
    """Return the fields of an offset that is written as `x,y,z`.

    Raises
    ------
    InvalidRequest : these are not three numbers.
    """
    return _number_fields("offset", text, ("x", "y", "z"), "metres")


def _number_fields(what: str, text: str, names: Sequence[str], unit: str) -> dict[str, float]:
    """Return numbers that are written with commas between, by their names."""
    try:
        return dict(zip(names, map(float, text.split(",")), strict=True))
    except ValueError as error:
        raise InvalidRequest(
            f"The {what} {text!r:.80} is not {len(names)} numbers. Write {','.join(names)}, in "
            f"{unit}.",
            ((what, f"not {','.join(names)}"),),
        ) from error


class WeakArea(ApiRecord):
    """A square of the floor in which a robot would not be found reliably."""

    centre: Vector = Field(description="In the parent frame of the map, on the floor.")
    width_m: float
    views: int = Field(description="Views in it that were looked up.")
    found: int = Field(description="Of these, those that were found at their poses.")


class MapImportResult(ApiRecord):
    """Result of the import of a whole map: `result` of its job."""

    points: int
    triangles: int = Field(description="0 of a cloud.")
    units_per_metre: float
    units_from: str = Field(description="`stated`, `file` or `estimated`.")
    up: Direction = Field(description="In the axes of the file.")
    up_from: str = Field(description="As `units_from`.")
    offset: Vector = Field(
        description="The coordinates of the file, in metres, are those of poses plus this; zero "
        "unless the file lies far from its origin."
    )
    notes: list[str] = Field(description="What was done to the file on the way.")
    session: str
    parent_frame: str = Field(description="What the poses of all views lead to.")
    views: int = Field(description="Frames that the map has of it.")
    refused: int = Field(description="Views that could not be added: see the import's items.")
    seen: float = Field(description="Share of the surface that the views see, 0 to 1.")
    tested: int = Field(description="Views that were not added, and looked up in the end.")
    found: int = Field(description="Of these, those that were found at their poses.")
    wrong: int
    ambiguous: int
    not_found: int
    coverage: float | None = Field(
        description="`found` / `tested`, an upper bound of the share of real frames that are "
        "found; null where nothing was looked up."
    )
    weak: list[WeakArea] = Field(
        description="Where fewer than half of the tested views were found, the worst first."
    )


class ImportItem(ApiRecord):
    """The result of one frame of an archive, or of a member that is no frame."""

    name: str = Field(description="Name of the member in the archive, or of a sequence.")
    status: int = Field(description="Status as of an item of a batch.")
    frame_id: str | None = Field(description="Null if the frame was refused.")
    job_id: str | None = Field(description="Id of the job that signs it.")
    problem: Problem | None = Field(description="Why it was refused, or null.")
    samples: SampleRange | None = Field(
        default=None, description="Range of its samples; see Frame."
    )
    has_pose: bool = Field(default=False, description="Whether the archive has a pose of it.")


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
