"""Rows of the store as JSON tells them."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import numpy as np
from sqlalchemy import Connection

from sceneprint.engine.transforms import transform
from sceneprint.schemas import CameraIntrinsics, Frame, Job, Map
from sceneprint.store.frames import frame_of
from sceneprint.store.maps import count_frames, model_names
from sceneprint.store.queue import jobs_of
from sceneprint.store.records import FrameRow, JobRow, MapRow


def when(seconds: float | None) -> Any:
    """Seconds since 1970 as a time in UTC."""
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC)


def model_label(name: str, model_id: str) -> str:
    """As `Model.label`."""
    return f"{name}-{model_id[:12]}"


def camera_frame(frame_id: str) -> str:
    """What the optical frame of a frame's camera is called in transforms."""
    return f"{frame_id}.optical"


def tell_map(connection: Connection, row: MapRow) -> Map:
    """A map."""
    name = model_names(connection)[row.model_id]
    return Map(
        name=row.name,
        title=row.title,
        model=model_label(name, row.model_id),
        model_id=row.model_id,
        created_at=when(row.created_at),
        revision=row.revision,
        frames=count_frames(connection, row.number),
    )


def tell_frames(connection: Connection, row: MapRow, found: list[FrameRow]) -> list[Frame]:
    """Frames of one map."""
    jobs = jobs_of(connection, [frame.number for frame in found])
    return [_frame(row, frame, jobs[frame.number]) for frame in found]


def tell_job(connection: Connection, job: JobRow, map_name: str) -> Job:
    """A job."""
    return Job(
        job_id=job.id,
        kind="sign",
        state=job.state,
        map=map_name,
        frame_id=frame_of(connection, job.frame_number).id,
        attempts=job.attempts,
        created_at=when(job.created_at),
        started_at=when(job.started_at),
        finished_at=when(job.finished_at),
        error=job.error,
        traceback=job.traceback,
    )


def _frame(row: MapRow, frame: FrameRow, job: JobRow) -> Frame:
    pose = None
    if frame.pose is not None and frame.pose_parent is not None:
        pose = transform(np.array(frame.pose), frame.pose_parent, camera_frame(frame.id))
    return Frame(
        frame_id=frame.id,
        map=row.name,
        state=frame.state,
        reason=frame.reason,
        job_id=job.id,
        content_id=frame.content_id,
        bytes=frame.bytes,
        intrinsics=CameraIntrinsics(**frame.intrinsics),
        depth_scale=frame.depth_scale,
        depth_along_ray=frame.depth_along_ray,
        robot=frame.robot,
        session=frame.session,
        captured_at=when(frame.captured_at),
        received_at=when(frame.received_at),
        indexed_at=when(frame.indexed_at),
        pose=pose,
        tags=frame.tags,
    )
