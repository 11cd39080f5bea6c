"""What a sequence of frames is, before any of its frames is read."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Literal

from sceneprint.datasets.clouds import CloudSource, read_cloud
from sceneprint.datasets.images import read_frame
from sceneprint.datasets.intrinsics import Camera
from sceneprint.datasets.poses import read_pose
from sceneprint.errors import DatasetError
from sceneprint.types import AnyFrame, Floats, Frame

Split = Literal["train", "test"]


class Layout(Enum):
    """How the files of a sequence are named."""

    #: `frame-%06d.depth.png`, each with `frame-%06d.pose.txt` where its pose is known.
    SEVEN_SCENES = "7-Scenes"
    #: `depth.txt` lists time stamps and files, `groundtruth.txt` poses at other stamps.
    TUM = "TUM RGB-D"
    #: Depth files of any name, PNG or NPY, in natural order; no poses.
    PLAIN = "plain"
    #: Files of points (PLY, PCD, KITTI .bin, LAS, LAZ) of any name, each with `NAME.pose.txt`
    #: where its pose is known.
    CLOUDS = "clouds"


@dataclass(frozen=True, eq=False)
class FrameReference:
    """One frame of a sequence, not yet read.

    Parameters
    ----------
    name : unique in what `find_sequences` returned, such as "seq-01/frame-000000"
    path : the depth image, or the file of points
    camera : the sensor; None for points
    timestamp : seconds, or None where the layout has none
    pose_source : file of the pose, the pose itself, or None where unknown
    cloud : how the points are read; None for a depth image. One of this and `camera` is given
    """

    name: str
    path: Path
    camera: Camera | None
    timestamp: float | None = None
    pose_source: Path | Floats | None = None
    cloud: CloudSource | None = None

    def __post_init__(self) -> None:
        if (self.camera is None) == (self.cloud is None):
            raise ValueError("a frame is a depth image with a camera, or a cloud with its source")

    @property
    def kind(self) -> Literal["depth", "cloud"]:
        """What its file holds."""
        return "depth" if self.cloud is None else "cloud"

    @property
    def pose(self) -> Floats | None:
        """(4, 4) T_parent_sensor, or None where unknown; read from its file each time.

        Raises
        ------
        InvalidPose : the file holds no rigid transform; names the file.
        """
        if isinstance(self.pose_source, Path):
            return read_pose(self.pose_source)
        return self.pose_source

    def read(self) -> AnyFrame:
        """Return the frame; raises as `read_frame`, `read_cloud` and `pose`."""
        if self.cloud is None:
            return self.read_depth()
        return read_cloud(self.path, self.cloud, name=self.name, pose=self.pose).cloud

    def read_depth(self) -> Frame:
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
        return read_frame(
            self.path,
            self.camera.intrinsics,
            depth_scale=self.camera.depth_scale,
            along_ray=self.camera.along_ray,
            name=self.name,
            pose=self.pose,
        )


@dataclass(frozen=True, eq=False)
class Sequence:
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
    """

    name: str
    folder: Path
    layout: Layout
    parent_frame: str
    split: Split | None
    frames: tuple[FrameReference, ...]
