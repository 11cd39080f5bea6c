"""Clouds beside depth images, and turned clouds: `python -m benchmarks.clouds SCENE`.

Every cloud is a depth frame's own samples at full resolution, back-projected and shuffled.

same points: among a cloud's own depth frame and all others of the room that are more than 0.5 m or
30 degrees away, the own one is nearest; and the other way round, among clouds.
turned: in a database of clouds (0-599 step 2; queries 650-999 step 2), a query turned by a random
rotation about its viewpoint has the same first match.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from sceneprint.datasets import find_sequences
from sceneprint.geometry.depth import DepthParameters
from sceneprint.geometry.retrieval import Metric, distances
from sceneprint.geometry.rigid import rotation_angle
from sceneprint.pipeline import Signer, open_signer, sign
from sceneprint.types import AnyFrame, Bytes, Cloud, Floats, Frame

FAR_M = 0.5
FAR_RAD = np.radians(30.0)


@dataclass(frozen=True)
class Figures:
    """What one model gives; shares of frames.

    Parameters
    ----------
    frames : clouds compared with depth frames
    own_depth, own_cloud : whose own is the nearest, from cloud to depth and from depth to cloud
    margin : mean distance of the own, in distances of the nearest that is far
    turned : queries whose first match is the same when they are turned
    turned_margin : mean distance of a query and itself turned, in distances of the first match
    milliseconds : median time of one cloud's signature
    """

    model: str
    has_viewpoint: bool
    frames: int
    own_depth: float
    own_cloud: float
    margin: float
    queries: int
    turned: float
    turned_margin: float
    milliseconds: float


def cloud_of(
    frame: Frame, seed: int, R: Floats | None = None, *, has_viewpoint: bool = True
) -> Cloud:
    """All samples of a depth frame that are in range, in no order, turned by R."""
    k, p = frame.intrinsics, DepthParameters()
    y, x = np.nonzero((frame.depth >= p.minimum_depth) & (frame.depth <= p.maximum_depth))
    z = frame.depth[y, x].astype(float)
    points = np.column_stack([(x - k.cx) / k.fx * z, (y - k.cy) / k.fy * z, z])
    if R is not None:
        points = points @ R.T
    shuffled = points[np.random.default_rng(seed).permutation(len(points))]
    return Cloud(shuffled.astype(np.float32), has_viewpoint, frame.name, frame.pose)


def any_rotation(seed: int) -> Floats:
    """A rotation drawn uniformly: (3, 3)."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    if np.linalg.det(q) < 0:
        q[:, 0] *= -1
    return np.asarray(q, float)


def are_far(frames: Sequence[Frame]) -> NDArray[np.bool_]:
    """(N, N), by pose."""
    poses = np.stack([frame.pose for frame in frames if frame.pose is not None])
    apart = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=2) > FAR_M
    turned = [[rotation_angle(a[:3, :3].T @ b[:3, :3]) > FAR_RAD for b in poses] for a in poses]
    result: NDArray[np.bool_] = apart | np.array(turned)
    return result


def own_is_nearest(
    queries: Bytes, database: Bytes, own: NDArray[np.intp], far: NDArray[np.bool_], metric: Metric
) -> tuple[float, float]:
    """Share of queries whose own row of the database is nearer than any far one, and the margin.

    Parameters
    ----------
    queries, database : (Q, L), (D, L) signatures
    own : (Q,) index of each query's own in the database
    far : (Q, D) who it is to be told from
    metric : of the signatures
    """
    ratios = []
    for query, mine, others in zip(queries, own, far, strict=True):
        d = distances(query, database, metric).astype(float)
        ratios.append(d[mine] / d[others].min())
    return float(np.mean(np.array(ratios) < 1)), float(np.mean(ratios))


def signed(frames: Sequence[AnyFrame], signer: Signer, what: str) -> tuple[Bytes, list[float]]:
    """Signatures (N, L), and the seconds that each took."""
    rows, seconds = [], []
    for frame in tqdm(frames, desc=what, unit="frame", disable=None):
        begun = time.perf_counter()
        rows.append(sign(frame, signer).vector)
        seconds.append(time.perf_counter() - begun)
    return np.stack(rows), seconds


