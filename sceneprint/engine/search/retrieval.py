"""Retrieval: ranking R of the frames of all queried maps, Sec. III-C.

maps  --Readers.view-->  IndexViews  --search_maps-->  Searched
"""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, select

from sceneprint import errors
from sceneprint.decoders import Decoders
from sceneprint.engine.ingest.frame_decoder import read_upload
from sceneprint.engine.search.index_place import IN_USE_S, IndexPlace
from sceneprint.engine.search.local_index import IndexView, Reader
from sceneprint.engine.search.up_vectors import known_ups
from sceneprint.engine.signers import Signers
from sceneprint.engine.upkeep.repair import rebuild_frame, resign_frames
from sceneprint.formats.artifact import read_geometry, write_geometry
from sceneprint.geometry.retrieval.ranking import Ranking, ranking_size, similarity
from sceneprint.index.index_version import SearchHits
from sceneprint.index.part_files import Keys
from sceneprint.models import Model
from sceneprint.pipeline import Signer, prepare, sign
from sceneprint.store import Store
from sceneprint.store.frame_queries import QueryOrigin, passing_frames
from sceneprint.store.frames import refers_to
from sceneprint.store.maps import find_frame, find_map, geometry_blobs, list_maps
from sceneprint.store.signatures import stored_vector
from sceneprint.store.tables import MapRow, maps
from sceneprint.types import Bytes, Floats, Geometry
from sceneprint_client.api import Filter, FrameMeta, FrameName, Query
from sceneprint_client.api.frames import Kind

#: Maximum total size of tails, bytes; when it is exceeded, the readers of the least recently
#: queried maps are closed.
HELD_BYTES = 1 << 30
#: Seconds between checks for readers of deleted maps.
_TIDY_S = 10.0


class Readers:
    """Readers of all queried maps; safe to share between threads."""

    def __init__(self, signers: Signers, place: IndexPlace) -> None:
        self._signers, self._place = signers, place
        self._database, self._history = signers.database, signers.database.history
        self._lock = threading.Lock()
        self._open: OrderedDict[str, tuple[tuple[int, str], Reader]] = OrderedDict()
        self._tidied = time.monotonic()

    def view(self, connection: Connection, row: MapRow) -> IndexView:
        """Return a view of a map at the revision of `row` or later."""
        reader = self._reader(connection, row)
        if time.monotonic() - self._tidied >= _TIDY_S:
            self.tidy(connection)
        return reader.view(connection, row)

    def _reader(self, connection: Connection, row: MapRow) -> Reader:
        with self._lock:
            if self._history != self._database.history:  # restored databases reuse revisions
                self._history = self._database.history
                self._open.clear()
            open_key, reader = self._open.get(row.name, (None, None))
            key = (row.number, row.model_id)
            if reader is None or open_key != key:  # new map or model
                model = self._signers(row.model_id).model
                reader = Reader(connection, row, self._place.folder(row), model)
                self._open[row.name] = (key, reader)
            self._open.move_to_end(row.name)
            # close the least recently queried readers, but never the current one
            held_bytes = sum(reader.bytes_held for _, reader in self._open.values())
            while len(self._open) > 1 and held_bytes > HELD_BYTES:
                _, (_, oldest) = self._open.popitem(last=False)
                held_bytes -= oldest.bytes_held
        if self._place.is_shared and self._signers(row.model_id).model.metric == "l2":
            self._place.want(row, reader.version)
        return reader

    def forget(self, name: str) -> None:
        """Close the reader of a deleted map."""
        with self._lock:
            self._open.pop(name, None)

    def purge(self, connection: Connection) -> None:
        """Remove deleted frames from the readers, which switch to the newest indexes."""
        self.tidy(connection)
        with self._lock:
            readers = list(self._open.items())
        rows = {row.name: row for row in list_maps(connection)}
        for name, (key, reader) in readers:
            row = rows.get(name)
            if row is not None and (row.number, row.model_id) == key:
                reader.purge(connection, row)

    def tidy(self, connection: Connection) -> None:
        """Close readers of maps that another process deleted or switched to another model.

        While mapped, their deleted files occupy disk space and file descriptors.
        """
        statement = select(maps.c.name, maps.c.number, maps.c.model_id)
        rows = {row.name: (row.number, row.model_id) for row in connection.execute(statement)}
        with self._lock:
            self._tidied = time.monotonic()
            for name in [name for name, (key, _) in self._open.items() if rows.get(name) != key]:
                del self._open[name]
            for name, (_, reader) in list(self._open.items()) if self._place.is_shared else ():
                if reader.lost_index(IN_USE_S):
                    del self._open[name]


