"""Inspection of stored answers: request, points, similarities, and evidence of matches.

query id  --Inspection-->  Answer | StoredQuery | PLY | PNG | Similarities | MatchDetails
query id, frame id  --Pairs-->  StoredPair  --load-->  geometries  --validated-->  PairValidation
frame | query | match  --PointClouds-->  Output

A match is validated again with the seed and the options of the query, which yields the same result.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np

from sceneprint import errors
from sceneprint.engine.context import Context
from sceneprint.engine.maps.map_frames import FORM, Output, find_indexed, geometry_of, placed
from sceneprint.engine.results.query_entry import StoredAnswer
from sceneprint.engine.search.response import uncertainty_record, validation_record
from sceneprint.engine.search.up_vectors import known_ups
from sceneprint.engine.search.verification import thresholds
from sceneprint.engine.serializers import copy_fields, query_sensor, sensor_of, tag_of, transform
from sceneprint.engine.upkeep.repair import rebuild_frame, resign_frames
from sceneprint.formats.artifact import read_geometry
from sceneprint.formats.export import LIMIT, encode_points, points_of, thinned, write_ply
from sceneprint.geometry.registration.icp import PAIR_METHOD
from sceneprint.geometry.registration.overlap import sample_points
from sceneprint.geometry.retrieval.ranking import pairwise_distances, similarity
from sceneprint.geometry.rigid import NO_UPS, Ups, inverse, transform_points
from sceneprint.geometry.validation.inspection import (
    AGREES,
    VIOLATES,
    Traces,
    Verdicts,
    overlay,
    patches_at,
    residuals,
    trace,
)
from sceneprint.geometry.validation.validation import PairValidation, ValidationParameters
from sceneprint.pictures import depth_view, normals_view, picture
from sceneprint.pipeline import validate, validate_guided, validate_without_up
from sceneprint.store.frames import refers_to
from sceneprint.store.maps import (
    find_frame,
    find_map,
    frame_of,
    frames_of,
    geometry_blobs,
    list_maps,
)
from sceneprint.store.signatures import stored_signatures
from sceneprint.store.tables import MapRow
from sceneprint.types import Bytes, Floats, Floats32, Geometry
from sceneprint_client.api import Answer, FrameState
from sceneprint_client.api import Match as MatchRecord
from sceneprint_client.api.query import FrameName
from sceneprint_client.api.results import (
    MOST_POINTS,
    CloudFrame,
    Coincidences,
    MatchDetails,
    OverlayColour,
    OverlayTransform,
    Points,
    PointsSide,
    Similarities,
    StoredQuery,
    Triple,
    View,
)

#: Number of cached validations (about 1 kB each); a page requests several views of a match.
_CACHE_SIZE = 64


@dataclass(frozen=True, eq=False)
class StoredPair:
    """A stored answer and one of its matches.

    Parameters
    ----------
    sensor : name of the sensor frame of the match
    blob : digest of the geometry of the match
    row, number : map and number of the matched frame
    ups : up vectors (3,) in the sensor frames of query and match; None if unknown
    """

    stored: StoredAnswer
    match: MatchRecord
    sensor: str
    blob: str
    row: MapRow
    number: int
    ups: Ups = NO_UPS


class Pairs:
    """Matches of stored answers."""

    def __init__(self, context: Context) -> None:
        self._store, self._signers, self._log = context.store, context.signers, context.query_log
        self._cache = _ValidationCache()

    def find(self, query_id: str, frame_id: str, map_name: str | None = None) -> StoredPair:
        """Return a stored answer together with one of its matches.

        Raises
        ------
        UnknownQuery : If the answer is not stored.
        UnknownMap, UnknownFrame : If the answer has no such match, or the match or its map was
            deleted.
        NotIndexed : If the query ran without validation, or the map has another model now.
        """
        stored = self._log.find(query_id)
        named = (record for record in stored.answer.matches if record.frame_id == frame_id)
        match = next((record for record in named if map_name in (None, record.map)), None)
        if match is None:
            where = "" if map_name is None else f" in map {map_name!r:.80}"
            raise errors.UnknownFrame(
                f"Query {query_id} has no match {frame_id!r:.80}{where}. Its answer lists the "
                "matches."
            )
        check_geometry(stored)
        with self._store.database.read() as connection:
            row = find_map(connection, match.map)
            frame = find_frame(connection, row, match.frame_id)
            blobs = geometry_blobs(connection, [frame.number], stored.model_id)
            ups = {} if stored.up is None else known_ups(connection, stored.ranked)
        if frame.state == FrameState.DELETED or frame.number not in stored.ranked:
            raise _deleted(match)
        if frame.number not in blobs:
            raise errors.NotIndexed(
                f"Map {match.map!r} has switched its model since the query, and signatures of "
                "different models cannot be compared. Send the query again."
            )
        return StoredPair(
            stored, match, sensor_of(frame), blobs[frame.number], row, frame.number,
            (stored.up, ups.get(frame.number)),
        )  # fmt: skip

    def load(self, pair: StoredPair) -> tuple[Geometry, Geometry]:
        """Return the geometries of query and match.

        If the match's geometry is damaged, rebuild it for this call and, unless the map has
        changed its model, queue a job that repairs it.

        Raises
        ------
        DamagedBlob : If the upload of the match is damaged as well.
        UnknownFrame : If the match's geometry is damaged and the match was deleted.
        """
        query = geometry_of_query(pair.stored)
        try:
            return query, read_geometry(self._store.blobs.get(pair.blob))
        except (errors.DamagedBlob, errors.UnreadableGeometry):
            with self._store.database.read() as connection:
                if not refers_to(connection, pair.blob):
                    raise _deleted(pair.match) from None
                frame = frame_of(connection, pair.number)
            if pair.row.model_id == pair.stored.model_id:
                resign_frames(self._store, pair.row, [pair.number], pair.row.model_id)
        _, artifact = rebuild_frame(self._store, self._signers(pair.stored.model_id), frame)
        return query, read_geometry(artifact)

    def parameters(self, pair: StoredPair) -> ValidationParameters:
        """Return the validation parameters of the model of the query."""
        return self._signers(pair.stored.model_id).model.parameters.validation

    def validated(self, pair: StoredPair, query: Geometry, match: Geometry) -> PairValidation:
        """Return the validation of a match with the options of its query; cache the result."""
        p = self.parameters(pair)
        seed, options = pair.stored.query.seed, thresholds(pair.stored.query.validation, p)
        key = pair.stored.answer.query_id, pair.blob

        def make() -> PairValidation:
            if pair.match.predicted is not None:
                T = np.array(pair.match.predicted.matrix)
                guided = validate_guided(query, match, T, seed, options[0], pair.ups)
                if guided is not None:
                    return guided
            validation = validate(query, match, seed, *options, ups=pair.ups)
            if validation.reason != pair.match.validation.reason and pair.stored.up is not None:
                # retry without up vectors, as the query does
                return validate_without_up(query, match, seed, options[0], pair.ups) or validation
            return validation

        return self._cache.get(key, make)


class _ValidationCache:
    """Cache of recent validations, but not of errors; concurrent requests share a computation."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._futures: OrderedDict[tuple[str, str], Future[PairValidation]] = OrderedDict()

    def get(self, key: tuple[str, str], make: Callable[[], PairValidation]) -> PairValidation:
        with self._lock:
            future = self._futures.get(key)
            mine = future is None
            if future is None:
                future = self._futures[key] = Future()
            self._futures.move_to_end(key)
            while len(self._futures) > _CACHE_SIZE:
                self._futures.popitem(last=False)
        if mine:
            try:
                future.set_result(make())
            except BaseException as error:
                with self._lock:
                    self._futures.pop(key, None)
                future.set_exception(error)
        return future.result()


