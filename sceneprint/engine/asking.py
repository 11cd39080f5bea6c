"""A query made ready: its signature and, for validation, its geometry.

upload | frame of the map  --ask_upload | ask_stored-->  Asked
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from sceneprint.artifacts import read_geometry, write_geometry
from sceneprint.engine.frames import read_upload
from sceneprint.errors import DamagedBlob, InvalidRequest, UnknownFrame
from sceneprint.pipeline import Signer, prepare, sign
from sceneprint.schemas import FrameMeta, Query
from sceneprint.store import Store
from sceneprint.store.frames import find_frame, refers_to
from sceneprint.store.maps import find_map
from sceneprint.store.signatures import geometry_blobs, stored_vector
from sceneprint.types import Bytes, Geometry


@dataclass(frozen=True, eq=False)
class Asked:
    """A query made ready.

    Parameters
    ----------
    vector : (D,) its signature
    geometry : its artifact; None where validation was not asked for
    frame : its number and id, if it is one of the map: it does not find itself
    prepare_ms : what making it ready took
    """

    vector: Bytes
    geometry: Geometry | None
    frame: tuple[int, str] | None
    prepare_ms: float


def ask_upload(data: bytes, meta: FrameMeta, signer: Signer, query: Query) -> Asked:
    """Make an uploaded frame ready.

    Raises
    ------
    FrameError : see `read_upload`; UselessFrame where nothing in it can be signed.
    """
    start = time.perf_counter()
    frame = read_upload(data, meta)
    if "validate" not in query.stages:
        return Asked(sign(frame, signer).vector, None, None, _since(start))
    signature, seen = prepare(frame, signer)
    # as it would be read back: the same answer as when the frame is in the map
    geometry = read_geometry(write_geometry(seen))
    return Asked(signature.vector, geometry, None, _since(start))


def ask_stored(store: Store, map_name: str, frame_id: str, query: Query) -> Asked:
    """Make a frame of the map ready.

    Raises
    ------
    UnknownMap, UnknownFrame : there is none.
    InvalidRequest : the frame has no signature, or not yet.
    DamagedBlob, UnreadableGeometry : its artifact was damaged.
    """
    start = time.perf_counter()
    with store.database.read() as connection:
        row = find_map(connection, map_name)
        frame = find_frame(connection, row, frame_id)
        vector = stored_vector(connection, frame.number, row.model_id)
        blobs = geometry_blobs(connection, [frame.number], row.model_id)
    if vector is None:
        raise InvalidRequest(
            f"Frame {frame_id} is {frame.state}: {frame.state.sentence} It can be asked for "
            "while it is indexed.",
            (("frame_id", f"is {frame.state}"),),
        )
    geometry = None
    if "validate" in query.stages:
        try:
            geometry = read_geometry(store.blobs.get(blobs[frame.number]))
        except DamagedBlob:
            with store.database.read() as connection:
                if not refers_to(connection, blobs[frame.number]):
                    raise UnknownFrame(
                        f"Frame {frame_id} of map {map_name!r} was deleted while it was asked for."
                    ) from None
            raise
    own = (frame.number, frame.id)
    return Asked(np.frombuffer(vector, np.uint8), geometry, own, _since(start))


def _since(start: float) -> float:
    return 1e3 * (time.perf_counter() - start)