@dataclass(frozen=True, eq=False)
class PreparedQuery:
    """A query frame with its signature and, for validation, its geometry.

    Parameters
    ----------
    model_id : id of the model of the signature
    vector : (D,) signature
    geometry : geometry; None if validation is skipped
    origin : robot, session and capture time
    frame : number and id of a stored frame, which the search excludes; None for an upload
    prepare_ms : duration of the preparation, milliseconds
    home : map of the stored frame
    base : name of the base frame of the robot, and T_base_query (4, 4); None if unknown
    artifact : encoded `geometry`
    up : (3,) unit up vector in the sensor frame; None if unknown
    pose : (4, 4) T_parent_sensor of an upload, the odometry of a sequence
    """

    model_id: str
    vector: Bytes
    geometry: Geometry | None
    origin: QueryOrigin
    frame: tuple[int, str] | None
    prepare_ms: float
    home: MapRow | None = None
    base: tuple[str, Floats] | None = None
    artifact: bytes | None = None
    kind: Kind = "depth"
    up: Floats | None = None
    pose: Floats | None = None

    @property
    def name(self) -> FrameName | None:
        """Map and id of a stored frame; None for an upload."""
        if self.frame is None or self.home is None:
            return None
        return FrameName(map=self.home.name, frame_id=self.frame[1])


def prepare_upload(
    data: bytes, meta: FrameMeta, signer: Signer, query: Query, decoders: Decoders
) -> PreparedQuery:
    """Return an uploaded frame as a query, decoded and signed.

    Raises
    ------
    FrameError : See `read_upload`; UselessFrame if the frame has too few surfaces to sign.
    InvalidRequest : See `check_origin` and `read_upload`.
    """
    start = time.perf_counter()
    at = None if meta.captured_at is None else meta.captured_at.timestamp()
    origin = check_origin(QueryOrigin(meta.robot, meta.session, at), query)
    read = read_upload(data, meta, decoders)
    kind, base = read.kind, read.base
    up = None if meta.up is None else np.array(meta.up.unit)
    if "validate" not in query.stages:
        vector = sign(read.frame, signer).vector
        return PreparedQuery(
            signer.model.id, vector, None, origin, None, _since(start), base=base, kind=kind, up=up
        )
    signature, geometry = prepare(read.frame, signer)
    # decode the artifact again: it is rounded, and a stored frame must get the same answer
    artifact = write_geometry(geometry)
    return PreparedQuery(
        signature.model_id, signature.vector, read_geometry(artifact), origin, None, _since(start),
        base=base, artifact=artifact, kind=kind, up=up, pose=read.frame.pose,
    )  # fmt: skip


