"""Copies of single maps in a robot's own store, updated by what is new in the service.

    digests of the copy's parts  --MapCopies.bundle-->  head of the map, and missing parts
    rows of these parts          -------------------->  missing artifacts
    --pull_map-->  one transaction

Parts of rows have the same bytes in the service and in the copy. A pull that is killed leaves the
copy unchanged, and the next one reuses the artifacts that it fetched.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sqlalchemy import JSON, Connection

from sceneprint.atomic_files import make_folder, write_durable
from sceneprint.bundle.rows import Row, cut_rows, decoded_rows, encoded_rows, read_rows, write_part
from sceneprint.engine.upkeep.garbage_collection import collect_deleted_blobs
from sceneprint.errors import Conflict, DamagedBlob, InvalidRequest, NotFound, UnknownMap
from sceneprint.models import parse_model
from sceneprint.store import Store
from sceneprint.store.copy_rows import (
    COLUMNS,
    COPIED_COLUMNS,
    CopiedFrame,
    add_copied,
    copied_rows,
    date_map,
    edit_copied,
    has_artifact,
    living_rows,
    model_of,
    numbers_in_blocks,
)
from sceneprint.store.deletion import BLOCK, delete_frames, remove_map
from sceneprint.store.frames import write_map
from sceneprint.store.maps import add_map, find_map, list_maps, store_model
from sceneprint.store.postgres.connection import allow
from sceneprint.store.signatures import StoredSignature
from sceneprint.store.tables import FrameRow, MapRow
from sceneprint_client.api.copies import CopyPart, MapCopy

if TYPE_CHECKING:
    from sceneprint_client import Client

#: Maximum number of consecutive requests without a new part, after which artifacts count as lost.
ROUNDS = 10
#: Size in bytes after which no further part is added to a response.
MOST_BYTES = 32 << 20
_NAMES = [one.name for one in COLUMNS]


def copy_parts(connection: Connection, row: MapRow) -> Iterator[tuple[str, bytes, int]]:
    """Yield digest, bytes and number of rows of each part of a map's indexed frames."""
    for rows, _ in cut_rows(encoded_rows(COLUMNS, copied_rows(connection, row)), [0]):
        data = write_part(_NAMES, rows)
        yield hashlib.sha256(data).hexdigest(), data, len(rows)


class MapCopies:
    """The service's side of copies."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def bundle(self, map_name: str, have: Collection[str]) -> bytes:
        """Return a consistent state of a map: a line with its `MapCopy`, and the bytes of parts.

        Parameters
        ----------
        have : digests of the caller's parts; about 32 MB of the other parts follow the line

        Raises
        ------
        UnknownMap : If the map does not exist.
        """
        parts, sent, size = list[CopyPart](), list[bytes](), 0
        with self._store.database.read() as connection:
            allow(connection, 0)  # sorting the rows of a large map takes long
            row = find_map(connection, map_name)
            name, _ = model_of(connection, row.model_id)
            for digest, data, count in copy_parts(connection, row):
                is_sent = digest not in have and size < MOST_BYTES
                if is_sent:
                    sent.append(data)
                    size += len(data)
                parts.append(CopyPart(digest=digest, bytes=len(data), rows=count, sent=is_sent))
        head = MapCopy(
            name=row.name, title=row.title, up=row.up, created_at=row.created_at,
            revision=row.revision, model_id=row.model_id, model=name, parts=parts,
        )  # fmt: skip
        return b"".join((head.model_dump_json().encode(), b"\n", *sent))

    def artifact(self, map_name: str, digest: str) -> bytes:
        """Return the artifact of an indexed frame.

        Raises
        ------
        UnknownMap, NotFound : If no frame of the map has the artifact.
        DamagedBlob : If the artifact is damaged or was just removed.
        """
        with self._store.database.read() as connection:
            row = find_map(connection, map_name)
            if not has_artifact(connection, row, digest):
                raise NotFound(
                    f"No indexed frame of map {map_name!r} has an artifact {digest[:80]!r}. List "
                    "the parts of the map again."
                )
        return self._store.blobs.get(digest)

    def model(self, map_name: str) -> bytes:
        """Return the file of the map's model; raise UnknownMap if the map does not exist."""
        with self._store.database.read() as connection:
            row = find_map(connection, map_name)
            return model_of(connection, row.model_id)[1]


