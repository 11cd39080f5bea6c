"""Sequences, references that read their frames on demand, and the metadata of frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from sceneprint.errors import DatasetError, InvalidPose, UnreadableCloud
from sceneprint.formats.depth_file import decode_frame
from sceneprint.formats.points.cloud import Scan, decode_scan
from sceneprint.types import AnyFrame, DepthFrame, Floats
from sceneprint_client.files import MAXIMUM_CLOUD_BYTES, data_lines, naming, read_bytes, read_text
from sceneprint_client.frame_files import FrameFile, is_kitti, meta_of
from sceneprint_client.poses import SensorTrajectory
from sceneprint_client.sidecars import CloudSource, pose_numbers

if TYPE_CHECKING:
    from sceneprint_client.api import FrameMeta
    from sceneprint_client.api.frames import ImportOptions

_TOLERANCE = 1e-2  #: maximum deviation of a quaternion's length from 1
_LATEST_S = 1e11  #: maximum time stamp, seconds; greater ones have another unit
_APART_M = 0.1  #: maximum distance of two positions at the same time along an axis, metres
_MAXIMUM_TRAJECTORY_BYTES = 2**26  #: size of an hour of poses at 200 Hz


def read_trajectory(path: Path) -> SensorTrajectory:
    """Read the poses of a TUM text file, with lines `t tx ty tz qx qy qz qw` and # comments.

    The poses are sorted by time. Of several lines with the same time stamp, the first is used.

    Raise InvalidPose if the file cannot be read or has no pose, a line does not consist of 8 finite
    numbers with a quaternion of unit length, a time stamp is not in seconds, or two lines with the
    same stamp contradict each other. The message names file and line.
    """
    numbers, rows = [], []
    for number, line in data_lines(read_text(path, _MAXIMUM_TRAJECTORY_BYTES, InvalidPose)):
        words = line.replace(",", " ").split()
        with naming(f"{path}, line {number}"):
            if len(words) != 8:
                raise InvalidPose(
                    f"The line has {len(words)} words, not 8. Write t tx ty tz qx qy qz qw."
                )
            rows.append(pose_numbers(words))
        numbers.append(number)
    if not rows:
        raise InvalidPose(f"{path}: The file has no pose. Remove the file, or add poses.")
    table = np.array(rows)
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(np.linalg.norm(table[:, 4:], axis=1) - 1.0)
    bad = ~np.isfinite(table).all(axis=1) | ~(off < _TOLERANCE)
    if bad.any():
        raise InvalidPose(
            f"{path}, line {numbers[int(np.argmax(bad))]}: The pose is not finite, or its "
            "quaternion does not have unit length. Write t tx ty tz qx qy qz qw, or remove the "
            "line."
        )
    if (late := float(table[:, 0].max())) > _LATEST_S:
        raise InvalidPose(
            f"{path}: The time stamp {late:.10g} is not in seconds. Write seconds, and poses as tx "
            "ty tz qx qy qz qw; EuRoC files have nanoseconds, and qw first."
        )
    stamps, first, places = np.unique(table[:, 0], return_index=True, return_inverse=True)
    apart = np.abs(table[:, 1:4] - table[first[places], 1:4]).max(axis=1)
    if apart.max() > _APART_M:
        raise InvalidPose(
            f"{path}, line {numbers[int(np.argmax(apart))]}: The position is {apart.max():.3g} m "
            "from that of an earlier line with the same time stamp. Remove one of them."
        )
    quaternions = table[first, 4:]
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return SensorTrajectory(stamps, table[first, 1:4], quaternions)


def read_cloud(
    path: Path, source: CloudSource, *, name: str = "", pose: Floats | None = None
) -> Scan:
    """Read the cloud of a file.

    Returns
    -------
    scan : cloud, and the parameters with which the file was read

    Raises
    ------
    UnreadableCloud : If the file is missing or too large; for further errors, see `decode_scan`.
        The message names the file.
    """
    data = read_bytes(path, MAXIMUM_CLOUD_BYTES, UnreadableCloud)
    file_format = source.file_format or ("kitti" if is_kitti(path) else None)
    with naming(str(path)):
        scan = decode_scan(
            data,
            file_format=file_format,
            viewpoint=source.viewpoint,
            units_per_metre=source.units_per_metre,
            pose=pose,
        )
    return replace(scan, cloud=replace(scan.cloud, name=name))


Split = Literal["train", "test"]


class Layout(Enum):
    """The layout of a sequence's files."""

    #: Files `frame-%06d.depth.png`, and files `frame-%06d.pose.txt` for frames with a pose.
    SEVEN_SCENES = "7-Scenes"
    #: File `depth.txt` with time stamps and files, and `groundtruth.txt` with poses.
    TUM = "TUM RGB-D"
    #: Depth images with arbitrary names in natural order, and poses that `find_pose_file` finds.
    PLAIN = "plain"
    #: Point clouds with arbitrary names in natural order, and poses that `find_pose_file` finds.
    CLOUDS = "clouds"
    #: Messages of a ROS recording, and poses from its transforms.
    RECORDING = "recording"
    #: Database of RTAB-Map: nodes with depth images or laser scans, and their poses.
    RTABMAP = "RTAB-Map"
    #: Folder of Polycam: `keyframes` with depth images, and cameras with poses.
    POLYCAM = "Polycam"
    #: Folder or .r3d file of Record3D: metadata with poses, and depth images.
    RECORD3D = "Record3D"
    #: File `transforms.json` of nerfstudio that names depth images.
    NERFSTUDIO = "nerfstudio"
    #: E57 file: scans with the poses of their scanner.
    E57 = "E57"

    @property
    def is_export(self) -> bool:
        """Return whether another system wrote the sequence: its parent folders have no meaning."""
        return self in _EXPORTS


