"""Frames in and out: depth images, cameras, clouds, poses, and the sequences they come in.

path  --find_sequences-->  Sequence  --FrameReference.read-->  Frame
bytes  --decode_frame-->  Frame
"""

from sceneprint.datasets.clouds import CloudSource, find_cloud_source, read_cloud
from sceneprint.datasets.images import decode_frame, make_frame, read_frame
from sceneprint.datasets.intrinsics import Camera, find_camera, read_camera
from sceneprint.datasets.npy import decode_npy
from sceneprint.datasets.png import decode_png
from sceneprint.datasets.poses import (
    Trajectory,
    interpolate,
    read_pose,
    read_trajectory,
)
from sceneprint.datasets.records import FrameReference, Layout, Sequence, Split
from sceneprint.datasets.sequences import find_sequences
from sceneprint.datasets.writing import (
    trajectory_row,
    trajectory_text,
    write_depth_png,
    write_intrinsics,
    write_pose,
)
from sceneprint.geometry.rigid import rigid_transform

__all__ = [
    "Camera",
    "CloudSource",
    "FrameReference",
    "Layout",
    "Sequence",
    "Split",
    "Trajectory",
    "decode_frame",
    "decode_npy",
    "decode_png",
    "find_camera",
    "find_cloud_source",
    "find_sequences",
    "interpolate",
    "make_frame",
    "read_camera",
    "read_cloud",
    "read_frame",
    "read_pose",
    "read_trajectory",
    "rigid_transform",
    "trajectory_row",
    "trajectory_text",
    "write_depth_png",
    "write_intrinsics",
    "write_pose",
]
