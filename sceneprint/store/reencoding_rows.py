"""Re-encoding of maps: frames without a signature of the next model, their jobs, and the switch.

Until the switch, searches use the signatures of the current model; those of the next model are
stored beside them. Signatures and jobs of models that a map does not use are removed in blocks.
"""

from __future__ import annotations

import uuid
from dataclasses import dataclass

from sqlalchemy import ColumnElement, Connection, and_, exists, func, insert, select, update

from sceneprint.store.events import record_event
from sceneprint.store.frames import set_state
from sceneprint.store.maps import next_revision
from sceneprint.store.queue import PENDING, UPKEEP, enqueue, read_clock
from sceneprint.store.tables import MapRow, frames, jobs, maps, signatures
from sceneprint_client.api import FrameState, JobState

#: Kind of the jobs that sign indexed frames with the next model.
REENCODE = "reencode"
PRIORITY = UPKEEP
#: Number of jobs to queue, and of rows to remove, in one transaction (less than a second).
QUEUED_AT_ONCE, REMOVED_AT_ONCE = 2000, 50


@dataclass(frozen=True)
class SwitchProgress:
    """Progress of the re-encoding of a map.

    Parameters
    ----------
    done : number of frames with a signature of the next model
    left : number of frames that wait for a signature
    failed : number of frames that the next model cannot sign; the switch rejects them
    dead : number of frames with a dead job; they block the switch
    """

    done: int
    left: int
    failed: int
    dead: int


def begin_reencoding(connection: Connection, row: MapRow, model_id: str) -> None:
    """Start to re-encode a map with a stored model."""
    connection.execute(
        update(maps).where(maps.c.number == row.number).values(next_model_id=model_id)
    )
    record_event(connection, "map.reencoding", row.name, model=model_id)


def cancel_reencoding(connection: Connection, row: MapRow) -> None:
    """Cancel the re-encoding of a map."""
    connection.execute(update(maps).where(maps.c.number == row.number).values(next_model_id=None))
    record_event(connection, "map.reencoding_cancelled", row.name, model=row.next_model_id)


def switch_progress(connection: Connection, row: MapRow) -> SwitchProgress:
    """Return the progress of the re-encoding of a map."""
    lacks = and_(_indexed(row), ~_signed(row.next_model_id))

    def count(*conditions: ColumnElement[bool]) -> int:
        counted = select(func.count()).select_from(frames).where(*conditions)
        return int(connection.execute(counted).scalar_one())

    def over(state: JobState, *conditions: ColumnElement[bool]) -> int:
        ended = select(frames.c.number).join(jobs, jobs.c.frame_number == frames.c.number)
        own = ended.where(jobs.c.state == state, _for_next(row), lacks, *conditions).distinct()
        return len(connection.execute(own).all())

    every, lacking = count(_indexed(row)), count(lacks)
    failed = over(JobState.FAILED)
    dead = over(JobState.DEAD, ~_has_job(row, (*PENDING, JobState.FAILED)))
    return SwitchProgress(every - lacking, lacking - failed - dead, failed, dead)


def is_pending(connection: Connection, row: MapRow) -> bool:
    """Return whether a job for the next model of a map is queued or running."""
    statement = (
        select(jobs.c.number)
        .join(frames, frames.c.number == jobs.c.frame_number)
        .where(_for_next(row), jobs.c.state.in_(PENDING), frames.c.map_number == row.number)
        .limit(1)
    )
    return connection.execute(statement).first() is not None


def unqueued_frames(
    connection: Connection, row: MapRow, after: int, *, again: bool = False
) -> list[int]:
    """Return the numbers of frames without a signature of the next model or a job for it.

    Parameters
    ----------
    after : number of the last frame of the previous block
    again : whether to include frames with a dead job
    """
    states = (*PENDING, JobState.FAILED, *(() if again else (JobState.DEAD,)))
    lacks = ~_signed(row.next_model_id), ~_has_job(row, states)
    statement = select(frames.c.number).where(_indexed(row), frames.c.number > after, *lacks)
    return list(
        connection.execute(statement.order_by(frames.c.number).limit(QUEUED_AT_ONCE)).scalars()
    )


