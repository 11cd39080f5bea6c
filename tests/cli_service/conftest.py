"""Fixtures of commands that use a service: a real service and a data set."""

import pytest

from sceneprint.formats.dataset import Camera, write_depth_png, write_intrinsics, write_pose
from tests.conftest import halved


@pytest.fixture
def sceneprint(service_url, run_command, monkeypatch):
    """Runs a command in this process against the service and checks its exit code."""
    monkeypatch.setenv("SCENEPRINT_URL", service_url)
    return run_command


@pytest.fixture(scope="session")
def room_frames(room_frames):
    """The frames of `tests/conftest.py` with a quarter of their samples, which are fast to sign."""
    return tuple(map(halved, room_frames))


def write_rooms(root, frames, views=3):
    """Write some views of each room, with poses, in 7-Scenes layout; return the folder."""
    for number, frame in enumerate(frames):
        folder = root / f"room-{number // views}" / "seq-01"
        folder.mkdir(parents=True, exist_ok=True)
        write_intrinsics(folder, Camera(frame.intrinsics))
        write_depth_png(folder / f"frame-{number % views:06d}.depth.png", frame.depth, 1000.0)
        assert frame.pose is not None
        write_pose(folder / f"frame-{number % views:06d}.pose.txt", frame.pose)
    return root


@pytest.fixture(scope="session")
def whole_rooms(room_views, tmp_path_factory):
    """The rooms with all samples: the third frames have no accepted match."""
    frames = [frame for i in range(2) for frame in room_views(21, i, 3).frames]
    return write_rooms(tmp_path_factory.mktemp("whole"), frames)


@pytest.fixture(scope="session")
def rooms(room_frames, tmp_path_factory):
    return write_rooms(tmp_path_factory.mktemp("rooms"), room_frames)
