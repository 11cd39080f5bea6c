"""A robot that maps a room, is carried away, and finds out where it is.

    python examples/robot_loop.py                               # all in this process, nothing kept
    python examples/robot_loop.py --data robot                  # the same, kept in a folder
    python examples/robot_loop.py --url http://127.0.0.1:8008   # a service, with --key KEY

The room is synthetic, and so is the odometry; the rest is what a real robot would do: it drives on
`found` alone. Beside a cabinet that looks the same from behind it is told several places, and does
not drive until it has moved and asked again, or has said what odometry makes of it.
"""

from __future__ import annotations

import argparse
import io
import tempfile
from collections.abc import Iterable

import numpy as np

from sceneprint.errors import MapExists, UselessFrame
from sceneprint.types import DepthFrame, Floats
from sceneprint_client import Client
from sceneprint_client.api import CameraIntrinsics, FrameMeta, GivenPose, Localization, Prior
from sceneprint_lab.synth import synthesise_lookalike, synthesise_room

MAP, CABINET, ROBOT = "robot-loop", "robot-loop-cabinet", "r2"


class Robot:
    """Uploads what it sees while it knows where it is, and asks when it does not."""

    def __init__(self, client: Client, name: str) -> None:
        self.client = client
        self.map = name
        self.waiting: list[str] = []  # jobs of what was uploaded: none has to be waited for

    def remember(self, seen: DepthFrame, session: str) -> None:
        """Once a metre, say: the frame is safe when this returns, and can be found soon after."""
        added = self.client.upload(self.map, depth_of(seen), meta_of(seen, session))
        self.waiting.append(added.job_id)

    def find_itself(
        self, views: Iterable[DepthFrame], prior: Prior | None = None
    ) -> tuple[DepthFrame, Floats] | None:
        """Look until the place is known: the frame it was known by, and the camera's pose (4, 4)
        in the map. None where it stays unknown. `prior`: what is believed of the first view.
        """
        for seen in views:
            try:
                found = self.client.localize(
                    self.map, depth_of(seen), meta_of(seen), k=5, prior=prior
                )
            except UselessFrame:
                print("  a blank wall: turn, and look again")
                continue
            if found.status == "ambiguous":
                print(f"  do not drive: {found.reason}")
                tell_alternatives(found)
                print("  move a metre, and look again")
                prior = None  # it was of this view
            elif found.status == "not_found":
                print(f"  not a place of the map ({found.cause}): explore, and map it")
                self.remember(seen, session="afternoon")
                return None
            elif found.pose is None or found.confidence is None:
                print("  a place of the map, but its pose is not known: look again")
            else:
                votes = f"{found.support} of {found.votes} views vote for one pose"
                sure = f"{100 * found.confidence:.1f} % sure, decided by {found.verified_by}"
                print(f"  found, {votes}, {sure}: go on from there")
                return seen, np.array(found.pose.matrix)
        return None


def tell_alternatives(found: Localization) -> None:
    """The poses that the evidence supports: one of them is right at most."""
    for one in found.alternatives:
        t, sure = one.pose.translation, 100 * (one.confidence or 0.0)
        print(f"    {sure:.0f} %: x {t.x:.2f}, y {t.y:.2f} m, support {one.support}")


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
    robot = Robot(client, MAP)
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
    errors += beside_a_cabinet(client)
    client.wait(robot.waiting)
    sessions = sorted({str(frame.session) for frame in client.frames(MAP)})
    print(f"the map has {client.map(MAP).frames} frames of the sessions {sessions}")
    return errors


def beside_a_cabinet(client: Client) -> list[float]:
    """A place that a view cannot tell from another, asked without and with a prior; as `run`."""
    site = synthesise_lookalike("object", seed=1, index=0, queries=2)
    try:
        client.create_map(CABINET, "Example: the same from two sides", model="depth")
    except MapExists:
        print(f"map {CABINET} is there already, and is used")
    robot = Robot(client, CABINET)
    for seen in site.map:
        robot.remember(seen, session="round")
    client.wait(robot.waiting)
    print("carried away, and set down beside a cabinet that looks the same from behind:")
    if robot.find_itself(site.queries) is None:
        print("  still not known: drive nowhere by these poses")
    last = site.queries[-1]
    odometry = truth_of(last).copy()
    odometry[:2, 3] += 0.1, -0.1  # what it believes is off by some centimetres
    believed = GivenPose(parent_frame=f"{ROBOT}/round", matrix=odometry.tolist())
    print("asked again, and odometry says where it is to 30 cm:")
    known = robot.find_itself([last], Prior(pose=believed, deviation_m=0.3, deviation_deg=10))
    if known is None:
        return []
    seen, pose = known
    error = float(np.linalg.norm(pose[:3, 3] - truth_of(seen)[:3, 3]))
    print(f"  {100 * error:.1f} cm from where it truly is")
    return [error]


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