def enqueue_all(connection: Connection, row: MapRow, numbers: list[int]) -> None:
    """Queue jobs that sign frames with the next model of their map."""
    now = read_clock(connection)
    values = [
        {
            "id": uuid.uuid4().hex, "kind": REENCODE, "frame_number": number,
            "map_number": row.number,
            "model_id": row.next_model_id, "state": JobState.QUEUED, "priority": PRIORITY,
            "attempts": 0, "failures": 0, "token": 0, "run_after": now, "created_at": now,
        }
        for number in numbers
    ]  # fmt: skip
    if values:
        connection.execute(insert(jobs), values)


def is_complete(connection: Connection, row: MapRow) -> bool:
    """Return whether all indexed frames have a signature of the next model, or a failed job."""
    lacking = exists().where(
        _indexed(row), ~_signed(row.next_model_id), ~_has_job(row, (JobState.FAILED,))
    )
    return not connection.execute(select(lacking)).scalar_one()


def frames_signed_by(connection: Connection, row: MapRow, revision: int) -> list[int]:
    """Return the numbers of frames indexed up to a revision that the next model has signed."""
    statement = select(frames.c.number).where(
        _indexed(row), frames.c.revision <= revision, _signed(row.next_model_id)
    )
    return list(connection.execute(statement).scalars())


def raise_revisions(connection: Connection, row: MapRow, numbers: list[int]) -> None:
    """Assign new revisions to indexed frames, so that indexes read them again."""
    for number in numbers:
        revision = next_revision(connection, row.number)
        connection.execute(
            update(frames).where(frames.c.number == number).values(revision=revision)
        )


def switch_model(connection: Connection, row: MapRow) -> list[str]:
    """Replace the model of a map by the next model, once all frames are signed.

    Frames with a failed job are rejected. Frames that the former model rejected are signed again.

    Returns
    -------
    rejected : ids of the rejected frames
    """
    former = connection.execute(
        select(frames.c.number, frames.c.id).where(
            frames.c.map_number == row.number, frames.c.state == FrameState.REJECTED
        )
    ).all()
    failed = connection.execute(
        select(frames.c.number, frames.c.id, jobs.c.id.label("job_id"), jobs.c.error)
        .join(jobs, jobs.c.frame_number == frames.c.number)
        .where(_indexed(row), ~_signed(row.next_model_id), _for_next(row),
               jobs.c.state == JobState.FAILED)
        .order_by(jobs.c.number)
    )  # fmt: skip
    rejected = {frame.number: frame for frame in failed}
    for number, frame in rejected.items():
        set_state(connection, number, FrameState.REJECTED, frame.error)
        # new revisions, since readers and indexes may still have the frame from an earlier switch
        raise_revisions(connection, row, [number])
        record_event(connection, "frame.rejected", row.name, frame.id, frame.job_id)
    for number, frame_id in former:
        set_state(connection, number, FrameState.RECEIVED)
        job = enqueue(connection, "sign", number, PRIORITY)
        record_event(connection, "frame.received", row.name, frame_id, job.id)
    connection.execute(
        update(maps)
        .where(maps.c.number == row.number)
        .values(model_id=row.next_model_id, next_model_id=None)
    )
    record_event(
        connection, "map.reencoded", row.name, model=row.next_model_id, before=row.model_id
    )
    return [frame.id for frame in rejected.values()]


def models_of(row: MapRow) -> tuple[str, ...]:
    """Return the models whose signatures a map stores."""
    return (row.model_id,) if row.next_model_id is None else (row.model_id, row.next_model_id)


def _indexed(row: MapRow) -> ColumnElement[bool]:
    return and_(frames.c.map_number == row.number, frames.c.state == FrameState.INDEXED)


def _signed(model_id: str | None) -> ColumnElement[bool]:
    return exists().where(
        signatures.c.frame_number == frames.c.number, signatures.c.model_id == model_id
    )


def _for_next(row: MapRow) -> ColumnElement[bool]:
    return and_(jobs.c.kind == REENCODE, jobs.c.model_id == row.next_model_id)


def _has_job(row: MapRow, states: tuple[JobState, ...]) -> ColumnElement[bool]:
    own = jobs.alias("own")  # an alias, since the outer query may use `jobs`
    return exists().where(
        own.c.frame_number == frames.c.number, own.c.kind == REENCODE,
        own.c.model_id == row.next_model_id, own.c.state.in_(states),
    )  # fmt: skip
