"""Whether a map has the place of a frame already, as `if_novel` of an upload asks.

signature  --look-->  Look, as of a revision  --judge, in the commit-->  Near, or None to keep it

The search holds no lock. What was indexed between it and the commit is compared in the commit,
so that of two frames of one place that are signed at once only one is kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from sqlalchemy import Connection

from sceneprint.engine.search.local_index import Readers
from sceneprint.errors import LostLease, UnknownMap
from sceneprint.geometry.retrieval.distance import Metric, distance_share, distances
from sceneprint.models import Model
from sceneprint.store import Database
from sceneprint.store.frames import frame_of
from sceneprint.store.maps import find_map, map_of
from sceneprint.store.signatures import StoredSignature, changes_since
from sceneprint.store.tables import FrameRow, MapRow
from sceneprint.types import Bytes


@dataclass(frozen=True)
class NearestFrame:
    """The indexed frame nearest to another; `distance` is of their signatures."""

    number: int
    distance: int


@dataclass(frozen=True)
class Look:
    """The nearest frame of a map as of one revision; None in an empty map."""

    revision: int
    nearest: NearestFrame | None


class Stale(Exception):
    """The nearest frame was deleted since the look, and nobody knows the next one."""


def look(database: Database, readers: Readers, row: MapRow, made: StoredSignature) -> Look | None:
    """Search a map for the nearest frame.

    Parameters
    ----------
    database, readers : see there
    row : of the map, as it was
    made : of the frame

    Returns
    -------
    look : None where the map has come to have another model: nothing can be compared

    Raises
    ------
    LostLease : the map is gone, and the job with it.
    """
    with database.read() as connection:
        try:
            now = find_map(connection, row.name)
        except UnknownMap as error:
            raise LostLease(str(error)) from error
        if now.number != row.number or now.model_id != made.model_id:
            return None
        (view,) = readers.views(connection, database, [now])
    hits = view.search(_vector(made), 1, dead=view.dead)
    if len(hits) == 0:
        return Look(view.revision, None)
    return Look(view.revision, NearestFrame(int(hits.keys[0]), int(hits.distances[0])))


def judge(
    connection: Connection, frame: FrameRow, made: StoredSignature, seen: Look | None, model: Model
) -> str | None:
    """Why a frame is not kept, in the transaction that would index it; None where it is.

    Parameters
    ----------
    connection : of a writing transaction
    frame : as it was claimed
    made : of it
    seen : by `look`
    model : of the signature

    Raises
    ------
    Stale : look again.
    """
    novelty = frame_of(connection, frame.number).novelty  # another upload may have loosened it
    row = map_of(connection, frame.map_number)
    if novelty is None or seen is None or row.model_id != made.model_id:
        return None
    nearest = _nearest_now(connection, row, _vector(made), seen, model.metric)
    if nearest is None:
        return None
    apart = np.array(nearest.distance)
    share = float(distance_share(apart, model.unrelated_distance, model.metric))
    if share > novelty:
        return None
    there = frame_of(connection, nearest.number).id
    return (
        f"the map already has this place: frame {there} is at {share:.3f} of the distance of "
        f"unrelated frames (required: more than {novelty:g})"
    )


def _nearest_now(
    connection: Connection, row: MapRow, vector: Bytes, seen: Look, metric: Metric
) -> NearestFrame | None:
    nearest = seen.nearest
    for block in changes_since(connection, row, seen.revision):
        for change in block:
            if nearest is not None and change.number == nearest.number:
                raise Stale
            if change.vector is not None:
                stored = np.frombuffer(change.vector, np.uint8)
                distance = int(distances(vector, stored[None], metric)[0])
                if nearest is None or distance < nearest.distance:
                    nearest = NearestFrame(change.number, distance)
    return nearest


def _vector(made: StoredSignature) -> Bytes:
    return np.frombuffer(made.vector, np.uint8)
