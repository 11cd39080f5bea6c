"""Frames in files and arrays: their bytes and metadata as an upload sends them.

Path  --find_frame_file-->  FrameFile  --meta_of-->  FrameMeta
bytes | path | FrameFile | array  --sendable-->  bytes, FrameMeta
array, camera  --array_sendable-->  bytes (NPY), FrameMeta
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from sceneprint_client.api.base import (
    MOST_OF_NAME,
    CameraIntrinsics,
    FrameMeta,
    GivenBase,
    GivenDirection,
    GivenPose,
    checked,
)
from sceneprint_client.errors import (
    DatasetError,
    InvalidIntrinsics,
    UnreadableCloud,
    UnreadableFrame,
)
from sceneprint_client.files import MAXIMUM_CLOUD_BYTES, MAXIMUM_IMAGE_BYTES, naming, read_bytes
from sceneprint_client.formats import (
    HEAD,
    format_at,
    format_named,
    format_of,
    is_cloud,
    titles_of,
)
from sceneprint_client.sidecars import (
    CLOUDS_FILE,
    Camera,
    CloudSource,
    Unsaid,
    find_camera,
    find_cloud_source,
    read_pose,
)

if TYPE_CHECKING:
    from sceneprint_client.http import FrameInput, MetaInput

#: Pattern of the names of depth images in the 7-Scenes layout; each image has a pose file.
SEVEN_SCENES = re.compile(r"frame-\d+\.depth\.png", re.ASCII)
#: Range of stamps that are dates (2001 to 2096), seconds since 1970; others have another origin.
_DATES_S = (1e9, 4e9)


@runtime_checkable
class PinholeCamera(Protocol):
    """Protocol of Open3D's PinholeCameraIntrinsic."""

    width: int
    height: int
    intrinsic_matrix: NDArray[Any]


class FrameSource(Protocol):
    """Source of the bytes of a frame that has no file of its own."""

    def read_bytes(self) -> bytes:
        """Return the frame as a PNG, NPY or other file; raise SceneprintError on failure."""


@dataclass(frozen=True, eq=False)
class FrameFile:
    """Reference to the file of one frame and its sidecar files; its samples are not loaded.

    Parameters
    ----------
    name : name of the frame, with its sequence, such as "seq-01/frame-000000"
    path : depth image or file of points; with `source`, a path that is unique to the frame
    camera : camera of a depth image; None for points
    timestamp : seconds, or None if the layout has none
    pose_source : file of the pose, or the pose itself; None if unknown
    cloud : how to read the points; None for a depth image
    source : source of the bytes if they are not in the file
    base : pose of the sensor on the robot; None if unknown
    original : path of the file within the folder of its sequence, or name of the message within
        its bag; default: the file's own name
    sequence : index within the sequence; None if unknown, as for a single file
    """

    name: str
    path: Path
    camera: Camera | None
    timestamp: float | None = None
    pose_source: Path | NDArray[np.float64] | None = None
    cloud: CloudSource | None = None
    source: FrameSource | None = None
    base: GivenBase | None = None
    original: str = ""
    sequence: int | None = None

    def __post_init__(self) -> None:
        if (self.camera is None) == (self.cloud is None):
            raise ValueError("pass either a depth image with `camera`, or points with `cloud`")

    @property
    def kind(self) -> Literal["depth", "cloud"]:
        """Kind of the file's content."""
        return "depth" if self.cloud is None else "cloud"

    def read_bytes(self) -> bytes:
        """Return the bytes of the frame as an upload sends them.

        Raise UnreadableFrame or UnreadableCloud if the file cannot be read or is too large. Raise
        DatasetError if the recording that contains the frame is damaged.
        """
        if self.source is not None:
            return self.source.read_bytes()
        data = _read_content(self.path, is_cloud=self.kind == "cloud")
        if self.row is None:
            return data
        with naming(str(self.path)):
            return rows_as_npy(data, self.row)

    @property
    def row(self) -> tuple[str, ...] | None:
        """Names of the values in each row of a .bin file, if `clouds.json` specifies them."""
        return self.cloud.row if self.cloud is not None and is_kitti(self.path) else None

    @property
    def pose(self) -> NDArray[np.float64] | None:
        """Return T_parent_sensor (4, 4), or None if unknown; each call reads the file again.

        Raise InvalidPose, which names the file, if it does not hold a rigid transform.
        """
        if isinstance(self.pose_source, Path):
            return read_pose(self.pose_source)
        return self.pose_source


