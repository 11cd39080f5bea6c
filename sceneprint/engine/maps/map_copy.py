"""Copies of single maps in the store of a robot, updated incrementally from the service.

    digests of the copy's parts  --read_copy-->  head of the map, and missing parts
    rows of these parts          ------------->  missing artifacts
    --pull_map-->  one transaction

A part consists of the encoded rows of some frames, and has the same bytes in the service and in the
copy. An interrupted pull leaves the copy unchanged; the next pull reuses its artifacts.
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
from sceneprint.engine.serializers import copy_fields
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
    has_artifact,
    living_rows,
    set_creation_time,
)
from sceneprint.store.deletion import BLOCK, delete_frames, remove_map
from sceneprint.store.frames import write_frame, write_map
from sceneprint.store.maps import (
    add_map,
    find_map,
    list_maps,
    model_content,
    model_names,
    store_model,
)
from sceneprint.store.postgres.connection import allow
from sceneprint.store.signatures import StoredSignature, replace_signature
from sceneprint.store.tables import FrameRow, MapRow, blocks
from sceneprint_client.api.copies import CopyPart, MapCopy

if TYPE_CHECKING:
    from sceneprint_client import Client

#: Maximum number of consecutive requests without a new part before the pull fails.
ROUNDS = 10
#: Size of a response, in bytes, at which no more parts are added.
MOST_BYTES = 32 << 20
_NAMES = [column.name for column in COLUMNS]


def copy_parts(connection: Connection, row: MapRow) -> Iterator[tuple[str, bytes, int]]:
    """Yield each part of the indexed frames of a map as its digest, bytes and number of rows."""
    for rows, _ in cut_rows(encoded_rows(COLUMNS, copied_rows(connection, row)), [0]):
        data = write_part(_NAMES, rows)
        yield hashlib.sha256(data).hexdigest(), data, len(rows)


def read_copy(store: Store, map_name: str, have: Collection[str]) -> bytes:
    """Return a consistent state of a map: a line of JSON (`MapCopy`), then the bytes of parts.

    Parameters
    ----------
    have : digests of the parts that the caller has; other parts follow, up to about 32 MB

    Raises
    ------
    UnknownMap : If the map does not exist.
    """
    parts, sent, size = list[CopyPart](), list[bytes](), 0
    with store.database.read() as connection:
        allow(connection, 0)  # no time limit, since sorting the rows of a large map takes long
        row = find_map(connection, map_name)
        name = model_names(connection)[row.model_id]
        for digest, data, count in copy_parts(connection, row):
            is_sent = digest not in have and size < MOST_BYTES
            if is_sent:
                sent.append(data)
                size += len(data)
            parts.append(CopyPart(digest=digest, bytes=len(data), rows=count, sent=is_sent))
    head = copy_fields(MapCopy, row, model=name, parts=parts)
    return b"".join((head.model_dump_json().encode(), b"\n", *sent))


def read_artifact(store: Store, map_name: str, digest: str) -> bytes:
    """Return the artifact of an indexed frame.

    Raises
    ------
    UnknownMap, NotFound : If the map does not exist, or none of its frames has the artifact.
    DamagedBlob : If the artifact is damaged or was removed meanwhile.
    """
    with store.database.read() as connection:
        if not has_artifact(connection, find_map(connection, map_name), digest):
            raise NotFound(
                f"No indexed frame of map {map_name!r} has an artifact {digest[:80]!r}. List "
                "the parts of the map again."
            )
    return store.blobs.get(digest)


def read_copied_model(store: Store, map_name: str) -> bytes:
    """Return the model of a map as a file; raise UnknownMap if the map does not exist."""
    with store.database.read() as connection:
        return model_content(connection, find_map(connection, map_name).model_id)


@dataclass(frozen=True)
class PulledMap:
    """The result of a pull.

    Parameters
    ----------
    revision : copied revision of the map
    frames : number of frames in the copy
    written, removed : number of new or changed frames, and of removed frames
    artifacts, bytes : number and total size of the fetched artifacts
    """

    revision: int
    frames: int
    written: int
    removed: int
    artifacts: int
    bytes: int


#: Name of the file that marks a data folder as one for map copies, which `pull_map` may change.
_MARK = "map-copy.json"


def claim_folder(folder: Path) -> None:
    """Create or mark a data folder for map copies; raise InvalidRequest if it has other files."""
    if (folder / _MARK).is_file():
        return
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InvalidRequest(
            f"{folder} contains files, but no pulled maps. Nothing was changed. Pass another "
            "folder with --data."
        )
    make_folder(folder)
    write_durable(folder / _MARK, b"{}", folder_is_new=False)


#: Encoded rows by frame id, for each part digest.
Parts = dict[str, dict[str, Row]]


def pull_map(
    client: Client, store: Store, map_name: str,
    progress: Callable[[int, int], None] | None = None,
) -> PulledMap:  # fmt: skip
    """Create or update the copy of a map from the service; return the numbers of changes.

    Queries of the copy use its former state until the update is complete.

    Parameters
    ----------
    client : client with a key that may read the map
    store : store of the copy
    progress : callback that receives the number of fetched frames, and the number of frames to
        fetch

    Raises
    ------
    UnknownMap : If the service has no such map that the key may read.
    Conflict : If the map was replaced, switched its model or lost artifacts meanwhile, or frames
        were uploaded into the copy.
    DamagedBlob : If the service sent damaged bytes, or an artifact was removed during the update.
    """
    own, fetched = _own_parts(store, map_name), Parts()
    artifacts = size = idle = 0
    while True:
        head, parts = client.map_copy(map_name, [*own, *fetched])
        with store.database.read() as connection:
            if own and _find_copy(connection, head) is None:
                own.clear()  # these rows belong to another map
                continue
        count = len(fetched)
        for digest, data in parts.items():
            rows = _read_part(map_name, digest, data)
            try:
                for row in rows.values():
                    more = _fetch_artifact(client, store, map_name, row[_NAMES.index("geometry")])
                    artifacts, size = artifacts + (more > 0), size + more
            except UnknownMap:
                raise
            except NotFound:  # the frame was deleted or signed again
                continue
            fetched[digest] = rows
            if progress is not None:
                total = sum(part.rows for part in head.parts if part.digest not in own)
                progress(sum(part.rows for part in head.parts if part.digest in fetched), total)
        if all(part.digest in own or part.digest in fetched for part in head.parts):
            break
        idle = 0 if len(fetched) > count else idle + 1
        if idle >= ROUNDS:
            raise _changed(map_name)
    model = client.copied_model(map_name)
    if parse_model(model, map_name).id != head.model_id:
        raise _changed(map_name)
    rows = {key: row for part in head.parts for key, row in (own | fetched)[part.digest].items()}
    before = {key: row for part in own.values() for key, row in part.items()}
    changed = [_decode_row(head, row) for key, row in rows.items() if before.get(key) != row]
    removed = _write(store, head, changed, rows.keys(), model)
    return PulledMap(head.revision, len(rows), len(changed), removed, artifacts, size)


def _own_parts(store: Store, map_name: str) -> Parts:
    """Return rows by frame id for each part digest of a map; empty if the map does not exist."""
    with store.database.read() as connection:
        row = next((record for record in list_maps(connection) if record.name == map_name), None)
        if row is None:
            return {}
        return {
            digest: {cells[0]: cells for cells in read_rows(data, _NAMES)}
            for digest, data, _ in copy_parts(connection, row)
        }


def _read_part(map_name: str, digest: str, data: bytes) -> dict[str, Row]:
    if hashlib.sha256(data).hexdigest() != digest:
        raise DamagedBlob(
            f"A part of map {map_name!r} arrived damaged. Nothing was changed. Pull the map again."
        )
    rows = list(read_rows(data, _NAMES))
    for _ in decoded_rows(COLUMNS, rows):  # check the types of the values
        pass
    return {row[0]: row for row in rows}


def _fetch_artifact(client: Client, store: Store, map_name: str, digest: str) -> int:
    """Fetch and store an artifact unless it is stored; return the number of fetched bytes.

    Raise DamagedBlob if the fetched bytes are damaged.
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
    """Return the copy of a map; None if there is none, or it copies a former map of this name."""
    row = next((record for record in list_maps(connection) if record.name == head.name), None)
    if row is None or (row.created_at, row.model_id) != (head.created_at, head.model_id):
        return None
    return row


