"""A frame in a file or in an array: what it is, what is known of it, and what is sent of it.

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
from sceneprint_client.files import (
    MAXIMUM_CLOUD_BYTES,
    MAXIMUM_IMAGE_BYTES,
    naming,
    read_bytes,
)
from sceneprint_client.formats import HEAD, format_named, format_of, is_cloud
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

#: A depth image of the 7-Scenes layout, whose pose lies beside it.
SEVEN_SCENES = re.compile(r"frame-\d+\.depth\.png", re.ASCII)
#: Time stamps, in seconds, that are dates (2001 to 2096); others count from some start.
_DATES_S = (1e9, 4e9)


@runtime_checkable
class PinholeCamera(Protocol):
    """The camera of Open3D: PinholeCameraIntrinsic."""

    width: int
    height: int
    intrinsic_matrix: NDArray[Any]


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
    original : what the file is called within the folder of its sequence, or the message within its
        bag; default: the file's own name
    sequence : place within its sequence; None where not known, as of a file that was named alone
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
        data = _read(self.path, is_cloud=self.kind == "cloud")
        if self.row is None:
            return data
        with naming(str(self.path)):
            return rows_as_npy(data, self.row)

    @property
    def row(self) -> tuple[str, ...] | None:
        """Names of the values of a row, of a .bin file whose rows are described."""
        return self.cloud.row if self.cloud is not None and is_kitti(self.path) else None

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
    folder, number = file.parent, seven_scenes_number(file.name)
    stem = file.name.removesuffix(".depth.png") if SEVEN_SCENES.fullmatch(file.name) else file.stem
    name, pose = f"{folder.name}/{stem}", find_pose_file(folder, stem)
    if is_cloud(file.name) or _is_npy_of_points(file):
        source = find_cloud_source(folder)
        return FrameFile(name, file, None, pose_source=pose, cloud=source)
    # what is named outright is taken, whatever its name; its content decides
    return FrameFile(name, file, find_camera(folder), pose_source=pose, sequence=number)


#: Folders that hold the poses of the frames beside them.
POSE_FOLDERS = ("pose", "poses")
NO_POSE_FILE = "no NAME.pose.txt is beside them, nor NAME.txt in a folder pose"


def find_pose_file(folder: Path, stem: str) -> Path | None:
    """Return the file of a frame's pose, or None.

    It is NAME.pose.txt beside the frame, or NAME.txt in a folder `pose` or `poses`. That lies in
    the frame's folder, or beside it if the folder is called depth (ScanNet). Of `depth_NAME` it
    may be called `pose_NAME.txt` too.

    Parameters
    ----------
    folder : of the frame
    stem : name of the frame's file without suffix: NAME, NAME.depth or depth_NAME
    """
    name = stem.removesuffix(".depth")
    renamed = [f"{name.replace('depth', 'pose')}.txt"] if "depth" in name else []
    beside = [f"{name}.pose.txt", *renamed]
    listed, found = [f"{name}.txt", *beside], [folder / one for one in beside]
    for place in [folder, folder.parent] if "depth" in folder.name.lower() else [folder]:
        found += [place / below / one for below in POSE_FOLDERS for one in listed]
    return next((one for one in found if one.is_file()), None)


def is_kitti(path: Path) -> bool:
    """Return whether a file is a KITTI scan by its name, which alone shows it."""
    found = format_named(path.name, "cloud")
    return found is not None and found.name == "kitti"


def _is_npy_of_points(file: Path) -> bool:
    """Return whether clouds.json is beside it; or no camera, and its content is N x 3 or N x 4."""
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
    with_name: bool = True,
    trust_depth: bool = False,
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
    with_name : send the original name and the place in the sequence; queries have no use for them
    trust_depth : take a depth image that does not look like one

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
    """A name of a file as it may be sent, whatever it was: a bad name must not cost the frame.

    Returns
    -------
    name : relative, its parts with `/` between; `_` where a character is not allowed; of a longer
        one the end. None where nothing is left
    """
    text = name.encode("utf-8", "replace").decode()  # half of a surrogate pair is no text
    text = re.sub(r"[\x00-\x1f\x7f\\]", "_", text)
    parts = text[-MOST_OF_NAME:].split("/")
    return "/".join(part for part in parts if part not in ("", ".", "..")) or None


def seven_scenes_number(name: str) -> int | None:
    """The number of a frame of the 7-Scenes layout by the name of its file; None of any other."""
    if not SEVEN_SCENES.fullmatch(name):
        return None
    number = name.removeprefix("frame-").removesuffix(".depth.png")
    return int(number) if len(number) <= _MOST_DIGITS else None


#: Digits of a number that every reader of JSON reads exactly.
_MOST_DIGITS = 15


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
    file_format = source.file_format
    if reference.row is not None:
        file_format = None  # it is sent as NPY, whose content says so
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
    """Bytes of a frame and what is known of it; a path's camera is looked for beside it.

    `with_pose` sends all that a map keeps: the pose, the file's name, its place in the sequence.
    Where `up` is given, it stands in the place of what `meta` or a sidecar says.

    Raises
    ------
    UnreadableFrame, UnreadableCloud : the file cannot be read, or the array is neither depth nor
        points.
    DatasetError : there is no intrinsics.json beside a depth image or above, or it is a folder.
    InvalidIntrinsics, InvalidPose : what is given or lies beside it is none.
    TypeError : bytes without metadata, and of no point cloud; or no frame or no metadata at all.
    """
    array = library_array(frame)
    if array is not None:
        return array_sendable(array, meta, up=up)
    known = _meta_without_array(meta)
    if known is not None and up is not None:
        known = known.model_copy(update={"up": _direction(up)})
    if isinstance(frame, bytes):
        if known is None and format_of(frame) is None:
            raise TypeError("the bytes of a depth image need its `meta`, at least the intrinsics")
        return frame, known or FrameMeta(up=_direction(up))
    if isinstance(frame, FrameFile):
        found = frame
    elif not isinstance(frame, str | os.PathLike):
        raise TypeError(
            "a frame is a path, the bytes of a file, a FrameFile, a numpy array, or an image or "
            f"cloud of Open3D or Pillow, not {type(frame).__name__}"
        )
    elif known is not None:
        data, name = _read(Path(frame), is_cloud=known.intrinsics is None), Path(frame).name
        return data, _named_as(known, name, seven_scenes_number(name)) if with_pose else known
    else:
        found = _named(Path(frame))
    data = found.read_bytes()
    if known is None:
        return data, meta_of(found, with_pose=with_pose, up=up, with_name=with_pose)
    if not with_pose:
        return data, known
    return data, _named_as(known, found.original or found.path.name, found.sequence)


def library_array(frame: Any) -> NDArray[Any] | None:
    """Return the array of a frame that is one, or an image or cloud of Open3D or Pillow; None of
    anything else. Neither library is imported.
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
    if array.dtype == np.int32 and array.size and 0 <= array.min() <= array.max() <= _MOST_UNITS:
        return array.astype(np.uint16)  # Pillow's mode I
    return array.astype(array.dtype.newbyteorder("="), copy=False)


