"""A query to R, one ranking over all maps that are asked: Sec. III-C.

maps as of now  --Readers.view-->  IndexViews  --search_maps-->  Searched
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
from sceneprint.index import SearchHits
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

# The readers of all maps.

#: Memory of all tails above which maps that were not asked for long are forgotten.
HELD_BYTES = 1 << 30
#: Seconds between two looks for maps that are held and no longer there.
_TIDY_S = 10.0


class Readers:
    """The readers of all queried maps, whose indexes `place` has."""

    def __init__(self, signers: Signers, place: IndexPlace) -> None:
        self._signers, self._place = signers, place
        self._database, self._history = signers.database, signers.database.history
        self._lock = threading.Lock()
        self._open: OrderedDict[str, tuple[tuple[int, str], Reader]] = OrderedDict()
        self._tidied = time.monotonic()

    def view(self, connection: Connection, row: MapRow) -> IndexView:
        """A map as of the row's revision, or later, on this node."""
        reader = self._reader(connection, row)
        if time.monotonic() - self._tidied >= _TIDY_S:
            self.tidy(connection)
        return reader.view(connection, row)

    def _reader(self, connection: Connection, row: MapRow) -> Reader:
        with self._lock:
            if self._history != self._database.history:  # revisions may be of other frames now
                self._history = self._database.history
                self._open.clear()
            held, reader = self._open.get(row.name, (None, None))
            wanted = (row.number, row.model_id)
            if reader is None or held != wanted:  # made anew, or signed with another model
                model = self._signers(row.model_id).model
                reader = Reader(connection, row, self._place.folder(row), model)
                self._open[row.name] = (wanted, reader)
            self._open.move_to_end(row.name)
            # the one that was asked longest ago first, and never the one that is asked now
            held_bytes = sum(one.bytes_held for _, one in self._open.values())
            while len(self._open) > 1 and held_bytes > HELD_BYTES:
                _, (_, oldest) = self._open.popitem(last=False)
                held_bytes -= oldest.bytes_held
        if self._place.is_shared and self._signers(row.model_id).model.metric == "l2":
            self._place.want(row, reader.version)
        return reader

    def forget(self, name: str) -> None:
        """Give up what is held of a map that was deleted."""
        with self._lock:
            self._open.pop(name, None)

    def purge(self, connection: Connection) -> None:
        """Hold nothing of deleted frames any more, beyond what the newest indexes have of them."""
        self.tidy(connection)
        with self._lock:
            held = list(self._open.items())
        rows = {row.name: row for row in list_maps(connection)}
        for name, (wanted, reader) in held:
            row = rows.get(name)
            if row is not None and (row.number, row.model_id) == wanted:
                reader.purge(connection, row)

    def tidy(self, connection: Connection) -> None:
        """Give up what is held of maps that another process deleted, or gave another model.

        Their files are gone, but take room on the disk and a descriptor each while mapped.
        """
        asked = select(maps.c.name, maps.c.number, maps.c.model_id)
        there = {row.name: (row.number, row.model_id) for row in connection.execute(asked)}
        with self._lock:
            self._tidied = time.monotonic()
            for name in [name for name, (held, _) in self._open.items() if there.get(name) != held]:
                del self._open[name]
            for name, (_, reader) in list(self._open.items()) if self._place.is_shared else ():
                if reader.lost_index(IN_USE_S):  # to make room; its files take it while mapped
                    del self._open[name]


# A query made ready: its signature and, for validation, its geometry.
#
# upload | frame of the map  --prepare_upload | prepare_stored-->  PreparedQuery


@dataclass(frozen=True, eq=False)
class PreparedQuery:
    """A query made ready.

    Parameters
    ----------
    model_id : of the model that signed it
    vector : (D,) its signature
    geometry : its artifact; None where validation was not asked for
    taken : by whom, in which run and when
    frame : its number and id, if it is one of the map: it does not find itself
    prepare_ms : what making it ready took
    home : the map that frame is in
    base : what the robot's base is called, and T_base_query (4, 4); None where it is not known
    artifact : `geometry` as bytes
    kind : of the frame
    up : (3,) unit vector in its sensor; None where it is not known
    pose : (4, 4) T_parent_sensor that came with an upload, of a sequence's odometry
    """

    model_id: str
    vector: Bytes
    geometry: Geometry | None
    taken: QueryOrigin
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
        """Map and id of the frame, if it is one of the map."""
        if self.frame is None or self.home is None:
            return None
        return FrameName(map=self.home.name, frame_id=self.frame[1])


