"""Tests of signatures of clouds: near those of depth images, and invariant to rotation."""

import time
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tqdm import tqdm

from sceneprint.errors import UselessFrame
from sceneprint.formats.dataset import find_sequences
from sceneprint.geometry.retrieval.ranking import distances
from sceneprint.geometry.rigid import rotation_angle
from sceneprint.geometry.surface.cloud import CloudParameters
from sceneprint.geometry.surface.depth_image import DepthParameters
from sceneprint.geometry.surface.voxels import Voxels
from sceneprint.pipeline import distance, geometry_of, open_signer, prepare, see, sign
from sceneprint.types import Cloud

FAR_M = 0.5

FAR_RAD = np.radians(30.0)


def cloud_of(frame, seed, R=None, *, has_viewpoint=True):
    """All samples of a depth frame that are in range, in no order, turned by R."""
    k, p = frame.intrinsics, DepthParameters()
    y, x = np.nonzero((frame.depth >= p.minimum_depth) & (frame.depth <= p.maximum_depth))
    z = frame.depth[y, x].astype(float)
    points = np.column_stack([(x - k.cx) / k.fx * z, (y - k.cy) / k.fy * z, z])
    if R is not None:
        points = points @ R.T
    shuffled = points[np.random.default_rng(seed).permutation(len(points))]
    return Cloud(shuffled.astype(np.float32), has_viewpoint, frame.name, frame.pose)


def any_rotation(seed):
    """A rotation drawn uniformly: (3, 3)."""
    q, r = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    if np.linalg.det(q) < 0:
        q[:, 0] *= -1
    return np.asarray(q, float)


def are_far(frames):
    """(N, N), by pose."""
    poses = np.stack([frame.pose for frame in frames if frame.pose is not None])
    apart = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=2) > FAR_M
    turned = [[rotation_angle(a[:3, :3].T @ b[:3, :3]) > FAR_RAD for b in poses] for a in poses]
    return apart | np.array(turned)


def own_is_nearest(queries, database, own, far, metric):
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


def signed(frames, signer, what):
    """Signatures (N, L), and the seconds that each took."""
    rows, seconds = [], []
    for frame in tqdm(frames, desc=what, unit="frame", disable=None):
        begun = time.perf_counter()
        rows.append(sign(frame, signer).vector)
        seconds.append(time.perf_counter() - begun)
    return np.stack(rows), seconds


def same_points(frames, chosen, signer, *, has_viewpoint=True):
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


def turned(database, queries, signer, *, has_viewpoint=True):
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


def grid(n, low, high):
    a, b = np.meshgrid(np.linspace(low, high, n), np.linspace(low, high, n))
    return a.reshape(-1), b.reshape(-1)


def wall():
    a, b = grid(120, -1.5, 1.5)
    return np.column_stack([np.full(len(a), 2.0), a, b])


def clusters():
    rng = np.random.default_rng(0)
    return np.concatenate([rng.normal(x, 0.05, (2000, 3)) for x in (-3.0, 3.0)])


