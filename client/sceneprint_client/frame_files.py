"""A frame in a file: what it is, what is known of it, and what is sent of it.

Path  --find_frame_file-->  FrameFile  --meta_of-->  FrameMeta
bytes | Path | FrameFile  --sendable-->  bytes, FrameMeta
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from sceneprint_client.api.base import GivenDirection, checked
from sceneprint_client.api.frames import CameraIntrinsics, FrameMeta, GivenBase, GivenPose
from sceneprint_client.errors import DatasetError, UnreadableCloud, UnreadableFrame
from sceneprint_client.file_formats import (
    HEAD,
    MAXIMUM_CLOUD_BYTES,
    MAXIMUM_IMAGE_BYTES,
    RECORDING_SUFFIXES,
    SUFFIXES,
    format_of,
    is_cloud,
)
from sceneprint_client.files import read_bytes
from sceneprint_client.sidecars import (
    CLOUDS_FILE,
    Camera,
    CloudSource,
    Unsaid,
    find_camera,
    find_cloud_source,
    read_pose,
)

#: A depth image of the 7-Scenes layout, whose pose lies beside it.
SEVEN_SCENES = re.compile(r"frame-\d+\.depth\.png", re.ASCII)
#: Time stamps, in seconds, that are dates (2001 to 2096); others count from some start.
_DATES_S = (1e9, 4e9)


class FrameSource(Protocol):
    """Where the bytes of a frame come from that has no file of its own."""

    def read_bytes(self) -> bytes:
        """What a PNG, NPY or other file of the frame would hold; raises SceneprintError."""


@dataclass(frozen=True, eq=False)
class FrameFile:
    """The file of one frame, and what lies beside it; not yet read.

    Parameters
    ----------
    name : of the frame, after its sequence, such as "seq-01/frame-000000"
    path : the depth image, or the file of points; with `source` a path that no other frame has
    camera : the sensor; None for points
    timestamp : seconds, or None where the layout has none
    pose_source : file of the pose, the pose itself, or None where unknown
    cloud : how the points are read; None for a depth image. One of this and `camera` is given
    source : where the bytes come from, if not from the file
    base : where the sensor sits on the robot; None where not known
    """

    name: str
    path: Path
    camera: Camera | None
    timestamp: float | None = None
    pose_source: Path | NDArray[np.float64] | None = None
    cloud: CloudSource | None = None
    source: FrameSource | None = None
    base: GivenBase | None = None

    def __post_init__(self) -> None:
        if (self.camera is None) == (self.cloud is None):
            raise ValueError("a frame is a depth image with a camera, or a cloud with its source")

    @property
    def kind(self) -> Literal["depth", "cloud"]:
        """What its file holds."""
        return "depth" if self.cloud is None else "cloud"

    def read_bytes(self) -> bytes:
        """Bytes of the frame, as they are sent.

        Raises
        ------
        UnreadableFrame, UnreadableCloud : they cannot be read, or are too many.
        DatasetError : what holds them is damaged.
        """
        if self.source is not None:
            return self.source.read_bytes()
        return _read(self.path, is_cloud=self.kind == "cloud")

    @property
    def pose(self) -> NDArray[np.float64] | None:
        """(4, 4) T_parent_sensor, or None where unknown; read from its file each time.

        Raises
        ------
        InvalidPose : the file holds no rigid transform; names the file.
        """
        if isinstance(self.pose_source, Path):
            return read_pose(self.pose_source)
        return self.pose_source


def find_frame_file(file: Path) -> FrameFile:
    """One frame by its file: a depth image, or points; its pose beside it where it has one.

    Parameters
    ----------
    file : absolute

    Raises
    ------
    DatasetError : there is no intrinsics.json beside a depth image or above, or clouds.json says
        what it cannot.
    InvalidIntrinsics : the intrinsics.json describes no camera.
    """
    folder, points = file.parent, is_cloud(file.name) or _is_npy_of_points(file)
    stem = file.stem if points else file.name.removesuffix(".depth.png")
    beside = folder / f"{stem}.pose.txt"
    pose = beside if beside.is_file() else None
    if points:
        source = find_cloud_source(folder)
        return FrameFile(f"{folder.name}/{stem}", file, None, pose_source=pose, cloud=source)
    camera = find_camera(folder)
    if SEVEN_SCENES.fullmatch(file.name):
        return FrameFile(f"{folder.name}/{stem}", file, camera, pose_source=pose)
    # what is named outright is taken, whatever its name; its content decides
    return FrameFile(f"{folder.name}/{file.stem}", file, camera)


def _is_npy_of_points(file: Path) -> bool:
    """Whether clouds.json is beside it; or no camera, and its content is N x 3 or N x 4."""
    if file.suffix.lower() != ".npy":
        return False
    if (file.parent / CLOUDS_FILE).is_file():
        return True
    try:
        find_camera(file.parent)
    except DatasetError:
        pass
    else:
        return False
    try:
        with file.open("rb") as opened:
            return format_of(opened.read(HEAD)) == "npy"
    except OSError:  # whoever reads the frame says why
        return False


def meta_of(
    reference: FrameFile,
    *,
    robot: str | None = None,
    session: str | None = None,
    tags: Iterable[str] = (),
    with_pose: bool = True,
    parent_frame: str | None = None,
    base: GivenBase | None = None,
    up: Sequence[float] | None = None,
) -> FrameMeta:
    """What a data set knows of one of its frames, as it is sent with an upload.

    Parameters
    ----------
    reference : the frame
    robot, tags : see FrameMeta
    session : default: the name of the frame's sequence
    with_pose : send the pose where it is known
    parent_frame : what its pose leads to; default: the session's name. Sequences of one scene
        share it: `Sequence.parent_frame`
    base : where the sensor sits on the robot; default: as the frame says
    up : unit vector in the sensor's axes; default: of the sidecar, for all of its frames

    Raises
    ------
    InvalidPose : the file of the pose holds none.
    InvalidRequest : a name is empty, too long or not printable.
    """
    if up is None:
        source = reference.camera or reference.cloud
        up = None if source is None else source.up
    sequence = reference.name.rpartition("/")[0] or reference.path.absolute().parent.name
    T_parent_sensor = reference.pose if with_pose else None
    stamp, pose = reference.timestamp, None
    if T_parent_sensor is not None:
        matrix = T_parent_sensor.tolist()
        pose = checked(GivenPose, "The pose", matrix=matrix, parent_frame=parent_frame)
    if stamp is not None and not _DATES_S[0] <= stamp < _DATES_S[1]:
        stamp = None
    return checked(
        FrameMeta,
        "What is known of the frame",
        **(_of_depth(reference.camera) if reference.camera else _of_cloud(reference)),
        robot=robot,
        session=sequence if session is None else session,
        captured_at=None if stamp is None else datetime.fromtimestamp(stamp, timezone.utc),
        pose=pose,
        T_base_sensor=reference.base if base is None else base,
        up=_direction(up),
        tags=list(tags),
    )


def _direction(up: Sequence[float] | None) -> GivenDirection | None:
    """Three numbers as they are sent; InvalidRequest where they are no unit vector."""
    if up is None:
        return None
    return checked(GivenDirection, "The up vector", **dict(zip("xyz", up, strict=False)))


def _of_depth(camera: Camera) -> dict[str, Any]:
    """How the samples of a depth image are read."""
    lens = camera.intrinsics
    return {
        "intrinsics": CameraIntrinsics(
            width=lens.width,
            height=lens.height,
            fx=lens.fx,
            fy=lens.fy,
            cx=lens.cx,
            cy=lens.cy,
            distortion=list(lens.distortion),
        ),
        "depth_scale": camera.depth_scale,
        "depth_along_ray": camera.along_ray,
    }


def _of_cloud(reference: FrameFile) -> dict[str, Any]:
    """How the points of a cloud are read; a KITTI scan's name alone says that it is one."""
    source = reference.cloud or CloudSource()
    told = source.file_format
    if told is None and SUFFIXES.get(reference.path.suffix.lower()) == "kitti":
        told = "kitti"
    known: dict[str, Any] = {"format": told, "units_per_metre": source.units_per_metre}
    if source.viewpoint is None:
        known["viewpoint"] = None
    elif not isinstance(source.viewpoint, Unsaid):
        known["viewpoint"] = dict(zip("xyz", source.viewpoint, strict=True))
    return known


