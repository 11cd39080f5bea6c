"""A robot that maps a room, is carried away, and finds out where it is.

    python examples/robot_loop.py                               # all in this process, nothing kept
    python examples/robot_loop.py --data robot                  # the same, kept in a folder
    python examples/robot_loop.py --url http://127.0.0.1:8008   # a service, with --key KEY

The room is synthetic, and so is the odometry; the rest is what a real robot would do.
"""

from __future__ import annotations

import argparse
import io
import tempfile
from collections.abc import Iterable

import numpy as np

from sceneprint.errors import MapExists, UselessFrame
from sceneprint.lab.synth import synthesise_room
from sceneprint.types import DepthFrame, Floats
from sceneprint_client import Client
from sceneprint_client.api import CameraIntrinsics, FrameMeta, GivenPose

MAP, ROBOT = "robot-loop", "r2"


class Robot:
    """Uploads what it sees while it knows where it is, and asks when it does not."""

    def __init__(self, client: Client) -> None:
        self.client = client
        self.waiting: list[str] = []  # jobs of what was uploaded: none has to be waited for

    def remember(self, seen: DepthFrame, session: str) -> None:
        """Once a metre, say: the frame is safe when this returns, and can be found soon after."""
        added = self.client.upload(MAP, depth_of(seen), meta_of(seen, session))
        self.waiting.append(added.job_id)

    def find_itself(self, views: Iterable[DepthFrame]) -> tuple[DepthFrame, Floats] | None:
        """Look until the place is known: the frame it was known by, and the camera's pose (4, 4)
        in the map. None where the map has not been here.
        """
        for seen in views:
            try:
                found = self.client.localize(MAP, depth_of(seen), meta_of(seen), k=5)
            except UselessFrame:
                print("  a blank wall: turn, and look again")
                continue
            if found.status == "ambiguous":
                print("  it could be several places: drive a metre, and look again")
            elif found.status == "not_found":
                print("  not a place of the map: explore, and map it as a new session")
                self.remember(seen, session="afternoon")
                return None
            elif found.strength == "weak" or found.pose is None:
                print("  probably known: look again before trusting it")
            else:
                print(f"  found, {found.support} of {found.votes} views agree: go on from there")
                return seen, np.array(found.pose.matrix)
        return None


def depth_of(seen: DepthFrame) -> bytes:
    """Depth as it is sent: metres, NPY. A 16-bit PNG in millimetres is smaller."""
    file = io.BytesIO()
    np.save(file, seen.depth)
    return file.getvalue()


def meta_of(seen: DepthFrame, session: str | None = None) -> FrameMeta:
    """What is known of a frame: its camera, and with a session also the pose by odometry."""
    k = seen.intrinsics
    camera = CameraIntrinsics(width=k.width, height=k.height, fx=k.fx, fy=k.fy, cx=k.cx, cy=k.cy)
    if session is None or seen.pose is None:
        return FrameMeta(intrinsics=camera, robot=ROBOT)
    # poses of two sessions are never mixed: each drifts from an origin of its own
    pose = GivenPose(parent_frame=f"{ROBOT}/{session}", matrix=seen.pose.tolist())
    return FrameMeta(intrinsics=camera, robot=ROBOT, session=session, pose=pose)


def truth_of(seen: DepthFrame) -> Floats:
    """Where a synthetic frame was taken: a real robot does not know."""
    if seen.pose is None:
        raise ValueError(f"{seen.name} has no pose")
    return seen.pose


def run(client: Client) -> list[float]:
    """The robot's day; how far off each pose was that it believed, metres."""
    walk = synthesise_room(seed=5, index=0, views=24, along_path=True).frames
    elsewhere = synthesise_room(seed=5, index=1, views=1).frames
    try:
        client.create_map(MAP, "Example: a robot's own map", model="depth")
    except MapExists:
        print(f"map {MAP} is there already, and is used")
    robot = Robot(client)
    print(f"driving: {len(walk[::2])} frames are uploaded")
    for seen in walk[::2]:
        robot.remember(seen, session="morning")
    client.wait(robot.waiting)
    errors = []
    for place, views in {"in its room": walk[13::2], "in another": elsewhere}.items():
        print(f"carried away, and set down {place}:")
        known = robot.find_itself(views)
        if known is not None:
            seen, pose = known
            errors.append(float(np.linalg.norm(pose[:3, 3] - truth_of(seen)[:3, 3])))
            print(f"  {100 * errors[-1]:.1f} cm from where it truly is")
    client.wait(robot.waiting)
    sessions = sorted({str(frame.session) for frame in client.frames(MAP)})
    print(f"the map has {client.map(MAP).frames} frames of the sessions {sessions}")
    return errors


def main() -> None:
    """The example as a command."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("--url", help="of a service")
    parser.add_argument("--key", help="where it asks for one")
    parser.add_argument("--data", help="folder to keep the map in, without a service")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as scratch:
        if options.url is not None:
            client = Client(options.url, options.key)
        else:
            client = Client.embedded(options.data or scratch)
        with client:
            run(client)


if __name__ == "__main__":
    main()
