"""The paper's Fig. 1 as functions: retrieve, diversify, associate, locate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from sceneprint import pipeline
from sceneprint.errors import ModelMismatch, UselessFrame
from sceneprint.geometry.association import preferred, voters
from sceneprint.geometry.averaging import average_poses
from sceneprint.geometry.diversity import diversify as select
from sceneprint.geometry.retrieval import Ranking
from sceneprint.geometry.segmentation import patches_of, segment
from sceneprint.geometry.surroundings import compress, surroundings
from sceneprint.geometry.validation import Validation
from sceneprint.models import Model
from sceneprint.pipeline import (
    Match,
    Signature,
    Signer,
    associate,
    diversify,
    geometry_of,
    locate,
    prepare,
    retrieve,
    sign,
    validate,
)
from sceneprint.signing import see
from sceneprint.types import Floats, Frame, Geometry, Intrinsics


def signature(*values: int, model_id: str = "a" * 64) -> Signature:
    return Signature(np.array(values, np.uint8), model_id, (5,), (20,))


def outcome(
    status: str = "accepted", strength: str | None = "strong", T: Floats | None = None
) -> Validation:
    """What `validate` might have said."""
    return Validation(
        status,  # type: ignore[arg-type]
        strength if status == "accepted" else None,  # type: ignore[arg-type]
        "as given", np.eye(4) if T is None else T, 0.01, 0.01, 0.5, 0.4, 0.0, 100, 0.0,
        None, 0,
    )  # fmt: skip


def shifted(x: float) -> Floats:
    T = np.eye(4)
    T[0, 3] = x
    return T


def match(index: int, validation: Validation) -> Match:
    return Match(index, 10, 0.5, validation)


def ranked(model: Model, *indices: int) -> Ranking:
    """A ranking of these rows, 10, 20 and so on away."""
    far = 10 * np.arange(1, len(indices) + 1)
    return Ranking(np.array(indices, np.intp), far, 1 - far / model.unrelated_distance)


# retrieve


def test_retrieve_by_hand(small_model: Model) -> None:
    query = signature(10, 10, 10)
    database = [
        signature(10, 10, 13),
        signature(255, 0, 0),
        signature(10, 9, 10),
        signature(7, 10, 10),
    ]
    found = retrieve(query, database, small_model)
    assert found.indices.tolist() == [2, 0, 3, 1]
    assert found.distances.tolist() == [1, 3, 3, 265]
    # d0 of the model is 1000
    np.testing.assert_allclose(found.similarities, [0.999, 0.997, 0.997, 0.735])
    assert retrieve(query, database, small_model, 2).indices.tolist() == [2, 0]
    assert retrieve(query, database, small_model, 0).indices.tolist() == []


def test_how_many_are_retrieved(small_model: Model) -> None:
    rng = np.random.default_rng(0)
    database = [signature(*rng.integers(0, 256, 4).tolist()) for _ in range(600)]
    for n, size in ((49, 49), (51, 50), (200, 80), (600, 200)):
        assert len(retrieve(database[0], database[:n], small_model)) == size


def test_an_empty_database(small_model: Model) -> None:
    for size in (None, 0, 5):
        found = retrieve(signature(1, 2, 3), [], small_model, size)
        assert len(found) == 0
        assert (found.distances.dtype, found.similarities.shape) == (np.int64, (0,))
        chosen = diversify(found, [], 10)
        assert (chosen.indices.tolist(), chosen.gains.tolist()) == ([], [])
        assert associate(never(), found, [], unopened) == []


def test_a_database_of_one_frame(small_model: Model) -> None:
    database = [signature(1, 2, 3)]
    found = retrieve(signature(1, 2, 5), database, small_model)
    assert (found.indices.tolist(), found.distances.tolist()) == ([0], [2])
    chosen = diversify(found, database, 10)
    assert (chosen.indices.tolist(), chosen.gains.tolist()) == ([0], [1.0])


def test_signatures_of_two_models_are_not_compared(small_model: Model) -> None:
    mixed = [signature(1, 2), signature(1, 2, model_id="b" * 64)]
    with pytest.raises(ModelMismatch, match="aaaaaaaaaaaa and bbbbbbbbbbbb"):
        retrieve(signature(1, 2), mixed, small_model)
    with pytest.raises(ModelMismatch, match="bbbbbbbbbbbb and aaaaaaaaaaaa"):
        retrieve(mixed[1], mixed[:1], small_model)


def test_a_frame_of_the_database_finds_itself(
    small_signer: Signer, room_frames: tuple[Frame, ...]
) -> None:
    signed = [sign(frame, small_signer) for frame in room_frames]
    for i, one in enumerate(signed):
        found = retrieve(one, signed, small_signer.model)
        assert (found.indices[0], found.distances[0], found.similarities[0]) == (i, 0, 1.0)
        assert sorted(found.indices.tolist()) == list(range(len(signed)))


# diversify


def test_diversify_is_the_selection_from_distances_among_the_ranking(small_model: Model) -> None:
    rng = np.random.default_rng(1)
    database = [signature(*rng.integers(0, 256, 30).tolist()) for _ in range(25)]
    database += database[:5]  # and duplicates, which add nothing
    query = signature(*rng.integers(0, 256, 30).tolist())
    found = retrieve(query, database, small_model, 20)
    rows = np.array([database[i].vector for i in found.indices], int)
    among = np.abs(rows[:, None] - rows[None]).sum(axis=2)
    chosen = diversify(found, database, 6)
    expected = select(found.distances.astype(float), among.astype(float), 6)
    assert chosen.indices.tolist() == expected.indices.tolist()
    np.testing.assert_array_equal(chosen.gains, expected.gains)
    assert chosen.indices[0] == 0
    assert len(diversify(found, database).indices) == 10


# prepare and geometry_of


def test_prepare_is_sign_and_geometry_of_one_look(
    small_signer: Signer, room_frames: tuple[Frame, ...]
) -> None:
    model = small_signer.model
    made, geometry = prepare(room_frames[0], small_signer)
    np.testing.assert_array_equal(made.vector, sign(room_frames[0], small_signer).vector)
    seen = see(room_frames[0], model.parameters)
    alone = geometry_of(seen, model)
    assert alone.surface is seen
    np.testing.assert_array_equal(geometry.surface.points, seen.points)
    np.testing.assert_array_equal(geometry.descriptors, alone.descriptors)
    assert geometry.model_id == made.model_id == model.id
    # the patches are of their own segmentation, the descriptors of its surroundings
    p = model.parameters
    patches = patches_of(seen, segment(seen, p.validation_segmentation))
    np.testing.assert_array_equal(geometry.patches.means, patches.means)
    expected = compress(surroundings(patches, p.surroundings), model.compression)
    np.testing.assert_array_equal(geometry.descriptors, expected)
    assert (geometry.descriptors.shape, geometry.descriptors.dtype) == (
        (len(patches), 16),
        np.uint8,
    )
    assert 250 < len(patches) < 450  # 400 cells


def test_prepare_of_nothing(small_signer: Signer) -> None:
    k = Intrinsics(64, 48, 60.0, 60.0, 32.0, 24.0)
    with pytest.raises(UselessFrame, match="every depth sample is missing"):
        prepare(Frame(np.zeros((48, 64), np.float32), k), small_signer)


# validate, associate


def never() -> Geometry:
    """An artifact that is not looked into."""
    return Geometry(None, None, None, "a" * 64)  # type: ignore[arg-type]


def unopened(index: int) -> Geometry:
    raise AssertionError(f"row {index} was opened")


def test_artifacts_of_two_models_are_not_compared(small_model: Model) -> None:
    other = replace(never(), model_id="b" * 64)
    with pytest.raises(ModelMismatch, match="aaaaaaaaaaaa and bbbbbbbbbbbb"):
        validate(never(), other)
    with pytest.raises(ModelMismatch, match="bbbbbbbbbbbb and aaaaaaaaaaaa"):
        associate(other, ranked(small_model, 4), [0], lambda _: never())


@pytest.fixture
def judge(monkeypatch: pytest.MonkeyPatch) -> dict[int, Validation]:
    """Verdicts by row of the database, in place of validation; artifacts are rows."""
    verdicts: dict[int, Validation] = {}

    def judged(query: Geometry, row: int, seed: int, p: object, mode: str) -> Validation:
        assert (seed, p, mode) == (7, None, "paper")
        return verdicts[row]

    monkeypatch.setattr(pipeline, "validate", judged)
    return verdicts


def tried(
    judge: dict[int, Validation], ranking: Ranking, among: list[int], k: int = 5
) -> tuple[list[int], list[Match]]:
    opened: list[int] = []

    def row(index: int) -> Geometry:
        opened.append(index)
        return index  # type: ignore[return-value]

    matches = associate(never(), ranking, among, row, k, 7, None, "paper")
    return opened, matches


def test_candidates_are_tried_in_order_until_enough(
    small_model: Model, judge: dict[int, Validation]
) -> None:
    ranking = ranked(small_model, 40, 10, 30, 20, 50)
    judge |= {40: outcome("rejected"), 10: outcome(strength="weak"), 30: outcome(), 20: outcome(),
              50: outcome("ambiguous")}  # fmt: skip
    opened, matches = tried(judge, ranking, [0, 1, 2, 3, 4], 2)
    assert opened == [40, 10, 30]
    # strong before weak, then what was not accepted
    assert [m.index for m in matches] == [30, 10, 40]
    assert [m.distance for m in matches] == [30, 20, 10]
    assert [m.similarity for m in matches] == pytest.approx([0.97, 0.98, 0.99])
    assert [m.validation for m in matches] == [judge[30], judge[10], judge[40]]
    opened, matches = tried(judge, ranking, [0, 1, 2, 3, 4])
    assert opened == [40, 10, 30, 20, 50]
    assert [m.index for m in matches] == [30, 20, 10, 40, 50]
    opened, matches = tried(judge, ranking, [1, 4], 1)
    assert (opened, [m.index for m in matches]) == ([10], [10])
    opened, matches = tried(judge, ranking, [0, 4], 1)
    assert (opened, [m.index for m in matches]) == ([40, 50], [40, 50])


def test_preferred() -> None:
    strong, weak = outcome(), outcome(strength="weak")
    no, unsure = outcome("rejected"), outcome("ambiguous")
    assert preferred([]) == []
    assert preferred([no, unsure]) == []
    assert preferred([weak, no, strong, weak, unsure, strong]) == [2, 5, 0, 3]
    assert preferred([strong, strong]) == [0, 1]


# locate


def test_voters_by_hand() -> None:
    def all_strong(parents: list[str], most: int = 5) -> list[int]:
        return voters(parents, [True] * len(parents), most)

    assert all_strong([]) == []
    assert all_strong(["a"]) == [0]
    assert all_strong(["b", "a", "a", "c"]) == [1, 2]
    # equally many: of the one that comes first
    assert all_strong(["b", "a", "a", "b"]) == [0, 3]
    assert all_strong(["a"] * 8) == [0, 1, 2, 3, 4]
    assert all_strong(["b", *["a"] * 8], 3) == [1, 2, 3]
    # one strong match outvotes two weak ones, and equals are parted by the weak
    assert voters(["b", "a", "a"], [True, False, False]) == [0]
    assert voters(["b", "a", "a"], [True, True, False]) == [1, 2]
    with pytest.raises(ValueError, match="zip"):
        voters(["a"], [])


def test_locate_by_hand() -> None:
    # the pose of the match in the map, then of the query in the match
    turn = np.array([[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]], float)
    found = locate([match(1, outcome(T=shifted(2.0)))], [np.eye(4), turn], ["here", "there"])
    assert found is not None
    np.testing.assert_allclose(found.average.T, turn @ shifted(2.0), atol=1e-12)
    assert found.average.T[:3, 3].tolist() == pytest.approx([5, 8, 7])
    assert (found.average.support, found.average.votes, found.parent) == (1, 1, "there")


def test_locate_averages_accepted_views_only() -> None:
    poses = [np.eye(4)] * 10
    lost = replace(outcome("rejected"), T_match_query=None)
    matches = [
        match(0, outcome(T=shifted(0.0))),
        match(1, outcome(T=shifted(0.04), strength="weak")),
        match(2, outcome("ambiguous", T=shifted(9.0))),
        match(3, outcome("rejected", T=shifted(9.0))),
        match(4, lost),
    ]
    found = locate(matches, poses)
    assert found is not None
    assert (found.average.support, found.average.votes, found.parent) == (2, 2, "")
    assert found.average.T[0, 3] == pytest.approx(0.02)
    assert locate(matches[2:], poses) is None
    assert locate([], poses) is None


def test_locate_combines_poses_of_one_parent_frame() -> None:
    # three matches of a hall, two of a flat whose coordinates mean something else
    parents = ["flat", "hall", "flat", "hall", "hall", "attic"]
    matches = [match(i, outcome(T=shifted(0.01 * i))) for i in (0, 1, 2, 3, 4)]
    found = locate(matches, [np.eye(4)] * 6, parents)
    assert found is not None
    assert (found.parent, found.average.votes) == ("hall", 3)
    assert found.average.T[0, 3] == pytest.approx((0.01 + 0.03 + 0.04) / 3)
    found = locate(matches[:4], [np.eye(4)] * 6, parents)
    assert found is not None
    assert (found.parent, found.average.T[0, 3]) == ("flat", pytest.approx(0.01))


def test_locate_takes_the_first_few() -> None:
    matches = [match(i, outcome(T=shifted(0.01 * i))) for i in range(8)]
    for views in (1, 2, 5, 20):
        found = locate(matches, [np.eye(4)] * 8, views=views)
        assert found is not None
        assert found.average.votes == min(views, 8)
        votes = np.array([shifted(0.01 * i) for i in range(min(views, 8))])
        np.testing.assert_array_equal(found.average.T, average_poses(votes).T)
    default = locate(matches, [np.eye(4)] * 8)
    assert default is not None
    assert default.average.votes == 5
