"""Queries of an engine: sign the frame with the maps' model, and answer with that model.

upload | stored frame, names of maps  -->  Answer
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import TypeVar

from sceneprint.engine.context import Context
from sceneprint.engine.results.query_entry import SentQuery, StoredAnswer, query_row
from sceneprint.engine.search.answer import SequenceFrame, answer
from sceneprint.engine.search.response import uncertainty_record, validation_record
from sceneprint.engine.search.retrieval import (
    Deadline,
    PreparedQuery,
    SearchedMap,
    check_taken,
    prepare_stored,
    prepare_upload,
)
from sceneprint.engine.search.verification import thresholds
from sceneprint.engine.serializers import model_label, sensor_frame, transform
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

# Queries that meet a map's switch to another model: answered wholly with one, or asked again.

T = TypeVar("T")

#: Times that a query is asked while its map switches from model to model.
TRIES = 5


def steadily(store: Store, maps: Sequence[str], ask: Callable[[list[MapRow]], T]) -> T:
    """Ask maps, and once more where one of them switched to another model meanwhile.

    Parameters
    ----------
    maps : their names
    ask : signs the query with the model of the rows, and answers it from maps of that model

    Raises
    ------
    UnknownMap : one of them is none.
    Busy : a map switched again and again.
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
            # also where all went well: artifacts of the former model may have been missed
            now = _other_models(store, rows)
            if now is None:
                return result
        rows = now
    raise Busy(
        f"Map {', '.join(map(repr, maps))} kept changing its model during the query. Send the "
        "query again."
    )


def check_model(one: str, other: str) -> None:
    """Raise ModelMismatch unless signatures that are to be compared are of one model."""
    if one != other:
        raise ModelMismatch(
            f"Signatures of two models cannot be compared: {one[:12]} and {other[:12]}. Send the "
            "query again."
        )


def _other_models(store: Store, rows: Sequence[MapRow]) -> list[MapRow] | None:
    """Return the maps as they are now if one of them has another model, else None."""
    try:
        with store.database.read() as connection:
            now = find_maps(connection, [row.name for row in rows])
    except UnknownMap:
        return None
    pairs = list(zip(now, rows, strict=True))
    if any(one.number != row.number for one, row in pairs):
        return None
    return now if any(one.model_id != row.model_id for one, row in pairs) else None


# Two frames compared: their signatures, and whether they see one place.
#
# frame, frame  --compare-->  Similarity

#: A frame that is stored, or sent: its bytes and what is known of it.
Side = NamedFrame | tuple[bytes, FrameMeta]


def compare(store: Store, signers: Signers, a: Side, b: Side, how: Comparison) -> Similarity:
    """Compare two frames; neither is kept.

    Parameters
    ----------
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
    """Return the signer of uploads: that of the stored frames' model, if there are any."""
    if not rows:
        return signers.of(read_model(how.model or PRESETS[0]))
    with store.database.read() as connection:
        names = model_names(connection)
    models = [f"{row.name} has {model_label(names[row.model_id], row.model_id)}" for row in rows]
    if len({row.model_id for row in rows}) > 1:
        raise InvalidRequest(
            f"Frames of two models cannot be compared: map {' and map '.join(models)}. Compare "
            "frames of maps that share a model, or upload one of them.",
            (("frame_a", models[0]), ("frame_b", models[1])),
        )
    if how.model is not None and read_model(how.model).id != rows[0].model_id:
        raise InvalidRequest(
            f"The stored frame is signed with another model than {how.model!r}: map {models[0]}. "
            "Leave `model` out.",
            (("model", f"map {models[0]}"),),
        )
    return signers(rows[0].model_id)


def _cameras(a: PreparedQuery, b: PreparedQuery) -> tuple[str, str]:
    """Return the names of both sensors' coordinates; `a` and `b` if their ids are equal."""
    ids = [x if one.frame is None else one.frame[1] for x, one in (("a", a), ("b", b))]
    if ids[0] == ids[1]:
        ids = ["a", "b"]
    return sensor_frame(ids[0], a.kind), sensor_frame(ids[1], b.kind)