@dataclass(frozen=True)
class PulledMap:
    """The result of a pull.

    Parameters
    ----------
    revision : revision of the map in the service
    frames : number of frames in the copy
    written, removed : numbers of new or changed frames, and of removed ones
    artifacts, bytes : number and size of the fetched artifacts
    """

    revision: int
    frames: int
    written: int
    removed: int
    artifacts: int
    bytes: int


#: Name of the file that marks a data folder with copies, which `pull_map` may change.
_MARK = "map-copy.json"


def claim_folder(folder: Path) -> None:
    """Mark a data folder as one for copies of maps; raise InvalidRequest if it has other files."""
    if (folder / _MARK).is_file():
        return
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InvalidRequest(
            f"{folder} has files, but is not a folder of pulled maps. Nothing was changed. Pass "
            "another folder with --data."
        )
    make_folder(folder)
    write_durable(folder / _MARK, b"{}", folder_is_new=False)


@dataclass(frozen=True, eq=False)
class _Pull:
    """The state of a pull.

    Parameters
    ----------
    own : encoded rows of the copy, by digest of the part and id
    fetched : encoded rows from the service, by digest of the part and id
    """

    own: dict[str, dict[str, Row]]
    fetched: dict[str, dict[str, Row]]

    def rows(self, head: MapCopy) -> dict[str, Row]:
        """Return the rows of all frames of the map, by id."""
        parts = self.own | self.fetched
        return {name: row for one in head.parts for name, row in parts[one.digest].items()}


def pull_map(
    client: Client, store: Store, map_name: str,
    progress: Callable[[int, int], None] | None = None,
) -> PulledMap:  # fmt: skip
    """Update the copy of a map to a state that the map had in the service during this call.

    Queries of the copy see its former state in the meantime.

    Parameters
    ----------
    client : client of the service, with a key that may read the map
    progress : callback with the numbers of fetched frames, and of all frames to fetch

    Raises
    ------
    UnknownMap : If the map does not exist in the service, or the key cannot read it.
    Conflict : If the map was replaced or lost artifacts meanwhile, or frames were uploaded into the
        copy.
    DamagedBlob : If the service sent damaged bytes.
    """
    pull = _Pull(_own_parts(store, map_name), {})
    artifacts = size = idle = 0
    while True:
        head, parts = client.map_copy(map_name, [*pull.own, *pull.fetched])
        if pull.own and not _is_copy_of(store, head):
            pull.own.clear()  # these rows belong to another map
            continue
        before = len(pull.fetched)
        for digest, data in parts.items():
            rows = _read_part(map_name, digest, data)
            try:
                for row in rows.values():
                    more = _fetch_artifact(client, store, map_name, row[_NAMES.index("geometry")])
                    artifacts, size = artifacts + (more > 0), size + more
            except UnknownMap:
                raise
            except NotFound:  # the frame was deleted or signed again in the meantime
                continue
            pull.fetched[digest] = rows
            if progress is not None:
                total = sum(one.rows for one in head.parts if one.digest not in pull.own)
                done = sum(one.rows for one in head.parts if one.digest in pull.fetched)
                progress(done, total)
        if all(one.digest in pull.own or one.digest in pull.fetched for one in head.parts):
            break
        idle = 0 if len(pull.fetched) > before else idle + 1
        if idle >= ROUNDS:
            raise _changed(map_name)
    model = client.copied_model(map_name)
    if parse_model(model, map_name).id != head.model_id:
        raise _changed(map_name)
    rows = pull.rows(head)
    written, removed = _write(store, head, pull, rows, model)
    return PulledMap(head.revision, len(rows), written, removed, artifacts, size)


def _own_parts(store: Store, map_name: str) -> dict[str, dict[str, Row]]:
    """Return the rows of a map in the store, by part and id; none if it does not exist."""
    with store.database.read() as connection:
        row = next((one for one in list_maps(connection) if one.name == map_name), None)
        if row is None:
            return {}
        return {
            digest: {one[0]: one for one in read_rows(data, _NAMES)}
            for digest, data, _ in copy_parts(connection, row)
        }


def _is_copy_of(store: Store, head: MapCopy) -> bool:
    with store.database.read() as connection:
        return _find_copy(connection, head) is not None


def _read_part(map_name: str, digest: str, data: bytes) -> dict[str, Row]:
    if hashlib.sha256(data).hexdigest() != digest:
        raise DamagedBlob(
            f"A part of map {map_name!r} arrived damaged. Nothing was changed. Pull the map again."
        )
    rows = list(read_rows(data, _NAMES))
    for _ in decoded_rows(COLUMNS, rows):  # raises if a value has another type
        pass
    return {one[0]: one for one in rows}


