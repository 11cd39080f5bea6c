"""Write two small ROS 2 recordings of two robots with depth cameras in one room.

    python examples/record_drives.py drives

`drives/mapping` has poses in `map`, as a SLAM system publishes them. `drives/later` has only
odometry with another origin and a drift of 1 %. `drives/later.tum` holds the true poses of
its camera in `map` for comparison. The room is synthetic. Needs rosbags (README.md).
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from sceneprint.formats.dataset import trajectory_row, trajectory_text
from sceneprint.types import Floats, Intrinsics
from sceneprint_client.poses import quaternion_of
from sceneprint_lab.synth import take, trajectory
from sceneprint_lab.synth.dataset import room_and_rng

CAMERA = Intrinsics(320, 240, 292.5, 292.5, 159.5, 119.5)
#: The camera sits above the base and looks ahead, 10 degrees down: x right, y down, z forward.
_C, _S = np.cos(np.radians(10)), np.sin(np.radians(10))
T_BASE_CAMERA = np.array([[0, -_S, _C, 0.1], [-1, 0, 0, 0], [0, -_C, -_S, 1.2], [0, 0, 0, 1]])
#: Start of each recording, seconds since 1970, and interval of frames, seconds.
BEGIN = {"mapping": 1_763_280_000, "later": 1_763_366_400}
STEP_S = 0.5


class Recorder:
    """Writer of messages to a rosbag2 with an MCAP file."""

    def __init__(self, folder: Path) -> None:
        self.types = get_typestore(Stores.ROS2_HUMBLE)
        self.writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
        self.connections: dict[str, Any] = {}

    def __enter__(self) -> Self:
        self.writer.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:  # fmt: skip
        self.writer.close()

    def make(self, name: str, **fields: Any) -> Any:
        """Return a message, such as `make("geometry_msgs/msg/Point", x=0.0, y=0.0, z=0.0)`."""
        return self.types.types[name](**fields)

    def write(self, topic: str, t: float, message: Any) -> None:
        """Record a message with a time stamp."""
        name = message.__msgtype__
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(topic, name, typestore=self.types)
        data = self.types.serialize_cdr(message, name)
        self.writer.write(self.connections[topic], round(t * 1e9), data)

    def header(self, t: float, frame: str) -> Any:
        """Return a header with a stamp and a frame."""
        stamp = self.make("builtin_interfaces/msg/Time", sec=int(t), nanosec=round(t % 1 * 1e9))
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def depth(self, t: float, depth: Floats) -> None:
        """Record `/camera/depth/image_raw`, in millimetres, and its camera_info."""
        k, header = CAMERA, self.header(t, "camera")
        samples = np.round(1000 * depth).astype("<u2")
        image = self.make(
            "sensor_msgs/msg/Image", header=header, height=k.height, width=k.width,
            encoding="16UC1", is_bigendian=0, step=2 * k.width, data=samples.view("u1").ravel(),
        )  # fmt: skip
        self.write("/camera/depth/image_raw", t, image)
        region = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
        K = np.array([[k.fx, 0, k.cx], [0, k.fy, k.cy], [0, 0, 1]])
        info = self.make(
            "sensor_msgs/msg/CameraInfo", header=header, height=k.height, width=k.width,
            distortion_model="plumb_bob", d=np.zeros(5), k=K.ravel(), r=np.eye(3).ravel(),
            p=np.column_stack([K, np.zeros(3)]).ravel(), binning_x=0, binning_y=0,
            roi=self.make("sensor_msgs/msg/RegionOfInterest", **region),
        )  # fmt: skip
        self.write("/camera/depth/camera_info", t, info)

    def transform(self, topic: str, t: float, parent: str, child: str, T: Floats) -> None:
        """Record T_parent_child on `/tf` or `/tf_static`."""
        pose = self.make(
            "geometry_msgs/msg/Transform", translation=self._xyz("Vector3", T),
            rotation=self._rotation(T),
        )  # fmt: skip
        edge = self.make(
            "geometry_msgs/msg/TransformStamped", header=self.header(t, parent),
            child_frame_id=child, transform=pose,
        )  # fmt: skip
        self.write(topic, t, self.make("tf2_msgs/msg/TFMessage", transforms=[edge]))

    def odometry(self, t: float, T_odom_base: Floats) -> None:
        """`/odom`."""
        zero = self._xyz("Vector3", np.eye(4))
        pose = self.make(
            "geometry_msgs/msg/Pose", position=self._xyz("Point", T_odom_base),
            orientation=self._rotation(T_odom_base),
        )  # fmt: skip
        twist = self.make("geometry_msgs/msg/Twist", linear=zero, angular=zero)
        none = {"covariance": np.zeros(36)}
        message = self.make(
            "nav_msgs/msg/Odometry", header=self.header(t, "odom"), child_frame_id="base_link",
            pose=self.make("geometry_msgs/msg/PoseWithCovariance", pose=pose, **none),
            twist=self.make("geometry_msgs/msg/TwistWithCovariance", twist=twist, **none),
        )  # fmt: skip
        self.write("/odom", t, message)

    def _xyz(self, kind: str, T: Floats) -> Any:
        x, y, z = map(float, T[:3, 3])
        return self.make(f"geometry_msgs/msg/{kind}", x=x, y=y, z=z)

    def _rotation(self, T: Floats) -> Any:
        x, y, z, w = map(float, quaternion_of(T[:3, :3]))
        return self.make("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)


def base_at(T_map_camera: Floats) -> Floats:
    """Return T_map_base of a robot on the floor below a hand-held camera, with its heading."""
    x, y = T_map_camera[:2, 3]
    forward = T_map_camera[:2, 2] / np.linalg.norm(T_map_camera[:2, 2])
    T = np.eye(4)
    T[:2, 0], T[:2, 1], T[:2, 3] = forward, (-forward[1], forward[0]), (x, y)
    return T


def odometry_of(T_map_base: list[Floats]) -> list[Floats]:
    """Return T_odom_base of a drive from the identity, with steps that are 1 % too long."""
    found = [np.eye(4)]
    for before, after in pairwise(T_map_base):
        step = np.linalg.inv(before) @ after
        step[:3, 3] *= 1.01
        found.append(found[-1] @ step)
    return found


def record(folder: Path, frames: int) -> None:
    """Record two drives along one path; frames of the second lie between those of the first."""
    room, rng = room_and_rng(5, 1)
    path = [base_at(T_map_camera) for T_map_camera in trajectory(room, 12 * frames, rng)]
    for name, drive in (("mapping", path[::12]), ("later", path[6::12])):
        stamps = [BEGIN[name] + STEP_S * i for i in range(len(drive))]
        with Recorder(folder / name) as recorder:
            recorder.transform("/tf_static", stamps[0], "base_link", "camera", T_BASE_CAMERA)
            for t, T_map_base, T_odom_base in zip(stamps, drive, odometry_of(drive), strict=True):
                recorder.odometry(t, T_odom_base)
                if name == "mapping":  # poses of SLAM
                    T_map_odom = T_map_base @ np.linalg.inv(T_odom_base)
                    recorder.transform("/tf", t, "map", "odom", T_map_odom)
                recorder.depth(t, take(room, T_map_base @ T_BASE_CAMERA, CAMERA, rng))
        print(f"{folder / name}: {len(drive)} frames in {STEP_S * (len(drive) - 1):g} s")
    rows = [trajectory_row(t, T @ T_BASE_CAMERA) for t, T in zip(stamps, drive, strict=True)]
    (folder / "later.tum").write_text(trajectory_text(rows, ["T_map_camera of the drive later"]))


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("folder", type=Path, help="new folder for the recordings")
    parser.add_argument("--frames", type=int, default=24, help="frames of each drive (default: 24)")
    options = parser.parse_args()
    options.folder.mkdir(parents=True)
    record(options.folder, options.frames)


if __name__ == "__main__":
    main()
