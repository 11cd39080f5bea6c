"""What the tests of PostgreSQL alone share: stores on it, and waiting for what comes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from benchmarks.fleet.postgres import Server
from sceneprint.formats.dataset import write_depth_png
from sceneprint.store import Store, open_store
from sceneprint.types import DepthFrame
from sceneprint_client.api import CameraIntrinsics, FrameMeta


class Small(NamedTuple):
    """A small depth image."""

    png: bytes
    meta: FrameMeta


@pytest.fixture(scope="session")
def small(
    room_frames: tuple[DepthFrame, ...], tmp_path_factory: pytest.TempPathFactory
) -> list[Small]:
    """Frames of their own content: every fourth sample from another corner each."""
    path, found = tmp_path_factory.mktemp("png") / "a.png", []
    for number in range(12):
        frame, (y, x) = room_frames[number % 6], divmod(number, 4)
        k = frame.intrinsics
        write_depth_png(path, np.ascontiguousarray(frame.depth[y::4, x::4]), 1000.0)
        lens = CameraIntrinsics(width=160, height=120, fx=k.fx / 4, fy=k.fy / 4,
                                cx=(k.cx - x) / 4, cy=(k.cy - y) / 4)  # fmt: skip
        found.append(Small(path.read_bytes(), FrameMeta(intrinsics=lens)))
    return found


@pytest.fixture
def server_store(postgres_url: str, tmp_path: Path) -> Iterator[Store]:
    """A store on PostgreSQL."""
    opened = open_store(postgres_url, tmp_path / "blobs")
    yield opened
    opened.database.close()


@pytest.fixture
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Server, Server]]:
    """A primary, and an asynchronous standby: the primary goes on without it."""
    folder = tmp_path_factory.mktemp("pair")
    primary = Server(folder / "primary")
    primary.start()
    primary.create("fleet")
    standby = primary.standby(folder / "standby", synchronous=False)
    yield primary, standby
    primary.kill()
    standby.kill()