def prepare_stored(
    store: Store, signers: Signers, map_name: str, frame_id: str, query: Query
) -> PreparedQuery:
    """Return a stored frame as a query; rebuild damaged signatures and artifacts from uploads.

    Raises
    ------
    UnknownMap, UnknownFrame : If the map or the frame does not exist.
    InvalidRequest : If the frame is not indexed; see also `check_origin`.
    DamagedBlob : If the upload is damaged as well.
    """
    start = time.perf_counter()
    with store.database.read() as connection:
        row = find_map(connection, map_name)
        frame = find_frame(connection, row, frame_id)
        try:
            vector = stored_vector(connection, frame.number, row.model_id)
            damaged = False
        except errors.DamagedSignature:
            vector, damaged = b"", True
        blobs = geometry_blobs(connection, [frame.number], row.model_id)
        up = known_ups(connection, [frame.number]).get(frame.number)
    if vector is None or frame.deletion is not None:
        raise errors.InvalidRequest(
            f"Frame {frame_id} is {frame.state}: {frame.state.sentence} Only an indexed frame "
            "can be a query.",
            (("frame_id", f"is {frame.state}"),),
        )
    origin = check_origin(QueryOrigin(frame.robot, frame.session, frame.captured_at), query)
    signature, geometry, artifact, base = np.frombuffer(vector, np.uint8), None, None, None
    if frame.base is not None:
        base = str(frame.base_frame), np.array(frame.base)
    validates = "validate" in query.stages
    if validates and not damaged:
        try:
            artifact = store.blobs.get(blobs[frame.number])
            geometry = read_geometry(artifact)
        except (errors.DamagedBlob, errors.UnreadableGeometry):
            with store.database.read() as connection:
                if not refers_to(connection, blobs[frame.number]):
                    raise errors.UnknownFrame(
                        f"Frame {frame_id} of map {map_name!r} was deleted during the query."
                    ) from None
            damaged = True
    if damaged:
        resign_frames(store, row, [frame.number], row.model_id)
        signature, rebuilt = rebuild_frame(store, signers(row.model_id), frame)
        if validates:
            artifact, geometry = rebuilt, read_geometry(rebuilt)
    own = (frame.number, frame.id)
    return PreparedQuery(
        row.model_id, signature, geometry, origin, own, _since(start), row, base, artifact,
        frame.kind, up,
    )  # fmt: skip


def check_origin(origin: QueryOrigin, query: Query) -> QueryOrigin:
    """Return the origin of a query frame.

    Raise InvalidRequest if the filter has `not_within_s`, but session or time is unknown.
    """
    if query.filter is not None and query.filter.not_within_s is not None:
        missing = [name for name in ("session", "captured_at") if getattr(origin, name) is None]
        if missing:
            raise errors.InvalidRequest(
                "The filter has `not_within_s`, but the query frame has no "
                f"{' and no '.join(missing)}. Send {'both' if missing[1:] else 'it'} in its meta, "
                "or omit `not_within_s`.",
                tuple((name, "needed by filter.not_within_s") for name in missing),
            )
    return origin


def _since(start: float) -> float:
    return 1e3 * (time.perf_counter() - start)


#: Assumed duration of the first validation, seconds; later ones are assumed to take as long as the
#: longest so far.
FIRST_S = 0.03


class Deadline:
    """The time limit of a query.

    Parameters
    ----------
    milliseconds : duration from `since`; None for no limit
    since : time of the request by `time.perf_counter`; None selects the current time
    """

    def __init__(self, milliseconds: int | None, since: float | None = None) -> None:
        self.since = time.perf_counter() if since is None else since
        self._ends = None if milliseconds is None else self.since + milliseconds / 1e3
        self._longest, self._began = FIRST_S, 0.0
        self.reached: bool | None = None if milliseconds is None else False

    def allows(self) -> bool:
        """Return whether the next validation will probably end in time; call this before each."""
        if self._ends is None:
            return True
        now = time.perf_counter()
        if self._began:
            self._longest = max(self._longest, now - self._began)
        self._began = now
        self.reached = now + self._longest > self._ends
        return not self.reached


@dataclass(frozen=True, eq=False)
class SearchedMap:
    """A queried map: its row, and a view of its signatures."""

    row: MapRow
    view: IndexView


@dataclass(frozen=True, eq=False)
class MapSearch:
    """The search of one map.

    Parameters
    ----------
    dead : frame numbers to exclude: deleted frames, and the queried frame
    among : frame numbers that pass the filter; None if there is no filter
    size : number of searchable frames
    """

    place: SearchedMap
    dead: frozenset[int]
    among: Keys | None
    size: int

    @property
    def passed(self) -> int:
        """Number of frames that pass the filter."""
        return self.size if self.among is None else len(self.among)


