"""Search indexes, compared with the database they were made from."""

from __future__ import annotations

import shutil
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from sqlalchemy import select

from sceneprint.atomic_files import folder_turn
from sceneprint.engine.search.local_index import (
    index_folder,
    is_index_folder,
    trusted,
)
from sceneprint.errors import DamagedIndex, StoreError
from sceneprint.index import Generation, newest
from sceneprint.index.generation_files import (
    GenerationManifest,
    check,
    is_ours,
    manifests,
    read_manifest,
)
from sceneprint.maintenance.fsck.blobs import WRITING_S, changed_at
from sceneprint.maintenance.fsck.findings import Finding, Folder
from sceneprint.store.maps import find_map, list_maps
from sceneprint.store.signatures import stored_signatures
from sceneprint.store.tables import MapRow, frames
from sceneprint_client.api import FrameState

if TYPE_CHECKING:
    pass

# Indexes that are damaged, or differ from the database.
#
# To remove what is damaged is to repair it: workers make an index again.

#: Signatures that are compared at once.
_BLOCK = 64


def check_indexes(folder: Folder) -> Iterator[Finding]:
    """Every generation of every map, and folders of maps that are no more."""
    with folder.store.database.read() as connection:
        rows = list_maps(connection)
        if folder.map_name is not None:
            rows = [find_map(connection, folder.map_name)]
    for done, row in enumerate(rows):
        folder.progress("indexes", done, len(rows))
        for model_id in dict.fromkeys((row.model_id, row.next_model_id or row.model_id)):
            own = replace(row, model_id=model_id)
            place = index_folder(folder.settings.indexes, own)
            damaged = list(_damaged_files(folder, own, place))
            yield from damaged
            yield from _unneeded(folder, place)
            # an index of the model to come is not complete, and not searched
            if not damaged and not folder.quick and model_id == row.model_id:
                yield from _differing_generations(folder, own, place)
    folder.progress("indexes", len(rows), len(rows))
    if folder.map_name is None:
        yield from _of_no_map(folder)


def _damaged_files(folder: Folder, row: MapRow, place: Path) -> Iterator[Finding]:
    seen: set[str] = set()
    for _, path in manifests(place):
        folder.counts["generations"] += 1
        wrong = _wrong_files(path, seen, quick=folder.quick)
        if not path.exists():
            continue  # a builder has replaced it meanwhile
        for file, why in wrong:
            yield Finding(
                "damaged-index", str(file), "damage",
                f"a file of the index of map {row.name}, {why}: it is passed over by queries",
                "remove it with the generations that need it; a worker makes the index again",
                map=row.name, path=file, repair=partial(_remove_file, file),
            )  # fmt: skip


def _wrong_files(path: Path, seen: set[str], *, quick: bool) -> list[tuple[Path, str]]:
    """Files of a generation, and the manifest itself, that are not what was written."""
    try:
        manifest = read_manifest(path)
    except DamagedIndex:
        return [(path, "changed")]
    wrong = []
    for name, size in manifest.files:
        if name in seen:
            continue
        seen.add(name)
        try:
            _read(path.parent, name, size, verify=not quick)
        except DamagedIndex:
            there = (path.parent / name).exists()
            wrong.append((path.parent / name, "changed" if there else "missing"))
    return wrong


def _read(place: Path, name: str, size: int, *, verify: bool) -> None:
    for _ in check(place, name, size):
        if not verify:  # its size is what was written
            return


def _remove_file(file: Path) -> str:
    """Remove a file and what needs it, so that a generation is there whole or not at all."""
    with folder_turn(file.parent) as mine:
        if not mine:
            raise StoreError("a worker is building this index; run it again when that is done")
        needing = [path for _, path in manifests(file.parent) if _needs(path, file.name)]
        for path in (*needing, file):  # manifests first: none should promise what is gone
            path.unlink(missing_ok=True)
    return f"removed, and {len(needing)} generations that need it" if needing else "removed"