def check_geometry(stored: StoredAnswer, needs: str = "the stage") -> bytes:
    """Return the encoded geometry of a query; raise NotIndexed if it ran without validation."""
    if stored.geometry is None:
        raise errors.NotIndexed(
            f"Query {stored.answer.query_id} ran without validation, so its points were not "
            f"stored. Send the query again with {needs} `validate`."
        )
    return stored.geometry


def geometry_of_query(stored: StoredAnswer) -> Geometry:
    """Return the geometry of a query; raise NotIndexed if it ran without validation."""
    return read_geometry(check_geometry(stored))


def _deleted(match: MatchRecord) -> errors.UnknownFrame:
    return errors.UnknownFrame(
        f"Frame {match.frame_id} of map {match.map!r} was deleted after the query matched it."
    )


class Inspection:
    """Data of stored answers for inspection."""

    def __init__(self, context: Context) -> None:
        self._store, self._signers, self._log = context.store, context.signers, context.query_log
        self.pairs = Pairs(context)

    def answer(self, query_id: str) -> Answer:
        """Return a stored answer; raise UnknownQuery if it is not stored."""
        return self._log.find(query_id).answer

    def question(self, query_id: str) -> StoredQuery:
        """Return the request of a query; raise UnknownQuery if its answer is not stored."""
        stored, record = self._log.find(query_id), self._log.record(query_id)
        return StoredQuery(
            **record.model_dump(),
            validates=stored.geometry is not None or stored.answer.frame is not None,
            model=stored.answer.model,
            options=stored.query.model_dump(mode="json", exclude_unset=True),
        )

    def preview(self, query_id: str, view: View = "depth", width: int = 320) -> bytes:
        """Return an image of the query frame as PNG.

        Raises
        ------
        UnknownQuery : If the answer is not stored.
        NotIndexed : If the query ran without validation.
        InvalidRequest : If the view is `patches`, since patches of queries are not stored.
        """
        stored = self._log.find(query_id)
        if view == "patches":
            raise errors.InvalidRequest(
                "The patches of a query are not stored. Use view=depth or view=normals.",
                (("view", "not stored for a query"),),
            )
        surface = read_geometry(check_geometry(stored, "the frame and the stage")).surface
        colours, text = (depth_view if view == "depth" else normals_view)(surface)
        return picture(colours, width, {"view": view, "model": stored.answer.model, **text})

    def cloud(self, query_id: str) -> bytes:
        """Return the points and normals of the query as a PLY file, in its sensor frame.

        See `preview` for errors.
        """
        stored = self._log.find(query_id)
        points, normals = points_of(geometry_of_query(stored).surface)
        comments = [
            f"frame {_sensor(stored)}", f"points of query {query_id}, metres",
            f"model {stored.answer.model}",
        ]  # fmt: skip
        return write_ply(points, normals, comments=comments)

    def similarities(self, query_id: str, limit: int = 50) -> Similarities:
        """Return the pairwise similarities of the query and the first frames of its ranking.

        Raise UnknownQuery if the answer is not stored.
        """
        stored = self._log.find(query_id)
        numbers = stored.ranked[:limit]
        with self._store.database.read() as connection:
            rows = frames_of(connection, numbers)
            vectors = stored_signatures(connection, rows, stored.model_id)
            names = {row.number: row.name for row in list_maps(connection)}
        # omit maps that were not searched, since the caller may not be permitted to read them
        readable = [
            n for n in numbers if n in vectors and names[rows[n].map_number] in stored.answer.maps
        ]
        stacked: Bytes = np.stack(
            [stored.vector, *(np.frombuffer(vectors[n], np.uint8) for n in readable)]
        )
        model = self._signers(stored.model_id).model
        shares = similarity(pairwise_distances(stacked, model.metric), model.unrelated_distance)
        return Similarities(
            query_id=query_id,
            model=stored.answer.model,
            frames=[
                FrameName(map=names[rows[n].map_number], frame_id=rows[n].id) for n in readable
            ],
            names=[rows[n].name for n in readable],
            similarity=shares.round(4).tolist(),
        )

    def match(self, query_id: str, frame_id: str, map_name: str | None = None) -> MatchDetails:
        """Validate a match again; return the result with the points and patches that support it.

        Parameters
        ----------
        query_id, frame_id : ids of the answer and of the match
        map_name : map of the match; None selects the first match with this id

        Raises
        ------
        UnknownQuery, UnknownMap, UnknownFrame, NotIndexed : See `Pairs.find`.
        DamagedBlob, UnreadableGeometry : If both geometry and upload of the match are damaged.
        """
        pair = self.pairs.find(query_id, frame_id, map_name)
        stored, match, p = pair.stored, pair.match, self.pairs.parameters(pair)
        query, other = self.pairs.load(pair)
        v = self.pairs.validated(pair, query, other)
        names = pair.sensor, _sensor(stored)
        T, rival = v.T_match_query, v.T_rival
        traces = None if T is None else trace(query, other, T, p.agreement, p.alignment.consensus)
        return copy_fields(
            MatchDetails,
            match,
            query_id=query_id,
            validation=validation_record(v),
            transform=None if T is None else transform(T, *names),
            uncertainty=uncertainty_record(v.covariance, PAIR_METHOD, p.covariance),
            rival=None if rival is None else transform(rival, *names),
            patches=None if traces is None else _coincidences(traces, query, other),
            query=None if traces is None else _points(traces.query, traces.of_query),
            match=None if traces is None else _points(traces.match, traces.of_match),
            seed=stored.query.seed,
        )

    def overlay(
        self, query_id: str, frame_id: str, map_name: str | None = None,
        colour: OverlayColour = "source", by: OverlayTransform = "aligned",
    ) -> bytes:  # fmt: skip
        """Return the points of query and match in one PLY file, in the sensor frame of the match.

        Parameters
        ----------
        colour : meaning of the colours: source, normal, or distance from the other surface
        by : transform of the query points: the transform of the match, its best rival, or none

        Raises
        ------
        UnknownQuery, UnknownMap, UnknownFrame, NotIndexed : See `match`.
        InvalidRequest : If the match has no such transform.
        """
        pair = self.pairs.find(query_id, frame_id, map_name)
        query, other = self.pairs.load(pair)
        T = np.eye(4)
        if by != "none":
            v = self.pairs.validated(pair, query, other)
            chosen = v.T_match_query if by == "aligned" else v.T_rival
            if chosen is None:
                what = "no transform" if by == "aligned" else "no rival"
                raise errors.InvalidRequest(
                    f"Frame {frame_id} has {what} with query {query_id}: {v.reason}. Use "
                    "transform=none to draw both without a transform.",
                    (("transform", f"there is {what}"),),
                )
            T = chosen
        p = self.pairs.parameters(pair).agreement
        points, normals, colours = overlay(query.surface, other.surface, T, colour, p)
        comments = [
            f"frame {pair.sensor}",
            f"query {query_id} and frame {pair.match.frame_id} of map {pair.match.map}, metres",
            f"transform {by}, colours by {colour}", f"model {pair.stored.answer.model}",
        ]  # fmt: skip
        if pair.match.name is not None:
            comments.append(f"name of the frame: {pair.match.name}")
        return write_ply(points, normals, colours, comments=comments)