class Queries:
    """Queries one or more maps of one model."""

    def __init__(self, context: Context) -> None:
        self._store, self._signers, self._readers = context.store, context.signers, context.readers
        self._log, self._cores = context.query_log, context.cores

    def upload(
        self, maps: Sequence[str], data: bytes, meta: FrameMeta, query: Query,
        since: float | None = None, sent: SentQuery | None = None,
    ) -> Answer:  # fmt: skip
        """Look a frame up that is not kept; see `prepare_upload`.

        Parameters
        ----------
        maps : their names, each once
        query : how to ask
        since : when the request came, by `time.perf_counter`; default: now
        sent : the query as the log lists it; None: the log does not list it

        Raises
        ------
        UnknownMap : one of them is none.
        InvalidRequest : they are of several models.
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
        """Look up the last of some frames of one run; the earlier ones vote for its pose too.

        Parameters
        ----------
        frames : samples and meta of each in the order they were taken: their poses, in one parent
            frame of any name, are the odometry
        query : how to ask, for each of them
        since, sent : see `upload`

        Raises
        ------
        UnknownMap : there is none.
        InvalidRequest : fewer than 2 frames, too many, or without odometry; or see `upload`.
        """
        check_sequence([meta for _, meta in frames], query)
        deadline = Deadline(query.deadline_ms, since)

        def ask(rows: list[MapRow]) -> Answer:
            signer = self._signers(rows[0].model_id)
            decoders = self._store.decoders
            *before, last = [prepare_upload(*one, signer, query, decoders) for one in frames]
            earlier = [
                SequenceFrame(one, inverse(_odometry(last)) @ _odometry(one)) for one in before
            ]
            return self.answer(rows, last, query, deadline, earlier, sent)

        return self._steadily([map_name], ask)

    def stored(
        self, maps: Sequence[str], frame: FrameName, query: Query, since: float | None = None,
        sent: SentQuery | None = None,
    ) -> Answer:  # fmt: skip
        """Look a stored frame up, which does not find itself; see `prepare_stored` and `upload`."""
        deadline = Deadline(query.deadline_ms, since)

        def ask(rows: list[MapRow]) -> Answer:
            self._check_models(rows)
            self._signers(rows[0].model_id)  # while no connection is held: a crowd would hold all
            ready = prepare_stored(self._store, self._signers, frame.map, frame.frame_id, query)
            return self.answer(rows[: len(maps)], ready, query, deadline, sent=sent)

        home = [] if frame.map in maps else [frame.map]
        names = [*maps, *home]
        return self._steadily(names, ask)

    def again(
        self, maps: Sequence[str], stored: StoredAnswer, query: Query,
        since: float | None = None, sent: SentQuery | None = None,
    ) -> Answer:  # fmt: skip
        """Repeat a query whose answer is stored, an upload without its file.

        Parameters
        ----------
        maps, query, since, sent : see `upload`
        stored : the earlier answer

        Raises
        ------
        UnknownMap, UnknownFrame : a map, or the stored frame that was the query, is gone.
        NotIndexed : it was an upload sent without validation, and this requests it; or a map has
            another model than its signature.
        InvalidRequest : see `prepare_upload` and `prepare_stored`.
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
            stored.model_id, stored.vector, geometry, check_taken(stored.taken, query), None, 0.0,
            base=stored.base, artifact=stored.geometry, kind=stored.answer.kind, up=stored.up,
        )  # fmt: skip

        def ask(rows: list[MapRow]) -> Answer:
            for row in rows:
                if row.model_id != stored.model_id:
                    raise NotIndexed(
                        f"Map {row.name!r} has a different model than the query was signed with, "
                        "and the upload of the query is not stored. Send the frame again."
                    )
            return self.answer(rows, prepared, query, deadline, sent=sent)

        return self._steadily(maps, ask)

    def answer(
        self, asked_of: Sequence[MapRow], prepared: PreparedQuery, query: Query, deadline: Deadline,
        earlier: Sequence[SequenceFrame] = (), sent: SentQuery | None = None,
    ) -> Answer:  # fmt: skip
        """Answer from the maps as they are now; ModelMismatch where one has switched meanwhile."""
        database = self._store.database
        with database.read() as connection:
            rows = find_maps(connection, [one.name for one in asked_of])
            for row, one in zip(rows, asked_of, strict=True):
                if row.number != one.number:
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
        self._note(response, ranked, prepared, query, deadline, sent)
        return response

    def _note(
        self, response: Answer, ranked: Sequence[int], prepared: PreparedQuery, query: Query,
        deadline: Deadline, sent: SentQuery | None,
    ) -> None:  # fmt: skip
        """Have the log store an answer."""
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
                tuple(ranked), taken=prepared.taken, base=prepared.base, up=prepared.up,
            )  # fmt: skip
            # explanations show the whole ranking
            shown = {ranked[one.rank - 1] for one in response.explanations or response.matches}
            shown |= set() if prepared.frame is None else {prepared.frame[0]}
        self._log.note(replace(row, listed=listed), stored, sorted(shown))

    def _steadily(self, maps: Sequence[str], ask: Callable[[list[MapRow]], Answer]) -> Answer:
        with self._cores.shared():
            return steadily(self._store, maps, ask)

    def compare(self, a: Side, b: Side, how: Comparison) -> Similarity:
        """Compare two frames; see `compare`."""
        with self._cores.shared():
            return compare(self._store, self._signers, a, b, how)

    def maps_of(
        self, query: SeveralQuery, may_read: Callable[[str], bool] = lambda _: True
    ) -> list[str]:
        """Return the names of the maps that a query searches, each once.

        Parameters
        ----------
        query : with their names, or `*` for all that may be read
        may_read : whether the caller may; what it may not is not there

        Raises
        ------
        UnknownMap : one of them is not there, or none is.
        InvalidRequest : they are more than may be asked at once.
        """
        if query.maps != "*":
            for name in query.maps:
                if not may_read(name):
                    raise unknown_map(name)
            return list(dict.fromkeys(query.maps))
        with self._store.database.read() as connection:
            names = [row.name for row in list_maps(connection) if may_read(row.name)]
        if not names:
            raise UnknownMap("There is no map to search yet. Create one, or name an existing one.")
        if len(names) > MOST_MAPS:
            raise InvalidRequest(
                f"There are {len(names)} maps, but a query can search at most {MOST_MAPS}. Name "
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
    """See that frames can be asked as a sequence; InvalidRequest where they cannot."""
    check_localizes(query)
    if not 2 <= len(metas) <= MOST_OF_SEQUENCE:
        raise InvalidRequest(
            f"A sequence of {len(metas)} frames. Send 2 to {MOST_OF_SEQUENCE}, the last one being "
            "the frame to be placed.",
            (("frame", f"{len(metas)} of them"),),
        )
    without = [i for i, meta in enumerate(metas) if meta.pose is None]
    parents = {meta.pose.parent_frame for meta in metas if meta.pose is not None}
    if without or len(parents) > 1:
        what = f"frame {without[0]} has no pose" if without else "they have several parent frames"
        raise InvalidRequest(
            f"The frames of a sequence need odometry, but {what}. Send each with `pose` in one "
            "parent frame, such as odom.",
            (("metas", what),),
        )


def _odometry(frame: PreparedQuery) -> Floats:
    """Return T_odom_sensor of a frame of a sequence."""
    if frame.pose is None:
        raise ValueError("a frame of a sequence without a pose")
    return frame.pose


# An answer to the one thing a robot wants: where it is.
#
# Answer  --localization_of-->  Localization


def check_localizes(query: Query) -> None:
    """See that a query comes to a pose; InvalidRequest where it does not."""
    if "validate" not in query.stages:
        raise InvalidRequest(
            "A pose needs validated matches. Leave `stages` out, or include `validate`.",
            (("stages", "without validate"),),
        )


def localization_of(answer: Answer) -> Localization:
    """Return the pose of a validated query to one map with its confidence, as one record."""
    accepted = [one for one in answer.matches if one.validation.status == "accepted"]
    status: LocalizationStatus = "not_found"
    if answer.status in ("found", "ambiguous"):
        status = answer.status
    there = answer.location
    judged = there if there is not None else next(iter(answer.alternatives), None)
    strength = there.strength if there is not None else None
    if there is None and status == "found":  # of matches without a pose
        strength = accepted[0].validation.strength
    return Localization(
        status=status,
        reason=answer.reason,
        cause=answer.cause,
        map=answer.maps[0],
        pose=None if there is None else there.pose,
        confidence=None if judged is None else judged.confidence,
        evidence=None if judged is None else judged.evidence,
        support=0 if there is None else there.support,
        votes=0 if there is None else there.votes,
        spread_m=None if there is None else there.spread_m,
        spread_deg=None if there is None else there.spread_deg,
        uncertainty=None if there is None else there.uncertainty,
        base=None if there is None else there.base,
        strength=strength,
        verified_by=None if there is None else there.verified_by,
        alternatives=answer.alternatives,
        best=accepted[0] if accepted and status == "found" else None,
        matches=[one.frame_id for one in accepted],
        frames=answer.frames,
        query_id=answer.query_id,
        seed=answer.seed,
        model=answer.model,
        deadline_reached=answer.deadline_reached,
        milliseconds=answer.milliseconds,
    )
