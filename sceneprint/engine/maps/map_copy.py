"""One map in a robot's own store, as it is in the service: found alike, and renewed by what is new.

    parts of the copy  --MapCopies.bundle-->  head of the map, and the parts that the robot lacks
    rows of these      ------------------->  artifacts that are not here
    --pull_map-->  all of it in one transaction

A part of rows is the same bytes in the service and in the copy. Whoever is killed before that
transaction leaves the copy as it was, and the artifacts that it had: the next one goes on from
there.
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
    COPIED,
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

#: Times that a map is asked for without any part that is new: its artifacts are away then.
ROUNDS = 10
#: Bytes of parts in one answer, and what one part has over it.
MOST_BYTES = 32 << 20
_NAMES = [one.name for one in COLUMNS]


def copy_parts(connection: Connection, row: MapRow) -> Iterator[tuple[str, bytes, int]]:
    """Yield digest, bytes and number of rows of each part of a map's indexed frames."""
    for rows, _ in cut_rows(encoded_rows(COLUMNS, copied_rows(connection, row)), [0]):
        data = write_part(_NAMES, rows)
        yield hashlib.sha256(data).hexdigest(), data, len(rows)


class MapCopies:
    """What a service tells of its maps to those who copy one."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def bundle(self, map_name: str, have: Collection[str]) -> bytes:
        """Return a map at one moment: a line with its `MapCopy`, and the bytes of its parts.

        Parameters
        ----------
        have : digests of parts that the caller has; of the others some 32 MB follow the line

        Raises
        ------
        UnknownMap : there is none of that name.
        """
        parts, sent, size = list[CopyPart](), list[bytes](), 0
        with self._store.database.read() as connection:
            allow(connection, 0)  # the rows of a large map take a while to put in order
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
        """Return the artifact of an indexed frame. Raise UnknownMap or NotFound if no frame of the
        map has it, and DamagedBlob if it is damaged or was just removed.
        """
        with self._store.database.read() as connection:
            row = find_map(connection, map_name)
            if not has_artifact(connection, row, digest):
                raise NotFound(
                    f"No indexed frame of map {map_name!r} has an artifact {digest[:80]!r}. List "
                    "the map again."
                )
        return self._store.blobs.get(digest)

    def model(self, map_name: str) -> bytes:
        """The file of the map's model; UnknownMap where there is no such map."""
        with self._store.database.read() as connection:
            row = find_map(connection, map_name)
            return model_of(connection, row.model_id)[1]


# The robot's side.


@dataclass(frozen=True)
class PulledMap:
    """What came of a pull.

    Parameters
    ----------
    revision : of the map in the service
    frames : that the copy has now
    written, removed : frames that are new or changed, and that are gone
    artifacts, bytes : that were fetched
    """

    revision: int
    frames: int
    written: int
    removed: int
    artifacts: int
    bytes: int


#: Says in a data folder that its maps are copies, and that `pull_map` may change them.
_MARK = "map-copy.json"


def claim_folder(folder: Path) -> None:
    """Mark a data folder as one for copies of maps; raise InvalidRequest if it holds something
    else.
    """
    if (folder / _MARK).is_file():
        return
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise InvalidRequest(
            f"{folder} is not empty, and no folder that maps were pulled into. Nothing was "
            "changed. Name another folder with --data."
        )
    make_folder(folder)
    write_durable(folder / _MARK, b"{}", folder_is_new=False)


