"""The index of a map, looked at: its lag, its cost, what it misses, and whether it is sound.

map  --describe_index-->  IndexStats;  map  --verify_index-->  what is wrong with it
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import select

from sceneprint.engine.search.local_index import (
    index_folder,
    is_index_folder,
    trusted,
)
from sceneprint.errors import DamagedIndex, StoreError
from sceneprint.index import Generation, newest, signatures_of
from sceneprint.index.generation_files import (
    GenerationManifest,
    building,
    bytes_of,
    check,
    draw,
    is_ours,
    manifests,
    read_manifest,
)
from sceneprint.maintenance.fsck.blobs import WRITING_S, changed_at
from sceneprint.maintenance.fsck.findings import Finding, Folder
from sceneprint.store.maps import find_map, list_maps
from sceneprint.store.signatures import stored_signatures
from sceneprint.store.tables import MapRow, frames, signatures
from sceneprint_client.api import FrameState

if TYPE_CHECKING:
    from sqlalchemy import Connection

    from sceneprint.engine import Engine
    from sceneprint.engine.search.local_index import IndexView

#: Neighbours by which recall is told, and farther ones whose distance tells how hard it is.
NEAR, FAR = 10, 100
#: Called with the number of steps done and their total.
Progress = Callable[[int, int], None]


@dataclass(frozen=True)
class IndexStats:
    """The index of a map.

    Parameters
    ----------
    map, model : names
    frames : that can be found
    generation : number of the one in use; 0 where there is none
    lag_frames : that no index holds: they are compared one by one with every query
    lag_s : seconds since the first of them was indexed; 0 where there are none
    deleted : frames that are in the index and not in the map any more
    upload_bytes, signature_bytes, artifact_bytes, index_bytes : per frame
    sample : frames that were looked up
    probes : frames that a query compares at least; 0 where it compares every frame
    recall : share of the 10 nearest by the exact scan that a query finds; None where it compares
        every frame
    spread : distance of the 100th neighbour over that of the 10th, median: near 1 is hard
    """

    map: str
    model: str
    frames: int
    generation: int
    lag_frames: int
    lag_s: float
    deleted: int
    upload_bytes: int
    signature_bytes: int
    artifact_bytes: int
    index_bytes: int
    sample: int
    probes: int
    recall: float | None
    spread: float | None

    @property
    def bytes_beyond_upload(self) -> int:
        """Bytes that a frame takes beside its upload."""
        return self.signature_bytes + self.artifact_bytes + self.index_bytes


def describe_index(
    engine: Engine, map_name: str, sample: int = 100, seed: int = 0,
    progress: Progress = lambda _done, _total: None,
) -> IndexStats:  # fmt: skip
    """Look at the index of a map, and search it for some of its own frames.

    Parameters
    ----------
    engine : see Engine
    map_name : of the map
    sample : frames to look up, at most; each without itself
    seed : of their choice
    progress : see Progress

    Raises
    ------
    UnknownMap : no such map.
    """
    row, model, view = engine.view(map_name)
    folder = index_folder(engine.settings.indexes, row)
    with engine.store.database.read() as connection:
        sizes = _sizes(connection, engine, row, seed)
        lag_s = _lag_s(connection, row, view)
    on_disk = bytes_of(folder)
    generation = view.generation
    recall, spread, looked_up = _recall(view, sample, seed, progress)
    return IndexStats(
        map=row.name,
        model=model.label,
        frames=view.size,
        generation=0 if generation is None else generation.number,
        lag_frames=len(view.tail),
        lag_s=lag_s,
        deleted=len(view.dead),
        upload_bytes=sizes[0],
        signature_bytes=model.signature_bytes,
        artifact_bytes=sizes[1],
        index_bytes=round(on_disk / max(len(generation or ()), 1)),
        sample=looked_up,
        probes=0 if generation is None else generation.manifest.recall.probes,
        recall=recall,
        spread=spread,
    )


def verify_index(engine: Engine, map_name: str) -> list[str]:
    """Read the index of a map, and compare it with the database, as `fsck` does.

    Parameters
    ----------
    engine : see Engine
    map_name : of the map

    Returns
    -------
    what is wrong, a line each; nothing where the index is sound, or where there is none

    Raises
    ------
    UnknownMap : no such map.
    """
    folder = Folder(
        engine.settings, engine.store, map_name, quick=False, grace_s=0, progress=lambda *_: None
    )
    found = check_indexes(folder)
    return [f"{one.what}: {one.means}" for one in found if one.severity != "leftover"]


def _recall(
    view: IndexView, sample: int, seed: int, progress: Progress
) -> tuple[float | None, float | None, int]:
    """Recall, spread, and how many frames were looked up."""
    keys = view.tail.keys if view.generation is None else np.union1d(
        view.generation.keys, view.tail.keys
    )  # fmt: skip
    keys = keys[~np.isin(keys, list(view.dead))]
    chosen: NDArray[np.int64] = keys[draw(len(keys), sample, seed)]
    found, spreads, short = 0, [], False
    for done, key in enumerate(chosen.tolist()):
        progress(done, len(chosen))
        (query,) = signatures_of(np.array([key]), view.generation, view.tail)
        dead = view.dead | {key}
        exact = view.search(query, FAR, dead=dead, exact=True)
        listed = view.search(query, NEAR, dead=dead)
        short |= not listed.exact
        # an equal distance is as good: which of two equal frames is meant is nobody's concern
        limit = exact.distances[:NEAR].max(initial=-1)
        found += int((listed.distances <= limit).sum())
        if len(exact) == FAR and exact.distances[NEAR - 1] > 0:
            spreads.append(exact.distances[FAR - 1] / exact.distances[NEAR - 1])
    progress(len(chosen), len(chosen))
    total = len(chosen) * min(NEAR, max(view.size - 1, 0))
    recall = found / total if short and total else None
    return recall, float(np.median(spreads)) if spreads else None, len(chosen)


def _lag_s(connection: Connection, row: MapRow, view: IndexView) -> float:
    first = connection.execute(
        select(frames.c.indexed_at).where(
            frames.c.number.in_(view.tail.keys[:1].tolist()), frames.c.map_number == row.number
        )
    ).scalar()
    return 0.0 if first is None else max(time.time() - float(first), 0.0)


def _sizes(connection: Connection, engine: Engine, row: MapRow, seed: int) -> tuple[int, int]:
    """Mean bytes of an upload and of an artifact, of at most a thousand frames."""
    found = connection.execute(
        select(frames.c.bytes, signatures.c.geometry)
        .join(signatures, signatures.c.frame_number == frames.c.number)
        .where(frames.c.map_number == row.number, signatures.c.model_id == row.model_id)
    ).all()
    some = [found[i] for i in draw(len(found), 1000, seed).tolist()]
    if not some:
        return 0, 0
    artifacts = [engine.store.blobs.size(one.geometry) or 0 for one in some]
    return round(np.mean([one.bytes for one in some])), round(np.mean(artifacts))


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
    with building(file.parent) as mine:
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
    with building(place) as mine:
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