def sendable(
    frame: bytes | Path | FrameFile, meta: FrameMeta | None, *, with_pose: bool,
    up: Sequence[float] | None = None,
) -> tuple[bytes, FrameMeta]:  # fmt: skip
    """Bytes of a frame and what is known of it; a path's camera is looked for beside it.

    Where `up` is given, it stands in the place of what `meta` or a sidecar says.

    Raises
    ------
    UnreadableFrame, UnreadableCloud : the file cannot be read.
    DatasetError : there is no intrinsics.json beside a depth image or above, or it is a folder.
    InvalidIntrinsics, InvalidPose : what is beside it is none.
    TypeError : bytes without metadata, and of no point cloud.
    """
    if meta is not None and up is not None:
        meta = meta.model_copy(update={"up": _direction(up)})
    if isinstance(frame, bytes):
        if meta is None and format_of(frame) is None:
            raise TypeError("the bytes of a depth image need its `meta`, at least the intrinsics")
        return frame, meta or FrameMeta(up=_direction(up))
    if isinstance(frame, FrameFile):
        found = frame
    elif meta is not None:
        return _read(frame, is_cloud=meta.intrinsics is None), meta
    else:
        found = _named(frame)
    data = found.read_bytes()
    return data, meta_of(found, with_pose=with_pose, up=up) if meta is None else meta


def _named(path: Path) -> FrameFile:
    """The frame of a path, which a caller gave."""
    if path.is_dir():
        raise DatasetError(
            f"{path}: This is a folder, and one frame is wanted. Name a depth image or a cloud, "
            "or send the frames that sceneprint.find_sequences returns."
        )
    # a name such as .. is none; a symlink's own name is what the user knows it by
    file = path.resolve() if ".." in path.parts else path.absolute()
    if not file.is_file():
        raise DatasetError(f"{path}: There is no such file or folder. Check the path.")
    if file.suffix.lower() in RECORDING_SUFFIXES:
        raise DatasetError(
            f"{path}: This is a recording of ROS, and one frame is wanted. Upload it with "
            "`sceneprint upload`, or send the frames that sceneprint.find_sequences returns."
        )
    return find_frame_file(file)


def _read(path: Path, *, is_cloud: bool) -> bytes:
    if is_cloud:
        return read_bytes(path, MAXIMUM_CLOUD_BYTES, UnreadableCloud)
    return read_bytes(path, MAXIMUM_IMAGE_BYTES, UnreadableFrame)