def find_frame_file(file: Path) -> FrameFile:
    """Return the frame of a depth image or file of points, with its pose if a pose file exists.

    `file`: absolute path. Raise DatasetError if no intrinsics.json lies beside a depth image or in
    a folder above it, or clouds.json is invalid. Raise InvalidIntrinsics if intrinsics.json does
    not describe a camera.
    """
    folder, number = file.parent, seven_scenes_number(file.name)
    stem = file.name.removesuffix(".depth.png") if SEVEN_SCENES.fullmatch(file.name) else file.stem
    name, pose = f"{folder.name}/{stem}", find_pose_file(folder, stem)
    if is_cloud(file.name) or _is_npy_of_points(file):
        source = find_cloud_source(folder)
        return FrameFile(name, file, None, pose_source=pose, cloud=source)
    # Any other file counts as a depth image; decoding checks its content.
    try:
        camera = find_camera(folder)
    except DatasetError as cause:
        if file.suffix.lower() == ".npy":
            raise DatasetError(
                f"{cause} If the file holds points, its shape must be (N, 3) or (N, 4)."
            ) from cause
        if format_named(file.name, "depth") or format_at(_head(file), "depth"):
            raise
        raise DatasetError(
            f"{file}: The file is neither a depth image ({titles_of('depth')}) nor a point cloud "
            f"({titles_of('cloud')}). Convert it."
        ) from cause
    return FrameFile(name, file, camera, pose_source=pose, sequence=number)


#: Names of folders that contain pose files, beside the frames.
POSE_FOLDERS = ("pose", "poses")
NO_POSE_FILE = "there is no NAME.pose.txt beside them and no NAME.txt in a folder `pose`"


def find_pose_file(folder: Path, stem: str) -> Path | None:
    """Return the path of a frame's pose file, or None.

    It is NAME.pose.txt beside the frame, or NAME.txt in a folder `pose` or `poses`. This folder
    lies in the frame's folder, or beside it if the frame's folder is named depth (ScanNet). The
    pose of `depth_NAME` may also be named `pose_NAME.txt`.

    `stem`: name of the frame's file without its suffix: NAME, NAME.depth or depth_NAME.
    """
    name = stem.removesuffix(".depth")
    renamed = [f"{name.replace('depth', 'pose')}.txt"] if "depth" in name else []
    beside = [f"{name}.pose.txt", *renamed]
    listed, candidates = [f"{name}.txt", *beside], [folder / name for name in beside]
    for place in [folder, folder.parent] if "depth" in folder.name.lower() else [folder]:
        candidates += [place / below / name for below in POSE_FOLDERS for name in listed]
    return next((path for path in candidates if path.is_file()), None)


def is_kitti(path: Path) -> bool:
    """Return whether a file is a KITTI scan, according to its name."""
    entry = format_named(path.name, "cloud")
    return entry is not None and entry.name == "kitti"


def _is_npy_of_points(file: Path) -> bool:
    """Return whether clouds.json describes the file, or it has (N, 3 or 4) values and no camera."""
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
    return format_of(_head(file)) == "npy"


