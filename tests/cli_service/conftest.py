"""Fixtures of commands that use a service: a real service and a data set."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from sceneprint.formats.dataset import Camera, write_depth_png, write_intrinsics, write_pose
from sceneprint.types import DepthFrame

Run = Callable[..., Any]


@pytest.fixture
def sceneprint(service_url: str, run_command: Run, monkeypatch: pytest.MonkeyPatch) -> Run:
    """Runs a command in this process against the service and checks its exit code."""
    monkeypatch.setenv("SCENEPRINT_URL", service_url)
    return run_command


@pytest.fixture(scope="session")
def rooms(room_frames: tuple[DepthFrame, ...], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three views of each of two rooms, with poses, in 7-Scenes layout."""
    root = tmp_path_factory.mktemp("rooms")
    for number, frame in enumerate(room_frames):
        folder = root / f"room-{number // 3}" / "seq-01"
        folder.mkdir(parents=True, exist_ok=True)
        write_intrinsics(folder, Camera(frame.intrinsics))
        write_depth_png(folder / f"frame-{number % 3:06d}.depth.png", frame.depth, 1000.0)
        assert frame.pose is not None
        write_pose(folder / f"frame-{number % 3:06d}.pose.txt", frame.pose)
    return root