#: Largest sample of a 16-bit image.
_MOST_UNITS = 65_535


def _named_as(known: FrameMeta, name: str, sequence: int | None) -> FrameMeta:
    """What is known of a frame, with name and place of its file where it says none."""
    labels = {"name": file_name(name), "sequence": sequence}
    missing = {field: label for field, label in labels.items() if getattr(known, field) is None}
    return known.model_copy(update=missing)


def _meta_without_array(meta: MetaInput | None) -> FrameMeta | None:
    """Return the metadata of a frame that is not an array; TypeError if it is no metadata."""
    if meta is None or isinstance(meta, FrameMeta):
        return meta
    if isinstance(meta, CameraIntrinsics | PinholeCamera):
        return FrameMeta(intrinsics=camera_of(meta, (1, 1)))
    if not isinstance(meta, np.ndarray | list | tuple):  # a matrix is one of these
        raise TypeError(f"meta is a FrameMeta or CameraIntrinsics, not {type(meta).__name__}")
    raise TypeError(
        "a camera matrix does not say how large the image of a file is; give CameraIntrinsics or "
        "FrameMeta"
    )


def array_sendable(
    array: NDArray[Any], meta: MetaInput | None, *, up: Sequence[float] | None = None
) -> tuple[bytes, FrameMeta]:
    """Return an array as an NPY file, and its metadata: with a camera it is depth, else points.

    Parameters
    ----------
    array : (H, W) depth, uint16 in stored units (`depth_scale` to a metre, 1000 unless `meta` says
        otherwise) or floating in metres; without a camera (N, 3) or (N, 4) floating points
    meta : FrameMeta, or the camera, as for `camera_of`
    up : as for `sendable`

    Raises
    ------
    UnreadableFrame, UnreadableCloud : another shape or type.
    InvalidIntrinsics : no camera.
    """
    size = (array.shape[1], array.shape[0]) if array.ndim == 2 else None
    if meta is None or isinstance(meta, FrameMeta):
        known = meta or FrameMeta()
    else:
        known = FrameMeta(intrinsics=camera_of(meta, size or (1, 1)))
    if up is not None:
        known = known.model_copy(update={"up": _direction(up)})
    if known.intrinsics is None:
        return _npy(_checked_points(array), _MOST_LOST_M), known
    if size is None or not array.size or array.dtype.kind + str(array.dtype.itemsize) not in _DEPTH:
        raise UnreadableFrame(
            f"The array has shape {array.shape} and type {array.dtype}, and depth is (H, W), "
            "uint16 in stored units or float32 in metres. Convert it."
        )
    return _npy(array), known


