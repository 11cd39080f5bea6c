"""Tests of signatures of clouds: near those of depth images, and invariant to rotation."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sceneprint.errors import UselessFrame
from sceneprint.geometry.surface.depth_image import DepthParameters
from sceneprint.pipeline import distance, prepare, sign
from sceneprint.types import Cloud


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


def wall():
    a, b = (x.ravel() for x in np.meshgrid(*[np.linspace(-1.5, 1.5, 120)] * 2))
    return np.column_stack([np.full(len(a), 2.0), a, b])


DEGENERATE = {
    "no points": (lambda: np.zeros((0, 3)), "0 points are too few"),
    "one point": (lambda: np.ones((5000, 3)), "fill 1 voxels"),
    "one line": (lambda: np.linspace([2, -2, 0], [2, 2, 0], 5000), "do not lie on a surface"),
    "millimetres": (lambda: wall() * 1000, "millimetres"),
    "far away": (lambda: wall() + 9000, "0 of its 14400 points"),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_what_shows_nothing_is_refused_with_a_reason(small_signer, name):
    make, says = DEGENERATE[name]
    with pytest.raises(UselessFrame, match=f"scan.*{says}"):
        prepare(Cloud(make().astype(np.float32), name="scan"), small_signer)


@pytest.mark.parametrize("has_viewpoint", [True, False])
def test_little_is_signed_all_the_same(small_signer, has_viewpoint):
    rng = np.random.default_rng(0)
    clusters = np.concatenate([rng.normal(x, 0.05, (2000, 3)) for x in (-3.0, 3.0)])
    for points in (wall(), clusters):
        signature, geometry = prepare(Cloud(points.astype(np.float32), has_viewpoint), small_signer)
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
        signatures = [
            prepare(cloud_of(room_frames[0], seed, has_viewpoint=has_viewpoint), small_signer)
            for seed in (1, 2)
        ]
        (a, of_a), (b, of_b) = signatures
        assert a.vector.tobytes() == b.vector.tobytes()
        assert of_a.surface.points.tobytes() == of_b.surface.points.tobytes()
        assert of_a.descriptors.tobytes() == of_b.descriptors.tobytes()


def test_a_cloud_is_near_its_own_depth_image(small_signer, room_frames):
    depth = [sign(frame, small_signer) for frame in room_frames]
    for i, frame in enumerate(room_frames[:3]):
        cloud = sign(cloud_of(frame, i), small_signer)
        d = [distance(cloud, signature) for signature in depth]
        assert int(np.argmin(d)) == i
        turned_ = sign(cloud_of(frame, i, any_rotation(i)), small_signer)
        assert distance(cloud, turned_) < 0.5 * sorted(d)[1]
