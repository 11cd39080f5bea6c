"""Fixtures of the viewer tests: a reader of scenes, a service with a map, and a command runner."""

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from benchmarks.waiting import PATIENCE_S
from sceneprint.formats.dataset import (
    Camera,
    find_sequences,
    write_depth_png,
    write_intrinsics,
    write_pose,
)
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


def _rows(path):
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


def mcap_rows(path):
    """Return all messages of an MCAP file, read by Rerun instead of Foxglove's library."""
    return [row for row in _rows(path) if not row.path.startswith("/__")]


def moves_of(rows, child):
    """Return the transforms of a coordinate frame in order of time."""
    key = "Transform3D:child_frame"
    return [row for row in rows if row.values.get(key) == [child]]


def drawn_at(rows, topic):
    """Return the final lines and labels of a topic by path."""
    drawn = {}
    for row in rows:
        if row.path == topic and UPDATE in row.values:
            [update] = row.values[UPDATE]
            for entity in update["deletions"] or ():
                del drawn[entity["id"]]
            drawn |= {entity["id"]: entity for entity in update["entities"] or ()}
    return drawn


@dataclass
class ListWriter:
    """A writer that stores its input."""

    moments: list[Moment] = field(default_factory=list)
    gone: list[Collection[SceneEntity]] = field(default_factory=list)

    def write(self, moment, gone):
        self.moments.append(moment)
        self.gone.append(gone)

    def contents(self, moment=-1):
        return {"/".join(entity.path): entity.content for entity in self.moments[moment].entities}


@pytest.fixture(scope="session")
def walk(building):
    """The first frames of a walk through a room, which are in the map."""
    return find_sequences(building / "room-0" / "seq-01")[0].frames[:WALK]


@pytest.fixture(scope="session")
def unseen(building):
    """Frames of the same walk that are not in the map."""
    return find_sequences(building / "room-0" / "seq-02")[0].frames[:2]


@pytest.fixture(scope="session")
def client(service_url, walk, room_frames, tmp_path_factory):
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
            for frame in frames:
                client.upload(MAP, frame, meta_of(frame, session=space, parent_frame=space))
        client.wait([frame.job_id for frame in client.frames(MAP)], timeout_s=PATIENCE_S)
        yield client


@pytest.fixture
def sceneprint(service_url, client, run_command, monkeypatch):
    """A function that runs a command in this process with the service and checks its exit code."""
    monkeypatch.setenv("SCENEPRINT_URL", service_url)
    return run_command


def moved(T, points):
    T = np.asarray(T, float)
    return np.asarray(points, float) @ T[:3, :3].T + T[:3, 3]
