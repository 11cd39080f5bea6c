"""What long jobs find and make: items, appended slice by slice, and files."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, delete, func, insert, select

from sceneprint.schemas import JobState
from sceneprint.store.records import JobRow, job_row
from sceneprint.store.tables import job_files, job_items, jobs

#: Rows that are inserted at once.
_BLOCK = 500


@dataclass(frozen=True)
class JobFile:
    """A file of a job.

    Parameters
    ----------
    name : such as mesh.ply, once a job
    blob : that holds its bytes, and is there
    bytes : size
    media_type : of its content
    """

    name: str
    blob: str
    bytes: int
    media_type: str


def append_items(connection: Connection, job_number: int, items: list[dict[str, Any]]) -> None:
    """Add to what a job has found."""
    first = count_items(connection, job_number)
    for start in range(0, len(items), _BLOCK):
        rows = [
            {"job_number": job_number, "number": first + start + i, "data": item}
            for i, item in enumerate(items[start : start + _BLOCK])
        ]
        connection.execute(insert(job_items), rows)


def count_items(connection: Connection, job_number: int) -> int:
    """How many items a job has found: they are numbered from 0."""
    asked = select(func.count()).where(job_items.c.job_number == job_number)
    return int(connection.execute(asked).scalar_one())


def items_of(
    connection: Connection, job_number: int, first: int = 0, limit: int | None = None
) -> list[dict[str, Any]]:
    """Items of a job in the order in which they were found, from number `first` on."""
    asked = (
        select(job_items.c.data)
        .where(job_items.c.job_number == job_number, job_items.c.number >= first)
        .order_by(job_items.c.number)
    )
    return list(connection.execute(asked if limit is None else asked.limit(limit)).scalars())


def add_files(connection: Connection, job_number: int, files: Iterable[JobFile]) -> None:
    """Let a job have files; one of the same name gives way."""
    for one in files:
        own = (job_files.c.job_number == job_number) & (job_files.c.name == one.name)
        connection.execute(delete(job_files).where(own))
        connection.execute(
            insert(job_files).values(
                job_number=job_number, name=one.name, blob=one.blob, bytes=one.bytes,
                media_type=one.media_type,
            )
        )  # fmt: skip


def files_of(connection: Connection, job_number: int) -> dict[str, JobFile]:
    """Files of a job by their names."""
    asked = select(job_files).where(job_files.c.job_number == job_number).order_by(job_files.c.name)
    return {
        row["name"]: JobFile(row["name"], row["blob"], row["bytes"], row["media_type"])
        for row in connection.execute(asked).mappings()
    }


def jobs_with_files(connection: Connection, kind: str) -> list[JobRow]:
    """Jobs of a kind that have any file, the oldest first."""
    having = select(job_files.c.job_number)
    asked = select(jobs).where(jobs.c.number.in_(having), jobs.c.kind == kind)
    return [job_row(row) for row in connection.execute(asked.order_by(jobs.c.number)).mappings()]


def given_up(connection: Connection, kind: str, name: str, before: float) -> list[int]:
    """Numbers of the jobs of a kind that were over by a time, and still have a file of a name."""
    asked = (
        select(jobs.c.number)
        .join(job_files, job_files.c.job_number == jobs.c.number)
        .where(
            job_files.c.name == name,
            jobs.c.kind == kind,
            jobs.c.state.in_([state for state in JobState if state.over]),
            jobs.c.finished_at < before,
        )
    )
    return list(connection.execute(asked).scalars())


def remove_parts(
    connection: Connection, job_number: int, *, items: bool = True,
    files: Iterable[str] | None = None,
) -> list[str]:  # fmt: skip
    """Forget what a job found and made.

    Parameters
    ----------
    connection : of a writing transaction
    job_number : of the job
    items : whether its items go
    files : names of the files that go; default: all

    Returns
    -------
    blobs : that it referred to: sweep them when this is committed
    """
    if items:
        connection.execute(delete(job_items).where(job_items.c.job_number == job_number))
    own = job_files.c.job_number == job_number
    if files is not None:
        own &= job_files.c.name.in_(list(files))
    blobs = list(connection.execute(select(job_files.c.blob).where(own)).scalars())
    connection.execute(delete(job_files).where(own))
    return blobs
