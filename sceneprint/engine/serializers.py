"""Conversion of store rows to API records and entity tags."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from typing import Any, TypeVar

import numpy as np
from pydantic import BaseModel
from sqlalchemy import Connection

from sceneprint.store.deletion import DAY_S, count_old_frames, without_content
from sceneprint.store.frames import count_states, count_states_by_map
from sceneprint.store.maps import model_names
from sceneprint.store.parent_joins import count_poses
from sceneprint.store.query_rows import count_statuses
from sceneprint.store.queue import signing_jobs
from sceneprint.store.reencoding_rows import switch_progress
from sceneprint.store.tables import FrameRow, JobRow, MapRow
from sceneprint.types import Floats
from sceneprint_client.api import (
    Frame,
    FrameName,
    Job,
    Map,
    Progress,
    Quaternion,
    Reencoding,
    Transform,
    Vector,
)
from sceneprint_client.api.base import Direction
from sceneprint_client.api.frames import Kind, SampleRange
from sceneprint_client.poses import quaternion_of

Record = TypeVar("Record", bound=BaseModel)

#: Editable columns of a frame.
EDITABLE = (
    "robot", "session", "captured_at", "tags", "pose_parent", "pose", "base_frame", "base", "up",
    "name", "sequence",
)  # fmt: skip


#: Equivalent to `json.dumps(parts, sort_keys=True)`, without creating an encoder in each call.
_encode = json.JSONEncoder(sort_keys=True).encode


def tag_of(*parts: object) -> str:
    """Return an entity tag: 32 hexadecimal digits of a hash of the parts as JSON."""
    encoded = _encode(parts)
    return hashlib.sha256(encoded.encode()).hexdigest()[:32]


def frame_tag(frame: FrameRow) -> str:
    """Return the entity tag of a frame: a hash of its editable columns."""
    return tag_of("frame", [getattr(frame, name) for name in EDITABLE])


def map_tag(row: MapRow) -> str:
    """Return the entity tag of a map: a hash of its editable columns."""
    limits = row.quota_frames, row.quota_bytes, row.retention_days
    return tag_of("map", row.name, row.title, *limits, row.up)


def transform(T: Floats, parent_frame: str, child_frame: str) -> Transform:
    """Return the API record of T_parent_child (4, 4)."""
    x, y, z, w = quaternion_of(T[:3, :3]).tolist()
    return Transform(
        parent_frame=parent_frame,
        child_frame=child_frame,
        translation=Vector(x=T[0, 3], y=T[1, 3], z=T[2, 3]),
        rotation=Quaternion(x=x, y=y, z=z, w=w),
        matrix=T.tolist(),
    )


def when(seconds: float | None) -> Any:
    """Convert seconds since 1970 to a time in UTC; None remains None."""
    return None if seconds is None else datetime.fromtimestamp(seconds, UTC)


def vector(at: Iterable[float]) -> Vector:
    """Return the API record of three coordinates."""
    return Vector(**dict(zip("xyz", at, strict=True)))


def copy_fields(record: type[Record], source: object, /, **own: Any) -> Record:
    """Return a record with the values `own`; `source` supplies the other fields by name."""
    names = record.model_fields
    return record(**{k: x for k, x in vars(source).items() if k in names} | own)


def model_label(name: str, model_id: str) -> str:
    """Return the label of a model; see `Model.label`."""
    return f"{name}-{model_id[:12]}"


def sensor_frame(frame_id: str, kind: Kind) -> str:
    """Return the name of a sensor frame: ID.optical for a camera, else ID.sensor."""
    return f"{frame_id}.optical" if kind == "depth" else f"{frame_id}.sensor"


def sensor_of(frame: FrameRow) -> str:
    """Return the name of the sensor frame of a stored frame."""
    return sensor_frame(frame.id, frame.kind)


def query_sensor(frame: FrameName | None, kind: Kind, maps: Sequence[str]) -> str:
    """Return the name of the coordinate frame of the sensor of a query.

    The name contains the id of a stored frame only if no other map is searched, since another map
    may have a frame with the same id.

    Parameters
    ----------
    frame : stored frame that is queried; None for an upload
    maps : names of the searched maps
    """
    alone = frame is not None and list(maps) == [frame.map]
    return sensor_frame(frame.frame_id if frame is not None and alone else "query", kind)


#: Length of the period of `recent_queries`, seconds.
RECENT_S = 3600.0


def map_records(connection: Connection, rows: Sequence[MapRow]) -> list[Map]:
    """Return the API records of all maps, with few statements even for many maps."""
    recent = count_statuses(connection, time.time() - RECENT_S)
    names, states = model_names(connection), count_states_by_map(connection)
    poses = count_poses(connection)
    return [_map(connection, row, names, states.get(row.number, {}), poses, recent) for row in rows]


def map_record(connection: Connection, row: MapRow) -> Map:
    """Return the API record of a map."""
    recent = count_statuses(connection, time.time() - RECENT_S, row.number)
    states, poses = count_states(connection, row.number), count_poses(connection, row.number)
    return _map(connection, row, model_names(connection), states, poses, recent)


def _map(
    connection: Connection, row: MapRow, names: Mapping[str, str], states: dict[str, int],
    poses: Mapping[int, tuple[int, int]], recent: Mapping[int, dict[str, int]],
) -> Map:  # fmt: skip
    reencoding, overdue = None, None
    if row.retention_days is not None:
        overdue = count_old_frames(connection, row.number, time.time() - DAY_S * row.retention_days)
    if row.next_model_id is not None:
        label = model_label(names[row.next_model_id], row.next_model_id)
        now = switch_progress(connection, row)
        reencoding = Reencoding(model=label, model_id=row.next_model_id, **asdict(now))
    posed, parents = poses.get(row.number, (0, 0))
    return copy_fields(
        Map,
        row,
        model=model_label(names[row.model_id], row.model_id),
        reencoding=reencoding,
        created_at=when(row.created_at),
        frames=states,
        posed_frames=posed,
        parent_frames=parents,
        recent_queries=recent.get(row.number, {}),
        up=row.up and direction(row.up),
        overdue=overdue,
        etag=map_tag(row),
    )


def frame_records(connection: Connection, row: MapRow, rows: list[FrameRow]) -> list[Frame]:
    """Return the API records of frames of a map; fields that a purge has removed are null."""
    jobs = signing_jobs(connection, [frame.number for frame in rows])
    return [_frame(row, without_content(frame), jobs[frame.number]) for frame in rows]


def job_progress(job: JobRow) -> Progress | None:
    """Return the progress of a long job; None before the end of the first slice."""
    if job.progress is None:
        return None
    fields = {name: job.progress[name] for name in Progress.model_fields if name in job.progress}
    return Progress(**{"done": 0} | fields)


def job_record(
    job: JobRow, frame_id: str | None, map_name: str | None, followed_by: str | None = None
) -> Job:
    """Return the API record of a job."""
    return copy_fields(
        Job, job, job_id=job.id, map=map_name, frame_id=frame_id, created_at=when(job.created_at),
        started_at=when(job.started_at), finished_at=when(job.finished_at),
        progress=job_progress(job), followed_by=followed_by,
    )  # fmt: skip


def _frame(row: MapRow, frame: FrameRow, job_id: str) -> Frame:
    pose = None
    if frame.pose is not None and frame.pose_parent is not None:
        pose = transform(np.array(frame.pose), frame.pose_parent, sensor_of(frame))
    sent = None
    if frame.sent_pose is not None and frame.sent_parent is not None:
        sent = transform(np.array(frame.sent_pose), frame.sent_parent, sensor_of(frame))
    base = None
    if frame.base is not None and frame.base_frame is not None:
        base = transform(np.array(frame.base), frame.base_frame, sensor_of(frame))
    return copy_fields(
        Frame,
        frame,
        frame_id=frame.id,
        map=row.name,
        job_id=job_id,
        **_sensor_record(frame),
        captured_at=when(frame.captured_at),
        received_at=when(frame.received_at),
        indexed_at=when(frame.indexed_at),
        pose=pose,
        sent_pose=sent,
        T_base_sensor=base,
        up=frame.up and direction(frame.up),
        etag=frame_tag(frame),
    )


def direction(up: Iterable[float]) -> Direction:
    """Return the API record of a unit vector."""
    return Direction(**dict(zip("xyz", up, strict=True)))


def sample_range_of(frame: FrameRow) -> SampleRange | None:
    """Return the sample range of a frame; None after a purge."""
    return None if frame.samples is None else SampleRange.model_validate(frame.samples)


def _sensor_record(frame: FrameRow) -> dict[str, Any]:
    """Return the fields of a frame record that depend on the kind of the frame."""
    if frame.cloud is None:
        trusted = None if frame.samples is None else frame.samples["trusted"]
        return {"kind": "depth", "trust_depth": trusted}
    eye = frame.cloud["viewpoint"]
    return {
        "kind": "cloud", "depth_scale": None, "depth_along_ray": None,
        "viewpoint": None if eye is None else vector(eye),
        **{name: frame.cloud[name] for name in ("points", "units_per_metre", "note")},
    }  # fmt: skip
