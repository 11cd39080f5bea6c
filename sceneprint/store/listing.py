"""Jobs as a list, for people who look after the queue."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import Connection, select

from sceneprint.schemas import JobState
from sceneprint.store.records import JobRow
from sceneprint.store.tables import frames, jobs, maps


@dataclass(frozen=True)
class Listed:
    """A job with the names of what it is about."""

    job: JobRow
    frame_id: str
    map_name: str


def list_jobs(
    connection: Connection, before: int | None, limit: int, state: JobState | None
) -> list[Listed]:
    """Jobs, the newest first, from below number `before` on."""
    asked = (
        select(jobs, frames.c.id.label("frame_id"), maps.c.name.label("map_name"))
        .join(frames, frames.c.number == jobs.c.frame_number)
        .join(maps, maps.c.number == frames.c.map_number)
        .order_by(jobs.c.number.desc())
        .limit(limit)
    )
    if before is not None:
        asked = asked.where(jobs.c.number < before)
    if state is not None:
        asked = asked.where(jobs.c.state == state)
    found = []
    for row in connection.execute(asked).mappings():
        own = {column.name: row[column.name] for column in jobs.columns}
        found.append(Listed(JobRow(**{**own, "state": JobState(own["state"])}),
                            row["frame_id"], row["map_name"]))  # fmt: skip
    return found
