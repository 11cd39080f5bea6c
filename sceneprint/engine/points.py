"""Points of frames, queries and matches as bytes that a page draws; see `sceneprint.points`.

frame | query | match  --PointClouds-->  Output
"""

from __future__ import annotations

import numpy as np

from sceneprint.engine.indexed import FORM, find_indexed, geometry_of
from sceneprint.engine.kept import KeptQueries
from sceneprint.engine.made import Output
from sceneprint.engine.outputs import placed
from sceneprint.engine.pairs import Pairs, check_geometry, geometry_of_query
from sceneprint.engine.tags import tag_of
from sceneprint.errors import InvalidRequest
from sceneprint.geometry.agreement import sampled
from sceneprint.geometry.belonging import patches_at
from sceneprint.geometry.rigid import inverse, moved
from sceneprint.geometry.traces import Verdicts, residuals
from sceneprint.points import LIMIT, encode_points, thinned
from sceneprint.schemas.kept import OverlayTransform, PointsSide
from sceneprint.schemas.outputs import CloudFrame
from sceneprint.store import Store
from sceneprint.types import Floats, Floats32, Geometry


class PointClouds:
    """Points to be drawn.

    Parameters
    ----------
    store, pairs : of the engine
    kept : the answers
    """

    def __init__(self, store: Store, pairs: Pairs, kept: KeptQueries) -> None:
        self._store, self._pairs, self._kept = store, pairs, kept

    def frame(
        self, map_name: str, frame_id: str, within: CloudFrame = "optical", limit: int = LIMIT
    ) -> Output[bytes]:
        """Points of a frame, with normals and patches. Parameters and errors as of
        `Outputs.cloud`.
        """
        found = find_indexed(self._store, map_name, frame_id)
        name, matrix = placed(found.frame, within)

        def make() -> bytes:
            geometry = geometry_of(self._store, found)
            points, total = _some(geometry, limit)
            return _encoded(geometry, points, total, np.array(matrix))

        tag = found.tag("points", found.frame.id, found.row.name, name, matrix, limit)
        return Output(tag, make)

    def query(self, query_id: str, limit: int = LIMIT) -> Output[bytes]:
        """Points of a kept query in its sensor's frame, with normals and patches.

        Raises
        ------
        UnknownQuery : it is not kept, or no longer.
        NotIndexed : it was asked without validation.
        """
        kept = self._kept.find(query_id)
        check_geometry(kept)

        def make() -> bytes:
            geometry = geometry_of_query(kept)
            points, total = _some(geometry, limit)
            return _encoded(geometry, points, total)

        return Output(tag_of("points of a query", FORM, query_id, limit), make)

    def match(
        self, query_id: str, frame_id: str, map_name: str | None = None,
        side: PointsSide = "query", by: OverlayTransform = "aligned", limit: int = LIMIT,
    ) -> Output[bytes]:  # fmt: skip
        """Points of a query or of one of its matches, each in its own sensor's frame, with
        normals, patches, and how far they are from the other's surface; without that where the
        frames gave no transform.

        Parameters
        ----------
        query_id, frame_id, map_name : see `Pairs.find`
        side : whose points
        by : under which transform they are compared
        limit : most points

        Raises
        ------
        UnknownQuery, UnknownMap, UnknownFrame, NotIndexed, DamagedBlob, UnreadableGeometry : see
            `Pairs.find` and `Pairs.opened`.
        InvalidRequest : there is no rival; raised when it is made.
        """
        pair = self._pairs.find(query_id, frame_id, map_name)

        def make() -> bytes:
            query, match = self._pairs.opened(pair)
            T: Floats | None = np.eye(4)
            if by != "none":
                v = self._pairs.validated(pair, query, match)
                T = v.T_match_query if by == "aligned" else v.T_rival
            if by == "rival" and T is None:
                raise InvalidRequest(
                    f"Frame {frame_id} has no rival with query {query_id}: {v.reason}. Ask for "
                    "transform=aligned.",
                    (("transform", "there is no rival"),),
                )
            mine, other = (query, match) if side == "query" else (match, query)
            points, total = _some(mine, limit)
            if T is None:
                return _encoded(mine, points, total)
            T = T if side == "query" else inverse(T)
            p = self._pairs.parameters(pair).agreement
            apart = residuals(points, other.surface, T, p)
            return _encoded(mine, points, total, residuals=apart, scale=p.surface_tolerance)

        tag = tag_of("points of a match", FORM, query_id, pair.blob, side, by, limit)
        return Output(tag, make)


def _some(geometry: Geometry, limit: int) -> tuple[Floats32, int]:
    """Points and normals (N, 6), at most so many, and of how many."""
    every = sampled(geometry.surface, 1)
    return np.ascontiguousarray(every[thinned(len(every), limit)]), len(every)


def _encoded(
    geometry: Geometry, points: Floats32, total: int, T: Floats | None = None,
    residuals: Verdicts | None = None, scale: float = 0.0,
) -> bytes:  # fmt: skip
    at, normals = points[:, :3].astype(float), points[:, 3:].astype(float)
    if T is not None:
        at, normals = moved(T, at), normals @ T[:3, :3].T
    patches = patches_at(points, geometry.patches)
    return encode_points(at, normals, patches, residuals, total=total, scale=scale)