_EXPORTS = frozenset(
    {
        Layout.RECORDING, Layout.RTABMAP, Layout.POLYCAM, Layout.RECORD3D, Layout.NERFSTUDIO,
        Layout.E57,
    }
)  # fmt: skip


class FrameReference(FrameFile):
    """A frame of a sequence that is read on demand; `find_sequences` assigns unique names."""

    def read(self) -> AnyFrame:
        """Read the frame; for errors, see `read_frame`, `read_cloud` and `pose`."""
        if self.cloud is None:
            return self.read_depth()
        if self.source is None and self.row is None:
            return read_cloud(self.path, self.cloud, name=self.name, pose=self.pose).cloud
        data = self.read_bytes()
        with naming(str(self.path)):
            scan = decode_scan(
                data,
                viewpoint=self.cloud.viewpoint,
                units_per_metre=self.cloud.units_per_metre,
                pose=self.pose,
            )
        return replace(scan.cloud, name=self.name)

    def read_depth(self) -> DepthFrame:
        """Read a depth image; for further errors, see `read_frame` and `pose`.

        Raise DatasetError if the frame is a cloud.
        """
        if self.camera is None:
            raise DatasetError(
                f"{self.path}: This is a cloud, not a depth image. Specify a folder or file of "
                "depth images."
            )
        camera = self.camera
        data = self.read_bytes()
        with naming(str(self.path)):
            frame = decode_frame(
                data,
                camera.intrinsics,
                depth_scale=camera.depth_scale,
                along_ray=camera.along_ray,
                pose=self.pose,
            )
        return replace(frame, name=self.name)


