"""What is left of the models that a map no longer has, nor is to have."""

from __future__ import annotations

from sqlalchemy import Connection, delete, select, update

from sceneprint.schemas import JobState
from sceneprint.store.clock import now
from sceneprint.store.records import MapRow
from sceneprint.store.reencoding import (
    PENDING,
    QUEUED_AT_ONCE,
    REENCODE,
    REMOVED_AT_ONCE,
    models_of,
)
from sceneprint.store.tables import frames, jobs, signatures


def stale_signatures(connection: Connection, row: MapRow, after: int) -> list[tuple[int, str]]:
    """The next signatures of a map that are of neither of its models: frame, model.

    Parameters
    ----------
    connection : of a transaction
    row : of the map
    after : number of a frame
    """
    found = connection.execute(
        select(signatures.c.frame_number, signatures.c.model_id)
        .join(frames, frames.c.number == signatures.c.frame_number)
        .where(
            frames.c.map_number == row.number, frames.c.number > after,
            signatures.c.model_id.not_in(models_of(row)),
        )
        .order_by(frames.c.number)
        .limit(REMOVED_AT_ONCE)
    )  # fmt: skip
    return [(number, model_id) for number, model_id in found]


def remove_signature(connection: Connection, number: int, model_id: str) -> list[str]:
    """Forget what a model made of a frame; returns the blobs that it referred to."""
    own = (signatures.c.frame_number == number) & (signatures.c.model_id == model_id)
    blobs = list(connection.execute(select(signatures.c.geometry).where(own)).scalars())
    connection.execute(delete(signatures).where(own))
    return blobs


def stale_jobs(connection: Connection, row: MapRow) -> list[int]:
    """Some jobs that wait or run for a model that is neither of a map's."""
    found = connection.execute(
        select(jobs.c.number)
        .join(frames, frames.c.number == jobs.c.frame_number)
        .where(
            jobs.c.state.in_(PENDING), jobs.c.kind == REENCODE,
            jobs.c.model_id.not_in(models_of(row)), frames.c.map_number == row.number,
        )
        .limit(QUEUED_AT_ONCE)
    )  # fmt: skip
    return list(found.scalars())


def cancel_jobs(connection: Connection, numbers: list[int]) -> None:
    """Cancel jobs that wait or run."""
    connection.execute(
        update(jobs)
        .where(jobs.c.number.in_(numbers), jobs.c.state.in_(PENDING))
        .values(state=JobState.CANCELLED, finished_at=now(connection), leased_until=None)
    )
