"""Clouds signed beside depth images: the same points are near, turned ones are the same."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from benchmarks.clouds import any_rotation, are_far, cloud_of, own_is_nearest, same_points, turned
from sceneprint.datasets import find_sequences
from sceneprint.errors import UselessFrame
from sceneprint.geometry.clouds import CloudParameters
from sceneprint.geometry.voxels import Voxels
from sceneprint.pipeline import Signer, distance, geometry_of, open_signer, prepare, see, sign
from sceneprint.types import Cloud, Floats, Frame


def grid(n: int, low: float, high: float) -> tuple[Floats, Floats]:
    a, b = np.meshgrid(np.linspace(low, high, n), np.linspace(low, high, n))
    return a.reshape(-1), b.reshape(-1)


def wall() -> Floats:
    a, b = grid(120, -1.5, 1.5)
    return np.column_stack([np.full(len(a), 2.0), a, b])


def clusters() -> Floats:
    rng = np.random.default_rng(0)
    return np.concatenate([rng.normal(x, 0.05, (2000, 3)) for x in (-3.0, 3.0)])


DEGENERATE: dict[str, tuple[Callable[[], Floats], str]] = {
    "ten points": (lambda: np.eye(10, 3) + 1, "10 points are too few"),
    "no points": (lambda: np.zeros((0, 3)), "0 points are too few"),
    "one point": (lambda: np.ones((5000, 3)), "fill 1 voxels"),
    "one line": (lambda: np.linspace([2, -2, 0], [2, 2, 0], 5000), "lie on no surface"),
    "one ray": (lambda: np.linspace([0, 0, 0.5], [0, 0, 9], 5000), "voxels"),
    "millimetres": (lambda: wall() * 1000, "if the coordinates are millimetres"),
    "at the viewpoint": (lambda: np.zeros((5000, 3)), "0 of its 5000 points"),
    "far away": (lambda: wall() + 9000, "0 of its 14400 points"),
}


@pytest.mark.parametrize("name", DEGENERATE)
def test_what_shows_nothing_is_refused_with_a_reason(small_signer: Signer, name: str) -> None:
    make, says = DEGENERATE[name]
    with pytest.raises(UselessFrame, match=f"scan.*{says}"):
        prepare(Cloud(make().astype(np.float32), name="scan"), small_signer)


@pytest.mark.parametrize("points", [wall, clusters])
@pytest.mark.parametrize("has_viewpoint", [True, False])
def test_little_is_signed_all_the_same(
    small_signer: Signer, points: Callable[[], Floats], has_viewpoint: bool
) -> None:
    cloud = Cloud(points().astype(np.float32), has_viewpoint)
    signature, geometry = prepare(cloud, small_signer)
    assert signature.n_pairs[0] > 0
    assert geometry.surface.valid.any()
    assert (geometry.surface.camera is not None) == has_viewpoint
    assert len(geometry.patches) > 0


@settings(max_examples=25, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    n=st.integers(0, 400),
    scale=st.sampled_from([1e-6, 0.1, 1.0, 3.0, 1e4]),
    flatness=st.sampled_from([0.0, 1e-4, 1.0]),
    copies=st.integers(1, 3),
    has_viewpoint=st.booleans(),
)
def test_any_points_are_signed_or_refused(
    small_signer: Signer, seed: int, n: int, scale: float, flatness: float, copies: int,
    has_viewpoint: bool,
) -> None:  # fmt: skip
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


def test_points_in_any_order_are_one_cloud(
    small_signer: Signer, room_frames: tuple[Frame, ...]
) -> None:
    for has_viewpoint in (True, False):
        made = [
            prepare(cloud_of(room_frames[0], seed, has_viewpoint=has_viewpoint), small_signer)
            for seed in (1, 2)
        ]
        (a, of_a), (b, of_b) = made
        assert a.vector.tobytes() == b.vector.tobytes()
        assert of_a.surface.points.tobytes() == of_b.surface.points.tobytes()
        assert of_a.descriptors.tobytes() == of_b.descriptors.tobytes()


def test_a_cloud_is_near_its_own_depth_image(
    small_signer: Signer, room_frames: tuple[Frame, ...]
) -> None:
    depth = [sign(frame, small_signer) for frame in room_frames]
    for i, frame in enumerate(room_frames[:3]):
        cloud = sign(cloud_of(frame, i), small_signer)
        d = [distance(cloud, one) for one in depth]
        assert int(np.argmin(d)) == i
        turned_ = sign(cloud_of(frame, i, any_rotation(i)), small_signer)
        assert distance(cloud, turned_) < 0.5 * sorted(d)[1]


def test_an_artifact_has_the_range_image(
    small_signer: Signer, room_frames: tuple[Frame, ...]
) -> None:
    p = small_signer.model.parameters
    seen = see(cloud_of(room_frames[0], 0), p)
    assert isinstance(seen, Voxels)
    made = geometry_of(seen, small_signer.model)
    assert made.surface.valid.shape[0] > 50
    coarser = replace(p, cloud=CloudParameters(image_angle=2 / 146))
    small = geometry_of(seen, replace(small_signer.model, parameters=coarser))
    assert small.surface.valid.size == pytest.approx(made.surface.valid.size / 4, rel=0.05)


def test_nearest_by_hand() -> None:
    database = np.array([[0, 0], [10, 0], [200, 0]], np.uint8)
    queries = np.array([[2, 0], [9, 0]], np.uint8)
    far = np.array([[False, True, True], [True, False, True]])
    assert own_is_nearest(queries, database, np.array([0, 2]), far, "l1")[0] == 0.5
    share, margin = own_is_nearest(queries, database, np.array([0, 1]), far, "l1")
    assert (share, margin) == (1.0, pytest.approx((2 / 8 + 1 / 9) / 2))


def test_real_clouds_are_near_their_depth_images_and_may_turn(data_root: Path) -> None:
    """A few frames of what `benchmarks.clouds` measures."""
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