DEGENERATE = {
    "ten points": (lambda: np.eye(10, 3) + 1, "10 points are too few"),
    "no points": (lambda: np.zeros((0, 3)), "0 points are too few"),
    "one point": (lambda: np.ones((5000, 3)), "fill 1 voxels"),
    "one line": (lambda: np.linspace([2, -2, 0], [2, 2, 0], 5000), "do not lie on a surface"),
    "one ray": (lambda: np.linspace([0, 0, 0.5], [0, 0, 9], 5000), "voxels"),
    "millimetres": (lambda: wall() * 1000, "millimetres"),
    "at the viewpoint": (lambda: np.zeros((5000, 3)), "0 of its 5000 points"),
    "far away": (lambda: wall() + 9000, "0 of its 14400 points"),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_what_shows_nothing_is_refused_with_a_reason(small_signer, name):
    make, says = DEGENERATE[name]
    with pytest.raises(UselessFrame, match=f"scan.*{says}"):
        prepare(Cloud(make().astype(np.float32), name="scan"), small_signer)


@pytest.mark.parametrize("points", [wall, clusters])
@pytest.mark.parametrize("has_viewpoint", [True, False])
def test_little_is_signed_all_the_same(small_signer, points, has_viewpoint):
    cloud = Cloud(points().astype(np.float32), has_viewpoint)
    signature, geometry = prepare(cloud, small_signer)
    assert signature.n_pairs[0] > 0
    assert geometry.surface.valid.any()
    assert (geometry.surface.camera is not None) == has_viewpoint
    assert len(geometry.patches) > 0


@settings(max_examples=25)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(0, 400),
    scale=st.sampled_from([1e-6, 0.1, 1.0, 3.0, 1e4]),
    flatness=st.sampled_from([0.0, 1e-4, 1.0]),
    copies=st.integers(1, 3),
    has_viewpoint=st.booleans(),
)
def test_any_points_are_signed_or_refused(
    small_signer, seed, n, scale, flatness, copies, has_viewpoint
):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(n, 3)) * [1, 1, flatness] @ any_rotation(seed) + rng.normal(size=3)
    cloud = Cloud(np.tile(points * scale, (copies, 1)).astype(np.float32), has_viewpoint)
    try:
        signature, geometry = prepare(cloud, small_signer)
    except UselessFrame:
        return
    assert len(signature.vector) == small_signer.model.signature_bytes
    assert np.isfinite(geometry.surface.points).all()
    assert np.isfinite(geometry.patches.means).all()


def test_points_in_any_order_are_one_cloud(small_signer, room_frames):
    for has_viewpoint in (True, False):
        made = [
            prepare(cloud_of(room_frames[0], seed, has_viewpoint=has_viewpoint), small_signer)
            for seed in (1, 2)
        ]
        (a, of_a), (b, of_b) = made
        assert a.vector.tobytes() == b.vector.tobytes()
        assert of_a.surface.points.tobytes() == of_b.surface.points.tobytes()
        assert of_a.descriptors.tobytes() == of_b.descriptors.tobytes()


def test_a_cloud_is_near_its_own_depth_image(small_signer, room_frames):
    depth = [sign(frame, small_signer) for frame in room_frames]
    for i, frame in enumerate(room_frames[:3]):
        cloud = sign(cloud_of(frame, i), small_signer)
        d = [distance(cloud, one) for one in depth]
        assert int(np.argmin(d)) == i
        turned_ = sign(cloud_of(frame, i, any_rotation(i)), small_signer)
        assert distance(cloud, turned_) < 0.5 * sorted(d)[1]


def test_an_artifact_has_the_range_image(small_signer, room_frames):
    p = small_signer.model.parameters
    seen = see(cloud_of(room_frames[0], 0), p)
    assert isinstance(seen, Voxels)
    made = geometry_of(seen, small_signer.model)
    assert made.surface.valid.shape[0] > 50
    coarser = replace(p, cloud=CloudParameters(image_angle=2 / 146))
    small = geometry_of(seen, replace(small_signer.model, parameters=coarser))
    assert small.surface.valid.size == pytest.approx(made.surface.valid.size / 4, rel=0.05)


def test_nearest_by_hand():
    database = np.array([[0, 0], [10, 0], [200, 0]], np.uint8)
    queries = np.array([[2, 0], [9, 0]], np.uint8)
    far = np.array([[False, True, True], [True, False, True]])
    assert own_is_nearest(queries, database, np.array([0, 2]), far, "l1")[0] == 0.5
    share, margin = own_is_nearest(queries, database, np.array([0, 1]), far, "l1")
    assert (share, margin) == (1.0, pytest.approx((2 / 8 + 1 / 9) / 2))


def test_real_clouds_are_near_their_depth_images_and_may_turn(data_root):
    """A few frames of what docs/evaluation.md tells of clouds."""
    references = find_sequences(data_root / "7scenes" / "redkitchen")[0].frames
    signer = open_signer("paper")
    room = [one.read_depth() for one in references[::200]]
    assert are_far(room).sum() > 8
    there, back, margin, _ = same_points(room, np.arange(len(room)), signer)
    assert (there, back) == (1.0, 1.0)
    assert margin < 0.7
    same, change = turned(room, [one.read_depth() for one in references[60::500]], signer)
    assert same == 1.0
    assert change < 0.1
