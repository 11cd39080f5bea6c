"""Files of long jobs, such as a mesh: lost or damaged."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from sqlalchemy import Connection, select

from sceneprint.maintenance.findings import Finding, Folder
from sceneprint.maintenance.repairs import GONE, quarantine_blob
from sceneprint.store.parts import remove_parts
from sceneprint.store.tables import job_files, jobs, maps


def check_products(folder: Folder) -> Iterator[Finding]:
    """Files of jobs, each against its hash."""
    asked = (
        select(job_files.c.job_number, job_files.c.name, job_files.c.blob, jobs.c.id, jobs.c.kind,
               maps.c.name.label("map"))
        .join(jobs, jobs.c.number == job_files.c.job_number)
        .join(maps, maps.c.number == jobs.c.map_number, isouter=True)
        .order_by(job_files.c.job_number, job_files.c.name)
    )  # fmt: skip
    if folder.map_name is not None:
        asked = asked.where(maps.c.name == folder.map_name)
    with folder.store.database.read() as connection:
        found = connection.execute(asked).all()
    for done, one in enumerate(found):
        folder.progress("files of jobs", done, len(found))
        folder.counts["blobs"] += 1
        condition = folder.store.blobs.condition(one.blob, quick=folder.quick)
        if condition == "sound":
            continue
        with folder.store.database.read() as connection:
            if not _is_there(connection, one.job_number, one.name, one.blob):
                continue
        move = "move it to the quarantine, and " if condition == "damaged" else ""
        yield Finding(
            f"{condition}-job-file", f"{one.name} of job {one.id} ({one.kind})", "damage",
            "it cannot be given out, nor gone on with", f"{move}forget it: begin the job anew",
            map=one.map, path=folder.store.blobs.place(one.blob),
            repair=partial(_repair, folder, one.job_number, one.name, one.blob),
        )  # fmt: skip


def _is_there(connection: Connection, job_number: int, name: str, blob: str) -> bool:
    """Whether the job still has the file: it may have been removed since."""
    own = (
        (job_files.c.job_number == job_number)
        & (job_files.c.name == name)
        & (job_files.c.blob == blob)
    )
    return connection.execute(select(job_files.c.name).where(own)).first() is not None


def _repair(folder: Folder, job_number: int, name: str, blob: str) -> str:
    # in one transaction: an upload of the same bytes may come, and what it put must stay
    with folder.store.database.write() as connection:
        condition = folder.store.blobs.condition(blob)
        if condition == "sound" or not _is_there(connection, job_number, name, blob):
            return GONE
        moved = quarantine_blob(folder, blob) if condition == "damaged" else ""
        remove_parts(connection, job_number, items=False, files=[name])
    return f"{moved}the job has it no more"
