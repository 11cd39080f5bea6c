"""Cache of signers by model, and warm-up of all kernels before the first request."""

from __future__ import annotations

import logging
import threading
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from sceneprint.errors import Busy, FrameError, ModelError
from sceneprint.formats.artifact import read_geometry, write_geometry
from sceneprint.geometry.registration.overlap import sample_points
from sceneprint.geometry.retrieval.ranking import distances, pairwise_distances
from sceneprint.geometry.validation.inspection import patches_at, residuals
from sceneprint.geometry.validation.validation import ValidationParameters
from sceneprint.geometry.views import Renderer, choose_views, view_parameters
from sceneprint.index.index_version import Tail, search
from sceneprint.models import Model, parse_model, read_model
from sceneprint.pipeline import Signer, open_signer, prepare, validate
from sceneprint.store import Database
from sceneprint.store.maps import list_maps, model_content
from sceneprint.store.reencoding_rows import models_of
from sceneprint.types import Cloud, DepthFrame, Geometry, Intrinsics, ReferenceSurface

log = logging.getLogger(__name__)

#: Maximum seconds that a request waits for the compilation of kernels.
KERNELS_S = 20.0


class Signers:
    """Cached signers of the models of a store; safe to share between threads.

    Parameters
    ----------
    cache_dir : folder of pair tables
    """

    def __init__(self, database: Database, cache_dir: Path) -> None:
        self.database, self._cache_dir = database, cache_dir
        self._lock = threading.Lock()
        self._open: dict[str, Signer] = {}
        self._compiled = threading.Event()
        self._compiled.set()

    def hold(self) -> None:
        """Make signing and validation wait, while another process compiles kernels."""
        self._compiled.clear()

    def release(self) -> None:
        """Let signing and validation proceed after `hold`."""
        self._compiled.set()

    def require_kernels(self, wait_s: float | None = None) -> None:
        """Wait for compiled kernels; raise Busy after `wait_s` seconds (default: KERNELS_S)."""
        if not self._compiled.wait(KERNELS_S if wait_s is None else wait_s):
            raise Busy(
                "The kernels of the service are being compiled. The first start after an "
                "installation takes about half a minute. Retry in a few seconds."
            )

    def __call__(self, model_id: str) -> Signer:
        """Return the signer of a stored model.

        Raises
        ------
        UnreadableModel : If another version of sceneprint stored the model.
        Busy : If kernels are still being compiled.
        """
        self.require_kernels()
        with self._lock:  # avoid building the same table twice
            if model_id not in self._open:
                with self.database.read() as connection:
                    content = model_content(connection, model_id)
                model = parse_model(content, f"model {model_id[:12]}")
                self._open[model_id] = open_signer(model, self._cache_dir)
            return self._open[model_id]

    def of(self, model: Model) -> Signer:
        """Return the signer of any model, stored or not; raise Busy while kernels are compiled."""
        self.require_kernels()
        with self._lock:
            if model.id not in self._open:
                self._open[model.id] = open_signer(model, self._cache_dir)
            return self._open[model.id]

    def warm(self) -> None:
        """Load the kernels and the tables of all models in use; log unusable models."""
        with self.database.read() as connection:
            used = {model_id for row in list_maps(connection) for model_id in models_of(row)}
        for model_id in used:
            try:
                warm(self(model_id))
            except ModelError as error:
                log.error("model unusable", extra={"model": model_id, "error": str(error)})


def warm(signer: Signer, *, clouds: bool = False) -> bool:
    """Compile or load all kernels: sign, search and validate the image of a corner of a room.

    Parameters
    ----------
    signer : signer, whose table is loaded
    clouds : whether to include the kernels of clouds

    Returns
    -------
    is_complete : whether all stages have run; False if the corner is out of the range of the model
    """
    p = signer.model.parameters.validation
    with suppress(FrameError):
        geometry = read_geometry(warm_signing(signer))
        if clouds:
            warm_clouds(signer, geometry)
        return warm_validation(geometry, p)
    return False


def warm_signing(signer: Signer) -> bytes:
    """Sign and search the image of a corner; return its artifact."""
    signature, geometry = prepare(_corner(), signer)
    metric, rows = signer.model.metric, signature.vector[None].copy()
    search(signature.vector, None, Tail(np.zeros(1, np.int64), rows), 1, metric=metric)
    pairwise_distances(rows, metric)
    rows.flags.writeable = False  # kernels are compiled separately for read-only arrays
    distances(signature.vector.copy(), rows, metric)
    return write_geometry(geometry)


def warm_validation(geometry: Geometry, p: ValidationParameters) -> bool:
    """Validate a geometry against itself, and draw it; return whether it was accepted."""
    drawn = sample_points(geometry.surface, 1)  # the dashboard draws all points
    patches_at(drawn, geometry.patches)
    residuals(drawn, geometry.surface, np.eye(4), p.agreement)
    return validate(geometry, geometry, p=p).status == "accepted"


def warm_clouds(signer: Signer, geometry: Geometry) -> None:
    """Sign and validate the corner as a point cloud, with and without a viewpoint."""
    p = signer.model.parameters.validation
    for has_viewpoint in (True, False):
        _, points = prepare(_cloud(_corner(), has_viewpoint=has_viewpoint), signer)
        validate(geometry, read_geometry(write_geometry(points)), p=p)


def warm_views() -> None:
    """Choose and render views of a small room, as a cloud and as a mesh."""
    model = read_model("depth").parameters
    camera = view_parameters(model, Intrinsics(40, 30, 36, 36, 19.5, 14.5))
    corners = np.array([[x, y, z] for x in (0, 3) for y in (0, 3) for z in (0, 2.5)], np.float32)
    sides = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
    faces = np.array([t for a, b, c, d in sides for t in ((c, b, a), (d, c, a))], np.int32)
    grid = np.stack(np.meshgrid(*[np.arange(0.0, 3.01, 0.1)] * 3), axis=-1).reshape(-1, 3)
    walls = grid[((grid < 0.05) | (grid > 2.95)).any(axis=1)].astype(np.float32)
    up = np.array([0.0, 0.0, 1.0])
    for points, triangles in ((corners, faces), (walls, None)):
        surface = ReferenceSurface(points, triangles, np.zeros(3), up)
        for parameters in (camera, replace(camera, camera=None, step=0.1)):
            plan = choose_views(surface, parameters)
            Renderer(surface, parameters).view(plan.poses[0])


def _corner() -> DepthFrame:
    """Return a depth image of a wall, a floor and a box at a distance of two metres."""
    camera = Intrinsics(256, 192, 220, 220, 127.5, 95.5)
    y, x = np.mgrid[0:192, 0:256]
    right, down = (x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy
    wall, floor = 2.4 / np.maximum(1 + right, 0.1), 1.2 / np.maximum(down, 0.01)
    box = np.where((abs(right - 0.1) < 0.2) & (down > 0.1), 1.5, np.inf)
    return DepthFrame(np.minimum.reduce([wall, floor, box]).astype(np.float32), camera)


def _cloud(frame: DepthFrame, *, has_viewpoint: bool) -> Cloud:
    """Convert a depth image to a point cloud, with or without a viewpoint."""
    k = frame.intrinsics
    v, u = np.nonzero(frame.depth)
    z = frame.depth[v, u]
    points = np.stack([(u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z], axis=1)
    return Cloud(points.astype(np.float32), has_viewpoint)
