"""Loading all code and tables before the first request asks for them."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from sceneprint.artifacts import read_geometry, write_geometry
from sceneprint.datasets.unfiltering import unfilter
from sceneprint.errors import FrameError
from sceneprint.geometry.agreement import sampled
from sceneprint.geometry.belonging import patches_at
from sceneprint.geometry.retrieval import distances, pairwise_distances
from sceneprint.geometry.traces import residuals
from sceneprint.index import Tail, search
from sceneprint.pipeline import Signer, prepare, validate
from sceneprint.types import Cloud, Frame, Intrinsics


def warm(signer: Signer, *, clouds: bool = False) -> bool:
    """Sign, search and validate a corner of a room, so that kernels are compiled or loaded.

    Parameters
    ----------
    signer : whose table is touched
    clouds : do it with clouds too, with and without a viewpoint: their kernels take longest to
        compile, and little to load once they are compiled

    Returns
    -------
    whole : the corner was recognised, so every stage has run; False where a model of another
        range sees nothing there
    """
    unfilter(np.frombuffer(bytes(5), np.uint8).reshape(1, 5))  # of a PNG
    corner, p = _corner(), signer.model.parameters.validation
    metric = signer.model.metric
    with suppress(FrameError):
        signature, seen = prepare(corner, signer)
        rows = signature.vector[None].copy()
        search(signature.vector, None, Tail(np.zeros(1, np.int64), rows), 1, metric=metric)
        pairwise_distances(rows, metric)
        rows.flags.writeable = False  # as a mapped file is: another compilation
        distances(signature.vector.copy(), rows, metric)
        geometry = read_geometry(write_geometry(seen))
        drawn = sampled(geometry.surface, 1)  # as a page asks for them
        patches_at(drawn, geometry.patches)
        residuals(drawn, geometry.surface, np.eye(4), p.agreement)
        for has_viewpoint in (True, False) if clouds else ():
            _, points = prepare(_cloud(corner, has_viewpoint=has_viewpoint), signer)
            validate(geometry, read_geometry(write_geometry(points)), p=p)
        return validate(geometry, geometry, p=p).status == "accepted"
    return False


def _corner() -> Frame:
    """A wall, a floor and a box that stands off the middle, two metres away."""
    camera = Intrinsics(256, 192, 220, 220, 127.5, 95.5)
    y, x = np.mgrid[0:192, 0:256]
    right, down = (x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy
    wall, floor = 2.4 / np.maximum(1 + right, 0.1), 1.2 / np.maximum(down, 0.01)
    box = np.where((abs(right - 0.1) < 0.2) & (down > 0.1), 1.5, np.inf)
    return Frame(np.minimum.reduce([wall, floor, box]).astype(np.float32), camera)


def _cloud(frame: Frame, *, has_viewpoint: bool) -> Cloud:
    """What a depth image shows, as points."""
    k = frame.intrinsics
    v, u = np.nonzero(frame.depth)
    z = frame.depth[v, u]
    points = np.stack([(u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z], axis=1)
    return Cloud(points.astype(np.float32), has_viewpoint)
