"""Queries: signing of a frame with the model of the queried maps, and search of the maps.

upload | stored frame, names of maps  -->  Answer
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, TypeVar

from sceneprint.engine.context import Context
from sceneprint.engine.results.query_entry import SentQuery, StoredAnswer, query_row
from sceneprint.engine.search.answer import SequenceFrame, answer
from sceneprint.engine.search.response import uncertainty_record, validation_record
from sceneprint.engine.search.retrieval import (
    Deadline,
    PreparedQuery,
    SearchedMap,
    check_origin,
    prepare_stored,
    prepare_upload,
)
from sceneprint.engine.search.verification import thresholds
from sceneprint.engine.serializers import copy_fields, model_label, sensor_frame, transform
from sceneprint.engine.signers import Signers
from sceneprint.errors import (
    Busy,
    InvalidRequest,
    ModelMismatch,
    NotIndexed,
    SceneprintError,
    UnknownMap,
)
from sceneprint.formats.artifact import read_geometry
from sceneprint.geometry.registration.icp import PAIR_METHOD
from sceneprint.geometry.retrieval.ranking import distances, similarity
from sceneprint.geometry.rigid import inverse
from sceneprint.models import PRESETS, read_model
from sceneprint.pipeline import Signer, validate
from sceneprint.store import Store
from sceneprint.store.maps import find_maps, list_maps, model_names, unknown_map
from sceneprint.store.tables import MapRow
from sceneprint.types import Floats
from sceneprint_client.api import (
    Answer,
    Comparison,
    FrameMeta,
    FrameName,
    Localization,
    NamedFrame,
    Query,
    SeveralQuery,
    Similarity,
)
from sceneprint_client.api.query import MOST_MAPS, MOST_OF_SEQUENCE, LocalizationStatus

T = TypeVar("T")

#: Maximum number of attempts of a query whose maps switch models.
TRIES = 5


def steadily(store: Store, maps: Sequence[str], ask: Callable[[list[MapRow]], T]) -> T:
    """Return the result of `ask`; call it again if a map has switched to another model meanwhile.

    Parameters
    ----------
    ask : function that answers the query with the model of the maps

    Raises
    ------
    UnknownMap : If a map does not exist.
    Busy : If a map switched models during every attempt.
    """
    with store.database.read() as connection:
        rows = find_maps(connection, maps)
    for _ in range(TRIES):
        try:
            result = ask(rows)
        except SceneprintError:
            now = _other_models(store, rows)
            if now is None:
                raise
        else:
            # check even after success, since artifacts of the former model may have been removed
            now = _other_models(store, rows)
            if now is None:
                return result
        rows = now
    raise Busy(
        f"Map {', '.join(map(repr, maps))} switched its model repeatedly during the query. Send "
        "the query again."
    )


def check_model(first: str, second: str) -> None:
    """Raise ModelMismatch if two model ids differ."""
    if first != second:
        raise ModelMismatch(
            f"Signatures of two models cannot be compared: {first[:12]} and {second[:12]}. Send "
            "the query again."
        )


def _other_models(store: Store, rows: Sequence[MapRow]) -> list[MapRow] | None:
    """Return the current rows of maps if a map has switched its model.

    Return None if no map has switched, or a map was deleted or replaced.
    """
    try:
        with store.database.read() as connection:
            rows_now = find_maps(connection, [row.name for row in rows])
    except UnknownMap:
        return None
    pairs = list(zip(rows_now, rows, strict=True))
    if any(current.number != row.number for current, row in pairs):
        return None
    return rows_now if any(current.model_id != row.model_id for current, row in pairs) else None


#: A stored frame, or the bytes and metadata of an upload.
Side = NamedFrame | tuple[bytes, FrameMeta]


def compare(store: Store, signers: Signers, a: Side, b: Side, how: Comparison) -> Similarity:
    """Return the similarity of two frames, without storing them.

    Parameters
    ----------
    how : options of the comparison; its frame names are ignored

    Raises
    ------
    UnknownMap, UnknownFrame : If a stored frame or its map does not exist.
    FrameError : If an upload cannot be used.
    InvalidRequest : If a stored frame is not indexed, or the models differ.
    """
    sides = (a, b)
    stages = ("retrieve", "validate") if how.aligned else ("retrieve",)
    query = Query.model_validate({"stages": stages})

    def ask(rows: list[MapRow]) -> Similarity:
        signer = _signer(store, signers, rows, how)
        ready = []
        for side in sides:
            if isinstance(side, NamedFrame):
                ready.append(prepare_stored(store, signers, side.map, side.frame_id, query))
            else:
                ready.append(prepare_upload(*side, signer, query, store.decoders))
        check_model(ready[0].model_id, ready[1].model_id)
        return _compared(ready[0], ready[1], signer, how)

    names = [side.map for side in sides if isinstance(side, NamedFrame)]
    maps = list(dict.fromkeys(names))
    return steadily(store, maps, ask)


def _compared(a: PreparedQuery, b: PreparedQuery, signer: Signer, how: Comparison) -> Similarity:
    start = time.perf_counter()
    distance = distances(a.vector, b.vector[None], signer.model.metric)
    validation, p = None, signer.model.parameters.validation
    if a.geometry is not None and b.geometry is not None:
        options = thresholds(how.validation, p)
        validation = validate(b.geometry, a.geometry, how.seed, *options, ups=(b.up, a.up))
    T = None if validation is None else validation.T_match_query
    covariance = None if validation is None else validation.covariance
    spent = {
        "prepare": round(a.prepare_ms + b.prepare_ms, 2),
        "validate": round(1e3 * (time.perf_counter() - start), 2),
    }
    return Similarity(
        distance=int(distance[0]),
        similarity=float(similarity(distance, signer.model.unrelated_distance)[0]),
        model=signer.model.label,
        a=a.name,
        b=b.name,
        validation=None if validation is None else validation_record(validation),
        uncertainty=uncertainty_record(covariance, PAIR_METHOD, p.covariance),
        transform=None if T is None else transform(T, *_cameras(a, b)),
        seed=how.seed,
        milliseconds={**spent, "total": round(sum(spent.values()), 2)},
    )


def _signer(store: Store, signers: Signers, rows: Sequence[MapRow], how: Comparison) -> Signer:
    """Return the signer of the model of the stored frames; without stored frames, that of `how`."""
    if not rows:
        return signers.of(read_model(how.model or PRESETS[0]))
    with store.database.read() as connection:
        names = model_names(connection)
    models = [f"{row.name} has {model_label(names[row.model_id], row.model_id)}" for row in rows]
    if len({row.model_id for row in rows}) > 1:
        raise InvalidRequest(
            "Frames of maps with different models cannot be compared: map "
            f"{' and map '.join(models)}. Compare frames of maps with the same model, or upload "
            "one of the frames.",
            (("frame_a", models[0]), ("frame_b", models[1])),
        )
    if how.model is not None and read_model(how.model).id != rows[0].model_id:
        raise InvalidRequest(
            f"The stored frame was not signed with the model {how.model!r}: map {models[0]}. Omit "
            "`model`.",
            (("model", f"map {models[0]}"),),
        )
    return signers(rows[0].model_id)


def _cameras(a: PreparedQuery, b: PreparedQuery) -> tuple[str, str]:
    """Return the names of both sensor frames, with the ids `a` and `b` if the ids are equal."""
    ids = [x if side.frame is None else side.frame[1] for x, side in (("a", a), ("b", b))]
    if ids[0] == ids[1]:
        ids = ["a", "b"]
    return sensor_frame(ids[0], a.kind), sensor_frame(ids[1], b.kind)


class Queries:
    """Queries to one or more maps of the same model."""

    def __init__(self, context: Context) -> None:
        self._store, self._signers, self._readers = context.store, context.signers, context.readers
        self._log, self._cores = context.query_log, context.cores

    def upload(
        self, maps: Sequence[str], data: bytes, meta: FrameMeta, query: Query,
        since: float | None = None, sent: SentQuery | None = None,
    ) -> Answer:  # fmt: skip
        """Return the answer to an uploaded frame, which is not stored; see `prepare_upload`.

        Parameters
        ----------
        maps : distinct names of the maps
        since : time of the request by `time.perf_counter`; None selects the current time
        sent : request for the query log; None does not log the query

        Raises
        ------
        UnknownMap : If a map does not exist.
        InvalidRequest : If the maps have several models.
        """
        deadline = Deadline(query.deadline_ms, since)

        def ask(rows: list[MapRow]) -> Answer:
            self._check_models(rows)
            signer = self._signers(rows[0].model_id)
            ready = prepare_upload(data, meta, signer, query, self._store.decoders)
            return self.answer(rows, ready, query, deadline, sent=sent)

        return self._steadily(maps, ask)

    def sequence(
        self, map_name: str, frames: Sequence[tuple[bytes, FrameMeta]], query: Query,
        since: float | None = None, sent: SentQuery | None = None,
    ) -> Answer:  # fmt: skip
        """Return the answer for the last frame of a sequence; earlier frames vote for its pose.

        Parameters
        ----------
        frames : uploads and metadata in chronological order, with odometry as poses in a common
            parent frame
        query : options for each frame

        Raises
        ------
        UnknownMap : If the map does not exist.
        InvalidRequest : See `check_sequence`.
        """
        check_sequence([meta for _, meta in frames], query)
        deadline = Deadline(query.deadline_ms, since)

        def ask(rows: list[MapRow]) -> Answer:
            signer = self._signers(rows[0].model_id)
            decoders = self._store.decoders
            *before, last = [prepare_upload(*frame, signer, query, decoders) for frame in frames]
            earlier = [
                SequenceFrame(each, inverse(_odometry(last)) @ _odometry(each)) for each in before
            ]
            return self.answer(rows, last, query, deadline, earlier, sent)

        return self._steadily([map_name], ask)

    def stored(
        self, maps: Sequence[str], frame: FrameName, query: Query, since: float | None = None,
        sent: SentQuery | None = None,
    ) -> Answer:  # fmt: skip
        """Return the answer to a stored frame, which is not matched with itself.

        See `prepare_stored` and `upload`.
        """
        deadline = Deadline(query.deadline_ms, since)

        def ask(rows: list[MapRow]) -> Answer:
            self._check_models(rows)
            self._signers(rows[0].model_id)  # slow, so do it before opening a connection
            ready = prepare_stored(self._store, self._signers, frame.map, frame.frame_id, query)
            return self.answer(rows[: len(maps)], ready, query, deadline, sent=sent)

        home = [] if frame.map in maps else [frame.map]
        names = [*maps, *home]
        return self._steadily(names, ask)

    def again(
        self, maps: Sequence[str], stored: StoredAnswer, query: Query,
        since: float | None = None, sent: SentQuery | None = None,
    ) -> Answer:  # fmt: skip
        """Return a new answer to a query whose answer is stored, without its upload.

        Parameters
        ----------
        stored : earlier answer

        Raises
        ------
        UnknownMap, UnknownFrame : If a map or the query's stored frame no longer exists.
        NotIndexed : If validation is requested, but the upload was queried without it, or if a map
            has another model than the stored signature.
        InvalidRequest : See `prepare_upload` and `prepare_stored`.
        """
        frame = stored.answer.frame
        if frame is not None:
            return self.stored(maps, frame, query, since, sent)
        deadline, geometry = Deadline(query.deadline_ms, since), None
        if "validate" in query.stages:
            if stored.geometry is None:
                raise NotIndexed(
                    f"Query {stored.answer.query_id} ran without validation, so its points were "
                    "not stored. Send the frame again."
                )
            geometry = read_geometry(stored.geometry)
        prepared = PreparedQuery(
            stored.model_id, stored.vector, geometry, check_origin(stored.origin, query), None, 0.0,
            base=stored.base, artifact=stored.geometry, kind=stored.answer.kind, up=stored.up,
        )  # fmt: skip

        def ask(rows: list[MapRow]) -> Answer:
            for row in rows:
                if row.model_id != stored.model_id:
                    raise NotIndexed(
                        f"The query was signed with another model than that of map {row.name!r}, "
                        "and its upload is not stored. Send the frame again."
                    )
            return self.answer(rows, prepared, query, deadline, sent=sent)

        return self._steadily(maps, ask)

    def answer(
        self, expected: Sequence[MapRow], prepared: PreparedQuery, query: Query, deadline: Deadline,
        earlier: Sequence[SequenceFrame] = (), sent: SentQuery | None = None,
    ) -> Answer:  # fmt: skip
        """Return the answer to a prepared query, with its maps' current state; log the query."""
        database = self._store.database
        with database.read() as connection:
            rows = find_maps(connection, [former.name for former in expected])
            for row, former in zip(rows, expected, strict=True):
                if row.number != former.number:
                    raise UnknownMap(
                        f"Map {row.name!r} was deleted and created again during the query. Send "
                        "the query again."
                    )
                check_model(prepared.model_id, row.model_id)
            views = [self._readers.view(connection, row) for row in rows]
        places = [SearchedMap(row, view) for row, view in zip(rows, views, strict=True)]
        for place in places:
            check_model(place.view.model_id, prepared.model_id)
        model = self._signers(prepared.model_id).model
        response, ranked = answer(self._store, places, model, prepared, query, deadline, earlier)
        self._log_answer(response, ranked, prepared, query, deadline, sent)
        return response

    def _log_answer(
        self, response: Answer, ranked: Sequence[int], prepared: PreparedQuery, query: Query,
        deadline: Deadline, sent: SentQuery | None,
    ) -> None:  # fmt: skip
        listed = sent is not None and query.record
        if not (listed or query.keep):
            return
        if sent is None:
            sent = SentQuery(response.maps, query, frame=response.frame)
        row = query_row(sent, response, time.perf_counter() - deadline.since)
        stored, shown = None, set[int]()
        if query.keep:
            stored = StoredAnswer(
                response, query, prepared.model_id, prepared.vector, prepared.artifact,
                tuple(ranked), origin=prepared.origin, base=prepared.base, up=prepared.up,
            )  # fmt: skip

            shown = {ranked[part.rank - 1] for part in response.explanations or response.matches}
            shown |= set() if prepared.frame is None else {prepared.frame[0]}
        self._log.note(replace(row, listed=listed), stored, sorted(shown))

    def _steadily(self, maps: Sequence[str], ask: Callable[[list[MapRow]], Answer]) -> Answer:
        with self._cores.shared():
            return steadily(self._store, maps, ask)

    def compare(self, a: Side, b: Side, how: Comparison) -> Similarity:
        """Return the similarity of two frames; see the function `compare`."""
        with self._cores.shared():
            return compare(self._store, self._signers, a, b, how)

    def maps_of(
        self, query: SeveralQuery, may_read: Callable[[str], bool] = lambda _: True
    ) -> list[str]:
        """Return the distinct names of the maps that a query searches.

        Parameters
        ----------
        query : query with map names; `*` selects all readable maps
        may_read : function that returns whether the caller may read a map

        Raises
        ------
        UnknownMap : If a map does not exist or is not readable, or no map is readable.
        InvalidRequest : If there are more than MOST_MAPS maps.
        """
        if query.maps != "*":
            for name in query.maps:
                if not may_read(name):
                    raise unknown_map(name)
            return list(dict.fromkeys(query.maps))
        with self._store.database.read() as connection:
            names = [row.name for row in list_maps(connection) if may_read(row.name)]
        if not names:
            raise UnknownMap("There is no map to search. Create a map, or check your grants.")
        if len(names) > MOST_MAPS:
            raise InvalidRequest(
                f"There are {len(names)} maps, but a query can search at most {MOST_MAPS}. Specify "
                "the maps to search.",
                (("maps", f"more than {MOST_MAPS}"),),
            )
        return names

    def _check_models(self, rows: Sequence[MapRow]) -> None:
        if len({row.model_id for row in rows}) == 1:
            return
        with self._store.database.read() as connection:
            names = model_names(connection)
        models = {row.name: model_label(names[row.model_id], row.model_id) for row in rows}
        which = ", ".join(f"{name} has {model}" for name, model in models.items())
        raise InvalidRequest(
            f"One query cannot search maps with different models: {which}. Query the maps of one "
            "model, or switch the others with `sceneprint reencode`.",
            tuple((f"maps.{name}", f"has {model}") for name, model in models.items()),
        )