@dataclass(frozen=True, eq=False)
class FrameSequence:
    """The frames of one run of a sensor, in order.

    Parameters
    ----------
    name : unique name among the results of `find_sequences`
    parent_frame : name of the parent frame of the poses; only poses with the same parent frame can
        be compared
    split : use of the sequence according to the authors of the scene; None if unknown
    frames : at least one frame
    note : description of omitted data for users; empty if all data is used
    unposed : reason why frames have no pose, for users; empty if all frames have poses, or if
        `note` states the reason
    lost : number of frames that are unexpectedly omitted, or used without their pose
    """

    name: str
    folder: Path
    layout: Layout
    parent_frame: str
    split: Split | None
    frames: tuple[FrameReference, ...]
    note: str = ""
    unposed: str = ""
    lost: int = 0

    @property
    def place(self) -> Path:
        """Return the folder that names the parent frame: that of the scene or of the sequence."""
        if self.layout.is_export or self.parent_frame == self.name:
            return self.folder
        return self.folder.parent


#: Reasons for omitting frames that have neither depth nor points.
EMPTY_FRAMES = frozenset(
    {
        "frames without a depth_file_path", "cameras without a depth image", "frames without depth",
        "scans without points", "stereo images without depth", "two-dimensional laser scans",
    }
)  # fmt: skip


def count_lost(left_out: Counter[str]) -> int:
    """Return the number of omitted frames with depth or points.

    `left_out`: number of omitted frames by reason.
    """
    return left_out.total() - sum(left_out[reason] for reason in EMPTY_FRAMES)


def import_meta(
    reference: FrameReference, sequence: FrameSequence, options: ImportOptions
) -> FrameMeta:
    """Return the metadata of an imported frame; for errors, see `meta_of`."""
    up = options.up
    return meta_of(
        reference, robot=options.robot, session=options.session or session_of(sequence),
        tags=options.tags, with_pose=options.with_poses,
        parent_frame=options.parent_frame or parent_frame_of(sequence, options.robot),
        base=options.T_base_sensor,
        up=None if up is None or isinstance(up, str) else up.unit,
        trust_depth=options.trust_depth,
    )  # fmt: skip


def session_of(sequence: FrameSequence) -> str:
    """Return the session of a sequence, the same for a search from its folder or its scene's."""
    if sequence.layout.is_export or sequence.parent_frame == sequence.name:
        return sequence.name
    return f"{sequence.parent_frame}/{sequence.folder.name}"


def parent_frame_of(sequence: FrameSequence, robot: str | None) -> str:
    """Return the parent frame of the poses; the robot, if specified, is its prefix."""
    own = sequence.parent_frame
    return own if robot is None else f"{robot}/{own}"


def numbered_sequences(
    sequences: Iterable[FrameSequence], session: str | None
) -> list[FrameSequence]:
    """Return sequences whose frames are numbered within their sessions.

    If several sequences form a session, each folder continues the numbers of the previous folder.
    Frames of a folder that the user lists one by one retain the order of their numbers in the
    folder; a frame without a number gets the next unused number. A session's only sequence is
    unchanged.

    Parameters
    ----------
    sequences : sequences in chronological order
    session : session of all sequences; None selects `session_of`, which sequences may share
    """
    numbered = list(sequences)
    keys = [(session or session_of(sequence), sequence.folder) for sequence in numbered]
    sizes = Counter(name for name, _ in keys)
    rank = {key: place for place, key in enumerate(dict.fromkeys(keys))}
    offsets: dict[tuple[str, Path], int] = {}
    free: dict[str, int] = {}  # next unused number of each session

    def place_in_order(i: int) -> tuple[int, bool]:
        # frames of different folders may be listed alternately
        return rank[keys[i]], numbered[i].frames[0].sequence is None

    for i in sorted(range(len(keys)), key=place_in_order):
        name = keys[i][0]
        if sizes[name] == 1:
            continue
        offset = offsets.setdefault(keys[i], free.get(name, 0))
        frames = []
        for frame in numbered[i].frames:
            place = free.get(name, 0)
            if frame.sequence is not None:
                place = offset + frame.sequence
            frames.append(replace(frame, sequence=place))
            free[name] = max(free.get(name, 0), place + 1)
        numbered[i] = replace(numbered[i], frames=tuple(frames))
    return numbered
