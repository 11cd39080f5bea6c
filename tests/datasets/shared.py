"""Helpers of the data set tests: poses, modified images and their results."""

import numpy as np

from sceneprint.errors import FrameError
from sceneprint.formats.dataset import Camera, make_frame, write_depth_png, write_pose
from sceneprint.types import Intrinsics

CAMERA = Camera(Intrinsics(4, 3, 5.0, 5.0, 1.5, 1.0), 1000.0)
DEPTH = np.arange(12, dtype=np.float32).reshape(3, 4) / 8


def frame_or_error(decode, data, camera):
    """Return a valid frame, or a FrameError with a message of one line."""
    try:
        frame = make_frame(decode(data), camera)
    except FrameError as error:
        assert "\n" not in str(error)  # noqa: PT017  (an error is a right outcome too)
        return None
    assert np.isfinite(frame.depth).all()
    assert (frame.depth >= 0).all()
    assert frame.depth.any()
    assert frame.depth.shape == (camera.height, camera.width)
    return frame


def mutations(data, number):
    random = np.random.default_rng(7)
    for _ in range(number):
        mutated = bytearray(data)
        for _ in range(int(random.integers(1, 4))):
            place = int(random.integers(0, len(mutated)))
            match random.integers(0, 4):
                case 0:
                    mutated[place] = int(random.integers(0, 256))
                case 1:
                    mutated[place] ^= 1 << int(random.integers(0, 8))
                case 2:
                    del mutated[place : place + int(random.integers(1, 9))]
                case _:
                    mutated[place:place] = random.bytes(int(random.integers(1, 9)))
        yield bytes(mutated)


def seven_scenes(folder, frames=2, farther=0):
    """Write a sequence of 7-Scenes with colour; return its folder."""
    folder.mkdir(parents=True)
    for i in range(frames):
        depth = DEPTH + np.float32(i + farther)
        write_depth_png(folder / f"frame-{i:06d}.depth.png", depth, 1000.0)
        write_pose(folder / f"frame-{i:06d}.pose.txt", pose_at(i))
        (folder / f"frame-{i:06d}.color.png").write_bytes(b"colour")
    return folder


def pose_at(x):
    pose = np.eye(4)
    pose[0, 3] = x
    return pose
