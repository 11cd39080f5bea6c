"""One map in a robot's own store, as it is in the service: found alike, and renewed by what is new.

    MapCopies.listing  -->  ids and tags of all frames
    tags that differ  --MapCopies.rows-->  FrameRowRecord, ...  -->  artifacts that are not here
    --pull_map-->  all of it in one transaction

Whoever is killed before that transaction leaves the copy as it was, and the artifacts that it had:
the next one goes on from there.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from zlib import crc32

from sqlalchemy import Connection

from sceneprint.atomic_files import make_folder, write_durable
from sceneprint.engine.upkeep.garbage_collection import collect_deleted_blobs
from sceneprint.errors import Conflict, DamagedBlob, InvalidRequest, NotFound, UnknownMap
from sceneprint.models import parse_model
from sceneprint.store import Store
from sceneprint.store.copy_rows import (
    COPIED,
    CopiedFrame,
    add_copied,
    copied_values,
    date_map,
    edit_copied,
    has_artifact,
    indexed_rows,
    living_rows,
    model_of,
    numbers_in_blocks,
    rows_of_ids,
)
from sceneprint.store.deletion import BLOCK, delete_frames, remove_map
from sceneprint.store.frames import write_map
from sceneprint.store.maps import add_map, find_map, keep_model, list_maps
from sceneprint.store.signatures import StoredSignature
from sceneprint.store.tables import FrameRow, MapRow
from sceneprint_client.api.copies import (
    MOST_LISTED,
    MOST_ROWS,
    FrameRowRecord,
    FrameRows,
    ListedFrame,
    MapListing,
)

if TYPE_CHECKING:
    from sceneprint_client import Client

#: Times that a map is listed at most, until nothing is left to fetch: it may change meanwhile.
ROUNDS = 10


def copy_tag(row: Mapping[str, Any]) -> str:
    """Stands for all that is copied of a frame."""
    told = json.dumps(copied_values(row), sort_keys=True)
    return hashlib.sha256(told.encode()).hexdigest()[:32]


class MapCopies:
    """What a service tells of its maps to those who copy one."""

    def __init__(self, store: Store) -> None:
        self._store = store

    def listing(self, map_name: str, cursor: str | None, limit: int) -> MapListing:
        """A map, and a part of the list of its indexed frames.

        Raises
        ------
        UnknownMap : there is none of that name.
        InvalidRequest : a cursor that was not given out.
        """
        after = self._store.seals.row("frame", cursor) or 0
        with self._store.database.read() as connection:
            row = find_map(connection, map_name)
            found = indexed_rows(connection, row, after, limit + 1)
            name, _ = model_of(connection, row.model_id)
        numbers = [one.number for one in found]
        return MapListing(
            name=row.name, title=row.title, up=row.up, created_at=row.created_at,
            revision=row.revision, model_id=row.model_id, model=name,
            items=[
                ListedFrame(frame_id=one.id, tag=copy_tag(dict(one._mapping)))
                for one in found[:limit]
            ],
            next_cursor=self._store.seals.next_cursor("frame", numbers, limit),
        )  # fmt: skip

    def rows(self, map_name: str, ids: Sequence[str]) -> FrameRows:
        """Rows of some of its indexed frames; UnknownMap where there is no such map."""
        with self._store.database.read() as connection:
            row = find_map(connection, map_name)
            found = rows_of_ids(connection, row, ids)
        # as bytes, which pydantic takes for base64 when it reads them
        return FrameRows(
            items=[
                FrameRowRecord.model_construct(
                    frame_id=one.id,
                    **{
                        name: one._mapping[name]
                        for name in FrameRowRecord.model_fields
                        if name != "frame_id"
                    },
                )
                for one in found
            ]
        )

    def artifact(self, map_name: str, digest: str) -> bytes:
        """The artifact of one of its indexed frames.

        Raises
        ------
        UnknownMap, NotFound : there is no such map, or none of its frames has it.
        DamagedBlob : it is damaged, or was removed just now.
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
    """Let a data folder be one for copies of maps.

    Raises
    ------
    InvalidRequest : it holds something else.
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


def pull_map(
    client: Client, store: Store, map_name: str,
    progress: Callable[[int, int], None] | None = None,
) -> PulledMap:  # fmt: skip
    """Let a store have a map as a service has it now.

    Queries of the store go on meanwhile, of the map as it was. Where the map changes all the time,
    the copy has each frame as it was at some moment of the pull.

    Parameters
    ----------
    client : of the service; its key may read the map
    progress : told of frames fetched and frames to fetch

    Raises
    ------
    UnknownMap : the service has none of that name, or the key may not read it.
    Conflict : it became another map meanwhile, or frames were uploaded into the copy.
    DamagedBlob : the service sent other bytes than it named.
    """
    fetched: dict[str, FrameRowRecord] = {}
    artifacts = size = 0
    for _ in range(ROUNDS):
        listing, listed, is_quiet = _list_all(client, map_name)
        with store.database.read() as connection:
            known = _tags(connection, listing)
        told = {one: copy_tag(row_values(row)) for one, row in fetched.items()}
        left = [
            one.frame_id for one in listed
            if one.tag not in (known.get(one.frame_id), told.get(one.frame_id))
        ]  # fmt: skip
        if not left and is_quiet:
            break
        for done in range(0, len(left), MOST_ROWS):
            for row in client.copied_rows(map_name, left[done : done + MOST_ROWS]):
                try:
                    more = _fetch_artifact(client, store, map_name, row.geometry)
                except UnknownMap:
                    raise
                except NotFound:  # the frame was deleted or signed again meanwhile
                    continue
                artifacts, size = artifacts + (more > 0), size + more
                fetched[row.frame_id] = row
            if progress is not None:
                progress(min(done + MOST_ROWS, len(left)), len(left))
    model = client.copied_model(map_name)
    if parse_model(model, map_name).id != listing.model_id:
        raise _changed(map_name)
    written, removed = _write(store, listing, listed, fetched, model)
    there = sum(one.frame_id in known or one.frame_id in fetched for one in listed)
    return PulledMap(listing.revision, there, written, removed, artifacts, size)


def _fetch_artifact(client: Client, store: Store, map_name: str, digest: str) -> int:
    """Have an artifact here, durable; returns the bytes that were fetched.

    Raises
    ------
    DamagedBlob : the service sent other bytes than it named.
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


