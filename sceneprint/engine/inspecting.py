"""What one can look at after a query: its points, its ranking, and any match with its evidence.

query id  --Inspection-->  Answer | PLY | Similarities | MatchDetails

A match is validated once more, with the seed and the options of the query: see `pairs.py`.
"""

from __future__ import annotations

import numpy as np

from sceneprint.clouds import points_of, write_ply
from sceneprint.engine.kept import Kept, KeptQueries
from sceneprint.engine.pairs import Pairs, geometry_of_query
from sceneprint.engine.signers import Signers
from sceneprint.engine.telling import tell_uncertainty, tell_validation
from sceneprint.engine.transforms import transform
from sceneprint.engine.wire import query_sensor
from sceneprint.errors import InvalidRequest
from sceneprint.geometry.covariance import PAIR_METHOD
from sceneprint.geometry.overlays import overlay
from sceneprint.geometry.retrieval import pairwise_distances, similarity
from sceneprint.geometry.traces import AGREES, VIOLATES, Traces, Verdicts, trace
from sceneprint.schemas import Answer
from sceneprint.schemas.kept import (
    MOST_POINTS,
    Coincidences,
    MatchDetails,
    OverlayColour,
    OverlayTransform,
    Points,
    Similarities,
)
from sceneprint.schemas.options import FrameName
from sceneprint.schemas.outputs import Triple
from sceneprint.store import Store
from sceneprint.store.frames import frames_of
from sceneprint.store.maps import list_maps
from sceneprint.store.signatures import stored_signatures
from sceneprint.types import Bytes, Floats, Floats32, Geometry


class Inspection:
    """Answers that are kept, and what is behind them.

    Parameters
    ----------
    store, signers : of the engine
    kept : the answers
    """

    def __init__(self, store: Store, signers: Signers, kept: KeptQueries) -> None:
        self._store, self._signers, self._kept = store, signers, kept
        self.pairs = Pairs(store, signers, kept)

    def answer(self, query_id: str) -> Answer:
        """The answer again; UnknownQuery where it is not kept, or no longer."""
        return self._kept.find(query_id).answer

    def cloud(self, query_id: str) -> bytes:
        """The query's points and normals as PLY, in the coordinates of its sensor.

        Raises
        ------
        UnknownQuery : it is not kept, or no longer.
        NotIndexed : it was asked without validation, for which alone its points are made.
        """
        kept = self._kept.find(query_id)
        points, normals = points_of(geometry_of_query(kept).surface)
        comments = [
            f"frame {_sensor(kept)}", f"points of query {query_id}, metres",
            f"model {kept.answer.model}",
        ]  # fmt: skip
        return write_ply(points, normals, comments=comments)

    def similarities(self, query_id: str, limit: int = 50) -> Similarities:
        """How alike the query and the first of its ranking are, each to each; UnknownQuery."""
        kept = self._kept.find(query_id)
        wanted = kept.ranked[:limit]
        with self._store.database.read() as connection:
            rows = frames_of(connection, wanted)
            vectors = stored_signatures(connection, rows, kept.model_id)
            names = {row.number: row.name for row in list_maps(connection)}
        # a frame's number is used once, but its map may be one that the caller cannot know
        there = [
            n for n in wanted if n in vectors and names[rows[n].map_number] in kept.answer.maps
        ]
        stacked: Bytes = np.stack(
            [kept.vector, *(np.frombuffer(vectors[n], np.uint8) for n in there)]
        )
        model = self._signers(kept.model_id).model
        shares = similarity(pairwise_distances(stacked, model.metric), model.unrelated_distance)
        return Similarities(
            query_id=query_id,
            model=kept.answer.model,
            frames=[FrameName(map=names[rows[n].map_number], frame_id=rows[n].id) for n in there],
            similarity=shares.round(4).tolist(),
        )

    def match(self, query_id: str, frame_id: str, map_name: str | None = None) -> MatchDetails:
        """One match, validated once more, with what its figures were counted on.

        Parameters
        ----------
        query_id, frame_id : of an answer, and of one of its matches
        map_name : where matches of several maps have that id; default: the first of them

        Raises
        ------
        UnknownQuery : it is not kept, or no longer.
        UnknownMap, UnknownFrame : no match has that id, or it was deleted since.
        NotIndexed : there are no points to validate it with: the query was asked without
            validation, or the map has changed its model since.
        DamagedBlob, UnreadableGeometry : the match's artifact is damaged; it is made again.
        """
        pair = self.pairs.find(query_id, frame_id, map_name)
        kept, match, p = pair.kept, pair.match, self.pairs.parameters(pair)
        query, other = self.pairs.opened(pair)
        v = self.pairs.validated(pair, query, other)
        names = pair.sensor, _sensor(kept)
        T, rival = v.T_match_query, v.T_rival
        traces = None if T is None else trace(query, other, T, p.agreement, p.alignment.consensus)
        return MatchDetails(
            query_id=query_id,
            frame_id=match.frame_id,
            map=match.map,
            validation=tell_validation(v),
            transform=None if T is None else transform(T, *names),
            uncertainty=tell_uncertainty(v.covariance, PAIR_METHOD, p.covariance),
            rival=None if rival is None else transform(rival, *names),
            patches=None if traces is None else _coincidences(traces, query, other),
            query=None if traces is None else _points(traces.query, traces.of_query),
            match=None if traces is None else _points(traces.match, traces.of_match),
            seed=kept.query.seed,
        )

    def overlay(
        self, query_id: str, frame_id: str, map_name: str | None = None,
        colour: OverlayColour = "source", by: OverlayTransform = "aligned",
    ) -> bytes:  # fmt: skip
        """The query's points and a match's as PLY, in the coordinates of the match's sensor; see
        `match`.

        Parameters
        ----------
        query_id, frame_id, map_name : see `match`
        colour : by where a point is from, by its normal, or by how far it is from the other's
            surface
        by : the transform that was found, its best rival, or none: both clouds as they are

        Raises
        ------
        UnknownQuery, UnknownMap, UnknownFrame, NotIndexed : see `match`.
        InvalidRequest : there is no such transform.
        """
        pair = self.pairs.find(query_id, frame_id, map_name)
        query, other = self.pairs.opened(pair)
        T = np.eye(4)
        if by != "none":
            v = self.pairs.validated(pair, query, other)
            found = v.T_match_query if by == "aligned" else v.T_rival
            if found is None:
                what = "no transform" if by == "aligned" else "no rival"
                raise InvalidRequest(
                    f"Frame {frame_id} has {what} with query {query_id}: {v.reason}. Ask for "
                    "transform=none to see both as they are.",
                    (("transform", f"there is {what}"),),
                )
            T = found
        p = self.pairs.parameters(pair).agreement
        points, normals, colours = overlay(query.surface, other.surface, T, colour, p)
        comments = [
            f"frame {pair.sensor}",
            f"query {query_id} and frame {pair.match.frame_id} of map {pair.match.map}, metres",
            f"transform {by}, colours by {colour}", f"model {pair.kept.answer.model}",
        ]  # fmt: skip
        return write_ply(points, normals, colours, comments=comments)


def _sensor(kept: Kept) -> str:
    return query_sensor(kept.answer.frame, kept.answer.kind, kept.answer.maps)


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