def _write(
    store: Store, head: MapCopy, written: list[CopiedFrame], ids: Collection[str], model: bytes
) -> int:
    """Update the copy in one transaction; return the number of removed frames.

    Parameters
    ----------
    written : new and changed frames
    ids : ids of all frames of the map
    """
    blobs: list[str] = []
    with store.blobs.locks.block_removals(), store.database.write() as connection:
        store_model(connection, head.model_id, head.model, model)
        row = _prepare_map(store, connection, head, blobs)
        existing = living_rows(connection, row)
        deleted = [frame for name, frame in existing.items() if name not in ids]
        renewed = [
            existing[copy.id] for copy in written
            if copy.id in existing and existing[copy.id].content_id != copy.values["content_id"]
        ]  # fmt: skip
        for some in blocks([frame.number for frame in (*deleted, *renewed)]):
            blobs += delete_frames(connection, row, list(some))
        remaining = existing.keys() - {frame.id for frame in renewed}
        for copy in written:
            if not store.blobs.holds(copy.signature.geometry):
                raise DamagedBlob(
                    f"The artifact {copy.signature.geometry[:12]} was removed during the pull. "
                    "Pull the map again."
                )
            if copy.id in remaining:
                write_frame(connection, row, existing[copy.id], copy.values)
                replace_signature(connection, existing[copy.id], copy.signature)
        new = [copy for copy in written if copy.id not in remaining]
        for first in range(0, len(new), BLOCK):
            add_copied(connection, row, new[first : first + BLOCK])
    collect_deleted_blobs(store, blobs)
    return len(deleted)


