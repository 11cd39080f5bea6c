"""Jobs, one by one and as a list."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from sqlalchemy import Connection, func, select

from sceneprint.errors import UnknownJob
from sceneprint.schemas import JobState
from sceneprint.store.blocks import among, blocks
from sceneprint.store.records import JobRow, job_row
from sceneprint.store.tables import frames, jobs, maps


@dataclass(frozen=True)
class Listed:
    """A job with the names of what it is about."""

    job: JobRow
    frame_id: str | None
    map_name: str | None
    followed_by: str | None  # id of the latest job of the same frame and kind, if it is another


def list_jobs(
    connection: Connection, before: int | None, limit: int, state: JobState | None,
    kind: str | None = None, map_names: Collection[str] | None = None,
) -> list[Listed]:  # fmt: skip
    """Jobs, the newest first, from below number `before` on.

    Parameters
    ----------
    connection : of the database
    before, limit : see above
    state, kind : of those that are wanted
    map_names : of those that are wanted; jobs of no map are not among them
    """
    later = jobs.alias()
    last = (
        select(later.c.id)
        .where(
            later.c.frame_number == jobs.c.frame_number, later.c.kind == jobs.c.kind,
            later.c.model_id.is_not_distinct_from(jobs.c.model_id), later.c.number > jobs.c.number,
        )
        .order_by(later.c.number.desc())
        .limit(1)
        .correlate(jobs)
        .scalar_subquery()
    )  # fmt: skip
    asked = (
        select(
            jobs, frames.c.id.label("frame_id"), maps.c.name.label("map_name"),
            last.label("followed_by"),
        )
        .join(frames, frames.c.number == jobs.c.frame_number, isouter=True)
        .join(maps, maps.c.number == jobs.c.map_number, isouter=True)
        .order_by(jobs.c.number.desc())
        .limit(limit)
    )  # fmt: skip
    if kind is not None:
        asked = asked.where(jobs.c.kind == kind)
    if map_names is not None:
        asked = asked.where(maps.c.name.in_(list(map_names)))
    if before is not None:
        asked = asked.where(jobs.c.number < before)
    if state is not None:
        asked = asked.where(jobs.c.state == state)
    found = []
    for row in connection.execute(asked).mappings():
        own = {column.name: row[column.name] for column in jobs.columns}
        found.append(Listed(JobRow(**{**own, "state": JobState(own["state"])}),
                            row["frame_id"], row["map_name"], row["followed_by"]))  # fmt: skip
    return found


def find_job(connection: Connection, job_id: str) -> JobRow:
    """The job of an id.

    Raises
    ------
    UnknownJob : there is none.
    """
    row = connection.execute(select(jobs).where(jobs.c.id == job_id)).mappings().first()
    if row is None:
        raise unknown_job(job_id)
    return job_row(row)


def unknown_job(job_id: str) -> UnknownJob:
    """What is said of a job that is not there, or not for whoever asks: the same words."""
    return UnknownJob(
        f"There is no job {job_id!r:.80}. An upload answers with the id of its job, and "
        "deleting a map deletes its jobs."
    )


def last_of(
    connection: Connection, kind: str, frame_number: int, model_id: str | None = None
) -> JobRow | None:
    """The latest job of a kind, and for a model, of a frame."""
    row = connection.execute(
        select(jobs)
        .where(
            jobs.c.frame_number == frame_number, jobs.c.kind == kind,
            jobs.c.model_id.is_(None) if model_id is None else jobs.c.model_id == model_id,
        )
        .order_by(jobs.c.number.desc())
        .limit(1)
    ).mappings().first()  # fmt: skip
    return None if row is None else job_row(row)


def jobs_of(connection: Connection, frame_numbers: list[int]) -> dict[int, JobRow]:
    """The latest job of each frame that is to have it indexed, not those that sign it again."""
    found: dict[int, JobRow] = {}
    for some in blocks(frame_numbers):
        rows = connection.execute(
            select(jobs)
            .where(among(connection, jobs.c.frame_number, some), jobs.c.kind == "sign")
            .order_by(jobs.c.number)
        ).mappings()
        found |= {row["frame_number"]: job_row(row) for row in rows}
    return found


def count_jobs(connection: Connection) -> dict[str, int]:
    """How many jobs are in each state that has any."""
    rows = connection.execute(select(jobs.c.state, func.count()).group_by(jobs.c.state))
    return {row[0]: row[1] for row in rows}
