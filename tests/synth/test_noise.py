from dataclasses import replace

import numpy as np
import pytest

from sceneprint_lab.synth import KINECT, KINECT_V1, kinect_noise

SHAPE = (480, 640)
FACING = np.ones(SHAPE, np.float32)
GAIN = KINECT.fx * KINECT_V1.baseline
QUIET = replace(
    KINECT_V1, disparity_sigma=0.0, warp=0.0, edge_jitter=0.0, speckle=0.0, disparity_step=1e-6
)


def wall(z: float) -> np.ndarray:
    return np.full(SHAPE, z, np.float32)


def noisy(depth, cosine=FACING, parameters=KINECT_V1, loss=None, seed=0):
    return kinect_noise(depth, cosine, KINECT, np.random.default_rng(seed), parameters, loss)


@pytest.mark.parametrize(("z", "low", "high"), [(1.0, 1.2e-3, 2.2e-3), (3.0, 11e-3, 20e-3)])
def test_sigma_grows_with_the_square_of_depth(z, low, high):
    measured = noisy(wall(z))
    valid = measured > 0
    assert valid.mean() > 0.99
    assert low < measured[valid].std() < high
    assert abs(measured[valid].mean() - z) < 2e-3 * z * z


def test_disparity_comes_in_eighths():
    slope = np.broadcast_to(np.linspace(1, 4, 640, dtype=np.float32), SHAPE)
    measured = noisy(slope)
    eighths = 8 * GAIN / measured[measured > 0].astype(float)
    np.testing.assert_allclose(eighths, eighths.round(), atol=1e-3)
    assert len(np.unique(eighths.round())) > 100


def test_noise_of_neighbours_is_alike_and_of_strangers_is_not():
    error = GAIN / noisy(wall(2.0), parameters=replace(KINECT_V1, warp=0.0, speckle=0.0)) - GAIN / 2
    error -= error.mean()

    def alike(pixels):
        return (error[:, pixels:] * error[:, :-pixels]).mean() / error.var()

    assert 0.45 < alike(1) < 0.85
    assert abs(alike(12)) < 0.05


def test_shadow_lies_left_of_what_is_near_and_is_as_wide_as_the_disparities_differ():
    scene = wall(3.0)
    scene[:, 300:] = 1.0
    valid = noisy(scene, parameters=replace(QUIET, shadow_growth=1)) > 0
    width = GAIN / 1.0 - GAIN / 3.0  # 29.25 px
    assert (~valid).sum(axis=1).tolist() == [int(width - QUIET.shadow_margin)] * 480
    assert not valid[:, 272:300].any()
    assert (noisy(scene[:, ::-1], parameters=QUIET)[:, 345:] > 0).all()  # none on the right


def test_edges_are_ragged_but_planes_are_not_bent():
    scene = wall(1.5)
    scene[:, :300] = 1.0  # the near side on the left: no shadow
    measured = noisy(scene, parameters=replace(QUIET, edge_jitter=0.9))
    border = np.argmax(measured > 1.25, axis=1)
    assert 0.2 < border.std() < 2.0
    assert 297 <= border.min() <= border.max() <= 303 + 3
    np.testing.assert_allclose(measured[:, :290], 1.0, rtol=1e-5)
