"""Local features, aggregated: Open3D's FPFH, and VLAD over a vocabulary of the database.

frame  --features-->  (n, 33)  --vlad-->  (64 * 33,)      two of them  -->  L2 distance

Rusu et al., Fast point feature histograms, ICRA 2009; Jegou et al., Aggregating local descriptors,
CVPR 2010. The vocabulary is learnt on the database that is searched, which favours the baseline:
the model it is held against has never seen a frame of it. Open3D is loaded here for this alone.
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from sceneprint.errors import UselessFrame
from sceneprint.open3d_loader import open3d
from sceneprint.types import AnyFrame, Cloud, Floats, Floats32

#: Voxel of the points, reach of normals and of features, metres, for a sensor of RANGE metres;
#: for others in proportion.
VOXEL, NORMALS, FEATURES, RANGE = 0.05, 0.10, 0.25, 9.0
_WHAT = "The baseline fpfh_vlad"  #: needs Open3D
#: Words of the vocabulary, and features that it is learnt from.
WORDS, LEARNT_FROM = 64, 20_000


def features(points: Floats, scale: float = 1.0) -> Floats32:
    """FPFH of a cloud's voxels.

    Parameters
    ----------
    points : (N, 3) metres, the sensor at the origin
    scale : of VOXEL, NORMALS and FEATURES

    Returns
    -------
    (n, 33) float32, of each of the three histograms the root of its shares, so that L2 between
    two is Hellinger's distance
    """
    o3d = open3d(_WHAT)
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.asarray(points, np.float64)))
    cloud = cloud.voxel_down_sample(VOXEL * scale)
    search = o3d.geometry.KDTreeSearchParamHybrid
    cloud.estimate_normals(search(radius=NORMALS * scale, max_nn=30))
    cloud.orient_normals_towards_camera_location(np.zeros(3))
    fpfh = o3d.pipelines.registration.compute_fpfh_feature(
        cloud, search(radius=FEATURES * scale, max_nn=100)
    )
    found = np.maximum(np.asarray(fpfh.data).T, 0.0).reshape(-1, 3, 11)
    total = found.sum(axis=2, keepdims=True)  # 0 without neighbours
    shares = np.divide(found, total, out=np.zeros_like(found), where=total > 0)
    rooted: Floats32 = np.sqrt(shares).reshape(-1, 33).astype(np.float32)
    return rooted


def vlad(local: Floats32, words: Floats) -> Floats32:
    """Sums of what is left of features less their nearest word: VLAD, intra-normalised.

    Parameters
    ----------
    local : (n, d)
    words : (k, d)

    Returns
    -------
    (k * d,) float32 of length 1, or 0 where every feature is a word
    """
    own = local.astype(np.float64)
    squares = (words**2).sum(axis=1) - 2 * own @ words.T  # and |own|^2, the same for every word
    nearest = squares.argmin(axis=1)
    sums = np.zeros_like(words)
    np.add.at(sums, nearest, own - words[nearest])
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    sums = np.divide(sums, length, out=np.zeros_like(sums), where=length > 0)
    whole = float(np.linalg.norm(sums))
    result: Floats32 = (sums.reshape(-1) / (whole if whole > 0 else 1.0)).astype(np.float32)
    return result


class FpfhVlad:
    """FPFH-VLAD as a baseline, for depth images and clouds.

    Parameters
    ----------
    maximum : the sensor's range, metres; farther points are left out
    """

    name = "fpfh_vlad"

    def __init__(self, maximum: float = RANGE) -> None:
        self.maximum = maximum
        self._words: Floats | None = None

    def check(self) -> None:
        """See `open3d`."""
        open3d(_WHAT)

    def takes(self, frame: AnyFrame) -> bool:  # noqa: ARG002
        """Whether the baseline is made for such a frame: always."""
        return True

    def read(self, frame: AnyFrame) -> Floats32:
        """The local features of a frame.

        Raises
        ------
        MissingDependency : see `open3d`.
        UselessFrame : no point is in range.
        """
        points = _points(frame)
        points = points[np.linalg.norm(points, axis=1) <= self.maximum]
        if not len(points):
            raise UselessFrame(f"{frame.name}: No point lies within {self.maximum:g} m.")
        return features(points, self.maximum / RANGE)

    def learn(self, database: Iterable[Floats32], count: int, seed: int) -> None:
        """The vocabulary: k-means of as many features of every frame of the database."""
        from sklearn.cluster import KMeans

        rng, share = np.random.default_rng(seed), -(-LEARNT_FROM // max(count, 1))
        drawn = [
            one[np.sort(rng.choice(len(one), min(share, len(one)), replace=False))]
            for one in database
        ]
        sample = np.concatenate(drawn).astype(np.float64)
        distinct = len(np.unique(sample, axis=0))  # k-means warns where words would be alike
        means = KMeans(min(WORDS, distinct), n_init=1, random_state=seed).fit(sample)
        self._words = np.asarray(means.cluster_centers_, np.float64)

    def finish(self, kept: Floats32) -> Floats32:
        """The VLAD of a frame's features; after `learn`."""
        if self._words is None:
            raise ValueError("the vocabulary has not been learnt")
        return vlad(kept, self._words)

    def distances(self, query: Floats32, database: Floats32) -> Floats:
        """Euclidean distance of one to each of (N, k * d): (N,)."""
        found: Floats = np.linalg.norm(database.astype(np.float64) - query, axis=1)
        return found


def _points(frame: AnyFrame) -> Floats:
    if isinstance(frame, Cloud):
        return np.asarray(frame.points, np.float64)
    k, depth = frame.intrinsics, frame.depth
    y, x = np.nonzero(depth > 0)
    z = depth[y, x].astype(np.float64)
    return np.stack([(x - k.cx) / k.fx * z, (y - k.cy) / k.fy * z, z], axis=1)
