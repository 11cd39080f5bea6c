"""Two frames compared: their signatures, and whether they see one place.

frame, frame  --compare-->  Similarity
"""

from __future__ import annotations

import time
from collections.abc import Sequence

from sceneprint.engine.asking import Asked, ask_stored, ask_upload
from sceneprint.engine.signers import Signers
from sceneprint.engine.switches import check_model, steadily
from sceneprint.engine.telling import tell_uncertainty, tell_validation
from sceneprint.engine.transforms import transform
from sceneprint.engine.validating import thresholds
from sceneprint.engine.wire import model_label, sensor_frame
from sceneprint.errors import InvalidRequest
from sceneprint.geometry.covariance import PAIR_METHOD
from sceneprint.geometry.retrieval import distances, similarity
from sceneprint.models import PRESETS, read_model
from sceneprint.pipeline import Signer, validate
from sceneprint.schemas import Comparison, FrameMeta, FrameName, NamedFrame, Query, Similarity
from sceneprint.store import Store
from sceneprint.store.maps import model_names
from sceneprint.store.records import MapRow
from sceneprint.store.replica import asked

#: A frame that is stored, or sent: its bytes and what is known of it.
Side = NamedFrame | tuple[bytes, FrameMeta]


def compare(store: Store, signers: Signers, a: Side, b: Side, how: Comparison) -> Similarity:
    """Compare two frames; neither is kept.

    Parameters
    ----------
    store, signers : of the engine
    a, b : the frames
    how : whether they are aligned, and with what; the frames it names are `a` and `b`

    Raises
    ------
    UnknownMap, UnknownFrame : there is none.
    FrameError : an upload that cannot be used.
    InvalidRequest : a stored frame is not indexed, or the models differ.
    """
    sides = (a, b)
    stages = ("retrieve", "validate") if how.aligned else ("retrieve",)
    query = Query.model_validate({"stages": stages})

    def ask(rows: list[MapRow]) -> Similarity:
        signer = _signer(store, signers, rows, how)
        ready = []
        for side in sides:
            if isinstance(side, NamedFrame):
                ready.append(ask_stored(store, side.map, side.frame_id, query))
            else:
                ready.append(ask_upload(*side, signer, query))
        check_model(ready[0].model_id, ready[1].model_id)
        return _compared(ready[0], ready[1], signer, how)

    names = [side.map for side in sides if isinstance(side, NamedFrame)]
    maps = list(dict.fromkeys(names))
    return asked(store.replica, lambda: steadily(store, maps, ask))


def _compared(a: Asked, b: Asked, signer: Signer, how: Comparison) -> Similarity:
    start = time.perf_counter()
    distance = distances(a.vector, b.vector[None], signer.model.metric)
    made, T, p = None, None, signer.model.parameters.validation
    if a.geometry is not None and b.geometry is not None:
        found = validate(b.geometry, a.geometry, how.seed, *thresholds(how.validation, p))
        made, T = found, found.T_match_query
    spent = {
        "prepare": round(a.prepare_ms + b.prepare_ms, 2),
        "validate": round(1e3 * (time.perf_counter() - start), 2),
    }
    return Similarity(
        distance=int(distance[0]),
        similarity=float(similarity(distance, signer.model.unrelated_distance)[0]),
        model=signer.model.label,
        a=_name(a),
        b=_name(b),
        validation=None if made is None else tell_validation(made),
        uncertainty=(
            None if made is None else tell_uncertainty(made.covariance, PAIR_METHOD, p.covariance)
        ),
        transform=None if T is None else transform(T, *_cameras(a, b)),
        seed=how.seed,
        milliseconds={**spent, "total": round(sum(spent.values()), 2)},
    )


def _signer(store: Store, signers: Signers, rows: Sequence[MapRow], how: Comparison) -> Signer:
    """What signs the uploads: with the model of the stored frames, if there are any."""
    if not rows:
        return signers.of(read_model(how.model or PRESETS[0]))
    with store.queried.read() as connection:
        names = model_names(connection)
    told = [f"{row.name} has {model_label(names[row.model_id], row.model_id)}" for row in rows]
    if len({row.model_id for row in rows}) > 1:
        raise InvalidRequest(
            f"Frames of two models cannot be compared: map {' and map '.join(told)}. Compare "
            "frames of maps with one model, or send one of them as an upload.",
            (("frame_a", told[0]), ("frame_b", told[1])),
        )
    if how.model is not None and read_model(how.model).id != rows[0].model_id:
        raise InvalidRequest(
            f"The stored frame is signed with another model than {how.model!r}: map {told[0]}. "
            "Leave `model` out.",
            (("model", f"map {told[0]}"),),
        )
    return signers(rows[0].model_id)


def _name(asked: Asked) -> FrameName | None:
    if asked.frame is None or asked.home is None:
        return None
    return FrameName(map=asked.home.name, frame_id=asked.frame[1])


def _cameras(a: Asked, b: Asked) -> tuple[str, str]:
    """What the coordinates of both sensors are called; of one id in two maps, a and b."""
    ids = [x if one.frame is None else one.frame[1] for x, one in (("a", a), ("b", b))]
    if ids[0] == ids[1]:
        ids = ["a", "b"]
    return sensor_frame(ids[0], a.kind), sensor_frame(ids[1], b.kind)