def prepare_upload(
    data: bytes, meta: FrameMeta, signer: Signer, query: Query, decoders: Decoders
) -> PreparedQuery:
    """Make an uploaded frame ready.

    Raises
    ------
    FrameError : see `read_upload`; UselessFrame where nothing in it can be signed; InvalidPose
        where T_base_sensor is none.
    InvalidRequest : the filter asks for distance from its session, and `meta` lacks it or a time;
        or see `read_upload`.
    """
    start = time.perf_counter()
    at = None if meta.captured_at is None else meta.captured_at.timestamp()
    taken = check_taken(QueryOrigin(meta.robot, meta.session, at), query)
    read = read_upload(data, meta, decoders)
    kind, base = read.kind, read.base
    up = None if meta.up is None else np.array(meta.up.unit)
    if "validate" not in query.stages:
        vector = sign(read.frame, signer).vector
        return PreparedQuery(
            signer.model.id, vector, None, taken, None, _since(start), base=base, kind=kind, up=up
        )
    signature, seen = prepare(read.frame, signer)
    # as it would be read back: the same answer as when the frame is in the map
    artifact = write_geometry(seen)
    return PreparedQuery(
        signature.model_id, signature.vector, read_geometry(artifact), taken, None, _since(start),
        base=base, artifact=artifact, kind=kind, up=up, pose=read.frame.pose,
    )  # fmt: skip


