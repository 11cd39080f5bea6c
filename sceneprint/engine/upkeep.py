"""Publishing indexes: a map whose tail has grown long gets a new generation."""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection

from sceneprint.engine.readers import index_folder, is_index_folder, trusted
from sceneprint.engine.signers import Signers
from sceneprint.errors import SceneprintError, UnknownMap
from sceneprint.index import newest, publish
from sceneprint.store import Store
from sceneprint.store.events import anchor_of
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
        """Publish what is due; returns how many generations were.

        What goes wrong with one map's index is logged, and costs neither the others nor any
        frame: queries read from the database what no index holds.
        """
        with self._store.database.read() as connection:
            rows = list_maps(connection)
            due = [row for row in rows if self._due(connection, row)]
        published = 0
        for row in due:
            try:
                published += self._publish(row)
            except UnknownMap:
                pass  # deleted in the meantime
            except (OSError, SceneprintError, ValueError) as error:
                log.error("no index published", extra={"map": row.name, "error": str(error)})
        self._clean(rows)
        return published

    def _due(self, connection: Connection, row: MapRow) -> bool:
        known = self._published.get(row.number, 0)
        return count_indexed(connection, row.number, known) > self._tail_frames

    def _publish(self, row: MapRow) -> bool:
        signer = self._signers(row.model_id)  # before a connection is held: it takes one itself
        with self._store.database.read() as connection:
            now = find_map(connection, row.name)
            if now.number != row.number:
                return False  # made anew in the meantime; next time
            folder = index_folder(self._indexes, now)
            length = signer.model.signature_bytes
            previous = trusted(connection, now, newest(folder, now.model_id, length))
            since = 0 if previous is None else previous.revision
            self._published[now.number] = since
            if count_indexed(connection, now.number, since) <= self._tail_frames:
                return False  # another worker was first
            generation = publish(
                folder,
                model_id=now.model_id,
                revision=now.revision,
                blocks=_blocks(connection, now, since),
                previous=previous,
                drop=deleted_since(connection, now.number, since),
                anchor=anchor_of(connection, now.name),
            )
        if generation is None:
            return False
        self._published[now.number] = generation.revision
        log.info(
            "index published",
            extra={"map": now.name, "generation": generation.number, "frames": len(generation)},
        )
        return True

    def _clean(self, rows: Sequence[MapRow]) -> None:
        """Remove the indexes of maps that are no more."""
        kept = {index_folder(self._indexes, row).name for row in rows}
        if not self._indexes.is_dir():
            return
        with self._store.database.read() as connection:  # a map may have been made since
            kept |= {index_folder(self._indexes, row).name for row in list_maps(connection)}
        for folder in self._indexes.iterdir():
            if is_index_folder(folder.name) and folder.name not in kept:
                shutil.rmtree(folder, ignore_errors=True)
                log.info("index removed", extra={"folder": folder.name})


def _blocks(
    connection: Connection, row: MapRow, since: int
) -> Iterator[tuple[NDArray[np.int64], Bytes]]:
    """Keys and signatures of what was indexed after a revision."""
    for block in changes_since(connection, row, since):
        made = [(one.number, one.vector) for one in block if one.vector is not None]
        if made:
            rows = np.stack([np.frombuffer(vector, np.uint8) for _, vector in made])
            yield np.array([number for number, _ in made], np.int64), rows
