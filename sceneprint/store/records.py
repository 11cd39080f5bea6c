"""Rows as the rest of the package sees them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sqlalchemy import RowMapping

from sceneprint.schemas import FrameState, JobState
from sceneprint.schemas.frames import Kind


@dataclass(frozen=True)
class MapRow:
    """A map; fields as in the table."""

    number: int
    name: str
    title: str | None
    model_id: str
    next_model_id: str | None
    revision: int
    created_at: float
    quota_frames: int | None = None
    quota_bytes: int | None = None
    retention_days: float | None = None
    used_frames: int = 0
    used_bytes: int = 0


@dataclass(frozen=True)
class FrameRow:
    """A frame; fields as in the table."""

    number: int
    id: str
    map_number: int
    state: FrameState
    reason: str | None
    content_id: str | None
    blob: str
    bytes: int
    intrinsics: dict[str, Any] | None
    depth_scale: float
    depth_along_ray: bool
    robot: str | None
    session: str | None
    captured_at: float | None
    tags: list[str]
    pose_parent: str | None
    pose: list[list[float]] | None
    pose_x: float | None
    pose_y: float | None
    pose_z: float | None
    base_frame: str | None
    base: list[list[float]] | None
    novelty: float | None
    received_at: float
    indexed_at: float | None
    revision: int | None
    cloud: dict[str, Any] | None

    @property
    def kind(self) -> Kind:
        """A depth image or a point cloud."""
        return "depth" if self.cloud is None else "cloud"


@dataclass(frozen=True)
class JobRow:
    """A job; fields as in the table."""

    number: int
    id: str
    kind: str
    frame_number: int | None
    map_number: int | None
    model_id: str | None
    data: dict[str, Any] | None
    progress: dict[str, Any] | None
    result: dict[str, Any] | None
    state: JobState
    priority: int
    attempts: int
    failures: int
    token: int
    run_after: float
    leased_until: float | None
    worker: str | None
    error: str | None
    traceback: str | None
    created_at: float
    started_at: float | None
    finished_at: float | None

    @property
    def frame(self) -> int:
        """Number of the frame that a job of a single frame is about."""
        if self.frame_number is None:
            raise ValueError(f"job {self.id} of kind {self.kind} is of no single frame")
        return self.frame_number


def map_row(row: RowMapping) -> MapRow:
    """A row of the table `maps`."""
    return MapRow(**row)


def frame_row(row: RowMapping) -> FrameRow:
    """A row of the table `frames`."""
    return FrameRow(**{**row, "state": FrameState(row["state"])})


def job_row(row: RowMapping) -> JobRow:
    """A row of the table `jobs`."""
    return JobRow(**{**row, "state": JobState(row["state"])})
