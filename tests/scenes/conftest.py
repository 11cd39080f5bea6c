"""Fixtures of the viewer tests: a reader of scenes, a service with a map, and a command runner."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.formats.dataset import (
    Camera,
    FrameReference,
    find_sequences,
    write_depth_png,
    write_intrinsics,
    write_pose,
)
from sceneprint.types import DepthFrame
from sceneprint_client import Client, meta_of
from sceneprint_viewers.scene import Moment, SceneEntity

MAP, WALK = "rooms", 8
#: Rerun's names of lines and labels, which it does not draw.
UPDATE = "foxglove.SceneUpdate:message"


@dataclass
class Logged:
    """Content of a file at one path and time: components by name, one row each."""

    path: str
    time_ns: int | None
    values: dict[str, Any]


def _rows(path: Path) -> Iterator[Logged]:
    from rerun.chunk import McapReader  # takes half a second

    for chunk in McapReader(path).stream():
        batch = chunk.to_record_batch()
        for i in range(batch.num_rows):
            row = {name: batch.column(name)[i] for name in batch.schema.names}
            at = row.pop("message_log_time", None)
            values = {
                name: one.as_py() for name, one in row.items() if ":" in name and one.is_valid
            }
            time_ns = None if chunk.is_static or at is None else at.cast("int64").as_py()
            yield Logged(chunk.entity_path, time_ns, values)


def mcap_rows(path: Path) -> list[Logged]:
    """Return all messages of an MCAP file, read by Rerun instead of Foxglove's library."""
    return [one for one in _rows(path) if not one.path.startswith("/__")]


def moves_of(rows: list[Logged], child: str) -> list[Logged]:
    """Return the transforms of a coordinate frame in order of time."""
    key = "Transform3D:child_frame"
    return [one for one in rows if one.values.get(key) == [child]]


def drawn_at(rows: list[Logged], topic: str) -> dict[str, Any]:
    """Return the final lines and labels of a topic by path."""
    drawn: dict[str, Any] = {}
    for row in rows:
        if row.path == topic and UPDATE in row.values:
            [update] = row.values[UPDATE]
            for one in update["deletions"] or ():
                del drawn[one["id"]]
            drawn |= {one["id"]: one for one in update["entities"] or ()}
    return drawn


@dataclass
class ListWriter:
    """A writer that stores its input."""

    moments: list[Moment] = field(default_factory=list)
    gone: list[Collection[SceneEntity]] = field(default_factory=list)

    def write(self, moment: Moment, gone: Collection[SceneEntity]) -> None:
        self.moments.append(moment)
        self.gone.append(gone)

    def contents(self, moment: int = -1) -> dict[str, Any]:
        """Return the contents of a moment by path."""
        return {"/".join(one.path): one.content for one in self.moments[moment].entities}


@pytest.fixture(scope="session")
def walk(building: Path) -> tuple[FrameReference, ...]:
    """The first frames of a walk through a room, which are in the map."""
    return find_sequences(building / "room-0" / "seq-01")[0].frames[:WALK]


@pytest.fixture(scope="session")
def unseen(building: Path) -> tuple[FrameReference, ...]:
    """Frames of the same walk that are not in the map."""
    return find_sequences(building / "room-0" / "seq-02")[0].frames[:2]


@pytest.fixture(scope="session")
def client(
    service_url: str, walk: tuple[FrameReference, ...], room_frames: tuple[DepthFrame, ...],
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[Client]:  # fmt: skip
    """A read-only client of a service whose map MAP has a walk in `room` and a frame in `yard`."""
    folder, far = tmp_path_factory.mktemp("yard"), room_frames[3]
    assert far.pose is not None
    write_intrinsics(folder, Camera(far.intrinsics))
    write_depth_png(folder / "frame-000000.depth.png", far.depth, 1000.0)
    write_pose(folder / "frame-000000.pose.txt", far.pose)
    other = find_sequences(folder)[0].frames
    with Client(service_url) as client:
        client.create_map(MAP)
        for space, frames in (("room", walk), ("yard", other)):
            for one in frames:
                client.upload(MAP, one, meta_of(one, session=space, parent_frame=space))
        client.wait([one.job_id for one in client.frames(MAP)], timeout_s=PATIENCE_S)
        yield client


@pytest.fixture
def sceneprint(
    service_url: str, client: Client, run_command: Callable[..., Any],
    monkeypatch: pytest.MonkeyPatch,
) -> Callable[..., Any]:  # fmt: skip
    """A function that runs a command in this process with the service and checks its exit code."""
    monkeypatch.setenv("SCENEPRINT_URL", service_url)
    return run_command


def moved(T: Any, points: Any) -> Any:
    """Return points transformed by a (4, 4) matrix."""
    T = np.asarray(T, float)
    return np.asarray(points, float) @ T[:3, :3].T + T[:3, 3]
