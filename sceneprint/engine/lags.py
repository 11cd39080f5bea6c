"""How far the search indexes are behind their maps, and which events they need to be believed."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from sqlalchemy import Connection

from sceneprint.engine.readers import index_folder, is_index_folder
from sceneprint.errors import DamagedIndex
from sceneprint.index.manifests import Manifest, manifests, read_manifest
from sceneprint.schemas.operations import IndexRecall, IndexState
from sceneprint.store.events import anchor_number
from sceneprint.store.maps import list_maps
from sceneprint.store.records import MapRow
from sceneprint.store.signatures import count_indexed

#: Maps that are told of at most: those that changed most often.
MOST = 200


def index_state(connection: Connection, indexes: Path, row: MapRow) -> IndexState:
    """The newest index of a map that can be read, by its manifest alone."""
    for _, path in manifests(index_folder(indexes, row)):
        found = _read(path)
        if found is not None and found.revision <= row.revision:
            tail = count_indexed(connection, row.number, found.revision)
            recall = None if found.recall is None else IndexRecall(**asdict(found.recall))
            return IndexState(map=row.name, generation=found.number, tail=tail, recall=recall)
    tail = count_indexed(connection, row.number, 0)
    return IndexState(map=row.name, generation=None, tail=tail, recall=None)


def index_states(connection: Connection, indexes: Path) -> list[IndexState]:
    """Of the maps that changed most often; the longest tail first."""
    rows = sorted(list_maps(connection), key=lambda row: -row.revision)[:MOST]
    found = [index_state(connection, indexes, row) for row in rows]
    return sorted(found, key=lambda state: (-state.tail, state.map))


def anchors(indexes: Path) -> frozenset[int]:
    """Numbers of the events that the indexes of this machine are held to."""
    if not indexes.is_dir():
        return frozenset()
    folders = [folder for folder in indexes.iterdir() if is_index_folder(folder.name)]
    read = [_read(path) for folder in folders for _, path in manifests(folder)]
    numbers = [anchor_number(one.anchor) for one in read if one is not None]
    return frozenset(number for number in numbers if number is not None)


def _read(path: Path) -> Manifest | None:
    try:
        return read_manifest(path)
    except DamagedIndex:
        return None  # readers pass it over too