def _needs(path: Path, name: str) -> bool:
    try:
        return name in {each for each, _ in read_manifest(path).files}
    except DamagedIndex:
        return False


def _unneeded(folder: Folder, place: Path) -> Iterator[Finding]:
    """What a killed builder left; the next one would remove it too."""
    needed = {name for _, path in manifests(place) for name, _ in _files(path)}
    old = time.time() - max(folder.grace_s, WRITING_S)
    for path in sorted(place.iterdir()) if place.is_dir() else ():
        if is_ours(path.name) and path.name not in needed and changed_at(path) < old:
            yield Finding(
                "unneeded-file", str(path), "leftover", "no generation of the index needs it",
                "remove it", path=path, repair=partial(_remove_file, path),
            )  # fmt: skip


def _files(path: Path) -> tuple[tuple[str, int], ...]:
    try:
        manifest: GenerationManifest | None = read_manifest(path)
    except DamagedIndex:
        manifest = None
    return () if manifest is None else manifest.files


def _differing_generations(folder: Folder, row: MapRow, place: Path) -> Iterator[Finding]:
    """A sound index that does not hold what the database says: made by a mistake, or elsewhere."""
    model = folder.model(row.model_id)
    found = None if model is None else newest(place, row.model_id, model.signature_bytes)
    if found is None:
        return
    with folder.store.database.read() as connection:
        generation = trusted(connection, row, found)
    if generation is None:
        yield Finding(
            "foreign-index", str(place), "note",
            f"the index of map {row.name} is of another history of the database, as after a "
            "restore, or older than rows of deleted frames stay: it is passed over, and made again "
            "by a worker",
            map=row.name, path=place,
        )  # fmt: skip
        return
    wrong = _differences(folder, row, generation)
    if wrong:
        yield Finding(
            "other-index", str(place), "damage",
            f"the index of map {row.name} has other signatures than the database, or lacks some: "
            f"frames {', '.join(wrong[:5])}{' and more' if len(wrong) > 5 else ''}",
            "remove its generations; a worker makes the index again",
            map=row.name, path=place, repair=partial(_remove_generations, place),
        )  # fmt: skip


def _differences(folder: Folder, row: MapRow, generation: Generation) -> list[str]:
    """Ids of frames whose signature is another in the index, or is not there."""
    wrong, after = list[str](), 0
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
            return wrong
        after = block[-1].number
        keys = np.array([each.number for each in block], np.int64)
        held = generation.has(keys)
        rows = generation.vectors_of(keys[held])
        indexed = dict(zip(keys[held].tolist(), rows, strict=True))
        for number, frame_id in block:
            # one that is damaged there is a finding of its own
            if number in stored and (
                number not in indexed or indexed[number].tobytes() != stored[number]
            ):
                wrong.append(frame_id)


def _remove_generations(place: Path) -> str:
    with folder_turn(place) as mine:
        if not mine:
            raise StoreError("a worker is building this index; run it again when that is done")
        listed = manifests(place)
        for _, path in listed:
            path.unlink(missing_ok=True)
        for path in place.iterdir():
            if is_ours(path.name):
                path.unlink(missing_ok=True)
    return f"{len(listed)} generations removed"


def _of_no_map(folder: Folder) -> Iterator[Finding]:
    place = folder.settings.indexes
    found = sorted(place.iterdir()) if place.is_dir() else []
    with folder.store.database.read() as connection:  # after: a map may have been made since
        rows = list_maps(connection)
    models = {row.number: (row.model_id, row.next_model_id or row.model_id) for row in rows}
    own = {
        index_folder(place, replace(row, model_id=model_id)).name
        for row in rows
        for model_id in models[row.number]
    }
    for path in found:
        if path.is_dir() and is_index_folder(path.name) and path.name not in own:
            yield Finding(
                "index-of-no-map", str(path), "leftover", "its map, or that model's, is no more",
                "remove it", path=path, repair=partial(_remove_folder, path),
            )  # fmt: skip


def _remove_folder(path: Path) -> str:
    shutil.rmtree(path, ignore_errors=True)
    return "removed"
