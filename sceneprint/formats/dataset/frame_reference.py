"""What a sequence of frames is, before any of its frames is read, and its metadata in uploads."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Literal

import numpy as np

from sceneprint.errors import DatasetError, InvalidPose, UnreadableCloud
from sceneprint.formats.depth_file import decode_frame
from sceneprint.formats.points import Scan, decode_scan
from sceneprint.types import AnyFrame, DepthFrame, Floats
from sceneprint_client.files import MAXIMUM_CLOUD_BYTES, data_lines, naming, read_bytes, read_text
from sceneprint_client.frame_files import FrameFile, is_kitti
from sceneprint_client.poses import SensorTrajectory
from sceneprint_client.sidecars import CloudSource

_TOLERANCE = 1e-2  #: how far a written quaternion may be from a true one
_MAXIMUM_TRAJECTORY_BYTES = 2**26  # an hour at 200 Hz


def read_trajectory(path: Path) -> SensorTrajectory:
    """Return the poses of a TUM text file, lines `t tx ty tz qx qy qz qw`, # comments.

    Lines are put in order of time; of equal stamps the first stays.

    Raises
    ------
    InvalidPose : the file cannot be read, has no pose, or a line is not 8 finite numbers
        with a quaternion of unit length to 1e-2; names file and line.
    """
    numbers, rows = [], []
    for number, line in data_lines(read_text(path, _MAXIMUM_TRAJECTORY_BYTES, InvalidPose)):
        words = line.replace(",", " ").split()
        with naming(f"{path}, line {number}"):
            if len(words) != 8:
                raise InvalidPose(f"The line has {len(words)} words. Write t tx ty tz qx qy qz qw.")
            rows.append(_numbers(words))
        numbers.append(number)
    if not rows:
        raise InvalidPose(f"{path}: The file holds no pose. Remove it, or write some.")
    table = np.array(rows)
    with np.errstate(over="ignore", invalid="ignore"):
        off = np.abs(np.linalg.norm(table[:, 4:], axis=1) - 1.0)
    bad = ~np.isfinite(table).all(axis=1) | ~(off < _TOLERANCE)
    if bad.any():
        raise InvalidPose(
            f"{path}, line {numbers[int(np.argmax(bad))]}: The pose is not finite, or its "
            "quaternion not of unit length. Write t tx ty tz qx qy qz qw, or leave the line out."
        )
    stamps, first = np.unique(table[:, 0], return_index=True)
    quaternions = table[first, 4:]
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return SensorTrajectory(stamps, table[first, 1:4], quaternions)


def _numbers(words: list[str]) -> list[float]:
    try:
        return [float(word) for word in words]
    except ValueError as cause:
        raise InvalidPose(f"A word is no number ({cause}). Write numbers only.") from cause


def read_cloud(
    path: Path, source: CloudSource, *, name: str = "", pose: Floats | None = None
) -> Scan:
    """Return the points of a file, and how they were read.

    Raises
    ------
    UnreadableCloud : the file is absent or too large; and as `decode_scan`. Each error names the
        file.
    """
    data = read_bytes(path, MAXIMUM_CLOUD_BYTES, UnreadableCloud)
    told = source.file_format or ("kitti" if is_kitti(path) else None)
    with naming(str(path)):
        scan = decode_scan(
            data,
            file_format=told,
            viewpoint=source.viewpoint,
            units_per_metre=source.units_per_metre,
            pose=pose,
        )
    return replace(scan, cloud=replace(scan.cloud, name=name))


Split = Literal["train", "test"]


class Layout(Enum):
    """How the files of a sequence are named."""

    #: `frame-%06d.depth.png`, each with `frame-%06d.pose.txt` where its pose is known.
    SEVEN_SCENES = "7-Scenes"
    #: `depth.txt` lists time stamps and files, `groundtruth.txt` poses at other stamps.
    TUM = "TUM RGB-D"
    #: Depth files of any name, PNG or NPY, in natural order; poses as `find_pose_file` finds them.
    PLAIN = "plain"
    #: Files of points (any format of clouds) of any name; poses likewise.
    CLOUDS = "clouds"
    #: Messages of a recording of ROS; poses of its transforms.
    RECORDING = "recording"
    #: A database of RTAB-Map: nodes with depth or laser scans, and their poses.
    RTABMAP = "RTAB-Map"
    #: A folder of Polycam: `keyframes` with depth, and cameras with poses.
    POLYCAM = "Polycam"
    #: A folder or .r3d file of Record3D: metadata with poses, depth.
    RECORD3D = "Record3D"
    #: A `transforms.json` of nerfstudio that names depth images.
    NERFSTUDIO = "nerfstudio"
    #: An E57 file: scans with the poses of their scanner.
    E57 = "E57"

    @property
    def is_export(self) -> bool:
        """Whether another system has written it, so that nothing around it names its frames."""
        return self in _EXPORTS


_EXPORTS = frozenset(
    {
        Layout.RECORDING, Layout.RTABMAP, Layout.POLYCAM, Layout.RECORD3D, Layout.NERFSTUDIO,
        Layout.E57,
    }
)  # fmt: skip


class FrameReference(FrameFile):
    """One frame of a sequence, not yet read; `find_sequences` gives each a name of its own."""

    def read(self) -> AnyFrame:
        """Return the frame; raises as `read_frame`, `read_cloud` and `pose`."""
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
        """Return the frame, where only a depth image will do; raises as `read_frame` and `pose`.

        Raises
        ------
        DatasetError : it is a cloud.
        """
        if self.camera is None:
            raise DatasetError(
                f"{self.path}: This is a cloud, and a depth image is needed here. Name a folder or "
                "file of depth images."
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
    """Frames of one run of a sensor, in order.

    Parameters
    ----------
    name : unique in what `find_sequences` returned
    folder : where its files are
    layout : how they are named
    parent_frame : name of the frame its poses lead to. Sequences with the same name share
        it, and their poses can be compared; others cannot
    split : what the scene's authors use it for, or None where they do not say
    frames : at least one
    note : what was left out on the way, for people; empty where nothing was
    unposed : why frames have no pose, for people; empty where all have one, and where `note` tells
    lost : frames with depth or points that are left out, or whose poses are, though nobody said so
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
        """Where its parent frame is named: the folder of the scene, or its own."""
        if self.layout.is_export or self.parent_frame == self.name:
            return self.folder
        return self.folder.parent