def _head(file: Path) -> bytes:
    """Return the first `HEAD` bytes of a file, or b"" if it cannot be read."""
    try:
        with file.open("rb") as opened:
            return opened.read(HEAD)
    except OSError:
        return b""


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
    with_name: bool = True,
    trust_depth: bool = False,
) -> FrameMeta:
    """Return the metadata that an upload sends with a frame of a data set.

    Parameters
    ----------
    reference : the frame
    session : name of the session; default: the name of the frame's sequence
    with_pose : whether to send the pose if it is known
    parent_frame : parent frame of the pose, such as `Sequence.parent_frame`, which all sequences of
        a scene share; default: the session's name
    base : pose of the sensor on the robot; default: `base` of the frame
    up : unit vector in the sensor's axes; default: `up` of the sidecar file
    with_name : whether to send the original name and the index in the sequence, which queries
        ignore
    trust_depth : whether to accept an image that does not look like depth

    Raises
    ------
    InvalidPose : If the pose file does not hold a rigid transform.
    InvalidRequest : If a name is empty, too long or not printable.
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
        "The metadata of the frame",
        **(_depth_fields(reference.camera) if reference.camera else _cloud_fields(reference)),
        trust_depth=trust_depth and reference.camera is not None,
        robot=robot,
        session=sequence if session is None else session,
        captured_at=None if stamp is None else datetime.fromtimestamp(stamp, timezone.utc),
        name=file_name(reference.original or reference.path.name) if with_name else None,
        sequence=reference.sequence if with_name else None,
        pose=pose,
        T_base_sensor=reference.base if base is None else base,
        up=_direction(up),
        tags=list(tags),
    )


def file_name(name: str) -> str | None:
    """Return a file name that is valid as metadata, so that no name blocks an upload.

    Returns
    -------
    name : relative path with `/` and with `_` for each forbidden character, shortened from the
        left if it is too long; None if nothing is left
    """
    text = name.encode("utf-8", "replace").decode()  # a lone surrogate cannot be encoded
    text = re.sub(r"[\x00-\x1f\x7f\\]", "_", text)
    parts = text[-MOST_OF_NAME:].split("/")
    return "/".join(part for part in parts if part not in ("", ".", "..")) or None


def seven_scenes_number(name: str) -> int | None:
    """Return the frame number in a file name of the 7-Scenes layout, or None for other names."""
    if not SEVEN_SCENES.fullmatch(name):
        return None
    number = name.removeprefix("frame-").removesuffix(".depth.png")
    return int(number) if len(number) <= _MOST_DIGITS else None


#: Number of digits of an integer that every JSON parser reads exactly.
_MOST_DIGITS = 15


def _direction(up: Sequence[float] | None) -> GivenDirection | None:
    """Return three numbers as a direction; raise InvalidRequest if it is not a unit vector."""
    if up is None:
        return None
    return checked(GivenDirection, "The up vector", **dict(zip("xyz", up, strict=False)))


def _depth_fields(camera: Camera) -> dict[str, Any]:
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


def _cloud_fields(reference: FrameFile) -> dict[str, Any]:
    source = reference.cloud or CloudSource()
    file_format = source.file_format
    if reference.row is not None:
        file_format = None  # rows_as_npy converts the file to NPY
    elif file_format is None and is_kitti(reference.path):
        file_format = "kitti"
    fields: dict[str, Any] = {"format": file_format, "units_per_metre": source.units_per_metre}
    if source.viewpoint is None:
        fields["viewpoint"] = None
    elif not isinstance(source.viewpoint, Unsaid):
        fields["viewpoint"] = dict(zip("xyz", source.viewpoint, strict=True))
    return fields


def sendable(
    frame: FrameInput, meta: MetaInput | None, *, with_pose: bool,
    up: Sequence[float] | None = None,
) -> tuple[bytes, FrameMeta]:  # fmt: skip
    """Return the bytes and metadata of a frame; without `meta`, sidecar files describe a file.

    `with_pose` includes the file's name, its index in the sequence and, without `meta`, its pose.
    `up` overrides `meta` and the sidecar file.

    Raises
    ------
    UnreadableFrame, UnreadableCloud : If the file cannot be read, or the array is neither depth
        nor points.
    DatasetError : If no intrinsics.json lies beside a depth image or in a folder above it, or the
        path is a folder.
    InvalidIntrinsics, InvalidPose : If the camera or the pose is invalid.
    TypeError : If `frame` or `meta` has the wrong type, or the bytes of a depth image come
        without metadata.
    """
    array = library_array(frame)
    if array is not None:
        return array_sendable(array, meta, up=up)
    metadata = _meta_without_array(meta)
    if metadata is not None and up is not None:
        metadata = metadata.model_copy(update={"up": _direction(up)})
    if isinstance(frame, bytes):
        if metadata is None and format_of(frame) is None:
            raise TypeError("the bytes of a depth image need `meta` with at least the intrinsics")
        return frame, metadata or FrameMeta(up=_direction(up))
    if isinstance(frame, FrameFile):
        reference = frame
    elif not isinstance(frame, str | os.PathLike):
        raise TypeError(
            "pass a path, the bytes of a file, a FrameFile, a numpy array, or an image or cloud "
            f"of Open3D or Pillow, not {type(frame).__name__}"
        )
    elif metadata is not None:
        path = Path(frame)
        data = _read_content(path, is_cloud=metadata.intrinsics is None)
        if with_pose:
            metadata = _with_name(metadata, path.name, seven_scenes_number(path.name))
        return data, metadata
    else:
        reference = _frame_at(Path(frame))
    data = reference.read_bytes()
    if metadata is None:
        return data, meta_of(reference, with_pose=with_pose, up=up, with_name=with_pose)
    if not with_pose:
        return data, metadata
    return data, _with_name(metadata, reference.original or reference.path.name, reference.sequence)


def library_array(frame: Any) -> NDArray[Any] | None:
    """Return the array of a numpy array, or of an image or cloud of Open3D or Pillow; else None.

    Neither library is imported.
    """
    if isinstance(frame, np.ndarray):
        return frame
    if isinstance(frame, bytes | str | os.PathLike | FrameFile) or frame is None:
        return None
    if hasattr(frame, "has_points"):  # open3d.geometry.PointCloud
        array = np.asarray(frame.points, np.float64)
    elif hasattr(frame, "as_tensor"):  # open3d.t.geometry.Image
        array = frame.as_tensor().cpu().numpy()
    elif hasattr(getattr(frame, "point", None), "positions"):  # open3d.t.geometry.PointCloud
        array = frame.point.positions.cpu().numpy()
    elif hasattr(frame, "__array_interface__") or hasattr(frame, "get_max_bound"):
        array = np.asarray(frame)  # Pillow, and open3d.geometry.Image
    else:
        return None
    if array.ndim == 3 and array.shape[2] == 1:
        array = array[:, :, 0]
    if array.dtype == np.int32 and array.size and 0 <= array.min() <= array.max() <= _MAXIMUM_UNITS:
        return array.astype(np.uint16)  # Pillow's mode I
    return array.astype(array.dtype.newbyteorder("="), copy=False)


#: Maximum sample of a 16-bit image.
_MAXIMUM_UNITS = 65_535


def _with_name(metadata: FrameMeta, name: str, sequence: int | None) -> FrameMeta:
    """Return the metadata with the file's name and sequence index, unless they are already set."""
    labels = {"name": file_name(name), "sequence": sequence}
    missing = {field: label for field, label in labels.items() if getattr(metadata, field) is None}
    return metadata.model_copy(update=missing)


