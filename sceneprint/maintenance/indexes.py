"""The index of a map, looked at: its lag, its cost, what it misses, and whether it is sound.

map  --describe_index-->  IndexStats;  map  --verify_index-->  what is wrong with it
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import select

from sceneprint.engine.readers import index_folder, trusted
from sceneprint.index import Generation, newest, newest_number, scrub, signatures_of
from sceneprint.index.keys import draw
from sceneprint.store.signatures import changes_since
from sceneprint.store.tables import frames, signatures

if TYPE_CHECKING:
    from sqlalchemy import Connection

    from sceneprint.engine import Engine
    from sceneprint.engine.views import View
    from sceneprint.store.records import MapRow

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
    probes : lists of the inverted file that a query compares; 0 where it compares every frame
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
    on_disk = sum(path.stat().st_size for path in folder.glob("*")) if folder.is_dir() else 0
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
        probes=0 if generation is None else generation.recall.probes,
        recall=recall,
        spread=spread,
    )


def verify_index(engine: Engine, map_name: str) -> list[str]:
    """Read the index of a map, and compare it with the database.

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
    row, model, _ = engine.view(map_name)
    folder = index_folder(engine.settings.indexes, row)
    wrong = [f"{path}: damaged or missing" for path in scrub(folder) if path is not None]
    if wrong or newest_number(folder) is None:
        return wrong
    found = newest(folder, row.model_id, model.signature_bytes)
    if found is None:
        return [f"{folder}: no generation in it can be read"]
    with engine.store.database.read() as connection:
        if trusted(connection, row, found) is None:
            return [f"{folder}: generation {found.number} is of a state that was undone"]
        return _differing(connection, row, found, folder)


def _differing(connection: Connection, row: MapRow, found: Generation, folder: Path) -> list[str]:
    """Signatures of the index that are not those of the database."""
    wrong = []
    for block in changes_since(connection, row, 0):
        own = [one for one in block if one.vector is not None and one.revision <= found.revision]
        held = found.places.of(np.array([one.number for one in own], np.int64)) >= 0
        own = [one for one, is_held in zip(own, held.tolist(), strict=True) if is_held]
        if own:
            stored = found.vectors_of(np.array([one.number for one in own]))
            wrong += [
                f"{folder}: the signature of frame {one.frame_id} is not that of the database"
                for one, vector in zip(own, stored, strict=True)
                if vector.tobytes() != one.vector
            ]
    return wrong


def _recall(
    view: View, sample: int, seed: int, progress: Progress
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


def _lag_s(connection: Connection, row: MapRow, view: View) -> float:
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
