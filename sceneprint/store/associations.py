"""Frames of sessions in the order in which they were taken, and jobs that associate them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Select, delete, null, select

from sceneprint.store.queue import remove_parts
from sceneprint.store.tables import JobRow, frames, jobs
from sceneprint_client.api import FrameState
from sceneprint_client.api.frames import Kind

#: Kind of the jobs.
ASSOCIATE = "associate"
#: Numbers that one statement asks for.
_BLOCK = 500


@dataclass(frozen=True)
class PathFrame:
    """A frame of a run, as far as associations need it.

    Parameters
    ----------
    number, id : of the frame
    robot, session, captured_at : as far as is known
    parent : that its pose leads to
    pose : T_parent_sensor, or None
    is_cloud : whether it is a point cloud
    """

    number: int
    id: str
    robot: str | None
    session: str | None
    captured_at: float | None
    parent: str | None
    pose: list[list[float]] | None
    is_cloud: bool

    @property
    def kind(self) -> Kind:
        """A depth image or a point cloud."""
        return "cloud" if self.is_cloud else "depth"


def numbers_of_session(
    connection: Connection, map_number: int, session: str, robot: str | None
) -> list[int]:
    """Numbers of the indexed frames of a session in the order of time, then as they came.

    Those without a time come last.
    """
    asked = select(frames.c.number).where(
        frames.c.map_number == map_number,
        frames.c.state == FrameState.INDEXED,
        frames.c.session == session,
    )
    if robot is not None:
        asked = asked.where(frames.c.robot == robot)
    time = frames.c.captured_at
    return list(connection.execute(asked.order_by(time.is_(None), time, frames.c.number)).scalars())


def stops_of(connection: Connection, numbers: Iterable[int]) -> dict[int, PathFrame]:
    """Frames by their numbers; those that are deleted, or not indexed any more, are left out."""
    wanted = list(numbers)
    found: dict[int, PathFrame] = {}
    for start in range(0, len(wanted), _BLOCK):
        rows = connection.execute(
            _select_path_frames().where(
                frames.c.number.in_(wanted[start : start + _BLOCK]),
                frames.c.state == FrameState.INDEXED,
            )
        )
        found |= {row["number"]: PathFrame(**row) for row in rows.mappings()}
    return found


def remove_job(connection: Connection, job: JobRow) -> list[str]:
    """Forget a job with all that it found; a worker that is at it finds its lease lost.

    Returns
    -------
    blobs : that it referred to: sweep them when this is committed
    """
    blobs = remove_parts(connection, job.number)
    connection.execute(delete(jobs).where(jobs.c.number == job.number))
    return blobs


def _select_path_frames() -> Select[Any]:
    return select(
        frames.c.number, frames.c.id, frames.c.robot, frames.c.session, frames.c.captured_at,
        frames.c.pose_parent.label("parent"), frames.c.pose,
        frames.c.cloud.is_not(null()).label("is_cloud"),
    )  # fmt: skip