def _meta_without_array(meta: MetaInput | None) -> FrameMeta | None:
    """Return the metadata for a frame that is not an array; raise TypeError for other types."""
    if meta is None or isinstance(meta, FrameMeta):
        return meta
    if isinstance(meta, CameraIntrinsics | PinholeCamera):
        return FrameMeta(intrinsics=camera_of(meta, (1, 1)))
    if not isinstance(meta, np.ndarray | list | tuple):  # a camera matrix is one of these types
        raise TypeError(f"pass a FrameMeta or CameraIntrinsics as meta, not {type(meta).__name__}")
    raise TypeError(
        "a camera matrix lacks the image size that a file needs; pass CameraIntrinsics or FrameMeta"
    )


def array_sendable(
    array: NDArray[Any], meta: MetaInput | None, *, up: Sequence[float] | None = None
) -> tuple[bytes, FrameMeta]:
    """Return the NPY bytes and metadata of an array: depth if it has a camera, else points.

    Parameters
    ----------
    array : (H, W) depth, uint16 in units of 1 / `depth_scale` metres (default 1000), or floating
        point in metres; without a camera, (N, 3) or (N, 4) floating-point coordinates
    meta : FrameMeta, or the camera in a form that `camera_of` accepts
    up : unit vector in the sensor's axes; overrides `meta`

    Raises
    ------
    UnreadableFrame, UnreadableCloud : If the array has another shape or type.
    InvalidIntrinsics : If `meta` does not describe a camera.
    """
    # masked samples are missing
    array = np.asarray(np.ma.filled(array, np.nan if array.dtype.kind == "f" else 0))
    size = (array.shape[1], array.shape[0]) if array.ndim == 2 else None
    if meta is None or isinstance(meta, FrameMeta):
        metadata = meta or FrameMeta()
    else:
        metadata = FrameMeta(intrinsics=camera_of(meta, size or (1, 1)))
    if up is not None:
        metadata = metadata.model_copy(update={"up": _direction(up)})
    if metadata.intrinsics is None:
        return _npy(_checked_points(array), _ROUNDING_M), metadata
    if size is None or not array.size or array.dtype.kind + str(array.dtype.itemsize) not in _DEPTH:
        raise UnreadableFrame(
            f"The array has shape {array.shape} and type {array.dtype}. Convert it to depth of "
            "shape (H, W), uint16 in stored units or float32 in metres."
        )
    return _npy(array), metadata


#: Types of depth images: kind and size in bytes.
_DEPTH = ("u2", "f2", "f4", "f8")


def _checked_points(array: NDArray[Any]) -> NDArray[Any]:
    """Return an array of points; raise UnreadableFrame or UnreadableCloud for other arrays."""
    if array.ndim == 2 and array.shape[1] in (3, 4) and array.dtype.kind == "f":
        if array.dtype.itemsize in (2, 4, 8):
            return array
    elif array.ndim == 2 and array.shape[1] not in (3, 4):
        raise UnreadableFrame(
            f"The array has shape {array.shape} and no camera. If it is a depth image, pass its "
            "camera: CameraIntrinsics, a 3 x 3 matrix, or (fx, fy, cx, cy). Points are (N, 3)."
        )
    raise UnreadableCloud(
        f"The array has shape {array.shape} and type {array.dtype}. Convert it to points of "
        "shape (N, 3), float32 or float64 in metres."
    )