def _fetch_artifact(client: Client, store: Store, map_name: str, digest: str) -> int:
    """Fetch a missing artifact, store it durably, and return the number of fetched bytes; raise
    DamagedBlob if it arrived damaged.
    """
    if store.blobs.holds(digest):
        return 0
    data = client.copied_artifact(map_name, digest)
    if store.blobs.put(data) != digest:
        raise DamagedBlob(
            f"The artifact {digest[:12]} of map {map_name!r} arrived damaged. Nothing was changed. "
            "Pull the map again."
        )
    return len(data)


def _changed(map_name: str) -> Conflict:
    return Conflict(
        f"Map {map_name!r} was created again, switched its model, or lost artifacts during the "
        "pull. The copy has not changed. Pull the map again."
    )


def _find_copy(connection: Connection, head: MapCopy) -> MapRow | None:
    """Return the copy of a map in the store; None if it is missing or copies a former map."""
    row = next((one for one in list_maps(connection) if one.name == head.name), None)
    if row is None or (row.created_at, row.model_id) != (head.created_at, head.model_id):
        return None
    return row


def _write(
    store: Store, head: MapCopy, pull: _Pull, rows: dict[str, Row], model: bytes
) -> tuple[int, int]:
    """Update the copy in one transaction; return the numbers of written and of removed frames."""
    before = {name: row for part in pull.own.values() for name, row in part.items()}
    written = [_copied(head, row) for name, row in rows.items() if before.get(name) != row]
    blobs: list[str] = []
    with store.blobs.block_removals(), store.database.write() as connection:
        store_model(connection, head.model_id, head.model, model)
        row = _prepare_map(store, connection, head, blobs)
        existing = living_rows(connection, row)
        deleted = [one for name, one in existing.items() if name not in rows]
        renewed = [
            existing[one.id] for one in written
            if one.id in existing and existing[one.id].content_id != one.values["content_id"]
        ]  # fmt: skip
        for some in numbers_in_blocks([*deleted, *renewed]):
            blobs += delete_frames(connection, row, some)
        remaining = existing.keys() - {one.id for one in renewed}
        for one in written:
            if not store.blobs.holds(one.signature.geometry):
                raise DamagedBlob(
                    f"The artifact {one.signature.geometry[:12]} was just removed. Pull the map "
                    "again."
                )
            if one.id in remaining:
                edit_copied(connection, row, existing[one.id], one)
        new = [one for one in written if one.id not in remaining]
        for first in range(0, len(new), BLOCK):
            add_copied(connection, row, new[first : first + BLOCK])
    collect_deleted_blobs(store, blobs)
    return len(written), len(deleted)


def _copied(head: MapCopy, row: Row) -> CopiedFrame:
    """Return a frame from its encoded row."""
    ((name, *cells),) = decoded_rows(COLUMNS, [row])
    values: dict[str, Any] = {
        column.name: json.loads(x) if isinstance(column.type, JSON) and x is not None else x
        for column, x in zip(COLUMNS[1:], cells, strict=True)
    }
    own = (values[one] for one in ("vector", "geometry", "n_patches", "n_pairs"))
    signature = StoredSignature(head.model_id, *own)
    return CopiedFrame(name, {one: values[one] for one in COPIED_COLUMNS}, signature)


def _prepare_map(store: Store, connection: Connection, head: MapCopy, blobs: list[str]) -> MapRow:
    """Return the copy, which is created if it is missing or copies a former map.

    Raises
    ------
    Conflict : If the copy has uploaded frames, which exist nowhere else.
    """
    rows = {one.name: one for one in list_maps(connection)}
    before, row = rows.get(head.name), _find_copy(connection, head)
    if before is not None:
        _require_copied(store, living_rows(connection, before).values(), head.name)
    if before is not None and row is None:
        blobs += remove_map(connection, before)
    if row is None:
        added = add_map(connection, head.name, head.title, head.model_id)
        row = date_map(connection, added, head.created_at)
    return write_map(connection, row, {"title": head.title, "up": head.up})


def _require_copied(store: Store, rows: Iterable[FrameRow], map_name: str) -> None:
    """Raise Conflict if a frame was uploaded into the copy; copied frames have no uploads."""
    own = [one.id for one in rows if store.blobs.holds(one.blob)]
    if own:
        raise Conflict(
            f"Map {map_name!r} has {len(own)} frames that were uploaded into the copy, such as "
            f"{own[0]}. Nothing was changed. Upload these frames to the service, delete them "
            "from the copy, and pull the map again."
        )