@dataclass(frozen=True, eq=False)
class _Pull:
    """What is known of a map while it is pulled.

    Parameters
    ----------
    own : rows that the copy has, as a part has them, by part and by id
    fetched : rows that came, likewise
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
    """Bring a map of a store to one state that it had in the service during this call.

    Queries of the store go on meanwhile, of the map as it was.

    Parameters
    ----------
    client : of the service; its key may read the map
    progress : called with the frames that were fetched, and those to fetch

    Raises
    ------
    UnknownMap : the service has none of that name, or the key may not read it.
    Conflict : it became another map meanwhile, or its artifacts are away; or frames were uploaded
        into the copy.
    DamagedBlob : the service sent other bytes than it named.
    """
    pull = _Pull(_own_parts(store, map_name), {})
    artifacts = size = idle = 0
    while True:
        head, parts = client.map_copy(map_name, [*pull.own, *pull.fetched])
        if pull.own and not _is_copy_of(store, head):
            pull.own.clear()  # of another map: its rows are not those of this one
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
            except NotFound:  # the frame was deleted or signed again meanwhile
                continue
            pull.fetched[digest] = rows
            if progress is not None:
                wanted = sum(one.rows for one in head.parts if one.digest not in pull.own)
                done = sum(one.rows for one in head.parts if one.digest in pull.fetched)
                progress(done, wanted)
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
    """Return the rows of a map in the store, by part and id; none where there is no such map."""
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
        return _here(connection, head) is not None


def _read_part(map_name: str, digest: str, data: bytes) -> dict[str, Row]:
    if hashlib.sha256(data).hexdigest() != digest:
        raise DamagedBlob(
            f"A part of map {map_name!r} came with other bytes than it has. Nothing was changed. "
            "Pull again."
        )
    rows = list(read_rows(data, _NAMES))
    for _ in decoded_rows(COLUMNS, rows):  # raises where a value is of another type
        pass
    return {one[0]: one for one in rows}


def _fetch_artifact(client: Client, store: Store, map_name: str, digest: str) -> int:
    """Fetch an artifact, store it durably, and return its bytes; raise DamagedBlob if the service
    sent others.
    """
    if store.blobs.holds(digest):
        return 0
    data = client.copied_artifact(map_name, digest)
    if store.blobs.put(data) != digest:
        raise DamagedBlob(
            f"The artifact {digest[:12]} of map {map_name!r} came with other bytes than it has. "
            "Nothing was changed. Pull again."
        )
    return len(data)


def _changed(map_name: str) -> Conflict:
    return Conflict(
        f"Map {map_name!r} was created again, came to another model, or lost artifacts while it "
        "was pulled. The copy is as it was. Pull again."
    )


def _here(connection: Connection, head: MapCopy) -> MapRow | None:
    """The map in the store, if it is a copy of this one, and not of one of before."""
    row = next((one for one in list_maps(connection) if one.name == head.name), None)
    if row is None or (row.created_at, row.model_id) != (head.created_at, head.model_id):
        return None
    return row


def _write(
    store: Store, head: MapCopy, pull: _Pull, rows: dict[str, Row], model: bytes
) -> tuple[int, int]:
    """Bring the map in the store to a state of the service, all of it or nothing.

    Returns
    -------
    frames that are new or changed, and that are gone
    """
    before = {name: row for part in pull.own.values() for name, row in part.items()}
    written = [_copied(head, row) for name, row in rows.items() if before.get(name) != row]
    blobs: list[str] = []
    with store.blobs.kept(), store.database.write() as connection:
        store_model(connection, head.model_id, head.model, model)
        row = _prepared(store, connection, head, blobs)
        there = living_rows(connection, row)
        gone = [one for name, one in there.items() if name not in rows]
        renewed = [
            there[one.id] for one in written
            if one.id in there and there[one.id].content_id != one.values["content_id"]
        ]  # fmt: skip
        for some in numbers_in_blocks([*gone, *renewed]):
            blobs += delete_frames(connection, row, some)
        kept = there.keys() - {one.id for one in renewed}
        for one in written:
            if not store.blobs.holds(one.made.geometry):
                raise DamagedBlob(
                    f"The artifact {one.made.geometry[:12]} was removed meanwhile. Pull again."
                )
            if one.id in kept:
                edit_copied(connection, row, there[one.id], one)
        new = [one for one in written if one.id not in kept]
        for first in range(0, len(new), BLOCK):
            add_copied(connection, row, new[first : first + BLOCK])
    collect_deleted_blobs(store, blobs)
    return len(written), len(gone)


def _copied(head: MapCopy, row: Row) -> CopiedFrame:
    """A frame from its row in a part."""
    ((name, *found),) = decoded_rows(COLUMNS, [row])
    values: dict[str, Any] = {
        column.name: json.loads(x) if isinstance(column.type, JSON) and x is not None else x
        for column, x in zip(COLUMNS[1:], found, strict=True)
    }
    own = (values[one] for one in ("vector", "geometry", "n_patches", "n_pairs"))
    made = StoredSignature(head.model_id, *own)
    return CopiedFrame(name, {one: values[one] for one in COPIED}, made)


def _prepared(store: Store, connection: Connection, head: MapCopy, blobs: list[str]) -> MapRow:
    """Return the map in the store, created where missing; an earlier copy is replaced. Raise
    Conflict if the map has frames that were uploaded here, and exist nowhere else.
    """
    rows = {one.name: one for one in list_maps(connection)}
    before, row = rows.get(head.name), _here(connection, head)
    if before is not None:
        _require_copied(store, living_rows(connection, before).values(), head.name)
    if before is not None and row is None:
        blobs += remove_map(connection, before)
    if row is None:
        made = add_map(connection, head.name, head.title, head.model_id)
        row = date_map(connection, made, head.created_at)
    return write_map(connection, row, {"title": head.title, "up": head.up})


def _require_copied(store: Store, found: Iterable[FrameRow], map_name: str) -> None:
    """See that no frame was uploaded here: of a copied one the upload is not there."""
    own = [one.id for one in found if store.blobs.holds(one.blob)]
    if own:
        raise Conflict(
            f"Map {map_name!r} has {len(own)} frames that were uploaded into the copy, such as "
            f"{own[0]}, and nothing was changed. Upload them to the service, delete them here, "
            "and pull again."
        )
