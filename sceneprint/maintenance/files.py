"""What lies where blobs are kept and nothing refers to, or is none of ours."""

from __future__ import annotations

import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from sqlalchemy import select

from sceneprint.engine.sweeping import sweep
from sceneprint.errors import StoreError
from sceneprint.maintenance.findings import Finding, Folder
from sceneprint.maintenance.repairs import GONE
from sceneprint.store.blobs import BlobEntry
from sceneprint.store.frames import refers_to
from sceneprint.store.tables import frames

#: Seconds that a file which is being written is left alone at least, whatever the grace.
WRITING_S = 60.0
#: Blobs that are looked up in one transaction.
_BATCH = 64


def check_files(folder: Folder) -> Iterator[Finding]:
    """What lies where blobs are kept and nothing refers to, or is none of ours."""
    if folder.map_name is not None:
        return
    now = time.time()
    old = now - folder.grace_s
    waiting: list[BlobEntry] = []
    for done, entry in enumerate(folder.store.blobs.entries()):
        if done % 1000 == 0:
            folder.progress("files", done, done)
        folder.counts["files"] += 1
        if entry.digest is not None and entry.changed_at < old:
            waiting.append(entry)
        elif entry.unfinished and entry.changed_at < min(old, now - WRITING_S):
            yield Finding(
                "unfinished-file", entry.place, "leftover",
                "a writer was killed before it was whole", "remove it",
                path=entry.place, repair=partial(_remove_part, entry),
            )  # fmt: skip
        elif entry.digest is None and not entry.unfinished:
            yield Finding(
                "foreign-file", entry.place, "note",
                "nothing here is called so: it is left alone", path=entry.place,
            )  # fmt: skip
        if len(waiting) == _BATCH:
            yield from _unreferenced(folder, waiting)
            waiting = []
    yield from _unreferenced(folder, waiting)


def _unreferenced(folder: Folder, entries: list[BlobEntry]) -> Iterator[Finding]:
    with folder.store.database.read() as connection:
        stray = [each for each in entries if not refers_to(connection, str(each.digest))]
        known = connection.execute(select(frames.c.number).limit(1)).first() is not None
    for entry in stray:
        if not known:  # more likely another database's than nobody's
            yield Finding(
                "unreferenced-blob", entry.place, "note",
                "the database has never held a frame: is it the one of these blobs?",
                path=entry.place,
            )  # fmt: skip
            continue
        yield Finding(
            "unreferenced-blob", entry.place, "leftover",
            "no frame refers to it: its upload was killed half way, or its frame was deleted",
            "remove it",
            path=entry.place, repair=partial(_sweep, folder, str(entry.digest)),
        )  # fmt: skip


def _remove_part(entry: BlobEntry) -> str:
    Path(entry.place).unlink(missing_ok=True)  # of a folder: elsewhere nobody sees one
    return "removed"


def _sweep(folder: Folder, digest: str) -> str:
    sweep(folder.store, [digest])
    if not folder.store.blobs.holds(digest):
        return "removed"
    with folder.store.database.read() as connection:
        if refers_to(connection, digest):  # its upload was only just committed
            return GONE
    raise StoreError("a snapshot is being taken; run it again when that is done")


def changed_at(path: Path) -> float:
    """When a file was changed, seconds since 1970; never old where it is gone."""
    try:
        return path.stat().st_mtime
    except OSError:  # gone meanwhile
        return float("inf")