def same_points(
    frames: Sequence[Frame], chosen: NDArray[np.intp], signer: Signer, *, has_viewpoint: bool = True
) -> tuple[float, float, float, float]:
    """Of the chosen frames as clouds: see own_depth, own_cloud, margin, milliseconds."""
    far = are_far(frames)
    depth, _ = signed(frames, signer, "depth")
    clouds, seconds = signed(
        [cloud_of(frames[i], int(i), has_viewpoint=has_viewpoint) for i in chosen], signer, "clouds"
    )
    there, margin = own_is_nearest(clouds, depth, chosen, far[chosen], signer.model.metric)
    back, _ = own_is_nearest(
        depth[chosen],
        clouds,
        np.arange(len(chosen)),
        far[np.ix_(chosen, chosen)],
        signer.model.metric,
    )
    return there, back, margin, float(np.median(seconds) * 1e3)


def turned(
    database: Sequence[Frame], queries: Sequence[Frame], signer: Signer, *,
    has_viewpoint: bool = True,
) -> tuple[float, float]:  # fmt: skip
    """Share of queries with the same first match when turned, and how far turning takes them."""
    d, _ = signed(
        [cloud_of(f, i, has_viewpoint=has_viewpoint) for i, f in enumerate(database)],
        signer,
        "database",
    )
    same, margins, metric = [], [], signer.model.metric
    for seed, frame in enumerate(tqdm(queries, desc="turned", unit="frame", disable=None)):
        plain = sign(cloud_of(frame, seed, has_viewpoint=has_viewpoint), signer).vector
        R = any_rotation(seed)
        other = sign(cloud_of(frame, seed + 1, R, has_viewpoint=has_viewpoint), signer).vector
        first, then = distances(plain, d, metric), distances(other, d, metric)
        same.append(first.argmin() == then.argmin())
        margins.append(distances(plain, other[None], metric)[0] / first.min())
    return float(np.mean(same)), float(np.mean(margins))


def main() -> int:
    """Print a row per model, and JSON where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scene", type=Path, help="folder of 7-Scenes redkitchen")
    parser.add_argument("--model", action="append", help="preset or model file; default: paper")
    parser.add_argument("--frames", type=int, default=100, help="clouds compared with depth frames")
    parser.add_argument("--database-step", type=int, default=2, help="of frames 0-599")
    parser.add_argument("--query-step", type=int, default=2, help="of frames 650-999")
    parser.add_argument("--fused", action="store_true", help="as clouds without a viewpoint")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    references = find_sequences(options.scene)[0].frames
    room = [reference.read_depth() for reference in references[::2]]
    chosen = np.linspace(0, len(room) - 1, options.frames).astype(np.intp)
    database = [r.read_depth() for r in references[0 : 600 : options.database_step]]
    queries = [r.read_depth() for r in references[650 : 1000 : options.query_step]]
    rows = []
    print("model     frames  own depth  own cloud  margin  queries  turned  margin  ms a cloud")
    for model in options.model or ["depth"]:
        signer, seen = open_signer(model), not options.fused
        there, back, margin, ms = same_points(room, chosen, signer, has_viewpoint=seen)
        same, change = turned(database, queries, signer, has_viewpoint=seen)
        r = Figures(
            signer.model.label,
            seen,
            len(chosen),
            there,
            back,
            margin,
            len(queries),
            same,
            change,
            ms,
        )
        rows.append(r)
        print(
            f"{model:9} {r.frames:6}  {r.own_depth:9.3f}  {r.own_cloud:9.3f}  {r.margin:6.3f}  "
            f"{r.queries:7}  {r.turned:6.3f}  {r.turned_margin:6.3f}  {r.milliseconds:10.0f}",
            flush=True,
        )
    if options.json:
        options.json.write_text(json.dumps([asdict(r) for r in rows], indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
