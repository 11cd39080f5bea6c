"""Rows of the store as JSON tells them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any

import numpy as np
from sqlalchemy import Connection

from sceneprint.engine.tags import frame_tag, map_tag
from sceneprint.engine.transforms import transform
from sceneprint.schemas import (
    CameraIntrinsics,
    Frame,
    FrameName,
    Job,
    Map,
    Progress,
    Reencoding,
    Vector,
)
from sceneprint.schemas.frames import Kind
from sceneprint.store.aging import DAY_S, count_old
from sceneprint.store.listing import jobs_of
from sceneprint.store.maps import count_frames, model_names
from sceneprint.store.records import FrameRow, JobRow, MapRow
from sceneprint.store.reencoding import standing


def when(seconds: float | None) -> Any:
    """Seconds since 1970 as a time in UTC."""
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC)


def model_label(name: str, model_id: str) -> str:
    """As `Model.label`."""
    return f"{name}-{model_id[:12]}"


def sensor_frame(frame_id: str, kind: Kind) -> str:
    """What the coordinates of a frame's sensor are called in transforms.

    The optical ones of a camera; a cloud keeps the axes that its sensor has.
    """
    return f"{frame_id}.optical" if kind == "depth" else f"{frame_id}.sensor"


def sensor_of(frame: FrameRow) -> str:
    """What the coordinates of a stored frame's sensor are called in transforms."""
    return sensor_frame(frame.id, frame.kind)


def query_sensor(frame: FrameName | None, kind: Kind, maps: Sequence[str]) -> str:
    """What the coordinates of a query's sensor are called.

    By its id where it is a stored frame, asked of its own map alone: another map may have a frame
    of the same id, and a transform leads from one frame to another.

    Parameters
    ----------
    frame : that was asked for; None for an upload
    kind : of it
    maps : that were asked
    """
    alone = frame is not None and list(maps) == [frame.map]
    return sensor_frame(frame.frame_id if frame is not None and alone else "query", kind)


def tell_map(connection: Connection, row: MapRow) -> Map:
    """A map."""
    names, coming = model_names(connection), None
    if row.next_model_id is not None:
        label = model_label(names[row.next_model_id], row.next_model_id)
        now = standing(connection, row)
        coming = Reencoding(model=label, model_id=row.next_model_id, **asdict(now))
    return Map(
        name=row.name,
        title=row.title,
        model=model_label(names[row.model_id], row.model_id),
        model_id=row.model_id,
        reencoding=coming,
        created_at=when(row.created_at),
        revision=row.revision,
        frames=count_frames(connection, row.number),
        used_frames=row.used_frames,
        used_bytes=row.used_bytes,
        quota_frames=row.quota_frames,
        quota_bytes=row.quota_bytes,
        retention_days=row.retention_days,
        overdue=None if row.retention_days is None else _overdue(connection, row),
        etag=map_tag(row),
    )


def _overdue(connection: Connection, row: MapRow) -> int:
    """Frames that a map has kept for longer than it should."""
    before = time.time() - DAY_S * (row.retention_days or 0.0)
    return count_old(connection, row.number, before)


def tell_frames(connection: Connection, row: MapRow, found: list[FrameRow]) -> list[Frame]:
    """Frames of one map."""
    jobs = jobs_of(connection, [frame.number for frame in found])
    return [_frame(row, frame, jobs[frame.number]) for frame in found]


def tell_job(
    job: JobRow, frame_id: str | None, map_name: str | None, followed_by: str | None = None
) -> Job:
    """A job, and the names of what it is about."""
    progress = None
    if job.progress is not None:
        progress = Progress(done=job.progress.get("done", 0), total=job.progress.get("total"))
    return Job(
        job_id=job.id,
        kind=job.kind,
        state=job.state,
        map=map_name,
        frame_id=frame_id,
        priority=job.priority,
        attempts=job.attempts,
        created_at=when(job.created_at),
        started_at=when(job.started_at),
        finished_at=when(job.finished_at),
        error=job.error,
        traceback=job.traceback,
        progress=progress,
        result=job.result,
        followed_by=followed_by,
    )


def _frame(row: MapRow, frame: FrameRow, job: JobRow) -> Frame:
    pose = None
    if frame.pose is not None and frame.pose_parent is not None:
        pose = transform(np.array(frame.pose), frame.pose_parent, sensor_of(frame))
    base = None
    if frame.base is not None and frame.base_frame is not None:
        base = transform(np.array(frame.base), frame.base_frame, sensor_of(frame))
    return Frame(
        frame_id=frame.id,
        map=row.name,
        state=frame.state,
        reason=frame.reason,
        job_id=job.id,
        content_id=frame.content_id,
        bytes=frame.bytes,
        **_seen(frame),
        robot=frame.robot,
        session=frame.session,
        captured_at=when(frame.captured_at),
        received_at=when(frame.received_at),
        indexed_at=when(frame.indexed_at),
        pose=pose,
        base_frame=frame.base_frame,
        T_base_sensor=base,
        tags=frame.tags,
        etag=frame_tag(frame),
    )


def _seen(frame: FrameRow) -> dict[str, Any]:
    """How the samples or the points of a frame are read."""
    if frame.cloud is None:
        return {
            "kind": "depth",
            "intrinsics": CameraIntrinsics.model_validate(frame.intrinsics),
            "depth_scale": frame.depth_scale,
            "depth_along_ray": frame.depth_along_ray,
        }
    at = frame.cloud["viewpoint"]
    return {
        "kind": "cloud",
        "intrinsics": None,
        "depth_scale": None,
        "depth_along_ray": None,
        "points": frame.cloud["points"],
        "viewpoint": None if at is None else Vector(**dict(zip("xyz", at, strict=True))),
        "units_per_metre": frame.cloud["units_per_metre"],
        "note": frame.cloud["note"],
    }
