"""Map a room with a robot, carry the robot away, and localise it again.

    python examples/robot_loop.py                               # in this process, nothing stored
    python examples/robot_loop.py --data robot                  # the same, stored in a folder
    python examples/robot_loop.py --url http://127.0.0.1:8008   # a service, with --key KEY

Room and odometry are synthetic; otherwise the robot behaves like a real one and drives only on
`found`. Beside a cabinet that looks the same from behind, the answer has several poses, and the
robot does not drive until it has moved and queried again, or has passed its odometry as a prior.
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
    """A robot that uploads frames while its pose is known, and queries while it is not."""

    def __init__(self, client: Client, name: str) -> None:
        self.client = client
        self.map = name
        self.waiting: list[str] = []  # jobs of uploaded frames, for which the robot need not wait

    def upload_frame(self, seen: DepthFrame, session: str) -> None:
        """Upload a frame, for example once per metre; it is durable when this returns."""
        added = self.client.upload(self.map, depth_of(seen), meta_of(seen, session))
        self.waiting.append(added.job_id)

    def localise(
        self, views: Iterable[DepthFrame], prior: Prior | None = None
    ) -> tuple[DepthFrame, Floats] | None:
        """Query views until one is found; return it and the camera's pose (4, 4) in the map, or
        None. `prior` is the prior of the first view.
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
                print_alternatives(found)
                print("  move a metre, and look again")
                prior = None  # it applied to this view
            elif found.status == "not_found":
                print(f"  not a place of the map ({found.cause}): explore, and map it")
                self.upload_frame(seen, session="afternoon")
                return None
            elif found.pose is None or found.confidence is None:
                print("  a place of the map, but its pose is unknown: look again")
            else:
                votes = f"{found.support} of {found.votes} views vote for one pose"
                sure = f"{100 * found.confidence:.1f} % sure, decided by {found.verified_by}"
                print(f"  found, {votes}, {sure}: go on from there")
                return seen, np.array(found.pose.matrix)
        return None


def print_alternatives(found: Localization) -> None:
    """Print the poses that the evidence supports, of which at most one is right."""
    for one in found.alternatives:
        t, sure = one.pose.translation, 100 * (one.confidence or 0.0)
        print(f"    {sure:.0f} %: x {t.x:.2f}, y {t.y:.2f} m, support {one.support}")


def depth_of(seen: DepthFrame) -> bytes:
    """Return depth as NPY in metres; a 16-bit PNG in millimetres would be smaller."""
    file = io.BytesIO()
    np.save(file, seen.depth)
    return file.getvalue()


def meta_of(seen: DepthFrame, session: str | None = None) -> FrameMeta:
    """Return the metadata of a frame: its camera, and in a session also its pose from odometry."""
    k = seen.intrinsics
    camera = CameraIntrinsics(width=k.width, height=k.height, fx=k.fx, fy=k.fy, cx=k.cx, cy=k.cy)
    if session is None or seen.pose is None:
        return FrameMeta(intrinsics=camera, robot=ROBOT)
    # Each session has its own parent frame, since its odometry has its own origin and drift.
    pose = GivenPose(parent_frame=f"{ROBOT}/{session}", matrix=seen.pose.tolist())
    return FrameMeta(intrinsics=camera, robot=ROBOT, session=session, pose=pose)


def truth_of(seen: DepthFrame) -> Floats:
    """Return the true pose of a synthetic frame, which a real robot does not know."""
    if seen.pose is None:
        raise ValueError(f"{seen.name} has no pose")
    return seen.pose


def run(client: Client) -> list[float]:
    """Run the whole example; return the position error of each pose the robot used, metres."""
    walk = synthesise_room(seed=5, index=0, views=24, along_path=True).frames
    elsewhere = synthesise_room(seed=5, index=1, views=1).frames
    try:
        client.create_map(MAP, "Example: a robot's own map", model="depth")
    except MapExists:
        print(f"using the existing map {MAP}")
    robot = Robot(client, MAP)
    print(f"driving: uploading {len(walk[::2])} frames")
    for seen in walk[::2]:
        robot.upload_frame(seen, session="morning")
    client.wait(robot.waiting)
    errors = []
    for place, views in {"in its room": walk[13::2], "in another": elsewhere}.items():
        print(f"carried away and put down {place}:")
        known = robot.localise(views)
        if known is not None:
            seen, pose = known
            errors.append(float(np.linalg.norm(pose[:3, 3] - truth_of(seen)[:3, 3])))
            print(f"  position error {100 * errors[-1]:.1f} cm")
    errors += beside_a_cabinet(client)
    client.wait(robot.waiting)
    sessions = sorted({str(frame.session) for frame in client.frames(MAP)})
    print(f"the map has {client.map(MAP).frames} frames of the sessions {sessions}")
    return errors


def beside_a_cabinet(client: Client) -> list[float]:
    """Query an ambiguous place without and with a prior; return position errors like `run`."""
    site = synthesise_lookalike("object", seed=1, index=0, queries=2)
    try:
        client.create_map(CABINET, "Example: the same from two sides", model="depth")
    except MapExists:
        print(f"using the existing map {CABINET}")
    robot = Robot(client, CABINET)
    for seen in site.map:
        robot.upload_frame(seen, session="round")
    client.wait(robot.waiting)
    print("carried away and put down beside a cabinet that looks the same from behind:")
    if robot.localise(site.queries) is None:
        print("  still unknown: do not drive by these poses")
    last = site.queries[-1]
    odometry = truth_of(last).copy()
    odometry[:2, 3] += 0.1, -0.1  # the prior is off by some centimetres
    believed = GivenPose(parent_frame=f"{ROBOT}/round", matrix=odometry.tolist())
    print("queried again with a prior from odometry, accurate to 30 cm:")
    known = robot.localise([last], Prior(pose=believed, deviation_m=0.3, deviation_deg=10))
    if known is None:
        return []
    seen, pose = known
    error = float(np.linalg.norm(pose[:3, 3] - truth_of(seen)[:3, 3]))
    print(f"  position error {100 * error:.1f} cm")
    return [error]


def main() -> None:
    """Run the example."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0] if __doc__ else None)
    parser.add_argument("--url", help="address of a service")
    parser.add_argument("--key", help="key of the service, if it requires one")
    parser.add_argument("--data", help="folder to store the map in, without a service")
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