def _sensor(stored: StoredAnswer) -> str:
    return query_sensor(stored.answer.frame, stored.answer.kind, stored.answer.maps)


def _coincidences(traces: Traces, query: Geometry, match: Geometry) -> Coincidences:
    pairs = traces.pairs[:MOST_POINTS]
    of_query, of_match = pairs[:, 0], pairs[:, 1]
    return Coincidences(
        query=of_query.tolist(),
        match=of_match.tolist(),
        query_mean=_triples(query.patches.means[of_query]),
        query_normal=_triples(query.patches.normals[of_query]),
        match_mean=_triples(match.patches.means[of_match]),
        match_normal=_triples(match.patches.normals[of_match]),
        distance_m=traces.distances[:MOST_POINTS].round(4).tolist(),
    )


def _points(points: Floats32, verdicts: Verdicts) -> Points:
    return Points(
        sampled=len(points),
        inliers=_triples(points[verdicts == AGREES, :3][:MOST_POINTS].astype(float)),
        violations=_triples(points[verdicts == VIOLATES, :3][:MOST_POINTS].astype(float)),
    )


def _triples(rows: Floats) -> list[Triple]:
    return [(x, y, z) for x, y, z in rows.round(4).tolist()]


class PointClouds:
    """Points of frames, queries and matches in binary form; see `sceneprint.formats.export`."""

    def __init__(self, context: Context, pairs: Pairs) -> None:
        self._store, self._signers, self._log = context.store, context.signers, context.query_log
        self._pairs = pairs

    def frame(
        self, map_name: str, frame_id: str, within: CloudFrame = "optical", limit: int = LIMIT
    ) -> Output[bytes]:
        """Return points, normals and patches of a frame; see `FrameFiles.cloud`."""
        indexed = find_indexed(self._store, map_name, frame_id)
        name, matrix = placed(indexed.frame, within)

        def make() -> bytes:
            geometry = geometry_of(self._store, self._signers, indexed)
            points, total = _limited_points(geometry, limit)
            return _encoded(geometry, points, total, np.array(matrix))

        tag = indexed.tag("points", indexed.frame.id, indexed.row.name, name, matrix, limit)
        return Output(tag, make)

    def query(self, query_id: str, limit: int = LIMIT) -> Output[bytes]:
        """Return points, normals and patches of a query in its sensor frame.

        Raises
        ------
        UnknownQuery : If the answer is not stored.
        NotIndexed : If the query ran without validation.
        """
        stored = self._log.find(query_id)
        check_geometry(stored)

        def make() -> bytes:
            geometry = geometry_of_query(stored)
            points, total = _limited_points(geometry, limit)
            return _encoded(geometry, points, total)

        return Output(tag_of("points of a query", FORM, query_id, limit), make)

    def match(
        self, query_id: str, frame_id: str, map_name: str | None = None,
        side: PointsSide = "query", by: OverlayTransform = "aligned", limit: int = LIMIT,
    ) -> Output[bytes]:  # fmt: skip
        """Return points, normals and patches of a query or a match in its own sensor frame.

        With a transform, the result includes the distance of each point from the other surface.

        Parameters
        ----------
        side : frame whose points are returned
        by : transform under which the distances are measured
        limit : maximum number of points

        Raises
        ------
        UnknownQuery, UnknownMap, UnknownFrame, NotIndexed : See `Pairs.find`.
        DamagedBlob : See `Pairs.load`; raised by `Output.make`.
        InvalidRequest : If the match has no rival; raised by `Output.make`.
        """
        pair = self._pairs.find(query_id, frame_id, map_name)

        def make() -> bytes:
            query, match = self._pairs.load(pair)
            T: Floats | None = np.eye(4)
            if by != "none":
                v = self._pairs.validated(pair, query, match)
                T = v.T_match_query if by == "aligned" else v.T_rival
            if by == "rival" and T is None:
                raise errors.InvalidRequest(
                    f"The match of frame {frame_id} with query {query_id} has no rival: "
                    f"{v.reason}. Use transform=aligned.",
                    (("transform", "the match has no rival"),),
                )
            mine, other = (query, match) if side == "query" else (match, query)
            points, total = _limited_points(mine, limit)
            if T is None:
                return _encoded(mine, points, total)
            T = T if side == "query" else inverse(T)
            p = self._pairs.parameters(pair).agreement
            apart = residuals(points, other.surface, T, p)
            return _encoded(mine, points, total, residuals=apart, scale=p.surface_tolerance)

        tag = tag_of("points of a match", FORM, query_id, pair.blob, side, by, limit)
        return Output(tag, make)


def _limited_points(geometry: Geometry, limit: int) -> tuple[Floats32, int]:
    """Return points and normals (N, 6), at most `limit`, and the number of all points."""
    every = sample_points(geometry.surface, 1)
    return np.ascontiguousarray(every[thinned(len(every), limit)]), len(every)


def _encoded(
    geometry: Geometry, points: Floats32, total: int, T: Floats | None = None,
    residuals: Verdicts | None = None, scale: float = 0.0,
) -> bytes:  # fmt: skip
    at, normals = points[:, :3].astype(float), points[:, 3:].astype(float)
    if T is not None:
        at, normals = transform_points(T, at), normals @ T[:3, :3].T
    patches = patches_at(points, geometry.patches)
    return encode_points(at, normals, patches, residuals, total=total, scale=scale)