def camera_of(
    camera: CameraIntrinsics | PinholeCamera | Sequence[float] | NDArray[Any],
    size: tuple[int, int],
) -> CameraIntrinsics:
    """Return the camera of an image.

    Parameters
    ----------
    camera : CameraIntrinsics, Open3D's PinholeCameraIntrinsic, a (3, 3) matrix without skew, or
        (fx, fy, cx, cy), pixels
    size : width and height, pixels, for a `camera` that lacks them

    Raises
    ------
    InvalidIntrinsics : If `camera` has another type or is not a valid camera.
    """
    if isinstance(camera, CameraIntrinsics):
        return camera
    if isinstance(camera, PinholeCamera):
        size = (camera.width, camera.height)
        camera = camera.intrinsic_matrix
    try:
        K = np.asarray(camera, np.float64)
    except (TypeError, ValueError):
        K = np.zeros(0)
    if K.shape == (3, 3) and np.array_equal(K[[0, 1, 2, 2, 2], [1, 0, 0, 1, 2]], (0, 0, 0, 0, 1)):
        K = K[[0, 1, 0, 1], [0, 1, 2, 2]]
    if K.shape != (4,) or not np.isfinite(K).all() or not (K[:2] > 0).all():
        raise InvalidIntrinsics(
            "The camera is invalid. Pass CameraIntrinsics, a matrix [[fx, 0, cx], [0, fy, cy], "
            "[0, 0, 1]], or (fx, fy, cx, cy), in pixels; or FrameMeta with other metadata too."
        )
    fx, fy, cx, cy = K.tolist()
    width, height = size
    return checked(
        CameraIntrinsics, "The camera", width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy
    )


def rows_as_npy(data: bytes, row: tuple[str, ...]) -> bytes:
    """Return x, y and z of rows of float32 values as an NPY file.

    Raise UnreadableCloud if the length is not a multiple of a row's size.
    """
    width = 4 * len(row)
    if len(data) % width or not data:
        raise UnreadableCloud(
            f"The file has {len(data)} bytes, which is not a multiple of {width}, the size of a "
            f"row of {','.join(row)}. Specify the values of a row with `row`."
        )
    rows = np.frombuffer(data, "<f4").reshape(-1, len(row))
    return _npy(rows[:, [row.index(axis) for axis in "xyz"]])


#: Maximum rounding error in float32, metres. Large coordinates, such as UTM, require float64.
_ROUNDING_M = 1e-4


def _npy(array: NDArray[Any], most_lost: float = np.inf) -> bytes:
    """Return an NPY file, uncompressed because compressing takes longer than sending.

    float64 is converted to float32 if no coordinate changes by more than `most_lost`.
    """
    file, compact = io.BytesIO(), array
    if array.dtype.itemsize == 8:
        with np.errstate(all="ignore"):
            compact = array.astype(np.float32)
            if np.nanmax(np.abs(compact[:, :3] - array[:, :3]), initial=0.0) > most_lost:
                compact = array
    np.save(file, np.ascontiguousarray(compact), allow_pickle=False)
    return file.getvalue()


def _frame_at(path: Path) -> FrameFile:
    """Return the frame at a path; raise DatasetError if the path is not one frame."""
    if path.is_dir():
        raise DatasetError(
            f"{path}: This is a folder, and a single frame is required. Specify a depth image or "
            "a cloud, or send the frames that sceneprint.find_sequences returns."
        )
    # `..` must be resolved; a symbolic link keeps its own name.
    file = path.resolve() if ".." in path.parts else path.absolute()
    if not file.is_file():
        raise DatasetError(f"{path}: There is no such file or folder. Check the path.")
    several = format_named(file.name, "recording", "capture")
    if several is not None:
        raise DatasetError(
            f"{path}: The file ({several.title}) may hold several frames; one is required. "
            "Upload it with `sceneprint upload`, or send the frames that "
            "sceneprint.find_sequences returns."
        )
    return find_frame_file(file)


def _read_content(path: Path, *, is_cloud: bool) -> bytes:
    """Return the content of a frame's file; raise UnreadableCloud or UnreadableFrame."""
    if is_cloud:
        return read_bytes(path, MAXIMUM_CLOUD_BYTES, UnreadableCloud)
    return read_bytes(path, MAXIMUM_IMAGE_BYTES, UnreadableFrame)
