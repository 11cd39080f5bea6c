"""Readers and writers of datasets: sequences of depth images or clouds with cameras and poses.

path  --find_sequences-->  FrameSequence  --FrameReference.read-->  Frame
bytes  --decode_frame-->  Frame
"""

from sceneprint.formats.dataset.frame_reference import (
    FrameReference,
    FrameSequence,
    Layout,
    Split,
    read_cloud,
    read_trajectory,
)
from sceneprint.formats.dataset.sequences import (
    find_recordings,
    find_sequences,
    trajectory_row,
    trajectory_text,
    write_depth_png,
    write_intrinsics,
    write_pose,
)
from sceneprint.formats.depth_file import (
    decode_frame,
    decode_npy,
    decode_png,
    make_frame,
    read_frame,
)
from sceneprint_client.poses import SensorTrajectory, interpolate, rigid_transform
from sceneprint_client.sidecars import (
    Camera,
    CloudSource,
    find_camera,
    find_cloud_source,
    read_camera,
    read_pose,
)

__all__ = [
    "Camera",
    "CloudSource",
    "FrameReference",
    "FrameSequence",
    "Layout",
    "SensorTrajectory",
    "Split",
    "decode_frame",
    "decode_npy",
    "decode_png",
    "find_camera",
    "find_cloud_source",
    "find_recordings",
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
