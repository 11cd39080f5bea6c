"""Pair tables that are damaged: who needs one builds it again."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from sceneprint.maintenance.files import WRITING_S, changed_at
from sceneprint.maintenance.findings import Finding, Folder
from sceneprint.models.tables import is_sound_table
from sceneprint.store.folders import PART

_TABLE = re.compile(r"table-v\d+-[0-9a-f]{64}\.bin")


def check_tables(folder: Folder) -> Iterator[Finding]:
    """Pair tables of models, each against its checksum."""
    place = folder.settings.cache_dir
    if folder.map_name is not None or not place.is_dir():
        return
    found = sorted(place.iterdir())
    for done, path in enumerate(found):
        folder.progress("tables", done, len(found))
        part = PART.fullmatch(path.name) is not None
        if part and changed_at(path) < time.time() - max(folder.grace_s, WRITING_S):
            yield Finding(
                "unfinished-file", str(path), "leftover",
                "a writer was killed before it was whole", "remove it",
                path=path, repair=partial(_remove_cached, path),
            )  # fmt: skip
        if not _TABLE.fullmatch(path.name):
            continue
        folder.counts["tables"] += 1
        if not folder.quick and not _is_sound(path):
            yield Finding(
                "damaged-table", str(path), "damage",
                "a pair table is not the one that was written: it is built again when it is "
                "needed",
                "remove it", path=path, repair=partial(_remove_cached, path),
            )  # fmt: skip
    folder.progress("tables", len(found), len(found))


def _is_sound(path: Path) -> bool:
    try:
        return is_sound_table(path)
    except FileNotFoundError:  # removed meanwhile
        return True
    except OSError:
        return False


def _remove_cached(path: Path) -> str:
    path.unlink(missing_ok=True)
    return "removed"
