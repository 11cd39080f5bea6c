"""Correct the drift of a robot's odometry with a map.

    python examples/tracked_drive.py                               # in this process
    python examples/tracked_drive.py --url http://127.0.0.1:8008   # a service, with --key KEY

Halfway, someone carries the robot to another room. The rooms and the odometry, which drifts, are
synthetic.
"""

from __future__ import annotations

import argparse
import tempfile

import numpy as np

from sceneprint.types import DepthFrame, Floats
from sceneprint_client import Client, Tracker
from sceneprint_client.api import CameraIntrinsics, FrameMeta, GivenPose
from sceneprint_lab.synth import synthesise_room

MAP = "tracked-drive"


def build_map(client: Client, name: str, views: tuple[DepthFrame, ...]) -> CameraIntrinsics:
    """Upload views with their poses, and return their camera."""
    k = views[0].intrinsics
    camera = CameraIntrinsics(width=k.width, height=k.height, fx=k.fx, fy=k.fy, cx=k.cx, cy=k.cy)
    poses = [GivenPose(parent_frame=name, matrix=np.array(one.pose).tolist()) for one in views]
    metas = [FrameMeta(intrinsics=camera, session=name, pose=pose) for pose in poses]
    added = [client.upload(MAP, one.depth, meta) for one, meta in zip(views, metas, strict=True)]
    client.wait([one.job_id for one in added])
    return camera


def moved(before: DepthFrame, after: DepthFrame) -> Floats:
    """Return the motion that wheel odometry measures, with a length that is off by 1 %."""
    step = np.linalg.inv(np.array(before.pose)) @ np.array(after.pose)
    step[:3, 3] *= 1.01
    return step


def drive(client: Client) -> None:
    """Map two rooms, then drive through both; no odometry exists between them."""
    walks = [synthesise_room(3, index, 24, along_path=True).frames for index in (0, 1)]
    client.create_map(MAP, "Example: two rooms", model="depth")
    cameras = [build_map(client, f"room-{i}", walk[::3]) for i, walk in enumerate(walks)]
    T_odom_camera, stamp = np.eye(4), 0.0
    tracker = Tracker(client, MAP, camera=cameras[0])
    for i, walk in enumerate(walks):
        print(f"in room {i}")
        for before, view in zip(walk[:-2:2], walk[2::2], strict=True):
            T_odom_camera, stamp = T_odom_camera @ moved(before, view), stamp + 0.5
            state = tracker.update(view.depth, T_odom_camera, stamp=stamp)
            text = state.reason
            if state.status == "tracking" and state.T_map_sensor is not None:  # safe to drive
                off = np.linalg.norm(state.T_map_sensor[:3, 3] - np.array(view.pose)[:3, 3])
                text = f"{state.parent_frame}, error {100 * off:.0f} cm: {text}"
            print(f"  {state.status}: {text}")


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--url", help="address of a service")
    parser.add_argument("--key", help="key of the service, if it requires one")
    options = parser.parse_args()
    with (
        tempfile.TemporaryDirectory() as scratch,
        Client(options.url, options.key) if options.url else Client.embedded(scratch) as client,
    ):
        drive(client)


if __name__ == "__main__":
    main()