def prepare_stored(
    store: Store, signers: Signers, map_name: str, frame_id: str, query: Query
) -> PreparedQuery:
    """Make a frame of the map ready; what is damaged of it is made again from its upload.

    Raises
    ------
    UnknownMap, UnknownFrame : there is none.
    InvalidRequest : the frame has no signature, or not yet; or the filter asks for distance from
        its session, and it has none, or no time.
    DamagedBlob : what was made of it is damaged, and its upload too.
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
    taken = check_taken(QueryOrigin(frame.robot, frame.session, frame.captured_at), query)
    asked, geometry, artifact, base = np.frombuffer(vector, np.uint8), None, None, None
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
        asked, made = rebuild_frame(store, signers(row.model_id), frame)
        if validates:
            artifact, geometry = made, read_geometry(made)
    own = (frame.number, frame.id)
    return PreparedQuery(
        row.model_id, asked, geometry, taken, own, _since(start), row, base, artifact, frame.kind,
        up,
    )  # fmt: skip


def check_taken(taken: QueryOrigin, query: Query) -> QueryOrigin:
    """What is known of a query, if it is enough for the filter."""
    if query.filter is not None and query.filter.not_within_s is not None:
        missing = [name for name in ("session", "captured_at") if getattr(taken, name) is None]
        if missing:
            raise errors.InvalidRequest(
                "The filter has `not_within_s`, but the query frame has no "
                f"{' and no '.join(missing)}. Send the frame with both in its meta, or leave "
                "`not_within_s` out.",
                tuple((name, "needed by filter.not_within_s") for name in missing),
            )
    return taken


def _since(start: float) -> float:
    return 1e3 * (time.perf_counter() - start)


# When a query must be answered, and whether there is time for one more candidate.

#: Seconds that the first candidate is expected to take; the next ones, as long as the longest.
FIRST_S = 0.03


class Deadline:
    """A point in time after which nothing more is begun.

    Parameters
    ----------
    milliseconds : after `since`; None for no deadline
    since : when the request came, by `time.perf_counter`; default: now
    """

    def __init__(self, milliseconds: int | None, since: float | None = None) -> None:
        self.since = time.perf_counter() if since is None else since
        self._ends = None if milliseconds is None else self.since + milliseconds / 1e3
        self._longest, self._began = FIRST_S, 0.0
        self.reached: bool | None = None if milliseconds is None else False

    def allows(self) -> bool:
        """Whether one more candidate would likely be over in time; ask before each."""
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
    """A map that is asked: its row, and its frames as of one revision."""

    row: MapRow
    view: IndexView


@dataclass(frozen=True, eq=False)
class MapSearch:
    """What is searched of one map.

    Parameters
    ----------
    dead : frames that may not be found: deleted ones, and the query itself
    among : frames that pass the filter; None without one
    size : frames that can be found
    """

    place: SearchedMap
    dead: frozenset[int]
    among: Keys | None
    size: int

    @property
    def passed(self) -> int:
        """How many pass the filter; all without one."""
        return self.size if self.among is None else len(self.among)


@dataclass(frozen=True, eq=False)
class Searched:
    """R, and where it is from.

    Parameters
    ----------
    parts : of each map
    hits : of each map, in the same order
    ranking : R, of frame numbers
    owners : (r,) which part each of R is of
    size : that R was to have
    """

    parts: tuple[MapSearch, ...]
    hits: tuple[SearchHits, ...]
    ranking: Ranking
    owners: NDArray[np.intp]
    size: int

    @property
    def exact(self) -> bool:
        """Every frame that passes was compared."""
        return all(one.exact for one in self.hits)

    def signatures(self) -> Bytes:
        """Stored signatures (r, D) of R."""
        keys = self.ranking.indices.astype(np.int64)
        first = self.parts[0].place.view
        if len(self.parts) == 1 or not len(keys):
            return first.signatures(keys)
        order = np.argsort(self.owners, kind="stable")
        edges = np.searchsorted(self.owners[order], np.arange(len(self.parts) + 1))
        found: list[Bytes] = [
            self.parts[i].place.view.signatures(keys[order[a:b]])
            for i, (a, b) in enumerate(pairwise(edges.tolist()))
            if a < b
        ]
        rows = np.empty((len(keys), found[0].shape[1]), np.uint8)
        rows[order] = np.concatenate(found)
        return rows


def search_maps(
    store: Store, places: Sequence[SearchedMap], asked: PreparedQuery, query: Query, model: Model
) -> Searched:
    """The frames of all maps that are nearest to a query.

    Parameters
    ----------
    places : the maps, one or more of one model
    asked, query : what is sought, and how
    model : of all of them
    """
    parts = tuple(_part(store, place, asked, query) for place in places)
    size = ranking_size(sum(part.passed for part in parts))
    hits = tuple(
        part.place.view.search(
            asked.vector, size, dead=part.dead, among=part.among, exact=query.exact
        )
        for part in parts
    )
    keys = np.concatenate([one.keys for one in hits])
    found = np.concatenate([one.distances for one in hits])
    owners = np.repeat(np.arange(len(parts)), [len(one) for one in hits])
    first = np.lexsort((keys, found))[:size]  # equal distances in the order in which frames came
    distances = found[first]
    shares = similarity(distances, model.unrelated_distance)
    return Searched(parts, hits, Ranking(keys[first].astype(np.intp), distances, shares),
                    owners[first], size)  # fmt: skip


def rank_among_all(searched: Searched, asked: PreparedQuery, number: int, distance: int) -> int:
    """The rank, from 1, of a distance among all frames that pass, each compared exactly."""
    return 1 + sum(
        part.place.view.nearer(asked.vector, number, distance, dead=part.dead, among=part.among)
        for part in searched.parts
    )


def _part(store: Store, place: SearchedMap, asked: PreparedQuery, query: Query) -> MapSearch:
    view, own = place.view, asked.frame
    dead = view.dead if own is None else view.dead | {own[0]}
    itself = asked.home is not None and asked.home.number == place.row.number
    size = max(view.size - itself, 0)  # it may just have been deleted
    among = None
    if query.filter is not None:
        among = _among(store, place, dead, asked, query.filter)
    return MapSearch(place, dead, among, size)


def _among(
    store: Store, place: SearchedMap, dead: frozenset[int], asked: PreparedQuery, wanted: Filter
) -> Keys:
    """Frames of a view that pass a filter; the database may be newer or older than the view."""
    view = place.view
    with store.database.read() as connection:
        numbers = passing_frames(connection, place.row.number, wanted, asked.taken)
    return numbers[view.has(numbers) & ~np.isin(numbers, list(dead))]
