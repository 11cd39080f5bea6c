"""A query made ready: its signature and, for validation, its geometry.

upload | frame of the map  --ask_upload | ask_stored-->  Asked
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from sceneprint.artifacts import read_geometry, write_geometry
from sceneprint.engine.frames import read_upload
from sceneprint.engine.healing import sign_again
from sceneprint.errors import (
    DamagedBlob,
    DamagedSignature,
    InvalidRequest,
    UnknownFrame,
    UnreadableGeometry,
)
from sceneprint.pipeline import Signer, prepare, sign
from sceneprint.schemas import FrameMeta, Query
from sceneprint.schemas.frames import Kind
from sceneprint.store import Store
from sceneprint.store.filters import Taken
from sceneprint.store.frames import find_frame, refers_to
from sceneprint.store.maps import find_map
from sceneprint.store.records import MapRow
from sceneprint.store.signatures import geometry_blobs, stored_vector
from sceneprint.types import Bytes, Floats, Geometry


@dataclass(frozen=True, eq=False)
class Asked:
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
    """

    model_id: str
    vector: Bytes
    geometry: Geometry | None
    taken: Taken
    frame: tuple[int, str] | None
    prepare_ms: float
    home: MapRow | None = None
    base: tuple[str, Floats] | None = None
    artifact: bytes | None = None
    kind: Kind = "depth"


def ask_upload(data: bytes, meta: FrameMeta, signer: Signer, query: Query) -> Asked:
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
    taken = check_taken(Taken(meta.robot, meta.session, at), query)
    read = read_upload(data, meta)
    kind, base = read.kind, read.base
    if "validate" not in query.stages:
        vector = sign(read.frame, signer).vector
        return Asked(
            signer.model.id, vector, None, taken, None, _since(start), base=base, kind=kind
        )
    signature, seen = prepare(read.frame, signer)
    # as it would be read back: the same answer as when the frame is in the map
    artifact = write_geometry(seen)
    return Asked(
        signature.model_id, signature.vector, read_geometry(artifact), taken, None, _since(start),
        base=base, artifact=artifact, kind=kind,
    )  # fmt: skip


def ask_stored(store: Store, map_name: str, frame_id: str, query: Query) -> Asked:
    """Make a frame of the map ready.

    Raises
    ------
    UnknownMap, UnknownFrame : there is none.
    InvalidRequest : the frame has no signature, or not yet; or the filter asks for distance from
        its session, and it has none, or no time.
    DamagedSignature, DamagedBlob, UnreadableGeometry : what was made of it is damaged; it is made
        again.
    """
    start = time.perf_counter()
    try:
        with store.queried.read() as connection:
            row = find_map(connection, map_name)
            frame = find_frame(connection, row, frame_id)
            vector = stored_vector(connection, frame.number, row.model_id)
            blobs = geometry_blobs(connection, [frame.number], row.model_id)
    except DamagedSignature:
        sign_again(store, row, [frame.number], row.model_id)
        raise
    if vector is None:
        raise InvalidRequest(
            f"Frame {frame_id} is {frame.state}: {frame.state.sentence} It can be asked for "
            "while it is indexed.",
            (("frame_id", f"is {frame.state}"),),
        )
    taken = check_taken(Taken(frame.robot, frame.session, frame.captured_at), query)
    geometry = artifact = base = None
    if frame.base is not None:
        base = str(frame.base_frame), np.array(frame.base)
    if "validate" in query.stages:
        try:
            artifact = store.blobs.get(blobs[frame.number])
            geometry = read_geometry(artifact)
        except (DamagedBlob, UnreadableGeometry):
            with store.queried.read() as connection:
                if not refers_to(connection, blobs[frame.number]):
                    raise UnknownFrame(
                        f"Frame {frame_id} of map {map_name!r} was deleted while it was asked for."
                    ) from None
            sign_again(store, row, [frame.number], row.model_id)
            raise
    own = (frame.number, frame.id)
    asked = np.frombuffer(vector, np.uint8)
    return Asked(
        row.model_id, asked, geometry, taken, own, _since(start), row, base, artifact, frame.kind
    )


def check_taken(taken: Taken, query: Query) -> Taken:
    """What is known of a query, if it is enough for the filter."""
    if query.filter is not None and query.filter.not_within_s is not None:
        missing = [name for name in ("session", "captured_at") if getattr(taken, name) is None]
        if missing:
            raise InvalidRequest(
                f"The filter has `not_within_s`, and the query frame has no "
                f"{' and no '.join(missing)}: there is nothing to keep away from. Send the frame "
                "with both in its meta, or leave `not_within_s` out.",
                tuple((name, "needed by filter.not_within_s") for name in missing),
            )
    return taken


def _since(start: float) -> float:
    return 1e3 * (time.perf_counter() - start)
