"""Publishing indexes: a map whose tail has grown long gets a new generation."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection

from sceneprint.engine.readers import index_folder
from sceneprint.engine.signers import Signers
from sceneprint.index import newest, publish
from sceneprint.store import Store
from sceneprint.store.maps import find_map, list_maps
from sceneprint.store.records import MapRow
from sceneprint.store.signatures import changes_since, count_indexed, deleted_since
from sceneprint.types import Bytes

log = logging.getLogger(__name__)


class Upkeep:
    """Keeps the indexes of one machine near the database.

    Parameters
    ----------
    store, signers : see there
    indexes : folder of all indexes
    tail_frames : frames that a generation may lack
    """

    def __init__(self, store: Store, signers: Signers, indexes: Path, tail_frames: int) -> None:
        self._store, self._signers = store, signers
        self._indexes, self._tail_frames = indexes, tail_frames
        self._published: dict[int, int] = {}  # revision up to which each map is known to be

    def run(self) -> int:
        """Publish what is due; returns how many generations were."""
        with self._store.database.read() as connection:
            due = [row for row in list_maps(connection) if self._due(connection, row)]
        return sum(self._publish(row) for row in due)

    def _due(self, connection: Connection, row: MapRow) -> bool:
        known = self._published.get(row.number, 0)
        return count_indexed(connection, row.number, known) > self._tail_frames

    def _publish(self, row: MapRow) -> bool:
        with self._store.database.read() as connection:
            row = find_map(connection, row.name)
            folder = index_folder(self._indexes, row)  # the map may just have been made anew
            length = self._signers(row.model_id).model.signature_bytes
            previous = newest(folder, row.model_id, length)
            if previous is not None and previous.revision > row.revision:
                previous = None  # the database was put back to an earlier state
            since = 0 if previous is None else previous.revision
            self._published[row.number] = since
            if count_indexed(connection, row.number, since) <= self._tail_frames:
                return False  # another worker was first
            generation = publish(
                folder,
                model_id=row.model_id,
                revision=row.revision,
                blocks=_blocks(connection, row, since),
                previous=previous,
                drop=deleted_since(connection, row.number, since),
            )
        if generation is None:
            return False
        self._published[row.number] = generation.revision
        log.info(
            "index published",
            extra={"map": row.name, "generation": generation.number, "frames": len(generation)},
        )
        return True


def _blocks(
    connection: Connection, row: MapRow, since: int
) -> Iterator[tuple[NDArray[np.int64], Bytes]]:
    """Keys and signatures of what was indexed after a revision."""
    for block in changes_since(connection, row, since):
        made = [(one.number, one.vector) for one in block if one.vector is not None]
        if made:
            rows = np.stack([np.frombuffer(vector, np.uint8) for _, vector in made])
            yield np.array([number for number, _ in made], np.int64), rows
