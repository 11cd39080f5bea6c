"""What maps are counted to hold, against what they hold: a quota is asked of the former."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

from sqlalchemy import update

from sceneprint.maintenance.findings import Finding, Folder
from sceneprint.maintenance.repairs import GONE
from sceneprint.store.maps import list_maps
from sceneprint.store.postgres import allow
from sceneprint.store.quotas import counted_anew, use_of
from sceneprint.store.tables import maps


def check_counts(folder: Folder) -> Iterator[Finding]:
    """Maps that are counted to hold more or less than they do."""
    with folder.store.database.read() as connection:
        found = list_maps(connection)
    for row in found:
        if folder.quick or folder.map_name not in (None, row.name):
            continue
        with folder.store.database.read() as connection:
            allow(connection, 0)
            told, there = use_of(connection, row.number), counted_anew(connection, row.number)
        if told != there:
            yield Finding(
                "other-use", f"map {row.name}", "damage",
                f"it is counted to hold {told.frames} frames of {told.bytes} bytes, and holds "
                f"{there.frames} of {there.bytes}: its quota is asked of the former",
                "count anew", map=row.name, repair=partial(_repair, folder, row.number),
            )  # fmt: skip


def _repair(folder: Folder, number: int) -> str:
    with folder.store.database.write() as connection:
        there = counted_anew(connection, number)
        if use_of(connection, number) == there:
            return GONE
        connection.execute(
            update(maps)
            .where(maps.c.number == number)
            .values(used_frames=there.frames, used_bytes=there.bytes)
        )
    return f"{there.frames} frames of {there.bytes} bytes are counted"