def check_sequence(metas: Sequence[FrameMeta], query: Query) -> None:
    """Raise InvalidRequest if the stages, length or odometry of a sequence are not valid."""
    check_localizes(query)
    if not 2 <= len(metas) <= MOST_OF_SEQUENCE:
        raise InvalidRequest(
            f"The sequence has {len(metas)} frames. Send 2 to {MOST_OF_SEQUENCE} frames; the query "
            "localises the last one.",
            (("frame", f"{len(metas)} frames"),),
        )
    without = [i for i, meta in enumerate(metas) if meta.pose is None]
    parents = {meta.pose.parent_frame for meta in metas if meta.pose is not None}
    if without or len(parents) > 1:
        what = f"frame {without[0]} has no pose" if without else "the parent frames differ"
        raise InvalidRequest(
            f"The frames of a sequence need odometry, but {what}. Send each frame with `pose` in "
            "the same parent frame, such as odom.",
            (("metas", what),),
        )


def _odometry(frame: PreparedQuery) -> Floats:
    """Return T_odom_sensor (4, 4) of a frame of a sequence."""
    if frame.pose is None:
        raise ValueError("a frame of a sequence without a pose")
    return frame.pose


def check_localizes(query: Query) -> None:
    """Raise InvalidRequest if a query omits validation, which a pose requires."""
    if "validate" not in query.stages:
        raise InvalidRequest(
            "A pose requires validated matches. Omit `stages`, or include `validate`.",
            (("stages", "without validate"),),
        )


def localization_of(answer: Answer) -> Localization:
    """Convert the answer to a validated query of one map to a pose with its confidence."""
    accepted = [match for match in answer.matches if match.validation.status == "accepted"]
    status: LocalizationStatus = "not_found"
    if answer.status in ("found", "ambiguous"):
        status = answer.status
    location = answer.location
    best_pose = location if location is not None else next(iter(answer.alternatives), None)
    strength = location.strength if location is not None else None
    if location is None and status == "found":  # the accepted matches have no pose
        strength = accepted[0].validation.strength
    own: dict[str, Any] = {
        "pose": None, "support": 0, "votes": 0, "spread_m": None, "spread_deg": None,
        "uncertainty": None, "base": None, "verified_by": None,
    }  # fmt: skip
    if location is not None:
        own = {name: getattr(location, name) for name in own}
    if best_pose is not None:
        own |= {"confidence": best_pose.confidence, "evidence": best_pose.evidence}
    return copy_fields(
        Localization, answer, **own, status=status, map=answer.maps[0], strength=strength,
        best=accepted[0] if accepted and status == "found" else None,
        matches=[match.frame_id for match in accepted],
    )  # fmt: skip
