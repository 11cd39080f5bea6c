"""Fixtures of the PostgreSQL tests: stores, and waits for conditions."""

from __future__ import annotations

from typing import NamedTuple

import pytest

from benchmarks.postgres import Server
from sceneprint.store import open_store
from sceneprint_client.api import FrameMeta


class Small(NamedTuple):
    """A small depth image."""

    png: bytes
    meta: FrameMeta


@pytest.fixture(scope="session")
def small(room_frames, small_image):
    """Frames with different content, from different offsets."""
    found = []
    for number in range(12):
        data, lens = small_image(room_frames[number % 6], *divmod(number, 4))
        found.append(Small(data, FrameMeta(intrinsics=lens)))
    return found


@pytest.fixture
def server_store(postgres_url, tmp_path):
    """A store on PostgreSQL."""
    opened = open_store(postgres_url, tmp_path / "blobs")
    yield opened
    opened.database.close()


@pytest.fixture
def pair(tmp_path_factory):
    """A primary and an asynchronous standby."""
    folder = tmp_path_factory.mktemp("pair")
    primary = Server(folder / "primary")
    primary.start()
    primary.create("fleet")
    standby = primary.standby(folder / "standby", synchronous=False)
    yield primary, standby
    primary.kill()
    standby.kill()
