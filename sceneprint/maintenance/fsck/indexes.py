"""Checks of search indexes against the database. Workers rebuild indexes that a repair removes."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from sqlalchemy import select

from sceneprint.engine.search.local_index import index_folder, trusted
from sceneprint.errors import StoreError
from sceneprint.index.index_manifest import newest_number
from sceneprint.index.index_version import IndexVersion, clear, newest
from sceneprint.maintenance.fsck.findings import BLOCK, Finding, Folder
from sceneprint.store.maps import list_maps
from sceneprint.store.signatures import stored_signatures
from sceneprint.store.tables import MapRow, frames
from sceneprint_client.api import FrameState


def check_indexes(folder: Folder) -> Iterator[Finding]:
    """Yield findings for maps whose newest index is damaged or differs from the database."""
    with folder.store.database.read() as connection:
        rows = [row for row in list_maps(connection) if folder.map_name in (None, row.name)]
    for done, row in enumerate(() if folder.quick else rows):
        folder.progress("indexes", done, len(rows))
        place, model = index_folder(folder.settings.indexes, row), folder.model(row.model_id)
        number = newest_number(place)
        if number is None or model is None:
            continue
        folder.counts["indexes"] += 1
        index = newest(place, row.model_id, model.signature_bytes)  # verifies all checksums
        wrong = [] if index is None else list(_differing_frames(folder, row, index))
        if index is None or index.number < number:
            means = "has a damaged or missing file"
        elif wrong:
            more = " and more" if len(wrong) > 5 else ""
            means = f"lacks the signatures of frames {', '.join(wrong[:5])}{more}"
        else:
            continue
        yield Finding(
            "damaged-index", f"the index of map {row.name}", "damage", means,
            "remove it; a worker builds it again",
            map=row.name, path=place, repair=partial(_remove, place),
        )  # fmt: skip


def _remove(place: Path) -> str:
    if not clear(place):
        raise StoreError("a worker is building this index; run the check again after it ends")
    return "the index is removed"


def _differing_frames(folder: Folder, row: MapRow, index: IndexVersion) -> Iterator[str]:
    """Yield the ids of frames whose signature is missing or different in the index."""
    with folder.store.database.read() as connection:
        version = trusted(connection, row, index)
    if version is None:  # of another history, such as after a restore; queries ignore it
        return
    after = 0
    here = (
        (frames.c.map_number == row.number)
        & (frames.c.state == FrameState.INDEXED)
        & (frames.c.revision <= version.revision)
    )
    while True:
        query = select(frames.c.number, frames.c.id).where(here, frames.c.number > after)
        with folder.store.database.read() as connection:
            block = connection.execute(query.order_by(frames.c.number).limit(BLOCK)).all()
            stored = stored_signatures(connection, [each.number for each in block], row.model_id)
        if not block:
            return
        after = block[-1].number
        keys = np.array([each.number for each in block], np.int64)
        held = version.has(keys)
        rows = version.vectors_of(keys[held])
        pairs = zip(keys[held].tolist(), rows, strict=True)
        indexed = {key: vector.tobytes() for key, vector in pairs}
        for number, frame_id in block:
            # `check_rows` reports damage in the database
            if number in stored and indexed.get(number) != stored[number]:
                yield frame_id