#: Types of depth images: kind and bytes.
_DEPTH = ("u2", "f2", "f4", "f8")


def _checked_points(array: NDArray[Any]) -> NDArray[Any]:
    """Return an array of points; raise UnreadableFrame for depth without a camera."""
    if array.ndim == 2 and array.shape[1] in (3, 4) and array.dtype.kind == "f":
        if array.dtype.itemsize in (2, 4, 8):
            return array
    elif array.ndim == 2 and array.shape[1] not in (3, 4):
        raise UnreadableFrame(
            f"The array has shape {array.shape} and no camera. If it is a depth image, give its "
            "camera: CameraIntrinsics, a 3 x 3 matrix, or (fx, fy, cx, cy). Points are (N, 3)."
        )
    raise UnreadableCloud(
        f"The array has shape {array.shape} and type {array.dtype}, and points are (N, 3), "
        "float32 or float64 in metres. Convert it."
    )


def camera_of(
    camera: CameraIntrinsics | PinholeCamera | Sequence[float] | NDArray[Any],
    size: tuple[int, int],
) -> CameraIntrinsics:
    """Return the camera of an image of a size (width, height).

    Parameters
    ----------
    camera : CameraIntrinsics as it is, Open3D's PinholeCameraIntrinsic, a (3, 3) matrix without
        skew, or (fx, fy, cx, cy), pixels
    size : width and height, pixels, where the camera does not say them

    Raises
    ------
    InvalidIntrinsics : none of these.
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
            "The camera is none. Give CameraIntrinsics, a matrix [[fx, 0, cx], [0, fy, cy], "
            "[0, 0, 1]], or (fx, fy, cx, cy), in pixels."
        )
    fx, fy, cx, cy = K.tolist()
    width, height = size
    return checked(
        CameraIntrinsics, "The camera", width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy
    )


def rows_as_npy(data: bytes, row: tuple[str, ...]) -> bytes:
    """Return x, y and z of rows of float32 as an NPY file.

    Raises
    ------
    UnreadableCloud : it is no whole number of rows.
    """
    width = 4 * len(row)
    if len(data) % width or not data:
        raise UnreadableCloud(
            f"The file has {len(data)} bytes, and rows of {','.join(row)} have {width}. Name what "
            "a row of it holds."
        )
    rows = np.frombuffer(data, "<f4").reshape(-1, len(row))
    return _npy(rows[:, [row.index(axis) for axis in "xyz"]])


#: What float32 may change in coordinates; those of a map, such as UTM, are sent as float64.
_MOST_LOST_M = 1e-4


def _npy(array: NDArray[Any], most_lost: float = np.inf) -> bytes:
    """Return an NPY file. It is not compressed: to compress takes longer than to send.

    float64 is sent as float32 where no number changes by more than `most_lost`.
    """
    file, compact = io.BytesIO(), array
    if array.dtype.itemsize == 8:
        with np.errstate(all="ignore"):
            compact = array.astype(np.float32)
            if np.nanmax(np.abs(compact[:, :3] - array[:, :3]), initial=0.0) > most_lost:
                compact = array
    np.save(file, np.ascontiguousarray(compact), allow_pickle=False)
    return file.getvalue()


def _named(path: Path) -> FrameFile:
    """Return the frame of a path, which a caller gave."""
    if path.is_dir():
        raise DatasetError(
            f"{path}: This is a folder, and one frame is wanted. Name a depth image or a cloud, "
            "or send the frames that sceneprint.find_sequences returns."
        )
    # a name such as .. is none; a symlink's own name is what the user knows it by
    file = path.resolve() if ".." in path.parts else path.absolute()
    if not file.is_file():
        raise DatasetError(f"{path}: There is no such file or folder. Check the path.")
    several = format_named(file.name, "recording", "capture")
    if several is not None:
        raise DatasetError(
            f"{path}: The file ({several.title}) may hold several frames, and one is wanted. "
            "Upload it with `sceneprint upload`, or send the frames that "
            "sceneprint.find_sequences returns."
        )
    return find_frame_file(file)


def _read(path: Path, *, is_cloud: bool) -> bytes:
    if is_cloud:
        return read_bytes(path, MAXIMUM_CLOUD_BYTES, UnreadableCloud)
    return read_bytes(path, MAXIMUM_IMAGE_BYTES, UnreadableFrame)