def _list_all(client: Client, map_name: str) -> tuple[MapListing, list[ListedFrame], bool]:
    """All indexed frames of a map, and whether it was quiet while they were listed.

    Raises
    ------
    Conflict : it became another map meanwhile.
    """
    first = part = client.map_listing(map_name, limit=MOST_LISTED)
    found, is_quiet = list(first.items), True
    while part.next_cursor is not None:
        part = client.map_listing(map_name, part.next_cursor, MOST_LISTED)
        if (part.created_at, part.model_id) != (first.created_at, first.model_id):
            raise _changed(map_name)
        is_quiet = is_quiet and part.revision == first.revision
        found += part.items
    return first, found, is_quiet


def _changed(map_name: str) -> Conflict:
    return Conflict(
        f"Map {map_name!r} was created again, or came to another model, while it was pulled. The "
        "copy is as it was. Pull again."
    )


def row_values(row: FrameRowRecord) -> dict[str, Any]:
    """Columns of a frame and its signature, as the database has them."""
    told = row.model_dump(exclude={"vector"})
    return told | {"vector": row.vector, "checksum": crc32(row.vector)}


def _here(connection: Connection, listing: MapListing) -> MapRow | None:
    """The map in the store, if it is a copy of this one, and not of one of before."""
    row = next((one for one in list_maps(connection) if one.name == listing.name), None)
    if row is None or (row.created_at, row.model_id) != (listing.created_at, listing.model_id):
        return None
    return row


def _tags(connection: Connection, listing: MapListing) -> dict[str, str]:
    """Tags of the frames that the store has of a map."""
    row, after = _here(connection, listing), 0
    found: dict[str, str] = {}
    while row is not None:
        some = indexed_rows(connection, row, after, MOST_LISTED)
        if not some:
            break
        found |= {one.id: copy_tag(dict(one._mapping)) for one in some}
        after = some[-1].number
    return found


def _write(
    store: Store, listing: MapListing, listed: Sequence[ListedFrame],
    fetched: Mapping[str, FrameRowRecord], model: bytes,
) -> tuple[int, int]:  # fmt: skip
    """Bring the map in the store to what was listed, all of it or nothing."""
    blobs: list[str] = []
    with store.blobs.kept(), store.database.write() as connection:
        keep_model(connection, listing.model_id, listing.model, model)
        row = _prepared(store, connection, listing, blobs)
        there = living_rows(connection, row)
        wanted = {one.frame_id for one in listed}
        gone = [one for name, one in there.items() if name not in wanted]
        renewed = [
            there[name] for name, one in fetched.items()
            if name in there and there[name].content_id != one.content_id
        ]  # fmt: skip
        for some in numbers_in_blocks([*gone, *renewed]):
            blobs += delete_frames(connection, row, some)
        kept = there.keys() - {one.id for one in renewed}
        written = [fetched[one.frame_id] for one in listed if one.frame_id in fetched]
        for one in written:
            if not store.blobs.holds(one.geometry):
                raise DamagedBlob(
                    f"The artifact {one.geometry[:12]} was removed meanwhile. Pull again."
                )
            if one.frame_id in kept:
                edit_copied(connection, row, there[one.frame_id], _copied(one, listing))
        new = [_copied(one, listing) for one in written if one.frame_id not in kept]
        for first in range(0, len(new), BLOCK):
            add_copied(connection, row, new[first : first + BLOCK])
    collect_deleted_blobs(store, blobs)
    return len(written), len(gone)


def _copied(one: FrameRowRecord, listing: MapListing) -> CopiedFrame:
    values = row_values(one)
    made = StoredSignature(listing.model_id, one.vector, one.geometry, one.n_patches, one.n_pairs)
    return CopiedFrame(one.frame_id, {name: values[name] for name in COPIED}, made)


def _prepared(
    store: Store, connection: Connection, listing: MapListing, blobs: list[str]
) -> MapRow:
    """The map in the store, made where it is not there; one of before goes.

    Raises
    ------
    Conflict : it has frames that were uploaded here, and are nowhere else.
    """
    rows = {one.name: one for one in list_maps(connection)}
    before, row = rows.get(listing.name), _here(connection, listing)
    if before is not None:
        _require_copied(store, living_rows(connection, before).values(), listing.name)
    if before is not None and row is None:
        blobs += remove_map(connection, before)
    if row is None:
        made = add_map(connection, listing.name, listing.title, listing.model_id)
        row = date_map(connection, made, listing.created_at)
    return write_map(connection, row, {"title": listing.title, "up": listing.up})


def _require_copied(store: Store, found: Iterable[FrameRow], map_name: str) -> None:
    """See that no frame was uploaded here: of a copied one the upload is not there."""
    own = [one.id for one in found if store.blobs.holds(one.blob)]
    if own:
        raise Conflict(
            f"Map {map_name!r} has {len(own)} frames that were uploaded into the copy, such as "
            f"{own[0]}, and nothing was changed. Upload them to the service, delete them here, "
            "and pull again."
        )
