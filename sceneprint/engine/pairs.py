"""A query that is kept and one of its matches, looked at again.

query id, frame id  --Pairs-->  Pair  --opened-->  both geometries  --validated-->  Validation

A match is validated once more, with the seed and the options of the query: the same answer. A page
asks for several views of one match at once, so the last few validations are remembered.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass

from sceneprint.artifacts import read_geometry
from sceneprint.engine.healing import sign_again
from sceneprint.engine.kept import Kept, KeptQueries
from sceneprint.engine.signers import Signers
from sceneprint.engine.validating import thresholds
from sceneprint.engine.wire import sensor_of
from sceneprint.errors import DamagedBlob, NotIndexed, UnknownFrame, UnreadableGeometry
from sceneprint.geometry.validation import Validation, ValidationParameters
from sceneprint.pipeline import validate
from sceneprint.schemas import FrameState
from sceneprint.schemas import Match as ToldMatch
from sceneprint.store import Store
from sceneprint.store.frames import find_frame, refers_to
from sceneprint.store.maps import find_map
from sceneprint.store.records import MapRow
from sceneprint.store.signatures import geometry_blobs
from sceneprint.types import Geometry

#: Validations that are remembered: some 1 kB each.
_REMEMBERED = 64


@dataclass(frozen=True, eq=False)
class Pair:
    """A kept query and one of its matches.

    Parameters
    ----------
    kept, match : the answer, and the match of it
    sensor : what the coordinates of the match are called
    blob : of the match's geometry artifact
    row, number : the match's map and number
    """

    kept: Kept
    match: ToldMatch
    sensor: str
    blob: str
    row: MapRow
    number: int


class Pairs:
    """Matches of answers that are kept.

    Parameters
    ----------
    store, signers : of the engine
    kept : the answers
    """

    def __init__(self, store: Store, signers: Signers, kept: KeptQueries) -> None:
        self._store, self._signers, self._kept = store, signers, kept
        self._remembered = _Remembered()

    def find(self, query_id: str, frame_id: str, map_name: str | None = None) -> Pair:
        """A query with one of its matches, while that is still the frame that was matched.

        Raises
        ------
        UnknownQuery : it is not kept, or no longer.
        UnknownMap, UnknownFrame : no match has that id, or it was deleted since.
        NotIndexed : the query was asked without validation, or the map has changed its model.
        """
        kept = self._kept.find(query_id)
        match = _match_of(kept, frame_id, map_name)
        check_geometry(kept)
        with self._store.database.read() as connection:
            row = find_map(connection, match.map)
            frame = find_frame(connection, row, match.frame_id)
            blobs = geometry_blobs(connection, [frame.number], kept.model_id)
        if frame.state == FrameState.DELETED or frame.number not in kept.ranked:
            raise _deleted(match)
        if frame.number not in blobs:
            raise NotIndexed(
                f"Map {match.map!r} has changed its model since the query, and a frame of one "
                "model cannot be compared with one of another. Ask again."
            )
        return Pair(kept, match, sensor_of(frame), blobs[frame.number], row, frame.number)

    def opened(self, pair: Pair) -> tuple[Geometry, Geometry]:
        """The artifacts of the query and of the match.

        Raises
        ------
        DamagedBlob, UnreadableGeometry : the match's is damaged; it is made again.
        UnknownFrame : the match was deleted meanwhile.
        """
        query = geometry_of_query(pair.kept)
        try:
            return query, read_geometry(self._store.blobs.get(pair.blob))
        except (DamagedBlob, UnreadableGeometry):
            with self._store.database.read() as connection:
                if not refers_to(connection, pair.blob):
                    raise _deleted(pair.match) from None
            if pair.row.model_id == pair.kept.model_id:
                sign_again(self._store, pair.row, [pair.number], pair.row.model_id)
            raise

    def parameters(self, pair: Pair) -> ValidationParameters:
        """Those of the model, by which evidence is counted."""
        return self._signers(pair.kept.model_id).model.parameters.validation

    def validated(self, pair: Pair, query: Geometry, match: Geometry) -> Validation:
        """What comes of aligning them, as the query had it."""
        p = self.parameters(pair)
        seed, options = pair.kept.query.seed, thresholds(pair.kept.query.validation, p)
        key = pair.kept.answer.query_id, pair.blob
        return self._remembered.get(key, lambda: validate(query, match, seed, *options))


class _Remembered:
    """The last few validations; who asks while one is made waits for it."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._made: OrderedDict[tuple[str, str], Future[Validation]] = OrderedDict()

    def get(self, key: tuple[str, str], make: Callable[[], Validation]) -> Validation:
        with self._lock:
            found = self._made.get(key)
            mine = found is None
            if found is None:
                found = self._made[key] = Future()
            self._made.move_to_end(key)
            while len(self._made) > _REMEMBERED:
                self._made.popitem(last=False)
        if mine:
            try:
                found.set_result(make())
            except BaseException as error:
                with self._lock:
                    self._made.pop(key, None)
                found.set_exception(error)
        return found.result()


def check_geometry(kept: Kept) -> bytes:
    """The bytes of a query's artifact; NotIndexed where it was asked without validation."""
    if kept.geometry is None:
        raise NotIndexed(
            f"Query {kept.answer.query_id} was asked without validation, so its points were not "
            "kept. Ask again with the stage `validate`."
        )
    return kept.geometry


def geometry_of_query(kept: Kept) -> Geometry:
    """A query's artifact; NotIndexed where it was asked without validation."""
    return read_geometry(check_geometry(kept))


def _deleted(match: ToldMatch) -> UnknownFrame:
    return UnknownFrame(
        f"Frame {match.frame_id} of map {match.map!r} was deleted since it was matched."
    )


def _match_of(kept: Kept, frame_id: str, map_name: str | None) -> ToldMatch:
    for one in kept.answer.matches:
        if one.frame_id == frame_id and map_name in (None, one.map):
            return one
    raise UnknownFrame(
        f"Query {kept.answer.query_id} has no match {frame_id!r:.80}"
        f"{'' if map_name is None else f' in map {map_name!r:.80}'}. Its answer lists them."
    )
