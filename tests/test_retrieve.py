"""Tests of the paper's Fig. 1 as functions: retrieve, diversify, associate, locate."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sceneprint.errors import ModelMismatch
from sceneprint.geometry.registration.patch_descriptors import compress, patch_descriptors
from sceneprint.geometry.retrieval.ranking import Ranking
from sceneprint.geometry.retrieval.ranking import diversify as select
from sceneprint.geometry.signature.segmentation import extract_patches, segment
from sceneprint.geometry.validation.validation import expected_error, rank_accepted
from sceneprint.models import read_model
from sceneprint.pipeline import (
    Signature,
    associate,
    diversify,
    geometry_of,
    prepare,
    retrieve,
    sign,
    validate,
)
from sceneprint.signing import see
from sceneprint.types import DepthFrame, Geometry
from sceneprint_lab.synth import KINECT, take, trajectory
from sceneprint_lab.synth.dataset import room_and_rng
from tests.test_localization import outcome, shifted


def signature(*values, model_id="a" * 64):
    return Signature(np.array(values, np.uint8), model_id, (5,), (20,), "l1")


def ranked(model, *indices):
    """A ranking of these rows, 10, 20 and so on away."""
    far = 10 * np.arange(1, len(indices) + 1)
    return Ranking(np.array(indices, np.intp), far, 1 - far / model.unrelated_distance)


@pytest.fixture
def model_a(small_model):
    """The small model by the id that signatures have here."""
    named = replace(small_model)
    vars(named)["id"] = "a" * 64
    return named


def test_retrieve_by_hand(model_a):
    query = signature(10, 10, 10)
    rows = ((10, 10, 13), (255, 0, 0), (10, 9, 10), (7, 10, 10))
    database = [signature(*row) for row in rows]
    ranking = retrieve(query, database, model_a)
    assert ranking.indices.tolist() == [2, 0, 3, 1]
    assert ranking.distances.tolist() == [1, 3, 3, 265]
    # d0 of the model is 1000
    np.testing.assert_allclose(ranking.similarities, [0.999, 0.997, 0.997, 0.735])
    assert retrieve(query, database, model_a, 2).indices.tolist() == [2, 0]
    assert retrieve(query, database, model_a, 0).indices.tolist() == []


def test_how_many_are_retrieved(model_a):
    database = [signature(number % 256, number // 256) for number in range(600)]
    for n, size in ((49, 49), (51, 50), (200, 80), (600, 200)):
        assert len(retrieve(database[0], database[:n], model_a)) == size


def test_an_empty_database(model_a):
    for size in (None, 0, 5):
        ranking = retrieve(signature(1, 2, 3), [], model_a, size)
        assert len(ranking) == 0
        assert (ranking.distances.dtype, ranking.similarities.shape) == (np.int64, (0,))
        chosen = diversify(ranking, [], 10)
        assert (chosen.indices.tolist(), chosen.gains.tolist()) == ([], [])
        assert associate(never(), ranking, [], unopened) == []


def test_signatures_of_two_models_are_not_compared(model_a):
    mixed = [signature(1, 2), signature(1, 2, model_id="b" * 64)]
    other = replace(model_a)
    vars(other)["id"] = "b" * 64
    with pytest.raises(ModelMismatch, match="aaaaaaaaaaaa and bbbbbbbbbbbb"):
        retrieve(signature(1, 2), mixed, model_a)
    with pytest.raises(ModelMismatch, match="bbbbbbbbbbbb and aaaaaaaaaaaa"):
        retrieve(mixed[1], mixed[:1], other)
    # d0 of another model would make similarities that mean nothing
    with pytest.raises(ModelMismatch, match="bbbbbbbbbbbb and aaaaaaaaaaaa"):
        retrieve(mixed[1], mixed[1:], model_a)


def test_diversify_is_the_selection_from_distances_among_the_ranking(model_a):
    rng = np.random.default_rng(1)
    database = [signature(*rng.integers(0, 256, 30).tolist()) for _ in range(25)]
    database += database[:5]  # and duplicates, which add nothing
    query = signature(*rng.integers(0, 256, 30).tolist())
    ranking = retrieve(query, database, model_a, 20)
    rows = np.array([database[i].vector for i in ranking.indices], int)
    among = np.abs(rows[:, None] - rows[None]).sum(axis=2)
    chosen = diversify(ranking, database, 6)
    expected = select(ranking.distances.astype(float), among.astype(float), 6)
    assert chosen.indices.tolist() == expected.indices.tolist()
    np.testing.assert_array_equal(chosen.gains, expected.gains)
    assert chosen.indices[0] == 0
    assert len(diversify(ranking, database).indices) == 10


def test_prepare_is_sign_and_geometry_of_one_look(small_signer, room_frames):
    model = small_signer.model
    signature, geometry = prepare(room_frames[0], small_signer)
    np.testing.assert_array_equal(signature.vector, sign(room_frames[0], small_signer).vector)
    seen = see(room_frames[0], model.parameters)
    alone = geometry_of(seen, model)
    assert alone.surface is seen
    np.testing.assert_array_equal(geometry.surface.points, seen.points)
    np.testing.assert_array_equal(geometry.descriptors, alone.descriptors)
    assert geometry.model_id == signature.model_id == model.id
    # the patches are of their own segmentation, the descriptors of its surroundings
    p = model.parameters
    patches = extract_patches(seen, segment(seen, p.validation_segmentation))
    np.testing.assert_array_equal(geometry.patches.means, patches.means)
    expected = compress(patch_descriptors(patches, p.surroundings), model.compression)
    np.testing.assert_array_equal(geometry.descriptors, expected)
    assert geometry.descriptors.dtype == np.uint8
    assert 250 < len(patches) < 450  # 400 cells


def never():
    return Geometry(None, None, None, "a" * 64)


def unopened(index):
    raise AssertionError(f"row {index} was opened")


def test_artifacts_of_two_models_are_not_compared(small_model):
    other = replace(never(), model_id="b" * 64)
    with pytest.raises(ModelMismatch, match="aaaaaaaaaaaa and bbbbbbbbbbbb"):
        validate(never(), other)
    with pytest.raises(ModelMismatch, match="bbbbbbbbbbbb and aaaaaaaaaaaa"):
        associate(other, ranked(small_model, 4), [0], lambda _: never())


@pytest.fixture(scope="module")
def walk():
    """Three views along a path in one room, and a view of another room."""
    model = read_model("paper")
    frames = []
    for number, views in ((3, (24, 36, 48)), (1, (0,))):
        room, rng = room_and_rng(11, number)
        poses = trajectory(room, 61, rng)
        frames += [DepthFrame(take(room, poses[i], KINECT, rng), KINECT) for i in views]
    return [geometry_of(see(frame, model.parameters), model) for frame in frames]


def test_candidates_are_tried_in_order_until_enough(small_model, walk):
    query, near, far, elsewhere = walk
    rows = {40: elsewhere, 10: far, 30: near, 20: query}
    ranking = ranked(small_model, 40, 10, 30, 20)
    opened = []

    def row(index):
        opened.append(index)
        return rows[index]

    matches = associate(query, ranking, [0, 1, 2, 3], row, 2, 7)
    assert opened == [40, 10, 30]  # enough: the last is not looked at
    # those accepted, what shares most first, then what was not
    assert [m.index for m in matches] == [30, 10, 40]
    assert [m.validation.status for m in matches] == ["accepted", "accepted", "rejected"]
    assert [m.distance for m in matches] == [30, 20, 10]
    assert [m.similarity for m in matches] == pytest.approx([0.97, 0.98, 0.99])
    assert [m.validation.seed for m in matches] == [7, 7, 7]
    alone = validate(query, far, 7)
    assert alone.T_match_query is not None
    assert matches[1].validation.T_match_query is not None
    np.testing.assert_array_equal(matches[1].validation.T_match_query, alone.T_match_query)
    # the paper's test tells nothing of strength
    (only,) = associate(query, ranking, [2], row, 1, 7, mode="paper")
    assert (only.validation.status, only.validation.strength) == ("accepted", "strong")


def test_preferred():
    strong, weak = outcome(), outcome(strength="weak")
    no, unsure = outcome("rejected"), outcome("ambiguous")
    assert rank_accepted([]) == []
    assert rank_accepted([no, unsure]) == []
    assert rank_accepted([weak, no, strong, weak, unsure, strong]) == [2, 5, 0, 3]
    assert rank_accepted([strong, strong]) == [0, 1]  # equals: the order of R


def test_of_cameras_the_least_expected_error_goes_first():
    turned = np.eye(4)
    turned[:2, :2] = [[math.cos(0.5), -math.sin(0.5)], [math.sin(0.5), math.cos(0.5)]]
    # deviations of 1 and 3 cm, and 4 cm for each radian between the views
    near, far, aside = (
        replace(outcome(T=T), covariance=np.eye(6) * deviation**2 / 3)
        for T, deviation in ((shifted(2.0), 0.01), (np.eye(4), 0.03), (turned, 0.01))
    )
    errors = [expected_error(view) for view in (near, far, aside)]
    np.testing.assert_allclose(errors, [0.01, 0.03, math.hypot(0.01, 0.02)], rtol=1e-12)
    weak = replace(near, strength="weak")
    assert rank_accepted([far, weak, near, aside, outcome("rejected")]) == [2, 3, 0, 1]
    assert expected_error(outcome()) == math.inf  # nothing is known of its precision


def test_of_scans_all_around_the_nearest_goes_first():
    far, near, nearest = (outcome(T=shifted(x)) for x in (3.0, -2.0, 1.0))
    weak = outcome(strength="weak", T=shifted(0.5))
    said = [far, weak, near, nearest]
    assert rank_accepted(said) == [0, 2, 3, 1]  # cameras: they share the same, so the order of R
    around = [replace(text, around=True) for text in said]
    assert rank_accepted(around) == [3, 2, 0, 1]
    assert rank_accepted([*around[:3], nearest]) == [0, 2, 3, 1]  # one of a camera: not comparable
    assert rank_accepted([replace(far, around=True)]) == [0]


def test_frames_are_judged_by_the_numbers_of_their_model(room_frames, small_model, small_signer):
    """Of a preset, whoever made the artifacts; of a model of one's own, once it was used."""
    query, match = (prepare(frame, small_signer)[1] for frame in room_frames[:2])
    lidar = read_model("lidar")
    halls = [replace(frame, model_id=lidar.id) for frame in (query, match)]
    p = lidar.parameters.validation
    own, outdoors, indoors = validate(*halls), validate(*halls, p=p), validate(query, match)
    assert (own.reason, own.inliers) == (outdoors.reason, outdoors.inliers)
    assert own.inliers != indoors.inliers
    strict = replace(small_model.parameters.validation, minimum_patches=10_000)
    other = replace(small_model, parameters=replace(small_model.parameters, validation=strict))
    mine = [replace(frame, model_id=other.id) for frame in (query, match)]
    with pytest.raises(ModelMismatch, match=r"has not been used by this process. Pass `p`"):
        validate(*mine)
    geometry = geometry_of(see(room_frames[0], other.parameters), other)
    assert geometry.model_id == other.id
    assert validate(*mine).status == "rejected"