def _decode_row(head: MapCopy, row: Row) -> CopiedFrame:
    """Decode a row to a frame."""
    ((name, *cells),) = decoded_rows(COLUMNS, [row])
    values: dict[str, Any] = {
        column.name: json.loads(x) if isinstance(column.type, JSON) and x is not None else x
        for column, x in zip(COLUMNS[1:], cells, strict=True)
    }
    own = (values[name] for name in ("vector", "geometry", "n_patches", "n_pairs"))
    signature = StoredSignature(head.model_id, *own)
    return CopiedFrame(name, {name: values[name] for name in COPIED_COLUMNS}, signature)


def _prepare_map(store: Store, connection: Connection, head: MapCopy, blobs: list[str]) -> MapRow:
    """Create, replace or update the row of a copied map, and return the row.

    A copy of a former map of this name is replaced; its blobs are added to `blobs`. Raise Conflict
    if the copy has uploaded frames, which would be lost.
    """
    rows = {record.name: record for record in list_maps(connection)}
    before, row = rows.get(head.name), _find_copy(connection, head)
    if before is not None:
        _require_copied(store, living_rows(connection, before).values(), head.name)
    if before is not None and row is None:
        blobs += remove_map(connection, before)
    if row is None:
        added = add_map(connection, head.name, head.title, head.model_id)
        row = set_creation_time(connection, added, head.created_at)
    return write_map(connection, row, {"title": head.title, "up": head.up})


def _require_copied(store: Store, rows: Iterable[FrameRow], map_name: str) -> None:
    """Raise Conflict if the upload of a frame is stored: it was uploaded into the copy."""
    own = [row.id for row in rows if store.blobs.holds(row.blob)]
    if own:
        raise Conflict(
            f"The copy of map {map_name!r} has {len(own)} uploaded frames, such as {own[0]}. "
            "Nothing was changed. Upload these frames to the service, delete them from the copy, "
            "and pull the map again."
        )
