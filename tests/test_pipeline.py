"""Tests of the path from a frame to its stored signature."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

from sceneprint.errors import ModelMismatch, UselessFrame
from sceneprint.geometry.signature.fisher_vector import quantise
from sceneprint.pipeline import distance, sign
from sceneprint.signing import describe, encode, float_signature, open_signer, table_statistics
from sceneprint.types import DepthFrame, Intrinsics

CAMERA = Intrinsics(640, 480, 585.0, 585.0, 320.0, 240.0)


def flat(depth, camera=CAMERA):
    return DepthFrame(np.full((camera.height, camera.width), depth, np.float32), camera, "wall")


def test_a_signature_has_the_size_of_its_model(small_signer, room_frames):
    signature = sign(room_frames[0], small_signer)
    assert signature.vector.dtype == np.uint8
    assert signature.vector.shape == (25 * 8 * 2,)
    assert signature.model_id == small_signer.model.id
    assert len(signature.n_patches) == len(signature.n_pairs) == 2
    pairs = zip(signature.n_pairs, signature.n_patches, strict=True)
    ratio = signature.n_patches[0] / signature.n_patches[1]
    assert ratio == pytest.approx(2**0.5, abs=0.03)
    assert all(0 < n <= p * (p - 1) for n, p in pairs)


def test_same_bytes_in_any_thread_and_order(small_signer, room_frames):
    alone = [sign(frame, small_signer).vector.tobytes() for frame in room_frames]
    with ThreadPoolExecutor(4) as pool:
        jobs = [pool.submit(sign, frame, small_signer) for frame in room_frames[::-1] * 2]
        threaded = [job.result().vector.tobytes() for job in jobs]
    assert threaded == alone[::-1] * 2
    assert len(set(alone)) == len(alone)


def test_stages_add_up_to_sign(small_signer, room_frames):
    model = small_signer.model
    patches = describe(room_frames[2], model.parameters)
    psi = float_signature([table_statistics(x, small_signer) for x in patches.levels], model)
    expected = quantise(psi, model.quantiser_step)
    np.testing.assert_array_equal(sign(room_frames[2], small_signer).vector, expected)
    np.testing.assert_array_equal(encode(patches, small_signer).vector, expected)
    half = len(psi) // 2
    assert np.linalg.norm(psi[:half]) == pytest.approx(1.0, abs=1e-12)
    assert np.linalg.norm(psi[half:]) == pytest.approx(1.0, abs=1e-12)


def test_distance_of_two_models_is_an_error_that_names_both(small_model, small_signer, room_frames):
    a = sign(room_frames[0], small_signer)
    other = open_signer(replace(small_model, quantiser_step=0.004), cached=False)
    b = sign(room_frames[0], other)
    with pytest.raises(ModelMismatch) as error:
        distance(a, b)
    assert small_model.id[:12] in str(error.value)
    assert other.model.id[:12] in str(error.value)
    assert distance(a, a) == 0
    assert distance(a, sign(room_frames[1], small_signer)) > 0


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        (flat(0.0), "every depth sample is missing"),
        (flat(0.01), "Check the depth scale"),
        (flat(1.0, Intrinsics(2, 1, 500.0, 500.0, 0.5, 0.0)), "2 x 1 samples show no surface"),
    ],
)
def test_frames_with_nothing_to_sign(small_signer, frame, message):
    with pytest.raises(UselessFrame, match=message):
        sign(frame, small_signer)


def test_one_patch_has_no_pair(small_model):
    few = replace(
        small_model.parameters,
        segmentation=replace(small_model.parameters.segmentation, n_patches=1),
    )
    signer = open_signer(replace(small_model, parameters=few), cached=False)
    with pytest.raises(UselessFrame, match="no two surface patches lie within 3 m"):
        sign(flat(2.0), signer)


def test_any_depth_signs_or_says_why(small_signer):
    rng = np.random.default_rng(3)
    outcomes = {"signed": 0, "useless": 0}
    for _ in range(40):
        height, width = (int(x) for x in rng.integers(1, 200, 2))
        f = float(10 ** rng.uniform(-1, 4))
        camera = Intrinsics(width, height, f, f, float(rng.normal(0, 300)), height / 2)
        plane = rng.normal(0, 0.01, 2)
        y, x = np.mgrid[:height, :width]
        depth = (3 + plane[0] * x + plane[1] * y).astype(np.float32)
        depth[rng.random(depth.shape) < rng.uniform(0, 0.6)] = rng.choice([0, np.nan, np.inf, -1])
        try:
            signature = sign(DepthFrame(depth, camera), small_signer)
            assert signature.n_pairs[0] > 0
            outcomes["signed"] += 1
        except UselessFrame:
            outcomes["useless"] += 1
    assert min(outcomes.values()) >= 5
