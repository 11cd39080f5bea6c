"""Codes: the principal components, the same each time, in bounded memory."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from sklearn.decomposition import PCA

from sceneprint.errors import DamagedIndex
from sceneprint.index import codes, fit_code
from sceneprint.index.coarse import read_coarse, train_coarse, write_coarse
from sceneprint.index.codes import draw, read_code, write_code
from sceneprint.types import Bytes

Walk = Callable[..., Bytes]


def test_the_same_rows_and_seed_give_the_same_code(walk: Walk) -> None:
    signatures = walk(1500, 300)
    first, again = fit_code(signatures, seed=3), fit_code(signatures.copy(), seed=3)
    assert first.id == again.id
    assert len(first.id) == 64
    np.testing.assert_array_equal(first.matrix, again.matrix)
    assert fit_code(signatures, seed=4).id != first.id
    assert fit_code(signatures, seed=3, dimension=16).matrix.shape == (16, 300)


def test_axes_are_those_of_scikit_learn(walk: Walk) -> None:
    signatures = walk(600, 9000)  # more columns than are taken at once
    code = fit_code(signatures, dimension=8)
    oracle = PCA(8, svd_solver="full").fit(signatures.astype(np.float64))
    np.testing.assert_allclose(code.mean, oracle.mean_, rtol=1e-6)
    np.testing.assert_allclose(code.matrix @ code.matrix.T, np.eye(8), atol=1e-5)
    agreement = np.abs(np.sum(code.matrix * oracle.components_, axis=1))
    np.testing.assert_allclose(agreement, 1.0, atol=1e-4)


def test_encode_is_the_projection(walk: Walk, monkeypatch: pytest.MonkeyPatch) -> None:
    signatures = walk(500, 2000)
    code = fit_code(signatures)
    expected = (signatures.astype(np.float64) - code.mean) @ code.matrix.T.astype(np.float64)
    found = code.encode(signatures)
    assert found.dtype == np.float32
    assert found.shape == (500, 128)
    scale = np.abs(expected).max()
    np.testing.assert_allclose(found, expected, atol=2e-5 * scale)
    np.testing.assert_allclose(code.encode(signatures[7:8])[0], expected[7], atol=2e-5 * scale)
    monkeypatch.setattr(codes, "_NUMBERS", 6000)  # three rows at once
    np.testing.assert_allclose(code.encode(signatures), expected, atol=2e-5 * scale)
    assert code.encode(signatures[:0]).shape == (0, 128)


@pytest.mark.parametrize("n", [1, 2, 5])
def test_few_rows_span_few_axes(walk: Walk, n: int) -> None:
    code = fit_code(walk(n, 400, walks=n))
    assert code.matrix.shape == (max(n - 1, 1), 400)
    norms = np.linalg.norm(code.matrix, axis=1)
    np.testing.assert_allclose(norms, 1.0 if n > 1 else 0.0, atol=1e-5)


def test_equal_rows_have_equal_codes(walk: Walk) -> None:
    signatures = np.repeat(walk(1, 400), 30, axis=0)
    code = fit_code(signatures)
    assert np.isfinite(code.matrix).all()
    encoded = code.encode(signatures)
    np.testing.assert_array_equal(encoded, np.repeat(encoded[:1], 30, axis=0))


def test_draw_takes_one_row_of_each_stretch() -> None:
    assert draw(5, 7, 0).tolist() == [0, 1, 2, 3, 4]
    drawn = draw(1003, 10, 2)
    assert len(drawn) == 10
    edges = np.arange(11) * 1003 // 10
    assert ((drawn >= edges[:-1]) & (drawn < edges[1:])).all()
    assert draw(1003, 10, 2).tolist() == drawn.tolist() != draw(1003, 10, 3).tolist()


@pytest.mark.parametrize("shape", [(0, 5), (5,)])
def test_no_rows_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="axes of signatures"):
        fit_code(np.zeros(shape, np.uint8))


def test_encode_refuses_other_signatures(walk: Walk) -> None:
    code = fit_code(walk(20, 64))
    for wrong in (np.zeros(64, np.uint8), np.zeros((2, 63), np.uint8), np.zeros((2, 64))):
        with pytest.raises(ValueError, match="not signatures of 64"):
            code.encode(wrong)  # type: ignore[arg-type]


def test_a_code_as_bytes(walk: Walk) -> None:
    code = fit_code(walk(50, 64))
    data = write_code(code)
    again = read_code(data)
    assert again.id == code.id
    np.testing.assert_array_equal(again.mean, code.mean)
    np.testing.assert_array_equal(again.matrix, code.matrix)
    for wrong in (b"", data[:-1], data + b"\0", b"X" + data[1:], data[:6] + b"\2" + data[7:]):
        with pytest.raises(DamagedIndex):
            read_code(wrong)


def test_the_coarse_index_finds_what_a_sort_finds() -> None:
    rng = np.random.default_rng(1)
    known = rng.normal(size=(400, 24)).astype(np.float32)
    query = rng.normal(size=24).astype(np.float32)
    empty = train_coarse(known)
    coarse = empty.appended(np.arange(0), [known[:150], known[150:]])
    assert (len(empty), len(coarse)) == (0, 400)
    order = np.argsort(((known - query) ** 2).sum(axis=1))
    assert len(np.intersect1d(coarse.nearest(query, 50, np.arange(0)), order[:50])) >= 48
    excluded = order[:200]
    found = coarse.nearest(query, 50, excluded)
    assert len(np.intersect1d(found, order[200:250])) >= 48
    # as many as are wanted come back, or all that there are
    assert sorted(coarse.nearest(query, 999, excluded)) == sorted(order[200:])
    assert len(coarse.nearest(query, 5, np.arange(400))) == 0
    # a copy without the nearest, and with others behind
    kept = np.sort(order[100:])
    changed = coarse.appended(kept, [known[order[:1]]])
    assert (len(coarse), len(changed)) == (400, 301)
    assert changed.nearest(query, 1, np.arange(0)).tolist() == [300]
    assert kept[changed.nearest(query, 1, np.array([300]))[0]] in order[100:102]


def test_a_coarse_index_as_bytes() -> None:
    import faiss

    known = np.random.default_rng(1).normal(size=(40, 8)).astype(np.float32)
    coarse = train_coarse(known).appended(np.arange(0), [known])
    data = write_coarse(coarse)
    again = read_coarse(data, 8, 40)
    np.testing.assert_array_equal(
        again.nearest(known[3], 9, np.arange(0)), coarse.nearest(known[3], 9, np.arange(0))
    )
    flat = faiss.IndexFlatL2(8)
    for wrong, dimension, number in (
        (data, 9, 40), (data, 8, 41), (data[:50], 8, 40),
        (faiss.serialize_index(flat).tobytes(), 8, 0),
    ):  # fmt: skip
        with pytest.raises(DamagedIndex):
            read_coarse(wrong, dimension, number)
