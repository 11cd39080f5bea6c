"""Files in the folder of blobs that nothing refers to, or that are none of ours."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from sqlalchemy import select

from sceneprint.engine.uploads import sweep
from sceneprint.errors import StoreError
from sceneprint.maintenance.findings import Finding, Folder
from sceneprint.maintenance.repairs import GONE
from sceneprint.store import Blobs
from sceneprint.store.frames import refers_to
from sceneprint.store.tables import frames

#: Seconds that a file which is being written is left alone at least, whatever the grace.
WRITING_S = 60.0
#: Blobs that are looked up in one transaction.
_BATCH = 64
_DIGEST = re.compile(r"[0-9a-f]{64}")
#: What a writer that was killed leaves behind.
PART = re.compile(r"\.[0-9a-f]{12}\.part")


@dataclass(frozen=True)
class _Entry:
    """A file in the folder of blobs.

    Parameters
    ----------
    path : of the file
    digest : of the blob that it is; None where it is none
    changed_at : seconds since 1970
    """

    path: Path
    digest: str | None
    changed_at: float

    @property
    def unfinished(self) -> bool:
        """Whether a writer writes it, or has left it."""
        return PART.fullmatch(self.path.name) is not None


def _entries(place: Path, blobs: Blobs) -> Iterator[_Entry]:
    """All files, in no order; those that vanish meanwhile are left out."""
    folders = [place]
    while folders:
        with os.scandir(folders.pop()) as found:
            for one in found:
                path = Path(one.path)
                if one.is_dir(follow_symlinks=False):
                    folders.append(path)
                    continue
                try:
                    changed_at = one.stat(follow_symlinks=False).st_mtime
                except FileNotFoundError:
                    continue
                own = _DIGEST.fullmatch(one.name) and blobs.path(one.name) == path
                yield _Entry(path, one.name if own else None, changed_at)


def check_files(folder: Folder) -> Iterator[Finding]:
    """Files in the folder of blobs that nothing refers to, or that are none of ours."""
    if folder.map_name is not None:
        return
    now = time.time()
    old = now - folder.grace_s
    waiting: list[_Entry] = []
    for done, entry in enumerate(_entries(folder.settings.blob_dir, folder.store.blobs)):
        if done % 1000 == 0:
            folder.progress("files", done, done)
        folder.counts["files"] += 1
        if entry.digest is not None and entry.changed_at < old:
            waiting.append(entry)
        elif entry.unfinished and entry.changed_at < min(old, now - WRITING_S):
            yield Finding(
                "unfinished-file", str(entry.path), "leftover",
                "a writer was killed before it was whole", "remove it",
                path=entry.path, repair=partial(_remove_part, entry),
            )  # fmt: skip
        elif entry.digest is None and not entry.unfinished:
            yield Finding(
                "foreign-file", str(entry.path), "note",
                "nothing here is called so: it is left alone", path=entry.path,
            )  # fmt: skip
        if len(waiting) == _BATCH:
            yield from _unreferenced(folder, waiting)
            waiting = []
    yield from _unreferenced(folder, waiting)


def _unreferenced(folder: Folder, entries: list[_Entry]) -> Iterator[Finding]:
    with folder.store.database.read() as connection:
        stray = [each for each in entries if not refers_to(connection, str(each.digest))]
        known = connection.execute(select(frames.c.number).limit(1)).first() is not None
    for entry in stray:
        if not known:  # more likely another database's than nobody's
            yield Finding(
                "unreferenced-blob", str(entry.path), "note",
                "the database has never held a frame: is it the one of these blobs?",
                path=entry.path,
            )  # fmt: skip
            continue
        yield Finding(
            "unreferenced-blob", str(entry.path), "leftover",
            "no frame refers to it: its upload was killed half way, or its frame was deleted",
            "remove it",
            path=entry.path, repair=partial(_sweep, folder, str(entry.digest)),
        )  # fmt: skip


def _remove_part(entry: _Entry) -> str:
    entry.path.unlink(missing_ok=True)
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