#: Reasons to leave out what holds neither depth nor points of a place: nothing is lost by it.
NOTHING_TO_TAKE = frozenset(
    {
        "frames without a depth_file_path", "cameras without a depth image", "frames without depth",
        "scans without points", "stereo images without depth", "laser scans of two dimensions",
    }
)  # fmt: skip


def count_lost(left_out: Counter[str]) -> int:
    """Return how many of the frames that were left out, by the reason, had something to take."""
    return left_out.total() - sum(left_out[reason] for reason in NOTHING_TO_TAKE)


# What a sequence is called, as it is sent with the uploads of its frames.


def session_of(sequence: FrameSequence) -> str:
    """Name of a sequence, the same whether its own folder was named or the scene's."""
    if sequence.layout.is_export or sequence.parent_frame == sequence.name:
        return sequence.name
    return f"{sequence.parent_frame}/{sequence.folder.name}"


def parent_frame_of(sequence: FrameSequence, robot: str | None) -> str:
    """What poses lead to: folders of two robots may share a name, and their poses no frame."""
    own = sequence.parent_frame
    return own if robot is None else f"{robot}/{own}"


def numbered_sequences(
    sequences: Iterable[FrameSequence], session: str | None
) -> list[FrameSequence]:
    """Sequences with the places of their frames within the sessions that they are sent to.

    Several sequences of one session are numbered one after the other, so that their frames do not
    mix; frames of one folder that were named one by one keep the folder's numbers, or are numbered
    as they were named.

    Parameters
    ----------
    sequences : in the order in which they follow each other
    session : of all of them; None: each has its own
    """
    told, found = list(sequences), []
    names = [session or session_of(one) for one in told]
    alone = {name for name in names if names.count(name) == 1}
    first: dict[tuple[str, Path], int] = {}
    free: dict[str, int] = {}  # the next number of each session
    for name, one in zip(names, told, strict=True):
        if name in alone:
            found.append(one)
            continue
        offset = first.setdefault((name, one.folder), free.get(name, 0))
        frames = []
        for frame in one.frames:
            place = free.get(name, 0)
            if frame.sequence is not None:
                place = offset + frame.sequence
            frames.append(replace(frame, sequence=place))
            free[name] = max(free.get(name, 0), place + 1)
        found.append(replace(one, frames=tuple(frames)))
    return found
