"""Rows of signatures that robots sent: packages that wait, and how far their senders are trusted.

    upload  --add_package-->  a file of the job, counted in the map  --remove_packages-->  gone

A signature that was sent keeps the id of the key that sent it, for as long as no worker has made it
anew: where a sender is found to be wrong, all that is left of it can be found.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, delete, exists, func, insert, or_, select, update
from sqlalchemy.dialects import postgresql, sqlite

from sceneprint.store.deletion import doom
from sceneprint.store.maps import count_on
from sceneprint.store.queue import PENDING, JobFile, add_files
from sceneprint.store.reencoding_rows import REENCODE
from sceneprint.store.tables import (
    PACKAGE,
    frames,
    job_files,
    jobs,
    keys,
    maps,
    rows_among,
    signature_senders,
    signatures,
)
from sceneprint_client.api import FrameState

#: Type of a package.
_MEDIA_TYPE = "application/octet-stream"

# Packages of frames that wait to be signed.


def add_package(
    connection: Connection, map_number: int, job_id: str, blob: str, size: int, *,
    counted: bool = False,
) -> None:  # fmt: skip
    """Let a job have the package that came with its frame, and count it in the map.

    Parameters
    ----------
    connection : of a writing transaction of the map
    map_number : of the frame
    job_id : of the job
    blob, size : of the package
    counted : whether the map counts it already
    """
    number = connection.execute(select(jobs.c.number).where(jobs.c.id == job_id)).scalar_one()
    add_files(connection, number, [JobFile(PACKAGE, blob, size, _MEDIA_TYPE)])
    if not counted:
        count_on(connection, map_number, 0, size)


def package_of(connection: Connection, job_number: int) -> str | None:
    """Blob of the package that a job has; None where it has none."""
    own = job_files.c.job_number == job_number, job_files.c.name == PACKAGE
    found: str | None = connection.execute(select(job_files.c.blob).where(*own)).scalar()
    return found


def remove_packages(
    connection: Connection, map_number: int, job_numbers: Sequence[int]
) -> list[str]:
    """Forget the packages of jobs of a map, a few hundred at most, and count them no more.

    Returns
    -------
    blobs : that they were, and that are doomed: sweep them when this is committed
    """
    own = job_files.c.job_number.in_(job_numbers), job_files.c.name == PACKAGE
    removed = delete(job_files).where(*own).returning(job_files.c.blob, job_files.c.bytes)
    found = connection.execute(removed).all()
    if found:
        count_on(connection, map_number, 0, -sum(one.bytes for one in found))
        doom(connection, [one.blob for one in found])
    return [one.blob for one in found]


def ended_packages(connection: Connection, limit: int) -> dict[int, list[int]]:
    """Numbers of jobs that are over and still have their package, at most so many, by their map."""
    asked = (
        select(jobs.c.map_number, jobs.c.number)
        .join(job_files, job_files.c.job_number == jobs.c.number)
        .where(job_files.c.name == PACKAGE, jobs.c.state.not_in(PENDING))
        .limit(limit)
    )
    found: dict[int, list[int]] = {}
    for map_number, job in connection.execute(asked):
        found.setdefault(map_number, []).append(job)
    return found


# Senders: keys, by their ids.


@dataclass(frozen=True)
class SenderRow:
    """A key that sent signatures; fields as in the table."""

    key_id: str
    verified: int
    distrusted_at: float | None
    map: str | None
    frame_id: str | None


def find_sender(connection: Connection, key_id: str) -> SenderRow:
    """What is known of a sender; of one that is new, that nothing is."""
    asked = select(signature_senders).where(signature_senders.c.key_id == key_id)
    found = connection.execute(asked).mappings().first()
    return SenderRow(key_id, 0, None, None, None) if found is None else SenderRow(**found)


def distrusted_senders(connection: Connection) -> dict[str, SenderRow]:
    """Senders of which a signature was found to be wrong, by their ids."""
    asked = select(signature_senders).where(signature_senders.c.distrusted_at.is_not(None))
    return {row["key_id"]: SenderRow(**row) for row in connection.execute(asked).mappings()}


def count_verified(connection: Connection) -> int:
    """How many signatures of all senders were made here as well, and agree."""
    asked = select(func.coalesce(func.sum(signature_senders.c.verified), 0))
    return int(connection.execute(asked).scalar_one())


def add_verified(connection: Connection, key_id: str) -> None:
    """Count one more signature of a sender that was made here as well, and agrees."""
    kind: Any = sqlite if connection.dialect.name == "sqlite" else postgresql
    first = kind.insert(signature_senders).values(key_id=key_id, verified=1)
    more = {"verified": signature_senders.c.verified + 1}
    connection.execute(first.on_conflict_do_update(index_elements=["key_id"], set_=more))


def distrust_sender(connection: Connection, key_id: str, map_name: str, frame_id: str) -> bool:
    """Trust a sender no more; returns False where it was not trusted before.

    Parameters
    ----------
    connection : of a transaction that no writer of any map is beside: what is committed later has
        looked whether the sender is trusted
    key_id : of the sender
    map_name, frame_id : whose signature does not agree
    """
    if find_sender(connection, key_id).distrusted_at is not None:
        return False
    values = {"distrusted_at": time.time(), "map": map_name, "frame_id": frame_id}
    own = signature_senders.c.key_id == key_id
    changed = connection.execute(update(signature_senders).where(own).values(**values))
    if changed.rowcount == 0:
        new = insert(signature_senders).values(key_id=key_id, verified=0, **values)
        connection.execute(new)
    return True


def key_of(connection: Connection, key_id: str) -> tuple[str, str] | None:
    """Name and tenant of a key; None where it was revoked."""
    asked = select(keys.c.name, keys.c.tenant).where(keys.c.id == key_id)
    found = connection.execute(asked).first()
    return None if found is None else (found.name, found.tenant)


# Signatures that were sent.


def senders_of(
    connection: Connection, numbers: Iterable[int], model_id: str
) -> dict[int, str | None]:
    """Who sent the signatures of frames, None where they were made here; of frames that have one of
    the model.
    """
    asked = select(signatures.c.frame_number, signatures.c.sender)
    own = asked.where(signatures.c.model_id == model_id)
    rows = rows_among(connection, own, signatures.c.frame_number, numbers)
    return {row.frame_number: row.sender for row in rows}


@dataclass(frozen=True)
class SentFrame:
    """A frame whose signature was sent; fields as in the tables."""

    number: int
    id: str
    map: str
    model_id: str


def distrusted_frames(
    connection: Connection, before: float, limit: int, numbers: Sequence[int] | None = None
) -> list[SentFrame]:
    """Indexed frames that have a signature of a sender that is trusted no more, and for whose
    signing no job waits or runs, nor was made lately.

    Parameters
    ----------
    connection : of the database
    before : seconds since 1970: of jobs that are over, those since then count
    limit : at most so many
    numbers : of the frames that are looked at, a few hundred at most; None: all
    """
    busy = exists().where(
        jobs.c.frame_number == frames.c.number,
        jobs.c.kind == REENCODE,
        jobs.c.model_id == signatures.c.model_id,
        or_(jobs.c.state.in_(PENDING), jobs.c.created_at > before),
    )
    asked = (
        select(frames.c.number, frames.c.id, maps.c.name, signatures.c.model_id)
        .join(signatures, signatures.c.frame_number == frames.c.number)
        .join(signature_senders, signature_senders.c.key_id == signatures.c.sender)
        .join(maps, maps.c.number == frames.c.map_number)
        .where(
            signatures.c.sender.is_not(None),
            signature_senders.c.distrusted_at.is_not(None),
            signatures.c.model_id == maps.c.model_id,
            frames.c.state == FrameState.INDEXED,
            *([] if numbers is None else [frames.c.number.in_(numbers)]),
            ~busy,
        )
        .order_by(frames.c.number)
        .limit(limit)
    )
    return [SentFrame(*row) for row in connection.execute(asked)]