@dataclass(frozen=True, eq=False)
class Searched:
    """Ranking R and the searches that yielded it.

    Parameters
    ----------
    hits : results of `parts`
    ranking : R, of frame numbers
    owners : (r,) index into `parts` for each frame of R
    size : requested length of R
    """

    parts: tuple[MapSearch, ...]
    hits: tuple[SearchHits, ...]
    ranking: Ranking
    owners: NDArray[np.intp]
    size: int

    @property
    def exact(self) -> bool:
        """Return whether all frames that pass the filter were compared."""
        return all(hit.exact for hit in self.hits)

    def signatures(self) -> Bytes:
        """Return the signatures (r, D) of the frames of R."""
        keys = self.ranking.indices.astype(np.int64)
        first = self.parts[0].place.view
        if len(self.parts) == 1 or not len(keys):
            return first.signatures(keys)
        order = np.argsort(self.owners, kind="stable")
        edges = np.searchsorted(self.owners[order], np.arange(len(self.parts) + 1))
        blocks: list[Bytes] = [
            self.parts[i].place.view.signatures(keys[order[a:b]])
            for i, (a, b) in enumerate(pairwise(edges.tolist()))
            if a < b
        ]
        rows = np.empty((len(keys), blocks[0].shape[1]), np.uint8)
        rows[order] = np.concatenate(blocks)
        return rows


def search_maps(
    store: Store, places: Sequence[SearchedMap], prepared: PreparedQuery, query: Query, model: Model
) -> Searched:
    """Return the ranking of the nearest frames of all maps.

    Parameters
    ----------
    places : one or more maps of one model
    prepared, query : frame and options of the query
    """
    parts = tuple(_part(store, place, prepared, query) for place in places)
    size = ranking_size(sum(part.passed for part in parts))
    hits = tuple(
        part.place.view.search(
            prepared.vector, size, dead=part.dead, among=part.among, exact=query.exact
        )
        for part in parts
    )
    keys = np.concatenate([hit.keys for hit in hits])
    all_distances = np.concatenate([hit.distances for hit in hits])
    owners = np.repeat(np.arange(len(parts)), [len(hit) for hit in hits])
    first = np.lexsort((keys, all_distances))[:size]  # sort ties in upload order
    distances = all_distances[first]
    shares = similarity(distances, model.unrelated_distance)
    return Searched(parts, hits, Ranking(keys[first].astype(np.intp), distances, shares),
                    owners[first], size)  # fmt: skip


def rank_among_all(searched: Searched, prepared: PreparedQuery, number: int, distance: int) -> int:
    """Return the exact rank, from 1, of a frame at `distance` among all frames that pass the
    filter.
    """
    return 1 + sum(
        part.place.view.nearer(prepared.vector, number, distance, dead=part.dead, among=part.among)
        for part in searched.parts
    )


def _part(store: Store, place: SearchedMap, prepared: PreparedQuery, query: Query) -> MapSearch:
    view, own = place.view, prepared.frame
    dead = view.dead if own is None else view.dead | {own[0]}
    itself = prepared.home is not None and prepared.home.number == place.row.number
    size = max(view.size - itself, 0)
    among = None
    if query.filter is not None:
        among = _among(store, place, dead, prepared, query.filter)
    return MapSearch(place, dead, among, size)


def _among(
    store: Store, place: SearchedMap, dead: frozenset[int], prepared: PreparedQuery, filters: Filter
) -> Keys:
    """Return the frame numbers in a view that pass a filter, except `dead`."""
    view = place.view
    with store.database.read() as connection:
        numbers = passing_frames(connection, place.row.number, filters, prepared.origin)
    return numbers[view.has(numbers) & ~np.isin(numbers, list(dead))]
