"""Search indexes, compared with the database that they were made from.

To remove what is damaged is to repair it: workers make an index again.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np
from sqlalchemy import select

from sceneprint.engine.search.local_index import index_folder, trusted
from sceneprint.errors import DamagedIndex, StoreError
from sceneprint.index import Generation, clear, newest
from sceneprint.index.generation_files import check, manifests, read_manifest
from sceneprint.maintenance.fsck.findings import Finding, Folder
from sceneprint.store.maps import find_map, list_maps
from sceneprint.store.signatures import stored_signatures
from sceneprint.store.tables import MapRow, frames
from sceneprint_client.api import FrameState

#: Signatures that are compared at once.
_BLOCK = 64


def check_indexes(folder: Folder) -> Iterator[Finding]:
    """Check the files of every generation, and what the newest one holds."""
    with folder.store.database.read() as connection:
        rows = list_maps(connection)
        if folder.map_name is not None:
            rows = [find_map(connection, folder.map_name)]
    for done, row in enumerate(rows):
        folder.progress("indexes", done, len(rows))
        place = index_folder(folder.settings.indexes, row)
        wrong = list(_damaged_files(folder, place))
        if not wrong and not folder.quick:
            wrong = _differences(folder, row, place)
        for path, why in wrong:
            yield Finding(
                "damaged-index", str(path), "damage",
                f"the index of map {row.name} {why}: a worker has to make it again",
                "remove the index", map=row.name, path=path, repair=partial(_remove, place),
            )  # fmt: skip


def _remove(place: Path) -> str:
    if not clear(place):
        raise StoreError("a worker is building this index; run it again when that is done")
    return "the index is removed"


def _damaged_files(folder: Folder, place: Path) -> Iterator[tuple[Path, str]]:
    """Yield the files of all generations that are not what was written, and what is wrong."""
    seen: set[str] = set()
    for _, path in manifests(place):
        folder.counts["generations"] += 1
        try:
            files = [one for one in read_manifest(path).files if one[0] not in seen]
        except DamagedIndex:
            if path.exists():  # else a builder has replaced it meanwhile
                yield path, "has a damaged manifest"
            continue
        for name, size in files:
            seen.add(name)
            try:
                for _ in check(place, name, size):
                    if folder.quick:  # its size is what was written
                        break
            except DamagedIndex:
                if path.exists():
                    yield place / name, "has a damaged or missing file"


def _differences(folder: Folder, row: MapRow, place: Path) -> list[tuple[Path, str]]:
    """Find what a sound index holds otherwise than the database, or does not hold."""
    model = folder.model(row.model_id)
    found = None if model is None else newest(place, row.model_id, model.signature_bytes)
    if found is None:
        return []
    with folder.store.database.read() as connection:
        generation = trusted(connection, row, found)
    if generation is None:  # of another history, as after a restore: queries pass it over
        return []
    wrong = [one for block in _blocks(folder, row, generation) for one in block]
    named = ", ".join(wrong[:5]) + " and more" * (len(wrong) > 5)
    return [(place, f"has not the signatures of frames {named}")] if wrong else []


def _blocks(folder: Folder, row: MapRow, generation: Generation) -> Iterator[list[str]]:
    """Yield the ids of frames whose signature is another in the index, or is not there."""
    after = 0
    here = (
        (frames.c.map_number == row.number)
        & (frames.c.state == FrameState.INDEXED)
        & (frames.c.revision <= generation.revision)
    )
    while True:
        wanted = select(frames.c.number, frames.c.id).where(here, frames.c.number > after)
        with folder.store.database.read() as connection:
            block = connection.execute(wanted.order_by(frames.c.number).limit(_BLOCK)).all()
            stored = stored_signatures(connection, [each.number for each in block], row.model_id)
        if not block:
            return
        after = block[-1].number
        keys = np.array([each.number for each in block], np.int64)
        held = generation.has(keys)
        rows = generation.vectors_of(keys[held])
        indexed = {key: one.tobytes() for key, one in zip(keys[held].tolist(), rows, strict=True)}
        # one that is damaged in the database is a finding of its own
        yield [own for n, own in block if n in stored and indexed.get(n) != stored[n]]
